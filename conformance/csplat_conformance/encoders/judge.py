"""What is made of one file that an encoder wrote: is it valid, whole, honest, and how does it look."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from csplat import _spec
from csplat.decoder import Scene, decode_scene
from csplat.errors import CsplatError
from csplat.model import UNSPECIFIED, SplatModel
from csplat_conformance.encoders.inputs import Input
from csplat_conformance.encoders.matching import Pairs, pair
from csplat_conformance.report import Status
from csplat_conformance.stated import Source, prove
from csplat_conformance.validator import validate

__all__ = ["PictureJudge", "Verdict", "judge_content", "judge_errors", "judge_pictures", "judge_stream"]

#: PSNR in dB of a decoded scene against its source; the source comes first.
PictureJudge = Callable[[SplatModel, SplatModel], float]

_CUT_SHORT = frozenset((_spec.ERROR_TRUNCATED,))
_SHOWN = 3


@dataclass(frozen=True)
class Verdict:
    """What one level says.

    Attributes:
        status: passed or not.
        message: why, or a remark.
        clauses: that are broken.
        code: of the first violation.
        details: numbers, for programs.
    """

    status: Status
    message: str = ""
    clauses: tuple[str, ...] = ()
    code: str = ""
    details: dict[str, Any] = field(default_factory=dict)


def judge_stream(data: bytes) -> tuple[Verdict, Scene | None]:
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


def judge_content(one: Input, source: Source, scene: Scene) -> tuple[Verdict, Pairs]:
    """L2: each splat of the source once, or counted as pruned; facts that the source does not know are not stated."""
    decoded = scene.model
    centres = decoded.means.astype(np.float64) + np.subtract(decoded.origin, source.origin)
    pairs = pair(source.means.astype(np.float64), centres, one.apart)
    details = {"splats": len(decoded), "source_splats": len(source), "missing": pairs.missing}
    wrong = [*_wrong_splats(one, pairs), *_wrong_counts(source, scene, pairs), *_wrong_facts(source, decoded)]
    if pairs.strays == pairs.surplus == 0:
        wrong += _wrong_extras(source, decoded, pairs)
    if wrong:
        clauses = tuple(dict.fromkeys(clause for clause, _ in wrong))
        return Verdict(Status.FAILED, "; ".join(text for _, text in wrong), clauses, details=details), pairs
    remark = f"{pairs.missing} splats pruned" if pairs.missing else ""
    return Verdict(Status.PASSED, remark, details=details), pairs


def _wrong_splats(one: Input, pairs: Pairs) -> list[tuple[str, str]]:
    wrong = []
    if pairs.strays:
        near = f"{one.apart / 2.0:g}"
        wrong.append(("CNF-6", f"{pairs.strays} splats of the file are not within {near} of a splat of the source"))
    if pairs.surplus:
        wrong.append(("CNF-6", f"{pairs.surplus} splats of the file stand for one that another stands for already"))
    return wrong


def _wrong_counts(source: Source, scene: Scene, pairs: Pairs) -> list[tuple[str, str]]:
    stated = scene.stated_errors
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


def _wrong_facts(source: Source, decoded: SplatModel) -> list[tuple[str, str]]:
    """A PLY says nothing of axes, unit and filters: a file that does has guessed."""
    facts = {
        "axes": (decoded.coordinate_system, UNSPECIFIED),
        "unit_metres": (decoded.unit_metres, None),
        "antialiased": (decoded.antialiased, False),
        "flat": (decoded.flat, False),
    }
    wrong = [
        ("CNF-6", f"{name} is {found}, of which the source says nothing")
        for name, (found, wanted) in facts.items()
        if found != wanted
    ]
    if decoded.sh_degree > source.sh_degree:
        wrong.append(("CNF-6", f"SH degree {decoded.sh_degree}, the source has {source.sh_degree}"))
    return wrong


def _wrong_extras(source: Source, decoded: SplatModel, pairs: Pairs) -> list[tuple[str, str]]:
    wrong = []
    for name, column in decoded.extra.items():
        other = source.extra.get(name)
        if other is None or column.tobytes() != other[pairs.source_index].astype(column.dtype).tobytes():
            wrong.append(("CNF-6", f"the extra column {name!r} is not the source's"))
    return wrong


def judge_errors(source: Source, scene: Scene, pairs: Pairs) -> Verdict:
    """L3: the stated errors hold (SER-5)."""
    if pairs.strays or pairs.surplus:
        return Verdict(Status.SKIPPED, "which splat is which is not known")
    if scene.stated_errors is None:
        return Verdict(Status.SKIPPED, "the file states no errors")
    proof = prove(source, scene.model, scene.header, scene.stated_errors, pairs.source_index)
    details = proof.as_json()["measures"]
    if not proof.holds:
        return Verdict(Status.FAILED, "; ".join(proof.failures), ("SER-5",), details=details)
    return Verdict(Status.PASSED, "; ".join(proof.notes), details=details)


def judge_pictures(one: Input, source: Source, scene: Scene, pictures: PictureJudge, psnr_min: float) -> Verdict:
    """L4: renders of the file look like those of the source."""
    if not one.renders:
        return Verdict(Status.SKIPPED, "pictures of this scene say nothing")
    psnr = pictures(source.model(scene.model.origin), scene.model)
    details = {"psnr": psnr}
    wanted = one.psnr_wanted(psnr_min)
    if psnr < wanted:
        return Verdict(Status.FAILED, f"{psnr:.2f} dB, wanted {wanted:g} at least", details=details)
    return Verdict(Status.PASSED, f"{psnr:.2f} dB", details=details)
