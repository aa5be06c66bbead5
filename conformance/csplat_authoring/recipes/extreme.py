"""Valid files at the limits, or of a kind that no sensible encoder writes: numbers and tiles."""

from __future__ import annotations

from dataclasses import replace
from sys import float_info

from csplat import _spec
from csplat_authoring.builder import build
from csplat_authoring.samples import (
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    SH0,
    Recipe,
    axis,
    coded,
    levels,
    morton,
    offset,
    scene,
    signed,
    single,
    sparse,
    tile,
)
from csplat_authoring.scene import Attribute, Block, Chunk, Extra, Scene, StatedErrors, Stream

_RUNS = (_spec.TRANSFORM_RUN_LENGTH,)
_MAX = _spec.INTEGER_MAX
_SINGLE_LARGEST = float(2**128 - 2**104)
_LARGEST = float_info.max


def extreme_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_numbers(), *_single(), *_facts(), *_tiles()]


def _recipe(name: str, why: str, clauses: str, made: Scene) -> Recipe:
    return Recipe(f"extreme/{name}", why, tuple(clauses.split()), lambda: build(made).data, made)


def _with(changes: dict[int, Block], n: int = 3, records: dict[int, Attribute] | None = None, **rest: object) -> Scene:
    made = scene(tiles=[replace(tile(2, n, 0, changes), **rest)])  # type: ignore[arg-type]  # fields of Tile
    return replace(made, attributes=made.attributes | (records or {}))


def _lattice(step: float, mapping: int = _spec.MAPPING_LATTICE, chroma_shift: int = 0) -> Attribute:
    return Attribute(mapping, step, chroma_shift=chroma_shift)


def _numbers() -> list[Recipe]:
    tiny = 2.0**-1022
    far = {MEANS: _lattice(2.0**-30)}
    near = axis([[0, 1, 0], [2, 0, 1], [3, 1, 0]])
    box = {MEANS: axis([[0, 2**24 - 1, 0], [2**24 - 1, 0, 5], [77, 1, 2**24 - 1]], Stream(3))}
    column = _spec.COLUMN_MAX
    lifted = _lattice(2.0**-30 / 3.0, _spec.MAPPING_YCOCG)
    lifted = replace(lifted, step=single(lifted.step))
    shifted = _lattice(0.5, _spec.MAPPING_YCOCG, 16)
    return [
        _recipe(
            "corner_at_2_53",
            "lattice integers of 2^53, by a corner alone and with an extent, and of −2^53",
            "TIL-7 MEA-1",
            _with({MEANS: axis([[0, 1, 0], [1, 0, 0], [0, 0, 0]])}, records=far, corner=(_MAX - 1, -_MAX, _MAX)),
        ),
        _recipe(
            "extent_24_bits",
            "the largest extent on each axis",
            "TIL-8 AXI-1 TIL-10",
            _with(box, corner=(-(2**52), 1, -1)),
        ),
        _recipe(
            "morton_17_bits",
            "51-bit codes in seven bytes",
            "MOR-1 MOR-2",
            _with({MEANS: morton([[2**17 - 1, 0, 2**17 - 1], [0, 2**17 - 1, 0], [2**16, 1, 3]], 17, Stream(7))}),
        ),
        _recipe(
            "morton_1_bit",
            "codes of three bits",
            "MOR-1 MOR-2",
            _with({MEANS: morton([[1, 0, 0], [0, 1, 1], [1, 1, 0]], 1, Stream(1))}),
        ),
        _recipe(
            "morton_wide_bits",
            "more bits than the extent needs",
            "MOR-1",
            _with({MEANS: morton([[1, 0, 0], [0, 1, 1], [1, 1, 0]], 17, Stream(1))}),
        ),
        _recipe(
            "step_smallest",
            "values that vanish in binary32: zeros of either sign",
            "ATT-6 TIL-11",
            _with({MEANS: near}, corner=(-3, -1, 0), exponent=0, records={MEANS: _lattice(tiny)}),
        ),
        _recipe(
            "exponent_beyond_1023",
            "2^exponent alone overflows binary64, step × 2^exponent does not",
            "TIL-9 ATT-6",
            _with({MEANS: near}, corner=(-3, -1, 0), exponent=1040, records={MEANS: _lattice(2.0**-1000)}),
        ),
        _recipe(
            "exponent_below_1074",
            "2^exponent alone vanishes, step × 2^exponent does not",
            "TIL-9",
            _with({MEANS: near}, corner=(-3, -1, 0), exponent=-1080, records={MEANS: _lattice(1.75 * 2.0**1000)}),
        ),
        _recipe(
            "exponent_beyond_127",
            "2^exponent alone overflows binary32, step × 2^exponent does not",
            "LAT-1 ATT-10",
            _with({SH0: signed([[0, 0, 0], [1, -1, 0], [-1, 0, 1]], exponent=240)}, records={SH0: _lattice(2.0**-120)}),
        ),
        _recipe(
            "exponent_below_149",
            "2^exponent alone vanishes in binary32, step × 2^exponent does not",
            "LAT-1",
            _with(
                {SH0: signed([[0, 9, 0], [1, -1, 0], [-1, 0, 1]], exponent=-240)},
                records={SH0: _lattice(1.75 * 2.0**120)},
            ),
        ),
        *(
            _recipe(
                f"exponents_{name}",
                f"{which} exponents of SIGNED and SPARSE: steps of 2^{power} and some more",
                "LAT-1",
                scene(
                    1,
                    [
                        tile(
                            2,
                            3,
                            1,
                            {
                                SH0: signed([[0, 1, 0], [1, -1, 0], [-1, 0, 1]], exponent=power + 6),
                                SH0 + 1: sparse((1, 0, 1), [[1, 0, -1] * 3] * 2, exponent=power + 7),
                            },
                        )
                    ],
                ),
            )
            for name, which, power in (("least", "the smallest", -126), ("most", "the largest", 127))
        ),
        _recipe(
            "single_step_smallest",
            "scales and colours whose step is the smallest normal number of binary32",
            "ATT-10 TIL-11",
            _with(
                {SCALES: signed([[-1, -2, -3], [-9, -1, -1], [-5, -5, -5]])},
                records={SCALES: _lattice(2.0**-126), SH0: _lattice(2.0**-126)},
            ),
        ),
        _recipe(
            "single_step_largest",
            "colours on the largest step of binary32, whose integers are 1, 0 and −1",
            "ATT-10 LAT-5",
            _with({SH0: signed([[0, 1, 0], [1, -1, 0], [-1, 0, 1]])}, records={SH0: _lattice(_SINGLE_LARGEST)}),
        ),
        _recipe(
            "step_largest_lattice_zero",
            "the largest step, on a lattice whose only integer is 0",
            "TIL-9 ATT-6",
            _with({MEANS: axis([[0, 0, 0]] * 3)}, corner=(0, 0, 0), exponent=0, records={MEANS: _lattice(_LARGEST)}),
        ),
        _recipe(
            "subnormal_values",
            "products that binary32 holds as subnormals",
            "NUM-1",
            _with(
                {MEANS: axis([[0, 9, 3], [99, 0, 100], [33, 7, 0]])},
                corner=(-7, 0, 2),
                exponent=0,
                records={MEANS: _lattice(1.1 * 2.0**-149)},
            ),
        ),
        _recipe(
            "ties_to_even",
            "float32 halfway cases: of large integers, and of products",
            "NUM-1",
            _with(
                {
                    MEANS: axis([[0, 0, 0], [2, 2, 5], [2**23, 6, 1]], Stream(3)),
                    SH0: signed([[3, -3, 5], [7, 9, -11], [2**21 + 1, 0, 1]], Stream(4)),
                },
                corner=(2**24 + 1, -(2**25) - 6, 0),
                exponent=0,
                records={MEANS: _lattice(1.0), SH0: _lattice(1.0 + 2.0**-23)},
            ),
        ),
        _recipe(
            "column_limits",
            "colour columns of ±2^22 through the lifting",
            "LAT-3 LAT-4",
            _with({SH0: _limits(column)}, records={SH0: lifted}),
        ),
        _recipe(
            "chroma_shift_16",
            "the coarsest chroma, negative and odd",
            "ATT-8 LAT-4",
            _with({SH0: signed([[1, -1, 3], [0, 2**6, -(2**6)], [-5, 7, -7]], Stream(4))}, records={SH0: shifted}),
        ),
        _recipe(
            "levels_of_one",
            "a single level of opacity",
            "ATT-3",
            _with({OPACITIES: levels([0, 1, 1])}, records={OPACITIES: Attribute(_spec.MAPPING_SQUARE, levels=1)}),
        ),
        _recipe(
            "quats_three_levels",
            "the smallest M; R of 0 makes w +0",
            "ATT-4 QUA-2",
            _with(
                {QUATS: signed([[3, 3, 0], [-3, 0, 3], [1, -2, 3]])},
                records={QUATS: Attribute(_spec.MAPPING_UNIT_W, levels=3)},
            ),
        ),
        _recipe(
            "quats_all_levels",
            "R of 0 at M = 32,767",
            "QUA-1 QUA-2",
            _with(
                {QUATS: signed([[32767, -32767, 0], [0, 0, 32767], [18918, 18918, -18918]], Stream(2))},
                records={QUATS: Attribute(_spec.MAPPING_UNIT_W, levels=32767)},
            ),
        ),
    ]


def _single() -> list[Recipe]:
    """Values that single precision gets wrong in the order that comes to mind first (9.2)."""
    far = axis([[0, 0, 0], [2**23 - 1, 1, 2**24 - 2], [2**23 + 1, 2, 2**24 - 1], [2**24 - 1, 3, 1]], Stream(3))
    small = signed([[32763, 32753, 1086], [-32747, 32642, -3080], [849, -32760, 32763], [0, 0, 1]], Stream(2))
    return [
        _recipe(
            "means_cancelling",
            "a box around 0, whose corner and rest cancel, and integers that binary32 cannot hold, between two steps",
            "MEA-1 NUM-1 CNF-7",
            _with(
                {MEANS: far},
                4,
                corner=(-(2**23), 2**25, _MAX - 2**24),
                exponent=0,
                records={MEANS: _lattice((1 + 2.0**-24 + 2.0**-40) * 2.0**-20)},
            ),
        ),
        _recipe(
            "quats_small_w",
            "R of 4, 5 and 8 beside squares of 2^30: w is what a rounded R or 1 − x² − y² − z² loses",
            "QUA-2 CNF-7",
            _with({QUATS: small}, 4, records={QUATS: Attribute(_spec.MAPPING_UNIT_W, levels=32767)}),
        ),
        _recipe(
            "mean_nearly_infinite",
            "the largest number of binary32; the factors, each rounded to binary32, overflow",
            "MEA-1 CNF-7 CNF-8",
            _with(
                {MEANS: axis([[0, 0, 0], [1, 0, 0], [2, 0, 0]])},
                corner=(2**25 + 1, 0, 0),
                exponent=0,
                records={MEANS: _lattice(float(2**128 - 2**103) / (2**25 + 3) * (1 - 2.0**-50))},
            ),
        ),
    ]


def _facts() -> list[Recipe]:
    errors = ((_spec.MEASURE_MEANS, _LARGEST, _LARGEST), (_spec.MEASURE_OPACITIES, 0.0, 0.0))
    return [
        _recipe(
            "origin_largest",
            "the largest numbers of binary64 as origin and unit",
            "IDX-5 IDX-6",
            scene(unit_metres=_LARGEST, origin=(_LARGEST, -_LARGEST, 0.0)),
        ),
        _recipe(
            "error_bounds",
            "stated errors of 0 and of the largest number, whose product with the components overflows",
            "SER-2",
            scene(chunks=(Chunk(_spec.CHUNK_STATED_ERRORS, errors=StatedErrors(2, records=errors)),)),
        ),
    ]


def _limits(column: int) -> Block:
    return offset([[column, column, -column]] * 3, Stream(1), offsets=(column, column, -column))


def _tiles() -> list[Recipe]:
    n = _spec.TILE_SPLATS_MAX
    same = tile(1, 1)
    full = {a: replace(b, rows=[list(b.rows[0])] * n) for a, b in same.blocks.items()}
    full |= {QUATS: signed([[1, 2, 3]] * (n - 1) + [[9, 9, 9]])}
    full |= {SH0 + 1: sparse((1,) * n, [[5] * 9] * n, mask_how=Stream(1, _RUNS))}
    many = [tile(k, 1, k % 2, corner=(k, -k, 2 * k), exponent=k % 5 - 2) for k in range(24)]
    extras = tuple(Extra("x" * _spec.EXTRA_NAME_MAX if i == 0 else f"é{i}", _spec.EXTRA_DTYPE_U8) for i in range(9))
    alike = tuple(Extra(name, _spec.EXTRA_DTYPE_U8) for name in ("é", "e\u0301", "a", "\ufeffa", "%61", "a ", "(a)"))
    raws = tuple(Block(_spec.CODING_RAW, [[i], [255 - i]]) for i in range(9))
    return [
        _recipe(
            "tile_of_65536",
            "a full tile, one run after the other",
            "TIL-1 STR-5 TRF-1 SPA-1",
            coded(scene(1, tiles=[replace(same, blocks=full)]), lambda how: replace(how, transforms=_RUNS)),
        ),
        _recipe("tiles_of_one", "many tiles, each with layers and exponents of its own", "TIL-1 TIL-4", scene(1, many)),
        _recipe(
            "extra_names",
            "a name of 62 bytes, names beyond ASCII, nine columns",
            "EXR-1 EXR-2",
            scene(tiles=[tile(extras=raws)], extras=extras),
        ),
        _recipe(
            "extra_names_alike",
            "names that only a decoder which normalises, strips a mark or decodes percents takes for the same",
            "EXR-2",
            scene(tiles=[tile(extras=raws[: len(alike)])], extras=alike),
        ),
    ]
