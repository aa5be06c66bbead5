"""The HTML report of a sweep, as one page that opens from a disk and loads nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from csplat_tools.console import format_bytes
from csplat_tools.file_streams import write_bytes
from csplat_tools.hardest_place import IMAGES_NOTE, piece_images
from csplat_tools.html_report import command_line, copy_button, definitions, document, table
from csplat_tools.render_files import make_output_folder
from csplat_tools.tradeoffs.sweep_points import DECODE_RUNS, SweepPoint
from csplat_tools.tradeoffs.sweep_run import Tradeoff
from csplat_tools.tradeoffs.tradeoff_plots import PLOTS, draw_plot
from csplat_tools.tradeoffs.tradeoff_tables import columns_of, mode_rows, partial_rows, views_line
from csplat_tools.views import VIRTUAL

_MOST_SHOWN = 9  # largest number of points with images, some 60 kB each
_FRONT = ' class="front"'


def make_tradeoff_page(tradeoff: Tradeoff) -> str:
    """Return the page: plots, tables, commands, images, and the conditions of measurement."""
    title = f"{tradeoff.setting.name}: size, quality and time"
    parts = [
        _head(tradeoff, title),
        _quality(tradeoff),
        _files(tradeoff),
        _renders(tradeoff),
        _times(tradeoff),
        _bytes(tradeoff),
        _layers(tradeoff),
        _renderer(tradeoff),
        _measured(tradeoff),
    ]
    return document(title, parts)


def _head(tradeoff: Tradeoff, title: str) -> str:
    setting = tradeoff.setting
    count = f"{len(setting.source):,} splats, SH degree {setting.source.sh_degree}"
    facts = f"{count}, {format_bytes(setting.source_bytes)} in the file; {views_line(tradeoff)}."
    return f'<h1>{escape(title)}</h1>\n<p class="quiet">{escape(facts)}</p>'


def _quality(tradeoff: Tradeoff) -> str:
    text = (
        "Each mark is a file, with its name or its number in the table below. Left is smaller, up is better. The dashed"
        " line joins the files to choose from: none of the others is smaller and at least as good."
    )
    plots = _figure(tradeoff, "size-quality") + _figure(tradeoff, "size-photographs")
    return f'<h2>Size and quality</h2>\n<p>{text}</p>\n<div class="plots">{plots}</div>'


def _files(tradeoff: Tradeoff) -> str:
    columns = columns_of(tradeoff)
    front = {one.name for one in tradeoff.front}
    heads = (
        f'<th scope="col" class="name" data-kind="text">{_sorting("file")}</th><th scope="col">{_sorting("no.")}</th>'
        '<th scope="col" title="The command that makes the file.">run</th>'
    ) + "".join(f'<th scope="col" title="{escape(one.hint)}">{_sorting(one.title)}</th>' for one in columns)
    rows = [
        f"<tr{_FRONT if point.name in front else ''}>"
        f'<td class="name" data-value="{escape(point.name)}">{escape(point.name)}</td>'
        f'<td data-value="{number}">{number}</td><td>{copy_button(f"command-{number}", point.command)}</td>'
        + "".join(f'<td data-value="{_value(one.value(point))}">{one.text(point)}</td>' for one in columns)
        + "</tr>"
        for number, point in enumerate(tradeoff.measured, 1)
    ]
    legend = definitions({one.title: one.hint for one in columns}, "legend")
    failures = [(one.name, one.error) for one in tradeoff.failures]
    lost = f"<h3>Not measured</h3>\n{table(('file', 'why'), failures, words=(1,))}" if failures else ""
    return (
        "<h2>Files</h2>\n<p>Those with a coloured ground are on the dashed line. A click on a heading sorts; copy takes"
        " the command that makes the file.</p>\n"
        f'<div class="scroll"><table class="sortable"><thead><tr>{heads}</tr></thead>'
        "<tbody>\n" + "\n".join(rows) + f"\n</tbody></table></div>\n{legend}\n{_commands(tradeoff)}\n{lost}"
    )


def _sorting(title: str) -> str:
    return f'<button type="button">{escape(title)}</button>'


def _commands(tradeoff: Tradeoff) -> str:
    """Return all commands as text, for readers without scripts."""
    text = (
        "Each makes the same bytes as were measured here, run where the report was made. Those that begin with python"
        " are no commands of csplat; they want a Python that has csplat."
    )
    entries = "\n".join(
        f"<div>{number} {escape(point.name)} {copy_button(f'command-{number}', point.command)}<br>"
        f"{command_line(f'command-{number}', point.command)}</div>"
        for number, point in enumerate(tradeoff.measured, 1)
    )
    return f'<details class="commands"><summary>All commands</summary>\n<p>{text}</p>\n{entries}\n</details>'


def _renders(tradeoff: Tradeoff) -> str:
    blocks = []
    for number, point in enumerate(tradeoff.measured, 1):
        if point.hardest is not None and point in shown_points(tradeoff):
            facts = f"{format_bytes(point.size_bytes)}, {point.psnr:.2f} dB"
            head = f'<h3>{number} {escape(point.name)} <span class="quiet">{facts}</span></h3>'
            blocks.append(f"{head}\n{piece_images(point.hardest, point.name)}")
    virtual = tradeoff.setting.views.name == VIRTUAL
    text = f"The presets, and files of the dashed line. {IMAGES_NOTE}" + (
        " The views are chosen because they show the scene well; they need not be test views." if virtual else ""
    )
    return f"<h2>The hardest places</h2>\n<p>{text}</p>\n" + "\n".join(blocks) if blocks else ""


def shown_points(tradeoff: Tradeoff) -> list[SweepPoint]:
    """Return the points with images: the presets, and others of the front, evenly spread; the smallest file first."""
    presets = [one for one in tradeoff.measured if one.family == "presets"]
    others = [one for one in tradeoff.front if one not in presets]
    room = max(0, _MOST_SHOWN - len(presets))
    if len(others) > room:
        others = [others[place * (len(others) - 1) // max(1, room - 1)] for place in range(room)]
    return sorted({*presets, *others}, key=lambda one: (one.size_bytes, one.name))


def _times(tradeoff: Tradeoff) -> str:
    plots = _figure(tradeoff, "size-encode-time", "From the splats to the bytes, including renders for decisions.")
    plots += _figure(tradeoff, "quality-decode-time", "From the bytes in memory to float32 arrays.")
    stages = [
        (point.name, f"{point.encode_seconds:.2f}", ", ".join(f"{k} {v:.2f}" for k, v in point.stages.items()) or "-")
        for point in tradeoff.measured
    ]
    rows = table(("file", "encode s", "stages, as far as they are known, s"), stages, words=(2,))
    details = f"<details><summary>Stages of encoding</summary>{rows}</details>"
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
    plot = _figure(tradeoff, "sh-layers")
    return f"<h2>Fewer SH layers</h2>\n<p>{text}</p>\n{plot}\n{table(('file', *rows[0]), rows[1:])}"


def _renderer(tradeoff: Tradeoff) -> str:
    rows = mode_rows(tradeoff)
    text = "Milliseconds for a view, and PSNR against the source in mode standard: what a faster renderer loses."
    return f"<h2>Modes of the renderer</h2>\n<p>{text}</p>\n{table(('mode', *rows[0]), rows[1:])}"


def _measured(tradeoff: Tradeoff) -> str:
    machine, scores = tradeoff.machine, tradeoff.source_image_scores
    facts = {
        "PSNR": "of the squared error pooled over views, pixels and channels, against the source's own renders, 99 dB"
        " at most; other cameras or another background give other numbers",
        "times": f"single runs on this machine; decoding is the median of {DECODE_RUNS},"
        " rendering the median over views",
        "views": views_line(tradeoff),
        "background": ", ".join(f"{value:g}" for value in tradeoff.setting.views.test_background),
        "machine": f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads in use,"
        f" {machine['system']}",
        "versions": f"csplat {machine['csplat']}, format {machine['format']}, Python {machine['python']}, "
        + ", ".join(f"{name} {version}" for name, version in machine["packages"].items()),
    }
    if scores is not None:
        facts["photographs"] = f"{len(scores.each)} that were held out; the source itself scores {scores.psnr:.2f} dB"
    return f"<h2>How it was measured</h2>\n{definitions(facts)}"


def _figure(tradeoff: Tradeoff, name: str, caption: str = "") -> str:
    text = draw_plot(name, tradeoff, inline=True)
    if text is None:
        return ""
    words = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure class="plot"><div class="scroll">{text}</div>{words}</figure>\n'


def _value(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def check_plots(folder: str | None, *, force: bool) -> None:
    """Make the folder of the plots; refuse if they would replace files.

    Raises:
        InputError: one of the files exists.
        OSError: the folder cannot be made.
    """
    if folder is not None:
        make_output_folder(folder, [_file(name) for name in PLOTS], force=force)


def write_plots(folder: str, tradeoff: Tradeoff) -> Sequence[str]:
    """Write the plots for which the sweep has data, and return their paths."""
    paths = []
    for name in PLOTS:
        text = draw_plot(name, tradeoff, inline=False)
        if text is not None:
            paths.append(f"{folder}/{_file(name)}")
            write_bytes(paths[-1], text.encode())
    return paths


def write_tradeoff_page(path: str, tradeoff: Tradeoff) -> None:
    """Write the report as one page."""
    write_bytes(path, make_tradeoff_page(tradeoff).encode())


def _file(name: str) -> str:
    return f"{name}.svg"
