"""Valid files that code makes: streams, codebooks, many tiles, full tiles, records as long as they may be."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import combinations

from csplat import _spec
from csplat_authoring.annexes import example_scene
from csplat_authoring.builder import SIZED
from csplat_authoring.recipe import Recipe, valid_recipe
from csplat_authoring.samples import (
    QUATS,
    SCALES,
    SH0,
    codebook_block,
    offset,
    rich_scene,
    rows_of,
    scene,
    signed,
    sparse,
    tile,
    with_stream_codings,
)
from csplat_authoring.scene import Attribute, Block, Codebook, Scene, Stream

_valid = partial(valid_recipe, "valid")
_RECORD_SIZE_MAX = 255  # bytes: the sizes of records are u8


def valid_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    many = [tile(k, 1, k % 2, corner=(k, -k, 2 * k), exponent=k % 5 - 2) for k in range(24)]
    return [
        valid_recipe(
            "valid", "worked_example", "the file that annex A reads byte by byte", "COV-2 DIR-3 TIL-4", example_scene()
        ),
        valid_recipe(
            "valid", "record_tails_longest", "a head and records of 255 bytes", "IDX-8 IDX-9", _longest_records()
        ),
        valid_recipe(
            "extreme", "tile_of_65536", "a full tile, one run after the other", "TIL-1 STR-5 TRF-1 SPA-1", _full_tile()
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


_DELTA, _ZIGZAG, _PLANES, _RUNS = (
    _spec.TRANSFORM_DELTA,
    _spec.TRANSFORM_ZIGZAG,
    _spec.TRANSFORM_BYTE_PLANES,
    _spec.TRANSFORM_RUN_LENGTH,
)


def valid_stream_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_streams(), *_codebooks()]


def _streams() -> list[Recipe]:
    base = scene(1, [tile(4, 6, 1)])
    wide = with_stream_codings(replace(base), lambda _: Stream(2))
    result = []
    every = (_DELTA, _ZIGZAG, _PLANES, _RUNS)
    for chosen in [c for k in range(5) for c in combinations(every, k)]:
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
    for first, last in ((1, 1), (2, 2), (3, 3), (1, 2), (2, 3), (1, 3)):
        entries = {band: rows_of(band, 3, 3 * (2 * band + 1), -99, 99) for band in range(first, last + 1)}
        made = Codebook(900, _spec.CODEBOOK_KIND_SH, entries, (first, last), Stream(1, (_DELTA, _ZIGZAG)))
        changes = {SH0 + first: codebook_block(900, (0, 2, 1, 1))} | {
            SH0 + b: codebook_block(900) for b in range(first + 1, last + 1)
        }
        others = {
            SH0 + b: signed(rows_of(b, 4, 3 * (2 * b + 1), -9, 9))
            for b in range(1, 4)
            if b not in range(first, last + 1)
        }
        whole = scene(3, [tile(3, 4, 0, dict(sorted((changes | others).items())))], codebooks=(made,))
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


def _changed(changes: dict[int, Block], n: int = 5, degree: int = 0, **records: Attribute) -> Scene:
    one = tile(2, n, degree, changes)
    made = scene(degree, [one])
    names = {_spec.ATTRIBUTE_NAMES[a]: a for a in made.attributes}
    return replace(made, attributes=made.attributes | {names[name]: record for name, record in records.items()})
