"""Draw bytes by attribute as horizontal bars: an SVG that takes the colours of the page, or stands alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from csplat_tools.files.console import format_bytes

# Colours that people tell apart whatever colours they see, on white and on black.
_COLOURS = {
    "opacities": "#88ccee",
    "scales": "#5588bb",
    "quats": "#44aa99",
    "means": "#2f9a55",
    "sh0": "#ddcc77",
    "sh1": "#cc6677",
    "sh2": "#aa4499",
    "sh3": "#9a3a72",
    "overhead": "#8a8a8a",
}
_OTHER = "#bbbbbb"

_WIDTH, _ROW, _BAR = 820, 24, 17  # width of the figure, height of a row and of its bar, pixels
_LETTER, _SIZE = 7.2, 13  # approximate width of a letter, and the font size, pixels
_GAP = 10  # pixels between text and bar

#: Style of an SVG that stands alone: colours of text and background by the reader's light or dark setting.
STANDALONE = (
    "<style>svg{color:#1d2126}.ground{fill:#ffffff}"
    "@media (prefers-color-scheme:dark){svg{color:#e4e8ed}.ground{fill:#14171b}}</style>"
    '<rect class="ground" x="-5%" y="-5%" width="110%" height="110%" fill="#ffffff"/>'
)


@dataclass(frozen=True)
class Bar:
    """A row of the figure.

    Attributes:
        label: text before the bar.
        parts: bytes by attribute, in this order from left to right.
        text: text after the bar.
    """

    label: str
    parts: Mapping[str, int]
    text: str


def draw_bars(bars: Sequence[Bar], *, key: bool, inline: bool = True) -> str:
    """Draw bars below each other, to one scale.

    Args:
        bars: the rows, at least one.
        key: name the colours above the bars, if the labels do not.
        inline: for a page, whose text colour is used; else with a background of its own.
    """
    names = [name for name in _COLOURS if any(bar.parts.get(name) for bar in bars)]
    names += sorted({name for bar in bars for name in bar.parts if bar.parts[name]} - set(names))
    left = _GAP + _LETTER * max(len(bar.label) for bar in bars)
    room = _WIDTH - left - _GAP - _LETTER * max(len(bar.text) for bar in bars)
    scale = room / max(1, *(sum(bar.parts.values()) for bar in bars))
    parts, top = _key(names) if key else ([], 0)
    for bar in bars:
        parts += _row(bar, left, scale, top)
        top += _ROW
    ground = "" if inline else STANDALONE
    mark = "" if inline else ' font-family="sans-serif" color="#1d2126"'
    air = 0 if inline else _GAP
    box = f"{-air} {-air} {_WIDTH + 2 * air} {top + 2 * air}"
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" role="img" font-size="{_SIZE}"'
    return f'{head} fill="currentColor"{mark}>{ground}{"".join(parts)}</svg>'


def attribute_figure(sizes: Mapping[str, int]) -> str:
    """Return a figure for a page with the bytes of each attribute, whose sum is the size of the file."""
    whole = sum(sizes.values())
    bars = [
        Bar(name, {name: size}, f"{format_bytes(size)}, {100.0 * size / whole:.1f} %") for name, size in sizes.items()
    ]
    return f'<figure class="plot"><div class="scroll">{draw_bars(bars, key=False)}</div></figure>'


def _row(bar: Bar, left: float, scale: float, top: float) -> list[str]:
    base = top + _BAR - 4
    parts = [f'<text x="{left - _GAP:.1f}" y="{base}" text-anchor="end">{escape(bar.label)}</text>']
    at = left
    for name, size in bar.parts.items():
        if size:
            width = scale * size
            parts.append(
                f'<rect x="{at:.2f}" y="{top}" width="{width:.2f}" height="{_BAR}" fill="{_COLOURS.get(name, _OTHER)}">'
                f"<title>{escape(f'{bar.label}: {name} {size:,} bytes')}</title></rect>"
            )
            at += width
    return [*parts, f'<text x="{at + _GAP / 2:.1f}" y="{base}">{escape(bar.text)}</text>']


def _key(names: Sequence[str]) -> tuple[list[str], int]:
    """Return coloured squares with their names, in as many lines as they take, and the height of these in pixels."""
    parts, across, top = list[str](), 0.0, 0
    for name in names:
        width = _ROW + _LETTER * len(name) + _GAP
        if across + width > _WIDTH:
            across, top = 0.0, top + _ROW
        parts.append(f'<rect x="{across:.1f}" y="{top}" width="13" height="13" fill="{_COLOURS.get(name, _OTHER)}"/>')
        parts.append(f'<text x="{across + 18:.1f}" y="{top + 11}">{escape(name)}</text>')
        across += width
    return parts, top + _ROW + 4
