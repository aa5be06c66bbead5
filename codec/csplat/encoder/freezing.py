"""Freeze a scene, and write the file of a frozen scene's values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.between import Between
from csplat.encoder.colour import quantise_rows
from csplat.encoder.frozen import Frozen, Held, Seen
from csplat.encoder.gauge import fix_gauge
from csplat.encoder.importance import Importance
from csplat.encoder.measure import measured_sums
from csplat.encoder.options import EncodeOptions
from csplat.encoder.pipeline import Decisions, EncodeResult, decide, write_decided
from csplat.encoder.plan import Plan, Progress
from csplat.encoder.tile import coarseness, tile_order
from csplat.errors import InputError
from csplat.model import SplatModel

__all__ = ["encode_frozen", "freeze"]

I64 = NDArray[np.int64]


_SEEN = tuple(field.name for field in fields(Seen))


def freeze(
    model: SplatModel,
    options: EncodeOptions | None = None,
    *,
    importance: NDArray[Any] | Importance | None = None,
    between: Between | None = None,
    source: SplatModel | None = None,
    progress: Progress | None = None,
) -> Frozen:
    """Decide how a scene is coded, all of it in one grade, and leave its values open.

    Args:
        model: the scene.
        options, importance, between, progress: as in `encode_with_report`.
        source: the scene that `between` counts the splats of; `None`: the model itself.

    Raises:
        InputError: as `encode`; or there are no splats.
    """
    if not len(model):
        raise InputError("a scene without splats has nothing to tune")
    if between is not None and source is None:
        raise InputError("the source that the splats come from is wanted, too")
    # What tunes it reckons with one step per attribute.
    decided = decide(model, options, importance=importance, between=between, graded=False, progress=progress)
    plan = replace(decided.books.plan, gauged=True)
    rows = [tile_order(decided.model, tile, plan)[0] for tile in decided.tiles]
    order = np.concatenate(rows).astype(np.int64)
    decided = _reordered(decided, order, [len(part) for part in rows], plan)
    index = order if between is None else between.source_index[order]
    low, high = np.empty_like(decided.model.means), np.empty_like(decided.model.means)
    for tile in decided.tiles:
        means = decided.model.means[tile.rows]
        low[tile.rows], high[tile.rows] = means.min(axis=0), means.max(axis=0)
    said = {} if between is None else {between.key: dict(between.said)}
    return Frozen(decided, source or model, index, low, high, _zeros(decided), said)


def encode_frozen(
    frozen: Frozen, held: Held, said: Mapping[str, Any] | None = None, progress: Progress | None = None
) -> EncodeResult:
    """Write the file of some values; `decode` gives `frozen.seen(held)` back, in the order of its `source_index`.

    Args:
        frozen: what was decided.
        held: values, constrained.
        said: what the file's options are to say of the tuning, JSON-compatible.
        progress: as in `encode_with_report`.

    Returns:
        The file. Its stated errors are those against the source, colours left out: they were fitted anew.
    """
    seen, decided = frozen.seen(held), frozen.decisions(held)
    decoded = replace(decided.model, **{name: getattr(seen, name) for name in _SEEN})
    measured = measured_sums(frozen.source, decoded, frozen.source_index)
    between = Between(len(frozen.source), frozen.source_index, said={**frozen.said, **(said or {})}, key="finetuned")
    return write_decided(decided, between=between, measured=measured, progress=progress)


def _reordered(decided: Decisions, order: I64, counts: Sequence[int], plan: Plan) -> Decisions:
    """The same decisions for splats in the order of their tiles, in their gauge."""
    model = decided.model.select(order)
    rotation, scales = fix_gauge(model.quats, model.scales)
    model = replace(model, quats=np.ascontiguousarray(rotation.T), scales=np.ascontiguousarray(scales.T))
    tables = decided.books.tables
    tables = replace(
        tables,
        weights=None if tables.weights is None else tables.weights[order],
        index=[stage[order] for stage in tables.index],
    )
    ends = np.cumsum(counts)
    tiles = [
        replace(tile, rows=np.arange(end - count, end))
        for tile, count, end in zip(decided.tiles, counts, ends, strict=True)
    ]
    shapes = None if decided.shapes is None else decided.shapes.select(order)
    books = replace(decided.books, plan=plan, tables=tables)
    return replace(decided, model=model, tiles=tiles, books=books, shapes=shapes)


def _zeros(decided: Decisions) -> NDArray[np.bool_] | None:
    plan, tables = decided.books.plan, decided.books.tables
    kept = (plan.sh_degree + 1) ** 2 - 1
    if tables.entries or not kept:
        return None
    zero = np.empty((len(decided.model), kept), np.bool_)
    for tile in decided.tiles:
        columns, _, _ = quantise_rows(decided.model.shN[tile.rows, :kept], plan, coarseness(tile.rows, plan, tables))
        for band in range(1, plan.sh_degree + 1):
            span = slice(band * band - 1, (band + 1) ** 2 - 1)
            largest = np.abs(columns[:, span]).max(axis=(0, 1))
            zero[tile.rows, span] = (largest == 0)[:, None]
    return zero
