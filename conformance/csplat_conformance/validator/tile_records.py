"""Tile and layer records (spec 4.3.5)."""

from __future__ import annotations

from dataclasses import dataclass, field

from csplat import _spec
from csplat_conformance.validator.chunks import Chunk, chunk_record, registered_flags
from csplat_conformance.validator.findings import Findings, Placed
from csplat_conformance.validator.index import Index, scaled
from csplat_conformance.validator.reading import place

_SH_LAYERS = range(1, _spec.SH_DEGREE_MAX + 1)


@dataclass
class Tile:
    """A tile record with its layers and tables.

    Attributes:
        place: in the index, from 0.
        record: the tile record.
        chunks: its TILE chunks, in the order of the layer records.
        tables: ids of the codebooks that it names.
        box_sound: whether corner, extent and exponent obey TIL-7 to TIL-9, so that they can be compared.
    """

    place: int
    record: Placed[_spec.TileRecord]
    chunks: list[Chunk] = field(default_factory=list)
    tables: set[int] = field(default_factory=set)
    box_sound: bool = True

    @property
    def count(self) -> int:
        """Splats."""
        return self.record.record.splat_count


def read_tiles(view: memoryview, at: int, end: int, index: Index, findings: Findings) -> list[Tile]:
    """Read the tiles, which fill the index up to its CRC (IDX-2), and compare their sum with N (IDX-7).

    Args:
        view: the file.
        at: offset of the first.
        end: offset of the index's CRC.
        index: the part of the index before them.
        findings: receives the violations.
    """
    tiles: list[Tile] = []
    head = index.head.record
    # A count that the index has no room for has been refused already, by IDX-2.
    told = index.size_of("tile") * head.tile_count > end - at
    while len(tiles) < head.tile_count:
        size = _tile_size(view, at, end, index)
        if size > end - at:
            if not told:
                findings.add("IDX-2", at, f"tile[{len(tiles)}]", "the index ends within the tile")
            findings.skip(f"tile[{len(tiles)}] and those after it", "the index ends before them")
            return tiles
        tiles.append(_read_tile(view, at, len(tiles), index, findings))
        at += size
    if at != end:
        findings.add("IDX-2", at, "index.rest", f"{end - at} bytes follow the last tile")
    total = sum(tile.count for tile in tiles)
    if total != head.splat_count:
        findings.of("IDX-7", index.head, "splat_count", f"{head.splat_count}, the tiles have {total} splats")
    return tiles


def _tile_size(view: memoryview, at: int, end: int, index: Index) -> int:
    size = index.size_of("tile")
    if end - at < size:
        return size
    record = _spec.unpack_tile_record(view, at)
    return size + record.layer_count * index.size_of("layer") + 2 * record.table_count


def _read_tile(view: memoryview, at: int, number: int, index: Index, findings: Findings) -> Tile:
    placed = place(view, _spec.unpack_tile_record, _spec.TILE_RECORD_OFFSETS, at, f"tile[{number}]")
    findings.reserved(placed)
    tile = Tile(number, placed)
    if placed.record.level:
        findings.of("RES-1", placed, "level", f"{placed.record.level} is reserved, wanted 0")
    if not 1 <= tile.count <= _spec.TILE_SPLATS_MAX:
        findings.of("TIL-1", placed, "splat_count", f"{tile.count}, wanted 1 to {_spec.TILE_SPLATS_MAX}")
    _check_box(findings, tile, index)
    at += index.size_of("tile")
    _read_layers(view, at, tile, index, findings)
    _read_tables(view, at + placed.record.layer_count * index.size_of("layer"), tile, index, findings)
    return tile


def _check_box(findings: Findings, tile: Tile, index: Index) -> None:
    record, before = tile.record.record, len(findings.violations)
    for axis, (corner, extent) in enumerate(zip(record.corner, record.extent, strict=True)):
        if max(abs(corner), abs(corner + extent)) > _spec.INTEGER_MAX:
            message = f"axis {axis} reaches from {corner} to {corner + extent}, beyond {_spec.INTEGER_MAX}"
            findings.of("TIL-7", tile.record, "corner", message, within=8 * axis)
        if extent >= 1 << _spec.AXIS_BITS_MAX:
            message = f"axis {axis} has {extent}, wanted less than 2^{_spec.AXIS_BITS_MAX}"
            findings.of("TIL-8", tile.record, "extent", message, within=4 * axis)
    step = index.steps.get(_spec.ATTRIBUTE_MEANS)
    if step is not None and scaled(step, record.exponent) is None:
        message = f"{step} x 2^{record.exponent} is not finite and at least 2^-1022"
        findings.of("TIL-9", tile.record, "exponent", message)
    tile.box_sound = len(findings.violations) == before


def _read_layers(view: memoryview, at: int, tile: Tile, index: Index, findings: Findings) -> None:
    start, last = at, -1
    flags = registered_flags(_spec.CHUNK_TILE)
    for i in range(tile.record.record.layer_count):
        layer = view[at]
        name = f"{tile.record.name}.layer[{layer}]"
        placed = place(view, _spec.unpack_layer_record, _spec.LAYER_RECORD_OFFSETS, at, name)
        findings.reserved(placed)
        if i == 0 and layer != _spec.LAYER_GEOMETRY:
            findings.of("TIL-2", placed, "layer", f"the first is {layer}, wanted {_spec.LAYER_GEOMETRY}")
        elif layer <= last:
            findings.of("TIL-2", placed, "layer", f"{layer} after {last}, wanted ascending layers")
        if layer < _spec.ANCILLARY_ID_MIN and layer not in _spec.LAYER_NAMES:
            findings.of("RES-2", placed, "layer", f"{layer} is no layer that this version uses")
        if index.degree is not None and layer in _SH_LAYERS and layer > index.degree:
            findings.of("TIL-3", placed, "layer", f"band {layer} in a scene of degree {index.degree}")
        chunk = Chunk(f"TILE.{tile.place}.{layer}", _spec.CHUNK_TILE, flags, placed, tile.place, layer)
        tile.chunks.append(chunk_record(findings, chunk))
        last = max(last, layer)
        at += index.size_of("layer")
    if not tile.chunks:
        findings.add("TIL-2", start, f"{tile.record.name}.layer", "no layer, wanted layer 0")
        return  # TIL-5 would say nothing more
    has_extra = any(chunk.layer == _spec.LAYER_EXTRA for chunk in tile.chunks)
    if has_extra != bool(index.head.record.extra_count):
        verb = "has" if has_extra else "lacks"
        message = f"the tile {verb} the extra layer, the scene has {index.head.record.extra_count} extra columns"
        findings.add("TIL-5", start, f"{tile.record.name}.layer", message)


def _read_tables(view: memoryview, at: int, tile: Tile, index: Index, findings: Findings) -> None:
    last = -1
    for k in range(tile.record.record.table_count):
        table = int.from_bytes(view[at : at + 2], "little")
        name = f"{tile.record.name}.table[{k}]"
        if table <= last:
            findings.add("TIL-6", at, name, f"{table} after {last}, wanted ascending ids")
        elif table not in index.codebook_ids:
            findings.add("TIL-6", at, name, f"{table} is the id of no codebook")
        tile.tables.add(table)
        last = max(last, table)
        at += 2
