"""Fit the splats of a level of detail: keep those that matter in renders, and adjust them to renders of the scene.

Views around the scene become smaller from level to level, so that a level is as good as it can be at the pixel size at
which it is shown. Work on a scene is bounded. In buckets of a larger scene, neighbouring splats are merged instead of
chosen, and adjusted with less work, proportional to the splats.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import covariance_entries, mean_axes
from csplat.errors import LimitError
from csplat.model import SplatModel
from csplat.scene_source import join_blocks
from csplat.types import F32, F64, I64, Progress, null_progress
from csplat_render.camera import Camera
from csplat_render.scorer import Scorer, renderer
from csplat_tools.views import HELD_OUT_COUNT, camera_sequence
from csplat_trainer.pruning import MeasuredViews, PruningOrder, total_error
from csplat_trainer.splat_refit import refit_splats

_PIXELS_PER_SPLAT = 8.0  # pixels of a view per splat of level 1; views of each coarser level are half as wide
_WIDTHS = (128, 640)  # pixels, the smallest and largest views of level 1
_LEAST_WIDTH = 64  # pixels, of the views of the coarsest levels
# Work is bounded so that a million splats take five minutes. On garden500k, less than half of it costs 2 dB at level 1.
_VIEWS = (40, 120)
_SPLATS_TO_MEASURE = 6e7  # views times splats of the finer level
_STEPS = (100, 800)
_SPLATS_TO_MOVE = 7.5e7  # steps times splats of the level
_CHECKS_EVERY = 4  # a held-out view for four others, up to `HELD_OUT_COUNT`

# Buckets of larger scenes: neighbours are merged, since few views of a bucket leave holes where they see nothing. In an
# aerial scene of 13.6 million splats, chosen in 40 views of each bucket, level 1 had 13 dB; merged, it has 22.4. The
# fit gains 1.3 dB on garden500k, and nothing there. A million splats take 50 CPU s.
_MERGED = 4  # splats that become one
_OPACITY_MAX = 0.99  # alpha that renderers cap at
_MERGED_VIEWS, _MERGED_STEPS = 16, 60  # a bucket takes 21 CPU s; 40, 100: 0.7 dB more on garden500k, four times as long


@dataclass(frozen=True)
class LevelFitter:
    """Fits levels of a scene.

    Attributes:
        scene: a scene or a part of one, in whose renders levels are measured.
        scene_count: number of splats of the whole scene.
        threads: number of threads; `None`: all. No result depends on it.
        progress: called with the stage and the completed fraction.
    """

    scene: SplatModel
    scene_count: int
    threads: int | None = None
    progress: Progress = null_progress

    def fit(self, finer: SplatModel, nodes: I64, count: int, level: int) -> tuple[I64, SplatModel]:
        """Choose or merge splats, and adjust them; merge them alone if there are too many in a view to be rendered.

        Args:
            finer: the next finer level.
            nodes: [N], the node to which each splat of `finer` goes.
            count: number of splats to keep, about a quarter; each node keeps one at least.
            level: the level, from 1; its views are 2^level times smaller than those of the scene.

        Returns:
            The node of each splat of the level, and the splats.
        """
        try:
            return self._fit(finer, nodes, count, level)
        except LimitError:
            return merge_by_node(finer, nodes)

    def _fit(self, finer: SplatModel, nodes: I64, count: int, level: int) -> tuple[I64, SplatModel]:
        used, check = self._cameras(len(finer), level)
        if self._merges:
            nodes, chosen = merge_by_node(finer, nodes)
        else:
            rows = self._choose(finer, nodes, count, used)
            nodes, chosen = nodes[rows], finer.select(rows)
        steps = _MERGED_STEPS if self._merges else _between(_SPLATS_TO_MOVE / len(chosen), _STEPS)
        draw = renderer(self.scene, (0.0, 0.0, 0.0), threads=self.threads)
        fitted = refit_splats(
            chosen, used, [draw(camera).rgb for camera in used], steps=steps, moves=True, threads=self.threads,
            progress=self.progress,
        )  # fmt: skip
        scorer = Scorer.of_source(self.scene, check, threads=self.threads)
        return nodes, fitted if scorer.psnr(fitted) >= scorer.psnr(chosen) else chosen

    @property
    def _merges(self) -> bool:
        return self.scene_count > len(self.scene)

    def _cameras(self, finer_count: int, level: int) -> tuple[list[Camera], list[Camera]]:
        """Return views for a level, and held-out ones."""
        widest = _between(math.sqrt(_PIXELS_PER_SPLAT * len(self.scene) / 3.0), _WIDTHS)
        width = max(_LEAST_WIDTH, widest >> (level - 1))
        views = _MERGED_VIEWS if self._merges else _between(_SPLATS_TO_MEASURE / finer_count, _VIEWS)
        checks = min(views // _CHECKS_EVERY, HELD_OUT_COUNT)
        cameras = camera_sequence(self.scene, views + checks, (width, width * 3 // 4))
        return cameras[checks:], cameras[:checks]

    def _choose(self, finer: SplatModel, nodes: I64, count: int, cameras: list[Camera]) -> I64:
        groups = [
            MeasuredViews.of(finer, part, (0.0, 0.0, 0.0), threads=self.threads, progress=self.progress)
            for part in (cameras[::2], cameras[1::2])
        ]
        # No view tells unseen splats apart: as many of them go, those of the least opacity times area.
        light = finer.opacities * areas(finer.scales)
        unseen = np.flatnonzero(~total_error(groups).seen)
        unseen = unseen[np.argsort(-light[unseen], kind="stable")]
        left = np.delete(np.arange(len(finer)), unseen[len(unseen) * count // len(finer) :])
        groups = [replace(group, pruning_error=group.pruning_error.of_rows(left)) for group in groups]
        order = PruningOrder(finer.select(left), groups, threads=self.threads, progress=self.progress)
        rows = left[order.kept(count)]
        by_node = np.lexsort((light, nodes))
        brightest = by_node[np.flatnonzero(np.diff(nodes[by_node], append=-1))]  # the last of each node
        return np.union1d(rows, brightest[~np.isin(nodes[brightest], nodes[rows])])


def merge_by_node(splats: SplatModel, nodes: I64) -> tuple[I64, SplatModel]:
    """Merge neighbours of the same node; return the node of each merged splat, and the splats."""
    order = np.argsort(nodes, kind="stable")
    found, starts = np.unique(nodes[order], return_index=True)
    merged = [merge_neighbours(splats.select(rows)) for rows in np.split(order, starts[1:])]
    return np.repeat(found, [len(part) for part in merged]), join_blocks(merged[0], merged)


def merge_neighbours(splats: SplatModel) -> SplatModel:
    """Merge groups of up to four neighbouring splats to one with the same mean, covariance and opacity × area.

    Sums weight each splat by opacity × area. Opacity is limited to 0.99; splats that grow instead, to keep the product,
    look up to 4 dB worse (fox60k_noreg).
    """
    groups = kd_groups(splats.means, math.ceil(len(splats) / _MERGED))
    order = np.concatenate(groups)
    starts = np.cumsum([0, *(len(rows) for rows in groups[:-1])])
    group = np.repeat(np.arange(len(groups)), [len(rows) for rows in groups])
    chosen = splats.select(order)
    light = chosen.opacities * areas(chosen.scales)
    weights = np.maximum(light, np.finfo(np.float64).tiny)
    weights = weights / np.add.reduceat(weights, starts)[group]

    def averaged(values: NDArray[np.floating]) -> F64:
        flat = values.reshape(len(values), -1).astype(np.float64)
        return np.add.reduceat(flat * weights[:, None], starts)

    means = averaged(chosen.means)
    offsets = (chosen.means - means[group]).T
    variances = np.exp(2.0 * chosen.scales.astype(np.float64)).T
    entries = covariance_entries(chosen.quats.T, variances)
    entries += np.stack([offsets[i] * offsets[j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))])
    covariances = averaged(entries.T).T
    trace = np.maximum(covariances[:3].sum(axis=0), np.finfo(np.float64).tiny)
    quats, scales = mean_axes(covariances / trace)
    scales = (scales + 0.5 * np.log(trace)[:, None]).astype(np.float32)
    opacities = np.add.reduceat(light, starts) / areas(scales)
    return replace(
        chosen.select(slice(0, len(groups))),
        means=means.astype(np.float32),
        quats=quats,
        scales=scales,
        opacities=np.minimum(opacities, _OPACITY_MAX).astype(np.float32),
        sh0=averaged(chosen.sh0).astype(np.float32),
        shN=averaged(chosen.shN).reshape(len(groups), *chosen.shN.shape[1:]).astype(np.float32),
        extra={},
        means_double=None,
    )


def kd_groups(points: F32, count: int) -> list[NDArray[np.intp]]:
    """Cut points at the medians of the longest sides of their boxes.

    Args:
        points: [N, 3].
        count: number of groups, 1 to N.

    Returns:
        Rows of each group, in spatial order; their numbers differ by 1 at most.
    """
    order = np.arange(len(points))
    sizes = np.array([len(points)], np.int64)  # points in each box
    counts = np.array([count], np.int64)  # groups in each box
    while counts.max() > 1:
        starts = np.cumsum(sizes) - sizes
        inside = points[order]
        sides = np.maximum.reduceat(inside, starts) - np.minimum.reduceat(inside, starts)
        box = np.repeat(np.arange(len(sizes)), sizes)
        along = inside[np.arange(len(points)), sides.argmax(axis=1)[box]]
        order = order[np.lexsort((along, box))]
        near = counts // 2
        splats = sizes * near // counts
        sizes = np.stack([splats, sizes - splats], axis=1).reshape(-1)
        counts = np.stack([near, counts - near], axis=1).reshape(-1)
        sizes, counts = sizes[counts > 0], counts[counts > 0]
    return np.split(order, np.cumsum(sizes)[:-1])


def areas(scales: F32) -> F64:
    """Return the areas of the projections of ellipsoids, averaged over directions, up to a factor (Knud Thomsen)."""
    a, b, c = np.exp(scales.astype(np.float64)).T
    return np.asarray((a * b + a * c + b * c) / 3.0)


def _between(value: float, bounds: tuple[int, int]) -> int:
    return round(min(max(value, bounds[0]), bounds[1]))
