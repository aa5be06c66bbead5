"""Invalid files in which nothing but the one rule is broken: a decoder that does not check it finds all else right.

If a field is overwritten in a whole file, another check often refuses it, too: an index that states too many entries
leads to a stream that is too short. Here sizes, counts and streams follow the defect.
"""

from __future__ import annotations

import math
from dataclasses import replace

from csplat import _spec
from csplat_authoring.broken import patched, small, whole
from csplat_authoring.builder import Built, build
from csplat_authoring.repair import seal
from csplat_authoring.samples import MEANS, Recipe, attributes, rows_of, scene
from csplat_authoring.scene import Attribute, Chunk, Codebook, Extra, Stream

_RUNS = (_spec.TRANSFORM_RUN_LENGTH,)
_META = Chunk(_spec.CHUNK_METADATA, b"{}")


def alone_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_records(), *_codebooks(), *_directory()]


def _records() -> list[Recipe]:
    """Records of the index, in scenes without tiles: nothing uses what they say."""
    steps = {
        "zero": 0.0,
        "negative": -0.5,
        "nan": math.nan,
        "infinite": math.inf,
        "subnormal": math.nextafter(2.0**-1022, 0.0),
    }
    bare = build(scene(1, []))
    longest = build(scene(tiles=[], extras=(Extra("x" * _spec.EXTRA_NAME_MAX, _spec.EXTRA_DTYPE_U8),)))
    unnamed = scene(tiles=[], extras=(Extra("", _spec.EXTRA_DTYPE_U8),))
    result = [
        patched(
            f"unused_step_{name}",
            f"a step of {step}, which no tile uses",
            "ATT-6",
            "E_VALUE",
            bare,
            {"attribute[sh1].step": step},
        )
        for name, step in steps.items()
    ]
    fourth = scene(tiles=[], sh_degree=4, attributes=attributes(3) | {_spec.ATTRIBUTE_SH4: Attribute(0, 0.25)})
    whole_file = small()
    last = whole_file.spans["TILE.0.0"][0]
    sums = (
        ("header_crc", "header.header_crc", 4, "HDR-3", "E_CRC"),
        ("index_crc", "index.crc", 4, "IDX-1", "E_CRC"),
    )
    rest = build(scene(trailing=bytes(3)))
    return [
        *result,
        whole("sh_degree_4", "degree 4 with its record", "IDX-3", "E_UNSUPPORTED", fourth, "index.sh_degree"),
        patched(
            "rest_after_chunks",
            "three bytes that the file's size counts and no chunk covers",
            "COV-1",
            "E_INDEX",
            rest,
            {"header.file_size": len(rest.data)},
        ),
        Recipe(
            "invalid/truncated_between_chunks",
            "the last chunk is missing as a whole",
            ("HDR-5",),
            lambda: whole_file.data[:last],
            None,
            "E_TRUNCATED",
            last,
        ),
        Recipe(
            "invalid/magic_high",
            "another last byte, above the right one",
            ("HDR-1",),
            lambda: seal(whole_file.data[:7] + b"\xff" + whole_file.data[8:]),
            None,
            "E_MAGIC",
            0,
        ),
        *(
            patched(f"{name}_high", f"{field} with all bits set", clause, code, whole_file, {field: b"\xff" * size})
            for name, field, size, clause, code in sums
        ),
        *(
            patched(f"axes_{name}", f"{name} as two axes", "IDX-4", "E_VALUE", whole_file, {"index.axes": bytes(axes)})
            for name, axes in {"up_and_down": (1, 3, 4), "forward_and_back": (5, 3, 6)}.items()
        ),
        patched("splat_count_low", "N is below the sum", "IDX-7", "E_INDEX", whole_file, {"index.splat_count": 1}),
        patched(
            "attribute_scales_twice",
            "the record of means names scales",
            "ATT-1",
            "E_INDEX",
            whole_file,
            {"attribute[means].attribute": _spec.ATTRIBUTE_SCALES},
        ),
        patched(
            "attribute_means_twice",
            "the record of scales names means",
            "ATT-1",
            "E_INDEX",
            whole_file,
            {"attribute[scales].attribute": MEANS},
        ),
        patched("extra_dtype_zero", "type 0 of no splats", "RES-2", "E_UNSUPPORTED", longest, {"extra[0].dtype": 0}),
        patched("extra_dtype_high", "type 9 of no splats", "RES-2", "E_UNSUPPORTED", longest, {"extra[0].dtype": 9}),
        whole(
            "attributes_beyond_degree",
            "a record of band 1 in a scene of degree 0",
            "ATT-1",
            "E_INDEX",
            replace(scene(1, []), sh_degree=0),
            "index.attribute_count",
        ),
        whole("extra_name_empty", "a name of no bytes", "EXR-1", "E_VALUE", unnamed, "extra[0].name_size"),
        patched(
            "extra_name_long",
            "62 bytes of a name, announced as 63",
            "EXR-1",
            "E_VALUE",
            longest,
            {"extra[0].name_size": _spec.EXTRA_NAME_MAX + 1},
        ),
    ]


def _codebooks() -> list[Recipe]:
    """Records of codebooks whose chunks say and hold the same."""

    def record(
        name: str, why: str, clause: str, field: str, *books: Codebook, degree: int = 1, code: str = "E_VALUE"
    ) -> Recipe:
        made = scene(degree, [], codebooks=books)
        return whole(f"codebook_{name}", why, clause, code, made, f"codebook[{books[-1].id}].{field}")

    def sh(bands: tuple[int, int], *layers: int) -> Codebook:
        entries = {layer: rows_of(layer, 2, 3 * (2 * layer + 1), -9, 9) for layer in layers}
        return Codebook(3, _spec.CODEBOOK_KIND_SH, entries, bands)

    def shapes(number: int, *layers: int) -> Codebook:
        entries = {layer: rows_of(layer, 2, 6, -9, 9) for layer in layers or (0,)}
        return Codebook(number, _spec.CODEBOOK_KIND_SHAPE, entries)

    one = build(scene(tiles=[], codebooks=(shapes(3),)))
    too_many = [[7] * 6] * (_spec.CODEBOOK_ENTRIES_MAX + 1)
    many = Codebook(3, _spec.CODEBOOK_KIND_SHAPE, {0: too_many}, how=Stream(1, _RUNS))
    shared = scene(tiles=[], codebooks=(shapes(2), shapes(3)), chunks=(_META,), order=("META", "CODB.2.0"))
    no_bands = scene(2, [], codebooks=(sh((2, 1), 1),), chunks=(_META,), order=("META",))
    bands = "codebook[3].band_first"
    return [
        record("of_65537", "65,537 entries", "CBR-4", "size", many),
        patched(
            "codebook_ids_share_a_chunk",
            "two records of one id, and one chunk of that id",
            "CBR-1",
            "E_INDEX",
            build(shared),
            {"codebook[3].codebook_id": 2},
        ),
        record(
            "ids_fall",
            "records and chunks of falling ids",
            "CBR-1",
            "codebook_id",
            shapes(7),
            shapes(2),
            code="E_INDEX",
        ),
        whole("codebook_bands_empty", "bands 2 to 1, and so no chunks", "CBR-2", "E_VALUE", no_bands, bands),
        record("band_0", "bands 0 and 1, with their chunks", "CBR-2", "band_first", sh((0, 1), 0, 1)),
        record(
            "band_2_of_1",
            "bands 1 and 2 in a scene of degree 1, with their chunks",
            "CBR-2",
            "band_first",
            sh((1, 2), 1, 2),
        ),
        record(
            "bands_of_shapes",
            "bands 0 and 1 of a codebook of shapes, with a chunk for each",
            "CBR-2",
            "band_first",
            replace(shapes(3, 0, 1), bands=(0, 1)),
        ),
        patched(
            "codebook_last_band_of_shapes",
            "band 1 as the last of a codebook of shapes, with a chunk of layer 0",
            "CBR-2",
            "E_VALUE",
            one,
            {"codebook[3].band_last": 1},
            at=bands,
        ),
        record(
            "both_bands_of_shapes",
            "band 1 as the only one of a codebook of shapes, with a chunk of layer 1",
            "CBR-2",
            "band_first",
            replace(shapes(3, 1), bands=(1, 1)),
        ),
    ]


def _directory() -> list[Recipe]:
    private = build(scene(tiles=[], chunks=(Chunk(b"priv", payload=b"x", flags=0),)))

    def kind(name: str, why: str, value: bytes) -> Recipe:
        changes = {"directory[priv].type": value, "priv/header.type": value}
        return patched(f"directory_type_{name}", why, "DIR-1", "E_VALUE", private, changes)

    texts = {"cameras": (_spec.CHUNK_CAMERAS, b"[]"), "options": (_spec.CHUNK_OPTIONS, b"{}")}
    result = []
    for name, (value, text) in texts.items():
        twice = scene(tiles=[], chunks=(Chunk(value, text), Chunk(value, text)))
        result.append(
            whole(
                f"{name}_twice",
                f"two chunks of {name}",
                "DIR-4",
                "E_INDEX",
                twice,
                f"directory[{value.decode()}#1].type",
            )
        )
        for field in ("id", "layer"):
            made = scene(tiles=[], chunks=(Chunk(value, text, **{field: 1}),))  # type: ignore[arg-type]  # numbers both
            result.append(
                whole(
                    f"{name}_{field}",
                    f"{name} with a {field}",
                    "DIR-4",
                    "E_INDEX",
                    made,
                    f"directory[{value.decode()}].type",
                )
            )
    table = Codebook(3, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(0, 2, 6, -9, 9)})
    payload = _payload(build(scene(tiles=[], codebooks=(table,))), "CODB.3.0")

    def surplus(name: str, why: str, number: int) -> Recipe:
        chunk = Chunk(_spec.CHUNK_CODEBOOK, payload=payload, id=number)
        made = scene(tiles=[], codebooks=(table,), chunks=(chunk,), order=("CODB.3.0", "CODB"))
        return whole(name, why, "DIR-5", "E_INDEX", made, "directory[CODB].type")

    described = build(scene(tiles=[], chunks=(_META,)))
    reserved = scene(tiles=[], chunks=(Chunk(_spec.CHUNK_TREE, payload=b"x", flags=0),))
    return [
        *result,
        whole(
            "reserved_chunk_skippable",
            "a reserved chunk that is not critical",
            "RES-2",
            "E_UNSUPPORTED",
            reserved,
            "directory[TREE].type",
        ),
        patched(
            "known_flags_high",
            "META as critical too, in record and chunk",
            "CHK-4",
            "E_VALUE",
            described,
            {"directory[META].flags": 3, "META/header.flags": 3},
        ),
        surplus("codebook_chunk_unasked", "a chunk of a codebook that has no record, beside all that are due", 4),
        surplus("codebook_chunk_again", "the same chunk of a codebook twice", 3),
        kind("delete", "U+007F in a type", b"pri\x7f"),
        kind("upper_half", "a byte of 255 in a type", b"\xffriv"),
        kind("unit_separator", "U+001F in a type", b"p\x1fiv"),
    ]


def _payload(built: Built, chunk: str) -> bytes:
    offset, size = built.spans[chunk]
    return built.data[offset + _spec.CHUNK_HEADER_SIZE : offset + size - 4]
