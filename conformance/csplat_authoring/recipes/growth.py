"""Extensions that later versions may add and this one skips: tails of records, ancillary layers, types and flags."""

from __future__ import annotations

from dataclasses import replace

from csplat import _spec
from csplat_authoring.broken import patched, whole
from csplat_authoring.builder import SIZED, Built, build
from csplat_authoring.samples import Recipe, rich_scene, scene, tile
from csplat_authoring.scene import Block, Chunk, Extra, Scene, Stream

_LONGEST = 255


def valid_growth_recipes() -> list[Recipe]:
    """Return files with everything that may be skipped."""
    made = (
        ("record_tails", "a tail behind the head and each kind of record", "IDX-8 IDX-9", _tails()),
        ("record_tails_longest", "a head and records of 255 bytes", "IDX-8 IDX-9", _longest()),
        ("ancillary_layers", "layers 128 and 255, whose payloads are no blocks", "ANC-2 TIL-2", _layers()),
        ("ancillary_extras", "columns of unknown types around one of a known type", "ANC-3 RAW-1", _extras()),
        ("ancillary_extra_alone", "one extra column, of an unknown type", "ANC-3 TIL-5", _one_extra()),
        ("ancillary_flags", "flags of scene and chunks that may be skipped", "ANC-1 CHK-4", _flags()),
    )
    return [_valid(*one) for one in made]


def invalid_growth_recipes() -> list[Recipe]:
    """Return files that go beyond what may be skipped."""
    layers, extras, flags = build(_layers()), build(_extras()), build(_flags())
    short = scene(tails=tuple((kind, bytes(3)) for kind in SIZED))
    private = scene(chunks=(Chunk(b"priv", payload=b"x", flags=_spec.CHUNK_FLAG_CRITICAL | 0x100),))
    first, other = "tile[0].layer[128]", "tile[0].layer[255]"
    return [
        whole("private_critical", "a critical private chunk", "DIR-6", "E_VALUE", private, "directory[priv].flags"),
        _short("record_tails_cut", "an index that ends within the tail of its last record", build(short)),
        *(
            patched(f"layer_{number}", why, "RES-2 ANC-2", "E_UNSUPPORTED", layers, {f"{first}.layer": number})
            for number, why in (
                (9, "the first id behind those of this version"),
                (100, "an id that no version lists and none may skip"),
                (127, "the last id that may not be skipped"),
            )
        ),
        patched(
            "ancillary_layers_descending",
            "layer 255 before 128",
            "TIL-2",
            "E_INDEX",
            layers,
            {f"{first}.layer": 255, f"{other}.layer": 128},
            at=f"{other}.layer",
        ),
        patched(
            "ancillary_layers_equal",
            "layer 255 twice",
            "TIL-2",
            "E_INDEX",
            layers,
            {f"{first}.layer": 255},
            at=f"{other}.layer",
        ),
        patched(
            "ancillary_layer_crc",
            "a wrong CRC of a layer that is skipped",
            "CHK-1 CHK-2 ANC-2",
            "E_CRC",
            layers,
            {f"{first}.crc": 1},
            at="TILE.0.128/header.type",
        ),
        patched(
            "ancillary_layer_type",
            "a skipped layer whose chunk is no TILE",
            "CHK-3 ANC-2",
            "E_INDEX",
            layers,
            {"TILE.0.128/header.type": b"LATE"},
        ),
        patched(
            "ancillary_layer_reserved",
            "a reserved field in the header of a skipped layer",
            "RES-1 ANC-2",
            "E_RESERVED",
            layers,
            {"TILE.0.128/header.reserved_0": 1},
        ),
        patched(
            "ancillary_layer_gap",
            "a skipped layer that leaves a gap",
            "COV-1 ANC-2",
            "E_INDEX",
            layers,
            {f"{other}.offset": layers.spans["TILE.0.255"][0] + 1},
        ),
        patched(
            "extra_type_127",
            "the last type that may not be skipped",
            "RES-2",
            "E_UNSUPPORTED",
            extras,
            {"extra[0].dtype": 127},
        ),
        patched(
            "ancillary_extra_column",
            "a skipped column in another's place",
            "RAW-1 ANC-3",
            "E_STREAM",
            extras,
            {"TILE.0.8/extra[0].params.column": 1},
        ),
        patched(
            "ancillary_extra_count",
            "a skipped column of too few elements",
            "STR-1 ANC-3",
            "E_STREAM",
            extras,
            {"TILE.0.8/extra[0].stream.count": 2},
        ),
        patched(
            "ancillary_extra_width",
            "a skipped column of nine bytes",
            "STR-2 ANC-3",
            "E_STREAM",
            extras,
            {"TILE.0.8/extra[0].stream.width": 9},
        ),
        patched(
            "ancillary_extra_name",
            "a skipped column with the name of another",
            "EXR-2 ANC-3",
            "E_VALUE",
            extras,
            {"extra[2].name": b"label".ljust(62, b"\0"), "extra[2].name_size": 5},
        ),
        patched(
            "ancillary_flag_of_record_alone",
            "a flag that may be skipped, in the record and not in the chunk",
            "CHK-3 ANC-1",
            "E_INDEX",
            flags,
            {"META/header.flags": _spec.CHUNK_FLAG_SAFE_TO_COPY},
        ),
        patched(
            "ancillary_flag_of_tile",
            "a flag that may be skipped, in a TILE",
            "CHK-3 ANC-1",
            "E_INDEX",
            flags,
            {"TILE.0.0/header.flags": _spec.CHUNK_FLAG_CRITICAL | 0x100},
        ),
        patched(
            "ancillary_and_critical",
            "an ancillary chunk made critical",
            "CHK-4 ANC-1",
            "E_VALUE",
            flags,
            {"directory[META].flags": 0x8003, "META/header.flags": 0x8003},
        ),
    ]


def _valid(name: str, why: str, clauses: str, made: Scene) -> Recipe:
    return Recipe(f"valid/{name}", why, tuple(clauses.split()), lambda: build(made).data, made)


def _tails() -> Scene:
    tails = tuple((kind, bytes(range(_LONGEST, _LONGEST - 1 - i, -1))) for i, kind in enumerate(SIZED))
    return replace(rich_scene(), tails=tails)


def _longest() -> Scene:
    sizes = {kind: int(getattr(_spec, f"{name.upper()}_SIZE")) for kind, name in SIZED.items()}
    return replace(rich_scene(), tails=tuple((kind, bytes([165]) * (_LONGEST - size)) for kind, size in sizes.items()))


def _layers() -> Scene:
    made = rich_scene()
    first, second = made.tiles
    unknown = ((128, b"\xff" * 5), (255, b"x"))
    return replace(made, tiles=(replace(first, unknown=unknown), replace(second, unknown=unknown[1:])))


def _extras() -> Scene:
    made = rich_scene()
    tiles = []
    for one in made.tiles:
        six = Block(_spec.CODING_RAW, [[2**40 + i] for i in range(one.splat_count)], Stream(6))
        tiles.append(replace(one, extras=(six, one.extras[0], Block(_spec.CODING_RAW, [[1]] * one.splat_count))))
    return replace(made, extras=(Extra("later", 128), *made.extras, Extra("last", 255)), tiles=tuple(tiles))


def _one_extra() -> Scene:
    three = Block(_spec.CODING_RAW, [[1], [2**24 - 1]], Stream(3))
    return scene(tiles=[tile(extras=(three,))], extras=(Extra("later", 200),))


def _flags() -> Scene:
    made = rich_scene()
    metadata, errors = made.chunks
    private = Chunk(b"priv", payload=b"any", flags=0xFF00 | _spec.CHUNK_FLAG_SAFE_TO_COPY)
    known = (replace(metadata, flags=0x8000 | _spec.CHUNK_FLAG_SAFE_TO_COPY), replace(errors, flags=0x0100))
    return replace(made, scene_flags=0xF0 | _spec.SCENE_FLAG_FLAT, chunks=(*known, private))


def _short(name: str, why: str, base: Built) -> Recipe:
    """Return a recipe whose index is two bytes shorter than its records."""
    size = _spec.unpack_header(base.data).index_size
    changes = {"header.index_size": size - 2}
    return patched(name, why, "IDX-2 IDX-9", "E_INDEX", base, changes, ("E_CRC",), at="tile[0].splat_count")
