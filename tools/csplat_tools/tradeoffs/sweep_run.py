"""Plan and run a sweep, point by point; a point that fails does not stop the others.

Each point has the command that makes its file again, for readers to paste into a shell.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import PurePath
from typing import Any

from csplat.encoder import PRESETS, EncodeOptions, EncodeResult, Target, encode_with_report
from csplat.errors import CsplatError, InputError, counted
from csplat.file_source import File
from csplat.model import SplatModel
from csplat.types import Progress, null_progress
from csplat_render.kernels import thread_count
from csplat_render.metrics import Scores
from csplat_tools.console import format_bytes, format_estimate
from csplat_tools.file_streams import STANDARD_STREAM
from csplat_tools.optional_packages import describe_machine, require_renderer
from csplat_tools.study import Reduction, encode_reduced
from csplat_tools.tradeoffs.sweep_options import SweepOptions, SweepSetting, read_setting
from csplat_tools.tradeoffs.sweep_points import (
    DECODE_RUNS,
    Measurer,
    ModeTime,
    PlannedPoint,
    SweepFailure,
    SweepFile,
    SweepPoint,
    pareto_front,
)
from csplat_tools.training.tuning_run import (
    LEARNING_FACTOR,
    RATE_WEIGHT,
    SHAPE_ENTRIES,
    VIEW_SIZE,
    VIEWS,
    choose_and_finetune,
    default_validation_count,
)
from csplat_tools.views import Colour, DataOptions, ViewSet, find_view_set
from csplat_tools.views.view_sets import pose_key
from csplat_trainer.tuning import FinetuneOptions

# Seconds by kind of point, measured on two cores: a fixed part (scores, and for presets those with fewer bands); per
# million splats; and per second that eight renders of the source take. Used only for the estimate shown to the user.
_COSTS = {
    "presets": (3.6, 12.0, 10.0),
    "precision": (1.2, 12.0, 4.0),
    "strategies": (1.2, 12.0, 4.0),
    "k-means": (1.2, 250.0, 6.0),
    "distilled": (1.2, 40.0, 80.0),
    "targets": (1.2, 0.0, 362.5),  # 2,900 renders, see `expected_renders`
    "simplify": (1.2, 40.0, 250.0),
    "finetune": (1.2, 100.0, 500.0),
}


@dataclass(frozen=True, eq=False)
class Tradeoff:
    """The results of a sweep.

    Attributes:
        setting: the scene and its views.
        sweep: the options of the sweep.
        points: all points, measured or failed, in the order of the sweep.
        source_modes: render times of the source, by mode of the renderer.
        source_image_scores: the source's scores against images; `None` without images.
        machine: processor, system, versions.
    """

    setting: SweepSetting
    sweep: SweepOptions
    points: Sequence[SweepPoint | SweepFailure]
    source_modes: dict[str, ModeTime]
    source_image_scores: Scores | None
    machine: dict[str, Any]

    @property
    def measured(self) -> list[SweepPoint]:
        """The points that were measured, the smallest file first."""
        return sorted((one for one in self.points if isinstance(one, SweepPoint)), key=lambda one: one.size_bytes)

    @property
    def failures(self) -> list[SweepFailure]:
        """The points that could not be measured."""
        return [one for one in self.points if isinstance(one, SweepFailure)]

    @property
    def front(self) -> list[SweepPoint]:
        """The points on the Pareto front of size and `psnr`, the smallest file first."""
        measured = self.measured
        return [measured[place] for place in pareto_front([(one.size_bytes, one.psnr) for one in measured])]

    @property
    def image_front(self) -> list[SweepPoint]:
        """The points on the Pareto front of size and PSNR against images; empty without images."""
        known = [one for one in self.measured if one.image_psnr is not None]
        return [known[at] for at in pareto_front([(one.size_bytes, one.image_psnr or 0.0) for one in known])]

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        setting = self.setting
        return {
            "scene": {
                "name": setting.name,
                "size_bytes": setting.source_bytes,
                "splats": len(setting.source),
                "sh_degree": setting.source.sh_degree,
                "defects": [str(one) for one in setting.findings],
            },
            "views": {
                "cameras": setting.views.name,
                "count": len(setting.views.test),
                "sizes": sorted({(camera.W, camera.H) for camera in setting.views.test}),
                "background": list(setting.views.test_background),
            },
            "machine": self.machine,
            "times": f"single runs; decoding: the median of {DECODE_RUNS}; rendering: the median over views",
            "source": {
                "render": {name: one.as_json() for name, one in self.source_modes.items()},
                "photographs": None if self.source_image_scores is None else self.source_image_scores.as_json(),
            },
            "pareto": [one.name for one in self.front],
            "pareto_photographs": [one.name for one in self.image_front],
            "points": [one.as_json() for one in self.points],
        }


def tradeoff(
    scene: SplatModel | File | SweepSetting,
    sweep: SweepOptions | None = None,
    *,
    cameras: str | None = None,
    data: DataOptions | None = None,
    background: Colour | None = None,
    lpips: str | None = None,
    say: Callable[[str], None] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Tradeoff:
    """Make and measure all files of a sweep, as `csplat tradeoff` does. Takes minutes, and requires the render extra.

    Args:
        scene: a model, or a file; or the `SweepSetting` of an earlier sweep, which replaces all inputs but `sweep`.
        sweep: the points to measure; `None`: presets, precision, strategies, targets and simplification.
        cameras, data, background: the views, as for `find_view_set`; paths, so that the report can contain the command
            for each file.
        lpips: a file of LPIPS weights, or `auto`; `None`: LPIPS is not computed.
        say: called with a line on the expected time, and with one for each file that was measured.
        progress: progress callback.

    Examples:
        >>> import csplat_tools
        >>> found = csplat_tools.tradeoff("scene.ply", csplat_tools.SweepOptions(what=("presets",)))  # doctest: +SKIP
        >>> [(point.name, point.size_bytes, point.psnr) for point in found.front]  # doctest: +SKIP

    Raises:
        InputError: the sweep has no points, or none of them could be measured.
        CsplatError: a file is not valid.
        OSError: a file cannot be read.
    """
    require_renderer()
    if isinstance(scene, SweepSetting):
        setting = scene
    else:
        setting = read_setting(scene, cameras=cameras, data=data, background=background, lpips=lpips)
    sweep = sweep or SweepOptions()
    report: Progress = progress or null_progress
    show = say or (lambda _line: None)
    with thread_count(sweep.threads):
        measurer = Measurer(setting, sweep.modes, sweep.threads)
        tried = plan_points(setting, sweep)
        if not tried:
            raise InputError("nothing to sweep: the groups have no values")
        costs = [estimated_seconds(one.cost or one.family, setting, sweep, measurer.source_modes) for one in tried]
        show(f"{counted(len(tried), 'file')} to make and measure: about {format_estimate(sum(costs))} here")
        points = list[SweepPoint | SweepFailure]()
        for number, candidate in enumerate(tried):
            report("the sweep", sum(costs[:number]) / sum(costs))
            points.append(_measure(measurer, candidate, lambda _stage, done: report("this file", done)))
            show(_line(points[-1], number + 1, len(tried)))
    first = points[0]
    if isinstance(first, SweepFailure) and all(isinstance(one, SweepFailure) for one in points):
        raise InputError(f"no point could be measured; {first.name}: {first.error}")
    machine = describe_machine(sweep.threads)
    return Tradeoff(setting, sweep, points, measurer.source_modes, measurer.source_image_scores, machine)


def estimated_seconds(kind: str, setting: SweepSetting, sweep: SweepOptions, modes: dict[str, ModeTime]) -> float:
    """Estimate the seconds for a point of a kind from the number of splats and the time of a render."""
    each, by_splats, by_renders = _COSTS[kind]
    milliseconds = next((one.milliseconds for name, one in modes.items() if name != "exact"), 100.0)
    steps = sweep.iterations / SweepOptions.iterations if kind == "finetune" else 1.0
    return each + by_splats * len(setting.source) / 1e6 + by_renders * steps * 8.0 * milliseconds / 1000.0


def _measure(measurer: Measurer, candidate: PlannedPoint, progress: Progress) -> SweepPoint | SweepFailure:
    try:
        return measurer.measure(candidate, progress)
    except CsplatError as error:
        return SweepFailure(candidate.name, candidate.family, " ".join(str(error).split()))
    except MemoryError:
        return SweepFailure(candidate.name, candidate.family, "out of memory")


def _line(point: SweepPoint | SweepFailure, number: int, count: int) -> str:
    if isinstance(point, SweepFailure):
        return f"{number}/{count} {point.name}: {point.error}"
    size, seconds = format_bytes(point.size_bytes), f"{point.encode_seconds:.1f} s"
    return f"{number}/{count} {point.name}: {size}, {point.psnr:.2f} dB, {seconds}"


_MOST_DISTILLED = 2  # SH degrees that are distilled, 0 and 1: each takes as long as a simplification


def plan_points(setting: SweepSetting, sweep: SweepOptions) -> list[PlannedPoint]:
    """Return the points of a sweep, quick ones first."""
    makers = {
        "presets": _presets,
        "precision": _precisions,
        "strategies": _strategies,
        "targets": _targets,
        "simplify": _plan_simplified,
        "finetune": _plan_tuned,
    }
    return [one for family, list_of in makers.items() if family in sweep.what for one in list_of(setting, sweep)]


def _presets(setting: SweepSetting, sweep: SweepOptions) -> Iterator[PlannedPoint]:
    for preset in PRESETS:
        options = EncodeOptions(preset=preset, threads=sweep.threads)
        command = encode_command(setting, preset, preset)
        has_bands = setting.source.sh_degree > 0
        yield PlannedPoint(preset, "presets", command, partial(_encode, setting.source, options), is_partial=has_bands)


def _precisions(setting: SweepSetting, sweep: SweepOptions) -> Iterator[PlannedPoint]:
    for decibels in sweep.attribute_psnr:
        name = f"attributes {decibels:g} dB"
        options = EncodeOptions(preset=sweep.preset, attribute_psnr=decibels, threads=sweep.threads)
        command = encode_command(setting, name, sweep.preset, attribute_psnr=decibels)
        yield PlannedPoint(name, "precision", command, partial(_encode, setting.source, options))


def _strategies(setting: SweepSetting, sweep: SweepOptions) -> Iterator[PlannedPoint]:
    """Yield the points of `csplat_tools.study`, and plain SH degrees; those that need renders come last."""

    def strategy(name: str, reduction: Reduction, cost: str = "strategies") -> PlannedPoint:
        how = replace(reduction, threads=sweep.threads)
        command = reduction_command(setting, name, sweep.preset, reduction)
        return PlannedPoint(name, "strategies", command, partial(_reduce, setting, sweep, how), cost=cost)

    degree = setting.source.sh_degree
    for kept in reversed(range(degree)):
        options = EncodeOptions(preset=sweep.preset, sh_degree=kept, threads=sweep.threads)
        command = encode_command(setting, f"SH {kept}", sweep.preset, sh_degree=kept)
        yield PlannedPoint(f"SH {kept}", "strategies", command, partial(_encode, setting.source, options))
    for tau in sweep.opacities:
        yield strategy(f"opacity > {tau:g}", Reduction(prune_opacity=tau))
    if degree and sweep.opacities:
        tau = sweep.opacities[-1]
        yield strategy(f"SH 0, opacity > {tau:g}", Reduction(prune_opacity=tau, sh_degree=0))
    for entries in sweep.kmeans:
        yield strategy(f"k-means {entries:g}", Reduction(kmeans=round(entries)), "k-means")
    for kept in reversed(range(min(degree, _MOST_DISTILLED))):
        yield strategy(f"SH {kept}, distilled", Reduction(sh_degree=kept, distil=True), "distilled")


def _targets(setting: SweepSetting, sweep: SweepOptions) -> Iterator[PlannedPoint]:
    for psnr in sweep.psnr:
        yield _target(setting, sweep, f"target {psnr:g} dB", Target(psnr=psnr))
    for size in sweep.sizes:
        yield _target(setting, sweep, f"target {format_bytes(size)}", Target(size_bytes=size))


def _target(setting: SweepSetting, sweep: SweepOptions, name: str, target: Target) -> PlannedPoint:
    command = target_command(setting, name, sweep.preset, target_psnr=target.psnr, target_size=target.size_bytes)
    return PlannedPoint(name, "targets", command, partial(_reach, setting, sweep, target))


def _plan_simplified(setting: SweepSetting, sweep: SweepOptions) -> Iterator[PlannedPoint]:
    for keep in sweep.keep:
        command = target_command(setting, f"keep {keep:g}", sweep.preset, keep=keep)
        yield PlannedPoint(f"keep {keep:g}", "simplify", command, partial(_reach, setting, sweep, Target(keep=keep)))


def _plan_tuned(setting: SweepSetting, sweep: SweepOptions) -> Iterator[PlannedPoint]:
    one_keep = sweep.keep[len(sweep.keep) // 2 :][:1]  # only the middle one: each takes minutes
    for keep in (None, *one_keep):
        name = "tuned" if keep is None else f"tuned, keep {keep:g}"
        command = finetune_command(setting, name, sweep, keep)
        yield PlannedPoint(name, "finetune", command, partial(_tune, setting, sweep, keep))


def _encode(source: SplatModel, options: EncodeOptions, progress: Progress) -> SweepFile:
    return _made(encode_with_report(source, options, progress=progress))


def _reduce(setting: SweepSetting, sweep: SweepOptions, reduction: Reduction, progress: Progress) -> SweepFile:
    return _made(
        encode_reduced(
            setting.source, reduction, EncodeOptions(preset=sweep.preset, threads=sweep.threads),
            views=setting.views, progress=progress,
        )
    )  # fmt: skip


def _reach(setting: SweepSetting, sweep: SweepOptions, target: Target, progress: Progress) -> SweepFile:
    options = EncodeOptions(preset=sweep.preset, threads=sweep.threads)
    made = encode_with_report(setting.source, options, target=target, views=setting.views, progress=progress)
    assert made.report.search is not None
    return _made(made, target=made.report.search.as_json())


def _made(result: EncodeResult, **settings: Any) -> SweepFile:
    return SweepFile(result.data, {"encoding": result.report.options, **settings})


def _tune(setting: SweepSetting, sweep: SweepOptions, keep: float | None, progress: Progress) -> SweepFile:
    """Make the file of `csplat finetune` with its default options."""
    itself = not setting.views.images
    encoding = EncodeOptions(preset=sweep.preset, shape_codebook_size=SHAPE_ENTRIES, threads=sweep.threads)
    options = FinetuneOptions(iterations=sweep.iterations, byte_cost=RATE_WEIGHT[itself])
    tuned = choose_and_finetune(
        setting.source, _tuning_views(setting), encoding, options.scaled(LEARNING_FACTOR[itself]),
        None if keep is None else Target(keep=keep), progress=progress,
    )  # fmt: skip
    made = tuned.made
    settings = {
        "steps": made.log["steps"],
        "best_step": made.log["best_iteration"],
        "keep": keep,
        **tuned.pruning,
    }
    return SweepFile(made.data, {"encoding": made.result.report.options, "finetune": settings}, dict(tuned.seconds))


def _tuning_views(setting: SweepSetting) -> ViewSet:
    """Return the views of `csplat finetune`: all images that are not test views, or more virtual views."""
    views = setting.views
    if views.images:
        test = {pose_key(camera) for camera in views.test}
        training = [one.camera for one in views.images if pose_key(one.camera) not in test]
        return replace(views, training=training, validation=())
    return find_view_set(
        setting.source, cameras=setting.cameras, background=setting.background, count=VIEWS, size=VIEW_SIZE,
        validation_count=default_validation_count(VIEWS, cameras=setting.cameras, data=None),
    )  # fmt: skip


_IMPORTS = (
    "from pathlib import Path; from csplat import EncodeOptions, read_ply;"
    " from csplat_tools.study import Reduction, encode_reduced"
)


def file_name(setting: SweepSetting, name: str) -> str:
    """Return the file name of a point: `scene-target-40-dB.csplat`."""
    stem = "scene" if setting.path == STANDARD_STREAM else PurePath(setting.path).stem
    return f"{stem}-{re.sub(r'[^A-Za-z0-9.]+', '-', name)}.csplat"


def encode_command(setting: SweepSetting, name: str, preset: str, **options: Any) -> str:
    """Return the `csplat encode` command for a file that does not depend on views."""
    return _csplat_command("encode", setting, name, "--preset", preset, *_option_words(options))


def target_command(setting: SweepSetting, name: str, preset: str, **options: Any) -> str:
    """Return the `csplat encode` command for a file that depends on views.

    It is empty if the views depend on options of the data set that the command line does not have.
    """
    if _has_own_data_options(setting):
        return ""
    return _csplat_command("encode", setting, name, *_option_words(options), "--preset", preset, *_view_words(setting))


def finetune_command(setting: SweepSetting, name: str, sweep: SweepOptions, keep: float | None) -> str:
    """Return the `csplat finetune` command for a file; empty as for `target_command`."""
    if _has_own_data_options(setting):
        return ""
    options = {"keep": keep, "iterations": None if sweep.iterations == SweepOptions.iterations else sweep.iterations}
    words = [*([] if setting.views.images else ["--self"]), *_option_words(options), "--preset", sweep.preset]
    return _csplat_command("finetune", setting, name, *words, *_view_words(setting))


def reduction_command(setting: SweepSetting, name: str, preset: str, reduction: Reduction) -> str:
    """Return a Python command for a file of `csplat_tools.study`, which has no csplat command."""
    before, others, views = "", list[str](), ""
    if reduction.prune_opacity is not None:
        others.append(f"prune_opacity={reduction.prune_opacity!r}")
    if reduction.sh_degree is not None:
        others.append(f"sh_degree={reduction.sh_degree}")
    if reduction.kmeans is not None:
        others.append(f"kmeans={reduction.kmeans}")
    if reduction.distil:
        others.append("distil=True")
        before = "from csplat_tools.views import DataOptions, find_view_set; "
        views = f", views=find_view_set(scene{_view_arguments(setting)})"
    source = "/dev/stdin" if setting.path == STANDARD_STREAM else setting.path
    arguments = f"scene, Reduction({', '.join(others)}), EncodeOptions(preset={_literal(preset)}){views}"
    program = (
        f"{_IMPORTS}; {before}scene = read_ply({_literal(source)}); "
        f"made = encode_reduced({arguments}); "
        f"Path({_literal(file_name(setting, name))}).write_bytes(made.data)"
    )
    return f"python -c {shlex.quote(program)}"


def _csplat_command(command: str, setting: SweepSetting, name: str, *words: str) -> str:
    return shlex.join(["csplat", command, setting.path, file_name(setting, name), *words])


def _option_words(values: dict[str, Any]) -> list[str]:
    given = {name: value for name, value in values.items() if value is not None}
    return [word for name, value in given.items() for word in (f"--{name.replace('_', '-')}", _number_text(value))]


def _number_text(value: Any) -> str:
    """Return a number in its short form if that is exact, else in full."""
    short = str(value) if isinstance(value, int) else f"{value:g}"
    return short if float(short) == value else repr(value)


def _has_own_data_options(setting: SweepSetting) -> bool:
    """Return True if the data set has options that only programs can set."""
    data = setting.data
    if data is None:
        return False
    return any(value is not None for value in (data.size, data.test_every, data.near))


def _view_words(setting: SweepSetting) -> list[str]:
    """Return the options that select the views of the sweep."""
    words, data = list[str](), setting.data
    if setting.cameras is not None:
        words += ["--cameras", setting.cameras]
    if data is not None:
        words += ["--data", data.path if data.images is None else str(PurePath(data.path, data.images))]
        words += ["--trust-paths"] if data.trust_paths else []
    if setting.background is not None:
        words += ["--background", ",".join(repr(one) for one in setting.background)]
    return words


def _view_arguments(setting: SweepSetting) -> str:
    """Return the views of the sweep as arguments of `find_view_set`."""
    words, data = list[str](), setting.data
    if setting.cameras is not None:
        words.append(f"cameras={_literal(setting.cameras)}")
    if data is not None:
        images = None if data.images is None else _literal(data.images)
        trust = ", trust_paths=True" if data.trust_paths else ""
        words.append(f"data=DataOptions({_literal(data.path)}, {data.size}, {images}, {data.test_every}{trust})")
    if setting.background is not None:
        words.append(f"background={setting.background}")
    return "".join(f", {word}" for word in words)


def _literal(value: str) -> str:
    """Return a string literal of Python, in double quotation marks."""
    return json.dumps(value, ensure_ascii=False)
