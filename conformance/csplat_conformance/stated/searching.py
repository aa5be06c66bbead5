"""Find the splats of a file that have a partner in a part of their source; several processes search the parts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from csplat import _spec
from csplat.boxes import tile_boxes
from csplat.decoder import TileReader
from csplat.model import SplatModel
from csplat.processes import each_apart
from csplat.scene import joined
from csplat.types import F64, I8, I64
from csplat_conformance.room import room
from csplat_conformance.stated.matching import UNMATCHED, match, tile_radii
from csplat_conformance.stated.spool import Spool

FOUND = 0  #: instead of which partner it is


@dataclass(frozen=True, eq=False)
class Search:
    """A file, and its source in cells on the disk.

    Attributes:
        opened: the file.
        spool: its source by cells.
        bounds: as for `match`.
        reach: as for `room`.
        most: splats that are compared at a time.
        workers: processes.
    """

    opened: TileReader
    spool: Spool
    bounds: Mapping[str, float]
    reach: float
    most: int
    workers: int

    def search(self, found: I8, *, far: bool) -> Iterator[int]:
        """Look for the partners of splats that have none; yield the number of source splats searched.

        Args:
            found: [N], `FOUND`, `UNMATCHED` or `UNDECIDED` by splat of the file; changed in place when all is done,
                so that the order of the cells does not matter.
            far: search up to the bound, instead of only as near as the file's lattice puts partners.

        Raises:
            OSError: the source cannot be read; or a process was killed.
        """
        after, counts = found.copy(), self.spool.counts()
        own = replace(self, opened=replace(self.opened, threads=1)) if self.workers > 1 else self
        cells = list(counts)
        for cell, results in each_apart(_search, (own, found, far), cells, self.workers, copied=True):
            for splats, partners in results:
                better = (partners == FOUND) | (after[splats] == UNMATCHED)
                after[splats[better]] = partners[better]
            yield counts[cell]
        found[:] = after

    def in_cell(self, cell: int, found: I8, *, far: bool) -> Iterator[tuple[I64, I8]]:
        """Splats that may have a partner in a cell, and what was found for each."""
        for source, _ in self.spool.sources(cell, self.most):
            columns = source.about(self.opened.facts.origin).means.T
            low, high = (np.array([end(column) for column in columns], np.float64) for end in (np.min, np.max))
            for model, radii, splats in self._near(low, high, found, far=far):
                threads = 1 if self.workers > 1 else None
                partners = match(source, model, self.bounds, radii, far=far, reach=self.reach, threads=threads)
                yield splats, np.where(partners >= 0, FOUND, partners).astype(np.int8)

    def _near(self, low: F64, high: F64, found: I8, *, far: bool) -> Iterator[tuple[SplatModel, F64, I64]]:
        """Splats without a partner that may lie within their radius of a box, some at a time; radii and numbers."""
        header, (boxes, widths) = self.opened.header, self._boxes
        bound = self.bounds["means"]
        most = (bound + room("means", bound, self.reach)) * (1.0 + 1e-6)
        margins = np.full(len(widths), most)[:, None] if far else np.minimum(widths, most)[:, None]
        touching = ((boxes[:, 0] - margins <= high) & (boxes[:, 1] + margins >= low)).all(axis=1)
        chosen = [tile for tile in np.flatnonzero(touching).tolist() if (found[self._splats(tile)] == UNMATCHED).any()]
        models, radii, splats, count = [], [], [], 0
        for tile, model in zip(chosen, self.opened.models(chosen), strict=True):
            own = tile_radii(model.means, header, header.tiles[tile])
            margin = most if far else np.minimum(own, most)
            rows = self._splats(tile)
            inside = found[rows] == UNMATCHED
            for axis in range(3):
                column = model.means[:, axis]
                inside &= (column >= low[axis] - margin) & (column <= high[axis] + margin)
            if not inside.any():
                continue
            models.append(model.select(inside))
            radii.append(own[inside])
            splats.append(rows.start + np.flatnonzero(inside))
            count += len(models[-1])
            if count >= self.most:
                yield joined(models[0], models), np.concatenate(radii), np.concatenate(splats)
                models, radii, splats, count = [], [], [], 0
        if models:
            yield joined(models[0], models), np.concatenate(radii), np.concatenate(splats)

    @cached_property
    def _boxes(self) -> tuple[F64, F64]:
        """Boxes of the tiles, [T, 2, 3], and how near the partners of their splats are expected at most, [T]."""
        tiles, step = self.opened.header.tiles, self.opened.header.attribute(_spec.ATTRIBUTE_MEANS).step
        boxes = tile_boxes(self.opened.header)
        # A centre was rounded to float32; a radius is a cell's, and as much again for that.
        return boxes, np.array([np.ldexp(step, tile.exponent) for tile in tiles]) + np.abs(boxes).max((1, 2)) * 2.0**-21

    def _splats(self, tile: int) -> slice:
        record = self.opened.header.tiles[tile]
        return slice(record.start, record.start + record.splat_count)


def _search(shared: tuple[Search, I8, bool], cell: int) -> list[tuple[I64, Any]]:
    one, found, far = shared
    return list(one.in_cell(cell, found, far=far))
