# SPDX-License-Identifier: Apache-2.0
"""Show a scene in a notebook: the page of `csplat export-html` in a frame.

The page is the text of the frame (`srcdoc`), so that it is saved with the notebook and needs no server. The frame is a
sandbox: its scripts cannot access the notebook. This is a module of its own because an entry point names it.
"""

from __future__ import annotations

import html

import numpy as np

from csplat.encode_api import encode_with_report
from csplat.encoder import EncodeOptions
from csplat.model import SplatModel
from csplat_render.first_view import viewing_metadata
from csplat_render.scene_frame import surface_areas, visible_opacity
from csplat_tools.present.viewer_page import export_page

#: Largest number of splats in a frame; each adds about 12 bytes to the notebook.
MOST_SPLATS = 250_000

_HEIGHT = 480  # height of the frame, pixels


def scene_html(model: SplatModel, *, most_splats: int = MOST_SPLATS) -> str:
    """Return HTML that shows a scene, or the most visible part of a large one.

    Args:
        model: the scene, of at least one splat.
        most_splats: of a larger scene, only this many splats that cover most are shown, with a note.

    Returns:
        A frame of the full width with the scene, encoded by the preset `fast`. It loads nothing else.

    Raises:
        InputError: the scene cannot be encoded, or the installation is incomplete.
    """
    shown = most_visible(model, most_splats)
    made = encode_with_report(shown.with_metadata(viewing_metadata(shown)), EncodeOptions(preset="fast"))
    page = export_page(made.data, "scene").page.decode()
    frame = (
        f'<iframe srcdoc="{html.escape(page)}" sandbox="allow-scripts" title="{html.escape(repr(model))}"'
        f' style="width: 100%; height: {_HEIGHT}px; border: 0"></iframe>'
    )
    if len(shown) == len(model):
        return frame
    return f"{frame}\n<div><small>{len(shown):,} of {len(model):,} splats, the most visible ones</small></div>"


def most_visible(model: SplatModel, count: int) -> SplatModel:
    """Return the `count` splats with the largest opacity × area, in their order; all if there are fewer."""
    if len(model) <= count:
        return model
    covered = visible_opacity(model) * surface_areas(model)
    return model.select(np.sort(np.argsort(-covered, kind="stable")[:count]))
