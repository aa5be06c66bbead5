# SPDX-License-Identifier: CC0-1.0
"""Small scenes and blocks of pseudo-random integers, which the recipes vary."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from csplat import _spec
from csplat_authoring.scene import (
    PAIRS,
    PLAIN,
    Attribute,
    Block,
    Chunk,
    Codebook,
    DeclaredErrors,
    Extra,
    Rows,
    Scene,
    Stream,
    Tile,
)

OPACITIES, SCALES, QUATS, MEANS, SH0 = (
    _spec.ATTRIBUTE_OPACITIES,
    _spec.ATTRIBUTE_SCALES,
    _spec.ATTRIBUTE_QUATS,
    _spec.ATTRIBUTE_MEANS,
    _spec.ATTRIBUTE_SH0,
)
_LEVELS_OPACITIES, _LEVELS_QUATS = 255, 127


def integers(seed: int, count: int, low: int, high: int) -> list[int]:
    """Return pseudo-random integers from low to high (64-bit linear congruential generator, Knuth's constants)."""
    state, result = seed * 2 + 1, []
    for _ in range(count):
        state = (state * 6364136223846793005 + 1442695040888963407) % 2**64
        result.append(low + (state >> 33) % (high - low + 1))
    return result


def rows_of(seed: int, n: int, columns: int, low: int, high: int) -> list[list[int]]:
    """Return [n, columns] pseudo-random integers."""
    flat = integers(seed, n * columns, low, high)
    return [flat[i * columns : (i + 1) * columns] for i in range(n)]


def means_rows(seed: int, n: int, high: int) -> list[list[int]]:
    """Return [n, 3] integers whose minimum is 0 on each axis."""
    rows = rows_of(seed, n, 3, 0, high)
    low = [min(column) for column in zip(*rows, strict=True)]
    return [[q - least for q, least in zip(row, low, strict=True)] for row in rows]


def quat_rows(seed: int, n: int, m: int = _LEVELS_QUATS) -> list[list[int]]:
    """Return [n, 3] integers of rotations at M levels."""
    return rows_of(seed, n, 3, -(m * 2 // 3), m * 2 // 3)


def levels(values: Sequence[int], stream_coding: Stream = PLAIN) -> Block:
    """Return a block coded LEVELS."""
    return Block(_spec.CODING_LEVELS, [*zip(values, strict=True)], stream_coding)


def morton(rows: Rows, bits: int, stream_coding: Stream = PAIRS) -> Block:
    """Return a block coded MORTON."""
    return Block(_spec.CODING_MORTON, rows, stream_coding, bits=bits)


def axis(rows: Rows, stream_coding: Stream = PLAIN) -> Block:
    """Return a block coded AXIS."""
    return Block(_spec.CODING_AXIS, rows, stream_coding)


def offset(rows: Rows, stream_coding: Stream = PLAIN, exponent: int = 0, offsets: tuple[int, ...] = ()) -> Block:
    """Return a block coded OFFSET; by default, the offsets are the minima of the columns."""
    return Block(_spec.CODING_OFFSET, rows, stream_coding, exponent=exponent, offsets=offsets)


def signed(rows: Rows, stream_coding: Stream = PLAIN, exponent: int = 0) -> Block:
    """Return a block coded SIGNED."""
    return Block(_spec.CODING_SIGNED, rows, stream_coding, exponent=exponent)


def sparse(
    mask: tuple[int, ...], rows: Rows, stream_coding: Stream = PLAIN, mask_coding: Stream = PLAIN, exponent: int = 0
) -> Block:
    """Return a block coded SPARSE: a bit per splat, and the rows of the splats whose bit is 1."""
    return Block(_spec.CODING_SPARSE, rows, stream_coding, exponent=exponent, mask=mask, mask_coding=mask_coding)


def codebook_block(
    codebook: int,
    indices: tuple[int, ...] = (),
    escape: Block | None = None,
    index_coding: Stream = PLAIN,
    **rest: Any,
) -> Block:
    """Return a block coded CODEBOOK; without indices it is not the first of its codebook."""
    return Block(
        _spec.CODING_CODEBOOK, codebook=codebook, indices=indices, index_coding=index_coding, escape=escape, **rest
    )


def sh_attribute(band: int) -> int:
    """Return the registry value of an SH band."""
    return SH0 + band


def as_binary32(step: float) -> float:
    """Return the binary32 value nearest to a step."""
    return float(np.float32(step))


def attributes(degree: int = 0, ycocg: bool = False, chroma_shift: int = 0) -> dict[int, Attribute]:
    """Return attribute records with steps that are not powers of two, of colours and scales in binary32."""
    colour = _spec.MAPPING_YCOCG if ycocg else _spec.MAPPING_LATTICE
    result = {
        OPACITIES: Attribute(_spec.MAPPING_LINEAR, levels=_LEVELS_OPACITIES),
        SCALES: Attribute(_spec.MAPPING_LATTICE, as_binary32(0.1)),
        QUATS: Attribute(_spec.MAPPING_UNIT_W, levels=_LEVELS_QUATS),
        MEANS: Attribute(_spec.MAPPING_LATTICE, 0.001),
    }
    for band in range(degree + 1):
        result[SH0 + band] = Attribute(colour, as_binary32(0.03 / (band + 1)), chroma_shift=chroma_shift)
    return result


def tile(seed: int = 1, n: int = 2, degree: int = 0, changes: dict[int, Block] | None = None, **rest: Any) -> Tile:
    """Return a tile of pseudo-random integers in one-byte streams."""
    blocks = {
        OPACITIES: levels(integers(seed, n, 0, _LEVELS_OPACITIES)),
        SCALES: offset(rows_of(seed + 1, n, 3, -90, 20)),
        QUATS: signed(quat_rows(seed + 2, n)),
        MEANS: axis(means_rows(seed + 3, n, 200)),
        SH0: offset(rows_of(seed + 4, n, 3, -60, 60)),
    }
    for band in range(1, degree + 1):
        blocks[SH0 + band] = signed(rows_of(seed + 4 + band, n, 3 * (2 * band + 1), -100, 100))
    blocks |= changes or {}
    values: dict[str, Any] = {"corner": (-100, 5, 1000)}
    return Tile(blocks, **(values | rest))


def scene(degree: int = 0, tiles: Sequence[Tile] | None = None, **rest: Any) -> Scene:
    """Return a scene of one small tile, or of the given tiles."""
    values: dict[str, Any] = {"attributes": attributes(degree), "sh_degree": degree}
    values["tiles"] = (tile(degree=degree),) if tiles is None else tuple(tiles)
    return Scene(**(values | rest))


def with_stream_codings(original: Scene, change: Callable[[Stream], Stream]) -> Scene:
    """Return the scene with the coding of every stream of a tile changed."""
    tiles = []
    for one in original.tiles:
        blocks = {
            attribute: replace(block, stream_coding=change(block.stream_coding))
            for attribute, block in one.blocks.items()
        }
        tiles.append(replace(one, blocks=blocks))
    return replace(original, tiles=tuple(tiles))


def rich_scene() -> Scene:
    """Return a scene of two tiles with codebooks, escapes, an absent band, extras and all known chunks."""
    shape = Codebook(2, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(1, 3, 6, -40, 40)})
    colours = Codebook(
        7,
        _spec.CODEBOOK_KIND_SH,
        {band: rows_of(band, 4, 3 * (2 * band + 1), -50, 50) for band in (1, 2)},
        (1, 2),
    )
    escape1, escape2 = signed(rows_of(21, 1, 9, -500, 500), Stream(2)), offset(rows_of(22, 1, 15, -5, 5))
    first = tile(
        3,
        3,
        0,
        {
            SCALES: codebook_block(2, (0, 2, 1), summands=(-50, -40, -60)),
            QUATS: codebook_block(2),
            SH0 + 1: codebook_block(7, (0, 4, 3), escape1),
            SH0 + 2: codebook_block(7, (), escape2),
        },
        extras=(Block(_spec.CODING_RAW, [[5], [0], [65535]], Stream(2)),),
    )
    second = tile(5, 2, 2, exponent=1, extras=(Block(_spec.CODING_RAW, [[1], [2]], Stream(2)),))
    return Scene(
        attributes(2, ycocg=True, chroma_shift=1),
        (first, second),
        codebooks=(shape, colours),
        extras=(Extra("label", _spec.EXTRA_DTYPE_U16),),
        chunks=(
            Chunk(_spec.CHUNK_METADATA, b'{"title":"rich"}'),
            Chunk(_spec.CHUNK_DECLARED_ERRORS, errors=DeclaredErrors(6, 1, 3, 0, ((_spec.MEASURE_MEANS, 0.5, 0.25),))),
        ),
        sh_degree=2,
    )
