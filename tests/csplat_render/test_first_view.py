# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_render.first_view."""

import json
from dataclasses import replace

import numpy as np
import pytest
from cameras_cases import ball, figure, niche, on_a_sphere
from checked import cloud
from models import with_facts
from tables import failures

import csplat
from csplat.errors import InputError
from csplat_render.camera import Camera, intrinsics, look_at
from csplat_render.camera_paths import orbit_cameras
from csplat_render.first_view import SAMPLE_SPLATS, viewing_metadata
from csplat_render.scene_frame import scene_frame


def first_view(model, *args, **options):
    view = viewing_metadata(model, *args, **options).entries["view"]
    return Camera.from_json(view), view["from"]


def places_in(camera, points):
    p = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return p[:, :2] / p[:, 2:] * camera.K[0, 0] + camera.K[:2, 2]


def room():
    """Return a closed box of 8 × 3 × 6 units, -y up, with a table."""
    rng = np.random.default_rng(7)
    half = np.array([4.0, 1.5, 3.0])
    walls = half * (2.0 * rng.random((6000, 3)) - 1.0)
    axes = np.arange(6000) % 3
    walls[np.arange(6000), axes] = half[axes] * np.where(np.arange(6000) % 2, 1.0, -1.0)
    return cloud(np.concatenate([walls, [0.0, 0.8, 0.0] + 0.3 * rng.standard_normal((300, 3))]))


def test_an_object_is_shown_whole_despite_floaters():
    model, count = figure()
    camera, source = first_view(model)
    places = places_in(camera, model.means[:count])
    assert "estimate" == source
    assert camera.W == camera.H
    assert ((places > 0) & (places < camera.W)).all()
    assert np.abs(2 * places / camera.W - 1).max() > 0.8


def test_far_splats_do_not_draw_the_first_view_away_from_the_scene():
    clean, rng = ball(), np.random.default_rng(3)
    dome = on_a_sphere(rng, 1400)
    away = on_a_sphere(rng, 75) * 10.0 ** rng.uniform(1.0, 6.0, (75, 1))
    clump = [1.0, 2.0, 0.5] + 0.01 * rng.standard_normal((450, 3))
    cases = {
        f"{name}, {distance:g} radii": (distance * np.asarray(places), distance * size, alpha)
        for distance in (10.0, 100.0, 1e4, 1e6)
        for name, places, size, alpha in (
            ("a faint blob", [[0.6, 0.8, 0.0]], 0.02, 0.3),
            ("an opaque blob", [[0.6, 0.8, 0.0]], 0.3, 1.0),
            ("eight blobs", on_a_sphere(rng, 8), 0.05, 0.5),
            ("a clump of 23 %", clump, 0.002, 1.0),
            ("a dome of 48 %", dome, 0.05, 1.0),
        )
    } | {"outliers, 5 %": (away, 0.03, 0.6)}

    def check(case):
        places, size, alpha = case
        means, sizes = np.concatenate([clean.means, places]), np.repeat([0.03, size], [len(clean), len(places)])
        alphas = np.repeat(np.float32([0.2, alpha]), [len(clean), len(places)])
        model = cloud(means, sizes, opacities=alphas)
        views = [first_view(model)[0], orbit_cameras(model, 3)[1]]
        shown = [places_in(camera, clean.means) / [camera.W, camera.H] for camera in views]
        inside = [((one > 0.0) & (one < 1.0)).all(axis=1).mean() for one in shown]
        kind = scene_frame(model).kind
        assert min(inside) > (0.98 if kind == "object" else 0.4), (kind, inside)  # surroundings: from near the middle
        assert all(0.3 < float(np.median(np.abs(one - np.median(one, axis=0)))) * 8.0 for one in shown)

    assert [] == failures(cases, check)


def test_known_axes_name_the_front():
    for axes, front in (("RDF", [0, 0, -1]), ("RUB", [0, 0, 1]), ("RFU", [0, -1, 0])):
        camera, _ = first_view(ball(metadata=replace(ball().metadata, coordinate_system=axes)))
        assert camera.position @ front > 0.8 * np.linalg.norm(camera.position)


def test_an_object_of_unknown_axes_is_shown_from_the_side_with_most_detail():
    rng = np.random.default_rng(1)
    sides = np.concatenate([rng.random((2000, 3)) * [1, 1, 0.02] + [0, 0, z] for z in (0.0, 0.3)])
    camera, _ = first_view(cloud(sides - 0.5, np.repeat([0.3, 0.01], 2000)))  # the side towards -z is smeared
    assert camera.position[2] > 0.0


def test_a_closed_room_is_seen_from_inside():
    camera, _ = first_view(room())
    assert (np.abs(camera.position) < [4.0, 1.5, 3.0]).all()
    model = room()
    camera, _ = first_view(model.select(model.means[:, 1] < 1.2))  # without a floor, it is an object
    assert (np.abs(camera.position) > [4.0, 1.5, 3.0]).any()


@pytest.mark.slow
def test_surroundings_are_seen_from_near_their_middle():
    model = niche()
    camera, source = first_view(model)
    assert "estimate" == source
    assert np.linalg.norm(camera.position) < 2.0 * scene_frame(model).extent
    towards = scene_frame(model).centre - camera.position
    assert camera.viewmat[2, :3] @ towards > 0.999 * np.linalg.norm(towards)


def test_surroundings_with_cameras_get_the_most_typical_one():
    eyes = [[2.0, -0.5, z] for z in (-0.9, -0.1, 0.2, 0.8)]
    cameras = [look_at(eye, [0, 0, 0], [0, -1, 0], intrinsics(64, 48, 60.0), 64, 48) for eye in eyes]
    camera, source = first_view(niche(), cameras)
    assert "training" == source
    assert np.allclose(cameras[1].position, camera.position, atol=1e-4)
    assert (64, 48) == (camera.W, camera.H)
    carried = replace(niche(), metadata=replace(niche().metadata, cameras=[one.as_json() for one in cameras]))
    assert (camera.viewmat == first_view(carried)[0].viewmat).all()
    assert "estimate" == first_view(ball(), cameras)[1]  # an object is shown whole
    broken = replace(niche(), metadata=replace(niche().metadata, cameras=[{"K": 1}]))
    assert "estimate" == first_view(broken)[1]


def test_a_view_and_an_up_direction_of_the_scene_stay():
    known = {"view": {"K": 1, "from": "author"}, "up": [0.0, 0.6, -0.8]}
    assert known == viewing_metadata(with_facts(ball(), entries=known)).entries
    assert {} == viewing_metadata(ball().select(np.arange(0))).entries


def test_a_sample_of_a_large_scene_gives_the_same_view_as_the_scene():
    model = ball(2 * SAMPLE_SPLATS + 7)
    sample = model.select(slice(None, None, 3))
    assert viewing_metadata(model) == viewing_metadata(sample, every=3)


def test_the_view_is_short():
    view = viewing_metadata(ball()).entries["view"]
    assert len(json.dumps(view, separators=(",", ":"))) < 300
    assert viewing_metadata(ball()).entries["view"] == view


def test_a_render_without_a_camera_shows_the_first_view(make_model):
    model = ball(300)
    assert np.array_equal(csplat.render(model, first_view(model)[0]).rgb, csplat.render(model).rgb)
    with pytest.raises(InputError, match="no camera is given"):
        csplat.render(make_model(0, 0))
