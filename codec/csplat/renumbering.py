"""Codebooks of several files under one numbering: the tiles that name them are rewritten, and no stream is decoded."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import IO

from csplat import _spec
from csplat.decoder.container import SceneHeader, Tile
from csplat.decoder.tiles import codebook_references
from csplat.encoder.container import CodebookTable, FileChunk, FileTile, LazyPayload, chunk_crc
from csplat.parts import InTurn, TileCopies, chunk_payload
from csplat.stores import Window

_ID_SIZE, _ID_MAX = 2, (1 << 16) - 1
_ID_END = _spec.CODEBOOK_HEAD_OFFSETS["codebook_id"] + _ID_SIZE


class Spool:
    """Payloads that wait in a file until theirs is written.

    Args:
        stream: a temporary file, open to write and read.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream

    def put(self, kind: bytes, payload: bytes) -> LazyPayload:
        """Put the payload of a chunk aside."""
        start = self._stream.seek(0, os.SEEK_END)
        self._stream.write(payload)
        return LazyPayload(len(payload), chunk_crc(kind, payload), partial(self._again, start, len(payload)))

    def _again(self, start: int, size: int) -> bytes:
        self._stream.seek(start)
        return self._stream.read(size)


class Books:
    """Codebooks under ids from 0 on; one that several files have alike is there once.

    Args:
        spool: where they wait.

    Attributes:
        tables: their records.
        chunks: their chunks.
    """

    def __init__(self, spool: Spool) -> None:
        self.tables: list[CodebookTable] = []
        self.chunks: list[FileChunk] = []
        self._spool = spool
        self._known: dict[tuple[object, ...], int] = {}

    def take(self, window: Window, header: SceneHeader) -> dict[int, int]:
        """Add the codebooks of a file that its tiles name; return the new ids by the old ones."""
        used = {table for tile in header.tiles for table in tile.tables}
        chunks = [one for one in header.directory if one.type == _spec.CHUNK_CODEBOOK and one.id in used]
        window.fetch((one.offset, one.size) for one in chunks)
        ids = {}
        for book in header.codebooks:
            if book.codebook_id in used:
                own = sorted((one for one in chunks if one.id == book.codebook_id), key=lambda one: one.layer)
                contents = {one.layer: chunk_payload(window, one)[_ID_END:] for one in own}
                ids[book.codebook_id] = self._id(book, contents)
        window.forget()
        return ids

    def _id(self, book: _spec.CodebookRecord, contents: Mapping[int, bytes]) -> int:
        """The id of a codebook, known or new.

        Args:
            book: its record in its file.
            contents: by layer, its payloads behind the id.
        """
        bands = (book.band_first, book.band_last)
        digests = (hashlib.sha256(content).digest() for content in contents.values())
        key = (book.kind, bands, book.size, *digests)
        if key not in self._known:
            id = self._known[key] = len(self.tables)
            self.tables.append(CodebookTable(id, book.kind, bands, book.size))
            if id <= _ID_MAX:  # who has more cannot be written
                for layer, content in contents.items():
                    payload = self._spool.put(_spec.CHUNK_CODEBOOK, _as_bytes(id) + content)
                    self.chunks.append(FileChunk(_spec.CHUNK_CODEBOOK, payload, id, layer))
        return self._known[key]


def renumbered(window: Window, header: SceneHeader, ids: Mapping[int, int], spool: Spool, files: int) -> list[FileTile]:
    """Tiles of a file, with other ids of codebooks.

    Args:
        window, files: as of `InTurn`.
        header: its header.
        ids: the new ids by the old ones.
        spool: where chunks wait that are rewritten; others are read when they are written.
    """
    changed: dict[int, dict[int, LazyPayload]] = {}
    naming = [
        (tile, tile.layers[layer])
        for layer in range(_spec.SH_DEGREE_MAX + 1)
        for tile in header.tiles
        if layer in _naming_layers(header, tile, ids) & tile.layers.keys()
    ]
    turn = InTurn(window, [record for _, record in naming], files)
    for place, (tile, record) in enumerate(naming):
        turn.take(place)
        if stored := _rewritten(window, header, record, ids, spool):
            changed.setdefault(tile.index, {})[record.layer] = stored
    window.forget()
    copies = TileCopies(window, files)
    tiles = [copies.of(tile, changed.get(tile.index)) for tile in header.tiles]
    return [replace(tile, tables=tuple(sorted({ids[table] for table in tile.tables}))) for tile in tiles]


def _naming_layers(header: SceneHeader, tile: Tile, ids: Mapping[int, int]) -> set[int]:
    """Layers of a tile that may name a codebook whose id is another one now."""
    moved = {table for table in tile.tables if ids[table] != table}
    return {
        layer
        for book in header.codebooks
        if book.codebook_id in moved
        for layer in range(book.band_first, book.band_last + 1)
    }


def _rewritten(
    window: Window, header: SceneHeader, record: _spec.LayerRecord, ids: Mapping[int, int], spool: Spool
) -> LazyPayload | None:
    """A chunk with other ids, put aside; `None` where it names no codebook."""
    with window.store.telling():
        places = list(codebook_references(window.view, header, record))
    if not places:
        return None
    payload = bytearray(chunk_payload(window, record))
    begin = record.offset + _spec.CHUNK_HEADER_SIZE
    for at, id in places:
        payload[at - begin : at - begin + _ID_SIZE] = _as_bytes(ids[id])
    return spool.put(_spec.CHUNK_TILE, bytes(payload))


def _as_bytes(id: int) -> bytes:
    return id.to_bytes(_ID_SIZE, "little")
