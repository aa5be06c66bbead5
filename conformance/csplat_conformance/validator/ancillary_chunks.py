# SPDX-License-Identifier: CC0-1.0
"""Check ancillary chunks: the JSON texts META, CAMS and OPTS (spec 5.4), and the declared error bounds SERR (5.5)."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from csplat import _spec
from csplat_conformance.tolerance import bound_tolerance, least_true_error
from csplat_conformance.validator.index import Index
from csplat_conformance.validator.streams import read_stream
from csplat_conformance.validator.violation_log import Payload, PlacedRecord, ViolationLog

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
    """Raised if a text violates JSN-1."""


def parse_json(data: bytes) -> Any:
    """Parse a text by JSN-1 and return its value, with numbers as float.

    Raises:
        JsonError: the text violates JSN-1.
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
    """Check META, CAMS or OPTS: STR, JSN-1, JSN-2. Missing keys of cameras are remarks."""
    stream = read_stream(payload, "stream", None, _TEXT_WIDTH, count_max=bytes_max // _spec.JSON_BYTE_COST)
    payload.finish()
    if stream.elements is None:
        return
    log = payload.log
    text = np.asarray(stream.elements, np.uint8)
    memory = _spec.JSON_BYTE_COST * len(text) + _spec.JSON_VALUE_COST * int(np.isin(text, list(b",:[{")).sum())
    if memory > bytes_max:
        log.add_field("STR-8", stream.head, "count", f"{memory} bytes of memory, expected at most {bytes_max} (budget)")
        return
    try:
        value = parse_json(text.tobytes())
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
    """Add a remark about the first camera without a usual key."""
    for i, camera in enumerate(cameras):
        missing = [key for key in _CAMERA_KEYS if key not in camera]
        if missing:
            log.remarks.append(f"CAMS: camera {i} has no {', '.join(missing)} (5.4)")
            return


class _Scanner:
    """A recursive-descent parser, with a depth limit of JSON_DEPTH_MAX."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0

    def error(self, what: str) -> JsonError:
        """Return an error with the position and the next characters."""
        near = ascii(self.text[self.at : self.at + _SHOWN_MAX])
        return JsonError(f"{what} at character {self.at}, {near}")

    def skip(self) -> None:
        """Step over white space."""
        match = _WHITESPACE.match(self.text, self.at)
        self.at = match.end() if match else self.at

    def taken(self, character: str) -> bool:
        """Step over white space and over a character, if it is next; return True if it was."""
        self.skip()
        if self.text.startswith(character, self.at):
            self.at += len(character)
            return True
        return False

    def value(self, depth: int) -> Any:
        """Read a value within `depth` arrays and objects."""
        self.skip()
        first = self.text[self.at : self.at + 1]
        if first in ("{", "["):
            if depth == _spec.JSON_DEPTH_MAX:
                raise self.error(f"more than {_spec.JSON_DEPTH_MAX} levels")
            self.at += 1
            return self.object(depth + 1) if first == "{" else self.array(depth + 1)
        if first == '"':
            return self.string()
        for literal, value in _LITERALS.items():
            if self.taken(literal):
                return value
        return self.number()

    def object(self, depth: int) -> dict[str, Any]:
        """Read an object after its brace."""
        result: dict[str, Any] = {}
        if self.taken("}"):
            return result
        while True:
            self.skip()
            start = self.at
            name = self.string()
            if name in result:
                self.at = start
                raise self.error("a repeated name")
            if not self.taken(":"):
                raise self.error("no colon")
            result[name] = self.value(depth)
            if self.taken("}"):
                return result
            if not self.taken(","):
                raise self.error("neither comma nor end of an object")

    def array(self, depth: int) -> list[Any]:
        """Read an array after its bracket."""
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
        """Read a string; a string that is not Unicode text is an error."""
        match = _STRING.match(self.text, self.at)
        if match is None:
            raise self.error("no string")
        units = _ESCAPE.sub(_unescape, match[1])
        # Surrogates written as two escapes form a pair; a lone surrogate is an error.
        try:
            value = units.encode("utf-16-le", "surrogatepass").decode("utf-16-le", "strict")
        except UnicodeDecodeError:
            raise self.error("half of a surrogate pair") from None
        self.at = match.end()
        return value

    def number(self) -> float:
        """Read a number, finite in binary64."""
        match = _NUMBER.match(self.text, self.at)
        if match is None:
            raise self.error("no value")
        value = float(match[0])
        if math.isinf(value):
            raise self.error("a number beyond binary64")
        self.at = match.end()
        return value


def _unescape(match: re.Match[str]) -> str:
    """Return the UTF-16 unit of an escape, `u00e9` or `n`; `_STRING` admits no others."""
    code = match[1]
    return _SHORT_ESCAPES[code] if code in _SHORT_ESCAPES else chr(int(code[1:], 16))


# Declared error bounds -----------------------------------------------------------------------------

#: Components of a splat by measure: its rms is at most its maximum times their root (SER-2).
_COMPONENTS = {"means": 1, "covariance": 1, "opacities": 1, "sh0": 3, "sh1": 9, "sh2": 15, "sh3": 21, "sh4": 27}
_ROUNDING = 1.0 + 2.0**-20  # factor by which rounded bounds may exceed a limit (SER-2)


def check_declared_bounds(payload: Payload, index: Index) -> None:
    """Check SERR: SER-1 to SER-4, and SER-5 as far as possible without the source."""
    log = payload.log
    head = payload.structure(_spec.DeclaredErrorsHead, "head")
    declared = head.record
    unlisted = declared.error_flags & ~sum(_spec.ERROR_FLAG_NAMES)
    if unlisted:
        log.add_field("RES-1", head, "error_flags", f"bits {unlisted:#04x} are reserved")
    splats = index.head.record.splat_count
    if declared.source_count - declared.pruned_count != splats:
        message = f"{declared.source_count} minus {declared.pruned_count} pruned, expected {splats}"
        log.add_field("SER-4", head, "source_count", message)
    last = 0
    for i in range(declared.record_count):
        name = _spec.MEASURE_NAMES.get(payload.view[payload.at] if payload.left else 0, str(i))
        record = payload.structure(_spec.DeclaredErrorRecord, f"record[{name}]")
        measure = record.record.measure
        if measure not in _spec.MEASURE_NAMES:
            log.add_field("SER-1", record, "measure", f"{measure} is not in the registry")
        elif measure <= last:
            log.add_field("SER-1", record, "measure", f"{measure} after {last}, expected ascending measures")
        last = max(last, measure)
        if _check_bound(log, record) and measure in _spec.MEASURE_NAMES:
            _check_bound_possible(log, record, index, declared.source_sh_degree)
    payload.finish()


def _check_bound(log: ViolationLog, record: PlacedRecord[_spec.DeclaredErrorRecord]) -> bool:
    """Check SER-2; return True if it holds."""
    largest, rms = record.record.max, record.record.rms
    wrong = [key for key, value in (("max", largest), ("rms", rms)) if not 0.0 <= value < math.inf]
    for key in wrong:
        log.add_field("SER-2", record, key, f"{getattr(record.record, key)}, expected finite and not negative")
    if wrong:
        return False
    components = _COMPONENTS.get(_spec.MEASURE_NAMES.get(record.record.measure, ""))
    if components is not None and rms > largest * math.sqrt(components) * _ROUNDING:
        message = f"{largest:.9g}, too small for rms {rms:.9g} of {components} components"
        log.add_field("SER-2", record, "max", message)
        return False
    return True


def _check_bound_possible(
    log: ViolationLog, record: PlacedRecord[_spec.DeclaredErrorRecord], index: Index, source_degree: int
) -> None:
    """Check SER-5 without the source: some pair of scenes must have errors that permit this bound.

    One splat has the true maximum, which the declared maximum hardly exceeds. The true rms is therefore at least that
    maximum over √N, and the declared rms is hardly smaller (SER-7).
    """
    largest, rms = record.record.max, record.record.rms
    splats, measure = index.head.record.splat_count, _spec.MEASURE_NAMES[record.record.measure]
    least = least_true_error(measure, largest)
    if splats and rms * _ROUNDING + bound_tolerance(measure, rms, 0.0) < least / math.sqrt(splats):
        message = f"{rms:.9g} is too small for max {largest:.9g} over {splats} splats"
        log.add_field("SER-5", record, "rms", message)
    if measure == "opacities" and least > 1.0:
        log.add_field("SER-5", record, "max", f"alpha differs by at most 1, not by {largest:.9g}")
    band = record.record.measure - _spec.MEASURE_SH0
    degree = index.degree if index.degree is not None else _spec.SH_DEGREE_MAX
    if (band > max(degree, source_degree) or not splats) and least > 0.0:
        log.add_field("SER-5", record, "max", f"{largest:.9g} for {measure}, expected 0: neither scene has {measure}")
