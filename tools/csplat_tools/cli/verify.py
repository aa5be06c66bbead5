# SPDX-License-Identifier: Apache-2.0
"""`csplat verify`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat.context import Context
from csplat.errors import CsplatError, counted
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.cli.error_lines import EXIT_FAILED
from csplat_tools.console import note
from csplat_tools.inspect.text_reports import format_verification
from csplat_tools.inspect.verification import Verification, verify_file


def verify(
    path: Annotated[str, typer.Argument(metavar="F.csplat", help="A .csplat file, or - for standard input.")],
    source: Annotated[
        str | None, typer.Option(metavar="IN.ply", help="Source: verify the declared errors, too.")
    ] = None,
    source_index: shared.SourceIndexInput = None,
    limit_splats: shared.LimitSplats = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Check a file against the format, and its declared errors.

    Lists all violations: clause, error code, byte, field. With --source,
    each splat of the file must have a splat of the PLY within the declared
    maxima. With --source-index the pairs are known, and RMS errors and
    counts are verified as well, in bounded memory.

    Examples:
      csplat verify scene.csplat
      csplat verify scene.csplat --source scene.ply
      csplat verify scene.csplat --source scene.ply --source-index scene.npy
    """
    out = Output(force, report, as_json, quiet)
    shared.require_one({"--source-index": source_index}, {"--source": source})
    out.check(inputs=(path, source, source_index))
    try:
        with out.bar() as progress:
            context = Context(progress=progress)
            verified = verify_file(path, source, source_index, limit_splats=limit_splats, context=context)
    except CsplatError as error:
        out.publish({"holds": False, "error": {"code": error.code, "message": str(error)}})
        raise
    out.publish(verified.as_json(), "" if out.quiet else format_verification(verified))
    if not verified.holds:
        _print_reasons(verified, path, unverified=source is not None and verified.bounds is None)
        raise typer.Exit(EXIT_FAILED)


def _print_reasons(verified: Verification, path: str, *, unverified: bool) -> None:
    """Print why a file fails: violations, errors that were not checked, and declared errors that do not hold."""
    violations = verified.validation.violations
    if violations:
        clauses, codes = (
            ", ".join(sorted({getattr(violation, name) for violation in violations})) for name in ("clause", "code")
        )
        remedies = {
            "E_LIMIT": "--limit-splats allows fewer splats",
            "E_VERSION": "update csplat, or have it written as a version that this one reads",
        }
        remedy = remedies.get(codes, "copy or make it again")
        note(f"error: {path}: {counted(len(violations), 'violation')} of {clauses}; {remedy} ({codes})")
    if unverified:
        note("error: the declared errors were not checked")
    for failure in verified.bounds.failures if verified.bounds is not None else ():
        note(f"error: {failure}")
