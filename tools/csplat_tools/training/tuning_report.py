"""Build the report on a tuned file: sizes, scores of source and decoded file on test views, times, bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from csplat.decoder import read_header
from csplat.encoder import EncodeResult
from csplat.errors import counted
from csplat.model import SplatModel
from csplat_render.metrics import Distance
from csplat_tools.console import format_bytes, format_table
from csplat_tools.inspect.file_description import bytes_by_attribute
from csplat_tools.scene_files import ply_splat_bytes
from csplat_tools.views import ViewSet

#: Scores that are reported, with their number of digits after the decimal point.
SCORES = {"psnr": 2, "psnr_mean": 2, "ssim": 4, "lpips": 4}


@dataclass(frozen=True)
class ModelScores:
    """Scores on test views, which were used neither for training nor for validation.

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
    threads: int | None = None,
    *,
    known: Mapping[str, Mapping[str, float | None]] | None = None,
) -> ModelScores | None:
    """Score models on test views: against images, else against renders of the source.

    Args:
        source: the scene.
        models: models by name; the source itself is left out if its renders are the reference.
        views: the views, of which test views are used.
        lpips: computes LPIPS; `None`: it is not computed.
        threads: number of threads; `None` for all.
        known: scores by name of models that were scored against the same images before.

    Returns:
        The scores; `None` without test views.
    """
    if not views.test:
        return None
    has_images = bool(views.images)
    scorer = views.image_test_scorer(threads=threads) if has_images else views.test_scorer(source, threads=threads)
    scores: dict[str, dict[str, float | None]] = {}
    for name, model in models.items():
        if known is not None and name in known:
            scores[name] = {score: known[name][score] for score in SCORES}
        elif has_images or model is not source:
            found = scorer.scores(model, lpips=lpips)
            scores[name] = {score: getattr(found, score) for score in SCORES}
    reference = "held-out photographs" if has_images else "renders of the source"
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
    shares = bytes_by_attribute(result.data, read_header(result.data))
    overhead = shares.pop("overhead")
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
        "bytes_by_attribute": shares,
        "overhead_bytes": overhead,
        "test_reference": None if test is None else test.reference,
        "test_view_count": 0 if test is None else test.view_count,
        "scores": {} if test is None else {name: dict(one) for name, one in test.scores.items()},
        "decoded_is_what_was_tuned": True,  # otherwise the run would have ended with an error
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
    words = [f"{unseen} that no view shows"] * bool(unseen) + [f"{others} that pictures need least"] * bool(others)
    left_out = f" ({' and '.join(words)} are left out)" if words else ""
    size = f"{format_bytes(report['size_bytes'])}, {report['bytes_per_source_splat']:.2f} bytes per source splat"
    ratio = f"{report['ratio']:.1f} times smaller than a PLY of {ply_splat_bytes(report['sh_degree'])} bytes per splat"
    lines = [f"{counted(report['source_splats'], 'splat')}{left_out}: {size}, {ratio}"]
    if report["scores"]:
        header = (f"{report['test_view_count']} {report['test_reference']}", *SCORES)
        lines += ["", format_table(header, score_rows(report["scores"]))]
    parts = [*report["bytes_by_attribute"].items(), ("everything else", report["overhead_bytes"])]
    rows_bytes = [(name, size, f"{size / report['source_splats']:.2f}") for name, size in parts]
    lines += ["", format_table(("bytes", "all", "per source splat"), rows_bytes)]
    times = ", ".join(f"{name} {seconds:.1f}" for name, seconds in report["seconds"].items())
    stop = ", and nothing was gained any more" if report["converged"] else ""
    lines += [
        "",
        f"{counted(report['steps'], 'step')}{stop}; the best stood at {report['best_step']}; seconds: {times}",
    ]
    return "\n".join(lines)


def score_rows(scores: Mapping[str, Mapping[str, float | None]]) -> list[tuple[str, ...]]:
    """Return the rows of a table of scores, one per model, with a dash for scores that were not measured."""

    def cell(value: float | None, digits: int) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    return [(name, *(cell(one[score], digits) for score, digits in SCORES.items())) for name, one in scores.items()]
