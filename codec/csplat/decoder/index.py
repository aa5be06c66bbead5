# SPDX-License-Identifier: Apache-2.0
"""Read and check header and index (spec 4.3)."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NoReturn

from csplat import _spec
from csplat.decoder.container import (
    EXTRA_LAYERS,
    ExtraColumn,
    SceneHeader,
    Tile,
    check_index_crc,
    check_length,
    check_reserved,
    read_file_header,
    refuse_field,
    refuse_length,
    view_of,
)
from csplat.decoder.limits import Limits
from csplat.decoder.resource_level import check_resource_level
from csplat.errors import FormatError, UnsupportedError

if TYPE_CHECKING:
    from csplat.file_source import File


#: Smallest normal number of binary64 (ATT-6, TIL-9).
STEP_MIN = 2.0**-1022
#: Smallest normal and largest finite number of binary32 (ATT-10, LAT-1).
SINGLE_MIN, SINGLE_MAX = 2.0**-126, 2.0**128 - 2.0**104
_SINGLE_END = 2.0**128 - 2.0**103  # the smallest number that binary32 rounds to infinity (MEA-1)

_CODEBOOK_ID_SIZE = 2  # bytes of a codebook id in a tile's record
_STEP_SIZE = 8  # bytes of a step, binary64
_INDEX_CRC_SIZE = 4  # bytes of the CRC-32 that ends the index
_CONTROL = frozenset(chr(c) for c in (*range(0x20), 0x7F))  # control characters, forbidden in names (EXR-2)
#: Record sizes in the index head and their minima, the sizes that this version reads.
_RECORD_SIZES: Final = {
    "head_size": _spec.INDEX_HEAD_SIZE,
    "attribute_size": _spec.ATTRIBUTE_RECORD_SIZE,
    "codebook_size": _spec.CODEBOOK_RECORD_SIZE,
    "extra_size": _spec.EXTRA_RECORD_SIZE,
    "directory_size": _spec.DIRECTORY_RECORD_SIZE,
    "tile_size": _spec.TILE_RECORD_SIZE,
    "layer_size": _spec.LAYER_RECORD_SIZE,
}
#: Fields of the index head whose unknown values from ANCILLARY_ID_MIN on are returned (ANC-4), and the known values.
_HINTS: Final = {
    "projection": _spec.PROJECTION_NAMES,
    "antialiasing": _spec.ANTIALIASING_NAMES,
    "colour_space": _spec.COLOUR_SPACE_NAMES,
}
#: Fields of the record of an extra column with their clauses and ranges.
_EXTRA_RANGES: Final = (
    ("components", "EXR-5", 1, _spec.EXTRA_COMPONENTS_MAX),
    ("name_size", "EXR-1", 1, _spec.EXTRA_NAME_MAX),
    ("semantic_size", "EXR-7", 0, _spec.EXTRA_SEMANTIC_MAX),
)
_SINGLE_CHUNKS = (
    _spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS, _spec.CHUNK_OPTIONS, _spec.CHUNK_DECLARED_ERRORS, _spec.CHUNK_TREE,
)  # fmt: skip


def read_header(data: File, *, limits: Limits | None = None) -> SceneHeader:
    """Read the header and index of a file, and check their CRCs; chunks are not read.

    Args:
        data: a file, as in `decode`, or its beginning: the first HEADER_SIZE + index_size bytes suffice.
        limits: of which only the resource level is used.

    Raises:
        FormatError: header or index breaks a clause; E_TRUNCATED if the data ends before the index does.
        UnsupportedError: another version or profile, or a critical chunk of unknown type.
        LimitError: the resource level is above that of `limits`.
        InputError: `data` is not a file or contiguous bytes.
    """
    return parse_header(view_of(data), whole=False, limits=limits)


def parse_header(view: memoryview, *, whole: bool, limits: Limits | None = None) -> SceneHeader:
    """Read header and index; errors as in `read_header`.

    Args:
        view: a file or its beginning.
        whole: require data of exactly the file's size (HDR-5, HDR-6).
        limits: as in `read_header`.
    """
    file = read_file_header(view, (limits or Limits()).resource_level)
    if whole:
        check_length(view, file.file_size)
    start, end = _spec.HEADER_SIZE, _spec.HEADER_SIZE + file.index_size
    if len(view) < end:
        refuse_length(_spec.ERROR_TRUNCATED, "HDR-5", "the data ends within the index", view, end)
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
    directory_at = range(at, at + head.directory_count * head.directory_size, head.directory_size)
    directory = read_directory(view, directory_at)
    check_codebook_chunks(directory, directory_at, codebooks)
    means_step = attributes[_spec.ATTRIBUTE_MEANS - 1].step
    tiles = read_tiles(view, directory_at.stop, end - _INDEX_CRC_SIZE, head, means_step, codebooks)
    _check_levels(tiles, directory, directory_at)
    check_coverage(directory, directory_at, tiles, head, end, file.file_size)
    letters = "".join(_spec.DIRECTION_LETTER[direction] for direction in head.axes)
    header = SceneHeader(
        version=(file.version_major, file.version_minor),
        profile=_spec.PROFILE_NAMES[file.profile],
        resource_level=_spec.RESOURCE_LEVEL_NAMES[file.resource_level],
        file_size=file.file_size,
        index_size=file.index_size,
        splat_count=head.splat_count,
        sh_degree=head.sh_degree,
        kernel=_spec.KERNEL_NAMES[head.kernel],
        projection=head.projection,
        antialiasing=head.antialiasing,
        colour_space=head.colour_space,
        flat=bool(head.scene_flags & _spec.SCENE_FLAG_FLAT),
        coordinate_system=letters or _spec.DIRECTION_NAMES[_spec.DIRECTION_UNSPECIFIED],
        unit_metres=head.unit_metres or None,
        origin=head.origin,
        attributes=attributes,
        codebooks=codebooks,
        extras=extras,
        directory=directory,
        tiles=tiles[: sum(tile.level == 0 for tile in tiles)],
        coarse_tiles=tiles[sum(tile.level == 0 for tile in tiles) :],
    )
    check_resource_level(header, None if header.coarse_tiles else header.tiles)
    return header


def _check_head(head: _spec.IndexHead, at: int) -> None:
    """Check the index head at offset `at`: RES-1, RES-2, IDX-3 to IDX-6, IDX-8, EXR-4."""
    offsets = _spec.INDEX_HEAD_OFFSETS
    check_reserved(head, at, offsets)
    for name, least in _RECORD_SIZES.items():
        if getattr(head, name) < least:
            refuse_field(_spec.ERROR_VALUE, "IDX-8", head, at, offsets, name, f"at least {least}")
    if head.extra_count > _spec.EXTRA_COLUMNS_MAX:
        refuse_field(_spec.ERROR_VALUE, "EXR-4", head, at, offsets, "extra_count", f"at most {_spec.EXTRA_COLUMNS_MAX}")
    if head.kernel not in _spec.KERNEL_NAMES:
        kernel = _spec.KERNEL_RESERVED.get(head.kernel, str(head.kernel)).upper()
        raise UnsupportedError(f"kernel {kernel}", offset=at + offsets["kernel"], clause="RES-2")
    for name, known in _HINTS.items():
        value = getattr(head, name)
        if value < _spec.ANCILLARY_ID_MIN and value not in known:
            raise UnsupportedError(f"{name} {value}", offset=at + offsets[name], clause="RES-2")
    if head.sh_degree > _spec.SH_DEGREE_MAX:
        subject = f"SH degree {head.sh_degree} (this decoder reads 0 to {_spec.SH_DEGREE_MAX})"
        raise UnsupportedError(subject, offset=at + offsets["sh_degree"], clause="IDX-3")
    if head.scene_flags & ~(sum(_spec.SCENE_FLAG_NAMES) | _spec.ANCILLARY_SCENE_FLAGS):
        raise FormatError(
            _spec.ERROR_RESERVED, at + offsets["scene_flags"], "RES-1", "scene_flags", found=f"{head.scene_flags:#04x}"
        )
    # Directions 1 and 2, 3 and 4, 5 and 6 are opposite.
    lines = {(direction + 1) // 2 for direction in head.axes}
    if any(head.axes) and lines != {1, 2, 3}:
        wanted = "three zeros, or directions along three different lines"
        raise FormatError(_spec.ERROR_VALUE, at + offsets["axes"], "IDX-4", "axes", found=[*head.axes], wanted=wanted)
    if not (0.0 <= head.unit_metres < math.inf):
        refuse_field(_spec.ERROR_VALUE, "IDX-5", head, at, offsets, "unit_metres")
    for axis, value in enumerate(head.origin):
        if not math.isfinite(value):
            raise FormatError(_spec.ERROR_VALUE, at + offsets["origin"] + 8 * axis, "IDX-6", "origin", found=value)


def _check_room(head: _spec.IndexHead, index_size: int) -> None:
    """Refuse counts that do not fit into the index, before any record is read (IDX-2)."""
    least = (
        head.head_size
        + head.attribute_count * head.attribute_size
        + head.codebook_count * head.codebook_size
        + head.extra_count * head.extra_size
        + head.directory_count * head.directory_size
        + head.tile_count * head.tile_size
        + _INDEX_CRC_SIZE
    )
    if least > index_size:
        detail, wanted = "the records do not fit into the index", f"at least {least} bytes"
        raise FormatError(
            _spec.ERROR_INDEX, _spec.HEADER_SIZE, "IDX-2", detail, found=f"{index_size} bytes", wanted=wanted
        )


def _read_attributes(view: memoryview, at: int, head: _spec.IndexHead) -> tuple[_spec.AttributeRecord, ...]:
    """Read the attribute records, which begin at `at`, and check ATT-1 to ATT-10; IDX-2 has been checked."""
    wanted = range(_spec.ATTRIBUTE_OPACITIES, _spec.ATTRIBUTE_SH0 + 1 + head.sh_degree)
    if head.attribute_count != len(wanted):
        offsets = _spec.INDEX_HEAD_OFFSETS
        refuse_field(_spec.ERROR_INDEX, "ATT-1", head, _spec.HEADER_SIZE, offsets, "attribute_count", len(wanted))
    records = []
    for i, attribute in enumerate(wanted):
        record_at = at + i * head.attribute_size
        record = _spec.unpack_attribute_record(view, record_at)
        if record.attribute != attribute:
            raise FormatError(
                _spec.ERROR_INDEX, record_at, "ATT-1", "attribute", found=record.attribute, wanted=attribute
            )
        step_at = record_at + _spec.ATTRIBUTE_RECORD_OFFSETS["step"]
        _check_attribute(record, record_at, bytes(view[step_at : step_at + _STEP_SIZE]))
        records.append(record)
    return tuple(records)


def _check_attribute(record: _spec.AttributeRecord, at: int, step_bits: bytes) -> None:
    """Check RES-1 and ATT-2 to ATT-10 for the record at offset `at`; `step_bits` also tells -0 from +0 (ATT-7)."""
    offsets = _spec.ATTRIBUTE_RECORD_OFFSETS
    check_reserved(record, at, offsets)
    legal = _spec.ATTRIBUTE_MAPPINGS[record.attribute]
    if _spec.MAPPING_NAMES.get(record.mapping) not in legal:
        refuse_field(_spec.ERROR_VALUE, "ATT-2", record, at, offsets, "mapping", " or ".join(legal))
    if _spec.ATTRIBUTE_KIND[record.attribute] == "levels":
        quats = record.attribute == _spec.ATTRIBUTE_QUATS
        low, high = (_spec.QUAT_LEVELS_MIN, _spec.QUAT_LEVELS_MAX) if quats else (1, _spec.OPACITY_LEVELS_MAX)
        if not low <= record.levels <= high:
            clause = "ATT-4" if quats else "ATT-3"
            refuse_field(_spec.ERROR_VALUE, clause, record, at, offsets, "levels", f"{low} to {high}")
        if any(step_bits):
            refuse_field(_spec.ERROR_RESERVED, "ATT-7", record, at, offsets, "step", 0)
    else:
        if record.levels != 0:
            refuse_field(_spec.ERROR_RESERVED, "ATT-5", record, at, offsets, "levels", 0)
        if not STEP_MIN <= record.step < math.inf:
            refuse_field(_spec.ERROR_VALUE, "ATT-6", record, at, offsets, "step", "2^-1022 or more")
        if record.attribute != _spec.ATTRIBUTE_MEANS and not _is_single(record.step):
            wanted = "a binary32 value of 2^-126 or more"
            refuse_field(_spec.ERROR_VALUE, "ATT-10", record, at, offsets, "step", wanted)
    _check_chroma(record, at)


def _is_single(step: float) -> bool:
    """Return True if a step > 0 is exactly a normal binary32 value."""
    if not SINGLE_MIN <= step <= SINGLE_MAX:
        return False
    (nearest,) = struct.unpack("<f", struct.pack("<f", step))
    return bool(nearest == step)


def _check_chroma(record: _spec.AttributeRecord, at: int) -> None:
    """Check ATT-8 and ATT-9."""
    offsets, most = _spec.ATTRIBUTE_RECORD_OFFSETS, _spec.CHROMA_SHIFT_MAX
    if record.chroma_shift > most:
        refuse_field(_spec.ERROR_VALUE, "ATT-8", record, at, offsets, "chroma_shift", f"at most {most}")
    if record.chroma_shift and record.mapping != _spec.MAPPING_YCOCG:
        refuse_field(_spec.ERROR_VALUE, "ATT-9", record, at, offsets, "chroma_shift", 0)


def read_codebook_records(view: memoryview, at: int, head: _spec.IndexHead) -> tuple[_spec.CodebookRecord, ...]:
    """Read the codebook records, which begin at `at`; IDX-2 has been checked."""
    records: list[_spec.CodebookRecord] = []
    offsets = _spec.CODEBOOK_RECORD_OFFSETS
    for i in range(head.codebook_count):
        record_at = at + i * head.codebook_size
        record = _spec.unpack_codebook_record(view, record_at)
        check_reserved(record, record_at, offsets)
        if records and record.codebook_id <= (last := records[-1].codebook_id):
            refuse_field(_spec.ERROR_INDEX, "CBR-1", record, record_at, offsets, "codebook_id", f"more than {last}")
        if record.kind not in _spec.CODEBOOK_KIND_NAMES:
            raise UnsupportedError(f"codebook kind {record.kind}", offset=record_at + offsets["kind"], clause="RES-2")
        _check_codebook(record, record_at, head.sh_degree)
        records.append(record)
    return tuple(records)


def _check_codebook(record: _spec.CodebookRecord, at: int, sh_degree: int) -> None:
    """Check CBR-2 and CBR-4 for the record at offset `at`."""
    offsets = _spec.CODEBOOK_RECORD_OFFSETS
    bands = (record.band_first, record.band_last)
    if record.kind == _spec.CODEBOOK_KIND_SH:
        legal = 1 <= bands[0] <= bands[1] <= sh_degree
    else:
        legal = bands == (0, 0)
    if not legal:
        raise FormatError(_spec.ERROR_VALUE, at + offsets["band_first"], "CBR-2", "bands", found=bands)
    if not 1 <= record.size <= _spec.CODEBOOK_ENTRIES_MAX:
        refuse_field(_spec.ERROR_VALUE, "CBR-4", record, at, offsets, "size", f"1 to {_spec.CODEBOOK_ENTRIES_MAX}")


def read_extras(view: memoryview, at: int, head: _spec.IndexHead) -> tuple[ExtraColumn, ...]:
    """Read the extra column records, which begin at `at`; IDX-2 has been checked."""
    columns: dict[str, ExtraColumn] = {}
    offsets = _spec.EXTRA_RECORD_OFFSETS
    for i in range(head.extra_count):
        record_at = at + i * head.extra_size
        record = _spec.unpack_extra_record(view, record_at)
        check_reserved(record, record_at, offsets)
        if record.dtype < _spec.ANCILLARY_ID_MIN and record.dtype not in _spec.EXTRA_DTYPE_NAMES:
            raise UnsupportedError(f"type {record.dtype} of an extra column", offset=record_at, clause="RES-2")
        if record.coding < _spec.ANCILLARY_ID_MIN and record.coding != _spec.CODING_RAW:
            subject, coding_at = f"coding {record.coding} of an extra column", record_at + offsets["coding"]
            raise UnsupportedError(subject, offset=coding_at, clause="EXR-6")
        for name, clause, least, most in _EXTRA_RANGES:
            if not least <= getattr(record, name) <= most:
                refuse_field(_spec.ERROR_VALUE, clause, record, record_at, offsets, name, f"{least} to {most}")
        name = _column_text(record.name, record.name_size, record_at + offsets["name"], "EXR-2", "name")
        semantic_at = record_at + offsets["semantic"]
        semantic = _column_text(record.semantic, record.semantic_size, semantic_at, "EXR-7", "semantic")
        if name in columns:
            raise FormatError(
                _spec.ERROR_VALUE, record_at + offsets["name"], "EXR-2", f"a second column is named {name!r}"
            )
        kind = _spec.EXTRA_DTYPE_NAMES.get(record.dtype) if record.coding == _spec.CODING_RAW else None
        dtype = kind and f"<{kind[0]}{_spec.EXTRA_DTYPE_BYTES[record.dtype]}"
        columns[name] = ExtraColumn(name, dtype, record.components, semantic)
    return tuple(columns.values())


def _column_text(field: bytes, size: int, at: int, clause: str, what: str) -> str:
    """Return the first `size` bytes of the field at offset `at` as text; check that it is UTF-8 without control
    characters, by `clause`, and EXR-3.
    """
    raw, rest = field[:size], field[size:]
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise FormatError(_spec.ERROR_VALUE, at + error.start, clause, f"{what} is not UTF-8") from None
    if not _CONTROL.isdisjoint(text):
        raise FormatError(_spec.ERROR_VALUE, at, clause, f"control character in the {what} {text!r}")
    if any(rest):
        raise FormatError(_spec.ERROR_RESERVED, at + size, "EXR-3", f"bytes after the {what} are not 0")
    return text


def read_directory(view: memoryview, at: range) -> tuple[_spec.DirectoryRecord, ...]:
    """Read the directory records at the offsets `at`; IDX-2 has been checked."""
    records = []
    seen = set()
    offsets = _spec.DIRECTORY_RECORD_OFFSETS
    for record_at in at:
        record = _spec.unpack_directory_record(view, record_at)
        check_reserved(record, record_at, offsets)
        _check_chunk_type(record, record_at)
        _check_chunk_size(record, record_at, offsets)
        if record.type in _SINGLE_CHUNKS:
            if record.type in seen or record.id or record.layer:
                detail = f"chunk {record.type.decode()} occurs twice, or has an id or a layer"
                present = f"id {record.id}, layer {record.layer}"
                raise FormatError(_spec.ERROR_INDEX, record_at, "DIR-4", detail, found=present)
            seen.add(record.type)
        records.append(record)
    return tuple(records)


def _check_chunk_size(record: _spec.DirectoryRecord | _spec.LayerRecord, at: int, offsets: Mapping[str, int]) -> None:
    """Check CHK-3: the chunk of a directory or layer record at offset `at` has room for its header."""
    if record.size < _spec.CHUNK_HEADER_SIZE:
        refuse_field(_spec.ERROR_INDEX, "CHK-3", record, at, offsets, "size", f"at least {_spec.CHUNK_HEADER_SIZE}")


def _check_chunk_type(record: _spec.DirectoryRecord, at: int) -> None:
    """Check type and flags of the directory record at offset `at`: DIR-1, DIR-2, DIR-6, RES-1, CHK-4."""
    if record.type == _spec.CHUNK_TILE or not all(0x20 <= byte <= 0x7E for byte in record.type):
        raise FormatError(_spec.ERROR_VALUE, at, "DIR-1", "type", found=record.type)
    flags_at = at + _spec.DIRECTORY_RECORD_OFFSETS["flags"]
    flags = record.flags & ~_spec.ANCILLARY_CHUNK_FLAGS
    if flags & ~sum(_spec.CHUNK_FLAG_NAMES):
        raise FormatError(_spec.ERROR_RESERVED, flags_at, "RES-1", "flags", found=f"{record.flags:#06x}")
    name = record.type.decode("ascii")
    if record.type in _spec.CHUNK_NAMES:
        registered = sum(
            flag for flag, flag_name in _spec.CHUNK_FLAG_NAMES.items() if flag_name in _spec.CHUNK_FLAGS[record.type]
        )
        if flags != registered:
            raise FormatError(_spec.ERROR_VALUE, flags_at, "CHK-4", f"flags of {name}", found=flags, wanted=registered)
    elif flags & _spec.CHUNK_FLAG_CRITICAL:
        if name[0].islower():
            raise FormatError(_spec.ERROR_VALUE, flags_at, "DIR-6", f"the private chunk type {name} is critical")
        raise UnsupportedError(f"critical chunk type {name}", offset=at, clause="DIR-2")


def check_codebook_chunks(
    directory: tuple[_spec.DirectoryRecord, ...], at: range, codebooks: tuple[_spec.CodebookRecord, ...]
) -> None:
    """Check DIR-5 for the directory records at `at`: a CODB chunk per codebook or, for the kind SH, per band."""
    wanted = {(book.codebook_id, layer) for book in codebooks for layer in range(book.band_first, book.band_last + 1)}
    for record_at, record in zip(at, directory, strict=True):
        if record.type != _spec.CHUNK_CODEBOOK:
            continue
        key = (record.id, record.layer)
        if key not in wanted:
            detail = "CODB chunk without a codebook record, or occurring twice"
            raise FormatError(_spec.ERROR_INDEX, record_at, "DIR-5", detail, found=f"id {key[0]}, layer {key[1]}")
        wanted.remove(key)
    if wanted:
        missing = min(wanted)
        detail = f"no CODB chunk for codebook {missing[0]}, layer {missing[1]}"
        raise FormatError(_spec.ERROR_INDEX, at.start, "DIR-5", detail)


def scaled_step(step: float, exponent: int, least: float = STEP_MIN) -> float | None:
    """Return step × 2^exponent, exact; `None` if it is not finite or is below `least` (TIL-9, LAT-1)."""
    try:
        scaled = math.ldexp(step, exponent)
    except OverflowError:
        return None
    # A product just below 2^-1022 may round up to it and is then not exact.
    return scaled if scaled >= least and math.ldexp(scaled, -exponent) == step else None


def read_tiles(
    view: memoryview,
    at: int,
    end: int,
    head: _spec.IndexHead,
    means_step: float,
    codebooks: tuple[_spec.CodebookRecord, ...],
) -> tuple[Tile, ...]:
    """Read the tile records, which fill the index from offset `at` up to its CRC at `end`."""
    known = {book.codebook_id for book in codebooks}
    tiles: list[Tile] = []
    start = 0
    for index in range(head.tile_count):
        tile, size = _read_tile(view, at, end, index, start, head)
        _check_tile(tile, means_step)
        _check_codebook_ids(tile, known, at + size - _CODEBOOK_ID_SIZE * len(tile.codebook_ids))
        tiles.append(tile)
        start += tile.splat_count
        at += size
    if at != end:
        rest = f"{end - at} bytes"
        raise FormatError(_spec.ERROR_INDEX, at, "IDX-2", "bytes follow the last tile", found=rest, wanted="the CRC")
    count = sum(tile.splat_count for tile in tiles if tile.level == 0)
    if count != head.splat_count:
        offsets = _spec.INDEX_HEAD_OFFSETS
        refuse_field(_spec.ERROR_INDEX, "IDX-7", head, _spec.HEADER_SIZE, offsets, "splat_count", count)
    return tuple(tiles)


def _check_levels(tiles: Sequence[Tile], directory: Sequence[_spec.DirectoryRecord], directory_at: range) -> None:
    """Check TIL-12 and TRE-1; directory records are at `directory_at`."""
    offsets = _spec.TILE_RECORD_OFFSETS
    for before, tile in pairwise(tiles):
        if tile.level < before.level:
            wanted = f"at least {before.level}"
            refuse_field(_spec.ERROR_INDEX, "TIL-12", tile, tile.offset, offsets, "level", wanted)
    coarse = next((tile for tile in tiles if tile.level > 0), None)
    tree_at = next(
        (at for at, record in zip(directory_at, directory, strict=True) if record.type == _spec.CHUNK_TREE), None
    )
    if coarse is not None and tree_at is None:
        at, detail = coarse.offset + offsets["level"], f"a tile of level {coarse.level}, and no TREE chunk"
        raise FormatError(_spec.ERROR_INDEX, at, "TRE-1", detail)
    if coarse is None and tree_at is not None:
        raise FormatError(_spec.ERROR_INDEX, tree_at, "TRE-1", "a TREE chunk, and no tile of a level above 0")


def check_coverage(
    directory: tuple[_spec.DirectoryRecord, ...],
    directory_at: range,
    tiles: tuple[Tile, ...],
    head: _spec.IndexHead,
    index_end: int,
    file_size: int,
) -> None:
    """Check COV-1: chunks are contiguous from `index_end` to `file_size`; directory records are at `directory_at`."""
    field_offset = _spec.DIRECTORY_RECORD_OFFSETS["offset"]
    chunks = [
        (record.offset, record.size, at + field_offset) for at, record in zip(directory_at, directory, strict=True)
    ]
    for tile in tiles:
        layer_at = tile.offset + head.tile_size + _spec.LAYER_RECORD_OFFSETS["offset"]
        for i, layer in enumerate(tile.layers.values()):
            chunks.append((layer.offset, layer.size, layer_at + i * head.layer_size))
    chunks.sort()
    expected = index_end
    for offset, size, named_at in chunks:
        if offset != expected:
            detail = "chunks leave a gap or overlap: offset"
            raise FormatError(_spec.ERROR_INDEX, named_at, "COV-1", detail, found=offset, wanted=expected)
        expected += size
    if expected != file_size:
        at, detail = _spec.HEADER_OFFSETS["file_size"], "the last chunk does not end with the file"
        raise FormatError(_spec.ERROR_INDEX, at, "COV-1", detail, found=expected, wanted=file_size)


def _read_tile(view: memoryview, at: int, end: int, index: int, start: int, head: _spec.IndexHead) -> tuple[Tile, int]:
    """Read a tile record with its layer records and table ids; check the layers.

    Args:
        view: the file, at least up to `end`.
        at: offset of the tile record.
        end: offset of the index's CRC.
        index: index of the tile.
        start: index of its first splat.
        head: the index head.

    Returns:
        The tile, and the size of its records in bytes.

    Raises:
        FormatError: the records do not fit into the index, or layers break a clause.
        UnsupportedError: a layer of unknown id that is not ancillary.
    """
    if end - at < head.tile_size:
        _ends_early(at)
    record = _spec.unpack_tile_record(view, at)
    layers_at = at + head.tile_size
    tables_at = layers_at + record.layer_count * head.layer_size
    after = tables_at + _CODEBOOK_ID_SIZE * record.table_count
    if after > end:
        _ends_early(at)
    check_reserved(record, at, _spec.TILE_RECORD_OFFSETS)
    tile = Tile(
        index=index,
        offset=at,
        start=start,
        level=record.level,
        splat_count=record.splat_count,
        exponent=record.exponent,
        corner=record.corner,
        extent=record.extent,
        max_scale=record.max_scale,
        layers=_read_layers(view, layers_at, record, head),
        codebook_ids=struct.unpack_from(f"<{record.table_count}H", view, tables_at),
    )
    return tile, after - at


def _ends_early(at: int) -> NoReturn:
    """Raise E_INDEX for a tile record, at offset `at`, that the index does not hold completely."""
    raise FormatError(_spec.ERROR_INDEX, at, "IDX-2", "the index ends within a tile")


def _read_layers(
    view: memoryview, at: int, tile: _spec.TileRecord, head: _spec.IndexHead
) -> dict[int, _spec.LayerRecord]:
    """Return the layer records of a tile by layer, the first at `at`; check RES-2, TIL-2, TIL-3, TIL-5, CHK-3."""
    layers: dict[int, _spec.LayerRecord] = {}
    offsets = _spec.LAYER_RECORD_OFFSETS
    last = -1  # id of the previous layer
    for i in range(tile.layer_count):
        record_at = at + i * head.layer_size
        record = _spec.unpack_layer_record(view, record_at)
        check_reserved(record, record_at, offsets)
        if record.layer <= last or (i == 0 and record.layer != _spec.LAYER_GEOMETRY):
            refuse_field(_spec.ERROR_INDEX, "TIL-2", record, record_at, offsets, "layer", "0, then ascending")
        known = record.layer in _spec.LAYER_NAMES or record.layer in EXTRA_LAYERS
        if record.layer < _spec.ANCILLARY_ID_MIN and not known:
            raise UnsupportedError(f"layer {record.layer}", offset=record_at, clause="RES-2")
        if head.sh_degree < record.layer <= _spec.SH_DEGREE_MAX:
            refuse_field(_spec.ERROR_INDEX, "TIL-3", record, record_at, offsets, "layer", f"at most {head.sh_degree}")
        _check_chunk_size(record, record_at, offsets)
        last = record.layer
        layers[last] = record
    if not layers:
        raise FormatError(_spec.ERROR_INDEX, at, "TIL-2", "a tile without layers", wanted="layer 0")
    columns = range(_spec.LAYER_EXTRA, _spec.LAYER_EXTRA + (0 if tile.level else head.extra_count))
    if [layer for layer in layers if layer in EXTRA_LAYERS] != [*columns]:
        detail = f"layers of extra columns at level {tile.level}, of which the file has {head.extra_count}"
        raise FormatError(_spec.ERROR_INDEX, at, "TIL-5", detail, found=[*layers])
    return layers


def _check_tile(tile: Tile, means_step: float) -> None:
    """Check number of splats, box and exponent of a tile: TIL-1, TIL-7 to TIL-9, MEA-1."""
    offsets = _spec.TILE_RECORD_OFFSETS
    if not 1 <= tile.splat_count <= _spec.TILE_SPLATS_MAX:
        wanted = f"1 to {_spec.TILE_SPLATS_MAX}"
        refuse_field(_spec.ERROR_VALUE, "TIL-1", tile, tile.offset, offsets, "splat_count", wanted)
    for axis, (corner, extent) in enumerate(zip(tile.corner, tile.extent, strict=True)):
        if abs(corner) > _spec.INTEGER_MAX or abs(corner + extent) > _spec.INTEGER_MAX:
            at, detail = tile.offset + offsets["corner"] + 8 * axis, "corner and corner + extent"
            corners, wanted = (corner, corner + extent), f"at most {_spec.INTEGER_MAX} in magnitude"
            raise FormatError(_spec.ERROR_VALUE, at, "TIL-7", detail, found=corners, wanted=wanted)
        if extent >> _spec.AXIS_BITS_MAX:
            at, wanted = tile.offset + offsets["extent"] + 4 * axis, f"below 2^{_spec.AXIS_BITS_MAX}"
            raise FormatError(_spec.ERROR_VALUE, at, "TIL-8", "extent", found=extent, wanted=wanted)
    scaled = scaled_step(means_step, tile.exponent)
    if scaled is None:
        detail = f"{means_step} x 2^{tile.exponent} is not positive, finite and at least 2^-1022"
        raise FormatError(_spec.ERROR_VALUE, tile.offset + offsets["exponent"], "TIL-9", detail)
    for axis, (corner, extent) in enumerate(zip(tile.corner, tile.extent, strict=True)):
        if not max(abs(corner * scaled), abs((corner + extent) * scaled)) < _SINGLE_END:
            at, detail = tile.offset + offsets["corner"] + 8 * axis, "the tile's box"
            ends = f"{corner} to {corner + extent}, times {scaled}"
            raise FormatError(_spec.ERROR_RANGE, at, "MEA-1", detail, found=ends, wanted="finite numbers of binary32")


def _check_codebook_ids(tile: Tile, known: set[int], at: int) -> None:
    """Check TIL-6: the ids of the codebooks, the first at offset `at`, ascend and are among the `known` ids."""
    last = -1
    for i, identity in enumerate(tile.codebook_ids):
        if identity <= last or identity not in known:
            wanted = "ids of codebooks, ascending"
            id_at = at + i * _CODEBOOK_ID_SIZE
            raise FormatError(_spec.ERROR_INDEX, id_at, "TIL-6", "codebook id", found=identity, wanted=wanted)
        last = identity
