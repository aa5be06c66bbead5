# SPDX-License-Identifier: CC0-1.0
"""Check the resource level of the header (spec 8.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence

from csplat import _spec
from csplat_conformance.validator.index import Index, Tile
from csplat_conformance.validator.violation_log import PlacedRecord, ViolationLog

# Bounds of index, codebooks, tile and version in bytes, written by hand to check the registry.
_MIB = 1 << 20
_BOUNDS = ((1 * _MIB, 16 * _MIB, 32 * _MIB, 256 * _MIB), (16 * _MIB, 256 * _MIB, 64 * _MIB, 4096 * _MIB))
_SHAPE_COLUMNS = 6  # three of scales, three of quats


def check_resource_level(
    log: ViolationLog,
    header: PlacedRecord[_spec.Header],
    index: Index,
    tiles: Sequence[Tile],
    coarsest: Sequence[Tile] | None,
) -> None:
    """Check RSL-1 and RSL-2, as far as the index could be read.

    Args:
        log: receives the violations.
        header: the file header.
        index: the index.
        tiles: all tiles.
        coarsest: tiles of the coarsest version, `None` if they are not known. Then RSL-2 is not checked.
    """
    found = header.record.resource_level
    if found not in _spec.RESOURCE_LEVEL_NAMES or index.degree is None:
        return
    extra_bytes = sum(math.prod(column) for column in index.extras if column is not None)
    floats = 11 + 3 * (index.degree + 1) ** 2
    columns = [
        book.record.size * (sum(3 * (2 * band + 1) for band in range(first, last + 1)) if first else _SHAPE_COLUMNS)
        for book in index.codebooks.values()
        for first, last in [(book.record.band_first, book.record.band_last)]
    ]
    coarse = any(tile.level for tile in coarsest or ())
    sizes = (
        header.record.index_size,
        4 * sum(columns),
        max((tile.count * (4 * floats + (0 if tile.level else extra_bytes)) for tile in tiles), default=0),
        sum(tile.count for tile in coarsest or ()) * (4 * floats + (0 if coarse else extra_bytes)),
    )
    fitting = [all(size <= bound for size, bound in zip(sizes, bounds, strict=True)) for bounds in _BOUNDS]
    needed = 1 if fitting[0] else 2 if fitting[1] else 3
    names = _spec.RESOURCE_LEVEL_NAMES
    what = "index, codebooks, largest tile and coarsest version of {:,}, {:,}, {:,} and {:,} bytes".format(*sizes)
    if found < needed:
        log.add_field("RSL-1", header, "resource_level", f"{names[found]}, expected {names[needed]} for {what}")
    elif found > needed and coarsest is not None:
        log.add_field("RSL-2", header, "resource_level", f"{names[found]}, expected {names[needed]} for {what}")
