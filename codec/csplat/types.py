# SPDX-License-Identifier: Apache-2.0
"""Define types and a constant that all layers share: arrays by dtype, the progress callback, and the largest PSNR."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

I8 = NDArray[np.int8]
I16 = NDArray[np.int16]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]
U64 = NDArray[np.uint64]
F16 = NDArray[np.float16]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
"""One bool per row."""

Progress = Callable[[str, float], None]
"""Progress callback: (name of the stage, fraction done from 0 to 1). A name may have a detail: `search: pruning`."""

PSNR_CAP = 99.0
"""Largest PSNR, dB, also the PSNR of equal images."""


def null_progress(stage: str, done: float) -> None:
    """Ignore progress."""
