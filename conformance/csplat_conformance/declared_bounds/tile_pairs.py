# SPDX-License-Identifier: CC0-1.0
"""Measure the pairs of a source index tile by tile, if file and source do not fit in memory together.

The source is read in order, once for each group of tiles whose source splats fit in memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import SceneHeader, Tile
from csplat.scene import BLOCK_SPLATS, Scene
from csplat.splat_file import SplatFile
from csplat.types import Progress
from csplat_conformance.declared_bounds.measurement import (
    PairErrors,
    Source,
    check_source_index,
    find_wrong_extras,
    measure_pairs,
    merge_errors,
)

_COMPARE_FACTOR = 2.2  # memory to compare two scenes, as a multiple of their arrays
_SPLAT_BYTES = 80  # bytes per source splat in addition to its arrays: keys, order, centres in doubles
_FLOAT_BYTES = 4
_GEOMETRY_FLOATS = 11  # per splat: centre, quaternion, scales and opacity
_BASE_BYTES = 200_000_000  # bytes of the program, of blocks of the source, and of tiles during decoding


def comparison_bytes(opened: SplatFile, source_count: int, source_bytes: int) -> int:
    """Estimate the memory in which a file and its source can be compared as a whole, bytes.

    Args:
        opened: the file.
        source_count: splats of the source.
        source_bytes: size of its file.
    """
    splat_bytes = _COMPARE_FACTOR * _splat_bytes(opened)
    source = max(source_count * (splat_bytes + _SPLAT_BYTES), source_bytes)
    return int(source + opened.count * splat_bytes)


def splats_in_memory(opened: SplatFile, memory_bytes: int) -> int:
    """Return how many source splats `measure_pairs_by_tile` may hold at once within a limit of the memory."""
    row_bytes = _COMPARE_FACTOR * _splat_bytes(opened) + _SPLAT_BYTES
    return max(BLOCK_SPLATS, int((memory_bytes - _BASE_BYTES) / row_bytes))


def _splat_bytes(opened: SplatFile) -> int:
    """Return the bytes of a splat in arrays of float32 and in extra columns."""
    float_count = _GEOMETRY_FLOATS + 3 * (opened.sh_degree + 1) ** 2
    return _FLOAT_BYTES * float_count + sum(dtype.itemsize for dtype in opened.extra.values())


def measure_pairs_by_tile(
    scene: Scene,
    opened: SplatFile,
    source_index: NDArray[Any],
    splats_max: int,
    *,
    context: Context = DEFAULT_CONTEXT,
) -> PairErrors:
    """Measure the errors of a file's splats, as `measure_pairs` does in memory.

    Args:
        scene: the source.
        opened: the file.
        source_index: [N] integers, the source splat of each splat of the file; may be memory-mapped.
        splats_max: largest number of source splats to hold at once, if no tile has more.
        context: threads and progress.

    Raises:
        InputError: `source_index` does not contain one index of a source splat for each splat of the file, or the
            source is incomplete.
        OSError: a file cannot be read.
    """
    check_source_index(source_index, scene.count, opened.count)
    names = [name for name in opened.extra if name in scene.extra]
    groups = list(_group_tiles(opened.header, splats_max)) or [[]]
    parts, lines, reach = [], {}, 0.0
    for number, tiles in enumerate(groups):
        report = partial(_report_group, context.progress, number, len(groups))
        start = tiles[0].start if tiles else 0
        rows = source_index[start : start + sum(tile.splat_count for tile in tiles)]
        order = np.argsort(rows)
        ascending, blocks = rows[order], []
        for place, model in scene.with_progress("measuring splats", report).numbered():
            block = Source.of(model)
            reach = max(reach, block.reach(opened.origin))
            first, end = np.searchsorted(ascending, (place.start, place.stop))
            block = replace(block, extra={name: block.extra[name] for name in names})
            blocks.append(block.select(ascending[first:end] - place.start))
        source = Source.concatenate(blocks) if blocks else Source.of(scene.empty())
        # positions[i]: row in `source`, whose rows are in ascending order, of the source splat of splat start + i.
        positions = np.empty(len(order), np.int64)
        positions[order] = np.arange(len(order))
        models = opened.models([tile.index for tile in tiles]) if tiles else [opened.empty()]
        for decoded in models:
            tile_positions, positions = np.split(positions, [len(decoded)])
            parts.append((start, len(decoded), measure_pairs(source, decoded, tile_positions, context=context)))
            lines.update(dict.fromkeys(find_wrong_extras(source, decoded, tile_positions)))
            start += len(decoded)
    return PairErrors(merge_errors(parts), list(lines), reach)


def _report_group(progress: Progress, number: int, count: int, stage: str, done: float) -> None:
    """Report a fraction of group `number` of `count` as a fraction of all groups."""
    progress(stage, (number + done) / count)


def _group_tiles(header: SceneHeader, splats_max: int) -> Iterator[list[Tile]]:
    """Yield groups of successive tiles with at most `splats_max` splats; a larger tile is a group of its own."""
    group: list[Tile] = []
    for tile in header.tiles:
        if group and sum(member.splat_count for member in group) + tile.splat_count > splats_max:
            yield group
            group = []
        group.append(tile)
    if group:
        yield group
