# SPDX-License-Identifier: Apache-2.0
"""Read parts of a file on disk, in memory or at a URL: header and index first, then requested parts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from csplat import _spec
from csplat.byte_store import FileWindow, Store
from csplat.context import DEFAULT_CONTEXT
from csplat.decoder import (
    DecodedTile,
    Limits,
    Node,
    read_header,
)
from csplat.decoder.budget import check_budget
from csplat.decoder.codebooks import wanted_codebooks
from csplat.decoder.container import SceneHeader, Tile, check_length, read_file_header
from csplat.decoder.decode_api import (
    DecodeRequest,
    decode_request,
    prepare_decode,
    request_packed,
    request_tiles,
)
from csplat.decoder.metadata import DeclaredBounds, bounds_chunk, json_chunk, scene_metadata
from csplat.decoder.reconstruct import boxes_touching, tile_boxes
from csplat.decoder.resource_level import float_bytes
from csplat.decoder.tiles import wanted_layers
from csplat.decoder.tree import read_nodes, select_tiles
from csplat.errors import InputError, counted
from csplat.file_source import File
from csplat.lint import Finding
from csplat.model import SplatModel, trusted_model
from csplat.packed import PackedTile
from csplat.remote_store import open_store
from csplat.scene import Scene
from csplat.scene_metadata import SRGB, SceneMetadata
from csplat.types import F64

_T = TypeVar("_T")


class SplatFile(Scene):
    """A `.csplat` file opened by `csplat.open`; parts of it can be read.

    The parts read are checked as in a decode. The scene is level 0.

    Attributes:
        header: header and index.
    """

    header: SceneHeader

    def __init__(self, store: Store, limits: Limits, head: bytes = b"") -> None:
        self._store = store
        self._limits = limits
        self._open = True
        with self._store.named_errors():
            window = FileWindow(store, head)
            self._head = _read_head(store, window, limits)
            self.header = header = read_header(window.view, limits=limits)
        self.count, self.sh_degree, self.origin = header.splat_count, header.sh_degree, header.origin
        self.extra = {column.name: column.splat_dtype for column in header.extras if column.dtype is not None}
        self.reader, self.has_doubles, self.file_axes = self.models, False, ""
        self.format, self.name, self.size_bytes = "csplat", store.name, store.size
        self.findings, self.in_memory, self.modified_ns = [], None, 0
        if header.coarse_tiles:
            self.findings.append(_levels_finding(header, "level 0 alone is read"))
        self.findings += _drawing_findings(header)

    @classmethod
    def open(cls, file: File, *, limits: Limits | None = None, storage: Mapping[str, Any] | None = None) -> SplatFile:
        """Open a `.csplat` file; arguments and errors as in `csplat.open`, which also opens other formats."""
        store = open_store(file, storage)
        try:
            return cls(store, limits or Limits())
        except BaseException:
            store.close()
            raise

    def __repr__(self) -> str:
        return f"SplatFile({self.name!r}, {self.count} splats)"

    @property
    def requests(self) -> int:
        """Number of requests to the store so far, including the request for the size of a file at a URL."""
        return self._store.requests

    @property
    def bytes_read(self) -> int:
        """Number of bytes read so far."""
        return self._store.bytes_read

    @cached_property
    def levels(self) -> tuple[int, ...]:  # type: ignore[override]  # requires the TREE chunk
        """Number of splats of each level of detail, finest first; empty if there is only level 0."""
        last = max((tile.level for tile in self.header.coarse_tiles), default=0)
        cuts = [select_tiles(self.header, self.nodes, level=level) for level in range(last + 1)] if last else []
        return tuple(sum(tile.splat_count for tile in tiles) for tiles in cuts)

    @cached_property
    def boxes(self) -> F64:
        """Boxes around the centres of each tile of level 0: [T, 2, 3] float64, scene units, relative to the origin.

        Their sides go through decoded centres, which are numbers of binary32.
        """
        return tile_boxes(self.header, self.header.tiles)

    @cached_property
    def nodes(self) -> tuple[Node, ...]:
        """Nodes of the levels of detail, read on first access.

        A file without levels has a single node, or no node if it has no tiles.

        Raises:
            FormatError: the TREE chunk breaks a clause.
        """
        with self._store.named_errors():
            window = self.window()
            window.fetch(self._chunk_ranges(_spec.CHUNK_TREE))
            return read_nodes(window.view, self.header)

    @cached_property
    def metadata(self) -> SceneMetadata:  # type: ignore[override]
        """Metadata of the scene; read on first access."""
        with self._store.named_errors():
            window = self.window()
            window.fetch(self._chunk_ranges(_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS))
            return scene_metadata(window.view, self.header, self._limits)

    @cached_property
    def options(self) -> dict[str, Any] | None:
        """The encoder's record of its options, if any; read on first access."""
        with self._store.named_errors():
            window = self.window()
            window.fetch(self._chunk_ranges(_spec.CHUNK_OPTIONS))
            options: dict[str, Any] | None = json_chunk(
                window.view, self.header, _spec.CHUNK_OPTIONS, self._limits.json_bytes
            )
            return options

    @cached_property
    def declared_bounds(self) -> DeclaredBounds | None:
        """Declared error bounds, if there are any; read on first access."""
        with self._store.named_errors():
            window = self.window()
            window.fetch(self._chunk_ranges(_spec.CHUNK_DECLARED_ERRORS))
            return bounds_chunk(window.view, self.header)

    def loaded(self) -> SplatFile:
        """Return this file after decoding all splats and reading their metadata and bounds; it may then be closed."""
        if self.in_memory is None:
            self.in_memory = self.read()
        _ = self.metadata, self.declared_bounds
        return self

    def close(self) -> None:
        """Close the file."""
        self._open = False
        self._store.close()
        super().close()

    def cut(
        self,
        *,
        level: int | None = None,
        pixel_size: float | Sequence[float] | None = None,
        max_splats: int | None = None,
        box: Sequence[float] | None = None,
    ) -> list[int]:
        """Select the tiles of a version of the scene, coarser where less detail is needed, for `read`.

        Only one of `level`, `pixel_size` and `max_splats` can be given. Default: `level=0`.

        Args:
            level: highest level of detail to use; 0 is the scene.
            pixel_size: size of a pixel in scene units, for all nodes or for each of `nodes`. Selects the coarsest
                version that looks like the scene at this size.
            max_splats: maximum number of splats. Selects the version with the smallest errors.
            box: as in `tiles`. Tiles of level 0 are selected if their splats touch it. Tiles of other levels are
                selected if the splats of level 0 that they replace touch it.

        Returns:
            Indices of tiles, ascending.

        Examples:
            >>> import csplat
            >>> with csplat.open("scene.csplat") as file:  # at a URL, only the tiles of the cut are fetched
            ...     coarse = file.read(tiles=file.cut(max_splats=5_000))  # this file has level 0 alone
            >>> len(coarse)
            1000

        Raises:
            InputError: an argument is invalid, or no tile touches the box.
            LimitError: the coarsest version has more than `max_splats` splats.
            FormatError: the TREE chunk breaks a clause.
        """
        corners = None if box is None else box_corners(box)
        chosen = select_tiles(
            self.header, self.nodes, level=level, pixel_size=pixel_size, max_splats=max_splats, box=corners
        )
        if corners is not None and not chosen:
            raise _nothing_touches(self.header, corners)
        return [tile.index for tile in chosen]

    def version(self, *, level: int = 0, max_splats: int | None = None) -> Scene:
        """Return a version of the scene; coarser versions have no extra columns.

        Args:
            level: level of detail; 0 is the finest.
            max_splats: instead of a level, the version with the smallest errors among the versions of at most this
                number of splats, or the coarsest version if all have more.

        Raises:
            InputError: the scene does not have this level.
            FormatError: the TREE chunk breaks a clause.
        """
        last = len(self.levels or (0,)) - 1
        if level > last:
            wanted = "0: it has no other levels" if last == 0 else f"0 to {last}"
            raise InputError(f"{Path(self.name).name}: the level is {level}, expected {wanted}")
        if last == 0 or (level == 0 and max_splats is None):
            return self
        most = None if max_splats is None else max(max_splats, self.levels[last])
        chosen = select_tiles(self.header, self.nodes, level=None if most else level, max_splats=most)
        count = sum(tile.splat_count for tile in chosen)
        if count == self.count and not any(tile.level for tile in chosen):
            return self
        which = f"level {level} alone is read" if most is None else f"a version of {counted(count, 'splat')} is read"
        return self.changed(
            count=count,
            reader=partial(self.models, [tile.index for tile in chosen]),
            extra={},
            findings=[_levels_finding(self.header, which)],
            size_bytes=sum(layer.size for tile in chosen for layer in tile.layers.values()),
        )

    def models(self, tiles: Sequence[int] | None = None) -> Iterator[SplatModel]:
        """Decode each tile to a model with the metadata of the scene.

        A file on disk is mapped, and its tiles are decoded in threads.

        Args:
            tiles: indices of the tiles to decode, in the order requested; default: all of level 0. Coarser tiles have
                no extra columns.

        Raises:
            FormatError, LimitError: as in `csplat.decoder.iter_tiles`.
            StoreError, OSError: as in `csplat.open`.
        """
        if not self._open:
            raise InputError(f"{self.name} is closed")
        metadata, origin, data = self.metadata, self.origin, self._store.whole()
        if data is None:
            decoded = self._decode(self._default_tiles() if tiles is None else tiles, None)
        else:
            with self._store.named_errors():
                request = prepare_decode(memoryview(data), self.header, self._limits, tiles, None)
            decoded = request_tiles(request, DEFAULT_CONTEXT)
        with self._store.named_errors():
            for tile in decoded:
                arrays = {name: value for name, value in vars(tile).items() if name != "tile"}
                yield trusted_model(**arrays, origin=origin, metadata=metadata)

    def tiles(self, box: Sequence[float] | None = None, *, sh_degree: int | None = None) -> Iterator[DecodedTile]:
        """Decode tile by tile; memory holds the codebooks, a single tile and a few megabytes of the file.

        Args:
            box: region whose tiles are read; tiles that touch it, or share a point with it, are returned whole. Two
                corners, x, y, z each, in any order, possibly infinite, in scene units relative to the origin. Default:
                all tiles of level 0.
            sh_degree: highest SH band to read; default: all.

        Raises:
            InputError: an argument is invalid, or no tile touches the box.
            FormatError, LimitError: as in `csplat.decoder.iter_tiles`.
            StoreError, OSError: as in `csplat.open`.
        """
        chosen = self._default_tiles() if box is None else [tile.index for tile in tiles_touching(self.header, box)]
        return self._decode(chosen, sh_degree)

    def packed_tiles(self, tiles: Sequence[int] | None = None, *, sh_degree: int | None = None) -> Iterator[PackedTile]:
        """Decode tile by tile to integers and the tables that tiles share, as a renderer on a GPU keeps them.

        Args:
            tiles: as in `read`.
            sh_degree: as in `tiles`.

        Raises:
            InputError, FormatError, LimitError, StoreError, OSError: as in `tiles`.
        """
        chosen = self._default_tiles() if tiles is None else tiles
        with self._store.named_errors():
            window = self.window()
            request = prepare_decode(window.view, self.header, self._limits, chosen, sh_degree)
            decoded = request_packed(request)
        return self._iterate(window, request, decoded)

    def read(
        self, box: Sequence[float] | None = None, *, tiles: Sequence[int] | None = None, sh_degree: int | None = None
    ) -> SplatModel:
        """Decode the file or a part of it.

        Args:
            box: as in `tiles`.
            tiles: indices of the tiles to decode, in the order requested, such as the result of `cut`; excludes `box`.
            sh_degree: as in `tiles`.

        Examples:
            >>> import csplat
            >>> with csplat.open("scene.csplat") as file:
            ...     corner = file.read((0, 0, 0, 1, 1, 1), sh_degree=1)
            >>> len(corner) <= 1000
            True

        Raises:
            InputError: an argument is invalid, or no tile touches the box.
            FormatError, LimitError: as in `csplat.decode`.
            StoreError, OSError: as in `csplat.open`.
        """
        if box is not None:
            if tiles is not None:
                raise InputError("box and tiles exclude each other")
            tiles = [tile.index for tile in tiles_touching(self.header, box)]
        if tiles is None:
            tiles = self._default_tiles()
        with self._store.named_errors():
            window = self.window()
            request = prepare_decode(window.view, self.header, self._limits, tiles, sh_degree)
            texts = self._chunk_ranges(_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS)
            splat_bytes = float_bytes(self.header, request.degree)
            check_budget(self.header, request.tiles, request.degree, splat_bytes, self._limits, whole=request.whole)
            window.fetch([*texts, *_side_ranges(request), *_layer_ranges(request.tiles, request.degree)])
            return decode_request(request).model

    def pieces(self) -> Iterator[bytes]:
        """Yield the bytes of the file, a few megabytes at a time.

        Raises:
            StoreError, OSError: as in `csplat.open`.
        """
        store = self.window().store
        for start in range(0, store.size, store.sizes.batch):
            yield from store.read([(start, min(start + store.sizes.batch, store.size))])

    def window(self) -> FileWindow:
        """Return a view into which parts of the file can be fetched."""
        if not self._open:
            raise InputError(f"{self.name} is closed")
        return FileWindow(self._store, self._head)

    def _decode(self, tiles: Sequence[int] | None, sh_degree: int | None) -> Iterator[DecodedTile]:
        """Return an iterator over decoded tiles; tile numbers and degree are checked before the first is read."""
        with self._store.named_errors():
            window = self.window()
            request = prepare_decode(window.view, self.header, self._limits, tiles, sh_degree)
            decoded = request_tiles(request)
        return self._iterate(window, request, decoded)

    def _iterate(self, window: FileWindow, request: DecodeRequest, decoded: Iterator[_T]) -> Iterator[_T]:
        """Yield the results of `decoded` in order, after fetching the chunks of each batch that it is about to read.

        Chunks that are not of tiles are fetched with the first batch. The window keeps one batch at a time.

        Raises:
            InputError: the file was closed in the meantime.
        """
        side = _side_ranges(request)
        for batch in _batches(request.tiles, request.degree, self._store.sizes.batch):
            if not self._open:
                raise InputError(f"{self.name} is closed")
            window.forget()
            with self._store.named_errors():
                window.fetch([*side, *_layer_ranges(batch, request.degree)])
            for _ in batch:
                with self._store.named_errors():
                    tile = next(decoded)
                yield tile
            side = []
        with self._store.named_errors():
            next(decoded, None)  # checks the chunks of a scene without tiles

    def _default_tiles(self) -> Sequence[int] | None:
        """Return the tiles of level 0, or `None` for a file without other levels, which is then read as a whole."""
        return range(len(self.header.tiles)) if self.header.coarse_tiles else None

    def _chunk_ranges(self, *kinds: bytes) -> list[tuple[int, int]]:
        """Return (offset, size) of the directory's chunks of some types."""
        return [(record.offset, record.size) for record in self.header.directory if record.type in kinds]


def _levels_finding(header: SceneHeader, which: str) -> Finding:
    """Report that a file has coarser levels; `which` describes the version that is read."""
    last = max(tile.level for tile in header.coarse_tiles)
    return Finding("levels", last, f"{counted(last, 'coarser level')} of detail: {which}", "note")


def _drawing_findings(header: SceneHeader) -> list[Finding]:
    """Report a projection or a colour space that no renderer here draws."""
    projection = _spec.PROJECTION_NAMES.get(header.projection)
    space = _spec.COLOUR_SPACE_NAMES.get(header.colour_space, str(header.colour_space))
    found = []
    if projection is None:
        text = f"the projection is {header.projection}, which is unknown: drawn in perspective"
        found.append(Finding("projection", 1, text, "note"))
    if space != SRGB:
        found.append(Finding("colour-space", 1, f"the colour space is {space}: drawn as {SRGB}", "note"))
    return found


def _read_head(store: Store, window: FileWindow, limits: Limits) -> bytes:
    """Return header and index, with any data after them from the same request."""
    first = min(store.size, store.sizes.first)
    window.fetch([(0, first)])
    head = read_file_header(window.view, limits.resource_level)
    check_length(window.view, head.file_size)
    end = _spec.HEADER_SIZE + head.index_size
    if end > first:
        window.fetch([(first, end - first)])
    return bytes(window.view[: max(first, end)])


def _side_ranges(request: DecodeRequest) -> list[tuple[int, int]]:
    """Return the ranges to read in addition to tiles: their codebooks, or all other chunks for a whole file."""
    records = (
        request.header.directory if request.whole else wanted_codebooks(request.header, request.tiles, request.degree)
    )
    return [(record.offset, record.size) for record in records]


def _layer_ranges(tiles: Sequence[Tile], degree: int) -> list[tuple[int, int]]:
    """Return (offset, size) of the layer chunks that decoding to an SH degree needs."""
    return [(layer.offset, layer.size) for tile in tiles for layer in wanted_layers(tile, degree)]


def _batches(tiles: Sequence[Tile], degree: int, size_bytes: int) -> Iterator[list[Tile]]:
    """Yield batches of tiles to fetch together; without tiles, a single empty batch."""
    batch: list[Tile] = []
    size = 0
    for tile in tiles:
        added = sum(layer.size for layer in wanted_layers(tile, degree))
        if batch and size + added > size_bytes:
            yield batch
            batch, size = [], 0
        batch.append(tile)
        size += added
    yield batch


def tiles_touching(header: SceneHeader, box: Sequence[float]) -> list[Tile]:
    """Return the tiles of level 0 whose boxes touch a box.

    Args:
        header: the scene.
        box: as in `extract`.

    Raises:
        InputError: the box is not six numbers, or no tile touches it.
    """
    corners = box_corners(box)
    touching = boxes_touching(tile_boxes(header, header.tiles), corners)
    if not touching.any():
        raise _nothing_touches(header, corners)
    return [header.tiles[index] for index in np.flatnonzero(touching)]


def box_corners(box: Sequence[float]) -> F64:
    """Return the corners of a box, [2, 3], smallest first.

    Raises:
        InputError: the box is not six numbers, or a number is NaN.
    """
    try:
        numbers = [float(value) for value in box]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != 6 or any(map(math.isnan, numbers)):
        raise InputError(f"box is {box!r}, expected six numbers other than NaN: two corners, x, y, z each")
    return np.sort(np.reshape(numbers, (2, 3)), axis=0)


def _nothing_touches(header: SceneHeader, corners: F64) -> InputError:
    """Return the error for a box, corners [2, 3], that no tile touches; it states the extent of the scene."""
    low, high = corners
    extent = _extent_text(tile_boxes(header, header.tiles))
    return InputError(f"no tile touches the box {_corner_text(low)} to {_corner_text(high)}: {extent}")


def _corner_text(corner: F64) -> str:
    """Format a corner [3] for messages, with nine digits, which tell numbers of binary32 apart."""
    return ", ".join(f"{value:.9g}" for value in corner)  # tells numbers of binary32 apart


def _extent_text(boxes: F64) -> str:
    """Describe the extent of boxes [T, 2, 3] for messages."""
    if not len(boxes):
        return "the scene has no splats"
    return f"centres lie within {_corner_text(boxes[:, 0].min(axis=0))} to {_corner_text(boxes[:, 1].max(axis=0))}"
