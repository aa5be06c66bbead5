# SPDX-License-Identifier: Apache-2.0
"""Weigh the errors of splats by their effect on renders.

Importance is one number per splat. Gauss-Newton blocks are matrices M: an error e of a splat's values adds eᵀ M e to
the squared error of renders. Both are measured with a renderer; without one, importance is guessed from opacity and
size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.coding_parameters import CodingParameters
from csplat.encoder.error_bounds import rotation_rows
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.portable_math import exp
from csplat.scene_parts import part_of
from csplat.spherical_harmonics import SH_C0
from csplat.types import F32, F64

Floats = NDArray[Any]
Rows = NDArray[np.intp]

#: Attributes whose steps may differ between quantisation classes, and the number of integers of each.
CLASSED_ATTRIBUTES = {"opacities": 1, "scales": 3, "quats": 3, "means": 3, "sh0": 3}

_WEIGHT_BLOCK = 1 << 16  # splats per block of scalar temporaries
_METRIC_BLOCK = 1 << 12  # splats per block of matrices
_SHAPE_BLOCK = 1 << 14  # splats per block of vectors
_PLAIN_NORM_SHARE = 0.3  # share of the identity in the SH metric, as other views have other directions
_SHAPE = 6  # distinct entries of a covariance
_TRIANGLE = 21  # distinct entries of a symmetric 6 × 6 matrix
_FLOOR = 0.5  # minimum of a measured weight, as a fraction of the guessed weight
_COMMON = 0.99  # quantile to which guessed weights are clipped
_LOG_SIZE_MAX = 80.0  # log sizes are clipped to ± this, so that the weights stay within float32
_SH_MAX = 1e37  # largest change of a coefficient by a projection
_UNIFORM = 1.0 / 12.0  # mean squared error of rounding, in squared steps
_ROOT2 = 2.0**0.5


@dataclass(frozen=True, eq=False)
class Importance:
    """Weights of the squared errors of splats; only ratios matter, except in `blocks`.

    Attributes:
        sh: [N], finite, >= 0, weights of the SH coefficients.
        shape: [N], weights of the covariance divided by its trace; `None`: `sh`.
        sh_metric: [N, B (B + 1) / 2], Gauss-Newton matrices of the B = (d + 1)² coefficients of bands 0 to d, which say
            in what directions a splat is seen. Normalised to a mean diagonal of 1 above band 0 for visible splats:
            upper triangles, row by row; `None`: the identity.
        shape_metric: [N, 21], the same for xx, yy, zz, √2 xy, √2 xz, √2 yz of the covariance divided by its trace.
        blocks: Gauss-Newton blocks in absolute units, required for several quantisation classes.
    """

    sh: Floats
    shape: Floats | None = None
    sh_metric: Floats | None = None
    shape_metric: Floats | None = None
    blocks: GaussNewtonBlocks | None = None

    def select(self, rows: Floats) -> Importance:
        """Return the importance of some splats."""

        def select_rows(array: Floats | None) -> Floats | None:
            """Return `rows` of an array; `None` if the importance does not have it."""
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
    """Blocks of the diagonal of the Gauss-Newton matrix of renders, per splat.

    An error e adds c e², or eᵀ M e, to the squared error of renders averaged over pixels and channels.

    Attributes:
        opacities: [N], c for alpha.
        shapes: [N, 21], M for xx, yy, zz, √2 xy, √2 xz, √2 yz of the covariance divided by its trace: upper triangles,
            row by row.
        means: [N], c for an error of e scene units in each coordinate.
        colours: [N], c for an error of e in each channel.
    """

    opacities: Floats
    shapes: Floats
    means: Floats
    colours: Floats

    def select(self, rows: Rows) -> GaussNewtonBlocks:
        """Return the blocks of some splats."""
        return GaussNewtonBlocks(*(getattr(self, field.name)[rows] for field in fields(self)))

    def check(self, count: int) -> None:
        """Raise an `InputError` unless all arrays have `count` rows and are finite and, except `shapes`, >= 0."""
        for field in fields(self):
            array = getattr(self, field.name)
            shape = (count, _TRIANGLE) if field.name == "shapes" else (count,)
            if array.shape != shape or array.dtype.kind != "f":
                actual = f"{array.dtype} {list(array.shape)}"
                raise InputError(f"Gauss-Newton blocks of {field.name} are {actual}, expected floats {list(shape)}")
            if not np.isfinite(array).all() or (field.name != "shapes" and (array < 0.0).any()):
                raise InputError(f"Gauss-Newton blocks of {field.name} are negative or not finite")


@dataclass(frozen=True, eq=False)
class ErrorMetric:
    """A metric w Σ_channels eᵀ M e for each point, with a weight and a Gauss-Newton matrix.

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
        """Return the metric of the first `size` coordinates."""
        rows, columns = np.triu_indices(self.size)
        return ErrorMetric(self.weights, self.triangles[:, (rows < size) & (columns < size)])

    def products(self, a: Floats, b: Floats) -> F64:
        """Return aᵀ M b for every point, [N], without weights; a and b are [N, D, C]."""
        products = np.empty(len(a))
        for start in range(0, len(a), _METRIC_BLOCK):
            part = slice(start, start + _METRIC_BLOCK)
            products[part] = np.einsum("nic,nic->n", a[part], matrix_products(self.triangles[part], b[part]))
        return products

    def errors(self, difference: Floats, rows: Rows | slice) -> F64:
        """Return the weighted squared errors [n] of differences [n, D, C] for the points `rows`."""
        triangles, weights = self.triangles[rows], self.weights[rows]
        upper_i, upper_j = np.triu_indices(self.size)
        errors = np.empty(len(difference))
        for start in range(0, len(difference), _METRIC_BLOCK):
            part = slice(start, start + _METRIC_BLOCK)
            d = difference[part].astype(np.float64)
            products = np.einsum("npc,npc->np", d[:, upper_i], d[:, upper_j])
            errors[part] = np.einsum("np,np->n", products, doubled_triangles(triangles[part])) * weights[part]
        return errors


def splat_weights(model: SplatModel, importance: Floats | Importance | None) -> F32:
    """Return the weights of squared errors, [N] float32, >= 0; only ratios matter.

    Without importance, the weight is α √(σ1 σ2) with the two larger standard deviations. Without occlusion, the error
    of renders would suggest α σ1 σ2. In captures, however, the largest splats are mostly hidden background, and the
    root was better in all scenes tried.

    Args:
        model: the scene.
        importance: [N], finite, >= 0; or an `Importance`, whose `sh` is used; `None`: guess.

    Raises:
        InputError: the importance has the wrong shape or dtype, is negative or not finite.
    """
    if isinstance(importance, Importance):
        importance = importance.sh
    if importance is None:
        weights = np.empty(len(model), np.float32)
        for start in range(0, len(model), _WEIGHT_BLOCK):
            part = slice(start, start + _WEIGHT_BLOCK)
            scales = model.scales[part]
            with np.errstate(over="ignore"):  # infinity is clipped
                size = (scales.sum(axis=1) - scales.min(axis=1)) * np.float32(0.5)
            np.clip(size, -_LOG_SIZE_MAX, _LOG_SIZE_MAX, out=size)
            weights[part] = model.opacities[part] * exp(size)
        return weights
    array = np.asarray(importance)
    if array.shape != (len(model),):
        raise InputError(f"importance has shape {array.shape}, expected ({len(model)},)")
    if array.dtype.kind not in "biuf":
        raise InputError(f"importance has dtype {array.dtype}, expected real numbers")
    values = array.astype(np.float64)
    if not (np.isfinite(values).all() and (values >= 0).all()):
        raise InputError("importance is negative or not finite")
    top = float(values.max(initial=0.0))
    return (values / top if top > 0 else values + 1.0).astype(np.float32)


def shape_weights(model: SplatModel, importance: Floats | Importance | None) -> F32:
    """Return the weights of covariances divided by their trace; see `splat_weights`."""
    if isinstance(importance, Importance):
        importance = importance.sh if importance.shape is None else importance.shape
    return splat_weights(model, importance)


def sh_metric(model: SplatModel, weights: F32 | None, importance: Floats | Importance | None) -> ErrorMetric | None:
    """Return the metric of SH coefficients, if known.

    Args:
        model: the scene.
        weights: [N], see `splat_weights`.
        importance: the caller's importance.

    Raises:
        InputError: the matrices have the wrong number or size, or are not finite.
    """
    if weights is None or not isinstance(importance, Importance) or importance.sh_metric is None:
        return None
    size = model.shN.shape[1] + 1
    metric = _make_metric("SH matrices", weights, importance.sh_metric, size)
    return ErrorMetric(weights, _with_other_views(metric.triangles[:, np.triu_indices(size)[0] > 0]))


def project_sh(model: SplatModel, degree: int, importance: Floats | Importance | None) -> SplatModel:
    """Replace the higher SH bands of a scene by the colours of the lower bands that come closest where splats are seen.

    With the coefficients split into kept and dropped ones, a and b, and the Gauss-Newton matrix M of a splat, the error
    of a change of a is least for M_aa Δa = M_ab b. Without M, dropping bands is best: they are orthogonal.

    Args:
        model: the scene.
        degree: SH degree to keep.
        importance: with `sh_metric`; without it, the bands are only dropped.

    Returns:
        The scene, its bands above `degree` 0.

    Raises:
        InputError: the matrices have the wrong number or size, or are not finite.
    """
    kept, size = (degree + 1) ** 2, model.shN.shape[1] + 1
    sh0, shN = model.sh0.copy(), np.zeros_like(model.shN)
    shN[:, : kept - 1] = model.shN[:, : kept - 1]
    if not isinstance(importance, Importance) or importance.sh_metric is None:
        return replace(model, shN=shN)
    ones = np.ones(len(model), np.float32)
    triangles = _with_other_views(_make_metric("SH matrices", ones, importance.sh_metric, size).triangles)
    for start in range(0, len(model), _METRIC_BLOCK):
        part = slice(start, start + _METRIC_BLOCK)
        matrices = _full_matrices(triangles[part])
        right = matrices[:, :kept, kept:] @ model.shN[part, kept - 1 :]
        change = np.linalg.solve(matrices[:, :kept, :kept], right)
        change[np.abs(change).max(axis=(1, 2)) > _SH_MAX] = 0.0  # would not fit float32
        sh0[part] += change[:, 0].astype(np.float32)
        shN[part, : kept - 1] += change[:, 1:].astype(np.float32)
    return replace(model, sh0=sh0, shN=shN)


def _with_other_views(triangles: Floats) -> F32:
    """Return matrices [N, D (D + 1) / 2] to which other views are added, which see splats from all directions."""
    rows, columns = np.triu_indices(_matrix_size(triangles))
    mixed = triangles.astype(np.float32) * np.float32(1.0 - _PLAIN_NORM_SHARE)
    mixed[:, rows == columns] += np.float32(_PLAIN_NORM_SHARE)
    return mixed


def shape_metric(weights: F32, importance: Floats | Importance | None) -> ErrorMetric | None:
    """Return the metric of covariances divided by their trace, if known; see `sh_metric`."""
    if not isinstance(importance, Importance) or importance.shape_metric is None:
        return None
    return _make_metric("shape matrices", weights, importance.shape_metric, _SHAPE)


def get_blocks(model: SplatModel, importance: Floats | Importance | None) -> GaussNewtonBlocks | None:
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

    Splats that the measured views hardly saw may be visible in others; and for hidden or small splats, a large error
    has more effect than the gradient suggests. The floor is _FLOOR · mean(measured) · guess / mean(guess).

    Args:
        measured: [N] or [N, A], >= 0.
        model: the scene.

    Returns:
        The raised weights, float64.
    """
    guessed = splat_weights(model, None).astype(np.float64)
    guessed = np.minimum(guessed, np.quantile(guessed, _COMMON)) if len(guessed) else guessed
    mean = float(guessed.mean()) if len(guessed) else 0.0
    least = _FLOOR * (guessed / mean if mean > 0.0 else np.ones_like(guessed))
    floor: F64 = np.multiply.outer(least, measured.mean(axis=0, dtype=np.float64))
    result: F64 = np.maximum(measured, floor)
    return result


def rounding_errors(model: SplatModel, blocks: GaussNewtonBlocks, parameters: CodingParameters) -> F64:
    """Estimate the squared error of renders that rounding causes: c step² / 12 for an error coefficient c.

    Args:
        model: the scene.
        blocks: Gauss-Newton blocks of the splats.
        parameters: steps.

    Returns:
        [N, 5] float64, >= 0, by splat and attribute, in the order of `CLASSED_ATTRIBUTES`. Infinite or NaN if squares
        are beyond float64.
    """
    errors = np.empty((len(model), len(CLASSED_ATTRIBUTES)))
    squared_levels = float(parameters.opacity_levels) ** 2
    # Squared error of the RGB channels from rounding Y, Co and Cg, in squared steps.
    rgb = SH_C0**2 * (1.0 + 4.0**parameters.chroma_shift * (1.0 / 4.0 + 1.0 / 6.0))
    # The error of a quaternion's component is half the angle.
    angle = 2.0 / (parameters.quat_levels * np.sqrt(2.0))
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.square(
            np.array([parameters.scale_step, angle, parameters.lattice.step, parameters.sh0_step], np.float64)
        )
        alpha = np.maximum(model.opacities.astype(np.float64), 0.25 / squared_levels)
        errors[:, 0] = blocks.opacities * alpha * (4.0 / squared_levels)  # alpha = q² / M²
        errors[:, 3] = blocks.means.astype(np.float64) * steps[2]
        if parameters.lattice.parts:
            octaves = np.array(parameters.lattice.octaves)[part_of(model.means, parameters.lattice.parts)]
            errors[:, 3] *= 4.0**octaves
        errors[:, 4] = blocks.colours * (rgb * steps[3])
        for start in range(0, len(model), _SHAPE_BLOCK):
            part = slice(start, start + _SHAPE_BLOCK)
            sizes, turns = _shape_curvatures(model, blocks, part)
            errors[part, 1], errors[part, 2] = sizes * steps[0], turns * steps[1]
        errors *= _UNIFORM
    return np.maximum(errors, 0.0, out=errors)


def matrix_products(triangles: Floats, points: Floats) -> F64:
    """Return the products M x, [n, D, C], of upper triangles and points [n, D, C]."""
    products: F64 = np.einsum("nij,njc->nic", _full_matrices(triangles), points.astype(np.float64))
    return products


def doubled_triangles(triangles: Floats) -> F64:
    """Return upper triangles with doubled off-diagonal entries."""
    upper_i, upper_j = np.triu_indices(_matrix_size(triangles))
    return np.asarray(triangles * np.where(upper_i == upper_j, 1.0, 2.0), np.float64)


def _full_matrices(triangles: Floats) -> F64:
    """Return the symmetric matrices [n, D, D] of upper triangles [n, D (D + 1) / 2]."""
    size = _matrix_size(triangles)
    rows, columns = np.triu_indices(size)
    matrices = np.empty((len(triangles), size, size))
    matrices[:, rows, columns] = triangles
    matrices[:, columns, rows] = triangles
    return matrices


def _make_metric(name: str, weights: F32, values: Floats, size: int) -> ErrorMetric:
    """Return the metric of a part of the importance.

    Args:
        name: name of the part in messages.
        weights: [N].
        values: upper triangles, [N, D (D + 1) / 2].
        size: D.

    Raises:
        InputError: the triangles have another shape, are no floats, or are not finite.
    """
    shape = (len(weights), size * (size + 1) // 2)
    if values.shape != shape or values.dtype.kind != "f":
        raise InputError(f"importance has {name} {values.dtype} {list(values.shape)}, expected floats {list(shape)}")
    if not np.isfinite(values).all():
        raise InputError(f"importance has {name} that are not finite")
    return ErrorMetric(weights, values)


def _matrix_size(triangles: Floats) -> int:
    """Return D of triangles [N, D (D + 1) / 2]."""
    return (math.isqrt(8 * int(triangles.shape[1]) + 1) - 1) // 2


def _shape_curvatures(model: SplatModel, blocks: GaussNewtonBlocks, part: slice) -> tuple[F64, F64]:
    """Return the sums of the error coefficients of the three log scales and of the three angles, [n] each.

    With axes a_i and variances v_i of the covariance Σ = Σ_i v_i a_i a_iᵀ, divided by its trace,
        ∂Σ / ∂(log scale i) = 2 v_i a_i a_iᵀ  and  ∂Σ / ∂(angle of a_i and a_j) = (v_i - v_j) (a_i a_jᵀ + a_j a_iᵀ).
    """
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
    for column, (i, j) in enumerate(zip(*np.triu_indices(6), strict=True)):
        total += (1.0 if i == j else 2.0) * triangles[column] * vectors[i] * vectors[j]
    return total
