"""Scenes from formats whose splats are rows of one type, with plain standard deviations and colours in bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import counted
from csplat.formats.activations import Spread, read_scales_as
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.ply.columns import SH_C0, RowStatistics, count_huge_rows, list_findings
from csplat.scene import Scene
from csplat.types import F32

Rows = NDArray[Any]

_HUGE = float(np.exp(87.0))  # from here on it is worth while to look for huge values
_SMALLEST = np.float32(1e-20)  # value that a standard deviation of 0 is replaced by


def finite_scene(
    blocks: Callable[[], Iterator[tuple[Rows, ...]]],
    decoded: Callable[..., SplatModel],
    facts: SplatModel,
    *,
    zero_quat: int = 0,
) -> Scene:
    """Make a scene of the rows without NaN and infinity; the others are dropped and counted.

    Args:
        blocks: yields structured rows, at most `BLOCK` at a time, together with arrays of the same length.
        decoded: makes a model of natural logarithms of scales and such a tuple.
        facts: as in `Scene`.
        zero_quat: value of each component of a rotation of length 0 in the file.

    Returns:
        The scene; if there are rows, but none is finite, its findings hold an error.
    """
    total, kept, empty, spread, counts = 0, 0, 0, Spread(), RowStatistics()
    for rows, *_ in blocks():
        good = _finite(rows)
        found = rows if good.all() else rows[good]
        scales = np.ascontiguousarray(found["scales"])
        spread.add(scales, total)
        colours = [found["shN"]] if "shN" in (rows.dtype.names or ()) and found["shN"].dtype.kind == "f" else []
        huge = max(spread.most, -spread.least) > _HUGE  # so far; most files have none
        counts.huge += count_huge_rows(_logs(scales.astype(np.float32)) if huge else scales[:0], *colours)
        empty += _empty_rows(rows)
        zero = np.logical_and.reduce([found["quats"][:, part] == zero_quat for part in range(4)])
        counts.zero_quats += int(np.count_nonzero(zero))
        total += len(rows)
        kept += len(found)
    counts.nonfinite = total - kept
    are_logs, findings = read_scales_as(spread, "scale", strict=False)
    findings = list_findings(counts, total) + findings
    if empty:
        text = f"{counted(empty, 'splat')} whose bytes are all 0, which nothing is seen of: kept"
        findings.append(Finding("zero-rows", empty, f"{text}; a download that broke off may leave them", "note"))

    def models() -> Iterator[SplatModel]:
        for parts in blocks():
            good = _finite(parts[0])
            if good.any():
                kept = parts if good.all() else tuple(part[good] for part in parts)
                scales = kept[0]["scales"].astype(np.float32)
                yield decoded(scales if are_logs else _logs(scales), *kept)

    return Scene(kept, facts, models, findings)


def _empty_rows(rows: Rows) -> int:
    """Count rows without a bit that is set."""
    unseen = np.flatnonzero(rows["colours"][:, 3] == 0)
    return int(np.count_nonzero(~rows[unseen].view(np.uint8).reshape(len(unseen), rows.dtype.itemsize).any(axis=1)))


def _finite(rows: Rows) -> NDArray[np.bool_]:
    good = np.ones(len(rows), bool)
    for name in rows.dtype.names or ():
        if rows.dtype[name].base.kind == "f" and rows[name].size:
            with np.errstate(over="ignore", invalid="ignore"):
                one_is_not = not np.isfinite(rows[name].sum(dtype=np.float32))  # or the sum is too large
            if one_is_not:
                good &= np.isfinite(rows[name]).all(axis=1)
    return good


def _logs(scales: F32) -> F32:
    """Natural logarithms of standard deviations; 0 becomes something tiny."""
    logs: F32 = np.log(np.maximum(np.abs(scales), _SMALLEST))
    return logs


def colours_of_bytes(colours: NDArray[np.uint8]) -> F32:
    """SH coefficients of degree 0 of colours that are seen from everywhere."""
    return (np.divide(colours, 255, dtype=np.float32) - np.float32(0.5)) / SH_C0
