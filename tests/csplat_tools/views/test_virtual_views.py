# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_tools.views.virtual_views."""

import captures
import numpy as np

from csplat_tools.optimise.simplify import SimplifyOptions
from csplat_tools.views import VIEW_COUNT, VIEW_SIZE, camera_sequence, cameras_on_part, default_views


def test_a_sequence_of_cameras_is_a_prefix_of_a_longer_one():
    source = captures.shell_with_hidden_splats()
    short, long = camera_sequence(source, 5, (40, 30)), camera_sequence(source, 9, (40, 30))
    for one, other in zip(short, long, strict=False):
        np.testing.assert_array_equal(one.viewmat, other.viewmat)
    heights = [camera.position[1] for camera in long]
    assert min(heights) < 0.0 < max(heights)  # from above and from below


def test_views_of_many_splats_are_larger_and_fewer():
    assert default_views(100_000) == (VIEW_COUNT, VIEW_SIZE)
    assert default_views(10_000_000) == (VIEW_COUNT // 2, (2 * VIEW_SIZE[0], 2 * VIEW_SIZE[1]))
    assert SimplifyOptions().views_and_size(100) == default_views(100)
    assert SimplifyOptions(views=3, view_size=(20, 10)).views_and_size(10_000_000) == (3, (20, 10))


def test_cameras_on_a_part_are_those_of_the_scene_turned_to_it():
    source = captures.shell_with_hidden_splats()
    part = source.select(np.argsort(source.means[:, 0])[-5:])
    reach = {"reach": 1.0}
    turned = cameras_on_part(source, part, 9, (40, 30), **reach)
    for camera, other in zip(turned, camera_sequence(source, 9, (40, 30), **reach), strict=True):
        np.testing.assert_allclose(camera.position, other.position, atol=1e-6)
        inside = camera.viewmat[:3, :3] @ part.means.mean(axis=0) + camera.viewmat[:3, 3]
        pixel = (camera.K @ inside)[:2] / inside[2]
        assert inside[2] > 0.0
        np.testing.assert_allclose(pixel, (20, 15), atol=10)
    assert max(camera.K[0, 0] for camera in turned) > 2.0 * other.K[0, 0]  # a small part fills the view
