# SPDX-License-Identifier: Apache-2.0
"""Extract a part of a file, or its finest level: copy tiles to another file without decoding their streams."""

from __future__ import annotations

import os
from collections.abc import Container, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import accumulate
from typing import Any

from csplat import _spec
from csplat.byte_store import FileWindow
from csplat.decoder.container import EXTRA_LAYERS, TILE_FLAGS, SceneHeader, Tile, open_chunk
from csplat.decoder.tree import Node
from csplat.disk_files import BinaryWriter, open_writer
from csplat.encoder.container import (
    FileChunk,
    FileNode,
    FileTile,
    IndexedCodebook,
    LazyPayload,
    Payload,
    SceneFields,
    file_pieces,
    tree_chunk,
)
from csplat.file_source import File
from csplat.splat_file import SplatFile, tiles_touching

#: Chunks that are copied to an extract; declared bounds and options refer to the whole file.
_KEPT = (_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS)
#: Chunks that are copied with the whole of level 0, to which declared bounds refer.
_KEPT_WITH_ALL = (*_KEPT, _spec.CHUNK_OPTIONS, _spec.CHUNK_DECLARED_ERRORS)
_ALL = 1 << 26  # maximum size of the data fetched at once from all files, bytes


@dataclass(frozen=True)
class ExtractResult:
    """The result of `csplat.extract`.

    Attributes:
        tiles: indices of the extracted tiles in the source file, of all levels of detail.
        splat_count: number of splats extracted, of level 0.
        size_bytes: size of the new file.
    """

    tiles: tuple[int, ...]
    splat_count: int
    size_bytes: int


def extract(
    file: File | SplatFile,
    box: Sequence[float],
    output: str | os.PathLike[str] | BinaryWriter,
    *,
    storage: Mapping[str, Any] | None = None,
) -> ExtractResult:
    """Write the tiles of a file that touch a box as a file of their own.

    Tiles are copied whole, including splats outside the box; values are preserved bit for bit. Nodes of a file with
    levels of detail are copied whole, and nodes of coarser levels only if everything below them is. Declared error
    bounds and the encoder's options, which refer to the whole file, are omitted, as are chunks of unknown types. Only
    header, index and the copied data are read, a few megabytes at a time.

    Args:
        file: a `.csplat` file as in `csplat.open`, or an open file.
        box: two corners, x, y, z each, in any order, possibly infinite, in scene units relative to the origin.
        output: a path, written atomically and replaced if it exists; or an open binary file.
        storage: as in `csplat.open`.

    Examples:
        >>> import csplat
        >>> part = csplat.extract("scene.csplat", (-1, -1, -1, 1, 1, 1), "part.csplat")
        >>> part.splat_count == len(csplat.decode("part.csplat"))
        True

    Raises:
        InputError: the box is not six numbers, or no tile touches the box.
        FormatError: the header, the index or a copied chunk breaks a clause.
        UnsupportedError, StoreError, OSError: as in `csplat.open`, or the output cannot be written.
    """
    opening = nullcontext(file) if isinstance(file, SplatFile) else SplatFile.open(file, storage=storage)
    with opening as opened:
        tiles = tiles_touching(opened.header, box)
        return _write_extract(opened.window(), opened.header, tiles, opened.nodes, output)


def extract_finest(
    file: SplatFile, output: str | os.PathLike[str] | BinaryWriter, *, origin: tuple[float, float, float]
) -> ExtractResult:
    """Write level 0 of a file with splats as a file of its own, with another origin; values are preserved bit for bit.

    Args:
        file: an open `.csplat` file.
        output: as in `extract`.
        origin: the origin of the new file; the means remain as they are.

    Raises:
        FormatError, StoreError, OSError: as in `extract`.
    """
    header = replace(file.header, coarse_tiles=(), origin=origin)
    return _write_extract(file.window(), header, header.tiles, (), output, kept_chunks=_KEPT_WITH_ALL)


def _write_extract(
    window: FileWindow,
    header: SceneHeader,
    tiles: Sequence[Tile],
    nodes: Sequence[Node],
    output: str | os.PathLike[str] | BinaryWriter,
    kept_chunks: Sequence[bytes] = _KEPT,
) -> ExtractResult:
    """Write some tiles of a file as a file of their own.

    In a file with levels of detail, leaves are written whole, and other nodes if all their children are.

    Args:
        window: the file.
        header: header of the file.
        tiles: tiles of level 0 to write, in file order.
        nodes: nodes of the file.
        output: a path or an open binary file.
        kept_chunks: types of the chunks to write that belong to no tile, besides codebooks.
    """
    kept = _kept_nodes(nodes, {tile.index for tile in tiles}) if header.coarse_tiles else []
    tiles = [tile for number in kept for tile in nodes[number].tiles] if kept else tiles
    codebook_ids = {identity for tile in tiles for identity in tile.codebook_ids}
    records = [
        record
        for record in header.directory
        if record.type in kept_chunks or (record.type == _spec.CHUNK_CODEBOOK and record.id in codebook_ids)
    ]
    copies = TileCopier(window)
    copied = [copies.of(tile) for tile in tiles]
    copies.begin(records)
    chunks = [FileChunk(record.type, chunk_payload(window, record), record.id, record.layer) for record in records]
    if tiles[-1].level > 0:
        chunks.append(tree_chunk(copy_nodes([nodes[number] for number in kept], kept, copied)))
    fields = scene_fields(window, header, codebook_ids, chunks)
    size = 0
    with open_writer(output) as stream:
        for part in file_pieces(fields, copied):
            stream.write(part)
            size += len(part)
    count = sum(tile.splat_count for tile in tiles if tile.level == 0)
    return ExtractResult(tuple(tile.index for tile in tiles), count, size)


def _kept_nodes(nodes: Sequence[Node], tiles: Container[int]) -> list[int]:
    """Return the leaves that contain any of some tiles, and the nodes all of whose children are kept."""
    kept: list[int] = []
    is_kept = [False] * len(nodes)
    for number, node in enumerate(nodes):  # children come before their parents
        if node.level == 0:
            is_kept[number] = any(tile.index in tiles for tile in node.tiles)
        else:
            is_kept[number] = all(is_kept[child] for child in node.children)
        if is_kept[number]:
            kept.append(number)
    return kept


def copy_nodes(nodes: Sequence[Node], numbers: Sequence[int], tiles: Sequence[FileTile]) -> list[FileNode]:
    """Return some nodes of a file for another file.

    Args:
        nodes: the nodes.
        numbers: their indices in the file; a parent that is not among them becomes none.
        tiles: the copies of their tiles, in file order.
    """
    position = {number: place for place, number in enumerate(numbers)}
    ends = [*accumulate(len(node.tiles) for node in nodes)]
    return [
        FileNode(
            None if node.parent is None else position.get(node.parent), tiles[end - len(node.tiles) : end], node.error
        )
        for node, end in zip(nodes, ends, strict=True)
    ]


class ChunkPrefetcher:
    """Fetches chunks of a file in order, several per request.

    Args:
        window: the file; each fetch discards the previous data.
        records: records of the chunks in the order in which they are taken.
        files: number of files that are read concurrently and share the memory.
    """

    def __init__(self, window: FileWindow, records: Sequence[_spec.LayerRecord], files: int = 1) -> None:
        self._window = window
        self._records = records
        self._batch = min(window.store.sizes.batch, _ALL // files)
        self._here = range(0)

    def take(self, index: int, extra: Sequence[_spec.DirectoryRecord] = ()) -> _spec.LayerRecord:
        """Return the record of a chunk; if it is not in the window, fetch it with the next batch and `extra`."""
        if index not in self._here:
            stop, size = index + 1, self._records[index].size
            while stop < len(self._records) and size + self._records[stop].size <= self._batch:
                size += self._records[stop].size
                stop += 1
            if self._here:
                self._window.forget()
            ranges = [(record.offset, record.size) for record in extra]
            self._window.fetch(ranges + [(record.offset, record.size) for record in self._records[index:stop]])
            self._here = range(index, stop)
        return self._records[index]


class TileCopier:
    """Copies tiles of a file; their chunks are read when the new file is written.

    Args:
        window, files: as in `ChunkPrefetcher`.
    """

    def __init__(self, window: FileWindow, files: int = 1) -> None:
        self._window = window
        self._files = files
        self._records: dict[int, list[_spec.LayerRecord]] = {layer: [] for layer in {*_spec.LAYER_NAMES, *EXTRA_LAYERS}}

    def of(self, tile: Tile, changed: Mapping[int, LazyPayload] | None = None) -> FileTile:
        """Return a tile for the new file, without layers of unknown ids.

        Args:
            tile: the tile's record.
            changed: replaced payloads by layer.
        """
        layers: dict[int, Payload] = dict(changed or {})
        for layer in self._records.keys() & tile.layers.keys() - layers.keys():
            record, records = tile.layers[layer], self._records[layer]
            read = partial(self._read, layer, len(records))
            layers[layer] = LazyPayload(record.size - _spec.CHUNK_HEADER_SIZE, record.crc, read)
            records.append(record)
        return FileTile(
            tile.splat_count, tile.exponent, tile.corner, tile.extent, tile.max_scale, layers, tile.codebook_ids,
            tile.level,
        )  # fmt: skip

    def begin(self, extra: Sequence[_spec.DirectoryRecord]) -> None:
        """Fetch the first chunks, and `extra`, which is needed before any tile; call after all tiles are added."""
        self._chunks[0].take(0, extra)

    @cached_property
    def _chunks(self) -> tuple[ChunkPrefetcher, dict[int, int]]:
        """Return all chunks in file order, and the index of the first chunk of each layer."""
        starts = dict(zip(self._records, accumulate(map(len, self._records.values()), initial=0), strict=False))
        records = [record for records in self._records.values() for record in records]
        return ChunkPrefetcher(self._window, records, self._files), starts

    def _read(self, layer: int, index: int) -> bytes:
        chunks, starts = self._chunks
        return chunk_payload(self._window, chunks.take(starts[layer] + index))


def chunk_payload(window: FileWindow, record: _spec.DirectoryRecord | _spec.LayerRecord) -> bytes:
    """Return the payload of a fetched chunk after checking its CRC and header."""
    with window.store.named_errors():
        if isinstance(record, _spec.LayerRecord):
            cursor = open_chunk(window.view, record, _spec.CHUNK_TILE, TILE_FLAGS, "TLE-1")
        else:
            cursor = open_chunk(window.view, record, record.type, record.flags, "CHK-3")
    return bytes(window.view[cursor.at : cursor.end])


def scene_fields(
    window: FileWindow, header: SceneHeader, codebook_ids: Container[int], chunks: Sequence[FileChunk]
) -> SceneFields:
    """Return the scene fields of a file with other chunks.

    Args:
        window: the file.
        header: header and index of the file.
        codebook_ids: ids of the codebooks to keep.
        chunks: all chunks except tiles.
    """
    head = _spec.unpack_index_head(window.view, _spec.HEADER_SIZE)
    at = _spec.HEADER_SIZE + head.head_size + head.attribute_count * head.attribute_size
    at += head.codebook_count * head.codebook_size
    extras = [_spec.unpack_extra_record(window.view, at + i * head.extra_size) for i in range(head.extra_count)]
    books = [book for book in header.codebooks if book.codebook_id in codebook_ids]
    return SceneFields(
        sh_degree=header.sh_degree,
        scene_flags=header.flat * _spec.SCENE_FLAG_FLAT,
        axes=bytes(head.axes),
        unit_metres=head.unit_metres,
        origin=header.origin,
        attributes=header.attributes,
        antialiasing=header.antialiasing,
        colour_space=header.colour_space,
        projection=header.projection,
        extras=extras,
        codebooks=[
            IndexedCodebook(book.codebook_id, book.kind, (book.band_first, book.band_last), book.size) for book in books
        ],
        chunks=chunks,
    )
