"""How many splats the best file of a size or a PSNR holds, when what stays is fitted to the source's renders.

As in `csplat_tools.rate`: what was removed errs by P, growing with the errors of removal, quantisation by Q, falling
with the bytes that are left for each splat; a file of one number of splats says how large both are, and where their
sum is least.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from csplat_tools.simplify.order import Order

__all__ = ["count_at_psnr", "first_count", "next_count"]

_USUAL_BYTES = (8.0, 11.0)  # of a splat in files that are worth looking at, without and with SH
_FRAME_BYTES = 1_000  # of a file without splats: header, index, options, stated errors
_BYTES_PER_DB = 0.045  # share of the bytes that a decibel costs
_POWER = _BYTES_PER_DB * 10.0 / math.log(10.0)
_LEAST_SPARE = 0.3  # of the error that a PSNR allows, for quantisation
_LEAST_QUANTISED = 0.1  # of the error of a file, that quantisation is taken to have
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
    error = math.pow(10.0, -psnr / 10.0)
    removed = max(min(math.pow(10.0, -fitted_psnr / 10.0), error), _LEAST_REMOVED * error)
    quantised = max(error - removed, _LEAST_QUANTISED * error)
    left, grown = _removal(order, splats, count)
    total = removed * grown + quantised * (left / count) ** (1.0 / _POWER)
    return int(left[np.argmin(total)])


def count_at_psnr(order: Order, splats: int, count: int, goal: float, fitted_psnr: float) -> int:
    """How many splats are likely to make the smallest file of a PSNR.

    Args:
        order, splats: as for `next_count`.
        count: so many splats were fitted,
        fitted_psnr: which then have this PSNR before they are quantised, dB.
        goal: dB.
    """
    allowed = math.pow(10.0, -goal / 10.0)
    removed = max(math.pow(10.0, -fitted_psnr / 10.0), _LEAST_REMOVED * allowed)
    left, grown = _removal(order, splats, count)
    spare = allowed - removed * grown
    fits = spare >= _LEAST_SPARE * allowed
    cost = np.where(fits, np.log(left) - _POWER * np.log(np.where(fits, spare, 1.0)), np.inf)
    return int(left[np.argmin(cost)])


def _removal(order: Order, splats: int, count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """How many splats may be left, and how much more error of removal there is then than with `count` of them."""
    sums = np.concatenate([[0.0], np.cumsum(order.errors)])[:splats]
    here = float(sums[min(splats - count, len(sums) - 1)])
    return splats - np.arange(len(sums)), sums / here if here > 0.0 else sums
