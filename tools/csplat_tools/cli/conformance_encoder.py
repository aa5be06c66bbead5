"""`csplat conformance encoder`; with `csplat conformance decoder`, which it adds itself to."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_conformance.encoders import PSNR_MIN, EncoderChoice, run_encoder
from csplat_conformance.encoders.judge import PictureJudge
from csplat_conformance.encoders.run import TIMEOUT_SECONDS
from csplat_conformance.runner import parse_levels
from csplat_tools.cli.conformance import check_reports, conformance, publish
from csplat_tools.cli.console import FAILED, guarded
from csplat_tools.files.console import note, progress_bar
from csplat_tools.files.extras import prepare_renderer

__all__ = ["conformance", "encoder"]

_PICTURES_LEVEL = 4
_OURS = "-m csplat_tools encode {ply} {out} --quiet"


@conformance.command()
@guarded
def encoder(
    command: Annotated[
        str | None, typer.Option("--cmd", metavar="COMMAND", help="Another encoder, with {ply} and {out}.")
    ] = None,
    level: Annotated[str, typer.Option(metavar="LEVEL", help="1 to 4: all up to this one; or some, as 1,3.")] = "4",
    pattern: Annotated[
        str | None, typer.Option("--filter", metavar="PATTERN", help="Only inputs of this name: 'nasty/*'.")
    ] = None,
    timeout: Annotated[float, typer.Option(metavar="SECONDS", min=0.1, help="For each input.")] = TIMEOUT_SECONDS,
    min_psnr: Annotated[
        float, typer.Option(metavar="DB", help="That pictures must keep at L4; choose it by your preset.")
    ] = PSNR_MIN,
    jobs: Annotated[
        int | None, typer.Option("--jobs", "-j", metavar="N", min=1, help="Processes at a time; one per core.")
    ] = None,
    keep: Annotated[
        str | None, typer.Option(metavar="FOLDER", help="Write the inputs and what was made of them there.")
    ] = None,
    json_file: Annotated[
        str | None, typer.Option("--json", metavar="FILE", help="Every result for programs; - for standard output.")
    ] = None,
    junit_file: Annotated[
        str | None, typer.Option("--junit", metavar="FILE", help="Every result as JUnit XML, for CI.")
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="A line for each check.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace existing reports, and files in FOLDER.")] = False,
) -> None:
    """Run an encoder over reference PLYs: csplat's own, or the one that --cmd starts.

    L1: it ends as it should and the file breaks no clause. L2: every splat
    of the source is there once, or counted as left out. L3: the stated errors
    hold. L4: pictures keep --min-psnr; needs the packages of the render
    extra. An encoder exits with 0 and a file, or with 1, a line that says
    why, and no file; ordinary inputs it must take.

    Examples:
      csplat conformance encoder --cmd 'my-encoder {ply} {out}'
      csplat conformance encoder --cmd 'my-encoder --small {ply} {out}' --min-psnr 28 --junit report.xml
      csplat conformance encoder --cmd 'my-encoder {ply} {out}' --filter 'nasty/*' --level 1 --keep tried
    """
    check_reports(json_file, junit_file, force=force)
    levels = tuple(f"L{number}" for number in parse_levels(level))
    folder = _checked_folder(keep, force=force)
    pictures, reason = _picture_judge() if f"L{_PICTURES_LEVEL}" in levels else (None, "")
    choice = EncoderChoice(pattern, levels, timeout, min_psnr, jobs, folder)
    with progress_bar() as bar:
        report = run_encoder(
            command or f"{shlex.quote(sys.executable)} {_OURS}",
            choice,
            pictures=pictures,
            no_pictures=reason,
            progress=(lambda done, count: bar("conformance", done / count)) if bar else None,
        )
    publish(report, json_file, junit_file, verbose=verbose)
    if not report.outcomes:
        note("error: no input has such a name")
    if not report.passed:
        raise typer.Exit(FAILED)


def _checked_folder(name: str | None, *, force: bool) -> Path | None:
    if name is None:
        return None
    folder = Path(name)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{name} is a file, wanted a folder")
    if folder.is_dir() and any(folder.iterdir()) and not force:
        raise InputError(f"{name} is not empty: --force replaces what is in the way")
    return folder


def _picture_judge() -> tuple[PictureJudge | None, str]:
    """Return what judges pictures, or why nothing does."""
    try:
        prepare_renderer(quiet=False)
    except InputError as error:
        return None, str(error)
    from csplat_render.judge import Judge
    from csplat_tools.views import comparison_cameras

    def psnr(source: SplatModel, decoded: SplatModel) -> float:
        return Judge.of_source(source, comparison_cameras(source)).psnr(decoded)

    return psnr, ""
