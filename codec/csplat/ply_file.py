"""The rows of a PLY file and the comments of its header, whatever order, type and form they have.

The only module that imports `plyfile`, which is GPL-3.0-or-later: programs that embed the decoder and never touch a PLY
do not load it.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import plyfile

from csplat.errors import InputError, counted
from csplat.foreign import HEAD_SIZE, refuse_folder, refuse_foreign, refuse_packed_header
from csplat.lint import Finding
from csplat.ply_columns import Rows

__all__ = ["Content", "blocks_of", "parse"]

_ELEMENT = "vertex"
_FRAME = "delta_vertex_"  # of Brush: what later moments add to the first
_END_OF_HEADER = re.compile(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)")
_MAX_HEADER_SIZE = 1 << 20
_BLOCK_SIZE = 1 << 20  # bytes of rows that are converted at a time: they stay in the cache


class Content(NamedTuple):
    """What a PLY of splats holds.

    Attributes:
        rows: scalar columns of the splats.
        comments: lines of the header.
        elements: names of the other elements, of which nothing is kept.
    """

    rows: Rows
    comments: list[str]
    elements: list[str]


def parse(path: Path, findings: list[Finding]) -> Content | None:
    """Let plyfile parse a file.

    Args:
        path: of the file.
        findings: what is noticed is appended.

    Returns:
        Its content; `None` where the findings hold an error.

    Raises:
        InputError: not a PLY of splats, or its header cannot be parsed.
        OSError: it cannot be read.
    """
    header = _header(path)
    refuse_packed_header(path, header)
    findings += _header_findings(header, path.stat().st_size)
    if any(not one.repairable for one in findings):
        return None
    with _open(path, header) as stream:
        try:
            # Numbers of text beyond their type become infinite, which is found later. NumPy warns of that, and of an
            # empty table, which plyfile then refuses.
            with np.errstate(over="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                parsed = plyfile.PlyData.read(stream)
        except plyfile.PlyElementParseError as error:
            findings.append(_row_finding(error, _has_comma(path, len(header), error.row or 0)))
            return None
        except (plyfile.PlyParseError, ValueError, OverflowError, MemoryError) as error:
            raise InputError(f"{path.name}: {error or type(error).__name__}") from None
        end = None if parsed.text else stream.tell()
    row_count = sum(element.count for element in parsed)
    findings += _trailing_findings(path, len(header), end, row_count)
    if _ELEMENT not in parsed:
        raise InputError(f"{path.name} has no element {_ELEMENT!r}: not a PLY of splats")
    others = [element.name for element in parsed if element.name != _ELEMENT]
    if others:
        text = f"elements besides {_ELEMENT}: {', '.join(others)}: dropped"
        if any(name.startswith(_FRAME) for name in others):
            text += "; they move the splats, of which the first moment is kept"
        findings.append(Finding("other-elements", len(others), text, "repair"))
    rows, lists = _scalars(parsed[_ELEMENT].data)
    if lists:
        text = f"list properties {', '.join(lists)}: dropped"
        findings.append(Finding("list-columns", len(lists), text, "repair"))
    comments = [*parsed.comments, *parsed.obj_info]
    for element in parsed:
        comments += element.comments
    return Content(rows, comments, others)


def _header(path: Path) -> bytes:
    """The bytes of a PLY header, up to and including the line `end_header`."""
    if path.is_dir():
        refuse_folder(path)
    with path.open("rb") as stream:
        refuse_foreign(path, stream.read(HEAD_SIZE), path.stat().st_size)
        stream.seek(0)
        start = stream.read(_MAX_HEADER_SIZE)
    end = _END_OF_HEADER.search(start)
    if end is None:
        raise InputError(f"{path.name}: the PLY header has no line end_header")
    return start[: end.end()]


def _header_findings(header: bytes, size: int) -> list[Finding]:
    findings = []
    if not header.isascii():
        count = sum(byte > 127 for byte in header)
        text = f"{counted(count, 'byte')} of the header outside ASCII: read as question marks"
        findings.append(Finding("non-ascii-header", count, text, "note"))
    for line in header.splitlines():
        words = line.split()
        if words[:1] != [b"element"] or len(words) != 3:
            continue
        if words[2].startswith(b"-"):
            text = f"{words[2].decode('ascii', 'replace')} rows are declared"
            findings.append(Finding("malformed", 1, text, "error"))
        elif words[2].isdigit():
            count = int(words[2])
            if count > size:  # a row takes a byte at least: do not let anyone allocate for it
                text = f"{count} rows are declared, the file has {size} bytes"
                findings.append(Finding("truncated", count, text, "error"))
    return findings


def _has_comma(path: Path, header_size: int, row: int) -> bool:
    """Return whether a row of an ASCII file has a comma, as numbers of some countries do."""
    with path.open("rb") as stream:
        stream.seek(header_size)
        line = next(islice(stream, row, None), b"")
    return b"," in line and line.isascii()


def _row_finding(error: Any, comma: bool) -> Finding:
    present, declared = error.row or 0, error.element.count
    if error.message == "early end-of-file":
        text = f"{declared} rows of {error.element.name} are declared, {present} are there: copy or download it again"
        return Finding("truncated", declared - present, text, "error")
    remedy = "; it has a comma, expected a point in numbers and spaces between them" if comma else ""
    return Finding("malformed", 1, f"row {present} of {error.element.name}: {error.message}{remedy}", "error")


def _trailing_findings(path: Path, header_size: int, end: int | None, row_count: int) -> list[Finding]:
    """Count the bytes after the last row; an ASCII file (`end` is `None`) has a line per row."""
    if end is not None:
        count = path.stat().st_size - end
    else:
        with path.open("rb") as stream:
            stream.seek(header_size)
            lines = stream.read().splitlines(keepends=True)
        count = len(b"".join(lines[row_count:]).strip())
    if count == 0:
        return []
    text = f"{counted(count, 'byte')} after the last row: ignored"
    return [Finding("trailing-bytes", count, text, "repair")]


def _scalars(data: Rows) -> tuple[Rows, list[str]]:
    """Take list properties out of rows. Returns contiguous rows and the names taken out."""
    names = data.dtype.names or ()
    lists = [name for name in names if data.dtype[name].hasobject]
    if not lists:
        return data, []
    kept = [(name, data.dtype[name]) for name in names if name not in lists]
    rows = np.empty(len(data), kept)
    for name, _ in kept:
        rows[name] = data[name]
    return rows, lists


def blocks_of(path: Path, rows: Rows, most: int | None = None) -> Iterator[Rows]:
    """Rows in blocks. Those of a memory map are read instead: aligned, and not resident twice.

    Args:
        path: of the file.
        rows: as `parse` gives them.
        most: rows of a block; `None`: as many as stay in the cache.
    """
    step = most or max(1, _BLOCK_SIZE // max(1, rows.dtype.itemsize))
    if not isinstance(rows, np.memmap):
        yield from (rows[start : start + step] for start in range(0, len(rows), step))
        return
    with path.open("rb") as stream:
        stream.seek(rows.offset)
        for start in range(0, len(rows), step):
            want = min(step, len(rows) - start)
            block = np.fromfile(stream, rows.dtype, want)
            if len(block) != want:
                raise InputError(f"{path.name} became shorter while it was read")
            yield block


def _open(path: Path, header: bytes) -> IO[Any]:
    """Open a PLY for plyfile: as text where it is text, and ASCII where plyfile insists on it."""
    if any(line.split()[:2] == [b"format", b"ascii"] for line in header.splitlines()):
        return io.TextIOWrapper(_AsciiReader(path, path.stat().st_size), encoding="ascii")
    return _AsciiReader(path, len(header))


class _AsciiReader(io.BufferedReader):
    """A file whose first bytes read as ASCII, whatever they are: plyfile stops at others."""

    def __init__(self, path: Path, ascii_size: int) -> None:
        super().__init__(io.FileIO(path))
        self._ascii_left = ascii_size

    def read(self, size: int | None = -1, /) -> bytes:
        return self._as_ascii(super().read(size))

    def read1(self, size: int = -1, /) -> bytes:
        return self._as_ascii(super().read1(size))

    def _as_ascii(self, data: bytes) -> bytes:
        if self._ascii_left <= 0 or data.isascii():
            self._ascii_left -= len(data)
            return data
        self._ascii_left -= len(data)
        return bytes(byte if byte < 128 else ord("?") for byte in data)
