"""Importance of each splat for renders: given by the caller, or opacity × projected size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.curvature import Curvatures
from csplat.encoder.metric import Metric
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32

_BLOCK = 1 << 16
_RIDGE = 0.2  # weight of the plain norm in the metric: unmeasured views see the scene from other directions
_SHAPE = 6  # distinct entries of a covariance
_GUESSED = 0.5  # share of what opacity and size suggest that a measured weight has at least
_COMMON = 0.99  # fraction of the splats whose size is not an outlier
_LARGEST_LOG = 80.0  # log sizes beyond ± this are treated as equal: float32 holds the weights


@dataclass(frozen=True, eq=False)
class Importance:
    """Weights of squared errors by attribute, of which only ratios matter.

    Attributes:
        sh: [N], finite, >= 0, weight of an SH coefficient.
        shape: [N], weight of the covariance divided by its trace; `None`: as `sh`.
        sh_metric: [N, K (K + 1) / 2], by how much the errors of two coefficients of bands 1 to d weigh together: the
            upper triangle, row by row, of a positive semidefinite matrix whose mean diagonal is 1 for splats that were
            seen; `None`: all weigh alike, each for itself.
        shape_metric: [N, 21], the same for xx, yy, zz, √2 xy, √2 xz, √2 yz of the covariance divided by its trace.
        curvatures: squared error of renders per error of opacities, shapes, centres and colours, in absolute terms, not
            only in ratios: with it, splats are sorted into quantisation classes (grades.py).
    """

    sh: NDArray[Any]
    shape: NDArray[Any] | None = None
    sh_metric: NDArray[Any] | None = None
    shape_metric: NDArray[Any] | None = None
    curvatures: Curvatures | None = None

    def select(self, rows: NDArray[Any]) -> Importance:
        """The same for some of the splats."""

        def some(array: NDArray[Any] | None) -> NDArray[Any] | None:
            return None if array is None else array[rows]

        curvatures = None if self.curvatures is None else self.curvatures.select(rows)
        return Importance(self.sh[rows], some(self.shape), some(self.sh_metric), some(self.shape_metric), curvatures)


def known_curvatures(model: SplatModel, importance: NDArray[Any] | Importance | None) -> Curvatures | None:
    """Return what pictures lose by errors, if that is known.

    Raises:
        InputError: it is about another number of splats, negative, or not finite.
    """
    if not isinstance(importance, Importance) or importance.curvatures is None:
        return None
    importance.curvatures.check(len(model))
    return importance.curvatures


def shape_weights(model: SplatModel, importance: NDArray[Any] | Importance | None) -> F32:
    """Return the weight of the squared error of each splat's covariance over its trace, as `splat_weights` does."""
    if isinstance(importance, Importance):
        importance = importance.sh if importance.shape is None else importance.shape
    return splat_weights(model, importance)


def sh_metric(model: SplatModel, weights: F32 | None, importance: NDArray[Any] | Importance | None) -> Metric | None:
    """Return how errors of SH coefficients weigh together, if that is known.

    Args:
        model: the scene.
        weights: [N], as `splat_weights` returns them.
        importance: importance given by the caller.

    Raises:
        InputError: matrices of another number or size, or not finite.
    """
    if weights is None or not isinstance(importance, Importance) or importance.sh_metric is None:
        return None
    size = model.shN.shape[1]
    metric = _metric("SH matrices", weights, importance.sh_metric, size)
    rows, columns = np.triu_indices(size)
    triangles = metric.triangles.astype(np.float32) * np.float32(1.0 - _RIDGE)
    triangles[:, rows == columns] += np.float32(_RIDGE)
    return Metric(weights, triangles)


def shape_metric(weights: F32, importance: NDArray[Any] | Importance | None) -> Metric | None:
    """Return how errors of a covariance's entries weigh together, if that is known; as `sh_metric`."""
    if not isinstance(importance, Importance) or importance.shape_metric is None:
        return None
    return _metric("shape matrices", weights, importance.shape_metric, _SHAPE)


def _metric(name: str, weights: F32, found: NDArray[Any], size: int) -> Metric:
    wanted = (len(weights), size * (size + 1) // 2)
    if found.shape != wanted or found.dtype.kind != "f":
        raise InputError(f"importance has {name} {found.dtype} {list(found.shape)}, wanted floats {list(wanted)}")
    if not np.isfinite(found).all():
        raise InputError(f"importance has {name} that are not finite")
    return Metric(weights, found)


def splat_weights(model: SplatModel, importance: NDArray[Any] | Importance | None) -> F32:
    """Return the weight of each splat's squared error, [N] float32, >= 0; only ratios matter.

    The cheap weight is alpha · √(σ1 σ2) with the two larger standard deviations, alpha times the size of its shadow:
    alpha times its area would follow from the pictures' error if nothing were hidden, but in captures the largest
    splats are background that little is seen of; the root served all scenes tried better.

    Args:
        model: the scene.
        importance: [N], finite, >= 0, or None; of an `Importance` that of SH.

    Raises:
        InputError: an importance of another shape or type, negative or not finite.
    """
    if isinstance(importance, Importance):
        importance = importance.sh
    if importance is None:
        weights = np.empty(len(model), np.float32)
        for at in range(0, len(model), _BLOCK):
            part = slice(at, at + _BLOCK)
            scales = model.scales[part]
            with np.errstate(over="ignore"):  # infinity is clipped like all that is too large
                size = (scales.sum(axis=1) - scales.min(axis=1)) * np.float32(0.5)
            np.clip(size, -_LARGEST_LOG, _LARGEST_LOG, out=size)
            weights[part] = model.opacities[part] * np.exp(size)
        return weights
    given = np.asarray(importance)
    if given.shape != (len(model),):
        raise InputError(f"importance has shape {given.shape}, wanted ({len(model)},)")
    if given.dtype.kind not in "biuf":
        raise InputError(f"importance has dtype {given.dtype}, wanted real numbers")
    values = given.astype(np.float64)
    if not (np.isfinite(values).all() and (values >= 0).all()):
        raise InputError("importance has negative or non-finite values")
    top = float(values.max(initial=0.0))
    return (values / top if top > 0 else values + 1.0).astype(np.float32)


def trusted(measured: NDArray[Any], model: SplatModel) -> NDArray[np.float64]:
    """Measured weights of which none is far below what the splat's opacity and size suggest.

    Other views see more of what the measured views hardly saw; and if a splat is hidden or small, a large error
    has more effect than the slope at its place suggests.

    Args:
        measured: [N] or [N, A], >= 0.
        model: the scene.

    Returns:
        As `measured`, float64: at least half of the column's mean times the cheap weight over its mean.
    """
    suggested = splat_weights(model, None).astype(np.float64)
    suggested = np.minimum(suggested, np.quantile(suggested, _COMMON)) if len(suggested) else suggested
    mean = float(suggested.mean()) if len(suggested) else 0.0
    least = _GUESSED * (suggested / mean if mean > 0.0 else np.ones_like(suggested))
    floor: NDArray[np.float64] = np.multiply.outer(least, measured.mean(axis=0, dtype=np.float64))
    result: NDArray[np.float64] = np.maximum(measured, floor)
    return result
