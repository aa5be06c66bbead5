"""Virtual cameras: kinds of scenes, coverage, determinism, agreement with the cameras of the shared scenes."""

import os
import subprocess
import sys

import numpy as np
import pytest
from checked import cloud

from csplat import read_ply
from csplat.errors import InputError
from csplat_render.camera_files import load_cameras
from csplat_render.camera_paths import orbit_cameras
from csplat_render.scene_frame import covered_fraction, sample_cloud, scene_frame, weighted_quantiles
from csplat_render.virtual_cameras import OBJECT_DISTANCES, SURROUNDING_DISTANCES, virtual_cameras


def ball(count=3000, radius=1.0, seed=0, **fields):
    p = np.random.default_rng(seed).standard_normal((count, 3))
    return cloud(radius * p / np.linalg.norm(p, axis=1, keepdims=True), **fields)


def capture(seed=0):
    """Return a small subject of fine splats, surrounded by far, coarse walls."""
    rng = np.random.default_rng(seed)
    subject, walls = rng.standard_normal((4000, 3)) * 0.3, rng.standard_normal((1500, 3))
    walls *= 6.0 / np.linalg.norm(walls, axis=1, keepdims=True)
    return cloud(np.concatenate([subject, walls]), np.repeat([0.02, 0.4], [4000, 1500]))


def same(a, b):
    return all(
        (x.viewmat == y.viewmat).all() and (x.K == y.K).all() and x.near == y.near for x, y in zip(a, b, strict=True)
    )


def test_objects_and_surroundings_are_distinguished():
    assert "object" == scene_frame(ball()).kind
    assert "surrounding" == scene_frame(capture()).kind


def test_one_far_floater_does_not_change_the_kind_of_scene():
    means = np.concatenate([ball().means, [[300.0, 0.0, 0.0]]])
    frame = scene_frame(cloud(means))
    assert "object" == frame.kind
    assert np.allclose(frame.centre, 0.0, atol=0.05)


def test_transparent_splats_are_ignored():
    clean = ball()
    means = np.concatenate([clean.means, 50.0 * np.random.default_rng(1).standard_normal((3000, 3))])
    dirty = scene_frame(cloud(means, opacities=np.repeat(np.array([0.9, 0.001], np.float32), 3000)))
    assert "object" == dirty.kind
    assert np.allclose(scene_frame(clean).centre, dirty.centre)
    assert np.isclose(scene_frame(clean).extent, dirty.extent)


@pytest.mark.parametrize(("count", "seed"), [(8, 0), (8, 3), (1, 0), (5, 1)])
def test_an_object_covers_half_of_each_render(count, seed):
    model = ball()
    sample = sample_cloud(model, 50_000, np.random.default_rng(9))
    cameras = virtual_cameras(model, count, seed=seed)
    assert count == len(cameras)
    frame = scene_frame(model)
    for camera in cameras:
        assert (640, 480) == (camera.W, camera.H)
        assert covered_fraction(sample, camera) >= 0.5
        distance = np.linalg.norm(camera.position - frame.centre) / frame.extent
        assert np.isclose(distance, OBJECT_DISTANCES).any()
        assert camera.near == min(0.2, 0.05 * frame.extent)


def test_a_tower_covers_half_of_each_render():
    rng = np.random.default_rng(0)
    model = cloud(rng.random((5000, 3)) * [0.3, 3.0, 0.3], 0.02)
    sample = sample_cloud(model, 50_000, rng)
    assert all(covered_fraction(sample, camera) >= 0.5 for camera in virtual_cameras(model, 3))


def test_cameras_surround_an_object():
    frame = scene_frame(ball())
    offsets = np.array([camera.position - frame.centre for camera in virtual_cameras(ball())])
    angles = np.sort(np.degrees(np.arctan2(offsets[:, 2], offsets[:, 0])))
    assert np.diff(np.append(angles, angles[0] + 360.0)).max() < 100.0
    assert (offsets[:, 1] < 0.0).all()  # above: y points down by default


@pytest.mark.slow
def test_cameras_in_surroundings_look_at_the_subject():
    model = capture()
    frame = scene_frame(model)
    for camera in virtual_cameras(model):
        towards = frame.centre - camera.position
        distance = np.linalg.norm(towards) / frame.extent
        assert np.isclose(distance, SURROUNDING_DISTANCES).any()
        assert np.allclose(camera.viewmat[2, :3], towards / np.linalg.norm(towards))


@pytest.mark.parametrize(("letters", "up"), [("RUB", [0, 1, 0]), ("RDF", [0, -1, 0]), ("RFU", [0, 0, 1])])
def test_up_follows_from_the_coordinate_system(letters, up):
    assert (scene_frame(ball(coordinate_system=letters)).up == up).all()


def test_up_of_a_flat_scene_is_normal_to_its_plane():
    means = np.random.default_rng(0).standard_normal((2000, 3)) * [1.0, 1.0, 0.1]
    assert (scene_frame(cloud(means)).up == [0, 0, 1]).all()


def test_cameras_are_deterministic_and_depend_on_the_seed():
    model = ball()
    first = virtual_cameras(model)
    assert same(first, virtual_cameras(model))
    assert not same(first, virtual_cameras(model, seed=1))
    carrying = ball(cameras=[{"K": np.eye(3).tolist()}])  # training cameras, which are ignored
    assert same(first, virtual_cameras(carrying))


def test_cameras_scale_with_the_scene():
    small, large = ball(), ball(radius=128.0, sizes=0.03 * 128.0)
    for a, b in zip(virtual_cameras(small), virtual_cameras(large), strict=True):
        assert np.allclose(a.viewmat[:3, :3], b.viewmat[:3, :3], atol=1e-5)
        assert np.allclose(128.0 * a.viewmat[:3, 3], b.viewmat[:3, 3], rtol=1e-4, atol=1e-2)


THREADS = """
import json
import numpy as np
from csplat.model import SplatModel, normalise_quats
from csplat_render.virtual_cameras import virtual_cameras

rng = np.random.default_rng(0)
f = lambda *shape: rng.standard_normal((20000, *shape)).astype(np.float32)
alpha = np.abs(np.tanh(f()))
model = SplatModel(means=f(3), quats=normalise_quats(f(4)), scales=f(3) - 4, opacities=alpha, sh0=f(3))
print(json.dumps([camera.to_json() for camera in virtual_cameras(model)]))
"""


@pytest.mark.slow
def test_the_number_of_threads_does_not_change_the_cameras():
    out = []
    for threads in ("1", "2"):
        environment = dict(os.environ)
        environment.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), threads))
        run = subprocess.run([sys.executable, "-c", THREADS], env=environment, capture_output=True, check=True)
        out.append(run.stdout)
    assert out[0] == out[1]
    assert 8 == out[0].count(b"viewmat")


@pytest.mark.slow
def test_degenerate_scenes_have_cameras():
    nothing = cloud(np.zeros((0, 3)), np.zeros(0))
    point = cloud(np.zeros((1, 3)))
    clear = ball(300, opacities=np.zeros(300, np.float32))
    huge = ball(300, scales=np.full((300, 3), 60.0, np.float32))
    tiny = ball(300, scales=np.full((300, 3), -60.0, np.float32))
    far = ball(300, radius=1e15)
    assert 3 == len(virtual_cameras(nothing, 3))
    for model in (point, clear, huge, tiny, far):
        (camera,) = virtual_cameras(model, 1)
        assert np.isfinite(camera.viewmat).all()
    for model in (clear, tiny, far):  # test_cameras.py makes paths for the others
        assert all(np.isfinite(camera.viewmat).all() for camera in orbit_cameras(model, 3))


def test_zero_cameras_are_refused():
    with pytest.raises(InputError, match="at least 1"):
        virtual_cameras(ball(), 0)


def test_weighted_quantiles_agree_with_values_by_hand():
    values = np.array([5.0, 1.0, 3.0, 2.0, 4.0])
    assert np.allclose([1.0, 3.0, 5.0], weighted_quantiles(values, np.ones(5), (0.2, 0.6, 1.0)))
    weights = np.array([1.0, 3.0, 0.0, 0.0, 0.0])  # weights of the values 5 and 1
    assert np.allclose([1.0, 3.0, 5.0], weighted_quantiles(values, weights, (0.75, 0.875, 1.0)))


@pytest.mark.parametrize("name", ["donut", "horse", "jacket", "lego60k", "plane3", "fox60k_noreg", "object_id"])
def test_distances_agree_with_the_cameras_of_the_shared_scenes(data_dir, name):
    model = read_ply(data_dir / "ply" / f"{name}.ply")
    frame = scene_frame(model)

    def distance(cameras):
        return np.median([np.linalg.norm(camera.position - frame.centre) for camera in cameras]) / frame.extent

    wanted = distance(load_cameras(data_dir / "psnr_cameras" / f"{name}.json"))
    assert 0.8 < distance(virtual_cameras(model)) / wanted < 1.25
