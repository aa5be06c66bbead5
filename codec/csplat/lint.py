"""Problems with the columns of a splat PLY and with the values of other formats, and the repairs that are safe.

A finding is one of three things. A *note* is ordinary variation: nothing is lost, nothing looks
different. A *repair* changes or drops something, safely, and is reported; `strict` refuses it. An
*error* cannot be repaired without guessing.

| id | what | kind |
|---|---|---|
| `missing-columns` | a column without which there is no splat | error |
| `sh-columns` | f_rest columns that are no SH degree, or of a higher one than 3, or not numbered from 0 | error |
| `ambiguous-columns` | two columns that other programs would both call the same | error |
| `colour-columns` | red, green and blue that are neither bytes nor 0 to 1 | error |
| `integer-columns` | integers in place of the floats of a splat | error |
| `colour-space` | colours of ml-sharp that are not sRGB | error |
| `truncated` | fewer splats than the header declares | error |
| `malformed` | a row that is no row, or binary rows that a text-mode transfer changed | error |
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
| `alias-columns` | columns that another program named in its own way: `scalar_opacity` of CloudCompare | note |
| `second-columns` | columns that are there once more under the usual name, which is read | note |
| `rgb-colours` | red, green and blue in place of f_dc, read as colours of SH degree 0 | note |
| `filter-3d` | the 3D filter of Mip-Splatting: fused into scales and opacities, or left out | note, repair |
| `sh-bands` | SH bands above those that were asked for: left out | note |
| `vertical-axis` | a comment that names the axis that is up | note |
| `opacities-are-alphas` | opacities that all lie in 0 to 1 or 255, as after the sigmoid; read as logits | note |
| `scales-are-linear` | scales that fit the scene as lengths, not as logarithms; read as logarithms | note |
| `colours-are-rgb` | f_dc that are all in 0 to 1 or in 0 to 255, as colours are; read as SH coefficients | note |
| `half-floats` | columns of 16-bit integers whose bits are those of half floats: read as these | note |
| `sharp-elements` | what ml-sharp writes besides the splats: dropped | note |
| `unusual-header` | a byte order mark, blank lines or capitals in the header | note |
| `unusual-rows` | rows of text with blank lines, decimal commas, NaN of other languages, or in other lines | note |
| `ranks` | checkpoints of gsplat: whether the splats of one GPU or of several are read | note |
| `zip-names` | backslashes or capitals in the names of a SOG's zip or in its list of files | note |
| `other-scenes` | scenes beside the one that is read: of a SOG's zip, or of glTF without a default scene | note |
| `double-means` | positions in doubles or integers: an origin carries what float32 cannot | note |
| `non-ascii-header` | characters outside ASCII in the header: read as question marks | note |
| `zero-rows` | splats of .splat and .ksplat whose bytes are all 0: kept | note |
| `empty` | no splats at all | note |
| `log-scales` | scales that should be standard deviations, most of them negative: read as logarithms | repair |
| `negative-scales` | others below 0: the sign is left out, but where a format forbids it | repair, error |
| `logit-opacities` | opacities that should lie in 0..1, many far outside: read as logits | repair |
| `out-of-range-opacities` | others: clipped, or an error where they lie beyond -1 and 2 | repair, error |
| `linear-colours` | colours in linear light (glTF): fitted to sRGB, by so much off | repair |
| `unclear-scales` | no scale is negative, of a program that wrote logarithms (glTF) | note |
| `spz-axes` | SPZ in glTF along axes that its extension does not name | note |
| `short-buffer` | a buffer of glTF that ends before its length, but not before the splats | note |
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from csplat.errors import InputError, counted
from csplat.model import MAX_SH_DEGREE

FindingKind = Literal["note", "repair", "error"]

_MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_OPACITY = "opacity"
_FILTER = "filter_3D"
_REST = re.compile(r"f_rest_(0|[1-9][0-9]*)")
_ZEROS = re.compile(r"\Af_rest_0+(?=[0-9])")

#: Prefix of CloudCompare's scalar fields (PlyFilter.cpp), and the one that 3dgsconverter, which prepares files for
#: it, before that.
_PREFIXES = re.compile(r"(?:scal(?:ar)?_)+")
#: Colours in place of f_dc, as ns-export of nerfstudio writes them; the other names are the equivalents that three.js'
#: PLYLoader and Brush accept.
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
#: By the type of a colour, the value that is 1.
_COLOUR_RANGES = {"u1": 255.0, "u2": 65535.0, "f4": 1.0, "f8": 1.0}
#: Names of columns that change what is seen, of scenes that are more than splats.
_MEANINGS = {
    re.compile(r"motion_.*|trbf_.*|omega_.*|scale_t|rot_r_\d"): (
        "dynamic (4D) splats: their time is lost, and those of all moments are seen at once"
    ),
    re.compile(r"f_anchor_feat.*|f_offset.*"): "anchors of Scaffold-GS, of which a network makes the splats",
    re.compile(r"sg_(axis|sharpness|color).*"): "colours by spherical Gaussians, which are lost",
}
_NAMED = 6  # columns that a message names
_ADVICE = "csplat train makes splats of its images"


@dataclass(frozen=True)
class Finding:
    """One thing that lint noticed.

    Attributes:
        id: id in the table above, constant across versions.
        count: number of splats, columns, elements or bytes concerned.
        text: one line that states what was found and what becomes of it.
        kind: `note`, `repair` or `error`.
        usual: trained scenes usually have it: reported only to callers that ask for all findings.
    """

    id: str
    count: int
    text: str
    kind: FindingKind
    usual: bool = False

    @property
    def repairable(self) -> bool:
        """True if reading can go on."""
        return self.kind != "error"

    def __str__(self) -> str:
        return f"{self.kind}: {self.id}: {self.text}"


@dataclass(frozen=True)
class ColumnMap:
    """Meaning of the columns of a PLY. Names are given in the order of the model's last axis.

    Attributes:
        means, scales, quats, sh0: names of the columns; `scales` has two names for discs.
        rest: 3 K names, channel by channel: all of red, all of green, all of blue.
        opacity: name of the column of logits.
        normals: three names, or none.
        extra: everything else.
        double: True if positions have more precision than float32 holds.
        colour_range: if `sh0` are red, green and blue, the value that is 1; 0 if they are coefficients.
        filter_3d: name of the column of standard deviations of Mip-Splatting's 3D filter, or "".
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
    colour_range: float = 0.0
    filter_3d: str = ""


def find_columns(
    dtype: np.dtype[Any], *, keep_extra: bool = False, sh_degree: int | None = None, elements: Sequence[str] = ()
) -> tuple[ColumnMap | None, list[Finding]]:
    """Tell the columns of a PLY apart, whatever their order, by their usual names or those of other programs.

    Args:
        dtype: structured, one field per scalar property, in the order of the file.
        keep_extra: extra columns will be kept: they are no finding then.
        sh_degree: highest SH band to read; `None`: all, up to degree 3.
        elements: names of the other elements of the file, for messages.

    Returns:
        The columns, `None` if the findings hold an error; and the findings.
    """
    names = _Names(dtype.names or ())
    findings: list[Finding] = []
    means, quats = names.find(_MEANS), names.find(_QUATS)
    scales, sh0, opacity = names.find(_SCALES), names.find(_SH0), names.find((_OPACITY,))
    flat = [name for name, found in zip(_SCALES, scales, strict=True) if not found] == [_SCALES[2]]
    if flat:
        scales = scales[:2]
        findings.append(Finding("flat-scales", 1, "scale_2 is absent: the splats are discs (2DGS)", "note"))
    colour_range, coefficients = 0.0, sh0
    if not any(sh0):
        colours = next((one for one in _COLOURS if names.has(one)), None)
        if colours is not None:
            sh0 = names.find(colours)
            colour_range, finding = _colour_range(dtype, sh0)
            findings.append(finding)
            coefficients = ()
    wanted = (*_MEANS, *_SH0, _OPACITY, *(_SCALES[:2] if flat else _SCALES), *_QUATS)
    missing = [name for name, found in zip(wanted, (*means, *sh0, *opacity, *scales, *quats), strict=True) if not found]
    if missing:
        findings.append(Finding("missing-columns", len(missing), _absence(names, missing, elements), "error"))
    every, rest, problem = _find_rest(names, sh_degree)
    if problem is not None:
        findings.append(problem)
    if integers := _integers(dtype, (coefficients, rest, opacity, scales, quats)):
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
    extra = tuple(name for name in names.all if name not in known and name != filter_3d)
    if extra and not keep_extra:
        findings.append(dropped_columns(extra))
    in_file = tuple(name for name in names.all if name in known)
    if in_file != usual:
        moved = sum(have != want for have, want in zip(in_file, usual, strict=True))
        text = f"{counted(moved, 'column')} in another place than usual: read by name"
        findings.append(Finding("shuffled-columns", moved, text, "note"))
    double = any(dtype[name].kind != "f" or dtype[name].itemsize > 4 for name in means)
    columns = ColumnMap(
        means, scales, quats, sh0, rest, opacity[0], normals, extra, double, colour_range, filter_3d
    )  # fmt: skip
    return columns, findings


def dropped_columns(names: Sequence[str]) -> Finding:
    """Report the columns that are dropped because splats lack them, and what a scene with them may be."""
    meaning = _meaning(names)
    text = f"columns {', '.join(names)} are no property of splats: dropped"
    text += "" if meaning is None else f"; the file holds {meaning}"
    return Finding("extra-columns", len(names), text, "repair")


class _Names:
    """The names of a file's columns, to be found by what they usually are."""

    def __init__(self, names: Sequence[str]) -> None:
        self.all = tuple(names)
        self.plain: dict[str, list[str]] = {}
        for name in names:
            self.plain.setdefault(plain_name(name), []).append(name)
        self._renamed: dict[str, str] = {}
        self._second: list[str] = []
        self._ambiguous: list[str] = []

    def has(self, wanted: Sequence[str]) -> bool:
        """Return whether there is a column for each name, however it is called."""
        return all(name in self.plain for name in wanted)

    def find(self, wanted: Sequence[str]) -> tuple[str, ...]:
        """Find the column that has each name; else the only one that another program would call so; else ""."""
        return tuple(self._find(name) for name in wanted)

    def _find(self, name: str) -> str:
        found = self.plain.get(name.lower(), [])
        if name in found:
            self._second += [other for other in found if other != name]
            return name
        if len(found) > 1:
            self._ambiguous.append(f"{' and '.join(found)} would both be {name}")
        elif found:
            self._renamed[found[0]] = name
        return found[0] if found else ""

    def findings(self) -> list[Finding]:
        """Return the findings about columns under other names."""
        found = []
        if self._ambiguous:
            text = f"{'; '.join(self._ambiguous[:_NAMED])}: rename one of them"
            found.append(Finding("ambiguous-columns", len(self._ambiguous), text, "error"))
        if self._renamed:
            pairs = _some([f"{name} as {self._renamed[name]}" for name in self.all if name in self._renamed])
            text = f"{counted(len(self._renamed), 'column')} named by another program: {pairs}"
            found.append(Finding("alias-columns", len(self._renamed), text, "note"))
        if self._second:
            text = f"{_some(self._second)}: there once more under the usual name, which is read"
            found.append(Finding("second-columns", len(self._second), text, "note"))
        return found


def _some(words: Sequence[str]) -> str:
    more = len(words) - _NAMED
    return ", ".join(words[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def _colour_range(dtype: np.dtype[Any], colours: Sequence[str]) -> tuple[float, Finding]:
    """Return the value of a colour that is 1, and the finding about it."""
    kinds = {dtype[name].str[1:] for name in colours}
    largest = _COLOUR_RANGES.get(kinds.pop(), 0.0) if len(kinds) == 1 else 0.0
    if not largest:
        shown = ", ".join(dtype[name].name for name in colours)
        text = f"{_named(colours)} are of type {shown}, expected uint8, uint16 or float: export the scene with f_dc"
        return 0.0, Finding("colour-columns", 3, text, "error")
    return largest, colour_finding(colours, largest)


def colour_finding(colours: Sequence[str], largest: float, why: str = "") -> Finding:
    """Report that columns are read as colours, of which a value is 1, and why that one is."""
    steps = "" if largest == 1.0 else f", in steps of 1/{largest:.0f}"
    text = f"{_named(colours)} are read as the colours of SH degree 0{steps}{why}"
    return Finding("rgb-colours", len(colours), text, "note")


def _named(colours: Sequence[str]) -> str:
    return f"{', '.join(colours[:2])} and {colours[2]}"


def _integers(dtype: np.dtype[Any], groups: Sequence[Sequence[str]]) -> Finding | None:
    """Report columns that hold integers, whose meaning is unknown."""
    found = [name for group in groups for name in group if name and dtype[name].kind != "f"]
    if not found:
        return None
    types = " and ".join(sorted({dtype[name].name for name in found}))
    colours = groups[0] and set(groups[0]) == set(found)
    remedy = (
        "call colours of 0 to 255 red, green and blue" if colours else "export the values before they are quantised"
    )
    text = f"{_some(found)} {'is' if len(found) == 1 else 'are'} of type {types}, expected float: {remedy}"
    return Finding("integer-columns", len(found), text, "error")


def float_columns(names: Sequence[str]) -> list[str]:
    """The columns of a PLY that hold numbers of splats other than positions, however they are called."""
    wanted = {*_SH0, *_SCALES, *_QUATS, _OPACITY}
    return [name for name in names if plain_name(name) in wanted or _REST.fullmatch(plain_name(name))]


def plain_name(name: str) -> str:
    """Return a column's name in small letters, without the prefix of another program and zeros before a number."""
    return _ZEROS.sub("f_rest_", _PREFIXES.sub("", name.lower(), count=1))


def _absence(names: _Names, missing: Sequence[str], elements: Sequence[str]) -> str:
    """List the missing columns, and describe what the file seems to be."""
    text = f"no column {', '.join(missing)}: not a PLY of Gaussian splats"
    shown = f"it has {_some(names.all)}" if names.all else "it has no columns"
    if (meaning := _meaning(names.all)) is not None:
        return f"{text}, but {meaning}: export plain splats"
    if {*_SCALES, *_QUATS, _OPACITY} <= set(missing):
        if "face" in elements:
            return f"{text}, but a mesh ({shown}; and faces): {_ADVICE}"
        return f"{text}, but a point cloud ({shown}): {_ADVICE}"
    return f"{text}; {shown}"


def _meaning(names: Sequence[str]) -> str | None:
    plain = [plain_name(name) for name in names]
    found = (meaning for known, meaning in _MEANINGS.items() if any(map(known.fullmatch, plain)))
    return next(found, None)


def _find_rest(names: _Names, sh_degree: int | None) -> tuple[tuple[str, ...], tuple[str, ...], Finding | None]:
    """Return the columns of all bands, the columns of the bands to read, and the finding about them."""
    numbers = sorted(int(match[1]) for name in names.plain if (match := _REST.fullmatch(name)))
    count = len(numbers)
    if numbers != list(range(count)):
        text = f"the {count} f_rest columns are not numbered from 0 to {count - 1}"
        return (), (), Finding("sh-columns", count, text, "error")
    bands = count // 3
    degree = math.isqrt(bands + 1) - 1
    if count % 3 or (degree + 1) ** 2 - 1 != bands:
        wanted = ", ".join(str(3 * (one * one - 1)) for one in range(1, MAX_SH_DEGREE + 1))
        last = 3 * ((MAX_SH_DEGREE + 1) ** 2 - 1)
        text = f"{count} f_rest columns are no SH degree, expected {wanted} or {last}"
        return (), (), Finding("sh-columns", count, text, "error")
    found = names.find([f"f_rest_{number}" for number in numbers])
    kept = degree if sh_degree is None else min(degree, sh_degree)
    if kept > MAX_SH_DEGREE:
        return found, (), Finding("sh-columns", count, f"{count} f_rest columns are {too_many_bands(degree)}", "error")
    if kept == degree:
        return found, found, None
    wanted_bands = (kept + 1) ** 2 - 1
    rest = tuple(found[channel * bands + band] for channel in range(3) for band in range(wanted_bands))
    if degree <= MAX_SH_DEGREE:
        return found, rest, None
    text = f"SH degree {degree}: {'all bands' if kept == 0 else f'bands above {kept}'} are left out, as asked"
    return found, rest, Finding("sh-bands", count - len(rest), text, "note")


def trailing_bytes(count: int) -> list[Finding]:
    """Report the bytes behind the end of a file's content, if there are any: another file may be joined to it."""
    text = f"{counted(count, 'byte')} after the last splat: ignored"
    return [Finding("trailing-bytes", count, text, "repair")] if count > 0 else []


def too_many_bands(degree: int) -> str:
    """Report that a file has more SH bands than a model, and how to read it without them."""
    bands = f"band {degree}" if degree == MAX_SH_DEGREE + 1 else f"bands {MAX_SH_DEGREE + 1} to {degree}"
    return (
        f"SH degree {degree}, expected at most {MAX_SH_DEGREE}: --sh-degree {MAX_SH_DEGREE} of csplat encode, convert,"
        f" finetune, lint and render, or sh_degree={MAX_SH_DEGREE} of csplat.read, leaves {bands} out"
    )


def refuse(findings: Sequence[Finding], *, strict: bool) -> None:
    """Refuse what cannot be repaired, and under `strict` what can.

    Raises:
        InputError: there is an error, or under `strict` a repair; the message names them all.
    """
    wrong = [one for one in findings if one.kind == "error" or (strict and one.kind == "repair")]
    if wrong:
        raise InputError("; ".join(f"{one.id}: {one.text}" for one in wrong))
