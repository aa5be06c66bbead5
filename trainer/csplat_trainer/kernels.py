"""Decorators for the kernels of training: those of the renderer, and one for small relaxed functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numba

from csplat_render.jit import kernel, parallel_kernel

__all__ = ["kernel", "parallel_kernel", "relaxed_kernel"]

P = ParamSpec("P")
R = TypeVar("R")


def relaxed_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of one thread that may reassociate and contract: the inside of a loop over pixels."""
    compiled: Callable[P, R] = numba.njit(
        function,
        cache=True,
        nogil=True,
        error_model="numpy",
        fastmath={"reassoc", "nsz", "arcp", "contract", "afn"},
    )
    return compiled
