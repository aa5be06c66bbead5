# SPDX-License-Identifier: Apache-2.0
"""Read the chunks other than tiles and codebooks: JSON texts (spec 5.4) and declared error bounds (spec 5.5)."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from csplat import _spec
from csplat.decoder.container import SceneHeader, check_reserved, open_chunk, refuse_field, view_of
from csplat.decoder.entropy import read_stream
from csplat.decoder.index import parse_header
from csplat.decoder.limits import Limits
from csplat.errors import FormatError, LimitError
from csplat.scene_metadata import SceneMetadata

if TYPE_CHECKING:
    from csplat.file_source import File


_BOM = b"\xef\xbb\xbf"
_VALUE_MARKS = (b",", b":", b"[", b"{")  # STR-8: a mark precedes or follows every value
_INT_DIGITS = 300  # digits; longer integers are read as binary64

#: Components of each measure, for SER-2.
_BOUND_COMPONENTS = {
    _spec.MEASURE_MEANS: 1,
    _spec.MEASURE_COVARIANCE: 1,
    _spec.MEASURE_OPACITIES: 1,
    _spec.MEASURE_SH0: _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_SH0],
    _spec.MEASURE_SH1: _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_SH1],
    _spec.MEASURE_SH2: _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_SH2],
    _spec.MEASURE_SH3: _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_SH3],
    _spec.MEASURE_SH4: _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_SH4],
}
_SLACK = 1.0 + 2.0**-20  # SER-2: tolerance for the rounding of both numbers


@dataclass(frozen=True)
class DeclaredBound:
    """The declared error bound of one measure.

    Attributes:
        measure: name in the registry, `means`.
        max: maximum error of a splat in the file.
        rms: root mean square error of the splats in the file.
    """

    measure: str
    max: float
    rms: float


@dataclass(frozen=True)
class DeclaredBounds:
    """The declared error bounds of a file, relative to the model that was encoded.

    Attributes:
        source_count: number of splats of the source.
        pruned_count: number of source splats that are not in the file.
        source_sh_degree: SH degree of the source.
        refitted: attributes were refitted; measures without a record can only be verified by renders.
        records: bound of each measure.
    """

    source_count: int
    pruned_count: int
    source_sh_degree: int
    refitted: bool
    records: tuple[DeclaredBound, ...]


def read_metadata(data: File, *, limits: Limits | None = None) -> SceneMetadata:
    """Return the metadata of a scene: flags, axes and unit of the index, and the contents of META and CAMS."""
    view = view_of(data)
    return scene_metadata(view, parse_header(view, whole=True, limits=limits), limits or Limits())


def scene_metadata(view: memoryview, header: SceneHeader, limits: Limits) -> SceneMetadata:
    """Return the metadata of a scene whose header has been parsed.

    Raises:
        FormatError, LimitError: as in `json_chunk`.
    """
    return SceneMetadata(
        coordinate_system=header.coordinate_system,
        unit_metres=header.unit_metres,
        antialiased=header.antialiased,
        flat=header.flat,
        colour_space=_spec.COLOUR_SPACE_NAMES.get(header.colour_space, str(header.colour_space)),
        entries=json_chunk(view, header, _spec.CHUNK_METADATA, limits.json_bytes) or {},
        cameras=json_chunk(view, header, _spec.CHUNK_CAMERAS, limits.json_bytes),
        semantics={column.name: column.semantic for column in header.extras if column.semantic},
    )


def read_options(data: File, *, limits: Limits | None = None) -> dict[str, Any] | None:
    """Return the content of the OPTS chunk, `None` if there is none."""
    value: dict[str, Any] | None = _read_text(data, _spec.CHUNK_OPTIONS, limits)
    return value


def read_declared_bounds(data: File) -> DeclaredBounds | None:
    """Return the content of the SERR chunk, `None` if there is none."""
    view = view_of(data)
    return bounds_chunk(view, parse_header(view, whole=True))


def json_chunk(view: memoryview, header: SceneHeader, kind: bytes, json_bytes: int) -> Any:
    """Return the content of a META, CAMS or OPTS chunk, `None` if the file has none.

    Raises:
        FormatError: E_JSON, or the stream breaks a clause.
        LimitError: the text would take more memory than `json_bytes`.
    """
    record = header.chunk(kind)
    if record is None:
        return None
    cursor = open_chunk(view, record, record.type, record.flags, "JSN-2")
    at = cursor.at
    text = read_stream(cursor, None, 1, json_bytes=json_bytes).tobytes()
    cursor.finish()
    cost = _spec.JSON_BYTE_COST * len(text) + _spec.JSON_VALUE_COST * sum(map(text.count, _VALUE_MARKS))
    if cost > json_bytes:
        offset = at + _spec.STREAM_HEAD_OFFSETS["count"]
        raise LimitError("json_bytes", cost, json_bytes, offset=offset, clause="STR-8")
    return parse_json(text, list if kind == _spec.CHUNK_CAMERAS else dict, at)


def parse_json(text: bytes, kind: type[dict[str, Any] | list[Any]], at: int) -> Any:
    """Parse a JSON text and check JSN-1.

    Args:
        text: UTF-8.
        kind: `dict`, or `list` for an array of objects.
        at: offset of the stream in the file, for errors.
    """
    try:
        if text.startswith(_BOM):
            raise _RefusedError("byte order mark")
        value = json.loads(
            text.decode("utf-8"),
            object_pairs_hook=_parse_object,
            parse_constant=_refuse_constant,
            parse_float=_parse_number,
            parse_int=_parse_integer,
        )
        _check_json_tree(value)
    except (ValueError, RecursionError) as error:
        reason = str(error) or type(error).__name__
        raise FormatError(_spec.ERROR_JSON, at, "JSN-1", reason) from None
    if not isinstance(value, kind) or (kind is list and not all(isinstance(item, dict) for item in value)):
        wanted = "an array of objects" if kind is list else "an object"
        raise FormatError(_spec.ERROR_JSON, at, "JSN-1", "top level", found=type(value).__name__, wanted=wanted)
    return value


def bounds_chunk(view: memoryview, header: SceneHeader) -> DeclaredBounds | None:
    """Return the content of the SERR chunk, `None` if the file has none."""
    record = header.chunk(_spec.CHUNK_DECLARED_ERRORS)
    if record is None:
        return None
    cursor = open_chunk(view, record, record.type, record.flags, "SER-3")
    at = cursor.take(_spec.DECLARED_ERRORS_HEAD_SIZE)
    head = _spec.unpack_declared_errors_head(view, at)
    if head.error_flags & ~sum(_spec.ERROR_FLAG_NAMES):
        refuse_field(_spec.ERROR_RESERVED, "RES-1", head, at, _spec.DECLARED_ERRORS_HEAD_OFFSETS, "error_flags")
    if head.source_count - head.pruned_count != header.splat_count:
        kept_count, wanted = head.source_count - head.pruned_count, header.splat_count
        raise FormatError(
            _spec.ERROR_VALUE, at, "SER-4", "source_count - pruned_count", found=kept_count, wanted=wanted
        )
    records: list[DeclaredBound] = []
    last = 0
    for _ in range(head.record_count):
        at = cursor.take(_spec.DECLARED_ERROR_RECORD_SIZE)
        item = _spec.unpack_declared_error_record(view, at)
        last = _check_bound_record(item, at, last)
        records.append(DeclaredBound(_spec.MEASURE_NAMES[item.measure], item.max, item.rms))
    cursor.finish()
    return DeclaredBounds(
        head.source_count,
        head.pruned_count,
        head.source_sh_degree,
        bool(head.error_flags & _spec.ERROR_FLAG_REFITTED),
        tuple(records),
    )


def _read_text(data: File, kind: bytes, limits: Limits | None) -> Any:
    """Return the parsed JSON of the file's chunk of type `kind`; as in `json_chunk`."""
    view = view_of(data)
    return json_chunk(view, parse_header(view, whole=True, limits=limits), kind, (limits or Limits()).json_bytes)


class _RefusedError(ValueError):
    """JSON that the `json` module accepts and JSN-1 forbids."""


def _parse_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the object of pairs from the `json` module; raise a `_RefusedError` if a name occurs twice."""
    result = dict(pairs)
    if len(result) != len(pairs):
        raise _RefusedError("a name occurs twice in an object")
    return result


def _refuse_constant(name: str) -> None:
    """Raise a `_RefusedError`: `NaN` and `Infinity`, which the `json` module accepts, are not JSON."""
    raise _RefusedError(f"{name} is not JSON")


def _parse_number(digits: str) -> float:
    """Return the number of a decimal; raise a `_RefusedError` if it exceeds binary64."""
    value = float(digits)
    if not math.isfinite(value):
        raise _RefusedError("a number is not finite in binary64")
    return value


def _parse_integer(digits: str) -> int | float:
    """Return the number of an integer; a float if it has more than `_INT_DIGITS` digits."""
    return int(digits) if len(digits) <= _INT_DIGITS else _parse_number(digits)


def _check_json_tree(value: Any) -> None:
    """Raise a `_RefusedError` for deep nesting, and a `ValueError` for strings that are not Unicode text.

    Walks the tree level by level, because recursion would overflow on the nesting to be refused.
    """
    level: list[Any] = [value]
    depth = 0
    while level:
        nested: list[Any] = []
        for item in level:
            if isinstance(item, dict):
                nested.extend(item.keys())
                nested.extend(item.values())
            elif isinstance(item, list):
                nested.extend(item)
            elif isinstance(item, str):
                item.encode("utf-8")  # an unpaired surrogate (\ud800) raises ValueError
        if any(isinstance(item, dict | list) for item in level):
            depth += 1
        if depth > _spec.JSON_DEPTH_MAX:
            raise _RefusedError(f"nested more than {_spec.JSON_DEPTH_MAX} deep")
        level = nested


def _check_bound_record(record: _spec.DeclaredErrorRecord, at: int, last: int) -> int:
    """Check SER-1 and SER-2; return the measure."""
    offsets = _spec.DECLARED_ERROR_RECORD_OFFSETS
    check_reserved(record, at, offsets)
    if record.measure not in _spec.MEASURE_NAMES or record.measure <= last:
        refuse_field(_spec.ERROR_VALUE, "SER-1", record, at, offsets, "measure", "registered ids, ascending")
    bound = record.max * math.sqrt(_BOUND_COMPONENTS[record.measure]) * _SLACK
    if not (0.0 <= record.max < math.inf and 0.0 <= record.rms < math.inf and record.rms <= bound):
        detail = f"max and rms of {_spec.MEASURE_NAMES[record.measure]}"
        raise FormatError(_spec.ERROR_VALUE, at + offsets["max"], "SER-2", detail, found=(record.max, record.rms))
    return record.measure
