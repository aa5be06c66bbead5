# SPDX-License-Identifier: Apache-2.0
"""Reports of a training run: loss plot, preview, memory."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from csplat.disk_files import atomic_writer
from csplat.types import F32, F64

_WINDOW_SHARE = 50  # the moving average spans the run divided by this


def peak_memory() -> int | None:
    """Return the peak memory of this process in bytes; `None` if the system does not report it."""
    if sys.platform == "win32":
        return None
    try:
        import resource
    except ImportError:  # some builds lack it
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(most) if sys.platform == "darwin" else int(most) * 1024


def moving_average(values: Sequence[float], window: int) -> F64:
    """Return for each value the mean of the last `window` values."""
    sums = np.concatenate([[0.0], np.cumsum(np.asarray(values, np.float64))])
    ends = np.arange(1, len(sums))
    starts = np.maximum(ends - window, 0)
    means: F64 = (sums[ends] - sums[starts]) / (ends - starts)
    return means


def plot_loss(path: str | Path, losses: Sequence[float], title: str = "") -> None:
    """Plot the loss of each step, and its moving average, as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    window = max(1, len(losses) // _WINDOW_SHARE)
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    steps = np.arange(1, len(losses) + 1)
    axes.plot(steps, losses, color="0.8", linewidth=0.6, label="each step")
    axes.plot(steps, moving_average(losses, window), color="C0", label=f"mean of the last {window}")
    axes.set(xlabel="iteration", ylabel="loss", yscale="log", title=title)
    axes.grid(visible=True, which="both", alpha=0.2)
    axes.legend()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    with atomic_writer(str(path)) as stream:
        stream.write(buffer.getvalue())


def side_by_side(*images: F32) -> F32:
    """Concatenate images of the same height."""
    return np.concatenate(images, axis=1)


def save_image(path: str | Path, image: F32) -> None:
    """Write an image, [H, W, 3] float in 0..1 (clipped), as a PNG."""
    from PIL import Image

    rounded = np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(rounded).save(buffer, format="png")
    with atomic_writer(str(path)) as stream:
        stream.write(buffer.getvalue())
