"""Who says how precise splats have to be, so that they may be sorted into grades."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import EncodeOptions, Importance, most_grades
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_tools.importances import measured_importance
from csplat_tools.views import ViewSet, evenly

__all__ = ["measured_for", "measuring_views"]

Weights = NDArray[Any] | Importance
Progress = Callable[[str, float], None]

_GIVEN = 40  # cameras that are enough, of those given
_VIRTUAL = {False: (120, 120), True: (80, 60)}  # small virtual ones, without and with SH; for small scenes and large
_LARGE = 40_000  # splats: of fewer, half of the views would change the size of files by a per cent


def measuring_views(source: SplatModel, views: ViewSet) -> Sequence[Camera]:
    """Views that say how precise splats have to be, of those that teach.

    Virtual ones look from nearer and farther, from below and beside, too. Cameras like those that judge would say less
    of what others see: plane3 graded by 40 of them has 42 dB by them and 39 by others; by these, 41 and 40.
    """
    return evenly(views.teaches, _VIRTUAL[source.sh_degree > 0][len(source) >= _LARGE] if views.virtual else _GIVEN)


def measured_for(
    source: SplatModel,
    views: ViewSet,
    encoding: EncodeOptions,
    importance: Weights | None,
    *,
    inside: bool,
    progress: Progress | None = None,
) -> tuple[Importance | None, int]:
    """Take what the caller knows, or measure the rest.

    Args:
        source: the scene.
        views: those that teach measure.
        encoding: knobs that are set; some leave nothing to grade.
        importance: what the caller knows. Where it holds curvatures, nothing is measured; else it stays for SH.
        inside: virtual views of surroundings, which do not say it.
        progress: is told the stages.

    Returns:
        Weights and curvatures, `None` where nothing says them or they would change nothing; and in how many views they
        were measured here.
    """
    several = most_grades(len(source), encoding) > 1
    if isinstance(importance, Importance) and importance.curvatures is not None:
        return (importance if several else None), 0
    has_sh = source.sh_degree > 0 and encoding.sh_degree != 0 and encoding.sh_coding != "none"
    quick = encoding.preset == "fast" and encoding.grades is None
    if inside or quick or not (several or has_sh):
        return None, 0
    seen_from = measuring_views(source, views)
    try:
        found = measured_importance(source, seen_from, views.background, threads=encoding.threads, progress=progress)
    except InputError:
        return None, 0  # nothing shows
    if isinstance(importance, Importance):
        found = replace(importance, curvatures=found.curvatures)
    elif importance is not None:
        found = replace(found, sh=np.asarray(importance))
    return found, len(seen_from)
