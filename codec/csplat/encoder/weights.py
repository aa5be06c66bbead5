"""Importance of splats, and the Gauss-Newton blocks that weigh their errors."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.coding_parameters import COLOUR_PER_SH0, CodingParameters
from csplat.encoder.error_bounds import rotation_rows
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32, F64

Floats = NDArray[Any]

_WEIGHT_BLOCK = 1 << 16
_PLAIN_NORM_SHARE = 0.2  # weight of the plain norm in the metric: unmeasured views see the scene from other directions
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
    curvatures: GaussNewtonBlocks | None = None

    def select(self, rows: NDArray[Any]) -> Importance:
        """The same for some of the splats."""

        def some(array: NDArray[Any] | None) -> NDArray[Any] | None:
            return None if array is None else array[rows]

        curvatures = None if self.curvatures is None else self.curvatures.select(rows)
        return Importance(self.sh[rows], some(self.shape), some(self.sh_metric), some(self.shape_metric), curvatures)


def checked_blocks(model: SplatModel, importance: NDArray[Any] | Importance | None) -> GaussNewtonBlocks | None:
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


def sh_metric(
    model: SplatModel, weights: F32 | None, importance: NDArray[Any] | Importance | None
) -> ErrorMetric | None:
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
    metric = _checked_metric("SH matrices", weights, importance.sh_metric, size)
    rows, columns = np.triu_indices(size)
    triangles = metric.triangles.astype(np.float32) * np.float32(1.0 - _PLAIN_NORM_SHARE)
    triangles[:, rows == columns] += np.float32(_PLAIN_NORM_SHARE)
    return ErrorMetric(weights, triangles)


def shape_metric(weights: F32, importance: NDArray[Any] | Importance | None) -> ErrorMetric | None:
    """Return how errors of a covariance's entries weigh together, if that is known; as `sh_metric`."""
    if not isinstance(importance, Importance) or importance.shape_metric is None:
        return None
    return _checked_metric("shape matrices", weights, importance.shape_metric, _SHAPE)


def _checked_metric(name: str, weights: F32, found: NDArray[Any], size: int) -> ErrorMetric:
    wanted = (len(weights), size * (size + 1) // 2)
    if found.shape != wanted or found.dtype.kind != "f":
        raise InputError(f"importance has {name} {found.dtype} {list(found.shape)}, wanted floats {list(wanted)}")
    if not np.isfinite(found).all():
        raise InputError(f"importance has {name} that are not finite")
    return ErrorMetric(weights, found)


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
        for at in range(0, len(model), _WEIGHT_BLOCK):
            part = slice(at, at + _WEIGHT_BLOCK)
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


def apply_weight_floor(measured: NDArray[Any], model: SplatModel) -> NDArray[np.float64]:
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


@dataclass(frozen=True, eq=False)
class ErrorMetric:
    """Weights and matrices that measure the errors of points.

    Attributes:
        weights: [N], >= 0.
        triangles: [N, D (D + 1) / 2], upper triangles of the matrices, row by row.
    """

    weights: Floats
    triangles: Floats

    @property
    def size(self) -> int:
        """D."""
        return _matrix_size(self.triangles)

    def first(self, size: int) -> ErrorMetric:
        """The same for the first `size` parts of a point."""
        rows, columns = np.triu_indices(self.size)
        return ErrorMetric(self.weights, self.triangles[:, (rows < size) & (columns < size)])

    def products(self, a: Floats, b: Floats) -> F64:
        """Return aᵀ M b of every point, [N], without the weights; a and b are [N, D, C]."""
        found = np.empty(len(a))
        for at in range(0, len(a), _WEIGHT_BLOCK):
            part = slice(at, at + _WEIGHT_BLOCK)
            found[part] = np.einsum("nic,nic->n", a[part], matrix_products(self.triangles[part], b[part]))
        return found

    def errors(self, difference: Floats, rows: NDArray[np.intp] | slice) -> F64:
        """Return the errors [n] of points `rows` that are off by `difference` [n, D, C]."""
        triangles, weights = self.triangles[rows], self.weights[rows]
        above, beside = np.triu_indices(self.size)
        found = np.empty(len(difference))
        for at in range(0, len(difference), _WEIGHT_BLOCK):
            part = slice(at, at + _WEIGHT_BLOCK)
            d = difference[part].astype(np.float64)
            products = np.einsum("npc,npc->np", d[:, above], d[:, beside])
            found[part] = np.einsum("np,np->n", products, doubled_triangles(triangles[part])) * weights[part]
        return found


def matrix_products(triangles: Floats, points: Floats) -> F64:
    """[n, D, C]: each matrix times its point."""
    size = points.shape[1]
    above, beside = np.triu_indices(size)
    matrices = np.empty((len(points), size, size))
    matrices[:, above, beside] = triangles
    matrices[:, beside, above] = triangles
    found: F64 = np.einsum("nij,njc->nic", matrices, points.astype(np.float64))
    return found


def doubled_triangles(triangles: Floats) -> F64:
    """Return the triangles with the entries doubled that occur twice in the matrix."""
    above, beside = np.triu_indices(_matrix_size(triangles))
    return np.asarray(triangles * np.where(above == beside, 1.0, 2.0), np.float64)


def _matrix_size(triangles: Floats) -> int:
    """D of triangles [N, D (D + 1) / 2]."""
    return (math.isqrt(8 * int(triangles.shape[1]) + 1) - 1) // 2


#: Attributes whose steps may differ from grade to grade, and how many integers each has.
CLASSED_ATTRIBUTES = {"opacities": 1, "scales": 3, "quats": 3, "means": 3, "sh0": 3}

_BLOCK = 1 << 14  # splats at a time
_TRIANGLE = 21  # entries of a symmetric matrix of 6 by 6
_UNIFORM = 1.0 / 12.0  # squared error of rounding, in squared steps
_ROOT2 = 2.0**0.5


@dataclass(frozen=True, eq=False)
class GaussNewtonBlocks:
    """Diagonals and blocks of the Gauss-Newton matrix of pictures, by splat.

    Errors e of a value add c e² to the squared error of pictures, averaged over pixels and channels.

    Attributes:
        opacities: [N], c of alpha.
        shapes: [N, 21], c of the covariance divided by its trace: upper triangles, row by row, over xx, yy, zz, √2 xy,
            √2 xz, √2 yz.
        means: [N], c of all three coordinates when each of them errs by e scene units in its own direction.
        colours: [N], c of the colour, all of whose channels err by e.
    """

    opacities: Floats
    shapes: Floats
    means: Floats
    colours: Floats

    def select(self, rows: NDArray[np.intp]) -> GaussNewtonBlocks:
        """The same for some of the splats."""
        return GaussNewtonBlocks(*(getattr(self, one.name)[rows] for one in fields(self)))

    def check(self, count: int) -> None:
        """Refuse what is not about `count` splats, negative or not finite."""
        for one in fields(self):
            array = getattr(self, one.name)
            wanted = (count, _TRIANGLE) if one.name == "shapes" else (count,)
            if array.shape != wanted or array.dtype.kind != "f":
                found = f"{array.dtype} {list(array.shape)}"
                raise InputError(f"curvatures of {one.name} are {found}, wanted floats {list(wanted)}")
            if not np.isfinite(array).all() or (one.name != "shapes" and (array < 0.0).any()):
                raise InputError(f"curvatures of {one.name} are negative or not finite")


def rounding_errors(model: SplatModel, curvatures: GaussNewtonBlocks, parameters: CodingParameters) -> F64:
    """Estimate the squared error of renders that rounding to the plan's lattices adds, in linear approximation.

    Args:
        model: the scene.
        curvatures: curvatures of its splats.
        parameters: the lattices.

    Returns:
        [N, 5] float64, >= 0, by splat and attribute, in the order of `CLASSED_ATTRIBUTES`; proportional to step².
        Not finite if a scene is so large that squares leave float64.
    """
    errors = np.empty((len(model), len(CLASSED_ATTRIBUTES)))
    squared_levels = float(parameters.opacity_levels) ** 2
    # Squared error that the RGB channels get from rounding Y, Co and Cg, in squared steps.
    seen = COLOUR_PER_SH0**2 * (1.0 + 4.0**parameters.chroma_shift * (1.0 / 4.0 + 1.0 / 6.0))
    # A component of a quaternion errs by half the angle.
    angle = 2.0 / (parameters.quat_levels * np.sqrt(2.0))
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.square(
            np.array([parameters.scale_step, angle, parameters.lattice.step, parameters.sh0_step], np.float64)
        )
        alpha = np.maximum(model.opacities.astype(np.float64), 0.25 / squared_levels)
        errors[:, 0] = curvatures.opacities * alpha * (4.0 / squared_levels)  # alpha = q² / M²
        errors[:, 3] = curvatures.means.astype(np.float64) * steps[2]
        errors[:, 4] = curvatures.colours * (seen * steps[3])
        for at in range(0, len(model), _BLOCK):
            part = slice(at, at + _BLOCK)
            sizes, turns = _shape_blocks(model, curvatures, part)
            errors[part, 1], errors[part, 2] = sizes * steps[0], turns * steps[1]
        errors *= _UNIFORM
    return np.maximum(errors, 0.0, out=errors)


def _shape_blocks(model: SplatModel, curvatures: GaussNewtonBlocks, part: slice) -> tuple[F64, F64]:
    """Return the summed curvatures of the three log scales and of the three angles, [n] each."""
    axes = [np.stack(axis) for axis in zip(*rotation_rows(model.quats[part].T), strict=True)]
    scales = model.scales[part].T.astype(np.float64)
    variances = np.exp(2.0 * (scales - scales.max(axis=0)))
    variances /= variances.sum(axis=0)
    triangles = curvatures.shapes[part].T.astype(np.float64)
    sizes, turns = np.zeros(scales.shape[1]), np.zeros(scales.shape[1])
    for first in range(3):
        second = (first + 1) % 3
        sizes += _quadratic_form(triangles, variances[first] * _symmetric_product(axes[first], axes[first]))
        turns += _quadratic_form(
            triangles, (variances[first] - variances[second]) * _symmetric_product(axes[first], axes[second])
        )
    return sizes, turns


def _symmetric_product(a: F64, b: F64) -> F64:
    """Entries xx, yy, zz, √2 xy, √2 xz, √2 yz of a bᵀ + b aᵀ, [6, n]."""
    square = [2.0 * a[i] * b[i] for i in range(3)]
    mixed = [_ROOT2 * (a[i] * b[j] + a[j] * b[i]) for i, j in ((0, 1), (0, 2), (1, 2))]
    return np.stack(square + mixed)


def _quadratic_form(triangles: F64, vectors: F64) -> F64:
    """vᵀ H v, [n], of upper triangles [21, n] and vectors [6, n]."""
    total = np.zeros(vectors.shape[1])
    for place, (i, j) in enumerate(zip(*np.triu_indices(6), strict=True)):
        total += (1.0 if i == j else 2.0) * triangles[place] * vectors[i] * vectors[j]
    return total
