# SPDX-License-Identifier: Apache-2.0
"""Describe a file without decoding it, for `csplat info`.

Only the heads of the blocks of a .csplat file are read. Nothing is inflated and no CRC is computed, so that a
memory-mapped file of any size is described at once. Every length is checked against the remaining bytes.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from mmap import mmap
from pathlib import Path
from typing import Any

import numpy as np

import csplat
from csplat import _spec
from csplat.decoder import (
    DeclaredBounds,
    ExtraColumn,
    SceneHeader,
    read_declared_bounds,
    read_header,
    read_metadata,
    read_options,
)
from csplat.decoder.container import EXTRA_LAYERS
from csplat.decoder.reconstruct import tile_boxes
from csplat.decoder.tree import read_nodes
from csplat.disk_files import finite_or_none, size_on_disk
from csplat.errors import FormatError
from csplat.formats import format_by_name
from csplat.scene import Scene
from csplat.scene_metadata import ESTIMATED, SRGB, TRAINING, UP, VIEW, SceneMetadata
from csplat.types import F64
from csplat_tools.console import format_bytes
from csplat_tools.scene_files import findings_as_json

_NULLABLE = ("bits_per_splat",)  # values that the JSON contains even if they are `None`
_STREAM_CLAUSE = "STR-6"
_MIDDLE = 0.9  # share of the splats in the second box, on each axis: without those far away
_SAMPLE_MAX = 1_000_000  # splats of a PLY by which the second box is found; all would take 24 bytes each
_OFFSET_SIZE = 4  # bytes of a column's offset, i32


@dataclass(frozen=True)
class Span:
    """A range of integers, both ends included."""

    min: int
    max: int


@dataclass
class AttributeUsage:
    """The bytes and codings of one attribute, over all tiles.

    Attributes:
        block_bytes: size of the blocks in tiles: heads, parameters and streams.
        codebook_bytes: size of the codebook chunks with the attribute's columns.
        codings, coders: number of blocks or streams that use each, by name.
        escaped_count: number of splats coded as escapes instead of codebook entries.
    """

    block_bytes: int = 0
    codebook_bytes: int = 0
    codings: Counter[str] = field(default_factory=Counter)
    coders: Counter[str] = field(default_factory=Counter)
    escaped_count: int = 0

    @property
    def size_bytes(self) -> int:
        """All bytes of the attribute."""
        return self.block_bytes + self.codebook_bytes


@dataclass(frozen=True)
class AttributeSummary:
    """The size and coding of one attribute.

    Attributes:
        size_bytes: all bytes of the attribute.
        codebook_bytes: bytes of its codebook columns, included in `size_bytes`.
        bits_per_splat: average over all splats; `None` without splats.
        codings, coders: number of blocks or streams that use each, by name.
        escaped_splats: number of splats coded as escapes instead of codebook entries.
        mapping, step, chroma_shift, levels: fields of the attribute's record, if any.
    """

    size_bytes: int
    codebook_bytes: int
    bits_per_splat: float | None
    codings: Mapping[str, int]
    coders: Mapping[str, int]
    escaped_splats: int
    mapping: str | None = None
    step: float | None = None
    chroma_shift: int | None = None
    levels: int | None = None


@dataclass(frozen=True)
class LayerSummary:
    """The size of a layer, including its codebook chunks."""

    size_bytes: int
    codebook_bytes: int
    bits_per_splat: float | None
    tiles: int


@dataclass(frozen=True)
class CodebookSummary:
    """A codebook: its kind, the SH bands that it covers, the number of entries, and the bytes of its chunks."""

    id: int
    kind: str
    bands: Sequence[int]
    entries: int
    size_bytes: int


@dataclass(frozen=True)
class LevelSummary:
    """A level of detail: nodes, tiles, splats, bytes of its tiles, smallest and largest error of its nodes."""

    level: int
    nodes: int
    tiles: int
    splats: int
    size_bytes: int
    errors: tuple[float, float]


@dataclass(frozen=True)
class FileDescription:
    """The content of a .csplat file; sizes in bytes.

    Attributes:
        header: header and index.
        attributes, layers: attributes and layers by name, in the order of the registry; of all levels of detail.
        levels: levels of detail, finest first; empty if level 0 is the only level.
        codebooks: codebooks in the order of the index.
        overhead: bytes outside attributes, by name: header, index, chunks of the whole file by type, layers of unknown
            ids if there are any, frames of the tiles' chunks.
        metadata: metadata of the scene.
        options: the encoder's record of its options; `None` if there is none.
        declared_bounds: the declared error bounds, and counts of the source.
    """

    header: SceneHeader
    attributes: Mapping[str, AttributeSummary]
    layers: Mapping[str, LayerSummary]
    levels: Sequence[LevelSummary]
    codebooks: Sequence[CodebookSummary]
    overhead: Mapping[str, int]
    metadata: SceneMetadata
    options: Mapping[str, Any] | None
    declared_bounds: DeclaredBounds | None

    @property
    def bytes_per_splat(self) -> float | None:
        """Size of the whole file divided by the number of splats; `None` without splats."""
        count = self.header.splat_count
        return self.header.file_size / count if count else None

    @property
    def spans(self) -> dict[str, Span]:
        """Ranges of splat counts, lattice exponents and bits per axis over the tiles; empty without tiles."""
        tiles = self.header.tiles
        columns = {
            "splats": [tile.splat_count for tile in tiles],
            "exponents": [tile.exponent for tile in tiles],
            "bits_per_axis": [max(extent.bit_length() for extent in tile.extent) for tile in tiles],
        }
        return {name: Span(min(values), max(values)) for name, values in columns.items() if values}

    def box(self, share: float = 1.0) -> list[float] | None:
        """Return a box around the centres of splats, in scene units relative to the origin, as `--box` takes it.

        Args:
            share: least share of the splats of level 0 that it covers on each axis, 0 to 1: tiles are left out at both
                ends while all of them have at most half of the rest.

        Returns:
            x, y, z of the smallest corner, then of the largest; `None` without splats.
        """
        boxes = tile_boxes(self.header, self.header.tiles)
        if not len(boxes):
            return None
        counts = np.array([tile.splat_count for tile in self.header.tiles])

        def end(sides: F64) -> F64:
            passed = np.cumsum(counts[np.argsort(sides, axis=0)], axis=0)
            first = np.argmax(passed > (1 - share) / 2 * counts.sum(), axis=0)
            chosen: F64 = np.sort(sides, axis=0)[first, range(3)]
            return chosen

        return [*end(boxes[:, 0]).tolist(), *(-end(-boxes[:, 1])).tolist()]

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        header, tiles = self.header, self.header.tiles
        metadata, up = self.metadata, self.metadata.up
        largest = {"max_scale": finite_or_none(max(tile.max_scale for tile in tiles))} if tiles else {}
        return {
            "format": "csplat",
            "format_version": f"{header.version[0]}.{header.version[1]}",
            "profile": header.profile,
            "resource_level": header.resource_level,
            "size_bytes": header.file_size,
            "bytes_per_splat": self.bytes_per_splat,
            "splats": header.splat_count,
            "sh_degree": header.sh_degree,
            "coordinate_system": header.coordinate_system,
            "up": None if up is None else list(up),
            "unit_metres": header.unit_metres,
            "origin": list(header.origin),
            "box": self.box(),
            "kernel": header.kernel,
            "projection": _spec.PROJECTION_NAMES.get(header.projection, str(header.projection)),
            "antialiasing": _spec.ANTIALIASING_NAMES.get(header.antialiasing, str(header.antialiasing)),
            "colour_space": metadata.colour_space,
            "antialiased": header.antialiased,
            "flat": header.flat,
            "attributes": {
                name: {key: value for key, value in asdict(summary).items() if value is not None or key in _NULLABLE}
                for name, summary in self.attributes.items()
            },
            "layers": {name: asdict(layer) for name, layer in self.layers.items()},
            "levels": [asdict(level) for level in self.levels],
            "overhead": dict(self.overhead),
            "codebooks": [asdict(codebook) for codebook in self.codebooks],
            "extra_columns": [asdict(extra) for extra in header.extras],
            "tiles": len(tiles),
            "tile_ranges": {**{name: asdict(span) for name, span in self.spans.items()}, **largest},
            "chunks": [
                {"type": chunk.type.decode("ascii"), "size_bytes": chunk.size, "offset_bytes": chunk.offset}
                for chunk in header.directory
            ],
            "cameras": None if metadata.cameras is None else len(metadata.cameras),
            "options": self.options,
            "metadata": dict(metadata.entries),
            **_bounds_as_json(self.declared_bounds),
        }


def describe_file(data: bytes | mmap) -> FileDescription:
    """Describe a .csplat file by its header, its index, the heads of its blocks, and its small chunks.

    Args:
        data: the whole file; only a small part is read.

    Raises:
        FormatError: header, index, a block head or a small chunk is not valid.
        LimitError: metadata, cameras or options are larger than the decoder's budget.
    """
    header = read_header(data)
    use = attribute_usage(data, header)
    attributes = {name: _summarise_attribute(header, name, usage) for name, usage in use.items()}
    return FileDescription(
        header,
        attributes,
        _summarise_layers(header),
        _summarise_levels(data, header),
        [_summarise_codebook(header, record) for record in header.codebooks],
        _overhead_sizes(header, use),
        read_metadata(data),
        read_options(data),
        read_declared_bounds(data),
    )


def describe_other_format(path: Path) -> tuple[dict[str, Any], str]:
    """Describe a scene in any format without reading its splats, except those of a PLY, whose box is found.

    Returns:
        JSON-compatible values, and the same as text.

    Raises:
        InputError: the file is in no readable format, or truncated.
        OSError: the file cannot be read.
    """
    with csplat.open(path) as scene:
        metadata, size, count = scene.metadata, size_on_disk(path), scene.count
        per_splat = size / count if count else None
        boxes = _boxes_of_splats(scene) if scene.format == "ply" and count else (None, None)
        report = {
            "format": scene.format,
            "size_bytes": size,
            "bytes_per_splat": per_splat,
            "splats": count,
            "levels": [{"level": level, "splats": splats} for level, splats in enumerate(scene.levels)],
            "sh_degree": scene.sh_degree,
            "coordinate_system": metadata.coordinate_system,
            "file_axes": scene.file_axes or metadata.coordinate_system,
            "origin": list(scene.origin),
            **({"box": whole} if (whole := boxes[0]) else {}),
            "unit_metres": metadata.unit_metres,
            "antialiased": metadata.antialiased,
            "flat": metadata.flat,
            "extra_columns": [
                {"name": name, "dtype": dtype.base.str, "components": math.prod(dtype.shape)}
                for name, dtype in scene.extra.items()
            ],
            "metadata": dict(metadata.entries),
            "findings": findings_as_json(scene.findings),
        }
        average = "" if per_splat is None else f", {per_splat:.2f} bytes per splat"
        words = describe_placement(scene, count, metadata) | _describe_boxes(*boxes)
        if scene.file_axes:
            words["axes"] = f"{scene.file_axes}, read as {metadata.coordinate_system}"
        if scene.levels:
            words["levels"] = f"{' / '.join(f'{splats:,}' for splats in scene.levels)} splats (csplat convert --level)"
        if scene.extra:
            words["extra"] = ", ".join(f"{name} ({describe_dtype(dtype)})" for name, dtype in scene.extra.items())
        if metadata.entries:
            words["metadata"] = json.dumps(metadata.entries, sort_keys=True)
        lines = [f"{format_by_name(scene.format).title}, {format_bytes(size)}{average}"]
        lines += [f"{name:12} {value}" for name, value in words.items()]
        lines += [str(finding) for finding in scene.findings if not finding.usual]
    return report, "\n".join(lines)


def bytes_by_attribute(data: bytes | mmap, header: SceneHeader) -> dict[str, int]:
    """Return the bytes of each attribute, and of everything else as `overhead`.

    Raises:
        FormatError: heads contradict each other.
    """
    use = attribute_usage(data, header)
    return {
        **{name: usage.size_bytes for name, usage in use.items()},
        "overhead": sum(_overhead_sizes(header, use).values()),
    }


def attribute_usage(data: bytes | mmap, header: SceneHeader) -> dict[str, AttributeUsage]:
    """Add up the bytes and codings of each attribute.

    Returns:
        Usage by attribute name, in the order of the registry. A codebook of several attributes other than SH bands
        counts with the first.

    Raises:
        FormatError: heads contradict each other, or the file is truncated or has trailing bytes.
    """
    if len(data) < header.file_size:
        raise FormatError(
            _spec.ERROR_TRUNCATED, len(data), "HDR-5", found=f"{len(data)} bytes", wanted=f"{header.file_size} bytes"
        )
    if len(data) > header.file_size:
        raise FormatError(
            _spec.ERROR_TRAILING, header.file_size, "HDR-6", found=f"{len(data)} bytes", wanted=f"{header.file_size}"
        )
    codebooks = {record.codebook_id: record for record in header.codebooks}
    use: dict[int, AttributeUsage] = {}
    for tile in header.all_tiles:
        for layer in (tile.layers[id_] for id_ in tile.layers if not header.skips(id_)):
            _walk_tile(_Cursor(data, layer.offset, layer.size), codebooks, use)
    for chunk in header.directory:
        if chunk.type == _spec.CHUNK_CODEBOOK:
            attribute = _first_attribute(codebooks[chunk.id], chunk.layer)
            use.setdefault(attribute, AttributeUsage()).codebook_bytes += chunk.size
    return {_spec.ATTRIBUTE_NAMES[id_]: use[id_] for id_ in sorted(use)}


def format_headline(file: FileDescription) -> str:
    """Return a headline: format version, profile, resource level, size, bytes per splat."""
    header, per_splat = file.header, file.bytes_per_splat
    average = "" if per_splat is None else f", {per_splat:.2f} bytes per splat"
    version = f"csplat {header.version[0]}.{header.version[1]}"
    level = f"resource level {header.resource_level}"
    return f"{version}, profile {header.profile}, {level}, {format_bytes(header.file_size)}{average}"


def describe_dtype(dtype: np.dtype[Any]) -> str:
    """Describe the type of an extra column: `float32`, or `3 × float32` for several values of a splat."""
    return f"{dtype.shape[0]} × {dtype.base}" if dtype.shape else str(dtype)


def _describe_column(column: ExtraColumn) -> str:
    """Describe an extra column by its name, type and semantic."""
    kind = "unknown type or coding" if column.dtype is None else describe_dtype(column.splat_dtype)
    return f"{column.name} ({kind}{column.semantic and f', {column.semantic}'})"


def describe_scene(file: FileDescription) -> dict[str, str]:
    """Describe the scene in words, by title."""
    header = file.header
    words = describe_placement(header, header.splat_count, file.metadata)
    words |= _describe_boxes(file.box(), file.box(_MIDDLE))
    words["tiles"] = _describe_tiles(file)
    if header.extras:
        words["extra"] = ", ".join(map(_describe_column, header.extras))
    if file.metadata.cameras is not None:
        words["cameras"] = str(len(file.metadata.cameras))
    if file.metadata.training is not None:
        words["trained on"] = str(file.metadata.training)
    view = file.metadata.entries.get(VIEW)
    if view is not None:
        source = view.get("from") if isinstance(view, dict) else None
        words["first view"] = "a camera of the metadata" + (f" ({source})" if isinstance(source, str) else "")
    return words


def describe_placement(scene: SceneHeader | Scene, count: int, metadata: SceneMetadata) -> dict[str, str]:
    """Describe splat count, axes, up direction, unit, origin and flags in words, by title.

    Args:
        scene: header of a .csplat file, or another scene.
        count: number of splats.
        metadata: metadata of the scene.
    """
    flags = [name for name in ("antialiased", "flat") if getattr(metadata, name)]
    flags += [f"colour space {metadata.colour_space}"] * (metadata.colour_space != SRGB)
    if isinstance(scene, SceneHeader):
        flags += [
            f"{field} {value} (unknown)"
            for field, value in (("projection", scene.projection), ("antialiasing", scene.antialiasing))
            if value >= _spec.ANCILLARY_ID_MIN
        ]
    up, unit = metadata.up, metadata.unit_metres
    estimated = " (estimated)" if UP in metadata.estimated else ""
    return {
        "splats": f"{count:,}, SH degree {scene.sh_degree}",
        "axes": metadata.coordinate_system,
        "up": "unknown" if up is None else " ".join(f"{value:g}" for value in up) + estimated,
        "unit": "unknown" if unit is None else f"{unit:g} m",
        "origin": " ".join(f"{value:.17g}" for value in scene.origin),
        "flags": ", ".join(flags) or "none",
    }


def describe_coding(attribute: AttributeSummary) -> str:
    """Describe how an attribute is coded."""
    words = ["+".join(attribute.codings)]
    if attribute.step is not None:
        words.append(f"step {attribute.step:.4g}")
    if attribute.levels:
        words.append(f"{attribute.levels} levels")
    if attribute.mapping not in (None, "lattice", "unit_w"):
        words.append(str(attribute.mapping))
    if attribute.chroma_shift:
        words.append(f"chroma / {2**attribute.chroma_shift}")
    if attribute.codebook_bytes:
        words.append(f"codebook {format_bytes(attribute.codebook_bytes)}")
    if attribute.escaped_splats:
        words.append(f"{attribute.escaped_splats} escaped")
    words.append("+".join(attribute.coders))
    return ", ".join(word for word in words if word)


def other_metadata(file: FileDescription) -> dict[str, object]:
    """Return the metadata that `describe_scene` does not describe."""
    metadata = file.metadata
    described = {VIEW: True, TRAINING: metadata.training is not None, UP: metadata.stated_up is not None}
    described[ESTIMATED] = metadata.estimated == [UP]
    return {key: value for key, value in metadata.entries.items() if not described.get(key)}


def _bits_per_splat(size_bytes: int, count: int) -> float | None:
    """Return bits per splat; `None` without splats."""
    return 8.0 * size_bytes / count if count else None


def _summarise_attribute(header: SceneHeader, name: str, use: AttributeUsage) -> AttributeSummary:
    """Return the summary of an attribute; one without a record has no mapping, step or levels."""
    record = next((entry for entry in header.attributes if _spec.ATTRIBUTE_NAMES[entry.attribute] == name), None)
    known: dict[str, Any] = {}
    if record is not None:
        known["mapping"] = _spec.MAPPING_NAMES[record.mapping]
        if _spec.ATTRIBUTE_KIND[record.attribute] == "lattice":
            known |= {"step": record.step, "chroma_shift": record.chroma_shift}
        else:
            known["levels"] = record.levels
    return AttributeSummary(
        use.size_bytes,
        use.codebook_bytes,
        _bits_per_splat(use.size_bytes, header.splat_count),
        dict(use.codings),
        dict(use.coders),
        use.escaped_count,
        **known,
    )


def _summarise_layers(header: SceneHeader) -> dict[str, LayerSummary]:
    """Return the layers by name, ascending by id, with their codebook chunks; "layer 128" for an unknown id."""
    tile_bytes, tile_count, codebook_bytes = Counter[int](), Counter[int](), Counter[int]()
    for tile in header.all_tiles:
        for id_, layer in tile.layers.items():
            tile_bytes[id_] += layer.size
            tile_count[id_] += 1
    for chunk in header.directory:
        if chunk.type == _spec.CHUNK_CODEBOOK:
            codebook_bytes[chunk.layer] += chunk.size
    names = _spec.LAYER_NAMES | {
        id_: f"extra:{column.name}" for id_, column in enumerate(header.extras, EXTRA_LAYERS[0])
    }
    sizes = {id_: tile_bytes[id_] + codebook_bytes[id_] for id_ in sorted(tile_bytes.keys() | codebook_bytes.keys())}
    return {
        names.get(id_, f"layer {id_}"): LayerSummary(
            size, codebook_bytes[id_], _bits_per_splat(size, header.splat_count), tile_count[id_]
        )
        for id_, size in sizes.items()
    }


def _summarise_levels(data: bytes | mmap, header: SceneHeader) -> list[LevelSummary]:
    """Return the levels of detail, finest first; empty if level 0 is the only level."""
    if not header.coarse_tiles:
        return []
    nodes = read_nodes(memoryview(data), header)
    levels = []
    for level in sorted({node.level for node in nodes}):
        own = [node for node in nodes if node.level == level]
        tiles = [tile for node in own for tile in node.tiles]
        size = sum(layer.size for tile in tiles for layer in tile.layers.values())
        errors = [node.error for node in own]
        splats = sum(node.splat_count for node in own)
        levels.append(LevelSummary(level, len(own), len(tiles), splats, size, (min(errors), max(errors))))
    return levels


def _overhead_sizes(header: SceneHeader, use: Mapping[str, AttributeUsage]) -> dict[str, int]:
    """Return the bytes outside attributes, by name. With the bytes of all attributes, they add up to the file's size.

    Chunks of one type, of which a file may have several if it is unknown, are added up. "unknown_layers", if there are
    any, are chunks of the tiles' layers that this version cannot read.
    """
    by_type = Counter[str]()
    for chunk in header.directory:
        if chunk.type != _spec.CHUNK_CODEBOOK:
            by_type[chunk.type.decode("ascii")] += chunk.size
    layers = (item for tile in header.all_tiles for item in tile.layers.items())
    unknown = sum(layer.size for id_, layer in layers if header.skips(id_))
    parts = {"header": _spec.HEADER_SIZE, "index": header.index_size, **by_type}
    if unknown:
        parts["unknown_layers"] = unknown
    frames = header.file_size - sum(parts.values()) - sum(usage.size_bytes for usage in use.values())
    return {**parts, "tile_frames": frames}


def _summarise_codebook(header: SceneHeader, record: _spec.CodebookRecord) -> CodebookSummary:
    """Return the summary of a codebook; only codebooks of SH have bands."""
    chunks = [chunk for chunk in header.directory if chunk.type == _spec.CHUNK_CODEBOOK]
    return CodebookSummary(
        record.codebook_id,
        _spec.CODEBOOK_KIND_NAMES[record.kind],
        list(range(record.band_first, record.band_last + 1)) if record.band_first else [],
        record.size,
        sum(chunk.size for chunk in chunks if chunk.id == record.codebook_id),
    )


def _bounds_as_json(bounds: DeclaredBounds | None) -> dict[str, Any]:
    """Return the declared bounds, and what they say of the source, as JSON-compatible values."""
    if bounds is None:
        return {"declared_errors": None, "source": None}
    return {
        "declared_errors": {record.measure: {"max": record.max, "rms": record.rms} for record in bounds.records},
        "source": {
            "splats": bounds.source_count,
            "pruned_splats": bounds.pruned_count,
            "sh_degree": bounds.source_sh_degree,
            "refitted": bounds.refitted,
        },
    }


class _Cursor:
    """A position in the payload of a chunk; `at` and `end` are offsets in the file, bytes."""

    def __init__(self, data: bytes | mmap, offset: int, size: int) -> None:
        self.data = data
        self.at = offset + _spec.CHUNK_HEADER_SIZE
        self.end = offset + size

    def take(self, size: int) -> bytes:
        """Return the next `size` bytes, and step over them; raise a `FormatError` if the payload has fewer."""
        data = self.data[self.at : self.at + size]
        self.skip(size)
        return data

    def skip(self, size: int) -> None:
        """Step over `size` bytes; raise a `FormatError` if the payload has fewer."""
        if size > self.end - self.at:
            raise FormatError(
                _spec.ERROR_STREAM, self.at, _STREAM_CLAUSE, found=f"{self.end - self.at} bytes", wanted=size
            )
        self.at += size


def _walk_tile(cursor: _Cursor, codebooks: Mapping[int, _spec.CodebookRecord], use: dict[int, AttributeUsage]) -> None:
    """Add the blocks of a layer to the usage by attribute id; the cursor is at the tile head.

    Raises:
        FormatError: an id is unknown, a codebook is missing, or the payload ends early.
    """
    head = _spec.unpack_tile_head(cursor.take(_spec.TILE_HEAD_SIZE))
    for _ in range(head.block_count):
        start = cursor.at
        block = _spec.unpack_block_head(cursor.take(_spec.BLOCK_HEAD_SIZE))
        _registered_name(_spec.ATTRIBUTE_NAMES, block.attribute, "attribute", start)
        usage = use.setdefault(block.attribute, AttributeUsage())
        usage.codings[_registered_name(_spec.CODING_NAMES, block.coding, "coding", start)] += 1
        _walk_coding(cursor, block.attribute, block.coding, codebooks, usage)
        usage.block_bytes += cursor.at - start


def _walk_coding(
    cursor: _Cursor, attribute: int, coding: int, codebooks: Mapping[int, _spec.CodebookRecord], use: AttributeUsage
) -> None:
    """Step over parameters and streams of a block, after its head, and add their coders to `use`.

    Raises:
        FormatError: as for `_walk_tile`.
    """
    columns = _spec.ATTRIBUTE_COLUMNS.get(attribute, 1)
    if coding == _spec.CODING_MORTON:
        cursor.skip(_spec.MORTON_PARAMS_SIZE)
    elif coding == _spec.CODING_OFFSET:
        cursor.skip(_spec.LATTICE_PARAMS_SIZE + _OFFSET_SIZE * columns)
    elif coding == _spec.CODING_SIGNED:
        cursor.skip(_spec.LATTICE_PARAMS_SIZE)
    elif coding == _spec.CODING_SPARSE:
        cursor.skip(_spec.SPARSE_PARAMS_SIZE)
        _walk_stream(cursor, use)
    elif coding == _spec.CODING_CODEBOOK:
        _walk_codebook(cursor, attribute, codebooks, use)
        return
    _walk_stream(cursor, use)


def _walk_codebook(
    cursor: _Cursor, attribute: int, codebooks: Mapping[int, _spec.CodebookRecord], use: AttributeUsage
) -> None:
    """Step over a CODEBOOK block, after its head, with its escape block; add coders and escapes to `use`.

    Raises:
        FormatError: the codebook is missing, the escape block has coding CODEBOOK, or as for `_walk_tile`.
    """
    start = cursor.at
    params = _spec.unpack_codebook_params(cursor.take(_spec.CODEBOOK_PARAMS_SIZE))
    record = codebooks.get(params.codebook_id)
    if record is None:
        raise FormatError(_spec.ERROR_CODEBOOK, start, "CBK-1", found=f"codebook {params.codebook_id}")
    if attribute == _first_attribute(record, record.band_first):
        _walk_stream(cursor, use)
    if attribute == _spec.ATTRIBUTE_SCALES:
        cursor.skip(_spec.LATTICE_PARAMS_SIZE + _OFFSET_SIZE)
        _walk_stream(cursor, use)
    use.escaped_count += params.escape_count
    if params.escape_count:
        escape = _spec.unpack_block_head(cursor.take(_spec.BLOCK_HEAD_SIZE))
        if escape.coding == _spec.CODING_CODEBOOK:  # bounds the recursion
            raise FormatError(_spec.ERROR_STREAM, cursor.at, "CBK-5", found="coding codebook")
        _walk_coding(cursor, attribute, escape.coding, codebooks, use)


def _walk_stream(cursor: _Cursor, use: AttributeUsage) -> None:
    """Step over a stream, and add its coder to `use`."""
    start = cursor.at
    head = _spec.unpack_stream_head(cursor.take(_spec.STREAM_HEAD_SIZE))
    use.coders[_registered_name(_spec.CODER_NAMES, head.coder, "coder", start)] += 1
    cursor.skip(head.coded_size)


def _first_attribute(record: _spec.CodebookRecord, band: int) -> int:
    """Return the id of the first attribute of a codebook chunk; for SH, of the band's attribute."""
    if record.kind == _spec.CODEBOOK_KIND_SH:
        name = f"sh{band}"
    else:
        name = _spec.CODEBOOK_KIND_ATTRIBUTES[record.kind][0]
    return next(id_ for id_, attribute in _spec.ATTRIBUTE_NAMES.items() if attribute == name)


def _registered_name(names: Mapping[int, str], id_: int, what: str, offset: int) -> str:
    """Return the registered name of an id.

    Args:
        names: names by id.
        id_: the id.
        what: kind of the id, for the message.
        offset: its offset in the file, for the message.

    Raises:
        FormatError: the id is unknown.
    """
    if id_ not in names:
        raise FormatError(_spec.ERROR_UNSUPPORTED, offset, "RES-2", found=f"{what} {id_}")
    return names[id_]


def _boxes_of_splats(scene: Scene) -> tuple[list[float], list[float]]:
    """Return boxes, as `FileDescription.box`, of all splats and of the middle 90 % on each axis."""
    every = -(-scene.count // _SAMPLE_MAX)
    ends, sample = [], []
    for splats, model in scene.numbered():
        ends += [model.means.min(axis=0), model.means.max(axis=0)]
        sample.append(model.means[-splats.start % every :: every])
    low, high = np.quantile(np.concatenate(sample), [(1 - _MIDDLE) / 2, (1 + _MIDDLE) / 2], axis=0)
    whole = [*np.min(ends, axis=0).tolist(), *np.max(ends, axis=0).tolist()]
    return whole, [*low.tolist(), *high.tolist()]


def _describe_boxes(whole: list[float] | None, middle: list[float] | None) -> dict[str, str]:
    """Return the box of all splats and, if it is another, that of the middle 90 %, as `--box` takes them."""
    boxes = {"box": whole, "middle 90 %": None if middle == whole else middle}
    return {title: ",".join(f"{value:.4g}" for value in box) for title, box in boxes.items() if box is not None}


def _describe_tiles(file: FileDescription) -> str:
    """Describe number, sizes, precision and exponents of the tiles of level 0 in words."""
    words = {
        name: str(span.min) if span.min == span.max else f"{span.min} to {span.max}"
        for name, span in file.spans.items()
    }
    if not words:
        return "0"
    count = len(file.header.tiles)
    bits = f"{words['bits_per_axis']} bits per axis, exponents {words['exponents']}"
    return f"{count} of {words['splats']} splats, {bits}"
