"""Scene statistics that the steps follow: extent, how colours vary from splat to splat, size of splats.

Errors that one step causes in pictures differ from scene to scene by a factor of ten; most of that is explained by
three numbers. A displaced, turned or resized splat shows as far as its neighbours have another colour; a displacement
shows in proportion to the scene's extent on the screen; a rotation in proportion to the splat's size on the screen.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.morton import morton_codes
from csplat.model import SplatModel

#: A channel's colour per coefficient of degree 0.
COLOUR_PER_SH0 = 0.28209479177387814

_SAMPLE = 1 << 16  # splats that are sampled
_RUNS = 16  # runs of neighbours among the sampled splats
_APART = 8  # places in Morton order
_CORE = 0.8  # share of the splats within the scene's reach
_BITS = 16
_LARGEST = 1e38  # largest cells per scene unit, within float32


@dataclass(frozen=True)
class Statistics:
    """Three numbers of a scene.

    Attributes:
        reach: distance from the median centre that 80 % of the splats keep, scene units, >= 0.
        contrast: rms difference of colours of near splats, weighted with their opacities, in [0.02, 1].
        size: median of the largest standard deviation, as a share of the reach, in [1e-4, 1].
    """

    reach: float
    contrast: float
    size: float


def scene_statistics(model: SplatModel, contrast: float | None = None) -> Statistics:
    """Look at a sample of a scene; the same model gives the same numbers.

    Args:
        model: the scene.
        contrast: as in `contrast_of`, if the model is itself a sample, whose splats are no neighbours.
    """
    if len(model) == 0:
        return Statistics(0.0, 0.2, 0.01)
    points, reach = _reach(model.means)
    largest = np.take(model.scales, _spread(len(model)), axis=0).max(axis=1)
    size = float(np.exp(np.clip(np.median(largest), -80, 80))) / reach if reach else 1.0
    if contrast is None:
        contrast = _rms(*_contrast(model, points, reach))
    return Statistics(reach, float(np.clip(contrast, 0.02, 1.0)), float(np.clip(size, 1e-4, 1.0)))


def contrast_of(parts: Iterable[SplatModel]) -> float:
    """Contrast of a scene of which these are parts, each with all splats of its place."""
    sums = [_contrast(part, *_reach(part.means)) for part in parts if len(part)]
    return _rms(sum(squares for squares, _ in sums), sum(weights for _, weights in sums))


def _spread(count: int) -> NDArray[np.intp]:
    return np.arange(0, count, max(1, count // _SAMPLE))


def _reach(means: NDArray[np.float32]) -> tuple[NDArray[np.float64], float]:
    """The centres that are looked at, and how far 80 % of them lie from the median one."""
    points = np.take(means, _spread(len(means)), axis=0).astype(np.float64)
    distance = points - np.median(points, axis=0)
    top = float(np.abs(distance).max())
    return points, top and top * float(np.quantile(np.sqrt(np.square(distance / top).sum(axis=1)), _CORE))


def _rms(squares: float, weights: float) -> float:
    return COLOUR_PER_SH0 * float(np.sqrt(squares / weights)) if weights else 0.2


def _contrast(model: SplatModel, sample: NDArray[np.float64], reach: float) -> tuple[float, float]:
    """Return the summed weighted squares of colour differences of splats a few places apart in Morton order."""
    squares = weights = 0.0
    if len(model) <= _APART or not reach:
        return squares, weights
    for rows in _neighbours(model.means, np.median(sample, axis=0), 2.0 * reach):
        near, far = rows[:-_APART], rows[_APART:]
        weight = model.opacities[near].astype(np.float64) * model.opacities[far]
        colour = np.clip(model.sh0[near].astype(np.float64) - model.sh0[far], -10, 10)
        squares += float((np.square(colour).mean(axis=1) * weight).sum())
        weights += float(weight.sum())
    return squares, weights


def _neighbours(means: NDArray[np.float32], centre: NDArray[Any], reach: float) -> list[NDArray[np.intp]]:
    """Return runs of splats in Morton order: all of a small scene, some of a large one."""
    codes = np.empty(len(means), np.int64)
    scale, top = np.float32(min(1.0 / reach, _LARGEST)), (1 << _BITS) - 1
    shift = np.float32(0.5) - (centre / reach).astype(np.float32)
    for at in range(0, len(means), _SAMPLE):
        with np.errstate(over="ignore"):  # infinity is clipped like all that is out of reach
            place = means[at : at + _SAMPLE].T * scale + shift[:, None]
        codes[at : at + _SAMPLE] = morton_codes((np.clip(place, 0, 1) * top).astype(np.int32))
    if len(means) <= 2 * _SAMPLE:
        return [np.argsort(codes, kind="stable")]
    bounds = np.sort(codes[:: len(codes) // _SAMPLE])
    length = len(bounds) // _RUNS
    share = max(1, length * _SAMPLE // len(means))
    runs = []
    for run in range(_RUNS):
        first, last = bounds[run * length], bounds[min(run * length + share, len(bounds) - 1)]
        rows = np.flatnonzero((codes >= first) & (codes <= last))
        if len(rows) > _APART:
            runs.append(rows[np.argsort(codes[rows], kind="stable")])
    return runs
