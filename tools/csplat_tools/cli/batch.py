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
from csplat_tools.batches.scene_job import CommandLineError, PlannedJob
from csplat_tools.cli.command_output import Output
from csplat_tools.cli.error_lines import EXIT_FAILED
from csplat_tools.cli.shared_options import (
    Dask,
    DryRun,
    Force,
    HelpAll,
    Json,
    Memory,
    Quiet,
    Report,
    checked,
    parse_bytes,
    refuse_together,
)
from csplat_tools.console import format_bytes, format_estimate, format_seconds, format_table, note, step_progress

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
    memory: Memory = None,
    dask: Dask = None,
    dry_run: DryRun = False,
    force: Force = False,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
    _all: HelpAll = False,
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
    refuse_together({"--dask": dask}, {"--workers": workers, "--memory": memory, "--dry-run": dry_run})
    memory_bytes = checked(parse_bytes, memory)
    out.check(inputs=(scenes,))
    points = starting_points(Path(scenes)) if Path(scenes).is_dir() else []
    if points:
        note(f"left out: {', '.join(points[:_SHOWN_MAX])}: initial points of a training, no scenes")
    try:
        if dry_run:
            planned = plan_batch(scenes, folder, words, ending=ending, match=match, workers=workers)
            out.publish(_planned_json(planned), _planned_text(planned))
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


def _planned_json(planned: list[PlannedJob]) -> list[dict[str, object]]:
    return [
        {
            "path": one.job.task.source,
            "output": one.job.task.output,
            "command": list(one.job.words),
            "done": one.is_done,
            "splats": None if one.file is None else one.file.splats,
            "source_bytes": None if one.file is None else one.file.size_bytes,
            "seconds": one.seconds,
            "memory_bytes": one.memory_bytes,
        }
        for one in planned
    ]


def _planned_text(planned: list[PlannedJob]) -> str:
    """Return a table of the planned work, and the total time."""
    rows = []
    for one in planned:
        seen = one.file
        splats = "?" if seen is None or seen.splats is None else f"{seen.splats:,}"
        size = "cannot be read" if seen is None else format_bytes(seen.size_bytes)
        seconds = "?" if one.seconds is None else format_seconds(one.seconds)
        work = ("nothing: done", "") if one.is_done else (seconds, format_bytes(one.memory_bytes))
        rows.append((one.job.task.source, one.job.task.output, splats, size, *work))
    left = [one for one in planned if not one.is_done]
    known = [one.seconds for one in left if one.seconds is not None]
    took = f"{format_estimate(sum(known))}, one after the other" if len(known) == len(left) else "the time is unknown"
    table = format_table(("scene", "output", "splats", "size", "time", "memory"), rows, left=2)
    return f"{table}\n{counted(len(left), 'scene')} to do of {len(planned)}, {took}"
