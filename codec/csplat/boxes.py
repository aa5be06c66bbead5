"""The boxes of a file's tiles, in scene units, and which of them touch another one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from csplat import _spec
from csplat.decoder.container import SceneHeader, Tile
from csplat.errors import InputError
from csplat.types import F64


def tile_boxes(header: SceneHeader) -> F64:
    """Boxes around the centres of each tile's splats (spec 4.3.5).

    Returns:
        [T, 2, 3] float64: smallest and largest corner; scene units, relative to the origin, as the means.
    """
    step = header.attribute(_spec.ATTRIBUTE_MEANS).step
    boxes = np.empty((len(header.tiles), 2, 3), np.float64)
    for tile in header.tiles:
        boxes[tile.index] = tile.corners(step)
    return boxes


def touching(header: SceneHeader, box: Sequence[float]) -> list[Tile]:
    """The tiles whose boxes touch a box.

    Args:
        header: the scene.
        box: two corners, x, y, z each, in any order; scene units, relative to the origin.

    Raises:
        InputError: six finite numbers are wanted; or no tile touches the box.
    """
    numbers = [float(value) for value in box]
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        raise InputError(f"a box is {tuple(box)!r}, wanted six finite numbers: two corners, x, y, z each")
    low, high = np.sort(np.reshape(numbers, (2, 3)), axis=0)
    boxes = tile_boxes(header)
    found = ((boxes[:, 0] <= high) & (boxes[:, 1] >= low)).all(axis=1)
    if not found.any():
        raise InputError(f"no tile touches the box {_text(low)} to {_text(high)}: {_extent(boxes)}")
    return [header.tiles[place] for place in np.flatnonzero(found)]


def _text(corner: F64) -> str:
    return ", ".join(f"{value:g}" for value in corner)


def _extent(boxes: F64) -> str:
    """Say where the splats are."""
    if not len(boxes):
        return "the scene has no splats"
    return f"centres lie within {_text(boxes[:, 0].min(axis=0))} to {_text(boxes[:, 1].max(axis=0))}"
