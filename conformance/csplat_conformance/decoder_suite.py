"""Run a decoder over the vectors and compare what it returns with the manifest.

    >>> from csplat_conformance.decoder_suite import DecoderSuiteOptions, run_builtin
    >>> run_builtin(DecoderSuiteOptions(pattern="valid/*")).passed
    True

`run_builtin` calls `csplat.decoder` in this process; `run_command` starts another decoder for each vector, by the
protocol of `protocol`. The levels are described in `answers` and `reference_renders`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from csplat.errors import InputError
from csplat_conformance import adapter, reference_renders
from csplat_conformance.answers import LEVELS, PARTS, FloatsByVector, check_payload_consistency, compare_answer
from csplat_conformance.conformance_report import ConformanceReport, Outcome
from csplat_conformance.manifest import VECTORS, Vector, load, select_names
from csplat_conformance.protocol import ask_decoder, split_command
from csplat_conformance.tolerance import CLASSES, EXACT, RENDERER

#: Seconds that another decoder has for each vector; the largest is of 65,536 splats.
TIMEOUT_SECONDS = 60.0

#: Called after each vector: how many are done, of how many.
CountProgress = Callable[[int, int], None]


@dataclass(frozen=True)
class DecoderSuiteOptions:
    """Settings of a run of the decoder suite.

    Attributes:
        pattern: shell patterns of the vectors' names, `valid/sh*,valid/rich`; None for all.
        clause: shell patterns of clauses, `HDR-*,LIM-1`: vectors that cover one of them; None for all.
        levels: levels to check, of 1 to 4.
        exact: require refusals to match in code, clause and offset, even optional ones: for csplat's own decoders.
        timeout: time limit for one process, seconds.
        jobs: number of processes at a time; None for the number of processors.
        by: the class of decoders (spec 9.2) whose rules apply.
    """

    pattern: str | None = None
    clause: str | None = None
    levels: tuple[int, ...] = tuple(PARTS)
    exact: bool = False
    timeout: float = TIMEOUT_SECONDS
    jobs: int | None = None
    by: str = EXACT

    def __post_init__(self) -> None:
        if not self.levels or any(level not in LEVELS for level in self.levels):
            raise InputError(f"levels {list(self.levels)}, wanted some of {list(LEVELS)}")
        if not self.timeout > 0:
            raise InputError(f"a timeout of {self.timeout:g} s, wanted more than 0")
        if self.jobs is not None and self.jobs < 1:
            raise InputError(f"{self.jobs} jobs, wanted 1 or more")
        if self.by not in CLASSES:
            raise InputError(f"the class {self.by!r} of decoders, wanted {' or '.join(CLASSES)}")

    @property
    def near(self) -> FloatsByVector | None:
        """The exact floats by vector, for decoders of the class renderer; None if floats must be equal bit for bit."""
        return adapter.exact_floats if self.by == RENDERER else None


def parse_levels(text: str) -> tuple[int, ...]:
    """Parse levels: `3` means all up to 3, `1,3` those two.

    Raises:
        InputError: there are no such levels.
    """
    try:
        numbers = [int(part.strip().upper().removeprefix("L")) for part in text.split(",")]
    except ValueError:
        raise InputError(f"the level {text!r}, wanted 1 to {LEVELS[-1]}, or some of them as 1,3") from None
    if any(number not in LEVELS for number in numbers):
        raise InputError(f"the level {text!r}, wanted 1 to {LEVELS[-1]}, or some of them as 1,3")
    return tuple(level for level in LEVELS if level <= numbers[0]) if len(numbers) == 1 else tuple(sorted(set(numbers)))


def run_builtin(choice: DecoderSuiteOptions | None = None, progress: CountProgress | None = None) -> ConformanceReport:
    """Run csplat's decoder over the vectors; its refusals must match in code, clause and offset.

    Args:
        choice: settings of the run; `exact`, `timeout` and `jobs` do not apply.
        progress: called with the number of vectors that are done.

    Raises:
        InputError: a pattern of `choice` matches nothing.
    """
    choice = choice or DecoderSuiteOptions()

    def run(vector: Vector) -> list[Outcome]:
        outcomes = []
        if any(level in choice.levels for level in PARTS):
            outcomes = compare_answer(vector, adapter.answer(vector.data), choice.levels, exact=True, near=choice.near)
        if 4 in choice.levels and vector.views:
            if reference_renders.can_render():
                outcomes += reference_renders.score_own_renderer(vector)
            else:
                outcomes += reference_renders.skip_views(vector, "needs the packages of the extra render")
        return outcomes

    chosen = _select_vectors(choice)
    results = []
    for done, vector in enumerate(chosen, 1):
        results.append(run(vector))
        if progress:
            progress(done, len(chosen))
    return _make_report("csplat's decoder", results, choice)


def run_command(
    command: str | None,
    choice: DecoderSuiteOptions | None = None,
    *,
    render: str | None = None,
    progress: CountProgress | None = None,
) -> ConformanceReport:
    """Run another decoder, another renderer, or both over the vectors.

    Args:
        command: command line of the decoder with `{input}` and `{outdir}`; None to test a renderer alone.
        choice: settings of the run.
        render: command line of the renderer with `{input}`, `{camera}` and `{out}` or `{outdir}`, for L4.
        progress: called with the number of vectors that are done.

    Raises:
        InputError: a command line that cannot be run; a pattern of `choice` matches nothing.
    """
    choice = choice or DecoderSuiteOptions()
    if command is not None:
        split_command(command, ("input", "outdir"))
    if render is not None:
        split_command(render, ("input", "camera", "outdir" if "{outdir}" in render else "out"))

    def run(vector: Vector) -> list[Outcome]:
        outcomes = []
        if command is not None and any(level in choice.levels for level in PARTS):
            answer = ask_decoder(command, VECTORS / vector.file, choice.timeout, keep_floats=choice.near is not None)
            outcomes = compare_answer(vector, answer, choice.levels, exact=choice.exact, near=choice.near)
        if 4 in choice.levels:
            if render is None:
                outcomes += reference_renders.skip_views(vector, "no command of a renderer was given")
            else:
                outcomes += reference_renders.score_renderer(vector, render, choice.timeout)
        return outcomes

    chosen = _select_vectors(choice)
    if command is None:
        chosen = [vector for vector in chosen if vector.views]
    results = []
    with ThreadPoolExecutor(choice.jobs or os.cpu_count() or 1) as pool:
        for done, outcomes in enumerate(pool.map(run, chosen), 1):
            results.append(outcomes)
            if progress:
                progress(done, len(chosen))
    return _make_report(command or render or "", results, choice)


def _select_vectors(choice: DecoderSuiteOptions) -> list[Vector]:
    vectors = load()
    names = select_names(choice.pattern, [vector.name for vector in vectors], "vector")
    clauses = select_names(
        choice.clause, {clause for vector in vectors for clause in vector.clauses}, "clause of a vector"
    )
    return [vector for vector in vectors if vector.name in names and clauses & {*vector.clauses}]


def _make_report(subject: str, results: Sequence[list[Outcome]], choice: DecoderSuiteOptions) -> ConformanceReport:
    outcomes, notes = check_payload_consistency(outcome for result in results for outcome in result)
    if choice.by != EXACT:
        notes.append(f"judged as a decoder of the class {choice.by}")
    return ConformanceReport("decoder", subject, outcomes, notes)
