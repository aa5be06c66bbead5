"""Run an encoder over the reference inputs."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from csplat.errors import InputError
from csplat_conformance.choosing import matching
from csplat_conformance.encoders.inputs import PSNR_MIN, Input, all_inputs
from csplat_conformance.encoders.levels import LEVELS, Asked, judge_input
from csplat_conformance.encoders.picturing import PictureJudge
from csplat_conformance.encoders.trial import AGAIN_SECONDS, OPTIONAL_PLACES, PLACES, Runner, Trial, try_once
from csplat_conformance.process import split_command
from csplat_conformance.report import Outcome, Report, Status

TIMEOUT_SECONDS = 60.0

_NO_PICTURES = "nothing renders here"
_AGAIN = ".again"


@dataclass(frozen=True)
class EncoderChoice:
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
    choice: EncoderChoice | None = None,
    *,
    pictures: PictureJudge | None = None,
    no_pictures: str = _NO_PICTURES,
    progress: Callable[[int, int], None] | None = None,
    run: Runner | None = None,
) -> Report:
    """Run an encoder over the inputs.

    It is started for each: status 0 and a complete file at `{out}`, or status 1, a line with the reason and no file.
    If it wrote a file, it is started once more, after all others: the bytes have to be the same.

    Args:
        command: its command line, with `{ply}` and `{out}`, and perhaps `{index}`, where it writes which splat of the
            source each splat of the file is.
        choice: settings of the run.
        pictures: judges L4; without it the level is skipped, or fails if nothing else can judge.
        no_pictures: why there is no judge of L4.
        progress: called with the number of steps done and the total.
        run: runs the command line with `ply`, `out` and `index` put in, within some seconds, in this process; on
            `choice.jobs` threads. Without it processes are started, each in an empty working
            directory, and `AGAIN_SECONDS` go by before a repetition.

    Raises:
        InputError: the command line is not one, there is no such program, or no such level, or a pattern matches no
            input.
    """
    choice = choice or EncoderChoice()
    split_command(command, PLACES, OPTIONAL_PLACES)
    unknown = [level for level in choice.levels if level not in LEVELS]
    if unknown:
        raise InputError(f"there is no level {', '.join(unknown)}, wanted {', '.join(LEVELS)}")
    inputs = chosen_inputs(choice.pattern)
    asked = Asked(choice.levels, choice.psnr_min, pictures, no_pictures)
    outcomes: list[Outcome] = []
    declined: dict[str, bool] = {}
    with _folder(choice.keep) as folder, ThreadPoolExecutor(choice.jobs or os.cpu_count() or 1) as pool:
        try:
            steps = _Steps(2 * len(inputs), progress)
            firsts, repeated = _try_all(pool, command, inputs, folder, choice.timeout_seconds, run, steps)
            for one, first, future in zip(inputs, firsts, repeated, strict=True):
                # Judged here, one after the other: rendering uses all cores by itself.
                again = future.result() if future is not None else None
                outcomes += _judged(one, first, again, asked)
                if one.may_refuse:
                    declined[one.name] = first.ended.status is None and first.ended.returncode == 1
                with suppress(OSError):
                    _forget(folder, one, first, again)
                steps.go()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    notes = _notes(declined)
    if pictures is None and "L4" in choice.levels and inputs:
        notes.append(f"L4 SKIPPED: {no_pictures}")
    extra = (Status.WARNED, Status.DECLINED, Status.NOT_PROVED)
    return Report("encoder", command, outcomes, notes, extra)


def _judged(one: Input, first: Trial, again: Trial | None, asked: Asked) -> list[Outcome]:
    """Judge an input; what cannot be read or drawn is a failure of this one alone."""
    outcomes: list[Outcome] = []
    try:
        outcomes.extend(judge_input(one, first, again, asked))
    except (InputError, OSError) as error:
        level = LEVELS[min(len(outcomes), len(LEVELS) - 1)]
        outcomes.append(Outcome(one.name, level, Status.FAILED, message=str(error)))
    return outcomes


def chosen_inputs(pattern: str | None) -> list[Input]:
    """Return the inputs of some names, in the order of a run.

    Args:
        pattern: see `EncoderChoice`.

    Raises:
        InputError: a pattern matches none.
    """
    inputs = all_inputs()
    names = matching(pattern, [one.name for one in inputs], "input")
    return [one for one in inputs if one.name in names]


@contextmanager
def _folder(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        yield keep.absolute()
        return
    with tempfile.TemporaryDirectory(prefix="csplat-encoder-") as name:
        yield Path(name)


def _place(folder: Path, one: Input) -> Path:
    return folder / one.name.replace("/", "-")


@dataclass
class _Steps:
    """The progress of a run."""

    count: int
    progress: Callable[[int, int], None] | None
    done: int = 0

    def go(self) -> None:
        """Count one step as done."""
        self.done += 1
        if self.progress is not None:
            self.progress(self.done, self.count)


def _try_all(
    pool: ThreadPoolExecutor,
    command: str,
    inputs: Sequence[Input],
    folder: Path,
    seconds: float,
    run: Runner | None,
    steps: _Steps,
) -> tuple[list[Trial], list[Future[Trial] | None]]:
    """Run all inputs, then begin with the repetitions of those that gave a file."""

    def again(one: Input, first: Trial) -> Trial:
        if run is None:
            time.sleep(max(0.0, first.started + AGAIN_SECONDS - time.monotonic()))
        place = _place(folder, one)
        return try_once(command, one, place.with_name(place.name + _AGAIN), seconds, run)

    begun = [pool.submit(try_once, command, one, _place(folder, one), seconds, run) for one in inputs]
    firsts = []
    for future in begun:
        firsts.append(future.result())
        steps.go()
    pairs = zip(inputs, firsts, strict=True)
    return firsts, [pool.submit(again, one, first) if first.wrote else None for one, first in pairs]


def _forget(folder: Path, one: Input, first: Trial, again: Trial | None) -> None:
    """Remove a repetition that gave the same file; if the files differ, keep both."""
    if again is not None and again.wrote and first.out.read_bytes() == again.out.read_bytes():
        place = _place(folder, one)
        shutil.rmtree(place.with_name(place.name + _AGAIN))


def _notes(declined: dict[str, bool]) -> list[str]:
    """Say how many of the inputs that may be refused were; all of them is worth a warning."""
    notes = []
    for group in dict.fromkeys(name.partition("/")[0] for name in declined):
        those = [gone for name, gone in declined.items() if name.partition("/")[0] == group]
        if any(those):
            word = "warning: " if all(those) and len(those) > 1 else ""
            notes.append(f"{word}{group}: {sum(those)} of {len(those)} declined")
    return notes
