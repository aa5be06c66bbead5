"""From where a scene is looked at: views that teach, views that decide, views that judge."""

from __future__ import annotations

from csplat_tools.views.finding import SPLITS, DataOptions, comparison_cameras, find_view_set, with_deciders
from csplat_tools.views.placing import VIEW_SIZE, camera_sequence, reduced
from csplat_tools.views.viewset import BLACK, WHITE, Colour, ViewSet

__all__ = [
    "BLACK",
    "SPLITS",
    "VIEW_SIZE",
    "WHITE",
    "Colour",
    "DataOptions",
    "ViewSet",
    "camera_sequence",
    "comparison_cameras",
    "find_view_set",
    "reduced",
    "with_deciders",
]
