"""The integer arrays by which decoders are compared (spec 9.2)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder.blocks import Columns, TileBlocks, runs
from csplat.decoder.header import SceneHeader
from csplat.decoder.reconstruct import check_max_scale, lattice_rows, quat_rows

_INT32 = np.dtype(np.int32)
_BAND_NAMES = {band: _spec.ATTRIBUTE_NAMES[_spec.ATTRIBUTE_SH0 + band] for band in range(1, _spec.SH_DEGREE_MAX + 1)}


def empty_integers(count: int, tile_count: int, degree: int) -> dict[str, NDArray[Any]]:
    """Allocate the arrays of 9.2; bands and exponents that nothing writes are 0."""
    arrays: dict[str, NDArray[Any]] = {
        "opacities": np.empty(count, np.uint32),
        "scales": np.empty((count, 3), np.int64),
        "quats": np.empty((count, 3), np.int32),
        "means": np.empty((count, 3), np.int64),
        "sh0": np.empty((count, 3), np.int64),
    }
    for band in range(1, degree + 1):
        arrays[_BAND_NAMES[band]] = np.zeros((count, 2 * band + 1, 3), np.int64)
    arrays["tile_splats"] = np.empty(tile_count, np.uint32)
    arrays["exponents"] = np.zeros((tile_count, _spec.ATTRIBUTE_SH0 + degree), np.int32)
    return arrays


def integer_part(arrays: dict[str, NDArray[Any]], start: int, stop: int) -> dict[str, NDArray[Any]]:
    """Return views of some splats, without the arrays that have a row per tile."""
    return {name: a[start:stop] for name, a in arrays.items() if name not in ("tile_splats", "exponents")}


def write_integers(
    source: TileBlocks, header: SceneHeader, out: dict[str, NDArray[Any]], exponents: NDArray[Any]
) -> None:
    """Write a tile's integers; the same clauses are enforced as on the way to values.

    Args:
        source: the tile's blocks.
        header: the scene.
        out: the tile's part of the arrays.
        exponents: the tile's row, zeros.
    """
    count = source.tile.splat_count
    for attribute, block in source.blocks.items():
        record = header.attribute(attribute)
        name = _spec.ATTRIBUTE_NAMES[attribute]
        array = out[name]
        exponents[attribute - 1] = block.exponent
        if attribute == _spec.ATTRIBUTE_OPACITIES:
            for start, stop in runs(count, 1):
                array[start:stop] = block.rows(start, stop, _INT32)[0]
        elif attribute == _spec.ATTRIBUTE_QUATS:
            for start, stop, q, _r in quat_rows(block, record, count):
                array[start:stop] = q.T
        else:
            by_channel = array.reshape(count, -1, 3)
            largest = []
            for start, stop, parts in lattice_rows(block, record, count):
                for i, part in enumerate(parts):
                    by_channel[start:stop, :, i] = part.T
                if not isinstance(block, Columns):
                    largest.append(max(int(part.max()) for part in parts))
            if attribute == _spec.ATTRIBUTE_SCALES:
                top = max(block.highs) if isinstance(block, Columns) else max(largest)
                check_max_scale(source, record, top)
