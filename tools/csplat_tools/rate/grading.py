"""Who says how precise splats have to be, so that a search may sort them into grades."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import EncodeOptions, Importance, most_grades
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_tools.importances import measured_importance
from csplat_tools.simplifying import DEFAULT_VIEWS
from csplat_tools.views import VIEW_SIZE, camera_sequence

__all__ = ["Graded", "evenly", "graded_by", "measuring_views"]

Weights = NDArray[Any] | Importance
Progress = Callable[[str, float], None]
Colour = tuple[float, float, float]

_GIVEN = 40  # cameras that are enough, of those given
_VIRTUAL = 120  # and of small ones
_SEED = 0


@dataclass(frozen=True, eq=False)
class Graded:
    """What is known of the splats.

    Attributes:
        importance: weights and curvatures; None where nothing says them, or they would change nothing.
        views: in how many views they were measured here.
    """

    importance: Importance | None = None
    views: int = 0


def measuring_views(source: SplatModel, cameras: Sequence[Camera] | None, most: int = DEFAULT_VIEWS) -> list[Camera]:
    """Cameras that say how precise splats have to be: those given, evenly chosen; or small virtual ones.

    Virtual ones are those that decide who may go: they look from nearer and farther, from below and beside, too.
    Cameras like those that judge would say less of what others see: plane3 graded by 40 of them has 42 dB by them and
    39 by others; by these, 41 and 40.

    Args:
        source: the scene.
        cameras: from which to choose.
        most: virtual ones at most.
    """
    if cameras is None:
        return camera_sequence(source, min(most, _VIRTUAL), VIEW_SIZE, seed=_SEED)
    return evenly(cameras, _GIVEN)


def evenly(cameras: Sequence[Camera], most: int) -> list[Camera]:
    """So many of some cameras at most, spread over their order."""
    places = np.unique(np.linspace(0, len(cameras) - 1, min(most, len(cameras))).round().astype(int))
    return [cameras[i] for i in places]


def graded_by(
    source: SplatModel,
    cameras: Sequence[Camera] | None,
    background: Colour,
    encoding: EncodeOptions,
    importance: Weights | None,
    *,
    views: int = DEFAULT_VIEWS,
    inside: bool,
    progress: Progress | None = None,
) -> Graded:
    """Take what the caller knows, or measure the rest.

    Args:
        source: the scene.
        cameras: to measure from; None for virtual ones.
        background: behind everything.
        encoding: knobs that are set; some leave nothing to grade.
        importance: what the caller knows. Where it holds curvatures, nothing is measured; else it stays for SH.
        views: virtual ones at most.
        inside: there are no cameras, and the scene is surroundings, where virtual views do not say it.
        progress: is told the stages.
    """
    several = most_grades(len(source), encoding) > 1
    if isinstance(importance, Importance) and importance.curvatures is not None:
        return Graded(importance if several else None)
    has_sh = source.sh_degree > 0 and encoding.sh_degree != 0 and encoding.sh_coding != "none"
    quick = encoding.preset == "fast" and encoding.grades is None
    if inside or quick or not (several or has_sh):
        return Graded()
    try:
        seen_from = measuring_views(source, cameras, views)
        found = measured_importance(source, seen_from, background, threads=encoding.threads, progress=progress)
    except InputError:
        return Graded()  # nothing shows
    if isinstance(importance, Importance):
        found = replace(importance, curvatures=found.curvatures)
    elif importance is not None:
        found = replace(found, sh=np.asarray(importance))
    return Graded(found, len(seen_from))
