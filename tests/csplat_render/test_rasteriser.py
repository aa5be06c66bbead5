"""The rasteriser: renders and gradients against the exact twin, numbers worked out by hand, and adversarial inputs."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from oracle import (
    VIEW,
    difference,
    extreme_splats,
    facing,
    float32_errors,
    random_gradients,
    random_splats,
)
from rasteriser_cases import camera

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render import render
from csplat_render.contributions import Contributions
from csplat_render.conventions import UncheckedSplats
from csplat_render.rasteriser import Rasteriser
from csplat_render.virtual_cameras import virtual_cameras

pytest.importorskip("numba", reason="the renderer requires the extra [render]")


def scene(count=400, degree=3, seed=0):
    """Return random splats of all shapes without degenerate ones."""
    rng = np.random.default_rng(seed)
    quats = rng.standard_normal((count, 4))
    return SplatModel(
        means=rng.uniform(-1.2, 1.2, (count, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=rng.uniform(-5.0, -0.8, (count, 3)).astype(np.float32),
        opacities=rng.random(count).astype(np.float32),
        sh0=rng.standard_normal((count, 3)).astype(np.float32),
        shN=(0.3 * rng.standard_normal((count, (degree + 1) ** 2 - 1, 3))).astype(np.float32),
    )


def assert_same_render(model, view, **options):
    fast, exact = render(model, view, **options), render(model, view, mode="exact", **options)
    for found, wanted in ((fast.rgb, exact.rgb), (fast.alpha[..., None], exact.alpha[..., None])):
        off = difference(found, wanted)
        assert off.share <= 1e-3
        assert off.mean <= 1e-5
    assert np.abs(fast.depth - exact.depth).mean() <= 1e-5 * max(1.0, exact.depth.max())
    assert fast.ignored == exact.ignored


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_renders_of_random_scenes_agree_with_the_twin(degree):
    assert_same_render(scene(degree=degree, seed=degree), camera(70, 53), background=(0.3, 0.6, 0.1))


def test_antialiased_renders_agree_with_the_twin():
    model = scene(count=300)
    model = replace(model, scales=model.scales - 2, antialiased=True)
    view = camera(64, 48, 40.0)
    assert_same_render(model, view)
    assert not np.allclose(render(model, view).rgb, render(model, view, antialiased=False).rgb, atol=0.01)


@pytest.mark.slow
def test_renders_of_the_sample_agree_with_the_twin(sample_path):
    model = read_ply(sample_path)
    view = virtual_cameras(model, 1, 96, 72)[0]
    assert render(model, view).alpha.mean() > 0.1
    assert_same_render(model.select(slice(0, None, 8)), view)


@pytest.mark.parametrize("mode", ["standard", "fast", "exact"])
def test_higher_sh_bands_can_be_ignored(mode):
    model = scene(count=50)
    flat = replace(model, shN=np.zeros((50, 0, 3), np.float32))
    cut, bare = render(model, camera(), sh_degree=0, mode=mode), render(flat, camera(), mode=mode)
    np.testing.assert_array_equal(cut.rgb, bare.rgb)


def test_the_fast_mode_is_close_to_the_standard_one():
    model = scene(count=2000)
    standard, fast = render(model, camera()).rgb, render(model, camera(), mode="fast").rgb
    error = math.sqrt(np.mean((standard - fast) ** 2))
    assert 0.0 < error < 0.02


def test_the_number_of_threads_does_not_change_a_bit():
    model, view = scene(count=3000), camera(100, 75)
    gradient = np.random.default_rng(0).standard_normal((75, 100, 3)).astype(np.float32)

    def outcome(threads):
        rasteriser = Rasteriser(threads=threads)
        picture = rasteriser.forward(model, view)
        g = rasteriser.backward(gradient)
        return [picture.rgb, picture.alpha, picture.depth, g.means, g.quats, g.scales, g.opacities, g.shN]

    wanted = outcome(1)
    for threads in (2, None):
        for a, b in zip(wanted, outcome(threads), strict=True):
            np.testing.assert_array_equal(a, b)


def test_earlier_renders_do_not_influence_later_ones():
    rasteriser = Rasteriser()
    large, small = scene(count=3000), scene(count=20, degree=1, seed=5)
    rasteriser.forward(large, camera(200, 150))
    again = rasteriser.forward(small, camera(33, 17)).rgb
    np.testing.assert_array_equal(again, Rasteriser().forward(small, camera(33, 17)).rgb)


@pytest.mark.parametrize("mode", ["standard", "fast"])
def test_rendering_in_slices_of_depth_gives_the_same_bits(mode):
    model, view, behind = scene(), camera(70, 53), (0.3, 0.6, 0.1)
    rasteriser = Rasteriser(mode, gradients=False)
    wanted = rasteriser.forward(model, view, background=behind)
    near = rasteriser.find_visible(model, view).near
    assert wanted.drawn == np.count_nonzero(near)
    limits = np.quantile(near[near > 0], [0.0, 0.1, 0.4, 0.4, 0.9, 1.0])  # one slice is empty
    state, found = rasteriser.initial_state(view), wanted
    for first, last in itertools.pairwise([*limits[:-1], np.inf]):
        part = model.select((near >= first) & (near < last))
        found = rasteriser.forward(part, view, background=behind, state=state)
    for name in ("rgb", "alpha", "depth"):
        np.testing.assert_array_equal(getattr(wanted, name), getattr(found, name))


def test_the_estimated_number_of_tiles_is_an_upper_bound():
    rasteriser = Rasteriser(gradients=False)
    model, view = scene(), camera(70, 53)
    seen, drawn = rasteriser.find_visible(model, view), rasteriser.forward(model, view)
    assert drawn.intersections <= seen.tiles.sum() <= 2 * drawn.intersections


def test_gradients_of_a_slice_are_refused():
    rasteriser = Rasteriser()
    with pytest.raises(InputError, match="slice"):
        rasteriser.forward(scene(), camera(), state=rasteriser.initial_state(camera()))
    rasteriser = Rasteriser(gradients=False)
    with pytest.raises(InputError, match="state"):
        rasteriser.forward(scene(), camera(), state=rasteriser.initial_state(camera(width=65)))


def test_results_belong_to_the_caller():
    rasteriser = Rasteriser()
    model = scene(count=100)
    first = rasteriser.forward(model, camera()).rgb
    before = first.copy()
    rasteriser.forward(model, camera(distance=5.0))
    np.testing.assert_array_equal(before, first)


def test_invalid_arrays_and_options_are_refused():
    model = scene(count=5)
    bad = UncheckedSplats(model.means, model.quats[:4], model.scales, model.opacities, model.sh0, model.shN)
    short = UncheckedSplats(**{**vars(bad), "quats": model.quats, "shN": model.shN[:, :4]})
    for message, call in {
        "quats has shape": lambda: Rasteriser().forward(bad, camera()),
        "coefficients": lambda: Rasteriser().forward(short, camera()),
        "mode": lambda: render(model, camera(), mode="slow"),
        "dtype": lambda: Rasteriser(dtype=np.float16),
        "forward": lambda: Rasteriser().backward(np.zeros((2, 2, 3))),
        "background": lambda: render(model, camera(), background=(0.0, float("nan"), 0.0)),
        "threads": lambda: render(model, camera(), threads=0),
    }.items():
        with pytest.raises(InputError, match=message):
            call()


@pytest.mark.long
def test_gradients_beyond_float32_are_clamped():
    rasteriser = Rasteriser()
    picture = rasteriser.forward(UncheckedSplats(**extreme_splats(scales=2.0)), facing(focal=1e6))
    g = rasteriser.backward(np.full_like(picture.rgb, 1e30))
    assert all(np.isfinite(value).all() for value in vars(g).values())


@pytest.mark.long
def test_float32_gradients_agree_with_float64_on_the_sample(sample_path):
    model = read_ply(sample_path)
    view = virtual_cameras(model, 1, 160, 120)[0]
    flipped, errors = float32_errors(model, view, random_gradients(view, seed=2))
    assert flipped <= 10
    assert max(errors.values()) <= 1e-4, errors


@pytest.mark.long
def test_clamped_capped_or_invisible_values_have_no_gradient():
    arrays = random_splats(4, 0, seed=3)
    arrays["means"][:] = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, -50.0], [90.0, 0.0, 0.0]]
    arrays["scales"][:] = -0.5
    arrays["opacities"][:] = [1.0, 0.5, 0.5, 0.5]
    arrays["sh0"][0] = [-9.0, 1.0, 1.0]
    rasteriser = Rasteriser(dtype=np.float64)
    rasteriser.forward(UncheckedSplats(**arrays), VIEW)
    g = rasteriser.backward(np.ones((VIEW.H, VIEW.W, 3)))
    assert g.sh0[0, 0] == 0.0
    assert g.sh0[0, 1] > 0.0
    assert (g.means[2:] == 0.0).all()
    assert (g.opacities[2:] == 0.0).all()
    assert (g.radii[2:] == 0.0).all()
    assert g.means2d[2:].max() == 0.0


@pytest.mark.long
def test_gradients_ignore_the_length_of_a_quaternion():
    arrays = random_splats(6, 0, seed=4)
    weights = random_gradients(VIEW, seed=4)
    found = []
    for factor in (1.0, 10.0):
        rasteriser = Rasteriser(dtype=np.float64)
        rasteriser.forward(UncheckedSplats(**{**arrays, "quats": arrays["quats"] * factor}), VIEW)
        found.append(rasteriser.backward(*weights).quats * factor)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9, atol=1e-12)
    radial = np.sum(found[0] * arrays["quats"], axis=1)
    np.testing.assert_allclose(radial, 0.0, atol=1e-9)


@pytest.mark.long
def test_ignored_sh_bands_have_no_gradient():
    arrays = random_splats(6, 3, seed=5)
    rasteriser = Rasteriser(dtype=np.float64)
    rasteriser.forward(UncheckedSplats(**arrays), VIEW, sh_degree=1)
    g = rasteriser.backward(np.ones((VIEW.H, VIEW.W, 3)))
    assert np.abs(g.shN[:, :3]).max() > 0.0
    assert (g.shN[:, 3:] == 0.0).all()


@pytest.mark.long
def test_colour_fits_of_degree_4_have_the_gradients_of_the_rasteriser():
    arrays = random_splats(20, 4, seed=5)
    splats, count = UncheckedSplats(**arrays), 20
    fit = Contributions(np.float64)
    view = fit.project_view(splats, VIEW)
    coefficients = np.concatenate([arrays["sh0"][:, None], arrays["shN"]], axis=1).astype(np.float32)
    gradient, diagonal = np.zeros((count, 25, 3), np.float32), np.zeros((count, 25), np.float32)
    lit = view.shape[:, 6:9] > 0.0
    rgb = fit.backproject(view, coefficients, lit, gradient, diagonal, offset=0.5, background=np.zeros(3))
    plain = Rasteriser(dtype=np.float64)
    np.testing.assert_allclose(plain.forward(splats, VIEW).rgb, rgb, atol=1e-6)
    wanted = plain.backward(rgb)
    np.testing.assert_allclose(gradient[:, 1:], wanted.shN, atol=1e-5 * np.abs(wanted.shN).max())
