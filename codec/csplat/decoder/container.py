# SPDX-License-Identifier: Apache-2.0
"""Read the file header and the frames of chunks, and check their CRCs (spec 4.2, 5.1).

The whole decoder reads from one `memoryview` of the file, so that offsets in errors are offsets in the file.
"""

from __future__ import annotations

import math
import mmap
import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from csplat import _spec
from csplat.errors import FormatError, InputError, LimitError, UnsupportedError
from csplat.file_source import File, describe_substitute, map_file

#: Flags of a TILE chunk.
TILE_FLAGS = sum(flag for flag, name in _spec.CHUNK_FLAG_NAMES.items() if name in _spec.CHUNK_FLAGS[_spec.CHUNK_TILE])

#: Layers of extra columns, whether there is one or not.
EXTRA_LAYERS = range(_spec.LAYER_EXTRA, _spec.LAYER_EXTRA + _spec.EXTRA_COLUMNS_MAX)

#: Name of the highest resource level.
HIGHEST_LEVEL = _spec.RESOURCE_LEVEL_NAMES[max(_spec.RESOURCE_LEVEL_NAMES)]

_CRC_SIZE = 4  # bytes
_SUBSTITUTE_SIZE = 64  # bytes that `describe_substitute` needs


@dataclass(frozen=True, slots=True)
class ExtraColumn:
    """An extra column of the splats.

    Attributes:
        name: key in `SplatModel.extra`.
        dtype: NumPy dtype of a value, `<u2`; `None` for a type or a coding unknown to this version: the column is
            skipped.
        components: values of a splat.
        semantic: what the values mean (registry of semantics); "" if that is not stated.
    """

    name: str
    dtype: str | None
    components: int = 1
    semantic: str = ""

    @property
    def splat_dtype(self) -> np.dtype[Any]:
        """The dtype of a splat, with a shape if there are several components; the dtype of the column must be known."""
        return np.dtype((self.dtype, self.components)) if self.components > 1 else np.dtype(self.dtype)


@dataclass(frozen=True, slots=True)
class Tile:
    """A tile record with its layer records and codebook ids (spec 4.3.5).

    Attributes:
        index: position of the record in the index.
        offset: offset of the record in the file.
        start: index of the tile's first splat among the splats of all tiles.
        level: level of detail; 0 is the scene.
        splat_count: number of splats.
        exponent: the step of the means is step × 2^exponent.
        corner: smallest lattice integer per axis.
        extent: largest minus smallest lattice integer per axis.
        max_scale: largest log scale.
        layers: layer records by layer id, including unknown layers.
        codebook_ids: ids of the codebooks that the tile may use.
    """

    index: int
    offset: int
    start: int
    level: int
    splat_count: int
    exponent: int
    corner: tuple[int, int, int]
    extent: tuple[int, int, int]
    max_scale: float
    layers: dict[int, _spec.LayerRecord]
    codebook_ids: tuple[int, ...]

    def corners(self, step: float) -> tuple[list[float], list[float]]:
        """Return the corners of the box around the centres (spec 4.3.5), scene units; `step` is the file's.

        The numbers are rounded to binary32, as the centres are, so that no centre is outside.
        """
        scaled = math.ldexp(step, self.exponent)
        far = [corner + extent for corner, extent in zip(self.corner, self.extent, strict=True)]
        low, high = ([float(np.float32(n * scaled)) for n in corner] for corner in (self.corner, far))
        return low, high


@dataclass(frozen=True)
class SceneHeader:
    """Header and index of a file, checked.

    Attributes:
        version: (major, minor).
        profile: name of the profile, `base`.
        resource_level: what the file requires a decoder to hold at least (spec 8.1): `A`, `B` or `C`.
        file_size: size of the file, bytes.
        index_size: size of the index, bytes.
        splat_count: N, the splats of level 0.
        sh_degree: 0 to 4.
        kernel: name of the kernel, `ellipse`.
        projection, antialiasing, colour_space: values of their registries, or unknown numbers from 128 on (spec ANC-4).
        flat, coordinate_system, unit_metres, origin: as in `SplatModel`.
        attributes: attribute records, ids ascending.
        codebooks: codebook records, ids ascending.
        extras: extra columns.
        directory: records of all chunks that are not tiles.
        tiles: tiles of level 0, in the order of their splats.
        coarse_tiles: tiles of the coarser levels, whose indices follow.
    """

    version: tuple[int, int]
    profile: str
    resource_level: str
    file_size: int
    index_size: int
    splat_count: int
    sh_degree: int
    kernel: str
    projection: int
    antialiasing: int
    colour_space: int
    flat: bool
    coordinate_system: str
    unit_metres: float | None
    origin: tuple[float, float, float]
    attributes: tuple[_spec.AttributeRecord, ...]
    codebooks: tuple[_spec.CodebookRecord, ...]
    extras: tuple[ExtraColumn, ...]
    directory: tuple[_spec.DirectoryRecord, ...]
    tiles: tuple[Tile, ...]
    coarse_tiles: tuple[Tile, ...] = ()

    @property
    def all_tiles(self) -> tuple[Tile, ...]:
        """Tiles of all levels, in the order of the index."""
        return self.tiles + self.coarse_tiles

    @property
    def antialiased(self) -> bool:
        """True if trained with the mip-splatting low-pass filter."""
        return self.antialiasing == _spec.ANTIALIASING_MIP

    def skips(self, layer: int) -> bool:
        """Return True if a layer is not decoded: it, or the type or coding of its column, is unknown (ANC-2, ANC-3)."""
        if layer in EXTRA_LAYERS:
            return self.extras[layer - EXTRA_LAYERS.start].dtype is None
        return layer >= _spec.ANCILLARY_ID_MIN

    def attribute(self, attribute: int) -> _spec.AttributeRecord:
        """Return an attribute's record; raise `KeyError` for a band above the scene's degree."""
        # ATT-1: the ids of the records are 1, 2, 3, ...
        if not 1 <= attribute <= len(self.attributes):
            raise KeyError(attribute)
        return self.attributes[attribute - 1]

    def chunk(self, kind: bytes) -> _spec.DirectoryRecord | None:
        """Return the directory record of the META, CAMS, OPTS, SERR or TREE chunk, `None` if there is none."""
        return next((record for record in self.directory if record.type == kind), None)


class Cursor:
    """A read position in a payload, which moves forward and never past the end.

    Args:
        view: the whole file.
        at: offset of the next byte.
        end: offset of the payload's end, at most the size of the file.
        clause: clause that requires the payload to end with its last structure.
    """

    def __init__(self, view: memoryview, at: int, end: int, clause: str) -> None:
        self.view = view
        self.at = at
        self.end = end
        self.clause = clause

    def take(self, size: int) -> int:
        """Step over `size` bytes and return their offset; E_STREAM if fewer are left."""
        at, left = self.at, self.end - self.at
        if size > left:
            detail = "the payload ends within a structure"
            raise FormatError(
                _spec.ERROR_STREAM, at, self.clause, detail, found=f"{left} bytes", wanted=f"{size} bytes"
            )
        self.at = at + size
        return at

    def finish(self) -> None:
        """Refuse bytes after the last structure."""
        if self.at != self.end:
            detail = "bytes follow the last structure of the payload"
            raise FormatError(_spec.ERROR_STREAM, self.at, self.clause, detail, found=f"{self.end - self.at} bytes")


def view_of(data: File) -> memoryview:
    """Return the bytes of a file: a view of bytes in memory, a mapping of a path.

    Args:
        data: a path; a binary file, which is read to its end; or a buffer (bytes, bytearray, memoryview, mmap).

    Raises:
        InputError: `data` has another type, is a buffer that is not contiguous, or is a file in text mode.
        OSError: the file cannot be read.
    """
    if isinstance(data, (str, os.PathLike)):
        return memoryview(map_file(data))
    try:
        # An mmap is both a buffer and a file.
        read = None if isinstance(data, mmap.mmap) else getattr(data, "read", None)
        return memoryview(data if read is None else read()).cast("B")  # type: ignore[arg-type]  # raises TypeError
    except (TypeError, ValueError) as error:
        name = type(data).__name__
        raise InputError(f"data is a {name}, expected a path, a binary file or contiguous bytes: {error}") from None


def check_reserved(record: Any, at: int, offsets: Mapping[str, int]) -> None:
    """Check RES-1, "A reserved field or bit MUST be 0"; arguments as in `refuse_field`."""
    for name in offsets:
        if name.startswith("reserved_") and getattr(record, name) != 0:
            refuse_field(_spec.ERROR_RESERVED, "RES-1", record, at, offsets, name, 0)


def refuse_field(
    code: str, clause: str, record: Any, at: int, offsets: Mapping[str, int], name: str, wanted: object = None
) -> NoReturn:
    """Raise the `FormatError` for a field of a structure.

    Args:
        code, clause, wanted: as in `FormatError`.
        record: a structure of `_spec`.
        at: offset of the structure in the file.
        offsets: the structure's `..._OFFSETS`.
        name: name of the field.
    """
    raise FormatError(code, at + offsets[name], clause, name, found=getattr(record, name), wanted=wanted)


def read_file_header(view: memoryview, level_max: str = HIGHEST_LEVEL) -> _spec.Header:
    """Read and check the header (HDR-1 to HDR-4, HDR-7, HDR-11, LIM-2).

    Args:
        view: a file or its beginning.
        level_max: name of the highest resource level that is accepted.
    """
    magic = bytes(view[: len(_spec.MAGIC)])
    if len(view) < _spec.HEADER_SIZE:
        if _spec.MAGIC.startswith(magic):
            refuse_length(_spec.ERROR_TRUNCATED, "HDR-11", "the data ends within the header", view, _spec.HEADER_SIZE)
        raise FormatError(_spec.ERROR_MAGIC, 0, "HDR-11", found=magic.hex(" "), wanted=_spec.MAGIC.hex(" "))
    header = _spec.unpack_header(view)
    offsets = _spec.HEADER_OFFSETS
    if header.magic != _spec.MAGIC:
        instead = describe_substitute(bytes(view[:_SUBSTITUTE_SIZE]))
        detail = "a PLY, which csplat.read reads" if magic[:4] in (b"ply\n", b"ply\r") else instead
        raise FormatError(_spec.ERROR_MAGIC, 0, "HDR-1", detail, found=magic.hex(" "), wanted=_spec.MAGIC.hex(" "))
    if header.version_major != _spec.VERSION_MAJOR or header.version_minor > _spec.VERSION_MINOR:
        raise UnsupportedError(
            f"version {header.version_major}.{header.version_minor}"
            f" (this decoder reads {_spec.VERSION_MAJOR}.{_spec.VERSION_MINOR})",
            _spec.ERROR_VERSION,
            offsets["version_major"],
            "HDR-2",
        )
    crc_at = offsets["header_crc"]
    _check_crc(view[:crc_at], header.header_crc, crc_at, "HDR-3")
    if header.profile not in _spec.PROFILE_NAMES:
        profile = _spec.PROFILE_RESERVED.get(header.profile, str(header.profile)).upper()
        raise UnsupportedError(f"profile {profile}", offset=offsets["profile"], clause="HDR-4")
    level, level_at = _spec.RESOURCE_LEVEL_NAMES.get(header.resource_level), offsets["resource_level"]
    if level is None:
        raise UnsupportedError(f"resource level {header.resource_level}", offset=level_at, clause="RES-2")
    if level > level_max:
        raise LimitError("resource_level", level, level_max, offset=level_at, clause="LIM-2")
    check_reserved(header, 0, offsets)
    least, most = _spec.INDEX_HEAD_SIZE + _CRC_SIZE, header.file_size - _spec.HEADER_SIZE
    if not least <= header.index_size <= most:
        refuse_field(_spec.ERROR_VALUE, "HDR-7", header, 0, offsets, "index_size", f"{least} to {most}")
    return header


def check_length(view: memoryview, file_size: int) -> None:
    """Refuse data that is shorter or longer than the file (HDR-5, HDR-6)."""
    if len(view) < file_size:
        refuse_length(_spec.ERROR_TRUNCATED, "HDR-5", "the data ends early", view, file_size)
    if len(view) > file_size:
        refuse_length(_spec.ERROR_TRAILING, "HDR-6", "bytes follow the end of the file", view, file_size)


def refuse_length(code: str, clause: str, detail: str, view: memoryview, size: int) -> NoReturn:
    """Raise the `FormatError` for data of the wrong length, expected to be `size` bytes."""
    at = min(len(view), size)
    raise FormatError(code, at, clause, detail, found=f"{len(view)} bytes", wanted=f"{size} bytes")


def check_index_crc(view: memoryview, start: int, size: int) -> None:
    """Check IDX-1; the data must contain the index."""
    end = start + size - _CRC_SIZE
    _check_crc(view[start:end], int.from_bytes(view[end : end + _CRC_SIZE], "little"), end, "IDX-1")


def open_chunk(
    view: memoryview, record: _spec.DirectoryRecord | _spec.LayerRecord, kind: bytes, flags: int, clause: str
) -> Cursor:
    """Check CRC and header of a chunk (CHK-1, CHK-3), and return a cursor at the beginning of its payload.

    Args:
        view: the whole file.
        record: record of the chunk, which lies within the file (COV-1) and has at least the size of a chunk header.
        kind: expected type.
        flags: expected flags.
        clause: clause of the cursor.
    """
    offset, end = record.offset, record.offset + record.size
    _check_crc(view[offset:end], record.crc, offset, "CHK-1")
    head = _spec.unpack_chunk_header(view, offset)
    offsets = _spec.CHUNK_HEADER_OFFSETS
    check_reserved(head, offset, offsets)
    payload_size = record.size - _spec.CHUNK_HEADER_SIZE
    for name, wanted in (("type", kind), ("flags", flags), ("payload_size", payload_size)):
        if getattr(head, name) != wanted:
            refuse_field(_spec.ERROR_INDEX, "CHK-3", head, offset, offsets, name, wanted)
    return Cursor(view, offset + _spec.CHUNK_HEADER_SIZE, end, clause)


def _check_crc(covered: memoryview, stored: int, at: int, clause: str) -> None:
    """Raise E_CRC with the clause unless the CRC-32 of `covered` is `stored`, which is at offset `at`."""
    computed = zlib.crc32(covered)
    if computed != stored:
        raise FormatError(_spec.ERROR_CRC, at, clause, f"found {stored:#010x}, computed {computed:#010x}")
