"""Fit the splats of a level of detail: keep those that matter in renders, and adjust them to renders of the scene.

Views around the scene become smaller from level to level, so that a level is as good as it can be at the pixel size at
which it is shown. Merging neighbours by their moments is 5 to 15 dB worse (suite `levels` of the benchmarks).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from csplat.model import SplatModel
from csplat.types import F32, F64, I64, Progress, null_progress
from csplat_render.camera import Camera
from csplat_render.scorer import Scorer, renderer
from csplat_tools.views import HELD_OUT_COUNT, camera_sequence
from csplat_trainer.pruning import MeasuredViews, PruningOrder, total_error
from csplat_trainer.splat_refit import refit_splats

_PIXELS_PER_SPLAT = 8.0  # pixels of a view per splat of level 1; views of each coarser level are half as wide
_WIDTHS = (128, 640)  # pixels, the smallest and largest views of level 1
_LEAST_WIDTH = 64
# Work is bounded so that a million splats take five minutes. On garden500k, less than half of it costs 2 dB at level 1.
_VIEWS = (40, 120)
_SPLATS_TO_MEASURE = 6e7  # views times splats of the finer level
_STEPS = (60, 800)
_SPLATS_TO_MOVE = 7.5e7  # steps times splats of the level


@dataclass(frozen=True)
class LevelFitter:
    """Fits levels of a scene.

    Attributes:
        scene: the scene, in whose renders levels are measured.
        progress: called with the stage and the completed fraction.
    """

    scene: SplatModel
    progress: Progress = null_progress

    def fit(self, finer: SplatModel, nodes: I64, count: int, level: int) -> tuple[I64, SplatModel]:
        """Choose and adjust splats.

        Args:
            finer: the next finer level.
            nodes: [N], the node to which each splat of `finer` goes.
            count: number of splats to keep; each node keeps one at least.
            level: the level, from 1; its views are 2^level times smaller than those of the scene.

        Returns:
            The ascending indices of the splats in `finer`, and the splats.
        """
        used, check = self._cameras(len(finer), level)
        rows = self._choose(finer, nodes, count, used)
        chosen = finer.select(rows)
        draw = renderer(self.scene, (0.0, 0.0, 0.0))
        fitted = refit_splats(
            chosen, used, [draw(camera).rgb for camera in used], steps=_between(_SPLATS_TO_MOVE / len(rows), _STEPS),
            moves=True, progress=self.progress,
        )  # fmt: skip
        scorer = Scorer.of_source(self.scene, check)
        return rows, fitted if scorer.psnr(fitted) >= scorer.psnr(chosen) else chosen

    def _cameras(self, finer_count: int, level: int) -> tuple[list[Camera], list[Camera]]:
        """Return views for a level, and held-out ones."""
        widest = _between(math.sqrt(_PIXELS_PER_SPLAT * len(self.scene) / 3.0), _WIDTHS)
        width = max(_LEAST_WIDTH, widest >> (level - 1))
        views = _between(_SPLATS_TO_MEASURE / finer_count, _VIEWS)
        cameras = camera_sequence(self.scene, views + HELD_OUT_COUNT, (width, width * 3 // 4))
        return cameras[HELD_OUT_COUNT:], cameras[:HELD_OUT_COUNT]

    def _choose(self, finer: SplatModel, nodes: I64, count: int, cameras: list[Camera]) -> I64:
        groups = [
            MeasuredViews.of(finer, part, (0.0, 0.0, 0.0), progress=self.progress)
            for part in (cameras[::2], cameras[1::2])
        ]
        # No view tells unseen splats apart: as many of them go, those of the least opacity times area.
        light = finer.opacities * areas(finer.scales)
        unseen = np.flatnonzero(~total_error(groups).seen)
        unseen = unseen[np.argsort(-light[unseen], kind="stable")]
        left = np.delete(np.arange(len(finer)), unseen[len(unseen) * count // len(finer) :])
        groups = [replace(group, pruning_error=group.pruning_error.of_rows(left)) for group in groups]
        rows = left[PruningOrder(finer.select(left), groups, progress=self.progress).kept(count)]
        by_node = np.lexsort((light, nodes))
        brightest = by_node[np.flatnonzero(np.diff(nodes[by_node], append=-1))]  # the last of each node
        return np.union1d(rows, brightest[~np.isin(nodes[brightest], nodes[rows])])


def areas(scales: F32) -> F64:
    """Return the areas of the projections of ellipsoids, averaged over directions, up to a factor (Knud Thomsen)."""
    a, b, c = np.exp(scales.astype(np.float64)).T
    return np.asarray((a * b + a * c + b * c) / 3.0)


def _between(value: float, bounds: tuple[int, int]) -> int:
    return round(min(max(value, bounds[0]), bounds[1]))
