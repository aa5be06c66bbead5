"""Find the size that a tuned file needs to reach a PSNR: sizes are tried, each with a tuning of its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol, TypeVar

from csplat.errors import InputError

_PER_DOUBLING = 1.25  # dB that twice the bytes bring, about, if there is only one file
_SLOPES = (0.3, 12.0)  # range of this slope if it is taken from two files, dB per doubling
_NEAR = 0.1  # dB above the target that are near enough
_TRIES, _FARTHEST = 5, 2.0  # files after the first; largest change of size from the nearest file, in doublings


class Tried(Protocol):
    """A file that was made."""

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        ...

    @property
    def psnr(self) -> float:
        """PSNR on the validation views, pooled, dB."""
        ...


T = TypeVar("T", bound=Tried)


def smallest_reaching(psnr: float, make: Callable[[int | None], T]) -> T:
    """Make files until one is near enough above a PSNR, and return the smallest that reaches it.

    Between two files, PSNR is taken to be linear in the logarithm of the size.

    Args:
        psnr: target PSNR, dB.
        make: makes a file of at most a number of bytes; called first with `None`, for any size.

    Raises:
        InputError: none of the files reaches the PSNR.
    """
    tried, least = [make(None)], 1.0
    for _ in range(_TRIES):
        if psnr <= tried[-1].psnr <= psnr + _NEAR:
            break
        size = _next(psnr + 0.5 * _NEAR, tried)
        if size <= least:  # no file can be that small: halfway to the smallest file
            size = math.sqrt(least * min(one.size_bytes for one in tried))
        try:
            tried.append(make(max(1, round(size))))
        except InputError:
            least = size
            continue
        if tried[-1].size_bytes < 0.9 * size:  # a larger file is not possible
            break
    enough = [one for one in tried if one.psnr >= psnr]
    if not enough:
        best = max(tried, key=lambda one: one.psnr)
        raise InputError(f"{psnr:g} dB are not reached: {best.size_bytes:,} bytes have {best.psnr:.2f} dB")
    return min(enough, key=lambda one: one.size_bytes)


def _next(psnr: float, tried: list[T]) -> float:
    """Return the size at which a PSNR is expected, from the two files nearest to it, on either side if possible."""
    near = sorted(tried, key=lambda one: abs(one.psnr - psnr))
    near[1:] = sorted(near[1:], key=lambda one: (one.psnr < psnr) == (near[0].psnr < psnr))
    octave = math.log2(near[0].size_bytes)
    slope = _PER_DOUBLING
    if len(near) > 1 and near[1].size_bytes != near[0].size_bytes:
        slope = (near[1].psnr - near[0].psnr) / (math.log2(near[1].size_bytes) - octave)
    by = (psnr - near[0].psnr) / min(max(slope, _SLOPES[0]), _SLOPES[1])
    return float(2.0 ** (octave + min(max(by, -_FARTHEST), _FARTHEST)))
