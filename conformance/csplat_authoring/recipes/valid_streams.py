"""Valid files: transforms, coders and codebooks."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

from csplat import _spec
from csplat_authoring.builder import build
from csplat_authoring.samples import QUATS, SCALES, SH0, Recipe, book, coded, offset, rows_of, scene, signed, tile
from csplat_authoring.scene import Attribute, Block, Codebook, Scene, Stream

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
    wide = coded(replace(base), lambda _: Stream(2))
    result = []
    every = (_DELTA, _ZIGZAG, _PLANES, _RUNS)
    for chosen in [c for k in range(5) for c in combinations(every, k)]:
        name = "_".join(_spec.TRANSFORM_NAMES[t] for t in chosen) or "none"
        made = coded(wide, lambda how, chosen=chosen: replace(how, transforms=chosen))  # type: ignore[misc]  # a bound default
        result.append(
            _recipe(f"transforms_{name}", "every stream of the file, two bytes wide", "STR-3 STR-4 STR-5 TRF-1", made)
        )
    for name in ("deflate_stored", "deflate_fixed", "deflate_dynamic"):
        made = coded(base, lambda how, name=name: replace(how, coder=name))  # type: ignore[misc]  # a bound default
        result.append(_recipe(f"coder_{name}", "each block type of RFC 1951", "COD-2 COD-4", made))
    made = coded(wide, lambda how: replace(how, transforms=(_PLANES, _RUNS), coder="deflate_dynamic"))
    result.append(_recipe("run_length_deflate", "runs of byte planes, then DEFLATE", "COD-2 STR-5 TRF-1", made))
    return result


def _codebooks() -> list[Recipe]:
    result = _shapes()
    for first, last in ((1, 1), (2, 2), (3, 3), (1, 2), (2, 3), (1, 3)):
        entries = {band: rows_of(band, 3, 3 * (2 * band + 1), -99, 99) for band in range(first, last + 1)}
        made = Codebook(900, _spec.CODEBOOK_KIND_SH, entries, (first, last), Stream(1, (_DELTA, _ZIGZAG)))
        changes = {SH0 + first: book(900, (0, 2, 1, 1))} | {SH0 + b: book(900) for b in range(first + 1, last + 1)}
        others = {
            SH0 + b: signed(rows_of(b, 4, 3 * (2 * b + 1), -9, 9))
            for b in range(1, 4)
            if b not in range(first, last + 1)
        }
        whole = scene(3, [tile(3, 4, 0, dict(sorted((changes | others).items())))], codebooks=(made,))
        result.append(
            _recipe(
                f"codebook_sh_{first}_{last}", "bands in chunks of their own, one index", "DIR-5 CBR-2 CBK-4", whole
            )
        )
    return result


def _shapes() -> list[Recipe]:
    shape = Codebook(5, _spec.CODEBOOK_KIND_SHAPE, {0: rows_of(1, 3, 6, -40, 40)})
    plain = tile(3, 4, 0, {SCALES: book(5, (2, 0, 1, 0), summands=(-9, 4, 0, 7)), QUATS: book(5)})
    escapes = tile(
        3,
        4,
        0,
        {
            SCALES: book(5, (3, 0, 1, 3), offset(rows_of(8, 2, 3, -30, 30)), summands=(0, 4, -300, 0), offsets=(-300,)),
            QUATS: book(5, (), signed(rows_of(9, 2, 3, -60, 60))),
        },
    )
    escapes = replace(escapes, blocks=escapes.blocks | {SCALES: replace(escapes.blocks[SCALES], how=Stream(2))})
    half = tile(3, 4, 0, {SCALES: book(5, (2, 0, 1, 0), summands=(-9, 4, 0, 7))})
    return [
        _recipe(
            "codebook_shape",
            "a common summand of the log scales",
            "CBK-1 CBK-2 CBK-4 CBK-6 CBK-7",
            scene(tiles=[plain], codebooks=(shape,)),
        ),
        _recipe(
            "codebook_shape_escape",
            "escapes in both blocks",
            "CBK-3 CBK-4 CBK-5",
            scene(tiles=[escapes], codebooks=(shape,)),
        ),
        _recipe(
            "codebook_shape_scales_only", "rotations coded apart", "CBK-1", scene(tiles=[half], codebooks=(shape,))
        ),
    ]


def _recipe(name: str, why: str, clauses: str, made: Scene) -> Recipe:
    return Recipe(f"valid/{name}", why, tuple(clauses.split()), lambda: build(made).data, made)


def _changed(changes: dict[int, Block], n: int = 5, degree: int = 0, **records: Attribute) -> Scene:
    one = tile(2, n, degree, changes)
    made = scene(degree, [one])
    names = {_spec.ATTRIBUTE_NAMES[a]: a for a in made.attributes}
    return replace(made, attributes=made.attributes | {names[name]: record for name, record in records.items()})
