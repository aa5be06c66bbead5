"""From a model to the bytes of a file, stage by stage."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.between import Between
from csplat.encoder.codebook import choose_sh, with_zero_books
from csplat.encoder.colour import ShTables
from csplat.encoder.container import write
from csplat.encoder.geometry import quantised_geometry
from csplat.encoder.importance import splat_weights
from csplat.encoder.measure import ErrorSums
from csplat.encoder.options import EncodeOptions
from csplat.encoder.plan import Plan, Progress, make_plan
from csplat.encoder.scene import chosen_settings, extra_columns, file_chunks, file_scene, stated_errors
from csplat.encoder.tile import EncodedTile, encode_tile
from csplat.encoder.tiling import Tile, cut
from csplat.model import SplatModel

__all__ = ["EncodeReport", "EncodeResult", "encode", "encode_with_report"]


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
    importance: NDArray[Any] | None = None,
    between: Between | None = None,
    progress: Progress | None = None,
) -> EncodeResult:
    """Compress a scene and say how.

    Args:
        model: the scene.
        options: as in `encode`.
        importance: [N] weights >= 0 of the splats, in place of opacity × projected area.
        between: what happened to the scene before, and who fits colours to its quantised geometry.
        progress: called with the stage's name and the share done, 0 to 1; from any thread.

    Raises:
        InputError: as `encode`; or an importance of another shape, or negative, or not finite.
    """
    options = options or EncodeOptions()
    report = progress or _silent
    threads = options.threads or os.cpu_count() or 1
    plan = make_plan(model, options, importance_given=importance is not None)
    extras = extra_columns(model, options)
    tiles = cut(model.means, plan.lattice, plan.tile_splats)
    if between is not None:
        sh0, shN = between.colours(quantised_geometry(model, tiles, plan))
        model = replace(model, sh0=sh0, shN=shN)
    needs_weights = importance is not None or plan.adaptive > 0.0 or plan.sh_coding in ("auto", "codebook")
    weights = splat_weights(model, importance) if needs_weights else None
    sample = tiles[len(tiles) // 2].rows if tiles else np.zeros(0, np.intp)
    carried = tuple(model.extra) if options.keep_extra else ()
    books = choose_sh(model, weights, carried, sample, plan, options, threads, report)
    plan = books.plan
    encoded = _encode_tiles(model, tiles, plan, books.tables, threads, report)
    errors = ErrorSums.total(part.errors for part in encoded)
    settings = chosen_settings(plan, books.tables, options, between)
    chunks = file_chunks(model, errors, settings, plan, between)
    books = with_zero_books(books, (id for part in encoded for id in part.tile.tables))
    data = write(file_scene(model, plan, books, extras, chunks), [part.tile for part in encoded])
    rows = np.concatenate([part.rows for part in encoded]) if encoded else np.zeros(0, np.int64)
    rows = rows.astype(np.int64, copy=False)
    stated = stated_errors(errors, between)
    summary = EncodeReport(settings, stated, len(model), len(tiles), len(data), _notes(encoded))
    return EncodeResult(data, rows if between is None else between.source_index[rows], summary)


def _encode_tiles(
    model: SplatModel, tiles: Sequence[Tile], plan: Plan, tables: ShTables, threads: int, report: Progress
) -> list[EncodedTile]:
    done = 0

    def one(tile: Tile) -> EncodedTile:
        nonlocal done
        encoded = encode_tile(model, tile, plan, tables)
        done += len(tile.rows)
        report("tiles", done / max(1, len(model)))
        return encoded

    if threads == 1 or len(tiles) < 2:
        return [one(tile) for tile in tiles]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(one, tiles))


def _notes(encoded: Sequence[EncodedTile]) -> tuple[str, ...]:
    """Say where a value so large that its tile's lattice had to be coarser took precision from its neighbours."""
    counts = Counter(name for part in encoded for name in part.coarsened)
    return tuple(
        f"{name}: huge values coarsen {count} of {len(encoded)} tiles; remove them, or see the stated errors"
        for name, count in sorted(counts.items())
    )


def _silent(stage: str, done: float) -> None:
    """Report to nobody."""
