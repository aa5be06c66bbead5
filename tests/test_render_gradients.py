"""The rasteriser's gradients: float64 against finite differences of the exact twin, float32 against float64.

`pytest -rP` shows how large the errors are: relative L2, the largest of any group of parameters.
"""

import json

import numpy as np
import pytest

pytest.importorskip("numba", reason="the renderer wants the extra [render]")

from oracle import (
    GROUPS,
    VIEW,
    adversarial,
    finite_differences,
    float32_errors,
    gradients_of,
    random_gradients,
    random_splats,
    relative_error,
)

from csplat.ply import read_ply
from csplat_render import Camera
from csplat_render.conventions import UncheckedSplats
from csplat_render.rasteriser import Rasteriser
from csplat_render.virtual_cameras import virtual_cameras

pytestmark = pytest.mark.area(name="rasteriser")


def most(errors):
    """The largest error; printed."""
    error = max(errors.values())
    print(f"relative error {error:.1e}")
    return error


@pytest.mark.parametrize(("degree", "antialiased"), [(0, False), (1, True), (2, False), (3, False), (3, True)])
def test_gradients_are_the_finite_differences_of_the_twin(degree, antialiased):
    arrays, weights = random_splats(3, degree, seed=degree), random_gradients(VIEW, seed=1)
    options = {"background": (0.2, 0.5, 0.7), "antialiased": antialiased}
    picture, gradients = gradients_of(UncheckedSplats(**arrays), VIEW, weights, **options)
    exact, differences = finite_differences(arrays, VIEW, weights, **options)
    np.testing.assert_allclose(picture.rgb, exact.rgb, atol=1e-12)
    errors = {group: relative_error(getattr(gradients, group), differences[group]) for group in GROUPS}
    assert most(errors) <= 1e-6, errors


@pytest.mark.area(name="torch")
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradients_are_those_of_autograd(degree, antialiased):
    pytest.importorskip("torch", reason="autograd is that of torch: pip install 'csplat[train]'")
    from torch_twin import autograd_gradients

    arrays, weights = random_splats(20, degree, seed=degree + 10), random_gradients(VIEW, seed=1)
    options = {"background": (0.2, 0.5, 0.7), "antialiased": antialiased}
    picture, gradients = gradients_of(UncheckedSplats(**arrays), VIEW, weights, **options)
    other, wanted = autograd_gradients(arrays, VIEW, weights, **options)
    np.testing.assert_allclose(picture.rgb, other, atol=1e-12)
    errors = {group: relative_error(getattr(gradients, group), wanted[group]) for group in GROUPS}
    assert most(errors) <= 1e-6, errors


def test_float32_gradients_are_those_of_float64_on_the_sample(sample_path):
    model = read_ply(sample_path)
    (view,) = virtual_cameras(model, 1, 160, 120)
    flipped, errors = float32_errors(model, view, random_gradients(view, seed=2))
    assert flipped <= 10
    assert most(errors) <= 1e-4, errors


@pytest.mark.parametrize("name", ["donut", "lego60k", "fox120k"])
def test_float32_gradients_are_those_of_float64_on_shared_scenes(data_dir, name):
    path, cameras = data_dir / "ply" / f"{name}.ply", data_dir / "psnr_cameras" / f"{name}.json"
    if not (path.exists() and cameras.exists()):
        pytest.skip(f"{name} is absent")
    model, view = read_ply(path), Camera.from_json(json.loads(cameras.read_text())[0])
    flipped, errors = float32_errors(model, view, random_gradients(view, seed=2))
    assert flipped <= 10
    assert most(errors) <= 1e-4, errors


@pytest.mark.parametrize(("name", "case"), [pytest.param(*pair, id=pair[0]) for pair in adversarial()])
def test_float32_gradients_survive_adversarial_splats(name, case):
    splats, weights = UncheckedSplats(**case.arrays), random_gradients(case.view, seed=1)
    _, found = gradients_of(splats, case.view, weights, np.float32, antialiased=case.antialiased)
    for group in GROUPS:
        assert np.isfinite(getattr(found, group)).all(), (name, group)
    if case.beyond:
        return
    flipped, errors = float32_errors(splats, case.view, weights, antialiased=case.antialiased)
    assert flipped <= 1
    assert most(errors) <= 1e-2, (name, errors)


def test_no_gradient_reaches_what_is_clamped_capped_or_out_of_view():
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


def test_the_gradient_ignores_the_length_of_a_quaternion():
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


def test_bands_that_were_not_rendered_have_no_gradient():
    arrays = random_splats(6, 3, seed=5)
    rasteriser = Rasteriser(dtype=np.float64)
    rasteriser.forward(UncheckedSplats(**arrays), VIEW, sh_degree=1)
    g = rasteriser.backward(np.ones((VIEW.H, VIEW.W, 3)))
    assert np.abs(g.shN[:, :3]).max() > 0.0
    assert (g.shN[:, 3:] == 0.0).all()
