"""Invalid files in which nothing but the one rule is broken (see `invalid_alone`): streams."""

from __future__ import annotations

from dataclasses import replace

from csplat import _spec
from csplat_authoring.broken import patched, whole
from csplat_authoring.builder import build
from csplat_authoring.samples import (
    OPACITIES,
    SH0,
    Recipe,
    book,
    levels,
    rows_of,
    scene,
    sh_attribute,
    signed,
    sparse,
    tile,
)
from csplat_authoring.scene import PAIRS, Block, Chunk, Codebook, Extra, Scene, Stream

_RUNS = (_spec.TRANSFORM_RUN_LENGTH,)
_STREAM = "TILE.0.0/opacities.stream"


def alone_stream_recipes() -> list[Recipe]:
    """Return the recipes of this module."""

    def opacities(name: str, why: str, clause: str, field: str, values: list[int], how: Stream) -> Recipe:
        made = scene(tiles=[tile(changes={OPACITIES: levels(values, how)})])
        return whole(name, why, clause, "E_STREAM", made, f"{_STREAM}.{field}")

    def entries(name: str, why: str, clause: str, field: str, size: int, how: Stream) -> Recipe:
        table = Codebook(3, _spec.CODEBOOK_KIND_SHAPE, {0: [[0] * 6] * 2}, how=how)
        changes = {"codebook[3].size": size}
        return patched(
            name,
            why,
            clause,
            "E_STREAM",
            build(scene(tiles=[], codebooks=(table,))),
            changes,
            at=f"CODB.3.0/entries.{field}",
        )

    deflated = build(scene(tiles=[tile(changes={OPACITIES: levels([7, 8], Stream(coder="deflate_fixed"))})]))
    one = tile(extras=(Block(_spec.CODING_RAW, [[1], [2]]),))
    columns = tuple(Extra(name, _spec.EXTRA_DTYPE_U8) for name in "ab")
    two = build(scene(tiles=[replace(one, extras=one.extras * 2)], extras=columns))
    nine = tile(extras=(Block(_spec.CODING_RAW, [[1], [2]], Stream(9)),))
    column = scene(tiles=[nine], extras=(Extra("a", _spec.EXTRA_DTYPE_F64),))
    return [
        patched(
            "deflate_called_3",
            "DEFLATE, called by a reserved coder",
            "RES-2",
            "E_UNSUPPORTED",
            deflated,
            {f"{_STREAM}.coder": 3},
        ),
        whole(
            "deflate_garbage_of_size",
            "no DEFLATE at all, in as many bytes as should come out",
            "COD-2",
            "E_CODER",
            scene(tiles=[tile(changes={OPACITIES: levels([7, 8], Stream(coder="deflate", coded=b"\xff\xff"))})]),
            f"{_STREAM}.coded",
        ),
        opacities(
            "count_more", "an element more than splats, and a byte for it", "STR-1", "count", [7, 8, 9], Stream()
        ),
        opacities("count_fewer", "an element fewer than splats, and no byte for it", "STR-1", "count", [7], Stream()),
        entries("count_of_entries", "an entry more than the index says", "STR-1", "count", 1, PAIRS),
        whole(
            "count_of_indices",
            "an index more than splats",
            "STR-1",
            "E_STREAM",
            _band_by(book(3, (0, 1, 0))),
            "TILE.0.1/sh1.indices.count",
        ),
        opacities(
            "width_of_nothing", "elements of no bytes, and no bytes", "STR-2", "width", [7, 8], Stream(0, packed=b"")
        ),
        whole(
            "width_5_of_signed",
            "signed integers of five bytes",
            "STR-2",
            "E_STREAM",
            scene(tiles=[tile(changes={SH0: signed([[0, 0, 0]] * 2, Stream(5))})]),
            "TILE.0.0/sh0.stream.width",
        ),
        whole(
            "width_5_of_indices",
            "indices of five bytes",
            "STR-2",
            "E_STREAM",
            _band_by(book(3, (0, 0), how=Stream(5))),
            "TILE.0.1/sh1.indices.width",
        ),
        whole(
            "width_5_of_sparse",
            "integers of some splats of five bytes",
            "STR-2",
            "E_STREAM",
            _band_by(sparse((1, 0), [[0] * 9], Stream(5))),
            "TILE.0.1/sh1.stream.width",
        ),
        whole(
            "width_2_of_mask",
            "a mask of two bytes for each that it has",
            "STR-2",
            "E_STREAM",
            _band_by(sparse((1, 0), [[0] * 9], mask_how=Stream(2))),
            "TILE.0.1/sh1.mask.width",
        ),
        entries("width_5_of_entries", "entries of five bytes", "STR-2", "width", 2, Stream(5)),
        whole(
            "width_9_of_raw", "a column of nine bytes", "STR-2", "E_STREAM", column, "TILE.0.8/extra[0].stream.width"
        ),
        whole(
            "width_2_of_one",
            "a text of one element of two bytes, which are a text",
            "STR-2",
            "E_STREAM",
            scene(tiles=[], chunks=(Chunk(_spec.CHUNK_METADATA, b"x", Stream(2, packed=b"{}")),)),
            "META/stream.width",
        ),
        whole(
            "extra_width_low",
            "one byte for a column of two",
            "RAW-2",
            "E_STREAM",
            scene(tiles=[one], extras=(Extra("a", _spec.EXTRA_DTYPE_U16),)),
            "TILE.0.8/extra[0].stream.width",
        ),
        patched(
            "extra_column_low",
            "the second column says 0",
            "RAW-1",
            "E_STREAM",
            two,
            {"TILE.0.8/extra[1].params.column": 0},
        ),
        whole(
            "width_2_of_json",
            "a text of two bytes for each character",
            "STR-2",
            "E_STREAM",
            scene(chunks=(Chunk(_spec.CHUNK_METADATA, b"{}", Stream(2)),)),
            "META/stream.width",
        ),
        opacities(
            "packed_more", "a byte more than elements", "STR-4", "packed_size", [7, 8], Stream(packed=b"\7\10\11")
        ),
        opacities("packed_fewer", "a byte fewer than elements", "STR-4", "packed_size", [7, 8], Stream(packed=b"\7")),
        opacities(
            "runs_and_a_byte",
            "two runs and a byte",
            "STR-5",
            "packed_size",
            [7, 8],
            Stream(1, _RUNS, packed=b"\7\10\0\0\0\0\0"),
        ),
        opacities(
            "runs_and_two_bytes",
            "two runs and two bytes",
            "STR-5",
            "packed_size",
            [7, 8],
            Stream(1, _RUNS, packed=b"\7\10\0\0\0\0\0\0"),
        ),
    ]


def _band_by(block: Block) -> Scene:
    table = Codebook(3, _spec.CODEBOOK_KIND_SH, {1: rows_of(0, 2, 9, -9, 9)}, (1, 1))
    return scene(1, [tile(degree=1, changes={sh_attribute(1): block})], codebooks=(table,))
