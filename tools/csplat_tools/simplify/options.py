"""What is asked of a simplification, and how it goes about it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from csplat.errors import InputError
from csplat_tools.views import VIEW_SIZE

__all__ = ["METHODS", "SimplifyOptions", "Target"]

#: By what splats are chosen: exact errors measured anew after each round; once; and two that look at no picture.
METHODS = ("rounds", "exact", "opacity", "opacity-area")


@dataclass(frozen=True)
class Target:
    """When to stop; exactly one is given.

    Attributes:
        keep: share of the splats that stay, above 0, at most 1.
        psnr: dB of the result against the source's renders, in the views that decide.
        max_loss: dB that PSNR against photographs may fall, in the views that decide.

    Raises:
        InputError: none or several are given, or one is out of range.
    """

    keep: float | None = None
    psnr: float | None = None
    max_loss: float | None = None

    def __post_init__(self) -> None:
        given = [name for name in ("keep", "psnr", "max_loss") if getattr(self, name) is not None]
        if len(given) != 1:
            raise InputError(f"{len(given)} targets, wanted one of keep, psnr and max_loss")
        if self.keep is not None and not 0.0 < self.keep <= 1.0:
            raise InputError(f"keep is {self.keep:g}, wanted a share above 0, at most 1")
        if self.psnr is not None and not 0.0 < self.psnr <= 99.0:
            raise InputError(f"the target PSNR is {self.psnr:g} dB, wanted above 0, at most 99")
        if self.max_loss is not None and not (math.isfinite(self.max_loss) and self.max_loss > 0.0):
            raise InputError(f"the largest loss is {self.max_loss:g} dB, wanted above 0")

    def count(self, splats: int) -> int:
        """How many of so many splats stay, one at least; for `keep`."""
        assert self.keep is not None
        return max(1, round(self.keep * splats))


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
