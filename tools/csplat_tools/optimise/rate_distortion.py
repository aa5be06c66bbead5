# SPDX-License-Identifier: Apache-2.0
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

#: Usual change of log bytes per dB of quantisation error, without and with SH. Files of neighbouring numbers of splats
#: show 0.02 (donut, no SH) and 0.07 (garden). Files of neighbouring precisions show 0.035 and 0.05.
BYTES_PER_DB = (0.03, 0.07)

#: Usual bytes per kept splat of a file of a size, without and with SH.
USUAL_BYTES = (8.0, 11.0)

#: Least fraction of a file's error that is attributed to quantisation, since a smaller rest is noise.
LEAST_QUANTISED = 0.1

#: Least mean squared error, to divide by.
NOTHING = 1e-12

#: Change of the natural logarithm of an error per dB.
LOG_ERROR_PER_DB = math.log(10.0) / 10.0

#: dB above a PSNR that is aimed at, since PSNR varies by chance; `simplify` does not improve a result this close.
#: Larger margins hardly help test views, whose PSNR differs in the same direction at any precision. Of 12 files of six
#: scenes, whose PSNR equals the target in virtual validation views, 5 miss it in test views; 4 with 0.1 or 0.3 dB more,
#: and 2 with 0.5 dB, which cost 5 % of the bytes.
AIM = 0.1

#: Distance of two precisions in dB. Nearer precisions do not determine a slope; files of half this distance differ by
#: 1 %, as much as by chance.
APART = 0.3

_SLOPES = (0.2, 2.0)  # range of a measured slope, as a multiple of the assumed slope

#: Largest fraction of a file's error that pruning and left-out SH bands may take, without and with SH; with more,
#: quantisation would have to be too fine. With SH, codebooks need more of the error: at 38 dB, mic (SH of degree 3)
#: takes 72 kB with 0.5 and 96 with 0.65; jacket (no SH) takes 99 with 0.5 and 94 with 0.65.
MOST_LEFT_OUT = (0.65, 0.5)


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
    def through(cls, points: Sequence[RatePoint], error_slope: float, bytes_slope: float) -> RateLine:
        """Return the line through files, the first of which is nearest to the goal.

        Args:
            points: the files. The first other file that is far enough from the nearest determines the slopes.
            error_slope, bytes_slope: the slopes to assume without such a file, and to limit measured slopes by.
        """
        first = points[0]
        for point in points[1:]:
            apart = point.quality - first.quality
            if abs(apart) >= APART:
                by_error = math.log(point.error / first.error) / apart / error_slope
                by_size = math.log(point.size_bytes / first.size_bytes) / apart / bytes_slope
                error_slope *= min(max(by_error, _SLOPES[0]), _SLOPES[1])
                bytes_slope *= min(max(by_size, _SLOPES[0]), _SLOPES[1])
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


def log_bytes_at_error(kept_count: F64, pruned: F64, allowed: float, exponent: float, most: float) -> F64:
    """Return the log bytes of files of equal error, up to a constant; infinite if pruning takes too much of it.

    Args:
        kept_count: numbers of kept splats.
        pruned: mean squared error of pruning the others.
        allowed: mean squared error of the files.
        exponent: k of bytes ∝ Q^-k.
        most: largest fraction of the error that pruning may take.
    """
    fits = pruned <= most * allowed
    quantised = np.where(fits, allowed - pruned, 1.0)  # 1: any positive number, to take its logarithm
    return np.where(fits, np.log(kept_count) - exponent * np.log(quantised), np.inf)


def log_bytes_at_size(relative_count: F64, pruned: F64, quantised: float, exponent: float) -> F64:
    """Return the log bytes that the error of files of equal size is worth, up to a constant.

    Args:
        relative_count: numbers of kept splats, relative to the number at which quantisation costs `quantised`.
        pruned: mean squared error of pruning the others.
        quantised: mean squared error of quantisation.
        exponent: k of bytes ∝ Q^-k.
    """
    return np.asarray(exponent * np.log(pruned + quantised * relative_count ** (1.0 / exponent)))
