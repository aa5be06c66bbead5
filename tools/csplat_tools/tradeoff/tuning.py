"""A fine-tuned file as a point of the sweep."""

from __future__ import annotations

from csplat.encoder import EncodeOptions
from csplat_tools.console import Report
from csplat_tools.finetune_sources import Looks, Sources
from csplat_tools.finetuning import BYTE_COST, LEARNING_FACTOR, SHAPE_ENTRIES, Clock, begin, tune
from csplat_tools.tradeoff.options import Wanted
from csplat_tools.tradeoff.points import Made
from csplat_tools.tradeoff.setting import Setting
from csplat_trainer.finetune import FinetuneOptions, Moment

__all__ = ["tune_file"]


def tune_file(setting: Setting, wanted: Wanted, keep: float | None, progress: Report) -> Made:
    """Make the file that `csplat finetune` makes with its usual options.

    Args:
        setting: photographs teach where there are some, else the scene's own renders from virtual cameras.
        wanted: preset, steps and threads.
        keep: share of the splats that stay; `None` for all.
        progress: is told the stages.

    Raises:
        CsplatError: as `csplat_tools.finetuning.begin` and `tune`.
    """
    itself = setting.data is None
    encoding = EncodeOptions(preset=wanted.preset, shape_codebook_size=SHAPE_ENTRIES, threads=wanted.threads)
    sources = Sources(background=setting.background, keep=keep)
    if setting.data is not None:
        data = setting.data
        sources = Sources(data.path, data.size, data.images, data.test_every, background=setting.background, keep=keep)
    options = FinetuneOptions(iterations=wanted.iterations, byte_cost=BYTE_COST[itself])
    clock = Clock()
    looks = Looks.read(setting.source, sources, quiet=True)
    begun = begin(setting.source, looks, sources, encoding, clock, progress=progress)

    def show(now: Moment) -> None:
        progress("tuning", now.iteration / now.iterations)

    tuned = tune(begun, options.scaled(LEARNING_FACTOR[itself]), clock, threads=wanted.threads, show=show)
    said = {"steps": tuned.log["steps"], "best_step": tuned.log["best_iteration"], "keep": keep, **begun.chosen.said}
    return Made(tuned.result.data, {"encoding": tuned.result.report.options, "finetune": said}, clock.seconds)
