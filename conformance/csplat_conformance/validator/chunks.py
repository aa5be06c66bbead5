"""Directory records, what the chunks cover, and the frame of a chunk (spec 4.3.4, 4.3.6, 5.1)."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from csplat import _spec
from csplat_conformance.validator.findings import Findings, Placed
from csplat_conformance.validator.index import Index
from csplat_conformance.validator.reading import Payload, place

_SINGLE = (_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS, _spec.CHUNK_OPTIONS, _spec.CHUNK_STATED_ERRORS)
#: The first layer that this version does not have; the order of its chunks is not checked (4.3.6).
_LAST = max(_spec.LAYER_NAMES) + 1


@dataclass
class Chunk:
    """A chunk as a record names it.

    Attributes:
        name: `META`, `CODB.2.0`, `TILE.0.1`.
        kind: its type.
        flags: flags of the record, or the flags registered for TILE.
        record: directory or layer record; both have `size` and `offset`.
        identity: codebook id, or place of the tile.
        layer: layer of the record.
        whole: whether its bytes exist and belong to no other chunk.
    """

    name: str
    kind: bytes
    flags: int
    record: Placed[Any]
    identity: int
    layer: int
    whole: bool = False

    @property
    def offset(self) -> int:
        """First byte."""
        return int(self.record.record.offset)

    @property
    def size(self) -> int:
        """Bytes, header included."""
        return int(self.record.record.size)

    @property
    def rank(self) -> tuple[int, int]:
        """Place in the order that 4.3.6 recommends: by layer, codebooks before tiles; ancillary chunks first."""
        if self.kind == _spec.CHUNK_TILE:
            return (self.layer, 1)
        return (self.layer, 0) if self.kind == _spec.CHUNK_CODEBOOK else (-1, 0)


def registered_flags(kind: bytes) -> int:
    """Return the flags that a known type has."""
    return sum(bit for bit, name in _spec.CHUNK_FLAG_NAMES.items() if name in _spec.CHUNK_FLAGS[kind])


def chunk_record(findings: Findings, chunk: Chunk) -> Chunk:
    """CHK-3, as far as a record alone shows it: a chunk has a header."""
    least = _spec.CHUNK_HEADER_SIZE
    if chunk.size < least:
        findings.of("CHK-3", chunk.record, "size", f"{chunk.size} bytes, a chunk has {least} at least")
    return chunk


def read_directory(view: memoryview, at: int, end: int, index: Index, findings: Findings) -> list[Chunk]:
    """Read the directory records that lie within the index; DIR-1 to DIR-6."""
    start, chunks = at, list[Chunk]()
    count = index.head.record.directory_count
    size = index.size_of("directory")
    for _ in range(min(count, max(0, (end - at) // size))):
        record = _spec.unpack_directory_record(view, at)
        name = _name(record, [chunk.name for chunk in chunks])
        placed = place(view, _spec.unpack_directory_record, _spec.DIRECTORY_RECORD_OFFSETS, at, f"directory[{name}]")
        findings.reserved(placed)
        chunks.append(chunk_record(findings, Chunk(name, record.type, record.flags, placed, record.id, record.layer)))
        _check_type(findings, placed)
        at += size
    index.complete &= len(chunks) == count
    index.end = at
    _check_single(findings, chunks)
    if index.complete:
        _check_codebook_chunks(findings, chunks, index, start)
    return chunks


def _name(record: _spec.DirectoryRecord, known: list[str]) -> str:
    """Name a chunk; bytes that are no letters are written as escapes."""
    kind = ascii(record.type.decode("latin-1"))[1:-1]
    if record.type == _spec.CHUNK_CODEBOOK:
        kind = f"CODB.{record.id}.{record.layer}"
    return kind if kind not in known else f"{kind}#{known.count(kind)}"


def _check_type(findings: Findings, placed: Placed[_spec.DirectoryRecord]) -> None:
    record = placed.record
    kind = record.type
    if kind == _spec.CHUNK_TILE:
        findings.of("DIR-1", placed, "type", "TILE, which layer records name")
        return
    if not all(0x20 <= byte <= 0x7E for byte in kind):
        findings.of("DIR-1", placed, "type", f"{kind!r}, wanted bytes 0x20 to 0x7E")
    flags = record.flags & 0x00FF  # the others are ancillary
    unlisted = flags & ~sum(_spec.CHUNK_FLAG_NAMES)
    if unlisted:
        findings.of("RES-1", placed, "flags", f"bits {unlisted:#06x} are reserved")
    if kind in _spec.CHUNK_NAMES:
        if flags & ~unlisted != registered_flags(kind):
            findings.of("CHK-4", placed, "flags", f"{record.flags:#06x}, wanted {registered_flags(kind):#06x}")
    elif kind == _spec.CHUNK_TREE:
        findings.of("RES-2", placed, "type", f"{kind.decode()} is reserved")
    elif flags & _spec.CHUNK_FLAG_CRITICAL:
        if kind[:1].islower():
            findings.of("DIR-6", placed, "flags", f"{kind!r} is private and critical")
        findings.of("DIR-2", placed, "type", f"{kind!r} is critical and not known")


def _check_single(findings: Findings, chunks: Sequence[Chunk]) -> None:
    seen = set()
    for chunk in chunks:
        if chunk.kind not in _SINGLE:
            continue
        if chunk.kind in seen:
            findings.of("DIR-4", chunk.record, "type", f"a second {chunk.kind.decode()}")
        if chunk.identity or chunk.layer:
            where = f"id {chunk.identity} and layer {chunk.layer}"
            findings.of("DIR-4", chunk.record, "type", f"{chunk.kind.decode()} with {where}, wanted 0 and 0")
        seen.add(chunk.kind)


def _check_codebook_chunks(findings: Findings, chunks: Sequence[Chunk], index: Index, start: int) -> None:
    if len(index.codebooks) != index.head.record.codebook_count:
        return  # the codebooks that they need are not known: the violations have been noted
    wanted = {
        (identity, layer)
        for identity, book in index.codebooks.items()
        for layer in range(book.record.band_first, book.record.band_last + 1)
    }
    for chunk in chunks:
        if chunk.kind != _spec.CHUNK_CODEBOOK:
            continue
        key = (chunk.identity, chunk.layer)
        if key not in wanted:
            findings.of("DIR-5", chunk.record, "type", "no codebook record asks for this chunk, or it is the second")
        wanted.discard(key)
    for identity, layer in sorted(wanted):
        findings.add("DIR-5", start, "directory", f"no CODB chunk for codebook {identity}, layer {layer}")


def check_coverage(findings: Findings, chunks: Sequence[Chunk], start: int, file_size: int, data_size: int) -> None:
    """COV-1; marks the chunks whose bytes can be read, and remarks on another order than 4.3.6 recommends.

    Args:
        findings: receives the violations.
        chunks: all of the file.
        start: end of the index.
        file_size: size of the file in the header.
        data_size: size of the data.
    """
    ordered = sorted(chunks, key=lambda chunk: (chunk.offset, chunk.size))
    expected = covered = start
    for chunk in ordered:
        if chunk.offset != expected:
            findings.of("COV-1", chunk.record, "offset", f"{chunk.offset}, the chunk before ends at {expected}")
        end = chunk.offset + chunk.size
        # A chunk that begins within another is not read: a file could name the same bytes a million times.
        chunk.whole = covered <= chunk.offset <= end - _spec.CHUNK_HEADER_SIZE and end <= min(data_size, file_size)
        if not chunk.whole:
            findings.skip(chunk.name, "its bytes are not there, or another chunk's")
        expected = end
        covered = max(covered, end) if chunk.whole else covered
    if expected != file_size:
        findings.add(
            "COV-1",
            _spec.HEADER_OFFSETS["file_size"],
            "header.file_size",
            f"the last chunk ends at {expected}, the file at {file_size}",
        )
    ranks = [chunk.rank for chunk in ordered if chunk.layer < _LAST]
    if ranks != sorted(ranks):
        findings.remarks.append("the chunks are not in the order that is recommended (4.3.6)")


def check_frame(view: memoryview, chunk: Chunk, clause: str, findings: Findings) -> Payload:
    """Check header and CRC of a chunk that is whole (CHK-1, CHK-3); return its payload.

    Args:
        view: the file.
        chunk: the chunk.
        clause: the clause that requires the payload to end with its last structure.
        findings: receives the violations.
    """
    at, end = chunk.offset, chunk.offset + chunk.size
    stored, computed = chunk.record.record.crc, zlib.crc32(view[at:end])
    if stored != computed:
        findings.add(
            "CHK-1", at, chunk.name, f"{chunk.record.path('crc')} is {stored:#010x}, computed {computed:#010x}"
        )
    header = place(view, _spec.unpack_chunk_header, _spec.CHUNK_HEADER_OFFSETS, at, f"{chunk.name}/header")
    findings.reserved(header)
    payload_size = chunk.size - _spec.CHUNK_HEADER_SIZE
    for key, wanted in (("type", chunk.kind), ("flags", chunk.flags), ("payload_size", payload_size)):
        found = getattr(header.record, key)
        if found != wanted:
            findings.of("CHK-3", header, key, f"{found!r}, its record wants {wanted!r}")
    # COV-1 has proved the record's size: the payload ends there.
    return Payload(view, at + _spec.CHUNK_HEADER_SIZE, end, chunk.name, clause, findings)
