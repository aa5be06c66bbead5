"""What is wrong with the columns of a splat PLY, and the repairs that are safe.

A finding is one of three things. A *note* is ordinary variation: nothing is lost, nothing looks
different. A *repair* changes or drops something, safely, and is reported; `strict` refuses it. An
*error* cannot be repaired without guessing.

| id | what | kind |
|---|---|---|
| `missing-columns` | a column without which there is no splat | error |
| `sh-columns` | f_rest columns that are no SH degree, or not numbered from 0 | error |
| `truncated` | fewer splats than the header declares | error |
| `malformed` | a row that is no row | error |
| `trailing-bytes` | bytes after the last declared splat: ignored | repair |
| `extra-columns` | columns that splats do not have: dropped, unless asked to keep them | repair |
| `list-columns` | list properties of splats: dropped | repair |
| `other-elements` | elements besides the splats: dropped | repair |
| `nonfinite-rows` | splats with NaN or infinity: dropped; where all are like that, an error | repair |
| `zero-quats` | rotations of length 0: the identity | repair |
| `unnormalised-quats` | rotations that are not unit: scaled, as every renderer does | note |
| `infinite-logits` | opacities of exactly 0 or 1 | note |
| `flat-scales` | two scales instead of three: discs (2DGS) | note |
| `nonzero-normals` | normals, which splats do not use: dropped | note |
| `huge-values` | log scales beyond ± 88, colours beyond ± 1e6 | note |
| `shuffled-columns` | columns in another order than usual | note |
| `double-means` | positions in double precision: an origin carries what float32 cannot | note |
| `non-ascii-header` | characters outside ASCII in the header: read as question marks | note |
| `empty` | no splats at all | note |
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from csplat.errors import InputError, counted

__all__ = ["Columns", "Finding", "find_columns", "refuse"]

Kind = Literal["note", "repair", "error"]

_MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_OPACITY = "opacity"
_REST = re.compile(r"f_rest_(0|[1-9][0-9]*)")
_REST_COUNTS = (0, 9, 24, 45)
_REST_COUNT_DEGREE_4 = 72


@dataclass(frozen=True)
class Finding:
    """One thing that lint noticed.

    Attributes:
        id: of the table above, constant across versions.
        count: how many splats, columns, elements or bytes are concerned.
        text: one line, which says what was found and what becomes of it.
        kind: `note`, `repair` or `error`.
        usual: trained scenes are like that: worth a word to who asks for all there is alone.
    """

    id: str
    count: int
    text: str
    kind: Kind
    usual: bool = False

    @property
    def repairable(self) -> bool:
        """Whether reading goes on."""
        return self.kind != "error"

    def __str__(self) -> str:
        return f"{self.kind}: {self.id}: {self.text}"


@dataclass(frozen=True)
class Columns:
    """Which column of a PLY is what. Names are given in the order of the model's last axis.

    Attributes:
        means, scales, quats, sh0: names of the columns; `scales` has two names for discs.
        rest: 3 K names, channel by channel: all of red, all of green, all of blue.
        opacity: name of the column of logits.
        normals: three names, or none.
        extra: everything else.
        double: whether positions have more than float32 holds.
    """

    means: tuple[str, ...]
    scales: tuple[str, ...]
    quats: tuple[str, ...]
    sh0: tuple[str, ...]
    rest: tuple[str, ...]
    opacity: str
    normals: tuple[str, ...]
    extra: tuple[str, ...]
    double: bool


def find_columns(dtype: np.dtype[Any], *, keep_extra: bool = False) -> tuple[Columns | None, list[Finding]]:
    """Tell the columns of a PLY apart, whatever their order.

    Args:
        dtype: structured, one field per scalar property, in the order of the file.
        keep_extra: extra columns will be kept: they are no finding then.

    Returns:
        The columns, `None` where the findings hold an error; and the findings.
    """
    names = dtype.names or ()
    findings: list[Finding] = []
    flat = set(_SCALES) - set(names) == {_SCALES[2]}
    scales = _SCALES[:2] if flat else _SCALES
    if flat:
        findings.append(Finding("flat-scales", 1, "scale_2 is absent: the splats are discs (2DGS)", "note"))
    missing = [name for name in (*_MEANS, *_SH0, _OPACITY, *scales, *_QUATS) if name not in names]
    if missing:
        text = f"no column {', '.join(missing)}: not a PLY of Gaussian splats"
        findings.append(Finding("missing-columns", len(missing), text, "error"))
    rest, problem = _find_rest(names)
    if problem is not None:
        findings.append(problem)
    if not all(finding.repairable for finding in findings):
        return None, findings

    normals = _NORMALS if set(_NORMALS) <= set(names) else ()
    usual = (*_MEANS, *normals, *_SH0, *rest, _OPACITY, *scales, *_QUATS)
    known = set(usual)
    extra = tuple(name for name in names if name not in known)
    if extra and not keep_extra:
        text = f"columns {', '.join(extra)} are no property of splats: dropped"
        findings.append(Finding("extra-columns", len(extra), text, "repair"))
    in_file = tuple(name for name in names if name in known)
    if in_file != usual:
        moved = sum(have != want for have, want in zip(in_file, usual, strict=True))
        text = f"{counted(moved, 'column')} in another place than usual: read by name"
        findings.append(Finding("shuffled-columns", moved, text, "note"))
    double = any(dtype[name].kind != "f" or dtype[name].itemsize > 4 for name in _MEANS)
    columns = Columns(_MEANS, scales, _QUATS, _SH0, rest, _OPACITY, normals, extra, double)
    return columns, findings


def _find_rest(names: Sequence[str]) -> tuple[tuple[str, ...], Finding | None]:
    numbers = sorted(int(match[1]) for name in names if (match := _REST.fullmatch(name)))
    count = len(numbers)
    if numbers != list(range(count)):
        text = f"the {count} f_rest columns are not numbered from 0 to {count - 1}"
        return (), Finding("sh-columns", count, text, "error")
    if count not in _REST_COUNTS:
        degree_4 = ": SH degree 4 is not supported" if count == _REST_COUNT_DEGREE_4 else ""
        text = f"{count} f_rest columns are no SH degree, wanted 0, 9, 24 or 45{degree_4}"
        return (), Finding("sh-columns", count, text, "error")
    return tuple(f"f_rest_{number}" for number in numbers), None


def refuse(findings: Sequence[Finding], *, strict: bool) -> None:
    """Refuse what cannot be repaired, and under `strict` what can.

    Raises:
        InputError: there is an error, or under `strict` a repair; the message names them all.
    """
    wrong = [one for one in findings if one.kind == "error" or (strict and one.kind == "repair")]
    if wrong:
        raise InputError("; ".join(f"{one.id}: {one.text}" for one in wrong))
