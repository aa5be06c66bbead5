"""The tolerance between a stated error and the measured one (spec SER-5, SER-7)."""

from __future__ import annotations

_EXCESS, _EXCESS_FLOOR = 1e-4, 1e-12  # SER-5: by how much a statement may exceed what is true
_ROUNDING = 1e-9  # SER-7: relative, sums in binary64 in another order
_COORDINATE = 2.0**-50  # SER-7: of the largest coordinate, which is added and subtracted in binary64
#: SER-7: whether alpha and unit quaternions are rounded to binary32 before they are compared is left open.
_OPEN = {"opacities": 2e-7, "covariance": 2e-6}


def room(measure: str, error: float, reach: float) -> float:
    """Return how far two right computations of an error may lie apart (SER-7).

    Args:
        measure: name in the registry of stated errors.
        error: the error, in the measure's unit.
        reach: largest magnitude of a coordinate of the source or of the file's origin, scene units.
    """
    open_ = reach * _COORDINATE if measure == "means" else _OPEN.get(measure, 0.0)
    return open_ + _ROUNDING * error


def may_be_stated(measure: str, stated: float, found: float, reach: float) -> bool:
    """Return True if a file may state this error: no less than was measured, and hardly more (SER-5).

    Args:
        measure: name in the registry of stated errors.
        stated: maximum or rms in the file.
        found: the same, as measured by a checker.
        reach: as for `room`.
    """
    open_ = room(measure, found, reach)
    return found - open_ <= stated <= found * (1.0 + _EXCESS) + _EXCESS_FLOOR + open_


def least_true(measure: str, stated: float) -> float:
    """Return what an error is at least, of which this may be stated; of centres that are not far from 0.

    Args:
        measure: name in the registry of stated errors.
        stated: maximum or rms, as the file has it.
    """
    return max(0.0, (stated - _EXCESS_FLOOR - room(measure, 0.0, 0.0)) / (1.0 + _EXCESS + _ROUNDING))
