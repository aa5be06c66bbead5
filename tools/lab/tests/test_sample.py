# SPDX-License-Identifier: Apache-2.0
"""The shipped sample scene, and its recipe on a small scale."""

import sys
from pathlib import Path

import numpy as np
import pytest

from csplat.ply import read_ply
from csplat_render import render
from csplat_render.camera import intrinsics, look_at
from csplat_render.metrics import psnr
from csplat_trainer.data import load
from csplat_trainer.training_options import TrainOptions

FOLDER = Path(__file__).resolve().parents[1] / "sample"
UP = (0.0, -1.0, 0.0)  # y points down
TURN = np.array([1.0, -1.0, -1.0])  # from the world to the garden, whose y points up
SOLID = 255
RECIPE = pytest.mark.slow


@pytest.fixture(scope="module")
def recipe():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        import make_sample

        yield make_sample


@pytest.fixture(scope="module")
def garden(recipe):
    return recipe.make_garden()


@pytest.fixture(scope="module")
def small(recipe):
    options = TrainOptions(max_splats=200, iterations=20, seed=1, background="random", refine_start=5, refine_every=5)
    return recipe.Recipe(train_views=3, test_views=2, size=32, points=150, training=options)


def field_at(garden, points):
    """Return distances, parts and items at points [P, 3] of the garden."""
    return sys.modules["distances"].field(garden, np.reshape(points, (-1, 3)).T)


@RECIPE
def test_the_recipe_makes_the_same_scene_twice(recipe, small, tmp_path):
    made = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        result = recipe.make_sample(tmp_path / f"{name}.ply", tmp_path / name, small)
        made.append((tmp_path / f"{name}.ply").read_bytes())
    assert made[0] == made[1]
    losses = result.log["losses"]
    assert np.mean(losses[-3:]) < 0.9 * np.mean(losses[:3])
    assert 2 == result.metrics["views"]
    model = read_ply(tmp_path / "one.ply", strict=True)
    assert (3, "RDF", "CC0-1.0") == (model.sh_degree, model.metadata.coordinate_system, model.metadata.licence)
    assert 100 < len(model) <= 200
    assert model.opacities.min() >= 0.0099


@RECIPE
def test_pictures_are_read_with_their_cameras_and_start_points_lie_on_the_garden(recipe, garden, small, tmp_path):
    points, colours = recipe.photograph_all(tmp_path, small)
    assert (150, 3) == points.shape == colours.shape
    assert 0.0 <= colours.min() < colours.max() <= 1.0
    assert np.abs(field_at(garden, points * TURN).distance).max() < 1e-3
    data = load(tmp_path)
    for pictures, count, between in ((data.train, 3, False), (data.test, 2, True)):
        for picture, wanted in zip(pictures, recipe.cameras(count, 32, between=between), strict=True):
            np.testing.assert_allclose(picture.camera.viewmat, wanted.viewmat, atol=1e-12)
            np.testing.assert_allclose(picture.camera.K, wanted.K, rtol=1e-12)
            assert 0.2 < np.mean(picture.pixels[..., 3] == SOLID) < 0.95


@RECIPE
def test_rays_end_at_the_first_surface(recipe, garden):
    """Small steps from the camera find no nearer surface, except for grazing rays."""
    camera = recipe.cameras(5, 24, between=False)[3]
    pixels, points = recipe.photograph(garden, camera)
    ends, eye = points[pixels[..., 3] == SOLID][::3] * TURN, camera.position * TURN
    assert len(ends) > 60
    missed = 0
    for end in ends:
        reach = np.linalg.norm(end - eye)
        places = eye + np.arange(1.5, reach - 0.01, 0.002)[:, None] * (end - eye) / reach
        missed += field_at(garden, places).distance.min() < 0.0
    assert missed <= 0.02 * len(ends)
    away = look_at((0.0, -0.1, -4.0), (0.0, -0.1, -8.0), UP, intrinsics(16, 16, 42.0), 16, 16)
    assert not recipe.photograph(garden, away)[0][..., 3].any()


@RECIPE
def test_gloss_depends_on_the_direction_and_moss_does_not(garden):
    shade, kinds = sys.modules["photograph"]._shade, sys.modules["garden"]
    lamp = np.array([0.46, 0.76, 0.46])
    directions = np.array([-lamp - side * np.array([0.7, 0.0, -0.7]) for side in (-0.8, -0.4, 0.0, 0.4, 0.8)]).T
    directions /= np.linalg.norm(directions, axis=0)

    def colours(point, wanted):
        assert [wanted] == field_at(garden, point).part
        return shade(garden, np.repeat(point[:, None], 5, axis=1), directions).T

    ball = garden.pebbles[garden.pebbles[:, 7] == 2][0]
    assert np.ptp(colours(ball[:3] + ball[3] * lamp, kinds.BALL), axis=0).min() > 0.3
    x, z = 0.0, -0.5
    column = np.stack([np.full(700, x), np.linspace(0.5, -0.2, 700), np.full(700, z)], axis=1)
    inside = column[field_at(garden, column).distance < 0.0]
    assert np.ptp(colours(inside[0], kinds.MOSS), axis=0).max() == 0.0


def test_the_sample_has_no_defects_and_all_kinds_of_splats(sample_path):
    """Examples and tests depend on it: three bands of colour, needles, discs, glass and solid."""
    report = []
    model = read_ply(sample_path, strict=True, report=report)
    assert [] == report
    assert ("RDF", "CC0-1.0", 3) == (model.metadata.coordinate_system, model.metadata.licence, model.sh_degree)
    assert ["made by tools/sample/make_sample.py"] == model.metadata.entries["comments"]
    assert sample_path.stat().st_size < 2.6e6
    assert 6000 <= len(model) <= 10_000
    sizes = np.sort(model.scales, axis=1)
    assert np.ptp(np.quantile(sizes[:, 2], (0.01, 0.99))) > np.log(8)
    assert np.mean(sizes[:, 1] - sizes[:, 0] > np.log(3)) > 0.2
    assert np.mean(sizes[:, 2] - sizes[:, 1] > np.log(3)) > 0.05
    assert model.opacities.min() < 0.05
    assert model.opacities.max() > 0.99
    assert np.abs(model.shN).mean() > 0.01


@RECIPE
def test_the_sample_looks_like_the_garden_it_was_trained_on(recipe, garden, sample_path):
    model = read_ply(sample_path)
    camera = recipe.cameras(5, 200, between=True)[3]
    pixels = recipe.photograph(garden, camera)[0] / 255.0
    assert psnr(pixels[..., :3] * pixels[..., 3:], render(model, camera).rgb) > 26.0
