# ruff: noqa: E402 -- the tests are skipped before the imports of the trainer if torch is absent
"""The torch rasteriser, the GPU engine and the perceptual loss, against their counterparts on the CPU."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the torch wrapper requires torch (the train extra)")

from csplat.errors import InputError
from csplat_render import lpips
from csplat_render.camera import Camera
from csplat_trainer import gsplat_engine, torch_rasteriser
from csplat_trainer.engine import CpuEngine
from csplat_trainer.losses import PerceptualLoss
from csplat_trainer.parameters import GROUPS, Parameters, from_model
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.training_options import TrainOptions

pytestmark = pytest.mark.area(name="torch")


@pytest.fixture
def camera() -> Camera:
    viewmat = np.eye(4)
    viewmat[2, 3] = 6.0
    return Camera(np.array([[30.0, 0, 12], [0, 30.0, 10], [0, 0, 1]]), viewmat, 24, 20)


def tensors_of(model, dtype):
    arrays = (model.means, model.quats, model.scales, model.opacities, model.sh0, model.shN)
    return [torch.tensor(array, dtype=dtype, requires_grad=True) for array in arrays]


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 3])
def test_gradients_agree_with_finite_differences(make_model, camera, degree, antialiased):
    model = make_model(
        6, degree, seed=5, scales=np.full((6, 3), -1.0, np.float32) + 0.3 * np.eye(6, 3, dtype=np.float32)
    )
    inputs = tensors_of(model, torch.float64)
    weight = torch.tensor(np.random.default_rng(0).standard_normal((20, 24, 3)))

    def loss(*tensors):
        return (
            torch_rasteriser.render(*tensors, camera, background=(0.2, 0.4, 0.6), antialiased=antialiased) * weight
        ).sum()

    # Alpha jumps at 1/255, where the render has no derivative: a step of 1e-7 meets few such pixels.
    loss(*inputs).backward()
    rng = np.random.default_rng(1)
    for tensor in inputs:
        if tensor.numel() == 0:
            continue
        direction = torch.tensor(rng.standard_normal(tensor.shape))
        step = 1e-7
        with torch.no_grad():
            up, down = (
                loss(*(one + sign * step * direction if one is tensor else one for one in inputs)) for sign in (1, -1)
            )
        expected = float((up - down) / (2 * step))
        assert float((tensor.grad * direction).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_gradients_of_two_renders_are_independent(make_model, camera):
    inputs = tensors_of(make_model(6, 1), torch.float32)
    first, second = (torch_rasteriser.render(*inputs, camera, background=(value,) * 3) for value in (0.0, 1.0))
    together = torch.autograd.grad((first + second).sum(), inputs)
    alone = [
        torch.autograd.grad(torch_rasteriser.render(*inputs, camera, background=(v,) * 3).sum(), inputs)
        for v in (0.0, 1.0)
    ]
    for got, *wanted in zip(together, *alone, strict=True):
        assert torch.allclose(got, sum(wanted), rtol=1e-5, atol=1e-5)


def test_mixed_types_are_refused(make_model, camera):
    inputs = tensors_of(make_model(2, 0), torch.float32)
    inputs[1] = inputs[1].double()
    with pytest.raises(InputError, match="all float32 or all float64"):
        torch_rasteriser.render(*inputs, camera)


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, sh_degree, backgrounds, **rest
):
    """Render with the CPU rasteriser, with the arguments of gsplat's function of this name."""
    camera = Camera(Ks[0].double().numpy(), viewmats[0].double().numpy(), width, height, near_plane)
    picture = torch_rasteriser.render(
        means, quats, scales.log(), opacities, colors[:, 0], colors[:, 1:], camera,
        background=tuple(backgrounds[0].tolist()), antialiased=rest["rasterize_mode"] == "antialiased",
        sh_degree=sh_degree,
    )  # fmt: skip
    return picture[None], None, {}


@pytest.mark.parametrize("loss", ["inria", "study"])
def test_the_gpu_engine_takes_the_same_steps(make_model, camera, loss):
    options = TrainOptions(strategy="fixed", loss=loss, noise=0.0, max_splats=12)
    pixels = np.random.default_rng(0).integers(0, 255, (20, 24, 4)).astype(np.uint8)
    starts = [Parameters.starting_at(from_model(make_model(12, 1), 1)) for _ in range(2)]
    gpu = gsplat_engine.GsplatEngine(starts[1], options, rasterization, "cpu")
    engines, figures = [CpuEngine(starts[0], options), gpu], []
    for engine in engines:
        rng = np.random.default_rng(0)
        for step in range(1, 6):
            rates = options.learning_rates(step, 1.0)
            value = engine.step(PosedImage(camera, pixels), np.ones(3, np.float32), 1, rates, rng)
        figures.append(value)
    assert figures[0].loss == pytest.approx(figures[1].loss, rel=1e-4)
    for name in GROUPS:
        assert np.allclose(engines[0].parameters.values[name], engines[1].parameters.values[name], atol=2e-3)
    pictures = [engine.render(camera, np.zeros(3, np.float32), 1) for engine in engines]
    assert np.abs(pictures[0] - pictures[1]).mean() < 1e-3


def test_a_missing_gpu_is_refused():
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(InputError, match="finds no GPU"):
        gsplat_engine.gsplat_rasterization()


def test_the_perceptual_loss_agrees_with_lpips_and_finite_differences():
    rng = np.random.default_rng(0)
    shapes = [shape for shape, *_ in lpips._LAYERS]
    weights = lpips.Lpips(
        kernels=tuple(rng.standard_normal(s).astype(np.float32) / np.float32(np.sqrt(np.prod(s[:3]))) for s in shapes),
        biases=tuple(rng.standard_normal(s[3]).astype(np.float32) for s in shapes),
        heads=tuple(rng.random(s[3]).astype(np.float32) for s in shapes),
        source="random",
    )
    x, y = (rng.random((64, 64, 3), dtype=np.float32) for _ in range(2))
    perceptual = PerceptualLoss(weights)
    assert weights(y, x) == pytest.approx(perceptual.distance(x, y), abs=1e-5)
    slope = perceptual.gradient(x, y, 2.0)
    length = np.linalg.norm(slope)
    up, down = (2 * perceptual.distance(x + sign * 1e-3 * slope / length, y) for sign in (1, -1))
    assert (up - down) / 2e-3 == pytest.approx(length, rel=0.02)
