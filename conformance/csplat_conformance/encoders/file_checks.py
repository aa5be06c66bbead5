# SPDX-License-Identifier: CC0-1.0
"""Check that a file of an encoder is valid (L1) and contains its source (L2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder import DecodedScene, decode_scene
from csplat.disk_files import read_array
from csplat.errors import CsplatError, InputError
from csplat.model import SplatModel
from csplat.scene_metadata import SRGB, UNSPECIFIED
from csplat.types import F64, I64
from csplat_conformance.conformance_report import Status
from csplat_conformance.declared_bounds import Source, check_source_index, find_wrong_extras
from csplat_conformance.encoders.encoder_inputs import EncoderInput
from csplat_conformance.encoders.encoder_run import Defect, Verdict, failed_verdict
from csplat_conformance.validator import validate

_PRUNED_MAX = 0.25  # fraction of the splats; pruning more causes a warning
_TRUNCATION = frozenset((_spec.ERROR_TRUNCATED,))
_VIOLATIONS_MAX = 3  # to mention in a message


def check_stream(data: bytes) -> tuple[Verdict, DecodedScene | None]:
    """Check L1: the file violates no clause (CNF-1, CNF-5). Return the verdict, and the scene if it passes."""
    if not data:
        return Verdict(Status.PARTIAL_OUTPUT, "the file is empty"), None
    validation = validate(data)
    violations = validation.violations
    if violations:
        clauses = tuple(dict.fromkeys(violation.clause for violation in violations))
        cut = {violation.code for violation in violations} <= _TRUNCATION
        remainder = f" and {len(violations) - _VIOLATIONS_MAX} more" if len(violations) > _VIOLATIONS_MAX else ""
        message = "; ".join(map(str, violations[:_VIOLATIONS_MAX])) + remainder
        status = Status.PARTIAL_OUTPUT if cut else Status.FAILED
        return Verdict(status, message, clauses, violations[0].code), None
    try:
        scene = decode_scene(data)
    except CsplatError as error:  # a defect of the validator or of the decoder
        return Verdict(Status.FAILED, f"csplat's decoder refuses it: {error}", (), error.code), None
    return Verdict(Status.PASSED, "; ".join(validation.remarks), details={"bytes": len(data)}), scene


def check_content(
    case: EncoderInput, source: Source, scene: DecodedScene, index: Path | None
) -> tuple[Verdict, SplatPairs]:
    """Check L2: each splat of the source is present once or counted as pruned, and no metadata is guessed.

    Args:
        case: the input.
        source: the scene of the input.
        scene: the decoded scene.
        index: path of the encoder's source index, `None` if the command has no placeholder for it.

    Returns:
        The verdict, and the pairs of splats: by the encoder's index if it is correct.
    """
    decoded = scene.model
    centres = decoded.means.astype(np.float64) + np.subtract(decoded.origin, source.origin)
    pairs = pair_splats(source.means.astype(np.float64), centres, case.separation)
    details = {"splats": len(decoded), "source_splats": len(source), "missing": pairs.missing}
    wrong = [
        *_find_unpaired(case, pairs),
        *_find_wrong_counts(source, scene, pairs),
        *_find_guessed_metadata(source, decoded),
    ]
    if index is not None:
        pairs, wrong_numbers = check_index(index, source, len(decoded), pairs)
        details["source_index"] = not wrong_numbers
        wrong += wrong_numbers
    if pairs.strays == pairs.surplus == 0:
        wrong += [("SRC-3", line) for line in find_wrong_extras(source, decoded, pairs.source_index)]
    if wrong:
        return failed_verdict(wrong, details), pairs
    if pairs.missing > _PRUNED_MAX * len(source):
        return Verdict(Status.WARNED, f"{pairs.missing} of {len(source)} splats pruned", details=details), pairs
    remark = f"{pairs.missing} splats pruned" if pairs.missing else ""
    return Verdict(Status.PASSED, remark, details=details), pairs


def _find_unpaired(case: EncoderInput, pairs: SplatPairs) -> list[Defect]:
    """Return a defect for splats far from the source, and a defect for splats near a represented splat."""
    wrong = []
    if pairs.strays:
        far = f"not within {case.separation / 2.0:g} of a splat of the source"
        wrong.append(("CNF-6", f"{_count_text(pairs.strays, pairs.examples[0])} {far}"))
    if pairs.surplus:
        many = _count_text(pairs.surplus, pairs.examples[1])
        wrong.append(("CNF-6", f"{many} near a splat of the source that another splat already represents"))
    return wrong


def _count_text(count: int, first: int) -> str:
    """Return the subject and verb of a message about `count` splats, at least 1, of which `first` is the first."""
    return (
        f"splat {first} of the file is" if count == 1 else f"{count} splats of the file, the first splat {first}, are"
    )


def _find_wrong_counts(source: Source, scene: DecodedScene, pairs: SplatPairs) -> list[Defect]:
    """Compare the declared counts and SH degree with the source, and the pruned count with the missing splats.

    Without declared bounds, missing splats are a defect.
    """
    declared = scene.declared_bounds
    if declared is None:
        text = f"{pairs.missing} splats of the source are missing, and the file does not declare it"
        return [("SER-5", text)] if pairs.missing else []
    wrong = []
    if declared.source_count != len(source):
        wrong.append(("SRC-1", f"the declared source_count is {declared.source_count}, expected {len(source)}"))
    elif declared.pruned_count != pairs.missing:
        wrong.append(("SER-5", f"the declared pruned_count is {declared.pruned_count}, expected {pairs.missing}"))
    if declared.source_sh_degree != source.sh_degree:
        text = f"the declared source_sh_degree is {declared.source_sh_degree}, expected {source.sh_degree}"
        wrong.append(("SER-5", text))
    return wrong


def _find_guessed_metadata(source: Source, decoded: SplatModel) -> list[Defect]:
    """Return a defect for axes, unit and flags that are set, since a PLY does not specify them, and for extra bands."""
    facts = {
        "axes": (decoded.metadata.coordinate_system, UNSPECIFIED),
        "unit_metres": (decoded.metadata.unit_metres, None),
        "antialiased": (decoded.metadata.antialiased, False),
        "flat": (decoded.metadata.flat, False),
        "colour_space": (decoded.metadata.colour_space, SRGB),
    }
    wrong = [
        ("SRC-3", f"{name} is {value}, but the source does not specify it")
        for name, (value, expected) in facts.items()
        if value != expected
    ]
    if decoded.sh_degree > source.sh_degree:
        wrong.append(("SRC-3", f"the SH degree is {decoded.sh_degree}, but the source has {source.sh_degree}"))
    return wrong


_INDEX_CLAUSE = "SRC-4"


def check_index(path: Path, source: Source, count: int, pairs: SplatPairs) -> tuple[SplatPairs, list[Defect]]:
    """Compare an encoder's source index with the pairs of nearby splats (SRC-4).

    Args:
        path: the .npy file.
        source: the encoded scene.
        count: splats of the file.
        pairs: pairs by position.

    Returns:
        The pairs, with the encoder's index if it is correct; and the defects of the index.
    """
    if not path.exists():
        return pairs, [(_INDEX_CLAUSE, "no source index was written")]
    try:
        stored = read_array(path)
        check_source_index(stored, len(source), count)
    except (InputError, OSError) as error:
        return pairs, [(_INDEX_CLAUSE, str(error).replace(str(path), "the source index"))]
    index = stored.astype(np.int64)
    paired = np.flatnonzero(pairs.source_index >= 0)
    near = pairs.source_index[paired]
    # Only the encoder can distinguish splats with equal centres.
    off = paired[(source.means[index[paired]] != source.means[near]).any(axis=1)]
    if len(off):
        text = (
            f"the source index of splat {off[0]} is {index[off[0]]}, but the nearest source splat is"
            f" {pairs.source_index[off[0]]} ({len(off)} of {count} numbers of the index are wrong)"
        )
        return pairs, [(_INDEX_CLAUSE, text)]
    return replace(pairs, source_index=index) if len(paired) == count else pairs, []


_NONE = -1  # index of no splat
_CELL_MAX = 2.0**40  # cells from the origin; centres beyond share a cell, which only costs comparisons
_HASH_SHIFT = np.uint64(29)  # bits; brings high bits down, which a product does not
#: Odd constants of well-mixed bits, by axis.
_HASH_FACTORS = (np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F), np.uint64(0x165667B19E3779F9))


@dataclass(frozen=True)
class SplatPairs:
    """Pairs of decoded splats and source splats.

    Attributes:
        source_index: [N], source splat of each decoded splat; −1 if none is near.
        strays: number of decoded splats without a source splat.
        surplus: number of decoded splats whose source splat is paired with another decoded splat.
        missing: number of source splats without a decoded splat.
        examples: first decoded splat of `strays` and of `surplus`; −1 if there is none.
    """

    source_index: I64
    strays: int
    surplus: int
    missing: int
    examples: tuple[int, int] = (_NONE, _NONE)


def pair_splats(source: F64, decoded: F64, separation: float) -> SplatPairs:
    """Pair splats by their centres.

    Args:
        source: [M, 3] centres. Distinct centres are at least `separation` apart. Equal centres are duplicates, which
            are paired one by one.
        decoded: [N, 3] centres.
        separation: distance; a decoded splat belongs to the source centre that is nearer than half of it.
    """
    if not len(source) or not len(decoded):
        first_stray = 0 if len(decoded) else _NONE
        return SplatPairs(np.full(len(decoded), _NONE, np.int64), len(decoded), 0, len(source), (first_stray, _NONE))
    centres, member_of, counts = np.unique(source, axis=0, return_inverse=True, return_counts=True)
    group = _find_nearest(centres, decoded, separation)
    members = np.argsort(member_of.reshape(-1), kind="stable")
    first = np.concatenate([[0], np.cumsum(counts)])
    index = np.full(len(decoded), _NONE, np.int64)
    near = np.flatnonzero(group != _NONE)
    order = near[np.argsort(group[near], kind="stable")]
    groups = group[order]
    # The first splats near a centre are paired with the source splats at that centre; those beyond them are surplus.
    rank = np.arange(len(order)) - np.searchsorted(groups, groups, "left")
    taken = rank < counts[groups]
    index[order[taken]] = members[first[groups[taken]] + rank[taken]]
    paired = int(taken.sum())
    examples = _first_index(group == _NONE), _first_index((group != _NONE) & (index == _NONE))
    return SplatPairs(index, len(decoded) - len(near), len(near) - paired, len(source) - paired, examples)


def _first_index(mask: NDArray[np.bool_]) -> int:
    """Return the index of the first True, or −1 if there is none."""
    return int(mask.argmax()) if mask.any() else _NONE


def _find_nearest(centres: F64, decoded: F64, separation: float) -> I64:
    """Return [N], for each decoded centre the source centre that is nearer than half of `separation`, or −1."""
    keys = _hash_cells(_locate_cells(centres, separation))
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    own = _locate_cells(decoded, separation)
    nearest = np.full(len(decoded), _NONE, np.int64)
    open_rows = np.arange(len(decoded))  # without a source centre so far
    # A splat's own cell comes first, because it is sufficient for most splats.
    for step in sorted(product((-1, 0, 1), repeat=3), key=lambda step: sum(map(abs, step))):
        probes = _hash_cells(own[open_rows] + np.array(step, np.int64))
        first, last = np.searchsorted(keys, probes, "left"), np.searchsorted(keys, probes, "right")
        # A cell has few centres, because its side is their smallest distance.
        for nth in range(int((last - first).max(initial=0))):
            more = first + nth < last
            rows, candidates = open_rows[more], order[first[more] + nth]
            moved = decoded[rows] - centres[candidates]
            near = np.sqrt(np.square(moved).sum(axis=1)) < separation / 2.0
            nearest[rows[near]] = candidates[near]
        open_rows = open_rows[nearest[open_rows] == _NONE]
    return nearest


def _locate_cells(points: F64, side: float) -> I64:
    """Return the cells of points, both [n, 3]; a coordinate that is NaN is in cell 0."""
    with np.errstate(over="ignore", invalid="ignore"):
        cells = np.clip(np.floor(points / side), -_CELL_MAX, _CELL_MAX)
    result: I64 = np.nan_to_num(cells).astype(np.int64)
    return result


def _hash_cells(cells: I64) -> NDArray[np.uint64]:
    """Hash cells, [n, 3]. A collision only costs a comparison."""
    keys = np.zeros(len(cells), np.uint64)
    for axis, factor in enumerate(_HASH_FACTORS):
        keys ^= cells[:, axis].astype(np.uint64) * factor
        keys ^= keys >> _HASH_SHIFT
    return keys
