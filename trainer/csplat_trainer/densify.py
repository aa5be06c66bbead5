"""Gradient-based densification, as the first publication has it: clone, split, prune, reset.

Kerbl et al. 2023, section 5, https://arxiv.org/abs/2308.04079. A splat whose place on screen the
pictures pull at strongly is copied where it is small and split in two where it is large; the
transparent are removed, and opacities are reset from time to time so that floaters die.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from csplat.types import F32, F64
from csplat_trainer.parameters import GROUPS, Parameters

_LARGE = 0.01  # of the extent: larger splats are split, smaller ones cloned
_SHRINK = 1.6  # of the two halves of a split
_RESET_ALPHA = 0.01
_LARGEST_LOG = 60.0  # of a scale whose halves stay within float32


@dataclass
class ScreenGradients:
    """Mean norm of the gradient by each splat's place on screen, over the pictures that drew it.

    Attributes:
        total: [N] float64.
        count: [N] int64.
    """

    total: F64
    count: NDArray[np.int64]

    @classmethod
    def none(cls, splats: int) -> ScreenGradients:
        """No picture yet."""
        return cls(np.zeros(splats), np.zeros(splats, np.int64))

    def add(self, norms: F32, drawn: NDArray[np.bool_]) -> None:
        """Add one picture's norms, where it drew the splat."""
        self.total[drawn] += norms[drawn]
        self.count[drawn] += 1

    @property
    def mean(self) -> F64:
        """The mean, 0 for splats that no picture drew."""
        return self.total / np.maximum(self.count, 1)


def densify(
    parameters: Parameters,
    screen: ScreenGradients,
    extent: float,
    threshold: float,
    cap: int,
    dead_opacity: float,
    rng: Generator,
) -> int:
    """Clone and split where the gradient is above a threshold, strongest first up to the cap; prune.

    Args:
        parameters: changed in place.
        screen: gathered since the last time.
        extent: of the scene.
        threshold: of the mean norm.
        cap: no more splats than this.
        dead_opacity: splats at this opacity and below are removed.
        rng: places the halves of a split.

    Returns:
        By how much the number of splats changed.
    """
    before = len(parameters)
    alive = parameters.alphas > dead_opacity
    if not alive.any():
        return 0
    strength = np.where(alive, screen.mean, 0.0)
    room = max(0, cap - int(alive.sum()))
    strongest = np.argsort(-strength, kind="stable")[:room]
    chosen = np.sort(strongest[strength[strongest] > threshold])
    values = parameters.values
    large = values["scales"][chosen].max(axis=1) > np.log(_LARGE * extent)
    split = chosen[large]
    new = {name: values[name][chosen].copy() for name in GROUPS}
    if len(split):
        first, second = _halves(values["quats"][split], values["scales"][split], rng)
        new["means"][large] += second
        new["scales"][large] -= np.float32(np.log(_SHRINK))
        values["means"][split] += first
        values["scales"][split] -= np.float32(np.log(_SHRINK))
        parameters.forget(split)
    parameters.keep(np.flatnonzero(alive))
    parameters.append(new)
    return len(parameters) - before


def reset_opacities(parameters: Parameters) -> None:
    """Make every splat nearly transparent, so that only those come back that pictures want."""
    logit = np.float32(np.log(_RESET_ALPHA / (1.0 - _RESET_ALPHA)))
    np.minimum(parameters.values["logits"], logit, out=parameters.values["logits"])
    for memory in (parameters.first, parameters.second):
        memory["logits"][:] = 0.0


def _halves(quats: F32, scales: F32, rng: Generator) -> tuple[F32, F32]:
    """Two offsets for each splat, drawn from its own shape."""
    w, x, y, z = quats.astype(np.float64).T
    rotation = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        1,
    )
    deviations = np.exp(np.minimum(scales.astype(np.float64), _LARGEST_LOG))
    drawn = rng.standard_normal((2, len(quats), 3)) * deviations
    first, second = (np.einsum("nij,nj->ni", rotation, one).astype(np.float32) for one in drawn)
    return first, second
