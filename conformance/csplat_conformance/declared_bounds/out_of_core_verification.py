"""Verify declared error bounds out of core, if file and source do not fit into memory.

Without a source index, space is divided into cells of about equal splat counts, and the source's splats are sorted by
cell in a temporary file. The tiles near a cell are decoded and matched with it: first within the distance that the
file's lattice implies, then, for the few splats without a partner, up to the declared maximum. With a source index, the
source's splats are sorted by tile instead.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from mmap import mmap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder import SceneHeader, TileReader
from csplat.decoder.reconstruct import tile_boxes
from csplat.file_source import PageReleaser
from csplat.model import SplatModel
from csplat.scene_source import SceneSource, join_blocks
from csplat.system import CAN_FORK, default_memory_bytes, map_in_processes
from csplat.types import F64, I8, I64, Progress
from csplat_conformance.declared_bounds.bounds_verification import (
    BoundsVerification,
    PairErrors,
    WorstSplat,
    find_worst,
    nearest_points,
    tile_of,
    verify_with,
)
from csplat_conformance.declared_bounds.measurement import (
    Source,
    check_source_index,
    find_wrong_extras,
    measure_names,
    measure_pairs,
    merge_errors,
)
from csplat_conformance.declared_bounds.partners import STAGE, UNMATCHED, find_partners, tile_radii
from csplat_conformance.declared_bounds.splat_spool import RecordLayout, SplatSpool, open_spool
from csplat_conformance.tolerance import bound_tolerance

_COMPARE_FACTOR = 2.2  # memory to compare two scenes, as a multiple of their arrays
_SPLAT_BYTES = 80  # bytes per source splat in addition to its arrays: keys, order, centres in doubles
_PART_FACTOR = 5  # memory for a part, as a multiple of its arrays: records, source, tiles and their selection
_BASE_BYTES = 200_000_000  # bytes of the program, of tiles during decoding, and of splats waiting to be written
_WORKER_BYTES = 50_000_000  # bytes of a process in addition to its part
_INDEX_BLOCK = 1 << 20  # numbers of a source index


@dataclass(frozen=True)
class PartSizes:
    """Limits on the number of splats that are compared at a time.

    Attributes:
        least: minimum, even if there is less memory.
        most: maximum, even if there is more memory, because larger parts are hardly faster.
        worth_a_process: smallest part that justifies another process, because work at the edges of parts is repeated.
    """

    least: int = 1 << 14
    most: int = 1 << 20
    worth_a_process: int = 1 << 18


def fits_memory(opened: TileReader, source_count: int, source_bytes: int, memory_bytes: int | None) -> bool:
    """Return True if a file and its source can be compared in memory.

    Args:
        opened: the file.
        source_count: splats of the source.
        source_bytes: size of its file.
        memory_bytes: memory limit; `None`: half of the free memory.
    """
    splat_bytes = _splat_bytes(opened)
    source = max(source_count * (_COMPARE_FACTOR * splat_bytes + _SPLAT_BYTES), source_bytes)
    needed = source + opened.header.splat_count * _COMPARE_FACTOR * splat_bytes
    return needed <= (default_memory_bytes() if memory_bytes is None else memory_bytes)


def _splat_bytes(opened: TileReader) -> int:
    metadata_model = opened.metadata_model
    return 4 * (11 + 3 * (metadata_model.sh_degree + 1) ** 2) + sum(
        column.itemsize for column in metadata_model.extra.values()
    )


def verify_out_of_core(
    scene: SceneSource,
    opened: TileReader,
    source_index: NDArray[Any] | None = None,
    *,
    memory_bytes: int | None = None,
    sizes: PartSizes | None = None,
    progress: Progress | None = None,
) -> BoundsVerification:
    """Verify the error bounds of a file against its source, with the same result as `verify_bounds`.

    The arrays of the source are copied to an unnamed file in the folder for temporary files (TMPDIR). The file vanishes
    when the program ends, even if it is killed.

    Args:
        scene: the source.
        opened: the file.
        source_index: see `verify_bounds`; may be memory-mapped.
        memory_bytes: approximate memory limit, excluding a few bytes per splat; `None`: half of the free memory.
        sizes: limits on the sizes of parts; the result does not depend on them.
        progress: called with the progress of the comparison.

    Raises:
        InputError: see `verify_bounds`; the source is incomplete; the disk is full.
        OSError: the disk cannot be written or read.
    """
    with closing(_OutOfCoreComparison(scene, opened, memory_bytes, sizes or PartSizes(), progress)) as scenes:
        return verify_with(scenes, opened.header, opened.declared_bounds, source_index)


@dataclass(eq=False)
class _OutOfCoreComparison:
    """A `SplatComparison` of parts of both scenes. Owns the temporary file."""

    scene: SceneSource
    opened: TileReader
    memory_bytes: int | None
    sizes: PartSizes
    progress: Progress | None
    _spool: SplatSpool | None = field(default=None, init=False)
    _reach: float = field(default=0.0, init=False)

    def close(self) -> None:
        """Close and thereby remove the temporary file."""
        if self._spool is not None:
            self._spool.stream.close()

    @property
    def names(self) -> list[str]:
        """Names of the measures, in the order of the registry."""
        return measure_names(self.scene.metadata_model, self.opened.metadata_model)

    @property
    def source_count(self) -> int:
        """Splats of the source."""
        return self.scene.count

    @property
    def source_degree(self) -> int:
        """SH degree of the source."""
        return self.scene.metadata_model.sh_degree

    @property
    def _memory(self) -> int:
        """Memory for parts, in bytes: the limit without that of the program itself."""
        return (default_memory_bytes() if self.memory_bytes is None else self.memory_bytes) - _BASE_BYTES

    @property
    def _most(self) -> int:
        """Largest number of splats of a part."""
        return max(self.sizes.least, min(self.sizes.most, self._memory // self._row_bytes))

    @property
    def _row_bytes(self) -> int:
        return _PART_FACTOR * (_splat_bytes(self.opened) + _SPLAT_BYTES)

    @property
    def _shares(self) -> tuple[int, int]:
        """Number of processes, each with parts that are large enough, and the number of splats per part."""
        for workers in range(os.cpu_count() or 1, 1, -1):
            most = (self._memory // workers - _WORKER_BYTES) // self._row_bytes
            if CAN_FORK and most >= self.sizes.worth_a_process:
                return workers, min(most, self.sizes.most)
        return 1, self._most

    def _report(self, stage: str, done: float) -> None:
        if self.progress is not None:
            self.progress(stage, done)

    def _sources(self) -> Iterator[tuple[int, Source]]:
        """Yield the blocks of the source, each with the index of its first splat."""
        start = 0
        for model in self.scene.blocks():
            self._report("reading the source", start / max(1, self.scene.count))
            block = Source.of(model)
            self._reach = max(self._reach, block.reach(self.opened.metadata_model.origin))
            yield start, block
            start += len(model)

    def _add(self, block: Source, rows: NDArray[Any], keys: I64, numbers: I64, names: tuple[str, ...] = ()) -> None:
        if self._spool is None:
            self._spool = open_spool(RecordLayout.of(block, names), self.scene.count)
        self._spool.add(block, rows, keys, numbers)

    # Without a source index ------------------------------------------------------------------------

    def matches(self, bounds: Mapping[str, float]) -> NDArray[Any]:
        """Implement `SplatComparison.matches`; [N] int8."""
        header, origin = self.opened.header, self.opened.metadata_model.origin
        workers, most = self._shares
        cells = CellTree.of(header, self.scene.count, most)
        for start, block in self._sources():
            everything = np.arange(len(block))
            self._add(block, everything, cells.place(block.about(origin).means), start + everything)
        found = np.full(header.splat_count, UNMATCHED, np.int8)
        if self._spool is None:
            return found
        self._spool.flush()
        search = PartnerSearch(self.opened, self._spool, bounds, self._reach, most, workers)
        done, everywhere = 0, 2 * self.scene.count
        for far in (False, True):
            if far and not (found == UNMATCHED).any():
                break
            for count in search.search(found, far=far):
                done += count
                self._report(STAGE, done / everywhere)
        self._report(STAGE, 1.0)
        return found

    def farthest(self, bounds: Mapping[str, float], rows: I64) -> dict[str, WorstSplat]:
        """Implement `SplatComparison.farthest` with the nearest source splats of all parts."""
        if self._spool is None or not len(rows):
            return {}
        header = self.opened.header
        decoded = self._decode_splats(rows)
        sources, numbers = [], []
        for cell in self._spool.counts():
            for source, known in self._spool.sources(cell, self._most):
                means = source.about(self.opened.metadata_model.origin).means.astype(np.float64)
                near = np.unique(np.concatenate([nearest_points(means, point) for point in decoded.means]))
                sources.append(source.select(near))
                numbers.append(known[near])
        order = np.argsort(np.concatenate(numbers))
        number = np.concatenate(numbers)[order]
        near_source = Source.concatenate(sources).select(order)
        found = find_worst(near_source, decoded, header, bounds, np.arange(len(rows)), self._reach, self.progress)
        return {
            name: replace(
                one,
                splat=int(rows[one.splat]),
                tile=tile_of(header, int(rows[one.splat])),
                source_splat=int(number[one.source_splat]),
            )
            for name, one in found.items()
        }

    def _decode_splats(self, rows: I64) -> SplatModel:
        """Decode the splats of the given ascending indices."""
        header = self.opened.header
        tiles = np.array([tile_of(header, row) for row in rows.tolist()])
        chosen = np.unique(tiles)
        models = [
            model.select(rows[tiles == tile] - header.tiles[tile].start)
            for tile, model in zip(chosen.tolist(), self.opened.models(chosen.tolist()), strict=True)
        ]
        return join_blocks(models[0], models)

    # With a source index ---------------------------------------------------------------------------

    def pairs(self, source_index: NDArray[Any]) -> PairErrors:
        """Implement `SplatComparison.pairs`; takes four or eight bytes of memory per source splat."""
        count = self.opened.header.splat_count
        check_source_index(source_index, self.scene.count, count)
        groups = self._groups()
        firsts = np.array([self.opened.header.tiles[group[0]].start for group in groups], np.int64)
        became = _invert_index(source_index, self.scene.count)
        names = tuple(name for name in self.opened.metadata_model.extra if name in self.scene.metadata_model.extra)
        for start, block in self._sources():
            splats = became[start : start + len(block)].astype(np.int64)
            kept = np.flatnonzero(splats < count)
            keys = np.searchsorted(firsts, splats[kept], "right") - 1
            self._add(block, kept, keys, splats[kept], names)
        del became
        if self._spool is None:
            empty = Source.of(self.scene.metadata_model)
            return PairErrors(measure_pairs(empty, self.opened.metadata_model, np.empty(0, np.int64)), [], self._reach)
        self._spool.flush()
        parts, lines = [], {}
        for key, group in enumerate(groups):
            self._report("measuring splats", int(firsts[key]) / count)
            models = list(self.opened.models(group))
            decoded = join_blocks(models[0], models)
            ((source, numbers),) = self._spool.sources(key, len(decoded))
            order = np.argsort(numbers)
            parts.append((int(firsts[key]), len(decoded), measure_pairs(source, decoded, order)))
            lines.update(dict.fromkeys(find_wrong_extras(source, decoded, order)))
        return PairErrors(merge_errors(parts), list(lines), self._reach)

    def _groups(self) -> list[list[int]]:
        """Return the tiles of each part."""
        groups: list[list[int]] = []
        count = 0
        for tile in self.opened.header.tiles:
            if not groups or count + tile.splat_count > self._most:
                groups.append([])
                count = 0
            groups[-1].append(tile.index)
            count += tile.splat_count
        return groups


def _invert_index(source_index: NDArray[Any], source_count: int) -> NDArray[Any]:
    """Return for each source splat the index of its splat in the file, or the dtype's largest number if none."""
    dtype = np.uint32 if len(source_index) < 2**32 - 1 else np.uint64
    became = np.full(source_count, np.iinfo(dtype).max, dtype)
    base = source_index.base
    let_go = PageReleaser(memoryview(base)) if isinstance(base, mmap) else None
    for start in range(0, len(source_index), _INDEX_BLOCK):
        part = source_index[start : start + _INDEX_BLOCK]
        became[part] = np.arange(start, start + len(part), dtype=dtype)
        if let_go is not None:
            let_go.after(part.nbytes)
    return became


_OCTANT_CENTRES = np.array([[x, y, z] for x in (0.25, 0.75) for y in (0.25, 0.75) for z in (0.25, 0.75)])


@dataclass(frozen=True, eq=False)
class CellTree:
    """A tree of axis-aligned planes that cuts space into cells; node k has the nodes 2k + 1 below and 2k + 2 above.

    Attributes:
        axes: [2^d - 1] axis of each plane.
        values: [2^d - 1] its coordinate.
    """

    axes: NDArray[np.int64]
    values: F64

    @classmethod
    def of(cls, header: SceneHeader, count: int, most: int) -> CellTree:
        """Divide space into cells of about `most` of `count` splats, estimated from the tiles of a file."""
        boxes = tile_boxes(header, header.tiles)
        points = (boxes[:, None, 0] + _OCTANT_CENTRES * (boxes[:, None, 1] - boxes[:, None, 0])).reshape(-1, 3)
        weights = np.repeat([float(tile.splat_count) for tile in header.tiles], len(_OCTANT_CENTRES))
        depth = max(0, int(np.ceil(np.log2(max(1.0, count / most))))) if len(points) else 0
        cells = cls(np.zeros(2**depth - 1, np.int64), np.zeros(2**depth - 1))
        cells._cut(0, points, weights)
        return cells

    def _cut(self, node: int, points: F64, weights: F64) -> None:
        if node >= len(self.axes) or not len(points):
            return
        axis = int(np.ptp(points, axis=0).argmax())
        order = np.argsort(points[:, axis], kind="stable")
        points, weights = points[order], weights[order]
        heavy = np.cumsum(weights)
        middle = min(int(np.searchsorted(heavy, heavy[-1] / 2.0)) + 1, len(points) - 1)
        self.axes[node], self.values[node] = axis, points[middle, axis]
        self._cut(2 * node + 1, points[:middle], weights[:middle])
        self._cut(2 * node + 2, points[middle:], weights[middle:])

    def place(self, means: NDArray[Any]) -> NDArray[np.int64]:
        """Return the cell of each centre, [n]."""
        node = np.zeros(len(means), np.int64)
        rows = np.arange(len(means))
        for _ in range(len(self.axes).bit_length()):
            node = 2 * node + 1 + (means[rows, self.axes[node]] >= self.values[node])
        return node - len(self.axes)


FOUND = 0  #: a partner was found; its index is not recorded


@dataclass(frozen=True, eq=False)
class PartnerSearch:
    """A search for the partners of a file's splats in its source, which is spooled by cells.

    Attributes:
        opened: the file.
        spool: the source by cells.
        bounds: see `find_partners`.
        reach: see `bound_tolerance`.
        most: largest number of splats to compare at a time.
        workers: number of processes.
    """

    opened: TileReader
    spool: SplatSpool
    bounds: Mapping[str, float]
    reach: float
    most: int
    workers: int

    def search(self, found: I8, *, far: bool) -> Iterator[int]:
        """Search partners for splats that have none; yield the number of source splats of each searched cell.

        Args:
            found: [N], `FOUND`, `UNMATCHED` or `UNDECIDED` by splat of the file. Updated in place at the end, so that
                the order of the cells does not matter.
            far: search up to the bound, not only within the distance that the file's lattice implies.

        Raises:
            OSError: the source cannot be read, or a process was killed.
        """
        after, counts = found.copy(), self.spool.counts()
        own = replace(self, opened=replace(self.opened, threads=1)) if self.workers > 1 else self
        cells = list(counts)
        for cell, results in map_in_processes(_search_in_process, (own, found, far), cells, self.workers, copied=True):
            for splats, partners in results:
                better = (partners == FOUND) | (after[splats] == UNMATCHED)
                after[splats[better]] = partners[better]
            yield counts[cell]
        found[:] = after

    def search_cell(self, cell: int, found: I8, *, far: bool) -> Iterator[tuple[I64, I8]]:
        """Yield splats that may have a partner in a cell, with their results."""
        for source, _ in self.spool.sources(cell, self.most):
            columns = source.about(self.opened.metadata_model.origin).means.T
            low, high = (np.array([end(column) for column in columns], np.float64) for end in (np.min, np.max))
            for model, radii, splats in self._near(low, high, found, far=far):
                threads = 1 if self.workers > 1 else None
                partners = find_partners(source, model, self.bounds, radii, far=far, reach=self.reach, threads=threads)
                yield splats, np.where(partners >= 0, FOUND, partners).astype(np.int8)

    def _near(self, low: F64, high: F64, found: I8, *, far: bool) -> Iterator[tuple[SplatModel, F64, I64]]:
        """Yield splats without a partner whose radius may reach a box: splats, radii and indices."""
        header, (boxes, widths) = self.opened.header, self._boxes
        bound = self.bounds["means"]
        most = (bound + bound_tolerance("means", bound, self.reach)) * (1.0 + 1e-6)
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
                yield join_blocks(models[0], models), np.concatenate(radii), np.concatenate(splats)
                models, radii, splats, count = [], [], [], 0
        if models:
            yield join_blocks(models[0], models), np.concatenate(radii), np.concatenate(splats)

    @cached_property
    def _boxes(self) -> tuple[F64, F64]:
        """Boxes of the tiles, [T, 2, 3], and the distances within which their splats' partners are expected, [T]."""
        tiles, step = self.opened.header.tiles, self.opened.header.attribute(_spec.ATTRIBUTE_MEANS).step
        boxes = tile_boxes(self.opened.header, self.opened.header.tiles)
        # The diagonal of a cell, plus the rounding of the centre to float32.
        return boxes, np.array([np.ldexp(step, tile.exponent) for tile in tiles]) + np.abs(boxes).max((1, 2)) * 2.0**-21

    def _splats(self, tile: int) -> slice:
        record = self.opened.header.tiles[tile]
        return slice(record.start, record.start + record.splat_count)


def _search_in_process(shared: tuple[PartnerSearch, I8, bool], cell: int) -> list[tuple[I64, Any]]:
    search, found, far = shared
    return list(search.search_cell(cell, found, far=far))
