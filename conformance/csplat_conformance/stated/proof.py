"""Prove the errors that a file states against its source (spec 5.5).

With a source index, maximum, rms and counts are proved. Without one, each splat of the file must have a splat of the
source within the stated maxima; rms and counts are then not proved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import SceneHeader, StatedErrors
from csplat.model import SplatModel
from csplat_conformance.room import may_be_stated, room
from csplat_conformance.stated.matching import UNDECIDED, UNMATCHED, Progress, lattice_radii, match
from csplat_conformance.stated.pairs import (
    check_source_index,
    differences,
    measure_names,
    measure_pairs,
    wrong_extras,
)
from csplat_conformance.stated.source import Source

__all__ = ["MeasureProof", "Proof", "Worst", "prove"]

I64 = NDArray[np.int64]

_NOT_WITHOUT_INDEX = "rms and counts are not proved without a source index"
_LOOKED_AT, _LOOKED_AT_LEAST = 100, 10  # splats without a partner whose nearest source splats are looked for
_PASSES = 10**8  # distances that this may take
_NEAREST = 8  # source splats that are compared with each of them


@dataclass(frozen=True)
class Worst:
    """The splat that is farthest off.

    Attributes:
        splat: of the file.
        tile: that holds it.
        source_splat: what it stands for or, where nobody said which it is, is nearest to.
        found: how far it is off, in the measure's unit.
    """

    splat: int
    tile: int
    source_splat: int
    found: float


@dataclass(frozen=True)
class MeasureProof:
    """One measure: what is stated, what was found, and whether it holds.

    Attributes:
        name: of the registry of stated errors.
        stated_max, stated_rms: of the file; `None` where it does not state the measure.
        measured_max, measured_rms: of the pairs; `None` without a source index.
        holds: nothing contradicts the statement; `None` where there is none.
        worst: the splat with the largest error. Without a source index it is there only where a splat has no partner
            because of this measure.
    """

    name: str
    stated_max: float | None
    stated_rms: float | None
    measured_max: float | None
    measured_rms: float | None
    holds: bool | None
    worst: Worst | None


@dataclass(frozen=True)
class Proof:
    """What became of the attempt.

    Attributes:
        measures: in the order of the registry.
        failures: one line each; none when the file's statement holds.
        clauses: of the spec, that they break.
        unproved: measures of which nothing is stated: what was fitted anew, or everything.
        rms_proved: whether rms and counts were proved too.
    """

    measures: tuple[MeasureProof, ...] = ()
    failures: tuple[str, ...] = ()
    clauses: tuple[str, ...] = ()
    unproved: tuple[str, ...] = ()
    rms_proved: bool = False

    @property
    def holds(self) -> bool:
        """Whether everything that could be looked at holds."""
        return not self.failures

    @property
    def notes(self) -> tuple[str, ...]:
        """What was not proved, a line each."""
        notes = []
        if self.measures and not self.rms_proved:
            notes.append(_NOT_WITHOUT_INDEX)
        if self.unproved:
            notes.append(f"not proved: {', '.join(self.unproved)}: no error of them is stated, renders are their judge")
        return tuple(notes)

    def as_json(self) -> dict[str, Any]:
        """Everything, JSON-compatible; what overflowed is `null`."""
        return {
            "rms_and_counts_proved": self.rms_proved and self.holds,
            "failures": list(self.failures),
            "not_proved": list(self.unproved),
            "notes": list(self.notes),
            "measures": {
                one.name: {
                    "stated_max": one.stated_max,
                    "stated_rms": one.stated_rms,
                    "measured_max": _finite(one.measured_max),
                    "measured_rms": _finite(one.measured_rms),
                    "holds": one.holds,
                    "worst": None if one.worst is None else {**vars(one.worst), "found": _finite(one.worst.found)},
                }
                for one in self.measures
            },
        }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def prove(
    source: Source,
    decoded: SplatModel,
    header: SceneHeader,
    stated: StatedErrors | None,
    source_index: NDArray[Any] | None = None,
    *,
    progress: Progress | None = None,
) -> Proof:
    """Compare a file's stated errors with its source.

    Args:
        source: what was encoded.
        decoded: what the file decodes to.
        header: the file's header and index.
        stated: what it states, `None` where it states nothing.
        source_index: [N] integers; which source splat each splat of the file is. `None`: not known.
        progress: is told how far matching has come.

    Raises:
        InputError: `source_index` is not one index of a source splat for each splat of the file.
    """
    names = measure_names(source, decoded)
    if stated is None:
        return Proof(failures=("the file states no errors",), clauses=("SER-6",), unproved=tuple(names))
    bounds = {record.measure: (record.max, record.rms) for record in stated.records}
    silent = tuple(name for name in names if name not in bounds) if len(decoded) else ()
    wrong = [("SER-5", line) for line in _different_scenes(source, stated)]
    if not stated.refitted:
        wrong += [("SER-6", f"the file states no error of {name}") for name in silent]
    measures: list[MeasureProof] = []
    if not wrong and source_index is not None:
        measures, wrong = _prove_pairs(source, decoded, header, bounds, source_index)
    elif not wrong and "means" in bounds:
        measures, wrong = _prove_matches(source, decoded, header, bounds, progress)
    elif not wrong:  # nothing says how far to look
        silent = tuple(names) if len(decoded) else ()
    measures.sort(key=lambda one: names.index(one.name))
    clauses = tuple(dict.fromkeys(clause for clause, _ in wrong))
    proved = source_index is not None and bool(measures)
    return Proof(tuple(measures), tuple(line for _, line in wrong), clauses, silent, rms_proved=proved)


def _different_scenes(source: Source, stated: StatedErrors) -> Iterator[str]:
    """What must be equal before splats are compared at all."""
    if len(source) != stated.source_count:
        yield f"the file stands for a source of {stated.source_count} splats, this one has {len(source)}"
    if source.sh_degree != stated.source_sh_degree:
        yield f"the file stands for a source of SH degree {stated.source_sh_degree}, this one has {source.sh_degree}"


Bounds = dict[str, tuple[float, float]]
Wrong = list[tuple[str, str]]  # clause and line


def _prove_pairs(
    source: Source, decoded: SplatModel, header: SceneHeader, bounds: Bounds, source_index: NDArray[Any]
) -> tuple[list[MeasureProof], Wrong]:
    check_source_index(source_index, len(source), len(decoded))
    measured = measure_pairs(source, decoded, source_index)
    failures = [("SRC-3", line) for line in wrong_extras(source, decoded, source_index)]
    reach, measures = source.reach(decoded.origin), []
    for name, found in measured.items():
        worst = None
        if len(decoded):
            splat = found.worst
            worst = Worst(splat, _tile_of(header, splat), int(source_index[splat]), found.max)
        if name not in bounds:
            measures.append(MeasureProof(name, None, None, found.max, found.rms, None, worst))
            continue
        wrong = contradictions(name, found[:2], bounds[name], reach, worst)
        failures += [("SER-5", line) for line in wrong]
        measures.append(MeasureProof(name, *bounds[name], found.max, found.rms, not wrong, worst))
    return measures, failures


def contradictions(
    name: str, found: tuple[float, float], stated: tuple[float, float], reach: float, worst: Worst | None
) -> list[str]:
    """Say where a statement is below what is true, or above it by more than SER-5 allows; a line each.

    Args:
        name: of the measure.
        found: (max, rms), as they are.
        stated: the same, as the file has them.
        reach: as of `room`.
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


def _tile_of(header: SceneHeader, splat: int) -> int:
    starts = [tile.start for tile in header.tiles]
    return int(np.searchsorted(starts, splat, "right")) - 1


# Without a source index ----------------------------------------------------------------------------


def _prove_matches(
    source: Source, decoded: SplatModel, header: SceneHeader, bounds: Bounds, progress: Progress | None
) -> tuple[list[MeasureProof], Wrong]:
    largest = {name: pair[0] for name, pair in bounds.items()}
    found = match(source, decoded, largest, lattice_radii(decoded, header), progress=progress)
    alone = np.flatnonzero(found == UNMATCHED)
    undecided = int(np.count_nonzero(found == UNDECIDED))
    lines = []
    if undecided:
        lines.append(f"{undecided} splats have too many equals in the source to tell: give a source index")
    worst: dict[str, Worst] = {}
    some = min(_LOOKED_AT, max(_LOOKED_AT_LEAST, _PASSES // max(1, len(source))))
    if len(alone):
        worst = _farthest(source, decoded, header, largest, alone[:some], progress)
        many = f"{len(alone)} splats of the file have" if len(alone) > 1 else "1 splat of the file has"
        lines.append(f"{many} no splat of the source within the stated maxima")
        lines += [
            f"{name}: {one.found:.9g} is above the stated {largest[name]:.9g}: splat {one.splat} (tile {one.tile}),"
            f" nearest source splat {one.source_splat}"
            for name, one in worst.items()
        ]
    # Of which measures the others are beyond is not known.
    open_ = len(alone) > some
    measures = [
        MeasureProof(
            name, *bounds[name], None, None, False if name in worst else None if open_ else True, worst.get(name)
        )
        for name in bounds
    ]
    return measures, [("SER-5", line) for line in lines]


def _farthest(
    source: Source,
    decoded: SplatModel,
    header: SceneHeader,
    bounds: dict[str, float],
    rows: I64,
    progress: Progress | None,
) -> dict[str, Worst]:
    """Return by measure the splat that is farthest beyond its bound, of some that have no partner.

    What is nearest is the source splat that breaks fewest bounds, of those whose centres are nearest.
    """
    worst: dict[str, Worst] = {}
    if not len(source):
        return worst
    reach, source = source.reach(decoded.origin), source.about(decoded.origin)
    means = source.means.astype(np.float64)
    for done, row in enumerate(rows.tolist()):
        if progress is not None:
            progress("looking for what is nearest", done / len(rows))
        with np.errstate(over="ignore"):
            distances = np.square(means - decoded.means[row]).sum(axis=1)
        near = np.argpartition(distances, min(_NEAREST, len(means) - 1))[:_NEAREST]
        near = near[np.argsort(distances[near], kind="stable")]
        errors = differences(source, decoded, near, np.full(len(near), row))
        largest = {name: np.abs(errors[name]).max(axis=1) for name in bounds if name in errors}
        beyond = np.stack([largest[name] > bounds[name] + room(name, bounds[name], reach) for name in largest])
        best = int(beyond.sum(axis=0).argmin())
        for name, is_beyond in zip(largest, beyond[:, best].tolist(), strict=True):
            error = float(largest[name][best])
            if is_beyond and (name not in worst or error > worst[name].found):
                worst[name] = Worst(row, _tile_of(header, row), int(near[best]), error)
    return worst
