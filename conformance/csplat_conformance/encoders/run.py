"""Run an encoder over the reference inputs."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from csplat.errors import InputError
from csplat_conformance.choosing import matching
from csplat_conformance.encoders.inputs import PSNR_MIN, Input, all_inputs
from csplat_conformance.encoders.judge import (
    PictureJudge,
    Verdict,
    judge_content,
    judge_errors,
    judge_pictures,
    judge_stream,
)
from csplat_conformance.process import Ended, run_program, split_command
from csplat_conformance.report import Outcome, Report, Status

__all__ = ["LEVELS", "PSNR_MIN", "TIMEOUT_SECONDS", "EncoderChoice", "run_encoder"]

LEVELS = ("L1", "L2", "L3", "L4")
TIMEOUT_SECONDS = 60.0

#: Runs a command line with some places put in, within some seconds.
Runner = Callable[[str, Mapping[str, str], float], Ended]

_NAMES = ("ply", "out")
_TRACEBACK = b"Traceback (most recent call last)"
_LINE_MAX = 200  # characters of a program's line that are shown
_NO_PICTURES = "nothing renders here"


@dataclass(frozen=True)
class EncoderChoice:
    """What to run.

    Attributes:
        pattern: shell patterns of the inputs' names, `ordinary/*,nasty/empty`; `None` for all.
        levels: those wanted; each needs the ones before it, which are run and not reported.
        timeout_seconds: for one input.
        psnr_min: dB, of L4; inputs that want more or less than the usual do so by as much here.
        jobs: processes at a time; one per core if left out.
        keep: folder for the inputs and what was made of them; `None` keeps nothing.
    """

    pattern: str | None = None
    levels: tuple[str, ...] = LEVELS
    timeout_seconds: float = TIMEOUT_SECONDS
    psnr_min: float = PSNR_MIN
    jobs: int | None = None
    keep: Path | None = None


def run_encoder(
    command: str,
    choice: EncoderChoice | None = None,
    *,
    pictures: PictureJudge | None = None,
    no_pictures: str = _NO_PICTURES,
    progress: Callable[[int, int], None] | None = None,
    run: Runner = run_program,
) -> Report:
    """Run an encoder over the inputs.

    It is started once for each: status 0 and a complete file at `{out}`, or status 1, a line that says why and no
    file.

    Args:
        command: its command line, with `{ply}` and `{out}`.
        choice: what to run.
        pictures: judges L4; without it the level is skipped.
        no_pictures: why it is.
        progress: is told how many inputs of how many are done.
        run: runs the command line with `ply` and `out` put in, within some seconds; `run_program` starts a process.
            On threads, as many as `choice.jobs` says.

    Raises:
        InputError: the command line is not one, there is no such program, or no such level, or a pattern matches no
            input.
    """
    choice = choice or EncoderChoice()
    split_command(command, _NAMES)
    unknown = [level for level in choice.levels if level not in LEVELS]
    if unknown:
        raise InputError(f"there is no level {', '.join(unknown)}, wanted {', '.join(LEVELS)}")
    names = matching(choice.pattern, [one.name for one in all_inputs()], "input")
    inputs = [one for one in all_inputs() if one.name in names]
    outcomes: list[Outcome] = []
    with _folder(choice.keep) as folder, ThreadPoolExecutor(choice.jobs or os.cpu_count() or 1) as pool:
        started = [pool.submit(_run, run, command, one, folder, choice.timeout_seconds) for one in inputs]
        try:
            for done, (one, future) in enumerate(zip(inputs, started, strict=True)):
                # Judged here, one after the other: rendering uses all cores by itself.
                levels = _judge(one, future.result(), folder, pictures, no_pictures, choice)
                outcomes += [outcome for outcome in levels if outcome.level in choice.levels]
                if progress is not None:
                    progress(done + 1, len(inputs))
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    wants_pictures = pictures is None and "L4" in choice.levels
    notes = (f"L4 SKIPPED: {no_pictures}",) if wants_pictures and inputs else ()
    return Report("encoder", command, outcomes, notes)


@contextmanager
def _folder(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        yield keep
        return
    with tempfile.TemporaryDirectory(prefix="csplat-encoder-") as name:
        yield Path(name)


def _places(one: Input, folder: Path) -> tuple[Path, Path]:
    stem = one.name.replace("/", "-")
    return folder / f"{stem}.ply", folder / f"{stem}.csplat"


def _run(run: Runner, command: str, one: Input, folder: Path, timeout_seconds: float) -> Ended:
    ply, out = _places(one, folder)
    ply.write_bytes(one.make())
    out.unlink(missing_ok=True)  # of an earlier run that was kept
    return run(command, {"ply": str(ply), "out": str(out)}, timeout_seconds)


# Judging -------------------------------------------------------------------------------------------


def _judge(
    one: Input,
    ended: Ended,
    folder: Path,
    pictures: PictureJudge | None,
    no_pictures: str,
    choice: EncoderChoice,
) -> Iterator[Outcome]:
    """Judge level by level; where one fails, those that need it are skipped."""

    def outcome(level: str, verdict: Verdict, seconds: float = 0.0) -> Outcome:
        facts = (verdict.clauses, verdict.code, verdict.message, seconds, verdict.details)
        return Outcome(one.name, level, verdict.status, *facts)

    def skipped(after: str, why: str) -> Iterator[Outcome]:
        for level in () if one.must_refuse else LEVELS[LEVELS.index(after) + 1 :]:
            yield outcome(level, Verdict(Status.SKIPPED, why))

    _, out = _places(one, folder)
    verdict = _judge_end(one, ended, out)
    if verdict is not None:
        yield outcome("L1", verdict, ended.seconds)
        yield from skipped("L1", "no file was written" if verdict.status is Status.PASSED else "L1 failed")
        return
    stream, scene = judge_stream(out.read_bytes())
    yield outcome("L1", stream, ended.seconds)
    if scene is None or one.source is None:
        yield from skipped("L1", "L1 failed")
        return
    source = one.source()
    content, pairs = judge_content(one, source, scene)
    yield outcome("L2", content)
    yield outcome("L3", judge_errors(source, scene, pairs))
    if pictures is None:
        yield outcome("L4", Verdict(Status.SKIPPED, no_pictures))
    elif "L4" in choice.levels:
        yield outcome("L4", judge_pictures(one, source, scene, pictures, choice.psnr_min))


def _judge_end(one: Input, ended: Ended, out: Path) -> Verdict | None:
    """Judge how the program ended; `None` where there is a file to look at."""
    if ended.status is not None:
        return Verdict(ended.status, _with_line(ended.message, ended))
    if ended.returncode == 1:
        return _judge_refusal(one, ended, out)
    if not out.exists():
        return Verdict(Status.NO_OUTPUT, "exit status 0, and there is no file")
    if one.must_refuse:
        return Verdict(Status.FAILED, "accepted, though there are no splats in it")
    return None


def _judge_refusal(one: Input, ended: Ended, out: Path) -> Verdict:
    if _TRACEBACK in ended.stderr:
        return Verdict(Status.CRASHED, _with_line("a traceback", ended))
    if out.exists():
        return Verdict(Status.PARTIAL_OUTPUT, "exit status 1, and there is a file")
    line = _last_line(ended)
    if not line:
        return Verdict(Status.WRONG_ANSWER, "exit status 1 without a line that says why")
    if one.must_refuse or one.may_refuse:
        return Verdict(Status.PASSED, f"refused: {line}")
    return Verdict(Status.REFUSED, line)


def _last_line(ended: Ended) -> str:
    text = (ended.stderr.strip() or ended.stdout.strip()).decode("utf-8", "replace")
    return text.splitlines()[-1].strip()[:_LINE_MAX] if text else ""


def _with_line(message: str, ended: Ended) -> str:
    line = _last_line(ended)
    return f"{message}; its last line: {line}" if line else message
