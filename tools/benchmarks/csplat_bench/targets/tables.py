"""Tables of what was measured of targets: two builds at equal PSNR, files that others beat, and means."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict

from csplat_bench.common.curves import Point, bytes_between
from csplat_bench.common.report import Table, laid_out

_BUILDS = ("before", "now")
_BYTES_PER_DB = 0.045  # share of the bytes that a decibel costs, if it cannot be taken from two files
_SMALLER, _BETTER = 0.01, 0.1  # share of the bytes, and dB, by which one file beats another
_GUESSED = "≈ "  # before what they say


class File(TypedDict, total=False):
    """A file; or why there is none, and how long that took to find out.

    Attributes:
        psnr: by cameras that no search knows, dB. stated: by the command.
        all_splats: whether every splat of the source was kept.
        machine: the machine that measured it, if not that of the build.
    """

    bytes: int
    splats: int
    psnr: float
    stated: float | None
    seconds: float
    all_splats: bool
    error: str
    machine: str


class Build(TypedDict):
    """The results of one build of the program, by name of the row."""

    machine: str
    rows: dict[str, File]


class Known(TypedDict, total=False):
    """A scene, and by their names what builds made of it."""

    splats: int
    sh_degree: int
    ply_bytes: int
    builds: dict[str, Build]


Rows = Mapping[str, File]
Results = Mapping[str, Known]


@dataclass(frozen=True)
class Ratio:
    """Size relative to files of another build at the same PSNR.

    Attributes:
        value: bytes divided by the other build's.
        guessed: True if one side had no file, so that 4.5 % of the bytes per dB were assumed.
    """

    value: float
    guessed: bool = False


def tables(known: Results, *, markdown: bool) -> str:
    """Everything that is known, as text.

    Args:
        known: by scene.
        markdown: format tables in Markdown.
    """
    parts = [*_bytes_tables(known), *_seconds_tables(known), _means_table(known)]
    return laid_out([*parts, _dominated_table(known), _failed_table(known)], markdown=markdown)


def kind_of(name: str) -> str:
    """Return a row's name without its number: `dB, every splat` for `38 dB, every splat`."""
    return " ".join(word for word in name.split() if not word.replace(".", "", 1).isdigit())


def at_equal_psnr(before: Rows, now: Rows, name: str) -> Ratio | None:
    """Bytes of a row now over those before, at the PSNR that it had before.

    log(bytes) is straight between those rows of the same kind of now that lie on either side of that PSNR.

    Args:
        before, now: rows by name.
        name: name of the row.

    Returns:
        `None` if it was not measured twice.
    """
    if not all(name in dict(_files(rows)) for rows in (before, now)):
        return None
    kind, size, psnr = kind_of(name), before[name]["bytes"], before[name]["psnr"]
    points = [Point(row["psnr"], row["bytes"]) for other, row in _files(now) if kind_of(other) == kind]
    between = bytes_between(points, psnr, gap=math.inf)
    if between is not None:
        return Ratio(between / size)
    near = min(points, key=lambda point: abs(point.psnr - psnr))
    return Ratio(near.size_bytes * math.exp(_BYTES_PER_DB * (psnr - near.psnr)) / size, guessed=True)


def dominated(rows: Rows) -> dict[str, str]:
    """Return files that another one beats by more than 1 % of the bytes and 0.1 dB, each with the smallest that does.

    A file that holds every splat is beaten only by others that do.

    Args:
        rows: rows of a scene and a build, by name.
    """
    found = {}
    for name, row in _files(rows):
        better = [
            other
            for other, one in _files(rows)
            if one["bytes"] < (1.0 - _SMALLER) * row["bytes"]
            and one["psnr"] > row["psnr"] + _BETTER
            and (one["all_splats"] or not row["all_splats"])
        ]
        if better:
            found[name] = min(better, key=lambda other: rows[other]["bytes"])
    return found


def _bytes_tables(known: Results) -> list[Table | str]:
    """Return a table of bytes, PSNRs and ratios for each kind of target, scenes by numbers."""

    def cell(before: Rows, now: Rows, name: str) -> str:
        sizes = " → ".join(_said(rows, name, lambda row: f"{row['bytes'] / 1e3:.1f}") for rows in (before, now))
        ratio = at_equal_psnr(before, now, name)
        share = "" if ratio is None else f", {_GUESSED * ratio.guessed}{ratio.value:.3f}"
        return sizes + _said(now, name, lambda row: f" at {row['psnr']:.2f}", none="") + share

    parts = _by_kind(known, "kB before → now at dB now, and the share of the bytes before at the same dB", cell)
    guessed = any(_GUESSED in str(part.rows) for part in parts)
    by = f"{_GUESSED}by {100.0 * _BYTES_PER_DB:g} % of the bytes per dB: files of now lie on one side only."
    return [*parts, by if guessed else ""]


def _seconds_tables(known: Results) -> list[Table]:
    """The same of seconds."""

    def cell(before: Rows, now: Rows, name: str) -> str:
        return " → ".join(_said(rows, name, lambda row: f"{row['seconds']:.0f}") for rows in (before, now))

    return _by_kind(known, "seconds before → now", cell)


def _by_kind(known: Results, title: str, cell: Callable[[Rows, Rows, str], str]) -> list[Table]:
    """A table for each kind of row that has a number, with a line for each scene."""
    builds = {scene: tuple(_rows(one, build) for build in _BUILDS) for scene, one in known.items()}
    names = dict.fromkeys(name for pair in builds.values() for rows in pair for name in rows)
    parts = []
    for kind in dict.fromkeys(kind_of(name) for name in names if kind_of(name) != name):
        columns = sorted((name for name in names if kind_of(name) == kind), key=_number)
        lines = [
            (scene, *(cell(before, now, name) for name in columns))
            for scene, (before, now) in builds.items()
            if any(name in rows for name in columns for rows in (before, now))
        ]
        parts.append(Table(("scene", *(f"{_number(name):g}" for name in columns)), lines, f"{kind}: {title}"))
    return parts


def _number(name: str) -> float:
    return next(float(word) for word in name.split() if word.replace(".", "", 1).isdigit())


def _said(rows: Rows, name: str, say: Callable[[File], str], *, none: str = "-") -> str:
    """Return a cell about a file; `none` if there is no file."""
    row = dict(_files(rows)).get(name)
    return none if row is None else say(row)


def _means_table(known: Results) -> Table:
    """Geometric means over scenes of what was measured twice, by kind of row."""
    ratios, seconds = dict[str, list[float]](), dict[str, list[tuple[float, float]]]()
    for one in known.values():
        before, now = (_rows(one, build) for build in _BUILDS)
        for name in before:
            ratio = at_equal_psnr(before, now, name)
            if ratio is None:
                continue
            for kind in (kind_of(name), *(["all targets"] if kind_of(name) != name else [])):
                ratios.setdefault(kind, []).append(ratio.value)
                seconds.setdefault(kind, []).append((before[name]["seconds"], now[name]["seconds"]))
    lines = []
    for kind in sorted(ratios, key=lambda kind: kind == "all targets"):
        earlier, later = (_geometric(part) for part in zip(*seconds[kind], strict=True))
        share = f"{_geometric(ratios[kind]):.3f}"
        lines.append((kind, f"{len(ratios[kind])}", share, f"{earlier:.1f}", f"{later:.1f}", f"{later / earlier:.2f}"))
    header = ("geometric means", "files", "bytes, same dB", "s before", "s now", "now of before")
    return Table(header, lines)


def _dominated_table(known: Results) -> Table | str:
    """Results of searches that other files of the same scene and build beat; or that there are none."""
    lines, count = [], 0
    for scene, one in known.items():
        for build in one["builds"]:
            rows = _rows(one, build)
            # Presets look at no picture, and of a share of the splats nothing is left to choose.
            searched = {name for name, _ in _files(rows) if kind_of(name) not in (name, "keep")}
            count += len(searched)
            for name, other in dominated(rows).items():
                if name in searched:
                    lines.append((scene, build, *_beside(name, rows[name]), *_beside(other, rows[other])))
    if count and not lines:
        return f"None of {count} results of searches is beaten by another file of its scene and build."
    header = ("scene", "build", "beaten", "kB", "dB", "by", "kB", "dB")
    return Table(header, lines)


def _failed_table(known: Results) -> Table:
    """Return the table of files that could not be made, and why."""
    lines = [
        (scene, build, name, row["error"])
        for scene, one in known.items()
        for build in one["builds"]
        for name, row in _rows(one, build).items()
        if "error" in row
    ]
    return Table(("scene", "build", "not made", "why"), lines)


def _beside(name: str, row: File) -> tuple[str, str, str]:
    return name, f"{row['bytes'] / 1e3:.1f}", f"{row['psnr']:.2f}"


def _rows(one: Known, build: str) -> Rows:
    return one["builds"][build]["rows"] if build in one["builds"] else {}


def _files(rows: Rows) -> Iterator[tuple[str, File]]:
    """Rows of which there is a file."""
    return ((name, row) for name, row in rows.items() if "error" not in row)


def _geometric(values: Sequence[float]) -> float:
    return math.exp(sum(map(math.log, values)) / len(values))
