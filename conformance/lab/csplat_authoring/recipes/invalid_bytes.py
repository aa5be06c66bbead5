# SPDX-License-Identifier: CC0-1.0
"""Computed invalid files: with changed bytes, or too large to declare."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from csplat import _spec
from csplat_authoring.builder import Built, build, seal
from csplat_authoring.coders import deflate_fixed
from csplat_authoring.recipe import Recipe, invalid_recipe
from csplat_authoring.recipes.valid import full_band_4
from csplat_authoring.samples import OPACITIES, SCALES, SH0, levels, rows_of, scene, sh_attribute, signed, tile
from csplat_authoring.scene import Block, Chunk, Codebook, Stream

_SPLAT_BYTES = 4 * (3 + 4 + 3 + 1 + 48)  # bytes per splat of SH degree 3, as float32 (spec section 3)
_RUNS = (_spec.TRANSFORM_RUN_LENGTH,)


def invalid_bytes_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_headers(), *_misplaced_chunks(), *_bombs(), _arrays_beyond_budget(), *_surplus_codebooks()]


def _headers() -> list[Recipe]:
    base = build(scene())
    data, size, last = base.data, len(base.data), base.spans["TILE.0.0"][0]
    header = _spec.HEADER_SIZE
    rows: list[tuple[str, str, str, str, bytes, int]] = [
        ("magic", "another first byte", "HDR-1", "E_MAGIC", seal(b"\x92" + data[1:]), 0),
        (
            "magic_high",
            "another last byte, above the right one",
            "HDR-1",
            "E_MAGIC",
            seal(data[:7] + b"\xff" + data[8:]),
            0,
        ),
        ("magic_text_mode", "a transfer turned CR LF into LF", "HDR-1", "E_MAGIC", data.replace(b"\r\n", b"\n"), 0),
        ("magic_seven_bits", "a transfer cleared the eighth bits", "HDR-1", "E_MAGIC", bytes(b & 127 for b in data), 0),
        ("truncated", "the last byte is missing", "HDR-5", "E_TRUNCATED", data[:-1], size - 1),
        ("truncated_after_header", "nothing follows the header", "HDR-5", "E_TRUNCATED", data[:header], header),
        ("truncated_between_chunks", "the last chunk is missing as a whole", "HDR-5", "E_TRUNCATED", data[:last], last),
        ("trailing", "one byte after the end", "HDR-6", "E_TRAILING", data + b"\0", size),
        ("short_magic", "twenty bytes, the first eight a magic", "HDR-11", "E_TRUNCATED", data[:20], 20),
        ("nothing", "no bytes at all", "HDR-11", "E_TRUNCATED", b"", 0),
        ("short_garbage", "five bytes of something else", "HDR-11", "E_MAGIC", b"hello", 0),
    ]
    huge = invalid_recipe(
        "file_size_huge",
        "more than any file has",
        "HDR-5",
        "E_TRUNCATED",
        base,
        {"header.file_size": 2**64 - 1},
        ("E_INDEX",),
    )
    return [*(_of_bytes(*row) for row in rows), replace(huge, offset=size)]


def _of_bytes(name: str, why: str, clause: str, code: str, data: bytes, at: int) -> Recipe:
    return Recipe(f"invalid/{name}", why, (clause,), lambda: data, None, code, at)


def _misplaced_chunks() -> list[Recipe]:
    """Return files whose first chunk is replaced by one of the same size, from another file or from the same one."""
    one = build(scene())
    two = build(scene(tiles=[tile(1), tile(1, changes={OPACITIES: levels([3, 1])})]))

    def misplaced(name: str, why: str, base: Built, chunks: tuple[str, ...]) -> Recipe:
        spans = [two.spans[chunk] for chunk in chunks]
        new = b"".join(two.data[offset : offset + size] for offset, size in spans)
        at = base.spans["TILE.0.0"][0]
        return _of_bytes(name, why, "CHK-1", "E_CRC", base.data[:at] + new + base.data[at + len(new) :], at)

    return [
        misplaced("chunk_of_another_file", "a tile's chunk, sound in itself, of another file", one, ("TILE.1.0",)),
        misplaced("tiles_swapped", "the chunks of two tiles have changed places", two, ("TILE.1.0", "TILE.0.0")),
    ]


def _bombs() -> list[Recipe]:
    zeros = Stream(coder="deflate", coded=deflate_fixed(bytes(200_000)))
    bomb = scene(tiles=[tile(changes={OPACITIES: levels([7, 8], zeros)})])
    runs = _spec.BUDGET_JSON_BYTES // _spec.JSON_BYTE_COST // _spec.RUN_MAX  # runs of spaces, 3 bytes each in the file
    values = b"{}" + b" " * runs
    packed = values + b"\0\0" + b"\xff" * runs + b"\0\0" + b"\xff" * runs
    text = scene(chunks=(Chunk(_spec.CHUNK_METADATA, b"{}", Stream(1, _RUNS, "deflate_fixed", packed=packed)),))
    # Without any one of the four bytes that count as values, the text is within the budget.
    each = _spec.BUDGET_JSON_BYTES // _spec.JSON_VALUE_COST // len(b",:[{") // _spec.RUN_MAX  # runs
    head, tail = b'{"a":"', b'"}'
    marks = b"".join(mark * each for mark in (b",", b":", b"[", b"{"))
    lengths = bytes(len(head)) + b"\xff" * len(marks) + bytes(len(tail))
    packed = head + marks + tail + lengths + lengths
    coding = Stream(1, _RUNS, "deflate_fixed", packed=packed)
    valued = replace(text, chunks=(replace(text.chunks[0], stream_coding=coding),))
    valued_count = len(head) + len(marks) * _spec.RUN_MAX + len(tail)
    full, band = full_band_4(), sh_attribute(4)
    (one,) = full.tiles
    longer = Stream(1, _RUNS, packed=bytes(range(28)) + (b"\xff" * 27 + b"\0") * 2)
    blocks = one.blocks | {band: replace(one.blocks[band], stream_coding=longer)}
    return [
        invalid_recipe(
            "deflate_bomb",
            "200,000 bytes come out instead of two",
            "COD-2 COD-4",
            "E_CODER",
            bomb,
            at="TILE.0.0/opacities.stream.coded",
        ),
        invalid_recipe(
            "tile_of_65536_band_4_long",
            "one element more than 65,536 times 27, the longest stream",
            "TRF-1",
            "E_CODER",
            replace(full, tiles=(replace(one, blocks=blocks),)),
            at="TILE.0.4/sh4.stream.coded",
        ),
        invalid_recipe(
            "json_beyond_budget",
            "a sound text of 16 MiB and two bytes, beyond the default budget",
            "STR-8 LIM-1",
            "E_LIMIT",
            text,
            {"META/stream.count": 2 + runs * _spec.RUN_MAX},
        ),
        invalid_recipe(
            "json_values_beyond_budget",
            "a sound text of 2 MiB, whose bytes that count as values exceed the default budget",
            "STR-8",
            "E_LIMIT",
            valued,
            {"META/stream.count": valued_count},
            at="META/stream.count",
        ),
    ]


def _full_runs(block: Block) -> Stream:
    """Return the stream of a full tile in which all splats equal the one of a block."""
    (row,) = block.rows
    return Stream(1, _RUNS, packed=bytes(q & 255 for q in row) + b"\xff\xff" * len(row))


def _arrays_beyond_budget() -> Recipe:
    """Return a valid file of SH degree 3 whose arrays exceed the default budget; all splats of a tile are equal."""
    tiles = _spec.BUDGET_BYTES // (_SPLAT_BYTES * _spec.TILE_SPLATS_MAX) + 1
    one = tile(1, 1, 0, {SCALES: signed([[-4, -5, -6]]), SH0: signed([[7, 8, 9]])})
    run = {attribute: replace(block, stream_coding=_full_runs(block)) for attribute, block in one.blocks.items()}

    @cache
    def data() -> bytes:
        made = scene(3, tiles=[*[replace(one, blocks=run)] * tiles, one], resource_level=_spec.RESOURCE_LEVEL_C)
        built = build(made)
        n = _spec.TILE_SPLATS_MAX
        changes = {"index.splat_count": tiles * n + 1}
        for i in range(tiles):
            changes[f"tile[{i}].splat_count"] = n
            for attribute, block in run.items():
                stream = f"TILE.{i}.0/{_spec.ATTRIBUTE_NAMES[attribute]}.stream"
                changes[f"{stream}.count"] = n * len(block.rows[0])
        return built.patched(changes)

    offset = _spec.HEADER_SIZE + _spec.INDEX_HEAD_OFFSETS["splat_count"]
    why = "arrays of a little more than 8 GiB, the default budget"
    return Recipe("invalid/arrays_beyond_budget", why, ("LIM-1",), data, None, "E_LIMIT", offset)


def _surplus_codebooks() -> list[Recipe]:
    """Return files with a surplus chunk of a codebook, a copy of the required one."""
    table = Codebook(3, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(0, 2, 6, -9, 9)})
    built = build(scene(tiles=[], codebooks=(table,)))
    offset, size = built.spans["CODB.3.0"]
    payload = built.data[offset + _spec.CHUNK_HEADER_SIZE : offset + size - 4]

    def surplus(name: str, why: str, number: int) -> Recipe:
        chunk = Chunk(_spec.CHUNK_CODEBOOK, payload=payload, id=number)
        made = scene(tiles=[], codebooks=(table,), chunks=(chunk,), order=("CODB.3.0", "CODB"))
        return invalid_recipe(name, why, "DIR-5", "E_INDEX", made, at="directory[CODB].type")

    return [
        surplus("codebook_chunk_unasked", "a chunk of a codebook that has no record, besides all required chunks", 4),
        surplus("codebook_chunk_again", "the same chunk of a codebook twice", 3),
    ]
