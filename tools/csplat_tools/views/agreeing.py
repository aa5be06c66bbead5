"""How many views it takes to decide what is needed: more of them until they agree with those that were kept aside.

A choice fits the views that it was made with better than others. How far it does is known without a render of the
result: the predicted error of what is to go, on the views that chose it and on views that did not, has to be about the
same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.conventions import ALPHA_MIN
from csplat_render.removal import Removal, measure_removal
from csplat_tools.files.console import Progress
from csplat_tools.views import CHECKS, VIEW_SIZE, ViewSet, reduced

__all__ = ["AgreedViews", "find_views", "removal_keys"]

F64 = NDArray[np.float64]

_BATCH = 40  # virtual views that are added at a time
# dB between what is predicted for used views and for others, below which there are enough. Fits follow their views
# farther than choices do: at 1 dB lego60k stops at 40 views, and is 3 dB better on others with 160.
_AGREED = 0.1
_SETTLED = 0.005  # share of the splats that the check views alone show, below which there are enough


@dataclass(frozen=True, eq=False)
class AgreedViews:
    """Cameras that teach, others to check by, and what those that teach say.

    Attributes:
        used: they teach.
        check: they were kept aside.
        removal: of the source, measured from `used`.
        gap: dB by which the error that is predicted for the share that is to go is larger in `check` than in `used`.
    """

    used: list[Camera]
    check: list[Camera]
    removal: Removal
    gap: float


def find_views(
    model: SplatModel,
    views: ViewSet,
    gone: float,
    *,
    size: tuple[int, int] = VIEW_SIZE,
    threads: int | None = None,
    progress: Progress | None = None,
) -> AgreedViews:
    """Take as many of the teaching views as it needs, and measure the source from them.

    Args:
        model: the source.
        views: virtual ones are taken batch by batch until no new splats appear and they agree with some that are
            kept apart; of others all, and those that decide check.
        gone: share of the splats that is to go; what is predicted for it has to agree.
        size: of the pictures; the user's cameras keep their shape and are never enlarged.
        threads: how many; None for all.
        progress: is told how much is done.

    Raises:
        InputError: no view teaches, or none decides.
    """

    def measured(cameras: Sequence[Camera]) -> Removal:
        return measure_removal(
            model, cameras, background=views.background, bands=False, threads=threads, progress=progress
        )

    if not views.teaches or not views.decides:
        found = len(views.teaches) + len(views.decides)
        raise InputError(f"{found} cameras, wanted 2 at least: one that teaches, one that decides")
    every, check = reduced(views.teaches, size), reduced(views.decides, size)
    if views.virtual:
        # What was taught is to hold elsewhere; whether it does, views of the same kind say.
        every, check = _parted(every)
    checked = measured(check)
    count = min(_BATCH, len(every)) if views.virtual else len(every)
    removal = measured(every[:count])
    while count < len(every):
        missed = int(np.count_nonzero(checked.seen & ~removal.seen))
        if missed <= _SETTLED * len(model) and _gap(model, removal, checked, gone) < _AGREED:
            break
        removal += measured(every[count : count + _BATCH])
        count = min(count + _BATCH, len(every))
    return AgreedViews(every[:count], check, removal, _gap(model, removal, checked, gone))


def _parted(cameras: Sequence[Camera]) -> tuple[list[Camera], list[Camera]]:
    """Cameras to use, and some to check by.

    These are taken evenly from the whole sequence: its beginning is not spread as evenly as all of it.
    """
    count = min(CHECKS, len(cameras) - 1)
    aside = set(np.linspace(0, len(cameras) - 1, count + 2).astype(int)[1:-1].tolist())
    return [one for i, one in enumerate(cameras) if i not in aside], [cameras[i] for i in sorted(aside)]


def removal_keys(opacities: NDArray[np.float32], removal: Removal, *, keep_unseen: bool = True) -> F64:
    """By what splats go, the smallest first.

    Args:
        opacities: [N], of a scene.
        removal: of the same.
        keep_unseen: what no view saw goes last, instead of first.

    Returns:
        [N] float64: −1 where no picture can show a splat, its alpha being too small to be drawn; the error of its
        removal; infinity for what no view saw.
    """
    keys = np.where(removal.seen, removal.error, np.inf if keep_unseen else -0.5)
    keys[opacities < ALPHA_MIN] = -1.0
    return keys


def _gap(model: SplatModel, used: Removal, check: Removal, gone: float) -> float:
    """How much larger, in dB, the predicted error is where it was not looked at."""
    keys = removal_keys(model.opacities, used)
    order = np.argsort(keys, kind="stable")[: int(gone * len(model))]
    order = order[np.isfinite(keys[order])]
    there = float(np.sum(used.error[order])) / used.value_count
    elsewhere = float(np.sum(check.error[order])) / check.value_count
    return 10.0 * math.log10(elsewhere / there) if there > 0.0 and elsewhere > 0.0 else 0.0
