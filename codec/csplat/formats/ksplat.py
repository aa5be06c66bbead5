# SPDX-License-Identifier: Apache-2.0
"""Read .ksplat 0.1 of mkkellogg/GaussianSplats3D: rows of floats, or of smaller types relative to bucket centres.

Level 0 is float32 throughout. Levels 1 and 2 store 16-bit positions in a block around the centre of a bucket of splats
and float16 for the rest, except that level 2 stores SH in bytes. The highest SH degree is 2. Files do not specify axes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.file_source import map_file
from csplat.formats.common import finite_scene, sh0_from_bytes
from csplat.formats.format import Format
from csplat.lint import other_contents, trailing_bytes
from csplat.model import SplatModel, normalise_quats
from csplat.scene import BLOCK_SPLATS, Scene
from csplat.types import F32, F64

Rows = NDArray[Any]

_HEADER = struct.Struct("<BBxxIIIIHxx12xff")
_SECTION = struct.Struct("<IIIIfHxxIIIIH")
_HEADER_SIZE, _SECTION_SIZE = 4096, 1024  # bytes; the section headers follow the file header
_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))  # by level: positions, others, SH
_COEFFICIENTS = (0, 9, 24)  # number of SH coefficients, by degree
_CENTRE_SIZE = 12  # bytes of a bucket's centre, three float32
_POSITION_MAX = 65535  # largest position of 16 bits
_DEFAULT_SPAN = 32767  # position units from the centre of a block to its faces
_DEFAULT_SH = 1.5  # SH bytes represent -1.5 to 1.5
_LARGEST = 1e38  # larger values exceed float32
_NAMED = 6  # maximum number of headers and sections that a message lists


@dataclass(frozen=True, eq=False)
class _Section:
    """A section: splats whose rows have the same type.

    Attributes:
        rows: [N], structured.
        ends: [buckets], index after the last splat of each bucket.
        corners: [buckets, 3], scene coordinates of position 0.
        step: scene units per position unit.
    """

    rows: Rows
    ends: NDArray[np.int64]
    corners: F64
    step: float


class _SectionHead(NamedTuple):
    """The header of a section.

    Attributes:
        capacity: number of splats for which the section has space.
        bucket: number of splats in a full bucket.
        block: edge length of the block around a bucket's centre, scene units.
        span: position units from the centre to a face; 0: `_DEFAULT_SPAN`.
        full, partial: number of full and of partial buckets.
    """

    splats: int
    capacity: int
    bucket: int
    buckets: int
    block: float
    centre_size: int
    span: int
    size_bytes: int
    full: int
    partial: int
    degree: int


@contextmanager
def _open(path: Path) -> Iterator[Scene]:
    """Open a file (`Format.open`).

    Raises:
        InputError: the file is truncated, of another version, or contradicts itself.
    """
    data = map_file(path)
    if len(data) < _HEADER_SIZE:
        raise InputError(f"{path.name} is truncated: it ends within its header")
    major, minor, section_count, _, _, count, level, low, high = _HEADER.unpack_from(data)
    if (major, minor) != (0, 1):
        raise InputError(f"{path.name} is .ksplat of version {major}.{minor}, expected 0.1")
    if level >= len(_TYPES):
        raise InputError(f"{path.name} has compression level {level}, expected at most {len(_TYPES) - 1}")
    low, high = low or -_DEFAULT_SH, high or _DEFAULT_SH
    if not (abs(low) < _LARGEST and abs(high) < _LARGEST and low <= high):
        raise InputError(f"{path.name} has SH from {low} to {high}, expected finite numbers, the larger one last")
    sections, end, spare = _read_sections(path.name, data, level, section_count)
    total = sum(len(section.rows) for section in sections)
    if total != count:
        raise InputError(f"{path.name} has {total:,} splats in its sections, its header declares {count:,}")
    widest = max((section.rows.dtype["shN"].shape[0] for section in sections if len(section.rows)), default=0)

    def blocks() -> Iterator[tuple[Rows, ...]]:
        for section in sections:
            yield from _section_blocks(section)

    def decode(scales: F32, rows: Rows, corners: F64, steps: F64) -> SplatModel:
        return SplatModel(
            means=(rows["means"] * steps + corners).astype(np.float32),
            quats=normalise_quats(rows["quats"].astype(np.float32)),
            scales=scales,
            opacities=np.divide(rows["colours"][:, 3], 255, dtype=np.float32),
            sh0=sh0_from_bytes(rows["colours"][:, :3]),
            shN=_decode_sh(rows["shN"], widest, low, high),
        )

    no_rows = np.empty(0, _row_type(level, 0))
    empty = decode(np.zeros((0, 3), np.float32), no_rows, np.zeros((0, 3)), np.zeros((0, 1)))
    scene = finite_scene(blocks, decode, empty)
    scene.findings.extend(
        [*other_contents([*_unread_bytes(data, section_count), *spare][:_NAMED]), *trailing_bytes(len(data) - end)]
    )
    yield scene


def _unread_bytes(data: Any, section_count: int) -> list[str]:
    """Describe bytes of the headers that are reserved and not 0; the centre of the scene follows from the splats."""
    heads = [("the header of the file", bytes(data[_HEADER.size : _HEADER_SIZE]))]
    for index in range(section_count):
        start = _HEADER_SIZE + index * _SECTION_SIZE
        heads.append((f"the header of section {index}", bytes(data[start + _SECTION.size : start + _SECTION_SIZE])))
    return [f"reserved bytes of {name}" for name, rest in heads if any(rest)]


def _row_type(level: int, degree: int) -> np.dtype[Any]:
    """Return the type of the rows of a section, by its compression level and SH degree."""
    means, others, rest = _TYPES[level]
    return np.dtype(
        [
            ("means", means, 3),
            ("scales", others, 3),
            ("quats", others, 4),
            ("colours", "u1", 4),
            ("shN", rest, (_COEFFICIENTS[degree],)),
        ]
    )


def _read_sections(name: str, data: Any, level: int, section_count: int) -> tuple[list[_Section], int, list[str]]:
    """Return the sections, the offset after the last one, and descriptions of rows after their splats that are not 0.

    Raises:
        InputError: a section does not fit into the file, or contradicts itself.
    """
    sections: list[_Section] = []
    spare: list[str] = []
    at = _HEADER_SIZE + section_count * _SECTION_SIZE
    if at > len(data):
        raise InputError(f"{name} declares {section_count:,} sections, too many for its {len(data):,} bytes")
    for index in range(section_count):
        head = _SectionHead(*_SECTION.unpack_from(data, _HEADER_SIZE + index * _SECTION_SIZE))
        where = f"{name}, section {index}"
        if head.degree >= len(_COEFFICIENTS):
            raise InputError(f"{where}: SH degree {head.degree}, expected at most {len(_COEFFICIENTS) - 1}")
        row = _row_type(level, head.degree)
        centres = at + 4 * head.partial
        start = centres + head.centre_size * head.buckets
        at = start + row.itemsize * head.capacity
        if at > len(data):
            raise InputError(f"{where} ends at byte {at:,}, the file at byte {len(data):,}")
        if head.splats > head.capacity:
            raise InputError(f"{where}: {head.splats:,} splats, but space for {head.capacity:,}")
        rows = np.frombuffer(data, row, head.splats, start)
        if np.frombuffer(data, np.uint8, at - start - rows.nbytes, start + rows.nbytes).any():
            spare.append(f"rows after the splats of section {index}")
        if level and head.splats:
            sections.append(_Section(rows, *_read_buckets(where, data, head, centres)))
        else:
            sections.append(_Section(rows, np.array([head.splats]), np.zeros((1, 3)), 1.0))
    return sections, at, spare


def _read_buckets(where: str, data: Any, head: _SectionHead, centres: int) -> tuple[NDArray[np.int64], F64, float]:
    """Return `ends` [B], `corners` [B, 3] and `step` of a `_Section`.

    Args:
        where: file and section, for messages.
        data: the file.
        head: header of the section.
        centres: file offset of the bucket centres, which follow the lengths of the partial buckets.

    Raises:
        InputError: the buckets contradict the header, or hold too few splats, or a centre is not finite.
    """
    if head.centre_size != _CENTRE_SIZE or head.full + head.partial > head.buckets:
        raise InputError(
            f"{where}: {head.full:,} full and {head.partial:,} partial buckets, expected {head.buckets:,} together"
        )
    lengths = np.frombuffer(data, "<u4", head.partial, centres - 4 * head.partial)
    ends = np.cumsum(np.concatenate([np.full(head.full, head.bucket, np.int64), lengths]))
    if not len(ends) or ends[-1] < head.splats:
        raise InputError(f"{where}: its buckets contain fewer than its {head.splats:,} splats")
    middles = np.frombuffer(data, "<f4", 3 * head.buckets, centres).reshape(-1, 3).astype(np.float64)
    span = head.span or _DEFAULT_SPAN
    if head.block < 0:
        raise InputError(f"{where}: the length of its blocks is {head.block:g}, expected at least 0")
    step = head.block / 2 / span
    if not (np.abs(middles) + _POSITION_MAX * abs(step) < _LARGEST).all():
        raise InputError(f"{where}: its bucket centres are not finite")
    return ends, middles - span * step, step


def _section_blocks(section: _Section) -> Iterator[tuple[Rows, ...]]:
    """Yield blocks of rows [n], the corner of the bucket of each row [n, 3], and its step [n, 1]."""
    for start in range(0, len(section.rows), BLOCK_SPLATS):
        rows = section.rows[start : start + BLOCK_SPLATS]
        bucket = np.searchsorted(section.ends, np.arange(start, start + len(rows)), side="right")
        yield rows, section.corners[bucket], np.full((len(rows), 1), section.step)


def _decode_sh(coded: Rows, widest: int, low: float, high: float) -> F32:
    """Decode SH coefficients [n, 3 K], ordered by band, then by channel, to [n, widest / 3, 3]."""
    width = coded.shape[1]
    bands = [np.arange(start, end).reshape(3, -1).T for start, end in pairwise(_COEFFICIENTS) if end <= width]
    values = coded[:, np.concatenate([np.zeros(0, np.int64), *(band.ravel() for band in bands)])].astype(np.float32)
    if coded.dtype.kind == "u":
        values *= np.float32((high - low) / 255)
        values += np.float32(low)
    values = values if width == widest else np.pad(values, ((0, 0), (0, widest - width)))
    return values.reshape(len(coded), widest // 3, 3)


FORMAT = Format(
    name="ksplat",
    open=_open,
    degree=2,
)
