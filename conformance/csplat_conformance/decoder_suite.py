# SPDX-License-Identifier: CC0-1.0
"""Run a decoder over the vectors and compare its results with the manifest.

    >>> from csplat_conformance.decoder_suite import DecoderSuiteOptions, run_builtin
    >>> run_builtin(DecoderSuiteOptions(pattern="valid/*")).passed
    True

`run_builtin` calls `csplat.decoder` in this process. `run_command` starts another decoder for each vector, by the
protocol described in `protocol`. `answers` and `reference_renders` describe the levels.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

from csplat import _spec
from csplat.decoder.container import HIGHEST_LEVEL
from csplat.decoder.limits import Limits
from csplat.errors import CsplatError, InputError
from csplat_conformance import adapter, reference_renders
from csplat_conformance.answers import (
    CUTS,
    LEVELS,
    PARTS,
    RENDERS,
    Answer,
    FloatsByVector,
    check_payload_consistency,
    compare_answer,
    compare_cuts,
    cuts_of_vector,
    skip_cuts,
)
from csplat_conformance.conformance_report import ConformanceReport, Outcome, Status
from csplat_conformance.manifest import VECTORS, Vector, load, select_names
from csplat_conformance.protocol import ask_cuts, ask_decoder, split_command
from csplat_conformance.tolerance import CLASSES, EXACT, RENDERER

TIMEOUT_SECONDS = 60.0  #: per vector; the largest has 65,536 splats

#: Called after each vector with the number of vectors done and the total.
CountProgress = Callable[[int, int], None]


@dataclass(frozen=True)
class DecoderSuiteOptions:
    """Settings of a run of the decoder suite.

    Attributes:
        pattern: shell patterns of names of vectors, `valid/sh*,valid/rich`; None for all.
        clause: shell patterns of clauses, `HDR-*,LIM-1`; only vectors that cover one of them are run. None for all.
        levels: levels to check, 1 to 5.
        exact: require refusals to match in code, clause and offset, even optional ones, as csplat's own decoders must.
        timeout: time limit of a process, seconds.
        jobs: number of processes at a time; None: one per core.
        by: class of the decoder (spec 9.2).
        resource_level: highest resource level that the decoder accepts; it must refuse files of higher levels (LIM-2).
    """

    pattern: str | None = None
    clause: str | None = None
    levels: tuple[int, ...] = tuple(PARTS)
    exact: bool = False
    timeout: float = TIMEOUT_SECONDS
    jobs: int | None = None
    by: str = EXACT
    resource_level: str = HIGHEST_LEVEL

    def __post_init__(self) -> None:
        if not self.levels or any(level not in LEVELS for level in self.levels):
            raise InputError(f"the levels are {list(self.levels)}, expected some of {list(LEVELS)}")
        if not self.timeout > 0:
            raise InputError(f"the timeout is {self.timeout:g} s, expected more than 0")
        if self.jobs is not None and self.jobs < 1:
            raise InputError(f"the number of jobs is {self.jobs}, expected 1 or more")
        if self.by not in CLASSES:
            raise InputError(f"the class of decoders is {self.by!r}, expected {' or '.join(CLASSES)}")
        self.limits  # noqa: B018 - checks the resource level

    @property
    def limits(self) -> Limits:
        """The limits of csplat's decoder."""
        return Limits(resource_level=self.resource_level)

    @property
    def claim(self) -> str:
        """The claim that a decoder may print once it passes; "" if not all vectors are compared."""
        if self.pattern or self.clause or not {*PARTS} <= {*self.levels}:
            return ""
        return f"a decoder, {self.by}, resource level {self.resource_level}"

    @property
    def near(self) -> FloatsByVector | None:
        """A function that returns exact floats, for the class renderer; None if floats must be equal bit for bit."""
        return adapter.exact_floats if self.by == RENDERER else None


def parse_levels(text: str, last: int = LEVELS[-1]) -> tuple[int, ...]:
    """Parse levels: `3` means levels 1 to 3, `1,3` only levels 1 and 3; `last` is the last level.

    Raises:
        InputError: there are no such levels.
    """
    try:
        numbers = [int(part.strip().upper().removeprefix("L")) for part in text.split(",")]
    except ValueError:
        raise InputError(f"the level is {text!r}, expected 1 to {last}, or a list such as 1,3") from None
    if any(not 1 <= number <= last for number in numbers):
        raise InputError(f"the level is {text!r}, expected 1 to {last}, or a list such as 1,3")
    return tuple(range(1, numbers[0] + 1)) if len(numbers) == 1 else tuple(sorted(set(numbers)))


def run_builtin(options: DecoderSuiteOptions | None = None, progress: CountProgress | None = None) -> ConformanceReport:
    """Run csplat's decoder over the vectors; its refusals must match in code, clause and offset.

    Args:
        options: settings of the run; `exact`, `timeout` and `jobs` do not apply.
        progress: called with the number of vectors that are done.

    Raises:
        InputError: a pattern of `options` matches nothing.
    """
    options = options or DecoderSuiteOptions()

    def run(vector: Vector) -> list[Outcome]:
        outcomes = []
        if any(level in options.levels for level in PARTS):
            outcomes = compare_answer(
                vector, adapter.answer(vector.data, options.limits), options.levels, exact=True, near=options.near
            )
        if RENDERS in options.levels and vector.views:
            if reference_renders.can_render():
                outcomes += reference_renders.score_own_renderer(vector)
            else:
                outcomes += reference_renders.skip_views(vector, "needs csplat's compiled renderer")
        if CUTS in options.levels and cuts_of_vector(vector):
            outcomes.append(compare_cuts(vector, _own_cuts(vector)))
        return outcomes

    vectors = _select_vectors(options)
    return _make_report("csplat's decoder", map(run, vectors), len(vectors), options, progress, options.claim)


def _own_cuts(vector: Vector) -> Answer:
    """Return the answer of csplat's decoder to the cuts of a vector."""
    try:
        return Answer(Status.PASSED, cuts=adapter.cuts_of(vector.data, cuts_of_vector(vector)))
    except CsplatError as error:
        return Answer(Status.REFUSED, str(error), code=error.code)


def run_command(
    command: str | None,
    options: DecoderSuiteOptions | None = None,
    *,
    render: str | None = None,
    cuts: str | None = None,
    progress: CountProgress | None = None,
) -> ConformanceReport:
    """Run another decoder, another renderer, another program for cuts, or several of them over the vectors.

    Args:
        command: command line of the decoder with `{input}` and `{outdir}`; None to test the other programs alone.
        options: settings of the run.
        render: command line of the renderer with `{input}`, `{camera}` and `{out}` or `{outdir}`, for L4.
        cuts: command line of the program for cuts with `{input}` and `{cuts}`, for L5.
        progress: called with the number of vectors that are done.

    Raises:
        InputError: a command line cannot be run, or a pattern of `options` matches nothing.
    """
    options = options or DecoderSuiteOptions()
    if command is not None:
        split_command(command, ("input", "outdir"))
    if render is not None:
        split_command(render, ("input", "camera", "outdir" if "{outdir}" in render else "out"))
    if cuts is not None:
        split_command(cuts, ("input", "cuts"))

    def run(vector: Vector) -> list[Outcome]:
        outcomes = []
        if command is not None and any(level in options.levels for level in PARTS):
            answer = ask_decoder(command, VECTORS / vector.file, options.timeout, keep_floats=options.near is not None)
            outcomes = compare_answer(vector, answer, options.levels, exact=options.exact, near=options.near)
        if RENDERS in options.levels:
            if render is None:
                outcomes += reference_renders.skip_views(vector, "no command of a renderer was given")
            else:
                outcomes += reference_renders.score_renderer(vector, render, options.timeout)
        vector_cuts = cuts_of_vector(vector) if CUTS in options.levels else []
        if vector_cuts and cuts is not None:
            outcomes.append(compare_cuts(vector, ask_cuts(cuts, VECTORS / vector.file, vector_cuts, options.timeout)))
        elif vector_cuts:
            outcomes.append(skip_cuts(vector, "no command for cuts was given"))
        return outcomes

    vectors = _select_vectors(options)
    if command is None:
        vectors = [v for v in vectors if (render and v.views) or (cuts and cuts_of_vector(v))]
    with ThreadPoolExecutor(options.jobs or os.cpu_count() or 1) as pool:
        results, claim = pool.map(run, vectors), "" if command is None else options.claim
        return _make_report(command or render or cuts or "", results, len(vectors), options, progress, claim)


def _select_vectors(options: DecoderSuiteOptions) -> list[Vector]:
    """Return the vectors whose name matches `options.pattern` and of which a clause matches `options.clause`.

    Raises:
        InputError: a pattern matches no name or no clause.
    """
    vectors = [_at_level(vector, options.resource_level) for vector in load()]
    names = select_names(options.pattern, [vector.name for vector in vectors], "vector")
    selected = [vector for vector in vectors if vector.name in names]
    if options.clause is None:
        return selected  # including vectors without a clause
    clauses = select_names(
        options.clause, {clause for vector in vectors for clause in vector.clauses}, "clause of a vector"
    )
    return [vector for vector in selected if clauses & {*vector.clauses}]


def _at_level(vector: Vector, level: str) -> Vector:
    """Return a vector with what a decoder of a resource level must answer: E_LIMIT for a file of a higher level."""
    offset = _spec.HEADER_OFFSETS["resource_level"]
    stated = _spec.RESOURCE_LEVEL_NAMES.get((vector.data[offset : offset + 1] or b"\0")[0], "")
    if stated <= level or vector.error.get("clause", "").startswith(("HDR", "RES")):  # which are found in the header
        return vector
    error = {"code": _spec.ERROR_LIMIT, "clause": "LIM-2", "offset": offset, "also": [], "optional": ""}
    return replace(vector, expect={}, error=error, views=[])


def _make_report(
    subject: str,
    results: Iterable[list[Outcome]],
    vector_count: int,
    options: DecoderSuiteOptions,
    progress: CountProgress | None,
    claim: str,
) -> ConformanceReport:
    """Collect the outcomes of each vector as they arrive, report progress, and check CHK-7 over all of them."""
    outcomes: list[Outcome] = []
    for done, vector_outcomes in enumerate(results, 1):
        outcomes += vector_outcomes
        if progress:
            progress(done, vector_count)
    outcomes, notes = check_payload_consistency(outcomes)
    if options.by != EXACT:
        notes.append(f"compared with the tolerances of the class {options.by}")
    return ConformanceReport("decoder", subject, outcomes, notes, claim=claim)
