"""`csplat lint`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat.lint import Finding
from csplat.ply import lint_ply, read_ply
from csplat_tools.cli.console import FAILED, guarded
from csplat_tools.files.console import format_table, note, say, say_json
from csplat_tools.files.convert import findings_as_json
from csplat_tools.files.streams import STANDARD_STREAM, check_output, ply_path, write_model

__all__ = ["lint"]


@guarded
def lint(
    source: Annotated[str, typer.Argument(metavar="F.ply", help="A 3DGS PLY, or - for standard input.")],
    fix: Annotated[
        str | None, typer.Option(metavar="OUT.ply", help="Write a repaired PLY, where that is safe.")
    ] = None,
    keep_extra: Annotated[
        bool, typer.Option("--keep-extra", help="Extra columns are no defect; --fix keeps them.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing OUT.ply.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
) -> None:
    """Say what is wrong with a PLY: each defect with its count.

    Notes are ordinary variation. Repairs are what encoding repairs by
    itself and `encode --strict` refuses; errors cannot be repaired without
    guessing. The status is 1 where there are repairs or errors; with --fix,
    where there are errors.

    Examples:
      csplat lint scene.ply
      csplat lint scene.ply --fix clean.ply
      csplat lint scene.ply --json | jq '.findings[].id'
    """
    if as_json and fix == STANDARD_STREAM:
        raise typer.BadParameter("--json and --fix - both want standard output")
    if fix is not None:
        check_output(fix, force=force, inputs=(source,))
    with ply_path(source) as path:
        findings = lint_ply(path)
        if keep_extra:
            findings = [one for one in findings if one.id != "extra-columns"]
        errors = any(one.kind == "error" for one in findings)
        if fix is not None and not errors:
            write_model(fix, read_ply(path, keep_extra=keep_extra), absolute=False)
    clean = all(one.kind == "note" for one in findings)
    if as_json:
        fixed = fix is not None and not errors
        say_json({"clean": clean, "fixed": fixed, "findings": findings_as_json(findings)})
    elif fix == STANDARD_STREAM:
        note(_table(findings))
    else:
        say(_table(findings))
    if errors or (fix is None and not clean):
        raise typer.Exit(FAILED)


def _table(findings: list[Finding]) -> str:
    if not findings:
        return "nothing found"
    rows = [(f"{one.kind:<6}  {one.id}", one.count) for one in findings]
    lines = format_table(("kind    id", "count"), rows).splitlines()
    return "\n".join([lines[0], *(f"{line}  {one.text}" for line, one in zip(lines[1:], findings, strict=True))])
