"""Run an encoder over the reference inputs and check its files level by level."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from csplat.decoder import DecodedScene
from csplat.errors import InputError
from csplat.files import atomic_writer
from csplat_conformance.conformance_report import ConformanceReport, Outcome, Status
from csplat_conformance.encoders.encoder_inputs import PSNR_MIN, EncoderInput, all_inputs
from csplat_conformance.encoders.encoder_run import (
    OPTIONAL_PLACES,
    PLACES,
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
_AGAIN = ".again"


@dataclass(frozen=True)
class EncoderSuiteOptions:
    """Settings of a run of the encoder suite.

    Attributes:
        pattern: shell patterns of the inputs' names, `ordinary/*,nasty/empty`; `None` for all.
        levels: levels to report; each depends on the ones before it, which are run but not reported. If L3 proves
            nothing, L4 is judged, too.
        timeout_seconds: time limit for one input.
        psnr_min: lowest PSNR that passes L4, dB; inputs with another limit keep their difference from the default.
        jobs: number of processes at a time; default: one per core.
        keep: folder for the inputs and their results, a folder for each; `None` keeps nothing.
    """

    pattern: str | None = None
    levels: tuple[str, ...] = LEVELS
    timeout_seconds: float = TIMEOUT_SECONDS
    psnr_min: float = PSNR_MIN
    jobs: int | None = None
    keep: Path | None = None


def run_encoder(
    command: str,
    choice: EncoderSuiteOptions | None = None,
    *,
    render_score: RenderScore | None = None,
    no_render_reason: str = _NO_RENDERER,
    progress: Callable[[int, int], None] | None = None,
    run: CommandRunner | None = None,
) -> ConformanceReport:
    """Run an encoder over the inputs.

    It is started for each: status 0 and a complete file at `{out}`, or status 1, a line with the reason and no file.
    If it wrote a file, it is started once more, after all others: the bytes have to be the same.

    Args:
        command: its command line, with `{ply}` and `{out}`, and perhaps `{index}`, where it writes which splat of the
            source each splat of the file is.
        choice: settings of the run.
        render_score: judges L4; without it the level is skipped, or fails if nothing else can judge.
        no_render_reason: why there is no judge of L4.
        progress: called with the number of steps done and the total.
        run: runs the command line with `ply`, `out` and `index` put in, within some seconds, in this process; on
            `choice.jobs` threads. Without it processes are started, each in an empty working
            directory, and `REPEAT_SECONDS` go by before a repetition.

    Raises:
        InputError: the command line is not one, there is no such program, or no such level, or a pattern matches no
            input.
    """
    choice = choice or EncoderSuiteOptions()
    split_command(command, PLACES, OPTIONAL_PLACES)
    unknown = [level for level in choice.levels if level not in LEVELS]
    if unknown:
        raise InputError(f"there is no level {', '.join(unknown)}, wanted {', '.join(LEVELS)}")
    inputs = select_inputs(choice.pattern)
    asked = CheckOptions(choice.levels, choice.psnr_min, render_score, no_render_reason)
    outcomes: list[Outcome] = []
    declined: dict[str, bool] = {}
    with _work_folder(choice.keep) as folder, ThreadPoolExecutor(choice.jobs or os.cpu_count() or 1) as pool:
        try:
            steps = _StepCounter(2 * len(inputs), progress)
            firsts, repeated = _run_all(pool, command, inputs, folder, choice.timeout_seconds, run, steps)
            for one, first, future in zip(inputs, firsts, repeated, strict=True):
                # Judged here, one after the other: rendering uses all cores by itself.
                again = future.result() if future is not None else None
                outcomes += _check_input_safely(one, first, again, asked)
                if one.may_refuse:
                    declined[one.name] = first.ended.status is None and first.ended.returncode == 1
                with suppress(OSError):
                    _remove_repetition(folder, one, first, again)
                steps.go()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    notes = _declined_notes(declined)
    if render_score is None and "L4" in choice.levels and inputs:
        notes.append(f"L4 SKIPPED: {no_render_reason}")
    extra = (Status.WARNED, Status.DECLINED, Status.NOT_PROVED)
    return ConformanceReport("encoder", command, outcomes, notes, extra)


def _check_input_safely(
    one: EncoderInput, first: EncoderRun, again: EncoderRun | None, asked: CheckOptions
) -> list[Outcome]:
    """Judge an input; what cannot be read or drawn is a failure of this one alone."""
    outcomes: list[Outcome] = []
    try:
        outcomes.extend(check_input(one, first, again, asked))
    except (InputError, OSError) as error:
        level = LEVELS[min(len(outcomes), len(LEVELS) - 1)]
        outcomes.append(Outcome(one.name, level, Status.FAILED, message=str(error)))
    return outcomes


def select_inputs(pattern: str | None) -> list[EncoderInput]:
    """Return the inputs of some names, in the order of a run.

    Args:
        pattern: see `EncoderSuiteOptions`.

    Raises:
        InputError: a pattern matches none.
    """
    inputs = all_inputs()
    names = select_names(pattern, [one.name for one in inputs], "input")
    return [one for one in inputs if one.name in names]


@contextmanager
def _work_folder(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        yield keep.absolute()
        return
    with tempfile.TemporaryDirectory(prefix="csplat-encoder-") as name:
        yield Path(name)


def _input_folder(folder: Path, one: EncoderInput) -> Path:
    return folder / one.name.replace("/", "-")


@dataclass
class _StepCounter:
    """The progress of a run."""

    count: int
    progress: Callable[[int, int], None] | None
    done: int = 0

    def go(self) -> None:
        """Count one step as done."""
        self.done += 1
        if self.progress is not None:
            self.progress(self.done, self.count)


def _run_all(
    pool: ThreadPoolExecutor,
    command: str,
    inputs: Sequence[EncoderInput],
    folder: Path,
    seconds: float,
    run: CommandRunner | None,
    steps: _StepCounter,
) -> tuple[list[EncoderRun], list[Future[EncoderRun] | None]]:
    """Run all inputs, then begin with the repetitions of those that gave a file."""

    def again(one: EncoderInput, first: EncoderRun) -> EncoderRun:
        if run is None:
            time.sleep(max(0.0, first.started + REPEAT_SECONDS - time.monotonic()))
        place = _input_folder(folder, one)
        return run_once(command, one, place.with_name(place.name + _AGAIN), seconds, run)

    begun = [pool.submit(run_once, command, one, _input_folder(folder, one), seconds, run) for one in inputs]
    firsts = []
    for future in begun:
        firsts.append(future.result())
        steps.go()
    pairs = zip(inputs, firsts, strict=True)
    return firsts, [pool.submit(again, one, first) if first.wrote else None for one, first in pairs]


def _remove_repetition(folder: Path, one: EncoderInput, first: EncoderRun, again: EncoderRun | None) -> None:
    """Remove a repetition that gave the same file; if the files differ, keep both."""
    if again is not None and again.wrote and first.out.read_bytes() == again.out.read_bytes():
        place = _input_folder(folder, one)
        shutil.rmtree(place.with_name(place.name + _AGAIN))


def _declined_notes(declined: dict[str, bool]) -> list[str]:
    """Say how many of the inputs that may be refused were; all of them is worth a warning."""
    notes = []
    for group in dict.fromkeys(name.partition("/")[0] for name in declined):
        those = [gone for name, gone in declined.items() if name.partition("/")[0] == group]
        if any(those):
            word = "warning: " if all(those) and len(those) > 1 else ""
            notes.append(f"{word}{group}: {sum(those)} of {len(those)} declined")
    return notes


@dataclass(frozen=True)
class CheckOptions:
    """The checks that are requested of an encoder.

    Attributes:
        levels: levels to report; each depends on the ones before it, which are judged but not reported.
        psnr_min: lowest PSNR that passes L4, dB.
        render_score: judge of L4; `None` if nothing can render.
        no_render_reason: why nothing can render.
    """

    levels: tuple[str, ...]
    psnr_min: float
    render_score: RenderScore | None
    no_render_reason: str


def check_input(
    one: EncoderInput, first: EncoderRun, again: EncoderRun | None, asked: CheckOptions
) -> Iterator[Outcome]:
    """Judge what became of an input.

    L4 is judged if it is requested, and if L3 is requested and proves nothing.

    Args:
        one: the input.
        first: the run that is judged.
        again: a second one; `None` if the first wrote no file.
        asked: the checks to make.
    """

    def outcome(level: str, verdict: Verdict, seconds: float = 0.0) -> Outcome:
        facts = (verdict.clauses, verdict.code, verdict.message, seconds, verdict.details)
        return Outcome(one.name, level, verdict.status, *facts)

    for level, verdict in _check_levels(one, first, again, asked):
        if level in asked.levels or (level == "L4" and verdict.status is not Status.SKIPPED):
            yield outcome(level, verdict, first.ended.seconds if level == "L1" else 0.0)


def _check_levels(
    one: EncoderInput, first: EncoderRun, again: EncoderRun | None, asked: CheckOptions
) -> Iterator[tuple[str, Verdict]]:
    def skipped(why: str) -> Iterator[tuple[str, Verdict]]:
        return ((level, Verdict(Status.SKIPPED, why)) for level in LEVELS[1:] if not one.must_refuse)

    end = check_end(one, first)
    if end is not None:
        yield "L1", end
        yield from skipped("no file was written" if end.status in (Status.PASSED, Status.DECLINED) else "L1 failed")
        return
    data = first.out.read_bytes()
    stream, scene = check_stream(data)
    wrong = find_side_effects(first, again) if stream.status is Status.PASSED else []
    yield "L1", failed_verdict(wrong, stream.details) if wrong else stream
    if scene is None or one.source is None:
        yield from skipped("L1 failed")
        return
    content, pairs = check_content(one, one.source(), scene, first.index)
    yield "L2", content
    errors, alone = check_errors(one, scene, pairs)
    yield "L3", errors
    yield "L4", _check_renders(one, scene, pairs, len(data), alone if "L3" in asked.levels else "", asked)


def _check_renders(
    one: EncoderInput, scene: DecodedScene, pairs: SplatPairs, size_bytes: int, alone: str, asked: CheckOptions
) -> Verdict:
    """Judge L4.

    Args:
        one: the input.
        scene: the decoded scene.
        pairs: the source splat of each decoded splat.
        size_bytes: size of the file.
        alone: why nothing but pictures can judge it; nothing if errors are proved.
        asked: the checks to make.
    """
    if not one.renders or one.source is None:
        return Verdict(Status.SKIPPED, "pictures of this scene say nothing")
    if not (alone or "L4" in asked.levels):
        return Verdict(Status.SKIPPED)
    if asked.render_score is not None:
        return check_renders(one, one.source(), scene, pairs, size_bytes, asked.render_score, asked.psnr_min)
    if alone:
        return Verdict(Status.FAILED, f"{alone}: only pictures can judge it, and {asked.no_render_reason}")
    return Verdict(Status.SKIPPED, asked.no_render_reason)


INPUT_LIST = "inputs.json"


def write_inputs(folder: Path, pattern: str | None = None) -> dict[str, Any]:
    """Write the PLY of every input, `ordinary/degree_3.ply`, and a list of them, `inputs.json`.

    Args:
        folder: folder for the files; existing ones are replaced.
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
    for one in select_inputs(pattern):
        file = folder / f"{one.name}.ply"
        file.parent.mkdir(parents=True, exist_ok=True)
        data = one.make()
        with atomic_writer(file) as stream:
            stream.write(data)
        entries.append(_input_json(one, data))
    result = {"inputs": entries}
    with atomic_writer(folder / INPUT_LIST) as stream:
        stream.write((json.dumps(result, indent=2) + "\n").encode())
    return result


def _input_json(one: EncoderInput, data: bytes) -> dict[str, Any]:
    return {
        "name": one.name,
        "file": f"{one.name}.ply",
        "why": one.why,
        "refusal": "must" if one.must_refuse else "may" if one.may_refuse else "no",
        "expected": _expected_json(one, data),
    }


def _expected_json(one: EncoderInput, data: bytes) -> dict[str, Any] | None:
    if one.source is None:
        return None
    source = one.source()
    return {
        "splats": len(source),
        "rows": _row_count(data),
        "sh_degree": source.sh_degree,
        "extra_columns": sorted(source.extra),
        "apart": one.separation,
        "renders": one.renders,
        "psnr_min": one.psnr_required(PSNR_MIN) if one.renders else None,
    }


def _row_count(data: bytes) -> int:
    """Return the number of rows in the header: 64 for `element vertex 64`."""
    # A comment may say anything, `end_header` and `element vertex 9` too.
    for line in data.split(b"\n"):
        words = line.split()
        if words[:2] == [b"element", b"vertex"]:
            return int(words[2])
    raise ValueError("the input has no element vertex")
