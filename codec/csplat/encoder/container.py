# SPDX-License-Identifier: Apache-2.0
"""Write header, index and chunks of a file (spec 4 and 5)."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from csplat import _spec
from csplat.encoder.entropy import DeflateSettings, unsigned_stream
from csplat.errors import InputError

_CRC_SIZE = 4  # bytes
CODEBOOK_ID_SIZE = 2  # bytes of a codebook id in a tile's record
#: Chunks that no renderer needs, which are last in a file with levels of detail.
_LAST = (_spec.CHUNK_CAMERAS, _spec.CHUNK_OPTIONS, _spec.CHUNK_DECLARED_ERRORS)


@dataclass(frozen=True)
class LazyPayload:
    """A payload that is read when the file is written.

    Attributes:
        size: size in bytes.
        crc: see `chunk_crc`.
        read: returns the payload.
    """

    size: int
    crc: int
    read: Callable[[], bytes]

    def __len__(self) -> int:
        return self.size


Payload = bytes | LazyPayload


@dataclass(frozen=True)
class FileChunk:
    """A chunk other than a tile; codebooks have an id and a layer."""

    type: bytes
    payload: Payload
    id: int = 0
    layer: int = 0


@dataclass(frozen=True)
class FileTile:
    """Index record of a tile, and the payloads of its layers."""

    splat_count: int
    exponent: int
    corner: tuple[int, int, int]
    extent: tuple[int, int, int]
    max_scale: float
    layers: Mapping[int, Payload]
    codebook_ids: tuple[int, ...] = ()
    level: int = 0

    def corners(self, step: float) -> tuple[list[float], list[float]]:
        """Return the corners of the box around the centres (spec 4.3.5), scene units, as numbers of binary32.

        Args:
            step: the file's step of means.
        """
        scaled = math.ldexp(step, self.exponent)
        far = [corner + extent for corner, extent in zip(self.corner, self.extent, strict=True)]
        low, high = ([float(np.float32(n * scaled)) for n in corner] for corner in (self.corner, far))
        return low, high


@dataclass(frozen=True)
class IndexedCodebook:
    """Index record of a codebook."""

    id: int
    kind: int
    bands: tuple[int, int]
    size: int


@dataclass(frozen=True)
class SceneFields:
    """The contents of a file except tiles; the chunks may include the chunk of the nodes (`tree_chunk`)."""

    sh_degree: int
    scene_flags: int
    axes: bytes
    unit_metres: float
    origin: tuple[float, float, float]
    attributes: Sequence[_spec.AttributeRecord]
    extras: Sequence[_spec.ExtraRecord] = ()
    codebooks: Sequence[IndexedCodebook] = ()
    chunks: Sequence[FileChunk] = field(default=())
    antialiasing: int = _spec.ANTIALIASING_NONE
    colour_space: int = _spec.COLOUR_SPACE_SRGB_REC709_DISPLAY
    projection: int = _spec.PROJECTION_PERSPECTIVE


@dataclass(frozen=True)
class FileNode:
    """A node of the levels of detail.

    Attributes:
        parent: index of the parent, or `None`.
        tiles: its tiles.
        error: see spec 5.7, scene units.
        squares: mean squared errors at the pixel sizes of spec E.5, finest first, from which the error follows; none
            for a leaf, or if they have not been measured.
    """

    parent: int | None
    tiles: Sequence[FileTile]
    error: float = 0.0
    squares: tuple[float, ...] = ()

    @property
    def level(self) -> int:
        """Level of its tiles."""
        return self.tiles[0].level

    @property
    def splat_count(self) -> int:
        """Number of splats in its tiles."""
        return sum(tile.splat_count for tile in self.tiles)


def tree_chunk(nodes: Sequence[FileNode]) -> FileChunk:
    """Return the TREE chunk (spec 5.7) of nodes in the order of their tiles."""
    records = (
        _spec.NodeRecord(_spec.NO_PARENT if node.parent is None else node.parent, len(node.tiles), node.error)
        for node in nodes
    )
    return FileChunk(_spec.CHUNK_TREE, b"".join(map(_spec.pack_node_record, records)))


def order_nodes(nodes: Sequence[FileNode]) -> list[FileNode]:
    """Return nodes by ascending level, as the index requires (TIL-12), with renumbered parents."""
    order = sorted(range(len(nodes)), key=lambda number: nodes[number].level)
    position = {number: place for place, number in enumerate(order)}
    return [
        replace(nodes[number], parent=None if (parent := nodes[number].parent) is None else position[parent])
        for number in order
    ]


def json_payload(value: Any, deflate: DeflateSettings) -> bytes:
    """Return the payload of a JSON chunk (spec 5.4), keys sorted.

    Raises:
        InputError: decoders would refuse the text with their default budget (STR-8).
    """
    text = json.dumps(value, ensure_ascii=False, sort_keys=True, allow_nan=False, separators=(",", ":")).encode()
    values = np.isin(np.frombuffer(text, np.uint8), list(b",:[{")).sum()
    cost = _spec.JSON_BYTE_COST * len(text) + _spec.JSON_VALUE_COST * int(values)
    if cost > _spec.BUDGET_JSON_BYTES:
        what = "the cameras" if isinstance(value, list) else "the metadata"
        text_size = f"{len(text):,} bytes of JSON with {values:,} values"
        raise InputError(f"{what} are {text_size}, more than decoders accept by default: store fewer, or none")
    return unsigned_stream(np.frombuffer(text, np.uint8), deflate)


def tile_payload(layer: int, blocks: Sequence[bytes]) -> bytes:
    """Return the payload of a TILE chunk (spec 5.2): a head, and blocks in the order of their attributes."""
    return _spec.pack_tile_head(_spec.TileHead(layer, len(blocks), 0)) + b"".join(blocks)


def file_pieces(scene: SceneFields, tiles: Sequence[FileTile]) -> Iterator[bytes]:
    """Yield a file in pieces: header, index, and chunks in the recommended order (spec 4.3.6)."""
    index_size = _index_size(scene, tiles)
    offset = _spec.HEADER_SIZE + index_size
    directory: list[_spec.DirectoryRecord] = []
    layers: dict[tuple[int, int], _spec.LayerRecord] = {}
    for layer_key, chunk in _ordered_chunks(scene, tiles):
        where = (_spec.CHUNK_HEADER_SIZE + len(chunk.payload), offset, chunk_crc(chunk.type, chunk.payload))
        if layer_key is None:
            directory.append(_spec.DirectoryRecord(chunk.type, _flags(chunk.type), chunk.id, chunk.layer, 0, 0, *where))
        else:
            layers[layer_key] = _spec.LayerRecord(chunk.layer, 0, 0, *where)
        offset += where[0]
    index = _index(scene, tiles, directory, layers)
    assert len(index) == index_size
    yield _header(_resource_level(scene, tiles, len(index)), len(index), offset)
    yield index
    for _, chunk in _ordered_chunks(scene, tiles):
        yield _chunk_head(chunk.type, len(chunk.payload))
        yield chunk.payload if isinstance(chunk.payload, bytes) else chunk.payload.read()


def _flags(kind: bytes) -> int:
    """Return the flags that the specification gives a type of chunk."""
    return sum(getattr(_spec, f"CHUNK_FLAG_{name.upper()}") for name in _spec.CHUNK_FLAGS[kind])


def _chunk_head(kind: bytes, size: int) -> bytes:
    """Return the header of a chunk, by its type and the size of its payload in bytes."""
    return _spec.pack_chunk_header(_spec.ChunkHeader(kind, _flags(kind), 0, size))


def _ordered_chunks(
    scene: SceneFields, tiles: Sequence[FileTile]
) -> Iterator[tuple[tuple[int, int] | None, FileChunk]]:
    """Yield each chunk in the order of the file, with its (tile, layer), or `None` for chunks other than tiles.

    First the nodes and the scene's other chunks, then layer by layer its codebooks and its tiles, coarsest level first.
    If there are nodes, the chunks of `_LAST` are at the end.
    """
    tree = [chunk for chunk in scene.chunks if chunk.type == _spec.CHUNK_TREE]
    others = [chunk for chunk in scene.chunks if chunk.type not in (_spec.CHUNK_CODEBOOK, _spec.CHUNK_TREE)]
    last = [chunk for chunk in others if tree and chunk.type in _LAST]
    yield from ((None, chunk) for chunk in (*tree, *others) if chunk not in last)
    coarsest_first = sorted(enumerate(tiles), key=lambda item: -item[1].level)
    for layer in sorted({*_spec.LAYER_NAMES, *(layer for tile in tiles for layer in tile.layers)}):
        for chunk in scene.chunks:
            if chunk.type == _spec.CHUNK_CODEBOOK and chunk.layer == layer:
                yield None, chunk
        for number, tile in coarsest_first:
            if layer in tile.layers:
                yield (number, layer), FileChunk(_spec.CHUNK_TILE, tile.layers[layer], layer=layer)
    yield from ((None, chunk) for chunk in last)


def chunk_crc(kind: bytes, payload: Payload) -> int:
    """Return the CRC of a chunk's header and payload (CHK-1)."""
    if not isinstance(payload, bytes):
        return payload.crc
    return zlib.crc32(payload, zlib.crc32(_chunk_head(kind, len(payload))))


def _index_size(scene: SceneFields, tiles: Sequence[FileTile]) -> int:
    """Return the size of the index in bytes, including its CRC."""
    return (
        _spec.INDEX_HEAD_SIZE
        + len(scene.attributes) * _spec.ATTRIBUTE_RECORD_SIZE
        + len(scene.codebooks) * _spec.CODEBOOK_RECORD_SIZE
        + len(scene.extras) * _spec.EXTRA_RECORD_SIZE
        + len(scene.chunks) * _spec.DIRECTORY_RECORD_SIZE
        + sum(
            _spec.TILE_RECORD_SIZE
            + len(tile.layers) * _spec.LAYER_RECORD_SIZE
            + len(tile.codebook_ids) * CODEBOOK_ID_SIZE
            for tile in tiles
        )
        + _CRC_SIZE
    )


def _index(
    scene: SceneFields,
    tiles: Sequence[FileTile],
    directory: Sequence[_spec.DirectoryRecord],
    layers: Mapping[tuple[int, int], _spec.LayerRecord],
) -> bytes:
    """Return the index, including its CRC (spec 4.3).

    Args:
        scene: fields and records of the scene.
        tiles: the tiles, whose levels ascend.
        directory: records of the chunks other than tiles.
        layers: layer records by (tile, layer).
    """
    head = _spec.IndexHead(
        head_size=_spec.INDEX_HEAD_SIZE,
        attribute_size=_spec.ATTRIBUTE_RECORD_SIZE,
        codebook_size=_spec.CODEBOOK_RECORD_SIZE,
        extra_size=_spec.EXTRA_RECORD_SIZE,
        directory_size=_spec.DIRECTORY_RECORD_SIZE,
        tile_size=_spec.TILE_RECORD_SIZE,
        layer_size=_spec.LAYER_RECORD_SIZE,
        kernel=_spec.KERNEL_ELLIPSE,
        splat_count=sum(tile.splat_count for tile in tiles if tile.level == 0),
        tile_count=len(tiles),
        directory_count=len(directory),
        codebook_count=len(scene.codebooks),
        extra_count=len(scene.extras),
        attribute_count=len(scene.attributes),
        sh_degree=scene.sh_degree,
        scene_flags=scene.scene_flags,
        axes=scene.axes,
        unit_metres=scene.unit_metres,
        origin=scene.origin,
        projection=scene.projection,
        antialiasing=scene.antialiasing,
        colour_space=scene.colour_space,
        reserved_0=0,
    )
    parts = [_spec.pack_index_head(head)]
    parts += [_spec.pack_attribute_record(record) for record in scene.attributes]
    for book in scene.codebooks:
        record = _spec.CodebookRecord(book.id, book.kind, *book.bands, 0, 0, book.size)
        parts.append(_spec.pack_codebook_record(record))
    parts += [_spec.pack_extra_record(record) for record in scene.extras]
    parts += [_spec.pack_directory_record(record) for record in directory]
    for number, tile in enumerate(tiles):
        parts.append(
            _spec.pack_tile_record(
                _spec.TileRecord(
                    splat_count=tile.splat_count,
                    level=tile.level,
                    layer_count=len(tile.layers),
                    table_count=len(tile.codebook_ids),
                    exponent=tile.exponent,
                    reserved_0=0,
                    corner=tile.corner,
                    extent=tile.extent,
                    max_scale=tile.max_scale,
                )
            )
        )
        parts += [_spec.pack_layer_record(layers[number, layer]) for layer in sorted(tile.layers)]
        parts += [identity.to_bytes(CODEBOOK_ID_SIZE, "little") for identity in tile.codebook_ids]
    index = b"".join(parts)
    return index + zlib.crc32(index).to_bytes(_CRC_SIZE, "little")


def _extra_bytes(column: _spec.ExtraRecord) -> int:
    """Return the bytes of a splat in an extra column, 0 if its type or coding is unknown."""
    return column.components * _spec.EXTRA_DTYPE_BYTES.get(column.dtype, 0) * (column.coding == _spec.CODING_RAW)


def _resource_level(scene: SceneFields, tiles: Sequence[FileTile], index_size: int) -> int:
    """Return the lowest resource level whose bounds the contents obey (spec 8.1); `index_size` is in bytes."""
    splat_bytes = 4 * (3 + 4 + 3 + 1 + 3 * (scene.sh_degree + 1) ** 2)
    extra_bytes = sum(_extra_bytes(extra) for extra in scene.extras)
    sizes = [tile.splat_count * (splat_bytes + extra_bytes * (tile.level == 0)) for tile in tiles]
    coarsest = _coarsest_tiles(scene, tiles)
    version = sum(tile.splat_count for tile in coarsest) * splat_bytes
    if not any(tile.level for tile in coarsest):
        version += sum(tile.splat_count for tile in coarsest) * extra_bytes
    columns = {
        _spec.CODEBOOK_KIND_SHAPE: _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_SCALES]
        + _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_QUATS]
    }
    elements = 0
    for book in scene.codebooks:
        bands = range(book.bands[0], book.bands[1] + 1)
        elements += book.size * columns.get(book.kind, sum(3 * (2 * band + 1) for band in bands))
    needed = (
        (index_size, _spec.RESOURCE_LEVEL_INDEX_BYTES),
        (4 * elements, _spec.RESOURCE_LEVEL_CODEBOOK_BYTES),
        (max(sizes, default=0), _spec.RESOURCE_LEVEL_TILE_BYTES),
        (version, _spec.RESOURCE_LEVEL_VERSION_BYTES),
    )
    return next(
        level
        for level in sorted(_spec.RESOURCE_LEVEL_NAMES)
        if all(size <= bounds.get(level, math.inf) for size, bounds in needed)
    )


def _coarsest_tiles(scene: SceneFields, tiles: Sequence[FileTile]) -> Sequence[FileTile]:
    """Return the tiles of the nodes without a parent; all tiles if there are no nodes."""
    tree = next((chunk.payload for chunk in scene.chunks if chunk.type == _spec.CHUNK_TREE), None)
    if tree is None:
        return tiles
    assert isinstance(tree, bytes)
    coarsest: list[FileTile] = []
    first = 0
    for at in range(0, len(tree), _spec.NODE_RECORD_SIZE):
        node = _spec.unpack_node_record(tree, at)
        if node.parent == _spec.NO_PARENT:
            coarsest += tiles[first : first + node.tile_count]
        first += node.tile_count
    return coarsest


def _header(resource_level: int, index_size: int, file_size: int) -> bytes:
    """Return the header, including its CRC (spec 4.2); sizes are in bytes."""
    header = _spec.Header(
        magic=_spec.MAGIC,
        version_major=_spec.VERSION_MAJOR,
        version_minor=_spec.VERSION_MINOR,
        profile=_spec.PROFILE_BASE,
        resource_level=resource_level,
        reserved_0=0,
        index_size=index_size,
        file_size=file_size,
        header_crc=0,
    )
    fixed = _spec.pack_header(header)[: _spec.HEADER_OFFSETS["header_crc"]]
    return fixed + zlib.crc32(fixed).to_bytes(_CRC_SIZE, "little")
