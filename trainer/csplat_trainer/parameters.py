# SPDX-License-Identifier: Apache-2.0
"""The trained parameters of splats, and Adam's moments.

Opacities are logits. Each step normalises quaternions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel, normalise_quats
from csplat.scene_metadata import SceneMetadata
from csplat.types import F32
from csplat_render import kernels
from csplat_render.rasteriser import FITTED, AdamStep

ParameterArrays = dict[str, F32]

#: Names of the arrays of `ParameterArrays`, in the order in which they are processed.
GROUPS = FITTED

_BETA1 = 0.9  # decay of the mean of gradients in a step, as in native/adam.h
_ALPHA_MARGIN = 1e-6  # least distance of an opacity from 0 and 1, whose logits are infinite


@dataclass
class Parameters:
    """The state of an optimisation. Arrays are replaced when the number of splats changes.

    Attributes:
        values: means [N, 3], quats [N, 4], scales [N, 3] (log), logits [N], sh0 [N, 3], shN [N, K, 3]; fine-tuning
            has another group, and the rows of its file.
        first: Adam's running mean of the gradients, the same shapes.
        second: Adam's running mean of their squares.
        step: number of Adam's steps.
        beta2: decay of the mean of squares in a step.
    """

    values: ParameterArrays
    first: ParameterArrays
    second: ParameterArrays
    step: int = 0
    beta2: float = 0.999

    @classmethod
    def starting_at(cls, values: ParameterArrays) -> Parameters:
        """Return parameters before the first step."""
        first, second = ({name: np.zeros_like(array) for name, array in values.items()} for _ in range(2))
        return cls(values, first, second)

    def __len__(self) -> int:
        return len(self.values["means"])

    @property
    def alphas(self) -> F32:
        """Opacities, [N]."""
        return sigmoid(self.values["logits"])

    def next_step(self, rates: dict[str, float], **settings: Any) -> AdamStep:
        """Count a step of Adam, and return it for a `Rasteriser`.

        Args:
            rates: learning rate of each group.
            settings: further fields of `AdamStep`.
        """
        self.step += 1
        correction = 1.0 - _BETA1**self.step
        over_root = 1.0 / math.sqrt(1.0 - self.beta2**self.step)
        corrected = {name: rates[name] / correction for name in self.values}
        return AdamStep(self.values, self.first, self.second, corrected, over_root, self.beta2, **settings)

    def on_cpu(self) -> Parameters:
        """Return the state in arrays of NumPy: itself."""
        return self

    def read(self, name: str, rows: NDArray[np.int64]) -> F32:
        """Return a group's values of some splats."""
        return self.values[name][rows]

    def write(self, name: str, rows: NDArray[np.int64], values: F32) -> None:
        """Replace a group's values of some splats."""
        self.values[name][rows] = values

    def copy_rows(self, sources: NDArray[np.int64], targets: NDArray[np.int64]) -> None:
        """Copy the values of some splats to others."""
        for name in GROUPS:
            self.values[name][targets] = self.values[name][sources]

    def forget(self, rows: NDArray[np.int64]) -> None:
        """Reset Adam's moments of some splats."""
        for name in GROUPS:
            self.first[name][rows] = 0.0
            self.second[name][rows] = 0.0

    def keep(self, rows: NDArray[np.int64]) -> None:
        """Keep some splats, in this order."""
        for part in (self.values, self.first, self.second):
            for name in GROUPS:
                part[name] = np.ascontiguousarray(part[name][rows])

    def append_copies(self, sources: NDArray[np.int64]) -> None:
        """Add copies of some splats, with zero moments."""
        for name in GROUPS:
            copies = self.values[name][sources]
            self.values[name] = np.concatenate([self.values[name], copies])
            for memory in (self.first, self.second):
                memory[name] = np.concatenate([memory[name], np.zeros_like(copies)])


def from_model(model: SplatModel, sh_degree: int) -> ParameterArrays:
    """Return the parameters of a model's splats, with SH truncated or extended by zeros to a degree."""
    coefficients = (sh_degree + 1) ** 2 - 1
    shN = np.zeros((len(model), coefficients, 3), np.float32)
    common = min(coefficients, model.shN.shape[1])
    shN[:, :common] = model.shN[:, :common]
    return {
        "means": model.means.copy(),
        "quats": normalise_quats(model.quats),
        "scales": model.scales.copy(),
        "logits": logits_of(model.opacities),
        "sh0": model.sh0.copy(),
        "shN": shN,
    }


def to_model(values: ParameterArrays, *, antialiased: bool = False) -> SplatModel:
    """Return the splats as a model."""
    return SplatModel(
        means=values["means"].copy(),
        quats=normalise_quats(values["quats"]),
        scales=values["scales"].copy(),
        opacities=sigmoid(values["logits"]),
        sh0=values["sh0"].copy(),
        shN=values["shN"].copy(),
        metadata=SceneMetadata(antialiased=antialiased),
    )


def sigmoid(logits: F32) -> F32:
    """Return the opacities of logits, computed in float64 and rounded once."""
    assert logits.dtype == np.float32
    alphas = np.empty_like(logits)
    kernels.call("sigmoid", logits.size, logits, alphas)
    return alphas


def logits_of(opacities: F32) -> F32:
    """Return the logits of opacities, which are limited to `_ALPHA_MARGIN` from 0 and 1."""
    alpha = np.clip(opacities.astype(np.float64), _ALPHA_MARGIN, 1.0 - _ALPHA_MARGIN)
    logits: F32 = np.log(alpha / (1.0 - alpha)).astype(np.float32)
    return logits


def adam_step(parameters: Parameters, gradients: ParameterArrays, rates: dict[str, float]) -> None:
    """Make a step of Adam without weight decay, then normalise quaternions and clip logits.

    Args:
        parameters: changed in place.
        gradients: gradients of the loss, shapes as `Parameters.values`.
        rates: learning rate of each group.
    """
    step = parameters.next_step(rates)
    for name, value in step.values.items():
        gradient = gradients[name]
        assert gradient.shape == value.shape
        assert gradient.dtype == value.dtype == np.float32
        arrays = value, gradient, step.first[name], step.second[name]
        kernels.call("adam", value.size, step.rates[name], step.over_root, step.beta2, *arrays)
    quats, logits = parameters.values["quats"], parameters.values["logits"]
    kernels.call("constrain_splats", len(quats), quats, len(logits), logits)
