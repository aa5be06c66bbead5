"""The trained parameters of splats, and Adam's moments.

Opacities are logits. Each step normalises quaternions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel, normalise_quats
from csplat.scene_metadata import SceneMetadata
from csplat.types import F32
from csplat_render.kernels import parallel_kernel, relaxed_kernel

ParameterArrays = dict[str, F32]

#: Names of the arrays of `ParameterArrays`, in the order in which they are processed.
GROUPS = ("means", "quats", "scales", "logits", "sh0", "shN")

_BETA1, _EPSILON = 0.9, 1e-15
_TINY = 1e-30  # moments up to this become 0
_SHORTEST = 1e-12  # least length of a quaternion that is normalised; shorter ones become the identity
_ALPHA_MARGIN = 1e-6  # least distance of an opacity from 0 and 1, whose logits are infinite
_LOGIT_LIMIT = 14.0  # beyond, alpha has few digits in float32
_BLOCK = 1 << 13  # values processed by a thread at a time


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
    alpha: F32 = (1.0 / (1.0 + np.exp(-logits.astype(np.float64)))).astype(np.float32)
    return alpha


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
    parameters.step += 1
    correction1 = 1.0 - _BETA1**parameters.step
    correction2 = math.sqrt(1.0 - parameters.beta2**parameters.step)
    for name, value in parameters.values.items():
        if value.size:
            _adam(
                value.reshape(-1),
                gradients[name].reshape(-1),
                parameters.first[name].reshape(-1),
                parameters.second[name].reshape(-1),
                np.float32(rates[name] / correction1),
                np.float32(1.0 / correction2),
                np.float32(parameters.beta2),
                np.float32(1.0 - parameters.beta2),
            )
    _constrain(parameters.values["quats"], parameters.values["logits"])


@parallel_kernel(relaxed=True)
def _adam(
    lane: int,
    lanes: int,
    value: F32,
    gradient: F32,
    first: F32,
    second: F32,
    rate: np.float32,
    over_root: np.float32,
    b2: np.float32,
    a2: np.float32,
) -> None:
    """Make a step of Adam; vectorises over the values.

    Args:
        value, first, second: [n], values and moments; changed in place.
        gradient: [n].
        rate: learning rate over 1 - β1^step.
        over_root: 1 / √(1 - β2^step).
        b2: β2.
        a2: 1 - β2; a compiler that knew this might use a difference of squares, which is NaN for infinite ones.
    """
    b1, a1 = np.float32(_BETA1), np.float32(1.0 - _BETA1)
    epsilon, tiny = np.float32(_EPSILON), np.float32(_TINY)
    blocks = (value.shape[0] + _BLOCK - 1) // _BLOCK
    for block in range(lane, blocks, lanes):
        begin = block * _BLOCK
        count = min(_BLOCK, value.shape[0] - begin)
        p, g = value[begin : begin + count], gradient[begin : begin + count]
        m, v = first[begin : begin + count], second[begin : begin + count]
        for i in range(count):
            slope = g[i]
            mean = b1 * m[i] + a1 * slope
            square = b2 * v[i] + a2 * slope * slope
            # Moments of a splat that no image shows decay towards denormal numbers, which are slow.
            mean = mean if abs(mean) > tiny else np.float32(0.0)
            square = square if square > tiny else np.float32(0.0)
            m[i] = mean
            v[i] = square
            p[i] -= rate * mean / (np.sqrt(square) * over_root + epsilon)


@relaxed_kernel
def _constrain(quats: F32, logits: F32) -> None:
    """Normalise quats [N, 4], and clip logits [N] to ± `_LOGIT_LIMIT`, in place."""
    limit = np.float32(_LOGIT_LIMIT)
    for i in range(len(logits)):
        logits[i] = min(max(logits[i], -limit), limit)
    for i in range(quats.shape[0]):
        w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        length = np.sqrt(w * w + x * x + y * y + z * z)
        if length > np.float32(_SHORTEST):
            over = np.float32(1.0) / length
            quats[i, 0] = w * over
            quats[i, 1] = x * over
            quats[i, 2] = y * over
            quats[i, 3] = z * over
        else:
            quats[i, 0] = np.float32(1.0)
            quats[i, 1] = quats[i, 2] = quats[i, 3] = np.float32(0.0)
