"""JSON chunks, read strictly (spec 5.4)."""

from __future__ import annotations

import json
import math
from typing import Any

from csplat import _spec
from csplat.decoder.container import open_chunk
from csplat.decoder.header import SceneHeader
from csplat.decoder.streams import read_stream
from csplat.errors import FormatError

_BOM = b"\xef\xbb\xbf"
_INT_DIGITS = 300  # longer ones are read as binary64, far beyond any integer that JavaScript keeps


class _RefusedError(ValueError):
    """JSON that the `json` module accepts and JSN-1 forbids."""


def read_json(view: memoryview, header: SceneHeader, kind: bytes, json_bytes: int) -> Any:
    """Return the value of the META, CAMS or OPTS chunk, `None` if the file has none.

    Args:
        view: the whole file.
        header: its header.
        kind: type of the chunk.
        json_bytes: budget for the text.

    Raises:
        FormatError: E_JSON, or what its stream breaks.
        LimitError: the text is longer than `json_bytes`.
    """
    record = header.chunk(kind)
    if record is None:
        return None
    cursor = open_chunk(view, record, record.type, record.flags, "JSN-2")
    at = cursor.at
    text = read_stream(cursor, None, 1, count_max=json_bytes).tobytes()
    cursor.finish()
    return parse_json(text, list if kind == _spec.CHUNK_CAMERAS else dict, at)


def parse_json(text: bytes, kind: type[dict[str, Any] | list[Any]], at: int) -> Any:
    """Parse a text by JSN-1.

    Args:
        text: UTF-8.
        kind: `dict`, or `list` for an array of objects.
        at: offset in the file where its stream begins, for errors.
    """
    try:
        if text.startswith(_BOM):
            raise _RefusedError("byte order mark")
        value = json.loads(
            text.decode("utf-8"),
            object_pairs_hook=_object,
            parse_constant=_constant,
            parse_float=_number,
            parse_int=_integer,
        )
        _check_tree(value)
    except (ValueError, RecursionError) as error:
        reason = str(error) or type(error).__name__
        raise FormatError(_spec.ERROR_JSON, at, "JSN-1", reason) from None
    if not isinstance(value, kind) or (kind is list and not all(isinstance(item, dict) for item in value)):
        wanted = "an array of objects" if kind is list else "an object"
        raise FormatError(_spec.ERROR_JSON, at, "JSN-1", "top level", found=type(value).__name__, wanted=wanted)
    return value


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise _RefusedError("a name occurs twice in an object")
    return result


def _constant(name: str) -> None:
    raise _RefusedError(f"{name} is not JSON")


def _number(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise _RefusedError("a number is not finite in binary64")
    return value


def _integer(digits: str) -> int | float:
    return int(digits) if len(digits) <= _INT_DIGITS else _number(digits)


def _check_tree(value: Any) -> None:
    """Refuse what is nested too deep and strings that are not Unicode text; no recursion."""
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
        depth += any(isinstance(item, dict | list) for item in level)
        if depth > _spec.JSON_DEPTH_MAX:
            raise _RefusedError(f"nested more than {_spec.JSON_DEPTH_MAX} deep")
        level = nested
