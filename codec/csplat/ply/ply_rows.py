"""Read the rows of PLY files: binary, or text of any layout.

Text rows may share a line or span several lines, and may have decimal commas and NaN or infinity as other languages
write them. Ambiguous text is an error that names the number or row. Lists are skipped. No object is made per row, so
the memory is proportional to the file.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from csplat.errors import counted
from csplat.file_source import map_file
from csplat.lint import Finding
from csplat.ply.columns import Rows
from csplat.ply.ply_header import PlyElement, PlyHeader
from csplat.types import I64

_BLOCK_SIZE = 1 << 20  # bytes that are converted at a time
_SHOWN = 40  # maximum number of characters of a word in a message


class RowError(ValueError):
    """Rows that the file does not contain, with a finding about the reason."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(finding.text)
        self.finding = finding


def read_rows(path: Path, header: PlyHeader, names: Sequence[str], findings: list[Finding]) -> dict[str, Rows]:
    """Read the single values of elements; all other rows are skipped.

    Args:
        path: path of the file.
        header: its header.
        names: names of the elements to read.
        findings: findings about the layout of text, and bytes after the last row, are appended to this list.

    Returns:
        Rows by element, in the order of the file. Those of binary elements without lists are mapped.

    Raises:
        RowError: rows are missing or invalid.
        OSError: the file cannot be read.
    """
    if header.is_text:
        return _read_text(path, header, names, findings)
    found: dict[str, Rows] = {}
    at, size = header.end, path.stat().st_size
    for element in header.elements:
        dtype, is_wanted = element.dtype(header.order), element.name in names
        if element.has_lists:
            at, rows = _read_lists(memoryview(map_file(path)), at, element, header.order, gathers=is_wanted)
        else:
            present = (size - at) // max(1, dtype.itemsize)
            if dtype.itemsize and present < element.count:
                raise RowError(truncated_finding(element.name, element.count, present))
            empty = not (is_wanted and element.count and dtype.itemsize)
            rows = np.empty(0, dtype) if empty else np.memmap(path, dtype, "c", at, element.count)
            at += element.count * dtype.itemsize
        if is_wanted:
            found[element.name] = rows
    if at < size:
        findings.append(_trailing_finding(path, header, size - at))
    return found


def truncated_finding(name: str, declared: int, present: int) -> Finding:
    """Report missing rows of an element."""
    text = f"{declared} rows of {name} are declared, {present} are present: copy or download it again"
    return Finding("truncated", declared - present, text, "error")


def _malformed(text: str) -> RowError:
    return RowError(Finding("malformed", 1, text, "error"))


def _read_lists(data: memoryview, at: int, element: PlyElement, order: str, *, gathers: bool) -> tuple[int, Rows]:
    """Read rows with lists one after the other, because the length of a row is in its lists.

    Args:
        data: the file.
        at: offset of the first row.
        element: the element.
        order: byte order.
        gathers: return the single values, else no rows.

    Returns:
        Offset of the end of the last row, and the rows without their lists.
    """
    gaps, lists, after = [], [], 0  # gaps: bytes of single values before each list
    for one in element.properties:
        if one.length_kind is None:
            after += np.dtype(one.kind).itemsize
        else:
            gaps.append(after)
            lists.append((after, np.dtype(one.length_kind), np.dtype(one.kind).itemsize, one.name))
            after = 0
    steps = [(gap, gap + kind.itemsize, width, kind.kind == "i", gathers and gap > 0) for gap, kind, width, _ in lists]
    byteorder: Literal["little", "big"] = "big" if order == ">" else "little"
    starts = array("q")  # offsets of the runs of single values that are gathered
    end = len(data)
    for row in range(element.count):
        for index, (gap, skipped, width, is_signed, is_run) in enumerate(steps):
            if is_run:
                starts.append(at)
            if at + skipped > end:
                raise RowError(truncated_finding(element.name, element.count, row))
            length = (
                data[at + gap]
                if skipped == gap + 1 and not is_signed
                else int.from_bytes(data[at + gap : at + skipped], byteorder, signed=is_signed)
            )
            if length < 0:
                name = lists[index][3][:_SHOWN]
                raise _malformed(f"row {row} of {element.name}: the list {name} has a length of {length}")
            at += skipped + length * width
        if after and gathers:
            starts.append(at)
        at += after
        if at > end:
            raise RowError(truncated_finding(element.name, element.count, row))
    rows = np.empty(element.count if gathers else 0, element.dtype(order))
    runs = [gap for gap in (*gaps, after) if gap]
    if gathers and runs:
        values = rows.view(np.uint8).reshape(len(rows), -1)
        firsts = np.frombuffer(starts, np.int64).reshape(len(rows), len(runs))
        source, column = np.frombuffer(data, np.uint8), 0
        for run, size in enumerate(runs):
            step = max(1, _BLOCK_SIZE // size)
            for start in range(0, len(rows), step):
                spots = firsts[start : start + step, run, None] + np.arange(size)
                values[start : start + step, column : column + size] = source[spots]
            column += size
    return at, rows


def _trailing_finding(path: Path, header: PlyHeader, count: int) -> Finding:
    """Report bytes after the last binary row."""
    if _is_changed_as_text(path, header, count):
        text = (
            f"{counted(count, 'byte')} after the last row, and a carriage return before each line feed of the rows:"
            " corrupted by a text-mode transfer (git autocrlf, FTP): copy it again as binary"
        )
        return Finding("malformed", count, text, "error")
    return Finding("trailing-bytes", count, f"{counted(count, 'byte')} after the last row: ignored", "repair")


def _is_changed_as_text(path: Path, header: PlyHeader, surplus: int) -> bool:
    """Return True if a carriage return was inserted before each line feed of binary rows.

    Args:
        path: path of the file.
        header: its header.
        surplus: number of bytes after the last row.
    """
    if header.line_end != b"\r\n":
        return False
    feeds, last = 0, b"\n"
    with path.open("rb") as stream:
        stream.seek(header.end)
        while block := stream.read(_BLOCK_SIZE):
            found = block.count(b"\n")
            feeds += found
            if found != (last[-1:] + block).count(b"\r\n"):
                return False
            last = block
    return surplus <= feeds


_NAN = re.compile(rb"(?<!\S)[+-]?(?:nan\([a-z]*\)|1\.#(?:ind|[qs]nan)0*)(?!\S)", re.IGNORECASE)
_INFINITY = re.compile(rb"(?<!\S)([+-]?)1\.#inf0*(?!\S)", re.IGNORECASE)
_EXPONENT = re.compile(rb"(?<!\S)([+-]?(?:\d+\.?\d*|\.\d+))d([+-]?\d+)(?!\S)", re.IGNORECASE)
#: Numbers as other languages write them: description for messages, characters that they contain, pattern,
#: Python's spelling.
_SPELLINGS = {
    "NaN as Microsoft's C writes it": ((b"#", b"("), _NAN, b"nan"),
    "infinity as Microsoft's C writes it": ((b"#",), _INFINITY, rb"\1inf"),
    "an exponent as Fortran writes it": ((b"d", b"D"), _EXPONENT, rb"\1e\2"),
}
_NO_THOUSANDS = re.compile(rb"\d,(?!\d{3}(?!\d))\d")  # not followed by three digits exactly
_SPACE = re.compile(rb"\s")
_SPACES = np.isin(np.arange(256), list(b" \t\n\v\f\r"))


class _Lines(NamedTuple):
    """The lines of a text that have words.

    Attributes:
        ends: offset of the end of each line.
        counts: number of its words.
    """

    ends: I64
    counts: NDArray[np.int32]


class _Part(NamedTuple):
    """The lines of an element: its first one, and the one after its last."""

    element: PlyElement
    first: int
    stop: int


def _read_text(path: Path, header: PlyHeader, names: Sequence[str], findings: list[Finding]) -> dict[str, Rows]:
    with path.open("rb") as stream:
        stream.seek(header.end)
        body = stream.read()
    if b"\r" in body:
        body = body.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    oddities = []
    for name, (hints, pattern, spelling) in _SPELLINGS.items():
        if any(hint in body for hint in hints):
            body, count = _substitute(pattern, spelling, body)
            oddities += [f"{name} ({counted(count, 'number')})"] if count else []
    first: RowError | None = None
    for separated, separators in _separations(body):
        lines = _index_lines(separated)
        try:
            parts, layout, rest = _split_rows(separated, lines, header.elements)
        except RowError as error:
            first = first or error
            continue
        oddities += [separators] * bool(separators) + layout
        if oddities:
            note = f"the rows have {', '.join(oddities)}"
            findings.append(Finding("unusual-rows", len(oddities), note, "note"))
        if rest:
            text = f"{counted(rest, 'byte')} after the last row: ignored"
            findings.append(Finding("trailing-bytes", rest, text, "repair"))
        return {one.element.name: _convert(separated, lines, one) for one in parts if one.element.name in names}
    assert first is not None, "_separations returns at least one reading"
    raise first


def _substitute(pattern: re.Pattern[bytes], spelling: bytes, text: bytes) -> tuple[bytes, int]:
    """Replace words as `re.subn` does, which makes an object per match, block by block."""
    blocks, total, start = [], 0, 0
    while start < len(text):
        end = _SPACE.search(text, start + _BLOCK_SIZE)
        stop = end.end() if end else len(text)
        block, count = pattern.subn(spelling, text[start:stop])
        blocks.append(block)
        total += count
        start = stop
    return b"".join(blocks), total


def _separations(text: bytes) -> Iterator[tuple[bytes, str]]:
    """Yield the text with only spaces between numbers, for each possible meaning of its commas."""
    if b"," not in text and b";" not in text:
        yield text, ""
        return
    if b"." not in text and _NO_THOUSANDS.search(text):
        yield _with_points(text.replace(b";", b" ")), "decimal commas"
    yield text.translate(bytes.maketrans(b",;", b"  ")), "commas or semicolons between numbers"
    yield text, ""


def _with_points(text: bytes) -> bytes:
    """Replace the commas between two digits by points."""
    characters = np.frombuffer(text, np.uint8).copy()
    is_digit = (ord("0") <= characters) & (characters <= ord("9"))
    commas = characters == ord(",")
    commas[1:] &= is_digit[:-1]
    commas[:-1] &= is_digit[1:]
    characters[commas] = ord(".")
    return characters.tobytes()


def _index_lines(body: bytes) -> _Lines:
    """Find the lines that have words."""
    data = np.frombuffer(body, np.uint8)
    ends, counts, start = [np.zeros(0, np.int64)], [np.zeros(0, np.int32)], 0
    while start < len(body):
        stop = body.find(b"\n", start + _BLOCK_SIZE) + 1 or len(body)
        block = data[start:stop]
        is_space = _SPACES[block]
        begins = ~is_space
        begins[1:] &= is_space[:-1]
        line_ends = np.flatnonzero(block == ord("\n"))
        if not len(line_ends) or line_ends[-1] != len(block) - 1:
            line_ends = np.append(line_ends, len(block))
        words = np.diff(np.searchsorted(np.flatnonzero(begins), line_ends), prepend=0)
        ends.append(line_ends[words > 0] + start)
        counts.append(words[words > 0].astype(np.int32))
        start = stop
    return _Lines(np.concatenate(ends), np.concatenate(counts))


def _split_rows(body: bytes, lines: _Lines, elements: Sequence[PlyElement]) -> tuple[list[_Part], list[str], int]:
    """Return the lines of each element, the oddities of the layout, and the number of bytes after the last row.

    Rows may share a line or continue on the next one, provided that every line end is a row end or every row end is a
    line end. So a missing value never shifts the values after it.
    """
    oddities: list[str] = []
    parts: list[_Part] = []
    at = 0
    for element in elements:
        width, count = len(element.properties), element.count
        if count and not width:
            raise _malformed(f"the element {element.name} has no properties")
        stop = at + count
        if not element.has_lists and (lines.counts[at:stop] != width).any():
            ends = np.cumsum(lines.counts[at : at + width * count], dtype=np.int64)
            last = int(np.searchsorted(ends, width * count))
            whole = np.count_nonzero(ends[: last + 1] % width == 0)
            if last == len(ends) or ends[last] != width * count or whole not in (count, last + 1):
                row = int((lines.counts[at:] != width).argmax())
                text = f"row {row} of {element.name} has {lines.counts[at + row]} values, expected {width}"
                raise _malformed(text)
            stop = at + last + 1
            oddities.append(f"{count} of {element.name} in {last + 1} lines" if last else "all values in one line")
        elif stop > len(lines.ends):
            raise RowError(truncated_finding(element.name, count, len(lines.ends) - at))
        parts.append(_Part(element, at, stop))
        at = stop
    end = int(lines.ends[at - 1]) if at else 0
    if body.count(b"\n", 0, end) >= max(1, at):
        oddities.insert(0, "blank lines")
    rest = int(lines.counts[at:].sum())
    if rest and at != sum(element.count for element in elements):
        text = f"found {counted(rest, 'value')} after rows that are not on separate lines"
        raise RowError(Finding("malformed", rest, text, "error"))
    return parts, oddities, len(body[end:].strip())


def _convert(body: bytes, lines: _Lines, part: _Part) -> Rows:
    """Return the single values of an element."""
    element, dtype = part.element, part.element.dtype("=")
    rows, width = np.empty(element.count, dtype), len(dtype.names or ())
    done, left = 0, list[bytes]()
    for first, stop in _blocks(lines, part):
        begin = int(lines.ends[first - 1]) if first else 0
        text = body[begin : int(lines.ends[stop - 1])]
        if element.has_lists:
            words = [
                word for line, row in enumerate(_word_lines(text)) for word in _without_lists(element, done + line, row)
            ]
            count = stop - first
        else:
            words = left + text.split()
            count = len(words) // width
            left = words[count * width :]
        _fill_rows(rows[done : done + count], words, element.name, done)
        done += count
    return rows


def _blocks(lines: _Lines, part: _Part) -> Iterator[tuple[int, int]]:
    """Yield the first and the last line but one of blocks of about `_BLOCK_SIZE` bytes."""
    first = part.first
    while first < part.stop:
        size = int(np.searchsorted(lines.ends, lines.ends[first] + _BLOCK_SIZE))
        stop = min(part.stop, max(first + 1, size))
        yield first, stop
        first = stop


def _word_lines(text: bytes) -> Iterator[list[bytes]]:
    """Yield the words of each line that has some."""
    return filter(None, (line.split() for line in text.split(b"\n")))


def _without_lists(element: PlyElement, row: int, words: list[bytes]) -> Iterator[bytes]:
    """Yield the single values of a row of text with lists."""
    at = 0
    for one in element.properties:
        word = words[at] if at < len(words) else b""
        at += 1
        if one.length_kind is None:
            yield word
        elif word.isdigit() and len(word) < len(str(1 << 63)):
            at += int(word)
        else:
            raise _malformed(f"row {row} of {element.name}: the length of {one.name[:_SHOWN]} is {_shorten(word)}")
    if at != len(words):
        raise _malformed(f"row {row} of {element.name} has {len(words)} values, expected {at}")


def _fill_rows(rows: Rows, words: list[bytes], name: str, first: int) -> None:
    """Convert the words of rows.

    Args:
        rows: the rows, which are changed.
        words: the words of one row after the other.
        name: name of the element, for messages.
        first: index of the first row, for messages.
    """
    columns = rows.dtype.names or ()
    width = len(columns)
    try:
        for index, column in enumerate(columns):
            with np.errstate(over="ignore"):  # numbers beyond their type become infinite and are dropped later
                rows[column] = _parse_words(words[index : len(rows) * width : width], rows.dtype[column])
    except (ValueError, OverflowError):
        for at, word in enumerate(words):
            kind = rows.dtype[columns[at % width]]
            try:
                _parse_words([word], kind)
            except (ValueError, OverflowError):
                expected = "a number" if kind.kind == "f" else f"an integer of type {kind.name}"
                place = f"row {first + at // width} of {name}: {columns[at % width]}"
                raise _malformed(f"{place} is {_shorten(word)}, expected {expected}") from None
        raise


def _parse_words(words: list[bytes], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return numbers; raise `ValueError` or `OverflowError` if a word is none of this type."""
    if kind.kind == "f":
        return np.fromiter(map(float, words), np.float64, len(words))
    values = np.fromiter(map(int, words), np.int64, len(words))
    limits = np.iinfo(kind)
    if len(values) and not limits.min <= values.min() <= values.max() <= limits.max:
        raise OverflowError
    return values


def _shorten(word: bytes) -> str:
    return repr(word[:_SHOWN].decode("ascii", "replace"))
