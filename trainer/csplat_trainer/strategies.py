# SPDX-License-Identifier: Apache-2.0
"""Changes of the number and positions of splats during training: MCMC, gradient-based densification, pruning.

* "3DGS as Markov chain Monte Carlo", Kheradmand et al. 2024, https://arxiv.org/abs/2404.09591. A dead splat moves onto
  a live splat. All n splats there get the opacity and the scales that change the render least. Noise then separates
  them.
* Densification of the first publication, Kerbl et al. 2023, section 5, https://arxiv.org/abs/2308.04079. A splat whose
  position on screen has a large gradient is cloned if it is small and split in two if it is large. Transparent splats
  are pruned, and opacities are reset from time to time so that floaters die.
* Pruning of the splats with the least pruning error, the exact squared change of the renders if only this splat is
  removed. Overlapping splats have small errors each, but a large error together. So few are pruned at once, and the
  others are trained before they are measured again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from csplat.types import F32, F64, I64
from csplat_render import kernels
from csplat_render.camera import Camera
from csplat_render.pruning_error import PruningError
from csplat_trainer.parameters import Parameters
from csplat_trainer.pruning import kept_in_round

_MAX_SHARE = 51  # largest number of splats in one place, as in the paper's code
_BINOMIAL = np.array([[float(math.comb(n, k)) for k in range(_MAX_SHARE + 1)] for n in range(_MAX_SHARE + 1)])
_SOURCE_MARGIN = 1e-7  # least distance from 0 and 1 of an opacity that is shared, so that factors of scales are finite
_SHARED_MARGIN = 1e-6  # least distance from 0 and 1 of a shared opacity, so that logits are finite
GATE_SLOPE, GATE_CENTRE = 100.0, 0.995  # the paper's gate, which limits noise to nearly transparent splats
MAX_NOISE = 1.0  # standard deviations per step; the paper's noise moves large splats out of small scenes
_GATE_OFF = 0.1  # opacity above which the gate is below 1e-4


def relocate(parameters: Parameters, dead_opacity: float, rng: Generator) -> int:
    """Move splats that are nearly transparent to live splats, chosen by opacity.

    Args:
        parameters: changed in place.
        dead_opacity: a splat of at most this opacity is dead.
        rng: source of random choices.

    Returns:
        Number of moved splats.
    """
    alphas = parameters.alphas
    dead = np.flatnonzero(alphas <= dead_opacity)
    alive = np.flatnonzero(alphas > dead_opacity)
    if len(dead) == 0 or len(alive) == 0:
        return 0
    sources = _draw_by_opacity(alphas, alive, len(dead), rng)
    _share_opacity_among(parameters, sources, alphas, dead_opacity)
    parameters.copy_rows(sources, dead)
    parameters.forget(dead)
    return len(dead)


def grow(parameters: Parameters, factor: float, cap: int, dead_opacity: float, rng: Generator) -> int:
    """Add splats at the positions of others, chosen by opacity, up to a cap.

    Args:
        parameters: changed in place.
        factor: growth of the number of splats, below the cap.
        cap: largest number of splats.
        dead_opacity: least opacity of a new splat.
        rng: source of random choices.

    Returns:
        Number of added splats.
    """
    count = len(parameters)
    added = min(cap, max(count + 1, int(factor * count))) - count
    if added <= 0 or count == 0:
        return 0
    alphas = parameters.alphas
    sources = _draw_by_opacity(alphas, np.arange(count), added, rng)
    _share_opacity_among(parameters, sources, alphas, dead_opacity)
    parameters.append_copies(sources)
    return added


def share_opacity(alphas: F64, counts: I64) -> tuple[F64, F64]:
    """Return opacity and scale of n equal splats that look like a single splat (equation 9 of the MCMC paper).

    Args:
        alphas: opacity of the single splat.
        counts: n, at most 51.

    Returns:
        Opacities of the n splats, and factors of their standard deviations.
    """
    shared = 1.0 - (1.0 - alphas) ** (1.0 / counts)
    # The paper's double sum, summed over its outer index: sum_i C(i - 1, k) = C(n, k + 1).
    denominator = np.zeros_like(shared)
    for k in range(int(counts.max(initial=1))):
        denominator += _BINOMIAL[counts, k + 1] * (-1.0) ** k / math.sqrt(k + 1) * shared ** (k + 1)
    return shared, alphas / denominator


def _draw_by_opacity(alphas: F32, among: I64, count: int, rng: Generator) -> I64:
    """Draw `count` of the indices `among` [n] with replacement, in proportion to the splats' opacities [N]."""
    edges = np.cumsum(alphas[among].astype(np.float64))
    drawn = np.searchsorted(edges, rng.random(count) * edges[-1], side="right")
    chosen: I64 = among[np.minimum(drawn, len(among) - 1)]
    return chosen


def _share_opacity_among(parameters: Parameters, sources: I64, alphas: F32, least: float) -> None:
    """Give each source the opacity and scales of a splat that shares its place with its copies; copy it afterwards.

    Args:
        parameters: logits and scales of the sources are changed in place, and their moments are reset.
        sources: splats to be copied, once for each occurrence.
        alphas: [N], opacities of all splats.
        least: least opacity of the result.
    """
    places, counts = np.unique(sources, return_counts=True)
    old = np.clip(alphas[places].astype(np.float64), _SOURCE_MARGIN, 1.0 - _SOURCE_MARGIN)
    shared, factor = share_opacity(old, np.minimum(counts + 1, _MAX_SHARE))
    shared = np.clip(shared, max(least, _SHARED_MARGIN), 1.0 - _SHARED_MARGIN)
    parameters.write("logits", places, np.log(shared / (1.0 - shared)).astype(np.float32))
    _add_to_rows(parameters, "scales", places, np.log(factor)[:, None].astype(np.float32))
    parameters.forget(places)


def _add_to_rows(parameters: Parameters, name: str, rows: I64, summand: F32 | np.float32) -> None:
    """Add to a group's values of some splats, in place; the summand has their shape, or is broadcast to it."""
    parameters.write(name, rows, parameters.read(name, rows) + summand)


def add_noise(parameters: Parameters, strength: float, normals: F32) -> None:
    """Move splats at random inside their own shapes, transparent splats more.

    This is the paper's noise, covariance · normal · gate · strength, limited to the splat's size along each axis.

    Args:
        parameters: the means are changed in place.
        strength: `noise` times the learning rate of the means.
        normals: [N, 3], standard normal numbers.
    """
    # Splats above an opacity of `_GATE_OFF` are skipped, and means that would overflow float32 stay.
    arrays = [parameters.values[name] for name in ("means", "quats", "scales", "logits")]
    assert {np.dtype(np.float32)} == {array.dtype for array in (*arrays, normals)}
    gate = float(strength), math.log(_GATE_OFF / (1.0 - _GATE_OFF)), GATE_SLOPE, GATE_CENTRE, MAX_NOISE
    kernels.call("add_noise", len(parameters), *arrays, normals, *gate)


_SPLIT_SIZE = 0.01  # fraction of the extent; larger splats are split, smaller ones cloned
_SPLIT_SHRINK = 1.6  # divisor of the scales of a split
_RESET_ALPHA = 0.01  # opacity after a reset
_MAX_LOG_SCALE = 60.0  # log scale up to which offsets of a split fit float32


@dataclass
class ScreenGradients:
    """Mean norm of the gradient by each splat's position on screen, over the renders that show it.

    Attributes:
        total: [N] float64.
        count: [N] int64.
    """

    total: F64
    count: NDArray[np.int64]

    @classmethod
    def none(cls, splats: int) -> ScreenGradients:
        """Return sums of no renders."""
        return cls(np.zeros(splats), np.zeros(splats, np.int64))

    def clear(self, splats: int) -> None:
        """Start anew, for another number of splats."""
        self.total, self.count = np.zeros(splats), np.zeros(splats, np.int64)

    def state(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint."""
        return {"screen_total": self.total, "screen_count": self.count}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take the state of a checkpoint, unless it has none or is of another number of splats."""
        total, count = arrays.get("screen_total"), arrays.get("screen_count")
        if total is not None and count is not None and total.shape == self.total.shape == count.shape:
            self.total, self.count = total.astype(np.float64), count.astype(np.int64)

    def add(self, norms: F32, drawn: NDArray[np.bool_]) -> None:
        """Add the norms of a render, for the splats that it shows."""
        self.total[drawn] += norms[drawn]
        self.count[drawn] += 1

    @property
    def mean(self) -> F64:
        """The mean, 0 for splats that no render shows."""
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
    """Clone and split splats whose gradient is above a threshold, largest first up to the cap; prune dead splats.

    Args:
        parameters: changed in place.
        screen: gradients since the last call.
        extent: extent of the scene.
        threshold: threshold of the mean norm.
        cap: largest number of splats.
        dead_opacity: splats of at most this opacity are pruned.
        rng: source of the offsets of splits.

    Returns:
        Change of the number of splats.
    """
    before = len(parameters)
    alive = parameters.alphas > dead_opacity
    if not alive.any():
        return 0
    strength = np.where(alive, screen.mean, 0.0)
    free = max(0, cap - int(alive.sum()))
    strongest = np.argsort(-strength, kind="stable")[:free]
    chosen = np.sort(strongest[strength[strongest] > threshold])
    parameters.append_copies(chosen)
    large = parameters.read("scales", chosen).max(axis=1) > np.log(_SPLIT_SIZE * extent)
    split, copies = chosen[large], before + np.flatnonzero(large)
    if len(split):
        offsets = _split_offsets(parameters.read("quats", split), parameters.read("scales", split), rng)
        for rows, offset in zip((split, copies), offsets, strict=True):
            _add_to_rows(parameters, "means", rows, offset)
            _add_to_rows(parameters, "scales", rows, -np.float32(np.log(_SPLIT_SHRINK)))
        parameters.forget(split)
    parameters.keep(np.concatenate([np.flatnonzero(alive), np.arange(before, len(parameters))]))
    return len(parameters) - before


def reset_opacities(parameters: Parameters) -> None:
    """Lower all opacities to at most `_RESET_ALPHA`; training restores those that the images need.

    The optimiser's moments of the opacities are cleared, so that they do not undo it.
    """
    rows = np.arange(len(parameters))
    logit = np.float32(np.log(_RESET_ALPHA / (1.0 - _RESET_ALPHA)))
    parameters.write("logits", rows, np.minimum(parameters.read("logits", rows), logit))
    for moments in (parameters.first, parameters.second):
        moments["logits"][:] = 0.0


def _split_offsets(quats: F32, scales: F32, rng: Generator) -> tuple[F32, F32]:
    """Draw two offsets for each splat from its own shape.

    Args:
        quats: [N, 4], of unit length.
        scales: [N, 3], logarithms.
        rng: source of the offsets.

    Returns:
        [N, 3] each.
    """
    w, x, y, z = quats.astype(np.float64).T
    rotation = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        1,
    )
    deviations = np.exp(np.minimum(scales.astype(np.float64), _MAX_LOG_SCALE))
    drawn = rng.standard_normal((2, len(quats), 3)) * deviations
    first, second = (np.einsum("nij,nj->ni", rotation, offsets).astype(np.float32) for offsets in drawn)
    return first, second


_PRUNING_VIEWS = 32  # largest number of views in which the pruning error is measured, evenly spread


def prune_least_needed(
    parameters: Parameters, cameras: Sequence[Camera], measure: Callable[[Sequence[Camera]], PruningError], count: int
) -> None:
    """Prune the splats with the least pruning error in rounds, unseen splats first.

    Args:
        parameters: changed in place.
        cameras: the cameras of the training images.
        measure: measures the pruning errors of the splats in some views.
        count: number of splats to keep.
    """
    views = cameras[:: -(-len(cameras) // _PRUNING_VIEWS)]
    while len(parameters) > count:
        parameters.keep(kept_in_round(parameters.alphas, measure(views), count))
