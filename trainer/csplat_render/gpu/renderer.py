# SPDX-License-Identifier: Apache-2.0
"""`GpuRenderer`: render scenes on a GPU, by screen tiles, from the integers of their files.

An image is rendered in bands of rows that fit the buffers. A band is rendered in slices of depth, nearest first, that
fit the buffers of records; a slice, in steps that fit the buffer of pairs of splat and screen tile. Most images are one
band, one slice and one step. Pixels pass from one step to the next, so slices and steps do not change the image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError, LimitError
from csplat.model import SplatModel
from csplat.packed import PackedTile
from csplat.types import F32, F64
from csplat_render.camera import Camera
from csplat_render.conventions import (
    HasSplats,
    Mode,
    checked_background,
    checked_degree,
    checked_splats,
    view_vector,
)
from csplat_render.gpu.device import Call, Device, Stage
from csplat_render.gpu.packing import BLOCK, MODEL_TILE, TILE_ROWS, SharedTables, TileWords, pack_splats, pack_tile

#: Words of a buffer of tiles, 32 MiB: a quarter of WebGPU's default limit. The largest tile has 6.5 million.
_PAGE_WORDS = 1 << 23

_SCREEN_TILE = 16  # pixels, width and height
_RECORD_BYTES = 16  # in each of the two buffers of records
_PIXEL_BYTES = 16  # four numbers of binary32
_WORD_BYTES = 4  # bytes of a key, a value or a sum
_RANGE_BYTES = 8  # first and last pair of a screen tile
_GROUP_COUNT_BYTES = 12  # bytes of a row of the table of workgroups: three numbers
_GROUPS_BYTES = 64  # bytes of that table: its rows and the arguments of a draw, 13 numbers, rounded up
_BLOCK_BYTES = 36  # bytes per block: the place of its first record, and 8 words with a bit per splat (cull.wgsl)
_DIGIT_BITS = 8  # bits of the keys that one pass of a sort orders
_DIGITS = 1 << _DIGIT_BITS
_KEY_BITS = 31  # bits of the largest key, `_LAST_KEY`
_DEPTH_KEY_BITS = 32  # bits of the keys that the depth sort orders
_CLEARED_PIXELS, _CLEARING_ROWS = 256, 64  # pixels per workgroup, and rows of workgroups that clear an image
_LEAST_PAIRS = 1 << 20  # room for pairs at first, 16 MB
_MOST_PAIRS = 1 << 26  # fewer than the saturation of the sums in scan.wgsl
_MOST_RECORDS = 65535 * BLOCK  # workgroups of a pass
_RUN = 4096  # elements per workgroup of a sort
_DEPTH_BITS = 15  # bits of a key that tell slices apart at once
_ALL_BANDS = 4  # the highest SH degree
_LAST_KEY = 0x7F7FFFFF  # bits of the largest finite depth
_SORT_RECORDS, _BLOCKS_OF_RANKS, _SORT_PAIRS = 0, 1, 2  # rows of the table of workgroups in dispatch.wgsl

#: `Counters` of common.wgsl.
_COUNTERS = np.dtype([(name, "<u4") for name in ("visible", "pairs", "first_block", "last_block")])

#: `View` of common.wgsl.
_VIEW = np.dtype(
    [
        ("rows", "<f4", (3, 4)), ("focal", "<f4", 4), ("slopes", "<f4", 4), ("size", "<f4", 2), ("near", "<f4"),
        ("first_key", "<u4"), ("last_key", "<u4"), ("screen_tiles_x", "<u4"), ("screen_tiles", "<u4"),
        ("records", "<u4"), ("pairs", "<u4"), ("blocks", "<u4"), ("block_table", "<u4"), ("tile_table", "<u4"),
        ("depth_shift", "<u4"), ("sh_degree", "<u4"), ("unused", "<u4", 2),
    ]
)  # fmt: skip


@runtime_checkable
class PackedFile(Protocol):
    """A file opened by `csplat.open`."""

    @property
    def header(self) -> Any: ...  # noqa: D102 - as in `csplat.SplatFile`

    def packed_tiles(  # noqa: D102 - as in `csplat.SplatFile`
        self, tiles: Sequence[int] | None = None, *, sh_degree: int | None = None
    ) -> Iterator[PackedTile]: ...

    def read(self, *, sh_degree: int | None = None) -> HasSplats: ...  # noqa: D102 - as in `csplat.SplatFile`


@dataclass(frozen=True, eq=False)
class GpuRender:
    """An image rendered on a GPU.

    Attributes:
        rgb: [H, W, 3] float32, not clipped.
        alpha: [H, W] float32, 1 − transmittance.
        ignored: number of splats with NaN or infinity.
        visible: number of splats that passed the culling.
        pairs: number of pairs of splat and screen tile.
        steps: number of steps; more than 1 if the image exceeded the buffers.
    """

    rgb: F32
    alpha: F32
    ignored: int
    visible: int
    pairs: int
    steps: int


@dataclass(frozen=True, eq=False)
class Page:
    """A buffer of tiles: their words, the number of its first block, and the number of blocks."""

    words: Any
    info: Any
    blocks: int


class GpuScene:
    """Scenes in the memory of a GPU, rendered as one.

    Args:
        device: the GPU.
        scenes: models, or files opened by `csplat.open`, at least one.
        antialiased: apply the mip-splatting filter; `None`: each scene's own setting.
        sh_degree: highest SH degree; `None`: each scene's own degree.

    Attributes:
        device: the GPU.
        origin: origin of the first scene, to which cameras are relative.
        splat_count: number of splats.
        ignored: number of splats with NaN or infinity, which are not drawn.
        size_bytes: GPU memory of the scenes, bytes.

    Raises:
        InputError: there are no scenes, array shapes do not match, or the GPU has too little memory.
        LimitError: the codebooks exceed the largest buffer of the GPU.
        CsplatError: a file is invalid, as in `csplat.decode`.
    """

    def __init__(
        self,
        device: Device,
        scenes: Sequence[PackedFile | HasSplats],
        *,
        antialiased: bool | None = None,
        sh_degree: int | None = None,
    ) -> None:
        if not scenes:
            raise InputError("there are no scenes to render")
        self.device = device
        self.origin = _origin_of(scenes[0])
        self.splat_count = self.ignored = self.size_bytes = self.block_count = 0
        self.pages: list[Page] = []
        tables = SharedTables(device.binding_max // 4)
        constants: list[NDArray[np.uint32]] = []
        owners: list[NDArray[np.uint32]] = []
        corners: list[F64] = []
        steps: list[float] = []
        page: list[NDArray[np.uint32]] = []
        words = 0  # number of words in the page so far
        first_block = 0  # first block of the page
        for tile in _tiles_of(scenes, tables, antialiased, sh_degree):
            if page and words + len(tile.words) > _PAGE_WORDS:
                self._add_page(page, first_block)
                page, words, first_block = [], 0, self.block_count
            constants.append(tile.placed(words, self.block_count))
            owners.append(np.full(tile.blocks, len(corners), np.uint32))
            corners.append(tile.corner)
            steps.append(tile.step)
            page.append(tile.words)
            words += len(tile.words)
            self.block_count += tile.blocks
            self.splat_count += tile.splats
            self.ignored += tile.ignored
        if page:
            self._add_page(page, first_block)
        self._corners = np.array(corners, np.float64).reshape(-1, 3)
        self._places = np.zeros((len(corners), 4), np.float32)
        self._places[:, 3] = np.minimum(steps, np.finfo(np.float32).max)
        self.tile_table = len(corners)
        self.block_table = len(corners) * (1 + TILE_ROWS)
        blocks = np.concatenate([*owners, np.zeros(-self.block_count % 4, np.uint32)]).reshape(-1, 4)
        self.tiles = self._upload(np.concatenate([self._places.view(np.uint32), *constants, blocks]))
        self.tables = self._upload(np.concatenate([*tables.runs, np.zeros(4, np.uint32)]))

    def renderer(
        self, background: ArrayLike, *, mode: Mode = "standard", context: Context = DEFAULT_CONTEXT
    ) -> Callable[[Camera], GpuRender]:
        """Return a function that renders the scene, like `csplat_render.scorer.renderer`.

        Raises:
            InputError: the mode is not `standard`.
        """
        del context  # its threads are the CPU's
        if mode != "standard":
            raise InputError(f"mode {mode} requires the backend cpu: the GPU has standard alone")
        own = GpuRenderer(self)
        return lambda camera: own.render(camera, background=background)

    def place(self, view: F64) -> None:
        """Write the corners of the tiles in camera coordinates, computed in float64."""
        if len(self._places):
            with np.errstate(over="ignore"):  # what is infinitely far is not drawn
                self._places[:, :3] = self._corners @ view[:9].reshape(3, 3).T + view[9:12]
            self.device.upload(self.tiles, self._places)

    def _upload(self, array: NDArray[Any], **usage: bool) -> Any:
        """Return a buffer with the content of an array, and add its size to `size_bytes`."""
        buffer = self.device.uploaded(array, **usage)
        self.size_bytes += buffer.size
        return buffer

    def _add_page(self, runs: list[NDArray[np.uint32]], first_block: int) -> None:
        """Append a page of the words of tiles, `runs`, whose blocks are `first_block` to `block_count`, to `pages`."""
        info = np.array([first_block, 0, 0, 0], np.uint32)
        words = self._upload(np.concatenate(runs))
        self.pages.append(Page(words, self._upload(info, uniform=True), self.block_count - first_block))


def _origin_of(scene: PackedFile | HasSplats) -> tuple[float, float, float]:
    """Return the origin of a scene; 0 0 0 if it has none."""
    origin = scene.header.origin if isinstance(scene, PackedFile) else getattr(scene, "origin", None)
    return origin or (0.0, 0.0, 0.0)


def _tiles_of(
    scenes: Sequence[PackedFile | HasSplats], tables: SharedTables, antialiased: bool | None, sh_degree: int | None
) -> Iterator[TileWords]:
    """Yield the tiles of scenes, relative to the origin of the first.

    Args:
        scenes: at least one.
        tables: tables of coefficients that tiles share; filled.
        antialiased: `None`: as each scene specifies.
        sh_degree: highest SH degree; `None`: the degree of each scene.
    """
    first = _origin_of(scenes[0])
    for scene in scenes:
        shift = np.subtract(_origin_of(scene), first)
        if isinstance(scene, PackedFile):
            own = scene.header.antialiased if antialiased is None else antialiased
            for tile in scene.packed_tiles(sh_degree=sh_degree):
                yield pack_tile(tile, tables, shift, antialiased=own)
            continue
        is_antialiased = isinstance(scene, SplatModel) and scene.metadata.antialiased
        own = is_antialiased if antialiased is None else antialiased
        splats = checked_splats(scene)
        degree = checked_degree(sh_degree, splats.shN.shape[1])
        for start in range(0, len(splats.means), MODEL_TILE):
            part = slice(start, start + MODEL_TILE)
            yield pack_splats(splats, part, shift, antialiased=own, sh_degree=degree)


class GpuRenderer:
    """Renders a scene in memory of a GPU; buffers are kept from one image to the next.

    Args:
        scene: the scene.
        records_max: maximum number of splats per slice of depth; `None`: what the largest buffer holds.
        pairs_max: maximum number of pairs per step; `None`: likewise.
    """

    def __init__(self, scene: GpuScene, *, records_max: int | None = None, pairs_max: int | None = None) -> None:
        self.scene = scene
        self.device = device = scene.device
        slots = max(1, scene.block_count * BLOCK)
        self._records = min(slots, device.binding_max // _RECORD_BYTES - 1, _MOST_RECORDS, records_max or slots)
        self._pairs_max = min(device.binding_max // 4, _MOST_PAIRS, pairs_max or _MOST_PAIRS)
        self._pairs_wanted = _LEAST_PAIRS
        self._pairs = 0
        self._size = (0, 0)
        self._view = device.buffer(_VIEW.itemsize, uniform=True)
        self._counters = device.buffer(_COUNTERS.itemsize)
        self._groups = device.buffer(_GROUPS_BYTES, indirect=True)
        self._blocks = device.buffer(_BLOCK_BYTES * scene.block_count)
        self._depths = device.buffer(_WORD_BYTES << _DEPTH_BITS)
        # The last record draws nothing, see bin.wgsl.
        self._ellipses, self._looks = (device.buffer(_RECORD_BYTES * (self._records + 1)) for _ in range(2))
        keys, values = ([device.buffer(_WORD_BYTES * self._records) for _ in range(2)] for _ in range(2))
        self._order = values[0]
        self._sums = device.buffer(_WORD_BYTES * -(-self._records // BLOCK))
        self._pair_counts = device.buffer(_WORD_BYTES * self._records)
        self._projection = self._stages_of_projection(keys, values)
        self._count_depths = [
            device.bind("cull", "count_depths", page.blocks, *self._page_buffers(page), None, self._depths)
            for page in scene.pages
        ]
        self.pixels: Any = None
        self._ranges: Any = None
        self._clear: list[Call] = []
        self._step: list[Stage] = []

    def render(self, camera: Camera, *, background: ArrayLike = (0.0, 0.0, 0.0)) -> GpuRender:
        """Render an image.

        Args:
            camera: the camera to render from.
            background: red, green, blue of the background.

        Raises:
            LimitError: more splats than the buffers hold have the same depth, or the image is too wide for them.
            InputError: the background is invalid, or the GPU has not enough memory.
        """
        colour = checked_background(background)
        rgb, alpha = np.empty((camera.H, camera.W, 3), np.float32), np.empty((camera.H, camera.W), np.float32)
        visible = pairs = steps = 0
        for rows in self.bands(camera):
            counts = self.draw(camera, rows)
            pixels = self.device.read(self.pixels, _PIXEL_BYTES * len(rows) * camera.W).view(np.float32)
            pixels = pixels.reshape(len(rows), camera.W, 4)
            transmittance = np.abs(pixels[..., 3:])  # negative for finished pixels
            rgb[rows.start : rows.stop] = pixels[..., :3] + transmittance * colour
            alpha[rows.start : rows.stop] = 1 - transmittance[..., 0]
            visible, pairs, steps = visible + counts[0], pairs + counts[1], steps + counts[2]
        return GpuRender(rgb, alpha, self.scene.ignored, visible, pairs, steps)

    def bands(self, camera: Camera) -> list[range]:
        """Return the rows of an image in bands that fit the buffers, after making room for the pixels of a band."""
        columns = -(-camera.W // _SCREEN_TILE)
        widest = min(self.device.binding_max // (_PIXEL_BYTES * _SCREEN_TILE), self._pairs_max // BLOCK * _SCREEN_TILE)
        if columns * _SCREEN_TILE > widest:
            raise LimitError("pixels of a row on the GPU", camera.W, widest)
        rows = widest // (columns * _SCREEN_TILE)
        height = min(camera.H, rows * _SCREEN_TILE)
        self._make_room(camera.W, height)
        return [range(start, min(camera.H, start + height)) for start in range(0, camera.H, height)]

    def draw(self, camera: Camera, rows: range, times: dict[str, float] | None = None) -> tuple[int, int, int]:
        """Draw a band of an image to `pixels`.

        Args:
            camera: the camera.
            rows: a band from the last call of `bands`.
            times: the milliseconds of each stage are added to it; this needs timestamps. `None`: none are measured.

        Returns:
            The numbers of visible splats, pairs and steps.
        """
        device = self.device
        self.scene.place(view_vector(camera))
        view = self._view_of(camera, rows)
        device.upload(self._view, view)
        device.run(self._clear)
        visible = pairs = steps = 0
        for first_key, last_key in self._slices(view):
            view["first_key"], view["last_key"] = first_key, last_key
            device.upload(self._view, view)
            stages = self._projection + self._step
            while True:
                self._run_stages(stages, times)
                counters = device.read(self._counters, _COUNTERS.itemsize).view(_COUNTERS)[0]
                slice_count = int(counters["visible"])
                if slice_count > self._records:
                    raise InputError(f"{device.adapter} failed: {slice_count} splats in a slice of {self._records}")
                pairs, steps = pairs + int(counters["pairs"]), steps + 1
                if int(counters["first_block"]) * BLOCK >= slice_count:
                    break
                self._pairs_wanted = min(2 * self._pairs, self._pairs_max)  # the next image gets larger buffers
                stages = self._step
            visible += slice_count
        return visible, pairs, steps

    def time(self, camera: Camera) -> dict[str, float]:
        """Render an image, and return the milliseconds of each stage on the GPU, without reading the image back.

        Raises:
            InputError: the GPU has no timestamps.
        """
        times: dict[str, float] = {}
        for rows in self.bands(camera):
            self.draw(camera, rows, times)
        return times

    def _run_stages(self, stages: list[Stage], times: dict[str, float] | None) -> None:
        """Run stages, whose ranges of pairs are set to 0 first; with `times`, wait and add the milliseconds of each."""
        if times is None:
            self.device.run([call for _, calls in stages for call in calls], clear=[self._ranges])
            return
        for (name, _), spent in zip(stages, self.device.time(stages, clear=[self._ranges]), strict=True):
            times[name] = times.get(name, 0.0) + spent

    def _view_of(self, camera: Camera, rows: range) -> NDArray[Any]:
        """Return the uniform `View`, a scalar of `_VIEW`, of a band of an image, with a single slice of all depths.

        It has the room for pairs of the last `_make_room`, so `bands` must be called before.
        """
        values = view_vector(camera)
        view = np.zeros((), _VIEW)
        view["rows"][:, :3] = values[:9].reshape(3, 3)
        view["focal"] = values[12:16] - (0, 0, 0, rows.start)
        view["slopes"] = values[17:21]
        view["size"] = camera.W, len(rows)
        view["near"] = camera.near
        view["sh_degree"] = _ALL_BANDS
        view["last_key"] = _LAST_KEY
        columns = -(-camera.W // _SCREEN_TILE)
        view["screen_tiles_x"], view["screen_tiles"] = columns, columns * -(-len(rows) // _SCREEN_TILE)
        view["records"], view["pairs"] = self._records, self._pairs
        scene = self.scene
        view["blocks"], view["block_table"], view["tile_table"] = scene.block_count, scene.block_table, scene.tile_table
        return view

    def _slices(self, view: NDArray[Any]) -> list[tuple[int, int]]:
        """Return the first and last key of each slice of depth, with at most as many splats as the records hold.

        If the records hold the whole scene, there is one slice, and nothing is counted on the GPU.
        """
        starts = [0]
        if self.scene.block_count * BLOCK > self._records:
            self._find_starts(view.copy(), starts, 0, (0, _LAST_KEY), _KEY_BITS - _DEPTH_BITS)
        return list(zip(starts, [start - 1 for start in starts[1:]] + [_LAST_KEY], strict=True))

    def _find_starts(self, view: NDArray[Any], starts: list[int], count: int, keys: tuple[int, int], shift: int) -> int:
        """Append the first keys of further slices, from splats by the upper bits of their keys.

        Args:
            view: the view; its slice is changed.
            starts: the first keys so far.
            count: number of splats since the last of these.
            keys: the first and last key of the search.
            shift: number of lower bits that are left out.

        Returns:
            The number of splats since the last start.

        Raises:
            LimitError: more splats than the records hold have the same depth.
        """
        view["first_key"], view["last_key"], view["depth_shift"] = *keys, shift
        self.device.upload(self._view, view)
        self.device.run(self._count_depths, clear=[self._depths])
        counts = self.device.read(self._depths, _WORD_BYTES << _DEPTH_BITS).view(np.uint32)
        for place in np.flatnonzero(counts):
            key, key_count = keys[0] + (int(place) << shift), int(counts[place])
            if count + key_count <= self._records:
                count += key_count
            elif shift:
                last = min(keys[1], key + (1 << shift) - 1)
                count = self._find_starts(view, starts, count, (key, last), max(0, shift - _DEPTH_BITS))
            elif key_count > self._records:
                raise LimitError("splats of equal depth on the GPU", key_count, self._records)
            else:
                starts.append(key)
                count = key_count
        return count

    def _page_buffers(self, page: Page) -> tuple[Any, ...]:
        """Return the buffers of bindings 0 to 3 of the passes over a page, see cull.wgsl and project.wgsl."""
        return self._view, page.info, self.scene.tiles, page.words

    def _stages_of_projection(self, keys: list[Any], values: list[Any]) -> list[Stage]:
        """Return the stages that find the visible splats of a slice, project them and sort them by depth.

        Args:
            keys: two buffers of `records` depths; the sort alternates between them.
            values: two buffers of indices of records; after the sort, the first has the order of depth.
        """
        bind, scene = self.device.bind, self.scene
        culls = [bind("cull", "cull", page.blocks, *self._page_buffers(page), self._blocks) for page in scene.pages]
        projections = [
            bind(
                "project", "project", page.blocks,
                *self._page_buffers(page), page.words, scene.tables, self._blocks, self._ellipses, self._looks, keys[0],
            )
            for page in scene.pages
        ]  # fmt: skip
        compact = bind("compact", "compact", 1, self._view, self._counters, self._blocks)
        after = bind("dispatch", "after_compact", 1, self._view, self._counters, self._groups)
        return [
            ("cull", [*culls, compact, after]),
            ("project", projections),
            ("depth sort", self._passes_of_sort(keys, values, _DEPTH_KEY_BITS, _SORT_RECORDS, of_pairs=False)),
        ]

    def _passes_of_sort(
        self, keys: list[Any], values: list[Any], bits: int, groups: int, *, of_pairs: bool
    ) -> list[Call]:
        """Return the passes of a sort by the lower `bits` of the keys, for the GPU to run in this order.

        Args:
            keys, values: two buffers each, of which the first are sorted; the result is in those of the number of
                digits modulo 2.
            bits: number of bits of the keys; rounded up to whole digits.
            groups: row of the table of workgroups, such as `_SORT_PAIRS`.
            of_pairs: sort pairs of splat and tile; otherwise records, whose values are initially 0, 1, 2, ...
        """
        device = self.device
        table = device.buffer(_WORD_BYTES * _DIGITS * (1 + -(-keys[0].size // (_WORD_BYTES * _RUN))))
        calls = []
        for digit in range(-(-bits // _DIGIT_BITS)):
            radix = device.uploaded(
                np.array([_DIGIT_BITS * digit, of_pairs, digit == 0 and not of_pairs, 0], np.uint32), uniform=True
            )  # `Pass` of sort.wgsl
            a, b = digit % 2, 1 - digit % 2
            here = self._groups, _GROUP_COUNT_BYTES * groups
            calls += [
                device.bind("sort", "count", here, radix, self._counters, keys[a], None, None, None, table),
                device.bind("sort", "scan", _DIGITS, radix, self._counters, keys[a], None, None, None, table),
                device.bind(
                    "sort", "scatter", here, radix, self._counters, keys[a], values[a], keys[b], values[b], table
                ),
            ]
        return calls

    def _make_room(self, width: int, height: int) -> None:
        """Set up the buffers whose size depends on the image, and the passes that use them, unless they fit already.

        If the GPU has too little memory for the pairs that are wanted, half of them are tried, and `_pairs_max` is
        lowered for good.

        Args:
            width, height: size of a band, pixels.

        Raises:
            InputError: the GPU has too little memory even so.
        """
        columns, rows = -(-width // _SCREEN_TILE), -(-height // _SCREEN_TILE)
        least = BLOCK * columns * rows  # pairs of a block whose splats touch all screen tiles, so that a step takes it
        pairs = max(min(self._pairs_wanted, self._pairs_max), least)
        if (width, height) == self._size and pairs == self._pairs:
            return
        self._size, self._pairs, self._clear, self._step = (0, 0), 0, [], []
        self.pixels = self._ranges = None
        try:
            self._allocate(width, height, pairs)
        except InputError:
            if pairs == least:
                raise
            pairs = self._pairs_max = max(least, pairs // 2)  # there is no room for more
            self._allocate(width, height, pairs)

    def _allocate(self, width: int, height: int, pairs: int) -> None:
        """Set up what `_make_room` needs: `pixels`, `_ranges`, `_clear` and `_step`; then set `_size` and `_pairs`.

        Args:
            width, height: size of a band, pixels.
            pairs: room for pairs of splat and screen tile.
        """
        columns, rows = -(-width // _SCREEN_TILE), -(-height // _SCREEN_TILE)
        device, bind = self.device, self.device.bind
        self.pixels = device.buffer(_PIXEL_BYTES * width * height)
        self._ranges = device.buffer(_RANGE_BYTES * columns * rows)
        keys, values = ([device.buffer(_WORD_BYTES * pairs) for _ in range(2)] for _ in range(2))
        bits = max(1, (columns * rows - 1).bit_length())
        sorted_side = -(-bits // _DIGIT_BITS) % 2  # the buffers that hold the result of the sort
        records = self._ellipses, self._looks
        splats = self._view, self._counters, self._order, *records, self._sums, self._pair_counts
        blocks = self._groups, _GROUP_COUNT_BYTES * _BLOCKS_OF_RANKS
        clearing_columns = -(-width * height // (_CLEARED_PIXELS * _CLEARING_ROWS))
        self._clear = [
            bind("dispatch", "clear_pixels", (clearing_columns, _CLEARING_ROWS), self._view, None, None, self.pixels)
        ]
        bins = [
            bind("bin", "count", blocks, *splats),
            bind("bin", "scan", 1, self._view, self._counters, None, None, None, self._sums),
            bind("dispatch", "after_scan", 1, None, self._counters, self._groups),
            bind("bin", "emit", blocks, *splats, keys[0], values[0]),
        ]  # fmt: skip
        sort = self._passes_of_sort(keys, values, bits, _SORT_PAIRS, of_pairs=True)
        find = bind(
            "ranges",
            "find",
            (self._groups, _GROUP_COUNT_BYTES * _SORT_PAIRS),
            self._counters,
            keys[sorted_side],
            self._ranges,
        )
        blend = bind(
            "blend", "blend", (columns, rows), self._view, *records, values[sorted_side], self._ranges, self.pixels
        )
        following = bind("dispatch", "next_step", 1, None, self._counters)
        self._step = [("bin", bins), ("tile sort", [*sort, find]), ("blend", [blend, following])]
        self._size, self._pairs = (width, height), pairs
