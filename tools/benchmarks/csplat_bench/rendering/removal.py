"""Measure the removal of splats: quality by method and share removed, and the cost of the pass that orders the splats.

    python -m csplat_bench.rendering.removal removal --scenes plane3,donut      # PSNR by share removed and method
    python -m csplat_bench.rendering.removal pass                               # the pass compared with a render
    python -m csplat_bench.rendering.removal tables                             # print what was measured

What was measured is kept scene by scene in out/removal/NAME.json: a run that is interrupted continues where it stopped.
PSNR is against the source, on cameras that decided nothing: those of the data folder (psnr_cameras/NAME.json).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from enum import StrEnum
from functools import cached_property, partial
from typing import Annotated, Any, TypedDict

import numpy as np
import typer
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.common.command import EXTRA, OUT, SCENES, VIEWS, listed, numbers, run
from csplat_bench.common.kept import Kept, read_kept
from csplat_bench.common.measuring import timed
from csplat_bench.common.report import table, tell_machine
from csplat_bench.common.scenes import OUT as EVERYTHING
from csplat_bench.common.scenes import find_scenes, judge_of
from csplat_render.pruning_error import measure_pruning_error
from csplat_render.rasteriser import Rasteriser
from csplat_render.scorer import ReferenceImage, Scorer, renderer
from csplat_tools.optimise.pruning_order import MeasuredViews, SimplifyOptions, find_pruning_order
from csplat_tools.optimise.splat_refit import refit_splats, refit_with_bands
from csplat_tools.study import prune_share
from csplat_tools.views import BLACK, VIEW_SIZE, camera_sequence, find_view_set
from csplat_tools.views.sufficient_views import find_sufficient_views

_SCENES = "plane3,lego60k,fox120k,fox60k_noreg,donut,jacket,statue"
_BY_OPACITY = ("opacity", "opacity-area")
_METHODS = (*_BY_OPACITY, "exact", "rounds")
_PASS_VIEWS = 24


class Part(StrEnum):
    """The parts that the command line can name."""

    removal = "removal"
    passes = "pass"
    tables = "tables"


class Left(TypedDict, total=False):
    """Quality after removing splats; the fit is measured only for the method `rounds`.

    Attributes:
        psnr: dB, before a fit.
        seconds: time to find the order of removal.
        views: number of training views.
        fit_*: the same after fitting the kept splats; `fit_used`, `fit_check`: PSNR on the training and on other views.
    """

    psnr: float
    seconds: float
    views: int
    fit_psnr: float
    fit_seconds: float
    fit_used: float
    fit_check: float


def main(
    what: Annotated[Part, typer.Argument(help="what to measure, or tables of what is known")],
    *,
    scenes: SCENES = _SCENES,
    extra: EXTRA = [],
    gone: Annotated[str, typer.Option(help="per cent removed, separated by commas")] = "40,60",
    views: VIEWS = 160,
    out: OUT = EVERYTHING / "removal",
) -> None:
    """Measure what the command line names; print what is known."""
    if what != Part.tables:
        tell_machine()
        for scene in find_scenes(listed(scenes), extra=extra):
            source, kept = read_ply(scene.path), Kept(out / f"{scene.name}.json")
            if what == Part.passes:
                kept.measure("pass", "milliseconds", partial(_pass_milliseconds, source))
                continue
            bench = _Bench(source, judge_of(scene.name, source), SimplifyOptions(views=views, bands=False))
            for percent in numbers(gone, int):
                for method in _METHODS:
                    kept.measure("removal", f"{percent} {method}", partial(bench.left, percent, method))
    known = read_kept(out)
    tables = [_pass_table({name: one["pass"] for name, one in known.items() if "pass" in one})]
    tables += [_removal_table(name, one["removal"]) for name, one in known.items() if "removal" in one]
    print("\n\n".join(text for text in tables if text))


class _Bench:
    """Simplifies one scene over and over. Owns its views, found once."""

    def __init__(self, source: SplatModel, judge: Scorer, options: SimplifyOptions) -> None:
        self._source, self._judge, self._options = source, judge, options
        self._views = find_sufficient_views(source, find_view_set(source, count=options.views), 0.5)

    @cached_property
    def _wanted(self) -> list[NDArray[np.float32]]:
        draw = renderer(self._source, BLACK)
        return [draw(camera).rgb for camera in self._views.used]

    @cached_property
    def _checked(self) -> Scorer:
        return Scorer.of_source(self._source, self._views.check, BLACK)

    def left(self, percent: int, method: str) -> Left:
        """Remove a share by a method; by the last one without and with a fit."""
        source, views, options = self._source, self._views, self._options
        count = round(len(source) * (1.0 - percent / 100.0))
        if method in _BY_OPACITY:
            (model, _), timing = timed(prune_share, source, count / len(source), by_area=method == "opacity-area")
        else:
            rounds, side = 1 if method == "exact" else options.rounds, MeasuredViews(views.used, views.pruning_error)
            order, timing = timed(find_pruning_order, source, [side], replace(options, rounds=rounds), count)
            model = source.select(order.kept(len(source), min(len(source) - count, len(order.rows))))
        result: Left = {"psnr": self._judge.psnr(model), "seconds": timing.wall, "views": len(views.used)}
        if method == "rounds":
            fitted, timing = timed(refit_with_bands, model, views.used, self._wanted, options)
            own = Scorer(views.used, [ReferenceImage(picture) for picture in self._wanted])
            result |= {"fit_psnr": self._judge.psnr(fitted.model), "fit_seconds": timing.wall}
            result |= {"fit_used": own.psnr(fitted.model), "fit_check": self._checked.psnr(fitted.model)}
        return result


def _pass_milliseconds(source: SplatModel) -> dict[str, float]:
    """Milliseconds for each view of a plain render, of the pass, of a step of a fit: the best of three, by turns."""
    cameras, rasteriser = camera_sequence(source, _PASS_VIEWS, VIEW_SIZE), Rasteriser(gradients=False)
    wanted, options = [renderer(source, BLACK)(camera).rgb for camera in cameras], SimplifyOptions()

    def render() -> None:
        for camera in cameras:
            rasteriser.forward(source, camera, antialiased=source.antialiased)

    calls = {
        "render": render,
        "pass": lambda: measure_pruning_error(source, cameras),
        "step": lambda: refit_splats(source, cameras, wanted, options, steps=len(cameras)),
    }
    turns = [{name: timed(call)[1].wall for name, call in calls.items()} for _ in range(3)]
    return {name: 1000.0 * min(turn[name] for turn in turns) / len(cameras) for name in calls}


def _pass_table(found: Mapping[str, Mapping[str, dict[str, float]]]) -> str:
    rows = [(name, *(f"{value:.1f}" for value in one["milliseconds"].values())) for name, one in found.items()]
    return table(("the pass, per view", "render ms", "pass ms", "step of a fit ms"), rows)


def _removal_table(name: str, found: Mapping[str, Left]) -> str:
    rows = []
    for percent in sorted({int(key.split()[0]) for key in found}):
        known = [found.get(f"{percent} {method}") for method in _METHODS]
        row: list[Any] = [f"{name} {percent} %", *("-" if one is None else f"{one['psnr']:.1f}" for one in known)]
        last = known[-1]
        if last is None:
            row += ["-"] * 6
        else:
            decibels = (last["fit_psnr"], last["fit_used"], last["fit_check"])
            seconds = (last["seconds"], last["fit_seconds"])
            row += [*(f"{value:.1f}" for value in decibels), last["views"], *(f"{value:.0f}" for value in seconds)]
        rows.append(row)
    fits = ("fitted", "used views", "check views")
    return table(("PSNR, dB", *_METHODS, *fits, "views", "rounds s", "fit s"), rows)


if __name__ == "__main__":
    sys.exit(run(main))
