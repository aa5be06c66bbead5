# SPDX-License-Identifier: Apache-2.0
"""Find parts of a scene that are far from each other, in comparison with their own sizes.

Each part has the steps and views that it would have alone: what is fine enough for the whole scene, or for a view of
it, would ruin a part.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat.portable_math import exp
from csplat.types import F32, F64

_SAMPLE = 1 << 11  # splats on which parts are found
_CENTRES = 64  # splats of the sample that may be the centre of a part
_LEAST = 20  # splats of the sample; fewer are outliers
_LEAST_SHARE = 0.01  # the same as a fraction of a large sample
_PARTS_MAX = 32  # further parts share the step and the views of the rest
_GAP = 3.0  # outer by inner radius of the empty shell around a part; in twenty scenes of one piece it is at most 2.9
_GAP_SHARE = 0.01  # largest fraction of the sample in that shell
_GAP_PART_SHARE = 10  # splats of the part for each splat in the shell, so that a part keeps its sparse border
_LOG_SIZE_MAX = 80  # log scale to which the median size is clipped, so that its square stays within float64
_BLOCK = 1 << 16  # splats per block of temporaries


@dataclass(frozen=True)
class ScenePart:
    """A part of a scene: the splats in a sphere that are in no part before it.

    Attributes:
        centre: x, y, z, scene units.
        square: squared radius.
    """

    centre: tuple[float, float, float]
    square: float


def find_parts(points: F64, scales: F32) -> tuple[ScenePart, ...]:
    """Find the parts of a scene between which there is much more space than within them.

    The centre of a part is the splat, of a few, with the nearest neighbours. The shell around the part, from its radius
    to `_GAP` times that radius, has hardly any splats. A part is at least as large as its splats.

    Args:
        points: [n, 3], means of a sample of the scene.
        scales: [n, 3], their log scales.

    Returns:
        The parts; none if the scene is in one piece but for outliers. Splats in no part are the rest, which may be
        another part, or surround the others.
    """
    step = max(1, len(points) // _SAMPLE)
    rest, largest = points[::step], scales[::step].max(axis=1)
    least = part_min(len(rest))
    parts: list[ScenePart] = []
    while len(rest) >= 2 * least and len(parts) < _PARTS_MAX:
        centres = rest[:: max(1, len(rest) // _CENTRES)]
        squares = np.stack([np.sort(_squares(rest, centre)) for centre in centres])
        chosen = int(np.argmin(squares[:, least - 1]))
        apart = _squares(rest, centres[chosen])
        size = median_size(largest[apart <= squares[chosen, least - 1]])
        last = np.arange(least - 1, len(rest))  # the last splat of the part
        beyond = last + np.maximum(1, np.minimum(int(len(rest) * _GAP_SHARE), (last + 1) // _GAP_PART_SHARE))
        last = last[beyond < len(rest)]
        inner, outer = np.maximum(squares[chosen][last], size * size), squares[chosen][beyond[: len(last)]]
        ratios = np.divide(outer, inner, out=np.zeros_like(outer), where=inner > 0.0)
        empty = np.append(ratios >= _GAP**2, False)
        first = int(np.argmax(empty))  # beyond the next shell may be other parts
        if not empty[first]:
            break
        widest = first + int(np.argmax(ratios[first : first + int(np.argmin(empty[first:]))]))
        x, y, z = map(float, centres[chosen])
        parts.append(ScenePart((x, y, z), float(inner[widest]) * _GAP))
        outside = apart > parts[-1].square
        rest, largest = rest[outside], largest[outside]
    return tuple(parts) if len(parts) > 1 or len(rest) >= least else ()


def median_size(largest: F32) -> float:
    """Return the median of largest standard deviations, scene units, of their logarithms [n], n > 0."""
    return float(exp(float(np.clip(np.median(largest), -_LOG_SIZE_MAX, _LOG_SIZE_MAX))))


def part_min(count: int) -> int:
    """Return the minimum number of splats of a part in a sample of `count` splats."""
    return max(_LEAST, int(count * _LEAST_SHARE))


def part_of(means: NDArray[Any], parts: Sequence[ScenePart]) -> NDArray[np.uint8]:
    """Return the first part that contains each of the means, [N, 3]; the number of parts if none does."""
    index = np.full(len(means), len(parts), np.uint8)
    for number in reversed(range(len(parts))):
        centre = np.array(parts[number].centre)
        for start in range(0, len(means), _BLOCK):
            block = means[start : start + _BLOCK].astype(np.float64)
            index[start : start + _BLOCK][_squares(block, centre) <= parts[number].square] = number
    return index


def split_parts(model: SplatModel, parts: Sequence[ScenePart]) -> Iterator[SplatModel]:
    """Yield the splats of each part, and of the rest; the scene itself if there are no parts."""
    if not parts:
        yield model
        return
    index = part_of(model.means, parts)
    for number in range(len(parts) + 1):
        yield model.select(np.flatnonzero(index == number))


def _squares(points: F64, centre: F64) -> F64:
    """Return the squared distances of points, [n, 3], from a centre, [3]."""
    x, y, z = (points - centre).T
    squares: F64 = x * x + y * y + z * z
    return squares
