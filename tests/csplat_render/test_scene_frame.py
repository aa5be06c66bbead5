# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_render.scene_frame."""

import numpy as np
import pytest
from cameras_cases import ball, figure, niche
from checked import cloud

from csplat_render.camera import intrinsics, look_at
from csplat_render.scene_frame import Cloud, detail, scene_frame, weighted_quantiles


def test_objects_and_surroundings_are_distinguished():
    assert ["object", "object", "surrounding"] == [scene_frame(one).kind for one in (ball(), figure()[0], niche())]


def test_floaters_and_transparent_splats_do_not_change_the_frame_of_a_scene():
    clean, rng = ball(), np.random.default_rng(1)
    fog = np.concatenate([clean.means, 50.0 * rng.standard_normal((1500, 3))])
    foggy = cloud(fog, opacities=np.repeat(np.array([0.9, 0.001], np.float32), 1500))
    wanted = scene_frame(clean)
    for model, tolerance in ((foggy, 1e-6), (cloud(np.concatenate([clean.means, [[300.0, 0.0, 0.0]]])), 0.05)):
        found = scene_frame(model)
        assert "object" == found.kind
        assert np.allclose(wanted.centre, found.centre, atol=tolerance)
        assert np.isclose(wanted.extent, found.extent, rtol=tolerance)


def test_up_follows_from_the_coordinate_system_or_is_normal_to_a_flat_scene():
    for letters, up in (("RUB", [0, 1, 0]), ("RDF", [0, -1, 0]), ("RFU", [0, 0, 1])):
        assert (scene_frame(ball(coordinate_system=letters)).up == up).all()
    flat = cloud(np.random.default_rng(0).standard_normal((2000, 3)) * [1.0, 1.0, 0.1])
    assert (scene_frame(flat).up == [0, 0, 1]).all()


def test_weighted_quantiles_agree_with_values_by_hand():
    values = np.array([5.0, 1.0, 3.0, 2.0, 4.0])
    assert np.allclose([1.0, 3.0, 5.0], weighted_quantiles(values, np.ones(5), (0.2, 0.6, 1.0)))
    weights = np.array([1.0, 3.0, 0.0, 0.0, 0.0])  # weights of the values 5 and 1
    assert np.allclose([1.0, 3.0, 5.0], weighted_quantiles(values, weights, (0.75, 0.875, 1.0)))


def test_detail_is_what_nearer_points_of_a_cell_let_through():
    rng = np.random.default_rng(5)
    points = np.concatenate([rng.normal(size=(400, 3)) * 1e-3, rng.normal(size=(400, 3))])  # many share a cell
    surface = Cloud(np.asfortranarray(points), rng.random(800) * 1e-2, np.full(800, 0.02))
    camera = look_at(
        np.array([0.0, 0.0, -4.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]), intrinsics(200, 200, 50.0), 200, 200, 0.1
    )
    focal, seen = camera.K[0, 0], 0.0
    transmittance = {}
    for index in np.argsort(points[:, 2]):
        x, y, z = camera.viewmat[:3, :3] @ points[index] + camera.viewmat[:3, 3]
        place = int((focal * x / z + 100) // 20), int((focal * y / z + 100) // 20)
        if not all(0 <= part < 10 for part in place):
            continue
        depth = surface.masses[index] * (focal / z / 20) ** 2
        left = transmittance.get(place, 1.0)
        transmittance[place] = left * np.exp(-depth)
        seen += (left - transmittance[place]) * 4.0 / max(4.0, surface.sizes[index] * focal / z)
    assert seen / 100 == pytest.approx(detail(surface, camera, 0.0), rel=1e-9)
    assert 0.0 < seen
