"""Fit the splats of a level of detail: keep splats that matter in renders, and refit them to renders of the scene.

Views around the scene become smaller from level to level, so that a level is as good as it can be at the pixel size at
which it is shown. Parts of a larger scene are seen from outside, as their coarse versions will be, and their splats are
merged. Work is bounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import LimitError
from csplat.model import SplatModel
from csplat.types import I64, null_progress
from csplat_render.camera import Camera
from csplat_render.scorer import Scorer, renderer
from csplat_tools.level_merging import light_of, merge_neighbours
from csplat_tools.planned_progress import STEP_COST, PlannedWork, view_cost
from csplat_tools.views import HELD_OUT_COUNT, camera_sequence, cameras_outside
from csplat_trainer.pruning import MeasuredViews, PruningOrder, total_error
from csplat_trainer.splat_refit import refit_splats

_PIXELS_PER_SPLAT = 8.0  # pixels of a view per splat of level 1; views of each coarser level are half as wide
#: Pixels, the smallest and largest views of level 1. Larger views take longer, and do not help at its pixel size.
_WIDTHS = (128, 448)
_LEAST_WIDTH = 64  # pixels, of the views of the coarsest levels
_ROUNDS = 6  # rounds of the order of pruning to a quarter
_CHECKS_EVERY = 4  # a held-out view for four others, up to `HELD_OUT_COUNT`


@dataclass(frozen=True)
class Work:
    """Bounds of the work on each level.

    Attributes:
        splats_to_measure: number of views times splats of the finer level, within the bounds of views.
        views: least and largest number of views.
        splats_to_move: number of steps times splats of the level, within the bounds of steps.
        steps: least and largest number of steps.
    """

    splats_to_measure: float
    views: tuple[int, int]
    splats_to_move: float
    steps: tuple[int, int]


#: Work on the levels of a whole scene. With half of it, levels 1 and 2 are clearly worse.
SCENE_WORK = Work(6e7, (40, 120), 7.5e7, (100, 1600))
#: Work on the levels of a bucket, less than on a scene. More views hardly help; coarser levels need more steps.
PART_WORK = Work(0.0, (16, 16), 6e6, (60, 240))


@dataclass(frozen=True)
class LevelFitter:
    """Fits levels of a scene.

    Attributes:
        scene: a scene or a part of a scene, in whose renders levels are measured.
        is_part: it is a part or a coarse version of a larger scene: views are from outside, and neighbours are merged.
            Choosing splats would leave holes where no view sees anything. Views as of whole scenes suit some scenes,
            and make the levels of others worse.
        work: how much is done.
        context: threads and progress.
    """

    scene: SplatModel
    is_part: bool = False
    work: Work = SCENE_WORK
    context: Context = DEFAULT_CONTEXT

    def fit(self, finer: SplatModel, nodes: I64, count: int, level: int) -> tuple[I64, SplatModel]:
        """Choose or merge splats, and refit them. Only merge them if a view has too many to be rendered.

        Args:
            finer: the next finer level.
            nodes: [N], the node to which each splat of `finer` goes.
            count: number of splats to keep, about a quarter; each node keeps at least one.
            level: the level, from 1; its views are 2^level times smaller than views of the scene.

        Returns:
            The node of each splat of the level, and the splats.
        """
        try:
            return self._fit(finer, nodes, count, level)
        except LimitError:
            return merge_neighbours(finer, nodes, count)

    def plan(self, finer_count: int, count: int, level: int) -> dict[str, PlannedWork]:
        """Return the expected work on a level by stage, for `PlannedProgress`; arguments as for `fit`."""
        views, width = self._views(finer_count, level)
        pixels, middle = 0.75 * width * width, 0.5 * (finer_count + count)
        stages = {
            "measuring splats": PlannedWork(views, view_cost(pixels, finer_count)),
            "ordering splats": PlannedWork(_ROUNDS, 0.5 * views * view_cost(pixels, middle)),
            "refitting splats": PlannedWork(self._steps(count), STEP_COST * view_cost(pixels, count)),
        }
        return {_named(stage, level): work for stage, work in stages.items()}

    def _fit(self, finer: SplatModel, nodes: I64, count: int, level: int) -> tuple[I64, SplatModel]:
        """Fit a level as `fit` does. The refit is discarded if it makes held-out views worse.

        Raises:
            LimitError: a view has too many splats to be rendered.
        """
        context = replace(self.context, progress=lambda stage, done: self.context.progress(_named(stage, level), done))
        used, check = self._cameras(len(finer), level)
        if self.is_part:
            nodes, chosen = merge_neighbours(finer, nodes, count)
        else:
            rows = self._choose_rows(finer, nodes, count, used, context)
            nodes, chosen = nodes[rows], finer.select(rows)
        steps = self._steps(len(chosen))
        draw = renderer(self.scene, (0.0, 0.0, 0.0), context=self.context)
        renders = [draw(camera).rgb for camera in used]
        fitted = refit_splats(chosen, used, renders, steps=steps, moves=True, context=context)
        scorer = Scorer.of_source(self.scene, check, context=replace(self.context, progress=null_progress))
        return nodes, fitted if scorer.psnr(fitted) >= scorer.psnr(chosen) else chosen

    def _cameras(self, finer_count: int, level: int) -> tuple[list[Camera], list[Camera]]:
        """Return views for a level, half as wide for each coarser one, and `HELD_OUT_COUNT` or fewer held-out views."""
        views, width = self._views(finer_count, level)
        checks = min(views // _CHECKS_EVERY, HELD_OUT_COUNT)
        place = cameras_outside if self.is_part else camera_sequence
        cameras = place(self.scene, views + checks, (width, width * 3 // 4))
        return cameras[checks:], cameras[:checks]

    def _views(self, finer_count: int, level: int) -> tuple[int, int]:
        """Return the number of views for a level, and their width in pixels."""
        widest = _clip_rounded(math.sqrt(_PIXELS_PER_SPLAT * len(self.scene) / 3.0), _WIDTHS)
        views = _clip_rounded(self.work.splats_to_measure / finer_count, self.work.views)
        return views, max(_LEAST_WIDTH, widest >> (level - 1))

    def _steps(self, count: int) -> int:
        """Return the number of steps of the refit of a level of N splats."""
        return _clip_rounded(self.work.splats_to_move / count, self.work.steps)

    @staticmethod
    def _choose_rows(finer: SplatModel, nodes: I64, count: int, cameras: list[Camera], context: Context) -> I64:
        """Return the ascending rows, int64, of about `count` splats that matter most in views, at least one by node.

        Args:
            finer: the splats to choose from.
            nodes: [N], the node of each splat.
            count: number of splats; more are chosen if nodes would have none.
            cameras: the views.
            context: threads and progress.
        """
        groups = [
            MeasuredViews.of(finer, part, (0.0, 0.0, 0.0), context=context) for part in (cameras[::2], cameras[1::2])
        ]
        # No view tells unseen splats apart: the same fraction is kept, with the largest opacity times area.
        light = light_of(finer)
        unseen = np.flatnonzero(~total_error(groups).seen)
        unseen = unseen[np.argsort(-light[unseen], kind="stable")]
        remaining = np.delete(np.arange(len(finer)), unseen[len(unseen) * count // len(finer) :])
        groups = [replace(group, pruning_error=group.pruning_error.of_rows(remaining)) for group in groups]
        order = PruningOrder(finer.select(remaining), groups, context=context)
        rows = remaining[order.kept(count)]
        by_node = np.lexsort((light, nodes))
        brightest = by_node[np.flatnonzero(np.diff(nodes[by_node], append=-1))]  # the last of each node
        return np.union1d(rows, brightest[~np.isin(nodes[brightest], nodes[rows])])


def _named(stage: str, level: int) -> str:
    """Return the name of a stage of fitting a level."""
    return f"{stage} of level {level}"


def _clip_rounded(value: float, bounds: tuple[int, int]) -> int:
    """Clip a number to bounds, and round it."""
    return round(min(max(value, bounds[0]), bounds[1]))
