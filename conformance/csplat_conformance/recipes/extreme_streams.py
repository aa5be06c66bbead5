"""Valid files of a kind that no sensible encoder writes: codebooks, streams, texts."""

from __future__ import annotations

from dataclasses import replace

from csplat import _spec
from csplat_conformance.builder import build
from csplat_conformance.deflate import deflate_fixed, deflate_stored
from csplat_conformance.samples import (
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    SH0,
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
    signed,
    tile,
)
from csplat_conformance.scene import PLAIN, Attribute, Block, Chunk, Codebook, Extra, Scene, StatedErrors, Stream

__all__ = ["extreme_stream_recipes"]

_RUNS = (_spec.TRANSFORM_RUN_LENGTH,)


def extreme_stream_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_codebooks(), *_streams(), *_texts()]


def _codebooks() -> list[Recipe]:
    n = _spec.CODEBOOK_ENTRIES_MAX
    flat = Codebook(65535, _spec.CODEBOOK_KIND_SH0, ({0: [[3, -4, 5]] * (n - 1) + [[7, 7, 7]]},), how=Stream(1, _RUNS))
    wide = book(65535, ((n - 1, n, 0),), signed([[1, 2, 3]]), Stream(3))
    unused = (
        Codebook(1, _spec.CODEBOOK_KIND_QUATS, ({0: [[1, 2, 3]]},)),
        Codebook(2, _spec.CODEBOOK_KIND_SH, ({1: rows_of(1, 2, 9, -1, 1)},), (1, 1)),
    )
    stages = tuple({0: rows_of(k, 2, 3, -9, 9)} for k in range(2))
    two = Codebook(4, _spec.CODEBOOK_KIND_SH0, stages)
    junk = book(4, ((2, 0, 2), (1, 1, 0)), signed([[9, 8, 7], [6, 5, 4]]))
    low, high = {0: [[-(2**31), 2**31 - 1, 0]]}, {0: [[2**31 - 1, -(2**31), 0]]}
    far = Codebook(6, _spec.CODEBOOK_KIND_SCALES, (low, low, high, high), how=Stream(4))
    alone = Codebook(3, _spec.CODEBOOK_KIND_QUATS, ({0: [[-200, 0, 0]]}, {0: [[201, 3, 4], [190, 5, 6]]}))
    shape = Codebook(9, _spec.CODEBOOK_KIND_SHAPE, ({0: rows_of(3, 2, 6, -9, 9)},))
    ignored = {
        SCALES: book(9, ((2, 0, 1),), signed([[1, 2, 3]]), summands=(77, 0, 5), offsets=(0,)),
        QUATS: book(9, (), signed([[4, 5, 6]])),
    }
    entries = ([[1, -2, 3], [2**30, 0, -(2**31)]], [[4, 5, 6], [0, 2**31 - 1, 0]])
    wild = Codebook(8, _spec.CODEBOOK_KIND_SH0, tuple({0: stage} for stage in entries), how=Stream(4))
    thrice = tuple({1: [entry * 3 for entry in stage]} for stage in entries)
    far_sh = Codebook(8, _spec.CODEBOOK_KIND_SH, thrice, (1, 1), Stream(4))
    bands = {SH0 + 1: book(8, ((0, 2, 0), (0, 0, 0)), signed([[5, -6, 7] * 3]))}
    largest = _spec.COLUMN_MAX
    at_bounds = (
        Codebook(2, _spec.CODEBOOK_KIND_QUATS, ({0: [[1, 2, 3], [127, -127, 0], [0, 127, 127]]},)),
        Codebook(3, _spec.CODEBOOK_KIND_SH0, ({0: [[1, 2, 3], [largest, 0, -largest]]},), how=Stream(4)),
    )
    ids = {QUATS: 2, SH0: 3}
    shifted = Codebook(
        1, _spec.CODEBOOK_KIND_SHAPE, ({0: [[2**22 + 2, 2**22 + 3, 2**22 + 1, 4, 5, 6]]},), how=Stream(4)
    )
    back = {SCALES: book(1, ((0, 0, 0),), summands=(-(2**22), 1 - 2**22, -(2**22))), QUATS: book(1)}
    return [
        _recipe(
            "codebook_of_65536",
            "the escape index is 65,536 and needs three bytes",
            "CBR-4 CBK-2",
            replace(_with({SH0: wide}), codebooks=(flat,)),
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
            replace(_with({SH0: book(4, ((2, 2, 2), (0, 0, 0)), signed([[1, 2, 3]] * 3))}), codebooks=(two,)),
        ),
        _recipe(
            "codebook_unused_indices",
            "later indices of escaped splats are not 0: ignored",
            "CBK-2",
            replace(_with({SH0: junk}), codebooks=(two,)),
        ),
        _recipe(
            "codebook_unused_summand",
            "the summand of an escaped splat is not 0: ignored",
            "CBK-6",
            replace(_with(ignored), codebooks=(shape,)),
        ),
        _recipe(
            "codebook_sums_beyond_32_bits",
            "entries of ±2^31 that add up to −2, by way of −2^32",
            "CBK-6 LAT-4",
            replace(_with({SCALES: book(6, ((0, 0, 0),) * 4)}, records={SCALES: _lattice(2.0**-30)}), codebooks=(far,)),
        ),
        _recipe(
            "codebook_unused_entries",
            "entries of two stages beyond every limit that no splat uses",
            "CBK-6 LAT-5",
            replace(
                _with({SH0: book(8, ((0, 0, 0), (0, 0, 0)))}, records={SH0: _lattice(2.0**100)}), codebooks=(wild,)
            ),
        ),
        _recipe(
            "codebook_unused_entries_sh",
            "the same in an SH codebook, whose last entry stands where the escaped splat has none",
            "CBK-6 LAT-5",
            replace(_with(bands, records={SH0 + 1: _lattice(2.0**100)}), codebooks=(far_sh,), sh_degree=1),
        ),
        _recipe(
            "codebook_entries_at_bounds",
            "rotations and colours that no splat uses and that are just allowed",
            "CBK-7",
            replace(
                _with({a: book(id, ((0, 0, 0),)) for a, id in ids.items()}, records={SH0: _lattice(2.0**105)}),
                codebooks=at_bounds,
            ),
        ),
        _recipe(
            "codebook_scales_before_summand",
            "scales of shapes beyond binary32, which the summands bring back",
            "CBK-7 CBK-6",
            replace(_with(back, records={SCALES: _lattice(2.0**106)}), codebooks=(shifted,)),
        ),
        _recipe(
            "codebook_negative_entries",
            "rotations that only the sum makes legal",
            "CBK-6 QUA-1",
            replace(_with({QUATS: book(3, ((0, 0, 0), (0, 1, 0)))}), codebooks=(alone,)),
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
