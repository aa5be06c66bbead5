# SPDX-License-Identifier: Apache-2.0
"""Render a scene that does not fit in memory, in slices of depth, using a file on the disk.

For each render all splats are read once, and the visible splats are sorted into slices. Slices are drawn from front to
back, each with the transmittance left by the previous slice. So the render equals a render of the whole scene, bit for
bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.scene import BLOCK_SPLATS, Scene
from csplat.types import F32, F64
from csplat_conformance.declared_bounds import Source
from csplat_render import Camera, Mode
from csplat_render.conventions import HasSplats, RenderResult
from csplat_render.rasteriser import Rasteriser
from csplat_tools.views.splat_spool import open_spool, record_type

STAGE = "drawing one picture by way of the disk"
_SAMPLED = 1 << 19  # approximate number of splats to sample when a slice is cut again
_BASE_BYTES = 320_000_000  # bytes of the program, samples, and buffered splats
_BLOCKS = 16  # blocks of splats in memory: being decoded, or freed and not yet returned to the system
_FOLDS = 2.2  # memory of a drawn splat divided by its arrays; it exists as a record and in arrays
_SPLAT_BYTES = 300  # additional bytes of the rasteriser per splat
_PAIR_BYTES = 12  # bytes per pair of a splat and a tile that it touches
_FULL = 0.75  # planned fraction of a slice's memory, since its limits come from a sample
_READING = 0.6  # fraction of the time of a render that reading takes, for progress


@dataclass(frozen=True, eq=False)
class SlicedScene:
    """A scene that is drawn without being in memory.

    A render takes disk space for the arrays of its visible splats, in an unnamed file in the folder for temporary files
    (TMPDIR), which disappears when the program ends in any way.

    Attributes:
        scene: its splats.
        sample, every: as returned by `sample_scene`.
        memory_bytes: approximate limit of the memory.
        slice_bytes: least memory for a slice, bytes.
    """

    scene: Scene
    sample: SplatModel
    every: int
    memory_bytes: int
    slice_bytes: int = 1 << 24

    @property
    def origin(self) -> tuple[float, float, float]:
        """The scene's origin, to which cameras are relative."""
        return self.scene.origin

    @property
    def disk_bytes(self) -> int:
        """Bytes of disk space that a render may take."""
        return self.scene.count * self.record.itemsize

    @property
    def record(self) -> np.dtype[Any]:
        """Type of a splat's record on the disk."""
        return record_type(_source(self.scene.empty()))

    @property
    def splat_bytes(self) -> float:
        """Bytes of memory of a drawn splat, without its pairs with tiles."""
        return _FOLDS * self.record.itemsize + _SPLAT_BYTES

    @property
    def least_bytes(self) -> int:
        """Least memory for a render, bytes."""
        return self._fixed_bytes + self.slice_bytes

    @property
    def room_bytes(self) -> int:
        """Memory for a slice, bytes."""
        return max(self.slice_bytes, self.memory_bytes - self._fixed_bytes)

    @property
    def _fixed_bytes(self) -> int:
        """Memory besides that of a slice, bytes."""
        return _BASE_BYTES + _BLOCKS * BLOCK_SPLATS * self.record.itemsize

    def renderer(
        self, background: ArrayLike, *, mode: Mode = "standard", context: Context = DEFAULT_CONTEXT
    ) -> Callable[[Camera], RenderResult]:
        """Return a function that draws the scene from a camera, like `csplat_render.scorer.renderer`, without `radii`.

        Raises:
            InputError: the mode is `exact`; while drawing: the disk is full, or the scene is damaged.
        """
        if mode == "exact":
            raise InputError("mode exact requires a scene that fits in memory: use standard")
        return lambda camera: _SlicedRender(self, camera, background, mode, context).drawn()


class _SlicedRender:
    """A render in progress. Owns the state of its pixels."""

    def __init__(self, scene: SlicedScene, camera: Camera, background: ArrayLike, mode: Mode, context: Context) -> None:
        self._scene, self._camera, self._background, self._progress = scene, camera, background, context.progress
        self._rasteriser = Rasteriser(mode, context=context)
        self._state = self._rasteriser.initial_state(camera)
        self._record, self._splat_bytes = scene.record, scene.splat_bytes
        self._ignored, self._visible, self._done, self._pairs = 0, 0, 0, 0
        self._last: RenderResult | None = None

    def drawn(self) -> RenderResult:
        """Draw all slices, and return the render."""
        limits = self._limits(map(_source, Scene.of(self._scene.sample).blocks()), 1, self._scene.every)
        self._draw_slice(_source(self._scene.scene.empty()))  # the background, in case no splat is visible
        self._sort_and_draw(self._blocks, self._scene.scene.count, limits, first=True)
        self._report(1.0)
        assert self._last is not None
        return replace(self._last, drawn=self._done, intersections=self._pairs, ignored=self._ignored)

    @property
    def _planned_bytes(self) -> float:
        """Memory that a planned slice may take, bytes; less than the limit, since plans use samples."""
        return _FULL * self._scene.room_bytes

    def _report(self, share: float) -> None:
        """Report the fraction of the render that is done."""
        self._progress(STAGE, share)

    def _visible_splats(self, splats: HasSplats) -> tuple[F32, F64, int]:
        """Return [n] depths and [n] bytes for drawing, both 0 if invisible, and the number of ignored splats."""
        seen = self._rasteriser.find_visible(splats, self._camera, antialiased=self._scene.scene.metadata.antialiased)
        return seen.near, np.where(seen.near > 0, self._splat_bytes + _PAIR_BYTES * seen.tiles, 0.0), seen.ignored

    def _blocks(self) -> Iterator[Source]:
        """Yield all splats of the scene."""
        for rows, block in self._scene.scene.numbered():
            self._report(_READING * rows.start / max(1, self._scene.scene.count))
            yield _source(block)

    def _sort_and_draw(
        self, blocks: Callable[[], Iterator[Source]], count: int, limits: F32, *, first: bool = False
    ) -> None:
        """Sort splats into slices on disk, and draw them from near to far; slices that are too large are cut again.

        Stops when no pixel lets more light through. The first pass sets the counts of ignored and visible splats.

        Args:
            blocks: the splats, in order.
            count: upper bound of their number.
            limits: limits of the slices, see `slice_limits`.
            first: count splats, as in the first pass over the scene.
        """
        spool = open_spool(self._record, count)
        with closing(spool.stream):
            sizes = np.zeros(len(limits) + 1)
            for block in blocks():
                near, taken, ignored = self._visible_splats(block)
                rows = np.flatnonzero(near)
                keys = np.searchsorted(limits, near[rows], "right")
                sizes += np.bincount(keys, taken[rows], len(sizes))
                spool.add(block, rows, keys)
                if first:
                    self._ignored, self._visible = self._ignored + ignored, self._visible + len(rows)
            spool.flush()
            for key, number in spool.counts().items():
                if not (self._state[..., 0] > 0.0).any():  # transmittance
                    return
                read = partial(spool.sources, key)
                if sizes[key] <= self._scene.room_bytes or number == 1:
                    self._draw_slice(next(read(number)))
                elif 0 < key < len(limits) and np.nextafter(limits[key - 1], np.float32(np.inf)) == limits[key]:
                    for part in read(max(1, int(number * self._planned_bytes / sizes[key]))):  # equal depths: in order
                        self._draw_slice(part)
                else:
                    every = -(-number // _SAMPLED)
                    self._sort_and_draw(
                        partial(read, BLOCK_SPLATS), number, self._limits(read(BLOCK_SPLATS), every, every, least=2)
                    )

    def _limits(self, blocks: Iterator[Source], every: int, share: int, *, least: int = 1) -> F32:
        """Return limits as `slice_limits` does, from every Nth splat of blocks, each of which represents `share`."""
        sampled = [[column[::every].copy() for column in self._visible_splats(block)[:2]] for block in blocks]
        if not sampled:
            return np.empty(0, np.float32)
        near, taken = (np.concatenate(columns) for columns in zip(*sampled, strict=True))
        return slice_limits(near, taken, max(least, math.ceil(taken.sum() * share / self._planned_bytes)))

    def _draw_slice(self, splats: HasSplats) -> None:
        """Draw splats behind those drawn before; sets the last render, and adds up drawn splats and pairs."""
        render = self._rasteriser.forward(
            splats, self._camera, background=self._background, state=self._state,
            antialiased=self._scene.scene.metadata.antialiased,
        )  # fmt: skip
        self._last = replace(render, radii=np.empty(0, np.float32))
        self._done, self._pairs = self._done + render.drawn, self._pairs + render.intersections
        self._report(_READING + (1.0 - _READING) * self._done / max(1, self._visible))


def slice_limits(near: F32, taken: F64, pieces: int) -> F32:
    """Return depths that cut splats into slices of about equal size in bytes.

    Args:
        near: [n] depths; 0 for splats that are not drawn.
        taken: [n] bytes of each splat.
        pieces: least number of slices.

    Returns:
        Limits in ascending order; a slice includes its lower limit, but not its upper limit. A depth with more splats
        than fit into a slice is a slice of its own, up to the next float.
    """
    rows = np.flatnonzero(near)
    if pieces < 2 or not len(rows):
        return np.empty(0, np.float32)
    rows = rows[np.argsort(near[rows], kind="stable")]
    sums = np.cumsum(taken[rows])
    cuts = np.searchsorted(sums, sums[-1] * np.arange(1, pieces) / pieces)
    values, counts = np.unique(near[rows[np.minimum(cuts, len(rows) - 1)]], return_counts=True)
    alone = values[(counts > 1) | (values == near[rows[0]])]
    limits: F32 = np.unique(np.concatenate([values, np.nextafter(alone, np.float32(np.inf))]))
    return limits


def _source(model: SplatModel) -> Source:
    """Return the splats to draw, with centres in float32."""
    return Source(model.means, model.quats, model.scales, model.opacities, model.sh0, model.shN)
