"""Invalid files in which nothing but the one rule is broken (see `invalid_alone`): integers and codebooks of tiles."""

from __future__ import annotations

from dataclasses import replace

from csplat import _spec
from csplat_authoring.broken import patched, rich, whole
from csplat_authoring.builder import Built, build
from csplat_authoring.samples import (
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    SH0,
    Recipe,
    axis,
    book,
    levels,
    morton,
    offset,
    rows_of,
    scene,
    sh_attribute,
    signed,
    tile,
)
from csplat_authoring.scene import Attribute, Block, Codebook, Extra, Rows, Scene, Stream

_COLUMN = _spec.COLUMN_MAX


def alone_block_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_codings(), *_integers(), *_coded()]


def _codings() -> list[Recipe]:
    """Blocks in codings that others have, with what those hold."""
    rows = [[1, 2, 3], [0, 0, 0]]
    coded = {
        OPACITIES: {"offset": offset([[1], [0]]), "signed": signed([[1], [0]])},
        SCALES: {"levels": Block(_spec.CODING_LEVELS, rows), "axis": axis(rows)},
        QUATS: {"levels": Block(_spec.CODING_LEVELS, rows), "offset": offset(rows)},
        MEANS: {"offset": offset(rows), "signed": signed(rows)},
        SH0: {"levels": Block(_spec.CODING_LEVELS, rows), "axis": axis(rows)},
    }
    column = scene(tiles=[tile(extras=(levels([1, 2]),))], extras=(Extra("a", _spec.EXTRA_DTYPE_U8),))
    result = [
        whole(
            f"coding_{name}_of_{_spec.ATTRIBUTE_NAMES[attribute]}",
            f"{_spec.ATTRIBUTE_NAMES[attribute]} coded {name.upper()}, and so they are",
            "BLK-1",
            "E_VALUE",
            scene(tiles=[tile(changes={attribute: block})]),
            f"TILE.0.0/{_spec.ATTRIBUTE_NAMES[attribute]}.coding",
        )
        for attribute, blocks in coded.items()
        for name, block in blocks.items()
    ]
    why = "an extra column coded LEVELS, and so it is"
    named = build(scene(tiles=[tile(extras=(Block(_spec.CODING_RAW, [[1], [2]]),))], extras=column.extras))
    extra = {"TILE.0.8/extra[0].coding": _spec.CODING_LEVELS}
    result.append(patched("extra_called_levels", "RAW, called LEVELS", "BLK-1", "E_VALUE", named, extra))
    return [*result, whole("coding_levels_of_extra", why, "BLK-1", "E_VALUE", column, "TILE.0.8/extra[0].coding")]


def _integers() -> list[Recipe]:
    fine = Attribute(_spec.MAPPING_LATTICE, 2.0**-30)
    lifted = Attribute(_spec.MAPPING_YCOCG, 2.0**-30, chroma_shift=16)
    steep = Attribute(_spec.MAPPING_LATTICE, 2.0**106)
    still = scene(tiles=[tile(changes={MEANS: morton([[0, 0, 0]] * 2, 0)})])

    def band(
        name: str,
        why: str,
        clause: str,
        rows: Rows,
        offsets: tuple[int, ...],
        record: Attribute,
        at: str = "stream.width",
        within: int = 0,
        width: int = 1,
    ) -> Recipe:
        number = (len(offsets) // 3 - 1) // 2
        attribute = sh_attribute(number)
        made = scene(number, [tile(degree=number, changes={attribute: offset(rows, Stream(width), offsets=offsets)})])
        made = replace(made, attributes=made.attributes | {attribute: record})
        code = "E_VALUE" if clause == "LAT-3" else "E_RANGE"
        return whole(name, why, clause, code, made, f"TILE.0.{number}/sh{number}.{at}", within=within)

    def first(name: str, why: str, clause: str, blocks: dict[int, Block]) -> Recipe:
        made = scene(tiles=[tile(changes=blocks)])
        attribute = _spec.ATTRIBUTE_NAMES[next(iter(blocks))]
        why = f"{why} in the first splat"
        return whole(f"{name}_at_first", why, clause, "E_RANGE", made, f"TILE.0.0/{attribute}.stream.width")

    def lone(place: int, value: int, columns: int) -> tuple[int, ...]:
        return tuple(value if i == place else 0 for i in range(columns))

    low = -_COLUMN - 1
    shift = _COLUMN >> 16
    return [
        whole(
            "morton_bits_zero",
            "codes of no bits, and all splats at the corner",
            "MOR-1",
            "E_VALUE",
            still,
            "TILE.0.0/means.params.bits",
        ),
        band(
            "value_beyond_float32_by_offset",
            "a colour above binary32, in an element of four bytes",
            "LAT-5",
            [(0, 0, 0), (0, 0, 2**22)],
            (0, 0, 0),
            steep,
            width=4,
        ),
        first("opacity_above_levels", "a level of M + 1", "LEV-1", {OPACITIES: levels([256, 0], Stream(2))}),
        first("quat_component", "a component of M + 1", "QUA-1", {QUATS: signed([[128, 0, 0], [0, 0, 0]], Stream(2))}),
        first("quat_radicand", "R below 0", "QUA-2", {QUATS: signed([[127, 127, 1], [0, 0, 0]], Stream(2))}),
        band(
            "integer_too_large_at_first",
            "2^22 + 1 in the first splat's first column",
            "LAT-4",
            [(_COLUMN + 1, 0, 0), (_COLUMN, 0, 0)],
            (_COLUMN, 0, 0),
            fine,
        ),
        band(
            "integer_too_large_at_last",
            "2^22 + 1 in the last splat's last column",
            "LAT-4",
            [(0, 0, _COLUMN), (0, 0, _COLUMN + 1)],
            (0, 0, _COLUMN),
            fine,
        ),
        band(
            "offset_low",
            "an offset of −2^22 − 1, and integers of −2^22",
            "LAT-3",
            [[-_COLUMN, 0, 0]] * 2,
            (low, 0, 0),
            fine,
            "offsets",
        ),
        band(
            "offset_low_of_last",
            "the same in the last column of band 3",
            "LAT-3",
            [lone(20, -_COLUMN, 21)] * 2,
            lone(20, low, 21),
            fine,
            "offsets",
            80,
        ),
        band(
            "luma_too_large",
            "2^22 + 1 in the last column of Y",
            "LAT-4",
            [lone(4, _COLUMN + 1, 15)] * 2,
            lone(4, _COLUMN, 15),
            lifted,
        ),
        band(
            "chroma_first_too_large",
            "2^22 + 2^16 after the shift, in the first column of Co",
            "LAT-4",
            [lone(5, shift + 1, 15)] * 2,
            lone(5, shift, 15),
            lifted,
        ),
        band(
            "chroma_last_too_large",
            "the same below 0, in the last column of Cg",
            "LAT-4",
            [lone(20, -shift - 1, 21)] * 2,
            lone(20, -shift - 1, 21),
            lifted,
        ),
    ]


def _coded() -> list[Recipe]:
    """Blocks of codebooks."""

    def shape(name: str, why: str, clause: str, summand: int, entry: int, at: str) -> Recipe:
        table = Codebook(2, _spec.CODEBOOK_KIND_SHAPE, {0: [[entry] * 3 + [0] * 3]})
        blocks = {SCALES: book(2, (0, 0), summands=(summand,) * 2), QUATS: book(2)}
        made = scene(tiles=[tile(changes=blocks)], codebooks=(table,))
        made = replace(made, attributes=made.attributes | {SCALES: Attribute(_spec.MAPPING_LATTICE, 2.0**-30)})
        code = "E_VALUE" if clause == "LAT-3" else "E_RANGE"
        return whole(name, why, clause, code, made, f"TILE.0.0/scales.{at}")

    def escaped(name: str, base: Built, block: str) -> Recipe:
        coding = {f"{block}.escape.coding": _spec.CODING_CODEBOOK}
        why = f"an escape block of {name} that says CODEBOOK and holds another coding"
        return patched(f"escape_of_{name}_by_codebook", why, "CBK-5", "E_STREAM", base, coding)

    shapes = Codebook(1, _spec.CODEBOOK_KIND_SHAPE, {0: [[1, 2, 3, 4, 5, 6]]})

    def own(of_scales: Block, of_quats: Block) -> Scene:
        blocks = {SCALES: book(1, (0, 1), of_scales, summands=(5, 0)), QUATS: book(1, (), of_quats)}
        return scene(tiles=[tile(changes=blocks)], codebooks=(shapes,))

    three = signed([[4, 5, 6]])
    elsewhere = {
        "scales": own(Block(_spec.CODING_LEVELS, [[4, 5, 6]]), three),
        "quats": own(three, offset([[4, 5, 6]])),
    }
    both = Codebook(4, _spec.CODEBOOK_KIND_SH, {b: rows_of(b, 2, 6 * b + 3, -9, 9) for b in (1, 2)}, (1, 2))
    first = book(4, (0, 2), signed(rows_of(7, 1, 9, -9, 9)))
    fewer = scene(2, [tile(degree=2, changes={sh_attribute(1): first, sh_attribute(2): book(4)})], codebooks=(both,))
    bands = Codebook(4, _spec.CODEBOOK_KIND_SH, {2: rows_of(2, 2, 15, -9, 9)}, (2, 2))
    other = scene(2, [tile(degree=2, changes={sh_attribute(1): book(4, (0, 1))})], codebooks=(bands,))
    return [
        shape(
            "summand_offset_high",
            "a summand's offset of 2^22 + 1, sums of 2^22",
            "LAT-3",
            _COLUMN + 1,
            -1,
            "summand.offset",
        ),
        shape(
            "summand_offset_low",
            "a summand's offset of −2^22 − 1, sums of −2^22",
            "LAT-3",
            -_COLUMN - 1,
            1,
            "summand.offset",
        ),
        shape("summand_low", "a sum of −2^22 − 1", "LAT-4", -_COLUMN, -1, "attribute"),
        escaped("band_1", rich(), "TILE.0.1/sh1"),
        whole(
            "coding_codebook_of_opacities",
            "opacities by a codebook, which no kind is for",
            "BLK-1",
            "E_VALUE",
            scene(tiles=[tile(changes={OPACITIES: book(1, (0, 0))})], codebooks=(shapes,)),
            "TILE.0.0/opacities.coding",
        ),
        whole(
            "coding_codebook_of_sh0",
            "colours of degree 0 by a codebook, which no kind is for",
            "BLK-1",
            "E_VALUE",
            scene(tiles=[tile(changes={SH0: book(1, (0, 0))})], codebooks=(shapes,)),
            "TILE.0.0/sh0.coding",
        ),
        escaped("quats", build(own(three, three)), "TILE.0.0/quats"),
        *(
            whole(
                f"escape_of_{name}_by_another",
                f"an escape block of {name} in a coding of other attributes",
                "CBK-5",
                "E_STREAM",
                made,
                f"TILE.0.0/{name}.escape.coding",
            )
            for name, made in elsewhere.items()
        ),
        patched(
            "escape_of_higher",
            "an escape block of band 1 that names band 2",
            "CBK-5",
            "E_STREAM",
            rich(),
            {"TILE.0.1/sh1.escape.attribute": sh_attribute(2)},
        ),
        whole(
            "codebook_fewer_escapes",
            "band 2 without escapes, where band 1 has one",
            "CBK-4",
            "E_CODEBOOK",
            fewer,
            "TILE.0.2/sh2.params.codebook_id",
        ),
        whole(
            "codebook_of_other_band",
            "band 1 by a codebook of band 2",
            "CBK-1",
            "E_CODEBOOK",
            other,
            "TILE.0.1/sh1.params.codebook_id",
        ),
    ]
