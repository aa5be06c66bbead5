"""Read parts of a file on disk, in memory or at a URL: header and index first, then requested parts."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, Self, TypeVar

import numpy as np

from csplat import _spec
from csplat.byte_store import FileWindow, Store
from csplat.decoder import (
    DecodedTile,
    Limits,
    Node,
    decode,
    iter_packed,
    iter_tiles,
    read_cameras,
    read_header,
    read_metadata,
)
from csplat.decoder.codebooks import wanted_codebooks
from csplat.decoder.container import SceneHeader, Tile, check_length, read_file_header
from csplat.decoder.decode_api import DecodeRequest, prepare_decode
from csplat.decoder.limits import check_budget, float_bytes
from csplat.decoder.reconstruct import boxes_touching, tile_boxes
from csplat.decoder.tiles import wanted_layers
from csplat.decoder.tree import read_nodes, select_tiles
from csplat.disk_files import BinaryWriter
from csplat.errors import InputError
from csplat.file_source import File
from csplat.model import SplatModel
from csplat.packed import PackedTile
from csplat.remote_store import open_store
from csplat.tile_copy import ExtractResult, write_extract
from csplat.types import F64

_T = TypeVar("_T")


class SplatFile:
    """A `.csplat` file opened by `csplat.open` to read parts of it; a context manager.

    The parts read are checked as in a decode.

    Attributes:
        header: header and index.
    """

    header: SceneHeader

    def __init__(self, store: Store, limits: Limits) -> None:
        self._store = store
        self._limits = limits
        self._open = True
        with self._store.named_errors():
            window = FileWindow(store)
            self._head = _read_head(store, window)
            self.header = read_header(window.view)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return self.splat_count

    def __repr__(self) -> str:
        return f"SplatFile({self.name!r}, {self.splat_count} splats)"

    @property
    def splat_count(self) -> int:
        """Number of splats in the file."""
        return self.header.splat_count

    @property
    def name(self) -> str:
        """Path or URL, without secrets, for messages."""
        return self._store.name

    @property
    def size(self) -> int:
        """Size of the file, bytes."""
        return self._store.size

    @property
    def requests(self) -> int:
        """Number of requests to the store so far, including one for the size of a file at a URL."""
        return self._store.requests

    @property
    def bytes_read(self) -> int:
        """Number of bytes read so far."""
        return self._store.bytes_read

    @cached_property
    def boxes(self) -> F64:
        """Boxes around the centres of each tile of level 0: [T, 2, 3] float64, scene units, relative to the origin.

        Their sides go through decoded centres, which are numbers of binary32.
        """
        return tile_boxes(self.header, self.header.tiles)

    @cached_property
    def nodes(self) -> tuple[Node, ...]:
        """Nodes of the levels of detail, read on first access; a file without levels has one, or none without tiles.

        Raises:
            FormatError: the TREE chunk breaks a clause.
        """
        with self._store.named_errors():
            window = self.window()
            window.fetch(self._chunks(_spec.CHUNK_TREE))
            return read_nodes(window.view, self.header)

    @cached_property
    def metadata(self) -> dict[str, Any] | None:
        """Content of the META chunk, `None` if there is none; read on first access."""
        with self._store.named_errors():
            window = self.window()
            window.fetch(self._chunks(_spec.CHUNK_METADATA))
            return read_metadata(window.view, limits=self._limits)

    @cached_property
    def cameras(self) -> list[dict[str, Any]] | None:
        """Content of the CAMS chunk, `None` if there is none; read on first access."""
        with self._store.named_errors():
            window = self.window()
            window.fetch(self._chunks(_spec.CHUNK_CAMERAS))
            return read_cameras(window.view, limits=self._limits)

    def close(self) -> None:
        """Close the file."""
        self._open = False
        self._store.close()

    def cut(
        self,
        *,
        level: int | None = None,
        pixel_size: float | Sequence[float] | None = None,
        max_splats: int | None = None,
        box: Sequence[float] | None = None,
    ) -> list[int]:
        """Select the tiles of a version of the scene, coarser where less detail is needed, for `read`.

        Args:
            level: highest level of detail to use; 0 is the scene.
            pixel_size: size of a pixel in scene units, for all nodes or for each of `nodes`: the coarsest version that
                looks like the scene at this size.
            max_splats: maximum number of splats: the version with the smallest errors. Only one of `level`,
                `pixel_size` and `max_splats` can be given; default: `level=0`.
            box: as in `tiles`. Tiles of level 0 are selected if their splats touch it, tiles of other levels if the
                splats of level 0 that they stand for do.

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

    def tiles(self, box: Sequence[float] | None = None, *, sh_degree: int | None = None) -> Iterator[DecodedTile]:
        """Decode tile by tile; memory holds the codebooks, one tile and a few megabytes of the file.

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
        with self._store.named_errors():
            window = self.window()
            job = prepare_decode(window.view, self._limits, chosen, sh_degree)
            decoded = iter_tiles(window.view, limits=self._limits, tiles=chosen, sh_degree=sh_degree)
        return self._iterate(window, job, decoded)

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
            job = prepare_decode(window.view, self._limits, chosen, sh_degree)
            decoded = iter_packed(window.view, limits=self._limits, tiles=chosen, sh_degree=sh_degree)
        return self._iterate(window, job, decoded)

    def read(
        self, box: Sequence[float] | None = None, *, tiles: Sequence[int] | None = None, sh_degree: int | None = None
    ) -> SplatModel:
        """Decode the file or a part of it.

        Args:
            box: as in `tiles`.
            tiles: indices of the tiles to decode, in the order requested, such as those of `cut`; excludes `box`.
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
            job = prepare_decode(window.view, self._limits, tiles, sh_degree)
            splat_bytes = float_bytes(self.header, job.degree)
            check_budget(self.header, job.tiles, job.degree, splat_bytes, self._limits, whole=job.whole)
            texts = self._chunks(_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS)
            window.fetch([*texts, *_side(job), *_layers(job.tiles, job.degree)])
            return decode(window.view, limits=self._limits, tiles=tiles, sh_degree=sh_degree)

    def extract(self, box: Sequence[float], output: str | os.PathLike[str] | BinaryWriter) -> ExtractResult:
        """Extract the tiles that touch a box; see `csplat.extract`."""
        with self._store.named_errors():
            return write_extract(self.window(), self.header, tiles_touching(self.header, box), self.nodes, output)

    def window(self) -> FileWindow:
        """Return a view into which parts of the file can be fetched."""
        if not self._open:
            raise InputError(f"{self.name} is closed")
        return FileWindow(self._store, self._head)

    def _iterate(self, window: FileWindow, job: DecodeRequest, decoded: Iterator[_T]) -> Iterator[_T]:
        side = _side(job)
        for batch in _batches(job.tiles, job.degree, self._store.sizes.batch):
            if not self._open:
                raise InputError(f"{self.name} is closed")
            window.forget()
            with self._store.named_errors():
                window.fetch([*side, *_layers(batch, job.degree)])
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

    def _chunks(self, *kinds: bytes) -> list[tuple[int, int]]:
        return [(one.offset, one.size) for one in self.header.directory if one.type in kinds]


def open(file: File, *, limits: Limits | None = None, storage: Mapping[str, Any] | None = None) -> SplatFile:
    """Open a file to read parts of it; only header and index are read at once.

    Args:
        file: a path; a URL that fsspec supports (`https://…`, `s3://…`; requires the extra `remote`); an open binary
            file, which is read to its end; or bytes.
        limits: as in `decode`, for each part.
        storage: options of fsspec's file system for the URL: `{"endpoint_url": …, "anon": True}`.

    Examples:
        >>> import csplat
        >>> with csplat.open("scene.csplat") as file:
        ...     for tile in file.tiles(sh_degree=0):
        ...         print(len(tile.means), tile.shN.shape)
        1000 (1000, 0, 3)

    Raises:
        FormatError, UnsupportedError: as in `read_header`, or the file is shorter or longer than its header specifies.
        InputError: `file` has another type; storage options without a URL; the extra is not installed.
        StoreError: the server does not answer, does not support ranges (HTTP Range), or closes the connection, also
            when requests are repeated; or the file has changed since it was opened.
        OSError: the file does not exist or cannot be read.
    """
    store = open_store(file, storage)
    try:
        return SplatFile(store, limits or Limits())
    except BaseException:
        store.close()
        raise


def extract(
    file: File,
    box: Sequence[float],
    output: str | os.PathLike[str] | BinaryWriter,
    *,
    storage: Mapping[str, Any] | None = None,
) -> ExtractResult:
    """Write the tiles of a file that touch a box as a file of their own.

    Tiles are copied whole, including splats outside the box; values are preserved bit for bit. Nodes of a file with
    levels of detail are copied whole, those of coarser levels if everything below them is. Declared error bounds
    and the encoder's options, which refer to the whole file, are omitted, as are chunks of unknown types. Only header,
    index and the copied data are read, a few megabytes at a time.

    Args:
        file: as in `open`.
        box: two corners, x, y, z each, in any order, possibly infinite, in scene units relative to the origin.
        output: a path, written atomically and replaced if it exists; or an open binary file.
        storage: as in `open`.

    Examples:
        >>> import csplat
        >>> part = csplat.extract("scene.csplat", (-1, -1, -1, 1, 1, 1), "part.csplat")
        >>> part.splat_count == len(csplat.decode("part.csplat"))
        True

    Raises:
        InputError: the box is not six numbers, or no tile touches the box.
        FormatError: the header, the index or a copied chunk breaks a clause.
        UnsupportedError, StoreError, OSError: as in `open`, or the output cannot be written.
    """
    with open(file, storage=storage) as opened:
        return opened.extract(box, output)


def _read_head(store: Store, window: FileWindow) -> bytes:
    """Return header and index, with any data after them from the same request."""
    first = min(store.size, store.sizes.first)
    window.fetch([(0, first)])
    head = read_file_header(window.view)
    check_length(window.view, head.file_size)
    end = _spec.HEADER_SIZE + head.index_size
    if end > first:
        window.fetch([(first, end - first)])
    return bytes(window.view[: max(first, end)])


def _side(job: DecodeRequest) -> list[tuple[int, int]]:
    """Return the ranges to read in addition to tiles: their codebooks, or all other chunks for a whole file."""
    records = job.header.directory if job.whole else wanted_codebooks(job.header, job.tiles, job.degree)
    return [(record.offset, record.size) for record in records]


def _layers(tiles: Sequence[Tile], degree: int) -> list[tuple[int, int]]:
    return [(layer.offset, layer.size) for tile in tiles for layer in wanted_layers(tile, degree)]


def _batches(tiles: Sequence[Tile], degree: int, size_bytes: int) -> Iterator[list[Tile]]:
    """Yield batches of tiles to fetch together, at least one, which may be empty."""
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
    found = boxes_touching(tile_boxes(header, header.tiles), corners)
    if not found.any():
        raise _nothing_touches(header, corners)
    return [header.tiles[index] for index in np.flatnonzero(found)]


def box_corners(box: Sequence[float]) -> F64:
    """Return the corners of a box, [2, 3], smallest first.

    Raises:
        InputError: the box is not six numbers, or one is NaN.
    """
    try:
        numbers = [float(value) for value in box]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != 6 or any(map(math.isnan, numbers)):
        raise InputError(f"box is {box!r}, expected six numbers other than NaN: two corners, x, y, z each")
    return np.sort(np.reshape(numbers, (2, 3)), axis=0)


def _nothing_touches(header: SceneHeader, corners: F64) -> InputError:
    low, high = corners
    extent = _extent_text(tile_boxes(header, header.tiles))
    return InputError(f"no tile touches the box {_corner_text(low)} to {_corner_text(high)}: {extent}")


def _corner_text(corner: F64) -> str:
    return ", ".join(f"{value:.9g}" for value in corner)  # tells numbers of binary32 apart


def _extent_text(boxes: F64) -> str:
    """Return the extent of the splats, for messages."""
    if not len(boxes):
        return "the scene has no splats"
    return f"centres lie within {_corner_text(boxes[:, 0].min(axis=0))} to {_corner_text(boxes[:, 1].max(axis=0))}"
