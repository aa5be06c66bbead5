"""Prove the errors that a file states against its source (spec 5.5).

With a source index, maximum, rms and counts are proved. Without one, each splat of the file must have a splat of the
source within the stated maxima; rms and counts are then not proved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder import SceneHeader, StatedErrors
from csplat.model import SplatModel
from csplat_tools.files.console import Progress, finite
from csplat_tools.inspect.matching import UNDECIDED, UNMATCHED, allowed, match
from csplat_tools.inspect.pairs import measure_names, measure_pairs

__all__ = ["MeasureProof", "Proof", "lattice_radii", "prove"]

F64 = NDArray[np.float64]

_COLOURS = ("sh0", "sh1", "sh2", "sh3")
_REFITTED = "what has no stated error was fitted anew: renders are its judge, nothing is proved of it"
_EXCESS, _EXCESS_FLOOR = 1e-4, 1e-12  # SER-5: by how much a statement may exceed what is true


@dataclass(frozen=True)
class MeasureProof:
    """One measure: what is stated, what was found, and whether it holds.

    Attributes:
        name: of the registry of stated errors.
        stated_max, stated_rms: of the file; `None` where it does not state the measure.
        measured_max, measured_rms: of the pairs; `None` without a source index.
        holds: nothing contradicts the statement.
    """

    name: str
    stated_max: float | None
    stated_rms: float | None
    measured_max: float | None
    measured_rms: float | None
    holds: bool


@dataclass(frozen=True)
class Proof:
    """What became of the attempt.

    Attributes:
        measures: in the order of the registry.
        failures: one line each; none when the file's statement holds.
        rms_proved: whether rms and counts were proved too.
    """

    measures: tuple[MeasureProof, ...] = ()
    failures: tuple[str, ...] = ()
    rms_proved: bool = False
    notes: tuple[str, ...] = field(default=())

    @property
    def holds(self) -> bool:
        """Whether everything that could be looked at holds."""
        return not self.failures

    def as_json(self) -> dict[str, Any]:
        """Everything, JSON-compatible; what overflowed is `null`."""
        return {
            "rms_and_counts_proved": self.rms_proved and self.holds,
            "failures": list(self.failures),
            "notes": list(self.notes),
            "measures": {
                one.name: {
                    "stated_max": one.stated_max,
                    "stated_rms": one.stated_rms,
                    "measured_max": finite(one.measured_max),
                    "measured_rms": finite(one.measured_rms),
                    "holds": one.holds,
                }
                for one in self.measures
            },
        }


def prove(
    source: SplatModel,
    decoded: SplatModel,
    header: SceneHeader,
    stated: StatedErrors | None,
    source_index: NDArray[Any] | None = None,
    *,
    progress: Progress | None = None,
) -> Proof:
    """Compare a file's stated errors with its source.

    Args:
        source: the model that was encoded.
        decoded: what the file decodes to.
        header: the file's header and index.
        stated: what it states, `None` where it states nothing.
        source_index: [N] integers; which source splat each splat of the file is. `None`: not known.
        progress: is told how far matching has come.

    Raises:
        InputError: `source_index` is not one index of a source splat for each splat of the file.
    """
    if stated is None:
        return Proof(failures=("the file states no errors",))
    names = measure_names(source, decoded)
    if stated.refitted:
        spoken_of = {record.measure for record in stated.records}
        names = [name for name in names if name in spoken_of]
        if not names or spoken_of.intersection(_COLOURS):
            return Proof(
                failures=("the file says that attributes were fitted anew: renders are its judge, not these bounds",)
            )
    failures = _compare_scenes(source, decoded, stated, names)
    if failures:
        return Proof(failures=tuple(failures))
    if source_index is not None:
        proof = _prove_pairs(source, decoded, stated, source_index, names)
    else:
        proof = _prove_matches(source, decoded, header, stated, names, progress)
    return replace(proof, notes=(*proof.notes, _REFITTED)) if stated.refitted else proof


def _compare_scenes(source: SplatModel, decoded: SplatModel, stated: StatedErrors, names: Sequence[str]) -> list[str]:
    """What must be equal before splats are compared at all."""
    failures = []
    if len(source) != stated.source_count:
        failures.append(f"the file stands for a source of {stated.source_count} splats, this one has {len(source)}")
    if source.sh_degree != stated.source_sh_degree:
        failures.append(
            f"the file stands for a source of SH degree {stated.source_sh_degree}, this one has {source.sh_degree}"
        )
    if source.origin != decoded.origin:
        failures.append(f"the file's origin is {decoded.origin}, the source's {source.origin}")
    bounds = _bounds(stated)
    failures += [f"the file states no error of {name}" for name in names if name not in bounds and len(decoded)]
    return failures


def _bounds(stated: StatedErrors) -> dict[str, tuple[float, float]]:
    return {record.measure: (record.max, record.rms) for record in stated.records}


def _prove_pairs(
    source: SplatModel,
    decoded: SplatModel,
    stated: StatedErrors,
    source_index: NDArray[Any],
    names: Sequence[str],
) -> Proof:
    every = measure_pairs(source, decoded, source_index)
    measured = {name: every[name] for name in names}
    failures = []
    different = len(np.unique(source_index))
    if different != len(decoded):
        failures.append(
            f"the source index names {different} splats for {len(decoded)}: counts of kept and pruned are wrong"
        )
    for name, column in decoded.extra.items():
        other = source.extra.get(name)
        if other is None or column.tobytes() != other[source_index].astype(column.dtype).tobytes():
            failures.append(f"the extra column {name!r} is not the source's")
    measures = []
    bounds = _bounds(stated)
    for name, (largest, rms) in measured.items():
        stated_max, stated_rms = bounds.get(name, (0.0, 0.0))
        wrong = [_contradiction(name, "max", largest, stated_max), _contradiction(name, "rms", rms, stated_rms)]
        failures += filter(None, wrong)
        measures.append(MeasureProof(name, stated_max, stated_rms, largest, rms, not any(wrong)))
    return Proof(tuple(measures), tuple(failures), rms_proved=True)


def _contradiction(name: str, kind: str, measured: float, stated: float) -> str:
    """Say what is wrong with a statement, or nothing: it is no less than what is true, and hardly more (SER-5)."""
    if measured > allowed(name, stated):
        return f"{name}: {kind} {measured:.9g} is above the stated {stated:.9g}"
    if stated > measured * (1.0 + _EXCESS) + _EXCESS_FLOOR + allowed(name, 0.0):
        return f"{name}: {kind} {measured:.9g} is well below the stated {stated:.9g}"
    return ""


def _prove_matches(
    source: SplatModel,
    decoded: SplatModel,
    header: SceneHeader,
    stated: StatedErrors,
    names: Sequence[str],
    progress: Progress | None,
) -> Proof:
    bounds = {"opacities": math.inf, "sh0": math.inf, **{record.measure: record.max for record in stated.records}}
    found = match(source, decoded, bounds, lattice_radii(decoded, header), progress=progress)
    unmatched = int(np.count_nonzero(found == UNMATCHED))
    undecided = int(np.count_nonzero(found == UNDECIDED))
    failures = []
    if unmatched:
        failures.append(f"{unmatched} splats of the file have no splat of the source within the stated maxima")
    if undecided:
        failures.append(f"{undecided} splats have too many equals in the source to tell: give a source index")
    measures = tuple(
        MeasureProof(name, *_bounds(stated).get(name, (0.0, 0.0)), None, None, not failures) for name in names
    )
    return Proof(measures, tuple(failures), notes=("rms and counts are not proved without a source index",))


def lattice_radii(decoded: SplatModel, header: SceneHeader) -> F64:
    """Half the diagonal of each splat's lattice cell, and what rounding to float32 adds: how near its source lies."""
    step = header.attribute(_spec.ATTRIBUTE_MEANS).step
    radii = np.empty(len(decoded))
    for tile in header.tiles:
        rows = slice(tile.start, tile.start + tile.splat_count)
        radii[rows] = 0.87 * math.ldexp(step, tile.exponent)
        radii[rows] += np.abs(decoded.means[rows]).max(axis=1).astype(np.float64) * 2.0**-22
    return radii
