"""The rasteriser's pictures: against the exact twin, and against numbers worked out by hand."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("numba", reason="the renderer wants the extra [render]")

from oracle import cropped, difference

from csplat.errors import InputError
from csplat.model import SH_C0, SplatModel
from csplat.ply import read_ply
from csplat_render import Camera, render
from csplat_render.conventions import ALPHA_CAP, DILATION, UncheckedSplats
from csplat_render.rasteriser import Rasteriser
from csplat_render.reference_rasteriser import render_exact


def camera(width=64, height=48, focal=60.0, distance=4.0, **fields):
    viewmat = np.eye(4)
    viewmat[2, 3] = distance
    K = [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]
    return Camera(K, viewmat, width, height, **fields)


def one_splat(alpha=0.5, scale=-2.0, colour=(1.0, 0.5, 0.25), mean=(0.0, 0.0, 0.0), quat=(1.0, 0.0, 0.0, 0.0)):
    scales = np.broadcast_to(np.asarray(scale, np.float32), (3,))
    return SplatModel(
        means=np.array([mean], np.float32),
        quats=np.array([quat], np.float32),
        scales=scales[None].copy(),
        opacities=np.array([alpha], np.float32),
        sh0=((np.array([colour], np.float32) - 0.5) / SH_C0).astype(np.float32),
    )


def scene(count=400, degree=3, seed=0):
    """A random scene of splats of all shapes, none of them degenerate."""
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


def assert_same_picture(model, view, **options):
    fast, exact = render(model, view, **options), render(model, view, mode="exact", **options)
    for found, wanted in ((fast.rgb, exact.rgb), (fast.alpha[..., None], exact.alpha[..., None])):
        off = difference(found, wanted)
        print(f"differs from the twin by {off.most:.1e} at most")
        assert off.share <= 1e-3
        assert off.mean <= 1e-5
    assert np.abs(fast.depth - exact.depth).mean() <= 1e-5 * max(1.0, exact.depth.max())
    assert fast.ignored == exact.ignored


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_random_scenes_look_like_the_twins(degree):
    assert_same_picture(scene(degree=degree, seed=degree), camera(70, 53), background=(0.3, 0.6, 0.1))


def test_antialiased_pictures_look_like_the_twins():
    model = scene(count=300)
    model = replace(model, scales=model.scales - 2, antialiased=True)
    view = camera(64, 48, 40.0)
    assert_same_picture(model, view)
    assert not np.allclose(render(model, view).rgb, render(model, view, antialiased=False).rgb, atol=0.01)


@pytest.mark.slow
def test_the_sample_looks_like_the_twins(sample_path):
    model = read_ply(sample_path)
    centre = np.median(model.means, axis=0)
    spread = float(np.quantile(np.abs(model.means - centre), 0.9))
    viewmat = np.eye(4)
    viewmat[:3, 3] = -centre + [0.0, 0.0, 3.0 * spread]
    view = Camera([[90.0, 0.0, 48.0], [0.0, 90.0, 36.0], [0.0, 0.0, 1.0]], viewmat, 96, 72, near=0.05 * spread)
    result = render(model, view)
    assert result.alpha.mean() > 0.1
    assert_same_picture(model.select(slice(0, None, 8)), view)


@pytest.mark.parametrize("name", ["donut", "lego60k", "fox60k_noreg"])
def test_shared_scenes_look_like_the_twins(data_dir, name):
    path, cameras = data_dir / "ply" / f"{name}.ply", data_dir / "psnr_cameras" / f"{name}.json"
    if not (path.exists() and cameras.exists()):
        pytest.skip(f"{name} is absent")
    model = read_ply(path)
    views = [Camera.from_json(entry) for entry in json.loads(cameras.read_text())]
    assert_same_picture(model.select(slice(0, None, 4)), cropped(views[1], 64, 48))


def test_one_splat_has_the_values_worked_out_by_hand():
    # σ = 0.5 at distance 4 with a focal length of 80 pixels: 10 pixels, and 0.3 of dilation.
    view = camera(65, 49, 80.0)
    result = render(one_splat(alpha=0.5, scale=math.log(0.5)), view)
    variance = 100.0 + DILATION
    for dx, dy in [(0, 0), (5, 0), (0, 7), (-12, 9)]:
        alpha = 0.5 * math.exp(-0.5 * (dx * dx + dy * dy) / variance)
        x, y = 32 + dx, 24 + dy  # the centre of the picture is the centre of a pixel
        np.testing.assert_allclose(result.rgb[y, x], np.array([1.0, 0.5, 0.25]) * alpha, atol=1e-6)
        assert result.alpha[y, x] == pytest.approx(alpha, abs=1e-6)
        assert result.depth[y, x] == pytest.approx(4.0 * alpha, abs=1e-5)
    assert result.radii[0] == pytest.approx(3.0 * math.sqrt(variance), rel=1e-6)
    # 0.5 · exp(−½ r²/100.3) falls below 1/255 at r = 31.17 pixels.
    reach = math.sqrt(2.0 * variance * math.log(0.5 * 255.0))
    assert result.alpha[24, 32 + math.floor(reach)] > 0.0
    assert result.alpha[24, 32 - math.floor(reach) - 1] == 0.0


def test_a_needle_lies_where_its_rotation_says():
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


def test_the_nearer_splat_covers_the_farther_and_equal_depths_go_by_index():
    red, blue = one_splat(0.9, -1.0, (1, 0, 0), (0, 0, 0.5)), one_splat(0.9, -1.0, (0, 0, 1), (0, 0, -0.5))
    names = ("means", "quats", "scales", "opacities", "sh0", "shN")
    both = SplatModel(**{name: np.concatenate([getattr(red, name), getattr(blue, name)]) for name in names})
    pixel = render(both, camera()).rgb[24, 32]
    assert pixel[2] > 5 * pixel[0]
    level = replace(both, means=np.zeros((2, 3), np.float32))
    pixel = render(level, camera()).rgb[24, 32]
    assert pixel[0] > 5 * pixel[2]


def test_a_pixel_is_finished_before_transmittance_falls_below_the_limit():
    count = 5
    one = one_splat(alpha=0.95, scale=0.0, colour=(1, 1, 1))
    names = ("means", "quats", "scales", "opacities", "sh0", "shN")
    stack = SplatModel(**{name: np.repeat(getattr(one, name), count, axis=0) for name in names})
    alpha = render(stack, camera(65, 49)).alpha[24, 32]
    # 0.05⁴ is below 1e-4: three are drawn.
    assert alpha == pytest.approx(1 - 0.05**3, abs=1e-6)


@pytest.mark.parametrize("mode", ["standard", "fast", "exact"])
def test_spherical_harmonics_can_be_cut_off(mode):
    model = scene(count=50)
    flat = replace(model, shN=np.zeros((50, 0, 3), np.float32))
    np.testing.assert_array_equal(
        render(model, camera(), sh_degree=0, mode=mode).rgb, render(flat, camera(), mode=mode).rgb
    )


def test_the_fast_mode_stays_near_the_standard_one():
    model = scene(count=2000)
    standard, fast = render(model, camera()).rgb, render(model, camera(), mode="fast").rgb
    error = math.sqrt(np.mean((standard - fast) ** 2))
    assert 0.0 < error < 0.02


def test_any_number_of_threads_gives_the_same_bits():
    model = scene(count=3000)
    view = camera(100, 75)
    rng = np.random.default_rng(0)
    gradient = rng.standard_normal((75, 100, 3)).astype(np.float32)
    outcomes = []
    for threads in (1, 2, None):
        rasteriser = Rasteriser(threads=threads)
        picture = rasteriser.forward(model, view)
        g = rasteriser.backward(gradient)
        outcomes.append([picture.rgb, picture.alpha, picture.depth, g.means, g.quats, g.scales, g.opacities, g.shN])
    for other in outcomes[1:]:
        for a, b in zip(outcomes[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_buffers_of_earlier_pictures_do_not_show():
    rasteriser = Rasteriser()
    large, small = scene(count=3000), scene(count=20, degree=1, seed=5)
    rasteriser.forward(large, camera(200, 150))
    again = rasteriser.forward(small, camera(33, 17)).rgb
    np.testing.assert_array_equal(again, Rasteriser().forward(small, camera(33, 17)).rgb)


@pytest.mark.parametrize("mode", ["standard", "fast"])
def test_slices_of_depth_one_after_the_other_give_the_same_bits(mode):
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


def test_tiles_that_a_splat_may_touch_are_no_fewer_than_it_touches():
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


def test_rejects_arrays_that_do_not_fit():
    model = scene(count=5)
    bad = UncheckedSplats(model.means, model.quats[:4], model.scales, model.opacities, model.sh0, model.shN)
    with pytest.raises(InputError, match="quats has shape"):
        Rasteriser().forward(bad, camera())
    with pytest.raises(InputError, match="coefficients"):
        Rasteriser().forward(UncheckedSplats(**{**vars(bad), "quats": model.quats, "shN": model.shN[:, :4]}), camera())
    with pytest.raises(InputError, match="mode"):
        render(model, camera(), mode="slow")
    with pytest.raises(InputError, match="dtype"):
        Rasteriser(dtype=np.float16)
    with pytest.raises(InputError, match="forward"):
        Rasteriser().backward(np.zeros((2, 2, 3)))
    with pytest.raises(InputError, match="background"):
        render(model, camera(), background=(0.0, float("nan"), 0.0))
    with pytest.raises(InputError, match="threads"):
        render(model, camera(), threads=0)


def test_the_twin_takes_what_the_rasteriser_takes():
    model = scene(count=30)
    assert render_exact(model, camera()).rgb.dtype == np.float64
    assert render(model, camera(), mode="exact").drawn == 30
