"""The rate-distortion model of the search, in the number of splats and the error of quantisation.

A decibel costs the fraction s of a file's bytes, so the bytes for n splats with quantisation error Q are proportional
to n · Q^-k, k = 10 / ln(10) · s. With P(n) the error of pruning, the smallest file of error D has the n that minimises
n · (D - P(n))^-k. The best file of a given size has the n that minimises P(n) + Q · (n / N)^(1 / k), where Q is the
quantisation error with N splats.
"""

from __future__ import annotations

import math

import numpy as np

from csplat.types import F64

#: Typical fraction of the bytes that a decibel costs; measured 0.035 without SH, 0.05 with it.
BYTES_PER_DB = 0.045

#: Least fraction of a file's error that is attributed to quantisation.
LEAST_QUANTISED = 0.1


def error_of_psnr(psnr: float) -> float:
    """Return the mean squared error of a PSNR in dB."""
    return math.pow(10.0, -psnr / 10.0)


def error_at_size(kept_count: F64, removed: F64, quantised: float, slope: float) -> F64:
    """Return the mean squared error of files of one size.

    Args:
        kept_count: number of kept splats, relative to the number at which quantisation costs `quantised`.
        removed: mean squared error of pruning the others.
        quantised: mean squared error of quantisation.
        slope: fraction of the bytes that a decibel costs.
    """
    return np.asarray(removed + quantised * kept_count ** (1.0 / rate_exponent(slope)))


def log_bytes_at_error(kept_count: F64, removed: F64, allowed: float, most: float, slope: float) -> F64:
    """Return the log bytes of files with equal error, up to a constant; infinite if pruning takes too much of it.

    Args:
        kept_count: number of kept splats, in any unit.
        removed: mean squared error of pruning the others.
        allowed: mean squared error of the files.
        most: largest fraction of it that pruning may take; beyond, the rest for quantisation would be a small
            difference of uncertain numbers.
        slope: fraction of the bytes that a decibel costs.
    """
    fits = removed <= most * allowed
    spare = np.where(fits, allowed - removed, 1.0)
    return np.where(fits, np.log(kept_count) - rate_exponent(slope) * np.log(spare), np.inf)


def rate_exponent(slope: float) -> float:
    """Return k of bytes ∝ error^-k for the fraction of the bytes that a decibel costs."""
    return slope * 10.0 / math.log(10.0)
