"""Valid files at the edges of what decoders do inside: widths of their integers, runs of splats, rare values."""

from __future__ import annotations

from dataclasses import replace

from csplat import _spec
from csplat_authoring.builder import build
from csplat_authoring.samples import (
    MEANS,
    QUATS,
    SCALES,
    SH0,
    Recipe,
    attributes,
    book,
    morton,
    offset,
    scene,
    sh_attribute,
    signed,
    tile,
)
from csplat_authoring.scene import Attribute, Block, Chunk, Codebook, Extra, Scene, Stream

_RUNS = (_spec.TRANSFORM_RUN_LENGTH,)
_COLUMN = _spec.COLUMN_MAX


def edge_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    lifted = Attribute(_spec.MAPPING_YCOCG, 2.0**-30, chroma_shift=16)
    return [
        _recipe(
            "integers_of_each_width",
            "lattice integers on either side of 2^15, 2^16 and 2^21, and at 2^22",
            "LAT-4 NUM-1",
            _widths(),
        ),
        _recipe(
            "lifting_at_type_bounds",
            "colours whose sums leave 16 and 22 bits, and whose parts do not",
            "ATT-2 LAT-4",
            _lifting(),
        ),
        _recipe(
            "column_limits_of_bands",
            "columns of ±2^22 in every band: Y as it is, Co and Cg after their shift",
            "LAT-3 LAT-4",
            scene(
                3,
                [tile(degree=3, changes={sh_attribute(band): _limits(band) for band in range(4)})],
                attributes=attributes(3) | {sh_attribute(band): lifted for band in range(4)},
            ),
        ),
        _recipe(
            "codebook_bounds",
            "parts of sums beyond 2^22 whose sums are not, escapes at the limit of Y, and the id 0",
            "CBK-6 LAT-3 LAT-4",
            _bounds(),
        ),
        _recipe(
            "summands_beyond",
            "summands of up to 2^32 + 2^22 whose sums with negative entries stay within 2^22",
            "LAT-4 LAT-3 CBK-6",
            _summands(),
        ),
        _recipe(
            "codebooks_of_many_splats",
            "more splats than a decoder may work on at a time, escapes where one run ends and another begins",
            "CBK-2 CBK-3 CBK-6",
            _many(),
        ),
        _recipe(
            "morton_each_width",
            "codes of one to seven bytes, as they are and as differences in byte planes",
            "MOR-2 STR-2",
            _codes(),
        ),
        _recipe(
            "unit_of_2_65",
            "a unit and an origin that some languages write as whole numbers of twenty digits",
            "IDX-5 IDX-6",
            scene(unit_metres=2.0**65, origin=(2.0**53 + 2.0, -(2.0**60), 0.0)),
        ),
        _recipe(
            "extra_names_with_mark",
            "a name that begins with U+FEFF, and the same without it: two names",
            "EXR-2",
            scene(
                tiles=[tile(extras=tuple(Block(_spec.CODING_RAW, [[i], [i]]) for i in range(2)))],
                extras=(Extra("\ufeffa", _spec.EXTRA_DTYPE_U8), Extra("a", _spec.EXTRA_DTYPE_U8)),
            ),
        ),
        _recipe(
            "extra_names_of_c1",
            "names of U+0080 to U+009F, which EXR-2 does not count as control characters",
            "EXR-2",
            scene(
                tiles=[tile(extras=tuple(Block(_spec.CODING_RAW, [[i], [i]]) for i in range(3)))],
                extras=tuple(Extra(name, _spec.EXTRA_DTYPE_U8) for name in ("\x80", "a\x85b", "\x9f")),
            ),
        ),
        _recipe(
            "unit_metres_minus_zero",
            "−0 metres: the unit is not known",
            "IDX-5",
            scene(tiles=[], unit_metres=-0.0),
        ),
        _recipe(
            "chunk_types",
            "the first and the last character of a type",
            "DIR-1 DIR-3",
            scene(tiles=[], chunks=(Chunk(b" ~~ ", flags=0), Chunk(b"~  ~", payload=b"x", flags=0))),
        ),
    ]


def _recipe(name: str, why: str, clauses: str, made: Scene) -> Recipe:
    return Recipe(f"extreme/{name}", why, tuple(clauses.split()), lambda: build(made).data, made)


def _widths() -> Scene:
    fine = Attribute(_spec.MAPPING_LATTICE, 2.0**-30)
    edges = [[2**15 - 1, 2**15, 2**16 - 1], [2**16, 2**21 - 1, 2**21], [2**22 - 1, 2**22, 1]]
    small = [[-(2**15), 2**15 - 1, 0], [1, -(2**15), 2**15 - 1], [-1, 2**14, -(2**14)]]
    tiles = (
        tile(
            1,
            3,
            1,
            {SH0: offset(edges, Stream(4), offsets=(0, 0, 0)), SCALES: offset(edges, Stream(4), offsets=(0, 0, 0))},
        ),
        tile(2, 3, 1, {SH0: signed(small, Stream(2)), SCALES: signed(small, Stream(2))}),
        tile(3, 3, 1, {SH0: signed([[-(2**22), 2**22, 0]] * 3, Stream(4)), SCALES: offset(small, Stream(2))}),
        tile(4, 2, 1, {SH0: offset([[40000, 50000, 65535], [0, 32767, 32768]], Stream(2), offsets=(0, 0, 0))}),
        *(
            tile(5, 2, 1, {SH0: offset([[0, 1, 2**bits]] * 2, Stream(width), offsets=(0, 0, 0))})
            for bits, width in ((15, 2), (16, 3), (22, 4))
        ),
    )
    return scene(1, tiles, attributes=attributes(1) | {SH0: fine, SCALES: fine})


def _lifting() -> Scene:
    """For b of 15 and 21: parts on either side of 2^b / 3 and 2^b / 2, whose sums are up to three times as large."""
    tiles = []
    for bits in (15, 21):
        for q in (*(2**bits // 3 + d for d in (-1, 0, 1)), 2 ** (bits - 1) - 1, 2 ** (bits - 1), 2**bits - 1):
            rows = [[s * q, t * q, u * q] for s, t, u in ((1, 1, -1), (1, -1, -1), (-1, -1, 1), (-1, 1, 1))]
            tiles.append(tile(1, 4, 0, {SH0: signed(rows, Stream(2 if bits == 15 else 4))}))
    lifted = Attribute(_spec.MAPPING_YCOCG, 2.0**-30, chroma_shift=1)
    return scene(tiles=tiles, attributes=attributes() | {SH0: lifted})


def _limits(band: int) -> Block:
    third = 2 * band + 1
    chroma = _COLUMN >> 16
    offsets = [_COLUMN if i % 2 else -_COLUMN for i in range(third)] + [
        chroma if i % 2 else -chroma for i in range(2 * third)
    ]
    return offset([offsets] * 2, offsets=tuple(offsets))


def _bounds() -> Scene:
    fine = Attribute(_spec.MAPPING_LATTICE, 2.0**-30)
    shapes = Codebook(2, _spec.CODEBOOK_KIND_SHAPE, {0: [[-9, -1, 0, 1, 2, 3], [9, 1, 0, 4, 5, 6]]})
    colours = Codebook(0, _spec.CODEBOOK_KIND_SH, {1: [[1, -2, 3] * 3]}, (1, 1))
    sh1 = sh_attribute(1)
    tiles = (
        tile(
            1,
            2,
            1,
            {
                SCALES: book(2, (0, 0), summands=(_COLUMN, _COLUMN), escape=None),
                QUATS: book(2),
                sh1: book(0, (0, 1), offset([[_COLUMN] * 3 + [5, -5] * 3], offsets=(_COLUMN,) * 3 + (0, -5) * 3)),
            },
        ),
        tile(
            2,
            2,
            1,
            {
                SCALES: book(2, (1, 1), summands=(-_COLUMN, -_COLUMN)),
                QUATS: book(2),
                sh1: book(0, (1, 0), offset([[-_COLUMN] * 3 + [0] * 6])),
            },
        ),
    )
    lifted = Attribute(_spec.MAPPING_YCOCG, 2.0**-30, chroma_shift=16)
    records = attributes(1) | {SCALES: fine, sh1: lifted}
    text = Chunk(_spec.CHUNK_METADATA, b"{}")  # whose id is 0, too
    return scene(1, tiles, codebooks=(colours, shapes), attributes=records, chunks=(text,))


def _summands() -> Scene:
    """Entries as far below 0 as they can be."""
    far = 2**31
    table = Codebook(1, _spec.CODEBOOK_KIND_SHAPE, {0: [[-far, -far, -far, 1, 2, 3]]}, how=Stream(4))
    summands = (far + _COLUMN, far - _COLUMN + 1)
    first = replace(book(1, (0, 0), summands=summands, offsets=(_COLUMN,)), how=Stream(4))
    fine = Attribute(_spec.MAPPING_LATTICE, 2.0**-30)
    one = tile(changes={SCALES: first, QUATS: book(1)})
    return scene(tiles=[one], codebooks=(table,), attributes=attributes() | {SCALES: fine})


def _many() -> Scene:
    """16,400 splats; every index and escape in long runs."""
    n, border = 16_400, 16_384
    how = Stream(1, _RUNS)
    shapes = Codebook(2, _spec.CODEBOOK_KIND_SHAPE, {0: [[-9, -1, 0, 1, 2, 3], [9, 1, 0, 4, 5, 6]]})
    bands = Codebook(3, _spec.CODEBOOK_KIND_SH, {1: [[*range(9)], [*range(9, 0, -1)]]}, (1, 1))
    escaped = {0, border - 1, border, n - 1}

    def indices(period: int) -> tuple[int, ...]:
        return tuple(2 if i in escaped else i // period % 2 for i in range(n))

    def rows(columns: int) -> list[list[int]]:
        return [[10 * k + c for c in range(columns)] for k in range(1, 1 + len(escaped))]

    same = tile(1, 1, 1)
    blocks = {
        a: replace(b, rows=[list(b.rows[0])] * n, how=replace(b.how, transforms=_RUNS)) for a, b in same.blocks.items()
    }
    blocks |= {
        SCALES: replace(
            book(2, indices(7000), signed(rows(3)), how, summands=tuple(-(i // 4000) for i in range(n))), how=how
        ),
        QUATS: book(2, (), signed(rows(3))),
        sh_attribute(1): book(3, indices(6000), signed(rows(9)), how),
    }
    return scene(1, [replace(same, blocks=blocks)], codebooks=(shapes, bands))


def _codes() -> Scene:
    ways: tuple[tuple[int, ...], ...] = (
        (),
        (_spec.TRANSFORM_DELTA, _spec.TRANSFORM_ZIGZAG, _spec.TRANSFORM_BYTE_PLANES),
    )
    tiles = []
    for width in range(1, 8):
        bits = min(_spec.MORTON_BITS_MAX, 8 * width // 3)
        high = (1 << bits) - 1
        rows = [[0, high, high >> 1], [high, 0, 1], [high >> 1, 1, 0], [1, high >> 2, high]]
        tiles += [tile(width, 4, 0, {MEANS: morton(rows, bits, Stream(width, way))}) for way in ways]
    return scene(tiles=tiles)
