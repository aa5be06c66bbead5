"""Options of a simplification."""

from __future__ import annotations

import math
from dataclasses import dataclass

from csplat.errors import InputError
from csplat_tools.views import VIEW_SIZE, usual_views

_USUAL = 3  # default effort


@dataclass(frozen=True)
class SimplifyOptions:
    """Options of a simplification.

    Attributes:
        rounds: number of times that errors are measured anew while splats are pruned, at least 1.
        refit: fit colours, opacities, scales and rotations of the kept splats to the source's renders.
        effort: amount of work, 1 to 9: each one less than 3 halves the steps of descent, every two more double them;
            below 3 a target tries fewer candidates.
        bands: set SH bands to zero that are worth less than their bits.
        keep_unseen: keep splats that no view shows.
        view_size: width and height of training renders, pixels; `None`: chosen by the number of splats.
        views: largest number of virtual views if no views are given; `None`: chosen by the number of splats.
        background: red, green, blue behind virtual views; given views have their own.
        seed: seed of the virtual views, and of the order in which views are used.
        threads: number of threads; None for all. The result does not depend on it.

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
        """Return the largest number of training views, and the width and height of their renders, for N splats."""
        views, size = usual_views(splats)
        return self.views or views, self.view_size or size

    def steps(self, usual: int) -> int:
        """Return the number of steps in place of the usual one, by effort; fewer if renders are larger than usual."""
        larger = math.sqrt(math.prod(self.view_size or VIEW_SIZE) / math.prod(VIEW_SIZE))
        return max(1, round(usual * self.work / max(1.0, larger)))

    @property
    def work(self) -> float:
        """The amount of work as a multiple of that with the default effort."""
        octaves = self.effort - _USUAL
        return 2.0 ** (octaves / 2 if octaves > 0 else octaves)

    @property
    def is_brief(self) -> bool:
        """True if a target tries fewer candidates."""
        return self.effort < _USUAL
