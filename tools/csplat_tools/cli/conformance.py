"""`csplat conformance`."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from csplat.errors import InputError
from csplat_conformance.report import Report, to_json, to_junit, to_table
from csplat_conformance.runner import TIMEOUT_SECONDS, Choice, parse_levels, run_builtin, run_command
from csplat_tools.cli.console import FAILED, guarded
from csplat_tools.files.console import note, progress_bar, say, say_json
from csplat_tools.files.streams import STANDARD_STREAM, check_output, write_bytes

__all__ = ["conformance"]

conformance = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")


@conformance.callback()
def root() -> None:
    """Run the conformance suite: files for decoders, scenes for encoders, and what must come of them.

    Examples:
      csplat conformance decoder
      csplat conformance decoder --cmd 'my-decoder {input} {outdir}'
      csplat conformance encoder --cmd 'my-encoder {ply} {out}'
    """


@conformance.command()
@guarded
def decoder(
    command: Annotated[
        str | None, typer.Option("--cmd", metavar="COMMAND", help="Another decoder, with {input} and {outdir}.")
    ] = None,
    render_command: Annotated[
        str | None,
        typer.Option(
            "--render-cmd", metavar="COMMAND", help="A renderer, with {input}, {camera} and {out} or {outdir}."
        ),
    ] = None,
    level: Annotated[
        str | None,
        typer.Option(metavar="LEVEL", help="1 to 4: all up to this one; or some, as 1,3. 3, and 4 with --render-cmd."),
    ] = None,
    profile: Annotated[
        str, typer.Option(metavar="base|archive", help="What the decoder reads; base must refuse archive.")
    ] = "archive",
    pattern: Annotated[
        str | None, typer.Option("--filter", metavar="PATTERN", help="Only vectors of this name: 'invalid/*'.")
    ] = None,
    clause: Annotated[
        str | None, typer.Option(metavar="PATTERN", help="Only vectors that cover such a clause of the spec: 'HDR-*'.")
    ] = None,
    timeout: Annotated[float, typer.Option(metavar="SECONDS", help="For each file.")] = TIMEOUT_SECONDS,
    jobs: Annotated[int | None, typer.Option("--jobs", "-j", metavar="N", help="Processes at a time.")] = None,
    exact: Annotated[
        bool, typer.Option("--exact", help="Of refusals demand code, clause and offset too: for our decoders.")
    ] = False,
    json_file: Annotated[
        str | None, typer.Option("--json", metavar="FILE", help="Every result for programs; - for standard output.")
    ] = None,
    junit_file: Annotated[
        str | None, typer.Option("--junit", metavar="FILE", help="Every result as JUnit XML, for CI.")
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="A line for each check.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace existing reports.")] = False,
) -> None:
    """Run a decoder over the vectors: csplat's own, or the one that --cmd starts.

    L1: header and refusals. L2: integers. L3: floats, bit for bit. L4: pictures
    of a renderer. Another decoder writes what it decodes into {outdir}, or
    exits with status 1 and the error code in a line of JSON:
    conformance/IMPLEMENTERS.md says how.

    Examples:
      csplat conformance decoder --filter 'invalid/*'
      csplat conformance decoder --cmd 'dec {input} {outdir}' --clause 'HDR-*'
      csplat conformance decoder --cmd 'dec {input} {outdir}' --profile base
      csplat conformance decoder --cmd 'dec {input} {outdir}' --junit all.xml
      csplat conformance decoder --render-cmd 'draw {input} {camera} {out}'
    """
    check_reports(json_file, junit_file, force=force)
    with progress_bar() as bar:
        # A renderer alone is tested at L4 alone.
        usual = "3" if render_command is None else "4"
        choice = Choice(pattern, clause, parse_levels(level or usual), profile, exact, timeout, jobs)
        moved = (lambda done, count: bar("conformance", done / count)) if bar else None
        if command is None and render_command is None:
            report = run_builtin(choice, moved)
        else:
            report = run_command(command, choice, render=render_command, progress=moved)
    publish(report, json_file, junit_file, verbose=verbose)
    if not report.outcomes:
        note("error: no vector is chosen")
    if not report.passed:
        raise typer.Exit(FAILED)


def check_reports(json_file: str | None, junit_file: str | None, *, force: bool) -> None:
    """Refuse the places of reports before anything is run; arguments as those of `publish`.

    Raises:
        InputError: a file exists and `force` is not given, or both reports go to the same place.
        OSError: a folder does not exist.
    """
    if json_file is not None and json_file == junit_file:
        both = "standard output" if json_file == STANDARD_STREAM else json_file
        raise InputError(f"only one report can go to {both}")
    for path in (json_file, junit_file):
        if path is not None and path != STANDARD_STREAM:
            check_output(path, force=force)


def publish(report: Report, json_file: str | None, junit_file: str | None, *, verbose: bool) -> None:
    """Print a report as a table, and write it as JSON and JUnit XML where that is wanted.

    Args:
        report: of a run.
        json_file: file name, `-` for standard output in place of the table, or None.
        junit_file: likewise.
        verbose: a line for each check.
    """
    if json_file == STANDARD_STREAM:
        say_json(to_json(report))
    elif json_file is not None:
        write_bytes(json_file, (json.dumps(to_json(report), indent=2, allow_nan=False) + "\n").encode())
    if junit_file == STANDARD_STREAM:
        say(to_junit(report).rstrip("\n"))
    elif junit_file is not None:
        write_bytes(junit_file, to_junit(report).encode())
    if STANDARD_STREAM not in (json_file, junit_file):
        say(to_table(report, verbose=verbose))
