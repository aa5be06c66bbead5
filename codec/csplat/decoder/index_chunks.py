"""Records of codebooks, extra columns and chunks (spec 4.3.2 to 4.3.4)."""

from __future__ import annotations

from csplat import _spec
from csplat.decoder.container import check_reserved
from csplat.decoder.header import ExtraColumn
from csplat.errors import FormatError, UnsupportedError

_CONTROL = frozenset(chr(c) for c in (*range(0x20), 0x7F))
_SINGLE_CHUNKS = (_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS, _spec.CHUNK_OPTIONS, _spec.CHUNK_STATED_ERRORS)


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
