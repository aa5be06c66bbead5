"""List the candidates of a sweep: ways of storing the scene, each with a name, a group, and a function to make it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from csplat.encoder import PRESETS, EncodeOptions, EncodeResult, encode_with_report
from csplat.model import SplatModel
from csplat.types import Progress
from csplat_tools.files.console import format_bytes
from csplat_tools.optimise.reaching import encode_to
from csplat_tools.study import Reduction, encode_reduced, parse_kmeans
from csplat_tools.tradeoffs.commands import encode_command, finetune_command, reduction_command, target_command
from csplat_tools.tradeoffs.options import Wanted
from csplat_tools.tradeoffs.points import TriedFile
from csplat_tools.tradeoffs.setting import Setting
from csplat_tools.training.finetune import (
    BYTE_COST,
    LEARNING_FACTOR,
    SHAPE_ENTRIES,
    VIEW_SIZE,
    VIEWS,
    choose_and_finetune,
    usually_aside,
)
from csplat_tools.views import ViewSet, find_view_set
from csplat_tools.views.viewset import pose
from csplat_trainer.tuning import FinetuneOptions

_MOST_DISTILLED = 2  # number of SH degrees that are distilled, 0 and 1: each takes as long as a simplification


@dataclass(frozen=True, eq=False)
class Candidate:
    """A way of storing the scene.

    Attributes:
        name: unique name.
        family: one of `FAMILIES`.
        command: command line that makes the same file.
        make: makes the file; called with a progress callback.
        is_partial: measure it with fewer SH layers, too.
        cost: kind of point in the estimates of time; `None`: that of the family.
    """

    name: str
    family: str
    command: str
    make: Callable[[Progress], TriedFile]
    is_partial: bool = False
    cost: str | None = None


def candidates(setting: Setting, wanted: Wanted) -> list[Candidate]:
    """List the candidates, quick ones first."""
    makers = {
        "presets": _presets,
        "precision": _precisions,
        "strategies": _strategies,
        "targets": _targets,
        "simplify": _simplified,
        "finetune": _tuned,
    }
    return [one for family, list_of in makers.items() if family in wanted.what for one in list_of(setting, wanted)]


def _presets(setting: Setting, wanted: Wanted) -> Iterator[Candidate]:
    for preset in PRESETS:
        options = EncodeOptions(preset=preset, threads=wanted.threads)
        command = encode_command(setting, preset, preset)
        has_bands = setting.source.sh_degree > 0
        yield Candidate(preset, "presets", command, partial(_encode, setting.source, options), is_partial=has_bands)


def _precisions(setting: Setting, wanted: Wanted) -> Iterator[Candidate]:
    for decibels in wanted.attribute_psnr:
        name = f"attributes {decibels:g} dB"
        options = EncodeOptions(preset=wanted.preset, attribute_psnr=decibels, threads=wanted.threads)
        command = encode_command(setting, name, wanted.preset, attribute_psnr=decibels)
        yield Candidate(name, "precision", command, partial(_encode, setting.source, options))


def _strategies(setting: Setting, wanted: Wanted) -> Iterator[Candidate]:
    """Yield candidates that reduce bands, splats and values by simple rules; those that need renders come last."""

    def strategy(name: str, reduction: Reduction, cost: str = "strategies") -> Candidate:
        how = replace(reduction, threads=wanted.threads)
        command = reduction_command(setting, name, wanted.preset, reduction)
        return Candidate(name, "strategies", command, partial(_reduce, setting, wanted, how), cost=cost)

    degree = setting.source.sh_degree
    for kept in reversed(range(degree)):
        options = EncodeOptions(preset=wanted.preset, sh_degree=kept, threads=wanted.threads)
        command = encode_command(setting, f"SH {kept}", wanted.preset, sh_degree=kept)
        yield Candidate(f"SH {kept}", "strategies", command, partial(_encode, setting.source, options))
    for tau in wanted.opacities:
        yield strategy(f"opacity > {tau:g}", Reduction(prune_opacity=tau))
    if degree and wanted.opacities:
        tau = wanted.opacities[-1]
        yield strategy(f"SH 0, opacity > {tau:g}", Reduction(prune_opacity=tau, sh_degree=0))
    for entries in wanted.kmeans:
        yield strategy(f"k-means {entries:g}", Reduction(kmeans=parse_kmeans(f"{entries:g}")), "k-means")
    for kept in reversed(range(min(degree, _MOST_DISTILLED))):
        yield strategy(f"SH {kept}, distilled", Reduction(sh_degree=kept, distil=True), "distilled")


def _targets(setting: Setting, wanted: Wanted) -> Iterator[Candidate]:
    for psnr in wanted.psnr:
        yield _target(setting, wanted, f"target {psnr:g} dB", psnr=psnr)
    for size in wanted.sizes:
        yield _target(setting, wanted, f"target {format_bytes(size)}", size=size)


def _target(
    setting: Setting, wanted: Wanted, name: str, psnr: float | None = None, size: int | None = None
) -> Candidate:
    command = target_command(setting, name, wanted.preset, target_psnr=psnr, target_size=size)
    return Candidate(name, "targets", command, partial(_reach, setting, wanted, psnr=psnr, size=size))


def _simplified(setting: Setting, wanted: Wanted) -> Iterator[Candidate]:
    for keep in wanted.keep:
        command = target_command(setting, f"keep {keep:g}", wanted.preset, keep=keep)
        yield Candidate(f"keep {keep:g}", "simplify", command, partial(_reach, setting, wanted, keep=keep))


def _tuned(setting: Setting, wanted: Wanted) -> Iterator[Candidate]:
    one_keep = wanted.keep[len(wanted.keep) // 2 :][:1]  # the middle one alone: each takes minutes
    for keep in (None, *one_keep):
        name = "tuned" if keep is None else f"tuned, keep {keep:g}"
        command = finetune_command(setting, name, wanted, keep)
        yield Candidate(name, "finetune", command, partial(_tune, setting, wanted, keep))


def _encode(source: SplatModel, options: EncodeOptions, progress: Progress) -> TriedFile:
    return _made(encode_with_report(source, options, progress=progress))


def _reduce(setting: Setting, wanted: Wanted, reduction: Reduction, progress: Progress) -> TriedFile:
    return _made(
        encode_reduced(
            setting.source, reduction, EncodeOptions(preset=wanted.preset, threads=wanted.threads),
            views=setting.views, progress=progress,
        )
    )  # fmt: skip


def _reach(setting: Setting, wanted: Wanted, progress: Progress, **asked: Any) -> TriedFile:
    options = EncodeOptions(preset=wanted.preset, threads=wanted.threads)
    found = encode_to(setting.source, views=setting.views, options=options, progress=progress, **asked)
    return _made(found.result, target=found.report.as_json())


def _made(result: EncodeResult, **said: Any) -> TriedFile:
    return TriedFile(result.data, {"encoding": result.report.options, **said})


def _tune(setting: Setting, wanted: Wanted, keep: float | None, progress: Progress) -> TriedFile:
    """Make the file of `csplat finetune` with its default options."""
    itself = not setting.views.photographs
    encoding = EncodeOptions(preset=wanted.preset, shape_codebook_size=SHAPE_ENTRIES, threads=wanted.threads)
    options = FinetuneOptions(iterations=wanted.iterations, byte_cost=BYTE_COST[itself])
    tuned = choose_and_finetune(
        setting.source, _tuning_views(setting), encoding, options.scaled(LEARNING_FACTOR[itself]), keep=keep,
        progress=progress,
    )  # fmt: skip
    made = tuned.made
    said = {"steps": made.log["steps"], "best_step": made.log["best_iteration"], "keep": keep, **tuned.chosen.said}
    return TriedFile(made.data, {"encoding": made.result.report.options, "finetune": said}, tuned.seconds)


def _tuning_views(setting: Setting) -> ViewSet:
    """Return the views of `csplat finetune`: all photographs that are not test views, or more virtual views."""
    views = setting.views
    if views.photographs:  # which are in memory already
        judging = {pose(camera) for camera in views.judges}
        teaches = [one.camera for one in views.photographs if pose(one.camera) not in judging]
        return replace(views, teaches=teaches, decides=())
    return find_view_set(
        setting.source, cameras=setting.cameras, background=setting.background, count=VIEWS, size=VIEW_SIZE,
        aside=usually_aside(VIEWS, cameras=setting.cameras, data=None),
    )  # fmt: skip
