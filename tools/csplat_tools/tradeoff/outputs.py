"""Files of a report: the plots, and the page."""

from __future__ import annotations

from collections.abc import Sequence

from csplat_tools.files.pictures import check_folder
from csplat_tools.files.streams import write_bytes
from csplat_tools.tradeoff.page import make_page
from csplat_tools.tradeoff.plots import PLOTS, draw_plot
from csplat_tools.tradeoff.running import Tradeoff

__all__ = ["check_plots", "write_page", "write_plots"]


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
