"""What formats share whose splats are rows of one type, with plain standard deviations and colours in bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.lint import refuse
from csplat.model import F32, SplatModel
from csplat.ply_columns import SH_C0, Counts, findings_of
from csplat.scene import Scene

__all__ = ["SH_C0", "colours_of_bytes", "finite_scene", "logs_of_scales"]

Rows = NDArray[Any]

_SMALLEST = np.float32(1e-20)  # what a standard deviation of 0 becomes


def finite_scene(
    blocks: Callable[[], Iterator[tuple[Rows, ...]]], decoded: Callable[..., SplatModel], facts: SplatModel
) -> Scene:
    """A scene of the rows without NaN and infinity; the others are dropped and counted.

    Args:
        blocks: gives structured rows, at most `BLOCK` at a time, and arrays as long beside them.
        decoded: makes a model of such a tuple.
        facts: as of `Scene`.

    Raises:
        InputError: there are rows, and none is finite.
    """
    total = kept = 0
    for rows, *_ in blocks():
        total += len(rows)
        kept += int(np.count_nonzero(_finite(rows)))
    findings = findings_of(Counts(nonfinite=total - kept), total) if kept < total else []
    refuse(findings, strict=False)

    def models() -> Iterator[SplatModel]:
        for parts in blocks():
            good = _finite(parts[0])
            if good.any():
                yield decoded(*(parts if good.all() else (part[good] for part in parts)))

    return Scene(kept, facts, models, findings)


def _finite(rows: Rows) -> NDArray[np.bool_]:
    good = np.ones(len(rows), bool)
    for name in rows.dtype.names or ():
        if rows.dtype[name].base.kind == "f" and rows[name].size:
            with np.errstate(over="ignore", invalid="ignore"):
                one_is_not = not np.isfinite(rows[name].sum(dtype=np.float32))  # or the sum is too large
            if one_is_not:
                good &= np.isfinite(rows[name]).all(axis=1)
    return good


def logs_of_scales(scales: Rows) -> F32:
    """Natural logarithms of standard deviations; the sign of one means nothing, and 0 becomes something tiny."""
    logs: F32 = np.log(np.maximum(np.abs(scales.astype(np.float32)), _SMALLEST))
    return logs


def colours_of_bytes(colours: NDArray[np.uint8]) -> F32:
    """SH coefficients of degree 0 of colours that are seen from everywhere."""
    return (np.divide(colours, 255, dtype=np.float32) - np.float32(0.5)) / SH_C0
