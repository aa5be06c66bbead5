"""Morton codes into the integers of three axes (spec 6.4.2)."""

from __future__ import annotations

import numpy as np

from csplat.decoder.blocks import runs
from csplat.decoder.streams import Ints

# Every third bit closes up in six steps, each of which halves the number of gaps: what is kept
# after shifting by 2, 4, 8, 16 and 32. Good for 21 bits per axis; the format has 17.
_FIRST = 0x1249249249249249
_STEPS = (
    (2, 0x10C30C30C30C30C3),
    (4, 0x100F00F00F00F00F),
    (8, 0x001F0000FF0000FF),
    (16, 0x001F00000000FFFF),
    (32, 0x00000000001FFFFF),
)


def morton_axes(codes: Ints) -> Ints:
    """Return [3, n] uint32: "Bit 3·b + a of a code is bit b of the integer q of axis a".

    Args:
        codes: [n], unsigned.
    """
    out = np.empty((3, len(codes)), np.uint32)
    for start, stop in runs(len(codes), 3):
        wide = codes[start:stop].astype(np.uint64)
        shifted = np.empty_like(wide)
        for axis in range(3):
            bits = (wide >> np.uint64(axis)) & np.uint64(_FIRST)
            for shift, mask in _STEPS:
                np.right_shift(bits, np.uint64(shift), out=shifted)
                bits |= shifted
                bits &= np.uint64(mask)
            out[axis, start:stop] = bits
    return out
