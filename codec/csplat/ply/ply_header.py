"""Read the headers of PLY files.

Headers may have byte order marks, blank lines, keywords in capitals and spaces after `end_header`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from csplat.detect import KINDS, detect_content, is_ply, read_head, refusal
from csplat.errors import InputError, counted
from csplat.lint import Finding

#: The element of the splats.
SPLAT_ELEMENT = "vertex"

_END_OF_HEADER = re.compile(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", re.IGNORECASE)
_MAX_SIZE = 1 << 20  # bytes of a header; programs write up to a few kilobytes
_MAX_DECLARED = 4096  # elements and properties; SH of degree 4 takes 87, and each takes memory in every block of rows
_MARK = b"\xef\xbb\xbf"  # byte order mark of UTF-8
_WIDE_MARKS = (b"\xff\xfe", b"\xfe\xff")  # byte order marks of UTF-16
_LINE_END = re.compile(rb"\r\n|\r|\n")
_FREE_TEXT = (b"comment", b"obj_info")  # keywords that are followed by free text
_SHOWN = 80  # maximum number of characters of a line in a message
_DIGITS = 18  # digits of a count; longer ones exceed every file
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", **{kind: kind for kind in ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")},
}  # fmt: skip


@dataclass(frozen=True)
class PlyProperty:
    """A property as a header declares it.

    Attributes:
        name: name of the property.
        kind: type of the values, `f4`.
        length_kind: type of the length of a list; `None`: a single value.
    """

    name: str
    kind: str
    length_kind: str | None = None


@dataclass
class PlyElement:
    """An element as a header declares it.

    Attributes:
        name: name of the element.
        count: number of rows.
        properties: its properties.
    """

    name: str
    count: int
    properties: list[PlyProperty] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        """True if a property is a list."""
        return any(one.length_kind is not None for one in self.properties)

    def dtype(self, order: str) -> np.dtype[Any]:
        """Return the type of a row without its lists, in this byte order."""
        return np.dtype([(one.name, order + one.kind) for one in self.properties if one.length_kind is None])


@dataclass(frozen=True)
class PlyHeader:
    """A parsed header.

    Attributes:
        end: offset of the rows in the file.
        order: byte order of the rows as NumPy writes it; `=` if the rows are numbers in ASCII.
        elements: the declared elements.
        comments: comments, then other information about the file, then comments on elements.
        line_end: the characters that end its last line.
    """

    end: int
    order: str
    elements: list[PlyElement]
    comments: list[str]
    line_end: bytes

    @property
    def is_text(self) -> bool:
        """True if the rows are numbers in ASCII."""
        return self.order == _ORDERS["ascii"]


def read_ply_header(path: Path, findings: list[Finding], kind: str = "ply") -> PlyHeader:
    """Read the header of a PLY.

    Args:
        path: path of the file.
        findings: findings are appended to this list.
        kind: name of the expected kind of PLY, a key of `csplat.detect.KINDS`.

    Raises:
        InputError: the file is not a PLY of this kind, or its header has no end, is invalid or beyond the limits.
        OSError: the file cannot be read.
    """
    head = read_head(path)
    if head.startswith(_WIDE_MARKS) and is_ply(head[2:].replace(b"\0", b"")):
        raise InputError(f"{path.name} is a PLY in UTF-16, expected ASCII: save it as UTF-8")
    if detect_content(path, head) not in (KINDS["ply"], KINDS[kind]):
        raise refusal(path, head, wanted=kind)
    with path.open("rb") as stream:
        start = len(_MARK) if head.startswith(_MARK) else 0
        stream.seek(start)
        data = stream.read(_MAX_SIZE)
    end = _END_OF_HEADER.search(data)
    if end is None:
        where = f" in its first {_MAX_SIZE:,} bytes" if len(data) == _MAX_SIZE else ""
        raise InputError(f"{path.name}: the PLY header has no line end_header{where}")
    raw = data[: end.end()]
    if raw[3:5] not in (b"\r\n", b"\r") and raw[3:4] == b"\r" and raw.endswith(b"\r\n"):
        raw = raw[:-1]  # the lines end with CR, so the LF is the first byte of a row
    lines, oddities = _normalise_lines(raw)
    if start:
        oddities.insert(0, "a byte order mark")
    if oddities:
        findings.append(Finding("unusual-header", len(oddities), f"the header has {', '.join(oddities)}", "note"))
    if not raw.isascii():
        count = sum(byte > 127 for byte in raw)
        note = f"{counted(count, 'byte')} of the header are not ASCII: read as question marks"
        findings.append(Finding("non-ascii-header", count, note, "note"))
    texts = [line.decode("ascii", "replace").replace("\ufffd", "?") for line in lines]
    try:
        order, elements, comments = _parse_lines(texts, findings, path.stat().st_size)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None
    return PlyHeader(start + len(raw), order, elements, comments, _LINE_END.findall(raw[-2:])[-1])


def _normalise_lines(raw: bytes) -> tuple[list[bytes], list[str]]:
    """Split a header into lines without blank ones, with keywords in lower case, and list its oddities."""
    lines = _LINE_END.split(raw)[:-1]
    normalised = [_normalise_line(line) for line in lines]
    changed = [old for old, new in zip(lines, normalised, strict=True) if old is not new and old.split() != new.split()]
    words = dict.fromkeys(word for line in changed for word in line.split() if word != word.lower())
    blank = sum(not line.strip() for line in lines)
    oddities = [f"{blank} blank lines" if blank > 1 else "a blank line"] if blank else []
    oddities += [f"capitals in {' '.join(word.decode('ascii', 'replace') for word in [*words][:3])}"] if words else []
    oddities += ["spaces next to end_header"] if lines[-1].lower() != b"end_header" else []
    first = _LINE_END.search(raw)
    assert first is not None, "the line end_header has an end"
    if sum(map(raw.count, (b"\r", b"\n"))) != len(lines) * len(first[0]) or raw.count(first[0]) != len(lines):
        oddities.append("line ends of two kinds")
    return [line for line in normalised if line.strip()], oddities


def _normalise_line(line: bytes) -> bytes:
    """Return a header line in lower case except for names and free text; it never becomes longer."""
    words = line.split()
    keyword = words[0].lower() if words else b""
    if keyword in _FREE_TEXT:
        return keyword + line.lstrip()[len(keyword) :]
    if keyword in (b"ply", b"format", b"end_header"):
        normalised = [word.lower() for word in words]
    elif keyword == b"property":
        normalised = [*(word.lower() for word in words[:-1]), words[-1]]
    elif keyword == b"element":
        named = [word.lower() if word.lower() == SPLAT_ELEMENT.encode() else word for word in words[1:]]
        normalised = [keyword, *named]
    else:
        return line
    return line if words == normalised and keyword not in (b"ply", b"end_header") else b" ".join(normalised)


def _parse_lines(lines: Sequence[str], findings: list[Finding], size: int) -> tuple[str, list[PlyElement], list[str]]:
    """Return the byte order, the elements and the comments.

    Args:
        lines: normalised lines without blank ones.
        findings: findings about the counts are appended to this list.
        size: size of the file in bytes.

    Raises:
        InputError: a line is invalid, or too many elements and properties are declared.
    """
    order, declared = "", 0
    elements: list[PlyElement] = []
    comments: list[str] = []
    names: set[str] = set()  # the last element has these properties
    remarks: tuple[list[str], list[str]] = [], []  # other information, comments on elements
    for line in lines[1:-1]:
        keyword, *words = line.split(None, 1)
        if keyword in ("comment", "obj_info"):
            into = remarks[0] if keyword == "obj_info" else remarks[1] if elements else comments
            into.append(line.strip()[len(keyword) + 1 :])
            continue
        declared += keyword in ("element", "property")
        if declared > _MAX_DECLARED:
            raise InputError(f"the header declares more than {_MAX_DECLARED:,} elements and properties")
        words = words[0].split() if words else []
        if keyword == "format" and not order and not elements and len(words) == 2 and words[1] == "1.0":
            order = _ORDERS.get(words[0], "")
        elif keyword == "element" and order and len(words) == 2:
            elements.append(PlyElement(words[0], _parse_count(words[1], findings, size)))
            if any(one.name == words[0] for one in elements[:-1]):
                raise InputError(f"the header declares two elements with the same name {words[0][:_SHOWN]}")
            names = set()
        elif keyword == "property" and elements and (found := _parse_property(words)):
            elements[-1].properties.append(found)
            if found.name in names:
                raise InputError(f"the header declares two properties with the same name {found.name[:_SHOWN]}")
            names.add(found.name)
        else:
            raise InputError(f"the header line {line[:_SHOWN]!r} is not valid in a PLY")
        if not order:
            raise InputError(
                f"the header line {line[:_SHOWN]!r} is not valid, expected format {' or '.join(_ORDERS)} 1.0"
            )
    if not order:
        raise InputError("the header has no line format")
    return order, elements, [*comments, *remarks[0], *remarks[1]]


def _parse_property(words: Sequence[str]) -> PlyProperty | None:
    """Return a property; `None` if its line is invalid."""
    if len(words) == 2 and words[0] in _TYPES:
        return PlyProperty(words[1], _TYPES[words[0]])
    if len(words) != 4 or words[0] != "list" or not {words[1], words[2]} <= set(_TYPES):
        return None
    length = _TYPES[words[1]]
    return None if length[0] == "f" else PlyProperty(words[3], _TYPES[words[2]], length)


def _parse_count(word: str, findings: list[Finding], size: int) -> int:
    """Return the number of rows of an element, after adding a finding if it is negative or exceeds the file."""
    digits = word.removeprefix("-")
    if not digits.isdecimal() or not digits.isascii():
        raise InputError(f"the count {word[:_SHOWN]!r} is not a whole number")
    shown = word if len(word) <= _DIGITS + 2 else f"{word[:_DIGITS]}... ({len(word):,} digits)"
    if digits != word:
        findings.append(Finding("malformed", 1, f"{shown} rows are declared", "error"))
        return 0
    count = int(word) if len(word) <= _DIGITS else 10**_DIGITS
    if count > size:  # a row has at least one byte; refuse before anything is allocated
        text = f"{shown} rows are declared, the file has {size} bytes: copy or download it again"
        findings.append(Finding("truncated", count, text, "error"))
    return count
