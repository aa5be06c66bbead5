"""The shape stage: shapes coded directly, or a codebook of shapes up to size if it makes the file smaller (spec 6.4.5).

The covariance divided by its trace is clustered, as in Niedermayr, Stumpfegger and Westermann ("Compressed 3D Gaussian
Splatting for Accelerated Novel View Synthesis", CVPR 2024); the trace stays each splat's own. Means of matrices of
trace 1 have trace 1, so they need no normalisation. Which splats are assigned to the codebook and which keep their own
shape ("escapes") depends on bytes and error: see `_worth_it`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.gauge import fix_gauge
from csplat.encoder.geometry import Shape, quantise_shape
from csplat.encoder.kmeans import cluster, rank_by_frequency
from csplat.encoder.metric import Metric, reassign
from csplat.encoder.nearest import search
from csplat.encoder.options import EncodeOptions
from csplat.encoder.plan import Plan
from csplat.encoder.quantise import quat_levels, quat_values
from csplat.encoder.shape_covariances import mean_axes, unit_covariances
from csplat.encoder.shape_tables import ShapePart, ShapeTables, shape_blocks, shape_book
from csplat.encoder.tile import tile_order
from csplat.encoder.tiling import Tile
from csplat.model import SplatModel
from csplat.types import F32, F64, I16, I32, I64, Progress

Rows = NDArray[np.intp]

_UNIT = 2048  # lattice steps of a trace: searches are exact up to norms of about 2,300
_USERS = 6  # splats per entry below which an entry does not pay for itself
_ROUNDS = 2  # rounds of clustering; from the second on, escaped splats have no influence
_METRIC_ROUNDS = 2
_TRIED = 64  # entries tried for a splat, if a metric ranks them
_MOST_RESIZED = 0.7  # largest summand of the log scales: beyond it, the metric is no longer linear
_CLEAR = 30.0  # log sizes are clipped to this: the error is already as large as can be
_ESCAPES = 0.05  # fraction of the splats, if nothing is known of the cost of an error
_ROOTS = np.sqrt([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])  # an entry off the diagonal occurs twice
_DIMENSIONS = 6  # dimensions of a shape: a bit per splat divides its squared error by 2**(2/6)
_MOST_STEPS = 2.0**20  # in log scale: above this, its tile may be coarser than the file's lattice
_TABLE_ID = 2  # bytes of the table id in a tile's record
_OVERHEAD = 128  # bytes of records, heads and checksums that come with a codebook


@dataclass(frozen=True, eq=False)
class _Scene:
    """Input of the shape stage.

    Attributes:
        covariances: [6, N], over their trace. sizes: [N], half the logarithm of the trace. weights: [N].
        metric: how the errors of entries weigh together, if known.
        plain: [N], weighted squared error of the covariance over its trace, coded directly.
        fits: [N] bool, True if the file's lattice holds the scales; tiles with outliers use a coarser one.
        bits: cost of a shape that is coded directly, by the entropy of its integers.
    """

    covariances: F64
    sizes: F64
    weights: F64
    metric: Metric | None
    plain: F64
    fits: NDArray[np.bool_]
    bits: float


def choose_shapes(
    model: SplatModel, weights: F32, metric: Metric | None, tiles: Sequence[Tile], plan: Plan, options: EncodeOptions,
    report: Progress,
) -> ShapeTables | None:  # fmt: skip
    """Make the codebook, and find the splats that are assigned to it.

    Args:
        model: the scene.
        weights: [N], of the squared error of a covariance over its trace; only ratios matter.
        metric: how errors of xx, yy, zz, √2 xy, √2 xz, √2 yz weigh together; None: each for itself.
        tiles: how the scene is cut.
        plan: the lattices.
        options: `shape_codebook_size`, `shape_escape_fraction`, `seed`.
        report: progress.

    Returns:
        The codebook, or None if the file is not smaller with one.
    """
    size = min(options.shape_codebook_size or 0, len(model) // _USERS)
    if size < 1:
        return None
    scene = _scene(model, weights, metric, plan)
    fraction = options.shape_escape_fraction
    if fraction is None and metric is None:
        fraction = _ESCAPES
    taking = scene.weights * scene.fits
    tables: ShapeTables | None = None
    for step in range(_ROUNDS):
        report("shapes", step / _ROUNDS)
        entries, index = _cluster(scene, taking, size, plan, options.seed, options.thread_count)
        errors, summand = _served_errors(scene, entries, index, plan)
        if fraction is None:
            served = _worth_it(scene, errors, index, summand)
        else:
            served = _but_worst(scene, errors, fraction)
        if not served.any():
            return None
        tables = _tables(entries, index, summand, served)
        taking = scene.weights * served
    assert tables is not None
    tables = _where_smaller(model, tables, tiles, plan)
    report("shapes", 1.0)
    return tables


def _scene(model: SplatModel, weights: F32, metric: Metric | None, plan: Plan) -> _Scene:
    rotation, scales = (model.quats.T, model.scales.T) if plan.gauged else fix_gauge(model.quats, model.scales)
    covariances, sizes = unit_covariances(rotation, scales)
    fits = np.abs(scales).max(axis=0) < _MOST_STEPS * plan.scale_step
    n = np.rint(np.where(fits, scales, 0.0).astype(np.float64) / plan.scale_step).astype(np.int64)
    q = quat_levels(rotation, plan.quat_levels)
    seen, seen_sizes = unit_covariances(quat_values(q, plan.quat_levels), n * plan.scale_step)
    bits = sum(_entropy(column[fits]) for column in (*n, *q))
    plain = _errors(covariances, seen, seen_sizes - sizes, weights, metric)
    return _Scene(covariances, sizes, weights.astype(np.float64), metric, plain, fits, bits)


def _errors(wanted: F64, found: F64, larger: F64, weights: NDArray[Any], metric: Metric | None) -> F64:
    """[N] weighted squared error of covariances [6, N], `found` · e^(2 · larger) in place of `wanted`."""
    difference = _vectors(found * np.exp(2.0 * np.clip(larger, -_CLEAR, _CLEAR)) - wanted)
    if metric is not None:
        return metric.errors(difference[:, :, None], slice(None))
    return np.asarray(np.einsum("ni,ni->n", difference, difference) * weights)


def _vectors(covariances: F64) -> F64:
    """[N, 6] vectors whose distances are those of the matrices."""
    return np.ascontiguousarray((covariances * _ROOTS[:, None]).T)


def _points(covariances: F64) -> I16:
    """The same on a lattice."""
    return np.rint(_vectors(covariances) * _UNIT).astype(np.int16)


def _cluster(scene: _Scene, weights: F64, size: int, plan: Plan, seed: int, threads: int) -> tuple[I32, I64]:
    """Train entries [6, K] on the file's lattices, and give each splat its own, [N]."""
    points = _points(scene.covariances)
    _, start = cluster(points, weights.astype(np.float32), size, seed=seed, threads=threads)
    entries, seen = _on_lattices(scene, weights, start.astype(np.int64), plan)
    index = search(points, _points(seen).astype(np.int32), 0, threads)[0].astype(np.int64)
    if scene.metric is None:
        return entries, index
    vectors = _vectors(scene.covariances)[:, :, None]
    for step in range(_METRIC_ROUNDS):
        if step:
            entries, seen = _on_lattices(scene, weights, index, plan)
            index = search(points, _points(seen).astype(np.int32), 0, threads)[0].astype(np.int64)
        index = reassign(vectors, scene.metric, _vectors(seen)[:, :, None], index, threads, _TRIED)
    return entries, index


def _on_lattices(scene: _Scene, weights: F64, index: I64, plan: Plan) -> tuple[I32, F64]:
    """[6, K] integers of the weighted mean covariance of each entry's splats; [6, K] what they decode to."""
    index = np.unique(index, return_inverse=True)[1].reshape(-1)  # entries that serve nobody are gone
    count = int(index.max()) + 1
    total = np.bincount(index, weights, count)
    weights = np.where(total[index] > 0.0, weights, 1.0)  # splats of no weight represent themselves
    total = np.bincount(index, weights, count)
    sums = np.stack([np.bincount(index, weights * entry, count) for entry in scene.covariances])
    rotation, scales = mean_axes(sums / total)
    rotation, scales = fix_gauge(rotation, scales)
    scales = np.maximum(scales, scales[0] - 20.0)  # thinner than this is as good as flat
    n = np.rint(scales.astype(np.float64) / plan.scale_step).astype(np.int32)
    entries = np.unique(np.concatenate([n - n[:1], quat_levels(rotation, plan.quat_levels)]), axis=1)
    return entries, unit_covariances(quat_values(entries[3:], plan.quat_levels), entries[:3] * plan.scale_step)[0]


def _served_errors(scene: _Scene, entries: I32, index: I64, plan: Plan) -> tuple[F64, I32]:
    """[N] weighted squared error of each splat by its entry, and [N] the summand that makes it least."""
    seen, sizes = unit_covariances(quat_values(entries[3:], plan.quat_levels), entries[:3] * plan.scale_step)
    found = seen[:, index]
    factor = np.zeros(len(index)) if scene.metric is None else _best_size(scene.covariances, found, scene.metric)
    steps = (scene.sizes + factor - sizes[index]) / plan.scale_step
    summand = np.rint(np.where(scene.fits, steps, 0.0)).astype(np.int32)
    larger = sizes[index] + summand * plan.scale_step - scene.sizes
    return _errors(scene.covariances, found, larger, scene.weights, scene.metric), summand


def _best_size(wanted: F64, found: F64, metric: Metric) -> F64:
    """Return [N], the summand of the log scales that brings `found` [6, N] closest to `wanted`; 0 keeps the trace."""
    a, b = _vectors(found)[:, :, None], _vectors(wanted)[:, :, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = metric.products(a, b) / metric.products(a, a)
    usable = np.isfinite(ratio) & (ratio > 0.0)
    return np.clip(0.5 * np.log(np.where(usable, ratio, 1.0)), -_MOST_RESIZED, _MOST_RESIZED)


def _worth_it(scene: _Scene, errors: F64, index: I64, summand: I32) -> NDArray[np.bool_]:
    """Return True for the splats to assign: those whose error grows by less than the bits that it saves are worth.

    Bits are worth what they buy elsewhere: at the plan's steps, one more for every splat would remove 2 ln 2 / 6 of
    their squared error. The cost of a shape is the entropy of its integers, alone or as index and summand.
    """
    fits = scene.fits
    if not fits.any():
        return fits
    worth = 2.0 * math.log(2.0) / _DIMENSIONS * float(scene.plain[fits].mean())
    saved = scene.bits - _entropy(index[fits]) - _entropy(summand[fits])
    return np.asarray(fits & (errors - scene.plain < worth * saved))


def _entropy(values: NDArray[Any]) -> float:
    """Order-0 entropy, bits per value."""
    _, counts = np.unique(values, return_counts=True)
    shares = counts / max(1, counts.sum())
    return -float((shares * np.log2(shares)).sum())


def _but_worst(scene: _Scene, errors: F64, fraction: float) -> NDArray[np.bool_]:
    """All but a share of the splats, those with the largest weighted error."""
    served = scene.fits.copy()
    worst = np.argsort(-np.where(scene.fits, errors, np.inf), kind="stable")
    served[worst[: int(len(errors) * fraction)]] = False
    return served


def _tables(entries: I32, index: I64, summand: I32, served: NDArray[np.bool_]) -> ShapeTables:
    """Drop entries that serve nobody, and number the others by how many they serve."""
    used, place = np.unique(index[served], return_inverse=True)
    ranked, order = rank_by_frequency(place.astype(np.uint32), np.ascontiguousarray(entries[:, used].T))
    full = np.full(len(index), len(used), np.int32)
    full[served] = ranked.astype(np.int32)
    return ShapeTables(np.ascontiguousarray(order.T), full, np.where(served, summand, 0).astype(np.int32))


def _where_smaller(model: SplatModel, tables: ShapeTables, tiles: Sequence[Tile], plan: Plan) -> ShapeTables | None:
    """Keep the codebook for the tiles that are smaller with it, if all of them together are."""
    escaped, saved = tables.escaped, 0
    for tile in tiles:
        rows = tile_order(model, tile, plan)[0]
        part = tables.part(rows)
        if part is None:
            continue
        quats, scales = model.quats[rows], model.scales[rows]
        plain = quantise_shape(quats, scales, plan)
        gain = -1
        if plain.exponent == 0:
            served = quantise_shape(quats, scales, plan, part)
            gain = _size(plain, None, plan) - _size(served, part, plan) - _TABLE_ID
        if gain > 0:
            saved += gain
        else:
            escaped[tile.rows] = True
    if escaped.all():
        return None
    kept = _tables(tables.entries, tables.index.astype(np.int64), tables.summand, ~escaped)
    return kept if saved > len(shape_book(kept, plan.coding)[1].payload) + _OVERHEAD else None


def _size(shape: Shape, part: ShapePart | None, plan: Plan) -> int:
    return sum(len(block) for block in shape_blocks(shape.scales, shape.exponent, shape.quats, part, plan.coding))
