# SPDX-License-Identifier: Apache-2.0
"""Training, tuning and measuring through gsplat's interface, for which `gsplat_twin` stands in, against the CPU.

Also: csplat_trainer.gsplat_derivatives.
"""

import numpy as np
import pytest
from captures import cameras, shell, training_images
from gsplat_twin import rasterization
from models import with_facts
from oracle import facing

from csplat import EncodeOptions, Target
from csplat.errors import InputError
from csplat_render import render
from csplat_render.camera import Camera
from csplat_render.pruning_error import measure_pruning_error
from csplat_tools.training import tuning_run
from csplat_tools.training.tuning_run import choose_and_finetune
from csplat_tools.views import ViewSet
from csplat_trainer import gsplat_rasteriser, training_loop
from csplat_trainer.gsplat_derivatives import estimate_pruning, estimate_sensitivity, splats_of
from csplat_trainer.gsplat_rasteriser import GsplatRasteriser
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.torch_parameters import memory_errors
from csplat_trainer.torch_rasteriser import CpuRasteriser, SplatTensors
from csplat_trainer.training_options import TrainOptions
from csplat_trainer.tuning import FinetuneOptions

torch = pytest.importorskip("torch", reason="the GPU engine requires torch (the train extra)")
pytestmark = pytest.mark.torch
CPU, BLACK = torch.device("cpu"), np.zeros(3, np.float32)
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat needs a GPU")


@pytest.fixture
def camera() -> Camera:
    return facing(focal=30.0, distance=6.0, width=24, height=20)


@pytest.fixture
def stand_in(monkeypatch):
    """Let device cuda be the CPU."""

    def start(self, *, antialiased, rasterization=None, **_):
        return original(self, antialiased=antialiased, rasterization=rasterization or twin, device="cpu")

    original, twin = GsplatRasteriser.__init__, rasterization
    monkeypatch.setattr(GsplatRasteriser, "__init__", start)


@pytest.mark.parametrize("antialiased", [False, True])
def test_renders_and_gradients_equal_those_of_the_cpu(make_model, camera, antialiased):
    found = []
    for rasteriser in (
        CpuRasteriser(antialiased=antialiased),
        GsplatRasteriser(antialiased=antialiased, rasterization=rasterization, device="cpu"),
    ):
        splats = SplatTensors(*(tensor.requires_grad_() for tensor in splats_of(make_model(40, 3, seed=1), CPU)))
        render = rasteriser.render(splats, camera, torch.ones(3), 2)
        render.image.square().sum().backward()
        gradients = [tensor.grad for tensor in (*splats, render.means2d)]
        found.append([render.image.detach(), render.drawn, *gradients])
    for expected, tensor in zip(*found, strict=True):
        assert torch.allclose(expected, tensor, rtol=1e-4, atol=1e-4)


@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize("strategy", ["mcmc", "gradient"])
def test_device_cuda_trains_as_torch_on_the_cpu(make_model, strategy):
    brief = {"max_splats": 60, "sh_degree": 1, "iterations": 8, "refine_start": 2, "refine_every": 2}
    engines = {"engine": "torch"}, {"device": "cuda"}
    options = [TrainOptions(**brief, **engine, strategy=strategy) for engine in engines]
    losses = [training_loop.train(training_images(make_model), one).log["losses"] for one in options]
    assert np.allclose(*losses, rtol=1e-3)


def test_a_full_or_missing_gpu_is_reported():
    with pytest.raises(InputError, match=r"--max-splats.*--size"), memory_errors():
        raise torch.OutOfMemoryError("2 GiB")
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(InputError, match="finds no GPU"):
        gsplat_rasteriser.gsplat_rasterization()


@pytest.mark.usefixtures("stand_in")
def test_a_scene_is_pruned_and_tuned_to_a_size(monkeypatch):
    monkeypatch.setattr(tuning_run, "SPLAT_BYTES", 15)  # small files have a larger share of overhead
    model = shell(8)
    around = ViewSet("cameras", (0.0, 0.0, 0.0), cameras(6)[:2], (), ())
    options = FinetuneOptions(iterations=8, validate_every=4, warm_up=2, device="cuda", lambda_=1e-3)
    tuned = choose_and_finetune(model, around, EncodeOptions("small"), options, Target(size=3600))
    assert 2800 < tuned.size_bytes <= 3600
    assert 240 == len(tuned.made.decoded)
    with pytest.raises(InputError, match="more than 300"):
        choose_and_finetune(model, around, EncodeOptions("small"), options, Target(size=300))


def spread(make_model, **fields):
    """Return a model of eight large splats, and gsplat's rasteriser."""
    model = make_model(8, 1, seed=5, scales=np.full((8, 3), -1.0, np.float32), **fields)
    return model, GsplatRasteriser(antialiased=False, rasterization=rasterization, device="cpu")


def test_estimates_agree_with_the_measured_derivatives(make_model, camera):
    model, rasteriser = spread(make_model, opacities=np.full(8, 0.4, np.float32))
    expected = measure_sensitivity(model, [camera], metric=True, magnitudes=False)
    estimate = estimate_sensitivity(rasteriser, model, [camera] * 60, BLACK)
    for name in ("colour_squares", "opacity_squares", "shape_squares", "means_squares"):
        exact = getattr(expected, name)
        assert np.allclose(getattr(estimate, name), exact, rtol=0.5, atol=0.1 * exact.max()), name
        assert getattr(estimate, name).sum() == pytest.approx(exact.sum(), rel=0.2), name
    for name in ("shape_metric", "metric"):
        exact = getattr(expected, name)
        assert np.abs(getattr(estimate, name) - exact).max() < 0.3 * np.abs(exact).max()


def test_pruning_errors_agree_with_the_measured_ones(make_model, camera):
    model, rasteriser = spread(make_model)
    exact = measure_pruning_error(model, [camera])
    estimate = estimate_pruning(rasteriser, model, [camera] * 60, BLACK)
    assert np.array_equal(exact.seen, estimate.seen)
    assert np.allclose(estimate.error / 60, exact.error, rtol=0.5, atol=0.1 * exact.error.max())


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplat_renders_as_the_cpu_does(make_model, camera, antialiased):
    model = make_model(40, 3, seed=1)
    rasteriser = GsplatRasteriser(antialiased=antialiased)
    splats, behind = splats_of(model, rasteriser.device), torch.zeros(3, device=rasteriser.device)
    found = rasteriser.render(splats, camera, behind, 3).image
    expected = render(with_facts(model, antialiased=antialiased), camera).rgb
    assert np.abs(found.cpu().numpy() - expected).mean() < 2e-3
