"""Invalid files: directory, tile and layer records."""

from __future__ import annotations

import struct
from dataclasses import replace

from csplat import _spec
from csplat_authoring.broken import patched, rich, small, swapped, whole
from csplat_authoring.builder import build
from csplat_authoring.samples import MEANS, SCALES, Recipe, axis, rich_scene, scene, signed, tile
from csplat_authoring.scene import Chunk, Scene

_NAN, _INF = float("nan"), float("inf")
_KNOWN = _spec.CHUNK_FLAG_CRITICAL


def tile_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_directory(), *_tiles()]


def _directory() -> list[Recipe]:
    made = rich_scene()
    base = rich()
    critical = scene(chunks=(Chunk(b"NEXT", payload=b"x", flags=_KNOWN),))
    reserved = scene(chunks=(Chunk(_spec.CHUNK_TREE, payload=b"x", flags=_KNOWN),))
    twice = scene(chunks=(Chunk(_spec.CHUNK_METADATA, b"{}"), Chunk(_spec.CHUNK_METADATA, b"{}")))
    odd = {"directory[META].type": b"M\x1fTA", "META/header.type": b"M\x1fTA"}
    tile_type = {"directory[META].type": _spec.CHUNK_TILE, "META/header.type": _spec.CHUNK_TILE}
    return [
        patched("directory_tile", "a TILE in the directory", "DIR-1", "E_VALUE", base, tile_type),
        patched("directory_type_control", "a control character in a type", "DIR-1", "E_VALUE", base, odd),
        whole(
            "critical_unknown", "an unknown critical chunk", "DIR-2", "E_UNSUPPORTED", critical, "directory[NEXT].type"
        ),
        whole(
            "critical_reserved",
            "a reserved critical chunk",
            "RES-2 DIR-2",
            "E_UNSUPPORTED",
            reserved,
            "directory[TREE].type",
        ),
        whole(
            "reserved_chunk_flag_unknown",
            "an unlisted flag of an unknown chunk",
            "RES-1",
            "E_RESERVED",
            scene(chunks=(Chunk(b"priv", payload=b"x", flags=0x0080),)),
            "directory[priv].flags",
        ),
        whole("metadata_twice", "two META chunks", "DIR-4", "E_INDEX", twice, "directory[META#1].type"),
        patched(
            "metadata_id",
            "META with an id",
            "DIR-4",
            "E_INDEX",
            base,
            {"directory[META].id": 1},
            at="directory[META].type",
        ),
        patched(
            "metadata_layer",
            "META in a layer",
            "DIR-4",
            "E_INDEX",
            base,
            {"directory[META].layer": 1},
            at="directory[META].type",
        ),
        whole(
            "codebook_chunk_missing",
            "no chunk for band 2 of a codebook",
            "DIR-5",
            "E_INDEX",
            _without(made, "CODB.7.2"),
            "directory[META].type",
        ),
        patched(
            "codebook_chunk_id",
            "a CODB chunk of no codebook",
            "DIR-5",
            "E_INDEX",
            base,
            {"directory[CODB.2.0].id": 3},
            at="directory[CODB.2.0].type",
        ),
        patched(
            "codebook_chunk_layer",
            "a CODB chunk of a band that the codebook lacks",
            "DIR-5",
            "E_INDEX",
            base,
            {"directory[CODB.7.2].layer": 3},
            at="directory[CODB.7.2].type",
        ),
        patched(
            "codebook_chunk_twice",
            "band 1 twice, band 2 never",
            "DIR-5",
            "E_INDEX",
            base,
            {"directory[CODB.7.2].layer": 1},
            at="directory[CODB.7.2].type",
        ),
    ]


def _without(made: Scene, name: str) -> Scene:
    codebooks = tuple(
        replace(b, entries={k: v for k, v in b.entries.items() if f"CODB.{b.id}.{k}" != name}) for b in made.codebooks
    )
    tiles = tuple(
        replace(t, blocks={a: b for a, b in t.blocks.items() if a != _spec.ATTRIBUTE_SH2}) for t in made.tiles
    )
    return replace(made, codebooks=codebooks, tiles=tiles)


def _tiles() -> list[Recipe]:
    base, one = rich(), small()
    extent = _spec.unpack_tile_record(one.data, one.fields["tile[0].splat_count"].offset).extent
    scale = _spec.unpack_tile_record(one.data, one.fields["tile[0].splat_count"].offset).max_scale
    big = _spec.INTEGER_MAX
    above = build(scene(1, [tile(degree=1)]))
    no_extra = scene(tiles=[tile(), tile(extras=rich_scene().tiles[1].extras)], extras=rich_scene().extras)
    no_column = scene(tiles=[tile(extras=rich_scene().tiles[1].extras)])
    return [
        patched(
            "layers_descending",
            "layer 0 after layer 1",
            "TIL-2",
            "E_INDEX",
            above,
            swapped(above, "tile[0].layer[0]", "tile[0].layer[1]"),
        ),
        patched(
            "layer_0_missing",
            "the first layer is not layer 0",
            "TIL-2",
            "E_INDEX",
            one,
            {"tile[0].layer[0].layer": _spec.LAYER_SH1},
        ),
        patched(
            "layers_none",
            "a tile without layers",
            "TIL-2",
            "E_INDEX",
            one,
            {"tile[0].layer_count": 0},
            at="tile[0].layer[0].layer",
        ),
        patched(
            "layer_above_degree",
            "layer 2 in a scene of degree 1",
            "TIL-3",
            "E_INDEX",
            above,
            {"tile[0].layer[1].layer": _spec.LAYER_SH2},
        ),
        whole(
            "extra_layer_missing",
            "one tile lacks the extra layer",
            "TIL-5",
            "E_INDEX",
            no_extra,
            "tile[0].layer[0].layer",
        ),
        whole(
            "extra_layer_unasked",
            "an extra layer without extra columns",
            "TIL-5",
            "E_INDEX",
            no_column,
            "tile[0].layer[0].layer",
        ),
        patched(
            "tables_descending",
            "table ids that descend",
            "TIL-6",
            "E_INDEX",
            base,
            {"tile[0].table[1]": 2, "tile[0].table[0]": 7},
        ),
        patched("tables_equal", "a table id twice", "TIL-6", "E_INDEX", base, {"tile[0].table[1]": 2}),
        patched("table_unknown", "the id of no codebook", "TIL-6", "E_INDEX", base, {"tile[0].table[1]": 8}),
        patched("corner_smallest", "a corner of −2^63", "TIL-7", "E_VALUE", one, {"tile[0].corner": (-(2**63), 0, 0)}),
        patched(
            "box_beyond",
            "corner plus extent of more than 2^53",
            "TIL-7",
            "E_VALUE",
            one,
            {"tile[0].corner": (big - extent[0] + 1, 0, 0)},
        ),
        patched("exponent_high", "step × 2^exponent overflows", "TIL-9", "E_VALUE", one, {"tile[0].exponent": 1100}),
        patched("exponent_low", "step × 2^exponent is subnormal", "TIL-9", "E_VALUE", one, {"tile[0].exponent": -1013}),
        patched("exponent_highest", "the largest exponent", "TIL-9", "E_VALUE", one, {"tile[0].exponent": 32767}),
        patched("exponent_lowest", "the smallest exponent", "TIL-9", "E_VALUE", one, {"tile[0].exponent": -32768}),
        patched(
            "extent_too_large",
            "an extent larger than the splats'",
            "TIL-10",
            "E_BOX",
            one,
            {"tile[0].extent": (extent[0], extent[1] + 1, extent[2])},
            at="tile[0].corner",
        ),
        patched(
            "extent_too_small",
            "an extent smaller than the splats'",
            "TIL-10",
            "E_BOX",
            one,
            {"tile[0].extent": (extent[0], extent[1], extent[2] - 1)},
            at="tile[0].corner",
        ),
        whole("corner_too_low", "no splat touches the smallest corner", "TIL-10", "E_BOX", _raised(), "tile[0].corner"),
        patched(
            "max_scale_larger",
            "a max_scale one unit in the last place too large",
            "TIL-11",
            "E_BOX",
            one,
            {"tile[0].max_scale": _next(scale)},
        ),
        patched("max_scale_nan", "a max_scale that is no number", "TIL-11", "E_BOX", one, {"tile[0].max_scale": _NAN}),
        _minus_zero(),
    ]


def _next(value: float) -> float:
    (bits,) = struct.unpack("<I", struct.pack("<f", value))
    (result,) = struct.unpack("<f", struct.pack("<I", bits + 1 if value > 0 else bits - 1))
    return float(result)


def _raised() -> Scene:
    return scene(tiles=[tile(changes={MEANS: axis([[1, 0, 3], [4, 2, 0]])})])


def _minus_zero() -> Recipe:
    base = build(scene(tiles=[tile(changes={SCALES: signed([[0, -1, -2], [-3, -4, -5]])})]))
    return patched(
        "max_scale_minus_zero", "−0 where the largest scale is +0", "TIL-11", "E_BOX", base, {"tile[0].max_scale": -0.0}
    )
