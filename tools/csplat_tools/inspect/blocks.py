"""Walk through the blocks of a file by their heads, to find the bytes and the codings of each attribute.

Nothing is inflated and no CRC is computed: only the heads are touched, so that a memory-mapped file of any size is
described at once. Every length is checked against the bytes that remain.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from mmap import mmap

from csplat import _spec
from csplat.decoder import SceneHeader
from csplat.errors import FormatError

_STREAM_CLAUSE = "STR-6"


@dataclass
class AttributeUse:
    """The bytes and codings of one attribute, over all tiles.

    Attributes:
        block_bytes: size of the blocks in tiles: heads, parameters and streams.
        codebook_bytes: size of the codebook chunks with the attribute's columns.
        codings, coders: number of blocks or streams that use each, by name.
        escaped_count: number of splats whose values are coded as escapes instead of codebook entries.
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


def attribute_use(data: bytes | mmap, header: SceneHeader) -> dict[str, AttributeUse]:
    """Add up the bytes and codings of each attribute.

    Args:
        data: the file.
        header: its header and index.

    Returns:
        By attribute name, in the order of the registry. A codebook of several attributes other than SH bands counts
        with its first.

    Raises:
        FormatError: the heads contradict each other, or the data is not one whole file.
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
    use: dict[int, AttributeUse] = {}
    for tile in header.tiles:
        for layer in (one for id_, one in tile.layers.items() if id_ in _spec.LAYER_NAMES):
            _walk_tile(_Cursor(data, layer.offset, layer.size), codebooks, use)
    for chunk in header.directory:
        if chunk.type == _spec.CHUNK_CODEBOOK:
            attribute = _first_attribute(codebooks[chunk.id], chunk.layer)
            use.setdefault(attribute, AttributeUse()).codebook_bytes += chunk.size
    return {_spec.ATTRIBUTE_NAMES[id_]: use[id_] for id_ in sorted(use)}


class _Cursor:
    """A place in the payload of one chunk."""

    def __init__(self, data: bytes | mmap, offset: int, size: int) -> None:
        self.data = data
        self.at = offset + _spec.CHUNK_HEADER_SIZE
        self.end = offset + size

    def take(self, size: int) -> bytes:
        data = self.data[self.at : self.at + size]
        self.skip(size)
        return data

    def skip(self, size: int) -> None:
        if size > self.end - self.at:
            raise FormatError(
                _spec.ERROR_STREAM, self.at, _STREAM_CLAUSE, found=f"{self.end - self.at} bytes", wanted=size
            )
        self.at += size


def _walk_tile(cursor: _Cursor, codebooks: Mapping[int, _spec.CodebookRecord], use: dict[int, AttributeUse]) -> None:
    head = _spec.unpack_tile_head(cursor.take(_spec.TILE_HEAD_SIZE))
    for _ in range(head.block_count):
        start = cursor.at
        block = _spec.unpack_block_head(cursor.take(_spec.BLOCK_HEAD_SIZE))
        _name(_spec.ATTRIBUTE_NAMES, block.attribute, "attribute", start)
        one = use.setdefault(block.attribute, AttributeUse())
        one.codings[_name(_spec.CODING_NAMES, block.coding, "coding", start)] += 1
        _walk_coding(cursor, block.attribute, block.coding, codebooks, one)
        one.block_bytes += cursor.at - start


def _walk_coding(
    cursor: _Cursor, attribute: int, coding: int, codebooks: Mapping[int, _spec.CodebookRecord], use: AttributeUse
) -> None:
    columns = _spec.ATTRIBUTE_COLUMNS.get(attribute, 1)
    if coding == _spec.CODING_MORTON:
        cursor.skip(_spec.MORTON_PARAMS_SIZE)
    elif coding == _spec.CODING_OFFSET:
        cursor.skip(_spec.LATTICE_PARAMS_SIZE + 4 * columns)
    elif coding == _spec.CODING_SIGNED:
        cursor.skip(_spec.LATTICE_PARAMS_SIZE)
    elif coding == _spec.CODING_RAW:
        cursor.skip(_spec.RAW_PARAMS_SIZE)
    elif coding == _spec.CODING_SPARSE:
        cursor.skip(_spec.SPARSE_PARAMS_SIZE)
        _walk_stream(cursor, use)
    elif coding == _spec.CODING_CODEBOOK:
        _walk_codebook(cursor, attribute, codebooks, use)
        return
    _walk_stream(cursor, use)


def _walk_codebook(
    cursor: _Cursor, attribute: int, codebooks: Mapping[int, _spec.CodebookRecord], use: AttributeUse
) -> None:
    at = cursor.at
    params = _spec.unpack_codebook_params(cursor.take(_spec.CODEBOOK_PARAMS_SIZE))
    record = codebooks.get(params.codebook_id)
    if record is None:
        raise FormatError(_spec.ERROR_CODEBOOK, at, "CBK-1", found=f"codebook {params.codebook_id}")
    if attribute == _first_attribute(record, record.band_first):
        _walk_stream(cursor, use)
    if attribute == _spec.ATTRIBUTE_SCALES:
        cursor.skip(_spec.LATTICE_PARAMS_SIZE + 4)
        _walk_stream(cursor, use)
    use.escaped_count += params.escape_count
    if params.escape_count:
        escape = _spec.unpack_block_head(cursor.take(_spec.BLOCK_HEAD_SIZE))
        if escape.coding == _spec.CODING_CODEBOOK:  # otherwise the recursion would not be bounded
            raise FormatError(_spec.ERROR_STREAM, cursor.at, "CBK-5", found="coding codebook")
        _walk_coding(cursor, attribute, escape.coding, codebooks, use)


def _walk_stream(cursor: _Cursor, use: AttributeUse) -> None:
    at = cursor.at
    head = _spec.unpack_stream_head(cursor.take(_spec.STREAM_HEAD_SIZE))
    use.coders[_name(_spec.CODER_NAMES, head.coder, "coder", at)] += 1
    cursor.skip(head.coded_size)


def _first_attribute(record: _spec.CodebookRecord, band: int) -> int:
    """Return the id of the attribute whose columns a codebook chunk holds; for SH that of the band."""
    if record.kind == _spec.CODEBOOK_KIND_SH:
        name = f"sh{band}"
    else:
        name = _spec.CODEBOOK_KIND_ATTRIBUTES[record.kind][0]
    return next(id_ for id_, one in _spec.ATTRIBUTE_NAMES.items() if one == name)


def _name(names: Mapping[int, str], id_: int, what: str, offset: int) -> str:
    if id_ not in names:
        raise FormatError(_spec.ERROR_UNSUPPORTED, offset, "RES-2", found=f"{what} {id_}")
    return names[id_]
