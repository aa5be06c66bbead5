"""Valid files: each feature of the format alone, then together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from csplat import _spec
from csplat_authoring.builder import build, chunk_names
from csplat_authoring.example import example_scene
from csplat_authoring.samples import (
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    SH0,
    Recipe,
    attributes,
    axis,
    integers,
    levels,
    means_rows,
    morton,
    offset,
    quat_rows,
    rich_scene,
    rows_of,
    scene,
    signed,
    sparse,
    tile,
)
from csplat_authoring.scene import PLAIN, Attribute, Block, Chunk, Extra, Scene, StatedErrors, Stream

_DELTA, _ZIGZAG, _PLANES, _RUNS = (
    _spec.TRANSFORM_DELTA,
    _spec.TRANSFORM_ZIGZAG,
    _spec.TRANSFORM_BYTE_PLANES,
    _spec.TRANSFORM_RUN_LENGTH,
)


def valid_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_basics(), *_codings(), *_colours(), *_files()]


def _recipe(name: str, why: str, clauses: str, made: Scene) -> Recipe:
    return Recipe(f"valid/{name}", why, tuple(clauses.split()), lambda: build(made).data, made)


def _changed(changes: dict[int, Block], n: int = 5, degree: int = 0, **records: Attribute) -> Scene:
    one = tile(2, n, degree, changes)
    made = scene(degree, [one])
    names = {_spec.ATTRIBUTE_NAMES[a]: a for a in made.attributes}
    return replace(made, attributes=made.attributes | {names[name]: record for name, record in records.items()})


def _basics() -> list[Recipe]:
    facts = replace(
        scene(),
        scene_flags=_spec.SCENE_FLAG_ANTIALIASED | _spec.SCENE_FLAG_FLAT,
        axes=(_spec.DIRECTION_RIGHT, _spec.DIRECTION_DOWN, _spec.DIRECTION_FORWARD),
        unit_metres=0.5,
        origin=(4.5e6, -1.25, 1e-3),
    )
    return [
        _recipe("worked_example", "the file that annex A reads byte by byte", "COV-2 DIR-3 TIL-4", example_scene()),
        _recipe("empty", "no splat, no tile, no chunk: the index ends the file", "IDX-7 COV-1", scene(tiles=[])),
        _recipe("empty_degree_3", "no splat, but bands and metadata", "IDX-7", scene(3, [], chunks=(_meta(b"{}"),))),
        _recipe("one_splat", "extent 0 on all axes", "TIL-10", scene(tiles=[tile(1, 1)])),
        _recipe(
            "scene_facts", "all scene flags, axes, unit, origin: the origin is not added", "IDX-4 IDX-5 IDX-6", facts
        ),
        _recipe(
            "axes_left_up_back",
            "the other three directions, in another order",
            "IDX-4",
            replace(scene(), axes=(_spec.DIRECTION_UP, _spec.DIRECTION_BACK, _spec.DIRECTION_LEFT)),
        ),
    ]


def _meta(text: bytes, how: Stream = PLAIN) -> Chunk:
    return Chunk(_spec.CHUNK_METADATA, text, how)


def _codings() -> list[Recipe]:
    wide = integers(7, 5, 0, 65535)
    square = Attribute(_spec.MAPPING_SQUARE, levels=63)
    unsorted = [[3, 0, 1], [0, 2, 0], [3, 0, 1], [1, 1, 7], [2, 0, 5]]
    rows = rows_of(11, 5, 3, -70000, 70000)
    return [
        _recipe(
            "opacities_linear", "q / M for a few levels", "LEV-1", _changed({OPACITIES: levels([0, 255, 1, 254, 128])})
        ),
        _recipe(
            "opacities_square",
            "q² / M² in binary64, rounded once",
            "LEV-1 NUM-1",
            _changed({OPACITIES: levels([0, 63, 1, 62, 31])}, opacities=square),
        ),
        _recipe(
            "opacities_two_bytes",
            "65,535 levels",
            "LEV-1 ATT-3",
            _changed({OPACITIES: levels(wide, Stream(2))}, opacities=Attribute(_spec.MAPPING_SQUARE, levels=65535)),
        ),
        _recipe(
            "means_morton",
            "codes neither sorted nor unique",
            "ORD-1 MOR-1 MOR-2",
            _changed({MEANS: morton(unsorted, 3)}),
        ),
        _recipe("means_axis", "three columns in any order", "ORD-1 AXI-1", _changed({MEANS: axis(unsorted)})),
        _recipe(
            "means_morton_sorted",
            "what an encoder writes: sorted codes, differences, byte planes",
            "MOR-2",
            _changed({MEANS: morton(sorted(means_rows(3, 5, 1023), key=_code), 10, Stream(4, (_DELTA, _PLANES)))}),
        ),
        _recipe(
            "scales_signed",
            "two's complement of three bytes",
            "LAT-4",
            _changed({SCALES: signed(_small(rows), Stream(3))}),
        ),
        _recipe(
            "scales_offset_exponent",
            "the tile's lattice is coarser than the file's",
            "LAT-1 TIL-11",
            _changed({SCALES: offset(rows_of(5, 5, 3, -9, 3), exponent=3)}),
        ),
        _recipe(
            "sh0_offset_negative_exponent",
            "offsets of their own per column, exponent below 0",
            "LAT-1 LAT-3",
            _changed({SH0: offset(rows, Stream(4), exponent=-7, offsets=(-70000, -80000, -(2**40) % 100 - 70000))}),
        ),
        _recipe(
            "quats",
            "w from the rest, not the largest component",
            "NUM-1 QUA-1 QUA-2",
            _changed(
                {QUATS: signed([[0, 0, 0], [127, 127, 0], [-127, 0, 127], [1, -1, 1], [89, 89, 2]]), **_fixed_five()},
            ),
        ),
        _recipe(
            "quats_rounding",
            "the first w differs where it is √R / M / √2, the second for √R / (M √2), √(R / 2) / M and √(R / 2M²)",
            "NUM-1 QUA-2",
            _changed(
                {QUATS: signed([[32742, 19543, 7188], [-425, 29928, -18]], Stream(2))},
                2,
                quats=Attribute(_spec.MAPPING_UNIT_W, levels=32749),
            ),
        ),
        _recipe(
            "quats_two_bytes",
            "M of 32,767 and many rotations",
            "NUM-1 ATT-4",
            _changed(
                {QUATS: signed(quat_rows(5, 40, 32767), Stream(2))},
                40,
                quats=Attribute(_spec.MAPPING_UNIT_W, levels=32767),
            ),
        ),
    ]


def _fixed_five() -> dict[int, Block]:
    return {OPACITIES: levels([9, 8, 7, 6, 5])}


def _small(rows: list[list[int]]) -> list[list[int]]:
    return [[value // 100 for value in row] for row in rows]


def _code(row: Sequence[int]) -> int:
    return sum((q >> b & 1) << 3 * b + a for a, q in enumerate(row) for b in range(17))


def _colours() -> list[Recipe]:
    result = []
    for degree in (1, 2, 3):
        made = scene(degree, [tile(6, 3, degree)])
        result.append(_recipe(f"sh_degree_{degree}", "bands by scalar quantisation", "ATT-1 TLE-2", made))
        shifted = replace(made, attributes=attributes(degree, True, degree))
        result.append(
            _recipe(
                f"sh_degree_{degree}_ycocg",
                "lifting per coefficient, Co and Cg shifted",
                "ATT-8 ATT-9",
                shifted,
            )
        )
    halves = [[0, odd, other] for odd in (-3, -1, 1) for other in (-3, -1, 1)]
    unshifted = replace(
        scene(1, [tile(6, 9, 1, {SH0: signed(halves)})]), attributes=attributes(1, ycocg=True, chroma_shift=0)
    )
    result.append(
        _recipe(
            "sh0_ycocg_odd", "halves of odd and negative Co and Cg are rounded towards −∞", "ATT-2 NUM-1", unshifted
        )
    )
    by_offset = tile(7, 3, 1, {SH0 + 1: offset(rows_of(8, 3, 9, -9, 9), exponent=2)})
    result.append(_recipe("sh1_offset", "a band with offsets and an exponent", "LAT-1", scene(1, [by_offset])))
    result += _sparse()
    lone = tile(8, 3, 0, {SH0 + 2: signed(rows_of(9, 3, 15, -9, 9))})
    result.append(_recipe("absent_band", "band 1 left out, band 2 there", "TIL-4", scene(2, [lone])))
    result.append(_recipe("absent_bands", "degree 3 and no band at all: zeros", "TIL-4", scene(3, [tile(9, 3, 0)])))
    mixed = scene(2, [tile(1, 2, 2), tile(2, 3, 0), tile(3, 1, 1)])
    result.append(_recipe("absent_in_some_tiles", "each tile with layers of its own", "TIL-4 TIL-2", mixed))
    return result


def _sparse() -> list[Recipe]:
    """Bands of some splats: masks that end within a byte, with it, and behind it."""
    masks = (0, 1, 0, 0, 1, 1, 0), (1, 0, 0, 0, 0, 0, 0, 1), (0, 0, 0, 0, 0, 0, 0, 0, 1)
    made = [
        _recipe(
            f"sparse_{len(mask)}",
            f"a mask of {len(mask)} splats, {sum(mask)} of which have the band",
            "SPA-1 SPA-2 SPA-3",
            scene(1, [tile(8, len(mask), 0, {SH0 + 1: sparse(mask, rows_of(7, sum(mask), 9, -99, 99))})]),
        )
        for mask in masks
    ]
    long = (0,) * 400 + (1,) * 24 + (0,) * 76
    values = rows_of(3, 24, 15, -300, 300)
    runs = sparse(long, values, Stream(2, (_ZIGZAG, _PLANES)), Stream(1, (_RUNS,)), exponent=-3)
    far = scene(2, [tile(2, 500, 0, {SH0 + 2: runs})])
    made.append(_recipe("sparse_runs", "a mask of runs, an exponent", "SPA-2 LAT-1", far))
    zero = sparse((1, 1, 0), [[0] * 21, rows_of(4, 1, 21, -9, 9)[0]])
    whole = tile(1, 3, 0, {SH0 + 1: sparse((1, 1, 1), rows_of(5, 3, 9, -9, 9)), SH0 + 3: zero})
    ycocg = replace(scene(3, [whole]), attributes=attributes(3, ycocg=True, chroma_shift=1))
    made.append(_recipe("sparse_all", "a mask of ones, and zeros that the mask names", "SPA-1", ycocg))
    return made


def _files() -> list[Recipe]:
    rich = rich_scene()
    names = chunk_names(rich)
    two = scene(1, [tile(1, 2, 1), tile(5, 3, 1, corner=(7, -7, 0), exponent=-2)])
    dtypes = tuple(Extra(f"column {name}", value) for value, name in _spec.EXTRA_DTYPE_NAMES.items())
    sizes = [_spec.EXTRA_DTYPE_BYTES[extra.dtype] for extra in dtypes]
    columns = tuple(Block(_spec.CODING_RAW, [[2 ** (8 * k) - 1], [3]], Stream(k)) for k in sizes)
    text = '{"title":"\\u00e9 é","comments":["a","b"],"n":[1,2.5e3,null,true,{}]}'.encode()
    camera = b'[{"K":[[9,0,4],[0,9,3],[0,0,1]],"viewmat":[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]],"W":8,"H":6}]'
    stated = StatedErrors(9, 7, 4, _spec.ERROR_FLAG_REFITTED, tuple((m, 0.5, 0.375) for m in _spec.MEASURE_NAMES))
    bounds = tuple(
        (measure, largest, largest * math.sqrt(components) * (1.0 + 2.0**-20))
        for measure, components, largest in (
            (_spec.MEASURE_SH0, 3, 0.1845703125),
            (_spec.MEASURE_SH2, 15, 0.0029296875),
            (_spec.MEASURE_SH3, 21, 0.0029296875),
        )
    )
    return [
        _recipe("two_tiles", "tiles with corners and exponents of their own", "TIL-7 TIL-9 IDX-7", two),
        _recipe(
            "rich",
            "codebooks, escapes, an absent layer, extras, chunks, all together",
            "CBK-3 TIL-5 TIL-6 SER-4",
            rich,
        ),
        _recipe(
            "chunks_reversed",
            "the same, every chunk before those it depends on",
            "COV-2",
            replace(rich, order=tuple(reversed(names))),
        ),
        _recipe(
            "directory_reversed",
            "directory records in another order than the chunks",
            "COV-2 DIR-5",
            _directory_reversed(rich),
        ),
        _recipe(
            "extras",
            "each type of extra column, all bits set: NaN among the floats",
            "TIL-5 RAW-1 RAW-2 EXR-2",
            scene(tiles=[tile(extras=columns)], extras=dtypes),
        ),
        _recipe("metadata", "JSON with escapes, UTF-8 and every kind of value", "JSN-1", scene(chunks=(_meta(text),))),
        _recipe(
            "metadata_coded",
            "JSON through all transforms and DEFLATE",
            "JSN-1 STR-8",
            scene(chunks=(_meta(text, Stream(1, (_DELTA, _ZIGZAG, _PLANES, _RUNS), "deflate_fixed")),)),
        ),
        _recipe(
            "cameras",
            "an array of cameras, and options",
            "JSN-1 DIR-4",
            scene(chunks=(Chunk(_spec.CHUNK_CAMERAS, camera), Chunk(_spec.CHUNK_OPTIONS, b'{"seed":0}'))),
        ),
        _recipe(
            "stated_errors",
            "every measure, a source of degree 4, a flag",
            "SER-1 SER-2 SER-3 SER-4",
            scene(chunks=(Chunk(_spec.CHUNK_STATED_ERRORS, errors=stated),)),
        ),
        _recipe(
            "stated_errors_at_bound",
            "rms as large as it may be; two other orders of the product bound it more tightly",
            "SER-2 NUM-1",
            scene(chunks=(Chunk(_spec.CHUNK_STATED_ERRORS, errors=StatedErrors(2, 0, 3, 0, bounds)),)),
        ),
        _recipe(
            "unknown_chunks",
            "private and unknown chunks, twice the same, some like known ones, with any id and layer: skipped",
            "DIR-1 DIR-3 CHK-2",
            scene(
                chunks=(
                    Chunk(b"priv", payload=b"abc", flags=_spec.CHUNK_FLAG_SAFE_TO_COPY),
                    Chunk(b"Z ~!", flags=0, id=1, layer=3),
                    *(
                        Chunk(kind[:3] + b"X", flags=0)
                        for kind in (_spec.CHUNK_TILE, _spec.CHUNK_CODEBOOK, _spec.CHUNK_METADATA)
                    ),
                    Chunk(b"priv", payload=b"d", flags=0, id=65535, layer=255),
                )
            ),
        ),
    ]


def _directory_reversed(made: Scene) -> Scene:
    listed = [name for name in chunk_names(made) if not name.startswith("TILE.")]
    return replace(made, directory=tuple(reversed(listed)))
