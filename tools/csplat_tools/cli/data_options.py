"""Options of a data set, which several commands have in common."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat_tools.cli.parsing import parse_size
from csplat_tools.views import SPLITS, DataOptions

__all__ = ["Images", "Near", "Size", "Split", "TestEvery", "data_options"]

_PANEL = "Photographs of --data (by default as the scene was trained)"

Size = Annotated[str | None, typer.Option(metavar="WxH", rich_help_panel=_PANEL, help="Scale them to this size.")]
Images = Annotated[
    str | None, typer.Option(metavar="NAME", rich_help_panel=_PANEL, help="COLMAP: folder of pictures, images_4.")
]
TestEvery = Annotated[
    int | None, typer.Option(metavar="N", rich_help_panel=_PANEL, help="Every Nth was held out; 8 if nothing says it.")
]
Near = Annotated[float | None, typer.Option(metavar="UNITS", rich_help_panel=_PANEL, help="Their near plane.")]
Split = Annotated[str, typer.Option(metavar="|".join(SPLITS), rich_help_panel=_PANEL, help="Which of them.")]


def data_options(
    data: str | None,
    size: str | None,
    images: str | None,
    test_every: int | None,
    near: float | None = None,
    split: str = SPLITS[0],
) -> DataOptions | None:
    """What the options say; `None` without a data set.

    Raises:
        typer.BadParameter: there is none, but options for one; or they cannot be.
    """
    if split not in SPLITS:
        raise typer.BadParameter(f"the split is {split!r}, wanted one of {', '.join(SPLITS)}")
    pixels = None if size is None else parse_size(size)
    if data is not None:
        return DataOptions(data, pixels, images, test_every, near)
    if (size, images, test_every, near, split) != (None, None, None, None, SPLITS[0]):
        raise typer.BadParameter("--size, --images, --test-every, --near and --split are for the photographs of --data")
    return None
