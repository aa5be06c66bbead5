"""The containers of SPZ: one gzip stream of versions 1 to 3, Zstandard streams of version 4."""

from __future__ import annotations

import gzip
import struct
import zlib
from contextlib import nullcontext
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, cast

import deflate
import numpy as np
import zstandard
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.files import atomic_writer
from csplat.lint import Finding, too_many_bands, trailing_bytes
from csplat.model import MAX_SH_DEGREE
from csplat.types import U8

#: Right, up, back.
AXES = "RUB"

#: A bit of `Packed.flags`.
ANTIALIASED = 0x01

#: Of a fraction: readers compute 1 << bits in 32 bits.
MOST_BITS = 30

_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_HEADER = struct.Struct("<4sIIBBBB")
_HEADER_REST = struct.Struct("<I12x")  # of version 4: where the table of streams begins
_STREAM = struct.Struct("<QQ")  # bytes packed, bytes unpacked
_RECORD = struct.Struct("<II")  # of an extension: type, bytes of its value
_EXTENDED, _LEVELS = 0x02, 0x80
_COORDINATE_SYSTEM = 0xADBE0003  # the extension SPZ_ADOBE_coordinate_system
_SYSTEMS = "RUBLDBRDBLUBRUBLDFRDFLUFRUFLFDRFDLFURFULBDRBDLBURBU"  # by number, three letters each; 0 is unspecified
_EXTENSION_BYTES = 1 << 20  # at most
_RATIO = 1032  # of deflate, at most; programs of the format refuse more of Zstandard, too
_MAX_DEGREE = 4  # of SH, of the format since its version 4
_GZIP_LEVEL, _ZSTD_LEVEL = 9, 12
_PIECE = 1 << 18


@dataclass(eq=False)
class Packed:
    """A file as it lies in memory.

    Attributes:
        name: of the file, for messages.
        version: 1 to 4.
        count: N.
        degree: of SH, to 4.
        bits: of the fraction of positions.
        flags: `ANTIALIASED` and others.
        streams: how many version 4 says it has.
        axes: three letters, as in `SplatModel`.
        findings: what is unusual about it.
        parts: [N, bytes] each: positions, alphas, colours, scales, rotations, SH.
    """

    name: str
    version: int
    count: int
    degree: int
    bits: int
    flags: int
    streams: int = 0
    axes: str = AXES
    parts: list[U8] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes of a splat, by attribute."""
        rest = 3 * ((self.degree + 1) ** 2 - 1)
        return 6 if self.version == 1 else 9, 1, 3, 3, 4 if self.version > 2 else 3, rest

    def room(self) -> U8:
        """Make the parts, one after the other behind a header: the bytes of versions 1 to 3."""
        ends = _HEADER.size + np.cumsum((0, *self.widths)) * self.count
        data = np.empty(ends[-1], np.uint8)
        self.parts = [
            data[start:end].reshape(self.count, width)
            for (start, end), width in zip(pairwise(ends), self.widths, strict=True)
        ]
        return data

    @property
    def means_half(self) -> NDArray[np.float16]:
        """The positions of version 1."""
        return self.parts[0].view("<f2")


def read_packed(file: BinaryIO, name: str, size: int, *, any_degree: bool = False) -> Packed:
    """Check a file and unpack it.

    Args:
        file: at its beginning.
        name: of it, for messages.
        size: of it, in bytes.
        any_degree: its SH may be of a higher degree than that of models, up to 4.

    Raises:
        InputError: it is not whole, or none that csplat reads.
        OSError: it cannot be read.
    """
    zipped = file.read(2) == _GZIP
    file.seek(0)
    try:
        with cast(BinaryIO, gzip.open(file)) if zipped else nullcontext(file) as stream:
            packed = _header(name, size, stream, any_degree=any_degree)
            (_read_streams if packed.version == 4 else _read_arrays)(packed, size, stream)
    except (EOFError, zlib.error, zstandard.ZstdError, gzip.BadGzipFile) as error:
        raise InputError(f"{name} is damaged: {str(error) or 'it ends too early'}") from None
    if packed.version == 1 and not np.isfinite(packed.means_half).all():
        raise InputError(f"{name} has positions that are NaN or infinite")
    return packed


def _header(name: str, size: int, stream: BinaryIO, *, any_degree: bool) -> Packed:
    magic, version, count, degree, bits, flags, streams = _HEADER.unpack(_taken(name, stream, _HEADER.size))
    if magic != _MAGIC:
        raise InputError(f"{name} is no SPZ: it begins with {magic!r}, wanted {_MAGIC!r}")
    if not 1 <= version <= 4 or (version == 4 and isinstance(stream, gzip.GzipFile)):
        raise InputError(f"{name} is SPZ of version {version}, wanted 1 to 4 (4 not inside of gzip)")
    if degree > _MAX_DEGREE:
        raise InputError(f"{name} has SH degree {degree}, wanted at most {_MAX_DEGREE}")
    if degree > MAX_SH_DEGREE and not any_degree:
        raise InputError(f"{name} has {too_many_bands(degree)}")
    if version > 1 and bits > MOST_BITS:
        raise InputError(f"{name} has {bits} fractional bits, wanted at most {MOST_BITS}")
    if flags & _LEVELS:
        raise InputError(f"{name} holds levels of detail of Spark in one list, which csplat does not read")
    packed = Packed(name, version, count, degree, bits, flags, streams)
    unpacked = count * sum(packed.widths)
    if unpacked > _RATIO * size:
        raise InputError(f"{name} says it has {count:,} splats, more than its {size:,} bytes can hold")
    return packed


def _read_arrays(packed: Packed, _size: int, stream: BinaryIO) -> None:
    """Versions 1 to 3: one attribute after the other, then extensions."""
    _fill(packed.name, stream, packed.room()[_HEADER.size :])
    tail = stream.read(_EXTENSION_BYTES + 1)  # to the end, where gzip has its checksum
    if len(tail) > _EXTENSION_BYTES:
        raise InputError(f"{packed.name} goes on after its last splat")
    packed.findings += trailing_bytes(len(tail) - _read_extensions(packed, tail))


def _read_streams(packed: Packed, size: int, stream: BinaryIO) -> None:
    """Version 4: extensions, a table, then each attribute packed by itself; those without bytes are left out."""
    (table,) = _HEADER_REST.unpack(_taken(packed.name, stream, _HEADER_REST.size))
    start = _HEADER.size + _HEADER_REST.size
    if not start <= table <= start + _EXTENSION_BYTES:
        raise InputError(f"{packed.name} has its table of streams at byte {table}, wanted {start} or a little more")
    _read_extensions(packed, _taken(packed.name, stream, table - start))
    sizes = [packed.count * width for width in packed.widths]
    wanted = [size for size in sizes if size]
    rows = [_STREAM.unpack(_taken(packed.name, stream, _STREAM.size)) for _ in range(packed.streams)]
    if [row[1] for row in rows] != wanted:
        raise InputError(f"{packed.name} has streams of {[row[1] for row in rows]} bytes, wanted {wanted}")
    found = table + _STREAM.size * len(rows) + sum(row[0] for row in rows)
    if found != size:
        raise InputError(f"{packed.name} has {size:,} bytes, and its table says {found:,}")
    each = iter(rows)
    for part_size, width in zip(sizes, packed.widths, strict=True):
        data = np.empty(part_size, np.uint8)
        if part_size:
            whole = _taken(packed.name, stream, next(each)[0])
            with zstandard.ZstdDecompressor().stream_reader(whole, read_across_frames=True) as reader:
                _fill(packed.name, reader, data)
                if reader.read(1):
                    raise InputError(f"{packed.name} has a stream that unpacks to more than {part_size:,} bytes")
        packed.parts.append(data.reshape(packed.count, width))


def _read_extensions(packed: Packed, data: bytes) -> int:
    """Find the axes, skipping everything else. Return the number of bytes that extensions take."""
    at = 0
    while packed.flags & _EXTENDED and at + _RECORD.size <= len(data):
        kind, size = _RECORD.unpack_from(data, at)
        value = data[at + _RECORD.size : at + _RECORD.size + size]
        at += _RECORD.size + size
        if kind == _COORDINATE_SYSTEM and len(value) == 4:
            number = int.from_bytes(value, "little")
            packed.axes = _SYSTEMS[3 * number : 3 * number + 3]
            if not packed.axes:
                raise InputError(f"{packed.name} has axes number {number}, wanted at most {len(_SYSTEMS) // 3 - 1}")
    return at


def _taken(name: str, stream: BinaryIO, size: int) -> bytes:
    data = stream.read(size)
    if len(data) < size:
        raise InputError(f"{name} is no SPZ, or ends too early")
    return data


def _fill(name: str, stream: Any, data: U8) -> None:
    at = 0
    while at < len(data):
        got = stream.readinto(data[at : at + _PIECE])  # of all gzip would make a copy
        if not got:
            raise InputError(f"{name} ends too early: {at:,} of {len(data):,} bytes are there")
        at += got


def write_packed(path: Path, packed: Packed, room: U8) -> None:
    """Write version 3 or 4, without extensions.

    Args:
        path: of the file.
        packed: what it says.
        room: that of the parts, which are filled; takes the header, too.

    Raises:
        OSError: the file cannot be written.
    """
    there = [part for part in packed.parts if part.size] if packed.version > 3 else []
    head = _HEADER.pack(_MAGIC, packed.version, packed.count, packed.degree, packed.bits, packed.flags, len(there))
    with atomic_writer(path) as stream:
        if packed.version < 4:
            room[: len(head)] = np.frombuffer(head, np.uint8)
            stream.write(deflate.gzip_compress(room, _GZIP_LEVEL))
            return
        streams = [zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(part.data) for part in there]
        rows = [_STREAM.pack(len(small), part.size) for small, part in zip(streams, there, strict=True)]
        stream.writelines([head, _HEADER_REST.pack(_HEADER.size + _HEADER_REST.size), *rows, *streams])
