# SPDX-License-Identifier: Apache-2.0
"""Rewrite headers and text rows that plyfile does not accept although their meaning is clear.

Headers may have byte order marks, blank lines, keywords in capitals and spaces after `end_header`. Text rows may share
a line or span several lines. They may have decimal commas, and NaN or infinity as other languages write them. Ambiguous
text is an error that names the number or row.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from csplat.detect import KINDS, detect_content, is_ply, read_head, refusal
from csplat.errors import InputError, counted
from csplat.file_source import open_binary
from csplat.lint import Finding

#: The element of the splats.
SPLAT_ELEMENT = "vertex"

_END_OF_HEADER = re.compile(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", re.IGNORECASE)
_MAX_SIZE = 1 << 20  # bytes of a header; programs write up to a few kilobytes
_MAX_DECLARED = 4096  # elements and properties; SH of degree 4 takes 87, and each takes memory in every block of rows
_MAX_DIGITS = 18  # digits of a count; longer counts exceed every file, and Python converts no more than 4300
_SHOWN = 80  # maximum number of characters of a word in a message
_MARK = b"\xef\xbb\xbf"  # byte order mark of UTF-8
_WIDE_MARKS = (b"\xff\xfe", b"\xfe\xff")  # byte order marks of UTF-16
_LINE_END = re.compile(rb"\r\n|\r|\n")
#: Bytes as ASCII, in which only space, tab, line ends, form feed and vertical tab separate words.
ASCII = bytes(byte if byte < 128 and byte not in range(0x1C, 0x20) else ord("?") for byte in range(256))
_FREE_TEXT = (b"comment", b"obj_info")  # keywords that are followed by free text


@dataclass
class PlyElement:
    """An element as a header declares it.

    Attributes:
        name: name of the element.
        count: number of rows; 0 if the header specifies no number.
        properties: names of the properties.
        has_lists: True if a property is a list.
    """

    name: str
    count: int
    properties: list[str] = field(default_factory=list)
    has_lists: bool = False


@dataclass(frozen=True)
class PlyHeader:
    """A header that plyfile can parse.

    Attributes:
        start: offset of the header in the file.
        text: the header up to and including the line `end_header`, with the same length as in the file; ASCII.
        is_text: True if the rows are numbers in ASCII.
        elements: the declared elements.
        comments: the comments and lines of `obj_info`, in the order of the file, without their keyword. Bytes that are
            not UTF-8 are question marks.
    """

    start: int
    text: bytes
    is_text: bool
    elements: list[PlyElement]
    comments: list[str]

    @property
    def end(self) -> int:
        """Offset of the rows in the file."""
        return self.start + len(self.text)

    def without_rows(self) -> bytes:
        """Return the header with counts of 0, for a parser that must not read rows."""
        lines = (b"element %s 0" % line.split()[1] if _is_element(line.split()) else line for line in _split(self.text))
        return b"\n".join([*lines, b""])


def read_ply_header(path: Path, findings: list[Finding], kind: str = "ply") -> PlyHeader:
    """Read the header of a PLY.

    Args:
        path: path of the file.
        findings: findings are appended to this list.
        kind: name of the expected kind of PLY, a key of `csplat.detect.KINDS`.

    Raises:
        InputError: the file is not a PLY of this kind, or its header has no end, declares too much, or has a count
            that is not a whole number.
        OSError: the file cannot be read.
    """
    head = read_head(path)
    if head.startswith(_WIDE_MARKS) and is_ply(head[2:].replace(b"\0", b"")):
        raise InputError(f"{path.name} is a PLY in UTF-16, expected ASCII: save it as UTF-8")
    if detect_content(path, head) not in (KINDS["ply"], KINDS[kind]):
        raise refusal(path, head, wanted=kind)
    with open_binary(path) as stream:
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
    text, oddities = _rewrite_header(raw)
    if start:
        oddities.insert(0, "a byte order mark")
    if oddities:
        findings.append(Finding("unusual-header", len(oddities), f"the header has {', '.join(oddities)}", "note"))
    comments, unread = _parse_comments(_split(text))
    if unread:
        note = f"{counted(unread, 'byte')} of the header are not ASCII, nor UTF-8 in a comment"
        lost = (f"{counted(unread, 'byte')} of names or comments of the header",)
        findings.append(Finding("non-ascii-header", unread, f"{note}: read as question marks", "note", lost=lost))
    text = text.translate(ASCII)
    lines = [line.split() for line in _split(text)]
    if sum(words[:1] in ([b"element"], [b"property"]) for words in lines) > _MAX_DECLARED:
        raise InputError(f"{path.name}: the header declares more than {_MAX_DECLARED:,} elements and properties")
    wrong = next(
        (words[2] for words in lines if _is_element(words) and not words[2].removeprefix(b"-").isdigit()), None
    )
    if wrong is not None:
        raise InputError(f"{path.name}: the count {wrong[:_SHOWN].decode()!r} of an element is not a whole number")
    findings += _count_findings(lines, path.stat().st_size)
    findings += _repeated_names(lines)
    is_text = any(words[:2] == [b"format", b"ascii"] for words in lines)
    return PlyHeader(start, text, is_text, _parse_elements(lines), comments)


def _parse_comments(lines: Sequence[bytes]) -> tuple[list[str], int]:
    """Return the comments among the lines of a header, and the number of bytes outside ASCII that are not read."""
    comments, unread = [], 0
    for line in lines:
        keyword, *_ = line.split(maxsplit=1) or (b"",)
        data = line.strip()[len(keyword) + 1 :]
        if keyword in _FREE_TEXT:
            with suppress(UnicodeDecodeError):
                comments.append(data.decode("utf-8"))
                continue
            comments.append(data.translate(ASCII).decode("ascii"))
        unread += sum(byte > 127 for byte in line)
    return comments, unread


def _repeated_names(lines: Sequence[Sequence[bytes]]) -> list[Finding]:
    """Return the finding for elements, or columns of one element, of the same name; empty without any."""
    elements, columns, repeated = Counter[str](), Counter[str](), list[str]()
    for words in lines:
        if _is_element(words):
            elements[words[1].decode("ascii", "replace")] += 1
            columns.clear()
        elif words[:1] == [b"property"]:
            name = words[-1].decode("ascii", "replace")
            columns[name] += 1
            repeated += [f"column {name}"] * (columns[name] == 2)
    repeated += [f"element {name}" for name, count in elements.items() if count > 1]
    what = f"{', '.join(repeated)}: declared twice"
    return [Finding("repeated-names", len(repeated), what, "error")] if repeated else []


def _split(text: bytes) -> list[bytes]:
    """Return the lines of a rewritten header, which end as its first line does."""
    end = _LINE_END.search(text)
    assert end is not None, "the line end_header has an end"
    return text.split(end[0])[:-1]


def _is_element(words: Sequence[bytes]) -> bool:
    """Return True for the words of a complete element line."""
    return words[:1] == [b"element"] and len(words) == 3


def _rewrite_header(raw: bytes) -> tuple[bytes, list[str]]:
    """Rewrite a header for plyfile with the same length, and list its oddities."""
    first_end = _LINE_END.search(raw)
    assert first_end is not None, "the line end_header has an end"
    end = first_end[0]
    lines = raw.split(end)[:-1]
    normalised = [_normalise_line(line) for line in lines]
    if lines[-1] == b"end_header" and all(lines) and lines == normalised and (end == b"\n" or not _has_line_end(lines)):
        return raw, []
    lines = _LINE_END.split(raw)[:-1]
    normalised = [_normalise_line(line) for line in lines]
    changed = [old for old, new in zip(lines, normalised, strict=True) if old.split() != new.split()]
    words = dict.fromkeys(word for line in changed for word in line.split() if word != word.lower())
    blank = sum(not line.strip() for line in lines)
    kinds = {match[0] for match in _LINE_END.finditer(raw)}
    oddities = [f"{blank} blank lines" if blank > 1 else "a blank line"] if blank else []
    oddities += [f"capitals in {' '.join(word.decode('ascii', 'replace') for word in [*words][:3])}"] if words else []
    oddities += ["spaces next to end_header"] if lines[-1].lower() != b"end_header" else []
    oddities += ["line ends of two kinds"] if len(kinds) > 1 else []
    kept = [line for line in normalised if line.strip()]
    text = b"\n".join([*kept, b""])
    kept[1] += b" " * (len(raw) - len(text))  # keeps the offset of the rows
    return b"\n".join([*kept, b""]), oddities


def _has_line_end(lines: list[bytes]) -> bool:
    """Return True if a line contains a line end, of another kind than the one it was split at."""
    return any(_LINE_END.search(line) for line in lines)


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


def _parse_elements(lines: list[list[bytes]]) -> list[PlyElement]:
    """Return the elements of a header, given as the words of each line, with names of properties in order."""
    elements: list[PlyElement] = []
    for words in lines:
        if _is_element(words):
            elements.append(PlyElement(words[1].decode(), _parse_count(words[2])))
        elif words[:1] == [b"property"] and len(words) > 2 and elements:
            elements[-1].properties.append(words[-1].decode())
            elements[-1].has_lists |= words[1] == b"list"
    return elements


def _parse_count(word: bytes) -> int:
    """Return a count; 0 if it is negative, and a number beyond every file if it is longer than `_MAX_DIGITS`."""
    if word.startswith(b"-"):
        return 0
    return int(word) if len(word) <= _MAX_DIGITS else 10**_MAX_DIGITS


def _count_findings(lines: list[list[bytes]], size: int) -> list[Finding]:
    """Report row counts that are negative or exceed the file size of `size` bytes, as errors."""
    findings = []
    for words in filter(_is_element, lines):
        word, count = words[2].decode(), _parse_count(words[2])
        shown = word if len(word) <= _SHOWN else f"{word[:_MAX_DIGITS]}... ({len(word):,} digits)"
        if word.startswith("-"):
            findings.append(Finding("malformed", 1, f"{shown} rows are declared", "error"))
        elif count > size:  # a row has at least one byte; refuse before anything is allocated
            text = f"{shown} rows are declared, the file has {size} bytes"
            findings.append(Finding("truncated", count, text, "error"))
    return findings


_TEXT_LINE_END = re.compile(r"\r\n|\r|\n")
_NAN = re.compile(r"(?<!\S)[+-]?(?:nan\([a-z]*\)|1\.#(?:ind|[qs]nan)0*)(?!\S)", re.IGNORECASE)
_INFINITY = re.compile(r"(?<!\S)([+-]?)1\.#inf0*(?!\S)", re.IGNORECASE)
_EXPONENT = re.compile(r"(?<!\S)([+-]?(?:\d+\.?\d*|\.\d+))d([+-]?\d+)(?!\S)", re.IGNORECASE)
#: Numbers as other languages write them: description for messages, pattern, Python's spelling.
_SPELLINGS = {
    "NaN as Microsoft's C writes it": (_NAN, "nan"),
    "infinity as Microsoft's C writes it": (_INFINITY, r"\1inf"),
    "an exponent as Fortran writes it": (_EXPONENT, r"\1e\2"),
}
_POINT = re.compile(r"\.(?!#)")  # not of Microsoft's 1.#INF
_DECIMAL_COMMA = re.compile(r"(?<=\d),(?=\d)")
_NO_THOUSANDS = re.compile(r"\d,(?!\d{3}(?!\d))\d")  # not followed by three digits exactly


class RowError(ValueError):
    """Bytes that do not form the declared rows, with a finding about the reason."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(finding.text)
        self.finding = finding


class TextRows(NamedTuple):
    """Rows of an element of a text.

    Attributes:
        rows: the words of each row.
        lines: number of the line in the file where each row begins, from 1.
    """

    rows: list[str]
    lines: list[int]


def count_lines(header: bytes) -> int:
    """Return the number of lines of a header."""
    return len(_LINE_END.findall(header))


def parse_text_rows(
    body: bytes, elements: Sequence[PlyElement], wanted: Sequence[str], lines_before: int = 0
) -> tuple[dict[str, TextRows], list[Finding]]:
    """Split text of any layout into rows.

    The encoder in C has the same rules (`check_layout` and `find_layout` of csplat_ply.c).

    Args:
        body: the file after its header.
        elements: the declared elements.
        wanted: names of the elements whose rows are returned.
        lines_before: number of lines of the header.

    Returns:
        The rows of each wanted element, with numbers as Python writes them, and the findings.

    Raises:
        RowError: rows are missing, or a row has another number of values than declared.
    """
    text = body.translate(ASCII).decode("ascii")
    first: RowError | None = None
    for separated, separators in _separations(text):
        oddities, spelled = [], separated
        for name, (pattern, spelling) in _SPELLINGS.items():
            spelled, count = pattern.subn(spelling, spelled)
            oddities += [f"{name} ({counted(count, 'number')})"] if count else []
        try:
            rows, layout, rest = _split_rows(_TEXT_LINE_END.split(spelled), elements, wanted, lines_before)
        except RowError as error:
            first = first or error
            continue
        oddities += [separators, *layout] if separators else layout
        note = f"the rows have {', '.join(oddities)}"
        findings = [Finding("unusual-rows", len(oddities), note, "note")] if oddities else []
        if rest:
            what = f"{counted(rest, 'byte')} after the last row"
            findings.append(Finding("trailing-bytes", rest, f"{what}: ignored", "repair", lost=(what,)))
        return rows, findings
    assert first is not None, "_separations returns at least one reading"
    raise first


def _separations(text: str) -> Iterator[tuple[str, str]]:
    """Yield the text with only spaces between numbers, for each possible meaning of its commas."""
    if "," in text or ";" in text:
        if not _POINT.search(text) and _NO_THOUSANDS.search(text):
            yield _DECIMAL_COMMA.sub(".", text.replace(";", " ")), "decimal commas"
        yield text.replace(",", " ").replace(";", " "), "commas or semicolons between numbers"
    yield text, ""


def _split_rows(
    lines: list[str], elements: Sequence[PlyElement], wanted: Sequence[str], lines_before: int
) -> tuple[dict[str, TextRows], list[str], int]:
    """Return the rows of the wanted elements, the oddities of the lines, and the number of bytes after the last row.

    Rows may share a line or continue on the next line, provided that every line end is a row end or every row end is a
    line end. So a missing value never shifts the values after it. An object per word is made only for a wanted element
    whose rows are not on lines of their own.

    Raises:
        RowError: rows are missing, or have another number of values than declared.
    """
    counts = np.fromiter((len(line.split()) for line in lines), np.int64, len(lines))
    filled = np.flatnonzero(counts)
    oddities = ["blank lines"] if len(filled) and filled[-1] >= len(filled) else []
    lines, counts = [lines[place] for place in filled], counts[filled]
    numbers = filled + lines_before + 1
    rows: dict[str, TextRows] = {}
    at = 0  # line of the next row
    for element in elements:
        width, count = len(element.properties), element.count
        if not width and count:
            raise RowError(Finding("malformed", 1, f"the element {element.name} has no properties", "error"))
        stop = at + count
        if element.has_lists or (counts[at:stop] == width).all():
            if len(lines) < stop:
                raise RowError(truncated_finding(element.name, count, len(lines) - at))
            if element.name in wanted:
                rows[element.name] = TextRows(lines[at:stop], numbers[at:stop].tolist())
            at = stop
            continue
        ends = np.cumsum(counts[at : at + width * count])
        line_count = int(np.searchsorted(ends, width * count)) + 1
        common_ends = np.count_nonzero(ends[:line_count] % width == 0)  # ends of a line and a row
        if line_count > len(ends) or ends[line_count - 1] != width * count or common_ends not in (count, line_count):
            row = int((counts[at:] != width).argmax())
            place = f"line {numbers[at + row]}: row {row} of {element.name}"
            text = f"{place} has {counts[at + row]} values, expected {width}"
            raise RowError(Finding("malformed", 1, text, "error"))
        if element.name in wanted:
            words = [word for line in lines[at : at + line_count] for word in line.split()]
            starts = np.searchsorted(ends, np.arange(count) * width, side="right")
            joined = [" ".join(words[first : first + width]) for first in range(0, len(words), width)]
            rows[element.name] = TextRows(joined, numbers[at + starts].tolist())
        layout = f"{count} of {element.name} in {line_count} lines" if line_count > 1 else "all values in one line"
        oddities.append(layout)
        at += line_count
    surplus = int(counts[at:].sum())  # values after the last row
    if surplus and at != sum(element.count for element in elements):
        text = f"line {numbers[at]}: found {counted(surplus, 'value')} after rows that are not on separate lines"
        raise RowError(Finding("malformed", surplus, text, "error"))
    return rows, oddities, len(" ".join(" ".join(lines[at:]).split()))


def truncated_finding(name: str, declared: int, present: int) -> Finding:
    """Report missing rows of an element."""
    text = f"{declared} rows of {name} are declared, {present} are present: copy or download it again"
    return Finding("truncated", declared - present, text, "error")
