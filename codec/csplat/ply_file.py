"""The rows of a PLY file and the comments of its header, whatever order, type and form they have.

The only module that imports `plyfile`, which is GPL-3.0-or-later: programs that embed the decoder and never touch a PLY
do not load it.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import plyfile

from csplat.errors import InputError, counted
from csplat.lint import Finding
from csplat.ply_columns import Rows
from csplat.ply_header import ELEMENT, Header, read_header
from csplat.ply_text import regular_rows

_FRAME = "delta_vertex_"  # prefix of Brush's elements: differences of later frames from the first
#: Elements of Apple's ml-sharp (gaussians.py): the camera of its image, and data that only its programs read.
_SHARP = {"extrinsic", "intrinsic", "image_size", "frame", "disparity", "color_space", "version"}
_COLOUR_SPACE, _SRGB = "color_space", 0
_BLOCK_SIZE = 1 << 20  # bytes of rows that are converted at a time: they stay in the cache
_EARLY_END = "early end-of-file"  # message of plyfile
_SHOWN = 40  # characters of a word in a message


class Content(NamedTuple):
    """Contents of a PLY of splats.

    Attributes:
        rows: scalar columns of the splats.
        comments: lines of the header.
        elements: names of the other elements, which are all dropped.
    """

    rows: Rows
    comments: list[str]
    elements: list[str]


def parse(path: Path, findings: list[Finding]) -> Content | None:
    """Let plyfile parse a file.

    Args:
        path: path of the file.
        findings: anything noticed is appended.

    Returns:
        Its content; `None` if the findings hold an error.

    Raises:
        InputError: not a PLY of splats, or its header cannot be parsed.
        OSError: it cannot be read.
    """
    header = read_header(path, findings)
    if any(not one.repairable for one in findings):
        return None
    # Numbers of text beyond their type become infinite, which is found later. NumPy warns of that, and of an empty
    # table, which plyfile then refuses.
    quiet = warnings.catch_warnings(action="ignore", category=UserWarning)
    with _open(path, header) as stream, np.errstate(over="ignore"), quiet:
        try:
            try:
                parsed = plyfile.PlyData.read(stream)
                end = None if parsed.text else stream.tell()
                findings += _trailing_findings(path, header, end, sum(element.count for element in parsed))
            except plyfile.PlyElementParseError as error:
                parsed = _read_again(path, header, findings, error)
        except (plyfile.PlyParseError, ValueError, OverflowError, MemoryError) as error:
            raise InputError(f"{path.name}: {error or type(error).__name__}") from None
    if parsed is None:
        return None
    if ELEMENT not in parsed:
        raise InputError(f"{path.name} has no element {ELEMENT!r}: not a PLY of splats")
    others = [element for element in parsed if element.name != ELEMENT]
    findings += _other_findings(others)
    rows, lists = _scalars(parsed[ELEMENT].data)
    if lists:
        text = f"list properties {', '.join(lists)}: dropped"
        findings.append(Finding("list-columns", len(lists), text, "repair"))
    comments = [*parsed.comments, *parsed.obj_info]
    for element in parsed:
        comments += element.comments
    return Content(rows, comments, [element.name for element in others])


def _read_again(path: Path, header: Header, findings: list[Finding], error: Any) -> Any:
    """Read a file that plyfile could not read as it is; `None`: it is refused, and the findings give the reason.

    Args:
        path: path of the file.
        header: its header.
        findings: anything noticed is appended.
        error: the error that plyfile raised.
    """
    if not header.is_text or error.message == _EARLY_END:
        present, declared = error.row or 0, error.element.count
        text = f"{declared} rows of {error.element.name} are declared, {present} are there: copy or download it again"
        findings.append(Finding("truncated", declared - present, text, "error"))
        return None
    with path.open("rb") as stream:
        stream.seek(header.end)
        rows, more = regular_rows(stream.read(), header.elements)
    findings += more
    if rows is None:
        return None
    text = "\n".join([*header.text.decode("ascii").splitlines(), *map(" ".join, rows), ""])
    try:
        return plyfile.PlyData.read(io.StringIO(text))
    except plyfile.PlyElementParseError as second:
        findings.append(_row_finding(second, rows, header))
        return None


def _row_finding(error: Any, rows: list[list[str]], header: Header) -> Finding:
    """Report which value of a row of text is wrong."""
    name, row, said = error.element.name, error.row or 0, error.message
    at = [element.name for element in header.elements].index(name)
    element, before = header.elements[at], sum(one.count for one in header.elements[:at])
    if error.prop is not None and not element.has_lists:
        word = rows[before + row][element.properties.index(error.prop.name)]
        kind = np.dtype(error.prop.val_dtype)
        wanted = "a number" if kind.kind == "f" else f"an integer of type {kind.name}"
        said = f"{error.prop.name} is {word[:_SHOWN]!r}, expected {wanted}"
    return Finding("malformed", 1, f"row {row} of {name}: {said}", "error")


def _other_findings(others: list[Any]) -> list[Finding]:
    """Report what becomes of elements that are no splats."""
    if not others:
        return []
    names = [element.name for element in others]
    text = f"elements besides {ELEMENT}: {', '.join(names)}: dropped"
    if not set(names) <= _SHARP:
        if any(name.startswith(_FRAME) for name in names):
            text += "; they move the splats, of which the first moment is kept"
        return [Finding("other-elements", len(others), text, "repair")]
    findings = [Finding("sharp-elements", len(others), f"{text}; they are the camera of ml-sharp", "note")]
    for element in others:
        values = element.data[_COLOUR_SPACE] if element.name == _COLOUR_SPACE == element.properties[0].name else ()
        said = [value for value in values if value != _SRGB]
        if said:
            text = f"{_COLOUR_SPACE} is {said[0]} (linear RGB), expected {_SRGB} (sRGB): export the scene in sRGB"
            findings.append(Finding("colour-space", 1, text, "error"))
    return findings


def _trailing_findings(path: Path, header: Header, end: int | None, row_count: int) -> list[Finding]:
    """Count the bytes after the last row; an ASCII file (`end` is `None`) has a line per row."""
    if end is not None:
        count = path.stat().st_size - end
        if count and _is_changed_as_text(path, header, count):
            text = (
                f"{counted(count, 'byte')} after the last row, and a carriage return before each line feed of the rows:"
                " changed by a text-mode transfer (git autocrlf, FTP): copy it again as binary"
            )
            return [Finding("malformed", count, text, "error")]
    else:
        with path.open("rb") as stream:
            stream.seek(header.end)
            lines = stream.read().splitlines(keepends=True)
        count = len(b"".join(lines[row_count:]).strip())
    if count == 0:
        return []
    text = f"{counted(count, 'byte')} after the last row: ignored"
    return [Finding("trailing-bytes", count, text, "repair")]


def _is_changed_as_text(path: Path, header: Header, surplus: int) -> bool:
    """Tell whether a carriage return was inserted before the line feeds of binary rows.

    Args:
        path: path of the file.
        header: its header.
        surplus: bytes after the last row.
    """
    if not header.text.endswith(b"\r\n"):
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
        path: path of the file.
        rows: as `parse` gives them.
        most: rows of a block; `None`: the number that stays in the cache.
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


def _open(path: Path, header: Header) -> IO[Any]:
    """Open a PLY for plyfile, behind a byte order mark: as text if it is text, with the header that it takes."""
    stream = _PlyReader(path, header)
    return io.TextIOWrapper(stream, encoding="ascii", errors="replace") if header.is_text else stream


class _PlyReader(io.BufferedReader):
    """A file with another header."""

    def __init__(self, path: Path, header: Header) -> None:
        super().__init__(io.FileIO(path))
        self.seek(header.start)
        self._header, self._at = header.text, 0

    def read(self, size: int | None = -1, /) -> bytes:
        return self._with_header(super().read(size))

    def read1(self, size: int = -1, /) -> bytes:
        return self._with_header(super().read1(size))

    def _with_header(self, data: bytes) -> bytes:
        if self._at >= len(self._header):
            return data
        begin = self._header[self._at : self._at + len(data)]  # a byte at a time: the rest is not to be copied
        self._at += len(begin)
        return begin + data[len(begin) :]
