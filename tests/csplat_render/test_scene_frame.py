"""Tests of csplat_render.scene_frame."""

import numpy as np
import pytest
from cameras_cases import ball, figure, niche
from checked import cloud

from csplat import read_ply
from csplat_render.camera_files import load_cameras
from csplat_render.camera_paths import orbit_cameras
from csplat_render.scene_frame import covered_fraction, sample_cloud, scene_frame, weighted_quantiles
from csplat_render.virtual_cameras import OBJECT_DISTANCES, virtual_cameras


def project(points, camera):
    p = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return p[:, :2] / p[:, 2:] * [camera.K[0, 0], camera.K[1, 1]] + [camera.K[0, 2], camera.K[1, 2]]


@pytest.mark.slow
@pytest.mark.parametrize("size", [(240, 320), (400, 100)])
def test_an_orbit_shows_an_object_entirely(size):
    model, count = figure()
    places = np.concatenate([project(model.means[:count], camera) for camera in orbit_cameras(model, 6, *size)])
    assert ((places > 0) & (places < size)).all()
    assert np.abs(2 * places / size - 1).max() > 0.8  # floaters do not increase the distance


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


def tower():
    return cloud(np.random.default_rng(0).random((5000, 3)) * [0.3, 3.0, 0.3], 0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("make", "count", "seed"), [(ball, 8, 0), (tower, 3, 0), (ball, 1, 3)])
def test_an_object_covers_half_of_each_render(make, count, seed):
    model = make()
    frame, sample = scene_frame(model), sample_cloud(model, 50_000, np.random.default_rng(9))
    cameras = virtual_cameras(model, count, seed=seed)
    assert [(640, 480, min(0.2, 0.05 * frame.extent))] * count == [(one.W, one.H, one.near) for one in cameras]
    for camera in cameras:
        assert covered_fraction(sample, camera) >= 0.5
        assert np.isclose(np.linalg.norm(camera.position - frame.centre) / frame.extent, OBJECT_DISTANCES).any()


def test_cameras_surround_an_object():
    offsets = np.array([camera.position for camera in virtual_cameras(ball())]) - scene_frame(ball()).centre
    angles = np.sort(np.degrees(np.arctan2(offsets[:, 2], offsets[:, 0])))
    assert np.diff(np.append(angles, angles[0] + 360.0)).max() < 100.0
    assert (offsets[:, 1] < 0.0).all()  # above: y points down by default


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


@pytest.mark.parametrize("name", ["donut", "horse", "plane3", "fox60k_noreg"])
def test_distances_agree_with_the_cameras_of_the_shared_scenes(data_dir, name):
    model = read_ply(data_dir / "ply" / f"{name}.ply")
    frame = scene_frame(model)

    def distance(cameras):
        return np.median([np.linalg.norm(camera.position - frame.centre) for camera in cameras]) / frame.extent

    wanted = distance(load_cameras(data_dir / "psnr_cameras" / f"{name}.json"))
    assert 0.8 < distance(virtual_cameras(model)) / wanted < 1.25
