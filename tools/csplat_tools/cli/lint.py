# SPDX-License-Identifier: Apache-2.0
"""`csplat lint`."""

from __future__ import annotations

from typing import Annotated

import typer

import csplat
from csplat import formats
from csplat.errors import InputError
from csplat.lint import Finding
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.cli.error_lines import EXIT_FAILED
from csplat_tools.console import format_table
from csplat_tools.file_streams import STANDARD_STREAM, check_name, source_path, write_model
from csplat_tools.scene_files import findings_as_json


def lint(
    source: Annotated[str, typer.Argument(metavar="SCENE", help="A PLY, another format of `convert`, or -.")],
    fix: Annotated[str | None, typer.Option(metavar="OUT.ply", help="Write a repaired PLY if that is safe.")] = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """List the defects of a PLY, each with its count.

    Notes are ordinary variation. Repairs are made by `csplat encode`, too.
    Errors cannot be repaired without guessing. The status is 1 if there are
    repairs or errors; with --fix, if there are errors.

    Examples:
      csplat lint scene.ply
      csplat lint scene.ply --fix clean.ply
      csplat lint scene.ply --json | jq '.findings[].id'
    """
    out = Output(force, report, as_json, quiet)
    out.check(fix, inputs=(source,))
    if fix is not None:
        check_name(fix, ".ply", "--fix", source)
    with source_path(source) as path:
        findings = formats.lint_file(path)
        if fix is not None:  # which keeps them
            findings = [finding for finding in findings if finding.id != "extra-columns"]
        errors = any(finding.kind == "error" for finding in findings)
        if fix is not None and not errors:
            with csplat.open(path) as scene:
                write_model(fix, scene, absolute=False)
    clean = all(finding.kind == "note" for finding in findings)
    table = _format_findings(findings)
    if fix == STANDARD_STREAM:
        out.remark(table)
    result = {"clean": clean, "fixed": fix is not None and not errors, "findings": findings_as_json(findings)}
    out.publish(result, "" if fix == STANDARD_STREAM else table)
    if fix is not None and errors:
        raise InputError(f"{source} cannot be repaired, and {fix} was not written; export the scene again")
    if errors or (fix is None and not clean):
        raise typer.Exit(EXIT_FAILED)


def _format_findings(findings: list[Finding]) -> str:
    """Format findings as a table, or as a remark that there are none; texts follow their rows."""
    if not findings:
        return "nothing found"
    rows = [(f"{finding.kind:<6}  {finding.id}", finding.count) for finding in findings]
    lines = format_table(("kind    id", "count"), rows).splitlines()
    return "\n".join(
        [lines[0], *(f"{line}  {finding.text}" for line, finding in zip(lines[1:], findings, strict=True))]
    )
