# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_render.virtual_cameras."""

import numpy as np
import pytest
from cameras_cases import ball, niche, same
from checked import cloud

from csplat.ply import read_ply
from csplat_render.camera_files import load_cameras
from csplat_render.scene_frame import covered_fraction, sample_cloud, scene_frame
from csplat_render.virtual_cameras import OBJECT_DISTANCES, SURROUNDING_DISTANCES, virtual_cameras


@pytest.mark.slow
def test_cameras_in_surroundings_look_at_the_subject():
    frame = scene_frame(niche())
    for camera in virtual_cameras(niche()):
        towards = frame.centre - camera.position
        distance = np.linalg.norm(towards)
        assert np.isclose(distance / frame.extent, SURROUNDING_DISTANCES).any()
        assert np.allclose(camera.viewmat[2, :3], towards / distance)


@pytest.mark.slow
def test_cameras_depend_on_scene_and_seed_alone():
    first = virtual_cameras(ball())
    assert same(first, virtual_cameras(ball()))
    assert same(first, virtual_cameras(ball(cameras=[{"K": np.eye(3).tolist()}])))  # training cameras
    assert not same(first, virtual_cameras(ball(), seed=1))


def test_cameras_scale_with_the_scene():
    small, large = ball(), ball(radius=128.0, sizes=0.03 * 128.0)
    for a, b in zip(virtual_cameras(small), virtual_cameras(large), strict=True):
        assert np.allclose(a.viewmat[:3, :3], b.viewmat[:3, :3], atol=1e-5)
        assert np.allclose(128.0 * a.viewmat[:3, 3], b.viewmat[:3, 3], rtol=1e-4, atol=1e-2)


def test_parts_far_from_each_other_are_viewed_each_for_itself():
    near, far = ball(seed=1), ball(400, seed=2)
    centre = np.array([500.0, 0.0, 0.0])
    means = np.concatenate([near.means, far.means + centre])
    cameras = virtual_cameras(cloud(means), 5)
    assert same(cameras[::2], virtual_cameras(near, 3))
    assert [True, True] == [np.linalg.norm(camera.position - centre) < 5.0 for camera in cameras[1::2]]
    under_a_dome = cloud(np.concatenate([near.means, 60.0 * far.means]))
    assert same(virtual_cameras(near, 2), virtual_cameras(under_a_dome, 4)[1::2])


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


@pytest.mark.parametrize("name", ["donut", "horse", "plane3", "fox60k_noreg"])
def test_distances_agree_with_the_cameras_of_the_shared_scenes(data_dir, name):
    model = read_ply(data_dir / "ply" / f"{name}.ply")
    frame = scene_frame(model)

    def distance(cameras):
        return np.median([np.linalg.norm(camera.position - frame.centre) for camera in cameras]) / frame.extent

    wanted = distance(load_cameras(data_dir / "psnr_cameras" / f"{name}.json"))
    assert 0.8 < distance(virtual_cameras(model)) / wanted < 1.25
