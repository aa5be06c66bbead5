"""Read and write PLY files of 3D Gaussian splats (INRIA's layout and its relatives).

PLY has no place for what a scene needs beyond its columns, so it goes into header comments:
`csplat origin X Y Z` (x, y, z are relative to it), `csplat absolute_origin X Y Z` (x, y, z are
absolute, in doubles), `csplat coordinate_system RDF`, `csplat up X Y Z`, `csplat unit_metres U`,
`csplat licence TEXT`, `csplat training {JSON}` and `csplat view {JSON}` (what the scene was trained on and where it is
shown from first, as `csplat.training` has them in the metadata). Antialiased and flat scenes are marked in the words of
other programs, `SplatRenderMode: mip` or `2dgs`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from csplat.files import local_file
from csplat.inputs import File
from csplat.lint import Columns, Finding, find_columns, refuse
from csplat.model import SplatModel, check_sh_degree
from csplat.ply_columns import Arrays, Counts, Rows, findings_of, gather, with_colour_range, with_half_floats
from csplat.ply_comments import SceneFacts, parse_comments
from csplat.ply_file import blocks_of, parse
from csplat.ply_origin import relative_to_origin
from csplat.scene import BLOCK, Scene
from csplat.types import F32, F64

_EMPTY = Finding("empty", 0, "the file holds no splats", "note")


def read_ply(
    file: File,
    *,
    strict: bool = False,
    keep_extra: bool = False,
    sh_degree: int | None = None,
    report: list[Finding] | None = None,
) -> SplatModel:
    """Read a PLY of splats: binary of either byte order or ASCII, SH degree 0 to 3.

    Columns that another program names in its own way are found by a table (`csplat.lint`): those of CloudCompare,
    red, green and blue in place of f_dc, and the filter of Mip-Splatting, which is fused. Each is reported.

    Opacities go through the sigmoid in float64, rounded once; above a logit of 16 float32 alpha
    is too close to 1 to keep neighbours apart. Rotations become unit length. Positions in doubles
    get an `origin`, named by a comment of the file or chosen so that float32 loses nothing.
    Header comments are kept in `metadata["comments"]`.

    Args:
        file: its path; an open binary file, or the bytes, of which a temporary copy is made.
        strict: refuse what would be repaired (`csplat.lint` lists it).
        keep_extra: keep columns that splats do not have in `SplatModel.extra`.
        sh_degree: leave out the SH bands above, also of a file of a higher degree than 3; `None`: keep all.
        report: findings are appended to this list, repairs among them.

    Examples:
        >>> import csplat
        >>> model = csplat.read_ply("scene.ply")
        >>> model
        SplatModel(1000 splats, sh_degree=3)
        >>> model.scales.shape, model.scales.dtype  # natural logarithms
        ((1000, 3), dtype('float32'))

    Raises:
        InputError: not a PLY of splats (other splat formats are named, with a converter), or one
            that cannot be repaired, or under `strict` one that would have to be.
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
    assert model is not None, "without an error there is a model"
    return model


def lint_ply(file: File, *, sh_degree: int | None = None) -> list[Finding]:
    """Find out what is wrong with a PLY of splats, without refusing it.

    Args:
        file: as in `read_ply`.
        sh_degree: as in `read_ply`.

    Returns:
        Findings in the order of reading; the last one is an error where `read_ply` would refuse.

    Raises:
        InputError: not a PLY at all, or its header cannot be parsed.
        OSError: the file cannot be read.
    """
    findings: list[Finding] = []
    with local_file(file) as path:
        opened = _opened(path, findings, keep_extra=False, strict=False, sh_degree=sh_degree)
        if opened is not None:
            survey = _surveyed(path, opened, findings)
            if len(opened.rows) == 0:
                findings.append(_EMPTY)
            _without_splats(opened, survey)  # a model refuses what no finding is about
            for _ in _models(path, opened, survey, keep_extra=False):
                pass
    return findings


@contextmanager
def open_ply(path: Path, sh_degree: int | None = None) -> Iterator[Scene]:
    """Open a PLY as `csplat.formats` does; the rest as `read_ply`.

    What belongs to all splats (how many are kept, an origin for doubles, the thickness of discs) is found first, in a
    pass of its own.
    """
    findings: list[Finding] = []
    opened = _opened(path, findings, keep_extra=True, strict=False, sh_degree=sh_degree)
    refuse(findings, strict=False)
    assert opened is not None, "without an error there are rows"
    survey = _surveyed(path, opened, findings)
    refuse(findings, strict=False)
    facts = _without_splats(opened, survey)
    yield Scene(survey.kept, facts, partial(_models, path, opened, survey, keep_extra=True), findings)


_Placed = tuple[F32, tuple[float, float, float], F64 | None]  # means, origin, means in doubles


class _Survey(NamedTuple):
    """Facts about all splats of a file together.

    Attributes:
        kept: splats without those that are dropped.
        thinnest: the smallest scale.
        placed: for positions in doubles, all of them, in their places.
    """

    kept: int
    thinnest: float
    placed: _Placed | None


def _surveyed(path: Path, opened: _Opened, findings: list[Finding]) -> _Survey:
    """Go through all rows, appending what is noticed to `findings`."""
    counts, total, positions, thinnest, columns = Counts(), 0, [], math.inf, opened.columns
    for block in blocks_of(path, opened.rows, BLOCK):
        arrays = gather([block], len(block), opened.rows.dtype, columns, counts=counts)
        total += len(arrays.means)
        thinnest = min(thinnest, float(arrays.scales[:, : len(columns.scales)].min(initial=math.inf)))
        if columns.double:
            positions.append(arrays.means)
    findings += findings_of(counts, len(opened.rows))
    if not columns.double:
        return _Survey(total, thinnest, None)
    placed = relative_to_origin(np.concatenate([np.zeros((0, 3)), *positions]), opened.facts)
    findings.append(_doubles_finding(opened, total, placed[1]))
    return _Survey(total, thinnest, placed)


def _without_splats(opened: _Opened, survey: _Survey) -> SplatModel:
    """Everything that is said of the scene."""
    empty = gather([], 0, opened.rows.dtype, opened.columns, keep_extra=True)
    placed = relative_to_origin(empty.means, opened.facts)
    return _model(empty, placed if survey.placed is None else (placed[0], survey.placed[1], None), opened)


def _models(path: Path, opened: _Opened, survey: _Survey, *, keep_extra: bool) -> Iterator[SplatModel]:
    """The splats that are kept, some at a time."""
    at = 0
    for block in blocks_of(path, opened.rows, BLOCK):
        arrays = gather(
            [block], len(block), opened.rows.dtype, opened.columns, keep_extra=keep_extra, thinnest=survey.thinnest
        )
        part = slice(at, at + len(arrays.means))
        if survey.placed is None:
            placed = relative_to_origin(arrays.means, opened.facts)
        else:
            means, origin, doubles = survey.placed
            placed = means[part], origin, None if doubles is None else doubles[part]
        at = part.stop
        if len(arrays.means):
            yield _model(arrays, placed, opened)


@dataclass(frozen=True, eq=False)
class _Opened:
    rows: Rows
    columns: Columns
    facts: SceneFacts


def _opened(
    path: Path, findings: list[Finding], *, keep_extra: bool, strict: bool, sh_degree: int | None
) -> _Opened | None:
    """Look at all but the rows, appending what is noticed to `findings`; `None` if that holds an error."""
    check_sh_degree(sh_degree)
    content = parse(path, findings)
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
    refuse(findings, strict=strict)  # before the work
    columns = with_colour_range(blocks_of(path, rows), columns, findings)
    facts = parse_comments(content.comments)
    findings += facts.findings
    return _Opened(rows, columns, facts)


def _load(
    path: Path, findings: list[Finding], *, keep_extra: bool, strict: bool, sh_degree: int | None
) -> SplatModel | None:
    """Read a file, appending what is noticed to `findings`; `None` if that holds an error."""
    opened = _opened(path, findings, keep_extra=keep_extra, strict=strict, sh_degree=sh_degree)
    if opened is None:
        return None
    rows, columns, counts = opened.rows, opened.columns, Counts()
    arrays = gather(blocks_of(path, rows), len(rows), rows.dtype, columns, keep_extra=keep_extra, counts=counts)
    findings += findings_of(counts, len(rows))
    if len(rows) == 0:
        findings.append(_EMPTY)
    placed = relative_to_origin(arrays.means, opened.facts)
    if columns.double:
        findings.append(_doubles_finding(opened, len(arrays.means), placed[1]))
    return _model(arrays, placed, opened)


def _doubles_finding(opened: _Opened, count: int, origin: tuple[float, float, float]) -> Finding:
    is_float = all(opened.rows.dtype[name].kind == "f" for name in opened.columns.means)
    text = f"positions are {'in doubles' if is_float else 'integers'}: {count} means are float32 relative to {origin}"
    return Finding("double-means", count, text, "note")


def _model(arrays: Arrays, placed: _Placed, opened: _Opened) -> SplatModel:
    means, origin, doubles = placed
    facts = opened.facts
    return SplatModel(
        means=means,
        quats=arrays.quats,
        scales=arrays.scales,
        opacities=arrays.opacities,
        sh0=arrays.sh0,
        shN=arrays.shN,
        origin=origin,
        **{**facts.fields(), "flat": facts.flat or len(opened.columns.scales) == 2},
        extra=arrays.extra,
        means_double=doubles,
    )
