# SPDX-License-Identifier: Apache-2.0
"""`csplat batch`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat.context import Context
from csplat.errors import counted
from csplat_tools.batch import PAGE, CommandLineError, run_batch
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.cli.error_lines import EXIT_FAILED
from csplat_tools.console import note

_SHOWN_MAX = 50  # failures listed on standard error; the page lists all


def batch(
    scenes: Annotated[
        str, typer.Argument(metavar="SCENES", help="A folder, or a manifest: .jsonl, or .csv of path, output, options.")
    ],
    folder: Annotated[str, typer.Argument(metavar="OUT", help="The folder of outputs.")],
    line: Annotated[
        list[str] | None,
        typer.Argument(metavar="[-- COMMAND OPTIONS]", help="A command that takes IN and OUT. Default: encode."),
    ] = None,
    ending: Annotated[str | None, typer.Option(metavar=".spz", help="Ending of outputs. Default: by COMMAND.")] = None,
    match: Annotated[
        str, typer.Option(metavar="PATTERN", show_default=False, help="Names, as '*.ply'. Default: all.")
    ] = "*",
    workers: Annotated[int | None, typer.Option(metavar="N", min=1, help="Processes. Default: one per core.")] = None,
    scheduler: shared.Scheduler = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Run a command on many scenes.

    OUT/index.html has a table of the results. The next run repeats no scene
    whose output exists, is newer, and passes its checks: all CRCs of a .csplat
    file. Another file in its place is kept, and the scene fails. After a change
    of COMMAND or OPTIONS, --force repeats all scenes and replaces their outputs.
    If a scene fails, the others are processed all the same; the status is 1.

    Examples:
      csplat batch scenes encoded
      csplat batch scenes encoded -- encode --preset small
      csplat batch list.jsonl web --ending .sog --workers 4 -- convert
    """
    out = Output(force, report, as_json, quiet)
    shared.refuse_together({"--scheduler": scheduler}, {"--workers": workers})
    out.check(inputs=(scenes,))
    try:
        with out.bar() as progress:
            context = Context(workers=scheduler or workers, progress=progress)
            done = run_batch(
                scenes, folder, line or ("encode",), ending=ending, match=match, force=force, context=context
            )
    except CommandLineError as error:
        raise typer.BadParameter(str(error)) from None
    counts = (f"{len(done.select(state))} {state.replace('_', ' ')}" for state in ("done", "done_before", "failed"))
    if done.select("done_before"):
        out.remark("scenes done before keep their files: --force repeats them, for instance with other options")
    page = f"; {done.folder / PAGE}" if done.has_page else ""
    out.publish(done.as_json(), f"{counted(len(done.results), 'scene')}: {', '.join(counts)}{page}")
    failed = done.select("failed")
    for result in failed[:_SHOWN_MAX]:
        note(f"failed: {result.path}: {result.error}")
    if not done.has_page:
        note(f"{done.folder / PAGE} is not from csplat batch, and was kept: no page was written")
    if failed:
        raise typer.Exit(EXIT_FAILED)
