# SPDX-License-Identifier: Apache-2.0
"""Run a suite: its cases take turns on every scene, and rows are medians over the turns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from subprocess import CalledProcessError, SubprocessError
from typing import Any

from csplat.errors import CsplatError
from csplat_bench.protocol import AbsentError, Measure, Setup, Subject
from csplat_bench.results import Results
from csplat_bench.rules import paired_ratio, summarise_turns
from csplat_bench.suites import Case, Suite
from csplat_tools.console import note


def run_suite(
    suite: Suite, subject: Subject, setup: Setup, results: Results, scenes: Sequence[str], only: Sequence[str] = ()
) -> bool:
    """Measure what is missing in the results.

    Args:
        suite, subject: what is measured.
        setup: where.
        results: the file, to which rows are added.
        scenes: names or paths of scenes to measure.
        only: patterns of names of cases; empty: all.

    Returns:
        True if every case gave a row without an error, or was left out because something is not installed.
    """
    fine = True
    for name_or_path in scenes:
        scene = scene_name(name_or_path)
        cases = suite.cases_on(scene, only)
        missing = [case for case in cases if not results.is_known(scene, case)]
        if not missing:
            continue
        # A ratio is that of one turn: cases with the same reference are measured in the same turns.
        references = {case.get("reference", case.name) for case in missing}
        cases = [case for case in cases if case.get("reference", case.name) in references]
        note(f"{suite.name} {scene}: {len(cases)} cases")
        try:
            with subject(setup, name_or_path, cases) as measure:
                for case, row in _take_turns(suite, cases, measure, scene):
                    fine &= "error" not in row
                    results.add(scene, case, row)
        except AbsentError as error:
            note(f"{scene} is left out: {error}")
    if "published" in suite.options:
        results.set_published(suite.options["published"])
    return fine


def scene_name(name_or_path: str) -> str:
    """Return the name of a scene in results: the last part of its path, without .ply or .csplat."""
    name = Path(name_or_path).name if "/" in name_or_path and Path(name_or_path).exists() else name_or_path
    return name.removesuffix(".ply").removesuffix(".csplat")


def _take_turns(
    suite: Suite, cases: Sequence[Case], measure: Measure, scene: str
) -> Iterator[tuple[Case, dict[str, Any]]]:
    """Yield rows: of failures and of cases that are measured once at once, of all others after the last turn."""
    at_once = suite.repeats == 1 and suite.ratio is None and suite.warmups == suite.warmup_splats == 0
    turns: dict[str, list[Mapping[str, Any]]] = {case.name: [] for case in cases}
    active, turn, warmups = list(cases), 0, suite.warmups
    while turn < warmups + suite.repeats:
        for case in list(active):
            try:
                values = measure(case)
            except (CsplatError, OSError, SubprocessError) as error:
                active.remove(case)
                absent = isinstance(error, AbsentError)
                note(f"{scene} {case.name} {'is left out' if absent else 'failed'}: {_last_line(error)}")
                if not absent:
                    yield case, {"error": _last_line(error)}
                continue
            turns[case.name].append(values)
            warmups = max(warmups, suite.warmups_of(int(values.get("splats") or 0)))
            note(f"{scene} {case.name}: turn {turn + 1}")
            if at_once:
                yield case, summarise_turns([values])
        turn += 1
    if at_once:
        return
    for case in active:
        row = summarise_turns(turns[case.name], suite.repeats)
        reference = turns.get(case.get("reference", ""), [])[-suite.repeats :]
        if suite.ratio and len(reference) == suite.repeats:
            row["times_as_fast"] = paired_ratio(reference, turns[case.name][-suite.repeats :], suite.ratio)
        yield case, row


def _last_line(error: Exception) -> str:
    text = str(error)
    if isinstance(error, CalledProcessError) and error.stderr:
        text = error.stderr if isinstance(error.stderr, str) else error.stderr.decode(errors="replace")
    return (text.strip().splitlines() or [type(error).__name__])[-1]
