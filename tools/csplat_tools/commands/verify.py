"""`csplat verify`."""

from __future__ import annotations

import math
from typing import Annotated, Any

import typer

from csplat.errors import CsplatError, FormatError
from csplat_tools.console import FAILED, format_table, guarded, note, progress_bar, say, say_json
from csplat_tools.convert import Verified, verify_file
from csplat_tools.proof import MeasureProof, Proof

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
        int | None, typer.Option(metavar="N", min=1, help="Refuse a scene of more splats; 2^25 by default.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Let the status speak.")] = False,
) -> None:
    """Check a file: every checksum, the digest, every value; and its stated errors.

    With --source, each splat of the file must have a splat of the PLY within
    the stated maxima. With --source-index it is known which one, and rms and
    counts are proved as well.

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
            say_json({"holds": False, "error": _error(error)})
        raise
    if as_json:
        say_json(_as_json(verified))
    elif not quiet:
        _report(verified)
    if verified.proof is not None and not verified.proof.holds:
        for failure in verified.proof.failures:
            note(f"error: {failure}")
        raise typer.Exit(FAILED)


def _report(verified: Verified) -> None:
    say(f"intact: {verified.splat_count} splats; checked: {', '.join(verified.checks)}")
    proof = verified.proof
    if proof is None:
        return
    if proof.measures:
        say(_table(proof))
    for remark in proof.notes:
        say(remark)
    if proof.holds:
        say("the stated errors hold" if proof.rms_proved else "the stated maxima hold")


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
        "holds": proof is None or proof.holds,
        "splats": verified.splat_count,
        "checks": list(verified.checks),
        "proof": None
        if proof is None
        else {
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
        },
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _error(error: CsplatError) -> dict[str, Any]:
    described: dict[str, Any] = {"code": error.code, "message": str(error)}
    if isinstance(error, FormatError):
        described |= {"offset": error.offset, "clause": error.clause}
    return described
