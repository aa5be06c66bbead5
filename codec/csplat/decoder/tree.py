# SPDX-License-Identifier: Apache-2.0
"""Read the nodes of the levels of detail, and cut through them (spec 5.7)."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from csplat import _spec
from csplat.decoder.container import SceneHeader, Tile, open_chunk
from csplat.decoder.reconstruct import boxes_touching, tile_boxes
from csplat.decoder.resource_level import check_resource_level
from csplat.errors import FormatError, InputError, LimitError
from csplat.types import F64


@dataclass(frozen=True)
class Node:
    """A node of the levels of detail.

    Attributes:
        tiles: its tiles.
        parent: index of the parent, which is after this node; `None` for a root.
        children: indices of the children.
        level: level of detail; 0 for a leaf.
        splat_count: number of splats.
        error: smallest pixel size, in scene units at the node, at which it may replace the splats below it.
    """

    tiles: tuple[Tile, ...]
    parent: int | None
    children: tuple[int, ...]
    level: int
    splat_count: int
    error: float


def read_nodes(view: memoryview, header: SceneHeader) -> tuple[Node, ...]:
    """Read and check the TREE chunk (TRE-2 to TRE-8), and the resource level (RSL-1, RSL-2).

    Args:
        view: the file, or a part that contains the chunk.
        header: header and index.

    Returns:
        The nodes. Without a TREE chunk, a single node of all tiles, or no node if there are no tiles.
    """
    chunk = header.chunk(_spec.CHUNK_TREE)
    if chunk is None:
        return (Node(header.tiles, None, (), 0, header.splat_count, 0.0),) if header.tiles else ()
    cursor = open_chunk(view, chunk, chunk.type, chunk.flags, "TRE-2")
    start, size = cursor.at, cursor.end - cursor.at
    rest = size % _spec.NODE_RECORD_SIZE
    if rest:
        at, wanted = cursor.end - rest, f"multiples of {_spec.NODE_RECORD_SIZE} bytes"
        raise FormatError(_spec.ERROR_STREAM, at, "TRE-2", "the payload of TREE", found=f"{size} bytes", wanted=wanted)
    offsets = range(start, cursor.end, _spec.NODE_RECORD_SIZE)
    records: list[_spec.NodeRecord] = []
    tiles = _read_node_records(view, offsets, start, header.all_tiles, records)
    children = _find_children(records, tiles, offsets)
    nodes = tuple(
        Node(
            own,
            None if record.parent == _spec.NO_PARENT else record.parent,
            tuple(below),
            own[0].level,
            sum(tile.splat_count for tile in own),
            record.error,
        )
        for record, own, below in zip(records, tiles, children, strict=True)
    )
    for at, node in zip(offsets, nodes, strict=True):
        _check_node(nodes, node, at)
    check_resource_level(header, [tile for node in nodes if node.parent is None for tile in node.tiles])
    return nodes


def _read_node_records(
    view: memoryview, offsets: range, start: int, tiles: tuple[Tile, ...], records: list[_spec.NodeRecord]
) -> list[tuple[Tile, ...]]:
    """Append the records at `offsets` to `records`, and return the tiles of each node; check TRE-3 and TRE-4."""
    count_at = _spec.NODE_RECORD_OFFSETS["tile_count"]
    tiles_of_nodes: list[tuple[Tile, ...]] = []
    first = 0
    for at in offsets:
        record = _spec.unpack_node_record(view, at)
        remaining = len(tiles) - first
        if not 1 <= record.tile_count <= remaining:
            wanted = f"1 to {remaining}, the tiles that are left"
            raise FormatError(
                _spec.ERROR_INDEX, at + count_at, "TRE-3", "tile_count", found=record.tile_count, wanted=wanted
            )
        node_tiles = tiles[first : first + record.tile_count]
        if node_tiles[0].level != node_tiles[-1].level:  # TIL-12: the levels of tiles do not descend
            detail = f"a node has tiles of the levels {node_tiles[0].level} and {node_tiles[-1].level}"
            raise FormatError(_spec.ERROR_INDEX, at + count_at, "TRE-4", detail)
        records.append(record)
        tiles_of_nodes.append(node_tiles)
        first += record.tile_count
    if first != len(tiles):
        raise FormatError(
            _spec.ERROR_INDEX, start, "TRE-3", "tiles of all nodes together", found=first, wanted=len(tiles)
        )
    return tiles_of_nodes


def _find_children(
    records: Sequence[_spec.NodeRecord], tiles: Sequence[tuple[Tile, ...]], offsets: range
) -> list[list[int]]:
    """Check TRE-5 and return the children of each node."""
    children: list[list[int]] = [[] for _ in records]
    for number, (record, node_tiles) in enumerate(zip(records, tiles, strict=True)):
        if record.parent == _spec.NO_PARENT:
            continue
        if record.parent >= len(records) or tiles[record.parent][0].level <= node_tiles[0].level:
            at = offsets[number] + _spec.NODE_RECORD_OFFSETS["parent"]
            wanted = f"a node of a level above {node_tiles[0].level}"
            raise FormatError(_spec.ERROR_INDEX, at, "TRE-5", "parent", found=record.parent, wanted=wanted)
        children[record.parent].append(number)
    return children


def _check_node(nodes: Sequence[Node], node: Node, at: int) -> None:
    """Check TRE-6 to TRE-8 for a node whose record is at an offset; its children are in `nodes`."""
    error_at = at + _spec.NODE_RECORD_OFFSETS["error"]
    if node.level == 0:
        if node.error != 0.0:
            raise FormatError(_spec.ERROR_VALUE, error_at, "TRE-8", "error of a leaf", found=node.error, wanted=0)
        return
    below = [nodes[child] for child in node.children]
    if not below:
        raise FormatError(_spec.ERROR_INDEX, at, "TRE-6", f"a node of level {node.level} has no children")
    most = sum(child.splat_count for child in below)
    if node.splat_count > most:
        wanted = f"at most {most}, those of its children"
        raise FormatError(_spec.ERROR_INDEX, at, "TRE-7", "splats of a node", found=node.splat_count, wanted=wanted)
    least = max(child.error for child in below)
    if not max(least, 0.0) <= node.error < math.inf:
        wanted = f"finite, at least {least}"
        raise FormatError(_spec.ERROR_VALUE, error_at, "TRE-8", "error", found=node.error, wanted=wanted)


def select_tiles(
    header: SceneHeader,
    nodes: Sequence[Node],
    *,
    level: int | None = None,
    pixel_size: float | Sequence[float] | None = None,
    max_splats: int | None = None,
    box: F64 | None = None,
) -> list[Tile]:
    """Select the tiles of a cut, in the order of the index.

    Args:
        header: header and index.
        nodes: the result of `read_nodes`.
        level: the highest level to use, 0 to 255.
        pixel_size: size of a pixel at each node, scene units, a number for all nodes or a number per node, at least 0.
        max_splats: maximum number of splats. At most one of these three is given; default: level 0.
        box: [2, 3] corners of a box, smallest first, relative to the origin. A tile of level 0 is selected only if its
            box touches this box, and a coarser node only if its region does.

    Raises:
        InputError: several of the three are given, or a value is out of its range.
        LimitError: the coarsest cut has more than `max_splats` splats.
    """
    criteria = [
        name
        for name, value in (("level", level), ("pixel_size", pixel_size), ("max_splats", max_splats))
        if value is not None
    ]
    if len(criteria) > 1:
        raise InputError(f"{' and '.join(criteria)} exclude each other")
    if pixel_size is not None:
        cut = _at_pixel_size(nodes, pixel_size)
    elif max_splats is not None:
        cut = _cut_within_budget(nodes, max_splats)
    else:
        most = 0 if level is None else level
        if not 0 <= most <= 255:
            raise InputError(f"level is {level}, expected 0 to 255")
        cut = _cut_where(nodes, lambda number: nodes[number].level > most)
    if box is None:
        return [tile for number in cut for tile in nodes[number].tiles]
    touching = boxes_touching(tile_boxes(header, header.all_tiles), box)
    inside = boxes_touching(node_regions(header, nodes), box)
    return [
        tile for number in cut for tile in nodes[number].tiles
        if (touching[tile.index] if tile.level == 0 else inside[number])
    ]  # fmt: skip


def node_regions(header: SceneHeader, nodes: Sequence[Node]) -> F64:
    """Return the regions of nodes: [n, 2, 3] float64, corners of boxes around all splats below, smallest first."""
    boxes = tile_boxes(header, header.all_tiles)
    regions = np.empty((len(nodes), 2, 3))
    for number, node in enumerate(nodes):  # children come before their parents
        parts = np.concatenate([boxes[[tile.index for tile in node.tiles]], regions[list(node.children)]])
        regions[number] = parts[:, 0].min(axis=0), parts[:, 1].max(axis=0)
    return regions


def _cut_where(nodes: Sequence[Node], is_replaced: Callable[[int], bool]) -> list[int]:
    """Return the first node from each root that its children do not replace, ascending."""
    replaced = np.zeros(len(nodes), bool)
    cut = []
    for number in reversed(range(len(nodes))):  # parents come after their children
        parent = nodes[number].parent
        if parent is not None and not replaced[parent]:
            continue
        if is_replaced(number):
            replaced[number] = True
        else:
            cut.append(number)
    return cut[::-1]


def _at_pixel_size(nodes: Sequence[Node], pixel_size: float | Sequence[float]) -> list[int]:
    """Return the first node on each path from a root whose error is at most its pixel size, ascending.

    Args:
        nodes: all nodes.
        pixel_size: scene units, >= 0; one number, or one for each node.

    Raises:
        InputError: there is another number of sizes, or one is negative or NaN.
    """
    sizes = [pixel_size] * len(nodes) if isinstance(pixel_size, (int, float)) else list(pixel_size)
    if len(sizes) != len(nodes):
        raise InputError(f"pixel_size has {len(sizes)} numbers, expected one, or one for each of {len(nodes)} nodes")
    for size in sizes:
        if not size >= 0.0:
            raise InputError(f"pixel_size is {size}, expected 0 or more")
    return _cut_where(nodes, lambda number: nodes[number].error > sizes[number])


def _cut_within_budget(nodes: Sequence[Node], max_splats: int) -> list[int]:
    """Return a cut of at most `max_splats` splats, ascending.

    From the roots on, the node with the largest error is replaced by its children, until that would exceed the number.
    The last node wins a tie.

    Raises:
        InputError: `max_splats` is negative.
        LimitError: the roots have more splats.
    """
    if max_splats < 0:
        raise InputError(f"max_splats is {max_splats}, expected 0 or more")
    cut = {number for number, node in enumerate(nodes) if node.parent is None}
    count = sum(nodes[number].splat_count for number in cut)
    if count > max_splats:
        raise LimitError("max_splats", count, max_splats, clause="TRE-9")
    queue = [(-nodes[number].error, -number) for number in cut if nodes[number].level > 0]
    heapq.heapify(queue)
    while queue:
        number = -heapq.heappop(queue)[1]
        children = nodes[number].children
        count += sum(nodes[child].splat_count for child in children) - nodes[number].splat_count
        if count > max_splats:
            break
        cut.remove(number)
        cut.update(children)
        for child in children:
            if nodes[child].level > 0:
                heapq.heappush(queue, (-nodes[child].error, -child))
    return sorted(cut)
