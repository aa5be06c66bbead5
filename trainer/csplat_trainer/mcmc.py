"""Splats as samples: relocation, growth and noise of "3DGS as Markov chain Monte Carlo".

Kheradmand et al. 2024, https://arxiv.org/abs/2404.09591. A dead splat moves onto a live one, and
both (all n, where several moved there) get the opacity and the scales that leave the picture as it
was, as nearly as n equal splats can; noise then parts them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from csplat.types import F32, F64, I64
from csplat_render.kernels import lane_range, parallel_kernel
from csplat_trainer.parameters import GROUPS, Parameters

_MAX_SHARE = 51  # splats in one place at most, as the paper's code has it
_BINOMIAL = np.array([[float(math.comb(n, k)) for k in range(_MAX_SHARE + 1)] for n in range(_MAX_SHARE + 1)])
_GATE_SLOPE, _GATE_CENTRE = 100.0, 0.995  # of the paper: noise for splats that are nearly transparent
_FARTHEST = 1.0  # standard deviations per step; the paper's noise flings large splats out of small scenes
_GATE_OFF = 0.1  # at this opacity and above the gate is below 1e-4


def relocate(parameters: Parameters, dead_opacity: float, rng: Generator) -> int:
    """Move splats that are nearly transparent to live ones, chosen by opacity.

    Args:
        parameters: changed in place.
        dead_opacity: at this opacity and below a splat is dead.
        rng: chooses.

    Returns:
        How many moved.
    """
    alphas = parameters.alphas
    dead = np.flatnonzero(alphas <= dead_opacity)
    alive = np.flatnonzero(alphas > dead_opacity)
    if len(dead) == 0 or len(alive) == 0:
        return 0
    sources = _choose(alphas, alive, len(dead), rng)
    _share_among(parameters, sources, alphas, dead_opacity)
    for name in GROUPS:
        parameters.values[name][dead] = parameters.values[name][sources]
    parameters.forget(dead)
    return len(dead)


def grow(parameters: Parameters, factor: float, cap: int, dead_opacity: float, rng: Generator) -> int:
    """Add splats beside others that are chosen by opacity, up to a cap.

    Args:
        parameters: changed in place.
        factor: how many splats there are afterwards, as a multiple of those there are, below the cap.
        cap: no more splats than this.
        dead_opacity: no new splat is more transparent than this.
        rng: chooses.

    Returns:
        How many were added.
    """
    count = len(parameters)
    wanted = min(cap, max(count + 1, int(factor * count))) - count
    if wanted <= 0 or count == 0:
        return 0
    alphas = parameters.alphas
    sources = _choose(alphas, np.arange(count), wanted, rng)
    _share_among(parameters, sources, alphas, dead_opacity)
    parameters.append({name: parameters.values[name][sources] for name in GROUPS})
    return wanted


def share(alphas: F64, counts: I64) -> tuple[F64, F64]:
    """Opacity and scale of n equal splats in one place that look like one (equation 9 of the paper).

    Args:
        alphas: opacity of the one.
        counts: n, at most 51.

    Returns:
        Opacities of each of the n, and factors of their standard deviations.
    """
    shared = 1.0 - (1.0 - alphas) ** (1.0 / counts)
    # The paper's double sum, added up along its outer index: sum_i C(i - 1, k) = C(n, k + 1).
    denominator = np.zeros_like(shared)
    for k in range(int(counts.max(initial=1))):
        denominator += _BINOMIAL[counts, k + 1] * (-1.0) ** k / math.sqrt(k + 1) * shared ** (k + 1)
    return shared, alphas / denominator


def _choose(alphas: F32, among: I64, count: int, rng: Generator) -> I64:
    """Draw splats with replacement, each as likely as it is opaque."""
    edges = np.cumsum(alphas[among].astype(np.float64))
    drawn = np.searchsorted(edges, rng.random(count) * edges[-1], side="right")
    chosen: I64 = among[np.minimum(drawn, len(among) - 1)]
    return chosen


def _share_among(parameters: Parameters, sources: I64, alphas: F32, least: float) -> None:
    places, counts = np.unique(sources, return_counts=True)
    old = np.clip(alphas[places].astype(np.float64), 1e-7, 1.0 - 1e-7)
    shared, factor = share(old, np.minimum(counts + 1, _MAX_SHARE))
    shared = np.clip(shared, max(least, 1e-6), 1.0 - 1e-6)
    parameters.values["logits"][places] = np.log(shared / (1.0 - shared))
    parameters.values["scales"][places] += np.log(factor)[:, None].astype(np.float32)
    parameters.forget(places)


def add_noise(parameters: Parameters, strength: float, normals: F32) -> None:
    """Move splats at random inside their own shapes, the more the more transparent they are.

    The paper's noise, covariance · normal · gate · strength, but along no axis wider than the splat.

    Args:
        parameters: the means change, in place.
        strength: the noise's factor times the learning rate of the means.
        normals: [N, 3], standard normal numbers.
    """
    v = parameters.values
    _noise(v["means"], v["quats"], v["scales"], v["logits"], np.float32(strength), normals)


@parallel_kernel()
def _noise(
    lane: int, lanes: int, means: F32, quats: F32, scales: F32, logits: F32, strength: np.float32, normals: F32
) -> None:
    """Add the noise to each mean; a thread takes a run of splats."""
    highest = math.log(_GATE_OFF / (1.0 - _GATE_OFF))
    for i in range(*lane_range(lane, lanes, means.shape[0])):
        if logits[i] > highest:
            continue
        alpha = 1.0 / (1.0 + math.exp(-logits[i]))
        gate = strength / (1.0 + math.exp(-_GATE_SLOPE * (1.0 - alpha - _GATE_CENTRE)))
        w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        r00, r01, r02 = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        r10, r11, r12 = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        r20, r21, r22 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        n0, n1, n2 = normals[i, 0], normals[i, 1], normals[i, 2]
        s0, s1, s2 = math.exp(scales[i, 0]), math.exp(scales[i, 1]), math.exp(scales[i, 2])
        l0 = (r00 * n0 + r10 * n1 + r20 * n2) * min(gate * s0, _FARTHEST) * s0
        l1 = (r01 * n0 + r11 * n1 + r21 * n2) * min(gate * s1, _FARTHEST) * s1
        l2 = (r02 * n0 + r12 * n1 + r22 * n2) * min(gate * s2, _FARTHEST) * s2
        m0 = np.float32(means[i, 0] + (r00 * l0 + r01 * l1 + r02 * l2))
        m1 = np.float32(means[i, 1] + (r10 * l0 + r11 * l1 + r12 * l2))
        m2 = np.float32(means[i, 2] + (r20 * l0 + r21 * l1 + r22 * l2))
        if np.isfinite(m0) and np.isfinite(m1) and np.isfinite(m2):  # a splat as wide as float32 stays where it is
            means[i, 0], means[i, 1], means[i, 2] = m0, m1, m2
