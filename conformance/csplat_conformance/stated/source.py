"""The splats of the source, with which a file is compared (spec 5.6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.model import MAX_SH_DEGREE, SplatModel
from csplat.types import F32

_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


@dataclass(frozen=True, eq=False)
class Source:
    """M splats as section 5.6 of the spec has them, of SH degree 0 to 4.

    Attributes:
        means: [M, 3] float32 or float64, centres relative to `origin`.
        quats: [M, 4] float32, w x y z, divided by their lengths and rounded.
        scales: [M, 3] float32, logarithms.
        opacities: [M] float32, alpha: the logistic function of the logit, rounded.
        sh0: [M, 3] float32.
        shN: [M, K, 3] float32, K = (d + 1)² − 1.
        origin: offset to add to `means`, float64.
        extra: further columns by name, [M].
    """

    means: NDArray[Any]
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    extra: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, model: SplatModel) -> Source:
        """Return the source that a model is; its centres in doubles, if it has them."""
        doubles = model.means_double
        return cls(
            model.means if doubles is None else doubles,
            model.quats,
            model.scales,
            model.opacities,
            model.sh0,
            model.shN,
            model.origin if doubles is None else (0.0, 0.0, 0.0),
            model.extra,
        )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """The SH degree, 0 to 4."""
        return math.isqrt(self.shN.shape[1] + 1) - 1

    def about(self, origin: tuple[float, float, float]) -> Source:
        """Return the same splats with centres relative to another origin."""
        if origin == self.origin:
            return self
        means = self.means.astype(np.float64) + np.subtract(self.origin, origin)
        return replace(self, means=means, origin=origin)

    def some(self, rows: NDArray[Any]) -> Source:
        """Return some of the splats, in the order of `rows`."""
        arrays: dict[str, Any] = {name: getattr(self, name)[rows] for name in _ARRAYS}
        return replace(self, **arrays, extra={name: column[rows] for name, column in self.extra.items()})

    @staticmethod
    def joined(parts: Sequence[Source]) -> Source:
        """Return parts of a source, one after the other; at least one."""
        first = parts[0]
        arrays: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in parts]) for name in _ARRAYS}
        extra = {name: np.concatenate([one.extra[name] for one in parts]) for name in first.extra}
        return replace(first, **arrays, extra=extra)

    def model(self, origin: tuple[float, float, float]) -> SplatModel:
        """Return it for renders next to a file of this origin: centres in float32 relative to it, degree 3 at most."""
        near = self.about(origin)
        with np.errstate(over="ignore"):  # the model refuses what leaves float32
            means = near.means.astype(np.float32)
        return SplatModel(
            means,
            self.quats,
            self.scales,
            self.opacities,
            self.sh0,
            np.ascontiguousarray(self.shN[:, : (MAX_SH_DEGREE + 1) ** 2 - 1]),
            origin,
        )

    def reach(self, origin: tuple[float, float, float]) -> float:
        """Return the largest magnitude of its coordinates and of a file's origin, scene units."""
        farthest = 0.0
        for axis in range(3):
            column, own = self.means[:, axis], self.origin[axis]
            ends = (float(column.min(initial=0.0)) + own, float(column.max(initial=0.0)) + own, own, origin[axis])
            farthest = max(farthest, *map(abs, ends))
        return farthest
