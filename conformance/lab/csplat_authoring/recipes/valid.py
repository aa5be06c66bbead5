# SPDX-License-Identifier: CC0-1.0
"""Computed valid files: streams, codebooks, tiles, the longest records, and combinations of features."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import combinations, cycle

from csplat import _spec
from csplat_authoring.builder import SIZED
from csplat_authoring.recipe import Recipe, valid_recipe
from csplat_authoring.samples import (
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    SH0,
    attributes,
    axis,
    codebook_block,
    integers,
    levels,
    means_rows,
    morton,
    offset,
    quat_rows,
    rich_scene,
    rows_of,
    scene,
    sh_attribute,
    signed,
    sparse,
    tile,
    with_stream_codings,
)
from csplat_authoring.scene import Block, Chunk, Codebook, Extra, Scene, Stream, Tile
from csplat_authoring.worked_example import example_scene

_valid = partial(valid_recipe, "valid")
_DELTA, _ZIGZAG, _PLANES, _RUNS = (
    _spec.TRANSFORM_DELTA,
    _spec.TRANSFORM_ZIGZAG,
    _spec.TRANSFORM_BYTE_PLANES,
    _spec.TRANSFORM_RUN_LENGTH,
)
#: Every list of transforms that STR-3 allows.
_TRANSFORMS = [chosen for k in range(5) for chosen in combinations((_DELTA, _ZIGZAG, _PLANES, _RUNS), k)]
_RECORD_SIZE_MAX = 255  # bytes: the sizes of records are u8


def valid_recipes() -> list[Recipe]:
    """Return recipes of single features and sizes."""
    many = [tile(k, 1, k % 2, corner=(k, -k, 2 * k), exponent=k % 5 - 2) for k in range(24)]
    return [
        valid_recipe(
            "valid",
            "worked_example",
            "the file that example.md reads byte by byte",
            "COV-2 DIR-3 TIL-4",
            example_scene(),
        ),
        valid_recipe(
            "valid", "record_tails_longest", "a head and records of 255 bytes", "IDX-8 IDX-9", _longest_records()
        ),
        valid_recipe(
            "extreme", "tile_of_65536", "a full tile, one run after the other", "TIL-1 STR-5 TRF-1 SPA-1", _full_tile()
        ),
        valid_recipe(
            "extreme",
            "tile_of_65536_band_4",
            "65,536 times 27 elements of four bytes in one stream, the longest",
            "TIL-1 STR-5 TIL-4",
            full_band_4(),
        ),
        valid_recipe(
            "extreme",
            "tiles_of_one",
            "many tiles, each with layers and exponents of its own",
            "TIL-1 TIL-4",
            scene(1, many),
        ),
    ]


def _longest_records() -> Scene:
    sizes = {kind: int(getattr(_spec, f"{name.upper()}_SIZE")) for kind, name in SIZED.items()}
    tails = tuple((kind, bytes([165]) * (_RECORD_SIZE_MAX - size)) for kind, size in sizes.items())
    return replace(rich_scene(), tails=tails)


def _full_tile() -> Scene:
    n = _spec.TILE_SPLATS_MAX
    same = tile(1, 1)
    full = {a: replace(b, rows=[list(b.rows[0])] * n) for a, b in same.blocks.items()}
    full |= {QUATS: signed([[1, 2, 3]] * (n - 1) + [[9, 9, 9]])}
    full |= {SH0 + 1: sparse((1,) * n, [[5] * 9] * n, mask_coding=Stream(1, (_RUNS,)))}
    return with_stream_codings(
        scene(1, tiles=[replace(same, blocks=full)]), lambda coding: replace(coding, transforms=(_RUNS,))
    )


def full_band_4() -> Scene:
    """Return a full tile without bands 1 to 3, whose last splat alone differs in band 4."""
    n = _spec.TILE_SPLATS_MAX
    same = tile(2, 1)
    full = {a: replace(b, rows=[list(b.rows[0])] * n) for a, b in same.blocks.items()}
    full |= {SH0 + 4: signed([[*range(-13, 14)]] * (n - 1) + [[*range(27)]], Stream(4))}
    return with_stream_codings(
        scene(4, tiles=[replace(same, blocks=full)]), lambda coding: replace(coding, transforms=(_PLANES, _RUNS))
    )


def valid_stream_recipes() -> list[Recipe]:
    """Return recipes of streams and codebooks."""
    return [*_streams(), *_codebooks()]


def _streams() -> list[Recipe]:
    base = scene(1, [tile(4, 6, 1)])
    wide = with_stream_codings(replace(base), lambda _: Stream(2))
    result = []
    for chosen in _TRANSFORMS:
        name = "_".join(_spec.TRANSFORM_NAMES[t] for t in chosen) or "none"
        made = with_stream_codings(wide, lambda coding, chosen=chosen: replace(coding, transforms=chosen))  # type: ignore[misc]  # a bound default
        result.append(
            _valid(f"transforms_{name}", "every stream of the file, two bytes wide", "STR-3 STR-4 STR-5 TRF-1", made)
        )
    for name in ("deflate_stored", "deflate_fixed", "deflate_dynamic"):
        made = with_stream_codings(base, lambda coding, name=name: replace(coding, coder=name))  # type: ignore[misc]  # a bound default
        result.append(_valid(f"coder_{name}", "each block type of RFC 1951", "COD-2 COD-4", made))
    made = with_stream_codings(
        wide, lambda coding: replace(coding, transforms=(_PLANES, _RUNS), coder="deflate_dynamic")
    )
    result.append(_valid("run_length_deflate", "runs of byte planes, then DEFLATE", "COD-2 STR-5 TRF-1", made))
    return result


def _codebooks() -> list[Recipe]:
    result = _shapes()
    for first, last in ((1, 1), (2, 2), (3, 3), (1, 2), (2, 3), (1, 3), (4, 4), (2, 4), (1, 4)):
        degree = max(3, last)
        entries = {band: rows_of(band, 3, 3 * (2 * band + 1), -99, 99) for band in range(first, last + 1)}
        made = Codebook(900, _spec.CODEBOOK_KIND_SH, entries, (first, last), Stream(1, (_DELTA, _ZIGZAG)))
        changes = {SH0 + first: codebook_block(900, (0, 2, 1, 1))} | {
            SH0 + b: codebook_block(900) for b in range(first + 1, last + 1)
        }
        others = {
            SH0 + b: signed(rows_of(b, 4, 3 * (2 * b + 1), -9, 9))
            for b in range(1, degree + 1)
            if b not in range(first, last + 1)
        }
        whole = scene(degree, [tile(3, 4, 0, dict(sorted((changes | others).items())))], codebooks=(made,))
        result.append(
            _valid(f"codebook_sh_{first}_{last}", "bands in chunks of their own, one index", "DIR-5 CBR-2 CBK-4", whole)
        )
    return result


def _shapes() -> list[Recipe]:
    shape = Codebook(5, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(1, 3, 6, -40, 40)})
    plain = tile(3, 4, 0, {SCALES: codebook_block(5, (2, 0, 1, 0), summands=(-9, 4, 0, 7)), QUATS: codebook_block(5)})
    escapes = tile(
        3,
        4,
        0,
        {
            SCALES: codebook_block(
                5, (3, 0, 1, 3), offset(rows_of(8, 2, 3, -30, 30)), summands=(0, 4, -300, 0), offsets=(-300,)
            ),
            QUATS: codebook_block(5, (), signed(rows_of(9, 2, 3, -60, 60))),
        },
    )
    escapes = replace(
        escapes, blocks=escapes.blocks | {SCALES: replace(escapes.blocks[SCALES], stream_coding=Stream(2))}
    )
    half = tile(3, 4, 0, {SCALES: codebook_block(5, (2, 0, 1, 0), summands=(-9, 4, 0, 7))})
    return [
        _valid(
            "codebook_shape",
            "a common summand of the log scales",
            "CBK-1 CBK-2 CBK-4 CBK-6 CBK-7",
            scene(tiles=[plain], codebooks=(shape,)),
        ),
        _valid(
            "codebook_shape_escape",
            "escapes in both blocks",
            "CBK-3 CBK-4 CBK-5",
            scene(tiles=[escapes], codebooks=(shape,)),
        ),
        _valid("codebook_shape_scales_only", "rotations coded apart", "CBK-1", scene(tiles=[half], codebooks=(shape,))),
    ]


# Combinations ----------------------------------------------------------------------------------------

_CODERS = ("stored", "deflate_stored", "deflate_fixed", "deflate_dynamic")
_N = 4


def combined_recipes() -> list[Recipe]:
    """Return recipes of files that combine features."""
    result = [
        _valid(
            f"combined_{coder}",
            f"every coding in every width, streams by {coder} after each of the sixteen transform lists",
            "STR-2 STR-3 STR-4 STR-5 TRF-1",
            _all_streams((coder,)),
        )
        for coder in _CODERS
    ]
    return [
        *result,
        _valid(
            "combined_codebooks",
            "codebooks of every kind in one file, escapes of every coding, extras and all known chunks",
            "CBK-1 CBK-3 CBK-4 CBK-5 DIR-5 TIL-6",
            _all_codebooks(),
        ),
        *(
            _valid(
                f"codebook_sh_1_{degree}_escape",
                "one index for all bands; the second and the last splat are escaped in each",
                "CBK-3 CBK-4 CBK-5",
                _escaped_bands(degree),
            )
            for degree in (3, 4)
        ),
        _valid(
            "combined_tiles",
            "tiles that differ in everything a tile may choose",
            "TIL-4 TIL-6 TIL-9 LAT-1",
            _different_tiles(),
        ),
    ]


# Streams -------------------------------------------------------------------------------------------


def _all_streams(coders: tuple[str, ...]) -> Scene:
    """Return tiles in which each coding has streams of all its widths, and each transform list occurs."""
    ways = _ways(coders)
    dtypes = (_spec.EXTRA_DTYPE_I8, _spec.EXTRA_DTYPE_I16, _spec.EXTRA_DTYPE_F32, _spec.EXTRA_DTYPE_F64)
    extras = tuple(Extra(_spec.EXTRA_DTYPE_NAMES[dtype], dtype) for dtype in dtypes)
    tiles = tuple(_tile_of_widths(k, ways) for k in range(8))
    return replace(scene(3, tiles), extras=extras)


def _ways(coders: tuple[str, ...]) -> Iterator[Stream]:
    pairs = [(transforms, coder) for coder in coders for transforms in _TRANSFORMS]
    return (Stream(1, transforms, coder) for transforms, coder in cycle(pairs))


def _tile_of_widths(k: int, ways: Iterator[Stream]) -> Tile:
    """Return tile number k, whose streams have the width k modulo the widths of their codings."""

    def way(most: int) -> Stream:
        return replace(next(ways), width=k % most + 1)

    seed = 50 + 10 * k
    lattice = signed if k % 2 else offset
    means = means_rows(seed, _N, 3)
    blocks = {
        OPACITIES: levels(integers(seed, _N, 0, 255), way(2)),
        SCALES: lattice(rows_of(seed + 1, _N, 3, -90, 20), way(4)),
        QUATS: signed(quat_rows(seed + 2, _N), way(4)),
        # A Morton code of two bits per axis fits the narrowest stream.
        MEANS: axis(means, way(3)) if k in (1, 3) else morton(means, 2, way(7)),
        SH0: offset(rows_of(seed + 4, _N, 3, -60, 60), way(4)),
    }
    for band in (1, 2, 3):
        rows = rows_of(seed + 4 + band, _N, 3 * (2 * band + 1), -90, 90)
        blocks[sh_attribute(band)] = (offset if (k + band) % 2 else signed)(rows, way(4))
    if k > 3:  # a band that only some splats have
        band = k % 3 + 1
        rows = rows_of(seed, 2, 3 * (2 * band + 1), -90, 90)
        blocks[sh_attribute(band)] = sparse((0, 1, 1, 0), rows, way(4), way(1))
    sizes = (1, 2, 4, 8)
    extras = tuple(
        Block(_spec.CODING_RAW, rows_of(seed + size, _N, 1, 0, 127), replace(next(ways), width=size)) for size in sizes
    )
    return Tile(blocks, corner=(k, -k, 0), exponent=k - 3, extras=extras)


# Codebooks -----------------------------------------------------------------------------------------


def _all_codebooks() -> Scene:
    books = (
        Codebook(2, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(2, 3, 6, -40, 40)}, stream_coding=Stream(4, (1, 2, 3, 4))),
        Codebook(4, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(5, 2, 6, -40, 40)}, stream_coding=Stream(2, (2, 3))),
        Codebook(6, _spec.CODEBOOK_KIND_SH, {1: rows_of(8, 3, 9, -50, 50)}, (1, 1), Stream(3)),
        Codebook(
            7,
            _spec.CODEBOOK_KIND_SH,
            {b: rows_of(9 + b, 3, 3 * (2 * b + 1), -30, 30) for b in (2, 3)},
            (2, 3),
            Stream(1, (), "deflate_dynamic"),
        ),
    )
    chunks = (
        Chunk(_spec.CHUNK_METADATA, b'{"title":"all codebooks"}'),
        Chunk(_spec.CHUNK_CAMERAS, b"[]"),
        Chunk(_spec.CHUNK_OPTIONS, b"{}", Stream(1, (4,))),
        Chunk(b"priv", payload=b"\0\1\2", flags=_spec.CHUNK_FLAG_SAFE_TO_COPY),
    )
    made = scene(3, [_apart(), _together()], codebooks=books, chunks=chunks)
    return replace(made, attributes=attributes(3, ycocg=True), extras=(Extra("id", _spec.EXTRA_DTYPE_U32),))


def _apart() -> Tile:
    """Return a tile whose codebooks all have escapes."""
    wide = Stream(2)
    changes = {
        SCALES: codebook_block(
            2, (2, 3, 0, 3), signed(rows_of(1, 2, 3, -300, 300), wide), Stream(4, (1, 3)), summands=(-9, 0, 4, 0)
        ),
        QUATS: codebook_block(2, (), signed(rows_of(2, 2, 3, -60, 60))),
        sh_attribute(1): codebook_block(6, (3, 0, 3, 1), offset(rows_of(4, 2, 9, -9, 900), wide), Stream(3)),
        sh_attribute(2): codebook_block(7, (0, 3, 1, 2), signed(rows_of(5, 1, 15, -99, 99))),
        sh_attribute(3): codebook_block(7, (), offset(rows_of(6, 1, 21, -99, 99))),
    }
    return tile(60, _N, 0, changes, extras=(_raw(1),))


def _together() -> Tile:
    """Return a tile with another SHAPE codebook; bands 2 and 3 are coded without codebooks."""
    changes = {
        SCALES: codebook_block(
            4, (1, 2, 0, 0), offset(rows_of(7, 1, 3, -20, 20)), summands=(-40, 0, -60, -20), offsets=(-60,)
        ),
        QUATS: codebook_block(4, (), signed(rows_of(8, 1, 3, -50, 50))),
        sh_attribute(2): offset(rows_of(9, _N, 15, -20, 20)),
        sh_attribute(3): signed(rows_of(10, _N, 21, -20, 20)),
        sh_attribute(1): codebook_block(6, (0, 1, 1, 0)),
    }
    return tile(70, _N, 0, dict(sorted(changes.items())), exponent=-1, extras=(_raw(2),))


def _escaped_bands(degree: int) -> Scene:
    entries = {band: rows_of(band, 2, 3 * (2 * band + 1), -99, 99) for band in range(1, degree + 1)}
    table = Codebook(1, _spec.CODEBOOK_KIND_SH, entries, (1, degree), Stream(1))
    rows = {band: rows_of(band + 5, 2, 3 * (2 * band + 1), -120, 120) for band in entries}
    changes = {
        sh_attribute(band): codebook_block(1, (1, 2, 0, 2) if band == 1 else (), signed(rows[band])) for band in rows
    }
    return replace(scene(degree, [tile(80, _N, 0, changes)]), codebooks=(table,))


def _raw(seed: int) -> Block:
    return Block(_spec.CODING_RAW, rows_of(seed, _N, 1, 0, 2**31), Stream(4, (3,)))


# Tiles ---------------------------------------------------------------------------------------------


def _different_tiles() -> Scene:
    """Return tiles of 1, 2, 9 and 40 splats with different layers, exponents, codings and codebooks."""
    shape = Codebook(4, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(1, 5, 6, -40, 40)})
    shapes = {
        SCALES: codebook_block(
            4, tuple(integers(3, 40, 0, 4)), summands=tuple(integers(5, 40, -60, 0)), offsets=(-60,)
        ),
        QUATS: codebook_block(4),
    }
    tiles = (
        tile(1, 1, 0, {SCALES: signed(rows_of(1, 1, 3, -90, -1), exponent=-2)}, corner=(0, 0, 0)),
        tile(2, 2, 3, corner=(-(2**40), 2**40, 0), exponent=7),
        tile(3, 9, 0, {sh_attribute(2): offset(rows_of(2, 9, 15, -60, 60), exponent=4)}, codebook_ids=(4,)),
        tile(4, 40, 1, {**shapes, MEANS: morton(means_rows(4, 40, 500), 9, Stream(4, (1, 3, 4)))}),
    )
    return replace(scene(3, tiles), codebooks=(shape,), attributes=attributes(3, ycocg=True, chroma_shift=3))
