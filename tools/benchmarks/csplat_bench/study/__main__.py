"""Repeat a published study of simple strategies: fewer SH bands, opacity pruning, k-means; and what it left to do.

    python -m csplat_bench.study                        # everything: about half an hour on two cores
    python -m csplat_bench.study baseline --markdown    # the published rows and the first of the others
    python -m csplat_bench.study tables plots           # what is known already, and the plots of tools/STUDY.md
    python -m csplat_bench.study baseline --iterations 200 --views 10 --out out/quick

The baseline is trained first: Lego at 200×200, 1,000 splats from first to last, SH degree 1, 7,000 iterations, white
background. The splats start at random in the scene's box and nothing moves, adds or removes any. Figures are means and
standard deviations over the 200 test views. Sizes are those of the published rule (raw float32, or codebooks in float32
and indices of ceil(log2 K) bits; MiB) and those of .csplat files. What was measured is kept in out/study/NAME.json, and
measured once. A baseline with LPIPS in its loss requires torch.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from csplat.errors import CsplatError, InputError
from csplat_bench.common.captures import Capture
from csplat_bench.common.command import MARKDOWN, OUT, SCENES, WrongWords, listed, run
from csplat_bench.common.kept import Kept, file_digest
from csplat_bench.common.report import machines, tell_machine
from csplat_bench.common.scenes import DATA, ROOT
from csplat_bench.common.scenes import OUT as EVERYTHING
from csplat_bench.study.judge import Distance
from csplat_bench.study.plots import draw
from csplat_bench.study.records import Facts, Results
from csplat_bench.study.rows import (
    Row,
    attribute_bytes,
    baseline_bytes,
    measure_row,
    measure_taus,
    rows_of_baseline,
    rows_of_render,
    rows_of_scene,
)
from csplat_bench.study.scenes import BASELINES, OTHERS, OWN, RENDERED, Subject, baselines, larger, open_subject
from csplat_bench.study.tables import tables
from csplat_render.lpips import load_lpips
from csplat_render.warmup import warm_up
from csplat_tools.console import note

_FIRST = "study1k"
_LAST = "study1k-lpips"
_PARTS = ("baseline", "variants", "scenes", "renders", "lpips")
_SHOWN = ("tables", "plots")
_SCENES = ",".join((*OTHERS, *OWN))
_WHAT = f"{', '.join(_PARTS)}; or {', '.join(_SHOWN)} of what is known; default: all"
_WEIGHTS = str(DATA / "lpips" / "lpips_alex.npz")

Rows = Callable[[Subject], list[Row]]


def main(
    what: Annotated[list[str], typer.Argument(metavar="WHAT", help=_WHAT)] = [],
    *,
    scenes: SCENES = _SCENES,
    iterations: Annotated[int, typer.Option(help="of the baseline")] = 7000,
    splats: Annotated[int, typer.Option(help="of the baseline")] = 1000,
    views: Annotated[int, typer.Option(help="test views at most; 0: all")] = 0,
    lpips: Annotated[str, typer.Option(help="weights of LPIPS-Alex, auto for the usual places, or none")] = _WEIGHTS,
    markdown: MARKDOWN = False,
    out: OUT = EVERYTHING / "study",
    plots: Annotated[Path, typer.Option(help="folder for them")] = ROOT / "tools" / "study",
) -> int:
    """Measure what the command line names; print tables, draw plots."""
    unknown = set(what) - {*_PARTS, *_SHOWN}
    if unknown:
        raise WrongWords(f"{', '.join(sorted(unknown))} cannot be measured, wanted some of {', '.join(_PARTS)}")
    parts = [part for part in _PARTS if part in what or not what]
    failed = False
    if parts:
        distance = _lpips(lpips)
        known = baselines(iterations, splats)
        warm_up(note, simplify=True, ssim=True, lpips=distance is not None)
        for part, name, rows in _jobs(listed(scenes)):
            if part in parts:
                try:
                    _subject(name, rows, known, distance, out, views)
                except (CsplatError, OSError) as error:  # the others are measured all the same
                    note(f"error: {error}")
                    failed = True
    _show(set(what) or set(_SHOWN), out, plots, markdown=markdown)
    return int(failed)


def _jobs(names: Sequence[str]) -> list[tuple[str, str, Rows]]:
    """Part, scene, and its rows.

    Raises:
        InputError: a name is not known.
    """
    unknown = set(names) - {*OTHERS, *OWN}
    if unknown:
        raise InputError(f"no scene is called {', '.join(sorted(unknown))}, wanted some of {_SCENES}")
    jobs: list[tuple[str, str, Rows]] = [("baseline", _FIRST, lambda _: rows_of_baseline())]
    jobs += [("variants", name, rows_of_scene) for name in BASELINES if name not in (_FIRST, _LAST)]
    jobs += [("scenes", name, rows_of_scene) for name in names]
    jobs += [("renders", f"{_FIRST}@{width}", lambda _: rows_of_render()) for width in RENDERED]
    return [*jobs, ("lpips", _LAST, rows_of_scene)]


def _lpips(text: str) -> Distance | None:
    if text == "none":
        return None
    if text != "auto":
        os.environ["CSPLAT_LPIPS"] = text  # where training looks for them
    return load_lpips(None if text == "auto" else text)


def _subject(
    name: str, rows: Rows, known: Mapping[str, Capture], lpips: Distance | None, out: Path, views: int
) -> None:
    """Measure the lines of a scene that are not known yet."""
    base, _, width = name.partition("@")
    subject = open_subject(base, known, out, lpips, views)
    if width:
        subject = larger(subject, int(width), min(len(subject.views.cameras), RENDERED[int(width)]))
    settings = {
        "ply_sha256": file_digest(subject.ply), "judged_by": subject.judged_by, "lpips": lpips is not None,
    }  # fmt: skip
    kept = Kept(out / f"{name}.json", settings)
    kept.values["machine"] = tell_machine()
    kept.values["facts"] = _facts(subject)
    wanted = rows(subject)
    for row in wanted:
        if kept.knows("rows", row.name) and kept.values["rows"][row.name]["how"] != json.loads(json.dumps(row.how)):
            del kept.values["rows"][row.name]  # it has been told otherwise since
        kept.measure("rows", row.name, partial(measure_row, subject, row))
    kept.values["order"] = [row.name for row in wanted]
    if not width:
        kept.measure("taus", "all", partial(measure_taus, subject.source, subject.views))
        kept.measure("attributes", "all", partial(attribute_bytes, subject))
    kept.write()


def _facts(subject: Subject) -> Facts:
    return {
        "splats": len(subject.source),
        "sh_degree": subject.source.sh_degree,
        "bytes": baseline_bytes(subject.source),
        "judged_by": subject.judged_by,
        "how": BASELINES.get(subject.name),
        "training_seconds": subject.training.get("seconds"),
        "training": subject.training.get("options"),
    }


def _show(what: set[str], out: Path, plots: Path, *, markdown: bool) -> None:
    """Print what is known, and draw it."""
    order = [_FIRST, *(f"{_FIRST}@{width}" for width in RENDERED), *BASELINES, *OTHERS, *OWN]
    paths = {name: out / f"{name}.json" for name in dict.fromkeys(order)}
    results: Results = {name: json.loads(path.read_text()) for name, path in paths.items() if path.exists()}
    results = {name: one for name, one in results.items() if "order" in one}
    if what != {"plots"}:
        print(tables(results, markdown=markdown))
    print("\n" + machines(one["machine"] for one in results.values()))
    if "plots" in what:
        plots.mkdir(parents=True, exist_ok=True)
        for path in draw(results, plots):
            note(f"drawn: {path}")


if __name__ == "__main__":
    sys.exit(run(main))
