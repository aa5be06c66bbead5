"""How a simplification goes about it."""

from __future__ import annotations

from dataclasses import dataclass

from csplat.errors import InputError
from csplat_tools.views import VIEW_SIZE

__all__ = ["METHODS", "SimplifyOptions"]

#: By what splats are chosen: exact errors measured anew after each round; once; and two that look at no picture.
METHODS = ("rounds", "exact", "opacity", "opacity-area")


@dataclass(frozen=True)
class SimplifyOptions:
    """How to go about it.

    Attributes:
        method: one of `METHODS`.
        rounds: how often errors are measured anew on the way, at least 1.
        refit: fit the colours of what stays to the source's renders.
        steps: of that fit at most.
        adjust: then move opacities and scales of what stays, by gradient descent, and fit colours again; not without
            `refit`.
        passes: how often that looks at each view.
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

    method: str = "rounds"
    rounds: int = 4
    refit: bool = True
    steps: int = 8
    adjust: bool = True
    passes: int = 2
    bands: bool = True
    keep_unseen: bool = True
    view_size: tuple[int, int] = VIEW_SIZE
    views: int = 160
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"the method is {self.method!r}, wanted one of {', '.join(METHODS)}")
        for name in ("rounds", "steps", "passes", "views"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}, wanted 1 or more")
        if min(self.view_size) < 1:
            raise InputError(f"view_size is {self.view_size}, wanted pixels")
