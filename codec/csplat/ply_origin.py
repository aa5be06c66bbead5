"""The origin that a PLY's positions are measured from."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.ply_comments import SceneFacts
from csplat.types import F32, F64

#: float64 positions keep origin 0 while their centre is nearer than this many spreads: float32
#: relative to 0 then is at most four bits coarser than relative to the centre.
_NEAR_SPREADS = 16.0


def relative_to_origin(means: NDArray[Any], facts: SceneFacts) -> tuple[F32, tuple[float, float, float], F64 | None]:
    """Split the positions of a PLY into float32 means and the origin they are relative to.

    Args:
        means: [N, 3] x, y, z as the file has them, float32 or float64.
        facts: metadata from the comments of the file, with their origin.

    Returns:
        [N, 3] float32 and three float64, in scene units; and the positions in doubles, where float32 does not hold
        what is left of them.
    """
    with np.errstate(over="ignore"):  # the model refuses what leaves float32
        if means.dtype == np.float32:
            origin = None if facts.origin_is_added else facts.origin
            return means, origin or (0.0, 0.0, 0.0), None
        positions = means
        origin = facts.origin
        if origin is None:
            origin = _origin_for(means)
        elif not facts.origin_is_added:
            positions = means + np.array(origin)
        rounded = (positions - np.array(origin)).astype(np.float32)
        exact = np.array_equal(rounded + np.array(origin), positions)
        return rounded, origin, None if exact else positions


def _origin_for(positions: F64) -> tuple[float, float, float]:
    """Choose an origin for float64 positions so that float32 loses nothing that shows.

    Zero, where float32 is exact or the scene lies around zero; else its centre (the median, which
    outliers do not move), rounded to a power of two near the scene's spread.
    """
    if len(positions) == 0 or np.array_equal(positions, positions.astype(np.float32)):
        return (0.0, 0.0, 0.0)
    centre = np.median(positions, axis=0)
    spread = float(np.median(np.abs(positions - centre), axis=0).max())
    if np.abs(centre).max() <= _NEAR_SPREADS * spread:
        return (0.0, 0.0, 0.0)
    if spread > 0.0:
        step = 2.0 ** np.floor(np.log2(spread))
        centre = np.round(centre / step) * step
    x, y, z = centre.tolist()
    return x, y, z
