# SPDX-License-Identifier: CC0-1.0
"""Write a declared scene as the bytes of a csplat file, field by field in the order of the spec; repair checksums.

The builder shares no code with the encoder and checks nothing: it writes invalid files if the scene is invalid. Every
field of the result has a name (`tile[0].extent`, `TILE.0.0/sh0.stream.count`), so that a vector can overwrite it.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from csplat import _spec
from csplat_authoring import coders
from csplat_authoring.reference import max_scale, required_level
from csplat_authoring.scene import Block, Chunk, Codebook, Scene, Stream, Tile, transpose
from csplat_conformance.fields import Field, Writer

#: Structures whose sizes are in the index head, in its order, by their names in `Scene.tails`.
SIZED: Final = {
    "head": "index_head",
    "attribute": "attribute_record",
    "codebook": "codebook_record",
    "extra": "extra_record",
    "directory": "directory_record",
    "tile": "tile_record",
    "layer": "layer_record",
}
_TREE = "TREE"
_LAST = ("CAMS", "OPTS", "SERR")  # chunks that no renderer needs, at the end of a file with levels
_CODERS = {"stored": _spec.CODER_STORED, "deflate": _spec.CODER_DEFLATE}


@dataclass(frozen=True)
class Built:
    """A file and the positions of its fields.

    Attributes:
        data: the bytes.
        fields: fields by name.
        spans: (offset, size) by chunk name.
    """

    data: bytes
    fields: dict[str, Field]
    spans: dict[str, tuple[int, int]]

    def patched(self, changes: dict[str, Any], repaired: bool = True) -> bytes:
        """Return the bytes with changed fields and, by default, repaired checksums, except those in `changes`."""
        data = self._with(self.data, changes)
        if not repaired:
            return data
        kept = {name: value for name, value in changes.items() if name.endswith("crc")}
        data = self._with(repair(data, self.records), kept)
        return self._with(seal(data), kept)  # the CRC of the index covers those of the chunks

    def _with(self, data: bytes, changes: dict[str, Any]) -> bytes:
        writer = Writer(bytearray(data), self.fields)
        for name, value in changes.items():
            writer.patch(name, value)
        return bytes(writer.data)

    @property
    def records(self) -> list[tuple[str, int]]:
        """Structure and offset of the records that refer to chunks."""
        return [
            (entry.structure, entry.offset - CHUNK_RECORDS[entry.structure])
            for name, entry in self.fields.items()
            if entry.structure in CHUNK_RECORDS and name.endswith(".crc")
        ]


def build(scene: Scene) -> Built:
    """Write a scene."""
    chunks = _chunks(scene)
    order = scene.order or tuple(chunks)
    index_size = len(_index(scene, chunks, dict.fromkeys(chunks, 0)).data) + 4
    at = _spec.HEADER_SIZE + index_size + len(scene.gap)
    offsets = {}
    for name in order:
        offsets[name] = at
        at += len(chunks[name].data)

    file = Writer()
    level = required_level(scene, index_size) if scene.resource_level is None else scene.resource_level
    file.structure("header", "header", _header(level, index_size, at))
    index = _index(scene, chunks, offsets)
    file.append(index)
    file.value("index.crc", "I", 0)
    file.data += scene.gap
    for name in order:
        file.append(chunks[name], name + "/")
    file.data += scene.trailing
    spans = {name: (offsets[name], len(chunks[name].data)) for name in order}
    unsealed = Built(bytes(file.data), file.fields, spans)
    return replace(unsealed, data=unsealed.patched({}))


def _header(level: int, index_size: int, file_size: int) -> list[Any]:
    version = [_spec.VERSION_MAJOR, _spec.VERSION_MINOR]
    return [_spec.MAGIC, *version, _spec.PROFILE_BASE, level, 0, index_size, file_size, 0]


# Index ---------------------------------------------------------------------------------------------


class _Records(Writer):
    """The index: structures with the tails that the scene declares."""

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.tails = {SIZED[kind]: tail for kind, tail in scene.tails}

    def structure(self, name: str, structure: str, values: Iterable[Any]) -> None:
        super().structure(name, structure, values)
        tail = self.tails.get(structure, b"")
        if tail:
            self.raw(f"{name}.tail", tail)

    def size_of(self, structure: str) -> int:
        return int(getattr(_spec, f"{structure.upper()}_SIZE")) + len(self.tails.get(structure, b""))


def _index(scene: Scene, chunks: dict[str, Writer], offsets: dict[str, int]) -> Writer:
    out = _Records(scene)
    sizes = [out.size_of(name) for name in SIZED.values()]
    directory = scene.directory or tuple(n for n in scene.order or chunks if not n.startswith("TILE."))
    counts = [len(directory), len(scene.codebooks), len(scene.extras), len(scene.attributes)]
    splats = sum(tile.splat_count for tile in scene.finest.tiles)
    facts: list[Any] = [scene.sh_degree, scene.scene_flags, bytes(scene.axes), scene.unit_metres, scene.origin]
    facts += [scene.projection, scene.antialiasing, scene.colour_space, 0]
    out.structure("index", "index_head", [*sizes, scene.kernel, splats, len(scene.tiles), *counts, *facts])
    for attribute, record in scene.attributes.items():
        name = f"attribute[{_spec.ATTRIBUTE_NAMES.get(attribute, attribute)}]"
        facts = [attribute, record.mapping, record.chroma_shift, 0, record.levels, record.step]
        out.structure(name, "attribute_record", facts)
    for book in scene.codebooks:
        values = [book.id, book.kind, *book.bands, 0, 0, len(next(iter(book.entries.values())))]
        out.structure(f"codebook[{book.id}]", "codebook_record", values)
    for i, extra in enumerate(scene.extras):
        texts = extra.name.encode(), extra.semantic.encode()
        facts = [extra.dtype, extra.components, extra.coding, *map(len, texts), 0, 0, *texts]
        out.structure(f"extra[{i}]", "extra_record", facts)
    for name in directory:
        out.structure(f"directory[{name}]", "directory_record", _directory(scene, name, chunks[name], offsets[name]))
    for i, tile in enumerate(scene.tiles):
        _tile_record(out, scene, i, tile, chunks, offsets)
    return out


def _directory(scene: Scene, name: str, chunk: Writer, offset: int) -> list[Any]:
    if name.startswith("CODB."):
        _, book_id, layer = name.split(".")
        kind, ids = _spec.CHUNK_CODEBOOK, (int(book_id), int(layer))
    elif name == _TREE and scene.nodes:
        kind, ids = _spec.CHUNK_TREE, (0, 0)
    else:
        declared = dict(zip(_ancillary_names(scene), scene.chunks, strict=True))[name]
        kind, ids = declared.type, (declared.id, declared.layer)
    flags = _spec.unpack_chunk_header(chunk.data).flags
    return [kind, flags, *ids, 0, 0, len(chunk.data), offset, 0]


def _tile_record(
    out: _Records, scene: Scene, i: int, tile: Tile, chunks: dict[str, Writer], offsets: dict[str, int]
) -> None:
    used = {b.codebook for b in tile.blocks.values() if b.coding == _spec.CODING_CODEBOOK}
    codebook_ids = sorted(used) if tile.codebook_ids is None else tile.codebook_ids
    columns = zip(*tile.blocks[_spec.ATTRIBUTE_MEANS].rows, strict=True)
    extent = tuple(max(column) for column in columns)
    head: list[Any] = [tile.splat_count, tile.level, len(tile.layers), len(codebook_ids), tile.exponent, 0]
    scale = max_scale(scene, tile) if _spec.ATTRIBUTE_SCALES in tile.blocks else 0.0
    out.structure(f"tile[{i}]", "tile_record", [*head, tile.corner, extent, scale])
    for layer in tile.layers:
        name = f"TILE.{i}.{layer}"
        where = [len(chunks[name].data), offsets[name], 0]
        out.structure(f"tile[{i}].layer[{layer}]", "layer_record", [layer, 0, 0, *where])
    for k, identity in enumerate(codebook_ids):
        out.value(f"tile[{i}].table[{k}]", "H", identity)


# Chunks --------------------------------------------------------------------------------------------


def _chunks(scene: Scene) -> dict[str, Writer]:
    """Return all chunks by name, in the recommended order."""
    out = {}
    if scene.nodes:
        out[_TREE] = _frame_chunk(_spec.CHUNK_TREE, _flags(_spec.CHUNK_TREE), _tree(scene))
    for name, chunk in zip(_ancillary_names(scene), scene.chunks, strict=True):
        flags = chunk.flags if chunk.flags is not None else _flags(chunk.type)
        out[name] = _frame_chunk(chunk.type, flags, _ancillary(chunk))
    # Without nodes, `last` is empty and the order that of the index.
    last = [name for name in out if scene.nodes and name in _LAST]
    for layer in sorted({*_spec.LAYER_NAMES, *(layer for tile in scene.tiles for layer in tile.layers)}):
        for book in scene.codebooks:
            if layer in book.layers:
                out[f"CODB.{book.id}.{layer}"] = _frame_chunk(
                    _spec.CHUNK_CODEBOOK, _flags(_spec.CHUNK_CODEBOOK), _codebook(book, layer)
                )
        for i, tile in sorted(enumerate(scene.tiles), key=lambda item: -item[1].level):
            if layer in tile.layers:
                payload = _unknown(tile, layer) if layer in dict(tile.unknown) else _tile(scene, tile, layer)
                out[f"TILE.{i}.{layer}"] = _frame_chunk(_spec.CHUNK_TILE, _flags(_spec.CHUNK_TILE), payload)
    return out | {name: out.pop(name) for name in last}


def _tree(scene: Scene) -> Writer:
    out = Writer()
    for n, node in enumerate(scene.nodes):
        out.structure(f"node[{n}]", "node_record", [node.parent, node.tile_count, node.error])
    return out


def _ancillary_names(scene: Scene) -> list[str]:
    names = [_TREE] if scene.nodes else []
    for chunk in scene.chunks:
        name = chunk.type.decode("latin-1")
        names.append(name + f"#{names.count(name)}" * (name in names))
    return names[bool(scene.nodes) :]


def _flags(kind: bytes) -> int:
    values = {name: bit for bit, name in _spec.CHUNK_FLAG_NAMES.items()}
    return sum(values[name] for name in _spec.CHUNK_FLAGS.get(kind, ()))


def _frame_chunk(kind: bytes, flags: int, payload: Writer) -> Writer:
    out = Writer()
    out.structure("header", "chunk_header", [kind, flags, 0, len(payload.data)])
    out.append(payload)
    return out


def _ancillary(chunk: Chunk) -> Writer:
    out = Writer()
    if chunk.text is not None:
        _stream(out, "stream", list(chunk.text), chunk.stream_coding)
    elif chunk.errors is not None:
        declared = chunk.errors
        head = [declared.source_count, declared.pruned_count, declared.source_sh_degree, declared.flags]
        out.structure("head", "declared_errors_head", [*head, len(declared.records)])
        for measure, largest, rms in declared.records:
            name = f"record[{_spec.MEASURE_NAMES[measure]}]"
            out.structure(name, "declared_error_record", [measure, 0, 0, 0, largest, rms])
    elif chunk.payload:
        out.raw("payload", chunk.payload)
    _tail(out, chunk.tail)
    return out


def _codebook(book: Codebook, layer: int) -> Writer:
    out = Writer()
    out.structure("head", "codebook_head", [book.id, layer, 0])
    _stream(out, "entries", transpose(book.entries[layer]), book.stream_coding)
    _tail(out, book.tail)
    return out


def _tile(scene: Scene, tile: Tile, layer: int) -> Writer:
    out = Writer()
    blocks: list[tuple[str, int, Block]] = []
    if layer >= _spec.LAYER_EXTRA:
        number = layer - _spec.LAYER_EXTRA
        blocks = [(f"extra[{number}]", _spec.ATTRIBUTE_EXTRA, tile.extras[number])]
    else:
        attributes = [a for a in tile.blocks if _spec.ATTRIBUTE_LAYER[a] == layer]
        if layer == _spec.LAYER_GEOMETRY:
            attributes = [a for a in tile.order if a in attributes]
        blocks = [(_spec.ATTRIBUTE_NAMES[a], a, tile.blocks[a]) for a in attributes]
    out.structure("head", "tile_head", [layer, len(blocks), 0])
    for name, attribute, block in blocks:
        _block(out, name, scene, attribute, block)
    _tail(out, dict(tile.tails).get(layer, b""))
    return out


def _unknown(tile: Tile, layer: int) -> Writer:
    out = Writer()
    out.raw("payload", dict(tile.unknown)[layer])
    return out


def _tail(out: Writer, tail: bytes) -> None:
    if tail:
        out.raw("tail", tail)


# Blocks and streams --------------------------------------------------------------------------------


def _block(out: Writer, name: str, scene: Scene, attribute: int, block: Block) -> None:
    out.structure(name, "block_head", [attribute, block.coding, 0])
    if block.coding in (_spec.CODING_OFFSET, _spec.CODING_SIGNED):
        _lattice(out, name, block)
    elif block.coding == _spec.CODING_SPARSE:
        out.structure(f"{name}.params", "sparse_params", [block.exponent, 0, len(block.rows)])
        whole = sum(bit << i for i, bit in enumerate(block.mask))
        _stream(out, f"{name}.mask", [*whole.to_bytes(-(-len(block.mask) // 8), "little")], block.mask_coding)
        _stream(out, f"{name}.stream", transpose(block.rows), block.stream_coding)
    elif block.coding == _spec.CODING_MORTON:
        out.structure(f"{name}.params", "morton_params", [block.bits, 0, 0])
        _stream(out, f"{name}.stream", [_morton(row) for row in block.rows], block.stream_coding)
    elif block.coding == _spec.CODING_CODEBOOK:
        _codebook_block(out, name, scene, attribute, block)
    else:
        _stream(out, f"{name}.stream", transpose(block.rows), block.stream_coding)
    if block.tail:
        out.raw(f"{name}.tail", block.tail)


def _lattice(out: Writer, name: str, block: Block) -> None:
    out.structure(f"{name}.params", "lattice_params", [block.exponent, 0])
    columns = [list(column) for column in zip(*block.rows, strict=True)]
    if block.coding == _spec.CODING_OFFSET:
        offsets = block.offsets or tuple(min(column) for column in columns)
        out.value(f"{name}.offsets", f"{len(offsets)}i", offsets)
        columns = [[v - offset for v in column] for column, offset in zip(columns, offsets, strict=True)]
    _stream(out, f"{name}.stream", [v for column in columns for v in column], block.stream_coding)


def _codebook_block(out: Writer, name: str, scene: Scene, attribute: int, block: Block) -> None:
    escapes = len(block.escape.rows) if block.escape else 0
    out.structure(f"{name}.params", "codebook_params", [block.codebook, 0, escapes])
    if block.indices:
        _stream(out, f"{name}.indices", block.indices, block.index_coding)
    if block.summands:
        (offset,) = block.offsets or (min(block.summands),)
        out.structure(f"{name}.summand", "lattice_params", [0, 0])
        out.value(f"{name}.summand.offset", "i", offset)
        _stream(out, f"{name}.summand.stream", [v - offset for v in block.summands], block.stream_coding)
    if block.escape:
        _block(out, f"{name}.escape", scene, attribute, block.escape)


def _morton(row: Sequence[int]) -> int:
    return sum((q >> b & 1) << 3 * b + axis for axis, q in enumerate(row) for b in range(q.bit_length()))


def _stream(out: Writer, name: str, values: Sequence[int], coding: Stream) -> None:
    packed = (
        coders.apply_transforms(values, coding.width, coding.transforms) if coding.packed is None else coding.packed
    )
    coded = _encode_stream(packed, coding) if coding.coded is None else coding.coded
    transforms = bytes(coding.transforms).ljust(_spec.TRANSFORMS_MAX, b"\0")
    coder = _CODERS[coding.coder.split("_")[0]]
    head = [coding.width, coder, transforms, 0, len(values), len(packed), len(coded)]
    out.structure(name, "stream_head", head)
    out.raw(f"{name}.coded", coded)


def _encode_stream(packed: bytes, coding: Stream) -> bytes:
    if coding.coder == "stored":
        return packed
    coder = {
        "deflate_stored": coders.deflate_stored,
        "deflate_fixed": coders.deflate_fixed,
        "deflate_dynamic": coders.deflate_dynamic,
    }[coding.coder]
    return coder(packed)


_CRC_SIZE = 4

#: Structures that refer to a chunk, and the offset of their `crc`.
CHUNK_RECORDS: Final = {
    "directory_record": _spec.DIRECTORY_RECORD_OFFSETS["crc"],
    "layer_record": _spec.LAYER_RECORD_OFFSETS["crc"],
}


def repair(data: bytes, records: Sequence[tuple[str, int]] | None = None) -> bytes:
    """Return the file with recomputed CRCs of chunks, index and header.

    Args:
        data: a file, damaged or not. Data shorter than a header are returned unchanged.
        records: structure and offset of each record that refers to a chunk, if the index may be damaged; None: read
            the index. A record that refers to bytes beyond the file keeps its CRC.
    """
    if len(data) < _spec.HEADER_SIZE:
        return data
    out = bytearray(data)
    for structure, at in chunk_records(data) if records is None else records:
        if at + int(getattr(_spec, f"{structure.upper()}_SIZE")) <= len(out):
            record = getattr(_spec, f"unpack_{structure}")(out, at)
            if record.offset + record.size <= len(out):
                _put_crc(out, record.offset, record.offset + record.size, at + CHUNK_RECORDS[structure])
    return seal(out)


def seal(data: bytes | bytearray) -> bytes:
    """Return the file with recomputed CRCs of index and header."""
    out = bytearray(data)
    index_size = _spec.unpack_header(out).index_size
    crc_at = _spec.HEADER_SIZE + index_size - _CRC_SIZE
    if index_size >= _CRC_SIZE and crc_at + _CRC_SIZE <= len(out):
        _put_crc(out, _spec.HEADER_SIZE, crc_at, crc_at)
    _put_crc(out, 0, _spec.HEADER_OFFSETS["header_crc"], _spec.HEADER_OFFSETS["header_crc"])
    return bytes(out)


def chunk_records(data: bytes) -> list[tuple[str, int]]:
    """Return structure and offset of the records that refer to chunks, as far as the index contains them."""
    end = min(len(data), _spec.HEADER_SIZE + _spec.unpack_header(data).index_size)
    return [(structure, at) for structure, at, size in _records(data) if at + size <= end]


def _records(data: bytes) -> Iterator[tuple[str, int, int]]:
    """Yield structure, offset and size of the records that refer to chunks, up to the first beyond the data."""
    at = _spec.HEADER_SIZE
    if at + _spec.INDEX_HEAD_SIZE > len(data):
        return
    head = _spec.unpack_index_head(data, at)
    at += head.head_size
    at += head.attribute_count * head.attribute_size
    at += head.codebook_count * head.codebook_size
    at += head.extra_count * head.extra_size
    for _ in range(head.directory_count):
        yield "directory_record", at, _spec.DIRECTORY_RECORD_SIZE
        at += head.directory_size
    for _ in range(head.tile_count):
        if at + _spec.TILE_RECORD_SIZE > len(data):
            return
        tile = _spec.unpack_tile_record(data, at)
        at += head.tile_size
        for _layer in range(tile.layer_count):
            yield "layer_record", at, _spec.LAYER_RECORD_SIZE
            at += head.layer_size
        at += 2 * tile.table_count


def _put_crc(out: bytearray, start: int, end: int, at: int) -> None:
    out[at : at + _CRC_SIZE] = struct.pack("<I", zlib.crc32(memoryview(out)[start:end]))
