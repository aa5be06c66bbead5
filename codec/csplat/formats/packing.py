"""Packing that several formats share: rotations as three numbers, and bounds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.model import normalise_quats
from csplat.types import F32

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def crossed(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return where a lower bound is above the upper one; a step of float32 is rounding."""
    above: NDArray[np.bool_] = low > np.nextafter(high.astype(np.float32), np.float32(np.inf))
    return above


def smallest_three(quats: F32) -> tuple[NDArray[np.int64], F32]:
    """Leave out the largest component of each rotation, made positive: the others determine it.

    Args:
        quats: [N, 4], unit.

    Returns:
        Which one is left out [N], 0 to 3, of equal ones the first; and the others [N, 3] in their order, within
        ± 1 / sqrt(2).
    """
    largest = np.argmax(np.abs(quats), 1)
    rows = np.arange(len(quats))
    sign = np.where(quats[rows, largest] < 0, np.float32(-1), np.float32(1))
    return largest, quats[rows[:, None], _OTHERS[largest]] * sign[:, None]


def all_three(largest: NDArray[Any], three: F32) -> F32:
    """The rotations of `smallest_three`; numbers that leave no room for a largest one are scaled.

    Args:
        largest: [N], 0 to 3.
        three: [N, 3] float32, within ± 1.

    Returns:
        [N, 4] float32, unit.
    """
    quats = np.empty((len(three), 4), np.float32)
    left = 1.0 - np.einsum("nd,nd->n", three, three)
    np.sqrt(np.maximum(left, 0.0, out=left), out=left)
    for index, others in enumerate(_OTHERS):
        here = np.flatnonzero(largest == index)
        quats[here[:, None], others] = three[here]
        quats[here, index] = left[here]
    return normalise_quats(quats)
