"""SPZ of Niantic and Adobe, versions 1 to 4: positions in fixed point, all else in bytes, attribute by attribute.

Its axes are right, up, back (https://github.com/nianticlabs/spz), unless an extension names others; some converters
put scenes into it as they stand, and no file says so.

Written is version 3, which more programs read than 4. Coefficients of SH get 6 bits each, where the owner's library
keeps 5 of band 1 and 4 of the others: on three scenes 36 to 38 % more bytes and 9 to 10 dB more; a seventh bit would be
18 % more for 2 to 4 dB, an eighth 16 % for 1. Positions get the usual 12 bits of fraction, more where splats are that
fine (all that fit would be up to 9 % more bytes, for 0.3 dB at best), fewer where the scene would not fit.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, cast

import deflate
import numpy as np
import zstandard
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.files import atomic_writer
from csplat.formats.format import Format
from csplat.model import F32, MAX_SH_DEGREE, SplatModel, normalise_quats
from csplat.scene import BLOCK, Scene
from csplat.turning import in_axes

__all__ = ["FORMAT", "write_spz"]

U8 = NDArray[np.uint8]

_AXES = "RUB"
_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_HEADER = struct.Struct("<4sIIBBBB")
_HEADER_REST = struct.Struct("<I12x")  # of version 4: where the table of streams begins
_STREAM = struct.Struct("<QQ")  # bytes packed, bytes unpacked
_RECORD = struct.Struct("<II")  # of an extension: type, bytes of its value
_ANTIALIASED, _EXTENDED, _LEVELS = 0x01, 0x02, 0x80
_COORDINATE_SYSTEM = 0xADBE0003  # the extension SPZ_ADOBE_coordinate_system
_SYSTEMS = "RUBLDBRDBLUBRUBLDFRDFLUFRUFLFDRFDLFURFULBDRBDLBURBU"  # by number, three letters each; 0 is unspecified
_EXTENSION_BYTES = 1 << 20  # at most
_MOST_BITS = 30  # of a fraction: readers compute 1 << bits in 32 bits
_RATIO = 1032  # of deflate, at most; programs of the format refuse more of Zstandard, too
_COLOUR = np.float32(0.15)  # what a coefficient is multiplied by, of the 256 levels
_LARGEST_POSITION = (1 << 23) - 1
_USUAL_BITS = 12
_STEPS = 32  # of positions, in the median of the standard deviations
_SH_STEP = 4  # of 256 levels
_GZIP_LEVEL, _ZSTD_LEVEL = 9, 12
_LARGEST = 2 * 511 * 511  # square of the length of a rotation whose parts are in units of sqrt(1/2) / 511


@dataclass(eq=False)
class _Packed:
    """A file as it lies in memory.

    Attributes:
        parts: [N, bytes] each: positions, alphas, colours, scales, rotations, SH.
    """

    name: str
    version: int
    count: int
    degree: int
    bits: int
    flags: int
    streams: int
    axes: str = _AXES
    parts: list[U8] = field(default_factory=list)

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes of a splat, by attribute."""
        rest = 3 * ((self.degree + 1) ** 2 - 1)
        return 6 if self.version == 1 else 9, 1, 3, 3, 4 if self.version > 2 else 3, rest

    @property
    def means_half(self) -> NDArray[np.float16]:
        """The positions of version 1."""
        return self.parts[0].view("<f2")


@contextmanager
def _open(path: Path) -> Iterator[Scene]:
    packed = _unpacked(path)
    yield Scene(packed.count, _decoded(packed, slice(0, 0)), lambda: _blocks(packed))


def write_spz(path: Path, scene: Scene, *, version: int) -> None:
    """Write version 3 or 4; the rest as `csplat.formats.format.Writer`."""
    scene = in_axes(scene, _AXES)
    packed = _Packed(path.name, version, scene.count, scene.facts.sh_degree, _fraction(path, scene), 0, 0)
    packed.flags = _ANTIALIASED if scene.facts.antialiased else 0
    packed.parts = [np.empty((scene.count, width), np.uint8) for width in packed.widths]
    start = 0
    for block in scene.blocks():
        rows = slice(start, start + len(block))
        for part, codes in zip(packed.parts, _encoded(block, packed.bits), strict=True):
            part[rows] = codes
        start = rows.stop
    head = _HEADER.pack(_MAGIC, version, packed.count, packed.degree, packed.bits, packed.flags, 0)
    if version < 4:
        data = bytes(deflate.gzip_compress(b"".join([head, *(part.tobytes() for part in packed.parts)]), _GZIP_LEVEL))
    else:
        data = _with_streams(head, packed.parts)
    with atomic_writer(path) as stream:
        stream.write(data)


def _blocks(packed: _Packed) -> Iterator[SplatModel]:
    for start in range(0, packed.count, BLOCK):
        yield _decoded(packed, slice(start, start + BLOCK))


def _unpacked(path: Path) -> _Packed:
    with path.open("rb") as stream:
        zipped = stream.read(2) == _GZIP
    try:
        with cast(BinaryIO, gzip.open(path) if zipped else path.open("rb")) as stream:
            packed = _header(path, stream)
            (_read_streams if packed.version == 4 else _read_arrays)(packed, path, stream)
    except (EOFError, zlib.error, zstandard.ZstdError, gzip.BadGzipFile) as error:
        raise InputError(f"{path.name} is damaged: {str(error) or 'it ends too early'}") from None
    if packed.version == 1 and not np.isfinite(packed.means_half).all():
        raise InputError(f"{path.name} has positions that are NaN or infinite")
    return packed


def _header(path: Path, stream: BinaryIO) -> _Packed:
    magic, version, count, degree, bits, flags, streams = _HEADER.unpack(_taken(path.name, stream, _HEADER.size))
    if magic != _MAGIC:
        raise InputError(f"{path.name} is no SPZ: it begins with {magic!r}, wanted {_MAGIC!r}")
    if not 1 <= version <= 4 or (version == 4 and isinstance(stream, gzip.GzipFile)):
        raise InputError(f"{path.name} is SPZ of version {version}, wanted 1 to 4 (4 not inside of gzip)")
    if degree > MAX_SH_DEGREE:
        raise InputError(f"{path.name} has SH degree {degree}, wanted at most {MAX_SH_DEGREE}")
    if version > 1 and bits > _MOST_BITS:
        raise InputError(f"{path.name} has {bits} fractional bits, wanted at most {_MOST_BITS}")
    if flags & _LEVELS:
        raise InputError(f"{path.name} holds levels of detail of Spark in one list, which csplat does not read")
    packed = _Packed(path.name, version, count, degree, bits, flags, streams)
    unpacked, size = count * sum(packed.widths), path.stat().st_size
    if unpacked > _RATIO * size:
        raise InputError(f"{path.name} says it has {count:,} splats, more than its {size:,} bytes can hold")
    return packed


def _read_arrays(packed: _Packed, path: Path, stream: BinaryIO) -> None:
    """Versions 1 to 3: one attribute after the other, then extensions."""
    data = np.empty(packed.count * sum(packed.widths), np.uint8)
    _fill(path.name, stream, data)
    ends = np.cumsum((0, *packed.widths)) * packed.count
    packed.parts = [
        data[start:end].reshape(packed.count, width)
        for (start, end), width in zip(pairwise(ends), packed.widths, strict=True)
    ]
    tail = stream.read(_EXTENSION_BYTES + 1)  # to the end, where gzip has its checksum
    if len(tail) > _EXTENSION_BYTES:
        raise InputError(f"{path.name} goes on after its last splat")
    _read_extensions(packed, tail)


def _read_streams(packed: _Packed, path: Path, stream: BinaryIO) -> None:
    """Version 4: extensions, a table, then each attribute packed by itself; those without bytes are left out."""
    (table,) = _HEADER_REST.unpack(_taken(path.name, stream, _HEADER_REST.size))
    start = _HEADER.size + _HEADER_REST.size
    if not start <= table <= start + _EXTENSION_BYTES:
        raise InputError(f"{path.name} has its table of streams at byte {table}, wanted {start} or a little more")
    _read_extensions(packed, _taken(path.name, stream, table - start))
    sizes = [packed.count * width for width in packed.widths]
    wanted = [size for size in sizes if size]
    rows = [_STREAM.unpack(_taken(path.name, stream, _STREAM.size)) for _ in range(packed.streams)]
    if [row[1] for row in rows] != wanted:
        raise InputError(f"{path.name} has streams of {[row[1] for row in rows]} bytes, wanted {wanted}")
    found, size = table + _STREAM.size * len(rows) + sum(row[0] for row in rows), path.stat().st_size
    if found != size:
        raise InputError(f"{path.name} has {size:,} bytes, and its table says {found:,}")
    each = iter(rows)
    for size, width in zip(sizes, packed.widths, strict=True):
        data = np.empty(size, np.uint8)
        if size:
            whole = _taken(path.name, stream, next(each)[0])
            with zstandard.ZstdDecompressor().stream_reader(whole, read_across_frames=True) as reader:
                _fill(path.name, reader, data)
                if reader.read(1):
                    raise InputError(f"{path.name} has a stream that unpacks to more than {size:,} bytes")
        packed.parts.append(data.reshape(packed.count, width))


def _read_extensions(packed: _Packed, data: bytes) -> None:
    """Find the axes; everything else is skipped."""
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


def _taken(name: str, stream: BinaryIO, size: int) -> bytes:
    data = stream.read(size)
    if len(data) < size:
        raise InputError(f"{name} ends too early")
    return data


def _fill(name: str, stream: Any, data: U8) -> None:
    at = 0
    while at < len(data):
        got = stream.readinto(data[at:])
        if not got:
            raise InputError(f"{name} ends too early: {at:,} of {len(data):,} bytes are there")
        at += got


def _decoded(packed: _Packed, rows: slice) -> SplatModel:
    _, alphas, colours, scales, rotations, rest = (part[rows] for part in packed.parts)
    shN = np.subtract(rest, 128, dtype=np.float32)
    shN *= np.float32(1 / 128)
    return SplatModel(
        means=_means(packed, rows),
        quats=(_smallest_three if packed.version > 2 else _first_three)(rotations),
        scales=np.divide(scales, 16, dtype=np.float32) - np.float32(10),
        opacities=np.divide(alphas[:, 0], 255, dtype=np.float32),
        sh0=(np.divide(colours, 255, dtype=np.float32) - np.float32(0.5)) / _COLOUR,
        shN=shN.reshape(len(rest), packed.widths[5] // 3, 3),
        coordinate_system=packed.axes,
        antialiased=bool(packed.flags & _ANTIALIASED),
    )


def _means(packed: _Packed, rows: slice) -> F32:
    if packed.version == 1:
        return packed.means_half[rows].astype(np.float32)
    part = packed.parts[0][rows]
    wide = np.zeros((len(part), 3, 4), np.uint8)
    wide[..., 1:] = part.reshape(-1, 3, 3)
    means = (wide.view("<i4")[..., 0] >> 8).astype(np.float32)
    means *= np.float32(2.0**-packed.bits)
    return means


def _first_three(rotations: U8) -> F32:
    """In bytes; w follows, and is not negative."""
    quats = np.empty((len(rotations), 4), np.float32)
    quats[:, 1:] = np.divide(rotations, 127.5, dtype=np.float32) - np.float32(1)
    quats[:, 0] = np.sqrt(np.maximum(0, 1 - np.einsum("ij,ij->i", quats[:, 1:], quats[:, 1:])))
    return normalise_quats(quats)


def _smallest_three(rotations: U8) -> F32:
    """All but the largest of x y z w in ten bits each, sign and magnitude, the first of them in the highest bits."""
    words = rotations.view("<u4")[:, 0]
    values = np.empty((len(words), 4), np.float32)
    squares = np.zeros(len(words), np.int32)
    for column, shift in enumerate((20, 10, 0)):
        part = (words >> np.uint32(shift)).astype(np.int32)
        size = part & 511
        squares += size * size
        values[:, column] = np.where(part & 512, -size, size)
    values[:, 3] = np.sqrt(np.maximum(0, _LARGEST - squares))
    # Where w x y z lie among the three and the largest, by which of x y z w that is.
    order = np.array([[2, 3, 0, 1], [2, 0, 3, 1], [2, 0, 1, 3], [3, 0, 1, 2]])[words >> np.uint32(30)]
    return normalise_quats(np.take_along_axis(values, order, axis=1))


def _with_streams(head: bytes, parts: list[U8]) -> bytes:
    there = [part.tobytes() for part in parts if part.size]
    streams = [zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(data) for data in there]
    rows = [_STREAM.pack(len(small), len(data)) for small, data in zip(streams, there, strict=True)]
    table = _HEADER_REST.pack(_HEADER.size + _HEADER_REST.size)
    return b"".join([head[:-1], bytes([len(streams)]), table, *rows, *streams])


def _fraction(path: Path, scene: Scene) -> int:
    """Bits for the fraction of positions: as many as the splats are fine, and no more than fit."""
    reach, scales = 0.0, np.zeros(256, np.int64)
    for block in scene.blocks():
        reach = max(reach, float(np.abs(block.means).max(initial=0.0)))
        scales += np.bincount(_scale_codes(block.scales).ravel(), minlength=256)
    if reach > _LARGEST_POSITION:
        raise InputError(f"{path.name}: positions reach {reach:,g}, and SPZ holds up to {_LARGEST_POSITION:,}")
    middle = int(np.searchsorted(np.cumsum(scales), scales.sum() / 2))
    fine = math.ceil(math.log2(_STEPS) - (middle / 16 - 10) / math.log(2))
    fitting = math.floor(math.log2(_LARGEST_POSITION / reach)) if reach > 2**-8 else _MOST_BITS
    return min(max(fine, _USUAL_BITS), fitting)


def _encoded(model: SplatModel, bits: int) -> tuple[U8, ...]:
    fixed = np.rint(model.means * np.float32(2.0**bits)).astype("<i4")
    rest = np.rint(model.shN * np.float32(128 / _SH_STEP)) * np.float32(_SH_STEP) + np.float32(128)
    return (
        fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3].reshape(-1, 9),
        _bytes(model.opacities[:, None] * np.float32(255)),
        _bytes(model.sh0 * (_COLOUR * np.float32(255)) + np.float32(127.5)),
        _scale_codes(model.scales),
        _three_of(model.quats),
        _bytes(rest).reshape(len(model), 3 * model.shN.shape[1]),
    )


def _scale_codes(scales: F32) -> U8:
    return _bytes(scales * np.float32(16) + np.float32(160))


def _bytes(values: F32) -> U8:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _three_of(quats: F32) -> U8:
    """The inverse of `_smallest_three`."""
    xyzw = quats[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(axis=1)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    sign = np.sign(np.take_along_axis(xyzw, largest[:, None], axis=1))
    three = np.rint(np.take_along_axis(xyzw, others, axis=1) * sign * np.float32(math.sqrt(_LARGEST)))
    fields = np.minimum(np.abs(three), 511).astype("<u4") | np.where(three < 0, np.uint32(512), np.uint32(0))
    words: NDArray[np.uint32] = largest.astype("<u4") << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return words[:, None].view(np.uint8)


def _is_spz(_path: Path, head: bytes) -> bool:
    if head[:2] == _GZIP:
        try:
            head = zlib.decompressobj(wbits=31).decompress(head, len(_MAGIC))
        except zlib.error:
            return False
    return head[:4] == _MAGIC


FORMAT = Format(
    name="spz",
    title="SPZ",
    suffixes=(".spz",),
    sniff=_is_spz,
    open=_open,
    write=partial(write_spz, version=3),
    axes=_AXES,
    carries=frozenset({"antialiased"}),
)
