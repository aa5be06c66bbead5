# SPDX-License-Identifier: Apache-2.0
"""Measure how much renders depend on each splat, for `csplat sensitivity`, tuning and quantisation classes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder import Importance, apply_weight_floor
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import null_progress
from csplat_render import Camera
from csplat_render.pruning_error import measure_pruning_error
from csplat_tools.file_streams import open_output
from csplat_tools.views import Colour, ViewSet, evenly_spaced
from csplat_tools.views.sufficient_views import find_sufficient_views
from csplat_trainer.sensitivity import Sensitivity, measure_sensitivity
from csplat_trainer.sensitivity_file import GROUPS, StoredSensitivity, write_sensitivity

_NOTHING = "a scene without splats has no sensitivities"
_VIEWS = (40, 80)  # number of views that suffice: of given cameras, and of small virtual views
MANY_SPLATS = 150_000  #: of more splats, half of the views show enough, and take long enough


@dataclass(frozen=True, eq=False)
class SceneSensitivity:
    """The sensitivities of a scene.

    Attributes:
        model: the scene.
        found: the sensitivities by splat.
        source: kind of the views, see `sensitivity_file.SOURCES`.
        missed_share: fraction of the splats that only held-out views saw; NaN if none were held out.
    """

    model: SplatModel
    found: Sensitivity
    source: str
    missed_share: float

    def write(self, path: str) -> None:
        """Write the file, whole or not at all."""
        with open_output(path) as stream:
            write_sensitivity(stream, self.model, self.found, self.source, self.missed_share)

    def as_json(self) -> dict[str, Any]:
        """Return counts, fractions, and quantiles of every group as JSON-compatible values."""
        at = (0.0, 0.5, 0.9, 0.99, 1.0)
        return {
            "splats": len(self.model),
            "views": self.found.view_count,
            "pixels": self.found.pixel_count,
            "source": self.source,
            "unseen": int(np.count_nonzero(~self.found.seen)),
            "unseen_share": self.found.unseen_share,
            "missed_share": None if np.isnan(self.missed_share) else self.missed_share,
            "quantiles": {
                name: {str(q): float(np.quantile(getattr(self.found, name), q)) for q in at} if len(self.model) else {}
                for name in GROUPS
            },
        }


def measure_scene(
    model: SplatModel,
    views: ViewSet,
    *,
    matrices: bool = True,
    context: Context = DEFAULT_CONTEXT,
) -> SceneSensitivity:
    """Measure the sensitivities of a scene in all training views, or in sufficiently many virtual views.

    Args:
        model: the scene.
        views: the views. Without training views, the test views are used.
        matrices, context: as for `measure_views`.

    Raises:
        InputError: there are no splats, or no views, or they show no splat.
    """
    if not len(model):
        raise InputError(_NOTHING)
    views.require_fit()
    cameras, check, source = (
        views.training or views.test,
        list[Camera](),
        "training" if views.images else "cameras",
    )
    if views.virtual and views.training:
        size = (views.training[0].W, views.training[0].H)
        sufficient = find_sufficient_views(model, views, size=size, context=context)
        cameras, check, source = sufficient.used, [*sufficient.check.cameras], "virtual"
    measured = measure_views(model, cameras, views.background, matrices=matrices, context=context)
    missed = float("nan")
    if check:
        quiet = replace(context, progress=null_progress)
        elsewhere = measure_pruning_error(model, check, background=views.background, context=quiet).seen
        missed = float(np.mean(elsewhere & ~measured.seen))
    return SceneSensitivity(model, measured, source, missed)


def measure_views(
    model: SplatModel,
    cameras: Sequence[Camera],
    background: Colour,
    *,
    matrices: bool,
    magnitudes: bool = True,
    context: Context = DEFAULT_CONTEXT,
) -> Sensitivity:
    """Measure the sensitivities of a scene in given views.

    Args:
        model: the scene.
        cameras: the views, relative to the scene's origin.
        background: background colour.
        matrices: measure the matrices of SH coefficients, too.
        magnitudes: measure gradient magnitudes, too; weights are made from squares.
        context: threads and progress.

    Raises:
        InputError: there are no splats, or no view shows any.
    """
    if not len(model):
        raise InputError(_NOTHING)
    sensitivity = measure_sensitivity(
        model, cameras, background=background, metric=matrices, magnitudes=magnitudes, context=context
    )
    if not sensitivity.seen.any():
        raise InputError("no view shows any splat: check that the cameras belong to the scene")
    return sensitivity


def measure_importance(
    model: SplatModel,
    cameras: Sequence[Camera],
    background: Colour,
    *,
    matrices: bool = False,
    context: Context = DEFAULT_CONTEXT,
) -> Importance:
    """Measure the importance for the encoder: SH weights, bounded below by opacity and size, and Gauss–Newton blocks.

    Args:
        model, cameras, background, context: as for `measure_views`.
        matrices: measure the directions in which splats are seen, too, onto which dropped SH bands are projected.

    Raises:
        InputError: as for `measure_views`.
    """
    sensitivity = measure_views(model, cameras, background, matrices=matrices, magnitudes=False, context=context)
    weights = StoredSensitivity.of(model, sensitivity).importance()
    return replace(weights, sh=apply_weight_floor(weights.sh, model))


def importance_views(views: ViewSet, splats: int) -> Sequence[Camera]:
    """Return the training views in which the importance of N splats is measured.

    Virtual training views have various distances and directions. Cameras like the test views generalise less. With
    quantisation classes from 40 of them, plane3 has 42 dB on them and 39 on others. From these views, it has 41 and 40.
    """
    count = _VIEWS[views.virtual]
    return evenly_spaced(views.training, count // 2 if splats > MANY_SPLATS else count)
