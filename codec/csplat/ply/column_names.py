# SPDX-License-Identifier: Apache-2.0
"""Find the columns of a splat PLY by their usual names or by the names that other programs give them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from typing import Any

import numpy as np

from csplat import _spec
from csplat.errors import counted
from csplat.lint import Finding, too_many_bands
from csplat.model import MAX_SH_DEGREE

_MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_SCALE = "scale"  # a column of spheres, in place of `_SCALES`
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_OPACITY = "opacity"
_FILTER = "filter_3D"
_REST = re.compile(r"f_rest_(0|[1-9][0-9]*)")
_REST_DIGITS = 9  # digits of its number that are compared; no valid file has a longer number
#: A column of several, `NAME_12`.
_NUMBERED = re.compile(r"(.+)_(0|[1-9][0-9]{0,6})")
_ZEROS = re.compile(r"\Af_rest_0+(?=[0-9])")

#: Prefix of CloudCompare's scalar fields (PlyFilter.cpp), and the second prefix that 3dgsconverter adds to files for
#: CloudCompare.
_PREFIXES = re.compile(r"(?:scal(?:ar)?_)+")
#: Colours in place of f_dc, under the names that nerfstudio's ns-export writes, and three.js' PLYLoader and Brush read.
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
#: The value of white, by type of the column.
_COLOUR_RANGES = {"u1": 255.0, "u2": 65535.0, "f4": 1.0, "f8": 1.0}
#: Columns of scenes that are more than plain splats, with a description for messages.
_MEANINGS = {
    re.compile(r"motion_.*|trbf_.*|omega_.*|scale_t|rot_r_\d"): (
        "dynamic (4D) splats: their time is lost, so the splats of all frames are visible at once"
    ),
    re.compile(r"f_anchor_feat.*|f_offset.*"): "anchors of Scaffold-GS, from which a network generates the splats",
    re.compile(r"sg_(axis|sharpness|color).*"): "colours by spherical Gaussians, which are lost",
}
_NAMED = 6  # maximum number of columns that a message lists
_ADVICE = "csplat train creates splats from its images"


@dataclass(frozen=True)
class ColumnMap:
    """The columns of a PLY by meaning, in the order of the model's last axis.

    Attributes:
        means, scales, quats, sh0: names of the columns; `scales` has two names for discs and a single name for spheres,
            whose `quats` may be empty.
        rest: 3 K names, channel by channel: red, green, blue.
        opacity: name of the column of logits.
        normals: three names, or none.
        extra: all other columns of the file, by the name of the extra column that they form, see `group_columns`.
        double: True if positions have more precision than float32.
        colour_range: the value of white if `sh0` are red, green and blue; 0 if they are coefficients.
        filter_3d: name of the column with the standard deviations of Mip-Splatting's 3D filter; "" if absent.
    """

    means: tuple[str, ...]
    scales: tuple[str, ...]
    quats: tuple[str, ...]
    sh0: tuple[str, ...]
    rest: tuple[str, ...]
    opacity: str
    normals: tuple[str, ...]
    extra: Mapping[str, tuple[str, ...]]
    double: bool
    colour_range: float = 0.0
    filter_3d: str = ""


def find_columns(
    dtype: np.dtype[Any], *, keep_extra: bool = False, sh_degree: int | None = None, elements: Sequence[str] = ()
) -> tuple[ColumnMap | None, list[Finding]]:
    """Find the columns of a PLY, in any order, by their usual names or by the names that other programs give them.

    Args:
        dtype: structured, a field per scalar property, in the order of the file.
        keep_extra: extra columns are kept, so they are not reported.
        sh_degree: highest SH degree to read; `None`: all, up to 4.
        elements: names of the other elements of the file, for messages.

    Returns:
        The columns, or `None` if the findings contain an error; and the findings.
    """
    names = _NameIndex(dtype.names or ())
    findings: list[Finding] = []
    means, quats = names.find(_MEANS), names.find(_QUATS)
    scales, sh0, opacity = names.find(_SCALES), names.find(_SH0), names.find((_OPACITY,))
    flat = [name for name, column in zip(_SCALES, scales, strict=True) if not column] == [_SCALES[2]]
    if flat:
        scales = scales[:2]
        findings.append(Finding("flat-scales", 1, "scale_2 is absent: the splats are discs (2DGS)", "note"))
    sphere = _sphere_column(names, scales)
    if sphere:
        scales = (sphere,)
        text = f"{sphere} is the only scale: all axes of a splat have this size"
        if not any(quats):
            quats, text = (), f"{text}, and no rotation"
        findings.append(Finding("one-scale", 1, text, "note"))
    colour_range, coefficients = 0.0, sh0
    if not any(sh0):
        colours = next((channels for channels in _COLOURS if names.has(channels)), None)
        if colours is not None:
            sh0 = names.find(colours)
            colour_range, finding = _colour_range(dtype, sh0)
            findings.append(finding)
            coefficients = ()
    required = (*_MEANS, *_SH0, _OPACITY, *_SCALES[: len(scales)], *_QUATS[: len(quats)])
    missing = [
        name for name, column in zip(required, (*means, *sh0, *opacity, *scales, *quats), strict=True) if not column
    ]
    if missing:
        findings.append(Finding("missing-columns", len(missing), _describe_absence(names, missing, elements), "error"))
    every, rest, problem = _find_rest(names, sh_degree)
    if problem is not None:
        findings.append(problem)
    if integers := _integer_finding(dtype, (coefficients, rest, opacity, scales, quats)):
        findings.append(integers)
    normals = names.find(_NORMALS) if names.has(_NORMALS) else ()
    filter_3d = names.find((_FILTER,))[0]
    if flat and filter_3d:
        text = f"{filter_3d} is the 3D filter of Mip-Splatting, which is not defined for discs: it is not fused"
        findings.append(Finding("filter-3d", 1, text, "note"))
        filter_3d = ""
    findings += names.findings()
    if not all(finding.repairable for finding in findings):
        return None, findings

    usual = (*means, *normals, *sh0, *every, *opacity, *scales, *quats)
    known = set(usual)
    others = [name for name in names.all if name not in known and name != filter_3d]
    if others and not keep_extra:
        findings.append(dropped_columns(others))
    in_file = tuple(name for name in names.all if name in known)
    if in_file != usual:
        moved = sum(have != want for have, want in zip(in_file, usual, strict=True))
        text = f"{counted(moved, 'column')} not in the usual order: read by name"
        findings.append(Finding("shuffled-columns", moved, text, "note"))
    double = any(dtype[name].kind != "f" or dtype[name].itemsize > 4 for name in means)
    columns = ColumnMap(
        means, scales, quats, sh0, rest, opacity[0], normals, group_columns(dtype, others), double, colour_range,
        filter_3d,
    )  # fmt: skip
    return columns, findings


def group_columns(dtype: np.dtype[Any], names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Group columns of one type with the names `NAME_0`, `NAME_1` and so on into an extra column NAME.

    An extra column has at most `EXTRA_COMPONENTS_MAX` components. The next ones form the column `NAME_64`, and so on.

    Args:
        dtype: structured, a field per column.
        names: the columns to group.

    Returns:
        Names of the columns by the name of the extra column, in the order of the file. `property_names` reverses it.
    """
    groups: dict[str, tuple[str, ...]] = {}
    grouped: set[str] = set()
    types = {name: dtype[name] for name in names}
    most = _spec.EXTRA_COMPONENTS_MAX
    for name in names:
        if name in grouped:
            continue
        match = _NUMBERED.fullmatch(name)
        group: tuple[str, ...] = (name,)
        if match is not None and int(match[2]) % most == 0 and match[1] not in types:
            first = int(match[2])
            run = (f"{match[1]}_{number}" for number in range(first, first + most))
            group = tuple(takewhile(partial(_is_alike, types, name), run))
        key = match[1] if match is not None and len(group) > 1 and match[2] == "0" else name
        groups[key] = group
        grouped.update(group)
    return groups


def _is_alike(types: Mapping[str, np.dtype[Any]], name: str, other: str) -> bool:
    """Return True if two columns exist and have the same type."""
    return other in types and types[name] == types[other]  # a dtype of doubles equals None


def property_names(name: str, components: int) -> list[str]:
    """Return the columns of a PLY that hold an extra column, one for each component."""
    if components == 1:
        return [name]
    match = _NUMBERED.fullmatch(name)
    first = int(match[2]) if match is not None else 0
    if match is not None and first and first % _spec.EXTRA_COMPONENTS_MAX == 0:
        name = match[1]
    else:
        first = 0
    return [f"{name}_{number}" for number in range(first, first + components)]


def _sphere_column(names: _NameIndex, scales: Sequence[str]) -> str:
    """Return the only column of scales, `scale_0` or `scale`; "" if there are several or none."""
    if not any(scales):
        return names.find((_SCALE,))[0]
    return scales[0] if not any(scales[1:]) else ""


def dropped_columns(names: Sequence[str]) -> Finding:
    """Report dropped columns that are not splat attributes, and the kind of scene that they indicate."""
    meaning = _kind_of_columns(names)
    text = f"extra columns {_list_some(names)} are dropped: --keep-extra of csplat encode or keep_extra=True keeps them"
    text += "" if meaning is None else f"; the file contains {meaning}"
    return Finding("extra-columns", len(names), text, "note", lost=(f"extra columns {_list_some(names)}",))


def colour_finding(colours: Sequence[str], largest: float, why: str = "") -> Finding:
    """Report that columns are read as colours, with the value of white and the reason."""
    steps = "" if largest == 1.0 else f", in steps of 1/{largest:.0f}"
    text = f"{_list_colours(colours)} are read as the colours of SH degree 0{steps}{why}"
    return Finding("rgb-colours", len(colours), text, "note")


def float_columns(names: Sequence[str]) -> list[str]:
    """Return the columns of splat attributes other than positions, under any name."""
    attributes = {*_SH0, *_SCALES, *_QUATS, _OPACITY}
    return [name for name in names if plain_name(name) in attributes or _REST.fullmatch(plain_name(name))]


def plain_name(name: str) -> str:
    """Return a column name in lower case without the prefixes of other programs and leading zeros of its number."""
    return _ZEROS.sub("f_rest_", _PREFIXES.sub("", name.lower(), count=1))


class _NameIndex:
    """The columns of a file by their usual names."""

    def __init__(self, names: Sequence[str]) -> None:
        self.all = tuple(names)
        self.plain: dict[str, list[str]] = {}
        for name in names:
            self.plain.setdefault(plain_name(name), []).append(name)
        self._renamed: dict[str, str] = {}
        self._second: list[str] = []
        self._ambiguous: list[str] = []

    def has(self, wanted: Sequence[str]) -> bool:
        """Return True if each usual name has a column, possibly under another name."""
        return all(name in self.plain for name in wanted)

    def find(self, wanted: Sequence[str]) -> tuple[str, ...]:
        """Return the column for each usual name; "" if it is absent.

        If several columns have aliases of the name, the first is returned, and `findings` reports an error.
        """
        return tuple(self._find(name) for name in wanted)

    def _find(self, name: str) -> str:
        """Return a column as `find` does; record aliases, duplicates and ambiguities for `findings`."""
        columns = self.plain.get(name.lower(), [])
        if name in columns:
            self._second += [column for column in columns if column != name]
            return name
        if len(columns) > 1:
            self._ambiguous.append(f"{' and '.join(columns)} would both be {name}")
        elif columns:
            self._renamed[columns[0]] = name
        return columns[0] if columns else ""

    def findings(self) -> list[Finding]:
        """Report columns under other names."""
        findings = []
        if self._ambiguous:
            text = f"{'; '.join(self._ambiguous[:_NAMED])}: rename one of them"
            findings.append(Finding("ambiguous-columns", len(self._ambiguous), text, "error"))
        if self._renamed:
            pairs = _list_some([f"{name} as {self._renamed[name]}" for name in self.all if name in self._renamed])
            text = f"{counted(len(self._renamed), 'column')} named by another program: {pairs}"
            findings.append(Finding("alias-columns", len(self._renamed), text, "note"))
        if self._second:
            text = f"{_list_some(self._second)}: duplicated under the usual name, which is read"
            findings.append(Finding("second-columns", len(self._second), text, "note"))
        return findings


def _list_some(words: Sequence[str]) -> str:
    """Join words for messages; beyond `_NAMED` of them, only their number is stated."""
    more = len(words) - _NAMED
    return ", ".join(words[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def _colour_range(dtype: np.dtype[Any], colours: Sequence[str]) -> tuple[float, Finding]:
    """Return the value of white, and the finding about it."""
    kinds = {dtype[name].str[1:] for name in colours}
    largest = _COLOUR_RANGES.get(kinds.pop(), 0.0) if len(kinds) == 1 else 0.0
    if not largest:
        shown = ", ".join(dtype[name].name for name in colours)
        text = (
            f"{_list_colours(colours)} are of type {shown}, expected uint8, uint16 or float: export the scene with f_dc"
        )
        return 0.0, Finding("colour-columns", 3, text, "error")
    return largest, colour_finding(colours, largest)


def _list_colours(colours: Sequence[str]) -> str:
    """Join the names of three colour columns for messages."""
    return f"{', '.join(colours[:2])} and {colours[2]}"


def _integer_finding(dtype: np.dtype[Any], groups: Sequence[Sequence[str]]) -> Finding | None:
    """Report columns of integers, whose scale is unknown."""
    integers = [name for group in groups for name in group if name and dtype[name].kind != "f"]
    if not integers:
        return None
    types = " and ".join(sorted({dtype[name].name for name in integers}))
    colours = groups[0] and set(groups[0]) == set(integers)
    remedy = "rename colours of 0 to 255 to red, green and blue" if colours else "export the values before quantisation"
    text = f"{_list_some(integers)} {'is' if len(integers) == 1 else 'are'} of type {types}, expected float: {remedy}"
    return Finding("integer-columns", len(integers), text, "error")


def _describe_absence(names: _NameIndex, missing: Sequence[str], elements: Sequence[str]) -> str:
    """Describe missing columns and the probable kind of the file."""
    text = f"no column {', '.join(missing)}: not a PLY of Gaussian splats"
    shown = f"it has {_list_some(names.all)}" if names.all else "it has no columns"
    if (meaning := _kind_of_columns(names.all)) is not None:
        return f"{text}, but {meaning}: export plain splats"
    if {*_SCALES, *_QUATS, _OPACITY} <= set(missing):
        if "face" in elements:
            return f"{text}, but a mesh ({shown}; and faces): {_ADVICE}"
        return f"{text}, but a point cloud ({shown}): {_ADVICE}"
    return f"{text}; {shown}"


def _kind_of_columns(names: Sequence[str]) -> str | None:
    """Return the kind of file that has one of the columns; `None` if it is unknown."""
    plain = [plain_name(name) for name in names]
    return next((meaning for known, meaning in _MEANINGS.items() if any(map(known.fullmatch, plain))), None)


def _find_rest(names: _NameIndex, sh_degree: int | None) -> tuple[tuple[str, ...], tuple[str, ...], Finding | None]:
    """Return the columns of all bands, the columns of the bands to read, and the finding about them."""
    numbers = sorted(int(match[1][:_REST_DIGITS]) for name in names.plain if (match := _REST.fullmatch(name)))
    count = len(numbers)
    if numbers != list(range(count)):
        text = f"the {count} f_rest columns are not numbered from 0 to {count - 1}"
        return (), (), Finding("sh-columns", count, text, "error")
    bands = count // 3
    degree = math.isqrt(bands + 1) - 1
    if count % 3 or (degree + 1) ** 2 - 1 != bands:
        *others, last = (3 * (n * n - 1) for n in range(1, MAX_SH_DEGREE + 2))
        text = f"{count} f_rest columns match no SH degree, expected {', '.join(map(str, others))} or {last}"
        return (), (), Finding("sh-columns", count, text, "error")
    every = names.find([f"f_rest_{number}" for number in numbers])
    kept = degree if sh_degree is None else min(degree, sh_degree)
    if kept > MAX_SH_DEGREE:
        return every, (), Finding("sh-columns", count, f"{count} f_rest columns are {too_many_bands(degree)}", "error")
    if kept == degree:
        return every, every, None
    kept_bands = (kept + 1) ** 2 - 1
    rest = tuple(every[channel * bands + band] for channel in range(3) for band in range(kept_bands))
    if degree <= MAX_SH_DEGREE:
        return every, rest, None
    text = f"SH degree {degree}: {'all bands' if kept == 0 else f'bands above {kept}'} are dropped, as requested"
    return every, rest, Finding("sh-bands", count - len(rest), text, "note")
