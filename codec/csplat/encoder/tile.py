"""One tile: order, quantise, code, and measure what it cost (spec 5.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.encoder import blocks
from csplat.encoder.colour import ShTables, code_sh, quantise_colour
from csplat.encoder.container import FileTile, tile_payload
from csplat.encoder.geometry import quantise_shape
from csplat.encoder.measure import ErrorSums, covariance_errors, distance_errors, true_means, value_errors
from csplat.encoder.morton import morton_codes
from csplat.encoder.plan import Plan
from csplat.encoder.quantise import (
    check_finite,
    lattice_step,
    lattice_values,
    opacity_levels,
    opacity_values,
    quantise_means,
)
from csplat.encoder.shape_tables import SHAPE_BOOK, ShapePart, ShapeTables, shape_blocks
from csplat.encoder.tiling import Coarse, Tile
from csplat.model import SplatModel
from csplat.types import F32

_COARSEST = 6  # powers of two

Integers = NDArray[Any]


@dataclass(frozen=True)
class EncodedTile:
    """A tile's bytes, the source rows in decoded order, its errors, and which attributes a huge value coarsened."""

    tile: FileTile
    rows: NDArray[np.intp]
    errors: ErrorSums
    coarsened: frozenset[str]


@dataclass
class _Work:
    """Results that the steps of one tile hand to each other."""

    plan: Plan
    blocks: list[bytes]
    largest: dict[str, float]
    squares: dict[str, float]
    coarsened: set[str]

    def note(self, measure: str, errors: tuple[float, float]) -> None:
        self.largest[measure], self.squares[measure] = errors


def encode_tile(
    model: SplatModel, tile: Tile, plan: Plan, tables: ShTables, shapes: ShapeTables | None = None
) -> EncodedTile:
    """Encode one tile.

    Args:
        model: the whole scene.
        tile: the tile's rows and lattice.
        plan: the file's lattices and codings.
        tables: decisions of the SH stage for the whole file.
        shapes: decisions of the shape stage, if it made a codebook.

    Returns:
        The tile; its rows are the model's, in the order in which a decoder returns them.
    """
    work = _Work(plan, [], {}, {}, set())
    rows, q, corner, codes = tile_order(model, tile, plan)
    _opacities(work, _take(model.opacities, rows), tile.coarse)
    part = None if shapes is None else shapes.part(rows)
    max_scale = _shape(work, _take(model.quats, rows), _take(model.scales, rows), part, tile.coarse)
    _means(work, model, rows, q, corner, codes, lattice_step(plan.lattice.step, tile.exponent))
    _sh0(work, _take(model.sh0, rows), tile.coarse)
    layers: dict[int, list[bytes]] = {_spec.ATTRIBUTE_LAYER[_spec.ATTRIBUTE_SH0]: work.blocks}
    used: tuple[int, ...] = () if part is None else (SHAPE_BOOK,)
    if model.sh_degree:
        coded = code_sh(model.shN, rows, plan, tables, coarseness(rows, plan, tables))
        layers |= {layer: [block] for layer, block in coded.blocks.items()}
        used = (*coded.tables, *used)
        if coded.exponent:
            work.coarsened.add("shN")
        for measure, errors in coded.errors.items():
            work.note(measure, errors)
    if tables.extras:
        layers[_spec.LAYER_EXTRA] = [
            blocks.raw_block(place, _take(model.extra[name], rows), plan.coding)
            for place, name in enumerate(tables.extras)
        ]
    extent = q.max(axis=1)
    file_tile = FileTile(
        splat_count=len(rows),
        exponent=tile.exponent,
        corner=(int(corner[0]), int(corner[1]), int(corner[2])),
        extent=(int(extent[0]), int(extent[1]), int(extent[2])),
        max_scale=max_scale,
        layers={layer: tile_payload(layer, parts) for layer, parts in layers.items()},
        tables=used,
    )
    return EncodedTile(file_tile, rows, ErrorSums(len(rows), work.largest, work.squares), frozenset(work.coarsened))


def tile_order(
    model: SplatModel, tile: Tile, plan: Plan
) -> tuple[NDArray[np.intp], Integers, Integers, Integers | None]:
    """Quantise the centres and sort the splats by Morton code.

    Returns:
        rows of the model in their new order, q [3, n], corner [3], and the codes [n], or None for AXIS.
    """
    step = lattice_step(plan.lattice.step, tile.exponent)
    n = quantise_means(np.ascontiguousarray(_take(model.means, tile.rows).T), step)
    corner = n.min(axis=1)
    q = n - corner[:, None]
    if not plan.morton:
        return tile.rows, q, corner, None
    # 48 bits of code and 16 of place: sorting whole keys is stable, and much faster than sorting places.
    keys = morton_codes(q).astype(np.uint64)
    keys <<= np.uint64(16)
    keys |= np.arange(len(keys), dtype=np.uint64)
    keys.sort()
    order = (keys & np.uint64(0xFFFF)).astype(np.intp)
    return tile.rows[order], np.take(q, order, axis=1), corner, (keys >> np.uint64(16)).astype(np.int64)


def coarseness(rows: NDArray[np.intp], plan: Plan, tables: ShTables) -> NDArray[np.int32] | None:
    """Return by which power of two the SH of each splat may be coarser than the lattice, or None."""
    if tables.weights is None or plan.adaptive == 0.0:
        return None
    with np.errstate(divide="ignore"):
        ratio = np.log2(tables.reference / tables.weights[rows].astype(np.float64))
    return np.clip(np.rint(0.5 * plan.adaptive * ratio), 0, _COARSEST).astype(np.int32)


def _opacities(work: _Work, opacities: F32, coarse: Coarse) -> None:
    levels = work.plan.opacity_levels
    q = opacity_levels(opacities, levels, square=True, multiple=coarse.opacities)
    work.blocks.append(blocks.levels_block(q, work.plan.coding))
    work.note("opacities", value_errors(opacities, opacity_values(q, levels, square=True)))


def _shape(work: _Work, quats: F32, scales: F32, part: ShapePart | None, coarse: Coarse) -> float:
    """Scales and rotations in their gauge. Returns the largest decoded scale."""
    plan = work.plan
    shape = quantise_shape(quats, scales, plan, part, coarse)
    if shape.exponent > coarse.scales:
        work.coarsened.add("scales")
    check_finite("scales", shape.decoded_scales)
    work.blocks.extend(shape_blocks(shape.scales, shape.exponent, shape.quats, part, plan.coding))
    work.note("covariance", covariance_errors(quats.T, scales.T, shape.decoded_quats, shape.decoded_scales))
    return float(shape.decoded_scales.max())


def _means(
    work: _Work,
    model: SplatModel,
    rows: NDArray[np.intp],
    q: Integers,
    corner: Integers,
    codes: Integers | None,
    step: float,
) -> None:
    coding = work.plan.coding
    if codes is None:
        work.blocks.append(blocks.axis_block(q, coding))
    else:
        bits = max(1, int(q.max()).bit_length())
        work.blocks.append(blocks.morton_block(codes, bits, coding))
    decoded = lattice_values(q + corner[:, None], step)
    check_finite("means", decoded)
    work.note("means", distance_errors(np.ascontiguousarray(true_means(model, rows).T), decoded))


def _sh0(work: _Work, sh0: F32, coarse: Coarse) -> None:
    plan = work.plan
    source = np.ascontiguousarray(sh0.T)
    colour = quantise_colour(source, plan.sh0_step, plan.chroma_shift, coarse.sh0)
    if colour.exponent > coarse.sh0:
        work.coarsened.add("sh0")
    work.blocks.append(blocks.offset_block(_spec.ATTRIBUTE_SH0, colour.columns, colour.exponent, plan.coding))
    check_finite("sh0", colour.decoded)
    work.note("sh0", value_errors(source, colour.decoded))


def _take(values: NDArray[Any], rows: NDArray[np.intp]) -> NDArray[Any]:
    """Rows of an array; `take` is twice as fast as indexing."""
    return np.take(values, rows, axis=0)
