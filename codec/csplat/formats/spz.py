# SPDX-License-Identifier: Apache-2.0
"""SPZ of Niantic and Adobe, versions 1 to 4: fixed-point positions, bytes for the rest, attribute by attribute.

Versions 1 to 3 are a single gzip stream, version 4 has a Zstandard stream per attribute. The axes are right, up, back
(https://github.com/nianticlabs/spz) unless an extension specifies others. Some converters store scenes along other axes
without this extension.

The writer produces version 3, which more programs read, or version 4. SH coefficients get 6 bits each; with the preset
"small" they get 5 in band 1 and 4 in the others, as in Niantic's library. On three scenes, 6 bits cost 36 to 38 % more
bytes and gain 9 to 10 dB; a seventh bit would cost 18 % more for 2 to 4 dB, an eighth 16 % for 1 dB. Positions get the
usual 12 fractional bits, more for fine splats unless the preset is "small" (the maximum would cost up to 9 % more bytes
for 0.3 dB at best), fewer if the scene would not fit.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, cast

import deflate
import numpy as np
import zstandard
from numpy.typing import NDArray

from csplat.archives import unpacked_limit
from csplat.disk_files import atomic_writer
from csplat.editing.transform import convert_axes
from csplat.errors import InputError, counted
from csplat.file_source import open_binary
from csplat.formats.common import MovedSplats, decode_smallest_three, encode_smallest_three, round_to_bytes
from csplat.formats.format import Format, ValueRange
from csplat.lint import Finding, other_contents, trailing_bytes
from csplat.model import MAX_SH_DEGREE, SplatModel, normalise_quats
from csplat.scene import BLOCK_SPLATS, Scene
from csplat.scene_metadata import SceneMetadata
from csplat.types import F32, U8

#: Directions of +x, +y and +z: right, up, back.
SPZ_AXES = "RUB"

#: Bit of `SpzArrays.flags`.
ANTIALIASED = 0x01

#: Maximum number of fractional bits: readers compute 1 << bits in 32 bits.
MAX_FRACTION_BITS = 30

_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_HEADER = struct.Struct("<4sIIBBBB")
_HEADER_REST = struct.Struct("<I12s")  # version 4: offset of the table of streams, reserved
_STREAM = struct.Struct("<QQ")  # entry of that table: packed size, unpacked size
_RECORD = struct.Struct("<II")  # head of an extension: type, size of its value
_EXTENDED, _LEVELS = 0x02, 0x80
_FLAGS = {ANTIALIASED, _EXTENDED, _LEVELS}
_COORDINATE_SYSTEM = 0xADBE0003  # the extension SPZ_ADOBE_coordinate_system
_EXTENSION_NAMES = {0xADBE0002: "SPZ_ADOBE_safe_orbit_camera"}  # extensions that are not read
_SYSTEMS = "RUBLDBRDBLUBRUBLDFRDFLUFRUFLFDRFDLFURFULBDRBDLBURBU"  # three letters per number; 0 is unspecified
_EXTENSION_BYTES = 1 << 20  # maximum size of all extensions together
_RATIO = 1032  # maximum expansion by deflate; SPZ programs refuse more from Zstandard, too
_GZIP_LEVEL, _ZSTD_LEVEL = 9, 12
_PIECE = 1 << 18  # bytes unpacked at a time


@dataclass(eq=False)
class SpzArrays:
    """The header and the byte arrays of a file.

    Attributes:
        name: name of the file, for messages.
        version: 1 to 4.
        count: N.
        degree: SH degree, 0 to 4.
        bits: fractional bits of positions.
        flags: `ANTIALIASED` and others.
        streams: number of streams that a header of version 4 declares.
        axes: three letters, as in `SplatModel`.
        parts: positions, alphas, colours, scales, rotations and SH, each [N, bytes].
        findings: findings about the file.
        unread: contents that are left out, in a few words each.
    """

    name: str
    version: int
    count: int
    degree: int
    bits: int
    flags: int
    streams: int = 0
    axes: str = SPZ_AXES
    parts: list[U8] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    unread: list[str] = field(default_factory=list)

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes per splat of each attribute."""
        rest = 3 * ((self.degree + 1) ** 2 - 1)
        return 6 if self.version == 1 else 9, 1, 3, 3, 4 if self.version > 2 else 3, rest

    def allocate(self) -> U8:
        """Allocate the parts contiguously after space for the header, as in versions 1 to 3; return the whole array."""
        ends = _HEADER.size + np.cumsum((0, *self.widths)) * self.count
        data = np.empty(ends[-1], np.uint8)
        self.parts = [
            data[start:end].reshape(self.count, width)
            for (start, end), width in zip(pairwise(ends), self.widths, strict=True)
        ]
        return data

    @property
    def means_half(self) -> NDArray[np.float16]:
        """Positions of version 1."""
        return self.parts[0].view("<f2")


def read_spz_file(file: BinaryIO, name: str, size: int) -> SpzArrays:
    """Check and unpack a file.

    Args:
        file: the file, positioned at its beginning.
        name: name of the file, for messages.
        size: bytes of the file.

    Raises:
        InputError: the file is incomplete, or csplat does not read its version.
        OSError: the file cannot be read.
    """
    zipped = file.read(2) == _GZIP
    file.seek(0)
    try:
        with cast(BinaryIO, gzip.open(file)) if zipped else nullcontext(file) as stream:
            packed = _parse_header(name, size, stream)
            (_read_streams if packed.version == 4 else _read_arrays)(packed, size, stream)
    except (EOFError, zlib.error, zstandard.ZstdError, gzip.BadGzipFile) as error:
        raise InputError(f"{name} is damaged: {str(error) or 'it is truncated'}") from None
    packed.findings += other_contents(packed.unread)
    if packed.version == 1 and not np.isfinite(packed.means_half).all():
        raise InputError(f"{name} has positions that are NaN or infinite")
    return packed


def _parse_header(name: str, size: int, stream: BinaryIO) -> SpzArrays:
    """Read the header.

    Args:
        name: name of the file, for messages.
        size: bytes of the file, which limit the number of splats.
        stream: the unpacked bytes, at their beginning.

    Raises:
        InputError: the file is not SPZ, has contents that csplat does not read, or too many splats for its size.
    """
    magic, version, count, degree, bits, flags, streams = _HEADER.unpack(_read_exactly(name, stream, _HEADER.size))
    if magic != _MAGIC:
        raise InputError(f"{name} is not SPZ: it begins with {magic!r}, expected {_MAGIC!r}")
    if not 1 <= version <= 4 or (version == 4 and isinstance(stream, gzip.GzipFile)):
        raise InputError(f"{name} is SPZ of version {version}, expected 1 to 4 (4 not within gzip)")
    if degree > MAX_SH_DEGREE:
        raise InputError(f"{name} has SH degree {degree}, expected at most {MAX_SH_DEGREE}")
    if version > 1 and bits > MAX_FRACTION_BITS:
        raise InputError(f"{name} has {bits} fractional bits, expected at most {MAX_FRACTION_BITS}")
    if flags & _LEVELS:
        raise InputError(f"{name} contains Spark's levels of detail in one list, which csplat does not read")
    packed = SpzArrays(name, version, count, degree, bits, flags, streams)
    rest = {f"flag 0x{bit:02x}": flags & bit for bit in (1 << n for n in range(8)) if bit not in _FLAGS}
    rest |= {"the reserved byte of the header": version < 4 and streams}
    packed.unread += [what for what, is_there in rest.items() if is_there]
    unpacked = count * sum(packed.widths)
    allowed = min(_RATIO * size, unpacked_limit(size))
    if unpacked > allowed:
        reason = f"too many for its {size:,} bytes: they unpack to {unpacked:,}, allowed {allowed:,}"
        raise InputError(f"{name} declares {count:,} splats, {reason}")
    return packed


def _read_arrays(packed: SpzArrays, _size: int, stream: BinaryIO) -> None:
    """Read versions 1 to 3 after the header into `parts` of `packed`, and the extensions that follow.

    Raises:
        InputError: the stream ends early, or too many bytes follow the attributes.
    """
    _read_into(packed.name, stream, packed.allocate()[_HEADER.size :])
    tail = stream.read(_EXTENSION_BYTES + 1)  # up to the end, where gzip verifies its checksum
    if len(tail) > _EXTENSION_BYTES:
        raise InputError(f"{packed.name} has more than {_EXTENSION_BYTES:,} bytes after its last splat")
    packed.findings += trailing_bytes(len(tail) - _read_extensions(packed, tail))


def _read_streams(packed: SpzArrays, size: int, stream: BinaryIO) -> None:
    """Read version 4 after its header: extensions, a table, then a stream for each attribute that is not empty.

    Sets `axes` and `parts` of `packed`; `size` is the size of the file in bytes.

    Raises:
        InputError: the file is truncated, or its table contradicts the header or the size.
    """
    table, reserved = _HEADER_REST.unpack(_read_exactly(packed.name, stream, _HEADER_REST.size))
    packed.unread += ["the reserved bytes of the header"] if any(reserved) else []
    start = _HEADER.size + _HEADER_REST.size
    if not start <= table <= start + _EXTENSION_BYTES:
        raise InputError(
            f"{packed.name} has its table of streams at byte {table}, expected {start} to {start + _EXTENSION_BYTES}"
        )
    rest = table - start - _read_extensions(packed, _read_exactly(packed.name, stream, table - start))
    packed.unread += [f"{counted(rest, 'byte')} before the table of streams"] if rest > 0 else []
    sizes = [packed.count * width for width in packed.widths]
    stream_sizes = [part_size for part_size in sizes if part_size]
    rows = [_STREAM.unpack(_read_exactly(packed.name, stream, _STREAM.size)) for _ in range(packed.streams)]
    if [row[1] for row in rows] != stream_sizes:
        raise InputError(f"{packed.name} has streams of {[row[1] for row in rows]} bytes, expected {stream_sizes}")
    declared_size = table + _STREAM.size * len(rows) + sum(row[0] for row in rows)
    if declared_size != size:
        raise InputError(f"{packed.name} has {size:,} bytes, its table declares {declared_size:,}")
    row_iterator = iter(rows)
    for part_size, width in zip(sizes, packed.widths, strict=True):
        data = np.empty(part_size, np.uint8)
        if part_size:
            coded = _read_exactly(packed.name, stream, next(row_iterator)[0])
            with zstandard.ZstdDecompressor().stream_reader(coded, read_across_frames=True) as reader:
                _read_into(packed.name, reader, data)
                if reader.read(1):
                    raise InputError(f"{packed.name} has a stream that unpacks to more than {part_size:,} bytes")
        packed.parts.append(data.reshape(packed.count, width))


def _read_extensions(packed: SpzArrays, data: bytes) -> int:
    """Set `axes` of `packed`, note other extensions, and return the size of all extensions in bytes."""
    at = 0
    while packed.flags & _EXTENDED and at + _RECORD.size <= len(data):
        kind, size = _RECORD.unpack_from(data, at)
        value = data[at + _RECORD.size : at + _RECORD.size + size]
        at += _RECORD.size + size
        if kind == _COORDINATE_SYSTEM and len(value) == 4:
            number = int.from_bytes(value, "little")
            packed.axes = _SYSTEMS[3 * number : 3 * number + 3]
            if not packed.axes:
                raise InputError(f"{packed.name} has axes number {number}, expected at most {len(_SYSTEMS) // 3 - 1}")
        else:
            packed.unread.append(f"extension {_EXTENSION_NAMES.get(kind, f'0x{kind:08X}')} ({counted(size, 'byte')})")
    return at


def _read_exactly(name: str, stream: BinaryIO, size: int) -> bytes:
    """Read `size` bytes; raise an `InputError` if the stream ends before."""
    data = stream.read(size)
    if len(data) < size:
        raise InputError(f"{name} is not SPZ, or is truncated")
    return data


def _read_into(name: str, stream: Any, data: U8) -> None:
    """Read as many bytes as `data` has into it; raise an `InputError` if the stream ends before."""
    at = 0
    while at < len(data):
        byte_count = stream.readinto(data[at : at + _PIECE])  # in pieces, because gzip copies each read
        if not byte_count:
            raise InputError(f"{name} is truncated: {at:,} of {len(data):,} bytes are present")
        at += byte_count


_COLOUR = np.float32(0.15)  # colour per unit of an SH coefficient of degree 0
_MAGNITUDE_MAX, _SIGN = 511, 512  # the nine lower bits of a quaternion component, and its sign bit
_PART = np.sqrt(np.float32(0.5)) / np.float32(_MAGNITUDE_MAX)  # quantisation step of a quaternion component
_LARGEST_POSITION = (1 << 23) - 1
_USUAL_BITS = 12
_SMALL_REACH = 2**-8  # scene units; positions up to this fit with `MAX_FRACTION_BITS`
_STEPS = 32  # minimum number of position steps within the median standard deviation
_SH_STEPS = (4, 4, 4, 4)  # quantisation steps of the SH bands from 1 on, in units of the 256 levels
_SMALL_SH_STEPS = (8, 16, 16, 16)


@contextmanager
def _open(path: Path, sh_degree: int | None = None) -> Iterator[Scene]:
    """Open a file (`Format.open`, `Format.open_bands`)."""
    with open_binary(path) as file:
        packed = read_spz_file(file, path.name, path.stat().st_size)
    degree = packed.degree if sh_degree is None else min(packed.degree, sh_degree)

    def blocks() -> Iterator[SplatModel]:
        for start in range(0, packed.count, BLOCK_SPLATS):
            yield decode_block(packed, slice(start, start + BLOCK_SPLATS), degree)

    yield Scene.like(decode_block(packed, slice(0, 0), degree), packed.count, blocks, packed.findings)


def write_spz(path: Path, scene: Scene, *, version: int, small: bool = False) -> list[Finding]:
    """Write version 3 or 4, without extensions (`Format.write`); `small`: with the preset of this name."""
    scene = convert_axes(scene, SPZ_AXES)
    degree, bits = scene.sh_degree, _choose_fraction_bits(path, scene, _USUAL_BITS if small else MAX_FRACTION_BITS)
    steps = np.repeat(_SMALL_SH_STEPS if small else _SH_STEPS, [3, 5, 7, 9]).astype(np.float32)[:, None]
    flags = ANTIALIASED if scene.metadata.antialiased else 0
    packed = SpzArrays(path.name, version, scene.count, degree, bits, flags)
    data, moved = packed.allocate(), MovedSplats()
    for rows, block in scene.numbered():
        moved.add(block, np.rint(block.means * np.float32(2.0**bits)) * 2.0**-bits)
        for part, codes in zip(packed.parts, _encode_block(block, bits, steps), strict=True):
            part[rows] = codes
    parts = [part for part in packed.parts if part.size] if version > 3 else []
    head = _HEADER.pack(_MAGIC, version, scene.count, degree, bits, flags, len(parts))
    reason = f"SPZ has 24 bits for positions, and the farthest splat leaves {bits} of them for fractions"
    with atomic_writer(path) as stream:
        if version < 4:
            data[: len(head)] = np.frombuffer(head, np.uint8)
            stream.write(deflate.gzip_compress(data, _GZIP_LEVEL))
            return moved.findings(reason)
        streams = [zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(part.data) for part in parts]
        table = [_STREAM.pack(len(small), part.size) for small, part in zip(streams, parts, strict=True)]
        stream.writelines([head, _HEADER_REST.pack(_HEADER.size + _HEADER_REST.size, b""), *table, *streams])
    return moved.findings(reason)


def decode_block(packed: SpzArrays, rows: slice, degree: int) -> SplatModel:
    """Decode some splats along the axes of the file, with SH bands up to a degree."""
    _, alphas, colours, scales, rotations, rest = (part[rows] for part in packed.parts)
    coefficients = (degree + 1) ** 2 - 1
    shN = np.subtract(rest[:, : 3 * coefficients], 128, dtype=np.float32)
    shN *= np.float32(1 / 128)
    return SplatModel(
        means=decode_means(packed, rows),
        quats=(_decode_rotations if packed.version > 2 else _decode_first_three)(rotations),
        scales=np.divide(scales, 16, dtype=np.float32) - np.float32(10),
        opacities=np.divide(alphas[:, 0], 255, dtype=np.float32),
        sh0=(np.divide(colours, 255, dtype=np.float32) - np.float32(0.5)) / _COLOUR,
        shN=shN.reshape(len(rest), coefficients, 3),
        metadata=SceneMetadata(
            coordinate_system=packed.axes, antialiased=bool(packed.flags & ANTIALIASED), quantised=True
        ),
    )


def decode_means(packed: SpzArrays, rows: slice) -> F32:
    """Decode the positions of some splats along the axes of the file."""
    if packed.version == 1:
        return packed.means_half[rows].astype(np.float32)
    part = packed.parts[0][rows]
    wide = np.zeros((len(part), 3, 4), np.uint8)
    wide[..., 1:] = part.reshape(-1, 3, 3)
    means = (wide.view("<i4")[..., 0] >> 8).astype(np.float32)
    means *= np.float32(2.0**-packed.bits)
    return means


def _decode_first_three(rotations: U8) -> F32:
    """Decode rotations [N, 3] of versions 1 and 2 to wxyz: x, y and z are bytes, w >= 0 follows from them."""
    quats = np.empty((len(rotations), 4), np.float32)
    quats[:, 1:] = np.divide(rotations, 127.5, dtype=np.float32) - np.float32(1)
    quats[:, 0] = np.sqrt(np.maximum(0, 1 - np.square(quats[:, 1:]).sum(axis=1)))
    return normalise_quats(quats)


def _decode_rotations(rotations: U8) -> F32:
    """Decode [N, 4] bytes to wxyz: the three smallest components have ten bits each, the first the highest."""
    words = rotations.view("<u4")[:, 0]
    fields = (words[:, None] >> np.array([20, 10, 0], np.uint32)).astype(np.int32)
    sizes = fields & _MAGNITUDE_MAX
    xyzw = decode_smallest_three(words >> np.uint32(30), np.where(fields & _SIGN, -sizes, sizes) * _PART)
    return xyzw[:, [3, 0, 1, 2]]


def _choose_fraction_bits(path: Path, scene: Scene, most: int) -> int:
    """Choose the fractional bits of positions: enough for the median splat, at most `most` and what the extent allows.

    Raises:
        InputError: a position exceeds the range of SPZ.
    """
    reach, scales = 0.0, np.zeros(256, np.int64)
    for block in scene.blocks():
        reach = max(reach, float(np.abs(block.means).max(initial=0.0)))
        scales += np.bincount(_scale_codes(block.scales).ravel(), minlength=256)
    if reach > _LARGEST_POSITION:
        raise InputError(
            f"{path.name}: positions reach {reach:,g}, SPZ stores up to {_LARGEST_POSITION:,}:"
            " --drop-floaters drops splats far from all others, or write another format"
        )
    middle = int(np.searchsorted(np.cumsum(scales), scales.sum() / 2))
    median_log = middle / 16 - 10  # the inverse of `_scale_codes`
    fine = math.ceil(math.log2(_STEPS) - median_log / math.log(2))
    fitting = math.floor(math.log2(_LARGEST_POSITION / reach)) if reach > _SMALL_REACH else MAX_FRACTION_BITS
    return min(max(fine, _USUAL_BITS), fitting, most)


def _encode_block(model: SplatModel, bits: int, sh_steps: F32) -> tuple[U8, ...]:
    """Encode splats to bytes, [n, width] per attribute, in the order of the file.

    Args:
        model: the splats.
        bits: fractional bits of positions.
        sh_steps: [24, 1], step of each SH coefficient, in units of the 256 levels.
    """
    fixed = np.rint(model.means * np.float32(2.0**bits)).astype("<i4")
    steps = sh_steps[: model.shN.shape[1]]
    rest = np.rint(model.shN * (np.float32(128) / steps)) * steps + np.float32(128)
    return (
        fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3].reshape(-1, 9),
        round_to_bytes(model.opacities[:, None] * np.float32(255)),
        round_to_bytes(model.sh0 * (_COLOUR * np.float32(255)) + np.float32(127.5)),
        _scale_codes(model.scales),
        _encode_rotations(model.quats),
        round_to_bytes(rest).reshape(len(model), 3 * model.shN.shape[1]),
    )


def _scale_codes(scales: F32) -> U8:
    """Encode log scales in steps of 1/16 from -10, clamped to bytes."""
    return round_to_bytes(scales * np.float32(16) + np.float32(160))


def _encode_rotations(quats: F32) -> U8:
    """Invert `_decode_rotations`: quats [N, 4] to bytes [N, 4]."""
    largest, three = encode_smallest_three(quats[:, [1, 2, 3, 0]])
    steps = np.rint(three / _PART)
    signs = np.where(steps < 0, np.uint32(_SIGN), np.uint32(0))
    fields = np.minimum(np.abs(steps), _MAGNITUDE_MAX).astype(np.uint32) | signs
    words: NDArray[np.uint32] = largest.astype("<u4") << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return words[:, None].view(np.uint8)


def _format(name: str, version: int, degree: int, splat_bytes: tuple[float, ...], *, small: bool) -> Format:
    """Return the format of a version, at the precision of "balanced" or "small".

    Args:
        name: name of the format.
        version: version that it writes.
        degree: highest SH degree.
        splat_bytes: as in `Format`.
        small: True for the preset of this name.
    """
    return Format(
        name=name,
        open=_open,
        open_bands=_open,
        write=partial(write_spz, version=version, small=small),
        degree=degree,
        axes=SPZ_AXES,
        ranges={
            "scales": ValueRange(-10.0, 5.9375, 1 / 16),
            "sh0": ValueRange(-0.5 / 0.15, 0.5 / 0.15, 1 / (255 * 0.15)),
            "shN": ValueRange(-1.0, 127 / 128, (_SMALL_SH_STEPS if small else _SH_STEPS)[0] / 128),
        },
        splat_bytes=splat_bytes[: degree + 1],
        carries=frozenset({"antialiased"}),
    )


_SPLAT_BYTES, _SMALL_SPLAT_BYTES = (16.5, 19.3, 23.9, 29.7, 36.2), (16.5, 18.5, 19.8, 20.7, 22.0)

FORMAT, FORMAT_4 = (
    replace(
        _format(name, version, degree, _SPLAT_BYTES, small=False),
        presets={"small": _format(name, version, degree, _SMALL_SPLAT_BYTES, small=True)},
    )
    for name, version, degree in (("spz", 3, 3), ("spz4", 4, 4))  # older readers of version 3 refuse degree 4
)
