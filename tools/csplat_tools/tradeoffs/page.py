"""The report as one page that opens from a disk, and fetches nothing."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from csplat_tools.files.console import format_bytes
from csplat_tools.files.pictures import check_folder
from csplat_tools.files.streams import write_bytes
from csplat_tools.tradeoffs.measuring import DECODE_RUNS
from csplat_tools.tradeoffs.page_parts import SCRIPT, STYLE, policy
from csplat_tools.tradeoffs.plots import PLOTS, draw_plot
from csplat_tools.tradeoffs.points import Point
from csplat_tools.tradeoffs.running import Tradeoff
from csplat_tools.tradeoffs.showing import AMPLIFICATION, as_data_uri
from csplat_tools.tradeoffs.tables import columns_of, mode_rows, partial_rows, views_line

__all__ = ["check_plots", "make_page", "write_page", "write_plots"]

_MOST_SHOWN = 9  # points with pictures: some 100 kB each


def make_page(tradeoff: Tradeoff) -> str:
    """Write the page: plots, tables, pictures, and how everything was measured."""
    title = f"{tradeoff.setting.name}: size, quality and time"
    parts = [
        _head(tradeoff, title),
        _quality(tradeoff),
        _files(tradeoff),
        _pictures(tradeoff),
        _times(tradeoff),
        _bytes(tradeoff),
        _layers(tradeoff),
        _renderer(tradeoff),
        _measured(tradeoff),
    ]
    body = "\n".join(part for part in parts if part)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy()}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="referrer" content="no-referrer">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )


def _head(tradeoff: Tradeoff, title: str) -> str:
    setting = tradeoff.setting
    count = f"{len(setting.source):,} splats, SH degree {setting.source.sh_degree}"
    facts = f"{count}, {format_bytes(setting.source_bytes)} as a PLY; {views_line(tradeoff)}."
    return f'<h1>{escape(title)}</h1>\n<p class="quiet">{escape(facts)}</p>'


def _quality(tradeoff: Tradeoff) -> str:
    text = (
        "Each mark is a file. The dashed line joins those that no other file beats: none is smaller and at least as"
        " good. Left is smaller, up is better; rest the mouse on a mark for its name."
    )
    plots = _figure(tradeoff, "size-quality") + _figure(tradeoff, "size-photographs")
    return f'<h2>Size and quality</h2>\n<p>{text}</p>\n<div class="plots">{plots}</div>'


def _files(tradeoff: Tradeoff) -> str:
    columns = columns_of(tradeoff)
    front = {one.name for one in tradeoff.front}
    heads = '<th scope="col"><button type="button">file</button></th>' + "".join(
        f'<th scope="col" title="{escape(one.hint)}"><button type="button">{escape(one.title)}</button></th>'
        for one in columns
    )
    marks = {point.name: ' class="front"' if point.name in front else "" for point in tradeoff.measured}
    rows = [
        f"<tr{marks[point.name]}><td>{escape(point.name)}</td>"
        + "".join(f'<td data-value="{_value(one.value(point))}">{one.text(point)}</td>' for one in columns)
        + "</tr>"
        for point in tradeoff.measured
    ]
    failures = "".join(
        f"<tr><td>{escape(one.name)}</td><td colspan={len(columns)}>{escape(one.error)}</td></tr>"
        for one in tradeoff.failures
    )
    lost = f"<h3>Not measured</h3>\n<table><tbody>{failures}</tbody></table>" if failures else ""
    return (
        "<h2>Files</h2>\n<p>Those with a coloured ground are on the dashed line. A click on a heading sorts.</p>\n"
        f'<div class="scroll"><table class="sortable"><thead><tr>{heads}</tr></thead>'
        "<tbody>\n" + "\n".join(rows) + f"\n</tbody></table></div>\n{lost}"
    )


def _pictures(tradeoff: Tradeoff) -> str:
    blocks = [_panel(point) for point in shown_points(tradeoff) if point.shown is not None]
    text = (
        f"The worst view of some files: the source, the file, and their difference times {AMPLIFICATION:g}."
        " The pictures are compressed for this page; the numbers are not measured on them."
    )
    return f"<h2>Pictures</h2>\n<p>{text}</p>\n" + "\n".join(blocks) if blocks else ""


def shown_points(tradeoff: Tradeoff) -> list[Point]:
    """The points with pictures: the presets, and others of the front, evenly spread; the smallest file first."""
    presets = [one for one in tradeoff.measured if one.family == "presets"]
    others = [one for one in tradeoff.front if one not in presets]
    room = max(0, _MOST_SHOWN - len(presets))
    if len(others) > room:
        others = [others[place * (len(others) - 1) // max(1, room - 1)] for place in range(room)]
    return sorted({*presets, *others}, key=lambda one: (one.size_bytes, one.name))


def _panel(point: Point) -> str:
    shown = point.shown
    assert shown is not None
    words = {"source": shown.source, "file": shown.decoded, f"difference × {AMPLIFICATION:g}": shown.difference}
    images = "".join(
        f'<figure><img src="{as_data_uri(pixels)}" width="{pixels.shape[1]}" height="{pixels.shape[0]}"'
        f' alt="{escape(f"{point.name}, view {shown.view}: {word}")}"><figcaption>{escape(word)}</figcaption></figure>'
        for word, pixels in words.items()
    )
    facts = f"{format_bytes(point.size_bytes)}, {point.psnr:.2f} dB; view {shown.view}: {shown.psnr:.2f} dB"
    return f'<h3>{escape(point.name)} <span class="quiet">{facts}</span></h3>\n<div class="pictures">{images}</div>'


def _times(tradeoff: Tradeoff) -> str:
    plots = _figure(tradeoff, "size-encode-time", "From the splats to the bytes, with the renders that decide.")
    plots += _figure(tradeoff, "quality-decode-time", "From the bytes in memory to float32 arrays.")
    stages = [
        (point.name, f"{point.encode_seconds:.2f}", ", ".join(f"{k} {v:.2f}" for k, v in point.stages.items()) or "-")
        for point in tradeoff.measured
    ]
    table = _table(("file", "encode s", "stages, as far as they are known, s"), stages)
    details = f'<details><summary>Stages of encoding</summary><div class="scroll">{table}</div></details>'
    return f'<h2>Time</h2>\n<div class="plots">{plots}</div>\n{details}'


def _bytes(tradeoff: Tradeoff) -> str:
    caption = "Codebooks count with their attributes; overhead is header, index, frames and what is said of the file."
    return f"<h2>Where the bytes are</h2>\n{_figure(tradeoff, 'attribute-bytes', caption)}"


def _layers(tradeoff: Tradeoff) -> str:
    rows = partial_rows(tradeoff)
    if len(rows) < 2:
        return ""
    text = (
        "A viewer shows the scene as soon as it has header, index and layer 0, and fetches the bands of spherical"
        " harmonics afterwards, or never. Bytes are those that it has fetched by then."
    )
    table = _table(("file", *rows[0]), rows[1:])
    plot = _figure(tradeoff, "sh-layers")
    return f'<h2>Fewer SH layers</h2>\n<p>{text}</p>\n{plot}\n<div class="scroll">{table}</div>'


def _renderer(tradeoff: Tradeoff) -> str:
    rows = mode_rows(tradeoff)
    text = "Milliseconds for a view, and psnr against the source in mode standard: what a faster renderer loses."
    table = _table(("mode", *rows[0]), rows[1:])
    return f'<h2>Modes of the renderer</h2>\n<p>{text}</p>\n<div class="scroll">{table}</div>'


def _measured(tradeoff: Tradeoff) -> str:
    machine, scores = tradeoff.machine, tradeoff.source_photographs
    facts = {
        "psnr": "of the squared error pooled over views, pixels and channels, against the source's own renders, 99 dB"
        " at most; other cameras or another background give other numbers",
        "times": f"single runs on this machine; decoding is the median of {DECODE_RUNS},"
        " rendering the median over views",
        "views": views_line(tradeoff),
        "background": ", ".join(f"{value:g}" for value in tradeoff.setting.views.judging_background),
        "machine": f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads in use,"
        f" {machine['system']}",
        "versions": f"csplat {machine['csplat']}, format {machine['format']}, Python {machine['python']}, "
        + ", ".join(f"{name} {version}" for name, version in machine["packages"].items()),
    }
    if scores is not None:
        facts["photographs"] = f"{len(scores.each)} that were held out; the source itself scores {scores.psnr:.2f} dB"
    entries = "\n".join(f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>" for key, value in facts.items())
    return f"<h2>How it was measured</h2>\n<dl>\n{entries}\n</dl>"


def _figure(tradeoff: Tradeoff, name: str, caption: str = "") -> str:
    text = draw_plot(name, tradeoff, inline=True)
    if text is None:
        return ""
    words = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure class="plot">{text}{words}</figure>\n'


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    heads = "".join(f'<th scope="col">{escape(one)}</th>' for one in header)
    cells = "\n".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{heads}</tr></thead><tbody>\n{cells}\n</tbody></table>"


def _value(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def check_plots(folder: str | None, *, force: bool) -> None:
    """Make the folder of the plots; refuse if they would replace files.

    Raises:
        InputError: one of them exists.
        OSError: the folder cannot be made.
    """
    if folder is not None:
        check_folder(folder, [_file(name) for name in PLOTS], force=force)


def write_plots(folder: str, tradeoff: Tradeoff) -> Sequence[str]:
    """Write the plots that the sweep has something for, and return their paths."""
    paths = []
    for name in PLOTS:
        text = draw_plot(name, tradeoff, inline=False)
        if text is not None:
            paths.append(f"{folder}/{_file(name)}")
            write_bytes(paths[-1], text.encode())
    return paths


def write_page(path: str, tradeoff: Tradeoff) -> None:
    """Write the report as one page."""
    write_bytes(path, make_page(tradeoff).encode())


def _file(name: str) -> str:
    return f"{name}.svg"
