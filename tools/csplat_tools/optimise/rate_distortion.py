"""The model of the search: size and error of files, by the number of splats and the precision of their values.

The error of a file is the sum of the error P of pruning and the error Q of quantisation. For one coding, the logarithms
of Q and of the bytes are nearly linear in the precision (`RateLine`), so that n splats take bytes ∝ n · Q^-k. P(n) is
known from the pruning order. Hence the smallest file of error D has the n that minimises n · (D - P(n))^-k. The best
file of a size has the n that minimises P(n) + Q · (n / N)^(1 / k), if N splats of that size have the error Q.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from csplat.types import F64

#: Change of log bytes per dB of quantisation error, by finer steps; measured 0.035 without SH, 0.05 with it.
BYTES_PER_DB = 0.045

#: Least fraction of a file's error that is attributed to quantisation, since a smaller rest is noise.
LEAST_QUANTISED = 0.1

#: Least mean squared error, to divide by.
NOTHING = 1e-12

#: Change of the natural logarithm of an error per dB.
LOG_ERROR_PER_DB = math.log(10.0) / 10.0

_APART = 0.5  # dB; two files of less distance do not determine a slope
#: Range of a measured slope, as a multiple of the assumed one.
LEAST_SLOPE, _LARGEST_SLOPE = 0.3, 2.0
#: Largest fraction of the error that pruning may take; with more, quantisation would have to be too fine. A file of mic
#: at 38 dB took 111 kB with 0.8, and 78 kB with 0.65.
MOST_PRUNED = 0.65


def error_of_psnr(psnr: float) -> float:
    """Return the mean squared error of a PSNR in dB, or the factor of an error by a gain in dB."""
    return math.pow(10.0, -psnr / 10.0)


def rate_exponent(slope: float) -> float:
    """Return the k of bytes ∝ Q^-k if a decibel of Q costs the fraction `slope` of the bytes."""
    return slope / LOG_ERROR_PER_DB


@dataclass(frozen=True)
class RatePoint:
    """A measured file: precision in dB of PSNR of each attribute alone, quantisation error, bytes."""

    quality: float
    error: float
    size_bytes: int


@dataclass(frozen=True)
class RateLine:
    """Logarithms of quantisation error and bytes of one kind of file, linear in the precision.

    Attributes:
        nearest: the file that the line passes through.
        error_slope: change of log error per dB of precision, below 0.
        bytes_slope: change of log bytes per dB of precision, above 0.
    """

    nearest: RatePoint
    error_slope: float
    bytes_slope: float

    @classmethod
    def through(
        cls, points: Sequence[RatePoint], error_slope: float, bytes_slope: float, flattest: float = LEAST_SLOPE
    ) -> RateLine:
        """Return the line through files, the first of which is nearest to the goal.

        Args:
            points: the files. Another one that is far enough from the first determines the slopes.
            error_slope, bytes_slope: the slopes to assume without one, and to limit measured ones by.
            flattest: least slope of the error, as a multiple of the assumed one.
        """
        first = points[0]
        for other in points[1:]:
            apart = other.quality - first.quality
            if abs(apart) >= _APART:
                by_error = math.log(other.error / first.error) / apart / error_slope
                by_size = math.log(other.size_bytes / first.size_bytes) / apart / bytes_slope
                error_slope *= min(max(by_error, flattest), _LARGEST_SLOPE)
                bytes_slope *= min(max(by_size, LEAST_SLOPE), _LARGEST_SLOPE)
                break
        return cls(first, error_slope, bytes_slope)

    def quality_at_error(self, error: float) -> float:
        """Return the precision for a quantisation error."""
        return self.nearest.quality + math.log(error / self.nearest.error) / self.error_slope

    def quality_at_size(self, size_bytes: float) -> float:
        """Return the precision for a size."""
        return self.nearest.quality + math.log(size_bytes / self.nearest.size_bytes) / self.bytes_slope

    def error_at(self, quality: float) -> float:
        """Return the quantisation error at a precision."""
        return self.nearest.error * math.exp(self.error_slope * (quality - self.nearest.quality))

    def log_bytes_at(self, quality: float) -> float:
        """Return the log bytes at a precision."""
        return math.log(self.nearest.size_bytes) + self.bytes_slope * (quality - self.nearest.quality)


def log_bytes_at_error(kept_count: F64, pruned: F64, allowed: float, exponent: float) -> F64:
    """Return the log bytes of files of equal error, up to a constant; infinite if pruning takes too much of it.

    Args:
        kept_count: numbers of kept splats.
        pruned: mean squared error of pruning the others.
        allowed: mean squared error of the files.
        exponent: k of bytes ∝ Q^-k.
    """
    fits = pruned <= MOST_PRUNED * allowed
    rest = np.where(fits, allowed - pruned, 1.0)
    return np.where(fits, np.log(kept_count) - exponent * np.log(rest), np.inf)


def log_bytes_at_size(relative_count: F64, pruned: F64, quantised: float, exponent: float) -> F64:
    """Return the log bytes that the error of files of equal size is worth, up to a constant.

    Args:
        relative_count: numbers of kept splats, relative to the number at which quantisation costs `quantised`.
        pruned: mean squared error of pruning the others.
        quantised: mean squared error of quantisation.
        exponent: k of bytes ∝ Q^-k.
    """
    return np.asarray(exponent * np.log(pruned + quantised * relative_count ** (1.0 / exponent)))
