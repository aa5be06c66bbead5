"""Inputs that break rasterisers: renders and gradients stay finite, and nothing is written out of bounds."""

import math

import numpy as np
import pytest

pytest.importorskip("numba", reason="the renderer wants the extra [render]")

from oracle import extreme_splats, facing

from csplat.errors import LimitError
from csplat_render import rasteriser, render
from csplat_render.conventions import UncheckedSplats
from csplat_render.rasteriser import Rasteriser
from csplat_render.warmup import warm_up

pytestmark = pytest.mark.area(name="rasteriser")

W, H = 50, 37


def assert_survives(arrays, view, *, antialiased=False):
    """Render forward and backward in both dtypes: finite, alike, and like the twin."""
    found = []
    rng = np.random.default_rng(1)
    weights = rng.standard_normal((view.H, view.W, 3)), *rng.standard_normal((2, view.H, view.W))
    for dtype in (np.float32, np.float64):
        rasteriser = Rasteriser(dtype=dtype)
        picture = rasteriser.forward(UncheckedSplats(**arrays), view, antialiased=antialiased)
        g = rasteriser.backward(*weights)
        for name in ("rgb", "alpha", "depth"):
            assert np.isfinite(getattr(picture, name)).all(), name
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN", "means2d"):
            assert np.isfinite(getattr(g, name)).all(), name
        found.append((picture, {name: np.array(value, np.float64) for name, value in vars(g).items()}))
    exact = render(UncheckedSplats(**arrays), view, mode="exact", antialiased=antialiased)
    assert np.isfinite(exact.rgb).all()
    for picture, _ in found:
        off = np.abs(picture.rgb - exact.rgb).max(2) > 1 / 255 * max(1.0, np.abs(exact.rgb).max())
        assert off.mean() <= 2e-3
    return found


def assert_gradients_agree(found):
    for name, wanted in found[1][1].items():
        size = np.linalg.norm(wanted)
        assert np.linalg.norm(found[0][1][name] - wanted) <= 1e-2 * size + 1e-30, name


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize(
    "scales",
    [(0.0, -13.8, -13.8), (0.0, 0.0, -13.8), (4.0, -9.8, -9.8), (4.0, 4.0, -9.8), (9.0, -4.8, -4.8)],
    ids=["needle", "disc", "large needle", "large disc", "huge needle"],
)
def test_an_anisotropy_of_a_million(scales, antialiased):
    arrays = extreme_splats(scales=scales)
    assert_gradients_agree(assert_survives(arrays, facing(), antialiased=antialiased))


def test_the_camera_inside_splats():
    arrays = extreme_splats(scales=(1.0, 0.5, 0.2))
    assert_gradients_agree(assert_survives(arrays, facing(distance=0.0)))


@pytest.mark.parametrize("near", [1e-30, 1e-6, 0.2, 3.0])
def test_splats_at_the_near_plane_and_behind_it(near):
    arrays = extreme_splats(count=80)
    arrays["means"][:, 2] = np.concatenate([np.float32(near) * np.linspace(0.5, 2.0, 40), np.linspace(-4.0, 4.0, 40)])
    found = assert_survives(arrays, facing(near=near, distance=0.0))
    assert 0 < found[0][0].drawn < 80


@pytest.mark.parametrize("log_scale", [-60.0, 60.0, 88.0, -88.0, 3e38, -3e38])
def test_extreme_log_scales(log_scale):
    for axes in ((1, 1, 1), (1, 0, 0), (1, 1, 0)):
        arrays = extreme_splats()
        arrays["scales"][:] = np.where(axes, np.float32(log_scale), arrays["scales"])
        assert_survives(arrays, facing())
    mixed = extreme_splats()
    mixed["scales"][:, 0], mixed["scales"][:, 1] = 60.0, -60.0
    assert_survives(mixed, facing(), antialiased=True)


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_alpha_zero_and_one(alpha):
    found = assert_survives(extreme_splats(opacities=alpha), facing())
    assert (found[0][0].alpha.max() > 0.0) == (alpha > 0.0)
    assert_gradients_agree(found)


@pytest.mark.parametrize("focal", [1e-6, 1e-2, 1e4, 1e9])
def test_tiny_and_huge_focal_lengths(focal):
    assert_survives(extreme_splats(), facing(focal=focal))


@pytest.mark.parametrize("distance", [1e-20, 1e20, 1e37])
def test_far_and_large_scenes(distance):
    arrays = extreme_splats()
    arrays["means"] *= np.float32(distance)
    arrays["scales"] += np.float32(math.log(distance))
    assert_survives(arrays, facing(near=distance * 1e-3, distance=3 * distance))


def test_zero_and_huge_quaternions():
    arrays = extreme_splats()
    arrays["quats"][::3] = 0.0
    arrays["quats"][1::3] *= np.float32(1e30)
    arrays["quats"][2::3] *= np.float32(1e-30)
    found = assert_survives(arrays, facing())
    plain = dict(arrays)
    plain["quats"] = arrays["quats"].copy()
    plain["quats"][::3] = [1.0, 0.0, 0.0, 0.0]
    np.testing.assert_array_equal(found[0][0].rgb, render(UncheckedSplats(**plain), facing()).rgb)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "sh0", "shN"])
def test_rows_that_hold_nan_are_left_out_and_counted(name, bad):
    arrays = extreme_splats(count=30)
    clean = {key: value[3:].copy() for key, value in arrays.items()}
    arrays[name].reshape(30, -1)[:3, -1] = bad
    found = assert_survives(arrays, facing())
    assert [result.ignored for result, _ in found] == [3, 3]
    assert render(UncheckedSplats(**arrays), facing(), mode="exact").ignored == 3
    np.testing.assert_array_equal(found[0][0].rgb, render(UncheckedSplats(**clean), facing()).rgb)


def test_an_empty_scene_shows_the_background():
    for degree in (0, 3):
        arrays = extreme_splats(count=0, degree=degree)
        assert_survives(arrays, facing())
        picture = render(UncheckedSplats(**arrays), facing(), background=(0.1, 0.2, 0.3))
        np.testing.assert_array_equal(picture.rgb, np.broadcast_to(np.float32([0.1, 0.2, 0.3]), (H, W, 3)))


@pytest.mark.parametrize(("width", "height"), [(1, 1), (16, 16), (17, 15), (1, 100), (333, 1)])
def test_pictures_of_any_size(width, height):
    assert_survives(extreme_splats(), facing(width=width, height=height))


def test_gradients_beyond_float32_are_clamped():
    rasteriser = Rasteriser()
    picture = rasteriser.forward(UncheckedSplats(**extreme_splats(scales=2.0)), facing(focal=1e6))
    g = rasteriser.backward(np.full_like(picture.rgb, 1e30))
    assert all(np.isfinite(value).all() for value in vars(g).values())


def test_too_many_intersections_are_refused(monkeypatch):
    monkeypatch.setattr(rasteriser, "MAX_INTERSECTIONS", 100)
    with pytest.raises(LimitError, match="MAX_INTERSECTIONS"):
        render(UncheckedSplats(**extreme_splats(scales=2.0)), facing())


def test_warming_up_says_nothing_once_all_is_compiled():
    warm_up()
    said = []
    assert warm_up(said.append) < 5.0
    assert len(said) in (0, 2)
