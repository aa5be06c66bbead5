# SPDX-License-Identifier: Apache-2.0
"""Run benchmark suites, and show their results."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import typer

from csplat.errors import CsplatError, InputError
from csplat_bench.pages import write_pages
from csplat_bench.protocol import Setup
from csplat_bench.results import Results, read_results
from csplat_bench.rules import mark_beaten, mean_rows, size_ratios
from csplat_bench.runner import run_suite, scene_name
from csplat_bench.scenes import DATA, OUT
from csplat_bench.subjects import SCENE_FINDERS, SUBJECTS
from csplat_bench.subjects.encoder_inputs import write_figures
from csplat_bench.suites import load_suite, suite_names
from csplat_bench.tables import draw_plot, markdown_table
from csplat_tools.console import note

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False, help=__doc__)

_ResultFile = Annotated[Path, typer.Argument(metavar="RESULT.json", help="Results of a suite.")]
_SuiteOption = Annotated[str, typer.Option(help="A suite, or a TOML file. Default: the one that the results name.")]


@app.command(name="list")
def list_suites() -> None:
    """List all suites."""
    for name in suite_names():
        suite = load_suite(name, list(SUBJECTS))
        print(f"{name:<22}{suite.title} ({len(suite.cases)} cases; {', '.join(suite.scenes)})")


@app.command()
def run(
    suite: Annotated[str, typer.Argument(metavar="SUITE", help="A name of `list`, or a TOML file.")],
    *,
    scenes: Annotated[str, typer.Option(help="Scenes or PLY files, separated by commas. Default: the suite's.")] = "",
    only: Annotated[list[str], typer.Option(help="Pattern of case names; may be repeated. Default: all.")] = [],
    again: Annotated[bool, typer.Option("--again", help="Measure these scenes and cases again.")] = False,
    out: Annotated[Path | None, typer.Option(help="Results. Default: out/bench/SUITE.json.")] = None,
    work: Annotated[Path, typer.Option(help="Folder for made scenes, trainings and files.")] = OUT / "bench",
    peers: Annotated[Path, typer.Option(help="Folder for npm packages and programs of others.")] = OUT / "peers",
    data: Annotated[Path, typer.Option(help="Folder of scenes and data sets.")] = DATA,
    lpips: Annotated[str | None, typer.Option(help="LPIPS weights; `auto` for the usual places.")] = None,
    csplat: Annotated[str, typer.Option(help="The csplat command that is measured.")] = "",
    chromium: Annotated[str, typer.Option(help="The browser.")] = shutil.which("chromium") or "chromium",
) -> None:
    """Measure the cases that are missing in the results; status 1 if one fails."""
    chosen = load_suite(suite, list(SUBJECTS))
    program = shlex.split(csplat) or [sys.executable, "-m", "csplat_tools"]
    setup = Setup(work, peers, data, program, chromium, lpips, chosen.options)
    path = out or work / f"{chosen.name}.json"
    by = f" --csplat {shlex.quote(csplat)}" if csplat else ""
    results = Results(path, chosen, f"python -m csplat_bench run {chosen.name}{by}")
    note(f"{results.machine}, {results.document['versions']}")
    names = [word.strip() for word in scenes.split(",") if word.strip()] or list(chosen.scenes)
    for pattern in only:
        if not any(fnmatchcase(case.name, pattern) for case in chosen.cases):
            known = ", ".join(repr(case.name) for case in chosen.cases)
            raise InputError(f"--only is {pattern!r}, expected a pattern of some of {known}")
    if chosen.subject in SCENE_FINDERS:
        names = SCENE_FINDERS[chosen.subject](setup, names)
    if again:
        for name in names:
            results.forget(scene_name(name), chosen.cases_on(scene_name(name), only))
    fine = run_suite(chosen, SUBJECTS[chosen.subject], setup, results, names, only)
    print(markdown_table(mark_beaten(results.rows), chosen.columns))
    raise typer.Exit(0 if fine else 1)


@app.command()
def table(
    result: _ResultFile,
    *,
    suite: _SuiteOption = "",
    before: Annotated[Path | None, typer.Option(metavar="OTHER.json", help="Add size ratios at equal PSNR.")] = None,
    mean: Annotated[str, typer.Option(metavar="FIELD", help="Means over the scenes of a group, such as set.")] = "",
) -> None:
    """Print the table of a suite's results, in Markdown; `beaten_by` names the file that is smaller and better."""
    document = read_results(result)
    chosen, rows = load_suite(suite or document["suite"], list(SUBJECTS)), mark_beaten(document["rows"])
    columns = [tuple(column) for column in chosen.columns]
    if before is not None:
        rows = size_ratios(read_results(before)["rows"], rows)
        columns += [("same dB, now/before", "{ratio:.3f}"), ("estimated", "{estimated}")]
    if mean:
        numbers = {key for row in rows for key, value in row.items() if isinstance(value, int | float)}
        rows = mean_rows(rows, mean, sorted(numbers))
    print(markdown_table(rows, columns))


@app.command()
def plot(
    result: _ResultFile,
    output: Annotated[Path | None, typer.Argument(metavar="OUT.svg", help="Default: RESULT.svg.")] = None,
    *,
    suite: _SuiteOption = "",
) -> None:
    """Draw the plot of a suite's results."""
    document = read_results(result)
    chosen = load_suite(suite or document["suite"], list(SUBJECTS))
    if chosen.plot is None:
        raise typer.BadParameter(f"suite {chosen.name} declares no plot")
    axes = [chosen.plot["x"].split(" ")[0], chosen.plot["y"].split(" ")[0]]
    rows = [{"series": row["case"], **row} for row in document["rows"] if all(row.get(axis) for axis in axes)]
    path = output or result.with_suffix(".svg")
    draw_plot(rows, chosen.plot, path)
    note(f"wrote {path}")


@app.command()
def pages(
    *, check: Annotated[bool, typer.Option("--check", help="Write nothing; status 1 if a page is stale.")] = False
) -> None:
    """Regenerate the tables and plots of the result pages."""
    for path in (changed := write_pages(check)):
        note(f"{path} is stale" if check else f"wrote {path}")
    raise typer.Exit(1 if check and changed else 0)


@app.command()
def figures(result: _ResultFile) -> None:
    """Write figures.json of the encoder conformance suite from the results of `run encoder_inputs`."""
    note(f"wrote {write_figures(read_results(result)['rows'])}")


def main(words: list[str] | None = None) -> int:
    """Run a command line; return the status: 0, 1 if something failed, 2 for usage errors."""
    # OpenMP reads it when it is loaded: threads that wait for each other sleep soon, see `csplat train`.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    try:
        app(words)
    except SystemExit as ended:
        return int(ended.code or 0)
    except (CsplatError, OSError) as error:
        note(f"error: {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
