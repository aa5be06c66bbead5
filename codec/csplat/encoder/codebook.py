"""The SH stage: no SH, each splat coded directly, or a codebook, whichever suits the scene (spec 6.4.5)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.encoder import blocks
from csplat.encoder.colour import ShBook, ShTables, quantise_rows
from csplat.encoder.container import CodebookTable, FileChunk
from csplat.encoder.importance import splat_weights
from csplat.encoder.kmeans import assign, cluster, rank_by_frequency
from csplat.encoder.metric import Metric, refine
from csplat.encoder.options import EncodeOptions
from csplat.encoder.plan import Plan
from csplat.encoder.quantise import colour_integers, largest_exact
from csplat.encoder.streams import signed_stream
from csplat.model import SplatModel
from csplat.types import F32, I16, I32, Progress

if TYPE_CHECKING:
    from csplat.encoder.draft import Draft


Rows = NDArray[np.intp]

_CLIP = 511  # lattice steps: splats beyond are coded directly, so that searches stay exact at full precision
_BLOCK = 1 << 14
_SAMPLE = 1 << 14  # splats on which coding every splat for itself is tried
_LEAST = 256  # splats for which a codebook may pay
_MANY = 4096  # entries from which on searching near groups saves more than it loses
_ENOUGH = 1 << 15  # splats whose share of entries a smaller scene gets too, if it has users for them
_USERS = 6  # splats per entry below which an entry does not pay for itself
_TRIED = 4  # splats tried as escapes, as a multiple of those that escape
_IMPORTANT = 0.95  # quantile of the weights above which a splat is quantised on the full lattice
_CODEBOOK_ID = 0


@dataclass(frozen=True, eq=False)
class Service:
    """Rules for assigning splats that a codebook was not trained on.

    Attributes:
        entries: [size, 3K] int32, R, G, B of each coefficient.
        near_groups: as in `assign`.
        threshold: weighted squared error above which a splat is coded directly.
    """

    entries: I32
    near_groups: int
    threshold: float


@dataclass(frozen=True)
class Books:
    """Decisions about SH: data for tiles, index records, chunks, and rules for splats not yet assigned."""

    tables: ShTables
    records: Sequence[CodebookTable] = ()
    chunks: Sequence[FileChunk] = ()
    service: Service | None = None


@dataclass(frozen=True)
class _Trained:
    """A trained codebook.

    Attributes:
        index: [N] int32; the codebook's size means "escaped".
        entries: [size, 3K] int32, R, G, B of each coefficient.
        error: weighted mean of the squared error that is left.
        service: rules for splats that had no part in it.
    """

    index: I32
    entries: I32
    error: float
    service: Service


def choose_sh(
    draft: Draft, weights: F32 | None, metric: Metric | None, sample: Rows, report: Progress
) -> tuple[Plan, Books]:
    """Decide how SH is coded, and train the codebook if there is to be one.

    Args:
        draft: the scene; its plan's `sh_coding` is "auto", "codebook", "scalar" or "none".
        weights: [N] float32, importance of the splats, a guess if the draft has none; None if nothing needs it.
        metric: how errors of the coefficients of all bands weigh together; None: each for itself, by `weights`.
        sample: rows of one tile, on which scalar coding is tried.
        report: progress.

    Returns:
        The plan with the coding of SH and its step, and the codebooks.
    """
    model, plan, options = draft.model, draft.plan, draft.options
    tables = ShTables(weights, _reference(weights), extras=tuple(model.extra) if options.keep_extra else ())
    scalar = replace(plan, sh_coding="scalar" if plan.sh_degree else "none"), Books(tables)
    if plan.sh_coding not in ("auto", "codebook") or weights is None or not len(model):
        return scalar
    fine = replace(plan, sh_coding="codebook", sh_step=plan.codebook_step)
    kept = (plan.sh_degree + 1) ** 2 - 1
    if plan.sh_coding == "auto" and (len(model) < _LEAST or not _escapes_fit(model.shN[:, :kept], fine)):
        return scalar
    judge = _Judge(weights, None if metric is None else metric.first(kept), draft.importance is not None)
    trained = _train(model, judge, fine, options, report)
    books = replace(_books(tables, trained, fine), service=trained.service)
    if plan.sh_coding == "auto" and not _codebook_pays(model, judge, trained, books, sample[:_SAMPLE], plan):
        return scalar
    return fine, books


def _reference(weights: F32 | None) -> float:
    """Return the weight of a splat that matters: the 95th percentile, of positive weights where most are 0."""
    if weights is None or not len(weights):
        return 1.0
    if (reference := float(np.quantile(weights, _IMPORTANT))) > 0.0:
        return reference
    positive = weights[weights > 0.0]
    return float(np.quantile(positive, _IMPORTANT)) if len(positive) else 1.0


@dataclass(frozen=True, eq=False)
class _Judge:
    """Weighting of errors: by splat and, if there is a metric, by coefficient too."""

    weights: F32
    metric: Metric | None
    measured: bool

    def errors(self, difference: F32, rows: Rows | slice) -> NDArray[np.float64]:
        """[n] weighted squared errors of differences [n, 3K]."""
        if self.metric is not None:
            return self.metric.errors(difference.reshape(len(difference), -1, 3), rows)
        squares = np.einsum("ij,ij->i", difference, difference, dtype=np.float64)
        return np.asarray(squares * self.weights[rows])


def _train(model: SplatModel, judge: _Judge, plan: Plan, options: EncodeOptions, report: Progress) -> _Trained:
    weights, threads = judge.weights, options.thread_count
    points = _lattice_points(model.shN, plan)
    size = _size(len(model), plan, options)
    effort = {"near_groups": 8, "iterations": 6, "sample_per_entry": 16} if size >= _MANY else {}

    def steps_done(done: int, steps: int) -> None:
        report("codebook", done / steps)

    found = cluster(points, weights, size, seed=options.seed, threads=threads, progress=steps_done, **effort)
    if judge.metric is not None:
        found = _refined(model.shN, points, judge.metric, found, plan, threads)
    ranked, entries = rank_by_frequency(found[1], found[0])
    index = ranked.astype(np.int32)
    errors = _errors(model.shN, index, entries, plan, judge)
    escaped = _escapes(model.shN, errors, plan, options, judge)
    threshold = float(errors[escaped].min(initial=np.inf))
    errors[escaped] = 0.0
    index[escaped] = len(entries)
    total = float(weights.sum(dtype=np.float64)) or 1.0
    service = Service(entries, effort.get("near_groups", 0), threshold)
    return _Trained(index, entries, float(errors.sum()) / total, service)


def largest_sh(shN: F32) -> float:
    """Magnitude of the largest coefficient."""
    return float(max(shN.max(initial=0.0), -shN.min(initial=0.0)))


def settled(plan: Plan, largest: float) -> Plan:
    """Return the plan for a scene whose largest SH coefficient is `largest`: no codebook if escapes would not fit."""
    fine = replace(plan, sh_step=plan.codebook_step)
    return replace(plan, sh_coding="scalar") if plan.sh_coding == "auto" and not _fits(largest, fine) else plan


def served(books: Books, model: SplatModel, plan: Plan, threads: int) -> ShTables:
    """Return the tables that tiles need for splats that took no part in the decisions.

    Args:
        books: decisions made on a sample of the scene.
        model: at most a bucket of the scene: the result may depend on which splats are searched together.
        plan: the plan that was decided on.
        threads: threads of the search; no effect on the result.
    """
    tables, service = books.tables, books.service
    weights = None if tables.weights is None else splat_weights(model, None)
    if service is None or tables.book is None or weights is None:
        return replace(tables, weights=weights)
    points = _lattice_points(model.shN, plan)
    found = assign(points, service.entries, near_groups=service.near_groups, threads=threads).astype(np.int32)
    errors = _errors(model.shN, found, service.entries, plan, _Judge(weights, None, measured=False))
    found[errors >= service.threshold] = tables.book.size
    return replace(tables, weights=weights, book=ShBook(tables.book.entries, found))


def _refined(
    shN: F32, points: I16, metric: Metric, found: tuple[I32, NDArray[np.uint32]], plan: Plan, threads: int
) -> tuple[I32, NDArray[np.uint32]]:
    """Go on from a codebook by what errors weigh together."""
    entries, index = found
    count, shape = points.shape[1] // 3, (-1, points.shape[1] // 3, 3)
    wanted = np.clip(shN[:, :count] * np.float32(1.0 / plan.sh_step), -_CLIP, _CLIP)
    entries, places = refine(wanted, metric, entries.reshape(shape), index.astype(np.int64), threads)
    return np.clip(entries, -_CLIP, _CLIP).reshape(len(entries), -1), places.astype(np.uint32)


def _lattice_points(shN: F32, plan: Plan) -> I16:
    """[N, 3K] R, G, B integers of the bands that are kept, clipped to what clustering is exact for."""
    kept = (plan.sh_degree + 1) ** 2 - 1
    points = np.empty((len(shN), 3 * kept), np.int16)
    for at in range(0, len(shN), _BLOCK):
        rows = shN[at : at + _BLOCK, :kept].reshape(-1, 3 * kept)
        rows = np.clip(rows, -_CLIP * plan.sh_step, _CLIP * plan.sh_step)
        points[at : at + _BLOCK] = np.rint(rows * np.float32(1.0 / plan.sh_step))
    return points


def _size(count: int, plan: Plan, options: EncodeOptions) -> int:
    """Choose how many entries: an entry costs some 20 bytes, and saves error for the splats that use it."""
    if options.codebook_size is not None:
        return options.codebook_size
    wanted = max(count * plan.codebook_share, min(_ENOUGH * plan.codebook_share, count / _USERS))
    return min(1 << max(round(math.log2(max(1.0, wanted))), 4), plan.codebook_most)


def _escapes_fit(shN: F32, plan: Plan) -> bool:
    """Return True if every splat could be coded directly next to a codebook, whose lattice no tile makes coarser."""
    return _fits(largest_sh(shN), plan)


def _fits(largest: float, plan: Plan) -> bool:
    return 2.0 * largest < largest_exact(plan.sh_step)


def _errors(shN: F32, index: I32, entries: I32, plan: Plan, judge: _Judge) -> NDArray[np.float64]:
    """[N] weighted squared error of each splat; infinite if a coefficient was clipped."""
    kept = (plan.sh_degree + 1) ** 2 - 1
    table = entries.astype(np.float32) * np.float32(plan.sh_step)
    errors = np.empty(len(shN))
    for at in range(0, len(shN), _BLOCK):
        part = slice(at, at + _BLOCK)
        difference = shN[part, :kept].reshape(-1, 3 * kept).copy()
        clipped = np.abs(difference).max(axis=1) > (_CLIP - 1) * plan.sh_step
        difference -= table[index[part]]
        errors[part] = judge.errors(difference, part)
        errors[part][clipped] = np.inf
    return errors


def _escapes(shN: F32, errors: NDArray[np.float64], plan: Plan, options: EncodeOptions, judge: _Judge) -> Rows:
    """Return the splats that are coded directly: those with the largest weighted error, and all that were clipped.

    If weights were measured, those that gain most by it, and none that gains nothing: the splat with the largest weight
    may well lie near its entry, and direct values are coarser than entries.
    """
    fraction = plan.escape_fraction if options.escape_fraction is None else options.escape_fraction
    clipped = int(np.count_nonzero(~np.isfinite(errors)))
    count = max(int(len(errors) * fraction), clipped)
    worst = np.argsort(-errors, kind="stable")
    if not judge.measured or not count:
        return np.sort(worst[:count])
    tried = worst[: _TRIED * count]
    kept = (plan.sh_degree + 1) ** 2 - 1
    source = shN[tried, :kept]
    own = quantise_rows(source, plan, np.full(len(tried), plan.escape_coarse, np.int32))[2]
    gain = errors[tried] - judge.errors((source - own).reshape(len(tried), -1), tried)
    if options.escape_fraction is None:
        count = max(min(count, int(np.count_nonzero(gain > 0.0))), clipped)
    return np.sort(tried[np.argsort(-gain, kind="stable")[:count]])


def _books(tables: ShTables, trained: _Trained, plan: Plan) -> Books:
    rgb = trained.entries.reshape(len(trained.entries), -1, 3).transpose(2, 1, 0).astype(np.float32)
    columns = colour_integers(np.ascontiguousarray(rgb), plan.chroma_shift)
    return books_of(tables, ShBook(columns, trained.index), plan)


def books_of(tables: ShTables, book: ShBook, plan: Plan) -> Books:
    """Return the tables, the index record and the chunks of a codebook."""
    bands = range(1, plan.sh_degree + 1)
    chunks = []
    for band in bands:
        head = _spec.pack_codebook_head(_spec.CodebookHead(_CODEBOOK_ID, band, 0))
        span = slice(band * band - 1, (band + 1) ** 2 - 1)
        stream = signed_stream(np.ascontiguousarray(book.entries[:, span]).reshape(-1), plan.coding)
        chunks.append(FileChunk(_spec.CHUNK_CODEBOOK, head + stream, _CODEBOOK_ID, band))
    record = CodebookTable(_CODEBOOK_ID, _spec.CODEBOOK_KIND_SH, (1, plan.sh_degree), book.size)
    return Books(replace(tables, book=book, ids=(_CODEBOOK_ID,), layers=tuple(bands)), (record,), tuple(chunks))


def _codebook_pays(model: SplatModel, judge: _Judge, trained: _Trained, books: Books, sample: Rows, plan: Plan) -> bool:
    """Compare bytes at equal error with scalar coding, tried on a sample at two steps.

    Between the two, scalar coding trades bytes for the logarithm of the error in a straight line.
    """
    count = len(model)
    spent = sum(len(chunk.payload) for chunk in books.chunks) / count
    shares = np.bincount(trained.index) / count
    spent -= float((shares * np.log2(np.maximum(shares, 1e-12))).sum()) / 8
    fine_bytes, fine_error = _try_scalar(model, judge, sample, plan)
    coarse_bytes, coarse_error = _try_scalar(model, judge, sample, replace(plan, sh_step=2 * plan.sh_step))
    escaped = float((trained.index == len(trained.entries)).mean())
    spent += escaped * fine_bytes
    if not 0.0 < fine_error < coarse_error:
        return spent < fine_bytes
    per_halving = (fine_bytes - coarse_bytes) / math.log2(coarse_error / fine_error)
    return spent + per_halving * math.log2(max(trained.error, 1e-30) / fine_error) < fine_bytes


def _try_scalar(model: SplatModel, judge: _Judge, sample: Rows, plan: Plan) -> tuple[float, float]:
    """Return bytes per splat and weighted mean squared error of scalar coding."""
    kept = (plan.sh_degree + 1) ** 2 - 1
    source = np.take(model.shN, sample, axis=0)[:, :kept]
    columns, _, decoded = quantise_rows(source, plan, None)
    size = 0
    for band in range(1, plan.sh_degree + 1):
        part = columns[:, band * band - 1 : (band + 1) ** 2 - 1]
        if part.any():
            flat = part.reshape(-1, len(sample))
            size += len(blocks.signed_or_sparse_block(_spec.ATTRIBUTE_SH0 + band, flat, 0, plan.coding))
    errors = judge.errors((source - decoded).reshape(len(sample), -1), sample)
    return size / len(sample), float(errors.sum() / (judge.weights[sample].sum(dtype=np.float64) or 1.0))
