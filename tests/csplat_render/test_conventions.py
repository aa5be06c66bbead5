# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_render.conventions."""

import itertools
import math
import re
from pathlib import Path

import numpy as np
import oracle
import pytest
from oracle import GROUPS, VIEW, Case, extreme_splats, facing, random_gradients, random_splats
from rasteriser_cases import camera, one_splat
from tables import failures

from csplat.errors import LimitError
from csplat_render import conventions, rasteriser, render
from csplat_render.conventions import DILATION, UncheckedSplats


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


def assert_survives(case):
    """Render forward and backward; assert finite results near the twin, and return the render."""
    splats, weights = UncheckedSplats(**case.arrays), random_gradients(case.view, seed=1)
    options = {"antialiased": case.antialiased}
    exact = render(splats, case.view, mode="exact", **options)
    picture, gradients = oracle.gradients_of(splats, case.view, weights, **options)
    values = {"exact": exact.rgb, "rgb": picture.rgb, "alpha": picture.alpha, "depth": picture.depth}
    values |= vars(gradients)
    assert [] == [name for name, value in values.items() if not np.isfinite(value).all()]
    off = np.abs(picture.rgb - exact.rgb).max(2) > 1 / 255 * max(1.0, np.abs(exact.rgb).max())
    assert off.mean() <= 2e-3
    assert exact.ignored == picture.ignored
    return picture


def test_the_compiled_library_has_the_constants_of_the_reference():
    header = (Path(__file__).resolve().parents[2] / "trainer/csplat_render/native/renderer.h").read_text("utf-8")
    for name in ("DILATION", "ALPHA_CAP", "LOG_SCALE_LIMIT", "COMPENSATION_MIN"):
        camel = "k" + name.title().replace("_", "")
        assert getattr(conventions, name) == float(re.search(rf"{camel} = ([\d.e-]+)f?;", header)[1])


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
    assert [] == failures({**dict(oracle.adversarial()), **dict(more_adversarial())}, assert_survives)


def test_transparent_splats_and_splats_in_front_of_the_near_plane_are_not_drawn():
    for near in (1e-30, 1e-6, 0.2, 3.0):
        arrays = extreme_splats(count=4, degree=0, means=0.0, opacities=0.9)
        arrays["means"][:, 2] = np.float32(near) * np.array([-1.0, 0.5, 0.99, 1.5])
        assert 1 == render(UncheckedSplats(**arrays), facing(near=near, distance=0.0)).drawn
    for alpha in (0.0, 1.0):
        assert bool(alpha) == render(UncheckedSplats(**extreme_splats(opacities=alpha)), facing()).alpha.any()


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
def test_an_empty_scene_renders_as_the_background():
    for degree in (0, 3):
        arrays = extreme_splats(count=0, degree=degree)
        assert_survives(Case(arrays, facing(), beyond=True))
        picture = render(UncheckedSplats(**arrays), facing(), background=(0.1, 0.2, 0.3))
        np.testing.assert_array_equal(picture.rgb, np.broadcast_to(np.float32([0.1, 0.2, 0.3]), (37, 50, 3)))


def test_too_many_intersections_are_refused(monkeypatch):
    monkeypatch.setattr(rasteriser, "MAX_INTERSECTIONS", 100)
    with pytest.raises(LimitError, match="MAX_INTERSECTIONS"):
        render(UncheckedSplats(**extreme_splats(scales=2.0)), facing())


def assert_gradients_agree(reference, count, degree, seed, antialiased):
    """Compare a render and its gradients with those of a function for both in float64."""
    arrays, weights = random_splats(count, degree, seed), random_gradients(VIEW, seed=1)
    options = {"background": (0.2, 0.5, 0.7), "antialiased": antialiased}
    flipped, errors = oracle.gradient_errors(arrays, VIEW, weights, reference, **options)
    assert flipped == 0
    assert max(errors.values()) <= 1e-5, errors


@pytest.mark.long
@pytest.mark.parametrize(("degree", "antialiased"), [(0, False), (1, True), (2, False), (3, False), (4, True)])
def test_gradients_agree_with_finite_differences_of_the_twin(degree, antialiased):
    assert_gradients_agree(oracle.finite_differences, 3, degree, degree, antialiased)


@pytest.mark.long
@pytest.mark.torch
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_gradients_agree_with_autograd(degree, antialiased):
    assert_gradients_agree(autograd(), 20, degree, degree + 10, antialiased)


@pytest.mark.long
@pytest.mark.torch
def test_gradients_of_adversarial_splats_agree_with_autograd():
    def check(case):
        weights = random_gradients(case.view, seed=1)
        flipped, errors = oracle.gradient_errors(
            case.arrays, case.view, weights, autograd(), antialiased=case.antialiased
        )
        assert flipped <= 1
        assert max(errors.values()) <= 1e-2, errors

    assert [] == failures({name: case for name, case in oracle.adversarial() if not case.beyond}, check)


def autograd():
    """Return the function of `torch_twin` for a render and its gradients."""
    pytest.importorskip("torch", reason="autograd is that of torch: pip install torch")
    from torch_twin import autograd_gradients

    return autograd_gradients
