# SPDX-License-Identifier: Apache-2.0
"""Parts of the HTML reports of commands: style, script, tables, bars, plots and images.

A report is one page that loads nothing else; a policy in it forbids the network.
"""

from __future__ import annotations

import base64
import hashlib
import io
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import quote
from xml.etree import ElementTree as ET

import numpy as np

from csplat.types import F32, F64, U8
from csplat_render.metrics import psnr, squared_error
from csplat_tools.console import format_bytes
from csplat_tools.render_files import side_by_side, to_uint8

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_STYLE = """
:root {
  color-scheme: light dark;
  --text: #1d2126; --quiet: #59636e; --line: #d5dae0; --ground: #ffffff; --raised: #f5f7f9; --accent: #0b62a8;
  --front: #e3f1e9;
  font: 15px/1.5 system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif;
}
@media (prefers-color-scheme: dark) {
  :root {
    --text: #e4e8ed; --quiet: #9aa5b1; --line: #333b45; --ground: #14171b; --raised: #1c2127; --accent: #7cc0ff;
    --front: #1b3328;
  }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--text); }
main { max-width: 1320px; margin: 0 auto; padding: 28px 20px 60px; }
h1 { font-size: 26px; line-height: 1.2; margin: 0 0 6px; overflow-wrap: anywhere; }
h2 { font-size: 19px; margin: 40px 0 6px; }
h3 { font-size: 15px; margin: 22px 0 6px; }
p { margin: 0 0 12px; max-width: 76ch; }
.quiet, figcaption { color: var(--quiet); font-weight: 400; }
figure { margin: 0; min-width: 0; }
figcaption { font-size: 13px; max-width: 76ch; }
.scroll { overflow-x: auto; }
.plot svg { display: block; width: 100%; min-width: 600px; max-width: 820px; height: auto; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 600px), 1fr)); gap: 20px 28px; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 6px; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
.name { text-align: left; position: sticky; left: 0; background: var(--ground); }
.words { text-align: left; white-space: normal; min-width: 13em; }
thead th { color: var(--quiet); font-weight: 600; vertical-align: bottom; white-space: normal; }
thead button { all: unset; cursor: pointer; color: inherit; }
thead button:hover, thead button:focus-visible { color: var(--accent); text-decoration: underline; }
th[aria-sort='ascending'] button::after { content: ' \\25b2'; }
th[aria-sort='descending'] button::after { content: ' \\25bc'; }
tr.front td { background: var(--front); }
code { font: 12.5px/1.5 ui-monospace, 'SF Mono', Consolas, monospace; }
td code { display: block; text-align: left; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(45%, 150px), 1fr)); gap: 6px; }
.pictures img { display: block; width: 100%; height: auto; background: #000; border-radius: 4px; }
dl { display: grid; grid-template-columns: fit-content(28ch) 1fr; gap: 3px 18px; margin: 0; }
@media (max-width: 640px) { dl { grid-template-columns: 1fr; } dd { padding-bottom: 6px; } }
dt { color: var(--quiet); }
dd { margin: 0; overflow-wrap: anywhere; }
"""

_SCRIPT = """
for (const table of document.querySelectorAll('table.sortable')) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => head.querySelector('button')?.addEventListener('click', () => {
    const rising = head.getAttribute('aria-sort') !== 'ascending';
    const key = (row) => row.cells[column].dataset.value;
    const order = (a, b) => {
      const [x, y] = [key(a), key(b)];
      if (x === '' || y === '') return Number(x === '') - Number(y === '');
      const found = head.dataset.kind === 'text' ? x.localeCompare(y) : x - y;
      return rising ? found : -found;
    };
    for (const other of heads) other.removeAttribute('aria-sort');
    head.setAttribute('aria-sort', rising ? 'ascending' : 'descending');
    table.tBodies[0].append(...[...table.tBodies[0].rows].sort(order));
  }));
}
"""


def document(title: str, parts: Sequence[str], summary: str = "") -> str:
    """Return a whole page.

    Args:
        title: title and heading of the page.
        parts: HTML of its body; empty parts are left out.
        summary: a line below the heading.
    """
    head = f"<h1>{escape(title)}</h1>" + (f'\n<p class="quiet">{escape(summary)}</p>' if summary else "")
    body = "\n".join(part for part in (head, *parts) if part)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_policy()}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="referrer" content="no-referrer">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n<script>{_SCRIPT}</script>\n</body>\n</html>\n"
    )


def section(title: str, *parts: str) -> str:
    """Return a heading and the parts below it, or an empty string if all parts are empty."""
    body = "\n".join(part for part in parts if part)
    return f"<h2>{escape(title)}</h2>\n{body}" if body else ""


def paragraph(text: str) -> str:
    """Return a paragraph of plain text."""
    return f"<p>{escape(text)}</p>"


def figure(svg: str) -> str:
    """Return an inline SVG as a figure that scrolls sideways on narrow screens."""
    return f'<figure class="plot"><div class="scroll">{svg}</div></figure>\n'


def table(header: Sequence[str], rows: Sequence[Sequence[str]], words: Collection[int] = ()) -> str:
    """Return a table: names on the left, numbers on the right.

    Args:
        header: titles of the columns.
        rows: their cells.
        words: indices of columns that hold words, in addition to the first.
    """
    kinds = ["words" if place in words else "" if place else "name" for place in range(len(header))]
    marks = [f' class="{kind}"' if kind else "" for kind in kinds]
    heads = "".join(f'<th scope="col"{mark}>{escape(title)}</th>' for mark, title in zip(marks, header, strict=True))
    cells = [
        "<tr>" + "".join(f"<td{mark}>{escape(cell)}</td>" for mark, cell in zip(marks, row, strict=True)) + "</tr>"
        for row in rows
    ]
    return _table(heads, cells)


@dataclass(frozen=True)
class Head:
    """The heading of a column of a `sortable_table`.

    Attributes:
        title: title of the column.
        kind: `number`, `name` or `link`, which a click on the heading sorts; or `html`, which is not sorted.
    """

    title: str
    kind: Literal["number", "name", "link", "html"] = "number"

    def html(self) -> str:
        """Return the cell of the heading."""
        kind = ' class="name" data-kind="text"' if self.kind in ("name", "link") else ""
        title = escape(self.title)
        return f'<th scope="col"{kind}>' + (
            f"{title}</th>" if self.kind == "html" else f'<button type="button">{title}</button></th>'
        )

    def cell(self, content: Any) -> str:
        """Return a cell of the column, see `sortable_table`."""
        if self.kind == "html":
            return f"<td>{content}</td>"
        text, more = content
        if self.kind == "number":
            return f'<td data-value="{"" if more is None else f"{more:.6g}"}">{escape(text)}</td>'
        hint = f' title="{escape(more)}"' if more else ""
        address = quote(text.encode("utf-8", "surrogateescape"), safe="/:")
        shown = f'<a href="{escape(address)}">{escape(text)}</a>' if self.kind == "link" else escape(text)
        return f'<td class="name" data-value="{escape(text)}"{hint}>{shown}</td>'


def sortable_table(heads: Sequence[Head], rows: Sequence[Sequence[Any]], marked: Collection[int] = ()) -> str:
    """Return a table that a click on a heading sorts.

    Args:
        heads: headings of the columns.
        rows: cells by the kind of their column. `number`: (text, value), a value of `None` comes last. `name`: (text,
            text that appears when the mouse rests on it). `link`: the same, with a path, which it leads to. `html`:
            HTML.
        marked: indices of rows with another background.
    """
    lines = [
        ('<tr class="front">' if place in marked else "<tr>")
        + "".join(head.cell(content) for head, content in zip(heads, row, strict=True))
        + "</tr>"
        for place, row in enumerate(rows)
    ]
    return _table("".join(head.html() for head in heads), lines, ' class="sortable"')


def _table(heads: str, rows: Sequence[str], kind: str = "") -> str:
    body = "\n".join(rows)
    return f'<div class="scroll"><table{kind}><thead><tr>{heads}</tr></thead><tbody>\n{body}\n</tbody></table></div>'


def definitions(entries: Mapping[str, str]) -> str:
    """Return a list of terms and their meanings."""
    lines = [f"<dt>{escape(key)}</dt> <dd>{escape(value)}</dd>" for key, value in entries.items()]
    return "<dl>\n" + "\n".join(lines) + "\n</dl>"


def _policy() -> str:
    """Return a Content Security Policy that allows this style, this script, embedded images, and no network."""
    return (
        f"default-src 'none'; script-src '{_hash(_SCRIPT)}'; style-src '{_hash(_STYLE)}'; img-src data:;"
        " connect-src 'none'; base-uri 'none'; form-action 'none'"
    )


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


# Colours that colour-blind readers can tell apart, on white and on black.
_COLOURS = {
    "opacities": "#88ccee",
    "scales": "#5588bb",
    "quats": "#44aa99",
    "means": "#2f9a55",
    "sh0": "#ddcc77",
    "sh1": "#cc6677",
    "sh2": "#aa4499",
    "sh3": "#9a3a72",
    "sh4": "#c79fd6",
    "overhead": "#8a8a8a",
}
_OTHER = "#bbbbbb"

_WIDTH, _ROW, _BAR = 820, 24, 17  # width of the figure, height of a row and of its bar, pixels
_LETTER, _SIZE = 7.2, 13  # approximate width of a letter, and the font size, pixels
_GAP = 10  # pixels between text and bar


def attribute_figure(sizes: Mapping[str, int]) -> str:
    """Return a figure with the bytes of each attribute as bars to one scale. Their sum is the size of the file."""
    whole = sum(sizes.values())
    texts = {name: f"{format_bytes(size)}, {100.0 * size / whole:.1f} %" for name, size in sizes.items()}
    left = _GAP + _LETTER * max(map(len, sizes))
    scale = (_WIDTH - left - _GAP - _LETTER * max(map(len, texts.values()))) / max(1, *sizes.values())
    parts = list[str]()
    for place, (name, size) in enumerate(sizes.items()):
        top, width = place * _ROW, scale * size
        base = top + _BAR - 4
        parts += [
            f'<text x="{left - _GAP:.1f}" y="{base}" text-anchor="end">{escape(name)}</text>',
            f'<rect x="{left:.2f}" y="{top}" width="{width:.2f}" height="{_BAR}" fill="{_COLOURS.get(name, _OTHER)}"/>',
            f'<text x="{left + width + _GAP / 2:.1f}" y="{base}">{escape(texts[name])}</text>',
        ]
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_ROW * len(sizes)}" role="img"'
    return figure(f'{head} font-size="{_SIZE}" fill="currentColor">{"".join(parts)}</svg>')


#: Placeholder for the colour of text until the SVG is written: no other colour is exactly this.
INK = "#123457"

_SVG = "{http://www.w3.org/2000/svg}"
_XLINK = "{http://www.w3.org/1999/xlink}"
# Older versions of matplotlib write font sizes in `font`, which is not an attribute of SVG.
_FONT = re.compile(r"^(?:\S+\s+)*?(?P<size>[0-9.]+px)\s")
_SETTINGS: dict[Any, Any] = {  # matplotlib's types list every key
    "svg.fonttype": "none",
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.labelcolor": INK,
    "legend.framealpha": 0.0,
    "legend.edgecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.alpha": 0.25,
    "grid.color": INK,
    "font.size": 11.0,
}


def draw_svg(draw: Callable[[Figure], None], size: tuple[float, float], name: str) -> str:
    """Draw a figure for a page, in its text colour.

    Args:
        draw: called with an empty figure.
        size: width and height, inches.
        name: name of the plot: ids inside begin with it, so that several plots can share a page.

    Returns:
        The SVG, the same for the same figure and version of matplotlib.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with mpl.rc_context({**_SETTINGS, "svg.hashsalt": name}):
        canvas = Figure(figsize=size, layout="constrained")
        FigureCanvasSVG(canvas)
        draw(canvas)
        buffer = io.StringIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        canvas.savefig(buffer, format="svg", metadata=nothing, transparent=True)
    root = ET.fromstring(buffer.getvalue())  # noqa: S314 -- matplotlib has just written it
    _make_embeddable(root, name)
    return ET.tostring(root, encoding="unicode").replace(INK, "currentColor")


def _make_embeddable(root: ET.Element, name: str) -> None:
    """Turn styles into attributes, and prefix ids with the plot's name, so that several plots can share a page.

    Changes the SVG in place: it loses its namespaces, style elements, width and height, and gets the role of an image.

    Args:
        root: the `svg` element as matplotlib writes it.
        name: name of the plot, unique in the page.
    """
    for element in list(root.iter()):
        element.tag = element.tag.removeprefix(_SVG)
        for child in list(element):
            if child.tag == f"{_SVG}style":
                element.remove(child)
        attributes = {**_parse_style(element.attrib.pop("style", "")), **element.attrib}
        element.attrib.clear()
        for key, value in attributes.items():
            plain = "href" if key == f"{_XLINK}href" else key
            element.set(plain, _prefix_ids(plain, value, name))
    del root.attrib["height"], root.attrib["width"]
    # The content of matplotlib's own style element, for this SVG alone.
    root.set("stroke-linejoin", "round")
    root.set("stroke-linecap", "butt")
    root.set("role", "img")
    root.set("xmlns", _SVG.strip("{}"))


def _prefix_ids(key: str, value: str, name: str) -> str:
    """Return an attribute's value with the plot's name before an id, which it defines or refers to."""
    if key == "id":
        return f"{name}-{value}"
    if key == "href":
        return value.replace("#", f"#{name}-", 1)
    return value.replace("url(#", f"url(#{name}-")


def _parse_style(style: str) -> dict[str, str]:
    """Parse `fill: none; stroke: red` into attributes; of fonts only the size, since the page sets the family."""
    attributes: dict[str, str] = {}
    for part in style.split(";"):
        key, _, value = (piece.strip() for piece in part.partition(":"))
        if key == "font":
            match = _FONT.match(value + " ")
            if match is not None:
                attributes["font-size"] = match["size"]
        elif key and key != "font-family":
            attributes[key] = value
    return attributes


_AMPLIFICATION = 10.0  # factor of the differences that are shown

#: Description of the images of `piece_images`, for the page.
IMAGES_NOTE = (
    "The piece of a view with the largest error: its place, the source, the file, and their difference times"
    f" {_AMPLIFICATION:g}. Images are compressed for this page; scores are not measured on them."
)

_SHARE = 4  # width and height of a view, divided by the piece's
_SIDE = 480  # largest side of an image, pixels; larger images would make pages of tens of megabytes
_WEBP = {"quality": 94, "method": 4}


@dataclass(frozen=True, eq=False)
class ImagePiece:
    """A piece of a view.

    Attributes:
        view: number of the view.
        psnr: PSNR of the piece, dB.
        where: [h, w, 3] uint8, the whole view of the source, with a frame around the piece.
        source, decoded, difference: [h, w, 3] uint8, the piece; the difference is amplified.
    """

    view: int
    psnr: float
    where: U8
    source: U8
    decoded: U8
    difference: U8


class HardestPlaceSearch:
    """A search through views for the place where a file differs most from its source."""

    def __init__(self) -> None:
        self._error = -1.0
        self._place: tuple[int, slice, slice, F32, F32] | None = None

    def examine(self, number: int, source: F32, decoded: F32) -> None:
        """Examine the view of this number. Both renders are [H, W, 3] in 0..1."""
        errors: F64 = np.asarray(squared_error(source, decoded).sum(axis=2), np.float64)
        height, width = (max(1, side // _SHARE) for side in errors.shape)
        sums = _window_sums(errors, height, width) / (height * width)
        top, left = np.unravel_index(int(np.argmax(sums)), sums.shape)
        if sums[top, left] > self._error:
            self._error = float(sums[top, left])
            rows, columns = slice(int(top), int(top) + height), slice(int(left), int(left) + width)
            self._place = (number, rows, columns, source, decoded)

    def found(self) -> ImagePiece | None:
        """Return the piece, with images reduced to a size for a page, or `None` if no view was examined."""
        if self._place is None:
            return None
        number, rows, columns, source, decoded = self._place
        a, b = source[rows, columns], decoded[rows, columns]
        pieces = [reduced(image) for image in np.split(side_by_side(a, b, _AMPLIFICATION), 3, axis=1)]
        return ImagePiece(number, float(psnr(a, b)), _framed(source, rows, columns), *pieces)


def piece_images(place: ImagePiece, name: str) -> str:
    """Return HTML that shows a piece side by side in the source and in the file of this name."""
    words = {
        f"view {place.view}": place.where,
        "source": place.source,
        f"file, here {place.psnr:.1f} dB": place.decoded,
        f"difference × {_AMPLIFICATION:g}": place.difference,
    }
    return image_row(words, name)


def image_row(images: Mapping[str, U8], name: str) -> str:
    """Return HTML that shows images side by side, reduced to a size for a page.

    Args:
        images: [h, w, 3] uint8, by caption.
        name: name of the subject, for the alternative text.
    """
    figures = ""
    for word, pixels in images.items():
        small = reduced(pixels)
        figures += (
            f'<figure><img src="{data_uri(small)}" width="{small.shape[1]}" height="{small.shape[0]}"'
            f' alt="{escape(f"{name}: {word}")}"><figcaption>{escape(word)}</figcaption></figure>'
        )
    return f'<div class="pictures">{figures}</div>'


def _window_sums(values: F64, height: int, width: int) -> F64:
    """Return the sums over all windows of this size, [H − height + 1, W − width + 1]."""
    total = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    np.cumsum(np.cumsum(values, axis=0), axis=1, out=total[1:, 1:])
    sums: F64 = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    return sums


def _framed(image: F32, rows: slice, columns: slice) -> U8:
    """Return the whole view, [H, W, 3] in 0..1, reduced, with a frame that is visible on any background.

    The frame runs inside the edge of the piece at `rows` and `columns`, which are in pixels of the view.
    """
    shown = reduced(to_uint8(image)).copy()
    factor = shown.shape[0] / image.shape[0]
    top, bottom, left, right = (round(factor * edge) for edge in (rows.start, rows.stop, columns.start, columns.stop))
    for inset, value in enumerate((0, 255, 0)):  # black, white and black lines of one pixel, from outside
        line = np.zeros(shown.shape[:2], bool)
        line[top + inset : bottom - inset, left + inset : right - inset] = True
        line[top + inset + 1 : bottom - inset - 1, left + inset + 1 : right - inset - 1] = False
        shown[line] = value
    return shown


def data_uri(pixels: U8) -> str:
    """Return an image [H, W, 3] as a data URI for an `img` element: WebP, or PNG if pillow was built without it."""
    from PIL import Image, features

    kind, options = ("WEBP", _WEBP) if features.check("webp") else ("PNG", {})
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, kind, **options)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def reduced(pixels: U8, side: int = _SIDE) -> U8:
    """Return an image, [H, W, 3], with sides of at most `side` pixels in the same proportion; unchanged if smaller."""
    from PIL import Image

    height, width = pixels.shape[:2]
    factor = side / max(width, height)
    if factor >= 1.0:
        return np.ascontiguousarray(pixels)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(Image.fromarray(np.ascontiguousarray(pixels)).resize(size, Image.Resampling.LANCZOS))
