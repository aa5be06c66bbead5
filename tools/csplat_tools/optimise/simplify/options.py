"""How a simplification goes about it."""

from __future__ import annotations

from dataclasses import dataclass

from csplat.errors import InputError
from csplat_tools.views import VIEW_COUNT, VIEW_SIZE

__all__ = ["SimplifyOptions"]


@dataclass(frozen=True)
class SimplifyOptions:
    """How to go about it.

    Attributes:
        rounds: how often errors are measured anew on the way, at least 1.
        refit: fit colours, opacities, scales and rotations of what stays to the source's renders.
        steps: of that fit; each looks at one view.
        bands: set SH bands to zero that are worth less than their bits.
        keep_unseen: splats that no view shows stay.
        view_size: of the pictures that teach, width and height in pixels.
        views: virtual views at most, where no views are given.
        background: red, green, blue behind those; of views that are given theirs counts.
        seed: of those, and of the order in which views are looked at.
        threads: how many; None for all. The result does not depend on it.

    Raises:
        InputError: a value is out of range.
    """

    rounds: int = 4
    refit: bool = True
    steps: int = 960
    bands: bool = True
    keep_unseen: bool = True
    view_size: tuple[int, int] = VIEW_SIZE
    views: int = VIEW_COUNT
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        for name in ("rounds", "steps", "views"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}, wanted 1 or more")
        if min(self.view_size) < 1:
            raise InputError(f"view_size is {self.view_size}, wanted pixels")
