"""Pictures of a scene that does not fit the memory: in slices of depth, by way of a file on the disk.

For each picture all splats are read once, and those that it shows are sorted into slices. These are drawn one after the
other, the nearest first, each upon what the one before it left of the pixels: the picture is that of the whole scene,
bit for bit, however it was cut.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.scene import BLOCK, Scene, scene_of
from csplat_conformance.stated import Source
from csplat_conformance.stated.spool import Rows, Spool, opened_spool
from csplat_render import Camera, Mode
from csplat_render.arrays import HasSplats, RenderResult
from csplat_tools.files.console import Progress

__all__ = ["Sliced", "slice_limits"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

STAGE = "drawing one picture by way of the disk"
_LOOKED_AT = 1 << 19  # splats of a slice that is cut again
_BASE_BYTES = 320_000_000  # program, samples, splats that wait for being written
_BLOCKS = 16  # that are being decoded, or were, and lie in what the system has not been given back
_FOLDS = 2.2  # of a splat's arrays: as records, and as arrays
_SPLAT_BYTES = 300  # beside them: what the rasteriser knows of a splat
_PAIR_BYTES = 5  # of a splat and a tile that it touches
_FULL = 0.75  # of a slice: its limits come from a sample
_READING = 0.6  # of the time for a picture


@dataclass(frozen=True, eq=False)
class Sliced:
    """A scene that is drawn without being in memory.

    While a picture is drawn the disk takes as much as the arrays of the splats that it shows do, in the folder for
    temporary files (TMPDIR), in a file of no name: it goes when the program ends, however that is.

    Attributes:
        scene: its splats.
        sample, every: as `OpenedScene.sample` gives them.
        memory_bytes: bound, about.
        progress: is told how far a picture has come.
        slice_bytes: least bytes of memory for a slice.
    """

    scene: Scene
    sample: SplatModel
    every: int
    memory_bytes: int
    progress: Progress | None = None
    slice_bytes: int = 1 << 24

    @property
    def origin(self) -> tuple[float, float, float]:
        """What cameras are relative to."""
        return self.scene.facts.origin

    @property
    def disk_bytes(self) -> int:
        """Bytes of the disk that a picture may take."""
        return self.scene.count * self.layout.dtype.itemsize

    @property
    def layout(self) -> Rows:
        """Of splats on the disk."""
        return Rows.of(_source(self.scene.facts), ())

    @property
    def splat_bytes(self) -> float:
        """Bytes of memory that a splat takes which is drawn, beside those of its pairs with tiles."""
        return _FOLDS * self.layout.dtype.itemsize + _SPLAT_BYTES

    @property
    def least_bytes(self) -> int:
        """Bytes of memory without which nothing can be drawn."""
        return self._beside + self.slice_bytes

    @property
    def room_bytes(self) -> int:
        """Bytes of memory for a slice."""
        return max(self.slice_bytes, self.memory_bytes - self._beside)

    @property
    def _beside(self) -> int:
        return _BASE_BYTES + _BLOCKS * BLOCK * self.layout.dtype.itemsize

    def renderer(
        self, background: ArrayLike, *, mode: Mode = "standard", threads: int | None = None
    ) -> Callable[[Camera], RenderResult]:
        """What draws the scene from camera after camera, as `csplat_render.judge.renderer`; `radii` are left out.

        Raises:
            InputError: the mode is `exact`; while drawing: the disk has no room, or the scene is not whole.
        """
        if mode == "exact":
            raise InputError("mode exact wants the scene in memory, and it does not fit: take standard")
        return lambda camera: _Picture(self, camera, background, mode, threads).drawn()


class _Picture:
    """One picture. Owns what is left of its pixels."""

    def __init__(self, scene: Sliced, camera: Camera, background: ArrayLike, mode: Mode, threads: int | None) -> None:
        from csplat_render.rasterise import Rasteriser  # numba takes a second to import

        self._scene, self._camera, self._background = scene, camera, background
        self._rasteriser = Rasteriser(mode, gradients=False, threads=threads)
        self._state = self._rasteriser.begun(camera)
        self._layout, self._splat_bytes = scene.layout, scene.splat_bytes
        self._ignored, self._visible, self._done, self._pairs = 0, 0, 0, 0
        self._last: RenderResult | None = None

    def drawn(self) -> RenderResult:
        """Draw it."""
        limits = self._limits(map(_source, scene_of(self._scene.sample).blocks()), 1, self._scene.every)
        self._draw(_source(self._scene.scene.facts))  # so that there is a picture, whatever comes
        self._sort_and_draw(self._blocks, self._scene.scene.count, limits, first=True)
        self._tell(1.0)
        assert self._last is not None, "something was drawn"
        return replace(self._last, drawn=self._done, intersections=self._pairs, ignored=self._ignored)

    @property
    def _full(self) -> float:
        return _FULL * self._scene.room_bytes

    def _tell(self, share: float) -> None:
        if self._scene.progress is not None:
            self._scene.progress(STAGE, share)

    def _looked(self, splats: HasSplats) -> tuple[F32, F64, int]:
        """Depths, the bytes of memory that drawing takes, both 0 for what is not shown; and how many are ignored."""
        seen = self._rasteriser.seen(splats, self._camera, antialiased=self._scene.scene.facts.antialiased)
        return seen.near, np.where(seen.near > 0, self._splat_bytes + _PAIR_BYTES * seen.tiles, 0.0), seen.ignored

    def _blocks(self) -> Iterator[Source]:
        """All splats of the scene."""
        for rows, block in self._scene.scene.numbered():
            self._tell(_READING * rows.start / max(1, self._scene.scene.count))
            yield _source(block)

    def _sort_and_draw(
        self, blocks: Callable[[], Iterator[Source]], count: int, limits: F32, *, first: bool = False
    ) -> None:
        """Sort splats into slices, and draw these; those that are too large are cut again.

        Args:
            blocks: the splats, in order.
            count: how many there are, at most.
            limits: as of `slice_limits`.
            first: whether this is the first time that they are looked at.
        """
        spool = opened_spool(self._layout, count)
        with closing(spool.stream):
            sizes = np.zeros(len(limits) + 1)
            for block in blocks():
                near, taken, ignored = self._looked(block)
                rows = np.flatnonzero(near)
                keys = np.searchsorted(limits, near[rows], "right")
                sizes += np.bincount(keys, taken[rows], len(sizes))
                spool.add(block, rows, keys, rows)
                if first:
                    self._ignored, self._visible = self._ignored + ignored, self._visible + len(rows)
            spool.flush()
            for key, number in spool.counts().items():
                if not (self._state[..., 0] > 0.0).any():
                    return
                read = partial(self._read, spool, key)
                if sizes[key] <= self._scene.room_bytes or number == 1:
                    self._draw(next(read(number)))
                elif 0 < key < len(limits) and np.nextafter(limits[key - 1], np.float32(np.inf)) == limits[key]:
                    for part in read(max(1, int(number * self._full / sizes[key]))):  # of one depth: by their order
                        self._draw(part)
                else:
                    every = -(-number // _LOOKED_AT)
                    self._sort_and_draw(partial(read, BLOCK), number, self._limits(read(BLOCK), every, every, least=2))

    def _read(self, spool: Spool, key: int, most: int) -> Iterator[Source]:
        return (source for source, _ in spool.sources(key, most))

    def _limits(self, blocks: Iterator[Source], every: int, share: int, *, least: int = 1) -> F32:
        """As `slice_limits`: by one in `every` of some splats, of which each stands for `share`."""
        looked = [[column[::every].copy() for column in self._looked(block)[:2]] for block in blocks]
        if not looked:
            return np.empty(0, np.float32)
        near, taken = (np.concatenate(columns) for columns in zip(*looked, strict=True))
        return slice_limits(near, taken, max(least, math.ceil(taken.sum() * share / self._full)))

    def _draw(self, splats: HasSplats) -> None:
        found = self._rasteriser.forward(
            splats, self._camera, background=self._background, state=self._state,
            antialiased=self._scene.scene.facts.antialiased,
        )  # fmt: skip
        self._last = replace(found, radii=np.empty(0, np.float32))
        self._done, self._pairs = self._done + found.drawn, self._pairs + found.intersections
        self._tell(_READING + (1.0 - _READING) * self._done / max(1, self._visible))


def slice_limits(near: F32, taken: F64, pieces: int) -> F32:
    """Depths that cut splats into slices of about as many bytes.

    Args:
        near: [n] depths; 0 of what is not drawn.
        taken: [n] bytes that each takes.
        pieces: how many slices, at least.

    Returns:
        Limits in rising order: a slice has its lower limit and not its upper one. A depth at which more than a slice
        lies is a slice of its own: its upper limit is the next float.
    """
    rows = np.flatnonzero(near)
    if pieces < 2 or not len(rows):
        return np.empty(0, np.float32)
    rows = rows[np.argsort(near[rows], kind="stable")]
    sums = np.cumsum(taken[rows])
    at = np.searchsorted(sums, sums[-1] * np.arange(1, pieces) / pieces)
    values, counts = np.unique(near[rows[np.minimum(at, len(rows) - 1)]], return_counts=True)
    alone = values[(counts > 1) | (values == near[rows[0]])]
    limits: F32 = np.unique(np.concatenate([values, np.nextafter(alone, np.float32(np.inf))]))
    return limits


def _source(model: SplatModel) -> Source:
    """The splats as they are drawn: centres in float32."""
    return Source(model.means, model.quats, model.scales, model.opacities, model.sh0, model.shN)
