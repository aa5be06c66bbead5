# SPDX-License-Identifier: CC0-1.0
"""Verify the error bounds that a file declares against its source (spec 5.5).

With a source index, maximum, rms and counts are verified. Without it, each splat of the file must have a splat of the
source within the declared maxima; rms and counts are then not verified.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import DeclaredBounds, SceneHeader
from csplat.disk_files import finite_or_none
from csplat.model import SplatModel
from csplat.scene import Scene
from csplat.splat_file import SplatFile
from csplat.types import I64, Progress
from csplat_conformance.declared_bounds.measurement import (
    PairErrors,
    Source,
    check_source_index,
    find_wrong_extras,
    measure_names,
    measure_pairs,
    pair_differences,
)
from csplat_conformance.declared_bounds.partners import UNDECIDED, UNMATCHED, find_partners, lattice_radii
from csplat_conformance.declared_bounds.tile_pairs import measure_pairs_by_tile
from csplat_conformance.tolerance import bound_tolerance, is_valid_bound

#: Errors by measure that a file declares: (max, rms).
_Bounds = dict[str, tuple[float, float]]
#: The clause and a line about each contradiction.
_Contradictions = list[tuple[str, str]]

_SEARCHED_MAX, _SEARCHED_MIN = 100, 10  # splats without a partner for which to search the nearest source splats
_DISTANCES_MAX = 10**8  # approximate number of distances to compute for all of these splats
_NEAREST = 8  # source splats to compare with each of them
_NEEDS_INDEX = "rms and counts are not proved without a source index"


@dataclass(frozen=True)
class WorstSplat:
    """The splat with the largest error.

    Attributes:
        splat: index of the splat in the file.
        tile: index of its tile.
        source_splat: index of its source splat or, if that is unknown, of the nearest source splat.
        found: the error, in the measure's unit.
    """

    splat: int
    tile: int
    source_splat: int
    found: float


@dataclass(frozen=True)
class MeasureVerification:
    """The verification of one measure.

    Attributes:
        name: name in the registry of measures.
        declared_max, declared_rms: bounds in the file; `None` if it declares no bound of this measure.
        measured_max, measured_rms: errors of the pairs; `None` without a source index.
        holds: whether the bounds hold as far as checked; `None` if there are none, or if it is undecided.
        worst: the splat with the largest error. Without a source index, `None` unless a splat has no partner because
            of this measure.
    """

    name: str
    declared_max: float | None
    declared_rms: float | None
    measured_max: float | None
    measured_rms: float | None
    holds: bool | None
    worst: WorstSplat | None


@dataclass(frozen=True)
class BoundsVerification:
    """The result of verifying declared error bounds.

    Attributes:
        measures: in the order of the registry.
        failures: a line for each contradiction; empty if the bounds hold.
        clauses: the clauses of the spec that the failures violate.
        unverified: measures without a declared bound: refitted measures, or all.
        rms_verified: whether rms and counts were verified, too.
    """

    measures: tuple[MeasureVerification, ...] = ()
    failures: tuple[str, ...] = ()
    clauses: tuple[str, ...] = ()
    unverified: tuple[str, ...] = ()
    rms_verified: bool = False

    @property
    def holds(self) -> bool:
        """True if everything that could be checked holds."""
        return not self.failures

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines about what could not be verified."""
        notes = []
        if self.measures and not self.rms_verified:
            notes.append(_NEEDS_INDEX)
        if self.unverified:
            names = ", ".join(self.unverified)
            notes.append(f"not proved: {names}: the file declares no bounds for them, compare renders")
        return tuple(notes)

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values; errors that overflowed are `null`."""
        return {
            "rms_and_counts_verified": self.rms_verified and self.holds,
            "failures": list(self.failures),
            "unverified": list(self.unverified),
            "notes": list(self.notes),
            "measures": {
                measure.name: {
                    "declared_max": measure.declared_max,
                    "declared_rms": measure.declared_rms,
                    "measured_max": finite_or_none(measure.measured_max),
                    "measured_rms": finite_or_none(measure.measured_rms),
                    "holds": measure.holds,
                    "worst": measure.worst and {**vars(measure.worst), "found": finite_or_none(measure.worst.found)},
                }
                for measure in self.measures
            },
        }


def verify_bounds(
    source: Source,
    decoded: SplatModel,
    header: SceneHeader,
    declared: DeclaredBounds | None,
    source_index: NDArray[Any] | None = None,
    *,
    context: Context = DEFAULT_CONTEXT,
) -> BoundsVerification:
    """Verify the error bounds of a decoded file against its source.

    Args:
        source: the encoded scene.
        decoded: the decoded file.
        header: the file's header and index.
        declared: the error bounds of the file; `None` if it declares none.
        source_index: [N] integers, the source splat of each splat of the file; `None` if unknown.
        context: threads, and progress of the search for partners.

    Raises:
        InputError: `source_index` does not contain one index of a source splat for each splat of the file.
    """
    claims = _read_claims(measure_names(source, decoded), len(source), source.sh_degree, header, declared)
    if claims.contradictions:
        return _build_verification(claims)
    if source_index is not None:
        check_source_index(source_index, len(source), len(decoded))
        pairs = PairErrors(
            measure_pairs(source, decoded, source_index, context=context),
            find_wrong_extras(source, decoded, source_index),
            source.reach(decoded.origin),
        )
        return _verify_pairs(claims, header, pairs, source_index)
    if "means" not in claims.bounds:  # there is no search radius
        return _build_verification(replace(claims, unverified=claims.names if header.splat_count else ()))
    return _verify_without_index(claims, source, decoded, header, context)


def verify_bounds_by_tile(
    scene: Scene,
    opened: SplatFile,
    source_index: NDArray[Any],
    splats_max: int,
    *,
    context: Context = DEFAULT_CONTEXT,
) -> BoundsVerification:
    """Verify the error bounds of a file in bounded memory, with the result of `verify_bounds`.

    See `measure_pairs_by_tile` for the arguments and errors.
    """
    names = measure_names(scene.empty(), opened.empty())
    degree = scene.sh_degree
    claims = _read_claims(names, scene.count, degree, opened.header, opened.declared_bounds)
    if claims.contradictions:
        return _build_verification(claims)
    pairs = measure_pairs_by_tile(scene, opened, source_index, splats_max, context=context)
    return _verify_pairs(claims, opened.header, pairs, source_index)


@dataclass(frozen=True)
class _Claims:
    """The declared errors of a file.

    Attributes:
        names: measures that apply to file and source, in the order of the registry.
        bounds: (max, rms) by measure.
        unverified: measures without a declared bound.
        contradictions: contradictions that show without a comparison of splats.
    """

    names: tuple[str, ...]
    bounds: _Bounds
    unverified: tuple[str, ...]
    contradictions: _Contradictions


def _read_claims(
    names: Sequence[str], source_count: int, source_degree: int, header: SceneHeader, declared: DeclaredBounds | None
) -> _Claims:
    """Return the declared bounds with the contradictions that need no splats: SER-6, and SER-5 of count and degree.

    Args:
        names: measures that apply to file and source, in the order of the registry.
        source_count: splats of the source.
        source_degree: SH degree of the source.
        header: the file's header. A file without splats needs no bounds.
        declared: its error bounds; `None` if it declares none, which violates SER-6.
    """
    if declared is None:
        return _Claims(tuple(names), {}, tuple(names), [("SER-6", "the file declares no bounds")])
    bounds = {record.measure: (record.max, record.rms) for record in declared.records}
    unverified = tuple(name for name in names if name not in bounds) if header.splat_count else ()
    contradictions = []
    if source_count != declared.source_count:
        count = declared.source_count
        contradictions.append(("SER-5", f"the source has {source_count} splats, the file declares {count}"))
    if source_degree != declared.source_sh_degree:
        degree = declared.source_sh_degree
        contradictions.append(("SER-5", f"the source has SH degree {source_degree}, the file declares {degree}"))
    if not declared.refitted:
        contradictions += [("SER-6", f"the file declares no bound for {name}") for name in unverified]
    return _Claims(tuple(names), bounds, unverified, contradictions)


def _build_verification(
    claims: _Claims,
    measures: Sequence[MeasureVerification] = (),
    contradictions: _Contradictions | None = None,
    *,
    rms_verified: bool = False,
) -> BoundsVerification:
    """Return the result, with the measures in the order of the registry and each clause once.

    Without `contradictions`, the contradictions in `claims` are the failures.
    """
    contradictions = claims.contradictions if contradictions is None else contradictions
    clauses = tuple(dict.fromkeys(clause for clause, _ in contradictions))
    ordered = tuple(sorted(measures, key=lambda measure: claims.names.index(measure.name)))
    failures = tuple(line for _, line in contradictions)
    return BoundsVerification(ordered, failures, clauses, claims.unverified, rms_verified)


def _verify_pairs(
    claims: _Claims, header: SceneHeader, pairs: PairErrors, source_index: NDArray[Any]
) -> BoundsVerification:
    """Verify maximum, rms and extra columns of the pairs of a source index, [N] (SER-5, SRC-3).

    Measures without a declared bound are reported without a verdict.
    """
    bounds = claims.bounds
    measures: list[MeasureVerification] = []
    failures = [("SRC-3", line) for line in pairs.extras]
    for name, error in pairs.measured.items():
        worst = None
        if header.splat_count:
            splat = error.worst
            worst = WorstSplat(splat, tile_of(header, splat), int(source_index[splat]), error.max)
        if name not in bounds:
            measures.append(MeasureVerification(name, None, None, error.max, error.rms, None, worst))
            continue
        lines = find_contradictions(name, error[:2], bounds[name], pairs.reach, worst)
        failures += [("SER-5", line) for line in lines]
        measures.append(MeasureVerification(name, *bounds[name], error.max, error.rms, not lines, worst))
    return _build_verification(claims, measures, failures, rms_verified=bool(measures))


def find_contradictions(
    name: str, measured: tuple[float, float], declared: tuple[float, float], reach: float, worst: WorstSplat | None
) -> list[str]:
    """Return a line for each declared bound that is below the true error, or further above it than SER-5 allows.

    Args:
        name: name of the measure.
        measured: (max, rms) as measured.
        declared: (max, rms) as in the file.
        reach: see `bound_tolerance`.
        worst: the splat with the largest error.
    """
    lines = []
    for kind, true, bound in zip(("max", "rms"), measured, declared, strict=True):
        if is_valid_bound(name, bound, true, reach):
            continue
        line = f"{name}: {kind} {true:.9g} is {'above' if bound < true else 'well below'} the declared {bound:.9g}"
        if kind == "max" and worst is not None:
            line += f": splat {worst.splat} (tile {worst.tile}), source splat {worst.source_splat}"
        lines.append(line)
    return lines


def tile_of(header: SceneHeader, splat: int) -> int:
    """Return the index of the tile that holds a splat."""
    starts = [tile.start for tile in header.tiles]
    return int(np.searchsorted(starts, splat, "right")) - 1


# Without a source index ----------------------------------------------------------------------------


def _verify_without_index(
    claims: _Claims, source: Source, decoded: SplatModel, header: SceneHeader, context: Context
) -> BoundsVerification:
    """Verify that each splat has a splat of the source within the declared maxima (SER-5).

    A file with undecided splats fails, too. The worst errors are searched for the first splats without a partner only.
    """
    bounds = claims.bounds
    declared_maxima = {name: pair[0] for name, pair in bounds.items()}
    partners = find_partners(source, decoded, declared_maxima, lattice_radii(decoded, header), context=context)
    unmatched = np.flatnonzero(partners == UNMATCHED)
    undecided_count = int(np.count_nonzero(partners == UNDECIDED))
    lines = []
    if undecided_count:
        lines.append(f"{undecided_count} splats have too many similar splats in the source: specify a source index")
    worst: dict[str, WorstSplat] = {}
    searched_count = min(_SEARCHED_MAX, max(_SEARCHED_MIN, _DISTANCES_MAX // max(1, len(source))))
    if len(unmatched):
        worst = _find_worst_splats(
            source, decoded, header, declared_maxima, unmatched[:searched_count], context.progress
        )
        many = f"{len(unmatched)} splats of the file have" if len(unmatched) > 1 else "1 splat of the file has"
        lines.append(f"{many} no splat of the source within the declared maxima")
        lines += [
            f"{name}: {splat.found:.9g} is above the declared {declared_maxima[name]:.9g}: splat {splat.splat}"
            f" (tile {splat.tile}), nearest source splat {splat.source_splat}"
            for name, splat in worst.items()
        ]
    # It is unknown which bounds the other splats without a partner exceed.
    holds_otherwise = None if len(unmatched) > searched_count else True
    measures = [
        MeasureVerification(
            name,
            *bounds[name],
            measured_max=None,
            measured_rms=None,
            holds=False if name in worst else holds_otherwise,
            worst=worst.get(name),
        )
        for name in bounds
    ]
    return _build_verification(claims, measures, [("SER-5", line) for line in lines])


def _find_worst_splats(
    source: Source,
    decoded: SplatModel,
    header: SceneHeader,
    bounds: Mapping[str, float],
    rows: I64,
    progress: Progress,
) -> dict[str, WorstSplat]:
    """Return the splat of `rows`, [n], with the largest error, for each measure whose bound one of them exceeds.

    Each splat is compared with whichever nearby source splat exceeds the fewest bounds. Without source splats, there is
    no result.
    """
    worst: dict[str, WorstSplat] = {}
    if not len(source):
        return worst
    reach, source = source.reach(decoded.origin), source.about(decoded.origin)
    means = source.means.astype(np.float64)
    for done, row in enumerate(rows.tolist()):
        progress("searching the nearest splats", done / len(rows))
        near = _nearest_points(means, decoded.means[row])
        errors = pair_differences(source, decoded, near, np.full(len(near), row))
        largest = {name: np.abs(errors[name]).max(axis=1) for name in bounds if name in errors}
        beyond = np.stack(
            [largest[name] > bounds[name] + bound_tolerance(name, bounds[name], reach) for name in largest]
        )
        best = int(beyond.sum(axis=0).argmin())  # row of `near`
        for name, is_beyond in zip(largest, beyond[:, best].tolist(), strict=True):
            error = float(largest[name][best])
            if is_beyond and (name not in worst or error > worst[name].found):
                worst[name] = WorstSplat(row, tile_of(header, row), int(near[best]), error)
    return worst


def _nearest_points(means: NDArray[np.float64], point: NDArray[np.float32]) -> I64:
    """Return the indices of the `_NEAREST` centres of `means`, [M, 3], nearest to a point, [3], the nearest first.

    There are fewer if M is smaller.
    """
    with np.errstate(over="ignore"):
        distances = np.square(means - point).sum(axis=1)
    nearest = np.argpartition(distances, min(_NEAREST, len(means) - 1))[:_NEAREST]
    ascending: I64 = nearest[np.argsort(distances[nearest], kind="stable")]
    return ascending
