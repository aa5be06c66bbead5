# SPDX-License-Identifier: Apache-2.0
"""Per-image gain and bias, for images of one scene with different exposure.

Renders are corrected before the comparison with an image, as in the code of "A Hierarchical 3D Gaussian Representation"
(Kerbl et al. 2024, https://arxiv.org/abs/2406.12080). Corrections are trained together with the splats, and are not
part of the scene. Their mean is 0, so that the scene is as bright as the images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from csplat.errors import InputError
from csplat.types import F32, F64

_STATE = (4, 2, 3)  # state of an image: values, both of Adam's means, steps; [gain, bias]; channels
_BETA1, _BETA2, _EPSILON = 0.9, 0.99, 1e-15
_LIMIT = 1.0  # largest logarithm of a gain, and largest bias


class ImageGains:
    """Per-image gain and bias of the training images, with Adam's moments.

    Args:
        count: number of images.
        stored: the result of `as_json` to continue from.

    Attributes:
        values: [P, 2, 3], logarithms of the gains, and biases, by image; their mean is 0.

    Raises:
        InputError: the stored state is for another number of images.
    """

    def __init__(self, count: int, stored: Sequence[Sequence[float]] = ()) -> None:
        state = np.zeros((count, *_STATE))
        if len(stored):
            restored = np.array(stored, np.float64)
            if restored.size != state.size or not np.isfinite(restored).all():
                raise InputError(f"the checkpoint has exposures of {len(restored)} images, expected {count}")
            state = restored.reshape(state.shape)
        self.values, self._first, self._second, self._steps = (state[:, part] for part in range(_STATE[0]))

    def as_json(self) -> list[list[float]]:
        """Return the state, a list per image."""
        state = np.stack([self.values, self._first, self._second, self._steps], axis=1)
        return [row.ravel().tolist() for row in state]

    def step(self, number: int, slope: F64, rate: float) -> None:
        """Make a step of Adam on the correction of an image, against the gradient of the loss, [2, 3]."""
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
    """The correction of an image.

    Attributes:
        gains: the corrections of all images.
        number: index of the image.
        rate: learning rate.
    """

    gains: ImageGains
    number: int
    rate: float

    @property
    def values(self) -> F64:
        """The logarithm of the gain, and the bias, by channel, [2, 3]."""
        own: F64 = self.gains.values[self.number]
        return own

    def update(self, slope: F64) -> None:
        """Make a step against the gradient of the loss, [2, 3]."""
        self.gains.step(self.number, slope, self.rate)

    def apply(self, render: F32) -> F32:
        """Apply the correction to a render, [H, W, 3]."""
        gain, bias = self.values
        corrected: F32 = render * np.exp(gain).astype(np.float32) + bias.astype(np.float32)
        return corrected

    def backward(self, render: F32, slope: F32) -> F32:
        """Update the correction, and propagate the gradient of the loss to the render.

        Args:
            render: [H, W, 3], as given to `apply`.
            slope: [H, W, 3], gradient by the result of `apply`; overwritten.

        Returns:
            The gradient by the render, in the memory of `slope`.
        """
        gain = np.exp(self.values[0])
        by_bias = slope.sum(axis=(0, 1), dtype=np.float64)
        by_gain = gain * np.einsum("hwc,hwc->c", slope, render, dtype=np.float64)
        self.update(np.stack([by_gain, by_bias]))
        slope *= gain.astype(np.float32)
        return slope
