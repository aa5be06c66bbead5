"""`csplat verify`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat.errors import CsplatError, counted
from csplat_conformance.declared_bounds import BoundsVerification, MeasureVerification
from csplat_tools.cli.command_output import Output
from csplat_tools.cli.error_lines import EXIT_FAILED
from csplat_tools.cli.shared_options import (
    Force,
    HelpAll,
    Json,
    MaxSplats,
    Quiet,
    Report,
    SourceIndexInput,
    require_one,
)
from csplat_tools.console import format_table, note
from csplat_tools.inspect.verification import Verification, verify_file


def verify(
    path: Annotated[str, typer.Argument(metavar="F.csplat", help="A .csplat file, or - for standard input.")],
    source: Annotated[
        str | None, typer.Option(metavar="IN.ply", help="Source: verify the declared errors, too.")
    ] = None,
    source_index: SourceIndexInput = None,
    max_splats: MaxSplats = None,
    force: Force = False,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
    _all: HelpAll = False,
) -> None:
    """Check a file against the format, and its declared errors.

    Lists all violations: clause, error code, byte, field. With --source,
    each splat of the file must have a splat of the PLY within the declared
    maxima. With --source-index the pairs are known, and RMS errors and
    counts are verified as well. Large scenes are verified on the disk, in a
    temporary file of the size of the PLY (TMPDIR).

    Examples:
      csplat verify scene.csplat
      csplat verify scene.csplat --source scene.ply
      csplat verify scene.csplat --source scene.ply --source-index scene.npy
    """
    out = Output(force, report, as_json, quiet)
    require_one({"--source-index": source_index}, {"--source": source})
    out.check(inputs=(path, source, source_index))
    try:
        with out.bar() as progress:
            verified = verify_file(path, source, source_index, max_splats=max_splats, progress=progress)
    except CsplatError as error:
        out.publish({"holds": False, "error": {"code": error.code, "message": str(error)}})
        raise
    out.publish(verified.as_json(), "" if out.quiet else _report(verified))
    if not verified.holds:
        _print_reasons(verified, path, unverified=source is not None and verified.proof is None)
        raise typer.Exit(EXIT_FAILED)


def _print_reasons(verified: Verification, path: str, *, unverified: bool) -> None:
    violations = verified.validation.violations
    if violations:
        clauses, codes = (", ".join(sorted({getattr(one, name) for one in violations})) for name in ("clause", "code"))
        note(f"error: {path}: {counted(len(violations), 'violation')} of {clauses}; copy or make it again ({codes})")
    if unverified:
        note("error: the stated errors were not looked at")
    for failure in verified.proof.failures if verified.proof is not None else ():
        note(f"error: {failure}")


def _report(verified: Verification) -> str:
    validation, proof = verified.validation, verified.proof
    lines = [*map(str, (*validation.violations, *validation.unread)), *(f"remark: {one}" for one in validation.remarks)]
    if validation.conforms:
        lines.append(f"intact: {counted(validation.splat_count, 'splat')}; checked: {', '.join(validation.checks)}")
    if proof is not None:
        lines += [_table(proof)] * bool(proof.measures) + list(proof.notes)
        if proof.holds:
            lines.append(_summary(proof))
    return "\n".join(lines)


def _summary(proof: BoundsVerification) -> str:
    if not any(one.holds for one in proof.measures):
        return "nothing is stated that could be proved"
    return "the stated errors hold" if proof.rms_verified else "the stated maxima hold"


def _table(proof: BoundsVerification) -> str:
    if proof.rms_verified:
        header = ("error", "stated max", "found max", "stated rms", "found rms", "")
        rows = [
            (
                one.name,
                *map(_number, (one.declared_max, one.measured_max, one.declared_rms, one.measured_rms)),
                _word(one),
            )
            for one in proof.measures
        ]
        return format_table(header, rows)
    rows = [(one.name, _number(one.declared_max), _word(one)) for one in proof.measures]
    return format_table(("error", "stated max", ""), rows)


def _word(measure: MeasureVerification) -> str:
    return "not proved" if measure.holds is None else "holds" if measure.holds else "FAILS"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}"
