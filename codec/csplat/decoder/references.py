"""Find the codebooks that a tile refers to, without decoding a stream (spec 5.2, 6.1, 6.4)."""

from __future__ import annotations

from collections.abc import Iterator

from csplat import _spec
from csplat.decoder.coded import leads
from csplat.decoder.container import Cursor, open_chunk
from csplat.decoder.header import SceneHeader
from csplat.decoder.lattice import read_block_head
from csplat.errors import FormatError

_TILE_FLAGS = sum(flag for flag, name in _spec.CHUNK_FLAG_NAMES.items() if name in _spec.CHUNK_FLAGS[_spec.CHUNK_TILE])
#: By coding: bytes of its parameters, i32 for each column, streams. CODEBOOK and RAW are handled by hand.
_SHAPES = {
    _spec.CODING_LEVELS: (0, False, 1),
    _spec.CODING_MORTON: (_spec.MORTON_PARAMS_SIZE, False, 1),
    _spec.CODING_AXIS: (0, False, 1),
    _spec.CODING_OFFSET: (_spec.LATTICE_PARAMS_SIZE, True, 1),
    _spec.CODING_SIGNED: (_spec.LATTICE_PARAMS_SIZE, False, 1),
    _spec.CODING_SPARSE: (_spec.SPARSE_PARAMS_SIZE, False, 2),
}


def codebook_references(view: memoryview, header: SceneHeader, layer: _spec.LayerRecord) -> Iterator[tuple[int, int]]:
    """Find the u16 that name codebooks in a tile's chunk of layer 0 or of an SH band.

    Args:
        view: the whole file, as far as the chunk.
        header: the scene.
        layer: the chunk's record.

    Yields:
        Offset in the file, and the id stored there.

    Raises:
        FormatError: a clause on the chunk's frame or on what is passed is broken; streams are not looked at.
    """
    cursor = open_chunk(view, layer, _spec.CHUNK_TILE, _TILE_FLAGS, "TLE-3")
    cursor.take(_spec.TILE_HEAD_SIZE)
    for attribute in (record.attribute for record in header.attributes):
        if _spec.ATTRIBUTE_LAYER[attribute] != layer.layer:
            continue
        coding = read_block_head(cursor, attribute)
        if coding == _spec.CODING_CODEBOOK:
            yield _step_over_coded(cursor, header, attribute)
        else:
            _step_over(cursor, attribute, coding)
    cursor.finish()


def _step_over_coded(cursor: Cursor, header: SceneHeader, attribute: int) -> tuple[int, int]:
    at = cursor.take(_spec.CODEBOOK_PARAMS_SIZE)
    params = _spec.unpack_codebook_params(cursor.view, at)
    book = next((one for one in header.codebooks if one.codebook_id == params.codebook_id), None)
    if book is None:
        raise FormatError(_spec.ERROR_CODEBOOK, at, "CBK-1", f"there is no codebook {params.codebook_id}")
    if leads(book, attribute):
        _step_over_stream(cursor)
    if attribute == _spec.ATTRIBUTE_SCALES:  # the summand: lattice parameters, one offset
        cursor.take(_spec.LATTICE_PARAMS_SIZE + 4)
        _step_over_stream(cursor)
    if params.escape_count:
        _step_over(cursor, attribute, read_block_head(cursor, attribute, (_spec.CODING_OFFSET, _spec.CODING_SIGNED)))
    return at + _spec.CODEBOOK_PARAMS_OFFSETS["codebook_id"], params.codebook_id


def _step_over(cursor: Cursor, attribute: int, coding: int) -> None:
    size, offsets, streams = _SHAPES[coding]
    cursor.take(size + 4 * offsets * _spec.ATTRIBUTE_COLUMNS[attribute])
    for _ in range(streams):
        _step_over_stream(cursor)


def _step_over_stream(cursor: Cursor) -> None:
    at = cursor.take(_spec.STREAM_HEAD_SIZE)
    cursor.take(_spec.unpack_stream_head(cursor.view, at).coded_size)
