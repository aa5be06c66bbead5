# SPDX-License-Identifier: Apache-2.0
"""Encode SH bands 1 to 4 with scalar coding or a codebook with escapes, whichever is smaller at equal distortion.

(Spec 6.4.4, 6.4.5, 7.1.) A codebook is trained on the whole scene. For a scene with more splats than a bucket it is
trained on a sample, and an `AssignmentRule` assigns the splats of each tile.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.context import Context
from csplat.encoder import entropy
from csplat.encoder.coding_parameters import CodingParameters, band_slice
from csplat.encoder.container import FileChunk, IndexedCodebook
from csplat.encoder.encode_options import EncodeOptions
from csplat.encoder.entropy import signed_stream, trial_settings
from csplat.encoder.entry_search import EntrySearch, run_blocks
from csplat.encoder.kmeans import assign, cluster, rank_by_frequency, refine_by_metric
from csplat.encoder.quantisation import colour_integers, largest_exact, lattice_values, lift_colour, quantise_sh
from csplat.encoder.splat_importance import ErrorMetric, splat_weights
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.portable_math import log2
from csplat.types import F32, F64, I16, I32, I64, U32

Rows = NDArray[np.intp]

_CLIP = 511  # lattice steps; splats with larger coefficients are escaped, so that assignments stay exact in float32
_BLOCK = 1 << 12  # splats per block of temporaries, 0.7 MiB, which fits the second-level cache
_TRIAL_SPLATS = 1 << 14  # maximum number of splats on which scalar coding is tried
_CODEBOOK_SPLATS_MIN = 256  # splats; in smaller scenes a codebook costs more bytes than it saves
_TRAINING_SPLATS, _TRAINING_USERS = 1 << 16, 64  # minimum numbers of splats, and per entry, to train a codebook on
_NEAR_GROUPS = 4  # see `assign`; 8 take a tenth to a fifth longer for 0.2 to 1.3 % less RMS error
_ITERATIONS, _SAMPLE_PER_ENTRY = 4, 8  # see `cluster`, if groups are searched; more take longer for little quality
_GROUPED_ENTRIES_MIN = 4096  # entries from which searching near groups is worth the additional distortion
_FULL_SHARE_SPLATS = 1 << 15  # splats; smaller scenes get the number of entries of this size, within `_USERS_MIN`
_USERS_MIN = 6  # splats per entry, below which an entry costs more bytes than it saves
_ESCAPE_CANDIDATES = 4  # candidates for escape, as a multiple of the number of escapes
_IMPORTANT = 0.95  # quantile of the weights above which splats are quantised on the full lattice
_CLEAR = 0.2  # relative difference of rates that no DEFLATE level reverses; rates of trials are up to 13 % too high
_COARSEST = 6  # log2 of the coarsest multiple of the SH step
_SLACK = 1.0 + 2.0**-18  # factor that covers the rounding of float32 differences in declared errors
_DISTINCT_PER_ENTRY = 8  # distinct SH of a quantised source per entry; more entries cost more than coarser steps save
_ENTRY_BITS_MIN = 4  # log2 of the smallest number of entries that is chosen
_CODEBOOK_ID = 0


@dataclass(frozen=True, eq=False)
class ShCodebook:
    """An SH codebook and the assignment of splats to it.

    Attributes:
        entries: [3, K, size] Y, Co, Cg integers on the file's lattice.
        index: [N] int32, entry of each splat; `size` for escaped splats.
    """

    entries: I32
    index: I32

    @property
    def size(self) -> int:
        """Number of entries."""
        return int(self.entries.shape[2])

    @property
    def escaped(self) -> Rows:
        """Indices of the escaped splats, ascending."""
        return np.flatnonzero(self.index == self.size)

    def select(self, order: NDArray[Any]) -> ShCodebook:
        """Return the codebook with the assignment of the splats `order`."""
        return ShCodebook(self.entries, self.index[order])

    def dequantise(self, parameters: CodingParameters) -> F32:
        """Return SH of all splats as decoded, [N, K, 3]; rows of escaped splats are undefined."""
        rgb = np.ascontiguousarray(lift_colour(self.entries, parameters.chroma_shift).transpose(2, 1, 0))
        return np.take(lattice_values(rgb, parameters.sh_step), self.index, axis=0, mode="clip")


@dataclass(frozen=True, eq=False)
class AssignmentRule:
    """A trained codebook with the rule that assigns splats outside the training set.

    Attributes:
        entries: [size, 3K] int32, R, G, B of each coefficient.
        search: the entries, prepared for searches.
        threshold: weighted squared error from which a splat is escaped.
    """

    entries: I32
    search: EntrySearch
    threshold: float


@dataclass(frozen=True)
class ShCodingPlan:
    """The SH coding of a file, as its tiles need it.

    Attributes:
        weights: [N], importance; `None`: all splats have the same.
        reference: weight above which a splat is quantised on the full lattice.
        book: the codebook; `None` without a codebook.
        extras: names of the extra columns to write.
        rule: assigns splats outside the training set of the codebook; `None` without a codebook.
        of_sample: weights and assignment are those of a sample of the scene; each tile gets its own.
    """

    weights: F32 | None = None
    reference: float = 1.0
    book: ShCodebook | None = None
    extras: Sequence[str] = ()
    rule: AssignmentRule | None = None
    of_sample: bool = False

    @property
    def codebook_ids(self) -> tuple[int, ...]:
        """Ids of the codebooks that a tile refers to."""
        return () if self.book is None else (_CODEBOOK_ID,)

    def select(self, order: NDArray[Any]) -> ShCodingPlan:
        """Return the plan of the splats `order`."""
        weights = None if self.weights is None else self.weights[order]
        return replace(self, weights=weights, book=None if self.book is None else self.book.select(order))


@dataclass(frozen=True)
class FileCodebooks:
    """SH plan, and codebooks with index records and chunks."""

    sh_plan: ShCodingPlan
    records: Sequence[IndexedCodebook] = ()
    chunks: Sequence[FileChunk] = ()


@dataclass(frozen=True, eq=False)
class _ErrorWeights:
    """Weights of squared errors per splat or, with a metric, per splat and pair of coefficients.

    Attributes:
        weights: [N].
        metric: Gauss-Newton matrices of the coefficients, if known.
        measured: the weights are measured, not guessed from opacity and size.
    """

    weights: F32
    metric: ErrorMetric | None
    measured: bool

    def errors(self, difference: F32, rows: Rows | slice) -> F64:
        """Return the weighted squared errors [n] of differences [n, 3K]."""
        if self.metric is not None:
            return self.metric.errors(difference.reshape(len(difference), -1, 3), rows)
        squares = np.empty(len(difference))
        for start in range(0, len(difference), _BLOCK):
            part = slice(start, start + _BLOCK)
            squares[part] = np.square(difference[part], dtype=np.float64).sum(axis=1)
        return np.asarray(squares * self.weights[rows])


def choose_sh_coding(
    model: SplatModel,
    parameters: CodingParameters,
    options: EncodeOptions,
    *,
    weights: F32 | None,
    metric: ErrorMetric | None,
    measured: bool,
    is_sample: bool,
    trial: Rows,
    context: Context,
) -> tuple[CodingParameters, FileCodebooks]:
    """Choose the SH coding, and train the codebook if the coding uses a codebook.

    Args:
        model: the scene.
        parameters: `sh_coding` is "auto", "codebook", "scalar" or "none".
        options: `codebook_size`, `escape_fraction`, `keep_extra`.
        weights: [N] float32, importance of the splats; `None` if no choice depends on it.
        metric: Gauss-Newton matrices of the coefficients; `None`: the identity, times the weights.
        measured: the weights are measured, not guessed from opacity and size.
        is_sample: the model is a sample of the scene, and the codebook is trained on part of the sample. The
            returned assignment covers this part only.
        trial: rows of about a tile, on which scalar coding is tried.
        context: threads, seed and progress.

    Returns:
        The parameters with SH coding and step, and the codebooks.
    """
    sh_plan = ShCodingPlan(weights, _reference_weight(weights), extras=tuple(model.extra) if options.keep_extra else ())
    scalar = replace(parameters, sh_coding="scalar" if parameters.sh_degree else "none"), FileCodebooks(sh_plan)
    if parameters.sh_coding not in ("auto", "codebook") or weights is None or not len(model):
        return scalar
    fine = replace(parameters, sh_coding="codebook", sh_step=parameters.codebook_step)
    kept, is_open = parameters.sh_coefficients, parameters.sh_coding == "auto"
    if is_open and (len(model) < _CODEBOOK_SPLATS_MIN or not _escapes_fit(largest_sh(model.shN[:, :kept]), fine)):
        return scalar
    error_weights = _ErrorWeights(weights, None if metric is None else metric.first(kept), measured)
    size = _codebook_size(len(model), fine, options)
    step = max(1, len(model) // max(_TRAINING_SPLATS, _TRAINING_USERS * size)) if is_sample else 1
    rule, index, distortion = _train(
        model.shN[::step],
        replace(error_weights, weights=weights[::step]),
        size,
        fine,
        options,
        context,
        quantised=model.metadata.quantised,
    )
    rgb = rule.entries.reshape(len(rule.entries), -1, 3).transpose(2, 1, 0).astype(np.float32)
    book = ShCodebook(colour_integers(np.ascontiguousarray(rgb), fine.chroma_shift), index)
    codebooks = make_codebooks(replace(sh_plan, rule=rule), book, fine)
    rate = _codebook_rate(codebooks, book)
    if is_open and not _codebook_pays(model, error_weights, book, rate, distortion, trial[:_TRIAL_SPLATS], parameters):
        return scalar
    return fine, codebooks


def final_parameters(parameters: CodingParameters, largest: float) -> CodingParameters:
    """Choose scalar coding if an escape cannot represent the scene's largest SH coefficient."""
    fine = replace(parameters, sh_step=parameters.codebook_step)
    if parameters.sh_coding == "auto" and not _escapes_fit(largest, fine):
        return replace(parameters, sh_coding="scalar")
    return parameters


def largest_sh(shN: F32) -> float:
    """Return the largest magnitude of a coefficient."""
    return float(max(shN.max(initial=0.0), -shN.min(initial=0.0)))


def assign_splats(
    sh_plan: ShCodingPlan, model: SplatModel, parameters: CodingParameters, context: Context
) -> ShCodingPlan:
    """Return the plan of splats outside the training set, with their own weights and assignment.

    Args:
        sh_plan: the plan of a sample of the scene.
        model: splats of the scene.
        parameters: the final parameters.
        context: threads.
    """
    weights = None if sh_plan.weights is None else splat_weights(model, None)
    own = replace(sh_plan, weights=weights, of_sample=False)
    rule = sh_plan.rule
    if rule is None or sh_plan.book is None or weights is None:
        return own
    nearest, _ = rule.search.nearest(_lattice_points(model.shN, parameters, context), context)
    index = nearest.astype(np.int32)
    error_weights = _ErrorWeights(weights, None, measured=False)
    errors = _entry_errors(model.shN, index, rule.entries, parameters, error_weights, context)
    index[errors >= rule.threshold] = sh_plan.book.size
    return replace(own, book=ShCodebook(sh_plan.book.entries, index))


def nearest_entries(book: ShCodebook, model: SplatModel, parameters: CodingParameters, context: Context) -> ShCodebook:
    """Return a codebook with the entry that is nearest to each splat of another model, without escapes.

    Args:
        book: the codebook.
        model: the splats.
        parameters: the final parameters.
        context: threads.
    """
    rgb = lift_colour(book.entries, parameters.chroma_shift).transpose(2, 1, 0)
    entries = np.ascontiguousarray(rgb, np.int32).reshape(book.size, -1)
    near_groups = _NEAR_GROUPS if book.size >= _GROUPED_ENTRIES_MIN else 0
    points = _lattice_points(model.shN, parameters, context)
    index = assign(points, entries, near_groups=near_groups, context=context)
    return ShCodebook(book.entries, index.astype(np.int32))


def make_codebooks(sh_plan: ShCodingPlan, book: ShCodebook, parameters: CodingParameters) -> FileCodebooks:
    """Return a codebook with its index record and chunks."""
    chunks = []
    for band in range(1, parameters.sh_degree + 1):
        head = _spec.pack_codebook_head(_spec.CodebookHead(_CODEBOOK_ID, band, 0))
        columns = np.ascontiguousarray(book.entries[:, band_slice(band)]).reshape(-1)
        stream = signed_stream(columns, parameters.deflate)
        chunks.append(FileChunk(_spec.CHUNK_CODEBOOK, head + stream, _CODEBOOK_ID, band))
    record = IndexedCodebook(_CODEBOOK_ID, _spec.CODEBOOK_KIND_SH, (1, parameters.sh_degree), book.size)
    return FileCodebooks(replace(sh_plan, book=book), (record,), tuple(chunks))


def sh_coarseness(rows: Rows | slice, parameters: CodingParameters, sh_plan: ShCodingPlan) -> I32 | None:
    """Return the exponent e of the multiples 2**e of the SH step that each splat is rounded to, [n]; `None` for 0.

    With adaptivity a and reference weight w₀, e = a/2 · log₂(w₀ / w): for a = 1, w · (2**e)² is constant.
    """
    if sh_plan.weights is None or parameters.adaptive == 0.0:
        return None
    with np.errstate(divide="ignore"):
        ratio = log2(sh_plan.reference / sh_plan.weights[rows].astype(np.float64))
    return np.clip(np.rint(0.5 * parameters.adaptive * ratio), 0, _COARSEST).astype(np.int32)


def encode_sh(
    source: F32, parameters: CodingParameters, sh_plan: ShCodingPlan
) -> tuple[dict[int, bytes], int, dict[str, tuple[float, float]]]:
    """Encode the bands 1 to `parameters.sh_degree` of a tile.

    Args:
        source: [n, K, 3], the tile's splats in decoding order; their degree may be higher.
        parameters: steps and codings.
        sh_plan: SH coding of these splats.

    Returns:
        The block of each layer, none for a band of zeros; the exponent of the tile's lattice; largest error and sum of
        squares by measure.
    """
    kept = parameters.sh_coefficients
    sums = _BandSums(source.shape[1])
    sums.add(source[:, kept:], np.float32(0), kept)
    layers: dict[int, bytes] = {}
    exponent = 0
    if sh_plan.book is not None:
        layers = _encode_by_codebook(source[:, :kept], sh_plan.book, parameters, sums)
    elif kept:
        coarse = sh_coarseness(slice(None), parameters, sh_plan)
        columns, exponent, decoded = quantise_sh(source[:, :kept], parameters, coarse)
        sums.add(source[:, :kept], decoded, 0)
        layers = dict(_scalar_blocks(columns, exponent, parameters))
    return layers, exponent, sums.by_band()


def _scalar_blocks(columns: NDArray[Any], exponent: int, parameters: CodingParameters) -> Iterator[tuple[int, bytes]]:
    """Yield layer and block of each band of columns [3, K, n] that is not all zero."""
    for band in range(1, parameters.sh_degree + 1):
        part = columns[:, band_slice(band)]
        if part.any():
            flat = part.reshape(-1, columns.shape[2])
            attribute = _spec.ATTRIBUTE_SH0 + band
            yield band, entropy.signed_or_sparse_block(attribute, flat, exponent, parameters.deflate)


def _encode_by_codebook(
    source: F32, book: ShCodebook, parameters: CodingParameters, sums: _BandSums
) -> dict[int, bytes]:
    """Encode the SH of a tile by a codebook, and add its errors to `sums`.

    Args:
        source: [n, K, 3], the kept coefficients in decoding order.
        book: the codebook with the assignment of these splats.
        parameters: steps and kept bands.
        sums: errors of the tile, changed in place.

    Returns:
        The block of each band: indices in band 1, and integers of escaped splats in every band.

    Raises:
        InputError: an escaped splat does not fit the file's lattice.
    """
    decoded, escaped = book.dequantise(parameters), book.escaped
    coarse = np.full(len(escaped), parameters.escape_coarse, np.int32)
    columns, exponent, decoded_escapes = quantise_sh(source[escaped], parameters, coarse)
    if exponent:
        raise InputError("SH coefficients are too large for escapes of a codebook: use scalar SH coding")
    decoded[escaped] = decoded_escapes
    sums.add(source, decoded, 0)
    layers = {}
    for band in range(1, parameters.sh_degree + 1):
        attribute = _spec.ATTRIBUTE_SH0 + band
        escape = b""
        if len(escaped):
            flat = columns[:, band_slice(band)].reshape(-1, len(escaped))
            escape = entropy.signed_block(attribute, flat, 0, parameters.deflate)
        index = book.index if band == 1 else None
        layers[band] = entropy.codebook_block(attribute, _CODEBOOK_ID, index, len(escaped), escape, parameters.deflate)
    return layers


class _BandSums:
    """Largest error and sum of squares of each coefficient of a tile."""

    def __init__(self, coefficients: int) -> None:
        self._largest = np.zeros(coefficients)
        self._squares = np.zeros(coefficients)

    def add(self, source: F32, decoded: F32 | np.float32, first: int) -> None:
        """Add values [n, k, 3] of the coefficients `first` to `first` + k - 1."""
        span, decoded = slice(first, first + source.shape[1]), np.broadcast_to(decoded, source.shape)
        for start in range(0, len(source) if source.size else 0, _BLOCK):
            difference = source[start : start + _BLOCK] - decoded[start : start + _BLOCK]
            flat = difference.reshape(len(difference), -1)  # reductions over whole rows are ten times faster
            squares = np.square(flat, dtype=np.float64).sum(axis=0)
            self._squares[span] += squares.reshape(-1, 3).sum(axis=1)
            np.abs(flat, out=flat)
            np.maximum(self._largest[span], flat.max(axis=0).reshape(-1, 3).max(axis=1), out=self._largest[span])

    def by_band(self) -> dict[str, tuple[float, float]]:
        """Return (largest, sum of squares) by measure, enlarged by `_SLACK`."""
        result = {}
        for band in range(1, round((len(self._largest) + 1) ** 0.5)):
            largest = float(self._largest[band_slice(band)].max()) * _SLACK
            squares = float(self._squares[band_slice(band)].sum()) * _SLACK
            result[_spec.MEASURE_NAMES[_spec.MEASURE_SH0 + band]] = (largest, squares)
        return result


def _reference_weight(weights: F32 | None) -> float:
    """Return the 95th percentile of the weights [N] or, if that is 0, of the positive weights."""
    if weights is None or not len(weights):
        return 1.0
    if (reference := float(np.quantile(weights, _IMPORTANT))) > 0.0:
        return reference
    positive = weights[weights > 0.0]
    return float(np.quantile(positive, _IMPORTANT)) if len(positive) else 1.0


def _escapes_fit(largest: float, parameters: CodingParameters) -> bool:
    """Return True if every splat can be escaped; escapes are on the file's lattice, which tiles cannot coarsen."""
    return 2.0 * largest < largest_exact(parameters.sh_step)  # chroma is a difference of two channels


def _train(
    shN: F32,
    error_weights: _ErrorWeights,
    size: int,
    parameters: CodingParameters,
    options: EncodeOptions,
    context: Context,
    *,
    quantised: bool,
) -> tuple[AssignmentRule, I32, float]:
    """Train a codebook, and escape the splats that it represents worst.

    Args:
        shN: [N, K', 3], of which the kept coefficients count.
        error_weights: weights of the errors of these splats.
        size: maximum number of entries.
        parameters: step, kept bands, and fraction to escape.
        options: `codebook_size` and `escape_fraction`, if the caller set them.
        context: threads, seed and progress.
        quantised: many splats have equal SH, of which each is clustered once, with the weight of all.

    Returns:
        The entries by frequency, with the rule for other splats; [N] entry of each splat, the number of entries for an
        escaped one; weighted mean squared error, in which escaped splats count 0.
    """
    weights = error_weights.weights
    points = _lattice_points(shN, parameters, context)
    distinct = _distinct_rows(points) if quantised else None
    if distinct is not None and options.codebook_size is None:
        share = max(1.0, len(distinct[0]) / _DISTINCT_PER_ENTRY)
        size = min(size, 1 << max(round(float(log2(share))), _ENTRY_BITS_MIN))
    effort = {}
    if size >= _GROUPED_ENTRIES_MIN:
        effort = {"near_groups": _NEAR_GROUPS, "iterations": _ITERATIONS, "sample_per_entry": _SAMPLE_PER_ENTRY}

    if distinct is None:
        clustered = cluster(points, weights, size, context=context, **effort)
    else:
        rows, inverse = distinct
        summed = np.bincount(inverse, weights).astype(np.float32)
        found, index_of_distinct = cluster(points[rows], summed, size, context=context, **effort)
        clustered = found, index_of_distinct[inverse]
    if error_weights.metric is not None:
        clustered = _refine(shN, points, error_weights.metric, clustered, parameters, context)
    ranked, entries = rank_by_frequency(clustered[1], clustered[0])
    index = ranked.astype(np.int32)
    errors = _entry_errors(shN, index, entries, parameters, error_weights, context)
    escaped = _choose_escapes(shN, errors, parameters, options, error_weights)
    threshold = float(errors[escaped].min(initial=np.inf))
    errors[escaped] = 0.0
    index[escaped] = len(entries)
    total = float(weights.sum(dtype=np.float64)) or 1.0
    search = EntrySearch.of(entries, effort.get("near_groups", 0), _CLIP * points.shape[1] ** 0.5, context)
    rule = AssignmentRule(entries, search, threshold)
    return rule, index, float(errors.sum()) / total


def _refine(
    shN: F32, points: I16, metric: ErrorMetric, book: tuple[I32, U32], parameters: CodingParameters, context: Context
) -> tuple[I32, U32]:
    """Refine entries [E, 3K] and index [N] under the metric; return both, without unused entries.

    Args:
        shN: [N, K', 3], coefficients that `points` are rounded from.
        points: [N, 3K], lattice integers.
        metric: metric of the splats.
        book: entries and index before.
        parameters: step.
        context: threads.
    """
    entries, index = book
    count = points.shape[1] // 3
    targets = np.clip(shN[:, :count] * np.float32(1.0 / parameters.sh_step), -_CLIP, _CLIP)
    start = entries.reshape(-1, count, 3)
    entries, refined = refine_by_metric(targets, metric, start, index.astype(np.int64), context)
    return np.clip(entries, -_CLIP, _CLIP).reshape(len(entries), -1), refined.astype(np.uint32)


def _lattice_points(shN: F32, parameters: CodingParameters, context: Context) -> I16:
    """Return R, G, B integers [N, 3K] of the kept bands, clipped to `_CLIP`."""
    kept = parameters.sh_coefficients
    points = np.empty((len(shN), 3 * kept), np.int16)

    def work(part: slice) -> None:
        rows = shN[part, :kept].reshape(-1, 3 * kept)
        rows = np.clip(rows, -_CLIP * parameters.sh_step, _CLIP * parameters.sh_step)
        rows *= np.float32(1.0 / parameters.sh_step)
        points[part] = np.rint(rows, out=rows)

    run_blocks(work, len(shN), _BLOCK, context)
    return points


def _distinct_rows(points: I16) -> tuple[Rows, Rows]:
    """Return the row of the first of each distinct point, and for each point [N] the number of that row.

    Points [N, D] are told apart by a random linear function modulo 2**64: of 2**20 points, two with the same value are
    expected once in 30 million scenes, and would share an entry, whose error is measured like any other.
    """
    factors: I64 = np.random.default_rng(0).integers(1, 1 << 63, size=(points.shape[1],), dtype=np.int64)
    keys = np.zeros(len(points), np.int64)
    for column in range(points.shape[1]):
        keys += points[:, column] * (factors[column] | 1)
    _, rows, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return rows, inverse.reshape(-1)


def _codebook_size(count: int, parameters: CodingParameters, options: EncodeOptions) -> int:
    """Return the number of entries for `count` splats: the option, or by default a power of two.

    The default is limited to `parameters.codebook_most`, which need not be a power of two. An entry costs about
    20 bytes and reduces the distortion of its users.
    """
    if options.codebook_size is not None:
        return options.codebook_size
    share = parameters.codebook_share
    size = max(count * share, min(_FULL_SHARE_SPLATS * share, count / _USERS_MIN))
    return min(1 << max(round(float(log2(max(1.0, size)))), _ENTRY_BITS_MIN), parameters.codebook_most)


def _entry_errors(
    shN: F32, index: I32, entries: I32, parameters: CodingParameters, error_weights: _ErrorWeights, context: Context
) -> F64:
    """Return the weighted squared error of each splat, [N], if it takes its entry; infinite if it has to be escaped.

    Args:
        shN: [N, K', 3], of which the kept coefficients count.
        index: [N], the entry of each splat.
        entries: [E, 3K], lattice integers.
        parameters: step and kept bands.
        error_weights: weights of the errors of these splats.
        context: threads.
    """
    kept = parameters.sh_coefficients
    table = entries.astype(np.float32) * np.float32(parameters.sh_step)
    errors = np.empty(len(shN))

    def work(part: slice) -> None:
        difference = shN[part, :kept].reshape(-1, 3 * kept).copy()
        clipped = np.flatnonzero(np.abs(difference) > (_CLIP - 1) * parameters.sh_step) // (3 * kept)
        difference -= np.take(table, index[part], axis=0)
        errors[part] = error_weights.errors(difference, part)
        errors[part][clipped] = np.inf

    run_blocks(work, len(shN), _BLOCK, context)
    return errors


def _choose_escapes(
    shN: F32, errors: F64, parameters: CodingParameters, options: EncodeOptions, error_weights: _ErrorWeights
) -> Rows:
    """Return the rows to escape, [n]: the splats with the largest of the errors [N], and all clipped splats.

    If weights are measured, rank by the reduction of the error instead, and escape no splat that gains nothing: an
    important splat may be near its entry, and the lattice of escapes is coarser.
    """
    fraction = parameters.escape_fraction if options.escape_fraction is None else options.escape_fraction
    clipped = int(np.count_nonzero(~np.isfinite(errors)))
    count = max(int(len(errors) * fraction), clipped)
    worst = np.argsort(-errors, kind="stable")
    if not error_weights.measured or not count:
        return np.sort(worst[:count])
    candidates = worst[: _ESCAPE_CANDIDATES * count]
    source = shN[candidates, : parameters.sh_coefficients]
    decoded = quantise_sh(source, parameters, np.full(len(candidates), parameters.escape_coarse, np.int32))[2]
    gain = errors[candidates] - error_weights.errors((source - decoded).reshape(len(candidates), -1), candidates)
    if options.escape_fraction is None:
        count = max(min(count, int(np.count_nonzero(gain > 0.0))), clipped)
    return np.sort(candidates[np.argsort(-gain, kind="stable")[:count]])


def _codebook_rate(codebooks: FileCodebooks, book: ShCodebook) -> float:
    """Estimate the bytes per splat of the entries and, by their entropy, of the indices."""
    entries = sum(len(chunk.payload) for chunk in codebooks.chunks) / len(book.index)
    shares = np.bincount(book.index) / len(book.index)
    # 1e-12 stands for a share of 0, which adds nothing; 8 bits are a byte.
    return entries - float((shares * log2(np.maximum(shares, 1e-12))).sum()) / 8


def _codebook_pays(
    model: SplatModel,
    error_weights: _ErrorWeights,
    book: ShCodebook,
    rate: float,
    distortion: float,
    trial: Rows,
    parameters: CodingParameters,
) -> bool:
    """Return True if the codebook has a lower rate than scalar coding at equal distortion.

    Scalar coding is tried on a few splats at two steps, between which its rate R is linear in the logarithm of the
    distortion D. The codebook has the distortion D_book; scalar coding would save s · log2(D_book / D) with
    s = -ΔR / Δlog2 D, which is added to the rate of the codebook. Quick DEFLATE decides if the rates differ clearly.

    Args:
        model: the scene.
        error_weights: weights of the errors of its splats.
        book: the codebook, with an assignment.
        rate: bytes per splat of the codebook, without escapes.
        distortion: weighted mean squared error with the codebook.
        trial: [n], rows on which scalar coding is tried, n > 0.
        parameters: step of scalar coding, and settings of DEFLATE.
    """
    share = float((book.index == book.size).mean())  # escapes
    scalar_rate = codebook_rate = 0.0
    for deflate in (trial_settings(parameters.deflate), parameters.deflate):
        fine = replace(parameters, deflate=deflate)
        scalar_rate, fine_distortion = _try_scalar(model, error_weights, trial, fine)
        coarser = replace(fine, sh_step=2 * parameters.sh_step)
        coarse_rate, coarse_distortion = _try_scalar(model, error_weights, trial, coarser)
        codebook_rate = rate + share * scalar_rate
        if 0.0 < fine_distortion < coarse_distortion:
            slope = (scalar_rate - coarse_rate) / float(log2(coarse_distortion / fine_distortion))
            codebook_rate += slope * float(log2(max(distortion, 1e-30) / fine_distortion))  # finite if it is 0
        if deflate == parameters.deflate or abs(codebook_rate - scalar_rate) > _CLEAR * scalar_rate:
            break
    return codebook_rate < scalar_rate


def _try_scalar(
    model: SplatModel, error_weights: _ErrorWeights, trial: Rows, parameters: CodingParameters
) -> tuple[float, float]:
    """Return bytes per splat and weighted mean squared error of scalar coding of the rows `trial` [n]."""
    source = np.take(model.shN, trial, axis=0)[:, : parameters.sh_coefficients]
    columns, _, decoded = quantise_sh(source, parameters, None)
    size = sum(len(block) for _, block in _scalar_blocks(columns, 0, parameters))
    errors = error_weights.errors((source - decoded).reshape(len(trial), -1), trial)
    return size / len(trial), float(errors.sum() / (error_weights.weights[trial].sum(dtype=np.float64) or 1.0))
