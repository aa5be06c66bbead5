# SPDX-License-Identifier: Apache-2.0
"""Reports on a training and on a tuned file: JSON, text, and the HTML page of `csplat train` and `finetune`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import read_header
from csplat.encoder import EncodeResult
from csplat.errors import counted
from csplat.model import SplatModel
from csplat.types import U8
from csplat_render.metrics import Distance
from csplat_tools import html_report as html
from csplat_tools.console import format_bytes, format_seconds, format_table
from csplat_tools.file_streams import write_text
from csplat_tools.html_report import INK, draw_svg
from csplat_tools.inspect.file_description import bytes_by_attribute
from csplat_tools.render_files import to_uint8
from csplat_tools.scene_files import ply_splat_bytes
from csplat_tools.views import ViewSet, evenly_spaced

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from csplat_trainer.fitter import FitStep


#: Scores that are reported, with their number of digits after the decimal point.
SCORES = {"psnr": 2, "psnr_mean": 2, "ssim": 4, "lpips": 4}

_TEST_IMAGES = "held-out photographs"  # in JSON; texts call them images


@dataclass(frozen=True)
class ModelScores:
    """Scores of several models on the test views.

    Attributes:
        reference: kind of the reference images, in words.
        view_count: number of views.
        scores: psnr (pooled), psnr_mean, ssim and lpips (or `None`) by name of the model.
    """

    reference: str
    view_count: int
    scores: Mapping[str, Mapping[str, float | None]]


def score_models(
    source: SplatModel,
    models: Mapping[str, SplatModel],
    views: ViewSet,
    lpips: Distance | None,
    context: Context = DEFAULT_CONTEXT,
    *,
    known: Mapping[str, Mapping[str, float | None]] | None = None,
) -> ModelScores | None:
    """Score models on test views: against images, else against renders of the source.

    Args:
        source: the scene.
        models: models by name; the source itself is left out if its renders are the reference.
        views: the views; only test views are used.
        lpips: computes LPIPS; `None`: it is not computed.
        context: threads and progress.
        known: scores of models that were scored against the same images before, by name.

    Returns:
        The scores; `None` without test views.
    """
    if not views.test:
        return None
    has_images = bool(views.images)
    scorer = views.image_test_scorer(context=context) if has_images else views.test_scorer(source, context=context)
    scores: dict[str, dict[str, float | None]] = {}
    for name, model in models.items():
        if known is not None and name in known:
            scores[name] = {score: known[name][score] for score in SCORES}
        elif has_images or model is not source:
            measured = scorer.scores(model, lpips=lpips)
            scores[name] = {score: getattr(measured, score) for score in SCORES}
    reference = _TEST_IMAGES if has_images else "renders of the source"
    return ModelScores(reference, len(views.test), scores)


def make_tuning_report(
    source: SplatModel,
    plain: EncodeResult,
    result: EncodeResult,
    test: ModelScores | None,
    log: Mapping[str, Any],
    seconds: Mapping[str, float],
    pruning: Mapping[str, Any],
) -> dict[str, Any]:
    """Build the report as JSON-compatible values.

    Args:
        source: the scene before pruning.
        plain: the file with the same quantisation before tuning.
        result: the tuned file.
        test: scores on test views; `None` if there are none.
        log: log of the tuning.
        seconds: time by stage.
        pruning: report on the splats that were pruned.
    """
    bytes_of = bytes_by_attribute(result.data, read_header(result.data))
    overhead = bytes_of.pop("overhead")
    size, count = len(result.data), len(source)
    return {
        "source_splats": count,
        "splats": result.report.splat_count,
        "unseen": pruning["unseen"],
        "sh_degree": source.sh_degree,
        "size_bytes": size,
        "size_bytes_before_tuning": len(plain.data),
        "bytes_per_source_splat": size / count,
        "ratio": count * ply_splat_bytes(source.sh_degree) / size,
        "bytes_by_attribute": bytes_of,
        "overhead_bytes": overhead,
        "test_reference": None if test is None else test.reference,
        "test_view_count": 0 if test is None else test.view_count,
        "scores": {} if test is None else {name: dict(values) for name, values in test.scores.items()},
        "decoded_is_what_was_tuned": True,  # `finetune` raises an error otherwise
        "validation": {
            "views": log["validation_views"],
            "held_out": log["held_out"],
            "psnr_before": log["start_psnr"],
            "psnr": log["best_psnr"],
        },
        "steps": log["steps"],
        "best_step": log["best_iteration"],
        "converged": log["converged"],
        "seconds": dict(seconds),
        "seconds_without_judging": round(sum(v for k, v in seconds.items() if k != "judging"), 3),
        "peak_memory_bytes": log["peak_memory_bytes"],
        "encoding": result.report.options,
    }


def format_tuning_report(report: Mapping[str, Any]) -> str:
    """Return the report as text."""
    unseen = report["unseen"]
    others = report["source_splats"] - report["splats"] - unseen
    words = []
    if unseen:
        words.append(f"{unseen} that no view shows")
    if others:
        words.append(f"{others} of low importance")
    left_out = f" ({' and '.join(words)} pruned)" if words else ""
    size = f"{format_bytes(report['size_bytes'])}, {report['bytes_per_source_splat']:.2f} bytes per source splat"
    ratio = f"{report['ratio']:.1f} times smaller than a PLY of {ply_splat_bytes(report['sh_degree'])} bytes per splat"
    lines = [f"{counted(report['source_splats'], 'splat')}{left_out}: {size}, {ratio}"]
    if report["scores"]:
        header = (f"{report['test_view_count']} {_reference_text(report['test_reference'])}", *SCORES)
        lines += ["", format_table(header, score_rows(report["scores"]))]
    parts = [*report["bytes_by_attribute"].items(), ("everything else", report["overhead_bytes"])]
    rows_bytes = [(name, size, f"{size / report['source_splats']:.2f}") for name, size in parts]
    lines += ["", format_table(("bytes", "all", "per source splat"), rows_bytes)]
    times = ", ".join(f"{name} {seconds:.1f}" for name, seconds in report["seconds"].items())
    stop = " until convergence" if report["converged"] else ""
    lines += ["", f"{counted(report['steps'], 'step')}{stop}; best step {report['best_step']}; seconds: {times}"]
    return "\n".join(lines)


def describe_step(now: FitStep) -> str:
    """Return the progress of a training or a tuning as a line, which a terminal of 80 columns may cut at its end."""
    size = "" if now.size_bytes is None else f", {format_bytes(now.size_bytes)}"
    return (
        f"{format_seconds(now.seconds_left)} left, {now.iteration}/{now.iterations} steps, PSNR {now.psnr:.2f} dB,"
        f" {counted(now.splat_count, 'splat')}{size}"
    )


def score_rows(scores: Mapping[str, Mapping[str, float | None]]) -> list[tuple[str, ...]]:
    """Return a table row per model, with a dash for scores that were not measured."""

    def cell(value: float | None, digits: int) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    return [
        (_caption(name), *(cell(values[score], digits) for score, digits in SCORES.items()))
        for name, values in scores.items()
    ]


def _caption(name: str) -> str:
    """Return the name of a model, which is a key of JSON, for people."""
    return name.replace("_", " ")


_SHOWN_VIEWS = 3  # number of test views on the page
_WIDE, _HIGH = 7.0, 3.4  # width and height of a plot, inches
_LINE, _OTHER = "#2f83c9", "#d55e00"


@dataclass(frozen=True, eq=False)
class ShownView:
    """Images of a test view.

    Attributes:
        name: name of its image, or number of the view.
        images: [H, W, 3] uint8 each, by caption.
    """

    name: str
    images: Mapping[str, U8]


def show_views(
    source: SplatModel, models: Mapping[str, SplatModel], views: ViewSet, context: Context
) -> list[ShownView]:
    """Render a few test views, evenly spread, and return the renders next to the reference images.

    Args:
        source: the scene, whose renders are the reference if the views have no images.
        models: models to render, by name.
        views: the views.
        context: threads and progress.
    """
    if not views.test:
        return []
    places = evenly_spaced(range(len(views.test)), _SHOWN_VIEWS)
    views = replace(views, test=[views.test[place] for place in places])
    scorer = views.image_test_scorer(context=context) if views.images else views.test_scorer(source, context=context)
    reference = "image" if views.images else "the source"
    rows: list[dict[str, U8]] = [{} for _ in places]
    for name, model in models.items():
        if model is source and not views.images:
            continue  # it is the reference itself

        def add(at: int, image: NDArray[np.float32], render: NDArray[np.float32], name: str = name) -> None:
            rows[at].setdefault(reference, to_uint8(image))
            rows[at][_caption(name)] = to_uint8(render)

        scorer.scores(model, ssim=False, on_view=add)
    names = [camera.image or f"view {place}" for place, camera in zip(places, scorer.cameras, strict=True)]
    return [ShownView(name, row) for name, row in zip(names, rows, strict=True)]


def write_training_page(
    path: str, name: str, training: Mapping[str, Any] | None, file: Mapping[str, Any] | None, shown: Sequence[ShownView]
) -> None:
    """Write the page; arguments as for `make_training_page`.

    Raises:
        OSError: the page cannot be written.
    """
    write_text(path, make_training_page(PurePath(name).name, training, file, shown))


def make_training_page(
    title: str, training: Mapping[str, Any] | None, file: Mapping[str, Any] | None, shown: Sequence[ShownView]
) -> str:
    """Return the page as HTML.

    Args:
        title: name of the scene or file.
        training: log of the training; `None` without a training.
        file: report on the tuned file, with its log; `None` without a tuning.
        shown: images of test views.
    """
    sizes = {} if file is None else {**file["bytes_by_attribute"], "overhead": file["overhead_bytes"]}
    parts = [
        _score_section(training, file),
        _image_section(shown),
        _training_section(training),
        _tuning_section(file),
        html.section("Bytes by attribute", html.attribute_figure(sizes)) if sizes else "",
        html.section("Options", html.definitions(_option_texts(training, file))),
    ]
    return html.document(title, parts, _summarise(training, file))


def _summarise(training: Mapping[str, Any] | None, file: Mapping[str, Any] | None) -> str:
    """Return a line on the result: splats, size of the file, and minutes of training and tuning without scoring."""
    words = []
    if file is not None:
        words += [counted(file["splats"], "splat"), format_bytes(file["size_bytes"])]
        words.append(f"{file['ratio']:.1f} times smaller than the PLY")
    elif training is not None:
        words.append(counted(training["splats"], "splat"))
    seconds = training["seconds"] if training else 0.0
    if file is not None:
        tuning = file["seconds"]["tuning"]
        # A resumed tuning took longer than this run: the log has the time of all runs.
        seconds += file["seconds_without_judging"] - tuning + max(tuning, file["log"]["seconds"])
    return "; ".join([*words, f"{seconds / 60:.1f} minutes"])


def _score_section(training: Mapping[str, Any] | None, file: Mapping[str, Any] | None) -> str:
    """Return the section on the scores of the file, or else of the trained scene; empty without scores."""
    if file is not None and file["scores"]:
        scores, view_count, reference = file["scores"], file["test_view_count"], file["test_reference"]
    elif training is not None and training["metrics"]:
        scores, view_count = {"trained scene": training["metrics"]}, training["metrics"]["views"]
        reference = _TEST_IMAGES
    else:
        return ""
    text = (
        f"Measured on {view_count} {_reference_text(reference)}, which had no part in the training. psnr is pooled over"
        " all pixels, dB; psnr_mean is the mean over the views, as in papers; ssim is 1 at best, lpips 0."
    )
    return html.section("Scores", html.paragraph(text), html.table(("", *SCORES), score_rows(scores)))


def _reference_text(reference: str) -> str:
    """Return the words for the references of the test views."""
    return "held-out images" if reference == _TEST_IMAGES else reference


def _image_section(shown: Sequence[ShownView]) -> str:
    """Return the section with images of test views; empty without any."""
    blocks = [f"<h3>{escape(view.name)}</h3>\n{html.image_row(view.images, view.name)}" for view in shown]
    text = "Test views, evenly spread. Images are compressed for this page."
    return html.section("Renders", html.paragraph(text), *blocks) if blocks else ""


def _training_section(training: Mapping[str, Any] | None) -> str:
    """Return the section with the plot of a training; empty if its log has fewer than two entries."""
    if training is None or len(training["entries"]) < 2:
        return ""
    entries, evaluations = training["entries"], training["evaluations"]

    def draw(canvas: Figure) -> None:
        """Plot PSNR of training and test images, and the number of splats, by step."""
        psnr_axes = canvas.add_subplot()
        steps = [entry["iteration"] for entry in entries]
        psnr_axes.plot(steps, [entry["psnr"] for entry in entries], color=_LINE, label="training images")
        if evaluations:
            test_steps = [evaluation["iteration"] for evaluation in evaluations]
            test_psnrs = [evaluation["psnr"] for evaluation in evaluations]
            psnr_axes.plot(test_steps, test_psnrs, "o", color=_OTHER, label="test images")
        psnr_axes.set(xlabel="step", ylabel="PSNR, dB")
        psnr_axes.legend(loc="lower right")
        count_axes = psnr_axes.twinx()
        count_axes.plot(steps, [entry["splat_count"] for entry in entries], ":", color=INK)
        count_axes.set_ylabel("splats (dotted)")
        count_axes.set_ylim(bottom=0)
        count_axes.grid(visible=False)

    half_size = training["options"]["half_size"]  # fraction of the steps
    note = html.paragraph(f"The first {half_size:.0%} of the steps used images of half the size.") if half_size else ""
    return html.section("Training", note, html.figure(draw_svg(draw, (_WIDE, _HIGH), "training")))


def _tuning_section(file: Mapping[str, Any] | None) -> str:
    """Return the section with the plot of a tuning; empty if its log has fewer than two validations."""
    validations = [] if file is None else file["log"]["validations"]
    if len(validations) < 2:
        return ""

    def draw(canvas: Figure) -> None:
        """Plot PSNR of validation views, and the size of the file, by step."""
        psnr_axes = canvas.add_subplot()
        steps = [validation["iteration"] for validation in validations]
        psnr_axes.plot(steps, [validation["psnr"] for validation in validations], "o-", color=_LINE, markersize=3)
        psnr_axes.set(xlabel="step", ylabel="PSNR on validation views, dB")
        size_axes = psnr_axes.twinx()
        size_axes.plot(steps, [validation["size_bytes"] / 1e6 for validation in validations], ":", color=INK)
        size_axes.set_ylabel("MB of the file (dotted)")
        size_axes.grid(visible=False)

    text = "Values are optimised through the encoder's quantisers; the step with the best loss was kept."
    plot = html.figure(draw_svg(draw, (_WIDE, _HIGH), "tuning"))
    return html.section("Tuning", html.paragraph(text), plot)


def _option_texts(training: Mapping[str, Any] | None, file: Mapping[str, Any] | None) -> dict[str, str]:
    """Return options of training, encoding and tuning, seconds by stage, and peak memory as text, by title."""
    words = {}
    if training is not None:
        words["training"] = _format_options(training["options"])
    if file is not None:
        words |= {"encoding": _format_options(file["encoding"]), "tuning": _format_options(file["log"]["options"])}
        words["seconds"] = _format_options(file["seconds"])
    memory = (file["log"] if file else training or {}).get("peak_memory_bytes")
    if memory is not None:
        words["peak memory"] = format_bytes(memory)
    return words


def _format_options(options: Mapping[str, Any]) -> str:
    """Format options as `name value, name value`, without `None`, lists and mappings."""
    return ", ".join(f"{name} {value}" for name, value in options.items() if isinstance(value, str | int | float))
