# SPDX-License-Identifier: Apache-2.0
"""Check the caller's limits (LIM-1) against the index before anything is allocated."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from csplat import _spec
from csplat.decoder.codebooks import table_bytes
from csplat.decoder.container import SceneHeader, Tile
from csplat.errors import InputError, LimitError


@dataclass(frozen=True)
class Limits:
    """Limits of a decode, by default the registry's.

    Attributes:
        splats: maximum number of splats decoded; default: no limit.
        bytes: maximum size of the returned arrays and the codebooks.
        json_bytes: maximum memory of a JSON text, estimated from its bytes and values (spec STR-8).
    """

    splats: int = sys.maxsize
    bytes: int = _spec.BUDGET_BYTES
    json_bytes: int = _spec.BUDGET_JSON_BYTES

    def __post_init__(self) -> None:
        for name in ("splats", "bytes", "json_bytes"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 0:
                raise InputError(f"limit {name} is {value!r}, expected a whole number, 0 or more")


def float_bytes(header: SceneHeader, degree: int) -> int:
    """Return the bytes per splat in the arrays of spec 3."""
    floats = 3 + 4 + 3 + 1 + 3 * (degree + 1) ** 2
    return 4 * floats + sum(np.dtype(column.dtype).itemsize for column in header.extras if column.dtype)


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
