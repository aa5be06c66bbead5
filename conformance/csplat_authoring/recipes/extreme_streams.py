"""Valid files of a kind that no sensible encoder writes: codebooks, streams, texts."""

from __future__ import annotations

from dataclasses import replace

from csplat import _spec
from csplat_authoring.builder import build
from csplat_authoring.deflate import deflate_fixed, deflate_stored
from csplat_authoring.samples import (
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    Recipe,
    attributes,
    axis,
    book,
    coded,
    integers,
    levels,
    means_rows,
    offset,
    rows_of,
    scene,
    sh_attribute,
    signed,
    tile,
)
from csplat_authoring.scene import PLAIN, Attribute, Block, Chunk, Codebook, Extra, Scene, StatedErrors, Stream

_RUNS = (_spec.TRANSFORM_RUN_LENGTH,)


def extreme_stream_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_codebooks(), *_streams(), *_texts()]


def _codebooks() -> list[Recipe]:
    n = _spec.CODEBOOK_ENTRIES_MAX
    entries = [[3, -4, 5, 1, 2, 3]] * (n - 1) + [[7] * 6]
    flat = Codebook(65535, _spec.CODEBOOK_KIND_SHAPE, {0: entries}, how=Stream(1, _RUNS))
    own = signed([[1, 2, 3]])
    wide = {SCALES: book(65535, (n - 1, n, 0), own, Stream(3), summands=(5, 0, 6)), QUATS: book(65535, (), own)}
    unused = (
        Codebook(1, _spec.CODEBOOK_KIND_SHAPE, {0: [[1, 2, 3, 4, 5, 6]]}),
        Codebook(2, _spec.CODEBOOK_KIND_SH, {1: rows_of(1, 2, 9, -1, 1)}, (1, 1)),
    )
    shape = Codebook(9, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(3, 2, 6, -9, 9)})
    every = {
        SCALES: book(9, (2, 2, 2), signed([[1, 2, 3]] * 3), summands=(0, 0, 0)),
        QUATS: book(9, (), signed([[4, 5, 6]] * 3)),
    }
    ignored = {
        SCALES: book(9, (2, 0, 1), signed([[1, 2, 3]]), summands=(77, 0, 5), offsets=(0,)),
        QUATS: book(9, (), signed([[4, 5, 6]])),
    }
    largest = _spec.COLUMN_MAX
    turns = {0: [[1, 2, 3, *turn] for turn in ([1, 2, 3], [127, -127, 0], [0, 127, 127])]}
    bounds = {1: [[*range(9)], [largest, 0, -largest] * 3]}
    at_bounds = (
        Codebook(2, _spec.CODEBOOK_KIND_SHAPE, turns),
        Codebook(3, _spec.CODEBOOK_KIND_SH, bounds, (1, 1), Stream(4)),
    )
    zeros = (0, 0, 0)
    first = {SCALES: book(2, zeros, summands=(4, 5, 6)), QUATS: book(2), sh_attribute(1): book(3, zeros)}
    shifted = Codebook(1, _spec.CODEBOOK_KIND_SHAPE, {0: [[2**22 + 2, 2**22 + 3, 2**22 + 1, 4, 5, 6]]}, how=Stream(4))
    back = {SCALES: book(1, (0, 0, 0), summands=(-(2**22), 1 - 2**22, -(2**22))), QUATS: book(1)}
    return [
        _recipe(
            "codebook_of_65536",
            "the escape index is 65,536 and needs three bytes",
            "CBR-4 CBK-2",
            replace(_with(wide), codebooks=(flat,)),
        ),
        _recipe(
            "codebooks_unused",
            "codebooks that no block uses, listed by the tile all the same",
            "TIL-6 DIR-5",
            scene(1, [tile(degree=1, tables=(1, 2))], codebooks=unused),
        ),
        _recipe(
            "codebook_all_escaped",
            "no splat uses an entry",
            "CBK-3",
            replace(_with(every), codebooks=(shape,)),
        ),
        _recipe(
            "codebook_unused_summand",
            "the summand of an escaped splat is not 0: ignored",
            "CBK-6",
            replace(_with(ignored), codebooks=(shape,)),
        ),
        _recipe(
            "codebook_entries_at_bounds",
            "rotations and colours that no splat uses and that are just allowed",
            "CBK-7",
            scene(
                1,
                [tile(2, 3, 1, first)],
                codebooks=at_bounds,
                attributes=attributes(1) | {sh_attribute(1): _lattice(2.0**105)},
            ),
        ),
        _recipe(
            "codebook_scales_before_summand",
            "scales of shapes beyond binary32, which the summands bring back",
            "CBK-7 CBK-6",
            replace(_with(back, records={SCALES: _lattice(2.0**106)}), codebooks=(shifted,)),
        ),
    ]


def _streams() -> list[Recipe]:
    values = [7, 8, 9]

    def with_coded(name: str, why: str, data: bytes) -> Recipe:
        how = Stream(coder="deflate", coded=data)
        return _recipe(name, why, "COD-2", _with({OPACITIES: levels(values, how)}))

    empties = b"\x00\x00\x00\xff\xff" * 50 + deflate_stored(bytes(values))
    single = Stream(1, _RUNS, packed=bytes([7, 8, 9, 0, 0, 0, 0, 0, 0]))
    split = Stream(1, _RUNS, packed=bytes([7, 7, 7, 0, 0, 0, 0, 0, 0]))
    return [
        with_coded("deflate_unused_bits", "ones after the final block: ignored", deflate_fixed(bytes(values), 1)),
        with_coded("deflate_empty_blocks", "fifty empty stored blocks", empties),
        with_coded("deflate_many_blocks", "a stored block per byte", deflate_stored(bytes(values), 1)),
        _recipe(
            "run_length_longer_than_plain",
            "runs of one: three times the size",
            "STR-5",
            _with({OPACITIES: levels(values, single)}),
        ),
        _recipe(
            "run_length_split_runs",
            "equal neighbours in runs of their own",
            "STR-5",
            _with({OPACITIES: levels([7, 7, 7], split)}),
        ),
        _recipe(
            "streams_too_wide",
            "more bytes than the integers need",
            "STR-2",
            _with(
                {
                    OPACITIES: levels(values, Stream(2)),
                    SCALES: offset(rows_of(1, 3, 3, -9, 9), Stream(4)),
                    MEANS: axis(means_rows(1, 3, 9), Stream(3)),
                }
            ),
        ),
        _recipe(
            "extra_of_eight_bytes_coded",
            "differences modulo 2^64",
            "STR-2 RAW-2",
            scene(
                tiles=[tile(extras=(Block(_spec.CODING_RAW, [[2**64 - 1], [1]], Stream(8, (1, 2, 3, 4))),))],
                extras=(Extra("e", _spec.EXTRA_DTYPE_F64),),
            ),
        ),
    ]


def _texts() -> list[Recipe]:
    deepest = b'{"a":' + b"[" * 63 + b"]" * 63 + b"}"
    number = b'{"n":0.' + b"1" * 5000 + b"}"
    long_number = Stream(1, _RUNS)
    other = b'{"a":{"a":1},"A":"\\ud83d\\ude00","\\u0000":-0.0e-0,"\xc3\xa9":1e308}'

    def meta(name: str, why: str, text: bytes, how: Stream = PLAIN) -> Recipe:
        return _recipe(name, why, "JSN-1", scene(chunks=(Chunk(_spec.CHUNK_METADATA, text, how),)))

    nothing = StatedErrors(2, 0, 255, 0, ())
    return [
        meta("json_64_deep", "the deepest nesting that is allowed", deepest),
        meta("json_long_number", "a number of 5,000 digits is valid JSON", number, long_number),
        meta("json_odd", "white space, escapes, U+0000, minus zero, a large number", b" \t\r\n" + other + b"\n"),
        _recipe(
            "stated_errors_none",
            "a head without records",
            "SER-3 SER-4",
            scene(chunks=(Chunk(_spec.CHUNK_STATED_ERRORS, errors=nothing),)),
        ),
        _recipe(
            "unit_smallest",
            "a subnormal unit and origin",
            "IDX-5 IDX-6",
            replace(scene(), unit_metres=5e-324, origin=(-1.7976931348623157e308, 5e-324, -0.0)),
        ),
        _recipe("seeded", "forty splats of degree 3 in three coders", "CNF-1", _seeded()),
    ]


def _seeded() -> Scene:
    made = scene(3, [tile(77, 40, 3)], attributes=attributes(3, True, 2))
    changed = coded(made, lambda how: replace(how, width=2, transforms=(1, 2, 3), coder="deflate_dynamic"))
    blocks = changed.tiles[0].blocks | {OPACITIES: levels(integers(5, 40, 0, 255), Stream(1, _RUNS))}
    return replace(changed, tiles=(replace(changed.tiles[0], blocks=blocks),))


def _recipe(name: str, why: str, clauses: str, made: Scene) -> Recipe:
    return Recipe(f"extreme/{name}", why, tuple(clauses.split()), lambda: build(made).data, made)


def _with(changes: dict[int, Block], n: int = 3, records: dict[int, Attribute] | None = None, **rest: object) -> Scene:
    made = scene(tiles=[replace(tile(2, n, 0, changes), **rest)])  # type: ignore[arg-type]  # fields of Tile
    return replace(made, attributes=made.attributes | (records or {}))


def _lattice(step: float, mapping: int = _spec.MAPPING_LATTICE, chroma_shift: int = 0) -> Attribute:
    return Attribute(mapping, step, chroma_shift=chroma_shift)
