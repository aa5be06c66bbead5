"""Read PLY files of 3D Gaussian splats.

This is the only module that imports plyfile, which is GPL-3.0-or-later, so programs that embed the decoder and never
read a PLY do not load it.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import plyfile

from csplat.disk_files import local_file
from csplat.errors import InputError, counted
from csplat.file_source import File, open_binary
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
from csplat.ply.ply_header import SPLAT_ELEMENT, PlyHeader, parse_text_rows, read_ply_header, truncated_finding
from csplat.scene_source import BLOCK_SPLATS, SceneSource
from csplat.types import F32, F64

_EMPTY = Finding("empty", 0, "the file contains no splats", "note")
_FRAME = "delta_vertex_"  # prefix of Brush's elements with the differences of later frames from the first
#: Elements of Apple's ml-sharp (gaussians.py): the camera of its image, and data for its own programs.
_SHARP = {"extrinsic", "intrinsic", "image_size", "frame", "disparity", "color_space", "version"}
_COLOUR_SPACE, _SRGB = "color_space", 0
_BLOCK_SIZE = 1 << 20  # bytes of rows that are converted at a time; they fit in the cache
_EARLY_END = "early end-of-file"  # message of plyfile
_PACKED_COLOURS = ("colors", "color", "rgb")
_SHOWN = 40  # maximum number of characters of a word in a message


def read_ply(
    file: File,
    *,
    strict: bool = False,
    keep_extra: bool = False,
    sh_degree: int | None = None,
    report: list[Finding] | None = None,
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

    Examples:
        >>> import csplat
        >>> model = csplat.read_ply("scene.ply")
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
            model = _load(path, findings, keep_extra=keep_extra, strict=strict, sh_degree=sh_degree)
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
        Findings in the order of reading; the last one is an error if `read_ply` would refuse the file.

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
def open_ply(path: Path, sh_degree: int | None = None) -> Iterator[SceneSource]:
    """Open a PLY to read it block by block (`csplat.formats.open_scene`); otherwise as `read_ply`.

    A first pass determines values that depend on all splats: the number of splats that are kept, the origin of doubles,
    and the thickness of discs.
    """
    findings: list[Finding] = []
    ply = _open(path, findings, keep_extra=True, strict=False, sh_degree=sh_degree)
    refuse(findings, strict=False)
    assert ply is not None, "only an error leaves no rows"
    survey = _survey(ply, findings)
    refuse(findings, strict=False)
    metadata = _empty_model(ply, survey)
    yield SceneSource(survey.kept_count, metadata, partial(_model_blocks, ply, survey, keep_extra=True), findings)


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


def parse_ply(path: Path, findings: list[Finding]) -> PlyContent | None:
    """Parse a file with plyfile.

    Args:
        path: path of the file.
        findings: findings are appended to this list.

    Returns:
        The content; `None` if the findings contain an error.

    Raises:
        InputError: the file is not a PLY of splats, or its header cannot be parsed.
        OSError: the file cannot be read.
    """
    header = read_ply_header(path, findings)
    if any(not one.repairable for one in findings):
        return None
    # NumPy warns about text numbers beyond their type, which become infinite and are dropped later, and about empty
    # tables, which plyfile refuses.
    quiet = warnings.catch_warnings(action="ignore", category=UserWarning)
    packed = None
    with _open_for_plyfile(path, header) as stream, np.errstate(over="ignore"), quiet:
        try:
            try:
                parsed = plyfile.PlyData.read(stream)
                end = None if parsed.text else stream.tell()
                packed = _with_packed_colours(path, header, parsed, findings)
                if packed is None:
                    findings += _trailing_findings(path, header, end, sum(element.count for element in parsed))
            except plyfile.PlyElementParseError as error:
                parsed = _read_again(path, header, findings, error)
        except (plyfile.PlyParseError, ValueError, OverflowError, MemoryError) as error:
            raise InputError(f"{path.name}: {error or type(error).__name__}") from None
    if parsed is None:
        return None
    if SPLAT_ELEMENT not in parsed:
        raise InputError(f"{path.name} has no element {SPLAT_ELEMENT!r}: not a PLY of splats")
    others = [element for element in parsed if element.name != SPLAT_ELEMENT]
    findings += _other_findings(others)
    rows, lists = _scalar_columns(parsed[SPLAT_ELEMENT].data if packed is None else packed)
    if lists:
        text = f"list properties {', '.join(lists)}: dropped"
        findings.append(Finding("list-columns", len(lists), text, "repair"))
    comments = [*parsed.comments, *parsed.obj_info]
    for element in parsed:
        comments += element.comments
    return PlyContent(rows, comments, [element.name for element in others])


def _with_packed_colours(path: Path, header: PlyHeader, parsed: Any, findings: list[Finding]) -> Rows | None:
    """Return the rows of a file that declares one byte of colour and has three; `None` if it is not such a file.

    nerfstudio's exporter declares `uchar colors` with the option `rgb` (exporter.py, up to 1.1.5).
    """
    if parsed.text or [element.name for element in parsed] != [SPLAT_ELEMENT]:
        return None
    data = parsed[SPLAT_ELEMENT].data
    names = data.dtype.names or ()
    name = next((one for one in names if one in _PACKED_COLOURS and data.dtype[one] == np.uint8), "")
    surplus = path.stat().st_size - header.end - data.nbytes
    if not name or not len(data) or surplus != 2 * len(data) or {"red", "green", "blue", "f_dc_0"} & {*names}:
        return None
    fields: list[Any] = []
    for one in names:
        fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")] if one == name else [(one, data.dtype[one])]
    text = f"one uchar {name} is declared, three are in each row: read as red, green and blue"
    findings.append(Finding("packed-colours", 1, text, "note"))
    return np.memmap(path, fields, "r", header.end, (len(data),))


@dataclass(frozen=True, eq=False)
class _OpenPly:
    """A parsed file with the meaning of its columns and comments."""

    path: Path
    rows: Rows
    columns: ColumnMap
    metadata: CommentMetadata

    def blocks(self, max_rows: int | None = None) -> Iterator[Rows]:
        return _row_blocks(self.path, self.rows, max_rows)


def _open(
    path: Path, findings: list[Finding], *, keep_extra: bool, strict: bool, sh_degree: int | None
) -> _OpenPly | None:
    """Parse everything except the values of the rows; return `None` if the findings contain an error."""
    check_sh_degree(sh_degree)
    content = parse_ply(path, findings)
    if content is None:
        return None
    rows = with_half_floats(content.rows, findings)
    if any(not one.repairable for one in findings):
        return None
    columns, more = find_columns(
        rows.dtype, keep_extra=keep_extra, sh_degree=sh_degree, elements=content.elements
    )  # fmt: skip
    findings += more
    if columns is None:
        return None
    refuse(findings, strict=strict)  # before all rows are read
    columns = with_colour_range(_row_blocks(path, rows), columns, findings)
    metadata = parse_comments(content.comments)
    findings += metadata.findings
    return _OpenPly(path, rows, columns, metadata)


def _load(
    path: Path, findings: list[Finding], *, keep_extra: bool, strict: bool, sh_degree: int | None
) -> SplatModel | None:
    """Read a file in one pass; return `None` if the findings contain an error."""
    ply = _open(path, findings, keep_extra=keep_extra, strict=strict, sh_degree=sh_degree)
    if ply is None:
        return None
    statistics = RowStatistics()
    arrays = gather_arrays(
        ply.blocks(), len(ply.rows), ply.rows.dtype, ply.columns, keep_extra=keep_extra, statistics=statistics
    )
    findings += list_findings(statistics, len(ply.rows))
    if len(ply.rows) == 0:
        findings.append(_EMPTY)
    positions = split_origin(arrays.means, ply.metadata)
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
    """Read all rows once, appending to `findings`."""
    statistics, kept_count, means, thinnest = RowStatistics(), 0, [], math.inf
    for block in ply.blocks(BLOCK_SPLATS):
        arrays = gather_arrays([block], len(block), ply.rows.dtype, ply.columns, statistics=statistics)
        kept_count += len(arrays.means)
        thinnest = min(thinnest, float(arrays.scales[:, : len(ply.columns.scales)].min(initial=math.inf)))
        if ply.columns.double:
            means.append(arrays.means)
    findings += list_findings(statistics, len(ply.rows))
    if not ply.columns.double:
        return _Survey(kept_count, thinnest, None)
    positions = split_origin(np.concatenate([np.zeros((0, 3)), *means]), ply.metadata)
    findings.append(_doubles_finding(ply, kept_count, positions[1]))
    return _Survey(kept_count, thinnest, positions)


def _empty_model(ply: _OpenPly, survey: _Survey) -> SplatModel:
    """Return a model with the metadata and no splats."""
    arrays = gather_arrays([], 0, ply.rows.dtype, ply.columns, keep_extra=True)
    means, origin, doubles = split_origin(arrays.means, ply.metadata)
    if survey.positions is not None:
        origin, doubles = survey.positions[1], None
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
            positions = split_origin(arrays.means, ply.metadata)
        else:
            means, origin, doubles = survey.positions
            positions = means[part], origin, None if doubles is None else doubles[part]
        start = part.stop
        if len(arrays.means):
            yield _build_model(arrays, positions, ply)


def _doubles_finding(ply: _OpenPly, count: int, origin: tuple[float, float, float]) -> Finding:
    is_float = all(ply.rows.dtype[name].kind == "f" for name in ply.columns.means)
    text = f"positions are {'in doubles' if is_float else 'integers'}: {count} means are float32 relative to {origin}"
    return Finding("double-means", count, text, "note")


def _build_model(arrays: AttributeArrays, positions: _Positions, ply: _OpenPly) -> SplatModel:
    means, origin, doubles = positions
    return SplatModel(
        means=means,
        quats=arrays.quats,
        scales=arrays.scales,
        opacities=arrays.opacities,
        sh0=arrays.sh0,
        shN=arrays.shN,
        origin=origin,
        **{**ply.metadata.fields(), "flat": ply.metadata.flat or len(ply.columns.scales) == 2},
        extra=arrays.extra,
        means_double=doubles,
    )


def _read_again(path: Path, header: PlyHeader, findings: list[Finding], error: Any) -> Any:
    """Read a file that plyfile refused; return `None` and append a finding if that is not possible.

    Args:
        path: path of the file.
        header: its header.
        findings: findings are appended to this list.
        error: the error that plyfile raised.
    """
    if not header.is_text or error.message == _EARLY_END:
        findings.append(truncated_finding(error.element.name, error.element.count, error.row or 0))
        return None
    with open_binary(path) as stream:
        stream.seek(header.end)
        rows, more = parse_text_rows(stream.read(), header.elements)
    findings += more
    if rows is None:
        return None
    text = "\n".join([*header.text.decode("ascii").splitlines(), *map(" ".join, rows), ""])
    try:
        return plyfile.PlyData.read(io.StringIO(text))
    except plyfile.PlyElementParseError as second:
        findings.append(_row_finding(second, rows, header))
        return None


def _row_finding(error: Any, rows: list[list[str]], header: PlyHeader) -> Finding:
    """Report the invalid value of a text row."""
    name, row, text = error.element.name, error.row or 0, error.message
    at = [element.name for element in header.elements].index(name)
    element, before = header.elements[at], sum(one.count for one in header.elements[:at])
    if error.prop is not None and not element.has_lists:
        word = rows[before + row][element.properties.index(error.prop.name)]
        kind = np.dtype(error.prop.val_dtype)
        expected = "a number" if kind.kind == "f" else f"an integer of type {kind.name}"
        text = f"{error.prop.name} is {word[:_SHOWN]!r}, expected {expected}"
    return Finding("malformed", 1, f"row {row} of {name}: {text}", "error")


def _other_findings(others: list[Any]) -> list[Finding]:
    """Report elements that contain no splats."""
    if not others:
        return []
    names = [element.name for element in others]
    text = f"elements besides {SPLAT_ELEMENT}: {', '.join(names)}: dropped"
    if not set(names) <= _SHARP:
        if any(name.startswith(_FRAME) for name in names):
            text += "; they move the splats, of which the first frame is kept"
        return [Finding("other-elements", len(others), text, "repair")]
    findings = [Finding("sharp-elements", len(others), f"{text}; they are the camera of ml-sharp", "note")]
    for element in others:
        values = element.data[_COLOUR_SPACE] if element.name == _COLOUR_SPACE == element.properties[0].name else ()
        linear = [value for value in values if value != _SRGB]
        if linear:
            text = f"{_COLOUR_SPACE} is {linear[0]} (linear RGB), expected {_SRGB} (sRGB): export the scene in sRGB"
            findings.append(Finding("colour-space", 1, text, "error"))
    return findings


def _trailing_findings(path: Path, header: PlyHeader, end: int | None, row_count: int) -> list[Finding]:
    """Report bytes after the last row, which ends at `end`; in ASCII files (`None`) each row is a line."""
    if end is not None:
        count = path.stat().st_size - end
        if count and _is_changed_as_text(path, header, count):
            text = (
                f"{counted(count, 'byte')} after the last row, and a carriage return before each line feed of the rows:"
                " corrupted by a text-mode transfer (git autocrlf, FTP): copy it again as binary"
            )
            return [Finding("malformed", count, text, "error")]
    else:
        with open_binary(path) as stream:
            stream.seek(header.end)
            lines = stream.read().splitlines(keepends=True)
        count = len(b"".join(lines[row_count:]).strip())
    if count == 0:
        return []
    text = f"{counted(count, 'byte')} after the last row: ignored"
    return [Finding("trailing-bytes", count, text, "repair")]


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
            found = block.count(b"\n")
            feeds += found
            if found != (last[-1:] + block).count(b"\r\n"):
                return False
            last = block
    return surplus <= feeds


def _scalar_columns(data: Rows) -> tuple[Rows, list[str]]:
    """Drop list properties; return contiguous rows and the names of the dropped properties."""
    names = data.dtype.names or ()
    lists = [name for name in names if data.dtype[name].hasobject]
    if not lists:
        return data, []
    kept = [(name, data.dtype[name]) for name in names if name not in lists]
    rows = np.empty(len(data), kept)
    for name, _ in kept:
        rows[name] = data[name]
    return rows, lists


def _row_blocks(path: Path, rows: Rows, max_rows: int | None = None) -> Iterator[Rows]:
    """Yield rows in blocks; memory-mapped rows are read from the file, which aligns them and saves memory.

    Args:
        path: path of the file.
        rows: as `parse_ply` returns them.
        max_rows: rows per block; `None`: the number that fits in the cache.
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


def _open_for_plyfile(path: Path, header: PlyHeader) -> IO[Any]:
    """Open a PLY after its byte order mark, with the rewritten header; ASCII files are opened as text."""
    stream = _StreamWithHeader(path, header)
    return io.TextIOWrapper(stream, encoding="ascii", errors="replace") if header.is_text else stream


class _StreamWithHeader(io.BufferedReader):
    """A file whose header is replaced by another one of the same length."""

    def __init__(self, path: Path, header: PlyHeader) -> None:
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
        begin = self._header[self._at : self._at + len(data)]  # plyfile reads byte by byte: do not copy the rest
        self._at += len(begin)
        return begin + data[len(begin) :]
