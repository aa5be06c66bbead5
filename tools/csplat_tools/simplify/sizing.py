"""How many splats the best file of a size or a PSNR holds, when what stays is fitted to the source's renders.

A fit makes removal err by less: how much less, one number of splats says, and the errors of removal how that grows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from csplat_tools.rate.exchange import (
    BYTES_PER_DB,
    LEAST_QUANTISED,
    error_at_size,
    error_of_psnr,
    log_bytes_at_error,
)
from csplat_tools.simplify.order import Order

__all__ = ["count_at_psnr", "first_count", "next_count"]

_USUAL_BYTES = (8.0, 11.0)  # of a splat in files that are worth looking at, without and with SH
_FRAME_BYTES = 1_000  # of a file without splats: header, index, options, stated errors
_MOST_REMOVED = 0.7  # of the error that a PSNR allows
_LEAST_REMOVED = 0.01  # of the error, that what was removed is taken to have


def first_count(size_bytes: int, splats: int, *, has_sh: bool) -> int:
    """How many splats to begin with."""
    return max(1, min(splats, int((size_bytes - _FRAME_BYTES) / _USUAL_BYTES[has_sh])))


def next_count(order: Order, splats: int, count: int, psnr: float, fitted_psnr: float) -> int:
    """How many splats are likely to be best.

    Args:
        order: in which splats go.
        splats: of the source.
        count: of those splats there is a file of that size.
        psnr: of that file, dB.
        fitted_psnr: of its splats before they were quantised.
    """
    error = error_of_psnr(psnr)
    removed = max(min(error_of_psnr(fitted_psnr), error), _LEAST_REMOVED * error)
    quantised = max(error - removed, LEAST_QUANTISED * error)
    left, grown = _removal(order, splats, count)
    return int(left[np.argmin(error_at_size(left / count, removed * grown, quantised, BYTES_PER_DB))])


def count_at_psnr(order: Order, splats: int, count: int, goal: float, fitted_psnr: float) -> int:
    """How many splats are likely to make the smallest file of a PSNR.

    Args:
        order, splats: as for `next_count`.
        count: so many splats were fitted,
        fitted_psnr: which then have this PSNR before they are quantised, dB.
        goal: dB.
    """
    allowed = error_of_psnr(goal)
    removed = max(error_of_psnr(fitted_psnr), _LEAST_REMOVED * allowed)
    left, grown = _removal(order, splats, count)
    cost = log_bytes_at_error(left, removed * grown, allowed, _MOST_REMOVED, BYTES_PER_DB)
    return int(left[np.argmin(cost)])


def _removal(order: Order, splats: int, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How many splats may be left, and how much more error of removal there is then than with `count` of them."""
    sums = np.concatenate([[0.0], np.cumsum(order.errors)])[:splats]
    here = float(sums[min(splats - count, len(sums) - 1)])
    return splats - np.arange(len(sums), dtype=np.float64), sums / here if here > 0.0 else sums
