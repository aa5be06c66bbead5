# SPDX-License-Identifier: CC0-1.0
"""Computed valid files at the limits: codebooks, streams, texts, integers of all widths."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from csplat import _spec
from csplat_authoring.coders import deflate_fixed, deflate_stored
from csplat_authoring.recipe import Recipe, valid_recipe
from csplat_authoring.samples import (
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    SH0,
    attributes,
    axis,
    codebook_block,
    integers,
    levels,
    means_rows,
    morton,
    offset,
    rows_of,
    scene,
    sh_attribute,
    signed,
    tile,
    with_stream_codings,
)
from csplat_authoring.scene import (
    PLAIN,
    Attribute,
    Block,
    Chunk,
    Codebook,
    DeclaredErrors,
    Extra,
    Node,
    Scene,
    Stream,
)

_extreme = partial(valid_recipe, "extreme")
_RUNS = (_spec.TRANSFORM_RUN_LENGTH,)


def extreme_stream_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_codebooks(), *_streams(), *_texts()]


def _codebooks() -> list[Recipe]:
    n = _spec.CODEBOOK_ENTRIES_MAX
    entries = [[3, -4, 5, 1, 2, 3]] * (n - 1) + [[7] * 6]
    flat = Codebook(65535, _spec.CODEBOOK_KIND_SHAPE, {0: entries}, stream_coding=Stream(1, _RUNS))
    own = signed([[1, 2, 3]])
    wide = {
        SCALES: codebook_block(65535, (n - 1, n, 0), own, Stream(3), summands=(5, 0, 6)),
        QUATS: codebook_block(65535, (), own),
    }
    rows = [[*range(-13, 14)]] * (n - 1) + [[*range(27)]]
    bands = Codebook(1, _spec.CODEBOOK_KIND_SH, {4: rows}, (4, 4), Stream(1, _RUNS))
    last_band = codebook_block(1, (n - 1, n, 0), signed([[*range(99, 126)]]), Stream(3))
    thirds = [[*range(9)]] * 256 + [[*range(20, 29)]] * (2**15 - 256) + [[*range(40, 49)]] * (2**15 - 1)
    common = Codebook(1, _spec.CODEBOOK_KIND_SH, {1: thirds}, (1, 1), Stream(1, _RUNS))
    two_bytes = codebook_block(1, (255, 256, 2**15, 2**16 - 1), signed([[*range(60, 69)]]), Stream(2))
    full, runs = _spec.TILE_SPLATS_MAX, Stream(1, _RUNS)
    escaped = codebook_block(1, (1,) * full, signed([[*range(9)]] * full, runs), runs)
    same = tile(2, 1, 1)
    every_one = {name: replace(block, rows=[list(block.rows[0])] * full) for name, block in same.blocks.items()}
    all_of_65536 = replace(same, blocks=every_one | {sh_attribute(1): escaped})
    unused = (
        Codebook(1, _spec.CODEBOOK_KIND_SHAPE, {0: [[1, 2, 3, 4, 5, 6]]}),
        Codebook(2, _spec.CODEBOOK_KIND_SH, {1: rows_of(1, 2, 9, -1, 1)}, (1, 1)),
    )
    shape = Codebook(9, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(3, 2, 6, -9, 9)})
    every = {
        SCALES: codebook_block(9, (2, 2, 2), signed([[1, 2, 3]] * 3), summands=(0, 0, 0)),
        QUATS: codebook_block(9, (), signed([[4, 5, 6]] * 3)),
    }
    ignored = {
        SCALES: codebook_block(9, (2, 0, 1), signed([[1, 2, 3]]), summands=(77, 0, 5), offsets=(0,)),
        QUATS: codebook_block(9, (), signed([[4, 5, 6]])),
    }
    largest = _spec.COLUMN_MAX
    turns = {0: [[1, 2, 3, *turn] for turn in ([1, 2, 3], [127, -127, 0], [0, 127, 127])]}
    bounds = {1: [[*range(9)], [largest, 0, -largest] * 3]}
    at_bounds = (
        Codebook(2, _spec.CODEBOOK_KIND_SHAPE, turns),
        Codebook(3, _spec.CODEBOOK_KIND_SH, bounds, (1, 1), Stream(4)),
    )
    zeros = (0, 0, 0)
    first = {
        SCALES: codebook_block(2, zeros, summands=(4, 5, 6)),
        QUATS: codebook_block(2),
        sh_attribute(1): codebook_block(3, zeros),
    }
    shifted = Codebook(
        1, _spec.CODEBOOK_KIND_SHAPE, {0: [[2**22 + 2, 2**22 + 3, 2**22 + 1, 4, 5, 6]]}, stream_coding=Stream(4)
    )
    back = {SCALES: codebook_block(1, (0, 0, 0), summands=(-(2**22), 1 - 2**22, -(2**22))), QUATS: codebook_block(1)}
    return [
        _extreme(
            "codebook_of_65536",
            "the escape index is 65,536 and needs three bytes",
            "CBR-4 CBK-2",
            replace(_with(wide), codebooks=(flat,)),
        ),
        _extreme(
            "codebook_of_65536_band_4",
            "65,536 entries of 27 columns, and an escaped splat",
            "CBR-4 CBK-2 CBK-3",
            scene(4, [tile(2, 3, 3, {sh_attribute(4): last_band})], codebooks=(bands,)),
        ),
        _extreme(
            "codebook_index_of_two_bytes",
            "indices on both sides of 2^8 and 2^15, and the escape index 65,535",
            "CBK-2 CBK-3",
            scene(1, [tile(2, 4, 1, {sh_attribute(1): two_bytes})], codebooks=(common,)),
        ),
        _extreme(
            "codebook_escapes_of_65536",
            "65,536 escaped splats, whose number needs 17 bits",
            "CBK-3",
            with_stream_codings(
                scene(1, [all_of_65536], codebooks=(Codebook(1, _spec.CODEBOOK_KIND_SH, {1: [[0] * 9]}, (1, 1)),)),
                lambda coding: replace(coding, transforms=_RUNS),
            ),
        ),
        _extreme(
            "codebooks_unused",
            "codebooks that no block uses, listed by the tile all the same",
            "TIL-6 DIR-5",
            scene(1, [tile(degree=1, codebook_ids=(1, 2))], codebooks=unused),
        ),
        _extreme(
            "codebook_all_escaped",
            "no splat uses an entry",
            "CBK-3",
            replace(_with(every), codebooks=(shape,)),
        ),
        _extreme(
            "codebook_unused_summand",
            "the summand of an escaped splat is not 0: ignored",
            "CBK-6",
            replace(_with(ignored), codebooks=(shape,)),
        ),
        _extreme(
            "codebook_entries_at_bounds",
            "rotations and colours that no splat uses and that are just allowed",
            "CBK-7",
            scene(
                1,
                [tile(2, 3, 1, first)],
                codebooks=at_bounds,
                attributes=attributes(1) | {sh_attribute(1): _lattice(2.0**105)},
            ),
        ),
        _extreme(
            "codebook_scales_before_summand",
            "scales of shapes beyond binary32, which the summands bring back",
            "CBK-7 CBK-6",
            replace(_with(back, records={SCALES: _lattice(2.0**106)}), codebooks=(shifted,)),
        ),
    ]


def _streams() -> list[Recipe]:
    values = [7, 8, 9]

    def with_coded(name: str, why: str, data: bytes) -> Recipe:
        stream_coding = Stream(coder="deflate", coded=data)
        return _extreme(name, why, "COD-2", _with({OPACITIES: levels(values, stream_coding)}))

    empties = b"\x00\x00\x00\xff\xff" * 50 + deflate_stored(bytes(values))
    single = Stream(1, _RUNS, packed=bytes([7, 8, 9, 0, 0, 0, 0, 0, 0]))
    split = Stream(1, _RUNS, packed=bytes([7, 7, 7, 0, 0, 0, 0, 0, 0]))
    return [
        with_coded("deflate_unused_bits", "ones after the final block: ignored", deflate_fixed(bytes(values), 1)),
        with_coded("deflate_empty_blocks", "fifty empty stored blocks", empties),
        with_coded("deflate_many_blocks", "a stored block per byte", deflate_stored(bytes(values), 1)),
        _extreme(
            "run_length_longer_than_plain",
            "runs of one: three times the size",
            "STR-5",
            _with({OPACITIES: levels(values, single)}),
        ),
        _extreme(
            "run_length_split_runs",
            "equal neighbours in runs of their own",
            "STR-5",
            _with({OPACITIES: levels([7, 7, 7], split)}),
        ),
        _extreme(
            "streams_too_wide",
            "more bytes than the integers need",
            "STR-2",
            _with(
                {
                    OPACITIES: levels(values, Stream(2)),
                    SCALES: offset(rows_of(1, 3, 3, -9, 9), Stream(4)),
                    MEANS: axis(means_rows(1, 3, 9), Stream(3)),
                }
            ),
        ),
        _extreme(
            "extra_of_eight_bytes_coded",
            "differences modulo 2^64",
            "STR-2 RAW-2",
            scene(
                tiles=[tile(extras=(Block(_spec.CODING_RAW, [[2**64 - 1], [1]], Stream(8, (1, 2, 3, 4))),))],
                extras=(Extra("e", _spec.EXTRA_DTYPE_F64),),
            ),
        ),
    ]


def _texts() -> list[Recipe]:
    deepest = b'{"a":' + b"[" * 63 + b"]" * 63 + b"}"
    number = b'{"n":0.' + b"1" * 5000 + b"}"
    long_number, zeros = Stream(1, _RUNS), b"0" * 10500
    exponents = b'{"n":[1%se-10500,0.%s1e10501,0%se99999999999999999999,1e-99999999999999999999]}' % (
        zeros,
        zeros,
        b".0",
    )
    other = b'{"a":{"a":1},"A":"\\ud83d\\ude00","\\u0000":-0.0e-0,"\xc3\xa9":1e308}'

    def meta(name: str, why: str, text: bytes, stream_coding: Stream = PLAIN) -> Recipe:
        return _extreme(name, why, "JSN-1", scene(chunks=(Chunk(_spec.CHUNK_METADATA, text, stream_coding),)))

    nothing = DeclaredErrors(2, 0, 255, 0, ())
    return [
        meta("json_64_deep", "the deepest nesting that is allowed", deepest),
        meta("json_long_number", "a number of 5,000 digits is valid JSON", number, long_number),
        meta("json_long_exponents", "digits and exponents that cancel: all of them are 1 or 0", exponents, long_number),
        meta("json_odd", "white space, escapes, U+0000, minus zero, a large number", b" \t\r\n" + other + b"\n"),
        _extreme(
            "declared_errors_none",
            "a head without records",
            "SER-3 SER-4",
            scene(chunks=(Chunk(_spec.CHUNK_DECLARED_ERRORS, errors=nothing),)),
        ),
        _extreme(
            "unit_smallest",
            "a subnormal unit and origin",
            "IDX-5 IDX-6",
            replace(scene(), unit_metres=5e-324, origin=(-1.7976931348623157e308, 5e-324, -0.0)),
        ),
        _extreme("seeded", "forty splats of degree 3 in three coders", "CNF-1", _seeded()),
    ]


def _seeded() -> Scene:
    made = scene(3, [tile(77, 40, 3)], attributes=attributes(3, True, 2))
    changed = with_stream_codings(
        made, lambda coding: replace(coding, width=2, transforms=(1, 2, 3), coder="deflate_dynamic")
    )
    blocks = changed.tiles[0].blocks | {OPACITIES: levels(integers(5, 40, 0, 255), Stream(1, _RUNS))}
    return replace(changed, tiles=(replace(changed.tiles[0], blocks=blocks),))


def _with(changes: dict[int, Block], n: int = 3, records: dict[int, Attribute] | None = None, **rest: object) -> Scene:
    made = scene(tiles=[replace(tile(2, n, 0, changes), **rest)])  # type: ignore[arg-type]  # fields of Tile
    return replace(made, attributes=made.attributes | (records or {}))


def _lattice(step: float, mapping: int = _spec.MAPPING_LATTICE, chroma_shift: int = 0) -> Attribute:
    return Attribute(mapping, step, chroma_shift=chroma_shift)


_COLUMN = _spec.COLUMN_MAX


def _levels() -> Scene:
    top = 255  # largest u8
    tiles = [tile(level, 1, level=level) for level in range(top + 1)]
    nodes = [Node(level + 1, 1, 1.0 if level else 0.0) for level in range(top)]
    return scene(tiles=tiles, nodes=(*nodes, Node(_spec.NO_PARENT, 1, 1.0)))


def edge_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    lifted = Attribute(_spec.MAPPING_YCOCG, 2.0**-30, chroma_shift=16)
    return [
        _extreme(
            "integers_of_each_width",
            "lattice integers on either side of 2^15, 2^16 and 2^21, and at 2^22",
            "LAT-4 NUM-1",
            _widths(),
        ),
        _extreme(
            "lifting_at_type_bounds",
            "colours whose sums leave 16 and 22 bits, and whose parts do not",
            "ATT-2 LAT-4",
            _lifting(),
        ),
        *(
            _extreme(
                name,
                f"columns of ±2^22 in every band to {degree}: Y as it is, Co and Cg after their shift",
                "LAT-3 LAT-4",
                scene(
                    degree,
                    [tile(degree=degree, changes={sh_attribute(band): _limits(band) for band in range(degree + 1)})],
                    attributes=attributes(degree) | {sh_attribute(band): lifted for band in range(degree + 1)},
                ),
            )
            for name, degree in (("column_limits_of_bands", 3), ("column_limits_of_band_4", 4))
        ),
        _extreme(
            "levels_chain_of_256",
            "a node of one splat on every level, all of them with the same error but for level 0",
            "TIL-12 TRE-5 TRE-8 TRE-9",
            _levels(),
        ),
        _extreme(
            "codebook_bounds",
            "parts of sums beyond 2^22 whose sums are not, escapes at the limit of Y, and the id 0",
            "CBK-6 LAT-3 LAT-4",
            _bounds(),
        ),
        _extreme(
            "summands_beyond",
            "summands of up to 2^32 + 2^22 whose sums with negative entries stay within 2^22",
            "LAT-4 LAT-3 CBK-6",
            _summands(),
        ),
        _extreme(
            "codebooks_of_many_splats",
            "more splats than a decoder may work on at a time, escapes where one run ends and another begins",
            "CBK-2 CBK-3 CBK-6",
            _many(),
        ),
        _extreme(
            "morton_each_width",
            "codes of one to seven bytes, as they are and as differences in byte planes",
            "MOR-2 STR-2",
            _morton_codes(),
        ),
        _extreme(
            "unit_of_2_65",
            "a unit and an origin that some languages write as whole numbers of twenty digits",
            "IDX-5 IDX-6",
            scene(unit_metres=2.0**65, origin=(2.0**53 + 2.0, -(2.0**60), 0.0)),
        ),
        _extreme(
            "extra_names_with_mark",
            "a name that begins with U+FEFF, and the same without it: two names",
            "EXR-2",
            scene(
                tiles=[tile(extras=tuple(Block(_spec.CODING_RAW, [[i], [i]]) for i in range(2)))],
                extras=(Extra("\ufeffa", _spec.EXTRA_DTYPE_U8), Extra("a", _spec.EXTRA_DTYPE_U8)),
            ),
        ),
        _extreme(
            "extra_names_of_c1",
            "names of U+0080 to U+009F, which EXR-2 does not count as control characters",
            "EXR-2",
            scene(
                tiles=[tile(extras=tuple(Block(_spec.CODING_RAW, [[i], [i]]) for i in range(3)))],
                extras=tuple(Extra(name, _spec.EXTRA_DTYPE_U8) for name in ("\x80", "a\x85b", "\x9f")),
            ),
        ),
        _extreme(
            "unit_metres_minus_zero",
            "−0 metres: the unit is not known",
            "IDX-5",
            scene(tiles=[], unit_metres=-0.0),
        ),
        _extreme(
            "chunk_types",
            "the first and the last character of a type",
            "DIR-1 DIR-3",
            scene(tiles=[], chunks=(Chunk(b" ~~ ", flags=0), Chunk(b"~  ~", payload=b"x", flags=0))),
        ),
    ]


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
    """Return colours near 2^b / 3 and 2^b / 2 for b of 15 and 21; their sums are up to three times larger."""
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
                SCALES: codebook_block(2, (0, 0), summands=(_COLUMN, _COLUMN), escape=None),
                QUATS: codebook_block(2),
                sh1: codebook_block(
                    0, (0, 1), offset([[_COLUMN] * 3 + [5, -5] * 3], offsets=(_COLUMN,) * 3 + (0, -5) * 3)
                ),
            },
        ),
        tile(
            2,
            2,
            1,
            {
                SCALES: codebook_block(2, (1, 1), summands=(-_COLUMN, -_COLUMN)),
                QUATS: codebook_block(2),
                sh1: codebook_block(0, (1, 0), offset([[-_COLUMN] * 3 + [0] * 6])),
            },
        ),
    )
    lifted = Attribute(_spec.MAPPING_YCOCG, 2.0**-30, chroma_shift=16)
    records = attributes(1) | {SCALES: fine, sh1: lifted}
    text = Chunk(_spec.CHUNK_METADATA, b"{}")  # whose id is 0, too
    return scene(1, tiles, codebooks=(colours, shapes), attributes=records, chunks=(text,))


def _summands() -> Scene:
    """Return a scene with the most negative entries and summands that compensate them."""
    far = 2**31
    table = Codebook(1, _spec.CODEBOOK_KIND_SHAPE, {0: [[-far, -far, -far, 1, 2, 3]]}, stream_coding=Stream(4))
    summands = (far + _COLUMN, far - _COLUMN + 1)
    first = replace(codebook_block(1, (0, 0), summands=summands, offsets=(_COLUMN,)), stream_coding=Stream(4))
    fine = Attribute(_spec.MAPPING_LATTICE, 2.0**-30)
    one = tile(changes={SCALES: first, QUATS: codebook_block(1)})
    return scene(tiles=[one], codebooks=(table,), attributes=attributes() | {SCALES: fine})


def _many() -> Scene:
    """Return a scene of 16,400 splats with long runs of indices and escapes."""
    n, border = 16_400, 16_384
    stream_coding = Stream(1, _RUNS)
    shapes = Codebook(2, _spec.CODEBOOK_KIND_SHAPE, {0: [[-9, -1, 0, 1, 2, 3], [9, 1, 0, 4, 5, 6]]})
    bands = Codebook(3, _spec.CODEBOOK_KIND_SH, {1: [[*range(9)], [*range(9, 0, -1)]]}, (1, 1))
    escaped = {0, border - 1, border, n - 1}

    def indices(period: int) -> tuple[int, ...]:
        return tuple(2 if i in escaped else i // period % 2 for i in range(n))

    def rows(columns: int) -> list[list[int]]:
        return [[10 * k + c for c in range(columns)] for k in range(1, 1 + len(escaped))]

    same = tile(1, 1, 1)
    blocks = {
        a: replace(b, rows=[list(b.rows[0])] * n, stream_coding=replace(b.stream_coding, transforms=_RUNS))
        for a, b in same.blocks.items()
    }
    blocks |= {
        SCALES: replace(
            codebook_block(
                2, indices(7000), signed(rows(3)), stream_coding, summands=tuple(-(i // 4000) for i in range(n))
            ),
            stream_coding=stream_coding,
        ),
        QUATS: codebook_block(2, (), signed(rows(3))),
        sh_attribute(1): codebook_block(3, indices(6000), signed(rows(9)), stream_coding),
    }
    return scene(1, [replace(same, blocks=blocks)], codebooks=(shapes, bands))


def _morton_codes() -> Scene:
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
