"""`csplat batch`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from csplat.errors import counted
from csplat_tools.batches.batch_page import PAGE
from csplat_tools.batches.batch_run import Batch, BatchStep, plan_batch
from csplat_tools.batches.batch_run import batch as run_batch
from csplat_tools.batches.batch_scenes import starting_points
from csplat_tools.batches.journal import JOURNAL
from csplat_tools.batches.scene_job import CommandLineError, format_plan
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.cli.error_lines import EXIT_FAILED
from csplat_tools.console import format_seconds, note, step_progress

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
    ending: Annotated[
        str | None, typer.Option(metavar=".spz", help="Ending of outputs. Default: the command's.")
    ] = None,
    match: Annotated[
        str, typer.Option(metavar="PATTERN", show_default=False, help="Names of scenes: '*.ply'. Default: all.")
    ] = "*",
    workers: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Scenes at a time. Default: one per core.")
    ] = None,
    memory: shared.Memory = None,
    dask: shared.Dask = None,
    dry_run: shared.DryRun = False,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Run a command on many scenes.

    OUT/batch.jsonl has a line for each scene, OUT/index.html a table with
    thumbnails (render extra). Work that is done is not repeated by the next
    run: the same content, command and version, and an unchanged output.
    Scenes that fail are listed, tried again in the next run, and make the
    status 1; the other scenes are processed all the same.

    Examples:
      csplat batch scenes encoded
      csplat batch scenes encoded -- encode --preset small
      csplat batch scenes web --ending .sog --match '*.ply' -- convert
      csplat batch list.jsonl encoded --workers 4 --memory 16GB
    """
    out, words = Output(force, report, as_json, quiet), tuple(line or ("encode",))
    shared.refuse_together({"--dask": dask}, {"--workers": workers, "--memory": memory, "--dry-run": dry_run})
    memory_bytes = shared.checked(shared.parse_bytes, memory)
    out.check(inputs=(scenes,))
    points = starting_points(Path(scenes)) if Path(scenes).is_dir() else []
    if points:
        note(f"left out: {', '.join(points[:_SHOWN_MAX])}: initial points of a training, no scenes")
    try:
        if dry_run:
            planned = plan_batch(scenes, folder, words, ending=ending, match=match, workers=workers)
            out.publish([one.as_json() for one in planned], format_plan(planned))
            return
        with step_progress("batch", _words(), quiet=out.quiet) as progress:
            done = run_batch(
                scenes, folder, words, ending=ending, match=match, workers=workers, memory_bytes=memory_bytes,
                dask=dask, force=out.force, progress=progress,
            )  # fmt: skip
    except CommandLineError as error:
        raise typer.BadParameter(str(error)) from None
    out.publish(done.as_json(), _text(done))
    _print_failures(done)
    if done.failures:
        sys.exit(EXIT_FAILED)


def _words() -> Callable[[BatchStep], str]:
    """Return a function that describes the progress in a line, with the time left counted from now on."""
    begun = time.monotonic()

    def words(step: BatchStep) -> str:
        failed = f", {step.failed} failed" if step.failed else ""
        left = (time.monotonic() - begun) * (1.0 / step.share - 1.0) if step.share > 0.0 else 0.0
        return f"{step.iteration} of {step.iterations}{failed}" + (
            f", about {format_seconds(left)} left" if left else ""
        )

    return words


def _text(done: Batch) -> str:
    before, failed = len(done.done_before), len(done.failures)
    made = len(done.records) - before - failed
    scenes = counted(len(done.records), "scene")
    return f"{scenes}: {made} done, {before} done before, {failed} failed; {done.folder / PAGE}"


def _print_failures(done: Batch) -> None:
    for one in done.failures[:_SHOWN_MAX]:
        note(f"failed: {one.path}: {one.error}" + (f" ({one.code})" if one.code not in one.error else ""))
    if len(done.failures) > _SHOWN_MAX:
        note(f"and {len(done.failures) - _SHOWN_MAX} more: {done.folder / JOURNAL}")
