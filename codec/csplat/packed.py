# SPDX-License-Identifier: Apache-2.0
"""Integers of tiles, with codebooks as tables, as a renderer on a GPU keeps them (`SplatFile.packed_tiles`).

A value is an integer times a step (spec 7). An SH band of a tile has a row of integers per splat, or an index per
splat into a table that tiles share, plus the rows of the escaped splats. Colours are red, green and blue.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

Integers = NDArray[Any]


@dataclass(frozen=True, eq=False)
class PackedColumns:
    """Integers and the step that makes values of them.

    Attributes:
        integers: [n, C], or [n, 2 l + 1, 3] for an SH band.
        step: the value of 1.
    """

    integers: Integers
    step: float


@dataclass(frozen=True, eq=False)
class PackedBand:
    """An SH band of a tile.

    Attributes:
        rows: the rows of all splats or, with a table, of the escaped splats.
        table: the codebook's rows, the same object for every tile of a file; `None` if there is none.
        index: [n] integers, row of the table; its length plus k is row k of `rows`. Bands that share a codebook have
            the same array. `None` without a table.
    """

    rows: PackedColumns
    table: PackedColumns | None = None
    index: Integers | None = None


@dataclass(frozen=True, eq=False)
class PackedTile:
    """The integers of a tile's splats.

    Attributes:
        means: [n, 3], relative to the scene's origin.
        opacities: [n]; alpha is integer / `opacity_levels`, squared if `opacities_squared`.
        opacity_levels: largest integer of the opacities.
        opacities_squared: True if alpha is a square.
        scales: [n, 3], natural logarithms.
        quats: [n, 3], x, y, z; w follows from the length, the root of 2 · `quat_levels`².
        quat_levels: largest magnitude of an integer of the quats.
        sh0: [n, 3].
        bands: the SH bands that the tile has, by number.
    """

    means: PackedColumns
    opacities: Integers
    opacity_levels: int
    opacities_squared: bool
    scales: PackedColumns
    quats: Integers
    quat_levels: int
    sh0: PackedColumns
    bands: dict[int, PackedBand]
