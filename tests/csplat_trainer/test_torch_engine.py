# SPDX-License-Identifier: Apache-2.0
"""Training in torch on the CPU, against the native engine.

Also: csplat_trainer.torch_losses, csplat_trainer.torch_parameters.
"""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from captures import photograph_object, shell, training_images
from command_line import call
from oracle import facing
from train_cases import QUICK

from csplat.errors import InputError
from csplat_render.camera import Camera
from csplat_tools.training.training_run import tuning_after
from csplat_trainer import training_loop
from csplat_trainer.engine import CpuEngine
from csplat_trainer.fitter import Fitter
from csplat_trainer.image_gains import ImageGain, ImageGains
from csplat_trainer.losses import LOSS_WEIGHTS, LossValue, photometric_loss_twin
from csplat_trainer.parameters import GROUPS, Parameters, from_model
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.strategies import ScreenGradients, densify, grow, relocate, reset_opacities
from csplat_trainer.torch_engine import TorchEngine
from csplat_trainer.torch_losses import DeviceImages, TorchLoss
from csplat_trainer.torch_parameters import DeviceParameters
from csplat_trainer.torch_rasteriser import CpuRasteriser
from csplat_trainer.training_options import Outputs, TrainOptions

torch = pytest.importorskip("torch", reason="the engine requires torch (the train extra)")
pytestmark = pytest.mark.torch
CPU, BLACK = torch.device("cpu"), np.zeros(3, np.float32)


@pytest.fixture
def camera() -> Camera:
    return facing(focal=30.0, distance=6.0, width=24, height=20)


@pytest.fixture
def image(camera) -> PosedImage:
    return PosedImage(camera, np.random.default_rng(0).integers(0, 255, (20, 24, 4)).astype(np.uint8))


@pytest.mark.parametrize("size", [(1, 1), (3, 40), (37, 21)])
@pytest.mark.parametrize("name", LOSS_WEIGHTS)
def test_the_loss_equals_its_twin(size, name):
    rng = np.random.default_rng(0)
    x, y = (rng.random((*size, 3), dtype=np.float32) for _ in range(2))
    value, slope = TorchLoss(name, CPU)(torch.from_numpy(x), torch.from_numpy(y))
    expected, wanted = photometric_loss_twin(x, y, *LOSS_WEIGHTS[name])
    assert value.read().loss == pytest.approx(expected.loss, rel=1e-5)
    assert value.read().mse == pytest.approx(expected.mse, rel=1e-5)
    assert np.abs(slope.numpy() - wanted).max() <= 1e-5 * np.abs(wanted).max()


def test_masked_pixels_do_not_count():
    rng = np.random.default_rng(0)
    x, y = (torch.from_numpy(rng.random((9, 9, 3), dtype=np.float32)) for _ in range(2))
    mask, losses = torch.ones((9, 9), dtype=torch.bool), []
    mask[3:5] = False
    for value in (0.0, 1.0):
        y[3:5] = value
        loss, slope = TorchLoss("inria", CPU)(x, y, mask)
        losses.append(loss.read())
        assert not slope[3:5].any()
    assert losses[0] == losses[1]


def test_images_are_kept_on_the_device_as_far_as_they_fit(image):
    images = DeviceImages(CPU)
    images._bytes_left = 2000.0
    shown = images.reference(image, torch.ones(3))
    assert torch.equal(shown, images.reference(image, torch.ones(3)))
    assert 1 == len(images._kept)
    images.reference(replace(image), torch.ones(3))
    assert 1 == len(images._kept)


@pytest.mark.parametrize("gains", [False, True])
@pytest.mark.parametrize(("strategy", "loss"), [("fixed", "inria"), ("fixed", "study"), ("gradient", "l1")])
def test_the_engine_takes_the_same_steps(make_model, image, strategy, loss, gains):
    options = TrainOptions(strategy=strategy, loss=loss, max_splats=12)
    starts = [Parameters.starting_at(from_model(make_model(12, 1), 1)) for _ in range(2)]
    engines = CpuEngine(starts[0], options), TorchEngine(starts[1], options, CpuRasteriser(antialiased=False))
    losses, corrections = [], []
    for engine in engines:
        rng, of_all = np.random.default_rng(0), ImageGains(2)
        for step in range(1, 6):
            gain = ImageGain(of_all, 0, 1e-2) if gains else None
            value = engine.step(image, np.ones(3, np.float32), 1, options.learning_rates(step, 1.0), rng, gain)
        losses.append(value.read().loss)
        corrections.append(of_all.values)
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)
    assert np.allclose(*corrections, atol=1e-4)
    for name in GROUPS:
        assert np.allclose(*(engine.parameters.on_cpu().values[name] for engine in engines), atol=2e-3)
    if strategy == "gradient":
        assert np.allclose(*(engine.screen.mean for engine in engines), rtol=1e-2)
    renders = [engine.render(image.camera, BLACK, 1) for engine in engines]
    assert np.abs(renders[0] - renders[1]).mean() < 1e-3


def strategies(parameters):
    """Let every strategy act once."""
    rng = np.random.default_rng(0)
    parameters.write("logits", np.arange(4), np.full(4, -9.0, np.float32))
    relocate(parameters, 0.005, rng)
    grow(parameters, 1.5, 60, 0.005, rng)
    screen = ScreenGradients(np.linspace(0.0, 1.0, len(parameters)), np.ones(len(parameters), np.int64))
    parameters.write("logits", np.arange(3), np.full(3, -9.0, np.float32))
    parameters.write("scales", np.arange(30, 40), np.full((10, 3), -1.0, np.float32))
    densify(parameters, screen, 1.0, 0.5, 80, 0.005, rng)
    reset_opacities(parameters)
    return parameters


def test_strategies_act_alike_on_a_device(make_model):
    starts = [Parameters.starting_at(from_model(make_model(40, 1), 1)) for _ in range(2)]
    for start in starts:
        start.first["means"][:] = start.second["shN"][:] = 1.0
    found = strategies(DeviceParameters(starts[1], CPU)).on_cpu()
    expected = strategies(starts[0])
    for part in ("values", "first", "second"):
        for name in GROUPS:
            assert np.allclose(getattr(expected, part)[name], getattr(found, part)[name], atol=1e-6)


@pytest.mark.parametrize("strategy", ["mcmc", "gradient"])
def test_a_training_has_the_same_psnr(make_model, strategy):
    options = TrainOptions(**QUICK, strategy=strategy, final_share=0.8)
    native, other = (
        training_loop.train(training_images(make_model), replace(options, engine=engine)).metrics["psnr"]
        for engine in ("native", "torch")
    )
    assert native == pytest.approx(other, abs=0.1)


def test_either_engine_resumes_a_training_of_the_other(make_model, tmp_path):
    data, path, ends = training_images(make_model), tmp_path / "run.npz", []
    options = TrainOptions(max_splats=60, sh_degree=1, iterations=8, refine_start=2, refine_every=2)
    for first, second in (("native", "native"), ("native", "torch"), ("torch", "native")):
        training_loop.train(data, replace(options, engine=first), outputs=Outputs(checkpoint=path))
        longer = replace(options, iterations=16, engine=second, final_share=0.5)
        resumed = training_loop.train(data, longer, outputs=Outputs(resume=path))
        assert len(resumed.model) == 30
        ends.append(resumed.log["losses"])
    assert np.allclose(ends[0], ends[1:], rtol=1e-2)


def test_the_command_trains_in_torch_and_tunes_likewise(tmp_path):
    photograph_object(shell(3), tmp_path)
    words = ("--device", "torch", "--iterations", 4, "--max-splats", 50, "--json")
    log = json.loads(call("train", tmp_path, tmp_path / "a.ply", *words).stdout)
    assert "torch" == log["options"]["engine"]
    assert "torch" == tuning_after(TrainOptions(engine="torch")).engine


def test_the_perceptual_loss_is_refused(make_model):
    options = TrainOptions(engine="torch", lpips_weight=0.1)
    with pytest.raises(InputError, match="requires the native engine"):
        training_loop._make_engine(Parameters.starting_at(from_model(make_model(2, 0), 0)), options, None, None)


def test_a_loss_that_is_not_finite_is_reported_with_its_step():
    count = []

    def step(view):
        count.append(view)
        loss = np.nan if len(count) == 3 else 1.0
        return SimpleNamespace(read=lambda: LossValue(loss, 0.0, 0.0, 0.0))

    with pytest.raises(InputError, match="not finite at step 3"):
        Fitter(4, 50, 0).run(SimpleNamespace(step=step, after_step=lambda: None))
