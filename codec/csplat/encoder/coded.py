"""A scene whose tiles are coded: a complete file but for the metadata about itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.codebook import Books
from csplat.encoder.container import write
from csplat.encoder.measure import ErrorSums, measured_sums
from csplat.encoder.scene import chosen_settings, file_chunks, file_scene, stated_errors
from csplat.encoder.shape_tables import shape_book
from csplat.encoder.tile import EncodedTile, encode_tile
from csplat.encoder.tiling import Tile
from csplat.errors import counted
from csplat.model import SplatModel
from csplat.types import Progress

if TYPE_CHECKING:
    from csplat.encoder.draft import Draft


_FEW_TILES, _SMALL_TILE = 16, 256  # tiles, and splats of a tile, below which the user is not warned


@dataclass(frozen=True)
class EncodeReport:
    """Choices of the encoder and what they cost.

    Attributes:
        options: what the caller asked for, and the steps and codings that followed; the file holds it too.
        errors: (max, rms) by measure, as the file declares them (spec 5.5).
        splat_count: splats of the file. tile_count: its tiles. size_bytes: its size.
        notes: what a user should know in addition to the errors, a sentence each.
    """

    options: dict[str, Any]
    errors: dict[str, tuple[float, float]]
    splat_count: int
    tile_count: int
    size_bytes: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class EncodeResult:
    """A file, and which source splat each of its splats is.

    Attributes:
        data: the file.
        source_index: [N] int64; row i of the decoded arrays is row source_index[i] of the model, or of the one that
            its `Origin` counts the splats of.
        report: choices and errors.
    """

    data: bytes
    source_index: NDArray[np.int64]
    report: EncodeReport


@dataclass(frozen=True, eq=False)
class Coded:
    """Tiles of a file.

    Attributes:
        draft: all that was decided.
        books: codebooks of the whole file.
        tiles: coded.
        errors: that the file states.
    """

    draft: Draft
    books: Books
    tiles: Sequence[EncodedTile]
    errors: ErrorSums

    @classmethod
    def of(
        cls, draft: Draft, books: Books, *, errors: ErrorSums | None = None, progress: Progress | None = None
    ) -> Coded:
        """Code the tiles of a draft whose plan is complete.

        Args:
            draft: everything but SH, whose coding its plan names.
            books: SH codebooks.
            errors: errors to declare; `None`: those of the coding.
            progress: as in `Draft.of`.
        """
        tiles = _coded_tiles(draft, books, progress)
        errors = errors or ErrorSums.total(part.errors for part in tiles)
        if draft.shapes is not None:
            record, chunk = shape_book(draft.shapes, draft.plan.coding)
            books = replace(books, records=[*books.records, record], chunks=[*books.chunks, chunk])
        return cls(draft, books, tiles, errors)

    @property
    def source_index(self) -> NDArray[np.int64]:
        """Index in the source of each splat of the file, [N] in decoding order."""
        rows = np.concatenate([part.rows for part in self.tiles]) if self.tiles else np.zeros(0, np.int64)
        index: NDArray[np.int64] = self.draft.origin.source_index[rows]
        return index

    def against(self, source: SplatModel, decoded: SplatModel) -> Coded:
        """The same, but stating errors against a scene that the encoder was not shown.

        Args:
            source: the scene that the origin counts the splats of.
            decoded: what the file decodes to.
        """
        return replace(self, errors=measured_sums(source, decoded, self.source_index))

    def write(self, said: Mapping[str, Any] | None = None) -> EncodeResult:
        """Write the file. This takes no time compared with coding: do it twice if a file is to record its own PSNR.

        Args:
            said: metadata to add to the options of the encoder, JSON-compatible, by a name for each.

        Raises:
            InputError: an error that no file can state.
        """
        draft, plan = self.draft, self.draft.plan
        settings = {**(said or {}), **chosen_settings(draft, self.books.tables)}
        chunks = file_chunks(draft, self.errors, settings)
        data = write(file_scene(draft, self.books, chunks), [part.tile for part in self.tiles])
        stated = stated_errors(self.errors, draft.origin)
        notes = notes_on(self.tiles, strict=plan.lattice.strict)
        report = EncodeReport(settings, stated, self.errors.count, len(self.tiles), len(data), notes)
        return EncodeResult(data, self.source_index, report)


def _coded_tiles(draft: Draft, books: Books, progress: Progress | None) -> list[EncodedTile]:
    model, tiles, threads = draft.model, draft.tiles, draft.options.thread_count
    done = 0

    def one(tile: Tile) -> EncodedTile:
        nonlocal done
        coded = encode_tile(model, tile, draft.plan, books.tables, draft.shapes)
        done += len(tile.rows)
        if progress is not None:
            progress("tiles", done / max(1, len(model)))
        return coded

    if threads == 1 or len(tiles) < 2:
        return [one(tile) for tile in tiles]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(one, tiles))


def notes_on(tiles: Sequence[EncodedTile], *, strict: bool) -> tuple[str, ...]:
    """Report values so large that their tile's lattice had to be coarser, which took precision from their neighbours.

    Report also a bound of the means that is finer than 16 bits of a tile of many splats, so that tiles hold few.
    """
    notes = []
    splats = sum(part.tile.splat_count for part in tiles)
    if strict and len(tiles) > max(_FEW_TILES, splats // _SMALL_TILE):
        notes.append(
            f"means: so small an error takes {counted(len(tiles), 'tile')}, each of which takes bytes of its own"
        )
    counts = Counter(name for part in tiles for name in part.coarsened)
    notes += [
        f"{name}: huge values coarsen {count} of {counted(len(tiles), 'tile')}; remove them, or see the stated errors"
        for name, count in sorted(counts.items())
    ]
    return tuple(notes)
