"""Invalid files: frames of chunks, JSON texts and stated errors."""

from __future__ import annotations

import math
from dataclasses import replace

from csplat import _spec
from csplat_authoring.broken import patched, rich, small, whole
from csplat_authoring.builder import Built, build
from csplat_authoring.samples import OPACITIES, Recipe, levels, rich_scene, scene, tile
from csplat_authoring.scene import Chunk, Scene, StatedErrors, Stream

_NAN, _INF = float("nan"), float("inf")
_LARGEST = 0.0048828125
_RMS = math.nextafter(_LARGEST * math.sqrt(3.0) * (1.0 + 2.0**-20), 1.0)
_KNOWN = _spec.CHUNK_FLAG_CRITICAL


def chunk_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_chunks(), *_texts()]


def _chunks() -> list[Recipe]:
    base, one = rich(), small()
    faint = tile(1, changes={OPACITIES: levels([3, 1])})
    twins = build(scene(tiles=[tile(1), faint]))
    first, second = (f"tile[{i}].layer[0]" for i in (0, 1))
    tail = "TILE.0.0/"
    return [
        whole(
            "gap",
            "three bytes between index and chunks",
            "COV-1",
            "E_INDEX",
            scene(gap=bytes(3)),
            "tile[0].layer[0].offset",
        ),
        patched(
            "chunks_overlap",
            "two records name one chunk",
            "COV-1",
            "E_INDEX",
            twins,
            {f"{second}.offset": twins.spans["TILE.0.0"][0]},
        ),
        patched("chunk_offset_huge", "an offset of 2^64 − 1", "COV-1", "E_INDEX", one, {f"{first}.offset": 2**64 - 1}),
        patched(
            "chunk_size_huge",
            "a size of 2^32 − 1",
            "COV-1",
            "E_INDEX",
            one,
            {f"{first}.size": 2**32 - 1},
            at="header.file_size",
        ),
        patched("chunk_size_zero", "a size of 0", "CHK-3", "E_INDEX", one, {f"{first}.size": 0}),
        patched(
            "directory_size_11",
            "a directory record's size, a byte below that of an empty chunk",
            "CHK-3",
            "E_INDEX",
            base,
            {"directory[META].size": 11},
        ),
        patched(
            "chunk_crc",
            "the CRC of a tile alone is wrong",
            "CHK-1 HDR-12",
            "E_CRC",
            one,
            {f"{first}.crc": 7},
            at=f"{tail}header.type",
        ),
        _misplaced(
            "chunk_of_another_file", "a tile's chunk, sound in itself, of another file", one, ("TILE.1.0",), twins
        ),
        patched(
            "metadata_crc",
            "the CRC of the metadata alone is wrong",
            "CHK-1 CHK-2",
            "E_CRC",
            base,
            {"directory[META].crc": 7},
            at="META/header.type",
        ),
        patched(
            "stated_errors_crc",
            "the CRC of a chunk that decoding does not need",
            "CHK-1 CHK-2",
            "E_CRC",
            base,
            {"directory[SERR].crc": 7},
            at="SERR/header.type",
        ),
        whole("codebook_tail", "a byte after the stream", "CDB-2", "E_STREAM", _codebook_tail(), "CODB.2.0/tail"),
        *_unknown_chunk(),
        patched(
            "chunk_type_differs",
            "CODB in the directory, META in the chunk",
            "CHK-3",
            "E_INDEX",
            base,
            {"CODB.2.0/header.type": _spec.CHUNK_METADATA},
        ),
        patched(
            "chunk_flags_differ",
            "flags of record and chunk differ",
            "CHK-3",
            "E_INDEX",
            base,
            {"META/header.flags": 0},
            ("E_VALUE",),
        ),
        patched(
            "tile_type",
            "a layer record names a chunk that is no TILE",
            "CHK-3",
            "E_INDEX",
            one,
            {f"{tail}header.type": b"TILF"},
        ),
        patched(
            "tile_flags",
            "a TILE that is not critical",
            "CHK-3",
            "E_INDEX",
            one,
            {f"{tail}header.flags": 0},
            ("E_VALUE",),
        ),
        patched(
            "payload_size",
            "the payload's size is not the record's",
            "CHK-3",
            "E_INDEX",
            one,
            {f"{tail}header.payload_size": 5},
        ),
        patched(
            "payload_size_huge",
            "a payload of 2^32 − 1 bytes",
            "CHK-3",
            "E_INDEX",
            one,
            {f"{tail}header.payload_size": 2**32 - 1},
        ),
        patched(
            "known_flags",
            "META as critical in record and chunk",
            "CHK-4",
            "E_VALUE",
            base,
            {"directory[META].flags": _KNOWN, "META/header.flags": _KNOWN},
        ),
        _misplaced("tiles_swapped", "the chunks of two tiles have changed places", twins, ("TILE.1.0", "TILE.0.0")),
        patched("tile_layer", "the chunk says another layer", "TLE-1", "E_INDEX", one, {f"{tail}head.layer": 1}),
        patched(
            "codebook_chunk_other_id",
            "the payload names another codebook",
            "CDB-1",
            "E_INDEX",
            base,
            {"CODB.7.1/head.codebook_id": 2},
        ),
        patched(
            "codebook_chunk_other_layer",
            "the payload names another band",
            "CDB-1",
            "E_INDEX",
            base,
            {"CODB.7.1/head.layer": 2},
        ),
    ]


def _unknown_chunk() -> list[Recipe]:
    base = build(scene(chunks=(Chunk(b"priv", payload=b"x", flags=0),)))
    return [
        patched(
            "unknown_chunk_crc",
            "the CRC of an unknown chunk",
            "CHK-1 CHK-2",
            "E_CRC",
            base,
            {"directory[priv].crc": 7},
            at="priv/header.type",
        ),
        patched(
            "unknown_chunk_reserved",
            "a reserved field in the header of an unknown chunk",
            "RES-1",
            "E_RESERVED",
            base,
            {"priv/header.reserved_0": 1},
        ),
    ]


def _misplaced(name: str, why: str, base: Built, chunks: tuple[str, ...], source: Built | None = None) -> Recipe:
    """Return a file whose first chunks are replaced by equally long ones, its own or another file's."""
    spans = [(source or base).spans[chunk] for chunk in chunks]
    new = b"".join((source or base).data[offset : offset + size] for offset, size in spans)
    at = base.spans["TILE.0.0"][0]
    data = base.data[:at] + new + base.data[at + len(new) :]
    return Recipe(f"invalid/{name}", why, ("CHK-1",), lambda: data, None, "E_CRC", at)


def _texts() -> list[Recipe]:
    deep = b'{"a":' + b"[" * 64 + b"]" * 64 + b"}"
    bad = {
        "not_utf_8": (b'{"a":"\xff"}', "a byte that is not UTF-8"),
        "surrogate": (b'{"a":"\xed\xa0\x80"}', "a surrogate in UTF-8"),
        "mark": (b"\xef\xbb\xbf{}", "a byte order mark"),
        "open": (b'{"a":1', "an object without an end"),
        "comma": (b'{"a":1,}', "a comma before the end"),
        "nan": (b'{"a":NaN}', "a word that JSON does not have"),
        "infinity": (b'{"a":-Infinity}', "another word that JSON does not have"),
        "zero": (b'{"a":01}', "a number that begins with 0"),
        "control": (b'{"a":"\t"}', "a control character in a string"),
        "two_values": (b"{} {}", "two values"),
        "array": (b"[]", "an array in META"),
        "twice": (b'{"a":1,"b":{"c":2,"\\u0063":3}}', "a name twice, once written as an escape"),
        "deep": (deep, "65 levels"),
        "lone_surrogate": (b'{"a":"\\ud800"}', "half of a surrogate pair as an escape"),
        "number_large": (b'{"a":1e999}', "a number beyond binary64"),
        "number_long": (b'{"a":-' + b"9" * 400 + b"}", "an integer beyond binary64"),
    }
    meta = _spec.CHUNK_METADATA
    result = [
        whole(
            f"json_{name}",
            why,
            "JSN-1",
            "E_JSON",
            scene(chunks=(Chunk(meta, text),)),
            "META/stream.width",
        )
        for name, (text, why) in bad.items()
    ]
    cameras = scene(chunks=(Chunk(_spec.CHUNK_CAMERAS, b"{}"),))
    numbers = scene(chunks=(Chunk(_spec.CHUNK_CAMERAS, b"[{},1]"),))
    options = scene(chunks=(Chunk(_spec.CHUNK_OPTIONS, b"[]"),))
    garbage = scene(chunks=(Chunk(meta, b"{}", Stream(1, coder="deflate", coded=b"\xff\xff")),))
    tail = scene(chunks=(Chunk(meta, b"{}", tail=b"\0"),))
    runs = 1024  # runs of 65,536 spaces: beyond the default budget, and 3 kB in the file
    values = b"{}" + b" " * runs
    packed = values + b"\0\0" + b"\xff" * runs + b"\0\0" + b"\xff" * runs
    spaces = Stream(1, (_spec.TRANSFORM_RUN_LENGTH,), "deflate_fixed", packed=packed)
    bomb = build(scene(chunks=(Chunk(meta, b"{}", spaces),)))
    base = rich()
    record = "SERR/record[means]"
    return [
        *result,
        whole("json_cameras_object", "an object in CAMS", "JSN-1", "E_JSON", cameras, "CAMS/stream.width"),
        whole("json_cameras_number", "a number in CAMS", "JSN-1", "E_JSON", numbers, "CAMS/stream.width"),
        whole("json_options_array", "an array in OPTS", "JSN-1", "E_JSON", options, "OPTS/stream.width"),
        whole("json_coded_garbage", "a text of damaged bytes", "COD-2", "E_CODER", garbage, "META/stream.coded"),
        whole("json_tail", "a byte after the stream", "JSN-2", "E_STREAM", tail, "META/tail"),
        patched(
            "json_beyond_budget",
            "a sound text of 64 MiB and two bytes, beyond the default budget",
            "STR-8 LIM-1",
            "E_LIMIT",
            bomb,
            {"META/stream.count": 2 + runs * _spec.RUN_MAX},
        ),
        _measures_descend(),
        patched("error_nan", "a maximum that is no number", "SER-2", "E_VALUE", base, {f"{record}.max": _NAN}),
        patched(
            "error_rms_above_max",
            "rms above max",
            "SER-2",
            "E_VALUE",
            base,
            {f"{record}.rms": 0.75},
            at="SERR/record[means].max",
        ),
        patched(
            "error_rms_next_above",
            "rms next above its bound, which two other orders of the product would let pass",
            "SER-2 NUM-1",
            "E_VALUE",
            base,
            {f"{record}.measure": _spec.MEASURE_SH0, f"{record}.max": _LARGEST, f"{record}.rms": _RMS},
            at=f"{record}.max",
        ),
        patched(
            "error_records_missing",
            "more records than the payload holds",
            "SER-3",
            "E_STREAM",
            base,
            {"SERR/head.record_count": 2},
            at="CODB.2.0/header.type",
        ),
        patched(
            "error_records_left",
            "a record too many",
            "SER-3",
            "E_STREAM",
            base,
            {"SERR/head.record_count": 0},
            at="SERR/record[means].measure",
        ),
        patched(
            "error_counts", "source minus pruned is not N", "SER-4", "E_VALUE", base, {"SERR/head.source_count": 7}
        ),
        patched(
            "error_counts_wrap",
            "more pruned than there were",
            "SER-4",
            "E_VALUE",
            base,
            {"SERR/head.pruned_count": 2**64 - 1},
            at="SERR/head.source_count",
        ),
        whole(
            "error_head_cut",
            "a payload shorter than its head",
            "SER-3",
            "E_STREAM",
            scene(chunks=(Chunk(_spec.CHUNK_STATED_ERRORS, payload=bytes(7)),)),
            "SERR/payload",
        ),
    ]


def _measures_descend() -> Recipe:
    records = ((_spec.MEASURE_SH0, 0.5, 0.25), (_spec.MEASURE_MEANS, 0.5, 0.25))
    made = scene(chunks=(Chunk(_spec.CHUNK_STATED_ERRORS, errors=StatedErrors(2, 0, 0, 0, records)),))
    return whole("measures_descending", "measures that descend", "SER-1", "E_VALUE", made, "SERR/record[means].measure")


def _codebook_tail() -> Scene:
    made = rich_scene()
    shape, colours = made.codebooks
    return replace(made, codebooks=(replace(shape, tail=b"\0"), colours))
