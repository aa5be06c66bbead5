"""From a model to the bytes of a file, stage by stage."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.encoder.apart import cut_scene
from csplat.encoder.between import Between
from csplat.encoder.codebook import Books, choose_sh, with_zero_books
from csplat.encoder.container import write
from csplat.encoder.geometry import quantised_geometry
from csplat.encoder.grades import Grades, choose_grades
from csplat.encoder.importance import (
    Importance,
    known_curvatures,
    sh_metric,
    shape_metric,
    shape_weights,
    splat_weights,
)
from csplat.encoder.measure import ErrorSums
from csplat.encoder.options import EncodeOptions
from csplat.encoder.plan import Plan, Progress, make_plan
from csplat.encoder.scene import chosen_settings, extra_columns, file_chunks, file_scene, stated_errors
from csplat.encoder.shape_codebook import choose_shapes
from csplat.encoder.shape_tables import SHAPE_BOOK, ShapeTables, shape_book
from csplat.encoder.tile import EncodedTile, encode_tile
from csplat.encoder.tiling import Tile
from csplat.model import SplatModel

__all__ = [
    "Decisions",
    "EncodeReport",
    "EncodeResult",
    "decide",
    "encode",
    "encode_with_report",
    "sample_rows",
    "write_decided",
]

_FEW_TILES, _SMALL_TILE = 16, 256  # tiles, and splats of one, that nobody has to be told of


@dataclass(frozen=True)
class EncodeReport:
    """What the encoder chose and what it cost.

    Attributes:
        options: what the caller asked for, and the steps and codings that followed; it stands in the file too.
        errors: (max, rms) by measure, as the file states them (spec 5.5).
        splat_count: splats of the file. tile_count: its tiles. size_bytes: its size.
        notes: what a user should know beside the errors, a sentence each.
    """

    options: dict[str, Any]
    errors: dict[str, tuple[float, float]]
    splat_count: int
    tile_count: int
    size_bytes: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class EncodeResult:
    """A file, and which source splat each of its splats is.

    Attributes:
        data: the file.
        source_index: [N] int64; row i of the decoded arrays is row source_index[i] of the model, or of the model that
            it was made from (`Between`).
        report: choices and errors.
    """

    data: bytes
    source_index: NDArray[np.int64]
    report: EncodeReport


def encode(model: SplatModel, options: EncodeOptions | None = None) -> bytes:
    """Compress a scene.

    Args:
        model: the scene.
        options: presets and knobs; the default preset is "balanced".

    Returns:
        The bytes of a `.csplat` file. Same model, options and library versions: same bytes, at any thread count.

    Raises:
        InputError: values that no lattice can hold, or an option that the model does not allow.
    """
    return encode_with_report(model, options).data


def encode_with_report(
    model: SplatModel,
    options: EncodeOptions | None = None,
    *,
    importance: NDArray[Any] | Importance | None = None,
    between: Between | None = None,
    progress: Progress | None = None,
) -> EncodeResult:
    """Compress a scene and say how.

    Args:
        model: the scene.
        options: as in `encode`.
        importance: [N] weights >= 0 of the splats, in place of opacity × projected area; or more than that.
        between: what happened to the scene before, and who fits colours to its quantised geometry.
        progress: called with the stage's name and the share done, 0 to 1; from any thread.

    Raises:
        InputError: as `encode`; or an importance of another shape, or negative, or not finite.
    """
    decided = decide(model, options, importance=importance, between=between, progress=progress)
    return write_decided(decided, between=between, progress=progress)


@dataclass(frozen=True, eq=False)
class Decisions:
    """What is decided once for a scene, before its tiles are coded.

    Attributes:
        model: the scene that is coded; its colours are those of `Between`.
        options: what was asked.
        tiles: which rows of the model, on which lattice.
        books: plan, weights and codebooks.
        extras: records of the extra columns that are carried.
        shapes: the codebook of shapes, if there is one.
        grades: of the splats, if there are several.
    """

    model: SplatModel
    options: EncodeOptions
    tiles: Sequence[Tile]
    books: Books
    extras: Sequence[_spec.ExtraRecord]
    shapes: ShapeTables | None = None
    grades: Grades | None = None


def decide(
    model: SplatModel,
    options: EncodeOptions | None = None,
    *,
    importance: NDArray[Any] | Importance | None = None,
    between: Between | None = None,
    graded: bool = True,
    progress: Progress | None = None,
) -> Decisions:
    """The first half of `encode_with_report`, with the same arguments: everything but the coding of tiles.

    With `graded` false, all splats are of one grade, whatever is known of them.
    """
    options = options or EncodeOptions()
    plan = make_plan(model, options, importance_given=importance is not None)
    extras = extra_columns(model, options)
    curvatures = known_curvatures(model, importance) if graded else None
    plan, grades = choose_grades(model, curvatures, plan, options)
    tiles = cut_scene(model, plan, grades)
    shapes = None
    if options.shape_codebook_size and len(model):
        by_shape = shape_weights(model, importance)
        together = shape_metric(by_shape, importance)
        shapes = choose_shapes(model, by_shape, together, tiles, plan, options, _threads(options), progress or _silent)
    if between is not None:
        sh0, shN = between.colours(quantised_geometry(model, tiles, plan, shapes))
        model = replace(model, sh0=sh0, shN=shN)
    needs_weights = importance is not None or plan.adaptive > 0.0 or plan.sh_coding in ("auto", "codebook")
    weights = splat_weights(model, importance) if needs_weights else None
    sample = sample_rows(model, tiles, grades)
    carried = tuple(model.extra) if options.keep_extra else ()
    metric = sh_metric(model, weights, importance)
    books = choose_sh(
        model, weights, carried, sample, plan, options, _threads(options), progress or _silent, metric,
        measured=importance is not None,
    )  # fmt: skip
    return Decisions(model, options, tiles, books, extras, shapes, grades)


def write_decided(
    decided: Decisions,
    *,
    between: Between | None = None,
    measured: ErrorSums | None = None,
    progress: Progress | None = None,
) -> EncodeResult:
    """The second half of `encode_with_report`: code the tiles, write the file.

    Args:
        decided: by `decide`.
        between: as given to `decide`.
        measured: errors to state, of a scene that is not `decided.model`; `None`: those of the coding.
        progress: as in `encode_with_report`.
    """
    model, options, tiles, books = decided.model, decided.options, decided.tiles, decided.books
    plan = books.plan
    encoded = _encode_tiles(decided, _threads(options), progress or _silent)
    errors = measured or ErrorSums.total(part.errors for part in encoded)
    settings = chosen_settings(plan, books.tables, options, between, decided.shapes, decided.grades)
    books = with_zero_books(books, (id for part in encoded for id in part.tile.tables if id != SHAPE_BOOK))
    if decided.shapes is not None:
        record, chunk = shape_book(decided.shapes, plan.coding)
        books = replace(books, records=[*books.records, record], chunks=[*books.chunks, chunk])

    def written() -> bytes:
        chunks = file_chunks(model, errors, settings, plan, between)
        return write(file_scene(model, plan, books, decided.extras, chunks), [part.tile for part in encoded])

    data = written()
    if between is not None and between.figures is not None:
        settings[between.key] |= between.figures(data)
        data = written()
    rows = np.concatenate([part.rows for part in encoded]) if encoded else np.zeros(0, np.int64)
    rows = rows.astype(np.int64, copy=False)
    stated = stated_errors(errors, between)
    summary = EncodeReport(settings, stated, len(model), len(tiles), len(data), _notes(encoded, plan))
    return EncodeResult(data, rows if between is None else between.source_index[rows], summary)


def _encode_tiles(decided: Decisions, threads: int, report: Progress) -> list[EncodedTile]:
    model, tiles, books = decided.model, decided.tiles, decided.books
    done = 0

    def one(tile: Tile) -> EncodedTile:
        nonlocal done
        encoded = encode_tile(model, tile, books.plan, books.tables, decided.shapes)
        done += len(tile.rows)
        report("tiles", done / max(1, len(model)))
        return encoded

    if threads == 1 or len(tiles) < 2:
        return [one(tile) for tile in tiles]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(one, tiles))


def sample_rows(model: SplatModel, tiles: Sequence[Tile], grades: Grades | None) -> NDArray[np.intp]:
    """Rows like those of one tile, on which codings are tried: of all grades, where there are several."""
    if not tiles:
        return np.zeros(0, np.intp)
    if grades is None:
        return tiles[len(tiles) // 2].rows
    return np.arange(0, len(model), math.ceil(len(model) / _spec.TILE_SPLATS_MAX))


def _notes(encoded: Sequence[EncodedTile], plan: Plan) -> tuple[str, ...]:
    """Say where a value so large that its tile's lattice had to be coarser took precision from its neighbours.

    And where a bound of the means, finer than 16 bits of a tile of many, took tiles of few.
    """
    splats = sum(len(part.rows) for part in encoded)
    if plan.lattice.strict and len(encoded) > max(_FEW_TILES, splats // _SMALL_TILE):
        note = f"means: so small an error takes {len(encoded)} tiles, each of which takes bytes of its own"
        return (note, *_notes(encoded, replace(plan, lattice=replace(plan.lattice, strict=False))))
    counts = Counter(name for part in encoded for name in part.coarsened)
    return tuple(
        f"{name}: huge values coarsen {count} of {len(encoded)} tiles; remove them, or see the stated errors"
        for name, count in sorted(counts.items())
    )


def _threads(options: EncodeOptions) -> int:
    return options.threads or os.cpu_count() or 1


def _silent(stage: str, done: float) -> None:
    """Report to nobody."""
