"""Scenes tile by tile, in memory for a few tiles and the codebooks."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder.codebooks import read_codebooks
from csplat.decoder.header import SceneHeader, Tile
from csplat.decoder.job import Job, model_of, prepare, read_side_chunks, read_texts, thread_count
from csplat.decoder.limits import Limits, check_budget, float_bytes
from csplat.decoder.reconstruct import Arrays, opacity_table, write_tile
from csplat.decoder.stated import StatedErrors
from csplat.decoder.tiles import read_tile
from csplat.inputs import LetGo
from csplat.model import SplatModel

if TYPE_CHECKING:
    from csplat.inputs import File


@dataclass(frozen=True)
class DecodedTile:
    """One tile's splats, arrays of its own.

    Attributes:
        tile: its record.
        means: [n, 3] float32.
        quats: [n, 4] float32, w, x, y, z.
        scales: [n, 3] float32, natural logarithms.
        opacities: [n] float32.
        sh0: [n, 3] float32.
        shN: [n, K, 3] float32.
        extra: [n] each, by name.
    """

    tile: Tile
    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    sh0: NDArray[np.float32]
    shN: NDArray[np.float32]
    extra: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Opened:
    """A file whose chunks are checked but for those of the tiles, which are decoded when they are asked for.

    Attributes:
        facts: the scene without its splats.
        options: what the encoder was asked (`None`: not stated).
        stated_errors: errors that the file states (`None`: likewise).
        job: the file.
        threads: as of `decode`.
    """

    facts: SplatModel
    options: dict[str, Any] | None
    stated_errors: StatedErrors | None
    job: Job
    threads: int | None

    @property
    def header(self) -> SceneHeader:
        """Header and index."""
        return self.job.header

    def models(self, tiles: Sequence[int] | None = None) -> Iterator[SplatModel]:
        """Decode tiles one after the other: a model each, which says what `facts` does.

        Args:
            tiles: places of the tiles wanted, in the order wanted; all if left out.
        """
        header = self.header
        chosen = header.tiles if tiles is None else [header.tiles[place] for place in tiles]
        texts = self.facts.metadata, self.facts.cameras
        for _, arrays in _iterate(replace(self.job, tiles=chosen), self.threads):
            yield model_of(header, arrays, texts)


def iter_tiles(
    data: File,
    *,
    limits: Limits | None = None,
    tiles: Sequence[int] | None = None,
    sh_degree: int | None = None,
    threads: int = 1,
) -> Iterator[DecodedTile]:
    """Decode tile by tile, in memory for one tile of each thread and the codebooks.

    An iteration over all tiles checks every chunk but the tiles' own before it gives the first; damage of a tile
    shows when it is its turn. `limits.bytes` applies to one tile at a time.

    Args:
        data: as of `decode`; a path or an `mmap` need not fit the memory.
        limits: as of `decode`.
        tiles: as of `decode`.
        sh_degree: as of `decode`.
        threads: how many tiles are decoded at the same time.
    """
    job = _prepared(data, limits, tiles, sh_degree)

    def every() -> Iterator[DecodedTile]:
        read_side_chunks(job)
        if job.whole:
            read_texts(job)
        for tile, arrays in _iterate(job, threads):
            yield DecodedTile(tile, **vars(arrays))

    return every()


def open_tiles(data: File, *, limits: Limits | None = None, threads: int | None = None) -> Opened:
    """Open a file to go through its splats tile by tile.

    Args:
        data: as of `iter_tiles`.
        limits: as of `iter_tiles`.
        threads: as of `decode`. Tiles come in their order, whatever the threads.

    Raises:
        CsplatError: as of `decode`; of a damaged tile its models do, when it is its turn.
    """
    job = _prepared(data, limits, None, None)
    header = job.header
    options, stated = read_side_chunks(job)
    empty = model_of(header, Arrays.empty(0, job.degree, header), read_texts(job))
    return Opened(empty, options, stated, job, threads)


def _prepared(data: File, limits: Limits | None, tiles: Sequence[int] | None, sh_degree: int | None) -> Job:
    job = prepare(data, limits, tiles, sh_degree)
    splat_bytes = float_bytes(job.header, job.degree)
    check_budget(job.header, job.tiles, job.degree, splat_bytes, job.limits, whole=job.whole, at_once=False)
    return job


def _iterate(job: Job, threads: int | None) -> Iterator[tuple[Tile, Arrays]]:
    """Decode tiles in their order; the error of the first one at fault is raised, whatever the threads."""
    header = job.header
    with np.errstate(all="ignore"):
        books = read_codebooks(job.view, header, job.tiles, job.degree)
    table = opacity_table(header.attribute(_spec.ATTRIBUTE_OPACITIES))
    let_go = LetGo(job.view)

    def decoded(tile: Tile) -> tuple[Tile, Arrays]:
        arrays = Arrays.empty(tile.splat_count, job.degree, header)
        with np.errstate(all="ignore"):
            write_tile(read_tile(job.view, header, tile, job.degree, books), header, job.degree, table, arrays)
        return tile, arrays

    for done in _in_order(decoded, job.tiles, thread_count(threads, len(job.tiles))):
        let_go.after(sum(layer.size for layer in done[0].layers.values()))
        yield done


def _in_order(
    decoded: Callable[[Tile], tuple[Tile, Arrays]], tiles: Sequence[Tile], threads: int
) -> Iterator[tuple[Tile, Arrays]]:
    if threads == 1:
        yield from map(decoded, tiles)
        return
    waiting: deque[Future[tuple[Tile, Arrays]]] = deque()
    with ThreadPoolExecutor(threads, "csplat") as pool:
        try:
            for tile in tiles:
                waiting.append(pool.submit(decoded, tile))
                if len(waiting) > threads:  # one more than are at work: nobody waits for whoever takes the tiles
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
