"""Draw plots as SVG without style attributes, which a page's policy forbids, and reproducible bit for bit."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET

from csplat_tools.pages.bars import STANDALONE

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Placeholder for the colour of text until the SVG is written: no other colour is exactly this.
INK = "#123457"

_SVG = "{http://www.w3.org/2000/svg}"
_XLINK = "{http://www.w3.org/1999/xlink}"
_BLACK = "#1d2126"  # colour of text for readers that do not support styles
# `font` is no attribute of SVG; older versions of matplotlib write sizes so.
_FONT = re.compile(r"^(?:\S+\s+)*?(?P<size>[0-9.]+px)\s")
_SETTINGS: dict[Any, Any] = {  # matplotlib's types name every key there is
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
    "text.parse_math": False,  # names of points may hold any character
}


def hover(plot: str, name: str) -> str:
    """Return the id of a point's mark in a plot: `point-` and hexadecimal digits, whatever the names contain."""
    return f"point-{hashlib.sha256(f'{plot}/{name}'.encode()).hexdigest()[:12]}"


def drawn(
    draw: Callable[[Figure], None],
    size: tuple[float, float],
    name: str,
    *,
    inline: bool,
    titles: Mapping[str, str] | None = None,
) -> str:
    """Draw a figure.

    Args:
        draw: called with an empty figure.
        size: width and height, inches.
        name: name of the plot: ids inside begin with it, so that several plots can share a page.
        inline: for a page, whose text colour lines and letters take; else with an XML prologue and a background, light
            or dark by the reader's setting.
        titles: texts that appear when the mouse rests on a mark, by its id.

    Returns:
        The SVG, the same for the same figure and version of matplotlib.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with mpl.rc_context({**_SETTINGS, "svg.hashsalt": name}):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure)
        buffer = io.StringIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(buffer, format="svg", metadata=nothing, transparent=True)
    root = ET.fromstring(buffer.getvalue())  # noqa: S314 -- matplotlib has just written it
    _clean(root, name, titles or {})
    if inline:
        root.attrib.pop("height", None)
        root.attrib.pop("width", None)
        return _text(root)
    root.set("font-family", "sans-serif")
    root.set("color", _BLACK)
    for place, child in enumerate(ET.fromstring(f"<g>{STANDALONE}</g>")):  # noqa: S314 -- our own text
        root.insert(place, child)
    return f'<?xml version="1.0" encoding="utf-8"?>\n{_text(root)}\n'


def _text(root: ET.Element) -> str:
    return ET.tostring(root, encoding="unicode").replace(INK, "currentColor")


def _clean(root: ET.Element, name: str, titles: Mapping[str, str]) -> None:
    """Turn styles into attributes, prefix ids with the plot's name, and add the titles of points."""
    for element in list(root.iter()):
        element.tag = element.tag.removeprefix(_SVG)
        for child in list(element):
            if child.tag == f"{_SVG}style":
                element.remove(child)
        attributes = {**_as_attributes(element.attrib.pop("style", "")), **element.attrib}
        element.attrib.clear()
        for key, value in attributes.items():
            plain = "href" if key == f"{_XLINK}href" else key
            element.set(plain, _own_id(plain, value, name, titles))
        title = titles.get(element.get("id", ""))
        if title is not None:
            label = ET.Element("title")
            label.text = title
            element.insert(0, label)
    # The content of matplotlib's own style element, for this SVG alone.
    root.set("stroke-linejoin", "round")
    root.set("stroke-linecap", "butt")
    root.set("role", "img")
    root.set("xmlns", _SVG.strip("{}"))


def _own_id(key: str, value: str, name: str, titles: Mapping[str, str]) -> str:
    if key == "id" and value not in titles:
        return f"{name}-{value}"
    if key == "href":
        return value.replace("#", f"#{name}-", 1)
    return value.replace("url(#", f"url(#{name}-")


def _as_attributes(style: str) -> dict[str, str]:
    """Parse `fill: none; stroke: red` into attributes; the font is left to the page."""
    found: dict[str, str] = {}
    for part in style.split(";"):
        key, _, value = (piece.strip() for piece in part.partition(":"))
        if key == "font":
            match = _FONT.match(value + " ")
            if match is not None:
                found["font-size"] = match["size"]
        elif key and key != "font-family":
            found[key] = value
    return found
