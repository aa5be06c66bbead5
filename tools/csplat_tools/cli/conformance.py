# SPDX-License-Identifier: Apache-2.0
"""`csplat conformance decoder` and `csplat conformance encoder`."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from csplat.decoder.container import HIGHEST_LEVEL
from csplat.errors import InputError, counted
from csplat.model import SplatModel
from csplat.types import Progress
from csplat_conformance.answers import CUTS, RENDERS
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
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.cli.error_lines import EXIT_FAILED
from csplat_tools.console import note, print_data
from csplat_tools.file_streams import STANDARD_STREAM, write_text
from csplat_tools.optional_packages import require_renderer

_OURS = "-m csplat_tools encode {ply} {out} --source-index {index} --quiet"
#: Clauses of the specification, as opposed to names of checks: `HDR-*`, `LIM-1`.
_CLAUSE = re.compile(r"[A-Z][A-Z0-9*?-]*")
_TIMEOUT_RANGE = (0.1, 86_400)  # seconds, a day at most

conformance = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")

# Options of both commands
_Jobs = Annotated[int | None, typer.Option("--jobs", metavar="N", min=1, help="Processes. Default: one per core.")]
_Timeout = Annotated[float | None, typer.Option(metavar="SECONDS", help="Time limit per file. Default: 60.")]
_Junit = Annotated[str | None, typer.Option(metavar="FILE", help="Write JUnit XML; - is standard output.")]


@conformance.callback()
def root() -> None:
    """Test a decoder or an encoder of the format.

    Examples:
      csplat conformance decoder
      csplat conformance decoder --cmd 'my-decoder {input} {outdir}'
      csplat conformance encoder --cmd 'my-encoder {ply} {out}'
      csplat conformance encoder --write-inputs inputs
    """


@conformance.command()
def decoder(
    programs: Annotated[
        list[str] | None, typer.Option("--cmd", metavar="COMMAND", help="Decoder, with {input} and {outdir}.")
    ] = None,
    level: Annotated[str | None, typer.Option(metavar="N", help="Levels 1 to N, or a list: 1,3. Default: 3.")] = None,
    filters: Annotated[
        list[str] | None, typer.Option("--filter", metavar="PATTERN", help="Names 'invalid/*', clauses 'HDR-*'.")
    ] = None,
    classes: Annotated[
        str,
        typer.Option(
            "--class", metavar="CLASS", show_default=False, help="exact or renderer, resource level. Default: exact,C."
        ),
    ] = f"{EXACT},{HIGHEST_LEVEL}",
    jobs: _Jobs = None,
    timeout: _Timeout = None,
    junit: _Junit = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Test a decoder with the test vectors.

    L1: header and errors. L2: integers. L3: floats, bit for bit, or within
    the tolerance of --class renderer (spec 9.2). A decoder of --class A or B
    must refuse files of higher resource levels (8.1). L4: images of a command
    with {camera}. L5: tiles of cuts through the levels of detail, and of
    boxes, of a command with {cuts}. --cmd can be repeated. Without it,
    csplat's own decoder is tested. Otherwise a decoder writes its results to
    {outdir}, or exits with status 1 and a line of JSON with the error code:
    conformance/IMPLEMENTERS.md explains how. If everything passes, the last
    line says what the decoder may claim.

    Examples:
      csplat conformance decoder --filter 'invalid/*'
      csplat conformance decoder --cmd 'dec {input} {outdir}' --filter 'HDR-*'
      csplat conformance decoder --cmd 'dec {input} {outdir}' --junit all.xml
      csplat conformance decoder --cmd 'draw {input} {camera} {out}'
      csplat conformance decoder --cmd 'select-tiles {input} {cuts}'
    """
    out = Output(force, report, as_json, quiet)
    _check_reports(out, junit)
    patterns = [pattern.strip() for text in filters or () for pattern in text.split(",")]
    clauses = [pattern for pattern in patterns if _CLAUSE.fullmatch(pattern)]
    names = [pattern for pattern in patterns if pattern not in clauses]
    program, render_program, cut_program = _sort_commands(programs or [])
    # The commands that are given select the default: a renderer alone is tested at L4 alone.
    more = [str(number) for number, given in ((RENDERS, render_program), (CUTS, cut_program)) if given is not None]
    levels = shared.checked(parse_levels, level or ",".join(["1", "2", "3", *more]))
    by, resource_level = (",".join(chosen) for chosen in _by_length(classes.split(",")))
    seconds = shared.check_range("--timeout", timeout, *_TIMEOUT_RANGE) or TIMEOUT_SECONDS
    options = shared.checked(
        DecoderSuiteOptions, _join_patterns(names), _join_patterns(clauses), levels, timeout=seconds, jobs=jobs,
        by=by or EXACT, resource_level=resource_level or HIGHEST_LEVEL,
    )  # fmt: skip
    with out.bar() as bar:
        if not programs:
            result = run_builtin(options, _bar_mover(bar))
        else:
            result = run_command(program, options, render=render_program, cuts=cut_program, progress=_bar_mover(bar))
    _publish(result, out, junit, "no vector is chosen")


def _by_length(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the words of several characters, and those of one, which are letters of resource levels."""
    stripped = [word.strip() for word in words]
    return [word for word in stripped if len(word) != 1], [word for word in stripped if len(word) == 1]


def _sort_commands(programs: Sequence[str]) -> tuple[str | None, str | None, str | None]:
    """Return the commands of a decoder, a renderer and cuts by their names in braces, each `None` if not given.

    Raises:
        typer.BadParameter: two commands are of one kind.
    """
    by_kind: dict[str, str] = {}
    for program in programs:
        kind = next((kind for kind in ("cuts", "camera") if f"{{{kind}}}" in program), "decoder")
        if kind in by_kind:
            raise typer.BadParameter(f"--cmd has two commands of one kind: {by_kind[kind]!r} and {program!r}")
        by_kind[kind] = program
    return by_kind.get("decoder"), by_kind.get("camera"), by_kind.get("cuts")


@conformance.command()
def encoder(
    program: Annotated[
        str | None, typer.Option("--cmd", metavar="COMMAND", help="Encoder: {ply} {out}, maybe {index}.")
    ] = None,
    level: Annotated[str | None, typer.Option(metavar="N", help="Levels 1 to N, or a list: 1,3. Default: 4.")] = None,
    min_psnr: Annotated[
        float | None, typer.Option(metavar="DB", help=f"Least PSNR at L4. Default: {PSNR_MIN:g}.")
    ] = None,
    filters: Annotated[
        list[str] | None, typer.Option("--filter", metavar="PATTERN", help="Names of inputs: 'ordinary/*'.")
    ] = None,
    jobs: _Jobs = None,
    timeout: _Timeout = None,
    junit: _Junit = None,
    save: Annotated[str | None, typer.Option(metavar="FOLDER", help="Keep inputs and results there.")] = None,
    folder: Annotated[
        str | None, typer.Option("--write-inputs", metavar="FOLDER", help="Write the inputs, run nothing.")
    ] = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Test an encoder with reference scenes.

    L1: the status is as expected, the file breaks no clause, and a second run
    gives the same bytes. L2: every splat is there once, or counted as left
    out. L3: the declared errors hold. L4: renders reach --min-psnr (also
    checked if L3 verifies nothing). Without --cmd, csplat's own encoder is
    tested. Otherwise it starts in an empty folder, and exits with status 0 and
    a file, or with 1 and a reason as the last line of standard error or output.
    {index}: a .npy file, the source splat of each splat.

    Examples:
      csplat conformance encoder --cmd 'my-encoder {ply} {out}'
      csplat conformance encoder --cmd 'enc -s {ply} {out}' --min-psnr 28
      csplat conformance encoder --cmd 'enc {ply} {out} {index}' --save tried
      csplat conformance encoder --write-inputs inputs
    """
    out = Output(force, report, as_json, quiet)
    shared.refuse_together(
        {"--write-inputs": folder},
        {
            "--cmd": program, "--level": level, "--min-psnr": min_psnr, "--save": save, "--timeout": timeout,
            "--jobs": jobs, "--junit": junit,
        },
    )  # fmt: skip
    _check_reports(out, junit)
    if folder is not None:
        made = write_inputs(_checked_folder(folder, force=out.force), _join_patterns(filters))
        out.publish(made, f"{counted(len(made['inputs']), 'input')} in {folder}")
        return
    levels = tuple(f"L{number}" for number in shared.checked(parse_levels, level or "4", last=4))
    kept = _checked_folder(save, force=out.force) if save is not None else None
    render_score, reason = _render_scorer(levels)
    least = PSNR_MIN if min_psnr is None else min_psnr
    seconds = shared.check_range("--timeout", timeout, *_TIMEOUT_RANGE) or ENCODER_SECONDS
    options = EncoderSuiteOptions(_join_patterns(filters), levels, seconds, least, jobs, kept)
    ours = f"{shlex.quote(sys.executable)} {_OURS}"
    with out.bar() as bar:
        result = run_encoder(
            program or ours, options, render_score=render_score, no_render_reason=reason, progress=_bar_mover(bar)
        )
    _publish(result, out, junit, "no input is chosen")


def _check_reports(out: Output, junit: str | None) -> None:
    """Refuse unusable paths of reports before anything is run. XML may go to a terminal."""
    to_stdout = junit == STANDARD_STREAM
    if to_stdout and out.as_json:
        raise typer.BadParameter("--json and --junit - both use standard output")
    out.check(None if to_stdout else junit)


def _publish(report: ConformanceReport, out: Output, junit: str | None, nothing: str) -> None:
    """Publish the report, and exit with status 1 if it did not pass.

    Args:
        report: the report of the run.
        out: the options that tell where results go.
        junit: file for JUnit XML, or `-`; `None`: none.
        nothing: message if nothing was checked.

    Raises:
        typer.Exit: a check failed, or there was none.
    """
    if junit == STANDARD_STREAM:
        print_data(to_junit(report).rstrip("\n"))
    elif junit is not None:
        write_text(junit, to_junit(report))
    out.publish(to_json(report), "" if junit == STANDARD_STREAM else to_table(report))
    if not report.outcomes:
        note(f"error: {nothing}")
    if not report.passed:
        raise typer.Exit(EXIT_FAILED)


def _join_patterns(patterns: Sequence[str] | None) -> str | None:
    """Join patterns by commas; `None` without any."""
    return ",".join(patterns) if patterns else None


def _bar_mover(bar: Progress) -> Callable[[int, int], None]:
    """Return a callback for the number of finished tests and of all, which moves a progress bar."""
    return lambda done, count: bar("conformance", done / count)


def _checked_folder(name: str, *, force: bool) -> Path:
    """Return the path of a folder to write to, which need not exist.

    Raises:
        InputError: it is a file, or it is not empty and `force` is not set.
    """
    folder = Path(name)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{name} is a file, expected a folder")
    if folder.is_dir() and any(folder.iterdir()) and not force:
        raise InputError(f"{name} is not empty: --force replaces what is in the way")
    return folder


def _render_scorer(levels: Sequence[str]) -> tuple[RenderScore | None, str]:
    """Return a function that measures the PSNR of renders, or `None` and the reason; `levels` are to be checked."""
    if not {"L3", "L4"} & {*levels}:
        return None, ""
    try:
        require_renderer()
    except InputError as error:
        return None, str(error)

    def psnr(source: SplatModel, decoded: SplatModel) -> float:
        """Return the PSNR of renders of two scenes, dB."""
        from csplat_render.scorer import Scorer
        from csplat_tools.views import comparison_cameras

        return Scorer.of_source(source, comparison_cameras(source)).psnr(decoded)

    return psnr, ""
