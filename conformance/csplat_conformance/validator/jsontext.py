"""JSON texts (spec 5.4): a scanner of RFC 8259 that takes nothing else."""

from __future__ import annotations

import math
import re
from typing import Any

from csplat import _spec

_SPACE = re.compile(r"[ \t\n\r]*")
_NUMBER = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?")
_STRING = re.compile(r'"((?:[^"\\\x00-\x1f]|\\(?:["\\/bfnrt]|u[0-9a-fA-F]{4}))*)"')
_ESCAPE = re.compile(r"\\(u[0-9a-fA-F]{4}|.)")
_SHORT = {'"': '"', "\\": "\\", "/": "/", "b": "\b", "f": "\f", "n": "\n", "r": "\r", "t": "\t"}
_WORDS = {"true": True, "false": False, "null": None}
_MARK = b"\xef\xbb\xbf"
_SHOWN = 24  # characters of the text in a message


class JsonError(Exception):
    """The text breaks JSN-1."""


def parse(data: bytes) -> Any:
    """Parse a text by JSN-1 and return its value; numbers as float.

    Raises:
        JsonError: in words.
    """
    if data.startswith(_MARK):
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


class _Scanner:
    """A place in a text. Recursion is bounded by JSON_DEPTH_MAX."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0

    def error(self, what: str) -> JsonError:
        near = ascii(self.text[self.at : self.at + _SHOWN])
        return JsonError(f"{what} at character {self.at}, {near}")

    def skip(self) -> None:
        match = _SPACE.match(self.text, self.at)
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
        for word, value in _WORDS.items():
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
        units = _ESCAPE.sub(_unescaped, match[1])
        # Halves of a pair that were written as two escapes join; a half that is left is no text.
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


def _unescaped(match: re.Match[str]) -> str:
    code = match[1]
    return chr(int(code[1:], 16)) if len(code) == 5 else _SHORT[code]
