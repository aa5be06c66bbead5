"""numba, with types that a type checker understands, and the options that every kernel shares."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ParamSpec, TypeVar

import numba as typed_numba
import numpy as np
from numba import extending as typed_extending

from csplat.errors import InputError

__all__ = [
    "LOCK",
    "available_threads",
    "fast_exp2",
    "inline",
    "kernel",
    "parallel_kernel",
    "python",
    "relaxed_kernel",
    "thread_count",
]

# The types that numba states for itself differ from version to version.
numba: Any = typed_numba
extending: Any = typed_extending

P = ParamSpec("P")
R = TypeVar("R")

#: Held while kernels run: not every threading layer of numba may be entered by two threads at once.
LOCK = threading.RLock()

# Work at import, because OpenMP reads it once, when numba starts its threads. A thread that spins at
# the end of a loop keeps the one that it waits for from the processor: on a machine with something
# else to do a picture of 1,000 splats took 32 ms, and takes 0.5 ms when threads sleep.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# Without nnan and ninf: the kernels test for NaN and infinity, and may meet them.
_LN2 = math.log(2.0)
_RELAXED = {"reassoc", "nsz", "arcp", "contract", "afn"}


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of one thread, in strict IEEE arithmetic."""
    compiled: Callable[P, R] = numba.njit(function, cache=True, nogil=True, error_model="numpy")
    return compiled


def inline(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small function that kernels call; it takes on their arithmetic."""
    compiled: Callable[P, R] = numba.njit(function, inline="never", cache=True, nogil=True, error_model="numpy")
    return compiled


def relaxed_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of one thread that may reassociate and contract: the inside of a loop over pixels."""
    compiled: Callable[P, R] = numba.njit(function, cache=True, nogil=True, error_model="numpy", fastmath=_RELAXED)
    return compiled


def parallel_kernel(*, relaxed: bool = False) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Compile a function whose `prange` loops run on all threads.

    Args:
        relaxed: reassociate and contract, for the loops over pixels.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        options: dict[str, Any] = {"fastmath": _RELAXED} if relaxed else {}
        compiled: Callable[P, R] = numba.njit(
            function, parallel=True, cache=True, nogil=True, error_model="numpy", **options
        )
        return compiled

    return decorate


def fast_exp2(x: float) -> float:
    """2**x for x < 128 in kernels: in float32 a polynomial (2e-7) that vectorises, in float64 exact."""
    return math.exp(x * _LN2)


def _fast_exp2(x: Any) -> Callable[[Any], Any]:
    def exact(x: Any) -> Any:
        return math.exp(x * _LN2)

    if x != numba.types.float32:
        return exact

    lowest, half = np.float32(-120.0), np.float32(0.5)
    # 2**f for |f| <= 1/2, fitted for the smallest relative error.
    c0, c1, c2 = np.float32(1.0000001353333114), np.float32(0.6931468253392489), np.float32(0.24021906575261626)
    c3, c4, c5 = np.float32(0.05550791318132806), np.float32(0.009684186484357147), np.float32(0.0013275470569714626)

    def polynomial(x: Any) -> Any:
        t = x if x > lowest else lowest
        whole = np.int32(t - half)
        f = t - np.float32(whole)
        power = np.float32(c0 + f * (c1 + f * (c2 + f * (c3 + f * (c4 + f * c5)))))
        # The whole part of the exponent goes straight into the bits.
        return np.int32(power.view(np.int32) + (whole << np.int32(23))).view(np.float32)

    return polynomial


extending.overload(fast_exp2, jit_options={"fastmath": _RELAXED}, inline="always")(_fast_exp2)


def python(compiled: Callable[P, R]) -> Callable[P, R]:
    """The Python function that was compiled; it takes arrays where a kernel takes numbers."""
    function: Callable[P, R] = getattr(compiled, "py_func", compiled)
    return function


def available_threads() -> int:
    """How many threads numba was started with, at most the processors of this process."""
    return int(numba.config.NUMBA_NUM_THREADS)


@contextmanager
def thread_count(threads: int | None) -> Iterator[int]:
    """Run kernels on so many threads, one caller at a time.

    Args:
        threads: 1 or more, no more than there are; None for as many as numba is set to.

    Raises:
        InputError: `threads` is below 1.
    """
    if threads is not None and threads < 1:
        raise InputError(f"threads is {threads}, wanted 1 or more")
    with LOCK:
        before = int(numba.get_num_threads())
        count = before if threads is None else min(threads, available_threads())
        if count == before:
            yield count
            return
        numba.set_num_threads(count)
        try:
            yield count
        finally:
            numba.set_num_threads(before)
