# SPDX-License-Identifier: CC0-1.0
"""Check TREE, the nodes of the levels of detail (spec 5.7)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate

from csplat import _spec
from csplat_conformance.validator.index import Chunk, Tile
from csplat_conformance.validator.violation_log import Payload, PlacedRecord, UnreadableError, ViolationLog


@dataclass
class _Node:
    """A node record and the facts that the other records and the index add.

    Attributes:
        record: the node record.
        level: level of its tiles; `None` if they are unknown or have several levels.
        splat_count: number of splats; `None` if its tiles are unknown.
        children: nodes with a valid `parent` that is this node.
        has_all_children: True if neither this nor an earlier node has an invalid `parent`, which may stand for another.
    """

    record: PlacedRecord[_spec.NodeRecord]
    level: int | None = None
    splat_count: int | None = None
    children: list[_Node] = field(default_factory=list)
    has_all_children: bool = True

    @property
    def error(self) -> float:
        """`error` of the record."""
        return self.record.record.error

    @property
    def has_valid_error(self) -> bool:
        """True if the error is possible at the node's level, whatever the errors of its children are (TRE-8)."""
        return self.error == 0.0 if self.level == 0 else 0.0 <= self.error < math.inf


def find_tree(log: ViolationLog, directory: Sequence[Chunk], tiles: Sequence[Tile]) -> Chunk | None:
    """Check TRE-1; return the chunk with the nodes, `None` if no tile has a level above 0."""
    coarse = next((tile for tile in tiles if tile.level), None)
    chunk = next((chunk for chunk in directory if chunk.kind == _spec.CHUNK_TREE), None)
    if coarse is None:
        if chunk is not None:
            log.add_field("TRE-1", chunk.record, "type", "a TREE chunk, but no tile has a level above 0")
        return None
    if chunk is None:
        log.add_field("TRE-1", coarse.record, "level", f"{coarse.level}, but there is no TREE chunk")
    return chunk


def check_tree(payload: Payload, tiles: Sequence[Tile]) -> list[Tile] | None:
    """Check the payload of TREE: TRE-2 to TRE-8. Clauses about tiles that a node may not have are not checked.

    Returns:
        The tiles of all roots, `None` if they are not known.

    Raises:
        UnreadableError: the payload does not consist of whole records.
    """
    log, start = payload.log, payload.at
    record_count, excess = divmod(payload.left, _spec.NODE_RECORD_SIZE)
    if excess:
        payload.at = payload.end - excess
        message = f"the payload ends within the record, {excess} of {_spec.NODE_RECORD_SIZE} bytes are left"
        log.add("TRE-2", payload.at, f"{payload.name}/node[{record_count}]", message)
        raise UnreadableError
    # Each node has a tile, so one of these nodes breaks TRE-3 if there are more nodes than tiles.
    nodes = [_Node(payload.structure(_spec.NodeRecord, f"node[{n}]")) for n in range(min(record_count, len(tiles) + 1))]
    _assign_tiles(log, nodes, tiles, (start, f"{payload.name}/node"))
    if payload.left:
        log.skip(f"{payload.name} from byte {payload.at} on", "there are more nodes than tiles")
    _find_children(log, nodes, record_count)
    for node in nodes:
        _check_node(log, node)
    if any(node.splat_count is None for node in nodes):
        return None
    ends = list(accumulate(node.record.record.tile_count for node in nodes))
    return [
        tile for node, end in zip(nodes, ends, strict=True) if node.record.record.parent == _spec.NO_PARENT
        for tile in tiles[end - node.record.record.tile_count : end]
    ]  # fmt: skip


def _assign_tiles(log: ViolationLog, nodes: Sequence[_Node], tiles: Sequence[Tile], start: tuple[int, str]) -> None:
    """Check TRE-3 and TRE-4, and set `level` and `splat_count` of all nodes if TRE-3 holds.

    `start` is the offset and the name to report if the nodes lack tiles.
    """
    assigned: list[tuple[int | None, int]] = []
    first = 0
    for node in nodes:
        count, left = node.record.record.tile_count, len(tiles) - first
        if not 1 <= count <= left:
            log.add_field("TRE-3", node.record, "tile_count", f"{count}, expected 1 or more of {left} left")
            return
        node_tiles = tiles[first : first + count]
        levels = sorted({tile.level for tile in node_tiles})
        if len(levels) > 1:
            log.add_field("TRE-4", node.record, "tile_count", f"tiles of levels {levels[0]} to {levels[-1]}")
        assigned.append((levels[0] if len(levels) == 1 else None, sum(tile.count for tile in node_tiles)))
        first += count
    if first < len(tiles):
        log.add("TRE-3", *start, f"{first} tiles of all nodes, expected {len(tiles)}")
        return
    for node, (level, splat_count) in zip(nodes, assigned, strict=True):
        node.level, node.splat_count = level, splat_count


def _find_children(log: ViolationLog, nodes: Sequence[_Node], record_count: int) -> None:
    """Check TRE-5; set `children` and `has_all_children` of the nodes.

    `record_count` includes records that were not read.
    """
    all_valid = True
    for n, node in enumerate(nodes):
        parent = node.record.record.parent
        if parent != _spec.NO_PARENT and not _is_above(nodes, record_count, n, parent):
            log.add_field("TRE-5", node.record, "parent", f"{parent}, expected a node of a higher level, or none")
            all_valid = False
        elif parent < len(nodes):
            nodes[parent].children.append(node)
        node.has_all_children = all_valid


def _is_above(nodes: Sequence[_Node], record_count: int, n: int, parent: int) -> bool:
    """Return False if node `parent` does not exist, or certainly does not have a higher level than node `n`."""
    if parent >= len(nodes):
        return parent < record_count
    level, below = nodes[parent].level, nodes[n].level
    return parent > n if level is None or below is None else level > below


def _check_node(log: ViolationLog, node: _Node) -> None:
    """Check TRE-8, and for a node above level 0 whose children are all known TRE-6 and TRE-7."""
    # An error that is invalid by itself does not bound the parent's error.
    least = max((child.error for child in node.children if child.has_valid_error), default=0.0)
    if not node.has_valid_error:
        expected = "0 at level 0" if node.level == 0 else "finite and not negative"
        log.add_field("TRE-8", node.record, "error", f"{node.error:.9g}, expected {expected}")
    elif node.level != 0 and node.error < least:
        log.add_field("TRE-8", node.record, "error", f"{node.error:.9g}, expected at least {least:.9g}, as of a child")
    if not node.level or not node.has_all_children:
        return
    most = sum(child.splat_count or 0 for child in node.children)
    if not node.children:
        log.add_field("TRE-6", node.record, "parent", f"a node of level {node.level} that is no node's parent")
    elif (node.splat_count or 0) > most:
        message = f"a node of {node.splat_count} splats, expected at most {most}, those of its children"
        log.add_field("TRE-7", node.record, "parent", message)
