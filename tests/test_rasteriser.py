"""The rasteriser: renders and gradients against the exact twin, numbers worked out by hand, and adversarial inputs."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from csplat.errors import InputError, LimitError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat.spherical_harmonics import SH_C0

pytest.importorskip("numba", reason="the renderer requires the extra [render]")


from oracle import (
    GROUPS,
    VIEW,
    Case,
    adversarial,
    difference,
    extreme_splats,
    facing,
    finite_differences,
    float32_errors,
    gradients_of,
    random_gradients,
    random_splats,
    relative_error,
)
from tables import failures

from csplat_render import rasteriser, render
from csplat_render.contributions import Contributions
from csplat_render.conventions import ALPHA_CAP, DILATION, UncheckedSplats
from csplat_render.rasteriser import Rasteriser
from csplat_render.virtual_cameras import virtual_cameras


def camera(width=64, height=48, focal=60.0, distance=4.0):
    return facing(focal, distance=distance, width=width, height=height)


def one_splat(alpha=0.5, scale=-2.0, colour=(1.0, 0.5, 0.25), mean=(0.0, 0.0, 0.0), quat=(1.0, 0.0, 0.0, 0.0)):
    scales = np.broadcast_to(np.asarray(scale, np.float32), (3,))
    return SplatModel(
        means=np.array([mean], np.float32),
        quats=np.array([quat], np.float32),
        scales=scales[None].copy(),
        opacities=np.array([alpha], np.float32),
        sh0=((np.array([colour], np.float32) - 0.5) / SH_C0).astype(np.float32),
    )


def stacked(*models):
    arrays = ("means", "quats", "scales", "opacities", "sh0", "shN")
    return SplatModel(**{name: np.concatenate([getattr(one, name) for one in models]) for name in arrays})


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


def test_one_splat_has_the_values_worked_out_by_hand():
    # σ = 0.5 at distance 4 with a focal length of 80 pixels is 10 pixels; the dilation is 0.3.
    view = camera(65, 49, 80.0)
    result = render(one_splat(alpha=0.5, scale=math.log(0.5)), view)
    variance = 100.0 + DILATION
    for dx, dy in [(0, 0), (5, 0), (0, 7), (-12, 9)]:
        alpha = 0.5 * math.exp(-0.5 * (dx * dx + dy * dy) / variance)
        x, y = 32 + dx, 24 + dy  # the centre of the image is the centre of a pixel
        np.testing.assert_allclose(result.rgb[y, x], np.array([1.0, 0.5, 0.25]) * alpha, atol=1e-6)
        assert result.alpha[y, x] == pytest.approx(alpha, abs=1e-6)
        assert result.depth[y, x] == pytest.approx(4.0 * alpha, abs=1e-5)
    assert result.radii[0] == pytest.approx(3.0 * math.sqrt(variance), rel=1e-6)
    # 0.5 · exp(−½ r²/100.3) falls below 1/255 at r = 31.17 pixels.
    reach = math.sqrt(2.0 * variance * math.log(0.5 * 255.0))
    assert result.alpha[24, 32 + math.floor(reach)] > 0.0
    assert result.alpha[24, 32 - math.floor(reach) - 1] == 0.0


def test_a_needle_is_rotated():
    half = math.sqrt(0.5)
    turned = (half, 0.0, 0.0, half)  # 90° about z: x becomes y, which points down
    picture = render(one_splat(scale=(-1.0, -6.0, -6.0), quat=turned), camera()).alpha
    assert picture[34, 32] > 0.04
    assert picture[24, 42] == 0.0


def test_alpha_is_capped_and_colours_are_clamped_at_zero():
    model = replace(one_splat(alpha=1.0, scale=0.0), sh0=np.array([[-10.0, 0.0, 10.0]], np.float32))
    result = render(model, camera())
    assert result.alpha[24, 32] == pytest.approx(ALPHA_CAP, abs=1e-6)
    assert result.rgb[24, 32] == pytest.approx([0.0, 0.5 * ALPHA_CAP, (0.5 + 10 * SH_C0) * ALPHA_CAP], abs=1e-5)


def test_the_background_shines_through():
    result = render(one_splat(), camera(), background=(0.1, 0.2, 0.3))
    assert result.rgb[0, 0] == pytest.approx([0.1, 0.2, 0.3])
    left = 1.0 - result.alpha[24, 32]
    assert result.rgb[24, 32, 2] == pytest.approx(0.25 * (1 - left) + 0.3 * left, abs=1e-6)


def test_splats_are_drawn_by_depth_then_by_index():
    red, blue = one_splat(0.9, -1.0, (1, 0, 0), (0, 0, 0.5)), one_splat(0.9, -1.0, (0, 0, 1), (0, 0, -0.5))
    both = stacked(red, blue)
    pixel = render(both, camera()).rgb[24, 32]
    assert pixel[2] > 5 * pixel[0]
    level = replace(both, means=np.zeros((2, 3), np.float32))
    pixel = render(level, camera()).rgb[24, 32]
    assert pixel[0] > 5 * pixel[2]


def test_a_pixel_is_finished_before_transmittance_falls_below_the_limit():
    stack = stacked(*[one_splat(alpha=0.95, scale=0.0, colour=(1, 1, 1))] * 5)
    alpha = render(stack, camera(65, 49)).alpha[24, 32]
    # 0.05⁴ is below 1e-4: three are drawn.
    assert alpha == pytest.approx(1 - 0.05**3, abs=1e-6)


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


def assert_survives(case):
    """Render forward and backward in both dtypes; assert finite results near the twin, and return the float32 render.

    Unless they exceed float32, gradients of both dtypes agree, too.
    """
    splats, weights = UncheckedSplats(**case.arrays), random_gradients(case.view, seed=1)
    options = {"antialiased": case.antialiased}
    exact = render(splats, case.view, mode="exact", **options)
    assert np.isfinite(exact.rgb).all()
    pictures = []
    for dtype in (np.float32, np.float64):
        picture, gradients = gradients_of(splats, case.view, weights, dtype, **options)
        values = {"rgb": picture.rgb, "alpha": picture.alpha, "depth": picture.depth, **vars(gradients)}
        assert [] == [name for name, value in values.items() if not np.isfinite(value).all()]
        off = np.abs(picture.rgb - exact.rgb).max(2) > 1 / 255 * max(1.0, np.abs(exact.rgb).max())
        assert off.mean() <= 2e-3
        assert exact.ignored == picture.ignored
        pictures.append(picture)
    if not case.beyond:
        flipped, errors = float32_errors(splats, case.view, weights, **options)
        assert flipped <= 1
        assert max(errors.values()) <= 1e-2, errors
    return pictures[0]


def more_adversarial():
    """Yield cases in addition to `adversarial`: log scales at the limits of float32, and renders of any size."""
    for log_scale in (-60.0, 60.0, 88.0, -88.0, 3e38, -3e38):
        for axes in ((1, 1, 1), (1, 0, 0), (1, 1, 0)):
            arrays = extreme_splats()
            arrays["scales"][:] = np.where(axes, np.float32(log_scale), arrays["scales"])
            yield f"log scales {log_scale:g} on axes {axes}", Case(arrays, facing(), beyond=True)
    for width, height in ((1, 1), (16, 16), (17, 15), (1, 100), (333, 1)):
        yield f"{width} by {height} pixels", Case(extreme_splats(), facing(width=width, height=height), beyond=True)


@pytest.mark.long
def test_adversarial_splats_survive():
    assert [] == failures({**dict(adversarial()), **dict(more_adversarial())}, assert_survives)


@pytest.mark.long
def test_gradients_beyond_float32_are_clamped():
    rasteriser = Rasteriser()
    picture = rasteriser.forward(UncheckedSplats(**extreme_splats(scales=2.0)), facing(focal=1e6))
    g = rasteriser.backward(np.full_like(picture.rgb, 1e30))
    assert all(np.isfinite(value).all() for value in vars(g).values())


@pytest.mark.parametrize("near", [1e-30, 1e-6, 0.2, 3.0])
def test_splats_in_front_of_the_near_plane_are_not_drawn(near):
    arrays = extreme_splats(count=4, degree=0, means=0.0, opacities=0.9)
    arrays["means"][:, 2] = np.float32(near) * np.array([-1.0, 0.5, 0.99, 1.5])
    assert 1 == render(UncheckedSplats(**arrays), facing(near=near, distance=0.0)).drawn


def test_splats_of_alpha_0_are_not_drawn():
    for alpha in (0.0, 1.0):
        picture = render(UncheckedSplats(**extreme_splats(opacities=alpha)), facing())
        assert (picture.alpha.max() > 0.0) == (alpha > 0.0)


@pytest.mark.long
def test_quaternions_of_any_length_survive():
    arrays = extreme_splats()
    arrays["quats"][1::3] *= np.float32(1e30)
    arrays["quats"][2::3] *= np.float32(1e-30)
    plain = {**arrays, "quats": arrays["quats"].copy()}
    plain["quats"][::3] = [1.0, 0.0, 0.0, 0.0]
    arrays["quats"][::3] = 0.0
    found = assert_survives(Case(arrays, facing(), beyond=True))
    np.testing.assert_array_equal(found.rgb, render(UncheckedSplats(**plain), facing()).rgb)


@pytest.mark.long
def test_non_finite_rows_are_ignored_and_counted():
    def check(case):
        name, bad = case
        arrays = extreme_splats(count=30)
        clean = UncheckedSplats(**{key: value[3:].copy() for key, value in arrays.items()})
        arrays[name].reshape(30, -1)[:3, -1] = bad
        found = assert_survives(Case(arrays, facing(), beyond=True))
        assert 3 == found.ignored
        np.testing.assert_array_equal(found.rgb, render(clean, facing()).rgb)

    cases = itertools.product(GROUPS, (np.nan, np.inf, -np.inf))
    assert [] == failures({f"{name} {bad}": (name, bad) for name, bad in cases}, check)


@pytest.mark.long
@pytest.mark.parametrize("degree", [0, 3])
def test_an_empty_scene_renders_as_the_background(degree):
    arrays = extreme_splats(count=0, degree=degree)
    assert_survives(Case(arrays, facing(), beyond=True))
    picture = render(UncheckedSplats(**arrays), facing(), background=(0.1, 0.2, 0.3))
    np.testing.assert_array_equal(picture.rgb, np.broadcast_to(np.float32([0.1, 0.2, 0.3]), (37, 50, 3)))


def test_too_many_intersections_are_refused(monkeypatch):
    monkeypatch.setattr(rasteriser, "MAX_INTERSECTIONS", 100)
    with pytest.raises(LimitError, match="MAX_INTERSECTIONS"):
        render(UncheckedSplats(**extreme_splats(scales=2.0)), facing())


def largest_error(gradients, wanted):
    """Return the largest relative error of any group of parameters."""
    return max(relative_error(getattr(gradients, group), wanted[group]) for group in GROUPS)


@pytest.mark.long
@pytest.mark.parametrize(("degree", "antialiased"), [(0, False), (1, True), (2, False), (3, False), (4, True)])
def test_gradients_agree_with_finite_differences_of_the_twin(degree, antialiased):
    arrays, weights = random_splats(3, degree, seed=degree), random_gradients(VIEW, seed=1)
    options = {"background": (0.2, 0.5, 0.7), "antialiased": antialiased}
    picture, gradients = gradients_of(UncheckedSplats(**arrays), VIEW, weights, **options)
    exact, differences = finite_differences(arrays, VIEW, weights, **options)
    np.testing.assert_allclose(picture.rgb, exact.rgb, atol=1e-12)
    assert largest_error(gradients, differences) <= 1e-6


@pytest.mark.long
@pytest.mark.torch
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_gradients_agree_with_autograd(degree, antialiased):
    pytest.importorskip("torch", reason="autograd is that of torch: pip install 'csplat[train]'")
    from torch_twin import autograd_gradients

    arrays, weights = random_splats(20, degree, seed=degree + 10), random_gradients(VIEW, seed=1)
    options = {"background": (0.2, 0.5, 0.7), "antialiased": antialiased}
    picture, gradients = gradients_of(UncheckedSplats(**arrays), VIEW, weights, **options)
    other, wanted = autograd_gradients(arrays, VIEW, weights, **options)
    np.testing.assert_allclose(picture.rgb, other, atol=1e-12)
    assert largest_error(gradients, wanted) <= 1e-6


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
