"""Read and check header and index (spec 4.3), before anything is used."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Final, NoReturn

from csplat import _spec
from csplat.decoder.container import (
    ExtraColumn,
    SceneHeader,
    Tile,
    check_index_crc,
    check_length,
    check_reserved,
    read_file_header,
    view_of,
)
from csplat.errors import FormatError, UnsupportedError

if TYPE_CHECKING:
    from csplat.file_source import File


#: Smallest normal number of binary64 (ATT-6, TIL-9).
STEP_MIN = 2.0**-1022
#: Smallest normal and largest finite number of binary32 (ATT-10, LAT-1).
SINGLE_MIN, SINGLE_MAX = 2.0**-126, 2.0**128 - 2.0**104

_CONTROL = frozenset(chr(c) for c in (*range(0x20), 0x7F))  # characters that names must not have (EXR-2)
#: Sizes in the index head and the minimum of each: the bytes that this version reads.
_RECORD_SIZES: Final = {
    "head_size": _spec.INDEX_HEAD_SIZE,
    "attribute_size": _spec.ATTRIBUTE_RECORD_SIZE,
    "codebook_size": _spec.CODEBOOK_RECORD_SIZE,
    "extra_size": _spec.EXTRA_RECORD_SIZE,
    "directory_size": _spec.DIRECTORY_RECORD_SIZE,
    "tile_size": _spec.TILE_RECORD_SIZE,
    "layer_size": _spec.LAYER_RECORD_SIZE,
}
_SINGLE_CHUNKS = (_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS, _spec.CHUNK_OPTIONS, _spec.CHUNK_STATED_ERRORS)


def read_header(data: File) -> SceneHeader:
    """Read a file's header and index; the first HEADER_SIZE + index_size bytes suffice.

    The CRCs of header and index are checked; chunks are not read.

    Args:
        data: a file, as in `decode`, or its beginning.

    Raises:
        FormatError: header or index breaks a clause; E_TRUNCATED if the data ends before the index does.
        UnsupportedError: another version or profile, or a critical chunk of unknown type.
        InputError: `data` is not a contiguous buffer.
    """
    return parse_header(view_of(data), whole=False)


def parse_header(view: memoryview, *, whole: bool) -> SceneHeader:
    """Read header and index; errors as in `read_header`.

    Args:
        view: a file or its beginning.
        whole: require the data to be the file, complete and nothing else (HDR-5, HDR-6).
    """
    file = read_file_header(view)
    if whole:
        check_length(view, file.file_size)
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
    # Directions 1 and 2, 3 and 4, 5 and 6 are opposite to each other.
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


def read_codebook_records(view: memoryview, at: int, head: _spec.IndexHead) -> tuple[_spec.CodebookRecord, ...]:
    """Read the codebook records, which begin at `at`; the caller has checked that they fit."""
    records: list[_spec.CodebookRecord] = []
    places = _spec.CODEBOOK_RECORD_OFFSETS
    for i in range(head.codebook_count):
        place = at + i * head.codebook_size
        record = _spec.unpack_codebook_record(view, place)
        check_reserved(record, place, places)
        if records and record.codebook_id <= records[-1].codebook_id:
            raise FormatError(
                _spec.ERROR_INDEX,
                place,
                "CBR-1",
                "codebook_id",
                found=record.codebook_id,
                wanted=f"more than {records[-1].codebook_id}",
            )
        if record.kind not in _spec.CODEBOOK_KIND_NAMES:
            raise UnsupportedError(f"codebook kind {record.kind}", offset=place + places["kind"], clause="RES-2")
        _check_codebook(record, place, head.sh_degree)
        records.append(record)
    return tuple(records)


def _check_codebook(record: _spec.CodebookRecord, at: int, sh_degree: int) -> None:
    places = _spec.CODEBOOK_RECORD_OFFSETS
    bands = (record.band_first, record.band_last)
    if record.kind == _spec.CODEBOOK_KIND_SH:
        legal = 1 <= bands[0] <= bands[1] <= sh_degree
    else:
        legal = bands == (0, 0)
    if not legal:
        raise FormatError(_spec.ERROR_VALUE, at + places["band_first"], "CBR-2", "bands", found=bands)
    if not 1 <= record.size <= _spec.CODEBOOK_ENTRIES_MAX:
        raise FormatError(
            _spec.ERROR_VALUE,
            at + places["size"],
            "CBR-4",
            "size of a codebook",
            found=record.size,
            wanted=f"1 to {_spec.CODEBOOK_ENTRIES_MAX}",
        )


def read_extras(view: memoryview, at: int, head: _spec.IndexHead) -> tuple[ExtraColumn, ...]:
    """Read the extra column records, which begin at `at`; the caller has checked that they fit."""
    columns: dict[str, ExtraColumn] = {}
    places = _spec.EXTRA_RECORD_OFFSETS
    for i in range(head.extra_count):
        place = at + i * head.extra_size
        record = _spec.unpack_extra_record(view, place)
        if record.dtype < _spec.ANCILLARY_ID_MIN and record.dtype not in _spec.EXTRA_DTYPE_NAMES:
            raise UnsupportedError(f"type {record.dtype} of an extra column", offset=place, clause="RES-2")
        if not 1 <= record.name_size <= _spec.EXTRA_NAME_MAX:
            raise FormatError(
                _spec.ERROR_VALUE,
                place + places["name_size"],
                "EXR-1",
                "name_size",
                found=record.name_size,
                wanted=f"1 to {_spec.EXTRA_NAME_MAX}",
            )
        name = _column_name(record, place + places["name"])
        if name in columns:
            raise FormatError(_spec.ERROR_VALUE, place + places["name"], "EXR-2", f"a second column is named {name!r}")
        kind = _spec.EXTRA_DTYPE_NAMES.get(record.dtype)
        columns[name] = ExtraColumn(name, kind and f"<{kind[0]}{_spec.EXTRA_DTYPE_BYTES[record.dtype]}")
    return tuple(columns.values())


def _column_name(record: _spec.ExtraRecord, at: int) -> str:
    raw, rest = record.name[: record.name_size], record.name[record.name_size :]
    try:
        name = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise FormatError(_spec.ERROR_VALUE, at + error.start, "EXR-2", "name is not UTF-8") from None
    if not _CONTROL.isdisjoint(name):
        raise FormatError(_spec.ERROR_VALUE, at, "EXR-2", f"control character in the name {name!r}")
    if any(rest):
        raise FormatError(_spec.ERROR_RESERVED, at + len(raw), "EXR-3", "bytes behind the name are not 0")
    return name


def read_directory(view: memoryview, at: range) -> tuple[_spec.DirectoryRecord, ...]:
    """Read the directory records, which begin at the places `at`; the caller has checked that they fit."""
    records = []
    seen = set()
    places = _spec.DIRECTORY_RECORD_OFFSETS
    for place in at:
        record = _spec.unpack_directory_record(view, place)
        check_reserved(record, place, places)
        _check_chunk_type(record, place)
        if record.size < _spec.CHUNK_HEADER_SIZE:
            raise FormatError(
                _spec.ERROR_INDEX,
                place + places["size"],
                "CHK-3",
                "size",
                found=record.size,
                wanted=f"{_spec.CHUNK_HEADER_SIZE} or more",
            )
        if record.type in _SINGLE_CHUNKS:
            if record.type in seen or record.id or record.layer:
                raise FormatError(
                    _spec.ERROR_INDEX,
                    place,
                    "DIR-4",
                    f"chunk {record.type.decode()} twice, or with an id or a layer",
                    found=f"id {record.id}, layer {record.layer}",
                )
            seen.add(record.type)
        records.append(record)
    return tuple(records)


def _check_chunk_type(record: _spec.DirectoryRecord, at: int) -> None:
    if record.type == _spec.CHUNK_TILE or not all(0x20 <= byte <= 0x7E for byte in record.type):
        raise FormatError(_spec.ERROR_VALUE, at, "DIR-1", "type", found=record.type)
    place = at + _spec.DIRECTORY_RECORD_OFFSETS["flags"]
    flags = record.flags & ~_spec.ANCILLARY_CHUNK_FLAGS
    if flags & ~sum(_spec.CHUNK_FLAG_NAMES):
        raise FormatError(_spec.ERROR_RESERVED, place, "RES-1", "flags", found=f"{record.flags:#06x}")
    name = record.type.decode("ascii")
    if record.type in _spec.CHUNK_NAMES:
        registered = sum(
            flag for flag, word in _spec.CHUNK_FLAG_NAMES.items() if word in _spec.CHUNK_FLAGS[record.type]
        )
        if flags != registered:
            raise FormatError(_spec.ERROR_VALUE, place, "CHK-4", f"flags of {name}", found=flags, wanted=registered)
    elif record.type == _spec.CHUNK_TREE:
        raise UnsupportedError(f"chunk type {name}", offset=at, clause="RES-2")
    elif flags & _spec.CHUNK_FLAG_CRITICAL:
        if name[0].islower():
            raise FormatError(_spec.ERROR_VALUE, place, "DIR-6", f"the private chunk type {name} is critical")
        raise UnsupportedError(f"critical chunk type {name}", offset=at, clause="DIR-2")


def check_codebook_chunks(
    directory: tuple[_spec.DirectoryRecord, ...], at: range, codebooks: tuple[_spec.CodebookRecord, ...]
) -> None:
    """DIR-5: one CODB chunk for each codebook and, for the kind SH, each of its bands; the records lie at `at`."""
    wanted = {(book.codebook_id, layer) for book in codebooks for layer in range(book.band_first, book.band_last + 1)}
    for place, record in zip(at, directory, strict=True):
        if record.type != _spec.CHUNK_CODEBOOK:
            continue
        key = (record.id, record.layer)
        if key not in wanted:
            raise FormatError(
                _spec.ERROR_INDEX,
                place,
                "DIR-5",
                "no codebook record asks for this CODB chunk, or it is the second",
                found=f"id {key[0]}, layer {key[1]}",
            )
        wanted.remove(key)
    if wanted:
        missing = min(wanted)
        raise FormatError(
            _spec.ERROR_INDEX, at.start, "DIR-5", f"no CODB chunk for codebook {missing[0]}, layer {missing[1]}"
        )


def scaled_step(step: float, exponent: int, least: float = STEP_MIN) -> float | None:
    """Return step × 2^exponent (exact), or `None` if it is not finite or below `least` (TIL-9, LAT-1)."""
    try:
        scaled = math.ldexp(step, exponent)
    except OverflowError:
        return None
    # Just below 2^-1022 the product may round up to it: then it is not exact.
    return scaled if scaled >= least and math.ldexp(scaled, -exponent) == step else None


def read_tiles(
    view: memoryview,
    at: int,
    end: int,
    head: _spec.IndexHead,
    means_step: float,
    codebooks: tuple[_spec.CodebookRecord, ...],
) -> tuple[Tile, ...]:
    """Read `tile_count` tiles, which must fill the index up to its CRC.

    Args:
        view: the file's beginning.
        at: offset of the first tile.
        end: offset of the index's CRC.
        head: the index head.
        means_step: step of the means' attribute record.
        codebooks: the codebook records.
    """
    known = {book.codebook_id for book in codebooks}
    tiles = []
    start = 0
    for index in range(head.tile_count):
        tile, size = _read_tile(view, at, end, index, start, head)
        _check_tile(tile, means_step)
        _check_codebook_ids(tile, known, at + size - 2 * len(tile.codebook_ids))
        tiles.append(tile)
        start += tile.splat_count
        at += size
    if at != end:
        raise FormatError(
            _spec.ERROR_INDEX, at, "IDX-2", "bytes follow the last tile", found=f"{end - at} bytes", wanted="the CRC"
        )
    if start != head.splat_count:
        raise FormatError(
            _spec.ERROR_INDEX,
            _spec.HEADER_SIZE + _spec.INDEX_HEAD_OFFSETS["splat_count"],
            "IDX-7",
            "splat_count",
            found=head.splat_count,
            wanted=start,
        )
    return tuple(tiles)


def check_coverage(
    directory: tuple[_spec.DirectoryRecord, ...],
    directory_at: range,
    tiles: tuple[Tile, ...],
    head: _spec.IndexHead,
    index_end: int,
    file_size: int,
) -> None:
    """COV-1: the chunks touch one another from the index to the end of the file.

    Args:
        directory: the directory records.
        directory_at: offset of each of them.
        tiles: the tiles.
        head: the index head.
        index_end: offset of the first chunk.
        file_size: end of the last chunk.
    """
    place = _spec.DIRECTORY_RECORD_OFFSETS["offset"]
    chunks = [(record.offset, record.size, at + place) for at, record in zip(directory_at, directory, strict=True)]
    for tile in tiles:
        layer_at = tile.offset + head.tile_size + _spec.LAYER_RECORD_OFFSETS["offset"]
        for i, layer in enumerate(tile.layers.values()):
            chunks.append((layer.offset, layer.size, layer_at + i * head.layer_size))
    chunks.sort()
    expected = index_end
    for offset, size, named_at in chunks:
        if offset != expected:
            raise FormatError(
                _spec.ERROR_INDEX,
                named_at,
                "COV-1",
                "chunks leave a gap or overlap: offset",
                found=offset,
                wanted=expected,
            )
        expected += size
    if expected != file_size:
        raise FormatError(
            _spec.ERROR_INDEX,
            _spec.HEADER_OFFSETS["file_size"],
            "COV-1",
            "the last chunk does not end with the file",
            found=expected,
            wanted=file_size,
        )


def _read_tile(view: memoryview, at: int, end: int, index: int, start: int, head: _spec.IndexHead) -> tuple[Tile, int]:
    """Return a tile, its layers checked, and its size in the index in bytes."""
    if end - at < head.tile_size:
        _ends_early(at)
    record = _spec.unpack_tile_record(view, at)
    layers_at = at + head.tile_size
    tables_at = layers_at + record.layer_count * head.layer_size
    after = tables_at + 2 * record.table_count
    if after > end:
        _ends_early(at)
    check_reserved(record, at, _spec.TILE_RECORD_OFFSETS)
    if record.level != 0:
        raise FormatError(
            _spec.ERROR_RESERVED,
            at + _spec.TILE_RECORD_OFFSETS["level"],
            "RES-1",
            "level",
            found=record.level,
            wanted=0,
        )
    raw = bytes(view[tables_at:after])
    tile = Tile(
        index=index,
        offset=at,
        start=start,
        splat_count=record.splat_count,
        exponent=record.exponent,
        corner=record.corner,
        extent=record.extent,
        max_scale=record.max_scale,
        layers=_read_layers(view, layers_at, record.layer_count, head),
        codebook_ids=tuple(int.from_bytes(raw[i : i + 2], "little") for i in range(0, len(raw), 2)),
    )
    return tile, after - at


def _ends_early(at: int) -> NoReturn:
    raise FormatError(_spec.ERROR_INDEX, at, "IDX-2", "the index ends within a tile")


def _read_layers(view: memoryview, at: int, count: int, head: _spec.IndexHead) -> dict[int, _spec.LayerRecord]:
    layers: dict[int, _spec.LayerRecord] = {}
    last = -1
    for i in range(count):
        place = at + i * head.layer_size
        record = _spec.unpack_layer_record(view, place)
        check_reserved(record, place, _spec.LAYER_RECORD_OFFSETS)
        if record.layer <= last or (i == 0 and record.layer != _spec.LAYER_GEOMETRY):
            raise FormatError(
                _spec.ERROR_INDEX, place, "TIL-2", "layer", found=record.layer, wanted="0, then ascending"
            )
        if record.layer < _spec.ANCILLARY_ID_MIN and record.layer not in _spec.LAYER_NAMES:
            raise UnsupportedError(f"layer {record.layer}", offset=place, clause="RES-2")
        if head.sh_degree < record.layer <= _spec.SH_DEGREE_MAX:
            raise FormatError(
                _spec.ERROR_INDEX, place, "TIL-3", "layer", found=record.layer, wanted=f"{head.sh_degree} at most"
            )
        if record.size < _spec.CHUNK_HEADER_SIZE:
            raise FormatError(
                _spec.ERROR_INDEX,
                place + _spec.LAYER_RECORD_OFFSETS["size"],
                "CHK-3",
                "size",
                found=record.size,
                wanted=f"{_spec.CHUNK_HEADER_SIZE} or more",
            )
        last = record.layer
        layers[last] = record
    if not layers:
        raise FormatError(_spec.ERROR_INDEX, at, "TIL-2", "a tile without layers", wanted="layer 0")
    if (_spec.LAYER_EXTRA in layers) != (head.extra_count > 0):
        raise FormatError(
            _spec.ERROR_INDEX, at, "TIL-5", f"layer EXTRA with {head.extra_count} extra columns", found=[*layers]
        )
    return layers


def _check_tile(tile: Tile, means_step: float) -> None:
    places = _spec.TILE_RECORD_OFFSETS
    if not 1 <= tile.splat_count <= _spec.TILE_SPLATS_MAX:
        raise FormatError(
            _spec.ERROR_VALUE,
            tile.offset,
            "TIL-1",
            "splat_count",
            found=tile.splat_count,
            wanted=f"1 to {_spec.TILE_SPLATS_MAX}",
        )
    for axis, (corner, extent) in enumerate(zip(tile.corner, tile.extent, strict=True)):
        if abs(corner) > _spec.INTEGER_MAX or abs(corner + extent) > _spec.INTEGER_MAX:
            raise FormatError(
                _spec.ERROR_VALUE,
                tile.offset + places["corner"] + 8 * axis,
                "TIL-7",
                "corner and corner + extent",
                found=(corner, corner + extent),
                wanted=f"{_spec.INTEGER_MAX} in magnitude at most",
            )
        if extent >> _spec.AXIS_BITS_MAX:
            raise FormatError(
                _spec.ERROR_VALUE,
                tile.offset + places["extent"] + 4 * axis,
                "TIL-8",
                "extent",
                found=extent,
                wanted=f"below 2^{_spec.AXIS_BITS_MAX}",
            )
    if scaled_step(means_step, tile.exponent) is None:
        raise FormatError(
            _spec.ERROR_VALUE,
            tile.offset + places["exponent"],
            "TIL-9",
            f"{means_step} x 2^{tile.exponent} is not positive, finite and at least 2^-1022",
        )


def _check_codebook_ids(tile: Tile, known: set[int], at: int) -> None:
    last = -1
    for i, identity in enumerate(tile.codebook_ids):
        if identity <= last or identity not in known:
            raise FormatError(
                _spec.ERROR_INDEX, at + 2 * i, "TIL-6", "table id", found=identity, wanted="ids of codebooks, ascending"
            )
        last = identity
