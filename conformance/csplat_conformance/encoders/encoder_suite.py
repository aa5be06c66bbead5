# SPDX-License-Identifier: CC0-1.0
"""Run an encoder over the reference inputs and check its files level by level."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from csplat.decoder import DecodedScene
from csplat.disk_files import atomic_writer, temporary_folder
from csplat.errors import InputError
from csplat_conformance.conformance_report import ConformanceReport, Outcome, Status
from csplat_conformance.encoders.encoder_inputs import PSNR_MIN, EncoderInput, all_inputs
from csplat_conformance.encoders.encoder_run import (
    OPTIONAL_PLACEHOLDERS,
    PLACEHOLDERS,
    REPEAT_SECONDS,
    CommandRunner,
    EncoderRun,
    Verdict,
    check_end,
    failed_verdict,
    find_side_effects,
    run_once,
)
from csplat_conformance.encoders.error_checks import check_errors
from csplat_conformance.encoders.file_checks import SplatPairs, check_content, check_stream
from csplat_conformance.encoders.render_checks import RenderScore, check_renders
from csplat_conformance.manifest import select_names
from csplat_conformance.protocol import split_command

LEVELS = ("L1", "L2", "L3", "L4")
TIMEOUT_SECONDS = 60.0  # for one input

_NO_RENDERER = "nothing renders here"
_REPEATED = ".again"  # suffix of the folder of a repetition
_INPUT_LIST = "inputs.json"


@dataclass(frozen=True)
class EncoderSuiteOptions:
    """Settings of a run of the encoder suite.

    Attributes:
        pattern: shell patterns of the inputs' names, `ordinary/*,nasty/empty`; `None` for all.
        levels: levels to report. Each depends on the previous ones, which are checked but not reported. If L3 cannot
            verify any error, L4 is reported, too.
        timeout_seconds: time limit for one input.
        psnr_min: lowest PSNR that passes L4, dB. Inputs with their own limit keep its difference from the default.
        jobs: number of processes at a time; default: one per core.
        keep: folder that keeps inputs and results, in a folder per input; `None`: they are removed.
    """

    pattern: str | None = None
    levels: tuple[str, ...] = LEVELS
    timeout_seconds: float = TIMEOUT_SECONDS
    psnr_min: float = PSNR_MIN
    jobs: int | None = None
    keep: Path | None = None


def run_encoder(
    command: str,
    options: EncoderSuiteOptions | None = None,
    *,
    render_score: RenderScore | None = None,
    no_render_reason: str = _NO_RENDERER,
    progress: Callable[[int, int], None] | None = None,
    run: CommandRunner | None = None,
) -> ConformanceReport:
    """Run an encoder over the reference inputs and check what it writes.

    The encoder is started once for each input. It must either exit with status 0 and write a complete file to `{out}`,
    or exit with status 1, print a line with the reason and write no file. If it wrote a file, it is started again after
    all inputs have run once, and must write the same bytes.

    Args:
        command: command line with `{ply}` and `{out}`, optionally with `{index}`, the path of the source index.
        options: settings of the run.
        render_score: computes the PSNR for L4. Without it the level is skipped, or fails if no other level can check
            the input.
        no_render_reason: the reason for the lack of a `render_score`.
        progress: called with the number of completed steps and the total.
        run: runs the command line in this process, on `options.jobs` threads. Default: start processes, each in an
            empty working directory, and wait `REPEAT_SECONDS` before a repetition.

    Raises:
        InputError: the command line cannot be used, there is no such program or level, or a pattern matches no input.
    """
    options = options or EncoderSuiteOptions()
    split_command(command, PLACEHOLDERS, OPTIONAL_PLACEHOLDERS)
    unknown = [level for level in options.levels if level not in LEVELS]
    if unknown:
        raise InputError(f"the level is {', '.join(unknown)}, expected {', '.join(LEVELS)}")
    inputs = select_inputs(options.pattern)
    checks = CheckOptions(options.levels, options.psnr_min, render_score, no_render_reason)
    outcomes: list[Outcome] = []
    declined: dict[str, bool] = {}
    with _work_folder(options.keep) as folder, ThreadPoolExecutor(options.jobs or os.cpu_count() or 1) as pool:
        try:
            steps = _StepCounter(2 * len(inputs), progress)
            firsts, repeated = _run_inputs(pool, command, inputs, folder, options.timeout_seconds, run, steps)
            for case, first, future in zip(inputs, firsts, repeated, strict=True):
                # One input at a time: rendering uses all cores by itself.
                again = future.result() if future is not None else None
                outcomes += _check_input_safely(case, first, again, checks)
                if case.may_refuse:
                    declined[case.name] = first.end.status is None and first.end.returncode == 1
                with suppress(OSError):
                    _remove_repetition(folder, case, first, again)
                steps.advance()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    notes = _summarise_declined(declined)
    if render_score is None and "L4" in options.levels and inputs:
        notes.append(f"L4 SKIPPED: {no_render_reason}")
    extra = (Status.WARNED, Status.DECLINED, Status.NOT_PROVED)
    is_complete = not options.pattern and {*options.levels} == {*LEVELS} and render_score is not None
    return ConformanceReport("encoder", command, outcomes, notes, extra, "an encoder" if is_complete else "")


def write_inputs(folder: Path, pattern: str | None = None) -> dict[str, Any]:
    """Write the PLY of every input, `ordinary/degree_3.ply`, and a list of them, `inputs.json`.

    Args:
        folder: folder for the files; existing files are replaced.
        pattern: shell patterns of the inputs' names; `None` for all.

    Returns:
        The list: `inputs`, each with `name`, `file`, `why`, `refusal` (`must`, `may` or `no`) and `expected`,
        `null` if it must be refused: `splats` of the source (SRC-1), `rows` of the PLY, `sh_degree`,
        `extra_columns`, `apart` (smallest distance between different centres), `renders` (whether renders are
        compared) and `psnr_min` (dB, by default; `null` if renders are not compared).

    Raises:
        InputError: the pattern matches no input.
    """
    entries = []
    for case in select_inputs(pattern):
        file = folder / f"{case.name}.ply"
        file.parent.mkdir(parents=True, exist_ok=True)
        data = case.make()
        with atomic_writer(file) as stream:
            stream.write(data)
        entries.append(_input_json(case, data))
    result = {"inputs": entries}
    with atomic_writer(folder / _INPUT_LIST) as stream:
        stream.write((json.dumps(result, indent=2) + "\n").encode())
    return result


def select_inputs(pattern: str | None) -> list[EncoderInput]:
    """Return the inputs with matching names, in the order of a run.

    Args:
        pattern: see `EncoderSuiteOptions`.

    Raises:
        InputError: a pattern matches no input.
    """
    inputs = all_inputs()
    names = select_names(pattern, [case.name for case in inputs], "input")
    return [case for case in inputs if case.name in names]


def _check_input_safely(
    case: EncoderInput, first: EncoderRun, again: EncoderRun | None, checks: CheckOptions
) -> list[Outcome]:
    """Check an input; if a file cannot be read or rendered, the level after the last outcome fails."""
    outcomes: list[Outcome] = []
    try:
        outcomes.extend(check_input(case, first, again, checks))
    except (InputError, OSError) as error:
        level = LEVELS[min(len(outcomes), len(LEVELS) - 1)]
        outcomes.append(Outcome(case.name, level, Status.FAILED, message=str(error)))
    return outcomes


@contextmanager
def _work_folder(keep: Path | None) -> Iterator[Path]:
    """Yield the folder `keep`, which is created if necessary, or a temporary folder for `None`."""
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        yield keep.absolute()
        return
    with temporary_folder() as folder:
        yield folder


def _input_folder(folder: Path, case: EncoderInput) -> Path:
    """Return the folder of an input's first run; it need not exist."""
    return folder / case.name.replace("/", "-")


@dataclass
class _StepCounter:
    """A counter of the steps of a run.

    Attributes:
        count: number of steps.
        progress: called with `done` and `count` after each step; `None` for no reports.
        done: number of steps that are done.
    """

    count: int
    progress: Callable[[int, int], None] | None
    done: int = 0

    def advance(self) -> None:
        """Count a step as done."""
        self.done += 1
        if self.progress is not None:
            self.progress(self.done, self.count)


def _run_inputs(
    pool: ThreadPoolExecutor,
    command: str,
    inputs: Sequence[EncoderInput],
    folder: Path,
    seconds: float,
    run: CommandRunner | None,
    steps: _StepCounter,
) -> tuple[list[EncoderRun], list[Future[EncoderRun] | None]]:
    """Run all inputs, then start the repetitions of the runs that wrote a file.

    Args:
        pool: runs the commands.
        command: see `run_encoder`.
        inputs: the inputs.
        folder: folder of the files, one subfolder per run.
        seconds: time limit of each run.
        run: runs a command line in this process; `None` for a process each, which is repeated after `REPEAT_SECONDS`.
        steps: counts the first runs.

    Returns:
        The first run of each input, and its repetition, which may still be running; `None` if no file was written.
    """

    def repeat(case: EncoderInput, first: EncoderRun) -> EncoderRun:
        if run is None:
            time.sleep(max(0.0, first.started + REPEAT_SECONDS - time.monotonic()))
        first_folder = _input_folder(folder, case)
        return run_once(command, case, first_folder.with_name(first_folder.name + _REPEATED), seconds, run)

    futures = [pool.submit(run_once, command, case, _input_folder(folder, case), seconds, run) for case in inputs]
    firsts = []
    for future in futures:
        firsts.append(future.result())
        steps.advance()
    pairs = zip(inputs, firsts, strict=True)
    return firsts, [pool.submit(repeat, case, first) if first.wrote else None for case, first in pairs]


def _remove_repetition(folder: Path, case: EncoderInput, first: EncoderRun, again: EncoderRun | None) -> None:
    """Remove the folder of a repetition if it gave the same file."""
    if again is not None and again.wrote and first.out.read_bytes() == again.out.read_bytes():
        first_folder = _input_folder(folder, case)
        shutil.rmtree(first_folder.with_name(first_folder.name + _REPEATED))


def _summarise_declined(declined: dict[str, bool]) -> list[str]:
    """Return a line with the number of declined inputs for each group, as a warning if all were declined."""
    notes = []
    for group in dict.fromkeys(name.partition("/")[0] for name in declined):
        answers = [was_declined for name, was_declined in declined.items() if name.partition("/")[0] == group]
        if any(answers):
            prefix = "warning: " if all(answers) and len(answers) > 1 else ""
            notes.append(f"{prefix}{group}: {sum(answers)} of {len(answers)} declined")
    return notes


@dataclass(frozen=True)
class CheckOptions:
    """The checks to make; see `EncoderSuiteOptions` and `run_encoder`.

    Attributes:
        levels: levels to report.
        psnr_min: lowest PSNR that passes L4, dB.
        render_score: computes the PSNR for L4; `None` if nothing can render.
        no_render_reason: the reason if nothing can render.
    """

    levels: tuple[str, ...]
    psnr_min: float
    render_score: RenderScore | None
    no_render_reason: str


def check_input(
    case: EncoderInput, first: EncoderRun, again: EncoderRun | None, checks: CheckOptions
) -> Iterator[Outcome]:
    """Check the runs of an input level by level; if one fails, the levels that depend on it are skipped.

    L4 is checked if it is requested, or if L3 is requested and cannot verify any error.

    Args:
        case: the input.
        first: the run to check.
        again: its repetition; `None` if the first run wrote no file.
        checks: the checks to make.
    """

    def outcome(level: str, verdict: Verdict, seconds: float = 0.0) -> Outcome:
        facts = (verdict.clauses, verdict.code, verdict.message, seconds, verdict.details)
        return Outcome(case.name, level, verdict.status, *facts)

    for level, verdict in _check_by_level(case, first, again, checks):
        if level in checks.levels or (level == "L4" and verdict.status is not Status.SKIPPED):
            yield outcome(level, verdict, first.end.seconds if level == "L1" else 0.0)


def _check_by_level(
    case: EncoderInput, first: EncoderRun, again: EncoderRun | None, checks: CheckOptions
) -> Iterator[tuple[str, Verdict]]:
    """Yield each level with its verdict; without a file, a valid L1 and a source, the others are skipped.

    An input that must be refused has only L1. See `check_input` for the arguments.
    """

    def skip_others(why: str) -> Iterator[tuple[str, Verdict]]:
        return ((level, Verdict(Status.SKIPPED, why)) for level in LEVELS[1:] if not case.must_refuse)

    end = check_end(case, first)
    if end is not None:
        yield "L1", end
        yield from skip_others("no file was written" if end.status in (Status.PASSED, Status.DECLINED) else "L1 failed")
        return
    data = first.out.read_bytes()
    stream, scene = check_stream(data)
    wrong = find_side_effects(first, again) if stream.status is Status.PASSED else []
    yield "L1", failed_verdict(wrong, stream.details) if wrong else stream
    if scene is None or case.source is None:
        yield from skip_others("L1 failed")
        return
    content, pairs = check_content(case, case.source(), scene, first.index)
    yield "L2", content
    errors, render_reason = check_errors(case, scene, pairs)
    yield "L3", errors
    yield "L4", _check_renders(case, scene, pairs, data, render_reason if "L3" in checks.levels else "", checks)


def _check_renders(
    case: EncoderInput, scene: DecodedScene, pairs: SplatPairs, data: bytes, render_reason: str, checks: CheckOptions
) -> Verdict:
    """Check L4, if it is requested or needed.

    Args:
        case: the input.
        scene: the decoded scene.
        pairs: the source splat of each decoded splat.
        data: the file.
        render_reason: the reason why only renders can check the file; empty if errors were verified.
        checks: the checks to make.
    """
    if not case.renders or case.source is None:
        return Verdict(Status.SKIPPED, "renders of this scene are not informative")
    if not (render_reason or "L4" in checks.levels):
        return Verdict(Status.SKIPPED)
    if checks.render_score is not None:
        return check_renders(case, case.source(), scene, pairs, data, checks.render_score, checks.psnr_min)
    if render_reason:
        return Verdict(Status.FAILED, f"{render_reason}: only renders can check it, and {checks.no_render_reason}")
    return Verdict(Status.SKIPPED, checks.no_render_reason)


def _input_json(case: EncoderInput, data: bytes) -> dict[str, Any]:
    """Return the entry of an input, whose file has the bytes `data`, in the list of inputs."""
    return {
        "name": case.name,
        "file": f"{case.name}.ply",
        "why": case.why,
        "refusal": "must" if case.must_refuse else "may" if case.may_refuse else "no",
        "expected": _expected_json(case, data),
    }


def _expected_json(case: EncoderInput, data: bytes) -> dict[str, Any] | None:
    """Return the facts that a file of the input must agree with; `None` if it has no source."""
    if case.source is None:
        return None
    source = case.source()
    return {
        "splats": len(source),
        "rows": _row_count(data),
        "sh_degree": source.sh_degree,
        "extra_columns": sorted(source.extra),
        "apart": case.separation,
        "renders": case.renders,
        "psnr_min": case.psnr_required(PSNR_MIN) if case.renders else None,
    }


def _row_count(data: bytes) -> int:
    """Return the number of rows in the header: 64 for `element vertex 64`."""
    # Comments may contain anything, including `end_header` and `element vertex 9`.
    for line in data.split(b"\n"):
        words = line.split()
        if words[:2] == [b"element", b"vertex"]:
            return int(words[2])
    raise ValueError("the input has no element vertex")
