# SPDX-License-Identifier: Apache-2.0
"""Fit the splats of a level of detail: keep splats that matter in renders, and refit them to renders of the scene.

Views around the scene become smaller from level to level, so that a level is as good as it can be at the pixel size at
which it is shown. In a part of a larger scene, splats are merged instead, and refitted together with a backdrop: a
few splats that stand for the rest of the scene. Work is bounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder import LevelCoding
from csplat.errors import LimitError
from csplat.model import SplatModel
from csplat.scene import join_blocks
from csplat.types import F16, I64, null_progress
from csplat_render.camera import Camera, resized
from csplat_render.scene_frame import scene_frame
from csplat_render.scorer import Scorer, renderer
from csplat_tools.level_merging import merge_neighbours
from csplat_tools.planned_progress import STEP_COST, PlannedWork, view_cost
from csplat_tools.views import HELD_OUT_COUNT, at_distance, camera_sequence, cameras_on_part
from csplat_trainer.merging import light_of
from csplat_trainer.pruning import ROUND_FRACTION, MeasuredViews, PruningOrder, total_error
from csplat_trainer.splat_refit import refit_splats

_PIXELS_PER_SPLAT = 8.0  # pixels of a view per splat of level 1; views of each coarser level are half as wide
#: Pixels, the smallest and largest views of level 1. Larger views take longer, and do not help at its pixel size.
_WIDTHS = (128, 448)
#: Pixels, of the views of the coarsest levels, which are a first picture, too. Views of 64 pixels would take 3 to 8 CPU
#: seconds less, and lose 0.5 and 2 dB in the two coarsest levels of twenty copies of garden500k.
_LEAST_WIDTH = 192
#: Factor of the largest distance of views in a surrounding scene, since coarse levels are seen from farther away.
#: Levels 1 and 2 of garden500k gain 0.7 and 1.2 dB at a distance of 1.3 extents, and lose 0.6 and 0.3 at 0.8.
_REACH = 1.5
#: Factor of the distance of every other view in a whole scene from level to level: coarse levels are seen from outside.
#: Level 3 of garden500k gains 2.5 dB in views from 16 extents, and loses 0.2 in the others.
_AWAY = 2.0
#: Factor for objects from level 3 on, whose views are outside already. Level 5 of ten million splats gains 1.6 dB in a
#: view from 2.2 extents, and loses nothing from 1.4. With it, level 2 of lego60k would lose 0.6 dB.
_OBJECT_AWAY = 2.0
_BACKDROP_SPLATS = 1 << 15  # largest number of splats of a backdrop
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


#: Work on the levels of a whole scene: 125 CPU s for a million splats. With half of it, level 1 is clearly worse.
SCENE_WORK = Work(8e7, (40, 160), 1.2e8, (100, 1600))
#: Work on the levels of a bucket, less than on a scene.
PART_WORK = Work(0.0, (80, 80), 3.2e7, (100, 400))


@dataclass(frozen=True)
class LevelFitter:
    """Fits levels of a scene.

    Attributes:
        scene: a scene or a part of a scene, in whose renders levels are measured.
        backdrop: splats that stand for the larger scene of which the scene is a part, see `make_backdrop`. Views
            look at the part, and neighbours are merged: choosing splats would take several times as many views. `None`:
            the scene is whole.
        work: how much is done.
        coding: how the file codes levels; splats are fitted around the SH that the file will have. `None`: unknown.
        context: threads and progress.
    """

    scene: SplatModel
    backdrop: SplatModel | None = None
    work: Work = SCENE_WORK
    coding: LevelCoding | None = None
    context: Context = DEFAULT_CONTEXT

    def fit(self, finer: SplatModel, nodes: I64, count: int, level: int) -> tuple[I64, SplatModel]:
        """Choose or merge splats, and refit them. Only merge them if a view has too many to be rendered.

        Args:
            finer: the next finer level; at level 1, the scene.
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
        views, width = self._view_count, self._width(level)
        rounds = math.ceil(math.log(count / finer_count) / math.log(ROUND_FRACTION))
        pixels, middle = 0.75 * width * width, 0.5 * (finer_count + count)
        stages = {
            "measuring splats": PlannedWork(views, view_cost(pixels, finer_count)),
            "ordering splats": PlannedWork(rounds, 0.5 * views * view_cost(pixels, middle)),
            "refitting splats": PlannedWork(self._steps(count), STEP_COST * view_cost(pixels, count)),
        }
        return {_named(stage, level): work for stage, work in stages.items()}

    def _fit(self, finer: SplatModel, nodes: I64, count: int, level: int) -> tuple[I64, SplatModel]:
        """Fit a level as `fit` does. The refit is discarded if it makes held-out views worse.

        Raises:
            LimitError: a view has too many splats to be rendered.
        """
        context = replace(self.context, progress=lambda stage, done: self.context.progress(_named(stage, level), done))
        width = self._width(level)
        cameras = [resized(camera, width, width * 3 // 4) for camera in self._views(level)]
        held_out, used = cameras[: -self._view_count], cameras[-self._view_count :]
        renders: list[F16] = []
        if self.backdrop is not None:
            nodes, chosen = merge_neighbours(finer, nodes, count)
        else:
            rows, renders = self._choose_rows(finer, nodes, count, used, context)
            nodes, chosen = nodes[rows], finer.select(rows)
        if self.coding is not None:
            chosen = self.coding.with_coded_sh(chosen)
        if not renders or level > 1:
            draw = renderer(self._source, (0.0, 0.0, 0.0), context=self.context)
            renders = [draw(camera).rgb.astype(np.float16) for camera in used]
        fitted = refit_splats(
            chosen, used, renders, steps=self._steps(len(chosen)), backdrop=self._rest, moves=True,
            context=context,
        )  # fmt: skip
        quiet = replace(self.context, progress=null_progress)
        scorer = Scorer.of_source(self._source, held_out, context=quiet)
        before, after = (scorer.psnr(self._with_rest(splats)) for splats in (chosen, fitted))
        return nodes, fitted if after >= before else chosen

    @cached_property
    def _rest(self) -> SplatModel | None:
        """The backdrop without the splats that stand for the part itself."""
        return None if self.backdrop is None else _without_part(self.backdrop, self.scene)

    @cached_property
    def _source(self) -> SplatModel:
        """The scene as views show it."""
        return self._with_rest(self.scene)

    def _with_rest(self, splats: SplatModel) -> SplatModel:
        """Return splats of a part, followed by the backdrop."""
        return splats if self._rest is None else join_blocks(splats, [splats, self._rest])

    @property
    def _view_count(self) -> int:
        """Number of views to fit to."""
        return _clip_rounded(self.work.splats_to_measure / len(self.scene), self.work.views)

    def _width(self, level: int) -> int:
        """Return the width of the views of a level, pixels."""
        widest = _clip_rounded(math.sqrt(_PIXELS_PER_SPLAT * len(self.scene) / 3.0), _WIDTHS)
        return max(_LEAST_WIDTH, widest >> (level - 1))

    def _steps(self, count: int) -> int:
        """Return the number of steps of the refit of a level of N splats."""
        return _clip_rounded(self.work.splats_to_move / count, self.work.steps)

    def _views(self, level: int) -> list[Camera]:
        """Return the views of a level, in the order of `_cameras`; of coarse levels, in part from farther away."""
        frame = scene_frame(self.scene)
        times = _AWAY ** (level - 1) if frame.kind == "surrounding" else _OBJECT_AWAY if level > 2 else 1.0
        if self.backdrop is not None or times == 1.0:
            return self._cameras
        return [
            at_distance(camera, frame.centre, times) if number % 2 else camera
            for number, camera in enumerate(self._cameras)
        ]  # fmt: skip

    @cached_property
    def _cameras(self) -> list[Camera]:
        """The views of level 1: `HELD_OUT_COUNT` or fewer held-out views, then those to fit to."""
        width = self._width(1)
        count, size = self._view_count + min(self._view_count // _CHECKS_EVERY, HELD_OUT_COUNT), (width, width * 3 // 4)
        if self.backdrop is not None:
            return cameras_on_part(self._source, self.scene, count, size, reach=_REACH)
        return camera_sequence(self.scene, count, size, reach=_REACH)

    @staticmethod
    def _choose_rows(
        finer: SplatModel, nodes: I64, count: int, cameras: list[Camera], context: Context
    ) -> tuple[I64, list[F16]]:
        """Choose about `count` splats that matter most in views, at least one by node.

        Args:
            finer: the splats to choose from.
            nodes: [N], the node of each splat.
            count: number of splats; more are chosen if nodes would have none.
            cameras: the views.
            context: threads and progress.

        Returns:
            Their ascending rows, int64, and renders of all splats in the views, [H, W, 3].
        """
        middle = len(cameras) // 2
        groups = [
            MeasuredViews.of(finer, part, (0.0, 0.0, 0.0), keep_renders=True, context=context)
            for part in (cameras[:middle], cameras[middle:])
        ]
        renders = [render for group in groups for render in group.renders]
        # No view tells unseen splats apart: the same fraction is kept, with the largest opacity times area.
        light = light_of(finer)
        unseen = np.flatnonzero(~total_error(groups).seen)
        unseen = unseen[np.argsort(-light[unseen], kind="stable")]
        remaining = np.delete(np.arange(len(finer)), unseen[len(unseen) * count // len(finer) :])
        groups = [MeasuredViews(group.cameras, group.pruning_error.of_rows(remaining)) for group in groups]
        order = PruningOrder(finer.select(remaining), groups, context=context)
        rows = remaining[order.kept(count)]
        by_node = np.lexsort((light, nodes))
        brightest = by_node[np.flatnonzero(np.diff(nodes[by_node], append=-1))]  # the last of each node
        return np.union1d(rows, brightest[~np.isin(nodes[brightest], nodes[rows])]), renders


def make_backdrop(sample: SplatModel, scene_count: int, most: int = _BACKDROP_SPLATS) -> SplatModel:
    """Return a few splats that stand for a scene, without SH, with which parts of it are fitted.

    They are chosen in proportion to opacity times area, and the smaller ones are enlarged, so that they cover about as
    much as the scene.

    Args:
        sample: an evenly spaced sample of the scene.
        scene_count: number of splats of the scene.
        most: largest number of splats to return.
    """
    light = light_of(sample)
    least = float(light.sum()) / most  # light from which on a splat is always chosen
    chances = np.minimum(light / least, 1.0)
    rows = np.flatnonzero(np.diff(np.floor(np.cumsum(chances) + 0.5), prepend=0.0))
    growth = np.maximum(least * scene_count / len(sample) / light[rows], 1.0)
    chosen = sample.select(rows)
    scales = (chosen.scales + 0.5 * np.log(growth)[:, None]).astype(np.float32)
    return replace(chosen, scales=scales, shN=chosen.shN[:, :0], extra={}, means_double=None)


def _without_part(backdrop: SplatModel, part: SplatModel) -> SplatModel:
    """Return the splats of a backdrop whose means no splat of a part has, with as many SH coefficients as the part."""
    kind = np.dtype([("", np.uint32)] * 3)  # a mean as one value that compares bit by bit
    own, all_means = (np.ascontiguousarray(splats.means).view(kind)[:, 0] for splats in (part, backdrop))
    chosen = backdrop.select(np.flatnonzero(~np.isin(all_means, own)))
    return replace(chosen, shN=np.zeros((len(chosen), *part.shN.shape[1:]), np.float32))


def _named(stage: str, level: int) -> str:
    """Return the name of a stage of fitting a level."""
    return f"{stage} of level {level}"


def _clip_rounded(value: float, bounds: tuple[int, int]) -> int:
    """Clip a number to bounds, and round it."""
    return round(min(max(value, bounds[0]), bounds[1]))
