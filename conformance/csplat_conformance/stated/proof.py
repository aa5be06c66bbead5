"""Prove the errors that a file states against its source (spec 5.5).

With a source index, maximum, rms and counts are proved. Without one, each splat of the file must have a splat of the
source within the stated maxima; rms and counts are then not proved.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import DeclaredBounds, SceneHeader
from csplat.model import SplatModel
from csplat.types import I64, Progress
from csplat_conformance.room import may_be_stated, room
from csplat_conformance.stated.matching import UNDECIDED, UNMATCHED, lattice_radii, match
from csplat_conformance.stated.pairs import (
    Measured,
    check_source_index,
    differences,
    measure_names,
    measure_pairs,
    wrong_extras,
)
from csplat_conformance.stated.source import Source
from csplat_conformance.stated.verdict import MeasureProof, Proof, Worst

_LOOKED_AT, _LOOKED_AT_LEAST = 100, 10  # splats without a partner whose nearest source splats are looked for
_PASSES = 10**8  # distances that this may take
_NEAREST = 8  # source splats that are compared with each of them


def prove(
    source: Source,
    decoded: SplatModel,
    header: SceneHeader,
    stated: DeclaredBounds | None,
    source_index: NDArray[Any] | None = None,
    *,
    progress: Progress | None = None,
) -> Proof:
    """Compare a file's stated errors with its source.

    Args:
        source: the encoded scene.
        decoded: the decoded file.
        header: the file's header and index.
        stated: the errors that it states; `None` if it states none.
        source_index: [N] integers; which source splat each splat of the file is. `None`: not known.
        progress: called with the progress of matching.

    Raises:
        InputError: `source_index` is not one index of a source splat for each splat of the file.
    """
    return prove_by(_InMemory(source, decoded, header, progress), header, stated, source_index)


class Pairs(NamedTuple):
    """Measurements of known pairs of splats.

    Attributes:
        measured: errors by measure.
        extras: lines about differences in extra columns.
        reach: as for `room`.
    """

    measured: dict[str, Measured]
    extras: list[str]
    reach: float


class Way(Protocol):
    """A way of comparing splats with those of their source."""

    @property
    def names(self) -> list[str]:
        """Names of the measures, in the order of the registry."""
        ...

    @property
    def source_count(self) -> int:
        """Splats of the source."""
        ...

    @property
    def source_degree(self) -> int:
        """Its SH degree."""
        ...

    def pairs(self, source_index: NDArray[Any]) -> Pairs:
        """Measure pairs.

        Raises:
            InputError: `source_index` is not one index of a source splat for each splat of the file.
        """
        ...

    def matches(self, bounds: Mapping[str, float]) -> NDArray[Any]:
        """Return `UNMATCHED`, `UNDECIDED`, or something else if it has a partner, for each splat of the file."""
        ...

    def farthest(self, bounds: Mapping[str, float], rows: I64) -> dict[str, Worst]:
        """Return by measure the splat farthest beyond its bound, of some that have no partner."""
        ...


def prove_by(
    way: Way, header: SceneHeader, stated: DeclaredBounds | None, source_index: NDArray[Any] | None = None
) -> Proof:
    """Compare a file's stated errors with its source; as `prove`, wherever the splats are."""
    if stated is None:
        return Proof(failures=("the file states no errors",), clauses=("SER-6",), unproved=tuple(way.names))
    bounds = {record.measure: (record.max, record.rms) for record in stated.records}
    silent = tuple(name for name in way.names if name not in bounds) if header.splat_count else ()
    wrong = [("SER-5", line) for line in _different_scenes(way, stated)]
    if not stated.refitted:
        wrong += [("SER-6", f"the file states no error of {name}") for name in silent]
    measures: list[MeasureProof] = []
    if not wrong and source_index is not None:
        measures, wrong = _prove_pairs(way, header, bounds, source_index)
    elif not wrong and "means" in bounds:
        measures, wrong = _prove_matches(way, bounds)
    elif not wrong:  # there is no bound to search within
        silent = tuple(way.names) if header.splat_count else ()
    measures.sort(key=lambda one: way.names.index(one.name))
    clauses = tuple(dict.fromkeys(clause for clause, _ in wrong))
    proved = source_index is not None and bool(measures)
    return Proof(tuple(measures), tuple(line for _, line in wrong), clauses, silent, rms_proved=proved)


def _different_scenes(way: Way, stated: DeclaredBounds) -> Iterator[str]:
    """Yield differences that rule out a comparison: number of splats, SH degree."""
    if way.source_count != stated.source_count:
        yield f"the file stands for a source of {stated.source_count} splats, this one has {way.source_count}"
    if way.source_degree != stated.source_sh_degree:
        yield f"the file stands for a source of SH degree {stated.source_sh_degree}, this one has {way.source_degree}"


Bounds = dict[str, tuple[float, float]]
Wrong = list[tuple[str, str]]  # clause and line


def _prove_pairs(
    way: Way, header: SceneHeader, bounds: Bounds, source_index: NDArray[Any]
) -> tuple[list[MeasureProof], Wrong]:
    found_pairs, measures = way.pairs(source_index), []
    failures = [("SRC-3", line) for line in found_pairs.extras]
    for name, found in found_pairs.measured.items():
        worst = None
        if header.splat_count:
            splat = found.worst
            worst = Worst(splat, tile_of(header, splat), int(source_index[splat]), found.max)
        if name not in bounds:
            measures.append(MeasureProof(name, None, None, found.max, found.rms, None, worst))
            continue
        wrong = contradictions(name, found[:2], bounds[name], found_pairs.reach, worst)
        failures += [("SER-5", line) for line in wrong]
        measures.append(MeasureProof(name, *bounds[name], found.max, found.rms, not wrong, worst))
    return measures, failures


def contradictions(
    name: str, found: tuple[float, float], stated: tuple[float, float], reach: float, worst: Worst | None
) -> list[str]:
    """Say where a statement is below what is true, or above it by more than SER-5 allows; a line each.

    Args:
        name: name of the measure.
        found: (max, rms), as they are.
        stated: the same, as the file has them.
        reach: as for `room`.
        worst: whose error the maximum is.
    """
    lines = []
    for kind, true, said in zip(("max", "rms"), found, stated, strict=True):
        if may_be_stated(name, said, true, reach):
            continue
        line = f"{name}: {kind} {true:.9g} is {'above' if said < true else 'well below'} the stated {said:.9g}"
        if kind == "max" and worst is not None:
            line += f": splat {worst.splat} (tile {worst.tile}), source splat {worst.source_splat}"
        lines.append(line)
    return lines


def tile_of(header: SceneHeader, splat: int) -> int:
    """Return the index of the tile that holds a splat."""
    starts = [tile.start for tile in header.tiles]
    return int(np.searchsorted(starts, splat, "right")) - 1


# Without a source index ----------------------------------------------------------------------------


def _prove_matches(way: Way, bounds: Bounds) -> tuple[list[MeasureProof], Wrong]:
    largest = {name: pair[0] for name, pair in bounds.items()}
    found = way.matches(largest)
    alone = np.flatnonzero(found == UNMATCHED)
    undecided = int(np.count_nonzero(found == UNDECIDED))
    lines = []
    if undecided:
        lines.append(f"{undecided} splats have too many equals in the source to tell: give a source index")
    worst: dict[str, Worst] = {}
    some = min(_LOOKED_AT, max(_LOOKED_AT_LEAST, _PASSES // max(1, way.source_count)))
    if len(alone):
        worst = way.farthest(largest, alone[:some])
        many = f"{len(alone)} splats of the file have" if len(alone) > 1 else "1 splat of the file has"
        lines.append(f"{many} no splat of the source within the stated maxima")
        lines += [
            f"{name}: {one.found:.9g} is above the stated {largest[name]:.9g}: splat {one.splat} (tile {one.tile}),"
            f" nearest source splat {one.source_splat}"
            for name, one in worst.items()
        ]
    # It is not known which bounds the others exceed.
    open_ = len(alone) > some
    measures = [
        MeasureProof(
            name, *bounds[name], None, None, False if name in worst else None if open_ else True, worst.get(name)
        )
        for name in bounds
    ]
    return measures, [("SER-5", line) for line in lines]


@dataclass(frozen=True, eq=False)
class _InMemory:
    """All of both scenes at once."""

    source: Source
    decoded: SplatModel
    header: SceneHeader
    progress: Progress | None

    @property
    def names(self) -> list[str]:
        return measure_names(self.source, self.decoded)

    @property
    def source_count(self) -> int:
        return len(self.source)

    @property
    def source_degree(self) -> int:
        return self.source.sh_degree

    def pairs(self, source_index: NDArray[Any]) -> Pairs:
        check_source_index(source_index, len(self.source), len(self.decoded))
        return Pairs(
            measure_pairs(self.source, self.decoded, source_index),
            wrong_extras(self.source, self.decoded, source_index),
            self.source.reach(self.decoded.origin),
        )

    def matches(self, bounds: Mapping[str, float]) -> NDArray[Any]:
        radii = lattice_radii(self.decoded, self.header)
        return match(self.source, self.decoded, bounds, radii, progress=self.progress)

    def farthest(self, bounds: Mapping[str, float], rows: I64) -> dict[str, Worst]:
        reach = self.source.reach(self.decoded.origin)
        return farthest(self.source, self.decoded, self.header, bounds, rows, reach, self.progress)


def farthest(
    source: Source,
    decoded: SplatModel,
    header: SceneHeader,
    bounds: Mapping[str, float],
    rows: I64,
    reach: float,
    progress: Progress | None,
) -> dict[str, Worst]:
    """Return by measure the splat that is farthest beyond its bound, of some that have no partner.

    What is nearest is the source splat that breaks fewest bounds, of those whose centres are nearest.
    """
    worst: dict[str, Worst] = {}
    if not len(source):
        return worst
    source = source.about(decoded.origin)
    means = source.means.astype(np.float64)
    for done, row in enumerate(rows.tolist()):
        if progress is not None:
            progress("looking for what is nearest", done / len(rows))
        near = nearest(means, decoded.means[row])
        errors = differences(source, decoded, near, np.full(len(near), row))
        largest = {name: np.abs(errors[name]).max(axis=1) for name in bounds if name in errors}
        beyond = np.stack([largest[name] > bounds[name] + room(name, bounds[name], reach) for name in largest])
        best = int(beyond.sum(axis=0).argmin())
        for name, is_beyond in zip(largest, beyond[:, best].tolist(), strict=True):
            error = float(largest[name][best])
            if is_beyond and (name not in worst or error > worst[name].found):
                worst[name] = Worst(row, tile_of(header, row), int(near[best]), error)
    return worst


def nearest(means: NDArray[np.float64], point: NDArray[np.float32]) -> I64:
    """Some of the points that are nearest to another one, the nearest first."""
    with np.errstate(over="ignore"):
        distances = np.square(means - point).sum(axis=1)
    near = np.argpartition(distances, min(_NEAREST, len(means) - 1))[:_NEAREST]
    chosen: I64 = near[np.argsort(distances[near], kind="stable")]
    return chosen
