"""The rasteriser's gradients: float64 against finite differences of the exact twin, float32 against float64."""

import json

import numpy as np
import pytest

pytest.importorskip("numba", reason="the renderer wants the extra [render]")

from csplat.ply import read_ply
from csplat_render import Camera
from csplat_render.rasterise import Rasteriser, Splats
from csplat_render.twin import Decisions, render_exact

GROUPS = ("means", "quats", "scales", "opacities", "sh0", "shN")

# A turned camera with an unusual centre, near enough that some splats lie beyond the field of view.
VIEWMAT = np.array(
    [[0.98006658, 0.0, 0.19866933, 0.05], [0.0, 1.0, 0.0, -0.03], [-0.19866933, 0.0, 0.98006658, 1.6], [0, 0, 0, 1.0]]
)
VIEW = Camera([[30.0, 0.0, 12.5], [0.0, 28.0, 9.0], [0.0, 0.0, 1.0]], VIEWMAT, 25, 19)


def random_splats(count, degree, seed):
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform((-1.1, -0.9, -0.6), (1.1, 0.9, 0.9), (count, 3)),
        "quats": rng.standard_normal((count, 4)),
        "scales": rng.uniform(-3.0, -0.8, (count, 3)),
        "opacities": rng.uniform(0.2, 1.0, count),
        "sh0": rng.standard_normal((count, 3)),
        "shN": 0.4 * rng.standard_normal((count, (degree + 1) ** 2 - 1, 3)),
    }


def random_gradients(view, seed):
    rng = np.random.default_rng(seed)
    size = (view.H, view.W)
    return rng.standard_normal((*size, 3)), rng.standard_normal(size), rng.standard_normal(size)


def relative_error(value, wanted):
    size = np.linalg.norm(wanted)
    return np.linalg.norm(np.asarray(value, np.float64) - wanted) / size if size else np.linalg.norm(value)


@pytest.mark.parametrize(("degree", "antialiased"), [(0, False), (1, True), (2, False), (3, False), (3, True)])
def test_gradients_are_the_finite_differences_of_the_twin(degree, antialiased):
    arrays = random_splats(9, degree, seed=degree)
    weights = random_gradients(VIEW, seed=1)
    options = {"background": (0.2, 0.5, 0.7), "antialiased": antialiased}
    rasteriser = Rasteriser(dtype=np.float64)
    picture = rasteriser.forward(Splats(**arrays), VIEW, **options)
    gradients = rasteriser.backward(*weights)

    decisions = Decisions()
    exact = render_exact(Splats(**arrays), VIEW, decisions=decisions, **options)
    np.testing.assert_allclose(picture.rgb, exact.rgb, atol=1e-12)

    def loss(changed):
        decisions.replay()
        result = render_exact(Splats(**changed), VIEW, decisions=decisions, **options)
        return sum(np.sum(a * b) for a, b in zip((result.rgb, result.alpha, result.depth), weights, strict=True))

    step = 1e-5
    for group in GROUPS:
        differences = np.zeros_like(arrays[group])
        for index in np.ndindex(differences.shape):
            values = []
            for sign in (1.0, -1.0):
                moved = arrays[group].copy()
                moved[index] += sign * step
                values.append(loss({**arrays, group: moved}))
            differences[index] = (values[0] - values[1]) / (2.0 * step)
        assert relative_error(getattr(gradients, group), differences) <= 1e-6, group


@pytest.mark.parametrize("name", ["donut", "lego60k", "fox120k"])
def test_float32_gradients_are_those_of_float64_on_shared_scenes(data_dir, name):
    path, cameras = data_dir / "ply" / f"{name}.ply", data_dir / "psnr_cameras" / f"{name}.json"
    if not (path.exists() and cameras.exists()):
        pytest.skip(f"{name} is absent")
    model, view = read_ply(path), Camera.from_json(json.loads(cameras.read_text())[0])
    weights = random_gradients(view, seed=2)
    pictures, found = [], []
    for dtype in (np.float32, np.float64):
        rasteriser = Rasteriser(dtype=dtype)
        pictures.append(rasteriser.forward(model, view).rgb)
        found.append(rasteriser.backward(*(weight.astype(dtype) for weight in weights)))
    # Pixels where a comparison (alpha against 1/255, say) fell the other way in float32: each of them
    # gives one splat another gradient, which is left out.
    flipped = int(np.count_nonzero(np.abs(pictures[0] - pictures[1]).max(2) > 1e-4))
    assert flipped <= 10
    for group in GROUPS:
        value, wanted = (np.asarray(getattr(g, group), np.float64).reshape(len(model), -1) for g in found)
        kept = np.argsort(np.square(value - wanted).sum(1))[: len(model) - flipped]
        assert relative_error(value[kept], wanted[kept]) <= 1e-4, group


def test_no_gradient_reaches_what_is_clamped_capped_or_out_of_view():
    arrays = random_splats(4, 0, seed=3)
    arrays["means"][:] = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, -50.0], [90.0, 0.0, 0.0]]
    arrays["scales"][:] = -0.5
    arrays["opacities"][:] = [1.0, 0.5, 0.5, 0.5]
    arrays["sh0"][0] = [-9.0, 1.0, 1.0]
    rasteriser = Rasteriser(dtype=np.float64)
    rasteriser.forward(Splats(**arrays), VIEW)
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
        rasteriser.forward(Splats(**{**arrays, "quats": arrays["quats"] * factor}), VIEW)
        found.append(rasteriser.backward(*weights).quats * factor)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9, atol=1e-12)
    radial = np.sum(found[0] * arrays["quats"], axis=1)
    np.testing.assert_allclose(radial, 0.0, atol=1e-9)


def test_bands_that_were_not_rendered_have_no_gradient():
    arrays = random_splats(6, 3, seed=5)
    rasteriser = Rasteriser(dtype=np.float64)
    rasteriser.forward(Splats(**arrays), VIEW, sh_degree=1)
    g = rasteriser.backward(np.ones((VIEW.H, VIEW.W, 3)))
    assert np.abs(g.shN[:, :3]).max() > 0.0
    assert (g.shN[:, 3:] == 0.0).all()
