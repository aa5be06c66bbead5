"""Invalid files in which nothing but the one rule is broken (see `invalid_alone`): tiles, layers, cut payloads."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from csplat import _spec
from csplat_authoring.broken import cut, patched, rich, small, swapped, whole
from csplat_authoring.builder import Built, build
from csplat_authoring.samples import (
    MEANS,
    Recipe,
    attributes,
    axis,
    rich_scene,
    rows_of,
    scene,
    sh_attribute,
    signed,
    tile,
)
from csplat_authoring.scene import Attribute, Block, Chunk, Codebook, Tile

_RUNS = (_spec.TRANSFORM_RUN_LENGTH,)
_META = Chunk(_spec.CHUNK_METADATA, b"{}")


def alone_tile_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_tiles(), *_upper_layers(), *_cut()]


@dataclass(frozen=True)
class _Partial(Tile):
    """A tile of which some layers are in the file."""

    there: tuple[int, ...] = ()

    @property
    def layers(self) -> list[int]:
        return list(self.there)


def _tiles() -> list[Recipe]:
    text = build(scene(tiles=[], chunks=(_META,)))
    bare = scene(tiles=[_Partial(**vars(tile()))])
    upper = scene(1, [_Partial(**vars(tile(degree=1)), there=(1,))])
    surplus = build(scene(tiles=[tile(extras=(Block(_spec.CODING_RAW, [[1], [2]]),))]))
    table = Codebook(3, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(0, 2, 6, -9, 9)})
    tables = [scene(tiles=[tile(tables=ids)], codebooks=(replace(table, id=2), table)) for ids in ((3, 3), (3, 2))]
    twins = build(scene(1, [tile(1, degree=1), tile(2, degree=1)]))
    three = build(scene(3, [tile(degree=3)]))
    nine = {sh_attribute(2): signed(rows_of(9, 2, 9, -9, 9))}  # as band 1 has columns
    double = build(scene(2, [tile(degree=2, changes=nine)]))
    turned = swapped(three, "tile[0].layer[1]", "tile[0].layer[2]")
    again = {"tile[0].layer[2].layer": 1, "TILE.0.2/head.layer": 1, "TILE.0.2/sh2.attribute": sh_attribute(1)}
    n = _spec.TILE_SPLATS_MAX + 1
    same = tile(1, 1)
    full = {
        a: replace(b, rows=[list(b.rows[0])] * n, how=replace(b.how, transforms=_RUNS)) for a, b in same.blocks.items()
    }
    band = build(scene(1, [tile(degree=1)]))
    block = band.spans["TILE.0.1"][1] - _spec.CHUNK_HEADER_SIZE - _spec.TILE_HEAD_SIZE
    far = attributes() | {MEANS: Attribute(_spec.MAPPING_LATTICE, 2.0**-40)}
    big = _spec.INTEGER_MAX
    still, moving = axis([[0, 0, 0]] * 2), axis([[0, 0, 0], [1, 1, 1]])

    def box(name: str, why: str, means: Block, corner: tuple[int, int, int], element: int) -> Recipe:
        made = scene(tiles=[tile(changes={MEANS: means}, corner=corner)], attributes=far)
        return whole(f"box_{name}", why, "TIL-7", "E_VALUE", made, "tile[0].corner", within=8 * element)

    def differs(name: str, why: str, clause: str, base: Built, changes: dict[str, Any]) -> Recipe:
        return patched(name, why, clause, "E_INDEX", base, changes)

    def beyond(degree: int, layers: tuple[int, ...], at: int) -> Recipe:
        bands = {sh_attribute(layer): tile(degree=3).blocks[sh_attribute(layer)] for layer in layers}
        made = scene(degree, [tile(changes=bands)])
        why = f"layer {at} in a scene of degree {degree}, with its chunk"
        return whole(f"layer_{at}_of_{degree}", why, "TIL-3", "E_INDEX", made, f"tile[0].layer[{at}].layer")

    return [
        whole(
            "tile_of_65537",
            "65,537 splats",
            "TIL-1",
            "E_VALUE",
            scene(tiles=[replace(same, blocks=full)]),
            "tile[0].splat_count",
        ),
        cut(
            "layer_unknown_empty",
            "layer 5, whose chunk has no block",
            "RES-2",
            "E_UNSUPPORTED",
            band,
            block,
            "tile[0].layer[1].layer",
            {"tile[0].layer[1].layer": 5, "TILE.0.1/head.layer": 5, "TILE.0.1/head.block_count": 0},
        ),
        patched("layers_turned", "layers 0, 2, 1, 3", "TIL-2", "E_INDEX", three, turned, at="tile[0].layer[2].layer"),
        patched("layer_twice", "layers 0, 1, 1", "TIL-2", "E_INDEX", double, again),
        whole("layers_none_at_all", "a tile without layers and chunks", "TIL-2", "E_INDEX", bare, "index.crc"),
        whole(
            "layer_1_alone", "a tile of layer 1, without layer 0", "TIL-2", "E_INDEX", upper, "tile[0].layer[1].layer"
        ),
        cut(
            "extra_layer_empty",
            "an extra layer without blocks, and no extra columns",
            "TIL-5",
            "E_INDEX",
            surplus,
            surplus.spans["TILE.0.8"][1] - _spec.CHUNK_HEADER_SIZE - _spec.TILE_HEAD_SIZE,
            "tile[0].layer[0].layer",
            {"TILE.0.8/head.block_count": 0},
        ),
        whole(
            "tables_equal_unused",
            "a table id twice, and no use of it",
            "TIL-6",
            "E_INDEX",
            tables[0],
            "tile[0].table[1]",
        ),
        whole(
            "tables_fall_unused",
            "table ids that fall, and no use of them",
            "TIL-6",
            "E_INDEX",
            tables[1],
            "tile[0].table[1]",
        ),
        differs("tile_layer_low", "the chunk of layer 1 says 0", "TLE-1", twins, {"TILE.0.1/head.layer": 0}),
        differs("chunk_type_low", "a type below that of the directory", "CHK-3", text, {"META/header.type": b"MESA"}),
        differs("chunk_flags_high", "a flag that no tile has", "CHK-3", small(), {"TILE.0.0/header.flags": 3}),
        beyond(0, (1,), 1),
        beyond(0, (3,), 3),
        beyond(1, (1, 2), 2),
        beyond(2, (1, 3), 3),
        box("high", "a corner of 2^53 + 1", still, (0, 0, big + 1), 2),
        box("low", "a corner of −2^53 − 1, and splats at −2^53", moving, (-big - 1, 0, 0), 0),
        box("far", "a corner of 2^53, and splats at 2^53 + 1", moving, (0, big, 0), 1),
    ]


def _upper_layers() -> list[Recipe]:
    """Payloads of the layers above 0."""
    made, base = rich_scene(), rich()

    def tail(name: str, why: str, layer: int) -> Recipe:
        tiles = (replace(made.tiles[0], tails=((layer, b"\0"),)), made.tiles[1])
        return whole(name, why, "TLE-3", "E_STREAM", replace(made, tiles=tiles), f"TILE.0.{layer}/tail")

    return [
        patched("tile_layer_of_extra", "the extra layer says 0", "TLE-1", "E_INDEX", base, {"TILE.0.8/head.layer": 0}),
        tail("tile_tail_of_band", "a byte after the block of a band", 1),
        tail("tile_tail_of_extra", "a byte after the last extra column", _spec.LAYER_EXTRA),
        *(
            patched(f"block_count_of_{name}", why, "TLE-2", "E_STREAM", base, {f"{chunk}/head.block_count": count})
            for name, why, chunk, count in (
                ("band", "two blocks of a band announced, one there", "TILE.0.1", 2),
                ("extra", "two extra columns announced, one there", "TILE.0.8", 2),
                ("extra_zero", "no extra column announced, one there", "TILE.0.8", 0),
            )
        ),
        patched(
            "attribute_of_extra",
            "a block of the extra layer that names sh0",
            "TLE-2",
            "E_STREAM",
            base,
            {"TILE.0.8/extra[0].attribute": _spec.ATTRIBUTE_SH0},
        ),
    ]


def _cut() -> list[Recipe]:
    """Payloads that end within a structure, at the end of the file: whoever reads on leaves it."""
    base = small()

    def left(field: str, more: int = 0) -> int:
        return len(base.data) - base.fields[field].offset - more

    table = Codebook(3, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(0, 2, 6, -9, 9)})
    last = build(scene(codebooks=(table,), order=("TILE.0.0", "CODB.3.0")))
    text = build(scene(chunks=(_META,), order=("TILE.0.0", "META")))

    def payload(built: Built, chunk: str) -> int:
        return built.spans[chunk][1] - _spec.CHUNK_HEADER_SIZE

    return [
        cut(
            "tile_ends_in_bytes",
            "the last coded byte is missing",
            "STR-6",
            "E_STREAM",
            base,
            1,
            "TILE.0.0/sh0.stream.coded_size",
        ),
        cut(
            "tile_ends_in_stream",
            "a stream's head is cut short",
            "TLE-3",
            "E_STREAM",
            base,
            left("TILE.0.0/sh0.stream.width", 7),
            "TILE.0.0/sh0.stream.width",
        ),
        cut(
            "tile_ends_in_offsets",
            "the offsets are cut short",
            "TLE-3",
            "E_STREAM",
            base,
            left("TILE.0.0/sh0.offsets", 3),
            "TILE.0.0/sh0.offsets",
        ),
        cut(
            "tile_ends_in_block",
            "a block's head is cut short",
            "TLE-3",
            "E_STREAM",
            base,
            left("TILE.0.0/sh0.attribute", 2),
            "TILE.0.0/sh0.attribute",
        ),
        cut(
            "tile_ends_at_once",
            "a tile without its head",
            "TLE-3",
            "E_STREAM",
            base,
            payload(base, "TILE.0.0"),
            "TILE.0.0/head.layer",
        ),
        cut(
            "codebook_ends_at_once",
            "a codebook without its head",
            "CDB-2",
            "E_STREAM",
            last,
            payload(last, "CODB.3.0"),
            "CODB.3.0/head.codebook_id",
        ),
        cut(
            "text_ends_at_once",
            "metadata without a stream",
            "JSN-2",
            "E_STREAM",
            text,
            payload(text, "META"),
            "META/stream.width",
        ),
    ]
