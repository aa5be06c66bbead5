# SPDX-License-Identifier: CC0-1.0
"""The worked example of the specification, byte by byte: `spec/example.md`."""

from __future__ import annotations

import struct
from typing import Final

from csplat import _spec
from csplat_authoring.builder import Built, build
from csplat_authoring.samples import MEANS, OPACITIES, QUATS, SCALES, SH0, axis, levels, offset, signed
from csplat_authoring.scene import Attribute, Chunk, Scene, Stream, Tile
from csplat_conformance.fields import Field


def example_scene() -> Scene:
    """Return a scene of two splats of SH degree 1: one round and opaque, the other rotated, long and faint."""
    runs = Stream(1, (_spec.TRANSFORM_RUN_LENGTH,))
    bands = [[4, 0, 0, 0, 0, 0, 0, 0, 0], [4, 0, 0, 0, 0, 0, 0, 0, -1]]
    tile = Tile(
        {
            OPACITIES: levels([4, 1]),
            SCALES: offset([[-12, -12, -12], [-8, -12, -16]]),
            QUATS: signed([[0, 0, 0], [0, 0, 3]]),
            MEANS: axis([[0, 2, 0], [5, 0, 1]]),
            SH0: signed([[2, 1, -1], [-1, 0, 0]]),
            SH0 + 1: signed(bands, runs),
        },
        corner=(-2, 0, 16),
        exponent=1,
    )
    lattice, colour = _spec.MAPPING_LATTICE, _spec.MAPPING_YCOCG
    return Scene(
        attributes={
            OPACITIES: Attribute(_spec.MAPPING_LINEAR, levels=4),
            SCALES: Attribute(lattice, 0.25),
            QUATS: Attribute(_spec.MAPPING_UNIT_W, levels=3),
            MEANS: Attribute(lattice, 0.125),
            SH0: Attribute(colour, 0.5),
            SH0 + 1: Attribute(lattice, 0.25),
        },
        tiles=(tile,),
        chunks=(Chunk(_spec.CHUNK_METADATA, b'{"title":"two"}'),),
        sh_degree=1,
        axes=(_spec.DIRECTION_RIGHT, _spec.DIRECTION_DOWN, _spec.DIRECTION_FORWARD),
        unit_metres=1.0,
    )


_INTRO = """# A file, byte by byte

<!-- Written by csplat_authoring: do not edit. -->
The file is `conformance/csplat_conformance/vectors/valid/worked_example.csplat`. It has {size} bytes and
contains two splats of SH degree 1 in one tile, and a title. Each row of a table is one field. Offsets are decimal,
bytes hexadecimal in the order of the file. Section numbers are those of [format.md](format.md).
"""

#: Names of the spec's structures, and the sections that define them.
_SECTIONS: Final = {
    "header": "Header (4.2)",
    "index_head": "Index head (4.3)",
    "attribute_record": "Attribute record (4.3.1)",
    "directory_record": "Directory record (4.3.4)",
    "tile_record": "Tile record (4.3.5)",
    "layer_record": "Layer record (4.3.5)",
    "chunk_header": "Chunk header (5.1)",
    "tile_head": "Head of the TILE payload (5.2)",
    "block_head": "Block head (6.4)",
    "lattice_params": "Parameters (6.4.4)",
    "stream_head": "Stream head (6.1)",
}

_NOTES: Final = {
    "header.version_minor": f"version {_spec.VERSION_MAJOR}.{_spec.VERSION_MINOR}",
    "header.profile": "BASE",
    "header.resource_level": "A",
    "header.header_crc": "of the bytes 0 to 27",
    "index.kernel": "ELLIPSE",
    "index.splat_count": "N",
    "index.sh_degree": "so six attribute records follow",
    "index.axes": "RIGHT, DOWN, FORWARD",
    "index.projection": "PERSPECTIVE",
    "index.antialiasing": "NONE",
    "index.colour_space": "SRGB_REC709_DISPLAY",
    "attribute[opacities].mapping": "LINEAR: q / M",
    "attribute[opacities].levels": "M",
    "attribute[quats].mapping": "UNIT_W",
    "attribute[quats].levels": "M",
    "attribute[sh0].mapping": "YCOCG",
    "directory[META].flags": "SAFE_TO_COPY",
    "tile[0].exponent": "s of the means is 0.125 × 2^1 = 0.25",
    "tile[0].max_scale": "n of −8 times 0.25",
    "META/stream.coded": '`{"title":"two"}`',
    "TILE.0.0/opacities.coding": "LEVELS",
    "TILE.0.0/opacities.stream.coded": "q: 4, 1",
    "TILE.0.0/scales.coding": "OFFSET",
    "TILE.0.0/scales.stream.coded": "columns 0 4, 0 0, 4 0",
    "TILE.0.0/quats.coding": "SIGNED",
    "TILE.0.0/quats.stream.coded": "q1: 0 0, q2: 0 0, q3: 0 3",
    "TILE.0.0/means.coding": "AXIS",
    "TILE.0.0/means.stream.coded": "x: 0 5, y: 2 0, z: 0 1",
    "TILE.0.0/sh0.coding": "SIGNED",
    "TILE.0.0/sh0.stream.coded": "Y: 2 −1, Co: 1 0, Cg: −1 0",
    "TILE.0.0/head.block_count": "opacities, scales, quats, means, sh0",
    "TILE.0.1/sh1.coding": "SIGNED",
    "TILE.0.1/sh1.stream.transforms": "RUN_LENGTH",
    "TILE.0.1/sh1.stream.count": "9 columns of 2",
    "TILE.0.1/sh1.stream.packed_size": "3 runs",
    "TILE.0.1/sh1.stream.coded": "values 04 00 FF; lengths 2, 15, 1",
}

_OUTRO = """A decoder returns the following values:

*opacities*. M = 4 and the mapping is LINEAR: 4 / 4 = 1 and 1 / 4 = 0.25.

*scales*. The offsets −12, −12, −16 plus the elements give the integers (−12, −12, −12) and (−8, −12, −16). Times 0.25,
these are (−3, −3, −3) and (−2, −3, −4). The largest value is `max_scale`.

*quats*. M = 3, so c = 1 / (3·√2) = 0.23570226…. The first splat has q = (0, 0, 0), R = 2·9 = 18 and w = √18 · c = 1:
no rotation. The second has q = (0, 0, 3), R = 18 − 9 = 9, w = 3 · c and z = 3 · c, both 0.70710677 in binary32: a
quarter turn about z.

*means*. The corner (−2, 0, 16) plus q gives (−2, 2, 16) and (3, 0, 17). Times 0.25, these are (−0.5, 0.5, 4) and
(0.75, 0, 4.25). On each axis the smallest q is 0 and the largest q is the extent (5, 2, 1), as TIL-10 requires.

*sh0*. The first splat has Y = 2, Co = 1, Cg = −1: t = 2 − (−1 >> 1) = 2 − (−1) = 3, G = −1 + 3 = 2, B = 3 − (1 >> 1)
= 3, R = 3 + 1 = 4. Times 0.5, this is (2, 1, 1.5). The second has Y = −1 and no chroma: (−0.5, −0.5, −0.5).

*shN*. The runs expand to 04 04, fifteen times 00, FF: eighteen elements in nine columns of two. Column 0 (red, first
coefficient) is 4 for both splats. Column 8 (blue, third coefficient) is 0 and −1. The other columns are 0. Times 0.25,
red is 1 in the first coefficient of both splats, and blue is −0.25 in the third coefficient of the second splat.
"""


def worked_example() -> str:
    """Return the page: every byte of the file with its field, and the values that follow."""
    built = build(example_scene())
    parts = [_INTRO.format(size=len(built.data))]
    heading = ""
    for name, entry in sorted(built.fields.items(), key=lambda item: item[1].offset):
        prefix = name.rsplit(".", 1)[0] if entry.structure else name.split("/")[0]
        if entry.structure and prefix != heading:
            heading = prefix
            title = f"{_SECTIONS[entry.structure]}: `{prefix}`"
            parts.append(f"\n{title}\n\n| offset | bytes | field | value |\n|---|---|---|---|\n")
        raw = built.data[entry.offset : entry.offset + entry.size]
        note = f"; {_NOTES[name]}" if name in _NOTES else ""
        label = name.removeprefix(f"{heading}.").removeprefix(f"{prefix}/")
        value = _value(entry, raw)
        if name == "header.index_size":
            note = f"; so the chunks begin at {_spec.HEADER_SIZE} + {value} = {_spec.HEADER_SIZE + int(value)}"
        if name.endswith(".crc"):
            start, end = _covered_range(built, name)
            value = f"of the bytes {start} to {end - 1}"
        parts.append(f"| {entry.offset} | {raw.hex(' ').upper()} | `{label}` | {(value + note).removeprefix('; ')} |\n")
    return "".join(parts) + "\n" + _OUTRO


def _covered_range(built: Built, name: str) -> tuple[int, int]:
    """Return the byte range that a CRC covers: the index before its CRC, or the chunk that a record refers to."""
    if name == "index.crc":
        return _spec.HEADER_SIZE, built.fields[name].offset
    fields = [built.fields[name.removesuffix("crc") + key] for key in ("offset", "size")]
    offset, size = (int(struct.unpack_from(one.format, built.data, one.offset)[0]) for one in fields)
    return offset, offset + size


def _value(entry: Field, raw: bytes) -> str:
    if entry.format.endswith("s"):
        return f'"{raw.decode()}"' if raw.isalpha() and raw.isascii() and len(raw) == 4 else ""
    values = struct.unpack(entry.format, raw)
    return ", ".join(f"{value:g}" if isinstance(value, float) else str(value) for value in values)
