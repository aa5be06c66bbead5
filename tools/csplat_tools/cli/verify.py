"""`csplat verify`."""

from __future__ import annotations

import math
from typing import Annotated, Any

import typer

from csplat.errors import CsplatError
from csplat_conformance.validator import Validation
from csplat_tools.cli.console import FAILED, guarded
from csplat_tools.files.console import format_table, note, progress_bar, say, say_json
from csplat_tools.inspect.proof import MeasureProof, Proof
from csplat_tools.inspect.verify import Verified, validation_as_json, verify_file

__all__ = ["verify"]


@guarded
def verify(
    path: Annotated[str, typer.Argument(metavar="F.csplat", help="A .csplat file, or - for standard input.")],
    source: Annotated[
        str | None, typer.Option(metavar="IN.ply", help="The PLY it was made from: prove the stated errors.")
    ] = None,
    source_index: Annotated[
        str | None, typer.Option(metavar="FILE.npy", help="What `encode --source-index` wrote: prove all.")
    ] = None,
    max_splats: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Refuse a scene of more splats; 2^25 by default with --source."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Let the status speak.")] = False,
) -> None:
    """Check a file against every clause of the format, and its stated errors.

    Lists all violations, not only the first: clause, error code, byte,
    field. The validator shares no code with the decoder. With --source, each
    splat of the file must have a splat of the PLY within the stated maxima.
    With --source-index it is known which one, and rms and counts are proved
    as well.

    Examples:
      csplat verify scene.csplat
      csplat verify scene.csplat --source scene.ply
      csplat verify scene.csplat --source scene.ply --source-index scene.npy --json
    """
    if source_index is not None and source is None:
        raise typer.BadParameter("--source-index says nothing without --source")
    try:
        with progress_bar(quiet=quiet) as progress:
            verified = verify_file(path, source, source_index, max_splats=max_splats, progress=progress)
    except CsplatError as error:
        if as_json:
            say_json({"holds": False, "error": {"code": error.code, "message": str(error)}})
        raise
    if as_json:
        say_json(_as_json(verified))
    elif not quiet:
        _report(verified)
    if not verified.holds:
        _say_why(verified, path, unproved=source is not None and verified.proof is None)
        raise typer.Exit(FAILED)


def _say_why(verified: Verified, path: str, *, unproved: bool) -> None:
    violations = verified.validation.violations
    if violations:
        clauses = sorted({one.clause for one in violations})
        many = "1 violation" if len(violations) == 1 else f"{len(violations)} violations"
        note(f"error: {path}: {many} of {', '.join(clauses)}")
    if unproved:
        note("error: the stated errors were not looked at")
    for failure in verified.proof.failures if verified.proof is not None else ():
        note(f"error: {failure}")


def _report(verified: Verified) -> None:
    _report_validation(verified.validation)
    proof = verified.proof
    if proof is None:
        return
    if proof.measures:
        say(_table(proof))
    for remark in proof.notes:
        say(remark)
    if proof.holds:
        say("the stated errors hold" if proof.rms_proved else "the stated maxima hold")


def _report_validation(validation: Validation) -> None:
    for one in (*validation.violations, *validation.unread):
        say(str(one))
    for remark in validation.remarks:
        say(f"remark: {remark}")
    if validation.conforms:
        say(f"intact: {validation.splat_count} splats; checked: {', '.join(validation.checks)}")


def _table(proof: Proof) -> str:
    if proof.rms_proved:
        header = ("error", "stated max", "found max", "stated rms", "found rms", "")
        rows = [
            (one.name, *map(_number, (one.stated_max, one.measured_max, one.stated_rms, one.measured_rms)), _word(one))
            for one in proof.measures
        ]
        return format_table(header, rows)
    return format_table(("error", "stated max"), [(one.name, _number(one.stated_max)) for one in proof.measures])


def _word(measure: MeasureProof) -> str:
    return "holds" if measure.holds else "FAILS"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}"


def _as_json(verified: Verified) -> dict[str, Any]:
    proof = verified.proof
    return {
        "holds": verified.holds,
        **validation_as_json(verified.validation),
        "proof": None if proof is None else _proof_as_json(proof),
    }


def _proof_as_json(proof: Proof) -> dict[str, Any]:
    return {
        "rms_and_counts_proved": proof.rms_proved and proof.holds,
        "failures": list(proof.failures),
        "notes": list(proof.notes),
        "measures": {
            one.name: {
                "stated_max": one.stated_max,
                "stated_rms": one.stated_rms,
                "measured_max": _finite(one.measured_max),
                "measured_rms": _finite(one.measured_rms),
                "holds": one.holds,
            }
            for one in proof.measures
        },
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
