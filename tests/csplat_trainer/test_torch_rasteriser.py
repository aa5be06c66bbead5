# SPDX-License-Identifier: Apache-2.0
"""The torch rasteriser and the perceptual loss, against their counterparts on the CPU."""

import numpy as np
import pytest

from csplat.errors import InputError
from csplat_render import lpips
from csplat_render.camera import Camera
from csplat_render.rasteriser import Rasteriser
from csplat_trainer import torch_rasteriser
from csplat_trainer.losses import PerceptualLoss
from csplat_trainer.torch_rasteriser import CpuRasteriser, SplatTensors

torch = pytest.importorskip("torch", reason="the torch wrapper requires torch (the train extra)")
pytestmark = pytest.mark.torch


@pytest.fixture
def camera() -> Camera:
    viewmat = np.eye(4)
    viewmat[2, 3] = 6.0
    return Camera(np.array([[30.0, 0, 12], [0, 30.0, 10], [0, 0, 1]]), viewmat, 24, 20)


def tensors_of(model):
    return SplatTensors(*(torch.tensor(getattr(model, name), requires_grad=True) for name in SplatTensors._fields))


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 3])
def test_gradients_agree_with_plain_torch(make_model, camera, degree, antialiased):
    from torch_twin import render_torch

    scales = np.full((6, 3), -1.0, np.float32) + 0.3 * np.eye(6, 3, dtype=np.float32)
    inputs = tensors_of(make_model(6, degree, seed=5, scales=scales))
    twins = {name: tensor.detach().double().requires_grad_() for name, tensor in inputs._asdict().items()}
    weight, behind = torch.tensor(np.random.default_rng(0).standard_normal((20, 24, 3))), (0.2, 0.4, 0.6)
    image = torch_rasteriser.render(*inputs, camera, background=behind, antialiased=antialiased)
    expected = render_torch(twins, camera, behind, antialiased)[0]
    assert torch.allclose(expected.float(), image, atol=1e-5)
    (image * weight.float()).sum().backward()
    (expected * weight).sum().backward()
    for tensor, twin in zip(inputs, twins.values(), strict=True):
        assert torch.allclose(twin.grad.float(), tensor.grad, rtol=1e-3, atol=1e-3)


def test_positions_on_screen_get_the_norms_of_their_gradients(make_model, camera):
    model = make_model(40, 1, seed=2)
    render = CpuRasteriser(antialiased=False).render(tensors_of(model), camera, torch.zeros(3), 1)
    slope = np.random.default_rng(0).standard_normal((20, 24, 3), dtype=np.float32)
    render.image.backward(torch.from_numpy(slope))
    rasteriser = Rasteriser()
    rasteriser.forward(model, camera)
    expected = rasteriser.backward(slope)
    assert np.array_equal(expected.means2d, render.means2d.grad[:, 0].numpy())
    assert np.array_equal(expected.radii > 0, render.drawn.numpy())
    assert 0 < render.drawn.sum() < 40


def test_gradients_of_two_renders_are_independent(make_model, camera):
    inputs = tensors_of(make_model(6, 1))

    def sums():
        return [torch_rasteriser.render(*inputs, camera, background=(value,) * 3).sum() for value in (0.0, 1.0)]

    together = torch.autograd.grad(sum(sums()), inputs)
    alone = [torch.autograd.grad(one, inputs) for one in sums()]
    for gradient, *parts in zip(together, *alone, strict=True):
        assert torch.allclose(gradient, sum(parts), rtol=1e-5, atol=1e-5)


def test_other_types_are_refused(make_model, camera):
    inputs = tensors_of(make_model(2, 0))
    with pytest.raises(InputError, match=r"quats is torch.float64, expected torch.float32"):
        torch_rasteriser.render(*inputs._replace(quats=inputs.quats.double()), camera)


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
