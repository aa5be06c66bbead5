# SPDX-License-Identifier: Apache-2.0
"""Encode a planned scene to a file in two steps, `encode_tiles` and `EncodedTiles.write`.

The second step takes almost no time, so that a file can be written, measured, and written again with its own PSNR.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from io import BytesIO
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.context import Context
from csplat.disk_files import atomic_writer
from csplat.encoder import entropy
from csplat.encoder.coding_parameters import CodingParameters, StepFactors
from csplat.encoder.container import (
    FileChunk,
    FileNode,
    FileTile,
    SceneFields,
    file_pieces,
    json_payload,
    tile_payload,
    tree_chunk,
)
from csplat.encoder.encode_plan import EncodePlan, Origin
from csplat.encoder.error_bounds import (
    ErrorSums,
    covariance_errors,
    distance_errors,
    measured_sums,
    take_precise_means,
    value_errors,
)
from csplat.encoder.quantisation import check_finite, lattice_values, opacity_levels, opacity_values, quantise_colour
from csplat.encoder.sh_codebook import FileCodebooks, ShCodingPlan, assign_splats, encode_sh
from csplat.encoder.shape_codebook import (
    SHAPE_CODEBOOK_ID,
    ShapeCodebook,
    ShapePart,
    quantise_shape,
    shape_blocks,
    shape_codebook_chunk,
)
from csplat.encoder.target import SearchReport
from csplat.encoder.tiling import QuantisedTile, TileSplats, quantise_and_sort
from csplat.errors import InputError, counted
from csplat.model import SplatModel
from csplat.portable_math import exp
from csplat.scene_metadata import COLOUR_SPACES, UNSPECIFIED
from csplat.types import F32, Progress, null_progress

Integers = NDArray[Any]

_ALONE = Context(threads=1)  # tiles are shared among threads
_NOTED_TILE_MIN = 48  # splats of a tile whose means may cause a note; fewer are outliers
_SMALL = 0.1  # fraction of the splats of a tile that count as small
_NOTED_ERROR = 2.0  # displacement relative to the size of small splats; presets have at most 1.1 in ordinary scenes
_FEW_TILES, _SMALL_TILE = 16, 256  # more tiles than this, with fewer splats per tile on average, cause a note
_COLOUR_MEASURES = tuple(_spec.MEASURE_NAMES[id] for id in range(_spec.MEASURE_SH0, _spec.MEASURE_SH4 + 1))
_SHAPE_MEASURES = tuple(_spec.MEASURE_NAMES[id] for id in (_spec.MEASURE_COVARIANCE, _spec.MEASURE_OPACITIES))


@dataclass(frozen=True)
class EncodeReport:
    """Choices of the encoder, and the resulting errors and size.

    Attributes:
        options: the caller's options, and the steps and codings chosen; the OPTS chunk of the file.
        errors: declared (max, rms) by measure (spec 5.5).
        splat_count: number of splats in the file.
        tile_count: number of tiles in the file.
        size_bytes: size of the file.
        notes: warnings for the user, one sentence each.
        search: the search for a target; `None` without one.
    """

    options: dict[str, Any]
    errors: dict[str, tuple[float, float]]
    splat_count: int
    tile_count: int
    size_bytes: int
    notes: tuple[str, ...] = ()
    search: SearchReport | None = None


@dataclass(frozen=True, eq=False, repr=False)
class EncodeResult:
    """An encoded scene.

    Attributes:
        report: choices and errors.
        content: the bytes of the file; `None` if the scene was encoded on disk.
        rows: `source_index`; `None` likewise.
    """

    report: EncodeReport
    content: bytes | None = None
    rows: NDArray[np.int64] | None = None

    def __repr__(self) -> str:
        quality = "" if self.psnr is None else f", {self.psnr:.2f} dB"
        return f"EncodeResult({self.size_bytes:,} bytes, {self.report.splat_count:,} splats{quality})"

    @property
    def data(self) -> bytes:
        """The bytes of the file.

        Raises:
            InputError: the scene was encoded on disk, and only the file has them.
        """
        if self.content is None:
            raise InputError("the scene was encoded on disk: its bytes are in the file")
        return self.content

    @property
    def source_index(self) -> NDArray[np.int64]:
        """[N] int64; row i of the decoded arrays is row source_index[i] of the model or its `Origin`.

        Raises:
            InputError: the scene was encoded on disk, where the order of splats is not recorded.
        """
        if self.rows is None:
            raise InputError("the scene was encoded on disk, where the order of splats is not recorded")
        return self.rows

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return self.report.size_bytes

    @property
    def psnr(self) -> float | None:
        """PSNR on the test views of a search against renders of the source, dB; `None` if nothing was rendered."""
        return None if self.report.search is None else self.report.search.psnr

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file; it appears under its name only when complete.

        Raises:
            OSError: the file cannot be written.
        """
        with atomic_writer(path) as stream:
            stream.write(self.data)

    def largest_error(self, measure: str) -> float:
        """Return the largest error that the file declares for a measure; 0 if the scene has no such attribute."""
        return self.report.errors.get(measure, (0.0, 0.0))[0]

    def with_search(self, search: SearchReport) -> EncodeResult:
        """Return the same file with the report of a search."""
        return replace(self, report=replace(self.report, search=search))

    def with_notes(self, *notes: str) -> EncodeResult:
        """Return the same file with notes added to its report."""
        return replace(self, report=replace(self.report, notes=(*self.report.notes, *notes)))


@dataclass(frozen=True)
class EncodedTile:
    """An encoded tile.

    Attributes:
        tile: index record and payloads.
        rows: [n], rows of the model in decoding order.
        errors: errors of the splats.
        coarsened: attributes with such large values that the tile's lattice is coarser; and means that move by more
            than `_NOTED_ERROR` times the size of the smallest tenth of the splats.
    """

    tile: FileTile
    rows: NDArray[np.intp]
    errors: ErrorSums
    coarsened: frozenset[str]


@dataclass(frozen=True, eq=False)
class EncodedTiles:
    """An encoded scene before the file is written.

    Attributes:
        plan: the complete plan.
        codebooks: codebooks of the file.
        tiles: the tiles of the scene.
        errors: errors to declare.
        nodes: nodes of the levels of detail with their tiles, by ascending level; empty if there is only one level.
    """

    plan: EncodePlan
    codebooks: FileCodebooks
    tiles: Sequence[EncodedTile]
    errors: ErrorSums
    nodes: Sequence[FileNode] = ()

    @property
    def source_index(self) -> NDArray[np.int64]:
        """Index in the source of each splat of the file, [N] in decoding order."""
        rows = np.concatenate([part.rows for part in self.tiles]) if self.tiles else np.zeros(0, np.int64)
        index: NDArray[np.int64] = self.plan.origin.source_index[rows]
        return index

    def against(self, source: SplatModel, decoded: SplatModel) -> EncodedTiles:
        """Return the same tiles with declared errors that refer to another scene than the encoded scene.

        Args:
            source: the scene that the plan's `Origin` refers to.
            decoded: the decoded file.
        """
        return replace(self, errors=measured_sums(source, decoded, self.source_index))

    def write(self, metadata: Mapping[str, Any] | None = None) -> EncodeResult:
        """Return the file.

        Args:
            metadata: JSON-compatible entries to add to the OPTS chunk.

        Raises:
            InputError: an error is too large to be declared.
        """
        stream = BytesIO()
        report = self.write_to(stream, metadata)
        return EncodeResult(report, stream.getvalue(), self.source_index)

    def part(self, nodes: Sequence[FileNode]) -> bytes:
        """Return a file of the tiles of some nodes alone, as one level without extra columns, in their order."""
        tiles = [
            replace(
                tile, level=0,
                layers={layer: payload for layer, payload in tile.layers.items() if layer < _spec.LAYER_EXTRA},
            )
            for node in nodes
            for tile in node.tiles
        ]  # fmt: skip
        return b"".join(file_pieces(scene_fields(replace(self.plan, extras=()), self.codebooks, []), tiles))

    def write_to(
        self, stream: BinaryIO, metadata: Mapping[str, Any] | None = None, progress: Progress = null_progress
    ) -> EncodeReport:
        """Write the file to a stream; arguments and errors as in `write`."""
        settings = {**(metadata or {}), **encoding_settings(self.plan, self.codebooks.sh_plan)}
        chunks = file_chunks(self.plan, self.errors, settings)
        tiles = [part.tile for part in self.tiles]
        if self.nodes:
            tiles = [tile for node in self.nodes for tile in node.tiles]
        if any(tile.level for tile in tiles):
            chunks.append(tree_chunk(self.nodes))
        scene = scene_fields(self.plan, self.codebooks, chunks)
        size, payloads = 0, sum(len(payload) for tile in tiles for payload in tile.layers.values())
        for piece in file_pieces(scene, tiles):
            stream.write(piece)
            size += len(piece)
            progress("writing", min(1.0, size / max(1, payloads)))
        plan = self.plan
        bounded, measured = plan.parameters.lattice.error is not None, plan.importance is not None
        notes = make_notes(self.tiles, bounded=bounded, measured=measured)
        errors = declared_errors(self.errors, self.plan.origin)
        return EncodeReport(settings, errors, self.errors.count, len(tiles), size, notes)


def encode_tiles(
    plan: EncodePlan,
    codebooks: FileCodebooks | None = None,
    *,
    errors: ErrorSums | None = None,
) -> EncodedTiles:
    """Encode the tiles of a scene, which is most of the work.

    Args:
        plan: the plan.
        codebooks: SH codebooks, if the plan's SH coding is chosen; `None`: choose it now.
        errors: errors to declare; `None`: the errors of the tiles.

    Raises:
        InputError: a value fits no lattice.
    """
    if codebooks is None:
        plan, codebooks = plan.choose_sh_coding()
    tiles = _encode_all(plan, codebooks.sh_plan)
    errors = errors or ErrorSums.total(part.errors for part in tiles)
    if plan.shapes is not None and not any(book.id == SHAPE_CODEBOOK_ID for book in codebooks.records):
        record, chunk = shape_codebook_chunk(plan.shapes, plan.parameters.deflate)
        codebooks = replace(codebooks, records=[*codebooks.records, record], chunks=[*codebooks.chunks, chunk])
    return EncodedTiles(plan, codebooks, tiles, errors)


def _encode_all(plan: EncodePlan, sh_plan: ShCodingPlan) -> list[EncodedTile]:
    """Encode the tiles, one per thread at a time, and return them in their order; the progress counts splats."""
    threads, done = plan.context.thread_count, 0

    def encode_one(tile: TileSplats) -> EncodedTile:
        nonlocal done
        encoded = encode_tile(plan.model, tile, plan.parameters, sh_plan, plan.shapes)
        done += len(tile.rows)
        plan.context.progress("tiles", done / max(1, len(plan.model)))
        return encoded

    if threads == 1 or len(plan.tiles) < 2:
        return [encode_one(tile) for tile in plan.tiles]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(encode_one, plan.tiles))


def make_notes(tiles: Sequence[EncodedTile], *, bounded: bool, measured: bool) -> tuple[str, ...]:
    """Return warnings about outliers that coarsen their neighbours, small splats that move far, and many tiles.

    Args:
        tiles: the tiles of level 0.
        bounded: the caller specified a `position_error`.
        measured: steps follow the importance of splats, so that those that move far are hardly seen.
    """
    notes = []
    splats = sum(part.tile.splat_count for part in tiles)
    if bounded and len(tiles) > max(_FEW_TILES, splats // _SMALL_TILE):
        notes.append(f"means: such a small error takes {counted(len(tiles), 'tile')}, and each tile costs bytes")
    moved = [part for part in tiles if "means" in part.coarsened]
    if moved and not bounded and not measured:
        most = max(part.errors.largest["means"] for part in moved)
        notes.append(
            f"means: errors of up to {most:.3g} are twice as large as the small splats in {len(moved)} of"
            f" {counted(len(tiles), 'tile')}, which blurs close views: bound the error of means"
        )
    counts = Counter(name for part in tiles for name in part.coarsened - {"means"})
    notes += [
        f"{name}: huge values coarsen {count} of {counted(len(tiles), 'tile')}; remove them, or see the declared errors"
        for name, count in sorted(counts.items())
    ]
    return tuple(notes)


def encode_tile(
    model: SplatModel,
    tile: TileSplats,
    parameters: CodingParameters,
    sh_plan: ShCodingPlan,
    shapes: ShapeCodebook | None = None,
) -> EncodedTile:
    """Quantise, code and measure one tile (spec 5.2).

    Args:
        model: the whole scene.
        tile: rows and steps of the tile.
        parameters: lattices and codings of the file.
        sh_plan: SH coding of the file.
        shapes: shape codebook of the file; `None` without a codebook.
    """
    result = _TileResult(parameters, tile.factors)
    quantised = quantise_and_sort(model, tile, parameters)
    rows = quantised.rows
    splats = model.select(rows)
    sh_plan = assign_splats(sh_plan, splats, parameters, _ALONE) if sh_plan.of_sample else sh_plan.select(rows)
    part = None if shapes is None else shapes.part(rows)
    result.add_opacities(splats.opacities)
    max_scale = result.add_shapes(splats.quats, splats.scales, part)
    result.add_means(take_precise_means(model, rows), quantised, math.ldexp(parameters.lattice.step, tile.exponent))
    if len(rows) >= _NOTED_TILE_MIN and result.largest["means"] > _NOTED_ERROR * _small_size(splats.scales):
        result.coarsened.add("means")
    result.add_sh0(splats.sh0)
    layers: dict[int, list[bytes]] = {_spec.ATTRIBUTE_LAYER[_spec.ATTRIBUTE_SH0]: result.blocks}
    used: tuple[int, ...] = () if part is None else (SHAPE_CODEBOOK_ID,)
    if model.sh_degree:
        blocks, exponent, errors = encode_sh(splats.shN, parameters, sh_plan)
        layers |= {layer: [block] for layer, block in blocks.items()}
        used = (*sh_plan.codebook_ids, *used)
        if exponent:
            result.coarsened.add("shN")
        for measure, pair in errors.items():
            result.add_errors(measure, pair)
    for layer, name in enumerate(sh_plan.extras, _spec.LAYER_EXTRA):
        layers[layer] = [entropy.raw_block(splats.extra[name], parameters.deflate)]
    corner, extent = quantised.corner, quantised.q.max(axis=1)
    file_tile = FileTile(
        splat_count=len(rows),
        exponent=tile.exponent,
        corner=(int(corner[0]), int(corner[1]), int(corner[2])),
        extent=(int(extent[0]), int(extent[1]), int(extent[2])),
        max_scale=max_scale,
        layers={layer: tile_payload(layer, parts) for layer, parts in layers.items()},
        codebook_ids=used,
    )
    return EncodedTile(
        file_tile, rows, ErrorSums(len(rows), result.largest, result.squares), frozenset(result.coarsened)
    )


def _small_size(scales: F32) -> float:
    """Return the `_SMALL` quantile of the largest standard deviations of splats, of their log scales [n, 3]."""
    largest = scales.max(axis=1)
    rank = int(len(largest) * _SMALL)
    return float(exp(float(np.partition(largest, rank)[rank])))


@dataclass
class _TileResult:
    """Blocks and errors of a tile, added attribute by attribute in the order of the blocks."""

    parameters: CodingParameters
    factors: StepFactors
    blocks: list[bytes] = field(default_factory=list)
    largest: dict[str, float] = field(default_factory=dict)
    squares: dict[str, float] = field(default_factory=dict)
    coarsened: set[str] = field(default_factory=set)

    def add_errors(self, measure: str, errors: tuple[float, float]) -> None:
        """Set the largest error and the sum of squares of a measure."""
        self.largest[measure], self.squares[measure] = errors

    def add_opacities(self, opacities: F32) -> None:
        """Add the alphas [n]."""
        levels = self.parameters.opacity_levels
        q = opacity_levels(opacities, levels, square=self.parameters.square_opacities, multiple=self.factors.opacities)
        self.blocks.append(entropy.levels_block(q, self.parameters.deflate))
        self.add_errors(
            "opacities", value_errors(opacities, opacity_values(q, levels, square=self.parameters.square_opacities))
        )

    def add_shapes(self, quats: F32, scales: F32, part: ShapePart | None) -> float:
        """Add scales and rotations; return the largest decoded log scale."""
        shape = quantise_shape(quats, scales, self.parameters, part, self.factors)
        if shape.exponent > self.factors.scales:
            self.coarsened.add("scales")
        check_finite("scales", shape.decoded_scales)
        self.blocks.extend(shape_blocks(shape.scales, shape.exponent, shape.quats, part, self.parameters.deflate))
        self.add_errors("covariance", covariance_errors(quats.T, scales.T, shape.decoded_quats, shape.decoded_scales))
        return float(shape.decoded_scales.max())

    def add_means(self, source: NDArray[Any], quantised: QuantisedTile, step: float) -> None:
        """Add the means.

        Args:
            source: [n, 3], the means before quantisation, as precise as they are known.
            quantised: their integers, sorted.
            step: scene units per lattice unit of the tile.

        Raises:
            InputError: a decoded mean leaves float32.
        """
        q, deflate = quantised.q, self.parameters.deflate
        if quantised.codes is None:
            self.blocks.append(entropy.axis_block(q, deflate))
        else:
            self.blocks.append(entropy.morton_block(quantised.codes, max(1, int(q.max()).bit_length()), deflate))
        decoded = lattice_values(q + quantised.corner[:, None], step)
        check_finite("means", decoded)
        self.add_errors("means", distance_errors(np.ascontiguousarray(source.T), decoded))

    def add_sh0(self, sh0: F32) -> None:
        """Add the coefficients [n, 3]; raise an `InputError` if a decoded coefficient leaves float32."""
        parameters, source = self.parameters, np.ascontiguousarray(sh0.T)
        columns, exponent, decoded = quantise_colour(
            source, parameters.sh0_step, parameters.chroma_shift, self.factors.sh0
        )
        if exponent > self.factors.sh0:
            self.coarsened.add("sh0")
        self.blocks.append(entropy.offset_block(_spec.ATTRIBUTE_SH0, columns, exponent, parameters.deflate))
        check_finite("sh0", decoded)
        self.add_errors("sh0", value_errors(source, decoded))


def encoding_settings(plan: EncodePlan, sh_plan: ShCodingPlan) -> dict[str, Any]:
    """Return the content of the OPTS chunk: the caller's options and the encoder's choices."""
    parameters, options, shapes = plan.parameters, plan.options, plan.shapes
    return {
        "asked": options.chosen(),
        "encoder": _versions(parameters),
        "position_step": parameters.lattice.step,
        "position_bits": parameters.lattice.bits,
        "means_coding": "morton" if parameters.morton else "axis",
        "scale_step": parameters.scale_step,
        "opacity_levels": parameters.opacity_levels,
        "quat_levels": parameters.quat_levels,
        "sh0_step": parameters.sh0_step,
        "sh_step": parameters.sh_step,
        "sh_degree": parameters.sh_degree,
        "sh_coding": parameters.sh_coding,
        "chroma_shift": parameters.chroma_shift,
        "adaptive": parameters.adaptive if parameters.sh_coding == "scalar" else 0.0,
        "codebook_size": 0 if sh_plan.book is None else sh_plan.book.size,
        **({} if shapes is None else {"shape_codebook_size": shapes.size}),
        **({} if shapes is None else {"shape_escape_fraction": float(shapes.escaped.mean())}),
        **({} if plan.classes is None else {"classes": plan.classes.as_json()}),
        "deflate_level": parameters.deflate.level,
        "deflate": parameters.deflate.library,
        "seed": plan.context.seed,
    }


def declared_errors(errors: ErrorSums, origin: Origin) -> dict[str, tuple[float, float]]:
    """Return (max, rms) by measure, without errors of refitted values, which have no meaning."""
    declared = errors.declared()
    if not origin.refitted:
        return declared
    fitted = (*_COLOUR_MEASURES, *_SHAPE_MEASURES) if origin.adjusted else _COLOUR_MEASURES
    return {name: pair for name, pair in declared.items() if name not in fitted}


def file_chunks(plan: EncodePlan, errors: ErrorSums, settings: dict[str, Any]) -> list[FileChunk]:
    """Return the chunks other than tiles and codebooks: metadata, cameras, options, declared errors."""
    metadata, deflate, chunks = plan.model.metadata, plan.parameters.deflate, []
    try:
        if metadata.entries:
            chunks.append(FileChunk(_spec.CHUNK_METADATA, json_payload(dict(metadata.entries), deflate)))
        if metadata.cameras is not None:
            chunks.append(FileChunk(_spec.CHUNK_CAMERAS, json_payload(list(metadata.cameras), deflate)))
    except (TypeError, ValueError) as problem:
        raise InputError(f"metadata or cameras cannot be written as JSON: {problem}") from None
    chunks.append(FileChunk(_spec.CHUNK_OPTIONS, json_payload(settings, deflate)))
    chunks.append(FileChunk(_spec.CHUNK_DECLARED_ERRORS, _declared_errors_chunk(plan, errors)))
    return chunks


def scene_fields(plan: EncodePlan, codebooks: FileCodebooks, chunks: Sequence[FileChunk]) -> SceneFields:
    """Return the scene fields of header and index."""
    metadata, parameters = plan.model.metadata, plan.parameters
    directions = {letter: id for id, letter in _spec.DIRECTION_LETTER.items()}
    letters = ("", "", "") if metadata.coordinate_system == UNSPECIFIED else tuple(metadata.coordinate_system)
    return SceneFields(
        sh_degree=parameters.sh_degree,
        scene_flags=_spec.SCENE_FLAG_FLAT if metadata.flat else 0,
        axes=bytes(directions[letter] for letter in letters),
        unit_metres=metadata.unit_metres or 0.0,
        origin=plan.model.origin,
        attributes=parameters.attribute_records(),
        antialiasing=_spec.ANTIALIASING_MIP if metadata.antialiased else _spec.ANTIALIASING_NONE,
        colour_space=COLOUR_SPACES[metadata.colour_space],
        extras=plan.extras,
        codebooks=codebooks.records,
        chunks=[*chunks, *codebooks.chunks],
    )


def _declared_errors_chunk(plan: EncodePlan, errors: ErrorSums) -> bytes:
    """Return the payload of SERR: counts of the source, and the errors in the order of their ids (spec 5.5)."""
    model, origin = plan.model, plan.origin
    ids = {name: id for id, name in _spec.MEASURE_NAMES.items()}
    bounds = sorted((ids[name], *pair) for name, pair in declared_errors(errors, origin).items())
    count = origin.source_count
    flags = _spec.ERROR_FLAG_REFITTED if origin.refitted else 0
    head = _spec.DeclaredErrorsHead(count, count - errors.count, model.sh_degree, flags, len(bounds))
    records = [_spec.pack_declared_error_record(_spec.DeclaredErrorRecord(id, 0, 0, 0, *pair)) for id, *pair in bounds]
    return _spec.pack_declared_errors_head(head) + b"".join(records)


def _versions(parameters: CodingParameters) -> str:
    """Return the versions of csplat and NumPy, and the library of DEFLATE, which determine the bytes of a file."""
    from importlib.metadata import PackageNotFoundError, version  # takes a tenth of the import time of the encoder

    try:
        own = version("csplat")
    except PackageNotFoundError:
        own = "unpackaged"
    return f"csplat {own}, numpy {np.__version__}, {parameters.deflate.library}"
