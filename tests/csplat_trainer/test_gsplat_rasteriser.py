"""Training, tuning and measuring through gsplat's interface, for which `gsplat_twin` stands in, against the CPU.

Also: csplat_trainer.gsplat_derivatives, csplat_trainer.gsplat_engine, csplat_trainer.torch_losses,
csplat_trainer.torch_quantisers, csplat_trainer.tuning.gsplat_tuning.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from captures import cameras, shell, training_images
from gsplat_twin import rasterization
from models import with_facts

from csplat import EncodeOptions, Target
from csplat.encoder import EncodePlan, fix_quantisation
from csplat.errors import InputError
from csplat_render import render
from csplat_render.camera import Camera
from csplat_render.pruning_error import measure_pruning_error
from csplat_tools.training import tuning_run
from csplat_tools.training.tuning_run import choose_and_finetune
from csplat_tools.views import ViewSet
from csplat_trainer import gsplat_rasteriser, training_loop
from csplat_trainer.engine import CpuEngine
from csplat_trainer.fitter import Fitter
from csplat_trainer.gsplat_derivatives import estimate_pruning, estimate_sensitivity, splats_of
from csplat_trainer.gsplat_engine import GsplatEngine
from csplat_trainer.gsplat_rasteriser import DeviceParameters, GsplatRasteriser
from csplat_trainer.image_gains import ImageGain, ImageGains
from csplat_trainer.losses import LOSS_WEIGHTS, LossValue, photometric_loss_twin
from csplat_trainer.parameters import GROUPS, Parameters, from_model
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.strategies import ScreenGradients, densify, grow, relocate, reset_opacities
from csplat_trainer.torch_losses import DeviceImages, TorchLoss
from csplat_trainer.training_options import Outputs, TrainOptions
from csplat_trainer.tuning import FinetuneOptions, renders_of, split_views, tune
from csplat_trainer.tuning.gsplat_tuning import GsplatTuning
from csplat_trainer.tuning.tuning_engine import CpuTuning

torch = pytest.importorskip("torch", reason="the GPU engine requires torch (the train extra)")
pytestmark = pytest.mark.torch
CPU, BLACK = torch.device("cpu"), np.zeros(3, np.float32)
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat needs a GPU")


@pytest.fixture
def camera() -> Camera:
    viewmat = np.eye(4)
    viewmat[2, 3] = 6.0
    return Camera(np.array([[30.0, 0, 12], [0, 30.0, 10], [0, 0, 1]]), viewmat, 24, 20)


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
@pytest.mark.parametrize("loss", ["inria", "study"])
def test_the_engine_takes_the_same_steps(make_model, image, loss, gains):
    options = TrainOptions(strategy="fixed", loss=loss, noise=0.0, max_splats=12)
    starts = [Parameters.starting_at(from_model(make_model(12, 1), 1)) for _ in range(2)]
    cpu, gpu = CpuEngine(starts[0], options), GsplatEngine(starts[1], options, rasterization, "cpu")
    losses, corrections = [], []
    for engine in (cpu, gpu):
        rng, of_all = np.random.default_rng(0), ImageGains(2)
        for step in range(1, 6):
            gain = ImageGain(of_all, 0, 1e-2) if gains else None
            value = engine.step(image, np.ones(3, np.float32), 1, options.learning_rates(step, 1.0), rng, gain)
        losses.append(value.read().loss)
        corrections.append(of_all.values)
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)
    assert np.allclose(*corrections, atol=1e-4)
    for name in GROUPS:
        assert np.allclose(starts[0].values[name], gpu.parameters.on_cpu().values[name], atol=2e-3)
    pictures = [engine.render(image.camera, BLACK, 1) for engine in (cpu, gpu)]
    assert np.abs(pictures[0] - pictures[1]).mean() < 1e-3


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


@pytest.fixture
def stand_in(monkeypatch):
    """Let device cuda be the CPU."""

    def start(self, *, antialiased, rasterization=None, **_):
        return original(self, antialiased=antialiased, rasterization=rasterization or twin, device="cpu")

    original, twin = GsplatRasteriser.__init__, rasterization
    monkeypatch.setattr(GsplatRasteriser, "__init__", start)


@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize(("first", "second"), [("cpu", "cuda"), ("cuda", "cpu")])
def test_either_engine_resumes_a_training_of_the_other(make_model, tmp_path, first, second):
    data = training_images(make_model)
    options = TrainOptions(max_splats=60, sh_degree=1, iterations=8, refine_start=2, refine_every=2, device=first)
    start = training_loop.train(data, options, outputs=Outputs(checkpoint=tmp_path / "run.npz"))
    longer = replace(options, iterations=16, device=second, final_share=0.5)
    resumed = training_loop.train(data, longer, outputs=Outputs(resume=tmp_path / "run.npz"))
    assert len(start.log["losses"]) < len(resumed.log["losses"])
    assert resumed.log["losses"][-1] < resumed.log["losses"][0]
    assert len(resumed.model) == 30


@pytest.mark.usefixtures("stand_in")
def test_densification_trains_on_a_device(make_model):
    brief = {"max_splats": 60, "sh_degree": 0, "iterations": 8, "refine_start": 2, "refine_every": 2}
    options = TrainOptions(**brief, device="cuda", strategy="gradient")
    assert np.isfinite(training_loop.train(training_images(make_model), options).log["losses"]).all()


def test_a_loss_that_is_not_finite_is_reported_with_its_step():
    count = []

    def step(view):
        count.append(view)
        loss = np.nan if len(count) == 3 else 1.0
        return SimpleNamespace(read=lambda: LossValue(loss, 0.0, 0.0, 0.0))

    with pytest.raises(InputError, match="not finite at step 3"):
        Fitter(4, 50, 0).run(SimpleNamespace(step=step, after_step=lambda: None))


def test_a_full_or_missing_gpu_is_reported():
    with pytest.raises(InputError, match=r"--max-splats.*--size"), gsplat_rasteriser.memory_errors():
        raise torch.OutOfMemoryError("2 GiB")
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(InputError, match="finds no GPU"):
        gsplat_rasteriser.gsplat_rasterization()


ENCODINGS = {
    "codebook": EncodeOptions(attribute_psnr=28.0, sh_coding="codebook", codebook_size=16),
    "shapes": EncodeOptions(attribute_psnr=28.0, sh_coding="codebook", codebook_size=16, shape_codebook_size=32),
    "scalar": EncodeOptions(attribute_psnr=28.0, sh_coding="scalar", tile_splats=80),
    "no SH": EncodeOptions(attribute_psnr=28.0, sh_coding="none"),
}


@pytest.fixture(scope="module", params=ENCODINGS)
def fixed(request):
    return fix_quantisation(EncodePlan.of(shell(8), ENCODINGS[request.param], importance=np.linspace(1, 99, 300)))


@pytest.fixture(scope="module")
def views():
    return split_views(renders_of(shell(8), cameras(6), BLACK), BLACK, validation_count=2)


@pytest.mark.parametrize(
    "engine", [{"rasterization": rasterization, "device": "cpu"}, pytest.param({}, marks=[pytest.mark.gpu, needs_gpu])]
)
def test_the_loss_sees_what_a_decoder_returns(fixed, views, engine):
    gpu = GsplatTuning(fixed, FinetuneOptions(iterations=9), BLACK, **engine)
    rates = dict.fromkeys(gpu.parameters.values, 0.02)
    for view in views.train:
        gpu.step(view, None, rates, gpu.count(1e-3))
        gpu.free_values()  # which compares the quantisers with the encoder's


def test_tuning_takes_the_same_steps(fixed, views):
    options = FinetuneOptions(iterations=9)
    engines = CpuTuning(fixed, options, BLACK), GsplatTuning(fixed, options, BLACK, None, rasterization, "cpu")
    values, figures = [], []
    for engine in engines:
        rates = dict.fromkeys(engine.parameters.values, 1e-3)
        costs = engine.count(1e-4)
        losses = [engine.step(view, None, rates, costs).read().loss for view in views.train]
        figures.append([costs.bits, *losses, engine.score(views.validation[0], None)[1]])
        values.append(engine.free_values())
    assert np.allclose(*figures, rtol=2e-3)
    for name, array in vars(values[0]).items():
        assert np.count_nonzero(np.abs(array - getattr(values[1], name)) > 1e-5) <= 0.02 * array.size, name


def test_values_that_the_encoder_quantises_differently_are_refused(fixed):
    gpu = GsplatTuning(fixed, FinetuneOptions(), BLACK, None, rasterization, "cpu")
    gpu.parameters.tensors["sh0"][0] = 1e9
    with pytest.raises(InputError, match="sh0 are too large"):
        gpu.free_values()


@pytest.mark.usefixtures("stand_in")
def test_either_engine_resumes_a_tuning_of_the_other(fixed, views, tmp_path):
    path = tmp_path / "run.npz"
    options = FinetuneOptions(iterations=6, validate_every=3, warm_up=1, device="cuda")
    tune(fixed, views, options, outputs=Outputs(checkpoint=path))
    longer = replace(options, iterations=9, device="cpu")
    found = tune(fixed, views, longer, outputs=Outputs(checkpoint=path, resume=path))
    again = tune(fixed, views, replace(options, iterations=12), outputs=Outputs(resume=path))
    assert [9, 12] == [len(one.log["losses"]) for one in (found, again)]
    assert again.log["best_psnr"] > found.log["start_psnr"] - 0.2


@pytest.mark.usefixtures("stand_in")
def test_a_scene_is_pruned_and_tuned_to_a_size(views, monkeypatch):
    monkeypatch.setattr(tuning_run, "SPLAT_BYTES", 15)  # small files have a larger share of overhead
    model = shell(8)
    around = ViewSet("cameras", (0.0, 0.0, 0.0), [one.camera for one in views.train[:2]], (), ())
    options = FinetuneOptions(iterations=8, validate_every=4, warm_up=2, device="cuda", byte_cost=1e-3)
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
    expected = measure_sensitivity(model, [camera], metric=True, magnitudes=False, dtype=np.float64)
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
    estimate = estimate_pruning(rasteriser, splats_of(rasteriser, model), [camera] * 60, BLACK)
    assert np.array_equal(exact.seen, estimate.seen)
    assert np.allclose(estimate.error / 60, exact.error, rtol=0.5, atol=0.1 * exact.error.max())


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplat_renders_as_the_cpu_does(make_model, camera, antialiased):
    model = make_model(40, 3, seed=1)
    rasteriser = GsplatRasteriser(antialiased=antialiased)
    found, _ = rasteriser.render(splats_of(rasteriser, model), camera, rasteriser.upload(BLACK), 3)
    expected = render(with_facts(model, antialiased=antialiased), camera).rgb
    assert np.abs(found.detach().cpu().numpy() - expected).mean() < 2e-3
