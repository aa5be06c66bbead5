"""`csplat conformance decoder` and `csplat conformance encoder`."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

import typer

from csplat.errors import InputError, counted
from csplat.model import SplatModel
from csplat.types import Progress
from csplat_conformance.conformance_report import ConformanceReport, to_json, to_junit, to_table
from csplat_conformance.decoder_suite import (
    TIMEOUT_SECONDS,
    DecoderSuiteOptions,
    parse_levels,
    run_builtin,
    run_command,
)
from csplat_conformance.encoders import PSNR_MIN, EncoderSuiteOptions, run_encoder, write_inputs
from csplat_conformance.encoders.encoder_suite import TIMEOUT_SECONDS as ENCODER_SECONDS
from csplat_conformance.encoders.render_checks import RenderScore
from csplat_conformance.tolerance import EXACT
from csplat_tools.cli.command import EXIT_FAILED, OptionGroup, OutputOptions, chosen, command
from csplat_tools.console import note, print_data
from csplat_tools.file_streams import STANDARD_STREAM, write_bytes
from csplat_tools.optional_packages import prepare_renderer, require_renderer

_OURS = "-m csplat_tools encode {ply} {out} --source-index {index} --quiet"
#: Options of a run, which exclude --write-inputs.
_OF_A_RUN = ("program", "level", "min_psnr", "keep", "timeout", "jobs", "junit", "verbose")

conformance = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")


@dataclass(frozen=True)
class RunOptions(OptionGroup):
    """Options of a run of the suite, and of its reports in addition to the JSON."""

    filters: Annotated[
        list[str] | None,
        typer.Option("--filter", metavar="PATTERN,...", help="Only checks of these names: 'invalid/*'. May repeat."),
    ] = None
    timeout: Annotated[float | None, typer.Option(metavar="SECONDS", min=0.1, help="For each file.")] = None
    jobs: Annotated[
        int | None, typer.Option("--jobs", "-j", metavar="N", min=1, help="Processes at a time; one per core.")
    ] = None
    junit: Annotated[
        str | None, typer.Option(metavar="FILE", help="Every result as JUnit XML, for CI; - for standard output.")
    ] = None
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="A line for each check.")] = False

    @property
    def pattern(self) -> str | None:
        """Patterns of the checks to run, joined by commas as the library takes them; `None`: all."""
        return _joined(self.filters)

    def check(self, out: OutputOptions) -> None:
        """Refuse unusable paths of reports before anything is run; XML may go to a terminal."""
        to_stdout = self.junit == STANDARD_STREAM
        if to_stdout and out.as_json:
            raise typer.BadParameter("--json and --junit - both use standard output")
        out.check(None if to_stdout else self.junit)

    def publish(self, report: ConformanceReport, out: OutputOptions, nothing: str) -> None:
        """Publish the report in every form that was requested, and exit with status 1 if it did not pass.

        Args:
            report: the report of the run.
            out: the options that tell where results go.
            nothing: message if nothing was checked.

        Raises:
            typer.Exit: a check failed, or there was none.
        """
        if self.junit == STANDARD_STREAM:
            print_data(to_junit(report).rstrip("\n"))
        elif self.junit is not None:
            write_bytes(self.junit, to_junit(report).encode())
        out.publish(to_json(report), "" if self.junit == STANDARD_STREAM else to_table(report, verbose=self.verbose))
        if not report.outcomes:
            note(f"error: {nothing}")
        if not report.passed:
            raise typer.Exit(EXIT_FAILED)


@conformance.callback()
def root() -> None:
    """Run the conformance suite: files for decoders, scenes for encoders, and what must come of them.

    Examples:
      csplat conformance decoder
      csplat conformance decoder --cmd 'my-decoder {input} {outdir}'
      csplat conformance encoder --cmd 'my-encoder {ply} {out}'
      csplat conformance encoder --write-inputs inputs
    """


@conformance.command()
@command()
def decoder(
    run: RunOptions,
    out: OutputOptions,
    program: Annotated[
        str | None, typer.Option("--cmd", metavar="COMMAND", help="Another decoder, with {input} and {outdir}.")
    ] = None,
    render_program: Annotated[
        str | None,
        typer.Option(
            "--render-cmd", metavar="COMMAND", help="A renderer, with {input}, {camera} and {out} or {outdir}."
        ),
    ] = None,
    level: Annotated[
        str | None,
        typer.Option(metavar="LEVEL", help="1 to 4: all up to this one; or some, as 1,3. 3, and 4 with --render-cmd."),
    ] = None,
    clause: Annotated[
        list[str] | None,
        typer.Option(metavar="PATTERN,...", help="Only vectors of such clauses of the spec: 'HDR-*'. May repeat."),
    ] = None,
    by: Annotated[
        str, typer.Option("--class", metavar="CLASS", help="exact, or renderer: floats in single precision (spec 9.2).")
    ] = EXACT,
    exact: Annotated[
        bool, typer.Option("--exact", help="Of refusals demand code, clause and offset too: for our decoders.")
    ] = False,
) -> None:
    """Run a decoder over the vectors: csplat's own, or the one that --cmd starts.

    L1: header and refusals. L2: integers. L3: floats, bit for bit, or near
    enough for --class renderer. L4: images of a renderer. Another decoder
    writes what it decodes into {outdir}, or exits with status 1 and the error
    code in a line of JSON: conformance/IMPLEMENTERS.md says how.

    Examples:
      csplat conformance decoder --filter 'invalid/*'
      csplat conformance decoder --cmd 'dec {input} {outdir}' --clause 'HDR-*'
      csplat conformance decoder --filter 'valid/sh*,valid/absent_*' --level 2
      csplat conformance decoder --cmd 'dec {input} {outdir}' --junit all.xml
      csplat conformance decoder --render-cmd 'draw {input} {camera} {out}'
    """
    run.check(out)
    with out.bar() as bar:
        # A renderer alone is tested at L4 alone.
        levels = chosen(parse_levels, text=level or ("3" if render_program is None else "4"))
        timeout = run.timeout or TIMEOUT_SECONDS
        choice = DecoderSuiteOptions(run.pattern, _joined(clause), levels, exact, timeout, run.jobs, by)
        if program is None and render_program is None:
            report = run_builtin(choice, _moved(bar))
        else:
            report = run_command(program, choice, render=render_program, progress=_moved(bar))
    run.publish(report, out, "no vector is chosen")


@conformance.command()
@command(one_of=[("folder", name) for name in _OF_A_RUN])
def encoder(
    run: RunOptions,
    out: OutputOptions,
    program: Annotated[
        str | None,
        typer.Option("--cmd", metavar="COMMAND", help="Another encoder, with {ply}, {out}, and perhaps {index}."),
    ] = None,
    level: Annotated[str, typer.Option(metavar="LEVEL", help="1 to 4: all up to this one; or some, as 1,3.")] = "4",
    min_psnr: Annotated[
        float,
        typer.Option(
            metavar="DB",
            help="Least PSNR of renders at L4, dB; choose it by your preset.",
        ),
    ] = PSNR_MIN,
    keep: Annotated[
        str | None, typer.Option(metavar="FOLDER", help="Keep the inputs and what was made of them there.")
    ] = None,
    folder: Annotated[
        str | None,
        typer.Option(
            "--write-inputs", metavar="FOLDER", help="Write the inputs and a list of them there; run nothing."
        ),
    ] = None,
) -> None:
    """Run an encoder over reference PLYs: csplat's own, or the one that --cmd starts.

    L1: it ends as it should, the file breaks no clause, and a second run gives
    the same bytes. L2: every splat of the source is there once, or counted as
    left out. L3: the stated errors hold. L4: renders keep --min-psnr; requires
    the packages of the render extra; also checked if L3 proves nothing.
    An encoder exits with 0 and a file, or with 1, a line that says why, and
    no file; ordinary inputs it must take. The line is the last one on standard
    error or, where nothing is there, on standard output. It starts in an empty
    folder; words of the command that name files here still do.
    {index}: a .npy of integers, which splat of the source each splat is.

    Examples:
      csplat conformance encoder --cmd 'my-encoder {ply} {out}'
      csplat conformance encoder --cmd 'enc -s {ply} {out}' --min-psnr 28
      csplat conformance encoder --cmd 'enc {ply} {out} {index}' --keep tried
      csplat conformance encoder --write-inputs inputs
    """
    run.check(out)
    if folder is not None:
        made = write_inputs(_checked_folder(folder, force=out.force), run.pattern)
        out.publish(made, f"{counted(len(made['inputs']), 'input')} in {folder}")
        return
    levels = tuple(f"L{number}" for number in chosen(parse_levels, text=level))
    kept = _checked_folder(keep, force=out.force) if keep is not None else None
    render_score, reason = _render_scorer(levels, quiet=out.quiet)
    choice = EncoderSuiteOptions(run.pattern, levels, run.timeout or ENCODER_SECONDS, min_psnr, run.jobs, kept)
    ours = f"{shlex.quote(sys.executable)} {_OURS}"
    with out.bar() as bar:
        report = run_encoder(
            program or ours, choice, render_score=render_score, no_render_reason=reason, progress=_moved(bar)
        )
    run.publish(report, out, "no input is chosen")


def _joined(patterns: Sequence[str] | None) -> str | None:
    return ",".join(patterns) if patterns else None


def _moved(bar: Progress | None) -> Callable[[int, int], None] | None:
    return (lambda done, count: bar("conformance", done / count)) if bar else None


def _checked_folder(name: str, *, force: bool) -> Path:
    folder = Path(name)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{name} is a file, wanted a folder")
    if folder.is_dir() and any(folder.iterdir()) and not force:
        raise InputError(f"{name} is not empty: --force replaces what is in the way")
    return folder


def _render_scorer(levels: Sequence[str], *, quiet: bool) -> tuple[RenderScore | None, str]:
    """Return a function that measures the PSNR of renders, or `None` and the reason.

    Args:
        levels: levels to be checked. At L4 every file is rendered, and the renderer is prepared at once; at L3 alone
            hardly any is, and it is prepared at the first.
        quiet: print nothing while the renderer is compiled.
    """
    if not {"L3", "L4"} & {*levels}:
        return None, ""
    try:
        require_renderer()
    except InputError as error:
        return None, str(error)
    ready = cache(lambda: prepare_renderer(quiet=quiet))
    if "L4" in levels:
        ready()

    def psnr(source: SplatModel, decoded: SplatModel) -> float:
        ready()
        from csplat_render.scorer import Scorer
        from csplat_tools.views import comparison_cameras

        return Scorer.of_source(source, comparison_cameras(source)).psnr(decoded)

    return psnr, ""
