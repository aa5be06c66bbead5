# SPDX-License-Identifier: CC0-1.0
"""Tolerances of comparisons: SER-5 and SER-7 for declared errors, CNF-7 for floats."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

#: The classes of decoders (spec 9.2): floats equal bit for bit, or within the tolerance of CNF-7.
CLASSES: Final = (EXACT := "exact", RENDERER := "renderer")

_EXCESS, _EXCESS_FLOOR = 1e-4, 1e-12  # relative and absolute excess of a bound over the true error (SER-5)
_ROUNDING = 1e-9  # relative; the order of sums in binary64 is free (SER-7)
_COORDINATE_ROUNDING = 2.0**-50  # relative to the largest coordinate; rounding of sums in binary64 (SER-7)
#: Absolute, by measure; rounding alpha and unit quaternions to binary32 is optional (SER-7).
_ROUNDING_OF_MEASURE = {"opacities": 2e-7, "covariance": 2e-6}

_ULPS: Final = 2  # CNF-7
_FLOOR: Final = 2.0**-125  # absolute tolerance of all other arrays (CNF-7)
_FLOOR_OF_ARRAY: Final = {"quats": 2.0**-20, "opacities": 2.0**-20}


# Declared error bounds -----------------------------------------------------------------------------


def bound_tolerance(measure: str, error: float, reach: float) -> float:
    """Return the largest difference between two correct computations of an error (SER-7).

    Args:
        measure: name in the registry of measures.
        error: the error, in the measure's unit.
        reach: largest magnitude of a coordinate of the source or of the file's origin, scene units.
    """
    rounding = reach * _COORDINATE_ROUNDING if measure == "means" else _ROUNDING_OF_MEASURE.get(measure, 0.0)
    return rounding + _ROUNDING * error


def is_valid_bound(measure: str, declared: float, measured: float, reach: float) -> bool:
    """Return True if a declared bound is not below the measured error, and not too far above it (SER-5).

    Args:
        measure: name in the registry of measures.
        declared: maximum or rms in the file.
        measured: maximum or rms as measured.
        reach: see `bound_tolerance`.
    """
    tolerance = bound_tolerance(measure, measured, reach)
    return measured - tolerance <= declared <= measured * (1.0 + _EXCESS) + _EXCESS_FLOOR + tolerance


def least_true_error(measure: str, declared: float) -> float:
    """Return the smallest true error for which a bound is valid; means are assumed near coordinate 0.

    Args:
        measure: name in the registry of measures.
        declared: maximum or rms in the file.
    """
    return max(0.0, (declared - _EXCESS_FLOOR - bound_tolerance(measure, 0.0, 0.0)) / (1.0 + _EXCESS + _ROUNDING))


# Floats of the class renderer ----------------------------------------------------------------------


def ulps_between(values: NDArray[np.float32], exact: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the distances in ulp; +0 and -0 count as equal."""
    distances: NDArray[np.int64] = np.abs(_ordinals(values) - _ordinals(exact))
    return distances


def _ordinals(values: NDArray[np.float32]) -> NDArray[np.int64]:
    """Number the binary32 values in ascending order, so that neighbours differ by 1; +0 and -0 are 0."""
    magnitudes = np.abs(values).view(np.uint32).astype(np.int64)
    return np.where(np.signbit(values), -magnitudes, magnitudes)


def describe_deviation(name: str, data: bytes, expected: NDArray[Any]) -> str:
    """Return a line about values beyond the tolerance of CNF-7, or an empty string.

    Args:
        name: name of the array, such as `means`.
        data: raw values, with the size of `expected`.
        expected: exact values, float32.
    """
    values, exact = np.frombuffer(data, "<f4").astype(np.float32), expected.ravel()
    ulps = ulps_between(values, exact)
    with np.errstate(invalid="ignore"):  # signalling NaN
        distances = np.abs(values.astype(np.float64) - exact)
    near = np.isfinite(values) & ((ulps <= _ULPS) | (distances <= _FLOOR_OF_ARRAY.get(name, _FLOOR)))
    if near.all():
        return ""
    at = int(np.argmax(np.where(near, -1, ulps)))
    count = np.count_nonzero(~near)
    return f"{count} of {exact.size} values are too far, such as {values[at]}, expected {exact[at]}, {ulps[at]} ulp"
