"""Invalid files: blocks and decoded values."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from csplat import _spec
from csplat_authoring.broken import patched, rich, small, whole
from csplat_authoring.builder import build
from csplat_authoring.samples import (
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    SH0,
    Recipe,
    attributes,
    axis,
    book,
    levels,
    morton,
    offset,
    rows_of,
    scene,
    sh_attribute,
    signed,
    sparse,
    tile,
)
from csplat_authoring.scene import Attribute, Block, Codebook, Extra, Scene, Stream

_STREAM = "TILE.0.0/opacities.stream"


def block_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_blocks(), *_values(), *_extras(), *_sparse()]


def _blocks() -> list[Recipe]:
    base = small()
    order = (OPACITIES, QUATS, SCALES, MEANS, SH0)
    one = tile()
    swapped = scene(tiles=[replace(one, order=order)])
    four = scene(tiles=[replace(one, order=(OPACITIES, SCALES, QUATS, MEANS))])
    coding = "TILE.0.0/{}.coding".format
    cut = scene(tiles=[replace(one, tails=((0, b"\0"),))])
    two = build(scene(1, [tile(degree=1)]))
    exponent = "TILE.0.0/sh0.params.exponent"
    zeros = scene(tiles=[tile(changes={SH0: signed([[0, 0, 0]] * 2, exponent=134)})])
    return [
        whole("blocks_swapped", "rotations before scales", "TLE-2", "E_STREAM", swapped, "TILE.0.0/quats.attribute"),
        whole("block_missing", "layer 0 without sh0", "TLE-2", "E_STREAM", four, "TILE.0.0/head.block_count"),
        patched(
            "block_count_zero", "a layer without blocks", "TLE-2", "E_STREAM", base, {"TILE.0.0/head.block_count": 0}
        ),
        patched(
            "block_of_other_band",
            "band 2 in the layer of band 1",
            "TLE-2",
            "E_STREAM",
            two,
            {"TILE.0.1/sh1.attribute": sh_attribute(2)},
        ),
        patched(
            "block_count",
            "six blocks announced, five there",
            "TLE-2",
            "E_STREAM",
            base,
            {"TILE.0.0/head.block_count": 6},
        ),
        whole("tile_tail", "a byte after the last block", "TLE-3", "E_STREAM", cut, "TILE.0.0/tail"),
        patched(
            "coding_of_another",
            "scales coded MORTON",
            "BLK-1",
            "E_VALUE",
            base,
            {coding("scales"): _spec.CODING_MORTON},
        ),
        patched(
            "coding_offset_quats",
            "quats coded OFFSET",
            "BLK-1",
            "E_VALUE",
            base,
            {coding("quats"): _spec.CODING_OFFSET},
        ),
        whole("lattice_exponent_high", "the step overflows binary32", "LAT-1", "E_VALUE", zeros, exponent),
        patched(
            "lattice_exponent_low",
            "the step is subnormal in binary32",
            "LAT-1",
            "E_VALUE",
            base,
            {exponent: -121},
        ),
        patched("lattice_exponent_highest", "the largest exponent", "LAT-1", "E_VALUE", base, {exponent: 32767}),
        patched("lattice_exponent_lowest", "the smallest exponent", "LAT-1", "E_VALUE", base, {exponent: -32768}),
        patched(
            "escape_exponent",
            "an exponent in an escape block",
            "LAT-2",
            "E_VALUE",
            rich(),
            {"TILE.0.1/sh1.escape.params.exponent": -1},
        ),
        patched(
            "summand_exponent",
            "an exponent for the summand of a shape",
            "LAT-2",
            "E_VALUE",
            rich(),
            {"TILE.0.0/scales.summand.exponent": 1},
        ),
    ]


def _values() -> list[Recipe]:
    base = small()
    column = _spec.COLUMN_MAX
    offsets = "TILE.0.0/sh0.offsets"
    at_limit = offset([[column, 0, 0], [column + 1, 0, 0]], offsets=(column, 0, 0))
    limit, far = Attribute(_spec.MAPPING_LATTICE, 2.0**-30), Attribute(_spec.MAPPING_LATTICE, 2.0**100)
    shifted = offset([[0, 2**6, 0], [0, 2**6 + 1, 0]], offsets=(0, 2**6, 0))
    rgb, m = scene().attributes[SH0], 127

    def quats(name: str, why: str, clause: str, row: list[int], code: str = "E_RANGE") -> Recipe:
        made = _with({QUATS: signed([[0, 0, 0], row], Stream(2))})
        return whole(name, why, clause, code, made, "TILE.0.0/quats.stream.width")

    return [
        whole(
            "opacity_above_levels",
            "a level of M + 1",
            "LEV-1",
            "E_RANGE",
            _with({OPACITIES: levels([0, 256], Stream(2))}),
            f"{_STREAM}.width",
        ),
        whole(
            "morton_code",
            "a code beyond its bits",
            "MOR-2",
            "E_RANGE",
            _with({MEANS: morton([[0, 2, 0], [1, 0, 1]], 1)}),
            "TILE.0.0/means.stream.width",
        ),
        whole(
            "offset_too_large",
            "an offset of 2^22 + 1",
            "LAT-3",
            "E_VALUE",
            _with({SH0: offset([[column + 1, 0, 0]] * 2)}, {SH0: limit}),
            offsets,
        ),
        patched("offset_smallest", "an offset of −2^31", "LAT-3", "E_VALUE", base, {offsets: (-(2**31), 0, 0)}),
        whole(
            "integer_too_large",
            "an integer of 2^22 + 1",
            "LAT-4",
            "E_RANGE",
            _with({SH0: at_limit}, {SH0: limit}),
            "TILE.0.0/sh0.stream.width",
        ),
        whole(
            "chroma_too_large",
            "2^22 + 2^16 after the chroma shift",
            "LAT-4",
            "E_RANGE",
            _with({SH0: shifted}, {SH0: Attribute(_spec.MAPPING_YCOCG, 2.0**-30, chroma_shift=16)}),
            "TILE.0.0/sh0.stream.width",
        ),
        whole(
            "value_beyond_float32",
            "a colour above binary32",
            "LAT-5",
            "E_RANGE",
            _with(
                {SH0: signed([[0, 0, 0], [0, 0, 2**22]], Stream(4))},
                {SH0: replace(rgb, step=2.0**106)},
            ),
            "TILE.0.0/sh0.stream.width",
        ),
        whole(
            "value_rounds_to_infinity",
            "a colour that rounds up to infinity",
            "LAT-5",
            "E_RANGE",
            _with({SH0: signed([[0, 0, 0], [0, 0, -31]])}, {SH0: replace(far, step=1082401 * 2.0**103)}),
            "TILE.0.0/sh0.stream.width",
        ),
        whole(
            "mean_beyond_float32",
            "a centre above binary32",
            "MEA-1",
            "E_RANGE",
            scene(tiles=[tile(corner=(2**50, 0, 0))], attributes=attributes() | {MEANS: far}),
            "TILE.0.0/means.stream.width",
        ),
        whole(
            "mean_rounds_to_infinity",
            "a centre that rounds up to infinity; cut to binary32 it is finite",
            "MEA-1 CNF-8",
            "E_RANGE",
            _with(
                {MEANS: axis([[0, 0, 0], [31, 0, 0]])},
                {MEANS: replace(attributes()[MEANS], step=1082401 * 2.0**103)},
                corner=(0, 0, 0),
                exponent=0,
            ),
            "TILE.0.0/means.stream.width",
        ),
        quats("quat_component", "a component of M + 1", "QUA-1", [m + 1, 0, 0]),
        quats("quat_component_negative", "a component of −M − 1", "QUA-1", [0, -m - 1, 0]),
        quats("quat_component_last", "a third component of M + 1", "QUA-1", [0, 0, m + 1]),
        quats("quat_component_smallest", "a component of −2^15", "QUA-1", [0, 0, -(2**15)]),
        quats("quat_radicand", "R below 0", "QUA-2", [m, m, 1]),
        quats("quat_all_m", "three components of M", "QUA-2", [-m, m, -m]),
    ]


def _extras() -> list[Recipe]:
    made = scene(
        tiles=[tile(extras=(Block(_spec.CODING_RAW, [[1], [2]], Stream(2)),))],
        extras=(Extra("a", _spec.EXTRA_DTYPE_U8),),
    )
    return [
        patched(
            "extra_column",
            "the block names another column",
            "RAW-1",
            "E_STREAM",
            rich(),
            {"TILE.0.8/extra[0].params.column": 1},
        ),
        whole(
            "extra_width", "two bytes for a column of one", "RAW-2", "E_STREAM", made, "TILE.0.8/extra[0].stream.width"
        ),
    ]


def _sparse() -> list[Recipe]:
    sh1, rows = SH0 + 1, rows_of(1, 2, 9, -9, 9)
    params, mask = "TILE.0.1/sh1.params", "TILE.0.1/sh1.mask.width"

    def one(block: Block) -> Scene:
        return scene(1, [tile(1, 3, 0, {sh1: block})])

    def range_(name: str, why: str, clause: str, bits: tuple[int, ...]) -> Recipe:
        return whole(f"sparse_{name}", why, clause, "E_RANGE", one(sparse(bits, rows)), mask)

    made = one(sparse((1, 0, 1), rows))
    base, few, many = build(made), {f"{params}.present_count": 1}, {f"{params}.present_count": 4}
    zeros = one(sparse((1, 0, 1), [[0] * 9] * 2, exponent=135))
    escape = one(book(1, (0, 2, 1), sparse((1,), rows[:1])))
    table = Codebook(1, _spec.CODEBOOK_KIND_SH, {1: rows_of(2, 2, 9, -9, 9)}, (1, 1))
    far = one(sparse((1, 0, 1), [[2**20] * 9] * 2, Stream(4)))
    limit = far.attributes | {sh1: Attribute(_spec.MAPPING_LATTICE, 2.0**115)}
    return [
        patched("sparse_count", "four of three splats", "SPA-1", "E_VALUE", base, many),
        whole("sparse_exponent", "the step overflows", "LAT-1", "E_VALUE", zeros, f"{params}.exponent"),
        patched("sparse_exponent_low", "a subnormal step", "LAT-1", "E_VALUE", base, {f"{params}.exponent": -120}),
        patched("sparse_fewer", "less than the mask names", "SPA-2", "E_RANGE", base, few, at=mask),
        range_("missing", "the mask names one splat, two have values", "SPA-2", (1, 0, 0)),
        range_("several", "the mask names three splats, two have values", "SPA-2", (1, 1, 1)),
        range_("beyond", "a bit behind the last splat", "SPA-3", (1, 0, 1, 1)),
        whole(
            "sparse_escape",
            "an escape block coded SPARSE",
            "CBK-5",
            "E_STREAM",
            replace(escape, codebooks=(table,)),
            "TILE.0.1/sh1.escape.coding",
        ),
        whole(
            "sparse_value_beyond_float32",
            "values that overflow",
            "LAT-5",
            "E_RANGE",
            replace(far, attributes=limit),
            "TILE.0.1/sh1.stream.width",
        ),
    ]


def _with(changes: dict[int, Block], records: dict[int, Attribute] | None = None, **rest: Any) -> Scene:
    made = scene(tiles=[tile(changes=changes, **rest)])
    return replace(made, attributes=made.attributes | (records or {}))
