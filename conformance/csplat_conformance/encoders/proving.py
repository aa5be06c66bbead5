"""L3: what the errors that a file states are worth."""

from __future__ import annotations

from csplat.decoder import DecodedScene
from csplat_conformance.encoders.coarse import coarse_errors
from csplat_conformance.encoders.cut import find_cuts
from csplat_conformance.encoders.inputs import Input
from csplat_conformance.encoders.matching import Pairs
from csplat_conformance.encoders.verdict import Verdict, in_short
from csplat_conformance.report import Status
from csplat_conformance.stated import prove

_UNKNOWN = "which splat is which is not known"
_SILENT = "the file states no errors"


def judge_errors(one: Input, scene: DecodedScene, pairs: Pairs) -> tuple[Verdict, str]:
    """Judge L3: what is stated holds (SER-5); what is not stated is not proved.

    Args:
        one: the input.
        scene: the decoded scene.
        pairs: the source splat of each of its splats.

    Returns:
        The verdict, and why only pictures can judge the rest; nothing if they need not.
    """
    source = one.source() if one.source is not None else None
    if source is None or pairs.strays or pairs.surplus:
        return Verdict(Status.SKIPPED, _UNKNOWN), ""
    stated = scene.declared_bounds
    if stated is None:
        # An empty scene has no errors.
        return (Verdict(Status.NOT_PROVED, _SILENT), _SILENT) if len(scene.model) else (Verdict(Status.PASSED), "")
    proof = prove(source, scene.model, scene.header, stated, pairs.source_index)
    details = proof.as_json()["measures"]
    unproved = f"{', '.join(proof.unproved)}: fitted anew, nothing is stated" if proof.unproved else ""
    why = f"{', '.join(proof.unproved)} fitted anew" if proof.unproved and stated.refitted else ""
    if not proof.holds:
        return Verdict(Status.FAILED, in_short(proof.failures), proof.clauses, details=details), why
    coarse = coarse_errors(one, source, proof)
    warnings = [*coarse.values()]
    if len(scene.model) and not stated.refitted:  # refitted values differ on purpose
        names = frozenset(record.measure for record in stated.records) - coarse.keys()
        warnings += find_cuts(source, scene.model, scene.header, pairs.source_index, names)
    message = in_short((unproved,) * bool(unproved) + tuple(warnings))
    status = Status.NOT_PROVED if unproved else Status.WARNED if warnings else Status.PASSED
    return Verdict(status, message, details=details), why
