# SPDX-License-Identifier: Apache-2.0
"""Read PLY files of 3D Gaussian splats.

This is the only module that imports plyfile, which is GPL-3.0-or-later, so programs that embed the decoder and never
read a PLY do not load it.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count as count_from
from itertools import islice
from pathlib import Path
from tempfile import TemporaryFile
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import plyfile

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.disk_files import local_file
from csplat.errors import InputError, counted
from csplat.file_source import File, map_file, open_binary
from csplat.lint import Finding, refuse
from csplat.model import SplatModel, check_sh_degree
from csplat.ply.column_names import ColumnMap, find_columns
from csplat.ply.columns import (
    AttributeArrays,
    Rows,
    RowStatistics,
    gather_arrays,
    list_findings,
    with_colour_range,
    with_half_floats,
)
from csplat.ply.comments import CommentMetadata, parse_comments, split_origin
from csplat.ply.ply_header import (
    SPLAT_ELEMENT,
    PlyHeader,
    RowError,
    count_lines,
    parse_text_rows,
    read_ply_header,
    truncated_finding,
)
from csplat.ply.ply_rows import is_list, lines_without_lists, row_type, skip_lists
from csplat.scene import BLOCK_SPLATS, Scene
from csplat.types import F32, F64

_EMPTY = Finding("empty", 0, "the file contains no splats", "note")
_FRAME = "delta_vertex_"  # prefix of Brush's elements with the differences of later frames from the first
#: Elements of Apple's ml-sharp (gaussians.py): the camera of its image, and data for its own programs.
_SHARP = {"extrinsic", "intrinsic", "image_size", "frame", "disparity", "color_space", "version"}
_COLOUR_SPACE, _SRGB = "color_space", 0
_BLOCK_SIZE = 1 << 20  # bytes of rows that are converted at a time; they fit in the cache
_PACKED_COLOURS = ("colors", "color", "rgb")
_FORMATS = {"=": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}  # by plyfile's byte order
_SHOWN = 40  # maximum number of characters of a word in a message
_SHOWN_NAMES = 200  # characters of names in a message, which may be a MiB long
_SEPARATORS = dict.fromkeys(range(0x1C, 0x20), "?")  # of words for Python alone
_DAMAGED = (plyfile.PlyParseError, ValueError, OverflowError, MemoryError)  # what plyfile and NumPy raise


def read_ply(
    file: File,
    *,
    strict: bool = False,
    keep_extra: bool = False,
    sh_degree: int | None = None,
    report: list[Finding] | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> SplatModel:
    """Read a PLY of splats: binary of either byte order or ASCII, SH degree 0 to 4.

    Columns that other programs name differently are recognised and reported (`csplat.lint`): CloudCompare's names,
    red, green and blue in place of f_dc, and the filter of Mip-Splatting, which is fused into scales and opacities.

    The sigmoid of opacities is computed in float64 and rounded once; above a logit of 16, float32 alpha is too close to
    1 to distinguish neighbouring values. Rotations are normalised. Positions in doubles get an `origin`, either from a
    comment of the file or chosen so that float32 loses nothing visible. Header comments are kept in
    `metadata["comments"]`.

    Args:
        file: path of the file; or an open binary file or bytes, which are copied to a temporary file.
        strict: refuse files that need repairs (`csplat.lint` lists them).
        keep_extra: keep columns that are not splat attributes in `SplatModel.extra`.
        sh_degree: drop the SH bands above this degree; the file's own degree may exceed 4. `None`: keep all.
        report: findings, including repairs, are appended to this list.
        context: threads.

    Examples:
        >>> import csplat
        >>> model = csplat.read("scene.ply")
        >>> model
        SplatModel(1000 splats, sh_degree=3)
        >>> model.scales.shape, model.scales.dtype  # natural logarithms
        ((1000, 3), dtype('float32'))

    Raises:
        InputError: the file is not a PLY of splats (for other splat formats, the message names a converter), cannot
            be repaired, or needs repairs and `strict` is set.
        OSError: the file cannot be read.
    """
    findings: list[Finding] = []
    try:
        with local_file(file) as path:
            model = _load(path, findings, context, keep_extra=keep_extra, strict=strict, sh_degree=sh_degree)
    finally:
        if report is not None:
            report.extend(findings)
    refuse(findings, strict=strict)
    assert model is not None, "only an error leaves no model"
    return model


def lint_ply(file: File, *, sh_degree: int | None = None) -> list[Finding]:
    """List the defects of a PLY of splats without refusing it.

    Args:
        file: as in `read_ply`.
        sh_degree: as in `read_ply`.

    Returns:
        Findings in the order of reading; the last finding is an error if `read_ply` would refuse the file.

    Raises:
        InputError: the file is not a PLY, or its header cannot be parsed.
        OSError: the file cannot be read.
    """
    findings: list[Finding] = []
    with local_file(file) as path:
        ply = _open(path, findings, keep_extra=False, strict=False, sh_degree=sh_degree)
        if ply is not None:
            survey = _survey(ply, findings)
            if len(ply.rows) == 0:
                findings.append(_EMPTY)
            _empty_model(ply, survey)  # raises errors that no finding reports
            for _ in _model_blocks(ply, survey, keep_extra=False):
                pass
    return findings


@contextmanager
def open_ply(path: Path, sh_degree: int | None = None) -> Iterator[Scene]:
    """Open a PLY to read it block by block (`csplat.open`); otherwise as `read_ply`.

    A first pass determines values that depend on all splats: the number of splats that are kept, the origin of doubles,
    and the thickness of discs.
    """
    findings: list[Finding] = []
    ply = _open(path, findings, keep_extra=True, strict=False, sh_degree=sh_degree)
    refuse(findings, strict=False)
    assert ply is not None, "only an error leaves no rows"
    survey = _survey(ply, findings)
    refuse(findings, strict=False)
    blocks = partial(_model_blocks, ply, survey, keep_extra=True)
    yield Scene.like(_empty_model(ply, survey), survey.kept_count, blocks, findings)


class PlyContent(NamedTuple):
    """The contents of a PLY of splats.

    Attributes:
        rows: scalar columns of the splats.
        comments: comment lines of the header.
        elements: names of the other elements, which are dropped.
    """

    rows: Rows
    comments: list[str]
    elements: list[str]


def parse_ply(path: Path, findings: list[Finding], *, only_splats: bool = False) -> PlyContent | None:
    """Parse a file with plyfile.

    plyfile first parses the header without counts, and then the needed elements separately. Lists are left out because
    plyfile makes an object for each list.

    Args:
        path: path of the file.
        findings: findings are appended to this list.
        only_splats: refuse a file that lacks columns of splats before its rows are read.

    Returns:
        The content; `None` if the findings contain an error.

    Raises:
        InputError: the file is not a PLY of splats, or its header cannot be parsed.
        OSError: the file cannot be read.
    """
    header = read_ply_header(path, findings)
    if any(not finding.repairable for finding in findings):
        return None
    try:
        declared = plyfile.PlyData.read(io.BytesIO(header.without_rows()))
        if packed := _packed_colours(path, header, declared, findings):
            declared = plyfile.PlyData.read(io.BytesIO(packed))
    except _DAMAGED as error:
        raise _input_error(path, error) from None
    if SPLAT_ELEMENT not in declared:
        raise InputError(f"{path.name} has no element {SPLAT_ELEMENT!r}: not a PLY of splats")
    counts = {element.name: element.count for element in header.elements}
    names = [one.name for one in declared if one.name != SPLAT_ELEMENT]
    others = [one.name for one in declared if one.name in names and counts[one.name] and one.properties]
    properties = declared[SPLAT_ELEMENT].properties
    list_findings = _list_findings([prop.name for prop in properties if is_list(prop)])
    if only_splats:
        _, more = find_columns(row_type(properties), elements=names)
        if any(finding.id == "missing-columns" for finding in more):
            findings += [*_other_findings(others), *list_findings, *more]
            return None
    try:
        rows = _read_rows(path, header, declared, findings)
    except RowError as error:
        findings.append(error.finding)
        return None
    except _DAMAGED as error:
        raise _input_error(path, error) from None
    findings += [*_other_findings(others, rows.get(_COLOUR_SPACE)), *list_findings]
    return PlyContent(rows.get(SPLAT_ELEMENT, np.empty(0, [])), header.comments, names)


def _input_error(path: Path, error: Exception) -> InputError:
    """Return an `InputError` with the file's name and the start of another error's message."""
    return InputError(f"{path.name}: {str(error)[:_SHOWN_NAMES] or type(error).__name__}")


def _packed_colours(path: Path, header: PlyHeader, declared: Any, findings: list[Finding]) -> bytes:
    """Return the header without counts of a file that declares one byte of colour and has three; b"" for other files.

    nerfstudio's exporter declares `uchar colors` with the option `rgb` (exporter.py, up to 1.1.5).
    """
    if header.is_text or [element.name for element in declared] != [SPLAT_ELEMENT]:
        return b""
    properties, count = declared[SPLAT_ELEMENT].properties, header.elements[0].count
    names = {prop.name for prop in properties}
    single = [prop for prop in properties if not is_list(prop)]
    packed = next((prop for prop in single if prop.name in _PACKED_COLOURS and prop.val_dtype == "u1"), None)
    surplus = path.stat().st_size - header.end - count * row_type(properties).itemsize
    # Two bytes of colour per row follow the declared bytes.
    if packed is None or len(single) < len(properties) or count == 0 or surplus != 2 * count:
        return b""
    if names & {"red", "green", "blue", "f_dc_0"}:
        return b""
    text = f"one uchar {packed.name} is declared, three are in each row: read as red, green and blue"
    findings.append(Finding("packed-colours", 1, text, "note"))
    three = b"\n".join(b"property uchar %s" % name for name in (b"red", b"green", b"blue"))
    line = rb"(?m)^property[ \t]+\S+[ \t]+%s[ \t]*$" % re.escape(packed.name).encode()
    return re.sub(line, three, header.without_rows(), count=1)


@dataclass(frozen=True, eq=False)
class _OpenPly:
    """A parsed file with the meaning of its columns and comments."""

    path: Path
    rows: Rows
    columns: ColumnMap
    comments: CommentMetadata

    def blocks(self, max_rows: int | None = None) -> Iterator[Rows]:
        return _row_blocks(self.path, self.rows, max_rows)


def _open(
    path: Path, findings: list[Finding], *, keep_extra: bool, strict: bool, sh_degree: int | None
) -> _OpenPly | None:
    """Parse everything except the values of the rows; return `None` if the findings contain an error."""
    check_sh_degree(sh_degree)
    content = parse_ply(path, findings, only_splats=True)
    if content is None:
        return None
    rows = with_half_floats(content.rows, findings)
    if any(not finding.repairable for finding in findings):
        return None
    columns, more = find_columns(
        rows.dtype, keep_extra=keep_extra, sh_degree=sh_degree, elements=content.elements
    )  # fmt: skip
    findings += more
    if columns is None:
        return None
    refuse(findings, strict=strict)  # before all rows are read
    columns = with_colour_range(_row_blocks(path, rows), columns, findings)
    comments = parse_comments(content.comments)
    findings += comments.findings
    types = {name: np.dtype((rows.dtype[group[0]], len(group))) for name, group in columns.extra.items()}
    semantics = {name: name for name, dtype in types.items() if name == comments.metadata.semantic_of(name, dtype)}
    metadata = replace(comments.metadata, semantics=semantics | dict(comments.metadata.semantics))
    return _OpenPly(path, rows, columns, replace(comments, metadata=metadata))


def _load(
    path: Path, findings: list[Finding], context: Context, *, keep_extra: bool, strict: bool, sh_degree: int | None
) -> SplatModel | None:
    """Read a file in one pass; return `None` if the findings contain an error."""
    ply = _open(path, findings, keep_extra=keep_extra, strict=strict, sh_degree=sh_degree)
    if ply is None:
        return None
    statistics = RowStatistics()
    arrays = gather_arrays(
        ply.blocks(), len(ply.rows), ply.rows.dtype, ply.columns, keep_extra=keep_extra, statistics=statistics,
        context=context,
    )  # fmt: skip
    findings += list_findings(statistics, len(ply.rows))
    if len(ply.rows) == 0:
        findings.append(_EMPTY)
    positions = split_origin(arrays.means, ply.comments)
    if ply.columns.double:
        findings.append(_doubles_finding(ply, len(arrays.means), positions[1]))
    return _build_model(arrays, positions, ply)


_Positions = tuple[F32, tuple[float, float, float], F64 | None]  # means, origin, means in doubles


class _Survey(NamedTuple):
    """Values that depend on all splats of a file.

    Attributes:
        kept_count: number of splats that are not dropped.
        thinnest: smallest scale.
        positions: positions of all splats if the file has doubles.
    """

    kept_count: int
    thinnest: float
    positions: _Positions | None


def _survey(ply: _OpenPly, findings: list[Finding]) -> _Survey:
    """Read all rows once, and append the findings about them to `findings`."""
    statistics, means = RowStatistics(), []
    kept_count, thinnest = 0, math.inf
    for block in ply.blocks(BLOCK_SPLATS):
        arrays = gather_arrays([block], len(block), ply.rows.dtype, ply.columns, statistics=statistics)
        kept_count += len(arrays.means)
        thinnest = min(thinnest, float(arrays.scales[:, : len(ply.columns.scales)].min(initial=math.inf)))
        if ply.columns.double:
            means.append(arrays.means)
    findings += list_findings(statistics, len(ply.rows))
    if not ply.columns.double:
        return _Survey(kept_count, thinnest, None)
    positions = split_origin(np.concatenate([np.zeros((0, 3)), *means]), ply.comments)
    findings.append(_doubles_finding(ply, kept_count, positions[1]))
    return _Survey(kept_count, thinnest, positions)


def _empty_model(ply: _OpenPly, survey: _Survey) -> SplatModel:
    """Return a model with the metadata and no splats."""
    arrays = gather_arrays([], 0, ply.rows.dtype, ply.columns, keep_extra=True)
    means, origin, doubles = split_origin(arrays.means, ply.comments)
    if survey.positions is not None:
        origin, doubles = survey.positions[1], survey.positions[2]
        doubles = None if doubles is None else doubles[:0]
    return _build_model(arrays, (means, origin, doubles), ply)


def _model_blocks(ply: _OpenPly, survey: _Survey, *, keep_extra: bool) -> Iterator[SplatModel]:
    """Yield the remaining splats, at most `BLOCK_SPLATS` at a time."""
    start = 0
    for block in ply.blocks(BLOCK_SPLATS):
        arrays = gather_arrays(
            [block], len(block), ply.rows.dtype, ply.columns, keep_extra=keep_extra, thinnest=survey.thinnest
        )
        part = slice(start, start + len(arrays.means))
        if survey.positions is None:
            positions = split_origin(arrays.means, ply.comments)
        else:
            means, origin, doubles = survey.positions
            positions = means[part], origin, None if doubles is None else doubles[part]
        start = part.stop
        if len(arrays.means):
            yield _build_model(arrays, positions, ply)


def _doubles_finding(ply: _OpenPly, count: int, origin: tuple[float, float, float]) -> Finding:
    """Report that `count` means were rounded to float32 relative to an origin."""
    is_float = all(ply.rows.dtype[name].kind == "f" for name in ply.columns.means)
    text = f"positions are {'in doubles' if is_float else 'integers'}: {count} means are float32 relative to {origin}"
    return Finding("double-means", count, text, "note")


def _build_model(arrays: AttributeArrays, positions: _Positions, ply: _OpenPly) -> SplatModel:
    """Return a model of arrays, with the positions and the metadata of a file; two scales mean flat splats."""
    (means, origin, doubles), metadata = positions, ply.comments.metadata
    return SplatModel(
        means=means,
        quats=arrays.quats,
        scales=arrays.scales,
        opacities=arrays.opacities,
        sh0=arrays.sh0,
        shN=arrays.shN,
        origin=origin,
        metadata=replace(metadata, flat=True) if len(ply.columns.scales) == 2 else metadata,
        extra=arrays.extra,
        means_double=doubles,
    )


def _read_rows(path: Path, header: PlyHeader, declared: Any, findings: list[Finding]) -> dict[str, Rows]:
    """Read the single values of the elements that are needed, by name of the element; all others are skipped.

    Args:
        path: path of the file.
        header: its header.
        declared: the header as plyfile parses it, without counts.
        findings: findings about the layout of text, and bytes after the last row, are appended to this list.

    Raises:
        RowError: rows are missing or invalid.
        plyfile.PlyParseError, ValueError, OverflowError, MemoryError: plyfile cannot read them.
        OSError: the file cannot be read.
    """
    if not header.is_text:
        return _read_binary(path, header, declared, findings)
    # NumPy warns about text numbers beyond their type, which become infinite and are dropped later.
    with np.errstate(over="ignore"), warnings.catch_warnings(action="ignore", category=UserWarning):
        with suppress(plyfile.PlyElementParseError, RowError):
            return _read_lines(path, header, declared, findings)
        return _read_layout(path, header, declared, findings)


def _is_needed(element: Any) -> bool:
    """Return True for splats with a scalar column, and for an element whose first scalar column is its colour space."""
    if element.name == _COLOUR_SPACE:
        return [prop.name for prop in element.properties if not is_list(prop)][:1] == [_COLOUR_SPACE]
    return element.name == SPLAT_ELEMENT and not all(map(is_list, element.properties))


def _read_binary(path: Path, header: PlyHeader, declared: Any, findings: list[Finding]) -> dict[str, Rows]:
    """Read binary rows of the elements that are needed; lists are skipped. As in `_read_rows`."""
    rows: dict[str, Rows] = {}
    at, size, order = header.end, path.stat().st_size, declared.byte_order
    for element, header_element in zip(declared, header.elements, strict=True):
        name, properties, count = element.name, element.properties, header_element.count
        if any(map(is_list, properties)):
            data = memoryview(map_file(path))
            if not _is_needed(element):
                at = skip_lists(data, at, name, count, properties, order, None)
                continue
            with TemporaryFile() as copy:
                copy.write(_element_header(declared, element, count))
                at = skip_lists(data, at, name, count, properties, order, copy)
                copy.seek(0)
                rows[name] = np.array(plyfile.PlyData.read(copy)[name].data)
            continue
        width = row_type(properties).itemsize
        if width and (size - at) // width < count:
            raise RowError(truncated_finding(name, count, (size - at) // width))
        if _is_needed(element):
            with _StreamWithHeader(path, _element_header(declared, element, count), at) as stream:
                rows[name] = plyfile.PlyData.read(stream)[name].data
        at += count * width
    findings += _trailing_findings(path, header, at)
    return rows


def _read_lines(path: Path, header: PlyHeader, declared: Any, findings: list[Finding]) -> dict[str, Rows]:
    """Read text with a row in each line; raise an error for any other layout."""
    rows: dict[str, Rows] = {}
    with open_binary(path) as file:
        rows_size = file.seek(0, io.SEEK_END) - header.end
        file.seek(header.end)
        stream = io.TextIOWrapper(file, encoding="ascii", errors="replace", newline="")
        lines = (line.translate(_SEPARATORS) for line in stream)
        for element, header_element in zip(declared, header.elements, strict=True):
            absent = RowError(truncated_finding(header_element.name, header_element.count, 0))
            # Refuse before memory for the rows is allocated: a value takes a digit and a separator, except the last.
            width, count = len(header_element.properties), header_element.count
            if count * 2 * width > rows_size + 1 or (count and not width):
                raise absent
            if _is_needed(element):
                rows[header_element.name] = _parse_lines(declared, element, header_element.count, lines)
            elif header_element.count != sum(1 for _ in islice(_scalar_lines(element, lines), header_element.count)):
                raise absent
        surplus_bytes = len(stream.read().strip())
    findings += _rest_findings(surplus_bytes)
    return rows


def _read_layout(path: Path, header: PlyHeader, declared: Any, findings: list[Finding]) -> dict[str, Rows]:
    """Read text of any layout, as `parse_text_rows` splits it; as in `_read_rows`."""
    with open_binary(path) as stream:
        lines_before = count_lines(stream.read(header.end))
        needed = [element.name for element in declared if _is_needed(element)]
        texts, more = parse_text_rows(stream.read(), header.elements, needed, lines_before)
    findings += more
    rows: dict[str, Rows] = {}
    for name, text in texts.items():
        try:
            rows[name] = _parse_lines(declared, declared[name], len(text.rows), text.rows, text.lines)
        except plyfile.PlyElementParseError as error:
            row = next(islice(_scalar_lines(declared[name], text.rows), error.row or 0, None)).split()
            raise RowError(_row_finding(error, row, text.lines)) from None
    return rows


def _scalar_lines(element: Any, lines: Iterable[str], numbers: Sequence[int] | None = None) -> Iterator[str]:
    """Return text rows of an element without the values of its lists; `numbers` are their lines, for messages."""
    return lines_without_lists(lines, element.name, element.properties, numbers)


def _parse_lines(
    declared: Any, element: Any, count: int, lines: Iterable[str], numbers: Sequence[int] | None = None
) -> Rows:
    """Parse the first `count` lines, a row each, without the values of lists; as in `_read_rows`."""
    if any(map(is_list, element.properties)):
        lines = _scalar_lines(element, lines, numbers)
    rows_read = count_from(0)
    lines = (line.replace("_", "?") for line, _ in zip(lines, rows_read, strict=False))  # Python accepts 1_000
    header = io.StringIO(_element_header(declared, element, count).decode())
    stream = SimpleNamespace(read=header.read, readline=partial(next, iter(lines), ""))
    try:
        rows: Rows = plyfile.PlyData.read(stream)[element.name].data
    except OverflowError:
        row = next(rows_read) - 1
        place = (
            f"row {row} of {element.name}" if numbers is None else f"line {numbers[row]}: row {row} of {element.name}"
        )
        raise RowError(Finding("malformed", 1, f"{place} has an integer beyond its type", "error")) from None
    return rows


def _element_header(declared: Any, element: Any, count: int) -> bytes:
    """Return the header of a file that has only this element, without its lists."""
    single = (prop for prop in element.properties if not is_list(prop))
    lines = [f"format {_FORMATS[declared.byte_order]} 1.0", f"element {element.name} {count}", *map(str, single)]
    return "\n".join(["ply", *lines, "end_header", ""]).encode("ascii")


def _row_finding(error: Any, words: list[str], lines: Sequence[int]) -> Finding:
    """Report the invalid value of a text row, which has these words; `lines` are those of all rows."""
    name, row, text = error.element.name, error.row or 0, error.message
    if error.prop is not None:
        word = words[[prop.name for prop in error.element.properties].index(error.prop.name)]
        kind = np.dtype(error.prop.val_dtype)
        expected = "a number" if kind.kind == "f" else f"an integer of type {kind.name}"
        text = f"{error.prop.name} is {word[:_SHOWN]!r}, expected {expected}"
    return Finding("malformed", 1, f"line {lines[row]}: row {row} of {name}: {text}", "error")


def _list_findings(names: list[str]) -> list[Finding]:
    """Report lists of splats."""
    what = f"list properties {textwrap.shorten(', '.join(names), _SHOWN_NAMES)}"
    return [Finding("list-columns", len(names), f"{what}: dropped", "repair", lost=(what,))] if names else []


def _other_findings(names: list[str], colour_space: Rows | None = None) -> list[Finding]:
    """Report elements that contain no splats.

    Args:
        names: their names.
        colour_space: rows of the element with the colour space, if any.
    """
    if not names:
        return []
    shown = textwrap.shorten(", ".join(names), _SHOWN_NAMES)
    text, lost = f"elements besides {SPLAT_ELEMENT}: {shown}: dropped", (f"elements {shown}",)
    if not set(names) <= _SHARP:
        if any(name.startswith(_FRAME) for name in names):
            text += "; they move the splats, of which the first frame is kept"
        return [Finding("other-elements", len(names), text, "repair", lost=lost)]
    findings = [Finding("sharp-elements", len(names), f"{text}; they are the camera of ml-sharp", "note", lost=lost)]
    if colour_space is None:
        return findings
    linear = colour_space[_COLOUR_SPACE][colour_space[_COLOUR_SPACE] != _SRGB]
    if len(linear):
        text = f"{_COLOUR_SPACE} is {linear[0]} (linear RGB), expected {_SRGB} (sRGB): export the scene in sRGB"
        findings.append(Finding("colour-space", 1, text, "error"))
    return findings


def _trailing_findings(path: Path, header: PlyHeader, end: int) -> list[Finding]:
    """Report bytes after the last binary row, which ends at `end`."""
    count = path.stat().st_size - end
    if count and _is_changed_as_text(path, header, count):
        text = (
            f"{counted(count, 'byte')} after the last row, and a carriage return before each line feed of the rows:"
            " corrupted by a text-mode transfer (git autocrlf, FTP): copy it again as binary"
        )
        return [Finding("malformed", count, text, "error")]
    return _rest_findings(count)


def _rest_findings(count: int) -> list[Finding]:
    """Report `count` bytes after the last row; no finding for 0."""
    what = f"{counted(count, 'byte')} after the last row"
    return [Finding("trailing-bytes", count, f"{what}: ignored", "repair", lost=(what,))] if count else []


def _is_changed_as_text(path: Path, header: PlyHeader, surplus: int) -> bool:
    """Return True if a carriage return was inserted before each line feed of binary rows.

    Args:
        path: path of the file.
        header: its header.
        surplus: number of bytes after the last row.
    """
    if not header.text.endswith(b"\r\n"):
        return False
    feeds, last = 0, b"\n"
    with open_binary(path) as stream:
        stream.seek(header.end)
        while block := stream.read(_BLOCK_SIZE):
            block_feeds = block.count(b"\n")
            feeds += block_feeds
            if block_feeds != (last[-1:] + block).count(b"\r\n"):
                return False
            last = block
    return surplus <= feeds


def _row_blocks(path: Path, rows: Rows, max_rows: int | None = None) -> Iterator[Rows]:
    """Yield rows in blocks. Memory-mapped rows are read from the file, which aligns them and saves memory.

    Args:
        path: path of the file.
        rows: as `parse_ply` returns them.
        max_rows: rows per block; `None`: the number that fits in the cache.

    Raises:
        InputError: the file became shorter.
    """
    step = max_rows or max(1, _BLOCK_SIZE // max(1, rows.dtype.itemsize))
    if not isinstance(rows, np.memmap):
        yield from (rows[start : start + step] for start in range(0, len(rows), step))
        return
    with open_binary(path) as stream:
        stream.seek(rows.offset)
        for start in range(0, len(rows), step):
            count = min(step, len(rows) - start)
            block = np.fromfile(stream, rows.dtype, count)
            if len(block) != count:
                raise InputError(f"{path.name} became shorter while it was read")
            yield block


class _StreamWithHeader(io.BufferedReader):
    """A file at an offset, whose bytes follow a header that is not in the file."""

    def __init__(self, path: Path, header: bytes, offset: int) -> None:
        super().__init__(io.FileIO(path))
        self.seek(offset)
        self._header = io.BytesIO(header)

    def read(self, size: int | None = -1, /) -> bytes:
        return self._header.read(size) or super().read(size)
