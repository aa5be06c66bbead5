"""Invalid files: blocks coded by codebooks."""

from __future__ import annotations

from dataclasses import replace

from csplat import _spec
from csplat_authoring.broken import patched, rich, whole
from csplat_authoring.samples import (
    QUATS,
    SCALES,
    SH0,
    Recipe,
    attributes,
    book,
    offset,
    rich_scene,
    rows_of,
    scene,
    sh_attribute,
    signed,
    tile,
)
from csplat_authoring.scene import Attribute, Block, Codebook, Scene, Stream


def codebook_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_codebooks(), *_unused_entries()]


def _codebooks() -> list[Recipe]:
    made = rich_scene()
    base = rich()
    first = made.tiles[0]
    one = Codebook(1, _spec.CODEBOOK_KIND_SH, {1: rows_of(4, 3, 9, -60, 60)}, (1, 1))

    def sh1(block: Block, *books: Codebook, tables: tuple[int, ...] | None = None) -> Scene:
        changes = {sh_attribute(1): block}
        return scene(1, [tile(degree=1, changes=changes, tables=tables)], codebooks=books or (one,))

    def tiled(blocks: dict[int, Block]) -> Scene:
        return replace(made, tiles=(replace(first, blocks=first.blocks | blocks), made.tiles[1]))

    shapes = Codebook(1, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(4, 3, 6, -60, 60)})
    escape = signed([[*range(9)]])
    nested = book(1, (0, 0))
    without = {a: b for a, b in first.blocks.items() if a != sh_attribute(1)}
    lone = replace(made, tiles=(replace(first, blocks=without), made.tiles[1]))
    far = Attribute(_spec.MAPPING_LATTICE, 2.0**107)
    large = Codebook(1, _spec.CODEBOOK_KIND_SH, {1: [[1, 0, 0] * 3, [2**21, 0, 0] * 3]}, (1, 1), Stream(4))
    summed = {SCALES: replace(book(2, (0, 2, 1), summands=(0, 2**21, 0)), how=Stream(4))}
    shape = {SCALES: book(2, (0, 2, 1), summands=(2**22, 2**22, 2**22))}
    small = Codebook(1, _spec.CODEBOOK_KIND_SHAPE, {0: [[1, 1, -(2**22), 1, 2, 3]]}, how=Stream(4))
    lower = {SCALES: book(1, (0, 0), summands=(-1, -1)), QUATS: book(1)}
    return [
        whole(
            "codebook_unlisted",
            "a codebook that the tile does not list",
            "CBK-1",
            "E_CODEBOOK",
            sh1(book(1, (0, 1)), tables=()),
            "TILE.0.1/sh1.params.codebook_id",
        ),
        whole(
            "codebook_of_another",
            "band 1 by a codebook of shapes",
            "CBK-1",
            "E_CODEBOOK",
            sh1(book(1, (0, 1)), shapes),
            "TILE.0.1/sh1.params.codebook_id",
        ),
        whole(
            "codebook_index",
            "an index above the escape index",
            "CBK-2",
            "E_CODEBOOK",
            sh1(book(1, (0, 4))),
            "TILE.0.1/sh1.indices.width",
        ),
        whole(
            "codebook_escape_unasked",
            "an escaped splat, and none announced",
            "CBK-3",
            "E_CODEBOOK",
            sh1(book(1, (0, 3))),
            "TILE.0.1/sh1.params.escape_count",
        ),
        whole(
            "codebook_escape_missing",
            "no escaped splat, and one announced",
            "CBK-3",
            "E_CODEBOOK",
            sh1(book(1, (0, 1), escape)),
            "TILE.0.1/sh1.params.escape_count",
        ),
        patched(
            "codebook_escape_count_huge",
            "2^32 − 1 escaped splats",
            "CBK-3",
            "E_CODEBOOK",
            base,
            {"TILE.0.1/sh1.params.escape_count": 2**32 - 1},
            ("E_STREAM", "E_LIMIT"),
        ),
        whole(
            "codebook_without_first",
            "band 2 by a codebook whose band 1 the tile left out",
            "CBK-4",
            "E_CODEBOOK",
            lone,
            "TILE.0.2/sh2.params.codebook_id",
        ),
        whole(
            "codebook_other_first",
            "rotations by a codebook of shapes, scales without",
            "CBK-4",
            "E_CODEBOOK",
            _without_first(made),
            "TILE.0.0/quats.params.codebook_id",
        ),
        whole(
            "codebook_other_escapes",
            "band 2 with another number of escapes",
            "CBK-4",
            "E_CODEBOOK",
            tiled({sh_attribute(2): book(7, (), offset(rows_of(2, 2, 15, -5, 5)))}),
            "TILE.0.2/sh2.params.codebook_id",
        ),
        whole(
            "escape_by_codebook",
            "an escape block coded CODEBOOK",
            "CBK-5",
            "E_STREAM",
            sh1(book(1, (0, 3), replace(nested, rows=((0,) * 9,)))),
            "TILE.0.1/sh1.escape.coding",
        ),
        patched(
            "escape_of_another",
            "an escape block of another attribute",
            "CBK-5",
            "E_STREAM",
            base,
            {"TILE.0.1/sh1.escape.attribute": SH0},
        ),
        whole(
            "codebook_value_beyond_float32",
            "an entry whose value leaves binary32: a decoder may compute values once for all tiles",
            "LAT-5 CBK-7",
            "E_RANGE",
            replace(sh1(book(1, (0, 1)), large), attributes=attributes(1) | {sh_attribute(1): far}),
            "CODB.1.1/entries.width",
        ),
        whole(
            "codebook_value_of_shape",
            "entry plus summand leave binary32",
            "LAT-5 CBK-6",
            "E_RANGE",
            replace(tiled(summed), attributes=made.attributes | {SCALES: far}),
            "TILE.0.0/scales.attribute",
        ),
        whole(
            "codebook_unused_damaged",
            "coded bytes of a codebook that no tile names",
            "COD-2",
            "E_CODER",
            scene(1, codebooks=(replace(one, how=Stream(1, coder="deflate", coded=b"\xff\xff")),)),
            "CODB.1.1/entries.coded",
        ),
        whole(
            "codebook_summand_large",
            "entry plus summand beyond 2^22",
            "LAT-4 CBK-6",
            "E_RANGE",
            replace(tiled(shape), attributes=made.attributes | {SCALES: Attribute(0, 2.0**-30)}),
            "TILE.0.0/scales.attribute",
        ),
        whole(
            "codebook_summand_low",
            "entry plus summand beyond -2^22, and no entry above 1",
            "LAT-4 CBK-6",
            "E_RANGE",
            scene(
                tiles=[tile(changes=lower)],
                codebooks=(small,),
                attributes=attributes(0) | {SCALES: Attribute(_spec.MAPPING_LATTICE, 2.0**-30)},
            ),
            "TILE.0.0/scales.attribute",
        ),
    ]


def _unused_entries() -> list[Recipe]:
    """CBK-7: of each kind an entry out of bounds that no splat uses; the first one all splats use."""
    far = 2.0**107  # 2^21 steps of it are beyond binary32
    four = Stream(4)

    def shapes(rotation: list[int]) -> Scene:
        table = Codebook(1, _spec.CODEBOOK_KIND_SHAPE, {0: [[1, 2, 3, 4, 5, 6], [1, 2, 3, *rotation]]}, how=Stream(2))
        one = tile(changes={SCALES: book(1, (0, 0), summands=(5, 6)), QUATS: book(1)})
        return scene(tiles=[one], codebooks=(table,))

    def colours(entry: list[int], step: float) -> Scene:
        one = tile(degree=1, changes={sh_attribute(1): book(1, (0, 0))})
        table = Codebook(1, _spec.CODEBOOK_KIND_SH, {1: [[*range(9)], entry]}, (1, 1), four)
        record = {sh_attribute(1): Attribute(_spec.MAPPING_LATTICE, step)}
        return scene(1, [one], codebooks=(table,), attributes=attributes(1) | record)

    second = sh_attribute(2)
    lifted = [2 * 10**6] * 5 + [1, 15 * 10**5, 1, 1, 1] + [0] * 5  # red is 2 750 000 in the second coefficient
    bands = {1: [[1] * 9, [2] * 9], 2: [[1] * 15, lifted]}
    lifting = scene(
        2,
        [tile(degree=2, changes={sh_attribute(1): book(1, (0, 0)), second: book(1)})],
        codebooks=(Codebook(1, _spec.CODEBOOK_KIND_SH, bands, (1, 2), four),),
        attributes=attributes(2, ycocg=True) | {second: Attribute(_spec.MAPPING_YCOCG, far)},
    )
    unnamed = Codebook(1, _spec.CODEBOOK_KIND_SHAPE, {0: [[1, 2, 3, 127, 127, 127]]})
    return [
        _unused("quat", "a component beyond M", "QUA-1", shapes([0, -128, 0]), "CODB.1.0"),
        _unused("quat_radicand", "R below 0", "QUA-2", shapes([127, 1, 127]), "CODB.1.0"),
        _unused("sh_integer", "2^22 + 1", "LAT-4", colours([0] * 8 + [2**22 + 1], 2.0**-30), "CODB.1.1"),
        _unused("sh", "a colour that only the lifting takes there", "LAT-5", lifting, "CODB.1.2"),
        whole(
            "codebook_unnamed_entry",
            "an entry out of bounds of a codebook that no tile names",
            "QUA-2 CBK-7 CHK-2",
            "E_RANGE",
            scene(codebooks=(unnamed,)),
            "CODB.1.0/entries.width",
        ),
        whole(
            "codebook_unnamed_value",
            "a coefficient beyond binary32 in a codebook that no tile names",
            "LAT-5 CBK-7 CHK-2",
            "E_RANGE",
            replace(colours([0] * 8 + [2**21], far), tiles=()),
            "CODB.1.1/entries.width",
        ),
    ]


def _unused(name: str, why: str, clause: str, made: Scene, chunk: str) -> Recipe:
    words = f"an entry that no splat uses: {why}" + (" beyond binary32" if clause == "LAT-5" else "")
    return whole(f"codebook_unused_{name}", words, f"{clause} CBK-7", "E_RANGE", made, f"{chunk}/entries.width")


def _without_first(made: Scene) -> Scene:
    first = made.tiles[0]
    plain = replace(first, blocks=first.blocks | {SCALES: signed(rows_of(1, 3, 3, -9, 9))})
    return replace(made, tiles=(plain, made.tiles[1]))
