"""Collect what is known of a .csplat file without decoding it, for `csplat info`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from mmap import mmap
from typing import Any

from csplat import _spec
from csplat.decoder import (
    DeclaredBounds,
    SceneHeader,
    read_cameras,
    read_declared_bounds,
    read_header,
    read_metadata,
    read_options,
)
from csplat.upright import up_of
from csplat_tools.files.console import finite
from csplat_tools.inspect.blocks import AttributeUse, attribute_use


@dataclass(frozen=True)
class Span:
    """The smallest and the largest of some integers."""

    min: int
    max: int


@dataclass(frozen=True)
class AttributeFacts:
    """The size and coding of one attribute.

    Attributes:
        size_bytes: all bytes of the attribute.
        codebook_bytes: those among them of its columns of codebooks.
        bits_per_splat: average over all splats; `None` without splats.
        codings, coders: number of blocks or streams that use each, by name.
        escaped_splats: number of splats whose values are coded as escapes instead of codebook entries.
        mapping, step, chroma_shift, levels: fields of the attribute's record; `None` if it has none.
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
class LayerFacts:
    """Size of a layer: its tiles, and the codebook chunks that it needs."""

    size_bytes: int
    codebook_bytes: int
    bits_per_splat: float | None
    tiles: int


@dataclass(frozen=True)
class CodebookFacts:
    """A codebook: its kind, the SH bands that it covers, the number of entries, and the bytes of its chunks."""

    id: int
    kind: str
    bands: Sequence[int]
    entries: int
    size_bytes: int


@dataclass(frozen=True)
class FileFacts:
    """A file as it describes itself; sizes in bytes.

    Attributes:
        header: header and index.
        attributes, layers: attributes and layers by name, in the order of the registry.
        codebooks: codebooks in the order of the index.
        overhead: bytes outside attributes, by name: header, index, chunks of the whole file, frames of the tiles'
            chunks.
        cameras: number of cameras; `None` without the chunk, as for all that follows.
        options, metadata: the file's JSON.
        declared_bounds: the source of which the file is an encoding, and the declared error bounds.
    """

    header: SceneHeader
    attributes: Mapping[str, AttributeFacts]
    layers: Mapping[str, LayerFacts]
    codebooks: Sequence[CodebookFacts]
    overhead: Mapping[str, int]
    cameras: int | None
    options: Mapping[str, Any] | None
    metadata: Mapping[str, Any] | None
    declared_bounds: DeclaredBounds | None

    @property
    def bytes_per_splat(self) -> float | None:
        """Size of the whole file divided by the number of splats; `None` without splats."""
        count = self.header.splat_count
        return self.header.file_size / count if count else None

    @property
    def spans(self) -> dict[str, Span]:
        """Ranges of splat count, lattice exponent and bits per axis over the tiles; empty without tiles."""
        tiles = self.header.tiles
        columns = {
            "splats": [one.splat_count for one in tiles],
            "exponents": [one.exponent for one in tiles],
            "bits_per_axis": [max(extent.bit_length() for extent in one.extent) for one in tiles],
        }
        return {name: Span(min(values), max(values)) for name, values in columns.items() if values}

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        header, tiles = self.header, self.header.tiles
        up = up_of(self.metadata or {}, header.coordinate_system)
        largest = {"max_scale": finite(max(tile.max_scale for tile in tiles))} if tiles else {}
        return {
            "format": f"csplat {header.version[0]}.{header.version[1]}",
            "profile": header.profile,
            "size_bytes": header.file_size,
            "bytes_per_splat": self.bytes_per_splat,
            "splats": header.splat_count,
            "sh_degree": header.sh_degree,
            "coordinate_system": header.coordinate_system,
            "up": None if up is None else list(up),
            "unit_metres": header.unit_metres,
            "origin": list(header.origin),
            "antialiased": header.antialiased,
            "flat": header.flat,
            "attributes": {
                name: {key: value for key, value in asdict(one).items() if value is not None or key in _ALWAYS}
                for name, one in self.attributes.items()
            },
            "layers": {name: asdict(one) for name, one in self.layers.items()},
            "overhead": dict(self.overhead),
            "codebooks": [asdict(one) for one in self.codebooks],
            "extra_columns": [{"name": extra.name, "dtype": extra.dtype} for extra in header.extras],
            "tiles": {"count": len(tiles), **{name: asdict(one) for name, one in self.spans.items()}, **largest},
            "chunks": [
                {"type": chunk.type.decode("ascii"), "size_bytes": chunk.size, "offset_bytes": chunk.offset}
                for chunk in header.directory
            ],
            "cameras": self.cameras,
            "options": self.options,
            "metadata": self.metadata,
            "stated_errors": None if self.declared_bounds is None else _stated(self.declared_bounds),
        }


_ALWAYS = ("bits_per_splat",)


def describe_file(data: bytes | mmap) -> FileFacts:
    """Describe a file by its header, its index, the heads of its blocks, and its small chunks.

    Args:
        data: the whole file; little of a memory-mapped one is touched.

    Raises:
        FormatError: header, index, block heads or one of the small chunks are not valid.
        LimitError: metadata, cameras or options are larger than the decoder's budget.
    """
    header = read_header(data)
    use = attribute_use(data, header)
    attributes = {name: _attribute(header, name, one) for name, one in use.items()}
    cameras = read_cameras(data)
    return FileFacts(
        header,
        attributes,
        _layers(header),
        [_codebook(header, record) for record in header.codebooks],
        _overhead(header, use),
        None if cameras is None else len(cameras),
        read_options(data),
        read_metadata(data),
        read_declared_bounds(data),
    )


def byte_shares(data: bytes | mmap, header: SceneHeader) -> dict[str, int]:
    """Return the bytes of each attribute, and as `overhead` those of everything else.

    Raises:
        FormatError: heads contradict each other.
    """
    use = attribute_use(data, header)
    return {**{name: one.size_bytes for name, one in use.items()}, "overhead": sum(_overhead(header, use).values())}


def _bits(size_bytes: int, count: int) -> float | None:
    return 8.0 * size_bytes / count if count else None


def _attribute(header: SceneHeader, name: str, use: AttributeUse) -> AttributeFacts:
    record = next((one for one in header.attributes if _spec.ATTRIBUTE_NAMES[one.attribute] == name), None)
    known: dict[str, Any] = {}
    if record is not None:
        known["mapping"] = _spec.MAPPING_NAMES[record.mapping]
        if _spec.ATTRIBUTE_KIND[record.attribute] == "lattice":
            known |= {"step": record.step, "chroma_shift": record.chroma_shift}
        else:
            known["levels"] = record.levels
    return AttributeFacts(
        use.size_bytes,
        use.codebook_bytes,
        _bits(use.size_bytes, header.splat_count),
        dict(use.codings),
        dict(use.coders),
        use.escaped_count,
        **known,
    )


def _layers(header: SceneHeader) -> dict[str, LayerFacts]:
    tile_bytes, tile_count, codebook_bytes = Counter[int](), Counter[int](), Counter[int]()
    for tile in header.tiles:
        for id_, layer in tile.layers.items():
            tile_bytes[id_] += layer.size
            tile_count[id_] += 1
    for chunk in header.directory:
        if chunk.type == _spec.CHUNK_CODEBOOK:
            codebook_bytes[chunk.layer] += chunk.size
    sizes = {id_: tile_bytes[id_] + codebook_bytes[id_] for id_ in sorted(tile_bytes.keys() | codebook_bytes.keys())}
    return {
        _spec.LAYER_NAMES.get(id_, f"layer {id_}"): LayerFacts(
            size, codebook_bytes[id_], _bits(size, header.splat_count), tile_count[id_]
        )
        for id_, size in sizes.items()
    }


def _overhead(header: SceneHeader, use: Mapping[str, AttributeUse]) -> dict[str, int]:
    whole = {chunk.type.decode("ascii"): chunk.size for chunk in header.directory if chunk.type != _spec.CHUNK_CODEBOOK}
    parts = {"header": _spec.HEADER_SIZE, "index": header.index_size, **whole}
    rest = header.file_size - sum(parts.values()) - sum(one.size_bytes for one in use.values())
    return {**parts, "tile_frames": rest}


def _codebook(header: SceneHeader, record: _spec.CodebookRecord) -> CodebookFacts:
    chunks = [chunk for chunk in header.directory if chunk.type == _spec.CHUNK_CODEBOOK]
    return CodebookFacts(
        record.codebook_id,
        _spec.CODEBOOK_KIND_NAMES[record.kind],
        list(range(record.band_first, record.band_last + 1)) if record.band_first else [],
        record.size,
        sum(chunk.size for chunk in chunks if chunk.id == record.codebook_id),
    )


def _stated(stated: DeclaredBounds) -> dict[str, Any]:
    return {
        "source_splats": stated.source_count,
        "pruned_splats": stated.pruned_count,
        "source_sh_degree": stated.source_sh_degree,
        "refitted": stated.refitted,
        "errors": {record.measure: {"max": record.max, "rms": record.rms} for record in stated.records},
    }
