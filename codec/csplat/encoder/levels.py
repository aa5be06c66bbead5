# SPDX-License-Identifier: Apache-2.0
"""Encode a scene with levels of detail (spec 5.7), which a caller with a renderer has built."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from csplat.context import Context
from csplat.encoder.coding_parameters import SAME_STEPS, StepFactors
from csplat.encoder.container import FileNode, FileTile, order_nodes
from csplat.encoder.encode_plan import EncodePlan, clip_scales
from csplat.encoder.pipeline import EncodedTiles, encode_tile, encode_tiles
from csplat.encoder.sh_codebook import FileCodebooks, ShCodingPlan, assign_splats, nearest_entries
from csplat.encoder.tiling import cut_scene
from csplat.errors import InputError
from csplat.model import SplatModel, check_model

Rows = NDArray[np.intp]

#: Factors of the steps of levels above 1: fewer bytes for a small loss of quality.
_COARSE_STEPS = StepFactors(opacities=2, scales=1, quats=2, sh0=1)


@dataclass(frozen=True, eq=False)
class LevelNode:
    """A node of the levels of detail.

    Attributes:
        level: 0 for a leaf, and above the level of each child otherwise.
        parent: index of the parent; `None` for a root.
        rows: rows of the scene, for a leaf.
        splats: the splats of a coarser node, no more than its children have together.
        error: pixel size from which on the node may replace the splats below it, scene units. At least as large as
            the error of each child; 0 for a leaf.
    """

    level: int
    parent: int | None
    rows: Rows | None = None
    splats: SplatModel | None = None
    error: float = 0.0


@dataclass(frozen=True, eq=False)
class LevelCoding:
    """The steps and SH codebooks of a scene, with which its coarser levels are coded, too.

    Attributes:
        plan: the plan of the scene, whose SH coding is chosen.
        codebooks: codebooks of the file.
    """

    plan: EncodePlan
    codebooks: FileCodebooks

    @property
    def scene(self) -> SplatModel:
        """The scene with SH from band 1 on as decoded, except that of escaped splats."""
        plan, model, sh_plan = self.plan, self.plan.model, self.codebooks.sh_plan
        if sh_plan.book is not None and sh_plan.of_sample:
            sh_plan = assign_splats(sh_plan, model, plan.parameters, plan.context)
        book = sh_plan.book
        if book is None:
            return model
        decoded, coded = book.dequantise(plan.parameters), book.index < book.size
        shN = np.zeros_like(model.shN)
        shN[:, : decoded.shape[1]] = decoded
        shN[~coded] = model.shN[~coded]
        return replace(model, shN=shN)

    def with_coded_sh(self, splats: SplatModel) -> SplatModel:
        """Return splats above level 0 with bands from 1 on as decoded, if the file has a codebook of them."""
        book, parameters = self.codebooks.sh_plan.book, self.plan.parameters
        if book is None:
            return splats
        decoded = nearest_entries(book, splats, parameters, self.plan.context).dequantise(parameters)
        shN = np.zeros_like(splats.shN)
        shN[:, : decoded.shape[1]] = decoded
        return replace(splats, shN=shN)

    def encode(self, node: LevelNode) -> list[FileTile]:
        """Encode the splats of a node above level 0, above level 1 with coarser steps.

        The step of the means doubles from level to level, from level 2 on. At level 1, doubling would cost quality for
        few bytes.

        Raises:
            InputError: a value fits no lattice.
        """
        assert node.splats is not None
        check_model("the encoder", node.splats)
        splats, level, parameters = clip_scales(node.splats), node.level, self.plan.parameters
        factors = SAME_STEPS if level == 1 else _COARSE_STEPS
        sh_plan = self._assign(splats)
        lattice = replace(parameters.lattice, error=None)  # is a bound for the scene
        tiles = [
            replace(tile, exponent=tile.exponent + level - 1, factors=factors)
            for tile in cut_scene(splats, replace(parameters, lattice=lattice))
        ]  # fmt: skip
        return [replace(encode_tile(splats, tile, parameters, sh_plan).tile, level=level) for tile in tiles]

    def _assign(self, splats: SplatModel) -> ShCodingPlan:
        """Return the SH coding of coarse splats, without escapes.

        Large splats would often be escaped, which takes many bytes for hardly any quality.
        """
        plan, sh_plan = self.plan, self.codebooks.sh_plan
        if sh_plan.book is None:
            return replace(sh_plan, of_sample=True, extras=())  # each tile gets its own weights
        book = nearest_entries(sh_plan.book, splats, plan.parameters, plan.context)
        return replace(sh_plan, weights=None, book=book, extras=(), of_sample=False)


class LevelBuilder(Protocol):
    """A builder of levels of detail, which also measures their errors; picklable."""

    @property
    def whole_splats(self) -> int:
        """Number of splats up to which a scene is built in one piece, in memory."""
        ...

    def settings(self, count: int) -> dict[str, Any]:
        """Return the value of `levels` in the OPTS chunk of a scene of `count` splats, JSON-compatible."""
        ...

    def seconds(self, count: int, workers: int) -> float:
        """Return the approximate time for the levels of a scene of `count` splats.

        Args:
            count: number of splats.
            workers: number of threads for a scene built in one piece, of processes for a larger one.
        """
        ...

    def encode_plan(self, plan: EncodePlan, codebooks: FileCodebooks | None = None) -> EncodedTiles:
        """Encode a planned scene with its levels, in memory; arguments as for `encode_levels`."""
        ...

    def of_scene(self, sample: SplatModel, count: int) -> LevelBuilder:
        """Return the builder for the buckets of a scene of `count` splats, given an evenly spaced sample."""
        ...

    def build_part(self, splats: SplatModel, context: Context, coding: LevelCoding | None = None) -> list[LevelNode]:
        """Build the nodes of a bucket of that scene."""
        ...

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
        ...

    def measure(self, encoded: EncodedTiles, context: Context) -> EncodedTiles:
        """Return the same tiles with errors of the nodes that have none yet."""
        ...


def encode_levels(
    plan: EncodePlan,
    nodes: Sequence[LevelNode],
    codebooks: FileCodebooks | None = None,
) -> EncodedTiles:
    """Encode the tiles of a scene and of its coarser versions.

    All choices are made for the scene alone, so that level 0 has the same steps and codebooks as without other levels.

    Args:
        plan: the plan of the scene; its tiles are replaced by the tiles of the leaves.
        nodes: the nodes, whose leaves hold each splat once.
        codebooks: SH codebooks, if the plan's SH coding is chosen; `None`: choose it now.

    Raises:
        InputError: the leaves do not hold each splat once, a parent is not above its child, or a value fits no lattice.
    """
    _check_nodes(nodes, len(plan.model))
    if codebooks is None:
        plan, codebooks = plan.choose_sh_coding()
    leaves = [number for number, node in enumerate(nodes) if node.level == 0]
    of_leaves = [
        cut_scene(plan.model, plan.parameters, plan.classes, [rows])
        for rows in (nodes[number].rows for number in leaves) if rows is not None
    ]  # fmt: skip
    plan = replace(plan, tiles=[tile for tiles in of_leaves for tile in tiles])
    encoded = encode_tiles(plan, codebooks)
    parts = iter(encoded.tiles)
    tiles_by_node = {number: [next(parts).tile for _ in tiles] for number, tiles in zip(leaves, of_leaves, strict=True)}
    coarse, coding = [number for number, node in enumerate(nodes) if node.level], LevelCoding(plan, codebooks)
    for done, number in enumerate(coarse):
        tiles_by_node[number] = coding.encode(nodes[number])
        plan.context.progress("levels", (done + 1) / len(coarse))
    tree = [FileNode(node.parent, tiles_by_node[number], node.error) for number, node in enumerate(nodes)]
    return replace(encoded, nodes=order_nodes(tree))


def _check_nodes(nodes: Sequence[LevelNode], count: int) -> None:
    """Raise an `InputError` unless the leaves hold `count` splats once each, and parents have higher levels."""
    rows = [node.rows for node in nodes if node.rows is not None]
    if not np.array_equal(np.sort(np.concatenate(rows)) if rows else [], np.arange(count)):
        raise InputError("the leaves do not hold each splat of the scene once")
    for node in nodes:
        if node.parent is not None and not nodes[node.parent].level > node.level:
            raise InputError(f"the parent of a node of level {node.level} has level {nodes[node.parent].level}")
