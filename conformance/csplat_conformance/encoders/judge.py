"""L1 and L2 of one file that an encoder wrote: is it valid, and does it hold what its source does."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from csplat import _spec
from csplat.decoder import DecodedScene, decode_scene
from csplat.errors import CsplatError
from csplat.model import UNSPECIFIED, SplatModel
from csplat_conformance.encoders.coarse import coarse_pruning
from csplat_conformance.encoders.inputs import Input
from csplat_conformance.encoders.mapping import check_index
from csplat_conformance.encoders.matching import Pairs, pair
from csplat_conformance.encoders.verdict import Verdict, Wrong, failed
from csplat_conformance.report import Status
from csplat_conformance.stated import Source, wrong_extras
from csplat_conformance.validator import validate

_CUT_SHORT = frozenset((_spec.ERROR_TRUNCATED,))
_SHOWN = 3


def judge_stream(data: bytes) -> tuple[Verdict, DecodedScene | None]:
    """L1: no clause is broken (CNF-1, CNF-5); and the scene, if so."""
    if not data:
        return Verdict(Status.PARTIAL_OUTPUT, "an empty file"), None
    validation = validate(data)
    found = validation.violations
    if found:
        clauses = tuple(dict.fromkeys(one.clause for one in found))
        cut = {one.code for one in found} <= _CUT_SHORT
        rest = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
        message = "; ".join(map(str, found[:_SHOWN])) + rest
        status = Status.PARTIAL_OUTPUT if cut else Status.FAILED
        return Verdict(status, message, clauses, found[0].code), None
    try:
        scene = decode_scene(data)
    except (
        CsplatError
    ) as error:  # the validator finds nothing: one of the two is wrong, and this is the place to see it
        return Verdict(Status.FAILED, f"csplat's decoder refuses it: {error}", (), error.code), None
    return Verdict(Status.PASSED, "; ".join(validation.remarks), details={"bytes": len(data)}), scene


def judge_content(one: Input, source: Source, scene: DecodedScene, index: Path | None) -> tuple[Verdict, Pairs]:
    """L2: each splat of the source once, or counted as pruned; facts that the source does not know are not stated.

    Args:
        one: the input.
        source: the scene of the input.
        scene: the decoded scene.
        index: the encoder's own source index, `None` if none was asked for.

    Returns:
        The verdict, and which splat of the source each of the file is: by the encoder's own index, if it is right.
    """
    decoded = scene.model
    centres = decoded.means.astype(np.float64) + np.subtract(decoded.origin, source.origin)
    pairs = pair(source.means.astype(np.float64), centres, one.apart)
    details = {"splats": len(decoded), "source_splats": len(source), "missing": pairs.missing}
    wrong = [*_wrong_splats(one, pairs), *_wrong_counts(source, scene, pairs), *_wrong_facts(source, decoded)]
    if index is not None:
        pairs, wrong_numbers = check_index(index, source, len(decoded), pairs)
        details["source_index"] = not wrong_numbers
        wrong += wrong_numbers
    if pairs.strays == pairs.surplus == 0:
        wrong += [("SRC-3", line) for line in wrong_extras(source, decoded, pairs.source_index)]
    if wrong:
        return failed(wrong, details), pairs
    coarse = coarse_pruning(pairs.missing, len(source))
    remark = f"{pairs.missing} splats pruned" if pairs.missing else ""
    return Verdict(Status.WARNED if coarse else Status.PASSED, coarse or remark, details=details), pairs


def _wrong_splats(one: Input, pairs: Pairs) -> list[Wrong]:
    wrong = []
    if pairs.strays:
        far = f"not within {one.apart / 2.0:g} of a splat of the source"
        wrong.append(("CNF-6", f"{_many(pairs.strays, pairs.examples[0])} {far}"))
    if pairs.surplus:
        many = _many(pairs.surplus, pairs.examples[1])
        wrong.append(("CNF-6", f"{many} near a splat of the source that another stands for already"))
    return wrong


def _many(count: int, first: int) -> str:
    return (
        f"splat {first} of the file is" if count == 1 else f"{count} splats of the file, the first splat {first}, are"
    )


def _wrong_counts(source: Source, scene: DecodedScene, pairs: Pairs) -> list[Wrong]:
    stated = scene.declared_bounds
    if stated is None:
        text = f"{pairs.missing} splats of the source are missing, and nothing says so"
        return [("SER-5", text)] if pairs.missing else []
    wrong = []
    if stated.source_count != len(source):
        wrong.append(("SRC-1", f"a source of {stated.source_count} splats is stated, it has {len(source)}"))
    elif stated.pruned_count != pairs.missing:
        wrong.append(("SER-5", f"{stated.pruned_count} pruned splats are stated, {pairs.missing} are missing"))
    if stated.source_sh_degree != source.sh_degree:
        text = f"a source of SH degree {stated.source_sh_degree} is stated, it has {source.sh_degree}"
        wrong.append(("SER-5", text))
    return wrong


def _wrong_facts(source: Source, decoded: SplatModel) -> list[Wrong]:
    """A PLY does not specify axes, unit and filters: an encoder that states them has guessed."""
    facts = {
        "axes": (decoded.coordinate_system, UNSPECIFIED),
        "unit_metres": (decoded.unit_metres, None),
        "antialiased": (decoded.antialiased, False),
        "flat": (decoded.flat, False),
    }
    wrong = [
        ("SRC-3", f"{name} is {found}, of which the source says nothing")
        for name, (found, wanted) in facts.items()
        if found != wanted
    ]
    if decoded.sh_degree > source.sh_degree:
        wrong.append(("SRC-3", f"SH degree {decoded.sh_degree}, the source has {source.sh_degree}"))
    return wrong
