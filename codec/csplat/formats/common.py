"""Steps that several formats share: rows to a scene, checks of activated values, packing, sorting along a Z curve."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.entropy import morton_codes
from csplat.errors import InputError, counted
from csplat.formats.format import ARRAYS
from csplat.lint import Finding
from csplat.model import SH_C0, SplatModel, normalise_quats
from csplat.ply.columns import RowStatistics, count_huge_rows, list_findings
from csplat.scene_source import BLOCK_SPLATS, SceneSource
from csplat.types import F32, F64, I64, U8

Rows = NDArray[Any]

_HUGE = float(np.exp(87.0))  # scene units; only files with larger standard deviations are searched for huge values
_SMALLEST = np.float32(1e-20)  # scene units; replaces a standard deviation of 0


def finite_scene(
    blocks: Callable[[], Iterator[tuple[Rows, ...]]],
    decode: Callable[..., SplatModel],
    metadata_model: SplatModel,
    *,
    zero_quat: int = 0,
) -> SceneSource:
    """Make a scene of structured rows, dropping and counting those with NaN or infinity.

    Args:
        blocks: yields rows, at most `BLOCK_SPLATS` at a time, together with arrays of the same length.
        decode: makes a model of natural logarithms of scales and such a tuple.
        metadata_model: as in `SceneSource`.
        zero_quat: value of each component of a rotation of length 0 in the file.

    Returns:
        The scene; its findings hold an error if there are rows but none is finite.
    """
    total, kept, empty, scale_range, statistics = 0, 0, 0, RangeStatistics(), RowStatistics()
    for rows, *_ in blocks():
        good = _finite_rows(rows)
        found = rows if good.all() else rows[good]
        scales = np.ascontiguousarray(found["scales"])
        scale_range.add(scales, total)
        colours = [found["shN"]] if "shN" in (rows.dtype.names or ()) and found["shN"].dtype.kind == "f" else []
        huge = max(scale_range.most, -scale_range.least) > _HUGE  # so far; most files have none
        statistics.huge += count_huge_rows(_log_scales(scales.astype(np.float32)) if huge else scales[:0], *colours)
        empty += _count_empty_rows(rows)
        zero = np.logical_and.reduce([found["quats"][:, part] == zero_quat for part in range(4)])
        statistics.zero_quats += int(np.count_nonzero(zero))
        total += len(rows)
        kept += len(found)
    statistics.nonfinite = total - kept
    are_logs, findings = classify_scales(scale_range, "scale", strict=False)
    findings = list_findings(statistics, total) + findings
    if empty:
        text = f"{counted(empty, 'splat')} whose bytes are all 0, which nothing is seen of: kept"
        findings.append(Finding("zero-rows", empty, f"{text}; a download that broke off may leave them", "note"))

    def models() -> Iterator[SplatModel]:
        for parts in blocks():
            good = _finite_rows(parts[0])
            if good.any():
                kept = parts if good.all() else tuple(part[good] for part in parts)
                scales = kept[0]["scales"].astype(np.float32)
                yield decode(scales if are_logs else _log_scales(scales), *kept)

    return SceneSource(kept, metadata_model, models, findings)


def _count_empty_rows(rows: Rows) -> int:
    """Count rows whose bits are all 0."""
    unseen = np.flatnonzero(rows["colours"][:, 3] == 0)
    return int(np.count_nonzero(~rows[unseen].view(np.uint8).reshape(len(unseen), rows.dtype.itemsize).any(axis=1)))


def _finite_rows(rows: Rows) -> NDArray[np.bool_]:
    good = np.ones(len(rows), bool)
    for name in rows.dtype.names or ():
        if rows.dtype[name].base.kind == "f" and rows[name].size:
            with np.errstate(over="ignore", invalid="ignore"):
                one_is_not = not np.isfinite(rows[name].sum(dtype=np.float32))  # or the sum is too large
            if one_is_not:
                good &= np.isfinite(rows[name]).all(axis=1)
    return good


def _log_scales(scales: F32) -> F32:
    """Return natural logarithms of standard deviations, with `_SMALLEST` in place of 0."""
    logs: F32 = np.log(np.maximum(np.abs(scales), _SMALLEST))
    return logs


def round_to_bytes(values: F32) -> U8:
    """Round to integers within 0 to 255."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def sh0_from_bytes(colours: NDArray[np.uint8]) -> F32:
    """Return the SH coefficients of degree 0 of colours [N, 3]."""
    return (np.divide(colours, 255, dtype=np.float32) - np.float32(0.5)) / np.float32(SH_C0)


# glTF, .splat and .ksplat store values after activation: scales of at least 0, opacities from 0 to 1. Some writers omit
# the activation (splat-transform 2.3.1 in its GLB). One value does not show that; all of them together do.
_LOGS = (-30.0, 10.0)  # plausible natural logarithms of lengths in scene units: 1e-13 to 22,026
_MOST_ARE_LOGS = 0.5  # smallest share of negative values: most splats of trained scenes are smaller than a unit
_MANY_LOGITS = 0.25  # smallest share of values outside of 0..1: in trained scenes it is two thirds and more
_OVERSHOOT = (-1.0, 2.0)  # opacities that are clipped: writers that do not end in a sigmoid overshoot now and then


@dataclass
class RangeStatistics:
    """Statistics of values relative to the range that is allowed, updated by `add`.

    Attributes:
        low, high: the range.
        count: number of values.
        below, above: number of values below and above the range.
        least, most: smallest and largest of all values.
        rows: number of splats with a value outside.
        first: index of the first of these splats and its value; `None`: there is none.
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
        """Add values [N] or [N, C] of the splats from number `start` on; NaN statistics as inside the range."""
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


def classify_scales(found: RangeStatistics, name: str, *, strict: bool, writer: str = "") -> tuple[bool, list[Finding]]:
    """Decide whether scales are logarithms.

    Args:
        found: the scales of a file, with a range from 0 on.
        name: name of their column, for messages.
        strict: the format forbids negative scales; otherwise their sign is ignored: a covariance has their squares.
        writer: the program that wrote the file, if the file names it.

    Returns:
        True if they are logarithms; and findings, with an error if they are neither.
    """
    if found.first is None:
        return False, []
    share, (row, value) = found.below / found.count, found.first
    if share >= _MOST_ARE_LOGS and _LOGS[0] <= found.least and found.most <= _LOGS[1]:
        by = f" (written by {writer})" if writer else ""
        text = f"{name}: {share:.0%} of the values are negative, standard deviations never are: read as logarithms{by}"
        return True, [Finding("log-scales", found.rows, text, "repair")]
    text = f"{name} of splat {row} is {value:.6g}, expected a standard deviation of at least 0"
    if not strict:
        repair = f"{text}; {counted(found.rows, 'splat')} of that kind: the sign is left out"
        return False, [Finding("negative-scales", found.rows, repair, "repair")]
    text += f"; {share:.1%} of the values are negative, from {found.least:.3g} to {found.most:.3g}: export it again"
    return False, [Finding("negative-scales", found.rows, text, "error")]


def classify_opacities(found: RangeStatistics, name: str) -> tuple[bool, list[Finding]]:
    """Decide whether opacities are logits; as `classify_scales`, with a range from 0 to 1."""
    if found.first is None:
        return False, []
    share, (row, value) = found.rows / found.count, found.first
    if share >= _MANY_LOGITS and found.below and (found.above or found.least < _OVERSHOOT[0]):
        text = f"{name}: {share:.0%} of the values lie outside of 0 to 1, from {found.least:.3g} to {found.most:.3g}"
        return True, [Finding("logit-opacities", found.rows, f"{text}: read as logits", "repair")]
    text = f"{name} of splat {row} is {value:.6g}, expected 0 to 1"
    if _OVERSHOOT[0] <= found.least and found.most <= _OVERSHOOT[1]:
        repair = f"{text}; {counted(found.rows, 'splat')} of that kind: clipped"
        return False, [Finding("out-of-range-opacities", found.rows, repair, "repair")]
    text += f"; the values go from {found.least:.3g} to {found.most:.3g}: export it again"
    return False, [Finding("out-of-range-opacities", found.rows, text, "error")]


_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def crossed_bounds(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of lower bounds that exceed the upper one by more than a rounding of float32."""
    above: NDArray[np.bool_] = low > np.nextafter(high.astype(np.float32), np.float32(np.inf))
    return above


def encode_smallest_three(quats: F32) -> tuple[NDArray[np.int64], F32]:
    """Drop the largest component of each rotation after making it positive: the others determine it.

    Args:
        quats: [N, 4], unit.

    Returns:
        The index of the dropped component [N], 0 to 3, the first of equal ones; and the others [N, 3] in order, within
        ± 1 / sqrt(2).
    """
    largest = np.argmax(np.abs(quats), 1)
    rows = np.arange(len(quats))
    sign = np.where(quats[rows, largest] < 0, np.float32(-1), np.float32(1))
    return largest, quats[rows[:, None], _OTHERS[largest]] * sign[:, None]


def decode_smallest_three(largest: NDArray[Any], three: F32) -> F32:
    """Invert `encode_smallest_three`; components whose squares sum to more than 1 are normalised.

    Args:
        largest: [N], 0 to 3.
        three: [N, 3] float32, within ± 1.

    Returns:
        [N, 4] float32, unit.
    """
    quats = np.empty((len(three), 4), np.float32)
    left = 1.0 - np.einsum("nd,nd->n", three, three)
    np.sqrt(np.maximum(left, 0.0, out=left), out=left)
    for index, others in enumerate(_OTHERS):
        here = np.flatnonzero(largest == index)
        quats[here[:, None], others] = three[here]
        quats[here, index] = left[here]
    return normalise_quats(quats)


_STEPS = 1 << 21  # cells along each axis of the Z curve
_CURVE_SAMPLE = 1 << 16  # splats that determine the ends of the curve and its splits
_IN_MEMORY = 1 << 24  # bytes that are sorted without a file


@contextmanager
def sorted_along_curve(scene: SceneSource, folder: Path) -> Iterator[SceneSource]:
    """Sort a scene along a Z curve, which keeps neighbours together; splats in one cell keep their order.

    Args:
        scene: the scene; its blocks are read twice.
        folder: folder for an unnamed file of 56 bytes per splat, and 12 more per SH coefficient. Memory holds only a
            few blocks.

    Yields:
        The sorted scene, without extra columns; all of its blocks but the last are full.

    Raises:
        InputError: the blocks of the scene raise it.
        OSError: the folder is full.
    """
    curve = _ZCurve.through(scene)
    metadata_model = replace(scene.metadata_model, extra={}, means_double=None)
    dtype = np.dtype([(name, "<f4", getattr(metadata_model, name).shape[1:]) for name in ARRAYS])
    with tempfile.SpooledTemporaryFile(_IN_MEMORY, dir=str(folder)) as spool:
        runs = []  # for each block written, the offsets of its parts
        for model in scene.blocks():
            codes = curve.codes(model.means)
            order = np.argsort(codes, kind="stable")
            rows = np.empty(len(model), dtype)
            for name in ARRAYS:
                rows[name] = getattr(model, name)[order]
            parts = np.searchsorted(codes[order], curve.splits)
            runs.append(spool.tell() + dtype.itemsize * np.concatenate([[0], parts, [len(model)]]))
            spool.write(rows.tobytes())
        yield replace(
            scene,
            metadata_model=metadata_model,
            blocks=lambda: _fill_blocks(metadata_model, _merge_runs(spool, runs, dtype, curve)),
        )


def _merge_runs(spool: IO[bytes], runs: Sequence[I64], dtype: np.dtype[Any], curve: _ZCurve) -> Iterator[NDArray[Any]]:
    """Yield sorted rows, about a block at a time: the parts of all runs between two splits."""
    for part in range(len(curve.splits) + 1):
        pieces = []
        for run in runs:
            spool.seek(run[part])
            pieces.append(np.frombuffer(spool.read(run[part + 1] - run[part]), dtype))
        rows = np.concatenate(pieces) if pieces else np.empty(0, dtype)
        yield rows[np.argsort(curve.codes(rows["means"]), kind="stable")]


def _fill_blocks(metadata_model: SplatModel, parts: Iterator[NDArray[Any]]) -> Iterator[SplatModel]:
    left: list[NDArray[Any]] = []
    for rows in parts:
        left = [np.concatenate([*left, rows])]
        while len(left[0]) >= BLOCK_SPLATS:
            yield _model_of_rows(metadata_model, left[0][:BLOCK_SPLATS])
            left = [left[0][BLOCK_SPLATS:]]
    if left and len(left[0]):
        yield _model_of_rows(metadata_model, left[0])


def _model_of_rows(metadata_model: SplatModel, rows: NDArray[Any]) -> SplatModel:
    arrays: dict[str, Any] = {name: np.ascontiguousarray(rows[name]) for name in ARRAYS}
    return replace(metadata_model, **arrays)


@dataclass(frozen=True)
class _ZCurve:
    """A Z curve through a scene.

    Attributes:
        low, high: [3], bounds of a sample; positions beyond are moved to the border.
        splits: codes that divide the scene into blocks of about equal size.
    """

    low: F64
    high: F64
    splits: I64

    @classmethod
    def through(cls, scene: SceneSource) -> _ZCurve:
        stride = -(-scene.count // _CURVE_SAMPLE) or 1
        taken, at = [np.zeros((0, 3), np.float32)], 0
        for model in scene.blocks():
            taken.append(model.means[-at % stride :: stride])
            at += len(model)
        sample = np.concatenate(taken)
        if at != scene.count:
            raise InputError(f"the scene has {at:,} splats, {scene.count:,} were announced")
        if not len(sample):
            return cls(np.zeros(3), np.ones(3), np.zeros(0, np.int64))
        low, high = sample.min(0).astype(np.float64), sample.max(0).astype(np.float64)
        curve = cls(low, np.where(high > low, high, low + 1.0), np.zeros(0, np.int64))
        codes = np.sort(curve.codes(sample))
        blocks = -(-scene.count // BLOCK_SPLATS)
        return replace(curve, splits=codes[np.arange(1, blocks) * len(codes) // blocks])

    def codes(self, means: F32) -> I64:
        """Return the Morton codes of positions [N, 3]."""
        steps = (means - self.low) * (_STEPS / (self.high - self.low))
        return morton_codes(np.clip(steps, 0, _STEPS - 1).astype(np.int64).T)
