# SPDX-License-Identifier: Apache-2.0
"""The rasteriser: renders and gradients against the exact twin, numbers worked out by hand, and adversarial inputs.

Also: csplat_render.reference_rasteriser.
"""

import itertools
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import oracle
import pytest
from models import with_facts
from oracle import VIEW, extreme_splats, facing, random_gradients, random_splats
from rasteriser_cases import camera

from csplat.context import Context
from csplat.errors import InputError, LimitError
from csplat.model import SplatModel, normalise_quats
from csplat.ply import read_ply
from csplat_render import rasteriser, render
from csplat_render.conventions import UncheckedSplats
from csplat_render.rasteriser import Rasteriser
from csplat_render.virtual_cameras import virtual_cameras


def scene(count=400, degree=3, seed=0):
    """Return random splats of all shapes without degenerate ones."""
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.uniform(-1.2, 1.2, (count, 3)),
        "quats": normalise_quats(rng.standard_normal((count, 4))),
        "scales": rng.uniform(-5.0, -0.8, (count, 3)),
        "opacities": rng.random(count),
        "sh0": rng.standard_normal((count, 3)),
        "shN": 0.3 * rng.standard_normal((count, (degree + 1) ** 2 - 1, 3)),
    }
    return SplatModel(**{name: array.astype(np.float32) for name, array in arrays.items()})


def assert_same_render(model, view, **options):
    fast, exact = render(model, view, **options), render(model, view, mode="exact", **options)
    for found, wanted in ((fast.rgb, exact.rgb), (fast.alpha[..., None], exact.alpha[..., None])):
        off = oracle.difference(found, wanted)
        assert off.share <= 1e-3
        assert off.mean <= 1e-5
    assert np.abs(fast.depth - exact.depth).mean() <= 1e-5 * max(1.0, exact.depth.max())
    assert fast.ignored == exact.ignored


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_renders_of_random_scenes_agree_with_the_twin(degree):
    assert_same_render(scene(degree=degree, seed=degree), camera(70, 53), background=(0.3, 0.6, 0.1))


def test_antialiased_renders_agree_with_the_twin():
    model, view = scene(count=300), camera(64, 48, 40.0)
    model = with_facts(replace(model, scales=model.scales - 2), antialiased=True)
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
    standard, fast = (render(scene(count=2000), camera(), mode=mode).rgb for mode in ("standard", "fast"))
    assert 0.0 < math.sqrt(np.mean((standard - fast) ** 2)) < 0.02


def test_neither_threads_nor_earlier_renders_change_a_bit():
    model, view = scene(count=3000), camera(100, 75)
    gradient = np.random.default_rng(0).standard_normal((75, 100, 3)).astype(np.float32)

    def outcome(rasteriser):
        picture, g = rasteriser.forward(model, view), rasteriser.backward(gradient)
        return [picture.rgb, picture.alpha, picture.depth, g.means, g.quats, g.scales, g.opacities, g.shN]

    used = Rasteriser()
    first = used.forward(scene(count=4000, degree=1, seed=5), camera(200, 150)).rgb
    kept, wanted = first.copy(), outcome(Rasteriser(context=Context(threads=1)))
    for other in (Rasteriser(context=Context(threads=2)), used):
        assert all(map(np.array_equal, wanted, outcome(other)))
    np.testing.assert_array_equal(kept, first)  # results belong to the caller


@pytest.mark.parametrize("mode", ["standard", "fast"])
def test_rendering_in_slices_of_depth_gives_the_same_bits(mode):
    model, view, behind = scene(), camera(70, 53), (0.3, 0.6, 0.1)
    rasteriser = Rasteriser(mode)
    wanted = rasteriser.forward(model, view, background=behind)
    seen = rasteriser.find_visible(model, view)
    near = seen.near
    assert wanted.drawn == np.count_nonzero(near)
    limits = np.quantile(near[near > 0], [0.0, 0.1, 0.4, 0.4, 0.9, 1.0])  # one slice is empty
    state, found = rasteriser.initial_state(view), wanted
    for first, last in itertools.pairwise([*limits[:-1], np.inf]):
        part = model.select((near >= first) & (near < last))
        found = rasteriser.forward(part, view, background=behind, state=state)
    for name in ("rgb", "alpha", "depth"):
        np.testing.assert_array_equal(getattr(wanted, name), getattr(found, name))
    assert wanted.intersections <= seen.tiles.sum() <= 2 * wanted.intersections  # an estimate from above


def test_invalid_arrays_and_options_are_refused():
    model, view, other = scene(count=5), camera(), camera(width=65)
    plain, sliced = Rasteriser(), Rasteriser()
    sliced.forward(model, view, state=sliced.initial_state(view))
    bad = UncheckedSplats(model.means, model.quats[:4], model.scales, model.opacities, model.sh0, model.shN)
    short = UncheckedSplats(**{**vars(bad), "quats": model.quats, "shN": model.shN[:, :4]})
    for message, call in {
        "quats has shape": lambda: plain.forward(bad, view),
        "coefficients": lambda: plain.forward(short, view),
        "mode": lambda: render(model, view, mode="slow"),
        "forward": lambda: Rasteriser().backward(np.zeros((2, 2, 3))),
        "background": lambda: render(model, view, background=(0.0, float("nan"), 0.0)),
        "all splats": lambda: sliced.backward(np.zeros((view.H, view.W, 3))),
        "state": lambda: plain.forward(model, view, state=plain.initial_state(other)),
    }.items():
        with pytest.raises(InputError, match=message):
            call()


@pytest.mark.long
def test_gradients_beyond_float32_are_clamped():
    rasteriser = Rasteriser()
    picture = rasteriser.forward(UncheckedSplats(**extreme_splats(scales=2.0)), facing(focal=1e6))
    g = rasteriser.backward(np.full_like(picture.rgb, 1e30))
    assert all(np.isfinite(value).all() for value in vars(g).values())


def gradients(arrays, *weights, **options):
    """Return the gradients of the sum of all colours, or a weighted sum."""
    rasteriser = Rasteriser()
    rasteriser.forward(UncheckedSplats(**arrays), VIEW, **options)
    return rasteriser.backward(*(weights or [np.ones((VIEW.H, VIEW.W, 3))]))


@pytest.mark.long
def test_clamped_capped_or_invisible_values_have_no_gradient():
    arrays = random_splats(4, 0, seed=3)
    arrays["means"][:] = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, -50.0], [90.0, 0.0, 0.0]]
    arrays["scales"][:] = -0.5
    arrays["opacities"][:] = [1.0, 0.5, 0.5, 0.5]
    arrays["sh0"][0] = [-9.0, 1.0, 1.0]
    g = gradients(arrays)
    assert g.sh0[0, 0] == 0.0 < g.sh0[0, 1]
    for values in (g.means, g.opacities, g.radii, g.means2d):
        assert not values[2:].any()


@pytest.mark.long
def test_gradients_ignore_the_length_of_a_quaternion():
    arrays, weights = random_splats(6, 0, seed=4), random_gradients(VIEW, seed=4)
    plain, longer = (
        factor * gradients(arrays | {"quats": arrays["quats"] * factor}, *weights).quats for factor in (1.0, 10.0)
    )
    np.testing.assert_allclose(plain, longer, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(np.sum(plain * arrays["quats"], axis=1), 0.0, atol=1e-4)


@pytest.mark.long
def test_ignored_sh_bands_have_no_gradient():
    shN = gradients(random_splats(6, 3, seed=5), sh_degree=1).shN
    assert np.abs(shN[:, :3]).max() > 0.0
    assert not shN[:, 3:].any()


def test_calls_of_several_threads_wait_for_each_other_and_a_failed_call_leaves_nothing_for_gradients(monkeypatch):
    small, large, view = scene(count=20), scene(count=3000), camera(100, 75)
    shared, wanted = Rasteriser(), {id(model): Rasteriser().forward(model, view).rgb for model in (small, large)}
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda model: (id(model), shared.forward(model, view).rgb), [small, large] * 10))
    for number, rgb in found:
        np.testing.assert_array_equal(wanted[number], rgb)
    monkeypatch.setattr(rasteriser, "MAX_INTERSECTIONS", 100)
    with pytest.raises(LimitError):
        shared.forward(large, view)
    assert np.count_nonzero(shared.find_visible(large, view).near)  # for slices, without a limit
    with pytest.raises(InputError, match="forward"):
        shared.backward(np.zeros((75, 100, 3)))
