"""Tolerances: how far two correct results may differ (spec SER-5, SER-7 for errors; 9.2, CNF-7 for floats)."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

#: The classes of decoders (spec 9.2): floats equal bit for bit, or within the tolerance of CNF-7.
CLASSES: Final = (EXACT := "exact", RENDERER := "renderer")

_EXCESS, _EXCESS_FLOOR = 1e-4, 1e-12  # relative and absolute; by how much a bound may exceed the true error (SER-5)
_ROUNDING = 1e-9  # relative; sums in binary64 in another order (SER-7)
_COORDINATE_ROUNDING = 2.0**-50  # relative to the largest coordinate, added and subtracted in binary64 (SER-7)
#: Absolute, by measure. SER-7 leaves open whether alpha and unit quaternions are rounded to binary32 first.
_ROUNDING_OF_MEASURE = {"opacities": 2e-7, "covariance": 2e-6}

_ULPS: Final = 2  # CNF-7
_FLOOR: Final = 2.0**-125  # absolute distance that any array may have (CNF-7)
_FLOOR_OF_ARRAY: Final = {"quats": 2.0**-20, "opacities": 2.0**-20}


# Declared error bounds -----------------------------------------------------------------------------


def bound_tolerance(measure: str, error: float, reach: float) -> float:
    """Return how far two correct computations of an error may differ (SER-7).

    Args:
        measure: name in the registry of measures.
        error: the error, in the measure's unit.
        reach: largest magnitude of a coordinate of the source or of the file's origin, scene units.
    """
    rounding = reach * _COORDINATE_ROUNDING if measure == "means" else _ROUNDING_OF_MEASURE.get(measure, 0.0)
    return rounding + _ROUNDING * error


def is_valid_bound(measure: str, declared: float, measured: float, reach: float) -> bool:
    """Return True if a file may declare this bound: not below the measured error, and hardly above it (SER-5).

    Args:
        measure: name in the registry of measures.
        declared: maximum or rms in the file.
        measured: maximum or rms as measured.
        reach: see `bound_tolerance`.
    """
    tolerance = bound_tolerance(measure, measured, reach)
    return measured - tolerance <= declared <= measured * (1.0 + _EXCESS) + _EXCESS_FLOOR + tolerance


def least_true_error(measure: str, declared: float) -> float:
    """Return the smallest true error for which this bound may be declared; for means near coordinate 0.

    Args:
        measure: name in the registry of measures.
        declared: maximum or rms in the file.
    """
    return max(0.0, (declared - _EXCESS_FLOOR - bound_tolerance(measure, 0.0, 0.0)) / (1.0 + _EXCESS + _ROUNDING))


# Floats of the class renderer ----------------------------------------------------------------------


def ulps_between(values: NDArray[np.float32], exact: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the distances in ulp; +0 and -0 are one number."""
    distances: NDArray[np.int64] = np.abs(_ordinals(values) - _ordinals(exact))
    return distances


def _ordinals(values: NDArray[np.float32]) -> NDArray[np.int64]:
    magnitudes = np.abs(values).view(np.uint32).astype(np.int64)
    return np.where(np.signbit(values), -magnitudes, magnitudes)


def describe_deviation(name: str, found: bytes, wanted: NDArray[Any]) -> str:
    """Return a line about values beyond the tolerance of CNF-7, or an empty string.

    Args:
        name: name of the array, as `means`.
        found: raw values, with the size of `wanted`.
        wanted: exact values, float32.
    """
    values, exact = np.frombuffer(found, "<f4").astype(np.float32), wanted.ravel()
    ulps = ulps_between(values, exact)
    with np.errstate(invalid="ignore"):  # signalling NaN
        distances = np.abs(values.astype(np.float64) - exact)
    near = np.isfinite(values) & ((ulps <= _ULPS) | (distances <= _FLOOR_OF_ARRAY.get(name, _FLOOR)))
    if near.all():
        return ""
    at = int(np.argmax(np.where(near, -1, ulps)))
    return f"{np.count_nonzero(~near)} of {exact.size} values too far, as {values[at]} for {exact[at]}, {ulps[at]} ulp"
