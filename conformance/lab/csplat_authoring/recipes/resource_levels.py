# SPDX-License-Identifier: CC0-1.0
"""Files whose sizes are at the bounds of resource levels (8.1), or just above them.

An invalid vector at a bound has a level that is too high, and one above it a level that is too low. Together they fix
the bound without a decode of that size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from csplat import _spec
from csplat_authoring.builder import Built, build
from csplat_authoring.recipe import Recipe, invalid_recipe, valid_recipe
from csplat_authoring.samples import MEANS, OPACITIES, QUATS, SCALES, SH0, axis, levels, scene, signed, tile
from csplat_authoring.scene import Block, Codebook, Extra, Node, Scene, Stream, Tile

_A, _B, _C = _spec.RESOURCE_LEVEL_A, _spec.RESOURCE_LEVEL_B, _spec.RESOURCE_LEVEL_C
_FULL = _spec.TILE_SPLATS_MAX
_AT = "header.resource_level"
_RUNS = (_spec.TRANSFORM_RUN_LENGTH,)
_RECORD_MAX = 255  # bytes
_UNKNOWN = range(_spec.ANCILLARY_ID_MIN, 256)  # layers


def valid_level_recipes() -> list[Recipe]:
    """Return recipes of files of the levels B and C."""
    columns, components = 3, _spec.EXTRA_COMPONENTS_MAX
    n = _spec.RESOURCE_LEVEL_TILE_BYTES[_B] // (56 + 8 * columns * components) + 1
    raw = [Block(_spec.CODING_RAW, [[0] * components] * n, _equal(0, 8 * components * n, 8))] * columns
    one = _tile_of(n, raw)
    extras = tuple(Extra(f"c{k}", _spec.EXTRA_DTYPE_F64, components) for k in range(columns))
    books = scene(3, codebooks=_codebooks(65534, 51886))
    return [
        valid_recipe("extreme", "resource_level_b", "codebooks just above the bound of level A", "RSL-1 RSL-2", books),
        valid_recipe(
            "extreme",
            "resource_level_c",
            "a tile just above the bound of level B, with extra columns of the most components",
            "RSL-1 RSL-2",
            scene(tiles=[one], extras=extras),
        ),
        valid_recipe(
            "extreme",
            "resource_level_of_ancillary_column",
            "a full tile of level A, which a wide column of a type from 128 on does not raise",
            "RSL-1 RSL-2 ANC-3",
            scene(
                tiles=[_tile_of(_FULL, [Block(_spec.CODING_RAW, [[0]] * _FULL, _equal(0, _FULL))])],
                extras=(Extra("later", _spec.ANCILLARY_ID_MIN + 2, _spec.EXTRA_COMPONENTS_MAX),),
            ),
        ),
    ]


def invalid_level_recipes() -> list[Recipe]:
    """Return recipes of files with another level than the lowest that their contents allow."""
    return [*_simple(), *_of_index(), *_of_codebooks(), *_of_tiles(), *_of_versions()]


def _simple() -> list[Recipe]:
    return [
        _too_high("b", "two splats at level B", build(scene())),
        _too_high("c", "two splats at level C", build(scene()), level=_C),
        _too_high("b_of_nothing", "no splats at level B", build(scene(tiles=[]))),
    ]


def _of_index() -> list[Recipe]:
    most = _spec.RESOURCE_LEVEL_INDEX_BYTES[_A]
    return [
        _too_high("b_index", "an index at the bound of level A, at level B", build(_indexed(most))),
        _too_low("a_index", "an index a byte above the bound of level A, at level A", build(_indexed(most + 1))),
    ]


def _indexed(size: int) -> Scene:
    """Return a scene of 32 tiles whose index has `size` bytes, most of them in records of unknown layers."""
    tile_count, layer_tail = 32, bytes(_RECORD_MAX - _spec.LAYER_RECORD_SIZE)
    one = tile(1, 1)

    def made(missing: int, tile_tail: int, head_tail: int) -> Scene:
        counts = [len(_UNKNOWN)] * (tile_count - 1) + [len(_UNKNOWN) - missing]
        tiles = [replace(one, unknown=tuple((layer, b"") for layer in _UNKNOWN[:count])) for count in counts]
        tails = {"head": bytes(head_tail), "tile": bytes(tile_tail), "layer": layer_tail}
        return scene(tiles=tiles, tails=tuple(tails.items()))

    excess = _spec.unpack_header(build(made(0, 0, 0)).data).index_size - size
    room = _RECORD_MAX - _spec.INDEX_HEAD_SIZE
    tile_tail = next(tail for tail in range(_RECORD_MAX) if -(excess + tile_count * tail) % _RECORD_MAX <= room)
    excess += tile_count * tile_tail
    return made(-(-excess // _RECORD_MAX), tile_tail, -excess % _RECORD_MAX)


def _of_codebooks() -> list[Recipe]:
    # 45, 24 and 6 columns: 4 × (65535 × 45 + 51884 × 24 + 2 × 6) is four bytes below the bound of level A.
    at, above = scene(3, codebooks=_codebooks(65535, 51884)), scene(3, codebooks=_codebooks(65534, 51886))
    return [
        _too_high("b_codebooks", "codebooks at the bound of level A, at level B", build(at)),
        _too_low("a_codebooks", "codebooks just above the bound of level A, at level A", build(above)),
    ]


def _codebooks(first: int, second: int) -> tuple[Codebook, ...]:
    """Return codebooks of bands 1 to 3, of bands 1 and 2, and of the kind SHAPE, whose entries are all 0."""

    def sh(number: int, size: int, last: int) -> Codebook:
        rows = {band: [[0] * (6 * band + 3)] * size for band in range(1, last + 1)}
        return Codebook(number, _spec.CODEBOOK_KIND_SH, rows, (1, last), Stream(1, _RUNS))

    shape = Codebook(3, _spec.CODEBOOK_KIND_SHAPE, {0: [[0] * 6] * 2})
    return sh(1, first, 3), sh(2, second, 2), shape


def _of_tiles() -> list[Recipe]:
    # 14 floats of 4 bytes and 57 or 121 values of 8 bytes are 512 or 1,024 bytes, 65,536 times 32 or 64 MiB.
    a, byte = [(_spec.EXTRA_DTYPE_F64, 1)] * 57, [(_spec.EXTRA_DTYPE_U8, 1)]
    b = [*a, (_spec.EXTRA_DTYPE_F64, 64)]
    return [
        _too_high("b_tile", "a tile at the bound of level A, at level B", *_grown(0, a, [_FULL])),
        _too_low("a_tile", "a tile just above the bound of level A, at level A", *_grown(0, a + byte, [_FULL])),
        _too_high("c_tile", "a tile at the bound of level B, at level C", *_grown(0, b, [_FULL]), level=_C),
        _too_low(
            "b_tile", "a tile just above the bound of level B, at level B", *_grown(0, b + byte, [_FULL]), level=_B
        ),
    ]


def _of_versions() -> list[Recipe]:
    # 86 floats of degree 4 and 21 columns of 8 bytes are 512 bytes, 8 × 65,536 times 256 MiB.
    columns, none = [(_spec.EXTRA_DTYPE_F64, 21)], _spec.NO_PARENT
    at = [_FULL] * 8
    small_root = _grown(4, columns, [*at, 1, 1], coarse=1, nodes=(Node(1, 9), Node(none, 1, 0.5)))
    large_root = _grown(4, [], [_FULL] * 24, coarse=12, nodes=(Node(1, 12), Node(none, 12, 0.5)))
    forest = _grown(4, columns, [*at, 1, 1], coarse=1, nodes=(Node(none, 8), Node(2, 1), Node(none, 1, 0.5)))
    return [
        _too_high("b_version", "a scene at the bound of level A, at level B", *_grown(4, columns, at)),
        _too_low("a_version", "a scene a splat above the bound of level A, at level A", *_grown(4, columns, [*at, 1])),
        _too_high("b_small_root", "a scene above the bound of level A, whose root is not, at level B", *small_root),
        _too_low("a_large_root", "a root above the bound of level A, at level A", *large_root),
        _too_high("b_forest", "two roots, without extra columns because one is coarse, at level B", *forest),
    ]


def _grown(
    degree: int,
    columns: Sequence[tuple[int, int]],
    counts: Sequence[int],
    coarse: int = 0,
    nodes: tuple[Node, ...] = (),
) -> tuple[Built, dict[str, Any]]:
    """Return a file with one splat in each tile, and the changes that repeat the splats; SH layers are omitted.

    Args:
        degree: SH degree.
        columns: types and numbers of components of the extra columns.
        counts: number of splats of each tile, the coarse ones last.
        coarse: number of tiles of level 1.
        nodes: nodes of TREE.
    """
    tiles = []
    for number, n in enumerate(counts):
        level = int(number >= len(counts) - coarse)
        sizes = [(_spec.EXTRA_DTYPE_BYTES[dtype], components) for dtype, components in columns]
        raw = [Block(_spec.CODING_RAW, [[0] * c], _equal(0, size * c * n, size)) for size, c in sizes]
        one = _tile_of(n, [] if level else raw)
        blocks = {attribute: replace(block, rows=block.rows[:1]) for attribute, block in one.blocks.items()}
        tiles.append(replace(one, blocks=blocks, level=level))
    extras = tuple(Extra(f"c{k}", *column) for k, column in enumerate(columns))
    built = build(scene(degree, tiles=tiles, extras=extras, nodes=nodes))
    finest = counts[: len(counts) - coarse]
    changes: dict[str, Any] = {"index.splat_count": sum(finest)}
    for name, entry in built.fields.items():
        if name.startswith("TILE.") and name.endswith("stream.count"):
            n = counts[int(name.split(".")[1])]
            changes[name] = n * int.from_bytes(built.data[entry.offset : entry.offset + entry.size], "little")
    return built, changes | {f"tile[{i}].splat_count": n for i, n in enumerate(counts)}


def _tile_of(n: int, raw: Sequence[Block]) -> Tile:
    """Return a tile of n equal splats, with extra columns."""
    blocks = {
        OPACITIES: levels([200] * n, _equal(200, n)),
        SCALES: signed([[-4] * 3] * n, _equal(-4, 3 * n)),
        QUATS: signed([[0] * 3] * n, _equal(0, 3 * n)),
        MEANS: axis([[0] * 3] * n, _equal(0, 3 * n)),
        SH0: signed([[7] * 3] * n, _equal(7, 3 * n)),
    }
    return Tile(blocks, corner=(-100, 5, 1000), extras=tuple(raw))


def _equal(value: int, size: int, width: int = 1) -> Stream:
    """Return the coding of a stream whose `size` bytes are equal."""
    runs, last = divmod(size - 1, _spec.RUN_MAX)
    lows, highs = b"\xff" * runs + bytes([last & 255]), b"\xff" * runs + bytes([last >> 8])
    return Stream(width, _RUNS, packed=bytes([value & 255]) * (runs + 1) + lows + highs)


def _too_high(name: str, why: str, base: Built, changes: dict[str, Any] | None = None, level: int = _B) -> Recipe:
    changes = (changes or {}) | {_AT: level}
    return invalid_recipe(f"resource_level_high_{name}", why, "RSL-2", "E_VALUE", base, changes, at=_AT)


def _too_low(name: str, why: str, base: Built, changes: dict[str, Any] | None = None, level: int = _A) -> Recipe:
    changes = (changes or {}) | {_AT: level}
    return invalid_recipe(f"resource_level_low_{name}", why, "RSL-1", "E_VALUE", base, changes, at=_AT)
