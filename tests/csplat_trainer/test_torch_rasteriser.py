"""The torch rasteriser and the perceptual loss, against their counterparts on the CPU."""

import numpy as np
import pytest

from csplat.errors import InputError
from csplat_render import lpips
from csplat_render.camera import Camera
from csplat_trainer import torch_rasteriser
from csplat_trainer.losses import PerceptualLoss

torch = pytest.importorskip("torch", reason="the torch wrapper requires torch (the train extra)")
pytestmark = pytest.mark.torch


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
    scales = np.full((6, 3), -1.0, np.float32) + 0.3 * np.eye(6, 3, dtype=np.float32)
    inputs = tensors_of(make_model(6, degree, seed=5, scales=scales), torch.float64)
    weight = torch.tensor(np.random.default_rng(0).standard_normal((20, 24, 3)))

    def loss(*tensors):
        picture = torch_rasteriser.render(*tensors, camera, background=(0.2, 0.4, 0.6), antialiased=antialiased)
        return (picture * weight).sum()

    # Alpha jumps at 1/255, where the render has no derivative: a step of 1e-7 meets few such pixels.
    loss(*inputs).backward()
    rng, step = np.random.default_rng(1), 1e-7
    for tensor in (one for one in inputs if one.numel()):
        direction = torch.tensor(rng.standard_normal(tensor.shape))
        with torch.no_grad():
            up, down = (loss(*(t + h * direction if t is tensor else t for t in inputs)) for h in (step, -step))
        expected = float((up - down) / (2 * step))
        assert float((tensor.grad * direction).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_gradients_of_two_renders_are_independent(make_model, camera):
    inputs = tensors_of(make_model(6, 1), torch.float32)

    def sums():
        return [torch_rasteriser.render(*inputs, camera, background=(value,) * 3).sum() for value in (0.0, 1.0)]

    together = torch.autograd.grad(sum(sums()), inputs)
    alone = [torch.autograd.grad(one, inputs) for one in sums()]
    for gradient, *parts in zip(together, *alone, strict=True):
        assert torch.allclose(gradient, sum(parts), rtol=1e-5, atol=1e-5)


def test_mixed_types_are_refused(make_model, camera):
    inputs = tensors_of(make_model(2, 0), torch.float32)
    inputs[1] = inputs[1].double()
    with pytest.raises(InputError, match="all float32 or all float64"):
        torch_rasteriser.render(*inputs, camera)


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
