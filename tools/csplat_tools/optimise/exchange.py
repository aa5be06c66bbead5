"""What splats and bits are worth in pictures: the one error model that the search decides by.

A decibel costs the share s of a file's bytes, so that quantisation which errs by Q takes bytes in proportion to
n · Q^-k for n splats, k = 10 / ln(10) · s. With P(n) the error of what was removed, a file that may err by D is
smallest where n · (D - P(n))^-k is; one of a given size is best where P(n) + Q · (n / N)^(1 / k) is least, Q being what
quantisation costs while N splats are there.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["BYTES_PER_DB", "LEAST_QUANTISED", "error_at_size", "error_of_psnr", "log_bytes_at_error", "price_of_bytes"]

F64 = NDArray[np.float64]

#: Share of the bytes that a decibel costs, about: 0.035 without SH, 0.05 with it.
BYTES_PER_DB = 0.045

#: Share of a file's error that quantisation is taken to have, at least.
LEAST_QUANTISED = 0.1


def error_of_psnr(psnr: float) -> float:
    """The mean squared error of a PSNR in dB."""
    return math.pow(10.0, -psnr / 10.0)


def error_at_size(left: F64, removed: F64, quantised: float, slope: float) -> F64:
    """The error of files of one size.

    Args:
        left: splats, in units of those for which quantisation costs `quantised`.
        removed: what the others' removal costs.
        quantised: mean squared error.
        slope: share of the bytes that a decibel costs.
    """
    return np.asarray(removed + quantised * left ** (1.0 / price_of_bytes(slope)))


def log_bytes_at_error(left: F64, removed: F64, allowed: float, most: float, slope: float) -> F64:
    """The logarithm of the bytes of files that err alike, but for a constant; infinite where too much is removed.

    Args:
        left: splats, in any unit.
        removed: what the others' removal costs.
        allowed: mean squared error.
        most: share of it that removal may take: what is left for quantisation would else be a small difference of
            numbers that are not known well.
        slope: share of the bytes that a decibel costs.
    """
    fits = removed <= most * allowed
    spare = np.where(fits, allowed - removed, 1.0)
    return np.where(fits, np.log(left) - price_of_bytes(slope) * np.log(spare), np.inf)


def price_of_bytes(slope: float) -> float:
    """The power k with which bytes grow while the error falls.

    Args:
        slope: share of the bytes that a decibel costs.
    """
    return slope * 10.0 / math.log(10.0)
