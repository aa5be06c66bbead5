"""A fine-tuned file as a point of the sweep."""

from __future__ import annotations

from dataclasses import replace

from csplat.encoder import EncodeOptions
from csplat_tools.files.console import Progress
from csplat_tools.tradeoff.options import Wanted
from csplat_tools.tradeoff.points import Made
from csplat_tools.tradeoff.setting import Setting
from csplat_tools.training.finetune import (
    BYTE_COST,
    LEARNING_FACTOR,
    SHAPE_ENTRIES,
    VIEW_SIZE,
    VIEWS,
    Clock,
    begin,
    tune,
)
from csplat_tools.views import ViewSet, find_view_set
from csplat_tools.views.viewset import pose
from csplat_trainer.finetune import FinetuneOptions, Moment

__all__ = ["tune_file"]


def tune_file(setting: Setting, wanted: Wanted, keep: float | None, progress: Progress) -> Made:
    """Make the file that `csplat finetune` makes with its usual options, but for which virtual views decide.

    Args:
        setting: photographs teach where there are some, else the scene's own renders from virtual cameras.
        wanted: preset, steps and threads.
        keep: share of the splats that stay; `None` for all.
        progress: is told the stages.

    Raises:
        CsplatError: as `csplat_tools.training.finetune.begin` and `tune`.
    """
    itself = not setting.views.photographs
    encoding = EncodeOptions(preset=wanted.preset, shape_codebook_size=SHAPE_ENTRIES, threads=wanted.threads)
    options = FinetuneOptions(iterations=wanted.iterations, byte_cost=BYTE_COST[itself])
    clock = Clock()
    begun = begin(setting.source, _tuning_views(setting), encoding, clock, keep=keep, progress=progress)

    def show(now: Moment) -> None:
        progress("tuning", now.iteration / now.iterations)

    tuned = tune(begun, options.scaled(LEARNING_FACTOR[itself]), clock, threads=wanted.threads, show=show)
    said = {"steps": tuned.log["steps"], "best_step": tuned.log["best_iteration"], "keep": keep, **begun.chosen.said}
    return Made(tuned.result.data, {"encoding": tuned.result.report.options, "finetune": said}, clock.seconds)


def _tuning_views(setting: Setting) -> ViewSet:
    """Those of `csplat finetune`: of photographs, all teach that do not judge; of virtual views, there are more."""
    views = setting.views
    if views.photographs:
        judging = {pose(camera) for camera in views.judges}
        teaches = [one.camera for one in views.photographs if pose(one.camera) not in judging]
        return replace(views, teaches=teaches, decides=())
    if views.virtual:
        more = find_view_set(setting.source, background=views.background, count=VIEWS, size=VIEW_SIZE)
        return replace(views, teaches=more.teaches, decides=more.decides)
    return views
