"""Morton codes of three integers, at most 21 bits each."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_codes(q: NDArray[Any]) -> NDArray[np.int64]:
    """Interleave the bits of three axes: bit 3·b + a of a code is bit b of axis a (spec 6.4.2).

    Args:
        q: [3, n] integers, 0 to 2**21 - 1.

    Returns:
        [n] int64.
    """
    codes = np.zeros(q.shape[1], np.int64)
    spread = np.empty(q.shape[1], np.int64)
    shifted = np.empty_like(spread)
    for axis in range(3):
        np.copyto(spread, q[axis], casting="unsafe")
        for shift, mask in _SPREAD:
            np.left_shift(spread, shift, out=shifted)
            np.bitwise_or(spread, shifted, out=spread)
            np.bitwise_and(spread, mask, out=spread)
        np.left_shift(spread, axis, out=spread)
        np.bitwise_or(codes, spread, out=codes)
    return codes
