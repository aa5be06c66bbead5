# SPDX-License-Identifier: CC0-1.0
"""Find a source splat within given bounds for each decoded splat, if no source index is known.

Source splats are sorted by the cells of a grid over centre, opacity and green. Cells are twice as wide as the bounds,
so a splat's partner is in its own cell or, along each axis, in the nearer neighbour. Most partners are found in the
first of these 32 cells. The search uses a few numbers per splat, plus blocks of fixed size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import SceneHeader
from csplat.model import SplatModel
from csplat.types import F64, I64, U64
from csplat_conformance.declared_bounds.measurement import Source, pair_differences
from csplat_conformance.tolerance import bound_tolerance

UNMATCHED = -1  #: no source splat lies within the bounds
UNDECIDED = -2  #: there are more candidates than were compared

#: The stage that `Progress` is called with.
STAGE = "matching splats"

_HALF_DIAGONAL = 0.87  # half the diagonal of a unit cube, √3 / 2, rounded up
_ROUNDING = 2.0**-22  # relative error of a centre in float32: a few times that of a single rounding
_AXES = 5  # x, y, z, alpha, green
_BLOCK = 1 << 16  # splats per task of a thread
_FIRST = frozenset(("means", "opacities", "sh0"))  # measures to compare first, the cheap ones
_PAIR_BLOCK = 4096  # pairs to compare at a time
_CANDIDATES_MAX = 1000  # splats of one cell to compare; bounds the time for scenes of equal splats
_HASH_FACTOR = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio (Fibonacci hashing)
_HASH_SHIFT = np.uint64(29)  # bits; brings high bits down, which a product does not
_EXPONENT_MIN = -1000.0  # smallest exponent of a radius, instead of minus infinity for a radius of 0


def find_partners(
    source: Source,
    decoded: SplatModel,
    bounds: Mapping[str, float],
    radii: F64,
    *,
    candidates_max: int = _CANDIDATES_MAX,
    context: Context = DEFAULT_CONTEXT,
) -> I64:
    """Find a source splat within the bounds for each decoded splat.

    Args:
        source: M splats.
        decoded: N splats; their origin may differ.
        bounds: largest error by measure, `means` among them, without the tolerance of SER-7. Other measures are not
            compared.
        radii: [N], distance within which the partner's centre is expected; the search goes on up to the bound.
        candidates_max: largest number of splats of one cell to compare with one splat.
        context: threads, and progress as the fraction of the splats that have a partner.

    Returns:
        [N] index of a source splat within the bounds, `UNMATCHED` or `UNDECIDED`.
    """
    partners = np.full(len(decoded), UNMATCHED, np.int64)
    if not len(source):
        return partners
    reach = source.reach(decoded.origin)
    source = source.about(decoded.origin)
    bounds = {name: bound + bound_tolerance(name, bound, reach) for name, bound in bounds.items()}
    bounds = {"opacities": math.inf, "sh0": math.inf, **bounds}
    bound = bounds["means"]
    levels = _radius_levels(radii, bound)
    for radius in np.unique(np.append(levels, bound)):
        rows = np.flatnonzero((partners == UNMATCHED) & (levels <= radius))
        if not len(rows):
            continue
        search = partial(_search_grid, _Grid(source, float(radius), bounds), source, decoded, bounds, candidates_max)
        parts = [rows[start : start + _BLOCK] for start in range(0, len(rows), _BLOCK)]
        with ThreadPoolExecutor(context.threads) as pool:
            for part, matches in zip(parts, pool.map(search, parts), strict=True):
                partners[part] = matches
                context.progress(STAGE, float(np.count_nonzero(partners >= 0)) / len(partners))
    return partners


def _radius_levels(radii: F64, bound: float) -> F64:
    """Round radii, [N], up to powers of two, but not beyond the bound, to limit the number of grids."""
    with np.errstate(divide="ignore"):
        exponents = np.ceil(np.log2(radii))
    rounded: F64 = np.minimum(np.exp2(np.maximum(exponents, _EXPONENT_MIN)), bound)
    return rounded


class _Grid:
    """The source splats sorted by the hash of their cells.

    Attributes:
        widths: width of a cell along each of the `_AXES`; infinite for a measure without a bound, 0 for equality.
        order: [M], the source splats in ascending order of `keys`.
        keys: [M], sorted hashes.
    """

    def __init__(self, source: Source, radius: float, bounds: Mapping[str, float]) -> None:
        margin = 1.0 + 1e-6  # relative; covers the rounding of coordinates to cells
        self.widths = [2.0 * radius * margin] * 3
        self.widths += [2.0 * bounds[name] * margin for name in ("opacities", "sh0")]
        keys = np.empty(len(source), np.uint64)
        for start in range(0, len(source), _BLOCK):
            rows = slice(start, start + _BLOCK)
            cells = self.cells(source, rows)
            keys[rows] = _hash_cells([own for own, _ in cells])
        self.order: I64 = np.argsort(keys, kind="stable")
        self.keys: U64 = keys[self.order]

    def cells(self, model: Source | SplatModel, rows: slice | NDArray[Any]) -> list[tuple[F64, F64]]:
        """Return for each axis the cell of each splat and the nearer neighbour, [n] each."""
        columns = [*model.means[rows].T, model.opacities[rows], model.sh0[rows, 1]]
        return [
            _locate_cells(column.astype(np.float64), width) for column, width in zip(columns, self.widths, strict=True)
        ]


def _locate_cells(values: F64, width: float) -> tuple[F64, F64]:
    """Return the cell of each value and the neighbour nearer to it, [n] each."""
    if width == 0.0:
        return values, values  # splats match only if they are equal
    with np.errstate(over="ignore"):
        scaled = values / width
    own = np.floor(scaled)
    with np.errstate(invalid="ignore"):
        return own, np.where(scaled - own < 0.5, own - 1.0, own + 1.0)


def _hash_cells(cells: list[F64]) -> U64:
    """Mix the bits of the cells, [n] per axis. A collision only costs a comparison."""
    mixed = np.zeros(len(cells[0]), np.uint64)
    for cell in cells:
        mixed ^= (cell + 0.0).view(np.uint64)  # -0 becomes 0
        mixed *= _HASH_FACTOR
        mixed ^= mixed >> _HASH_SHIFT
    return mixed


def _search_grid(
    grid: _Grid,
    source: Source,
    decoded: SplatModel,
    bounds: Mapping[str, float],
    candidates_max: int,
    rows: I64,
) -> I64:
    """Search partners of the decoded splats `rows`, [n], in one grid.

    Args:
        grid: the source splats.
        source: M splats.
        decoded: N splats with the origin of `source`.
        bounds: largest error by measure, with its tolerance.
        candidates_max: see `find_partners`.
        rows: [n], decoded splats.

    Returns:
        [n] index of a source splat within the bounds, `UNMATCHED` or `UNDECIDED`.
    """
    partners = np.full(len(rows), UNMATCHED, np.int64)
    cells = grid.cells(decoded, rows)
    # Bit a of a probe selects the neighbour along axis a instead of the own cell.
    for probe in range(1 << _AXES):
        open_rows = np.flatnonzero(partners == UNMATCHED)
        if not len(open_rows):
            break
        keys = _hash_cells([pair[probe >> axis & 1][open_rows] for axis, pair in enumerate(cells)])
        order = np.argsort(keys)  # halves the time, because neighbouring keys are then adjacent in memory
        open_rows, keys = open_rows[order], keys[order]
        slots = np.searchsorted(grid.keys, keys)
        # Equal keys are adjacent: in round n, each splat is compared with its candidate n.
        for nth in range(candidates_max + 1):
            more = (slots < len(grid.keys)) & (grid.keys[np.minimum(slots, len(grid.keys) - 1)] == keys)
            open_rows, keys, slots = open_rows[more], keys[more], slots[more]
            if not len(open_rows):
                break
            if nth == candidates_max:
                partners[open_rows] = UNDECIDED
                break
            candidates = grid.order[slots]
            within = _pairs_within(source, decoded, candidates, rows[open_rows], bounds)
            partners[open_rows[within]] = candidates[within]
            open_rows, keys, slots = open_rows[~within], keys[~within], slots[~within] + 1
    return partners


def _pairs_within(
    source: Source, decoded: SplatModel, source_rows: I64, decoded_rows: I64, bounds: Mapping[str, float]
) -> NDArray[np.bool_]:
    """Return [n] bool, True for pairs within the bounds. SH and covariance are compared only if the rest is."""
    within = np.ones(len(source_rows), bool)
    for names in (_FIRST, bounds.keys() - _FIRST):
        pairs = np.flatnonzero(within)
        for start in range(0, len(pairs), _PAIR_BLOCK):
            part = pairs[start : start + _PAIR_BLOCK]
            errors = pair_differences(source, decoded, source_rows[part], decoded_rows[part], names)
            for name, values in errors.items():
                within[part] &= reduce(np.maximum, np.abs(values).T) <= bounds[name]
    return within


def lattice_radii(decoded: SplatModel, header: SceneHeader) -> F64:
    """Return the distance within which the source of each splat is expected.

    This is half the diagonal of the splat's lattice cell, plus the error of rounding to float32.
    """
    radii = np.empty(len(decoded))
    step = header.attribute(_spec.ATTRIBUTE_MEANS).step
    for tile in header.tiles:
        rows = slice(tile.start, tile.start + tile.splat_count)
        x, y, z = np.abs(decoded.means[rows].T)  # NumPy is slow along an axis of three
        largest = np.maximum(np.maximum(x, y), z).astype(np.float64)
        radii[rows] = _HALF_DIAGONAL * math.ldexp(step, tile.exponent) + largest * _ROUNDING
    return radii
