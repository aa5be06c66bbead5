"""Figures as files: the same results give the same bytes."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

from csplat.disk_files import atomic_writer

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure, its size in inches of 100 pixels, without a window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_svg(figure: Figure, path: Path) -> Path:
    """Write an SVG that depends on nothing but what it shows."""
    from matplotlib import rc_context

    buffer = io.BytesIO()
    with rc_context({"svg.hashsalt": path.stem}):
        figure.savefig(buffer, format="svg", dpi=100, metadata={"Date": None})
    with atomic_writer(path) as stream:
        stream.write(b"\n".join(line.rstrip() for line in buffer.getvalue().split(b"\n")))
    return path
