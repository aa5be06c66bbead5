"""Importance of splats, and how much errors of their values show in renders.

Importance is one number per splat. Gauss-Newton blocks are matrices: errors e of a splat's values add eᵀ M e to the
squared error of renders. They are measured by a renderer; without one, importance is guessed from opacity and size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.coding_parameters import CodingParameters
from csplat.encoder.error_bounds import rotation_rows
from csplat.errors import InputError
from csplat.model import SH_C0, SplatModel
from csplat.types import F32, F64

Floats = NDArray[Any]
Rows = NDArray[np.intp]

#: Attributes whose steps may differ between quantisation classes, and the number of integers of each.
CLASSED_ATTRIBUTES = {"opacities": 1, "scales": 3, "quats": 3, "means": 3, "sh0": 3}

_WEIGHT_BLOCK = 1 << 16  # splats per block of temporaries: one number each,
_METRIC_BLOCK = 1 << 12  # a matrix each,
_SHAPE_BLOCK = 1 << 14  # a few vectors each
_PLAIN_NORM_SHARE = 0.2  # share of the identity in a metric: other views see the scene from other directions
_SHAPE = 6  # distinct entries of a covariance
_TRIANGLE = 21  # distinct entries of a symmetric 6 × 6 matrix
_FLOOR = 0.5  # a measured weight is at least this fraction of the guessed one
_COMMON = 0.99  # quantile of the guessed weights above which they are clipped
_LOG_SIZE_MAX = 80.0  # log sizes beyond ± this are treated as equal: float32 holds the weights
_UNIFORM = 1.0 / 12.0  # mean squared error of rounding, in squared steps
_ROOT2 = 2.0**0.5


@dataclass(frozen=True, eq=False)
class Importance:
    """Weights of squared errors by attribute; only their ratios matter, except for `blocks`.

    Attributes:
        sh: [N], finite, >= 0, weight of an SH coefficient.
        shape: [N], weight of the covariance divided by its trace; `None`: as `sh`.
        sh_metric: [N, K (K + 1) / 2], Gauss-Newton matrices of the coefficients of bands 1 to d, normalised to a mean
            diagonal of 1 for visible splats: upper triangles, row by row; `None`: the identity.
        shape_metric: [N, 21], the same for xx, yy, zz, √2 xy, √2 xz, √2 yz of the covariance divided by its trace.
        blocks: Gauss-Newton blocks in absolute terms, which allow several quantisation classes.
    """

    sh: Floats
    shape: Floats | None = None
    sh_metric: Floats | None = None
    shape_metric: Floats | None = None
    blocks: GaussNewtonBlocks | None = None

    def select(self, rows: Floats) -> Importance:
        """Return the importance of some of the splats."""

        def select_rows(array: Floats | None) -> Floats | None:
            return None if array is None else array[rows]

        return Importance(
            self.sh[rows],
            select_rows(self.shape),
            select_rows(self.sh_metric),
            select_rows(self.shape_metric),
            None if self.blocks is None else self.blocks.select(rows),
        )


@dataclass(frozen=True, eq=False)
class GaussNewtonBlocks:
    """Diagonals and blocks of the Gauss-Newton matrix of renders, by splat.

    An error e of a value adds c e² to the squared error of renders, averaged over pixels and channels.

    Attributes:
        opacities: [N], c of alpha.
        shapes: [N, 21], c of the covariance divided by its trace: upper triangles, row by row, over xx, yy, zz, √2 xy,
            √2 xz, √2 yz.
        means: [N], c of an error of e scene units in each coordinate.
        colours: [N], c of an error of e in each channel.
    """

    opacities: Floats
    shapes: Floats
    means: Floats
    colours: Floats

    def select(self, rows: Rows) -> GaussNewtonBlocks:
        """Return the blocks of some of the splats."""
        return GaussNewtonBlocks(*(getattr(self, one.name)[rows] for one in fields(self)))

    def check(self, count: int) -> None:
        """Check number, sign and finiteness.

        Raises:
            InputError: an array has another number of splats than `count`, or values that are negative or not finite.
        """
        for one in fields(self):
            array = getattr(self, one.name)
            wanted = (count, _TRIANGLE) if one.name == "shapes" else (count,)
            if array.shape != wanted or array.dtype.kind != "f":
                found = f"{array.dtype} {list(array.shape)}"
                raise InputError(f"curvatures of {one.name} are {found}, expected floats {list(wanted)}")
            if not np.isfinite(array).all() or (one.name != "shapes" and (array < 0.0).any()):
                raise InputError(f"curvatures of {one.name} are negative or not finite")


@dataclass(frozen=True, eq=False)
class ErrorMetric:
    """Errors of points: w eᵀ M e, with a weight and a Gauss-Newton matrix for each point, summed over channels.

    Attributes:
        weights: [N], w >= 0.
        triangles: [N, D (D + 1) / 2], upper triangles of M, row by row.
    """

    weights: Floats
    triangles: Floats

    @property
    def size(self) -> int:
        """D, the size of a matrix."""
        return _matrix_size(self.triangles)

    def first(self, size: int) -> ErrorMetric:
        """Return the metric of the first `size` coordinates of a point."""
        rows, columns = np.triu_indices(self.size)
        return ErrorMetric(self.weights, self.triangles[:, (rows < size) & (columns < size)])

    def products(self, a: Floats, b: Floats) -> F64:
        """Return aᵀ M b of every point, [N], without the weights; a and b are [N, D, C]."""
        found = np.empty(len(a))
        for at in range(0, len(a), _METRIC_BLOCK):
            part = slice(at, at + _METRIC_BLOCK)
            found[part] = np.einsum("nic,nic->n", a[part], matrix_products(self.triangles[part], b[part]))
        return found

    def errors(self, difference: Floats, rows: Rows | slice) -> F64:
        """Return the errors [n] of the points `rows` for the differences [n, D, C]."""
        triangles, weights = self.triangles[rows], self.weights[rows]
        upper_i, upper_j = np.triu_indices(self.size)
        found = np.empty(len(difference))
        for at in range(0, len(difference), _METRIC_BLOCK):
            part = slice(at, at + _METRIC_BLOCK)
            d = difference[part].astype(np.float64)
            products = np.einsum("npc,npc->np", d[:, upper_i], d[:, upper_j])
            found[part] = np.einsum("np,np->n", products, doubled_triangles(triangles[part])) * weights[part]
        return found


def splat_weights(model: SplatModel, importance: Floats | Importance | None) -> F32:
    """Return the weight of each splat's squared error, [N] float32, >= 0; only ratios matter.

    The guess is alpha · √(σ1 σ2), with the two larger standard deviations. Without occlusion alpha · σ1 σ2 would follow
    from the error of renders; but in captures the largest splats are mostly hidden background, and the root was
    better in all scenes tried.

    Args:
        model: the scene.
        importance: [N], finite, >= 0, or an `Importance`, whose weights of SH are used; `None`: guess.

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
            np.clip(size, -_LOG_SIZE_MAX, _LOG_SIZE_MAX, out=size)
            weights[part] = model.opacities[part] * np.exp(size)
        return weights
    given = np.asarray(importance)
    if given.shape != (len(model),):
        raise InputError(f"importance has shape {given.shape}, expected ({len(model)},)")
    if given.dtype.kind not in "biuf":
        raise InputError(f"importance has dtype {given.dtype}, expected real numbers")
    values = given.astype(np.float64)
    if not (np.isfinite(values).all() and (values >= 0).all()):
        raise InputError("importance has negative or non-finite values")
    top = float(values.max(initial=0.0))
    return (values / top if top > 0 else values + 1.0).astype(np.float32)


def shape_weights(model: SplatModel, importance: Floats | Importance | None) -> F32:
    """Return the weight of each splat's covariance divided by its trace; see `splat_weights`."""
    if isinstance(importance, Importance):
        importance = importance.sh if importance.shape is None else importance.shape
    return splat_weights(model, importance)


def sh_metric(model: SplatModel, weights: F32 | None, importance: Floats | Importance | None) -> ErrorMetric | None:
    """Return the metric of SH coefficients, if known.

    Args:
        model: the scene.
        weights: [N], see `splat_weights`.
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


def shape_metric(weights: F32, importance: Floats | Importance | None) -> ErrorMetric | None:
    """Return the metric of covariances divided by their trace, if known; see `sh_metric`."""
    if not isinstance(importance, Importance) or importance.shape_metric is None:
        return None
    return _checked_metric("shape matrices", weights, importance.shape_metric, _SHAPE)


def checked_blocks(model: SplatModel, importance: Floats | Importance | None) -> GaussNewtonBlocks | None:
    """Return the Gauss-Newton blocks, if known.

    Raises:
        InputError: see `GaussNewtonBlocks.check`.
    """
    if not isinstance(importance, Importance) or importance.blocks is None:
        return None
    importance.blocks.check(len(model))
    return importance.blocks


def apply_weight_floor(measured: Floats, model: SplatModel) -> F64:
    """Raise measured weights that are far below the guess from opacity and size.

    Other views see more of what the measured views hardly saw; and if a splat is hidden or small, a large error
    has more effect than the gradient at its place suggests.

    Args:
        measured: [N] or [N, A], >= 0.
        model: the scene.

    Returns:
        Like `measured`, float64: at least half of the column's mean, times the guess divided by its mean.
    """
    guessed = splat_weights(model, None).astype(np.float64)
    guessed = np.minimum(guessed, np.quantile(guessed, _COMMON)) if len(guessed) else guessed
    mean = float(guessed.mean()) if len(guessed) else 0.0
    least = _FLOOR * (guessed / mean if mean > 0.0 else np.ones_like(guessed))
    floor: F64 = np.multiply.outer(least, measured.mean(axis=0, dtype=np.float64))
    result: F64 = np.maximum(measured, floor)
    return result


def rounding_errors(model: SplatModel, blocks: GaussNewtonBlocks, parameters: CodingParameters) -> F64:
    """Estimate the squared error of renders caused by rounding, in linear approximation.

    Args:
        model: the scene.
        blocks: Gauss-Newton blocks of its splats.
        parameters: the steps.

    Returns:
        [N, 5] float64, >= 0, by splat and attribute, in the order of `CLASSED_ATTRIBUTES`; proportional to step².
        Not finite if a scene is so large that squares leave float64.
    """
    errors = np.empty((len(model), len(CLASSED_ATTRIBUTES)))
    squared_levels = float(parameters.opacity_levels) ** 2
    # Squared error that the RGB channels get from rounding Y, Co and Cg, in squared steps.
    rgb = SH_C0**2 * (1.0 + 4.0**parameters.chroma_shift * (1.0 / 4.0 + 1.0 / 6.0))
    # A component of a quaternion errs by half the angle.
    angle = 2.0 / (parameters.quat_levels * np.sqrt(2.0))
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.square(
            np.array([parameters.scale_step, angle, parameters.lattice.step, parameters.sh0_step], np.float64)
        )
        alpha = np.maximum(model.opacities.astype(np.float64), 0.25 / squared_levels)
        errors[:, 0] = blocks.opacities * alpha * (4.0 / squared_levels)  # alpha = q² / M²
        errors[:, 3] = blocks.means.astype(np.float64) * steps[2]
        errors[:, 4] = blocks.colours * (rgb * steps[3])
        for at in range(0, len(model), _SHAPE_BLOCK):
            part = slice(at, at + _SHAPE_BLOCK)
            sizes, turns = _shape_curvatures(model, blocks, part)
            errors[part, 1], errors[part, 2] = sizes * steps[0], turns * steps[1]
        errors *= _UNIFORM
    return np.maximum(errors, 0.0, out=errors)


def matrix_products(triangles: Floats, points: Floats) -> F64:
    """Return the product of each matrix and its point, [n, D, C]."""
    size = points.shape[1]
    upper_i, upper_j = np.triu_indices(size)
    matrices = np.empty((len(points), size, size))
    matrices[:, upper_i, upper_j] = triangles
    matrices[:, upper_j, upper_i] = triangles
    found: F64 = np.einsum("nij,njc->nic", matrices, points.astype(np.float64))
    return found


def doubled_triangles(triangles: Floats) -> F64:
    """Return the triangles with their off-diagonal entries doubled."""
    upper_i, upper_j = np.triu_indices(_matrix_size(triangles))
    return np.asarray(triangles * np.where(upper_i == upper_j, 1.0, 2.0), np.float64)


def _checked_metric(name: str, weights: F32, found: Floats, size: int) -> ErrorMetric:
    wanted = (len(weights), size * (size + 1) // 2)
    if found.shape != wanted or found.dtype.kind != "f":
        raise InputError(f"importance has {name} {found.dtype} {list(found.shape)}, expected floats {list(wanted)}")
    if not np.isfinite(found).all():
        raise InputError(f"importance has {name} that are not finite")
    return ErrorMetric(weights, found)


def _matrix_size(triangles: Floats) -> int:
    """Return D of triangles [N, D (D + 1) / 2]."""
    return (math.isqrt(8 * int(triangles.shape[1]) + 1) - 1) // 2


def _shape_curvatures(model: SplatModel, blocks: GaussNewtonBlocks, part: slice) -> tuple[F64, F64]:
    """Return the summed second derivatives by the three log scales and the three angles, [n] each."""
    axes = [np.stack(axis) for axis in zip(*rotation_rows(model.quats[part].T), strict=True)]
    scales = model.scales[part].T.astype(np.float64)
    variances = np.exp(2.0 * (scales - scales.max(axis=0)))
    variances /= variances.sum(axis=0)
    triangles = blocks.shapes[part].T.astype(np.float64)
    sizes, turns = np.zeros(scales.shape[1]), np.zeros(scales.shape[1])
    for first in range(3):
        second = (first + 1) % 3
        sizes += _quadratic_form(triangles, variances[first] * _symmetric_product(axes[first], axes[first]))
        turns += _quadratic_form(
            triangles, (variances[first] - variances[second]) * _symmetric_product(axes[first], axes[second])
        )
    return sizes, turns


def _symmetric_product(a: F64, b: F64) -> F64:
    """Return the entries xx, yy, zz, √2 xy, √2 xz, √2 yz of a bᵀ + b aᵀ, [6, n]."""
    square = [2.0 * a[i] * b[i] for i in range(3)]
    mixed = [_ROOT2 * (a[i] * b[j] + a[j] * b[i]) for i, j in ((0, 1), (0, 2), (1, 2))]
    return np.stack(square + mixed)


def _quadratic_form(triangles: F64, vectors: F64) -> F64:
    """Return vᵀ H v, [n], of upper triangles [21, n] and vectors [6, n]."""
    total = np.zeros(vectors.shape[1])
    for place, (i, j) in enumerate(zip(*np.triu_indices(6), strict=True)):
        total += (1.0 if i == j else 2.0) * triangles[place] * vectors[i] * vectors[j]
    return total
