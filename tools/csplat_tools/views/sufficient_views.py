# SPDX-License-Identifier: Apache-2.0
"""Find how many views are needed to choose splats: views are added until they agree with held-out views.

A choice of splats to prune overfits its views. This can be measured without rendering the result: the predicted error
of the pruned splats should be about the same in the views that chose them and in held-out views.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.pruning_error import PruningError
from csplat_tools.views import HELD_OUT_COUNT, VIEW_SIZE, ViewSet, shrink_cameras
from csplat_trainer.pruning import MeasuredViews, pruning_keys, total_error

_BATCH = 40  # virtual views added at a time
# Views suffice if the errors predicted for used and held-out views differ by less, dB. Refits overfit more than choices
# do, so the difference has to be small.
_GAP_MAX = 0.1
_PRUNED = 0.5  # fraction of the splats to prune, for these errors
_MISSED_MAX = 0.005  # fraction of the splats; views suffice if only held-out views show fewer


@dataclass(frozen=True, eq=False)
class SufficientViews:
    """Training views, held-out views, and the pruning errors of a source.

    Attributes:
        batches: the training views, with pruning errors and renders of the source.
        check: the held-out views, likewise.
        gap: dB by which the predicted error of the splats to prune is larger in `check` than in the training views.
    """

    batches: list[MeasuredViews]
    check: MeasuredViews
    gap: float

    @property
    def used(self) -> list[Camera]:
        """The training views."""
        return [camera for batch in self.batches for camera in batch.cameras]


def find_sufficient_views(
    model: SplatModel,
    views: ViewSet,
    *,
    size: tuple[int, int] = VIEW_SIZE,
    context: Context = DEFAULT_CONTEXT,
) -> SufficientViews:
    """Add training views until they suffice, and measure the pruning errors of the source in them.

    Args:
        model: the source.
        views: the views. Virtual training views are added batch by batch until they show all splats and agree with some
            held-out views. Other training views are all used, with the validation views as held-out views.
        size: width and height of the renders, pixels; the user's cameras keep their aspect ratio and are never
            enlarged.
        context: threads and progress.

    Raises:
        InputError: there are no training or no validation views.
    """

    def measure(cameras: Sequence[Camera]) -> MeasuredViews:
        """Measure pruning errors in views, and keep their renders."""
        return MeasuredViews.of(model, cameras, views.background, keep_renders=True, context=context)

    if not views.training or not views.validation:
        count = len(views.training) + len(views.validation)
        raise InputError(f"{count} cameras, expected at least 2: one for training, one for validation")
    every, check = shrink_cameras(views.training, size), shrink_cameras(views.validation, size)
    if views.virtual:
        every, check = _hold_out(every)  # views of the same kind
    held_out = measure(check)
    check_errors = held_out.pruning_error
    count = min(_BATCH, len(every)) if views.virtual else len(every)
    batches = [measure(every[:count])]
    while count < len(every):
        total = total_error(batches)
        missed = int(np.count_nonzero(check_errors.seen & ~total.seen))
        if missed <= _MISSED_MAX * len(model) and _gap(model, total, check_errors) < _GAP_MAX:
            break
        batches.append(measure(every[count : count + _BATCH]))
        count = min(count + _BATCH, len(every))
    return SufficientViews(batches, held_out, _gap(model, total_error(batches), check_errors))


def _hold_out(cameras: Sequence[Camera]) -> tuple[list[Camera], list[Camera]]:
    """Split cameras into used and held-out cameras. These are evenly spaced, since only the whole sequence is even."""
    count = min(HELD_OUT_COUNT, len(cameras) - 1)
    held_out = set(np.linspace(0, len(cameras) - 1, count + 2).astype(int)[1:-1].tolist())
    return [camera for i, camera in enumerate(cameras) if i not in held_out], [cameras[i] for i in sorted(held_out)]


def _gap(model: SplatModel, used: PruningError, check: PruningError) -> float:
    """Return by how many dB the predicted error of the splats to prune is larger in held-out views than in used views.

    It is per value of a render, and 0 if either error is 0.
    """
    keys = pruning_keys(model.opacities, used)
    order = np.argsort(keys, kind="stable")[: int(_PRUNED * len(model))]
    order = order[np.isfinite(keys[order])]
    in_used = float(np.sum(used.error[order])) / used.value_count
    in_check = float(np.sum(check.error[order])) / check.value_count
    return 10.0 * math.log10(in_check / in_used) if in_used > 0.0 and in_check > 0.0 else 0.0
