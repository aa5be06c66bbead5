"""What a file consists of, as plain values: for `csplat info`."""

from __future__ import annotations

import math
from collections import Counter
from mmap import mmap
from typing import Any

from csplat import _spec
from csplat.decoder import SceneHeader
from csplat_tools.inspect.blocks import AttributeUse, attribute_use

__all__ = ["describe"]


def describe(data: bytes | mmap, header: SceneHeader) -> dict[str, Any]:
    """Describe a file by its header, its index and the heads of its blocks.

    Args:
        data: the file.
        header: its header and index.

    Returns:
        JSON-compatible values; sizes in bytes, `bits_per_splat` with everything that an attribute or layer takes.

    Raises:
        FormatError: heads contradict each other.
    """
    use = attribute_use(data, header)
    count = header.splat_count
    return {
        "format": f"csplat {header.version[0]}.{header.version[1]}",
        "profile": header.profile,
        "size_bytes": header.file_size,
        "bytes_per_splat": _per_splat(header.file_size, count),
        "splats": count,
        "sh_degree": header.sh_degree,
        "coordinate_system": header.coordinate_system,
        "unit_metres": header.unit_metres,
        "origin": list(header.origin),
        "antialiased": header.antialiased,
        "flat": header.flat,
        "digest": header.digest.hex(),
        "attributes": {name: _attribute(header, name, one) for name, one in use.items()},
        "layers": _layers(header),
        "overhead": _overhead(header, use),
        "codebooks": [_codebook(header, record) for record in header.codebooks],
        "extra_columns": [{"name": extra.name, "dtype": extra.dtype} for extra in header.extras],
        "tiles": _tiles(header),
        "chunks": [
            {"type": chunk.type.decode("ascii"), "size_bytes": chunk.size, "offset_bytes": chunk.offset}
            for chunk in header.directory
        ],
    }


def _per_splat(size_bytes: int, count: int) -> float | None:
    return size_bytes / count if count else None


def _bits(size_bytes: int, count: int) -> float | None:
    return 8.0 * size_bytes / count if count else None


def _attribute(header: SceneHeader, name: str, use: AttributeUse) -> dict[str, Any]:
    described: dict[str, Any] = {
        "size_bytes": use.size_bytes,
        "codebook_bytes": use.codebook_bytes,
        "bits_per_splat": _bits(use.size_bytes, header.splat_count),
        "codings": dict(use.codings),
        "coders": dict(use.coders),
        "escaped_splats": use.escaped_count,
    }
    record = next((one for one in header.attributes if _spec.ATTRIBUTE_NAMES[one.attribute] == name), None)
    if record is not None:
        described["mapping"] = _spec.MAPPING_NAMES[record.mapping]
        if _spec.ATTRIBUTE_KIND[record.attribute] == "lattice":
            described["step"] = record.step
            described["chroma_shift"] = record.chroma_shift
        else:
            described["levels"] = record.levels
    return described


def _layers(header: SceneHeader) -> dict[str, Any]:
    """Size of each layer: its tiles, and the codebook chunks that it needs."""
    tile_bytes: Counter[int] = Counter()
    tile_count: Counter[int] = Counter()
    for tile in header.tiles:
        for id_, layer in tile.layers.items():
            tile_bytes[id_] += layer.size
            tile_count[id_] += 1
    codebook_bytes: Counter[int] = Counter()
    for chunk in header.directory:
        if chunk.type == _spec.CHUNK_CODEBOOK:
            codebook_bytes[chunk.layer] += chunk.size
    return {
        _spec.LAYER_NAMES[id_]: {
            "size_bytes": tile_bytes[id_] + codebook_bytes[id_],
            "codebook_bytes": codebook_bytes[id_],
            "bits_per_splat": _bits(tile_bytes[id_] + codebook_bytes[id_], header.splat_count),
            "tiles": tile_count[id_],
        }
        for id_ in sorted(tile_bytes.keys() | codebook_bytes.keys())
    }


def _overhead(header: SceneHeader, use: dict[str, AttributeUse]) -> dict[str, int]:
    """What is no attribute: header, index, chunks of the whole file, and the frames of the tiles' chunks."""
    whole = {chunk.type.decode("ascii"): chunk.size for chunk in header.directory if chunk.type != _spec.CHUNK_CODEBOOK}
    parts = {"header": _spec.HEADER_SIZE, "index": header.index_size, **whole}
    rest = header.file_size - sum(parts.values()) - sum(one.size_bytes for one in use.values())
    return {**parts, "tile_frames": rest}


def _codebook(header: SceneHeader, record: _spec.CodebookRecord) -> dict[str, Any]:
    return {
        "id": record.codebook_id,
        "kind": _spec.CODEBOOK_KIND_NAMES[record.kind],
        "bands": list(range(record.band_first, record.band_last + 1)) if record.band_first else [],
        "stages": list(record.sizes[: record.stage_count]),
        "size_bytes": sum(
            chunk.size
            for chunk in header.directory
            if chunk.type == _spec.CHUNK_CODEBOOK and chunk.id == record.codebook_id
        ),
    }


def _tiles(header: SceneHeader) -> dict[str, Any]:
    if not header.tiles:
        return {"count": 0}
    counts = [tile.splat_count for tile in header.tiles]
    bits = [max(extent.bit_length() for extent in tile.extent) for tile in header.tiles]
    return {
        "count": len(counts),
        "splats": {"min": min(counts), "max": max(counts)},
        "exponents": {"min": min(t.exponent for t in header.tiles), "max": max(t.exponent for t in header.tiles)},
        "bits_per_axis": {"min": min(bits), "max": max(bits)},
        "max_scale": _finite(max(tile.max_scale for tile in header.tiles)),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None  # nothing has been decoded that would contradict it
