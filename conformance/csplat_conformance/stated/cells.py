"""Space cut into cells of about as many splats, by where a file's tiles lie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.boxes import tile_boxes
from csplat.decoder import SceneHeader
from csplat.types import F64

_EIGHTHS = np.array([[x, y, z] for x in (0.25, 0.75) for y in (0.25, 0.75) for z in (0.25, 0.75)])


@dataclass(frozen=True, eq=False)
class Cells:
    """A tree of planes across an axis each; node k has the nodes 2k + 1 below and 2k + 2 above its plane.

    Attributes:
        axes: [2^d - 1] which axis.
        values: [2^d - 1] where.
    """

    axes: NDArray[np.int64]
    values: F64

    @classmethod
    def of(cls, header: SceneHeader, count: int, most: int) -> Cells:
        """Cut space so that about `most` of `count` splats lie in a cell: tiles stand for what lies in them."""
        boxes = tile_boxes(header)
        points = (boxes[:, None, 0] + _EIGHTHS * (boxes[:, None, 1] - boxes[:, None, 0])).reshape(-1, 3)
        weights = np.repeat([float(tile.splat_count) for tile in header.tiles], len(_EIGHTHS))
        depth = max(0, int(np.ceil(np.log2(max(1.0, count / most))))) if len(points) else 0
        cells = cls(np.zeros(2**depth - 1, np.int64), np.zeros(2**depth - 1))
        cells._cut(0, points, weights)
        return cells

    def _cut(self, node: int, points: F64, weights: F64) -> None:
        if node >= len(self.axes) or not len(points):
            return
        axis = int(np.ptp(points, axis=0).argmax())
        order = np.argsort(points[:, axis], kind="stable")
        points, weights = points[order], weights[order]
        heavy = np.cumsum(weights)
        middle = min(int(np.searchsorted(heavy, heavy[-1] / 2.0)) + 1, len(points) - 1)
        self.axes[node], self.values[node] = axis, points[middle, axis]
        self._cut(2 * node + 1, points[:middle], weights[:middle])
        self._cut(2 * node + 2, points[middle:], weights[middle:])

    def place(self, means: NDArray[Any]) -> NDArray[np.int64]:
        """The cell of each centre, [n]."""
        node = np.zeros(len(means), np.int64)
        rows = np.arange(len(means))
        for _ in range(len(self.axes).bit_length()):
            node = 2 * node + 1 + (means[rows, self.axes[node]] >= self.values[node])
        return node - len(self.axes)
