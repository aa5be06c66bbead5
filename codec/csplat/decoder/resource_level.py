# SPDX-License-Identifier: Apache-2.0
"""Compare the sizes of a file's contents with its resource level (spec 8.1)."""

from __future__ import annotations

from collections.abc import Sequence

from csplat import _spec
from csplat.decoder.container import SceneHeader, Tile
from csplat.errors import FormatError

_BOUNDS = (
    _spec.RESOURCE_LEVEL_INDEX_BYTES,
    _spec.RESOURCE_LEVEL_CODEBOOK_BYTES,
    _spec.RESOURCE_LEVEL_TILE_BYTES,
    _spec.RESOURCE_LEVEL_VERSION_BYTES,
)
_COLUMNS = {name: _spec.ATTRIBUTE_COLUMNS[attribute] for attribute, name in _spec.ATTRIBUTE_NAMES.items()}


def float_bytes(header: SceneHeader, degree: int, *, extras: bool = True) -> int:
    """Return the bytes per splat in the arrays of spec 3, with or without extra columns."""
    floats = 3 + 4 + 3 + 1 + 3 * (degree + 1) ** 2
    columns = header.extras if extras else ()
    return 4 * floats + sum(column.splat_dtype.itemsize for column in columns if column.dtype)


def check_resource_level(header: SceneHeader, coarsest: Sequence[Tile] | None) -> None:
    """Check RSL-1 and RSL-2.

    Args:
        header: header and index.
        coarsest: tiles of the coarsest version; `None` if TREE has not been read. Then RSL-2 is not checked, and RSL-1
            not for this version.
    """
    tile_sizes = (_array_bytes(header, [tile]) for tile in header.all_tiles)
    codebooks = 4 * sum(map(_elements, header.codebooks))
    sizes = (header.index_size, codebooks, max(tile_sizes, default=0), _array_bytes(header, coarsest or ()))
    found = next(level for level, name in _spec.RESOURCE_LEVEL_NAMES.items() if name == header.resource_level)
    needed = next(
        level
        for level in _spec.RESOURCE_LEVEL_NAMES
        if all(size <= bound.get(level, size) for size, bound in zip(sizes, _BOUNDS, strict=True))
    )
    if found < needed or (found > needed and coarsest is not None):
        clause, at = "RSL-1" if found < needed else "RSL-2", _spec.HEADER_OFFSETS["resource_level"]
        wanted = f"{_spec.RESOURCE_LEVEL_NAMES[needed]} for index, codebooks, tile and version of {sizes} bytes"
        raise FormatError(_spec.ERROR_VALUE, at, clause, "resource_level", found=header.resource_level, wanted=wanted)


def _array_bytes(header: SceneHeader, tiles: Sequence[Tile]) -> int:
    """Return the size of the arrays of tiles; only level 0 has extra columns."""
    splat_bytes = float_bytes(header, header.sh_degree, extras=not any(tile.level for tile in tiles))
    return splat_bytes * sum(tile.splat_count for tile in tiles)


def _elements(book: _spec.CodebookRecord) -> int:
    """Return the integers in the entries of a codebook."""
    names = _spec.CODEBOOK_KIND_ATTRIBUTES[book.kind]
    if book.kind == _spec.CODEBOOK_KIND_SH:
        names = names[book.band_first - 1 : book.band_last]
    return book.size * sum(_COLUMNS[name] for name in names)
