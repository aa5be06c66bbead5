"""Read the file header and the frames of chunks, and check their CRCs (spec 4.2, 5.1).

All modules of the decoder read from one `memoryview` of the whole file, so that offsets in errors are offsets in the
file.
"""

from __future__ import annotations

import math
import mmap
import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from csplat import _spec
from csplat.errors import FormatError, InputError, UnsupportedError
from csplat.file_source import File, describe_substitute, map_file

#: All flags that the specification defines for a chunk of a tile.
TILE_FLAGS = sum(flag for flag, name in _spec.CHUNK_FLAG_NAMES.items() if name in _spec.CHUNK_FLAGS[_spec.CHUNK_TILE])

_CRC_SIZE = 4
_STAND_IN_SIZE = 64  # bytes from which content of another kind is recognised


@dataclass(frozen=True, slots=True)
class ExtraColumn:
    """One further column per splat.

    Attributes:
        name: as in `SplatModel.extra`.
        dtype: NumPy name of its type, `<u2`; `None` if this version does not know it: then it is not returned.
    """

    name: str
    dtype: str | None


@dataclass(frozen=True, slots=True)
class Tile:
    """A tile record with its layer records and codebook ids (spec 4.3.5).

    Attributes:
        index: place of the record in the index.
        offset: byte of the file where the record begins.
        start: place of the tile's first splat in a whole decode.
        splat_count: its splats.
        exponent: its lattice of means has step × 2^exponent.
        corner: lattice integers of the box's smallest corner.
        extent: largest minus smallest lattice integer.
        max_scale: largest of its scales (natural logarithm).
        layers: layer records by layer id, including those of unknown layers.
        codebook_ids: ids of the codebooks it may use.
    """

    index: int
    offset: int
    start: int
    splat_count: int
    exponent: int
    corner: tuple[int, int, int]
    extent: tuple[int, int, int]
    max_scale: float
    layers: dict[int, _spec.LayerRecord]
    codebook_ids: tuple[int, ...]

    def corners(self, step: float) -> tuple[list[float], list[float]]:
        """Return the corners of the box around its centres (spec 4.3.5), scene units.

        Args:
            step: step of the means' attribute record.
        """
        scaled = math.ldexp(step, self.exponent)
        low = [corner * scaled for corner in self.corner]
        return low, [(corner + extent) * scaled for corner, extent in zip(self.corner, self.extent, strict=True)]


@dataclass(frozen=True)
class SceneHeader:
    """A file's header and index, all of their clauses checked.

    Attributes:
        version: (major, minor).
        profile: name in the registry of profiles, `base`.
        file_size: bytes of the file.
        index_size: bytes of the index.
        splat_count: N.
        sh_degree: 0 to 3.
        antialiased: trained with the mip-splatting low-pass filter.
        flat: splats are discs; the smallest scale has no meaning.
        coordinate_system: as in `SplatModel`.
        unit_metres: metres per scene unit, `None` if unknown.
        origin: the point that the means are relative to.
        attributes: attribute records in the order of their ids.
        codebooks: codebook records in the order of their ids.
        extras: extra columns.
        directory: records of all chunks that are not tiles.
        tiles: tiles in the order of their splats.
    """

    version: tuple[int, int]
    profile: str
    file_size: int
    index_size: int
    splat_count: int
    sh_degree: int
    antialiased: bool
    flat: bool
    coordinate_system: str
    unit_metres: float | None
    origin: tuple[float, float, float]
    attributes: tuple[_spec.AttributeRecord, ...]
    codebooks: tuple[_spec.CodebookRecord, ...]
    extras: tuple[ExtraColumn, ...]
    directory: tuple[_spec.DirectoryRecord, ...]
    tiles: tuple[Tile, ...]

    def attribute(self, attribute: int) -> _spec.AttributeRecord:
        """Return an attribute's record; `KeyError` for a band above the scene's degree."""
        # ATT-1: the records are opacities, scales, quats, means, sh0 and the bands, ids from 1 on.
        if not 1 <= attribute <= len(self.attributes):
            raise KeyError(attribute)
        return self.attributes[attribute - 1]

    def chunk(self, kind: bytes) -> _spec.DirectoryRecord | None:
        """Return the directory record of META, CAMS, OPTS or SERR, `None` if there is none."""
        return next((record for record in self.directory if record.type == kind), None)


class Cursor:
    """A place in the file that moves forward and never past the end of its payload.

    Args:
        view: the whole file.
        at: offset of the next byte.
        end: offset behind the payload; the caller has checked that the file is that long.
        clause: the clause that requires the payload to end with its last structure.
    """

    def __init__(self, view: memoryview, at: int, end: int, clause: str) -> None:
        self.view = view
        self.at = at
        self.end = end
        self.clause = clause

    def take(self, size: int) -> int:
        """Step over `size` bytes and return their offset; E_STREAM if fewer are left."""
        at = self.at
        if size > self.end - at:
            raise FormatError(
                _spec.ERROR_STREAM,
                at,
                self.clause,
                "the payload ends within a structure",
                found=f"{self.end - at} bytes",
                wanted=f"{size} bytes",
            )
        self.at = at + size
        return at

    def finish(self) -> None:
        """Refuse bytes behind the last structure."""
        if self.at != self.end:
            raise FormatError(
                _spec.ERROR_STREAM,
                self.at,
                self.clause,
                "bytes follow the last structure of the payload",
                found=f"{self.end - self.at} bytes",
            )


def view_of(data: File) -> memoryview:
    """Return the bytes of a file; those in memory are not copied, a path's are mapped.

    Args:
        data: a path; a binary file, which is read to its end; or a buffer (bytes, bytearray, memoryview, mmap).

    Raises:
        InputError: it is none of these, or a buffer that is not contiguous, or a file of text.
        OSError: it cannot be read.
    """
    if isinstance(data, (str, os.PathLike)):
        return memoryview(map_file(data))
    try:
        # An mmap is a buffer and a file; other files must return bytes.
        read = None if isinstance(data, mmap.mmap) else getattr(data, "read", None)
        return memoryview(data if read is None else read()).cast("B")  # type: ignore[arg-type]  # the except says so
    except (TypeError, ValueError) as error:
        raise InputError(
            f"data is a {type(data).__name__}, expected a path, a binary file or contiguous bytes: {error}"
        ) from None


def check_reserved(record: Any, at: int, offsets: Mapping[str, int]) -> None:
    """RES-1: "A reserved field or bit MUST be 0".

    Args:
        record: a structure of `_spec`.
        at: its offset in the file.
        offsets: its `..._OFFSETS`.
    """
    for name, place in offsets.items():
        if name.startswith("reserved_") and getattr(record, name) != 0:
            raise FormatError(_spec.ERROR_RESERVED, at + place, "RES-1", name, found=getattr(record, name), wanted=0)


def read_file_header(view: memoryview) -> _spec.Header:
    """Read and check the header (HDR-1 to HDR-4, HDR-7, HDR-11)."""
    magic = bytes(view[: len(_spec.MAGIC)])
    if len(view) < _spec.HEADER_SIZE:
        if _spec.MAGIC.startswith(magic):
            raise FormatError(
                _spec.ERROR_TRUNCATED,
                len(view),
                "HDR-11",
                "the data ends within the header",
                found=f"{len(view)} bytes",
                wanted=f"{_spec.HEADER_SIZE} bytes",
            )
        raise FormatError(_spec.ERROR_MAGIC, 0, "HDR-11", found=magic.hex(" "), wanted=_spec.MAGIC.hex(" "))
    header = _spec.unpack_header(view)
    places = _spec.HEADER_OFFSETS
    if header.magic != _spec.MAGIC:
        instead = describe_substitute(bytes(view[:_STAND_IN_SIZE]))
        detail = "a PLY, which csplat.read_ply reads" if magic[:4] in (b"ply\n", b"ply\r") else instead
        raise FormatError(_spec.ERROR_MAGIC, 0, "HDR-1", detail, found=magic.hex(" "), wanted=_spec.MAGIC.hex(" "))
    version = (header.version_major, header.version_minor)
    if version != (_spec.VERSION_MAJOR, _spec.VERSION_MINOR):
        raise UnsupportedError(
            f"version {version[0]}.{version[1]} (this decoder reads {_spec.VERSION_MAJOR}.{_spec.VERSION_MINOR})",
            _spec.ERROR_VERSION,
            places["version_major"],
            "HDR-2",
        )
    crc_at = places["header_crc"]
    _check_crc(view[:crc_at], header.header_crc, crc_at, "HDR-3")
    if header.profile not in _spec.PROFILE_NAMES:
        raise UnsupportedError(f"profile {header.profile}", offset=places["profile"], clause="HDR-4")
    check_reserved(header, 0, places)
    room = header.file_size - _spec.HEADER_SIZE
    if not _spec.INDEX_HEAD_SIZE + _CRC_SIZE <= header.index_size <= room:
        raise FormatError(
            _spec.ERROR_VALUE,
            places["index_size"],
            "HDR-7",
            "index_size",
            found=header.index_size,
            wanted=f"{_spec.INDEX_HEAD_SIZE + _CRC_SIZE} to {room}",
        )
    return header


def check_length(view: memoryview, file_size: int) -> None:
    """Refuse data that is not the file, complete and nothing else (HDR-5, HDR-6)."""
    if len(view) < file_size:
        raise FormatError(
            _spec.ERROR_TRUNCATED,
            len(view),
            "HDR-5",
            "the data ends early",
            found=f"{len(view)} bytes",
            wanted=f"{file_size} bytes",
        )
    if len(view) > file_size:
        raise FormatError(
            _spec.ERROR_TRAILING,
            file_size,
            "HDR-6",
            "bytes follow the end of the file",
            found=f"{len(view)} bytes",
            wanted=f"{file_size} bytes",
        )


def check_index_crc(view: memoryview, start: int, size: int) -> None:
    """Check IDX-1; the caller has checked that the data holds the index."""
    end = start + size - _CRC_SIZE
    _check_crc(view[start:end], int.from_bytes(view[end : end + _CRC_SIZE], "little"), end, "IDX-1")


def open_chunk(
    view: memoryview, record: _spec.DirectoryRecord | _spec.LayerRecord, kind: bytes, flags: int, clause: str
) -> Cursor:
    """Check CRC and header of a chunk (CHK-1, CHK-3) and return a cursor at the beginning of its payload.

    Args:
        view: the whole file; COV-1 has shown that the chunk lies within.
        record: the one that names the chunk; its size is at least that of a chunk header.
        kind: type of the record, or TILE.
        flags: flags of the record, or those registered for TILE.
        clause: the cursor's clause, for a payload that is too long or too short.
    """
    offset, end = record.offset, record.offset + record.size
    _check_crc(view[offset:end], record.crc, offset, "CHK-1")
    head = _spec.unpack_chunk_header(view, offset)
    places = _spec.CHUNK_HEADER_OFFSETS
    check_reserved(head, offset, places)
    for name, found, wanted in (
        ("type", head.type, kind),
        ("flags", head.flags, flags),
        ("payload_size", head.payload_size, record.size - _spec.CHUNK_HEADER_SIZE),
    ):
        if found != wanted:
            raise FormatError(_spec.ERROR_INDEX, offset + places[name], "CHK-3", name, found=found, wanted=wanted)
    return Cursor(view, offset + _spec.CHUNK_HEADER_SIZE, end, clause)


def _check_crc(covered: memoryview, stored: int, at: int, clause: str) -> None:
    computed = zlib.crc32(covered)
    if computed != stored:
        raise FormatError(_spec.ERROR_CRC, at, clause, f"found {stored:#010x}, computed {computed:#010x}")
