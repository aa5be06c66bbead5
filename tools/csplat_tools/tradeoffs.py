# SPDX-License-Identifier: Apache-2.0
"""Measure size, quality and time of many encodings of a scene, for a table, JSON, and an HTML page with plots.

A *grid* lists settings of `csplat encode`, as in `presets,precision=36:44,targets=38:1MB,simplify=0.5`. Files of other
formats, as `csplat convert` writes them, are measured alike.
"""

from __future__ import annotations

import re
import shlex
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from itertools import cycle
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from csplat import formats
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import decode
from csplat.disk_files import temporary_folder
from csplat.editing.transform import DEFAULT_AXES, axes_rotation, rotate_scene, rotation_to_axes
from csplat.encode_api import encode_with_report
from csplat.encoder import PRESETS, EncodeOptions, PresetName, Target
from csplat.errors import CsplatError, InputError
from csplat.model import SplatModel
from csplat.scene import Scene
from csplat.types import Progress, null_progress
from csplat_tools import html_report as html
from csplat_tools.console import NUMBER, format_bytes, format_table
from csplat_tools.file_streams import STANDARD_STREAM
from csplat_tools.html_report import INK, draw_svg
from csplat_tools.inspect.comparison import compare
from csplat_tools.optional_packages import describe_machine, require_renderer
from csplat_tools.scene_files import SceneLike, load_scene, read_source, scene_sizes, with_first_view
from csplat_tools.views import ViewSet, describe_views, find_view_set

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Groups of a grid, quick groups first, and their values if none are given.
GROUPS = {
    "presets": ":".join(PRESETS),
    "precision": "32:36:40:44:48:56",  # `--attribute-psnr`, dB
    "targets": "36:40:44",  # `--target-psnr`, dB, or `--target-size`
    "simplify": "0.7:0.5:0.3",  # `--keep`, fractions of the splats
}
_SEARCH = 50.0  # time with a target / time without: 70 to 140 s and 0.8 s for the sample scene, on two busy cores
_DECODE_RUNS = 3  # timed runs, of which the median is reported


@dataclass(frozen=True)
class GridSetting:
    """A way to encode a scene, or to write it in another format.

    Attributes:
        group: one of `GROUPS`, or the name of another format.
        value: the value in this group, as in a grid; the preset of another format, "" if it is the usual one.
        options, target: arguments of `csplat.encode_with_report`; of another format, only the preset counts.
        words: the same as options of `csplat encode`, or of `csplat convert`.
    """

    group: str
    value: str
    options: EncodeOptions
    target: Target | None
    words: tuple[str, ...]

    @property
    def name(self) -> str:
        """The grid that has this setting alone, `precision=44`; or a format with its preset, `spz` or `spz=small`."""
        return f"{self.group}={self.value}" if self.value else self.group

    @property
    def is_other_format(self) -> bool:
        """True if the file is not a .csplat file."""
        return self.group not in GROUPS


def parse_grid(text: str = ",".join(GROUPS), preset: PresetName = "balanced") -> list[GridSetting]:
    """Parse a grid: groups separated by commas, their values after `=`, separated by colons.

    Args:
        text: the grid. A group without values has the values of `GROUPS`.
        preset: preset of all settings outside the group `presets`.

    Examples:
        >>> import csplat_tools
        >>> [setting.name for setting in csplat_tools.parse_grid("precision=36:44,targets=1MB")]
        ['precision=36', 'precision=44', 'targets=1MB']

    Raises:
        InputError: a group is unknown, or a value is invalid.
    """
    settings = dict[str, GridSetting]()
    for part in text.split(","):
        group, _, values = (piece.strip() for piece in part.partition("="))
        if group not in GROUPS:
            raise InputError(f"{group!r} is not a group of settings, expected some of {', '.join(GROUPS)}")
        for value in (values or GROUPS[group]).split(":"):
            setting = _parse_setting(group, value.strip(), EncodeOptions(preset=preset))
            settings.setdefault(setting.name, setting)
    return list(settings.values())


def _parse_setting(group: str, value: str, options: EncodeOptions) -> GridSetting:
    """Return the setting of a value in a group; `targets` takes a PSNR in dB, or a size with a unit such as `1MB`.

    Raises:
        InputError: the value is invalid for the group.
    """
    if group == "presets":
        options = replace(options, preset=cast(PresetName, value))  # the options refuse other values
        return GridSetting(group, value, options, None, ("--preset", value))
    target: Target | None = None
    if group == "targets" and not re.fullmatch(NUMBER, value):
        option, target = "--target-size", Target(size=value)
    elif not re.fullmatch(NUMBER, value):
        raise InputError(f"{value!r} is not a number, expected numbers separated by colons")
    elif group == "precision":
        option, options = "--attribute-psnr", replace(options, attribute_psnr=float(value))
    elif group == "targets":
        option, target = "--target-psnr", Target(psnr=float(value))
    else:
        option, target = "--keep", Target(keep=float(value))
    return GridSetting(group, value, options, target, (option, value, "--preset", options.preset))


def parse_formats(text: str) -> list[GridSetting]:
    """Parse names of other formats, separated by commas, into settings: each format with all its presets.

    Examples:
        >>> import csplat_tools
        >>> [setting.name for setting in csplat_tools.parse_formats("spz,sog")]
        ['spz', 'spz=small', 'sog']

    Raises:
        InputError: csplat does not both read and write a format of that name, or it holds csplat.
    """
    known = {one.name: one for one in formats.formats() if one.open and one.write and "csplat" not in one.name}
    settings = dict[str, GridSetting]()
    for name in (part.strip() for part in text.split(",")):
        if name not in known:
            raise InputError(f"{name!r} is not another format, expected some of {', '.join(known)}")
        settings[name] = GridSetting(name, "", EncodeOptions(), None, ())
        for preset in known[name].presets:
            setting = GridSetting(name, preset, EncodeOptions(cast(PresetName, preset)), None, ("--preset", preset))
            settings[setting.name] = setting
    return list(settings.values())


@dataclass(frozen=True)
class TradeoffRow:
    """The measurements of one file.

    Attributes:
        setting: how it was encoded.
        command: the command that makes the same file.
        size_bytes: its size.
        ratio: size of the source divided by the size of the file.
        splats: number of splats in the file.
        psnr, ssim: against the source's renders: PSNR pooled over all test views, dB; and mean SSIM.
        images: scores of the source (`a`) and of the file (`b`) against the images of a data set, as in
            `Comparison`; `None` without a data set.
        encode_seconds: time from the splats to the bytes, with all renders of a search.
        decode_seconds: time from the bytes to the splats.
    """

    setting: GridSetting
    command: str
    size_bytes: int
    ratio: float
    splats: int
    psnr: float
    ssim: float | None
    images: dict[str, Any] | None
    encode_seconds: float
    decode_seconds: float

    @property
    def image_psnr(self) -> float | None:
        """PSNR against the images, dB."""
        return None if self.images is None else self.images["b"]["psnr"]

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        values = {name: value for name, value in vars(self).items() if name not in ("setting", "images")}
        return {"name": self.setting.name, **values, "images": self.images}


@dataclass(frozen=True, eq=False)
class Tradeoff:
    """The measurements of a grid.

    Attributes:
        source: the scene.
        views: its views; all files are scored on the same test views.
        rows: a row for each file, the smallest first.
        failures: by name of a setting, the error due to which there is no file.
        machine: processor, system and versions.
    """

    source: Scene
    views: ViewSet
    rows: Sequence[TradeoffRow]
    failures: dict[str, str]
    machine: dict[str, Any] = field(default_factory=describe_machine)

    @property
    def front(self) -> list[TradeoffRow]:
        """The Pareto front: rows for which no other file is smaller and at least as good by `psnr`."""
        front = list[TradeoffRow]()
        for row in sorted(self.rows, key=lambda row: (row.size_bytes, -row.psnr)):
            if not front or row.psnr > front[-1].psnr:
                front.append(row)
        return front

    @property
    def source_image_psnr(self) -> float | None:
        """The source's PSNR against the images, dB; `None` without images."""
        scores = self.rows[0].images
        return None if scores is None else scores["a"]["psnr"]

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {
            "scene": {"name": self.source.name, **scene_sizes(self.source)},
            "views": {"cameras": self.views.name, "count": len(self.views.test)},
            "machine": self.machine,
            "pareto": [row.setting.name for row in self.front],
            "points": [row.as_json() for row in self.rows],
            "failed": self.failures,
        }


def tradeoff(
    scene: SceneLike,
    grid: Sequence[GridSetting] | None = None,
    *,
    views: ViewSet | None = None,
    path: str = "scene.ply",
    view_words: Sequence[str] = (),
    say: Callable[[str], None] | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> Tradeoff:
    """Encode a scene with each setting of a grid, and measure the files, as `csplat tradeoff` does.

    Takes minutes with targets.

    Args:
        scene: a model, or a file in any format but .csplat.
        grid: the settings, see `parse_grid` and `parse_formats`; `None`: all groups.
        views: the views that targets use, and test views for the scores; `None`: virtual views.
        path: path of the scene in commands.
        view_words: options of `csplat encode` that give the same views, for commands.
        say: called with a line for each setting.
        context: threads, seed and progress.

    Examples:
        >>> import csplat_tools
        >>> grid = csplat_tools.parse_grid("presets") + csplat_tools.parse_formats("spz,sog")
        >>> measured = csplat_tools.tradeoff("scene.ply", grid)  # doctest: +SKIP
        >>> [(row.setting.name, row.size_bytes, row.psnr) for row in measured.front]  # doctest: +SKIP

    Raises:
        InputError: the scene has no splats, or no file could be made and measured.
        CsplatError: the scene is not valid.
        OSError: the scene cannot be read.
    """
    require_renderer()
    source = load_scene(scene) if isinstance(scene, (SplatModel, Scene)) else read_source(scene)
    if not source.count:
        raise InputError("the scene has no splats")
    around = views or find_view_set(source.model(), seed=context.seed)
    viewed = with_first_view(source).model()  # as `csplat encode` writes it

    def measure(setting: GridSetting) -> TradeoffRow:
        """Write a file with a setting, read it, and score it."""
        if setting.is_other_format:
            made = _write_other_format(source, setting)
        else:
            made = _encode(viewed, setting, around if setting.target else None, context)
        compared = compare(source, made.model, views=around, source_index=made.source_index, context=context)
        command = "convert" if setting.is_other_format else "encode"
        words = (command, path, _suggested_name(path, setting), *setting.words, *(view_words if setting.target else ()))
        return TradeoffRow(
            setting, shlex.join(("csplat", *words)), made.size_bytes, source.size_bytes / made.size_bytes,
            len(made.model), compared.psnr, compared.ssim, compared.images, made.encode_seconds, made.decode_seconds,
        )  # fmt: skip

    rows, failures = measure_grid(parse_grid() if grid is None else grid, measure, say, context.progress)
    return Tradeoff(source, around, rows, failures, describe_machine(context))


def measure_grid(
    grid: Sequence[GridSetting],
    measure: Callable[[GridSetting], TradeoffRow],
    say: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> tuple[list[TradeoffRow], dict[str, str]]:
    """Measure each setting. A setting that fails does not stop the others.

    Returns:
        The rows, the smallest file first, and errors by the name of the setting.

    Raises:
        InputError: all settings failed.
    """
    rows, failures = list[TradeoffRow](), dict[str, str]()
    costs = [_SEARCH if setting.target else 1.0 for setting in grid]
    for number, setting in enumerate(grid):
        (progress or null_progress)("all settings", sum(costs[:number]) / sum(costs))
        try:
            row = measure(setting)
        except (CsplatError, MemoryError) as error:
            failures[setting.name] = line = " ".join(str(error).split()) or "out of memory"
        else:
            rows.append(row)
            line = f"{format_bytes(row.size_bytes)}, {row.psnr:.2f} dB, {row.encode_seconds:.1f} s"
        if say is not None:
            say(f"{number + 1}/{len(grid)} {setting.name}: {line}")
    if not rows:
        raise InputError(
            "; ".join(["nothing could be measured", *(f"{name}: {reason}" for name, reason in failures.items())])
        )
    return sorted(rows, key=lambda row: row.size_bytes), failures


class _MadeFile(NamedTuple):
    """The size of a file, the splats read from it, their indices in the source, and times as in `TradeoffRow`."""

    size_bytes: int
    model: SplatModel
    source_index: NDArray[np.intp] | None
    encode_seconds: float
    decode_seconds: float


def _encode(model: SplatModel, setting: GridSetting, views: ViewSet | None, context: Context) -> _MadeFile:
    """Encode a model, and decode the file."""
    start = time.perf_counter()
    made = encode_with_report(model, setting.options, target=setting.target, views=views, context=context)
    seconds = time.perf_counter() - start
    decoded, decode_seconds = _time_reading(lambda: decode(made.data, context=context))
    return _MadeFile(len(made.data), decoded, made.source_index, seconds, decode_seconds)


def _write_other_format(source: Scene, setting: GridSetting) -> _MadeFile:
    """Write a scene in another format, and read the file, on the axes and at the origin of the scene."""
    other = formats.format_by_name(setting.group)
    with temporary_folder() as folder:
        file, start = folder / f"scene{other.suffixes[0]}", time.perf_counter()
        formats.write_levels(file, [source], other.name, setting.options.preset)
        seconds, size = time.perf_counter() - start, file.stat().st_size
        model, decode_seconds = _time_reading(lambda: formats.read(file, other.name))
    if other.axes:
        turn = axes_rotation(other.axes, DEFAULT_AXES) @ rotation_to_axes(source.metadata, other.axes)
        model = rotate_scene(model, turn.T)
    if "origin" not in other.carries:
        model = replace(model, origin=source.origin)
    return _MadeFile(size, model, None, seconds, decode_seconds)


def _time_reading(read: Callable[[], SplatModel]) -> tuple[SplatModel, float]:
    """Return the splats that are read, and the median of the times of `_DECODE_RUNS` runs in seconds."""
    seconds = list[float]()
    model: SplatModel | None = None
    for _ in range(_DECODE_RUNS):
        start = time.perf_counter()
        model = read()
        seconds.append(time.perf_counter() - start)
    assert model is not None  # there is at least one run
    return model, statistics.median(seconds)


def _suggested_name(path: str, setting: GridSetting) -> str:
    """Return the name of the file that the command of a setting writes, by the source's name and the setting."""
    stem = "scene" if path == STANDARD_STREAM else PurePath(path).stem
    suffix = formats.format_by_name(setting.group).suffixes[0] if setting.is_other_format else ".csplat"
    return "-".join([stem, setting.group, *([setting.value] if setting.value else [])]) + suffix


# Columns of the table: title, meaning, attribute of the row, and format.
_COLUMNS = (
    ("bytes", "Size of the file.", "size_bytes", ",d"),
    ("smaller", "Size of the source divided by the size of the file.", "ratio", ".1f"),
    ("PSNR", "Similarity of renders of the file and the source, dB. At 30 dB a difference is visible, at 40 dB hardly.",
     "psnr", ".2f"),
    ("SSIM", "Structural similarity, 1 at best: mean over the views.", "ssim", ".4f"),
    ("image PSNR", "PSNR against the test images of the data set, dB.", "image_psnr", ".2f"),
    ("splats", "Number of splats in the file.", "splats", ",d"),
    ("encode s", "Seconds from the splats to the bytes, with the renders of a search.", "encode_seconds", ".2f"),
    ("decode s", f"Seconds from the bytes to the splats, median of {_DECODE_RUNS} runs.", "decode_seconds", ".3f"),
)  # fmt: skip


def _columns(tradeoff: Tradeoff) -> list[tuple[str, str, str, str]]:
    """Return the columns that have values."""
    return [column for column in _COLUMNS if all(getattr(row, column[2]) is not None for row in tradeoff.rows)]


def format_tradeoff(tradeoff: Tradeoff) -> str:
    """Return the table as text."""
    columns, front = _columns(tradeoff), tradeoff.front
    rows = list[Sequence[str]]()
    for row in tradeoff.rows:
        mark = "*" if row in front else " "
        rows.append((f"{mark} {row.setting.name}", *(f"{getattr(row, key):{how}}" for *_, key, how in columns)))
    table = format_table(("  setting", *(title for title, *_ in columns)), rows)
    lines = ["* no other file is smaller and at least as good, by PSNR"]
    lines += [f"not measured: {name}: {error}" for name, error in tradeoff.failures.items()]
    return "\n".join((_summary(tradeoff), "", table, *lines))


def _summary(tradeoff: Tradeoff) -> str:
    """Return a line on the source: name, splats, size, views, and its PSNR against images if there are any."""
    source, views = tradeoff.source, tradeoff.views
    text = (
        f"{source.name}: {len(source.model()):,} splats, SH degree {source.model().sh_degree},"
        f" {format_bytes(source.size_bytes)}; scored on {describe_views(len(views.test), views.name)}"
    )
    psnr = tradeoff.source_image_psnr
    return text if psnr is None else f"{text}; the source itself has {psnr:.2f} dB against the images"


def make_tradeoff_page(tradeoff: Tradeoff) -> str:
    """Return the HTML report: plots, the table with commands, and the conditions of the measurement."""
    columns, front, machine = _columns(tradeoff), tradeoff.front, tradeoff.machine
    heads = [html.Head("setting", kind="name"), *(html.Head(title) for title, *_ in columns)]
    heads.append(html.Head("command", kind="html"))
    rows = [
        [
            (row.setting.name, ""),
            *((f"{getattr(row, key):{how}}", getattr(row, key)) for *_, key, how in columns),
            f"<code>{escape(row.command)}</code>",
        ]
        for row in tradeoff.rows
    ]
    plots = [_plot(tradeoff, "psnr", "PSNR against the source's renders, dB")]
    if tradeoff.source_image_psnr is not None:
        plots.append(_plot(tradeoff, "image_psnr", "PSNR against the images, dB", tradeoff.source_image_psnr))
    plots.append(_plot(tradeoff, _SECONDS, "seconds to encode"))
    failures = html.table(("setting", "error"), list(tradeoff.failures.items()), words=(1,))
    terms = {title: meaning for title, meaning, *_ in columns}
    terms["machine"] = (
        f"{machine['processor']}, {machine['cores']} cores, {machine['system']}; csplat {machine['csplat']}, Python"
        f" {machine['python']}, numpy {machine['packages']['numpy']}."
    )
    return html.document(
        f"{tradeoff.source.name}: size, quality and time",
        [
            html.paragraph(
                "Each mark is a file. Left is smaller; up is better, or slower. Files on the dashed line are the best"
                " choices by PSNR: no other file is smaller and at least as good."
            ),
            f'<div class="plots">{"".join(map(html.figure, plots))}</div>',
            html.section(
                "Files",
                html.paragraph(
                    "Coloured rows are on the dashed line. A click on a heading sorts. Each command makes the bytes"
                    " that were measured, if it is run in the same folder as this measurement."
                ),
                html.sortable_table(heads, rows, [place for place, row in enumerate(tradeoff.rows) if row in front]),
            ),
            html.section("Not measured", failures) if tradeoff.failures else "",
            html.section("Measurement", html.definitions(terms)),
        ],
        _summary(tradeoff),
    )


_SECONDS = "encode_seconds"  # the attribute with a logarithmic axis
_MARK_RADIUS = 4.0  # half the side of the square that a mark takes, pixels
_SIZE = (7.0, 4.4)  # width and height of a plot, inches
_STYLES = {  # markers, in colours that colour-blind readers can tell apart, on white and on black
    "presets": ("s", "#d55e00"),
    "precision": ("o", "#2f83c9"),
    "targets": ("D", "#e69f00"),
    "simplify": ("v", "#009e73"),
}
_OTHER_STYLES = (("^", "#cc79a7"), ("P", "#7a5cc4"), ("X", "#8c6d46"), ("*", "#3aa6b9"))  # other formats, in turn
# Places of a label: the offset from its mark in points, and its alignment; the first free place is taken.
_PLACES = tuple(
    (distance * x, distance * y, {-1: "right", 0: "center", 1: "left"}[x], {-1: "top", 0: "center", 1: "bottom"}[y])
    for distance in (5, 10, 20)
    for x, y in ((-1, 1), (1, -1), (0, 1), (0, -1), (-1, 0), (1, 0), (1, 1), (-1, -1))
)


def _plot(tradeoff: Tradeoff, key: str, label: str, level: float | None = None) -> str:
    """Return a plot of an attribute of the rows by their size, as SVG.

    Args:
        tradeoff: the rows; the last has the largest file, which determines the unit of sizes.
        key: name of the attribute. `psnr` has a dashed line through the best files, `_SECONDS` a logarithmic axis.
        label: label of the axis.
        level: level of the source, for a dotted line; `None`: no line.
    """
    unit, divisor = ("MB", 1e6) if tradeoff.rows[-1].size_bytes >= 1e6 else ("kB", 1e3)

    def marks(rows: Sequence[TradeoffRow]) -> list[tuple[float, float]]:
        """Return the size, in the plot's unit, and the attribute of each row."""
        return [(row.size_bytes / divisor, getattr(row, key)) for row in rows]

    def draw(figure: Figure) -> None:
        """Draw the marks of each group, lines, legend and labels."""
        axes = figure.add_subplot()
        axes.set(xlabel=f"size, {unit}", ylabel=label, xscale="log", yscale="log" if key == _SECONDS else "linear")
        axes.margins(0.1)
        if key == "psnr":
            axes.plot(*zip(*marks(tradeoff.front), strict=True), "--", color=INK, linewidth=1)
        if level is not None:
            axes.axhline(level, color=INK, linewidth=1, linestyle=":", label="the source")
        others = dict.fromkeys(row.setting.group for row in tradeoff.rows if row.setting.is_other_format)
        for group, (marker, colour) in {**_STYLES, **dict(zip(others, cycle(_OTHER_STYLES), strict=False))}.items():
            rows = [row for row in tradeoff.rows if row.setting.group == group]
            if rows:
                axes.plot(*zip(*marks(rows), strict=True), marker, color=colour, label=group, zorder=3)
        for axis in (axes.xaxis, axes.yaxis):
            _use_plain_ticks(axis)
        figure.legend(loc="outside upper left", ncols=5, fontsize="small")
        figure.draw_without_rendering()  # fixes the limits of the axes
        settings = [row.setting for row in tradeoff.rows]
        _label_marks(axes, marks(tradeoff.rows), [one.name if one.is_other_format else one.value for one in settings])

    return draw_svg(draw, _SIZE, key)


def _use_plain_ticks(axis: Any) -> None:
    """Write plain numbers on a logarithmic axis; leave a linear axis as it is."""
    from matplotlib.ticker import LogLocator, NullLocator

    if axis.get_scale() == "log":
        axis.set_major_locator(LogLocator(10.0, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())


def _label_marks(axes: Axes, marks: Sequence[tuple[float, float]], texts: Sequence[str]) -> None:
    """Write a label next to each mark, at the first of `_PLACES` where it covers neither marks nor other labels.

    If there is no such place, it is written at the last. The limits of the axes must be final.

    Args:
        axes: the axes.
        marks: coordinates of the marks, in the units of the data.
        texts: the label of each mark.
    """
    from matplotlib.transforms import Bbox

    centres = axes.transData.transform(marks)
    taken = [Bbox([centre - _MARK_RADIUS, centre + _MARK_RADIUS]) for centre in centres]
    for mark, text in zip(marks, texts, strict=True):
        label = axes.annotate(text, mark, (0.0, 0.0), textcoords="offset points", fontsize="small")
        label.set_in_layout(False)
        for x, y, across, up in _PLACES:
            label.set(position=(x, y), ha=across, va=up)
            if not label.get_window_extent().count_overlaps(taken):
                break
        taken.append(label.get_window_extent())
