"""Prune splats by their own opacity and size, without rendering."""

from __future__ import annotations

import numpy as np

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import I64
from csplat_render.virtual_cameras import surface_areas


def prune_opacity(model: SplatModel, tau: float) -> tuple[SplatModel, I64]:
    """Keep the splats whose alpha is larger than a threshold.

    Args:
        model: the scene; its alpha is the sigmoid of a PLY's logit, rounded once to float32.
        tau: the threshold, at least 0 and less than 1. 0 prunes fully transparent splats.

    Returns:
        The kept splats, in their order, and the index of each in the scene, [N] int64.

    Raises:
        InputError: the threshold is out of range, or nothing would be left.
    """
    check_threshold(tau)
    rows = np.flatnonzero(model.opacities.astype(np.float64) > tau)  # tau is not rounded to float32
    if len(model) and not len(rows):
        largest = float(model.opacities.max())
        raise InputError(f"no splat has an opacity above {tau:g}: the largest is {largest:g}")
    return model.select(rows), rows.astype(np.int64, copy=False)


def prune_share(model: SplatModel, keep: float, *, by_area: bool = False) -> tuple[SplatModel, I64]:
    """Keep a fraction of the splats: the most opaque ones, or those with the largest opacity × surface area.

    Args:
        model: the scene.
        keep: the fraction, above 0, at most 1; at least one splat is kept.
        by_area: multiply the opacity by the surface area.

    Returns:
        The kept splats, in their order, and the index of each in the scene, [N] int64.
    """
    keys = model.opacities.astype(np.float64)
    if by_area:
        keys *= surface_areas(model)
    gone = len(model) - max(1, round(keep * len(model)))
    rows = np.sort(np.argsort(keys, kind="stable")[gone:])
    return model.select(rows), rows


def check_threshold(tau: float) -> None:
    """Refuse an invalid opacity threshold.

    Raises:
        InputError: it is not a number of at least 0 and less than 1.
    """
    if not 0.0 <= tau < 1.0:
        raise InputError(f"the opacity to prune by is {tau:g}, wanted at least 0 and less than 1")
