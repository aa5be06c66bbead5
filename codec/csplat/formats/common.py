# SPDX-License-Identifier: Apache-2.0
"""Shared steps of the formats: rows to scenes, checks of values, quaternion packing, sorting on a Z curve."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.entropy import morton_codes
from csplat.errors import InputError, counted
from csplat.file_source import named_errors
from csplat.formats.format import ARRAYS, ValueRange
from csplat.lint import Finding
from csplat.model import SplatModel, normalise_quats
from csplat.ply.columns import LOG_OF_0, RowStatistics, count_huge_rows, list_findings
from csplat.portable_math import log
from csplat.scene import BLOCK_SPLATS, Scene
from csplat.spherical_harmonics import SH_C0
from csplat.types import F32, F64, I64, U8

Rows = NDArray[Any]

_HUGE = float(np.exp(87.0))  # scene units; huge values are only counted if a standard deviation exceeds this


def finite_scene(
    blocks: Callable[[], Iterator[tuple[Rows, ...]]],
    decode: Callable[..., SplatModel],
    empty: SplatModel,
    *,
    zero_quat: int = 0,
) -> Scene:
    """Build a scene from structured rows, dropping and counting rows with NaN or infinity.

    Args:
        blocks: yields tuples of rows, at most `BLOCK_SPLATS`, and further arrays of the same length.
        decode: called with the natural logarithms of the scales and such a tuple, returns a model.
        empty: the model of no rows, with the metadata of the scene.
        zero_quat: value of each component of a rotation of length 0 in the file.

    Returns:
        The scene; its findings contain an error if there are rows but none is finite.
    """
    total = kept_count = blank_count = 0
    scale_range, statistics = RangeStatistics(), RowStatistics()
    for rows, *_ in blocks():
        good = _finite_rows(rows)
        finite = rows if good.all() else rows[good]
        scales = np.ascontiguousarray(finite["scales"])
        scale_range.add(scales, total)
        colours = [finite["shN"]] if "shN" in (rows.dtype.names or ()) and finite["shN"].dtype.kind == "f" else []
        huge = max(scale_range.most, -scale_range.least) > _HUGE
        statistics.huge += count_huge_rows(log_scales(scales.astype(np.float32)) if huge else scales[:0], *colours)
        blank_count += _count_empty_rows(rows)
        zero = np.logical_and.reduce([finite["quats"][:, part] == zero_quat for part in range(4)])
        statistics.zero_quats += int(np.count_nonzero(zero))
        total += len(rows)
        kept_count += len(finite)
    statistics.nonfinite = total - kept_count
    are_logs, findings = classify_scales(scale_range, "scale", strict=False)
    findings = list_findings(statistics, total) + findings
    if blank_count:
        text = f"{counted(blank_count, 'splat')} whose bytes are all 0, which are invisible: kept"
        findings.append(Finding("zero-rows", blank_count, f"{text}; an interrupted download may leave them", "note"))

    def models() -> Iterator[SplatModel]:
        for parts in blocks():
            good = _finite_rows(parts[0])
            if good.any():
                finite = parts if good.all() else tuple(part[good] for part in parts)
                scales = finite[0]["scales"].astype(np.float32)
                yield decode(scales if are_logs else log_scales(scales), *finite)

    return Scene.like(empty, kept_count, models, findings)


def _count_empty_rows(rows: Rows) -> int:
    """Count rows whose bits are all 0."""
    transparent = rows[rows["colours"][:, 3] == 0]
    return int(np.count_nonzero(~transparent.view(np.uint8).reshape(len(transparent), rows.dtype.itemsize).any(axis=1)))


def _finite_rows(rows: Rows) -> NDArray[np.bool_]:
    """Return a mask [N] of the rows without NaN and infinity; columns of integers are not checked."""
    good = np.ones(len(rows), bool)
    for name in rows.dtype.names or ():
        if rows.dtype[name].base.kind == "f" and rows[name].size:
            with np.errstate(over="ignore", invalid="ignore"):
                suspicious = not np.isfinite(rows[name].sum(dtype=np.float32))  # a sum of finite values may overflow
            if suspicious:
                good &= np.isfinite(rows[name]).all(axis=1)
    return good


def log_scales(scales: F32) -> F32:
    """Return natural logarithms of standard deviations, at least `LOG_OF_0`."""
    logs: F32 = np.maximum(log(np.abs(scales)).astype(np.float32), np.float32(LOG_OF_0))
    return logs


def round_to_bytes(values: F32) -> U8:
    """Round to integers, clipped to 0..255."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def sh0_from_bytes(colours: NDArray[np.uint8]) -> F32:
    """Convert colours [N, 3] to SH coefficients of degree 0."""
    return (np.divide(colours, 255, dtype=np.float32) - np.float32(0.5)) / np.float32(SH_C0)


# glTF, .splat and .ksplat store activated values: scales >= 0, opacities from 0 to 1. Some writers omit the activation
# (splat-transform 2.3.1 in its GLB). A single value does not reveal that, the distribution of all values does.
_LOGS = (-30.0, 10.0)  # plausible natural logarithms of lengths in scene units: 1e-13 to 22,026
_MOST_ARE_LOGS = 0.5  # minimum fraction of negative values: most splats of trained scenes are smaller than one unit
_MANY_LOGITS = 0.25  # minimum fraction of values outside 0..1; trained scenes have two thirds or more
_OVERSHOOT = (-1.0, 2.0)  # opacities in this range are clipped: writers without a sigmoid overshoot occasionally


@dataclass
class RangeStatistics:
    """Statistics of values relative to an allowed range, updated by `add`.

    Attributes:
        low, high: the allowed range.
        count: number of values.
        below, above: number of values below and above the range.
        least, most: minimum and maximum of all values.
        rows: number of splats with a value outside the range.
        first: index of the first such splat and its value; `None` if there is none.
    """

    low: float = 0.0
    high: float = np.inf
    count: int = 0
    below: int = 0
    above: int = 0
    least: float = np.inf
    most: float = -np.inf
    rows: int = 0
    first: tuple[int, float] | None = None

    def add(self, values: NDArray[Any], start: int) -> None:
        """Add values [N] or [N, C] of the splats from index `start` on; NaN counts as inside the range."""
        if not values.size:
            return
        least, most = float(np.fmin.reduce(values, axis=None)), float(np.fmax.reduce(values, axis=None))
        self.count += values.size
        self.least, self.most = min(self.least, least), max(self.most, most)
        if least >= self.low and most <= self.high:
            return
        below, above = values < self.low, values > self.high
        self.below += int(np.count_nonzero(below))
        self.above += int(np.count_nonzero(above))
        outside = (below | above).reshape(len(values), -1)
        rows = np.flatnonzero(outside.any(axis=1))
        self.rows += len(rows)
        if len(rows) and self.first is None:
            value = values.reshape(len(values), -1)[rows[0]][outside[rows[0]]][0]
            self.first = (start + int(rows[0]), float(value))


class ClampStatistics:
    """Counts of the values of some scenes that a writer clamps, by attribute."""

    def __init__(self) -> None:
        self._scenes: list[dict[str, tuple[ValueRange, RangeStatistics]]] = []

    def watch(self, scene: Scene, ranges: Mapping[str, ValueRange]) -> Scene:
        """Return the scene with blocks that are counted; only the last iteration over them counts.

        Args:
            scene: the scene as it is written.
            ranges: ranges of the attributes in the file, as in `Format.ranges`.
        """
        if not ranges:
            return scene
        place = len(self._scenes)
        self._scenes.append({})

        def blocks() -> Iterator[SplatModel]:
            statistics_by_name = {
                name: RangeStatistics(
                    value_range.low - value_range.step / 2.0, value_range.high + value_range.step / 2.0
                )
                for name, value_range in ranges.items()
            }
            self._scenes[place] = {name: (ranges[name], statistics) for name, statistics in statistics_by_name.items()}
            for rows, model in scene.numbered():
                for name, statistics in statistics_by_name.items():
                    statistics.add(getattr(model, name), rows.start)
                yield model

        return scene.changed(reader=blocks)

    def findings(self, title: str, holders: Callable[[str, float, float], Sequence[str]]) -> list[Finding]:
        """Return a finding for each attribute with clamped values.

        Args:
            title: title of the format.
            holders: called with an attribute and its least and largest value; returns the names of other formats that
                hold such values.
        """
        findings = []
        for name in ARRAYS:
            watched = [scene[name] for scene in self._scenes if name in scene]
            rows = sum(statistics.rows for _, statistics in watched)
            values = sum(statistics.below + statistics.above for _, statistics in watched)
            if not rows:
                continue
            # Of several scenes, the text describes the scene with the largest error.
            error, stored, worst = max(
                (
                    (max(stored.low - statistics.least, statistics.most - stored.high), stored, statistics)
                    for stored, statistics in watched
                ),
                key=lambda clamp: clamp[0],
            )
            others = holders(
                name,
                min(statistics.least for _, statistics in watched),
                max(statistics.most for _, statistics in watched),
            )
            text = f"{counted(values, 'value')} of {name} in {counted(rows, 'splat')} outside {stored.low:.4g} to"
            text += f" {stored.high:.4g}, the range of {title}: clamped, by up to {error:.3g}"
            text += _clamped_sizes(name, stored, worst)
            if others:
                *first, last = others
                text += f"; {', '.join(first)}{' and ' if first else ''}{last} hold them"
            findings.append(Finding("clamped-values", rows, text, "loss", attribute=name, largest_error=error))
        return findings


def _clamped_sizes(name: str, stored: ValueRange, clamped: RangeStatistics) -> str:
    """Describe clamped logarithms of scales as sizes; return "" for other attributes."""
    if name != "scales":
        return ""
    ends = [(clamped.most, stored.high)] if clamped.above else []
    ends += [(clamped.least, stored.low)] if clamped.below else []
    with np.errstate(over="ignore"):  # a size beyond float64 is shown as inf
        sizes = [f"{np.exp(np.float64(value)):.3g} becomes {np.exp(np.float64(end)):.3g}" for value, end in ends]
    return f" (a size of {', one of '.join(sizes)} scene units)"


_MOVED = 0.125  # fraction of a splat's standard deviation; common rounding moves it by less than a fiftieth


@dataclass
class MovedSplats:
    """Splats that a writer moves visibly by rounding their positions, updated by `add`.

    Attributes:
        count: number of splats moved by more than `_MOVED` of their largest standard deviation.
        largest: largest movement along an axis among these, scene units.
    """

    count: int = 0
    largest: float = 0.0

    def add(self, model: SplatModel, written: NDArray[Any]) -> None:
        """Add splats whose positions are written as `written` [N, 3], scene units."""
        with np.errstate(over="ignore"):
            errors = np.abs(written - model.means.astype(np.float64)).max(axis=1, initial=0.0)
            moved = errors > _MOVED * np.exp(model.scales.max(axis=1, initial=-np.inf).astype(np.float64))
        self.count += int(np.count_nonzero(moved))
        self.largest = max(self.largest, float(errors.max(where=moved, initial=0.0)))

    def findings(self, reason: str) -> list[Finding]:
        """Return the finding, if there are any; `reason` is why the positions are coarse."""
        if not self.count:
            return []
        text = f"{counted(self.count, 'splat')} moved visibly, by up to {self.largest:.3g} scene units: {reason};"
        text += " --drop-floaters drops splats far from all others, and ply, gltf and csplat hold them"
        return [Finding("moved-splats", self.count, text, "loss", attribute="means", largest_error=self.largest)]


def classify_scales(stats: RangeStatistics, name: str, *, strict: bool, writer: str = "") -> tuple[bool, list[Finding]]:
    """Decide whether scales are logarithms.

    Args:
        stats: statistics of the scales of a file, with an allowed range from 0 on.
        name: name of their column, for messages.
        strict: negative scales are an error. Otherwise their sign is ignored, because covariances contain squares.
        writer: the program that wrote the file, if the file names it.

    Returns:
        True if the scales are logarithms; and findings, which contain an error if they are neither.
    """
    if stats.first is None:
        return False, []
    share, (row, value) = stats.below / stats.count, stats.first
    if share >= _MOST_ARE_LOGS and _LOGS[0] <= stats.least and stats.most <= _LOGS[1]:
        by = f" (written by {writer})" if writer else ""
        text = f"{name}: {share:.0%} of the values are negative, standard deviations never are: read as logarithms{by}"
        return True, [Finding("log-scales", stats.rows, text, "repair")]
    text = f"{name} of splat {row} is {value:.6g}, expected a standard deviation of at least 0"
    if not strict:
        repair = f"{text}; {counted(stats.rows, 'splat')} of that kind: the sign is ignored"
        return False, [Finding("negative-scales", stats.rows, repair, "repair")]
    text += f"; {share:.1%} of the values are negative, from {stats.least:.3g} to {stats.most:.3g}: export it again"
    return False, [Finding("negative-scales", stats.rows, text, "error")]


def classify_opacities(stats: RangeStatistics, name: str) -> tuple[bool, list[Finding]]:
    """Decide whether opacities are logits; like `classify_scales`, with an allowed range of 0 to 1."""
    if stats.first is None:
        return False, []
    share, (row, value) = stats.rows / stats.count, stats.first
    if share >= _MANY_LOGITS and stats.below and (stats.above or stats.least < _OVERSHOOT[0]):
        text = f"{name}: {share:.0%} of the values are outside 0 to 1, from {stats.least:.3g} to {stats.most:.3g}"
        return True, [Finding("logit-opacities", stats.rows, f"{text}: read as logits", "repair")]
    text = f"{name} of splat {row} is {value:.6g}, expected 0 to 1"
    if _OVERSHOOT[0] <= stats.least and stats.most <= _OVERSHOOT[1]:
        repair = f"{text}; {counted(stats.rows, 'splat')} of that kind: clipped"
        return False, [Finding("out-of-range-opacities", stats.rows, repair, "repair")]
    text += f"; the values range from {stats.least:.3g} to {stats.most:.3g}: export it again"
    return False, [Finding("out-of-range-opacities", stats.rows, text, "error")]


_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def crossed_bounds(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of the lower bounds that exceed their upper bound by more than a float32 rounding."""
    above: NDArray[np.bool_] = low > np.nextafter(high.astype(np.float32), np.float32(np.inf))
    return above


def encode_smallest_three(quats: F32) -> tuple[NDArray[np.int64], F32]:
    """Drop the largest component of each unit quaternion, which the other three determine once it is positive.

    Args:
        quats: [N, 4], unit.

    Returns:
        [N] index of the dropped component, 0 to 3, the lowest on ties; and [N, 3] the others in order, within
        ± 1 / sqrt(2).
    """
    largest = np.argmax(np.abs(quats), 1)
    rows = np.arange(len(quats))
    sign = np.where(quats[rows, largest] < 0, np.float32(-1), np.float32(1))
    return largest, quats[rows[:, None], _OTHERS[largest]] * sign[:, None]


def decode_smallest_three(largest: NDArray[Any], three: F32) -> F32:
    """Invert `encode_smallest_three`; components whose squares sum to more than 1 are rescaled.

    Args:
        largest: [N], 0 to 3.
        three: [N, 3] float32, within ± 1.

    Returns:
        [N, 4] float32, unit.
    """
    quats = np.empty((len(three), 4), np.float32)
    left = 1.0 - np.square(three).sum(axis=1)
    np.sqrt(np.maximum(left, 0.0, out=left), out=left)
    for index, others in enumerate(_OTHERS):
        here = np.flatnonzero(largest == index)
        quats[here[:, None], others] = three[here]
        quats[here, index] = left[here]
    return normalise_quats(quats)


_STEP_BITS = 19  # bits per axis of a cell of the Z curve; 5 more bits of a code number the shell
_CURVE_QUANTILES = (0.2, 0.8)  # between which positions spread: a third of the splats of a scene may be its sky
_CORE, _SHELL_RATIO = 8.0, 16.0  # half the width of the cube around the middle, in spreads; the ratio of two shells
_SHELL_CODES = np.arange(1, 32) << 3 * _STEP_BITS  # the least code of each shell; 16**31 spreads exceed float32
_CURVE_SAMPLE = 1 << 16  # number of splats that determine the bounds of the curve and its splits
_IN_MEMORY = 1 << 24  # bytes; smaller scenes are sorted without a file


@contextmanager
def sorted_along_curve(scene: Scene, folder: Path) -> Iterator[Scene]:
    """Sort a scene along a Z curve, which keeps neighbours together; splats in one cell keep their order.

    Args:
        scene: the scene; its blocks are read twice.
        folder: as in `sorted_parts`.

    Yields:
        The sorted scene without extra columns; all blocks but the last are full.

    Raises:
        InputError: raised by the blocks of the scene.
        OSError: the folder is full.
    """
    curve = _ZCurve.through(scene)
    with sorted_parts(scene, folder, curve.codes, curve.splits) as parts:
        yield Scene.like(parts.empty, scene.count, parts.blocks, scene.findings)


@contextmanager
def sorted_shells(scene: Scene, folder: Path) -> Iterator[list[Scene]]:
    """Sort a scene like `sorted_along_curve`, and divide it by the distance from its middle.

    Yields:
        The splats around the middle, then the splats of each shell that contains any; a shell is 16 times as wide as
        the previous shell.
    """
    curve = _ZCurve.through(scene)
    with sorted_parts(scene, folder, curve.codes, curve.splits) as parts:
        starts = [0, *(np.searchsorted(curve.splits, _SHELL_CODES) + 1), len(parts.counts)]
        yield [
            Scene.like(parts.empty, count, partial(parts.blocks, start, stop))
            for start, stop in pairwise(starts)
            if (count := int(parts.counts[start:stop].sum()))
        ]


@dataclass(frozen=True, eq=False)
class SortedParts:
    """A scene that is sorted by keys and divided.

    Attributes:
        empty: the model without splats or extra columns.
        counts: number of splats of each part.
        rows: returns the parts from one index to another as rows for `scene_of_rows`, one by one.
    """

    empty: SplatModel
    counts: I64
    rows: Callable[[int, int], Iterator[Rows]]

    def blocks(self, start: int = 0, stop: int | None = None) -> Iterator[SplatModel]:
        """Yield the splats of some parts in blocks, of which all but the last are full."""
        pending: list[Rows] = []  # empty, or one array of rows not yet yielded
        for rows in self.rows(start, len(self.counts) if stop is None else stop):
            pending = [np.concatenate([*pending, rows])]
            while len(pending[0]) >= BLOCK_SPLATS:
                yield _model_of_rows(self.empty, pending[0][:BLOCK_SPLATS])
                pending = [pending[0][BLOCK_SPLATS:]]
        if pending and len(pending[0]):
            yield _model_of_rows(self.empty, pending[0])


@contextmanager
def sorted_parts(scene: Scene, folder: Path, keys: Callable[[F32], I64], splits: I64) -> Iterator[SortedParts]:
    """Sort a scene by keys of positions, and divide it at some keys; splats with the same key keep their order.

    Args:
        scene: the scene; its blocks are read once.
        folder: folder for an unnamed temporary file of 56 bytes per splat and 12 per SH coefficient. Only one block
            and one part are in memory at a time.
        keys: returns the key of each position [n, 3].
        splits: the least key of each part but the first, ascending.

    Raises:
        InputError: raised by the blocks of the scene.
        OSError: the folder is full.
    """
    empty = replace(scene.empty(), extra={}, means_double=None)
    dtype = np.dtype([(name, "<f4", getattr(empty, name).shape[1:]) for name in ARRAYS])
    with tempfile.SpooledTemporaryFile(_IN_MEMORY, dir=str(folder)) as spool:
        runs = []  # per block written: the offsets of its parts
        for model in scene.blocks():
            codes = keys(model.means)
            order = np.argsort(codes, kind="stable")
            rows = np.empty(len(model), dtype)
            for name in ARRAYS:
                rows[name] = getattr(model, name)[order]
            parts = np.searchsorted(codes[order], splits)
            runs.append(spool.tell() + dtype.itemsize * np.concatenate([[0], parts, [len(model)]]))
            with named_errors(folder):
                spool.write(rows.tobytes())
        counts = np.zeros(len(splits) + 1, np.int64)
        for run in runs:
            counts += np.diff(run) // dtype.itemsize

        def rows_of(start: int, stop: int) -> Iterator[Rows]:
            return _merge_runs(spool, runs, keys, dtype, start, stop)

        yield SortedParts(empty, counts, rows_of)


def _merge_runs(
    spool: IO[bytes], runs: Sequence[I64], keys: Callable[[F32], I64], dtype: np.dtype[Any], start: int, stop: int
) -> Iterator[Rows]:
    """Yield the rows of each part from `start` to `stop`, sorted by key; nothing without runs.

    Args:
        spool: sorted rows of type `dtype`.
        runs: per run, the file offsets of its parts, and of its end.
        keys: as in `sorted_parts`.
        dtype: type of the rows.
        start, stop: range of parts.
    """
    if not runs:
        return
    for part in range(start, stop):
        pieces = []
        for run in runs:
            spool.seek(run[part])
            pieces.append(np.frombuffer(spool.read(run[part + 1] - run[part]), dtype))
        rows = np.concatenate(pieces)
        pieces.clear()  # a part may be large
        rows = rows[np.argsort(keys(rows["means"]), kind="stable")]
        yield rows


def scene_of_rows(empty: SplatModel, rows: Rows) -> Scene:
    """Return the scene of rows with the fields of `ARRAYS`; its blocks copy them."""

    def blocks() -> Iterator[SplatModel]:
        for start in range(0, len(rows), BLOCK_SPLATS):
            yield _model_of_rows(empty, rows[start : start + BLOCK_SPLATS])

    return Scene.like(empty, len(rows), blocks)


def _model_of_rows(empty: SplatModel, rows: Rows) -> SplatModel:
    """Return a model like `empty` with the arrays of structured rows [n]."""
    arrays: dict[str, Any] = {name: np.ascontiguousarray(rows[name]) for name in ARRAYS}
    return replace(empty, **arrays)


@dataclass(frozen=True)
class _ZCurve:
    """A Z curve through a scene: first through a cube around its middle, then through shells around that.

    Attributes:
        middle: [3], scene units.
        spread: half the width of most of the scene, scene units.
        splits: codes that divide the scene into shells, and these into blocks of about equal size.
    """

    middle: F64
    spread: float
    splits: I64

    @classmethod
    def through(cls, scene: Scene) -> _ZCurve:
        """Fit the curve to a sample of the scene; reads all blocks.

        Raises:
            InputError: the blocks have another number of splats than the scene.
        """
        stride = -(-scene.count // _CURVE_SAMPLE) or 1
        samples = [np.zeros((0, 3), np.float32)]
        count = 0
        for model in scene.blocks():
            samples.append(model.means[-count % stride :: stride])
            count += len(model)
        sample = np.concatenate(samples)
        if count != scene.count:
            raise InputError(f"the scene has {count:,} splats, expected {scene.count:,}")
        if not len(sample):
            return cls(np.zeros(3), 1.0, _SHELL_CODES)
        most = np.quantile(sample.astype(np.float64), _CURVE_QUANTILES, axis=0)
        low, high = most if (most[1] > most[0]).any() else (sample.min(0).astype(np.float64), sample.max(0))
        curve = cls((low + high) / 2.0, float((high - low).max()) / 2.0 or 1.0, _SHELL_CODES)
        codes = np.sort(curve.codes(sample))
        blocks = -(-scene.count // BLOCK_SPLATS)
        return replace(curve, splits=np.union1d(_SHELL_CODES, codes[np.arange(1, blocks) * len(codes) // blocks]))

    def codes(self, means: F32) -> I64:
        """Return the codes of positions [N, 3] along the curve, [N].

        A code is the shell's number (0: the cube around the middle), then 3 * `_STEP_BITS` bits of Morton code within
        the shell's cube.
        """
        places = (means - self.middle) / (_CORE * self.spread)  # the cube around the middle is -1 to 1
        radii = np.abs(places).max(axis=1, initial=1.0)  # at least 1, so that the cube is shell 0
        shells = np.minimum(np.ceil(np.log(radii) / np.log(_SHELL_RATIO)), len(_SHELL_CODES))
        places /= _SHELL_RATIO ** shells[:, None]  # the shell's cube is -1 to 1
        cells = np.clip((places + 1.0) * 2.0 ** (_STEP_BITS - 1), 0, 2**_STEP_BITS - 1).astype(np.int64)
        codes: I64 = shells.astype(np.int64) << 3 * _STEP_BITS | morton_codes(cells.T)
        return codes
