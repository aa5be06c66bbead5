"""A scene at the end of a notebook's cell: the viewer's page in a frame, with the scene inside, turned with the mouse.

The page of `csplat export-html` is the text of the frame (`srcdoc`): it stands in the saved notebook, and no server is
needed. The frame is a sandbox: what runs in it does not reach the notebook.
"""

from __future__ import annotations

import html

import numpy as np

from csplat.encoder import EncodeOptions, encode
from csplat.model import SplatModel
from csplat_render.cloud import surface_areas, visible_opacity
from csplat_render.standing import seeming_up
from csplat_tools.present.export import export_page
from csplat_tools.present.viewing import seeming_wishes

__all__ = ["MOST_SPLATS", "most_visible", "scene_html"]

#: A frame shows no more: some 9 bytes each, a third more as text, are kept with the notebook.
MOST_SPLATS = 250_000

_HEIGHT = 480  # pixels


def scene_html(model: SplatModel, *, most_splats: int = MOST_SPLATS) -> str:
    """HTML that shows a scene, and how much of it.

    Args:
        model: the scene, of one splat at least.
        most_splats: of a larger scene those are shown that cover most, and a line says so.

    Returns:
        A frame of all the width there is; the scene is coded by the preset `fast`. Self-contained: nothing is loaded
        from elsewhere.

    Raises:
        InputError: values that no lattice can hold, or the installation is not complete.
    """
    shown = most_visible(model, most_splats)
    wishes = seeming_wishes(seeming_up(shown))
    page = export_page(encode(shown, EncodeOptions(preset="fast")), "scene", wishes).page.decode()
    frame = (
        f'<iframe srcdoc="{html.escape(page)}" sandbox="allow-scripts" title="{html.escape(repr(model))}"'
        f' style="width: 100%; height: {_HEIGHT}px; border: 0"></iframe>'
    )
    if len(shown) == len(model):
        return frame
    return f"{frame}\n<div><small>{len(shown):,} of {len(model):,} splats, those that cover most</small></div>"


def most_visible(model: SplatModel, count: int) -> SplatModel:
    """The splats that cover most, by opacity × area, in their order; all of them where there are no more."""
    if len(model) <= count:
        return model
    covered = visible_opacity(model) * surface_areas(model)
    return model.select(np.sort(np.argsort(-covered, kind="stable")[:count]))
