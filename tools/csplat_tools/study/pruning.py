"""Remove splats that are nearly transparent: one comparison a splat, and no picture is looked at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel

__all__ = ["check_threshold", "prune_opacity"]

I64 = NDArray[np.int64]


def prune_opacity(model: SplatModel, tau: float) -> tuple[SplatModel, I64]:
    """Keep the splats whose alpha is larger than a threshold.

    Args:
        model: the scene; its alpha is the sigmoid of a PLY's logit, rounded once to float32.
        tau: the threshold, at least 0 and less than 1. 0 removes what is wholly transparent.

    Returns:
        The others, in their order, and which splat of the scene each one was, [N] int64.

    Raises:
        InputError: the threshold is out of range, or nothing would be left.
    """
    check_threshold(tau)
    rows = np.flatnonzero(model.opacities.astype(np.float64) > tau)  # tau is not rounded to float32
    if len(model) and not len(rows):
        largest = float(model.opacities.max())
        raise InputError(f"no splat has an opacity above {tau:g}: the largest is {largest:g}")
    return model.select(rows), rows.astype(np.int64, copy=False)


def check_threshold(tau: float) -> None:
    """Refuse what is no threshold.

    Raises:
        InputError: it is not a number of at least 0 and less than 1.
    """
    if not 0.0 <= tau < 1.0:
        raise InputError(f"the opacity to prune by is {tau:g}, wanted at least 0 and less than 1")
