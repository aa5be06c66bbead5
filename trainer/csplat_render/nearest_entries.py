# SPDX-License-Identifier: Apache-2.0
"""Search the nearest entries of a codebook, for the encoder: an entry point of `csplat.kernels`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from csplat.errors import InputError
from csplat.types import F64, I16, I32, I64
from csplat_render import kernels


def compiled_search() -> Callable[..., F64] | None:
    """Return `nearest_entries`; `None` if the compiled library is missing, or does not support this processor."""
    try:
        kernels.require_library()
    except InputError:
        return None
    return nearest_entries


def nearest_entries(
    points: I16,
    entries: I16,
    ends: I64,
    centres: I16 | None,
    near: int,
    found: I32,
    own: I32 | None,
    *,
    threads: int,
) -> F64:
    """Find the nearest entry of each point, the first of several at equal distance.

    Arguments, all C-contiguous, and result are those of `csplat.encoder.entry_search.NearestEntries`.
    """
    squared = np.empty(len(points))
    arrays = points, len(points), points.shape[1], entries, ends, centres, len(ends) - 1, near, own, found, squared
    with kernels.thread_count(threads):
        kernels.call("nearest_entries", *arrays)
    return squared
