# SPDX-License-Identifier: Apache-2.0
"""Build the levels of detail of a scene of any size.

Space is cut by medians into leaves of equal numbers of splats. Four nodes have one parent. Above the node that all
leaves have in common, a chain of nodes goes on to a few thousand splats. Each level has a quarter of the splats of the
next finer level, and the root has as many as it may: the splats that matter most, fitted to renders
(`level_fitting.py`). Larger scenes are built bucket by bucket from merged neighbours, until each bucket is one node.
These nodes together are the scene whose levels are built next, as those of a small scene. If a scene has levels
already, in streamed SOG, these are taken instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import csplat
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder import (
    BUCKET_SPLATS,
    EncodedTiles,
    EncodeOptions,
    EncodePlan,
    FileCodebooks,
    LevelCoding,
    LevelNode,
    bucket_rows,
    encode_levels,
    sample_rows,
)
from csplat.errors import InputError
from csplat.formats.sog.sog_reader import read_leaf_numbers
from csplat.model import SplatModel
from csplat.scene import join_blocks
from csplat.types import F32, I64, null_progress
from csplat_render.kernels import thread_count
from csplat_tools.optional_packages import require_renderer
from csplat_tools.planned_progress import Plan, PlannedProgress, PlannedWork

# Modules that render are imported where they are used: the cost of levels can be estimated without them.

_KEPT = 4  # splats of a level, divided by the splats of the next coarser level
_CHILDREN = 4  # maximum number of children of a node, so that nodes of all levels have about as many splats
# CPU seconds to fit levels of a scene of a million splats in one piece and measure their errors, the power of its size
# that they grow with, since the work on a level is bounded, and the fraction that threads do not share. Four scenes of
# 60,000 to 1,136,356 splats of SH degree 3 took 0.8 to 1.1 times of it.
_SECONDS_WHOLE, _WHOLE_EXPONENT, _SERIAL = 235.0, 0.55, 0.25
# CPU seconds per splat for levels of buckets, fitted, and of any scene, merged, of which threads share hardly anything.
_SECONDS_FITTED, _SECONDS_MERGED = 9e-5, 2.4e-5
# Costs of each report for a splat, in the unit of plans: of buckets, of merging, and of coding and measuring levels.
_BUILDING_COST, _MERGING_COST, _CODING_COST = 8000.0, 500.0, 100.0
_MERGING = "merging splats of level {}"  # name of a stage
_QUICK_NEIGHBOURS = 4  # without a fit; 8 gain 0 to 0.4 dB at level 1 (lego60k, garden500k)
#: Of scenes that are built bucket by bucket, except the largest, whose upper levels would be too large to be built at
#: once: with it, the index of 10 million splats has 56 kB instead of 114 kB.
_LARGE_LEAF_SPLATS = 1 << 15
_ROUNDING = 1e-9  # more than the rounding error of a logarithm, so that an exact power needs no further level

#: A function that makes the splats of a level, and the node of each. Its arguments are as for `LevelFitter.fit`.
_Fit = Callable[[SplatModel, I64, int, int], tuple[I64, SplatModel]]


#: Largest number of levels to ask for: 4^16 splats are more than a scene can have.
LEVELS_MAX = 16

LevelCount = int | Literal["auto", "merged"] | None


@dataclass(frozen=True)
class FittedLevelBuilder:
    """Builds levels of detail of a scene by fitting them to renders (`csplat.encoder.levels.LevelBuilder`).

    Attributes:
        count: number of levels above 0; `None`: until one node has `root_splats`.
        leaf_splats: maximum number of splats of a leaf; smaller leaves take more bytes, also of the index, which comes
            before the first picture, and larger leaves load later when they are seen.
        root_splats: maximum number of splats of the root, the first picture of a scene; 4,096 are about 25 kB.
        whole_splats: number of splats up to which a scene is built in one piece, with more work and a better level 1.
        fitted_splats: number of splats of a scene up to which levels of buckets are fitted to renders. In larger
            scenes, neighbours are only merged. On two cores, 10 million splats of SH degree 3 take 9 minutes with the
            fit, so that 40 million would take about 40.
        fits: levels are fitted to renders; otherwise, neighbours are only merged in scenes of any size.
        bucket_splats: see `EncodeOptions`.
        nodes: nodes of the scene, which are taken instead.
        backdrop: splats that stand for the scene of the buckets, if their levels are fitted; see `make_backdrop`.
    """

    count: int | None = None
    leaf_splats: int = 1 << 14
    root_splats: int = 1 << 12
    whole_splats: int = 2_000_000
    fitted_splats: int = 40_000_000
    fits: bool = True
    bucket_splats: int = BUCKET_SPLATS
    nodes: Sequence[LevelNode] | None = None
    backdrop: SplatModel | None = field(default=None, compare=False, repr=False)

    def settings(self, count: int) -> dict[str, Any]:
        """Return what the OPTS chunk of a scene of `count` splats states."""
        if self.nodes is not None:
            return {"splats": "of the source"}
        size = {"root_splats": self.root_splats} if self.count is None else {"count": self.count}
        made = "fitted" if self._is_fitted(count) else "merged"
        return {"splats": made, "leaf_splats": self.leaf_splats, **size}

    def seconds(self, count: int, workers: int) -> float:
        """Return the approximate time for the levels of a scene of `count` splats, as in `LevelBuilder`."""
        is_fitted = self._is_fitted(count)
        if count > self.whole_splats:
            return count * (_SECONDS_FITTED if is_fitted else _SECONDS_MERGED) / workers
        if not is_fitted:
            return count * _SECONDS_MERGED
        return _SECONDS_WHOLE * math.pow(count / 1e6, _WHOLE_EXPONENT) * (_SERIAL + (1.0 - _SERIAL) / workers)

    def _is_fitted(self, count: int) -> bool:
        """Return True if the levels of a scene of `count` splats, or of its buckets, are fitted to renders."""
        return self.fits and count <= max(self.whole_splats, self.fitted_splats)

    def encode_plan(self, plan: EncodePlan, codebooks: FileCodebooks | None = None) -> EncodedTiles:
        """Encode a planned scene with its levels, in memory. Arguments are as for `csplat.encoder.encode_levels`."""
        progress = PlannedProgress("levels", self._plan(plan.model), plan.context.progress)
        plan = replace(plan, context=replace(plan.context, progress=progress))
        if codebooks is None:
            plan, codebooks = plan.choose_sh_coding()
        coding = LevelCoding(plan, codebooks)
        nodes = self.build(coding.scene, plan.context, coding) if self.nodes is None else self.nodes
        return self.measure(encode_levels(plan, nodes, codebooks), plan.context)

    def build(
        self, model: SplatModel, context: Context = DEFAULT_CONTEXT, coding: LevelCoding | None = None
    ) -> list[LevelNode]:
        """Build the nodes of a scene. Their errors are 0 until `measure` is called.

        Args:
            model: the scene.
            context: threads and progress.
            coding: how the file codes levels.
        """
        if not len(model):
            return []
        if len(model) <= self.whole_splats:
            from csplat_tools.level_fitting import LevelFitter

            scene = _plain(model)
            fit = LevelFitter(scene, coding=coding, context=context).fit if self.fits else _merger(context)
            with thread_count(context.threads):
                return self._build_leaves(scene, fit, self.count)
        nodes, roots, numbers = list[LevelNode](), list[SplatModel](), list[list[int]]()
        buckets, silent = bucket_rows(model.means, self.bucket_splats), replace(context, progress=null_progress)
        builder = self.of_scene(model.select(sample_rows(len(model), self.bucket_splats)), len(model))
        for done, rows in enumerate(buckets):
            part = builder.build_part(model.select(rows), silent, coding)
            numbers.append([len(nodes) + number for number, node in enumerate(part) if node.parent is None])
            roots.append(join_roots(part))
            nodes += [_renumber(node, len(nodes), rows) for node in part]
            context.progress("building levels", (done + 1) / len(buckets))
        parents, top = self.build_top(roots, context, coding)
        for own, parent in zip(numbers, parents, strict=False):
            for number in own:
                nodes[number] = replace(nodes[number], parent=None if parent is None else parent + len(nodes))
        return nodes + [_renumber(node, len(nodes)) for node in top]

    def of_scene(self, sample: SplatModel, count: int) -> FittedLevelBuilder:
        """Return the builder for the buckets of a scene of `count` splats, given an evenly spaced sample."""
        from csplat_tools.level_fitting import make_backdrop

        return replace(self, backdrop=make_backdrop(sample, count) if self._is_fitted(count) else None)

    def build_part(self, splats: SplatModel, context: Context, coding: LevelCoding | None = None) -> list[LevelNode]:
        """Build the nodes of a bucket, up to one node or the last level.

        Args:
            splats: the bucket.
            context: threads and progress.
            coding: how the file codes levels.
        """
        from csplat_tools.level_fitting import PART_WORK, LevelFitter

        splats = _plain(splats)
        fit = _merger(context)
        if self.backdrop is not None:
            fit = LevelFitter(splats, self.backdrop, work=PART_WORK, coding=coding, context=context).fit
        with thread_count(context.threads):
            return self._build_leaves(splats, fit, self._part_levels)

    def build_top(
        self, roots: Iterable[SplatModel], context: Context, coding: LevelCoding | None = None
    ) -> tuple[list[int | None], list[LevelNode]]:
        """Build the nodes above all buckets.

        Args:
            roots: the splats of the coarsest level of each bucket, which are not read if no level is above them.
            context: threads and progress.
            coding: how the file codes levels.

        Returns:
            The number of the parent of each bucket, and the nodes; neither if no level is above the buckets.
        """
        if self.count is not None and self.count <= self._part_levels:
            return [], []
        from csplat_tools.level_fitting import LevelFitter

        parts = list(roots)
        nodes = [LevelNode(self._part_levels, None, splats=splats) for splats in parts]
        places = np.repeat(np.arange(len(parts)), [len(splats) for splats in parts])
        scene = join_blocks(parts[0], parts)
        fit = LevelFitter(scene, coding=coding, context=context).fit if self.fits else _merger(context)
        with thread_count(context.threads):
            nodes = self._add_levels(nodes, scene, places, fit, self.count)
        nodes = [replace(node, parent=None if node.parent is None else node.parent - len(parts)) for node in nodes]
        return [node.parent for node in nodes[: len(parts)]], nodes[len(parts) :]

    def measure(self, encoded: EncodedTiles, context: Context) -> EncodedTiles:
        """Return the same tiles with errors of the nodes that have none yet."""
        from csplat_tools.level_errors import measure_errors

        return measure_errors(encoded, context=context)

    def _plan(self, model: SplatModel) -> Plan:
        """Return the expected work of `encode_plan`."""
        from csplat_tools.level_fitting import LevelFitter

        phases, count, level = list[dict[str, PlannedWork]](), len(model), 0
        if self.nodes is None and count > self.whole_splats:
            buckets = math.ceil(count / self.bucket_splats)
            phases.append({"building levels": PlannedWork(buckets, self.bucket_splats * _BUILDING_COST)})
        elif self.nodes is None and count:
            while count > self.root_splats if self.count is None else level < self.count:
                finer_count, count, level = count, math.ceil(count / _KEPT), level + 1
                merging = {_MERGING.format(level): PlannedWork(1, finer_count * _MERGING_COST)}
                phases.append(LevelFitter(model).plan(finer_count, count, level) if self.fits else merging)
        per_stage = _CODING_COST * len(model)
        return [
            *phases,
            {"codebook": PlannedWork(8, per_stage), "tiles": PlannedWork(3, per_stage)},
            {"measuring levels": PlannedWork(2, per_stage)},
        ]

    @property
    def _part_levels(self) -> int:
        """Number of levels above 0 with which the largest bucket becomes one node."""
        leaves = max(1, math.ceil(self.bucket_splats / self.leaf_splats))
        levels = math.ceil(math.log(leaves, _CHILDREN) - _ROUNDING) or 1
        return levels if self.count is None else min(levels, self.count)

    def _build_leaves(self, splats: SplatModel, fit: _Fit, last: int | None) -> list[LevelNode]:
        """Return leaves of about `leaf_splats` splats each, then the nodes of coarser levels; as `_add_levels`."""
        groups = kd_groups(splats.means, math.ceil(len(splats) / self.leaf_splats))
        places = np.empty(len(splats), np.int64)
        for place, rows in enumerate(groups):
            places[rows] = place
        nodes = [LevelNode(0, None, rows=rows) for rows in groups]
        return self._add_levels(nodes, splats, places, fit, last)

    def _add_levels(
        self, nodes: list[LevelNode], splats: SplatModel, places: I64, fit: _Fit, last: int | None
    ) -> list[LevelNode]:
        """Return the nodes of a level, followed by the nodes of coarser levels.

        Args:
            nodes: the nodes.
            splats: their splats.
            places: [N], the node of each splat.
            fit: makes the splats of a level from the next finer level, as `LevelFitter.fit`.
            last: the coarsest level; `None`: the first level with a single node of at most `root_splats`.
        """
        nodes, node_count = list(nodes), len(nodes)  # node_count counts the coarsest level so far
        level = first = nodes[0].level
        while (node_count > 1 or len(splats) > self.root_splats) if last is None else level < last:
            level += 1
            start = len(nodes)
            for child in range(node_count):
                index = start - node_count + child
                nodes[index] = replace(nodes[index], parent=start + child // _CHILDREN)
            node_count, places = math.ceil(node_count / _CHILDREN), places // _CHILDREN
            least = min(self.root_splats, len(splats) // 2) if last is None else 0  # a full root: it is seen first
            count = max(node_count, math.ceil(len(splats) / _KEPT), least)
            places, splats = fit(splats, places, count, level - first)
            nodes += [LevelNode(level, None, splats=splats.select(rows)) for rows in _rows_by_node(places, node_count)]
        return nodes


def choose_levels(count: int, options: EncodeOptions, levels: LevelCount) -> FittedLevelBuilder | None:
    """Return the builder of levels of detail for a scene of `count` splats, or `None` if the file gets none.

    Raises:
        InputError: the number of levels is out of range, or the renderer is not installed.
    """
    if isinstance(levels, int) and not 1 <= levels <= LEVELS_MAX:
        raise InputError(f"levels is {levels}, expected 1 to {LEVELS_MAX}, auto or merged")
    number = levels if isinstance(levels, int) else None
    builder = FittedLevelBuilder(number, bucket_splats=options.bucket_splats, fits=levels != "merged")
    if builder.whole_splats < count <= builder.fitted_splats:
        builder = replace(builder, leaf_splats=_LARGE_LEAF_SPLATS)
    if levels is None or not count or (number is None and count <= builder.root_splats):
        return None
    require_renderer()
    return builder


def join_roots(nodes: Sequence[LevelNode]) -> SplatModel:
    """Return the splats of the nodes without parents, all above level 0."""
    roots = [node.splats for node in nodes if node.parent is None and node.splats is not None]
    return join_blocks(roots[0], roots)


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


def _merger(context: Context) -> _Fit:
    """Return a function that makes levels as `LevelFitter.fit` does, by merging alone, in 0.6 of its time to merge."""
    from csplat_tools.level_merging import merge_neighbours

    def merge(finer: SplatModel, nodes: I64, count: int, level: int) -> tuple[I64, SplatModel]:
        context.progress(_MERGING.format(level), 0.0)
        merged = merge_neighbours(finer, nodes, count, _QUICK_NEIGHBOURS)
        context.progress(_MERGING.format(level), 1.0)
        return merged

    return merge


def _plain(model: SplatModel) -> SplatModel:
    """Return the splats without extra columns and means in double precision."""
    return replace(model, extra={}, means_double=None)


def _renumber(node: LevelNode, first: int, rows: NDArray[np.intp] | None = None) -> LevelNode:
    """Raise the number of a node's parent by `first`, and look its rows up in `rows` [N], the rows of its part."""
    parent = None if node.parent is None else node.parent + first
    return replace(node, parent=parent, rows=None if node.rows is None or rows is None else rows[node.rows])


def read_streamed_levels(path: Path, last: int | None = None) -> list[LevelNode]:
    """Return the levels of detail of streamed SOG: each leaf of its tree becomes a chain of nodes.

    Args:
        path: the file.
        last: the coarsest level to read; `None`: all.

    Raises:
        InputError: the file is damaged, or no streamed SOG.
        OSError: it cannot be read.
    """
    with csplat.open(path) as scene:
        count = len(scene.levels) if last is None else min(len(scene.levels), last + 1)
    levels = []
    for level in range(count):
        with csplat.open(path, level=level) as scene:
            levels.append((scene.model(), read_leaf_numbers(path, level)))
    return chain_leaves(levels)


def chain_leaves(levels: Sequence[tuple[SplatModel, I64]]) -> list[LevelNode]:
    """Return a chain of nodes for each leaf, without levels that have no fewer splats than the next finer level.

    Args:
        levels: the splats of each level, finest first, and the number of the leaf of each splat.
    """
    nodes: list[LevelNode] = []
    finest = levels[0][1]
    for leaf in np.unique(finest):
        nodes.append(LevelNode(0, None, rows=np.flatnonzero(finest == leaf)))
        splat_count = int(np.count_nonzero(finest == leaf))
        for level, (model, numbers) in enumerate(levels[1:], 1):
            rows = np.flatnonzero(numbers == leaf)
            if 0 < len(rows) < splat_count:
                nodes[-1] = replace(nodes[-1], parent=len(nodes))
                nodes.append(LevelNode(level, None, splats=_with_bands(model.select(rows), levels[0][0])))
                splat_count = len(rows)
    return nodes


def _with_bands(splats: SplatModel, scene: SplatModel) -> SplatModel:
    """Return splats with as many SH coefficients as a scene has, and without extra columns."""
    shN = np.zeros((len(splats), *scene.shN.shape[1:]), np.float32)
    kept = min(shN.shape[1], splats.shN.shape[1])
    shN[:, :kept] = splats.shN[:, :kept]
    return replace(splats, shN=shN, extra={})


def _rows_by_node(places: I64, node_count: int) -> list[NDArray[np.intp]]:
    """Return the rows of the splats of each node, ascending, given the node of each splat, [N]."""
    ends = np.cumsum(np.bincount(places, minlength=node_count))
    return np.split(np.argsort(places, kind="stable"), ends[:-1])
