"""Prove stated errors when file and source do not fit into memory: by way of a file on the disk.

Without a source index space is cut into cells of about as many splats, and the source's splats are sorted by them. The
tiles near a cell are decoded and matched with it: first as near as the file's own lattice puts partners, and then, for
the few that found none, as far as the stated maximum reaches. With a source index the source's splats are sorted by
the tiles that they became.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from mmap import mmap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import TileReader
from csplat.inputs import LetGo
from csplat.memory import default_bytes
from csplat.model import SplatModel
from csplat.processes import CAN_COPY
from csplat.scene import Scene, joined
from csplat.types import I64, Progress
from csplat_conformance.stated.cells import Cells
from csplat_conformance.stated.matching import STAGE, UNMATCHED
from csplat_conformance.stated.pairs import check_source_index, measure_names, measure_pairs, merged, wrong_extras
from csplat_conformance.stated.proof import Pairs, farthest, nearest, prove_by, tile_of
from csplat_conformance.stated.searching import Search
from csplat_conformance.stated.source import Source
from csplat_conformance.stated.spool import Rows, Spool, opened_spool
from csplat_conformance.stated.verdict import Proof, Worst

_FOLDS = 2.2  # memory to compare two scenes, as a multiple of their arrays
_SPLAT_BYTES = 80  # bytes per source splat in addition to its arrays: keys, order, centres in doubles
_PART_FOLDS = 5  # memory for a part, as a multiple of its arrays: records, source, tiles and their selection
_BASE_BYTES = 200_000_000  # bytes of the program, tiles that are being decoded, splats that wait to be written
_WORKER_BYTES = 50_000_000  # bytes of a process in addition to its part
_INDEX_BLOCK = 1 << 20  # numbers of a source index


@dataclass(frozen=True)
class PartSizes:
    """Numbers of splats that are compared at a time.

    Attributes:
        least: minimum, however little memory there is.
        most: maximum, however much there is: more are hardly faster, because caches are small.
        worth_a_process: with fewer, another process does not pay: at the edges of parts work is done twice.
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
    source = max(source_count * (_FOLDS * splat_bytes + _SPLAT_BYTES), source_bytes)
    wanted = source + opened.header.splat_count * _FOLDS * splat_bytes
    return wanted <= (default_bytes() if memory_bytes is None else memory_bytes)


def _splat_bytes(opened: TileReader) -> int:
    facts = opened.facts
    return 4 * (11 + 3 * (facts.sh_degree + 1) ** 2) + sum(column.itemsize for column in facts.extra.values())


def prove_by_disk(
    scene: Scene,
    opened: TileReader,
    source_index: NDArray[Any] | None = None,
    *,
    memory_bytes: int | None = None,
    sizes: PartSizes | None = None,
    progress: Progress | None = None,
) -> Proof:
    """Compare a file's stated errors with its source, as `prove` does, and find the same.

    The disk takes as much as the source's arrays do, in the folder for temporary files (TMPDIR), in a file of no name:
    it goes when the program ends, however that is.

    Args:
        scene: the source.
        opened: the file.
        source_index: as for `prove`; it may be mapped.
        memory_bytes: bound, about; `None`: half of what is free. A few bytes of each splat come to it.
        sizes: sizes of the parts; the proof does not depend on them.
        progress: called with the progress of the comparison.

    Raises:
        InputError: as for `prove`; the source is incomplete; or the disk is full.
        OSError: the disk cannot be written or read.
    """
    with closing(_ByDisk(scene, opened, memory_bytes, sizes or PartSizes(), progress)) as way:
        return prove_by(way, opened.header, opened.declared_bounds, source_index)


@dataclass(eq=False)
class _ByDisk:
    """A `Way`: both scenes a part at a time. Owns the file on the disk."""

    scene: Scene
    opened: TileReader
    memory_bytes: int | None
    sizes: PartSizes
    progress: Progress | None
    _spool: Spool | None = field(default=None, init=False)
    _reach: float = field(default=0.0, init=False)

    def close(self) -> None:
        """Give the disk back."""
        if self._spool is not None:
            self._spool.stream.close()

    @property
    def names(self) -> list[str]:
        """Names of the measures."""
        return measure_names(self.scene.facts, self.opened.facts)

    @property
    def source_count(self) -> int:
        """Splats of the source."""
        return self.scene.count

    @property
    def source_degree(self) -> int:
        """SH degree of the source."""
        return self.scene.facts.sh_degree

    @property
    def _memory(self) -> int:
        """Memory for parts, in bytes: the limit without the base of the program."""
        return (default_bytes() if self.memory_bytes is None else self.memory_bytes) - _BASE_BYTES

    @property
    def _most(self) -> int:
        """Splats of a part."""
        return max(self.sizes.least, min(self.sizes.most, self._memory // self._row_bytes))

    @property
    def _row_bytes(self) -> int:
        return _PART_FOLDS * (_splat_bytes(self.opened) + _SPLAT_BYTES)

    @property
    def _shares(self) -> tuple[int, int]:
        """Number of processes, and splats per part: as many processes as have large enough parts."""
        for workers in range(os.cpu_count() or 1, 1, -1):
            most = (self._memory // workers - _WORKER_BYTES) // self._row_bytes
            if CAN_COPY and most >= self.sizes.worth_a_process:
                return workers, min(most, self.sizes.most)
        return 1, self._most

    def _tell(self, stage: str, done: float) -> None:
        if self.progress is not None:
            self.progress(stage, done)

    def _sources(self) -> Iterator[tuple[int, Source]]:
        """The source a block at a time, each with the number of its first splat."""
        start = 0
        for model in self.scene.blocks():
            self._tell("reading the source", start / max(1, self.scene.count))
            block = Source.of(model)
            self._reach = max(self._reach, block.reach(self.opened.facts.origin))
            yield start, block
            start += len(model)

    def _add(self, block: Source, rows: NDArray[Any], keys: I64, numbers: I64, names: tuple[str, ...] = ()) -> None:
        if self._spool is None:
            self._spool = opened_spool(Rows.of(block, names), self.scene.count)
        self._spool.add(block, rows, keys, numbers)

    # Without a source index ------------------------------------------------------------------------

    def matches(self, bounds: Mapping[str, float]) -> NDArray[Any]:
        """Implement `Way.matches`; [N] int8."""
        header, origin = self.opened.header, self.opened.facts.origin
        workers, most = self._shares
        cells = Cells.of(header, self.scene.count, most)
        for start, block in self._sources():
            everything = np.arange(len(block))
            self._add(block, everything, cells.place(block.about(origin).means), start + everything)
        found = np.full(header.splat_count, UNMATCHED, np.int8)
        if self._spool is None:
            return found
        self._spool.flush()
        search = Search(self.opened, self._spool, bounds, self._reach, most, workers)
        done, everywhere = 0, 2 * self.scene.count
        for far in (False, True):
            if far and not (found == UNMATCHED).any():
                break
            for count in search.search(found, far=far):
                done += count
                self._tell(STAGE, done / everywhere)
        self._tell(STAGE, 1.0)
        return found

    def farthest(self, bounds: Mapping[str, float], rows: I64) -> dict[str, Worst]:
        """Implement `Way.farthest`: near splats are gathered from all parts, and compared as in memory."""
        if self._spool is None or not len(rows):
            return {}
        header = self.opened.header
        decoded = self._picked(rows)
        sources, numbers = [], []
        for cell in self._spool.counts():
            for source, known in self._spool.sources(cell, self._most):
                means = source.about(self.opened.facts.origin).means.astype(np.float64)
                near = np.unique(np.concatenate([nearest(means, point) for point in decoded.means]))
                sources.append(source.some(near))
                numbers.append(known[near])
        order = np.argsort(np.concatenate(numbers))
        number = np.concatenate(numbers)[order]
        some = Source.joined(sources).some(order)
        found = farthest(some, decoded, header, bounds, np.arange(len(rows)), self._reach, self.progress)
        return {
            name: replace(
                one,
                splat=int(rows[one.splat]),
                tile=tile_of(header, int(rows[one.splat])),
                source_splat=int(number[one.source_splat]),
            )
            for name, one in found.items()
        }

    def _picked(self, rows: I64) -> SplatModel:
        """Some splats of the file, by their numbers in order."""
        header = self.opened.header
        tiles = np.array([tile_of(header, row) for row in rows.tolist()])
        chosen = np.unique(tiles)
        models = [
            model.select(rows[tiles == tile] - header.tiles[tile].start)
            for tile, model in zip(chosen.tolist(), self.opened.models(chosen.tolist()), strict=True)
        ]
        return joined(models[0], models)

    # With a source index ---------------------------------------------------------------------------

    def pairs(self, source_index: NDArray[Any]) -> Pairs:
        """Implement `Way.pairs`; `source_index` may be mapped. Takes four or eight bytes of memory per source splat."""
        count = self.opened.header.splat_count
        check_source_index(source_index, self.scene.count, count)
        groups = self._groups()
        firsts = np.array([self.opened.header.tiles[group[0]].start for group in groups], np.int64)
        became = _inverse(source_index, self.scene.count)
        names = tuple(name for name in self.opened.facts.extra if name in self.scene.facts.extra)
        for start, block in self._sources():
            splats = became[start : start + len(block)].astype(np.int64)
            kept = np.flatnonzero(splats < count)
            keys = np.searchsorted(firsts, splats[kept], "right") - 1
            self._add(block, kept, keys, splats[kept], names)
        del became
        if self._spool is None:
            empty = Source.of(self.scene.facts)
            return Pairs(measure_pairs(empty, self.opened.facts, np.empty(0, np.int64)), [], self._reach)
        self._spool.flush()
        parts, lines = [], {}
        for key, group in enumerate(groups):
            self._tell("measuring splats", int(firsts[key]) / count)
            models = list(self.opened.models(group))
            decoded = joined(models[0], models)
            ((source, numbers),) = self._spool.sources(key, len(decoded))
            places = np.argsort(numbers)
            parts.append((int(firsts[key]), len(decoded), measure_pairs(source, decoded, places)))
            lines.update(dict.fromkeys(wrong_extras(source, decoded, places)))
        return Pairs(merged(parts), list(lines), self._reach)

    def _groups(self) -> list[list[int]]:
        """Tiles that are measured together."""
        groups: list[list[int]] = []
        count = 0
        for tile in self.opened.header.tiles:
            if not groups or count + tile.splat_count > self._most:
                groups.append([])
                count = 0
            groups[-1].append(tile.index)
            count += tile.splat_count
        return groups


def _inverse(source_index: NDArray[Any], source_count: int) -> NDArray[Any]:
    """Return the splat of the file that each source splat became; the dtype's largest number if there is none."""
    dtype = np.uint32 if len(source_index) < 2**32 - 1 else np.uint64
    became = np.full(source_count, np.iinfo(dtype).max, dtype)
    base = source_index.base
    let_go = LetGo(memoryview(base)) if isinstance(base, mmap) else None
    for start in range(0, len(source_index), _INDEX_BLOCK):
        part = source_index[start : start + _INDEX_BLOCK]
        became[part] = np.arange(start, start + len(part), dtype=dtype)
        if let_go is not None:
            let_go.after(part.nbytes)
    return became
