"""Invalid files in which nothing but the one rule is broken (see `invalid_alone`): codebooks that blocks share."""

from __future__ import annotations

from dataclasses import replace

from csplat import _spec
from csplat_authoring.broken import patched, rich, whole
from csplat_authoring.builder import build
from csplat_authoring.samples import QUATS, SCALES, Recipe, book, quat_rows, rows_of, scene, sh_attribute, signed, tile
from csplat_authoring.scene import Block, Codebook, Scene, Stream

_SH1, _SH2 = sh_attribute(1), sh_attribute(2)


def alone_book_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_later_blocks(), *_parts(), *_chunks()]


def _shape(number: int) -> Codebook:
    return Codebook(number, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(number, 2, 6, -40, 40)})


def _bands(number: int, first: int = 1, last: int = 2, layers: tuple[int, ...] = ()) -> Codebook:
    entries = {band: rows_of(band, 2, 6 * band + 3, -9, 9) for band in layers or range(first, last + 1)}
    return Codebook(number, _spec.CODEBOOK_KIND_SH, entries, (first, last))


def _later_blocks() -> list[Recipe]:
    """CBK-4: blocks that are not the first of their codebook."""

    def later(name: str, why: str, made: Scene, block: str) -> Recipe:
        return whole(f"codebook_{name}", why, "CBK-4", "E_CODEBOOK", made, f"{block}.params.codebook_id")

    def shapes(first: Block, second: Block, *books: Codebook) -> Scene:
        return scene(tiles=[tile(n=3, changes={SCALES: first, QUATS: second})], codebooks=books)

    def colours(first: Block, second: Block, *books: Codebook) -> Scene:
        return scene(2, [tile(n=3, changes={_SH1: first, _SH2: second})], codebooks=books)

    indices, sums = (0, 1, 0), (-50, -40, -60)
    first = book(1, (0, 2, 1), signed(rows_of(7, 1, 3, -9, 9)), summands=sums)
    unescaped = book(1, indices, summands=sums)
    quats, turn = "TILE.0.0/quats", signed(quat_rows(8, 1))
    return [
        later(
            "shape_of_another",
            "scales by one codebook of shapes, rotations by a second one",
            shapes(unescaped, book(2), _shape(1), _shape(2)),
            quats,
        ),
        later(
            "band_of_another",
            "bands 1 and 2 by two codebooks, each of which has both",
            colours(book(1, indices), book(2), _bands(1), _bands(2)),
            "TILE.0.2/sh2",
        ),
        later(
            "band_of_one_before",
            "band 2 by the codebook before that of band 1",
            colours(book(2, indices), book(1), _bands(1), _bands(2)),
            "TILE.0.2/sh2",
        ),
        later(
            "shape_more_escapes",
            "rotations with two escapes and their integers, where scales have one",
            shapes(first, book(1, (), signed(quat_rows(8, 2))), _shape(1)),
            quats,
        ),
        later(
            "shape_escape_alone",
            "rotations with an escape and its integers, where scales have none",
            shapes(unescaped, book(1, (), turn), _shape(1)),
            quats,
        ),
        later(
            "band_escape_alone",
            "band 2 with an escape and its integers, where band 1 has none",
            colours(book(1, indices), book(1, (), signed(rows_of(2, 1, 15, -5, 5))), _bands(1)),
            "TILE.0.2/sh2",
        ),
        *(
            patched(
                f"codebook_{name}_escapes_announced",
                f"{what} with one escape, announced as two",
                "CBK-4",
                "E_CODEBOOK",
                base,
                {f"{block}.params.escape_count": 2},
                at=f"{block}.params.codebook_id",
            )
            for name, what, base, block in (
                ("shape", "rotations", build(shapes(first, book(1, (), turn), _shape(1))), quats),
                ("band", "band 2", rich(), "TILE.0.2/sh2"),
            )
        ),
    ]


def _parts() -> list[Recipe]:
    """Indices, summands and escape blocks."""
    block = book(1, (0, 1), summands=(-50, -40))
    wide = replace(block, summands=(-50, -50), how=Stream(5))
    summand, escape = "TILE.0.0/scales.summand", "TILE.0.1/sh1.escape"

    def shape(first: Block, second: Block | None = None) -> Scene:
        return scene(tiles=[tile(changes={SCALES: first, QUATS: second or book(1)})], codebooks=(_shape(1),))

    own = signed([[4, 5, 6]])
    turn = build(shape(book(1, (0, 2), own, summands=(-50, 0)), book(1, (), own)))

    reserved = {
        "summand": ("the lattice parameters of a summand", f"{summand}.reserved_0"),
        "escape": ("the head of an escape block", f"{escape}.reserved_0"),
        "escape_params": ("the lattice parameters of an escape block", f"{escape}.params.reserved_0"),
        "tile_head_of_band": ("the head of a band's layer", "TILE.0.1/head.reserved_0"),
        "tile_head_of_extra": ("the head of the extra layer", "TILE.0.8/head.reserved_0"),
    }
    return [
        patched(
            "escape_exponent_of_quats",
            "an exponent in an escape block of rotations, which have no step",
            "LAT-2",
            "E_VALUE",
            turn,
            {"TILE.0.0/quats.escape.params.exponent": 1},
        ),
        patched(
            "summand_width_zero",
            "summands of no bytes",
            "STR-2",
            "E_STREAM",
            build(shape(block)),
            {f"{summand}.stream.width": 0},
        ),
        whole("summand_width_5", "summands of five bytes", "STR-2", "E_STREAM", shape(wide), f"{summand}.stream.width"),
        *(
            patched(f"reserved_{name}", f"a reserved field of {what}", "RES-1", "E_RESERVED", rich(), {field: 1})
            for name, (what, field) in reserved.items()
        ),
    ]


def _chunks() -> list[Recipe]:
    """DIR-5: as many chunks as there are bands, one of them of another band of the scene."""
    books = {"below": _bands(1, 2, 3, (1, 2)), "above": _bands(1, 1, 2, (1, 3))}
    others = {"below": "CODB.1.1", "above": "CODB.1.3"}
    return [
        whole(
            f"codebook_chunk_{name}_bands",
            f"a chunk of a band {name} those of the codebook, in the place of one of them",
            "DIR-5",
            "E_INDEX",
            scene(3, [], codebooks=(made,)),
            f"directory[{others[name]}].type",
        )
        for name, made in books.items()
    ]
