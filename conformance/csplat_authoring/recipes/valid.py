"""Valid files that code makes: the worked example, many tiles, full tiles, records as long as they may be."""

from __future__ import annotations

from dataclasses import replace

from csplat import _spec
from csplat_authoring.builder import SIZED, build
from csplat_authoring.example import example_scene
from csplat_authoring.samples import QUATS, SH0, Recipe, coded, rich_scene, scene, signed, sparse, tile
from csplat_authoring.scene import Scene, Stream

_RECORD_SIZE_MAX = 255  # bytes: the sizes of records are u8
_RUNS = (_spec.TRANSFORM_RUN_LENGTH,)


def valid_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    many = [tile(k, 1, k % 2, corner=(k, -k, 2 * k), exponent=k % 5 - 2) for k in range(24)]
    return [
        _recipe(
            "valid/worked_example", "the file that annex A reads byte by byte", "COV-2 DIR-3 TIL-4", example_scene()
        ),
        _recipe("valid/record_tails_longest", "a head and records of 255 bytes", "IDX-8 IDX-9", _longest_records()),
        _recipe(
            "extreme/tile_of_65536", "a full tile, one run after the other", "TIL-1 STR-5 TRF-1 SPA-1", _full_tile()
        ),
        _recipe(
            "extreme/tiles_of_one",
            "many tiles, each with layers and exponents of its own",
            "TIL-1 TIL-4",
            scene(1, many),
        ),
    ]


def _recipe(name: str, why: str, clauses: str, made: Scene) -> Recipe:
    return Recipe(name, why, tuple(clauses.split()), lambda: build(made).data, made)


def _longest_records() -> Scene:
    sizes = {kind: int(getattr(_spec, f"{name.upper()}_SIZE")) for kind, name in SIZED.items()}
    tails = tuple((kind, bytes([165]) * (_RECORD_SIZE_MAX - size)) for kind, size in sizes.items())
    return replace(rich_scene(), tails=tails)


def _full_tile() -> Scene:
    n = _spec.TILE_SPLATS_MAX
    same = tile(1, 1)
    full = {a: replace(b, rows=[list(b.rows[0])] * n) for a, b in same.blocks.items()}
    full |= {QUATS: signed([[1, 2, 3]] * (n - 1) + [[9, 9, 9]])}
    full |= {SH0 + 1: sparse((1,) * n, [[5] * 9] * n, mask_how=Stream(1, _RUNS))}
    return coded(scene(1, tiles=[replace(same, blocks=full)]), lambda how: replace(how, transforms=_RUNS))
