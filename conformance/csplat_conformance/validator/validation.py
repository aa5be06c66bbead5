# SPDX-License-Identifier: CC0-1.0
"""Validate a file from the first byte to the last: header, index, chunks."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from mmap import mmap

from csplat import _spec
from csplat.file_source import PageReleaser
from csplat.types import null_progress
from csplat_conformance.validator.ancillary_chunks import check_declared_bounds, check_text
from csplat_conformance.validator.index import (
    Chunk,
    Index,
    Tile,
    check_coverage,
    check_frame,
    read_directory,
    read_records,
    read_tiles,
)
from csplat_conformance.validator.resource_level import check_resource_level
from csplat_conformance.validator.tiles import CodebookEntries, TileChecker, read_codebook
from csplat_conformance.validator.tree import check_tree, find_tree
from csplat_conformance.validator.violation_log import (
    Payload,
    PlacedRecord,
    TooManyViolationsError,
    UnreadableError,
    Validation,
    ViolationLog,
    read_record,
)

_CRC_SIZE = 4
_TEXT_CHUNKS = (_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS, _spec.CHUNK_OPTIONS)
#: The clause that requires a payload to end with its last structure, by chunk type.
_END_CLAUSES = {
    _spec.CHUNK_CODEBOOK: "CDB-2",
    _spec.CHUNK_METADATA: "JSN-2",
    _spec.CHUNK_CAMERAS: "JSN-2",
    _spec.CHUNK_OPTIONS: "JSN-2",
    _spec.CHUNK_DECLARED_ERRORS: "SER-3",
    _spec.CHUNK_TREE: "TRE-2",
}
_STAGE = "validating"

Header = PlacedRecord[_spec.Header]


def validate(
    data: bytes | bytearray | memoryview | mmap,
    *,
    json_bytes_max: int = _spec.BUDGET_JSON_BYTES,
    splats_max: int | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Validation:
    """Find every violation of the spec in a file.

    Args:
        data: the file, complete or truncated.
        json_bytes_max: budget for the memory of one JSON text (STR-8), in bytes.
        splats_max: budget of splats of level 0 (LIM-1), above which the tiles are not read. Default: none, because only
            one tile is in memory at a time.
        progress: called with the fraction of the tiles that were checked.

    Returns:
        The violations, remarks and unread parts. No content of a file raises an error.
    """
    view = memoryview(data).cast("B")
    log = ViolationLog()
    counts = _Counts()
    with suppress(TooManyViolationsError):  # reported by the last remark
        _check(view, log, counts, json_bytes_max, splats_max, progress or null_progress)
    return Validation(
        tuple(sorted(log.violations, key=lambda violation: violation.offset)),
        tuple(log.remarks),
        tuple(log.unread),
        counts.splats,
        counts.tiles,
        tuple(log.checks),
    )


class _Counts:
    """Numbers of splats and tiles as far as they are known."""

    splats = 0
    tiles = 0


def _check(
    view: memoryview,
    log: ViolationLog,
    counts: _Counts,
    json_bytes_max: int,
    splats_max: int | None,
    progress: Callable[[str, float], None],
) -> None:
    """Check a file from its beginning as far as it can be read.

    Args:
        view: the file.
        log: receives the violations.
        counts: receives the numbers of splats and tiles.
        json_bytes_max, splats_max, progress: as in `validate`.
    """
    header = _read_header(view, log)
    if header is None:
        log.skip("everything after magic and version", "not a file of this version")
        return
    _check_length(view, header.record.file_size, log)
    end = _find_index_end(view, header, log)
    if end is None:
        log.skip("index and chunks", "the index is incomplete")
        return
    index = read_records(view, end - _CRC_SIZE, log)
    counts.splats = index.head.record.splat_count
    directory = read_directory(view, index.end, end - _CRC_SIZE, index, log) if index.complete else []
    tiles: list[Tile] = []
    if index.complete:
        tiles = read_tiles(view, index.end, end - _CRC_SIZE, index, log)
        index.complete = len(tiles) == index.head.record.tile_count
    else:
        log.skip("directory and tiles", "the preceding records exceed the index")
    counts.tiles = len(tiles)
    chunks = [*directory, *(chunk for tile in tiles for chunk in tile.chunks)]
    if index.complete:
        check_coverage(log, chunks, end, header.record.file_size, len(view))
    else:
        log.skip("the chunks", "the index does not list all of them")
        return
    coarsest: list[list[Tile]] = []
    books = _read_directory_chunks(view, directory, tiles, index, json_bytes_max, coarsest, log)
    if not any(tile.level for tile in tiles):
        coarsest.append(tiles)
    check_resource_level(log, header, index, tiles, coarsest[0] if coarsest else None)
    if splats_max is not None and sum(tile.count for tile in tiles if tile.level == 0) > splats_max:
        log.add_field("LIM-1", index.head, "splat_count", f"{counts.splats}, expected at most {splats_max} (budget)")
        log.skip("the tiles", "the number of splats exceeds the budget")
        return
    _read_tile_chunks(view, tiles, index, books, log, progress)


# Header --------------------------------------------------------------------------------------------


def _read_header(view: memoryview, log: ViolationLog) -> Header | None:
    """Check HDR-1 to HDR-4 and HDR-11; return `None` if nothing else can be checked."""
    magic = bytes(view[: len(_spec.MAGIC)])
    if len(view) < _spec.HEADER_SIZE:
        if _spec.MAGIC.startswith(magic):
            log.add("HDR-11", len(view), "header", f"the data ends here, a header has {_spec.HEADER_SIZE} bytes")
        else:
            log.add("HDR-11", 0, "header.magic", f"{magic.hex(' ')} is not the magic", _spec.ERROR_MAGIC)
        return None
    header = read_record(view, _spec.Header, 0, "header")
    record = header.record
    if magic != _spec.MAGIC:
        log.add_field("HDR-1", header, "magic", f"{magic.hex(' ')}, expected {_spec.MAGIC.hex(' ')}")
        return None
    if record.version_major != _spec.VERSION_MAJOR or record.version_minor > _spec.VERSION_MINOR:
        expected = f"{_spec.VERSION_MAJOR}.{_spec.VERSION_MINOR}"
        message = f"{record.version_major}.{record.version_minor}, expected at most {expected}"
        log.add_field("HDR-2", header, "version_major", message)
        return None
    end = _spec.HEADER_OFFSETS["header_crc"]
    computed = zlib.crc32(view[:end])
    if record.header_crc != computed:
        log.add_field("HDR-3", header, "header_crc", f"{record.header_crc:#010x}, computed {computed:#010x}")
    log.checks.append("header_crc")
    if record.profile not in _spec.PROFILE_NAMES:
        log.add_field("HDR-4", header, "profile", f"{record.profile} is not a profile of this version")
    if record.resource_level not in _spec.RESOURCE_LEVEL_NAMES:
        log.add_field("RES-2", header, "resource_level", f"{record.resource_level} is not a level of this version")
    log.check_reserved(header)
    return header


def _check_length(view: memoryview, size: int, log: ViolationLog) -> None:
    """Check HDR-5 and HDR-6: the data have the `size` that the header declares."""
    if len(view) < size:
        log.add("HDR-5", len(view), "end of the data", f"{len(view)} bytes, the header states {size}")
    elif len(view) > size:
        log.add("HDR-6", size, "end of the file", f"{len(view) - size} bytes follow the {size} of the file")


def _find_index_end(view: memoryview, header: Header, log: ViolationLog) -> int | None:
    """Check HDR-7 and IDX-1; return the end of the index, `None` if its head does not fit or it exceeds the data."""
    size, file_size = header.record.index_size, header.record.file_size
    least = _spec.INDEX_HEAD_SIZE + _CRC_SIZE
    end = _spec.HEADER_SIZE + size
    if size < least or end > file_size:
        message = f"{size}, expected {least} to {file_size - _spec.HEADER_SIZE}"
        log.add_field("HDR-7", header, "index_size", message)
    if size < least or end > len(view):
        return None
    at = end - _CRC_SIZE
    stored, computed = int.from_bytes(view[at:end], "little"), zlib.crc32(view[_spec.HEADER_SIZE : at])
    if stored != computed:
        log.add("IDX-1", at, "index.crc", f"{stored:#010x}, computed {computed:#010x}")
    log.checks.append("index_crc")
    return end


# Chunks --------------------------------------------------------------------------------------------


def _read_directory_chunks(
    view: memoryview,
    directory: list[Chunk],
    tiles: list[Tile],
    index: Index,
    json_bytes_max: int,
    coarsest: list[list[Tile]],
    log: ViolationLog,
) -> CodebookEntries:
    """Check every whole chunk of the directory, used or not, known or not (CHK-2); return the entries of codebooks.

    Adds the tiles of the coarsest version to `coarsest`, if TREE specifies them.
    """
    books: CodebookEntries = {}
    tree = find_tree(log, directory, tiles)
    for chunk in directory:
        if not chunk.whole:
            continue
        payload = check_frame(view, chunk, _END_CLAUSES.get(chunk.kind, "CHK-3"), log)
        if chunk.kind in _TEXT_CHUNKS:
            _read_payload(payload, log, partial(check_text, payload, chunk.kind, json_bytes_max))
        elif chunk.kind == _spec.CHUNK_DECLARED_ERRORS:
            _read_payload(payload, log, partial(check_declared_bounds, payload, index))
        elif chunk.kind == _spec.CHUNK_CODEBOOK:
            _read_payload(payload, log, partial(read_codebook, payload, chunk, index, books))
        elif chunk is tree:
            _read_payload(payload, log, partial(_read_tree, payload, tiles, coarsest))
        elif chunk.kind == _spec.CHUNK_TREE:
            log.skip(payload.name, "the file must not contain it")
    return books


def _read_tree(payload: Payload, tiles: list[Tile], coarsest: list[list[Tile]]) -> None:
    roots = check_tree(payload, tiles)
    if roots is not None:
        coarsest.append(roots)


def _read_tile_chunks(
    view: memoryview,
    tiles: list[Tile],
    index: Index,
    books: CodebookEntries,
    log: ViolationLog,
    progress: Callable[[str, float], None],
) -> None:
    """Check the whole chunks of all tiles; `books` are the entries of the codebooks that could be read.

    Adds two entries to `log.checks`, even if chunks had to be skipped.
    """
    pages = PageReleaser(view)
    for tile in tiles:
        progress(_STAGE, tile.index / len(tiles))
        pages.after(sum(chunk.size for chunk in tile.chunks))
        reader = TileChecker(view, index, tile, books, log)
        for chunk in sorted(tile.chunks, key=lambda chunk: chunk.layer):
            if not chunk.whole:
                reader.lost.add(chunk.layer)
                continue
            payload = check_frame(view, chunk, "TLE-3", log)
            if not _read_payload(payload, log, partial(reader.read_layer, payload, chunk)):
                reader.lost.add(chunk.layer)
    log.checks.append("all_chunk_crcs")
    log.checks.append("all_values")
    progress(_STAGE, 1.0)


def _read_payload(payload: Payload, log: ViolationLog, read: Callable[[], None]) -> bool:
    """Read a payload; return False and list the rest as not checked if its structure is unknown."""
    try:
        read()
    except UnreadableError:
        log.skip(f"{payload.name} from byte {payload.at} on", "its structure is unknown")
        return False
    return True
