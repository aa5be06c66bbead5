# SPDX-License-Identifier: Apache-2.0
"""Views of a scene by role: training, validation and test."""

from __future__ import annotations

from csplat_tools.views.off_path_views import views_off_path
from csplat_tools.views.view_sets import (
    BLACK,
    SPLITS,
    VIRTUAL,
    WHITE,
    Colour,
    DataOptions,
    Split,
    ViewSet,
    comparison_cameras,
    describe_views,
    display_cameras,
    find_view_set,
    require_visible,
    with_validation_views,
)
from csplat_tools.views.virtual_views import (
    HELD_OUT_COUNT,
    VIEW_COUNT,
    VIEW_SIZE,
    at_distance,
    camera_sequence,
    cameras_on_part,
    default_views,
    evenly_spaced,
    extra_test_cameras,
    shrink_cameras,
)

__all__ = [
    "BLACK",
    "HELD_OUT_COUNT",
    "SPLITS",
    "VIEW_COUNT",
    "VIEW_SIZE",
    "VIRTUAL",
    "WHITE",
    "Colour",
    "DataOptions",
    "Split",
    "ViewSet",
    "at_distance",
    "camera_sequence",
    "cameras_on_part",
    "comparison_cameras",
    "default_views",
    "describe_views",
    "display_cameras",
    "evenly_spaced",
    "extra_test_cameras",
    "find_view_set",
    "require_visible",
    "shrink_cameras",
    "views_off_path",
    "with_validation_views",
]
