"""Choose the inputs of `csplat finetune`: the views to tune by, and the splats that the file is to hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import Importance
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import I64, Progress
from csplat_render import Camera
from csplat_render.pruning_error import measure_pruning_error
from csplat_tools.importance_file import read_importance
from csplat_tools.optimise.pruning import simplify
from csplat_tools.optimise.pruning_order import SimplifyOptions
from csplat_tools.optimise.scene_sensitivity import measure_views
from csplat_tools.views import VIEW_COUNT, ViewSet, with_validation_views
from csplat_trainer.sensitivity import Sensitivity
from csplat_trainer.sensitivity_file import StoredSensitivity
from csplat_trainer.tuning import TuningView, TuningViews, renders_of, split_views


@dataclass(frozen=True, eq=False)
class TuningSubset:
    """The splats that the file will hold.

    Attributes:
        model: the splats; refitted if others were pruned.
        rows: [N] int64, their indices in the source, ascending.
        importance: the importance of each.
        pruning: report on the pruned splats, JSON-compatible.
    """

    model: SplatModel
    rows: I64
    importance: NDArray[Any] | Importance
    pruning: Mapping[str, Any] = field(default_factory=dict)


def training_views(source: SplatModel, views: ViewSet, threads: int | None) -> TuningViews:
    """Return the views to tune by: photographs, or renders of the scene itself; none of them is a test view.

    Without validation views to decide which step was best, some training views do.
    """
    background = np.array(views.background, np.float32)

    def as_views(cameras: Sequence[Camera]) -> list[TuningView]:
        if views.images:
            return [TuningView(one.camera, one) for one in views.images_of(cameras)]
        return renders_of(source, cameras, background, threads)

    training = as_views(views.training)
    return (
        TuningViews(training, as_views(views.validation), background)
        if views.validation
        else split_views(training, background)
    )


def choose_splats(
    source: SplatModel,
    views: ViewSet,
    *,
    keep: float | None = None,
    prune_unseen: bool | None = None,
    importance: str | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> TuningSubset:
    """Prune splats that no view shows and those that renders need least, and measure the importance of the others.

    Args:
        source: the scene.
        views: the views; importance is measured from training views.
        keep: fraction of the splats to keep; those that renders need least are pruned; `None`: keep all.
        prune_unseen: prune splats that no training or validation view shows; `None`: only if they are photographs.
        importance: a file of weights of the source's splats; `None`: importance of the kept splats is measured in
            these views, as by `csplat sensitivity`.
        threads: number of threads; `None` for all.
        progress: progress callback.

    Raises:
        InputError: no view shows any splat; or the file is invalid, or belongs to another scene.
    """
    measuring = views.training[:VIEW_COUNT] if views.virtual else views.training
    all_views = [*views.training, *views.validation]

    def measure(model: SplatModel) -> Sensitivity:
        return measure_views(
            model, measuring, views.background, matrices=True, magnitudes=False, threads=threads, progress=progress
        )

    given = _read_importance(importance, source)
    prune = bool(views.images) if prune_unseen is None else prune_unseen
    found = measure(source) if given is None and keep is None else None
    if found is not None and not (prune and len(measuring) < len(all_views)):
        seen = found.seen
    else:
        seen = measure_pruning_error(
            source, all_views, background=views.background, bands=False, threads=threads, progress=progress
        ).seen
    if not seen.any():
        raise InputError("no view shows any splat: scene and cameras do not belong together")
    rows = np.flatnonzero(seen) if prune else np.arange(len(source))
    model, pruning = source.select(rows), {"unseen": len(source) - len(rows)}
    if keep is not None:
        simplify_views = with_validation_views(replace(views, training=measuring, test=()))
        model, kept = _pruned(model, simplify_views, keep * len(source) / len(rows), threads, progress)
        rows, pruning = rows[kept], {**pruning, "simplified_from": len(rows)}
    if given is not None:
        return TuningSubset(model, rows, given.select(rows) if isinstance(given, Importance) else given[rows], pruning)
    if found is not None:
        return TuningSubset(model, rows, StoredSensitivity.of(source, found).importance().select(rows), pruning)
    return TuningSubset(model, rows, StoredSensitivity.of(model, measure(model)).importance(), pruning)


def _read_importance(importance: str | None, source: SplatModel) -> NDArray[Any] | Importance | None:
    """Read the importance of the source's splats from a file; return `None` for `None`."""
    if importance is None:
        return None
    given = read_importance(importance, source)
    if isinstance(given, StoredSensitivity):
        return given.importance()
    if isinstance(given, np.ndarray) and given.shape != (len(source),):
        raise InputError(f"{importance} has shape {given.shape}, wanted ({len(source)},)")
    return given


def _pruned(
    model: SplatModel, views: ViewSet, keep: float, threads: int | None, progress: Progress | None
) -> tuple[SplatModel, I64]:
    """Return a fraction of the splats, refitted, and their indices."""
    if keep >= 1.0:
        return model, np.arange(len(model))
    options = SimplifyOptions(threads=threads)
    result = simplify(model, keep=keep, views=views, options=options, progress=progress)
    return result.model, result.source_index
