"""Header and index into a `SceneHeader` (spec 4.3), every clause checked before anything is used."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Final

from csplat import _spec
from csplat.decoder.container import check_index_crc, check_reserved, read_file_header, view_of
from csplat.decoder.header import SceneHeader
from csplat.decoder.index_chunks import check_codebook_chunks, read_codebook_records, read_directory, read_extras
from csplat.decoder.index_tiles import SINGLE_MAX, SINGLE_MIN, STEP_MIN, check_coverage, read_tiles
from csplat.errors import FormatError, UnsupportedError

if TYPE_CHECKING:
    from csplat.inputs import File


#: The sizes that the index head states, and the least of each: what this version reads of it.
_RECORD_SIZES: Final = {
    "head_size": _spec.INDEX_HEAD_SIZE,
    "attribute_size": _spec.ATTRIBUTE_RECORD_SIZE,
    "codebook_size": _spec.CODEBOOK_RECORD_SIZE,
    "extra_size": _spec.EXTRA_RECORD_SIZE,
    "directory_size": _spec.DIRECTORY_RECORD_SIZE,
    "tile_size": _spec.TILE_RECORD_SIZE,
    "layer_size": _spec.LAYER_RECORD_SIZE,
}


def read_header(data: File) -> SceneHeader:
    """Read a file's header and index; the first HEADER_SIZE + index_size bytes suffice.

    The header's and the index's CRC are checked, chunks are not looked at.

    Args:
        data: a file, as in `decode`, or its beginning.

    Raises:
        FormatError: a clause on header or index is broken; E_TRUNCATED if the data ends
            before the index does.
        UnsupportedError: another version or profile, or a critical chunk of unknown type.
        InputError: `data` is not a contiguous buffer.
    """
    view = view_of(data)
    file = read_file_header(view)
    start, end = _spec.HEADER_SIZE, _spec.HEADER_SIZE + file.index_size
    if len(view) < end:
        raise FormatError(
            _spec.ERROR_TRUNCATED,
            len(view),
            "HDR-5",
            "the data ends within the index",
            found=f"{len(view)} bytes",
            wanted=f"{end} bytes",
        )
    check_index_crc(view, start, file.index_size)
    head = _spec.unpack_index_head(view, start)
    _check_head(head, start)
    _check_room(head, file.index_size)
    at = start + head.head_size
    attributes = _read_attributes(view, at, head)
    at += head.attribute_count * head.attribute_size
    codebooks = read_codebook_records(view, at, head)
    at += head.codebook_count * head.codebook_size
    extras = read_extras(view, at, head)
    at += head.extra_count * head.extra_size
    places = range(at, at + head.directory_count * head.directory_size, head.directory_size)
    directory = read_directory(view, places)
    check_codebook_chunks(directory, places, codebooks)
    tiles = read_tiles(view, places.stop, end - 4, head, attributes[_spec.ATTRIBUTE_MEANS - 1].step, codebooks)
    check_coverage(directory, places, tiles, head, end, file.file_size)
    letters = "".join(_spec.DIRECTION_LETTER[direction] for direction in head.axes)
    return SceneHeader(
        version=(file.version_major, file.version_minor),
        profile=_spec.PROFILE_NAMES[file.profile],
        file_size=file.file_size,
        index_size=file.index_size,
        splat_count=head.splat_count,
        sh_degree=head.sh_degree,
        antialiased=bool(head.scene_flags & _spec.SCENE_FLAG_ANTIALIASED),
        flat=bool(head.scene_flags & _spec.SCENE_FLAG_FLAT),
        coordinate_system=letters or _spec.DIRECTION_NAMES[_spec.DIRECTION_UNSPECIFIED],
        unit_metres=head.unit_metres or None,
        origin=head.origin,
        attributes=attributes,
        codebooks=codebooks,
        extras=extras,
        directory=directory,
        tiles=tiles,
    )


def _check_head(head: _spec.IndexHead, at: int) -> None:
    places = _spec.INDEX_HEAD_OFFSETS
    check_reserved(head, at, places)
    for name, least in _RECORD_SIZES.items():
        if getattr(head, name) < least:
            raise FormatError(
                _spec.ERROR_VALUE,
                at + places[name],
                "IDX-8",
                name,
                found=getattr(head, name),
                wanted=f"{least} or more",
            )
    if head.sh_degree > _spec.SH_DEGREE_MAX:
        raise UnsupportedError(f"SH degree {head.sh_degree}", offset=at + places["sh_degree"], clause="IDX-3")
    if head.scene_flags & ~(sum(_spec.SCENE_FLAG_NAMES) | _spec.ANCILLARY_SCENE_FLAGS):
        raise FormatError(
            _spec.ERROR_RESERVED, at + places["scene_flags"], "RES-1", "scene_flags", found=f"{head.scene_flags:#04x}"
        )
    # Directions 1 and 2, 3 and 4, 5 and 6 are the two ways along one line.
    lines = {(direction + 1) // 2 for direction in head.axes}
    if any(head.axes) and lines != {1, 2, 3}:
        raise FormatError(
            _spec.ERROR_VALUE,
            at + places["axes"],
            "IDX-4",
            "axes",
            found=list(head.axes),
            wanted="three zeros, or directions along three different lines",
        )
    if not (0.0 <= head.unit_metres < math.inf):
        raise FormatError(_spec.ERROR_VALUE, at + places["unit_metres"], "IDX-5", "unit_metres", found=head.unit_metres)
    for axis, value in enumerate(head.origin):
        if not math.isfinite(value):
            raise FormatError(_spec.ERROR_VALUE, at + places["origin"] + 8 * axis, "IDX-6", "origin", found=value)


def _check_room(head: _spec.IndexHead, index_size: int) -> None:
    """Refuse counts that the index cannot hold before a single record is read (IDX-2)."""
    least = (
        head.head_size
        + head.attribute_count * head.attribute_size
        + head.codebook_count * head.codebook_size
        + head.extra_count * head.extra_size
        + head.directory_count * head.directory_size
        + head.tile_count * head.tile_size
        + 4
    )
    if least > index_size:
        raise FormatError(
            _spec.ERROR_INDEX,
            _spec.HEADER_SIZE,
            "IDX-2",
            "the records that the index announces do not fit",
            found=f"{index_size} bytes",
            wanted=f"{least} bytes at least",
        )


def _read_attributes(view: memoryview, at: int, head: _spec.IndexHead) -> tuple[_spec.AttributeRecord, ...]:
    wanted = range(_spec.ATTRIBUTE_OPACITIES, _spec.ATTRIBUTE_SH0 + 1 + head.sh_degree)
    if head.attribute_count != len(wanted):
        raise FormatError(
            _spec.ERROR_INDEX,
            _spec.HEADER_SIZE + _spec.INDEX_HEAD_OFFSETS["attribute_count"],
            "ATT-1",
            "attribute_count",
            found=head.attribute_count,
            wanted=len(wanted),
        )
    records = []
    for i, attribute in enumerate(wanted):
        place = at + i * head.attribute_size
        record = _spec.unpack_attribute_record(view, place)
        if record.attribute != attribute:
            raise FormatError(_spec.ERROR_INDEX, place, "ATT-1", "attribute", found=record.attribute, wanted=attribute)
        _check_attribute(record, place, bytes(view[place + 8 : place + 16]))
        records.append(record)
    return tuple(records)


def _check_attribute(record: _spec.AttributeRecord, at: int, step_bits: bytes) -> None:
    places = _spec.ATTRIBUTE_RECORD_OFFSETS
    check_reserved(record, at, places)
    legal = _spec.ATTRIBUTE_MAPPINGS[record.attribute]
    if _spec.MAPPING_NAMES.get(record.mapping) not in legal:
        raise FormatError(
            _spec.ERROR_VALUE,
            at + places["mapping"],
            "ATT-2",
            "mapping",
            found=record.mapping,
            wanted=" or ".join(legal),
        )
    if _spec.ATTRIBUTE_KIND[record.attribute] == "levels":
        quats = record.attribute == _spec.ATTRIBUTE_QUATS
        low, high = (_spec.QUAT_LEVELS_MIN, _spec.QUAT_LEVELS_MAX) if quats else (1, _spec.OPACITY_LEVELS_MAX)
        if not low <= record.levels <= high:
            raise FormatError(
                _spec.ERROR_VALUE,
                at + places["levels"],
                "ATT-4" if quats else "ATT-3",
                "levels",
                found=record.levels,
                wanted=f"{low} to {high}",
            )
        if any(step_bits):
            raise FormatError(_spec.ERROR_RESERVED, at + places["step"], "ATT-7", "step", found=record.step, wanted=0)
    else:
        if record.levels != 0:
            raise FormatError(
                _spec.ERROR_RESERVED, at + places["levels"], "ATT-5", "levels", found=record.levels, wanted=0
            )
        if not STEP_MIN <= record.step < math.inf:
            raise FormatError(
                _spec.ERROR_VALUE, at + places["step"], "ATT-6", "step", found=record.step, wanted="2^-1022 or more"
            )
        if record.attribute != _spec.ATTRIBUTE_MEANS and not _is_single(record.step):
            raise FormatError(
                _spec.ERROR_VALUE,
                at + places["step"],
                "ATT-10",
                "step",
                found=record.step,
                wanted="a binary32 value of 2^-126 or more",
            )
    _check_chroma(record, at + places["chroma_shift"])


def _is_single(step: float) -> bool:
    """Return True if a step > 0 is exactly a normal binary32 value."""
    if not SINGLE_MIN <= step <= SINGLE_MAX:
        return False
    (nearest,) = struct.unpack("<f", struct.pack("<f", step))
    return bool(nearest == step)


def _check_chroma(record: _spec.AttributeRecord, at: int) -> None:
    if record.chroma_shift > _spec.CHROMA_SHIFT_MAX:
        raise FormatError(
            _spec.ERROR_VALUE,
            at,
            "ATT-8",
            "chroma_shift",
            found=record.chroma_shift,
            wanted=f"{_spec.CHROMA_SHIFT_MAX} at most",
        )
    if record.chroma_shift and record.mapping != _spec.MAPPING_YCOCG:
        raise FormatError(_spec.ERROR_VALUE, at, "ATT-9", "chroma_shift", found=record.chroma_shift, wanted=0)
