"""Who says how precise splats have to be, so that a search may sort them into grades."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import EncodeOptions, Importance
from csplat.encoder.grades import most_grades
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.virtual import virtual_cameras
from csplat_tools.importances import measured_importance

__all__ = ["MEASURING_VIEWS", "Graded", "graded_by"]

Weights = NDArray[Any] | Importance
Progress = Callable[[str, float], None]
Colour = tuple[float, float, float]

#: Views that are enough; of virtual ones, width and height, too.
MEASURING_VIEWS = (40, 480, 360)
_SEED = 7  # others than those that judge


@dataclass(frozen=True, eq=False)
class Graded:
    """What is known of the splats.

    Attributes:
        importance: weights and curvatures; None where nothing says them, or they would change nothing.
        views: in how many views they were measured here.
    """

    importance: Importance | None = None
    views: int = 0


def graded_by(
    source: SplatModel,
    cameras: Sequence[Camera] | None,
    background: Colour,
    encoding: EncodeOptions,
    importance: Weights | None,
    *,
    inside: bool,
    progress: Callable[[str, float], None] | None = None,
) -> Graded:
    """Take what the caller knows, or measure the rest.

    Args:
        source: the scene.
        cameras: to measure from; None for virtual ones.
        background: behind everything.
        encoding: knobs that are set; some leave nothing to grade.
        importance: what the caller knows. Where it holds curvatures, nothing is measured; else it stays for SH.
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
    views = list(cameras or virtual_cameras(source, *MEASURING_VIEWS, seed=_SEED))
    try:
        found = measured_importance(source, views, background, threads=encoding.threads, progress=progress)
    except InputError:
        return Graded()  # nothing shows
    if isinstance(importance, Importance):
        found = replace(importance, curvatures=found.curvatures)
    elif importance is not None:
        found = replace(found, sh=np.asarray(importance))
    return Graded(found, len(views))
