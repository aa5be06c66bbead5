# SPDX-License-Identifier: Apache-2.0
"""A page that shows images of one view on top of each other, with a border between two of them under a finger."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from csplat.types import U8
from csplat_tools.html_report import data_uri, reduced

_SIDE = 1280  # largest side of an image, pixels


@dataclass(frozen=True, eq=False)
class Panel:
    """An image of a view.

    Attributes:
        title: its name, in a few words.
        remark: what is written below the title.
        picture: data URI.
        size: width and height, pixels.
    """

    title: str
    remark: str
    picture: str
    size: tuple[int, int]

    @classmethod
    def of(cls, title: str, remark: str, pixels: U8) -> Panel:
        """Return the panel of an image [H, W, 3], reduced to the width of the page."""
        pixels = reduced(pixels, _SIDE)
        return cls(title, remark, data_uri(pixels), (pixels.shape[1], pixels.shape[0]))


def is_page(path: str) -> bool:
    """Return True for the name of a page, False for that of a folder."""
    return path.lower().endswith(".html")


def slider_page(title: str, about: str, views: Sequence[Sequence[Panel]]) -> str:
    """Return the page.

    Args:
        title, about: heading, and a paragraph at the end.
        views: images of each view, at least two, of one size.
    """
    return _TEMPLATE % {
        "side": _SIDE,
        "title": escape(title),
        "about": escape(about),
        "views": "".join(_view(panels) for panels in views),
    }


def _view(panels: Sequence[Panel]) -> str:
    """Return the HTML of a view."""
    pictures = "".join(
        f'<img src="{panel.picture}" alt="{escape(panel.title)}" width="{panel.size[0]}" height="{panel.size[1]}"'
        ' draggable="false">\n'
        for panel in panels
    )
    sliders = "".join(
        f'<button role="slider" aria-label="Border between {escape(left.title)} and {escape(right.title)}"'
        ' aria-valuemin="0" aria-valuemax="100"></button>\n'
        for left, right in itertools.pairwise(panels)
    )
    labels = "".join(f"<li><b>{escape(panel.title)}</b><br>{escape(panel.remark)}</li>" for panel in panels)
    return f'<div class="stage">\n{pictures}{sliders}</div>\n<ul>\n{labels}</ul>\n'


_TEMPLATE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>%(title)s</title>
<link rel="icon" href="data:,">
<style>
:root { color-scheme: light dark; font: 16px/1.5 system-ui, sans-serif; }
body { margin: 0 auto; max-width: %(side)dpx; padding: 12px; }
h1 { font-size: 1.3rem; margin: 0 0 8px; overflow-wrap: anywhere; }
.stage { position: relative; overflow: hidden; touch-action: pan-y; cursor: ew-resize; user-select: none; }
.stage img { display: block; width: 100%%; height: auto; position: absolute; top: 0; }
.stage img:first-child { position: static; }
.stage button { position: absolute; top: 0; bottom: 0; width: 44px; margin-left: -22px; padding: 0; border: 0;
  background: linear-gradient(#fff, #fff) center / 2px 100%% no-repeat; cursor: ew-resize; touch-action: pan-y; }
.stage button::after { content: '\\2194'; position: absolute; top: 50%%; left: 6px; width: 32px; line-height: 32px;
  border-radius: 16px; background: #fff; color: #000; font-size: 18px; }
.stage button:focus-visible { outline: 3px solid #4af; outline-offset: -3px; }
ul { display: flex; justify-content: space-between; gap: 8px; list-style: none; padding: 0; margin: 8px 0 20px; }
li { flex: 1; text-align: center; }
li:first-child { text-align: left; }
li:last-child { text-align: right; }
@media (max-width: 600px) { :root { font-size: 14px; } }
p { max-width: 80ch; opacity: .8; }
</style>
<h1>%(title)s</h1>
%(views)s<p>%(about)s</p>
<script>
const STEPS = {
  ArrowLeft: -2, ArrowDown: -2, ArrowRight: 2, ArrowUp: 2, PageDown: -10, PageUp: 10, Home: -100, End: 100,
};
for (const stage of document.querySelectorAll('.stage')) {
  const pictures = [...stage.querySelectorAll('img')].slice(1);
  const sliders = [...stage.querySelectorAll('button')];
  const values = sliders.map((_, i) => (100 * (i + 1)) / (sliders.length + 1));
  function move(i, value) {
    values[i] = Math.min(100, Math.max(0, value));
    for (let k = 0; k < values.length; k++) {
      values[k] = k < i ? Math.min(values[k], values[i]) : Math.max(values[k], values[i]);
    }
    for (const [k, at] of values.entries()) {
      pictures[k].style.clipPath = `inset(0 0 0 ${at}%%)`;
      sliders[k].style.left = `${at}%%`;
      sliders[k].setAttribute('aria-valuenow', Math.round(at));
    }
  }
  const at = ({ clientX }) => (100 * (clientX - stage.getBoundingClientRect().left)) / stage.clientWidth;
  const distance = (i, value) => Math.abs(value - values[i]);
  let dragged = null;
  stage.addEventListener('pointerdown', (event) => {
    const own = sliders.indexOf(event.target);
    const nearest = values.reduce((best, _, i) => (distance(i, at(event)) < distance(best, at(event)) ? i : best), 0);
    dragged = own < 0 ? nearest : own;
    stage.setPointerCapture(event.pointerId);
    sliders[dragged].focus({ focusVisible: false });
    event.preventDefault();
    move(dragged, at(event));
  });
  stage.addEventListener('pointermove', (event) => dragged !== null && move(dragged, at(event)));
  for (const type of ['pointerup', 'pointercancel']) stage.addEventListener(type, () => (dragged = null));
  for (const [i, slider] of sliders.entries()) {
    slider.addEventListener('keydown', (event) => {
      if (!(event.key in STEPS)) return;
      event.preventDefault();
      move(i, values[i] + STEPS[event.key]);
    });
  }
  move(0, values[0]);
}
</script>
</html>
"""
