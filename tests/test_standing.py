"""Up-axis estimates for scenes that record no up direction; they are used for viewing only."""

import numpy as np
import pytest

from csplat import decode, encode, read_ply
from csplat.model import SplatModel
from csplat_render.camera_paths import orbit_cameras
from csplat_render.up_estimate import estimate_up, with_estimated_up
from csplat_tools.cli.shared_options import parse_up, up_word
from csplat_tools.views import display_cameras, find_view_set

AXES = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]


def photographed_from(up, seed=0, **fields):
    """A ball of fine splats, whose far side from a direction nobody saw: there they are few and large."""
    places = np.random.default_rng(seed).standard_normal((4000, 3))
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    unseen = places @ np.array(up, float) < -0.2
    kept = ~unseen | (np.arange(4000) % 40 == 0)
    sizes = np.where(unseen, 0.3, 0.03)[kept]
    n = int(kept.sum())
    return SplatModel(
        means=places[kept].astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        scales=np.log(np.tile(sizes[:, None], 3)).astype(np.float32),
        opacities=np.full(n, 0.9, np.float32),
        sh0=np.zeros((n, 3), np.float32),
        **fields,
    )


@pytest.mark.parametrize("up", AXES)
def test_up_is_from_where_an_object_was_seen(up):
    assert list(up) == with_estimated_up(photographed_from(up)).metadata["up"]  # what `estimate_up` returns
    assert up == parse_up(up_word(up))


def test_nothing_is_guessed_where_nothing_tells_it():
    assert estimate_up(photographed_from((0, 0, 0))) is None  # seen from all sides
    assert estimate_up(photographed_from((0.6, 0.6, 0.6))) is None  # between the axes
    assert estimate_up(photographed_from((0, 0, 1)).select(np.arange(0))) is None


@pytest.mark.parametrize("said", [{"metadata": {"up": [1, 0, 0]}}, {"coordinate_system": "RDF"}])
def test_what_a_scene_says_is_not_doubted(said):
    model = photographed_from((0, 0, 1), **said)
    assert estimate_up(model) is None
    assert with_estimated_up(model) is model


@pytest.mark.slow
@pytest.mark.usefixtures("small_views")
def test_pictures_to_look_at_stand_upright_and_the_judges_stay():
    model = photographed_from((0, 1, 0))
    views = find_view_set(model, count=0)
    for camera in [*orbit_cameras(model, 4, 64, 48), *display_cameras(model, views)]:
        assert abs(camera.viewmat[0, 1]) < 1e-6
        assert camera.viewmat[1, 1] < 0.0  # down the picture
    assert all(camera.viewmat[1, 1] > 0.0 for camera in views.test)  # as in a PLY


def test_a_file_says_no_more_than_its_source():
    assert "up" not in decode(encode(photographed_from((0, 0, 1)))).metadata


@pytest.mark.parametrize(
    ("name", "up"), [("lego60k", (0, 0, 1)), ("donut", (0, 0, 1)), ("horse", None), ("jacket", None)]
)
def test_real_objects_seem_to_stand_as_they_do(data_dir, name, up):
    assert up == estimate_up(read_ply(data_dir / "ply" / f"{name}.ply"))
