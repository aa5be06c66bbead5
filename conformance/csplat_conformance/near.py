"""The distance that floats of the class renderer may have from the exact ones (spec 9.2, CNF-7)."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

#: The classes of decoders.
CLASSES: Final = (EXACT := "exact", RENDERER := "renderer")

_ULPS: Final = 2
_FLOORS: Final = {"quats": 2.0**-20, "opacities": 2.0**-20}
_FLOOR: Final = 2.0**-125


def ulps_between(values: NDArray[np.float32], exact: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return how many numbers of binary32 lie between two, the second counted and zeros of either sign one number."""
    apart: NDArray[np.int64] = np.abs(_places(values) - _places(exact))
    return apart


def _places(values: NDArray[np.float32]) -> NDArray[np.int64]:
    magnitudes = np.abs(values).view(np.uint32).astype(np.int64)
    return np.where(np.signbit(values), -magnitudes, magnitudes)


def too_far(name: str, found: bytes, wanted: NDArray[Any]) -> str:
    """Return which values lie too far off in words, or nothing.

    Args:
        name: name of the array, as `means`.
        found: raw values, as many bytes as `wanted` has.
        wanted: float32, exact.
    """
    values, exact = np.frombuffer(found, "<f4").astype(np.float32), wanted.ravel()
    apart = ulps_between(values, exact)
    with np.errstate(invalid="ignore"):  # a NaN that signals
        distances = np.abs(values.astype(np.float64) - exact)
    near = np.isfinite(values) & ((apart <= _ULPS) | (distances <= _FLOORS.get(name, _FLOOR)))
    if near.all():
        return ""
    at = int(np.argmax(np.where(near, -1, apart)))
    return f"{np.count_nonzero(~near)} of {exact.size} values too far, as {values[at]} for {exact[at]}, {apart[at]} ulp"
