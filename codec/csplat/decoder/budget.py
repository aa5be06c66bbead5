# SPDX-License-Identifier: Apache-2.0
"""Check the caller's limits (LIM-1) against the index before anything is allocated."""

from __future__ import annotations

from collections.abc import Sequence

from csplat import _spec
from csplat.decoder.codebooks import table_bytes
from csplat.decoder.container import SceneHeader, Tile
from csplat.decoder.limits import Limits
from csplat.errors import LimitError


def integer_bytes(degree: int) -> int:
    """Return the bytes per splat in the integer arrays of spec 9.2."""
    return 4 + 8 * 3 + 4 * 3 + 8 * 3 + 8 * 3 * (degree + 1) ** 2


def check_budget(
    header: SceneHeader,
    tiles: Sequence[Tile],
    degree: int,
    splat_bytes: int,
    limits: Limits,
    *,
    whole: bool,
    at_once: bool = True,
) -> None:
    """Refuse a decode that would exceed the limits.

    Args:
        header: header and index.
        tiles: tiles to decode.
        degree: highest SH band to decode.
        splat_bytes: bytes per splat of the result.
        limits: the caller's limits.
        whole: the whole file is decoded, which reads every codebook.
        at_once: the result holds all tiles, not one at a time.

    Raises:
        LimitError: E_LIMIT by LIM-1; `limit` is a field of `Limits`.
    """
    counts = [tile.splat_count for tile in tiles]
    at = _spec.HEADER_SIZE + _spec.INDEX_HEAD_OFFSETS["splat_count"]
    if sum(counts) > limits.splats:
        raise LimitError("splats", sum(counts), limits.splats, offset=at, clause="LIM-1")
    splats = sum(counts) if at_once else max(counts, default=0)
    size = splats * splat_bytes + table_bytes(header, tiles, degree, whole=whole)
    if size > limits.bytes:
        raise LimitError("bytes", size, limits.bytes, offset=at, clause="LIM-1")
