# SPDX-License-Identifier: Apache-2.0
"""PlayCanvas' compressed PLY: attributes packed into words, relative to the bounds of chunks of 256 splats.

Follows `decompress-ply.ts` and `compressed-chunk.ts` of splat-transform (MIT). Metadata is stored in header comments,
as in a plain PLY.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import atomic_writer, work_folder
from csplat.errors import InputError, counted
from csplat.file_source import open_binary
from csplat.formats.common import (
    MovedSplats,
    crossed_bounds,
    decode_smallest_three,
    encode_smallest_three,
    sorted_shells,
)
from csplat.formats.format import Format, ValueRange
from csplat.lint import Finding, list_names, other_contents, trailing_bytes
from csplat.model import SplatModel
from csplat.ply.comments import format_comments, parse_comments, unwritten_entries
from csplat.ply.ply_header import read_ply_header
from csplat.scene import BLOCK_SPLATS, Scene
from csplat.spherical_harmonics import SH_C0
from csplat.types import F32, U8, U32

_CHUNK = 256  # splats that share bounds
_LARGEST_LOG = 20.0  # log scales are clipped to ± this: a larger scale would use up the precision of its chunk
_LARGEST_BOUND = 9e37  # largest colour bound: a coefficient is 3.5 times that, and float32 ends at 3.4e38
_COUNT_DIGITS = 18  # most digits of a row count, which then fits in 64 bits
_BANDS = (9, 24, 45, 72)  # number of SH columns by degree, 1 to 4
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
_BOUNDS = [f"{end}_{kind}{axis}" for kind in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
_COLOUR_BOUNDS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
_PACKED_COLUMNS = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


@dataclass(frozen=True)
class _Element:
    """The rows of a PLY element: file offset, count and type."""

    offset: int
    count: int
    dtype: np.dtype[Any]

    def read(self, path: Path, start: int, stop: int) -> NDArray[Any]:
        """Read the rows from `start` to `stop`; raise an `InputError` if the file became shorter."""
        with open_binary(path) as stream:
            stream.seek(self.offset + start * self.dtype.itemsize)
            rows = np.fromfile(stream, self.dtype, stop - start)
        if len(rows) != stop - start:
            raise InputError(f"{path.name} became shorter while it was read")
        return rows


@contextmanager
def _open(path: Path) -> Iterator[Scene]:
    """Open a file (`Format.open`).

    Raises:
        InputError: the file is not a complete compressed PLY, or its bounds are not finite or crossed.
    """
    elements, comments, findings = _parse_header(path)
    chunk, vertex, sh = (elements.get(name) for name in ("chunk", "vertex", "sh"))
    if chunk is None or vertex is None:
        raise InputError(f"{path.name} has no element {'chunk' if chunk is None else 'vertex'}: not a compressed PLY")
    _check_columns(path, "vertex", vertex, _PACKED_COLUMNS, "<u4")
    coloured = "min_r" in (chunk.dtype.names or ())
    names = _BOUNDS + (_COLOUR_BOUNDS if coloured else [])
    _check_columns(path, "chunk", chunk, names, "<f4")
    if chunk.count != -(-vertex.count // _CHUNK):
        raise InputError(
            f"{path.name}: {counted(chunk.count, 'chunk')} for {counted(vertex.count, 'splat')},"
            f" expected one per {_CHUNK}"
        )
    coefficient_count = 0  # per channel
    if sh is not None and not sh.dtype.names:  # gsplat writes the element without SH, too
        sh = None
    if sh is not None:
        column_count = len(sh.dtype.names or ())
        if sh.count != vertex.count or column_count not in _BANDS:
            raise InputError(
                f"{path.name}: {counted(sh.count, 'row')} of {column_count} SH coefficients for"
                f" {counted(vertex.count, 'splat')}, expected one row of 9, 24, 45 or 72 per splat"
            )
        _check_columns(path, "sh", sh, [f"f_rest_{index}" for index in range(column_count)], "u1")
        coefficient_count = column_count // 3
    bounds = _read_bounds(path, chunk, names)
    try:
        parsed = parse_comments(comments)
        empty = SplatModel(
            **_unpack(np.zeros(0, vertex.dtype), bounds[:0], None, coefficient_count),
            origin=parsed.origin or (0.0, 0.0, 0.0),
            metadata=parsed.metadata,
        )
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None

    def blocks() -> Iterator[SplatModel]:
        for start in range(0, vertex.count, BLOCK_SPLATS):
            stop = min(start + BLOCK_SPLATS, vertex.count)
            coefficients = None if sh is None else sh.read(path, start, stop)
            words = vertex.read(path, start, stop)
            chunk_bounds = bounds[start // _CHUNK : -(-stop // _CHUNK)]
            yield replace(empty, **_unpack(words, chunk_bounds, coefficients, coefficient_count))

    yield Scene.like(empty, vertex.count, blocks, [*findings, *parsed.findings])


def _read_bounds(path: Path, chunk: _Element, names: Sequence[str]) -> NDArray[np.float64]:
    """Return the bounds of the chunks, [C, kinds, 2, 3]: kind of attribute, lower and upper end, axis.

    Args:
        path: path of the file.
        chunk: the element of the chunks.
        names: its columns in this order, six per kind.

    Raises:
        InputError: a bound is not finite, or a lower bound is above its upper bound.
    """
    table = chunk.read(path, 0, chunk.count)
    with np.errstate(invalid="ignore"):  # signalling NaNs are refused below
        columns = np.stack([table[name] for name in names], 1).astype(np.float64)
    bounds = columns.reshape(chunk.count, len(names) // 6, 2, 3)
    names_of = np.reshape(names, bounds.shape[1:])
    not_finite = np.argwhere(~(np.abs(bounds) < _LARGEST_BOUND))
    if len(not_finite):
        row, kind, end, axis = not_finite[0]
        raise InputError(f"{path.name}: {names_of[kind, end, axis]} of chunk {row} is not finite")
    crossed = np.argwhere(crossed_bounds(bounds[:, :, 0], bounds[:, :, 1]))
    if len(crossed):
        row, kind, axis = crossed[0]
        low, high = (f"{names_of[kind, end, axis]} {bounds[row, kind, end, axis]:.6g}" for end in (0, 1))
        raise InputError(f"{path.name}: chunk {row} has {low}, expected at most {high}")
    return bounds


def _parse_header(path: Path) -> tuple[dict[str, _Element], list[str], list[Finding]]:
    """Return the elements, the comments and findings, after checking that the file has all rows."""
    findings: list[Finding] = []
    header = read_ply_header(path, findings, "compressed-ply")
    findings = [finding for finding in findings if finding.repairable]  # row counts are checked below
    lines = [line.strip() for line in header.text.decode("ascii").splitlines()[:-1]]
    declared: list[tuple[str, int, list[tuple[str, str]]]] = []
    form = ""  # format named in the header
    for line in lines[1:]:
        words = line.split()
        if words[:1] == ["format"]:
            form = " ".join(words[1:])
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal() and len(words[2]) <= _COUNT_DIGITS:
            declared.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and len(words) == 3 and words[1] in _TYPES and declared:
            declared[-1][2].append((words[2], _TYPES[words[1]]))
        elif words and words[0] not in ("comment", "obj_info"):
            raise InputError(f"{path.name}: the header line {line[:80]!r} is not valid in a compressed PLY")
    if form != "binary_little_endian 1.0":
        raise InputError(f"{path.name}: the format is {form[:40]!r}, expected binary_little_endian 1.0")
    elements: dict[str, _Element] = {}
    offset, size = header.end, path.stat().st_size
    for name, count, columns in declared:
        if len({column for column, _ in columns}) != len(columns) or name in elements:
            raise InputError(f"{path.name}: the header declares {name} or one of its columns twice")
        elements[name] = _Element(offset, count, np.dtype(columns))
        offset += count * elements[name].dtype.itemsize
    if offset > size:
        raise InputError(f"{path.name} has {size:,} bytes, its header declares {offset:,}: copy or download it again")
    return elements, header.comments, findings + _other_findings(elements) + trailing_bytes(size - offset)


def _other_findings(elements: Mapping[str, _Element]) -> list[Finding]:
    """Return the findings about elements and columns that are not read."""
    read = {"chunk": {*_BOUNDS, *_COLOUR_BOUNDS}, "vertex": {*_PACKED_COLUMNS}}
    if "sh" in elements:
        read["sh"] = {*(elements["sh"].dtype.names or ())}  # others are refused
    others = [name for name, element in elements.items() if name not in read and element.count and element.dtype.names]
    columns = [
        f"{column} of {name}"
        for name, element in elements.items()
        if name in read and element.count
        for column in element.dtype.names or ()
        if column not in read[name]
    ]
    findings = other_contents([f"elements {list_names(others)}"] if others else [])
    if columns:
        lost = f"columns {list_names(columns)}"
        findings.append(Finding("extra-columns", len(columns), f"{lost}: dropped", "note", lost=(lost,)))
    return findings


def _check_columns(path: Path, name: str, element: _Element, wanted: list[str], kind: str) -> None:
    """Raise an `InputError` unless an element has all wanted columns, of the NumPy type `kind`."""
    fields: Any = element.dtype.fields or {}
    for column in wanted:
        if column not in fields or fields[column][0] != np.dtype(kind):
            raise InputError(f"{path.name}: {name} has no {np.dtype(kind).name} {column}: not a compressed PLY")


def _unpack(words: NDArray[Any], bounds: NDArray[Any], sh: NDArray[Any] | None, kept: int) -> dict[str, Any]:
    """Decode the arrays of a model.

    Args:
        words: [N] packed words of the splats.
        bounds: [C, 2 or 3, 2, 3], lower and upper bounds per chunk of means, scales and, if stored, colours.
        sh: [N] rows of SH coefficients; `None` if the file has none.
        kept: number of coefficients per channel to decode.
    """
    count = len(words)

    def between(fractions: NDArray[np.float64], kind: int) -> NDArray[np.float64]:
        return _between(fractions, bounds[:, kind])

    rotation, colour = (words[name] for name in ("packed_rotation", "packed_color"))
    three = np.stack([(rotation >> shift & 1023) for shift in (20, 10, 0)], 1).astype(np.float32)
    channels = np.stack([colour >> shift & 255 for shift in (24, 16, 8)], 1) / 255.0
    if bounds.shape[1] == 3:
        channels = between(channels, 2)
    shN = np.zeros((count, kept, 3), np.float32)
    if sh is not None and kept:
        names = sh.dtype.names or ()
        codes = sh.view(np.uint8).reshape(count, len(names))  # all columns are bytes, without gaps
        channel_size = len(names) // 3
        columns = [
            names.index(f"f_rest_{channel * channel_size + index}") for channel in range(3) for index in range(kept)
        ]
        shN = _sh_values()[codes[:, columns].reshape(count, 3, -1).transpose(0, 2, 1)]
    return {
        "means": _unpack_means(words["packed_position"], bounds[:, 0]).astype(np.float32),
        "scales": between(_split_words(words["packed_scale"]), 1).astype(np.float32),
        "quats": decode_smallest_three(
            rotation >> 30, (three / np.float32(1023) - np.float32(0.5)) * np.float32(2**0.5)
        ),
        "opacities": ((colour & 255) / 255.0).astype(np.float32),
        "sh0": ((channels - 0.5) / SH_C0).astype(np.float32),
        "shN": np.ascontiguousarray(shN),
    }


def _between(fractions: NDArray[np.float64], bounds: NDArray[Any]) -> NDArray[np.float64]:
    """Return values [N, 3] for fractions of the bounds of their chunks, [C, 2, 3]."""
    low, high = (np.repeat(bounds[:, end].astype(np.float64), _CHUNK, 0)[: len(fractions)] for end in (0, 1))
    values: NDArray[np.float64] = low * (1.0 - fractions) + high * fractions
    return values


def _unpack_means(words: U32, bounds: NDArray[Any]) -> NDArray[np.float64]:
    """Return the means [N, 3] of packed words [N] and the bounds [C, 2, 3] of their chunks."""
    return _between(_split_words(words), bounds)


def _split_words(words: U32) -> NDArray[np.float64]:
    """Return fields of 11, 10 and 11 bits, the first the highest, as fractions [N, 3] of their largest value."""
    return np.stack([(words >> 21) / 2047.0, (words >> 11 & 1023) / 1023.0, (words & 2047) / 2047.0], 1)


def _sh_values() -> F32:
    """Return the SH coefficient of each code, [256]: the middles of intervals of 1/32, but -4 and 4 at the ends."""
    values = (np.arange(256) + 0.5) / 32.0 - 4.0
    values[[0, -1]] = -4.0, 4.0
    return values.astype(np.float32)


def _write(path: Path, scene: Scene) -> list[Finding]:
    """Write a scene sorted along a Z curve (`Format.write`), splats far from the others in chunks of their own.

    A splat far away would make the positions of all splats in its chunk coarse. Invisible splats fill chunks up.

    Returns:
        Findings about positions that moved, and about the invisible splats if there are any.
    """
    sh_columns = 3 * ((scene.sh_degree + 1) ** 2 - 1)
    moved = MovedSplats()
    with atomic_writer(path, seekable=True) as stream, sorted_shells(scene, work_folder(path)) as shells:
        filling = sum(-shell.count % _CHUNK for shell in shells[:-1])
        count = scene.count + filling
        header = _build_header(scene, count, sh_columns)
        sizes = 4 * len(_BOUNDS + _COLOUR_BOUNDS) * -(-count // _CHUNK), 4 * len(_PACKED_COLUMNS) * count
        offsets = [len(header), len(header) + sizes[0], len(header) + sum(sizes)]
        stream.write(header)
        for shell in shells:
            for model in shell.blocks():
                bounds, words = _pack_words(model)
                moved.add(model, _unpack_means(words[:, 0], bounds[:, :6].reshape(-1, 2, 3)))
                if len(model) % _CHUNK and shell is not shells[-1]:
                    filler = words[-1:].copy()
                    filler[:, 3] &= np.uint32(0xFFFFFF00)  # alpha, the lowest byte, is 0
                    words = np.concatenate([words, np.repeat(filler, -len(model) % _CHUNK, axis=0)])
                codes = _sh_codes(model)
                codes = np.concatenate([codes, np.repeat(codes[-1:], len(words) - len(codes), axis=0)])
                for index, part in enumerate((bounds.astype("<f4"), words, codes)):
                    stream.seek(offsets[index])
                    offsets[index] += stream.write(part.tobytes())
    findings = moved.findings("it has 11 bits per position within each chunk of 256 splats")
    if filling:
        text = f"{counted(filling, 'splat')} with alpha 0 added: splats far from the others get chunks of their own"
        findings.append(Finding("filling-splats", filling, f"{text}; --drop-floaters drops these", "loss"))
    return findings


def _pack_words(model: SplatModel) -> tuple[F32, U32]:
    """Return the chunk bounds [C, 18] and the words [N, 4] of a block."""
    largest, three = encode_smallest_three(model.quats)
    steps = np.clip(np.rint((three / np.float32(2**0.5) + np.float32(0.5)) * 1023), 0, 1023).astype(np.int64)
    words = np.empty((len(model), 4), "<u4")
    words[:, 1] = largest << 30 | steps[:, 0] << 20 | steps[:, 1] << 10 | steps[:, 2]
    bounds = []
    for column, values, bits in (
        (0, model.means, (11, 10, 11)),
        (2, np.clip(model.scales, -_LARGEST_LOG, _LARGEST_LOG), (11, 10, 11)),
        (3, (model.sh0 * SH_C0 + 0.5).astype(np.float32), (8, 8, 8)),
    ):
        words[:, column], low, high = _pack(values, bits)
        bounds += [low, high]
    words[:, 3] |= np.rint(model.opacities * np.float32(255)).astype(np.uint32)
    return np.concatenate(bounds, 1), words


def _sh_codes(model: SplatModel) -> U8:
    """Return the codes [N, 3 K] of a model's SH coefficients, channel by channel; values outside ±4 are clamped."""
    codes: U8 = np.floor(model.shN.transpose(0, 2, 1) * np.float32(32) + np.float32(128)).clip(0, 255).astype(np.uint8)
    return codes


def _pack(values: F32, bits: tuple[int, int, int]) -> tuple[U32, F32, F32]:
    """Pack the columns of values [N, 3] into words [N], the first in the highest of their `bits`.

    Returns:
        The words, whose other bits are 0; and the lower and upper bounds of each chunk, [C, 3] each.
    """
    count = len(values)
    starts = np.arange(0, count, _CHUNK)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    span = (high.astype(np.float64) - low).clip(min=np.finfo(np.float32).tiny)
    words = np.zeros(count, np.uint32)
    shift = 32  # bits below the columns packed so far
    for axis, width in enumerate(bits):
        scale = ((1 << width) - 1) / span[:, axis]
        share = (values[:, axis] - np.repeat(low[:, axis].astype(np.float64), _CHUNK)[:count]) * np.repeat(
            scale, _CHUNK
        )[:count]
        shift -= width
        words |= np.rint(share).astype(np.uint32) << np.uint32(shift)
    return words, low, high


def _build_header(scene: Scene, count: int, sh_columns: int) -> bytes:
    """Return the header for `count` splats, filling included; without SH columns, there is no element for SH."""
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in format_comments(scene.metadata, scene.origin, absolute=False)),
    ]
    lines += [f"element chunk {-(-count // _CHUNK)}", *(f"property float {name}" for name in _BOUNDS + _COLOUR_BOUNDS)]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in _PACKED_COLUMNS)]
    if sh_columns:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{index}" for index in range(sh_columns))]
    return "\n".join([*lines, "end_header\n"]).encode("ascii")


FORMAT = Format(
    name="compressed-ply",
    open=_open,
    splat_bytes=(16.3, 25.3, 40.3, 61.3),
    write=_write,
    ranges={"scales": ValueRange(-_LARGEST_LOG, _LARGEST_LOG), "shN": ValueRange(-4.0, 4.0, 1 / 32)},
    carries=frozenset(
        {"antialiased", "origin", "coordinate_system", "unit_metres", "flat", "colour_space", "metadata"}
    ),
    unwritten=unwritten_entries,
)
