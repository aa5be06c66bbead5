"""Views of a scene by role: training views (teach), validation views (decide), and test views (judge)."""

from __future__ import annotations

from csplat_tools.views.elsewhere import elsewhere
from csplat_tools.views.finding import DataOptions, comparison_cameras, find_view_set, with_deciders
from csplat_tools.views.placing import CHECKS, VIEW_COUNT, VIEW_SIZE, camera_sequence, evenly, reduced, usual_views
from csplat_tools.views.showing import showing_cameras
from csplat_tools.views.viewset import BLACK, SPLITS, VIRTUAL, WHITE, Colour, Split, ViewSet, counted_views

__all__ = [
    "BLACK",
    "CHECKS",
    "SPLITS",
    "VIEW_COUNT",
    "VIEW_SIZE",
    "VIRTUAL",
    "WHITE",
    "Colour",
    "DataOptions",
    "Split",
    "ViewSet",
    "camera_sequence",
    "comparison_cameras",
    "counted_views",
    "elsewhere",
    "evenly",
    "find_view_set",
    "reduced",
    "showing_cameras",
    "usual_views",
    "with_deciders",
]
