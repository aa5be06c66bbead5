"""Find how many views a choice of splats needs: views are added until they agree with held-out ones.

A choice of splats to prune suits the views that it was made with better than others. By how much is known without
rendering the result: the predicted error of the pruned splats has to be about the same on the views that chose them
and on held-out views.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F64, Progress
from csplat_render import Camera
from csplat_render.conventions import ALPHA_MIN
from csplat_render.pruning_error import PruningError, measure_pruning_error
from csplat_tools.views import HELD_OUT_COUNT, VIEW_SIZE, ViewSet, shrink_cameras

_BATCH = 40  # virtual views that are added at a time
# dB between the errors predicted for used and for held-out views, below which there are enough views. Fits overfit
# their views more than choices do: at 1 dB lego60k stops at 40 views, and is 3 dB better on others with 160.
_GAP_MAX = 0.1
_MISSED_MAX = 0.005  # fraction of the splats that only the held-out views show, below which there are enough views


@dataclass(frozen=True, eq=False)
class SufficientViews:
    """Training views, held-out views, and the pruning errors of a source.

    Attributes:
        used: the training views.
        check: the held-out views.
        pruning_error: pruning errors of the source, measured from `used`.
        gap: dB by which the error predicted for the splats to be pruned is larger in `check` than in `used`.
    """

    used: list[Camera]
    check: list[Camera]
    pruning_error: PruningError
    gap: float


def find_sufficient_views(
    model: SplatModel,
    views: ViewSet,
    pruned: float,
    *,
    size: tuple[int, int] = VIEW_SIZE,
    threads: int | None = None,
    progress: Progress | None = None,
) -> SufficientViews:
    """Add training views until there are enough, and measure the pruning errors of the source from them.

    Args:
        model: the source.
        views: virtual training views are taken batch by batch until no new splats appear and they agree with some that
            are held out; of other views all are taken, and validation views are the held-out ones.
        pruned: fraction of the splats to be pruned, whose predicted errors have to agree.
        size: width and height of the renders, pixels; the user's cameras keep their aspect ratio and are never
            enlarged.
        threads: number of threads; None for all.
        progress: progress callback.

    Raises:
        InputError: there are no training or no validation views.
    """

    def measure(cameras: Sequence[Camera]) -> PruningError:
        return measure_pruning_error(
            model, cameras, background=views.background, bands=False, threads=threads, progress=progress
        )

    if not views.training or not views.validation:
        found = len(views.training) + len(views.validation)
        raise InputError(f"{found} cameras, wanted 2 at least: one for training, one for validation")
    every, check = shrink_cameras(views.training, size), shrink_cameras(views.validation, size)
    if views.virtual:
        # A choice has to be good on other views, too; this is checked on views of the same kind.
        every, check = _hold_out(every)
    check_errors = measure(check)
    count = min(_BATCH, len(every)) if views.virtual else len(every)
    pruning_error = measure(every[:count])
    while count < len(every):
        missed = int(np.count_nonzero(check_errors.seen & ~pruning_error.seen))
        if missed <= _MISSED_MAX * len(model) and _gap(model, pruning_error, check_errors, pruned) < _GAP_MAX:
            break
        pruning_error += measure(every[count : count + _BATCH])
        count = min(count + _BATCH, len(every))
    return SufficientViews(every[:count], check, pruning_error, _gap(model, pruning_error, check_errors, pruned))


def pruning_keys(opacities: NDArray[np.float32], pruning_error: PruningError, *, keep_unseen: bool = True) -> F64:
    """Return the keys by which splats are pruned, the smallest first.

    Args:
        opacities: [N], opacities of a scene.
        pruning_error: its pruning errors.
        keep_unseen: prune splats that no view saw last, instead of first.

    Returns:
        [N] float64: −1 for a splat whose alpha is too small to be drawn; infinity, or −0.5 without `keep_unseen`, for
        one that no view saw; else the error of pruning it.
    """
    keys = np.where(pruning_error.seen, pruning_error.error, np.inf if keep_unseen else -0.5)
    keys[opacities < ALPHA_MIN] = -1.0
    return keys


def _hold_out(cameras: Sequence[Camera]) -> tuple[list[Camera], list[Camera]]:
    """Split cameras into those to use, and some to hold out.

    The latter are taken evenly from the whole sequence: its beginning is not spread as evenly as all of it.
    """
    count = min(HELD_OUT_COUNT, len(cameras) - 1)
    held_out = set(np.linspace(0, len(cameras) - 1, count + 2).astype(int)[1:-1].tolist())
    return [one for i, one in enumerate(cameras) if i not in held_out], [cameras[i] for i in sorted(held_out)]


def _gap(model: SplatModel, used: PruningError, check: PruningError, pruned: float) -> float:
    """Return by how many dB the predicted error of the splats to be pruned is larger in held-out views."""
    keys = pruning_keys(model.opacities, used)
    order = np.argsort(keys, kind="stable")[: int(pruned * len(model))]
    order = order[np.isfinite(keys[order])]
    there = float(np.sum(used.error[order])) / used.value_count
    elsewhere = float(np.sum(check.error[order])) / check.value_count
    return 10.0 * math.log10(elsewhere / there) if there > 0.0 and elsewhere > 0.0 else 0.0
