"""Invalid files: head of the index and attribute records."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from csplat import _spec
from csplat_authoring.broken import patched, small, whole
from csplat_authoring.builder import build
from csplat_authoring.samples import SCALES, SH0, Recipe, scene, signed, tile
from csplat_authoring.scene import Block, Stream

_SPLAT_BYTES = 4 * (3 + 4 + 3 + 1 + 48)  # in the arrays of section 3, at SH degree 3
_NAN, _INF = float("nan"), float("inf")


def index_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_index(), *_attributes(), _arrays_beyond_budget()]


def _index() -> list[Recipe]:
    base = small()
    index_size = _spec.unpack_header(base.data).index_size
    padded = build(scene(gap=bytes(4)))
    return [
        patched("index_crc", "the index's CRC alone is wrong", "IDX-1 HDR-12", "E_CRC", base, {"index.crc": 1}),
        patched(
            "index_rest",
            "four bytes of the index belong to no record",
            "IDX-2",
            "E_INDEX",
            padded,
            {"header.index_size": index_size + 4},
            at="index.crc",
        ),
        patched(
            "index_tile_count",
            "more tile records than the index holds",
            "IDX-2",
            "E_INDEX",
            base,
            {"index.tile_count": 2},
            at="index.head_size",
        ),
        patched(
            "index_tile_count_huge",
            "2^32 − 1 tile records",
            "IDX-2",
            "E_INDEX",
            base,
            {"index.tile_count": 2**32 - 1},
            ("E_LIMIT",),
            at="index.head_size",
        ),
        patched(
            "index_tile_count_by_layers",
            "a second tile record announced, room for which the layers of the first take",
            "IDX-2",
            "E_INDEX",
            build(scene(3)),
            {"index.tile_count": 2},
            at="index.crc",
        ),
        patched(
            "index_table_count_huge",
            "65,535 table ids",
            "IDX-2",
            "E_INDEX",
            base,
            {"tile[0].table_count": 65535},
            at="tile[0].splat_count",
        ),
        patched(
            "index_directory_count_huge",
            "65,535 directory records",
            "IDX-2",
            "E_INDEX",
            base,
            {"index.directory_count": 65535},
            ("E_VALUE",),  # the records that follow, read as chunk records, break DIR-1
            at="index.head_size",
        ),
        patched(
            "axes_one_unspecified",
            "two directions and one unspecified",
            "IDX-4",
            "E_VALUE",
            base,
            {"index.axes": bytes([1, 4, 0])},
        ),
        patched("axes_same_line", "left and right", "IDX-4", "E_VALUE", base, {"index.axes": bytes([1, 2, 5])}),
        patched("unit_nan", "a unit that is no number", "IDX-5", "E_VALUE", base, {"index.unit_metres": _NAN}),
        patched(
            "origin_nan",
            "an origin that is no number",
            "IDX-6",
            "E_VALUE",
            base,
            {"index.origin": (0.0, 0.0, _NAN)},
            within=16,
        ),
        patched("splat_count", "N is not the sum of the tiles", "IDX-7", "E_INDEX", base, {"index.splat_count": 3}),
        patched(
            "splat_count_huge",
            "2^64 − 1 splats in one small tile",
            "IDX-7",
            "E_INDEX",
            base,
            {"index.splat_count": 2**64 - 1},
            ("E_LIMIT",),
        ),
    ]


def _attributes() -> list[Recipe]:
    base = small()
    made = scene()
    step = "attribute[means].step"
    swapped = dict(reversed(made.attributes.items()))
    missing = {a: r for a, r in made.attributes.items() if a != _spec.ATTRIBUTE_SH0}
    return [
        whole(
            "attributes_order",
            "attribute records in descending order",
            "ATT-1",
            "E_INDEX",
            replace(made, attributes=swapped),
            "attribute[sh0].attribute",
        ),
        whole(
            "attributes_missing",
            "no record for sh0",
            "ATT-1",
            "E_INDEX",
            replace(made, attributes=missing),
            "index.attribute_count",
        ),
        patched(
            "attribute_twice",
            "the record of scales names opacities",
            "ATT-1",
            "E_INDEX",
            base,
            {"attribute[scales].attribute": _spec.ATTRIBUTE_OPACITIES},
        ),
        patched(
            "attribute_reserved",
            "band 4 in place of sh0",
            "ATT-1",
            "E_INDEX",
            base,
            {"attribute[sh0].attribute": _spec.ATTRIBUTE_SH4},
            ("E_UNSUPPORTED",),
        ),
        patched(
            "sh_degree_without_records",
            "degree 1 with the records of degree 0",
            "ATT-1",
            "E_INDEX",
            base,
            {"index.sh_degree": 1},
            at="index.attribute_count",
        ),
        patched(
            "mapping_of_another",
            "scales as YCOCG",
            "ATT-2",
            "E_VALUE",
            base,
            {"attribute[scales].mapping": _spec.MAPPING_YCOCG},
        ),
        patched("step_zero", "a step of 0", "ATT-6", "E_VALUE", base, {step: 0.0}),
        patched("step_negative", "a step below 0", "ATT-6", "E_VALUE", base, {step: -1.0}),
        patched(
            "step_of_colours",
            "a step that is no binary32 value",
            "ATT-10",
            "E_VALUE",
            base,
            {"attribute[sh0].step": 0.1},
        ),
        patched("step_nan", "a step that is no number", "ATT-6", "E_VALUE", base, {"attribute[sh0].step": _NAN}),
        patched(
            "level_step_minus_zero",
            "a step of −0 for quats",
            "ATT-7",
            "E_RESERVED",
            base,
            {"attribute[quats].step": -0.0},
        ),
        patched(
            "chroma_shift_of_rgb",
            "a chroma shift for R, G, B",
            "ATT-9",
            "E_VALUE",
            base,
            {"attribute[sh0].chroma_shift": 1},
        ),
    ]


def _full_runs(block: Block) -> Stream:
    """Return the stream of a full tile whose splats are all like the one of a block."""
    (row,) = block.rows
    return Stream(1, (_spec.TRANSFORM_RUN_LENGTH,), packed=bytes(q & 255 for q in row) + b"\xff\xff" * len(row))


def _arrays_beyond_budget() -> Recipe:
    """Return a sound file of SH degree 3 whose arrays exceed the default budget; splats of a tile are all the same."""
    tiles = _spec.BUDGET_BYTES // (_SPLAT_BYTES * _spec.TILE_SPLATS_MAX) + 1
    one = tile(1, 1, 0, {SCALES: signed([[-4, -5, -6]]), SH0: signed([[7, 8, 9]])})
    run = {attribute: replace(block, how=_full_runs(block)) for attribute, block in one.blocks.items()}

    @cache
    def data() -> bytes:
        built = build(scene(3, tiles=[*[replace(one, blocks=run)] * tiles, one]))
        n = _spec.TILE_SPLATS_MAX
        changes = {"index.splat_count": tiles * n + 1}
        for i in range(tiles):
            changes[f"tile[{i}].splat_count"] = n
            for attribute, block in run.items():
                stream = f"TILE.{i}.0/{_spec.ATTRIBUTE_NAMES[attribute]}.stream"
                changes[f"{stream}.count"] = n * len(block.rows[0])
        return built.patched(changes)

    place = _spec.HEADER_SIZE + _spec.INDEX_HEAD_OFFSETS["splat_count"]
    why = "arrays of a little more than 8 GiB, the default budget"
    return Recipe("invalid/arrays_beyond_budget", why, ("LIM-1",), data, None, "E_LIMIT", place)
