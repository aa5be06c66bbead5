# SPDX-License-Identifier: Apache-2.0
"""Encode shapes (scales and rotations), with a codebook if that makes the file smaller (spec 6.4.5).

The covariance divided by its trace is clustered, as in Niedermayr, Stumpfegger and Westermann ("Compressed 3D Gaussian
Splatting for Accelerated Novel View Synthesis", CVPR 2024); each splat keeps its trace. The centroid of matrices of
trace 1 has trace 1 and needs no normalisation. `_worth_assigning` chooses the escapes by rate and distortion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.context import Context
from csplat.encoder import entropy
from csplat.encoder.coding_parameters import SAME_STEPS, CodingParameters, StepFactors
from csplat.encoder.container import CODEBOOK_ID_SIZE, FileChunk, IndexedCodebook
from csplat.encoder.encode_options import EncodeOptions
from csplat.encoder.entropy import DeflateSettings, signed_stream
from csplat.encoder.entry_search import search_nearest
from csplat.encoder.error_bounds import covariance_entries
from csplat.encoder.kmeans import cluster, rank_by_frequency, reassign_by_metric
from csplat.encoder.quantisation import (
    canonicalise_shape,
    lattice_exponent,
    lattice_values,
    quat_levels,
    quat_values,
    rotation_on_lattice,
)
from csplat.encoder.splat_importance import ErrorMetric
from csplat.encoder.tiling import TileSplats, quantise_and_sort
from csplat.model import SplatModel
from csplat.types import F32, F64, I16, I32, I64, Mask, null_progress

Integers = NDArray[Any]
Floats = NDArray[Any]

#: Codebook id, above the id of the SH codebook. It does not depend on the SH degree, so that files keep their bytes.
SHAPE_CODEBOOK_ID = 4

_TRACE_STEPS = 2048  # lattice steps per trace; assignments are exact up to norms of about 2,300
_USERS_MIN = 6  # splats per entry, below which an entry costs more bytes than it saves
_ROUNDS = 2  # trainings; splats that escape have no weight in the next training
_METRIC_ROUNDS = 2  # iterations under the metric
_CANDIDATES = 64  # entries tried for a splat under the metric
_SUMMAND_MAX = 0.7  # log scale, beyond which the metric is not linear
_LOG_SIZE_MAX = 30.0  # log scale to which size errors are clipped, to stay within float64
_ESCAPES = 0.05  # fraction of the splats to escape if the importance has no metric
_OFF_DIAGONAL_ROOTS = np.sqrt([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])  # each entry off the diagonal occurs twice
_DIMENSIONS = 6  # dimensions of a shape: an additional bit per splat divides the squared error by 2**(2/6)
_STEPS_MAX = 2.0**20  # steps of the log scales, above which a tile's lattice may be coarser than the file's
_OVERHEAD = 128  # bytes of records, heads and checksums of a codebook
_FLATTEST = 1e-30  # smallest variance as a fraction of the trace; rounding may leave an eigenvalue at 0 or below
_THINNEST = 20.0  # log scales by which an axis of an entry is at most smaller than the largest


@dataclass(frozen=True, eq=False)
class ShapeCodebook:
    """A shape codebook and the assignment of splats to it.

    Attributes:
        entries: [6, K] int32, log scales relative to the largest and x, y, z of the rotation, on the file's lattices.
        index: [N] int32, entry of each splat; K for escaped splats.
        summand: [N] int32, added to the log scales of a splat's entry, in steps; 0 for escaped splats.
    """

    entries: I32
    index: I32
    summand: I32

    @property
    def size(self) -> int:
        """Number of entries."""
        return int(self.entries.shape[1])

    @property
    def escaped(self) -> Mask:
        """True for escaped splats, [N]."""
        return np.asarray(self.index == self.size, np.bool_)

    def part(self, rows: NDArray[np.intp]) -> ShapePart | None:
        """Return the assignment of some splats; `None` if all are escaped."""
        index, summand = self.index[rows], self.summand[rows]
        assigned = np.asarray(index < self.size, np.bool_)
        if not assigned.any():
            return None
        entries = np.take(self.entries, index[assigned], axis=1)
        return ShapePart(index, self.size, assigned, entries[:3] + summand[assigned], entries[3:], summand)

    def select(self, order: NDArray[Any]) -> ShapeCodebook:
        """Return the codebook with the assignment of the splats `order`."""
        return ShapeCodebook(self.entries, self.index[order], self.summand[order])


@dataclass(frozen=True, eq=False)
class ShapePart:
    """The assignment of a tile's splats to a shape codebook.

    Attributes:
        index: [n] int32, entry of each splat; `size` for escaped splats.
        size: number of entries.
        assigned: [n] bool, True for splats that are not escaped.
        scales: [3, assigned] int32, log scales of the assigned splats.
        quats: [3, assigned] int32, x, y, z of their rotations.
        summand: [n] int32; see `ShapeCodebook`.
    """

    index: I32
    size: int
    assigned: Mask
    scales: I32
    quats: I32
    summand: I32


@dataclass(frozen=True)
class QuantisedShape:
    """Scales and rotations of a tile in columns: integers, the exponent of the scales, and decoded values."""

    scales: Integers
    exponent: int
    quats: Integers
    decoded_scales: F32
    decoded_quats: F32


def choose_shapes(
    model: SplatModel,
    weights: F32,
    metric: ErrorMetric | None,
    tiles: Sequence[TileSplats],
    parameters: CodingParameters,
    options: EncodeOptions,
    context: Context,
) -> ShapeCodebook | None:
    """Train a codebook, and assign splats to it.

    Args:
        model: the scene.
        weights: [N], weights of the squared errors of covariances divided by their trace; only ratios matter.
        metric: metric of xx, yy, zz, √2 xy, √2 xz, √2 yz; `None`: the identity, times the weights.
        tiles: tiles of the scene.
        parameters: steps and codings.
        options: `shape_codebook_size`, `shape_escape_fraction`.
        context: threads, seed and progress.

    Returns:
        The codebook, or `None` if it would not make the file smaller.
    """
    size = min(options.shape_codebook_size or 0, len(model) // _USERS_MIN)
    if size < 1:
        return None
    shapes = _shape_input(model, weights, metric, parameters)
    fraction = options.shape_escape_fraction
    if fraction is None and metric is None:
        fraction = _ESCAPES
    training = shapes.weights * shapes.fits
    quiet = replace(context, progress=null_progress)  # k-means would report a stage of its own
    codebook: ShapeCodebook | None = None
    for step in range(_ROUNDS):
        context.progress("shapes", step / _ROUNDS)
        entries, index = _train_entries(shapes, training, size, parameters, quiet)
        errors, summand = _assignment_errors(shapes, entries, index, parameters)
        if fraction is None:
            assigned = _worth_assigning(shapes, errors, index, summand)
        else:
            assigned = _all_but_worst(shapes, errors, fraction)
        if not assigned.any():
            return None
        codebook = _rank_entries(entries, index, summand, assigned)
        training = shapes.weights * assigned
    assert codebook is not None
    codebook = _keep_where_smaller(model, codebook, tiles, parameters)
    context.progress("shapes", 1.0)
    return codebook


def quantise_shape(
    quats: F32,
    scales: F32,
    parameters: CodingParameters,
    part: ShapePart | None = None,
    factors: StepFactors = SAME_STEPS,
) -> QuantisedShape:
    """Quantise the shapes of a tile in canonical axis order.

    Args:
        quats: [n, 4], w x y z.
        scales: [n, 3], log standard deviations.
        parameters: steps; `canonical` if shapes are in canonical axis order already.
        part: codebook assignment; assigned splats take the integers of their entries.
        factors: step factors of the tile; not together with a codebook.
    """
    rotation, sorted_scales = _canonical(quats, scales, parameters)
    exponent = max(factors.scales, lattice_exponent(float(np.abs(sorted_scales).max()), parameters.scale_step))
    step = math.ldexp(parameters.scale_step, exponent)
    n = np.rint(sorted_scales.astype(np.float64) / step).astype(np.int64)
    q = quat_levels(rotation, parameters.quat_levels, factors.quats)
    if part is not None:
        n[:, part.assigned], q[:, part.assigned] = part.scales, part.quats
    return QuantisedShape(n, exponent, q, lattice_values(n, step), quat_values(q, parameters.quat_levels))


def dequantise_shapes(
    quats: F32,
    scales: F32,
    tiles: Sequence[TileSplats],
    parameters: CodingParameters,
    shapes: ShapeCodebook | None = None,
) -> tuple[F32, F32]:
    """Return rotations [N, 4] and log scales [N, 3] as decoded."""
    decoded = np.empty_like(quats), np.empty_like(scales)
    for tile in tiles:
        part = None if shapes is None else shapes.part(tile.rows)
        shape = quantise_shape(quats[tile.rows], scales[tile.rows], parameters, part, tile.factors)
        decoded[0][tile.rows], decoded[1][tile.rows] = shape.decoded_quats.T, shape.decoded_scales.T
    return decoded


def shape_blocks(
    scales: Integers, exponent: int, quats: Integers, part: ShapePart | None, deflate: DeflateSettings
) -> list[bytes]:
    """Return the blocks of a tile's scales and quats [3, n], with a codebook if `part` is given."""
    if part is None:
        return [
            entropy.offset_block(_spec.ATTRIBUTE_SCALES, scales, exponent, deflate),
            entropy.signed_block(_spec.ATTRIBUTE_QUATS, quats, 0, deflate),
        ]
    assert exponent == 0, "codebooks are on the file's lattice"
    escaped = ~part.assigned
    count = int(np.count_nonzero(escaped))
    own_scales = own_quats = b""
    if count:
        own_scales = entropy.offset_block(_spec.ATTRIBUTE_SCALES, scales[:, escaped], 0, deflate)
        own_quats = entropy.signed_block(_spec.ATTRIBUTE_QUATS, quats[:, escaped], 0, deflate)
    return [
        entropy.codebook_block(
            _spec.ATTRIBUTE_SCALES, SHAPE_CODEBOOK_ID, part.index, count, own_scales, deflate, summand=part.summand
        ),
        entropy.codebook_block(_spec.ATTRIBUTE_QUATS, SHAPE_CODEBOOK_ID, None, count, own_quats, deflate),
    ]


def shape_codebook_chunk(codebook: ShapeCodebook, deflate: DeflateSettings) -> tuple[IndexedCodebook, FileChunk]:
    """Return the index record and the chunk of a codebook."""
    head = _spec.pack_codebook_head(_spec.CodebookHead(SHAPE_CODEBOOK_ID, 0, 0))
    stream = signed_stream(np.ascontiguousarray(codebook.entries).reshape(-1), deflate)
    record = IndexedCodebook(SHAPE_CODEBOOK_ID, _spec.CODEBOOK_KIND_SHAPE, (0, 0), codebook.size)
    return record, FileChunk(_spec.CHUNK_CODEBOOK, head + stream, SHAPE_CODEBOOK_ID)


def unit_covariances(quats: Floats, scales: Floats) -> tuple[F64, F64]:
    """Return covariances divided by their trace, Σ / tr Σ, and log sizes, ½ ln tr Σ.

    Args:
        quats: [4, n], w x y z.
        scales: [3, n], log standard deviations.

    Returns:
        [6, n] float64, xx, yy, zz, xy, xz, yz; [n] float64.
    """
    wide = scales.astype(np.float64)
    top = wide.max(axis=0)
    variances = np.exp(2.0 * (wide - top))
    trace = variances.sum(axis=0)
    return covariance_entries(quats, variances / trace), top + 0.5 * np.log(trace)


def mean_axes(covariances: F64) -> tuple[F32, F32]:
    """Return rotations [n, 4] and log standard deviations [n, 3] of covariances [6, n], in any axis order.

    Σ = R diag(σ²) Rᵀ: columns of R are eigenvectors, σ² eigenvalues.
    """
    xx, yy, zz, xy, xz, yz = covariances
    matrices = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    values, axes = np.linalg.eigh(matrices)
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]  # turns a reflection into a rotation
    scales = 0.5 * np.log(np.maximum(values, _FLATTEST))
    return _quaternions(axes).astype(np.float32), scales.astype(np.float32)


def _canonical(quats: F32, scales: F32, parameters: CodingParameters) -> tuple[F32, F32]:
    """Return quats [n, 4] and scales [n, 3] as columns [4, n] and [3, n] in canonical axis order.

    With `parameters.canonical` they are in this order already.
    """
    if parameters.canonical:
        return quats.T, scales.T
    if not parameters.sorts_axes:
        return rotation_on_lattice(quats, parameters.quat_levels), scales.T
    return canonicalise_shape(quats, scales)


@dataclass(frozen=True, eq=False)
class _ShapeInput:
    """Shapes to cluster, with their rate and distortion without a codebook.

    Attributes:
        covariances: [6, N], divided by their trace.
        sizes: [N], log sizes.
        weights: [N], weights of squared errors.
        metric: metric of the covariances, if known.
        plain_errors: [N], weighted squared errors without a codebook.
        fits: [N] bool, True if the scales fit the file's lattice; tiles with outliers have coarser lattices.
        plain_bits: bits per shape without a codebook: the entropy of the integers.
    """

    covariances: F64
    sizes: F64
    weights: F64
    metric: ErrorMetric | None
    plain_errors: F64
    fits: Mask
    plain_bits: float


def _shape_input(
    model: SplatModel, weights: F32, metric: ErrorMetric | None, parameters: CodingParameters
) -> _ShapeInput:
    """Return the shapes of a model in canonical axis order, and their rate and distortion without a codebook.

    Weights are [N]; the metric, if known, has its own. Errors of splats for which `fits` is false have no meaning.
    """
    rotation, scales = _canonical(model.quats, model.scales, parameters)
    covariances, sizes = unit_covariances(rotation, scales)
    fits = np.abs(scales).max(axis=0) < _STEPS_MAX * parameters.scale_step
    n = np.rint(np.where(fits, scales, 0.0).astype(np.float64) / parameters.scale_step).astype(np.int64)
    q = quat_levels(rotation, parameters.quat_levels)
    decoded, decoded_sizes = unit_covariances(quat_values(q, parameters.quat_levels), n * parameters.scale_step)
    bits = math.fsum(_entropy(column[fits]) for column in (*n, *q))
    plain = _shape_errors(covariances, decoded, decoded_sizes - sizes, weights, metric)
    return _ShapeInput(covariances, sizes, weights.astype(np.float64), metric, plain, fits, bits)


def _shape_errors(target: F64, coded: F64, log_growth: F64, weights: NDArray[Any], metric: ErrorMetric | None) -> F64:
    """Return the weighted squared errors [N] of `coded` · e^(2 · log_growth) against `target`, both [6, N].

    With a metric, its own weights count, and `weights` [N] is not used.
    """
    difference = _vectors(coded * np.exp(2.0 * np.clip(log_growth, -_LOG_SIZE_MAX, _LOG_SIZE_MAX)) - target)
    if metric is not None:
        return metric.errors(difference[:, :, None], slice(None))  # slice(None): all splats
    return np.asarray(np.einsum("ni,ni->n", difference, difference) * weights)


def _vectors(covariances: F64) -> F64:
    """Return vectors [N, 6] whose Euclidean distances are the Frobenius distances of the matrices."""
    return np.ascontiguousarray((covariances * _OFF_DIAGONAL_ROOTS[:, None]).T)


def _points(covariances: F64) -> I16:
    """Return `_vectors`, [N, 6], rounded to the lattice of k-means."""
    return np.rint(_vectors(covariances) * _TRACE_STEPS).astype(np.int16)


def _train_entries(
    shapes: _ShapeInput, weights: F64, size: int, parameters: CodingParameters, context: Context
) -> tuple[I32, I64]:
    """Train entries on the file's lattices.

    Args:
        shapes: the shapes of all splats.
        weights: [N], weights in the training; 0 for splats outside of it.
        size: number of entries; fewer result if some are unused or equal.
        parameters: steps and codings.
        context: threads, seed and progress.

    Returns:
        [6, K] entries; [N] index of each splat's entry, whether or not it is in the training.
    """
    points = _points(shapes.covariances)
    _, start = cluster(points, weights.astype(np.float32), size, context=context)
    entries, index = np.zeros((6, 0), np.int32), start.astype(np.int64)
    rounds = 1 if shapes.metric is None else _METRIC_ROUNDS  # one round quantises the centroids of k-means
    for _ in range(rounds):
        entries = _centroids(shapes, weights, index, parameters)
        index = _assign(shapes, points, entries, parameters, context)
    return entries, index


def _assign(shapes: _ShapeInput, points: I16, entries: I32, parameters: CodingParameters, context: Context) -> I64:
    """Return the nearest entry of each splat, [N], under the metric if the shapes have a metric."""
    decoded = _dequantise(entries, parameters)[0]
    index = search_nearest(points, _points(decoded).astype(np.int32), 0, context)[0].astype(np.int64)
    if shapes.metric is None:
        return index
    vectors, centroids = _vectors(shapes.covariances)[:, :, None], _vectors(decoded)[:, :, None]
    return reassign_by_metric(vectors, shapes.metric, centroids, index, context, _CANDIDATES)


def _centroids(shapes: _ShapeInput, weights: F64, index: I64, parameters: CodingParameters) -> I32:
    """Return the weighted mean covariance of each used entry's splats, quantised to an entry, [6, K]."""
    index = np.unique(index, return_inverse=True)[1].reshape(-1)  # drops unused entries
    count = int(index.max()) + 1
    total = np.bincount(index, weights, count)
    weights = np.where(total[index] > 0.0, weights, 1.0)  # equal weights if all are 0
    total = np.bincount(index, weights, count)
    sums = np.stack([np.bincount(index, weights * entry, count) for entry in shapes.covariances])
    rotation, scales = canonicalise_shape(*mean_axes(sums / total))
    scales = np.maximum(scales, scales[0] - _THINNEST)
    n = np.rint(scales.astype(np.float64) / parameters.scale_step).astype(np.int32)
    return np.unique(np.concatenate([n - n[:1], quat_levels(rotation, parameters.quat_levels)]), axis=1)


def _dequantise(entries: I32, parameters: CodingParameters) -> tuple[F64, F64]:
    """Return `unit_covariances` of entries [6, K]."""
    return unit_covariances(quat_values(entries[3:], parameters.quat_levels), entries[:3] * parameters.scale_step)


def _assignment_errors(shapes: _ShapeInput, entries: I32, index: I64, parameters: CodingParameters) -> tuple[F64, I32]:
    """Return the weighted squared error of each splat's assignment, [N], and the summand that minimises it, [N]."""
    decoded, sizes = _dequantise(entries, parameters)
    assigned = decoded[:, index]
    log_growth = np.zeros(len(index))
    if shapes.metric is not None:
        log_growth = _best_log_growth(shapes.covariances, assigned, shapes.metric)
    steps = (shapes.sizes + log_growth - sizes[index]) / parameters.scale_step
    summand = np.rint(np.where(shapes.fits, steps, 0.0)).astype(np.int32)
    log_growth = sizes[index] + summand * parameters.scale_step - shapes.sizes
    return _shape_errors(shapes.covariances, assigned, log_growth, shapes.weights, shapes.metric), summand


def _best_log_growth(target: F64, assigned: F64, metric: ErrorMetric) -> F64:
    """Return the summand of the log scales, [N], that brings covariances `assigned` closest to `target`, both [6, N].

    A summand t scales a covariance a by s = e^(2t). The error (s a - b)ᵀ M (s a - b) is least for s = aᵀ M b / aᵀ M a.
    """
    a, b = _vectors(assigned)[:, :, None], _vectors(target)[:, :, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = metric.products(a, b) / metric.products(a, a)
    usable = np.isfinite(ratio) & (ratio > 0.0)
    return np.clip(0.5 * np.log(np.where(usable, ratio, 1.0)), -_SUMMAND_MAX, _SUMMAND_MAX)


def _worth_assigning(shapes: _ShapeInput, errors: F64, index: I64, summand: I32) -> Mask:
    """Return a mask [N] of the splats whose assignment lowers D + λ R; errors, index and summand are [N].

    R is the entropy of the integers of a shape, or of index and summand. A scalar quantiser of 6 dimensions has
    D ∝ 2^(-2R/6), so λ = -dD/dR = 2 ln 2 / 6 · D with the mean distortion D without a codebook.
    """
    fits = shapes.fits
    if not fits.any():
        return fits
    lambda_ = 2.0 * math.log(2.0) / _DIMENSIONS * float(shapes.plain_errors[fits].mean())
    saved = shapes.plain_bits - _entropy(index[fits]) - _entropy(summand[fits])
    return np.asarray(fits & (errors - shapes.plain_errors < lambda_ * saved))


def _all_but_worst(shapes: _ShapeInput, errors: F64, fraction: float) -> Mask:
    """Return a mask [N] of the splats to assign: all but a fraction with the largest weighted errors, [N]."""
    assigned = shapes.fits.copy()
    worst = np.argsort(-np.where(shapes.fits, errors, np.inf), kind="stable")
    assigned[worst[: int(len(errors) * fraction)]] = False
    return assigned


def _entropy(values: NDArray[Any]) -> float:
    """Return the order-0 entropy of values [n], bits per value."""
    return entropy.order_0_entropy(np.unique(values, return_counts=True)[1])


def _rank_entries(entries: I32, index: I64, summand: I32, assigned: Mask) -> ShapeCodebook:
    """Escape splats that are not assigned [N], drop unused entries of [6, K], and sort the others by frequency."""
    used, inverse = np.unique(index[assigned], return_inverse=True)
    ranked, order = rank_by_frequency(inverse.astype(np.uint32), np.ascontiguousarray(entries[:, used].T))
    full = np.full(len(index), len(used), np.int32)
    full[assigned] = ranked.astype(np.int32)
    return ShapeCodebook(np.ascontiguousarray(order.T), full, np.where(assigned, summand, 0).astype(np.int32))


def _keep_where_smaller(
    model: SplatModel, codebook: ShapeCodebook, tiles: Sequence[TileSplats], parameters: CodingParameters
) -> ShapeCodebook | None:
    """Escape all splats of tiles that are not smaller with the codebook.

    Tiles whose scales need a coarser lattice than the file's are escaped, too: codebooks are on the file's lattice.

    Returns:
        The codebook without entries that are no longer used; `None` if it takes more bytes than the tiles save.
    """
    escaped = codebook.escaped
    saved = 0  # bytes
    for tile in tiles:
        rows = quantise_and_sort(model, tile, parameters).rows
        part = codebook.part(rows)
        if part is None:
            continue
        quats, scales = model.quats[rows], model.scales[rows]
        plain = quantise_shape(quats, scales, parameters)
        gain = -1  # bytes; escapes the tile
        if plain.exponent == 0:
            assigned = quantise_shape(quats, scales, parameters, part)
            gain = _shape_bytes(plain, None, parameters) - _shape_bytes(assigned, part, parameters) - CODEBOOK_ID_SIZE
        if gain > 0:
            saved += gain
        else:
            escaped[tile.rows] = True
    if escaped.all():
        return None
    kept = _rank_entries(codebook.entries, codebook.index.astype(np.int64), codebook.summand, ~escaped)
    return kept if saved > len(shape_codebook_chunk(kept, parameters.deflate)[1].payload) + _OVERHEAD else None


def _shape_bytes(shape: QuantisedShape, part: ShapePart | None, parameters: CodingParameters) -> int:
    """Return the bytes of a tile's blocks of scales and quats, with a codebook if `part` is given."""
    return sum(
        len(block) for block in shape_blocks(shape.scales, shape.exponent, shape.quats, part, parameters.deflate)
    )


def _quaternions(R: F64) -> F64:
    """Return unit quaternions w x y z, [n, 4], of rotation matrices [n, 3, 3], the largest component > 0.

    The rows of 4 q qᵀ are computed from R; the row with the largest diagonal entry is normalised.
    """
    xx, yy, zz = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    x, y, z = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    xy, xz, yz = R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 1, 2] + R[:, 2, 1]
    rows = np.stack(
        [
            np.stack([1.0 + xx + yy + zz, x, y, z], axis=1),
            np.stack([x, 1.0 + xx - yy - zz, xy, xz], axis=1),
            np.stack([y, xy, 1.0 - xx + yy - zz, yz], axis=1),
            np.stack([z, xz, yz, 1.0 - xx - yy + zz], axis=1),
        ],
        axis=1,
    )
    best = np.einsum("nii->ni", rows).argmax(axis=1)
    chosen = rows[np.arange(len(rows)), best]
    return np.asarray(chosen / np.linalg.norm(chosen, axis=1, keepdims=True))
