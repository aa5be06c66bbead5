"""Per-image gain and bias, for images of one scene that were exposed differently.

Renders are corrected before they are compared with an image, as in the code of "A Hierarchical 3D Gaussian
Representation" (Kerbl et al. 2024, https://arxiv.org/abs/2406.12080). Corrections are trained together with the splats
and stored in no file: on average they leave the scene as bright as the images are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from csplat.errors import InputError
from csplat.types import F32, F64

_STATE = (4, 2, 3)  # state of a photograph: values, both of Adam's means, steps
_BETA1, _BETA2, _EPSILON = 0.9, 0.99, 1e-15
_LIMIT = 1.0  # limit on the logarithm of a gain, and on a shift: images that differ by more are not of one scene


class ImageGains:
    """Per-image gain and bias of the training photographs, and Adam's memory of them.

    Args:
        count: number of photographs.
        stored: what `as_json` returned, to go on from.

    Attributes:
        values: [P, 2, 3], logarithms of the gains, and shifts, by photograph; their mean is 0.

    Raises:
        InputError: the stored state is for another number of photographs.
    """

    def __init__(self, count: int, stored: Sequence[Sequence[float]] = ()) -> None:
        state = np.zeros((count, *_STATE))
        if len(stored):
            found = np.array(stored, np.float64)
            if found.size != state.size or not np.isfinite(found).all():
                raise InputError(f"exposures of {len(found)} photographs are stored, wanted those of {count}")
            state = found.reshape(state.shape)
        self.values, self._first, self._second, self._steps = (state[:, part] for part in range(_STATE[0]))

    def as_json(self) -> list[list[float]]:
        """Everything, by photograph."""
        state = np.stack([self.values, self._first, self._second, self._steps], axis=1)
        return [row.ravel().tolist() for row in state]

    def move(self, number: int, slope: F64, rate: float) -> None:
        """Move the correction of a photograph against the slope of the loss, [2, 3], by Adam."""
        first, second, steps = self._first[number], self._second[number], self._steps[number]
        steps += 1.0
        first[:] = _BETA1 * first + (1.0 - _BETA1) * slope
        second[:] = _BETA2 * second + (1.0 - _BETA2) * slope * slope
        mean, square = first / (1.0 - _BETA1**steps), second / (1.0 - _BETA2**steps)
        self.values[number] -= rate * mean / (np.sqrt(square) + _EPSILON)
        np.clip(self.values, -_LIMIT, _LIMIT, out=self.values)
        self.values -= self.values.mean(axis=0)


@dataclass(frozen=True, eq=False)
class ImageGain:
    """The correction of one photograph.

    Attributes:
        among: the corrections of all photographs.
        number: index of the photograph.
        rate: learning rate.
    """

    among: ImageGains
    number: int
    rate: float

    def applied(self, seen: F32) -> F32:
        """Apply the photograph's correction to a render, [H, W, 3]."""
        gain, shift = self.among.values[self.number]
        shown: F32 = seen * np.exp(gain).astype(np.float32) + shift.astype(np.float32)
        return shown

    def learnt(self, seen: F32, slope: F32) -> F32:
        """Learn from a step, and take its slope back to what is seen.

        Args:
            seen: [H, W, 3], as given to `applied`.
            slope: [H, W, 3], of the loss by what `applied` returned; changed.

        Returns:
            The slope by what is seen, in the memory of the other.
        """
        gain = np.exp(self.among.values[self.number, 0])
        by_shift = slope.sum(axis=(0, 1), dtype=np.float64)
        by_gain = gain * np.einsum("hwc,hwc->c", slope, seen, dtype=np.float64)
        self.among.move(self.number, np.stack([by_gain, by_shift]), self.rate)
        slope *= gain.astype(np.float32)
        return slope
