"""How a simplification goes about it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from csplat.errors import InputError
from csplat_tools.views import VIEW_SIZE, usual_views

__all__ = ["SimplifyOptions"]

_USUAL = 3  # effort


@dataclass(frozen=True)
class SimplifyOptions:
    """How to go about it.

    Attributes:
        rounds: how often errors are measured anew on the way, at least 1.
        refit: fit colours, opacities, scales and rotations of what stays to the source's renders.
        effort: how much work that is, 1 to 9: each one less than 3 takes half of the steps of descent, every two more
            twice as many; below 3 a target tries fewer things.
        bands: set SH bands to zero that are worth less than their bits.
        keep_unseen: splats that no view shows stay.
        view_size: of the pictures that teach, width and height in pixels; `None`: as is usual for so many splats.
        views: virtual views at most, where no views are given; `None`: likewise.
        background: red, green, blue behind those; of views that are given theirs counts.
        seed: of those, and of the order in which views are looked at.
        threads: how many; None for all. The result does not depend on it.

    Raises:
        InputError: a value is out of range.
    """

    rounds: int = 4
    refit: bool = True
    effort: int = _USUAL
    bands: bool = True
    keep_unseen: bool = True
    view_size: tuple[int, int] | None = None
    views: int | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.effort <= 9:
            raise InputError(f"effort is {self.effort}, wanted 1 to 9")
        for name in ("rounds", "views"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"{name} is {value}, wanted 1 or more")
        if self.view_size is not None and min(self.view_size) < 1:
            raise InputError(f"view_size is {self.view_size}, wanted pixels")

    def pictures(self, splats: int) -> tuple[int, tuple[int, int]]:
        """How many views teach at most, and the width and height of their pictures, of a scene of so many splats."""
        views, size = usual_views(splats)
        return self.views or views, self.view_size or size

    def steps(self, usual: int) -> int:
        """Steps of descent in place of so many, which are usual: fewer, where pictures are larger and views fewer."""
        larger = math.sqrt(math.prod(self.view_size or VIEW_SIZE) / math.prod(VIEW_SIZE))
        return max(1, round(usual * self.work / max(1.0, larger)))

    @property
    def work(self) -> float:
        """How many times as much work as is usual."""
        octaves = self.effort - _USUAL
        return 2.0 ** (octaves / 2 if octaves > 0 else octaves)

    @property
    def is_brief(self) -> bool:
        """Whether a target tries fewer things."""
        return self.effort < _USUAL
