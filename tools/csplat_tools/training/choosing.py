"""What tuning looks at, and which splats its file is to hold: the inputs of `csplat finetune`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import Importance
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.removal import measure_removal
from csplat_tools.files.console import Progress
from csplat_tools.files.importance import read_importance
from csplat_tools.optimise.sensitivity import measure_views
from csplat_tools.optimise.simplify import SimplifyOptions, simplify
from csplat_tools.views import VIEW_COUNT, ViewSet, with_deciders
from csplat_trainer.sensitivity import Sensitivity
from csplat_trainer.sensitivity_file import StoredSensitivity
from csplat_trainer.tuning import View, Views, renders_of, split_views

__all__ = ["Chosen", "choose_splats", "training_views"]

I64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Chosen:
    """The splats that the file will hold.

    Attributes:
        model: the splats; their colours are fitted anew where others were taken away.
        rows: [N] int64, which splats of the source they are, ascending.
        importance: how much pictures depend on each.
        said: what was done, JSON-compatible.
    """

    model: SplatModel
    rows: I64
    importance: NDArray[Any] | Importance
    said: Mapping[str, Any] = field(default_factory=dict)


def training_views(source: SplatModel, views: ViewSet, threads: int | None) -> Views:
    """What the tuning looks at: photographs, or renders of the scene itself; none of those that judge.

    Where no view decides which step was best, some that teach do.
    """
    behind = np.array(views.background, np.float32)

    def looks(cameras: Sequence[Camera]) -> list[View]:
        if views.photographs:
            return [View(one.camera, one) for one in views.pictures(cameras)]
        return renders_of(source, cameras, behind, threads)

    teach = looks(views.teaches)
    return Views(teach, looks(views.decides), behind) if views.decides else split_views(teach, behind)


def choose_splats(
    source: SplatModel,
    views: ViewSet,
    *,
    keep: float | None = None,
    prune_unseen: bool | None = None,
    importance: str | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Chosen:
    """Leave out what no view shows and what pictures need least, and weigh the others.

    Args:
        source: the scene.
        views: those that teach say how much splats matter.
        keep: share of the splats that stay, the others being those that pictures need least; `None`: all.
        prune_unseen: leave out splats that no view shows that teaches or decides; `None`: if they took photographs.
        importance: a file of weights of the source's splats; `None`: what stays is measured in these views, as
            `csplat sensitivity` does.
        threads: how many; `None` for all.
        progress: is told the stages.

    Raises:
        InputError: no view shows anything; or the file is none, or about another scene.
    """
    measuring = views.teaches[:VIEW_COUNT] if views.virtual else views.teaches
    looking = [*views.teaches, *views.decides]

    def weighed(model: SplatModel) -> Sensitivity:
        return measure_views(
            model, measuring, views.background, matrices=True, magnitudes=False, threads=threads, progress=progress
        )

    given = _read(importance, source)
    prune = bool(views.photographs) if prune_unseen is None else prune_unseen
    found = weighed(source) if given is None and keep is None else None
    if found is not None and not (prune and len(measuring) < len(looking)):
        seen = found.seen
    else:
        seen = measure_removal(
            source, looking, background=views.background, bands=False, threads=threads, progress=progress
        ).seen
    if not seen.any():
        raise InputError("no view shows any splat: scene and cameras do not belong together")
    rows = np.flatnonzero(seen) if prune else np.arange(len(source))
    model, said = source.select(rows), {"unseen": len(source) - len(rows)}
    if keep is not None:
        teaching = with_deciders(replace(views, teaches=measuring, judges=()))
        model, kept = _simplified(model, teaching, keep * len(source) / len(rows), threads, progress)
        rows, said = rows[kept], {**said, "simplified_from": len(rows)}
    if given is not None:
        return Chosen(model, rows, given.select(rows) if isinstance(given, Importance) else given[rows], said)
    if found is not None:
        return Chosen(model, rows, StoredSensitivity.of(source, found).importance().select(rows), said)
    return Chosen(model, rows, StoredSensitivity.of(model, weighed(model)).importance(), said)


def _read(importance: str | None, source: SplatModel) -> NDArray[Any] | Importance | None:
    """What a file says of the source's splats."""
    if importance is None:
        return None
    given = read_importance(importance, source)
    if isinstance(given, StoredSensitivity):
        return given.importance()
    if isinstance(given, np.ndarray) and given.shape != (len(source),):
        raise InputError(f"{importance} has shape {given.shape}, wanted ({len(source)},)")
    return given


def _simplified(
    model: SplatModel, views: ViewSet, keep: float, threads: int | None, progress: Progress | None
) -> tuple[SplatModel, I64]:
    """A share of the splats, their colours fitted, and which they are."""
    if keep >= 1.0:
        return model, np.arange(len(model))
    options = SimplifyOptions(threads=threads)
    result = simplify(model, keep=keep, views=views, options=options, progress=progress)
    return result.model, result.source_index
