"""Check META, CAMS and OPTS: their JSON text (spec 5.4), by a parser that accepts RFC 8259 and nothing else."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from csplat import _spec
from csplat_conformance.validator.streams import read_stream
from csplat_conformance.validator.violation_log import Payload, ViolationLog

_WHITESPACE = re.compile(r"[ \t\n\r]*")
_NUMBER = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?")
_STRING = re.compile(r'"((?:[^"\\\x00-\x1f]|\\(?:["\\/bfnrt]|u[0-9a-fA-F]{4}))*)"')
_ESCAPE = re.compile(r"\\(u[0-9a-fA-F]{4}|.)")
_SHORT_ESCAPES = {'"': '"', "\\": "\\", "/": "/", "b": "\b", "f": "\f", "n": "\n", "r": "\r", "t": "\t"}
_LITERALS = {"true": True, "false": False, "null": None}
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_SHOWN_MAX = 24  # characters of the text in a message
_CAMERA_KEYS = ("K", "viewmat", "W", "H")
_TEXT_WIDTH = 1


class JsonError(Exception):
    """Raised if a text breaks JSN-1."""


def parse_json(data: bytes) -> Any:
    """Parse a text by JSN-1 and return its value, with numbers as float.

    Raises:
        JsonError: the text breaks JSN-1.
    """
    if data.startswith(_BYTE_ORDER_MARK):
        raise JsonError("a byte order mark")
    try:
        text = data.decode("utf-8", "strict")  # Python refuses surrogates and overlong forms
    except UnicodeDecodeError as error:
        raise JsonError(f"byte {error.start} of the text is not UTF-8") from None
    scanner = _Scanner(text)
    value = scanner.value(0)
    scanner.skip()
    if scanner.at != len(text):
        raise scanner.error("more than one value")
    return value


def check_text(payload: Payload, kind: bytes, bytes_max: int) -> None:
    """Check META, CAMS or OPTS: STR, JSN-1, JSN-2. Missing keys that the spec recommends are remarks."""
    stream = read_stream(payload, "stream", None, _TEXT_WIDTH, count_max=bytes_max)
    payload.finish()
    if stream.elements is None:
        return
    log = payload.log
    try:
        value = parse_json(np.asarray(stream.elements, np.uint8).tobytes())
    except JsonError as error:
        log.add("JSN-1", stream.head.offset, f"{payload.name}/stream", str(error))
        return
    if kind == _spec.CHUNK_CAMERAS:
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            log.add("JSN-1", stream.head.offset, f"{payload.name}/stream", "not an array of objects")
        else:
            _remark_cameras(log, value)
    elif not isinstance(value, dict):
        log.add("JSN-1", stream.head.offset, f"{payload.name}/stream", "not an object")


def _remark_cameras(log: ViolationLog, cameras: list[dict[str, Any]]) -> None:
    for i, camera in enumerate(cameras):
        missing = [key for key in _CAMERA_KEYS if key not in camera]
        if missing:
            log.remarks.append(f"CAMS: camera {i} has no {', '.join(missing)} (5.4)")
            return


class _Scanner:
    """A parser at a place of a text. JSON_DEPTH_MAX bounds the recursion."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0

    def error(self, what: str) -> JsonError:
        near = ascii(self.text[self.at : self.at + _SHOWN_MAX])
        return JsonError(f"{what} at character {self.at}, {near}")

    def skip(self) -> None:
        match = _WHITESPACE.match(self.text, self.at)
        self.at = match.end() if match else self.at

    def taken(self, character: str) -> bool:
        self.skip()
        if self.text.startswith(character, self.at):
            self.at += len(character)
            return True
        return False

    def value(self, depth: int) -> Any:
        self.skip()
        first = self.text[self.at : self.at + 1]
        if first in ("{", "["):
            if depth == _spec.JSON_DEPTH_MAX:
                raise self.error(f"more than {_spec.JSON_DEPTH_MAX} levels")
            self.at += 1
            return self.object(depth + 1) if first == "{" else self.array(depth + 1)
        if first == '"':
            return self.string()
        for word, value in _LITERALS.items():
            if self.taken(word):
                return value
        return self.number()

    def object(self, depth: int) -> dict[str, Any]:
        result: dict[str, Any] = {}
        if self.taken("}"):
            return result
        while True:
            self.skip()
            start = self.at
            name = self.string()
            if name in result:
                self.at = start
                raise self.error("a name that the object has already")
            if not self.taken(":"):
                raise self.error("no colon")
            result[name] = self.value(depth)
            if self.taken("}"):
                return result
            if not self.taken(","):
                raise self.error("neither comma nor end of an object")

    def array(self, depth: int) -> list[Any]:
        result: list[Any] = []
        if self.taken("]"):
            return result
        while True:
            result.append(self.value(depth))
            if self.taken("]"):
                return result
            if not self.taken(","):
                raise self.error("neither comma nor end of an array")

    def string(self) -> str:
        match = _STRING.match(self.text, self.at)
        if match is None:
            raise self.error("no string")
        units = _ESCAPE.sub(_unescape, match[1])
        # Surrogates written as two escapes join to a pair; a lone surrogate is an error.
        try:
            value = units.encode("utf-16-le", "surrogatepass").decode("utf-16-le", "strict")
        except UnicodeDecodeError:
            raise self.error("half of a surrogate pair") from None
        self.at = match.end()
        return value

    def number(self) -> float:
        match = _NUMBER.match(self.text, self.at)
        if match is None:
            raise self.error("no value")
        value = float(match[0])
        if math.isinf(value):
            raise self.error("a number beyond binary64")
        self.at = match.end()
        return value


def _unescape(match: re.Match[str]) -> str:
    code = match[1]
    return chr(int(code[1:], 16)) if len(code) == 5 else _SHORT_ESCAPES[code]
