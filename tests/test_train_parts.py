"""Parts of training: loss, parameters, strategies."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from test_train_loop import QUICK, assert_resumes_identically, training_images

from csplat.encoder import EncodeOptions, EncodePlan, fix_quantisation
from csplat.errors import InputError

pytest.importorskip("numba", reason="the trainer requires the extra [train]")


from csplat_render.camera import Camera, intrinsics, orbit
from csplat_trainer.data import DataSet
from csplat_trainer.image_gains import ImageGain, ImageGains
from csplat_trainer.losses import LOSS_WEIGHTS, PhotometricLoss, photometric_loss_twin
from csplat_trainer.parameters import GROUPS, Parameters, adam_step, from_model, to_model
from csplat_trainer.posed_images import PosedImage, compose, halve
from csplat_trainer.strategies import (
    ScreenGradients,
    add_noise,
    densify,
    grow,
    prune_least_needed,
    relocate,
    reset_opacities,
    share_opacity,
)
from csplat_trainer.training_checkpoint import TrainingCheckpoint, fit_to_options, load_checkpoint, save_checkpoint
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import Outputs, TrainOptions
from csplat_trainer.training_report import moving_average
from csplat_trainer.tuning import FinetuneOptions, TuningView, TuningViews, tune


@pytest.fixture
def parameters(make_model):
    return Parameters.starting_at(from_model(make_model(40, 2), 2))


@pytest.mark.parametrize("beta2", [0.999, 0.98])
def test_adam_agrees_with_the_textbook(parameters, beta2):
    parameters.beta2 = beta2
    rng = np.random.default_rng(0)
    gradients = [
        {name: rng.standard_normal(parameters.values[name].shape).astype(np.float32) for name in GROUPS}
        for _ in range(3)
    ]
    x = parameters.values["means"].astype(np.float64)
    m, v = np.zeros_like(x), np.zeros_like(x)
    for step, gradient in enumerate(gradients, 1):
        g = gradient["means"].astype(np.float64)
        m, v = 0.9 * m + 0.1 * g, beta2 * v + (1 - beta2) * g * g
        x -= 0.01 * (m / (1 - 0.9**step)) / (np.sqrt(v / (1 - beta2**step)) + 1e-15)
        adam_step(parameters, gradient, dict.fromkeys(GROUPS, 0.01))
    assert np.abs(parameters.values["means"] - x).max() <= 1e-6
    assert np.abs(np.linalg.norm(parameters.values["quats"], axis=1) - 1).max() <= 1e-6


def test_a_splat_without_gradient_does_not_move(parameters):
    before = {name: parameters.values[name].copy() for name in GROUPS}
    for _ in range(3):
        adam_step(parameters, {name: np.zeros_like(before[name]) for name in GROUPS}, dict.fromkeys(GROUPS, 0.1))
    for name in GROUPS:
        assert np.allclose(before[name], parameters.values[name], atol=1e-6)


def test_parameters_of_a_model_convert_back(make_model):
    model = make_model(20, 1)
    again = to_model(from_model(model, 3))
    assert again.sh_degree == 3
    assert np.array_equal(model.means, again.means)
    assert np.allclose(model.opacities, again.opacities, atol=1e-6)
    assert np.array_equal(model.shN, again.shN[:, :3])


@pytest.mark.parametrize("count", [2, 3, 10, 51])
@pytest.mark.parametrize("alpha", [0.05, 0.5, 0.9])
def test_shared_splats_cover_as_one(alpha, count):
    # n equal splats cover a line through their centre as much as the one, by the integral.
    shared, factor = share_opacity(np.array([alpha]), np.array([count]))
    x = np.linspace(-12, 12, 20_001)
    one = alpha * np.exp(-(x**2) / 2)
    many = 1 - (1 - shared * np.exp(-(x**2) / (2 * factor**2))) ** count
    assert many.sum() == pytest.approx(one.sum(), rel=1e-6)
    assert many.max() == pytest.approx(alpha, rel=1e-9)


def test_transparent_splats_are_relocated_to_others(parameters):
    parameters.values["logits"][:] = 2.0
    parameters.values["logits"][:10] = -9.0
    adam_step(parameters, {name: np.ones_like(parameters.values[name]) for name in GROUPS}, dict.fromkeys(GROUPS, 0.0))
    assert 10 == relocate(parameters, 0.005, np.random.default_rng(0))
    alive = {tuple(row) for row in parameters.values["means"][10:].tolist()}
    assert all(tuple(row) in alive for row in parameters.values["means"][:10].tolist())
    assert (parameters.first["means"][:10] == 0).all()
    assert parameters.alphas.min() > 0.005


def test_nothing_is_relocated_if_all_splats_are_transparent(parameters):
    parameters.values["logits"][:] = -9.0
    assert 0 == relocate(parameters, 0.005, np.random.default_rng(0))


def test_growth_stops_at_the_cap(parameters):
    rng = np.random.default_rng(0)
    assert 2 == grow(parameters, 1.05, 1000, 0.005, rng)
    assert 3 == grow(parameters, 2.0, 45, 0.005, rng)
    assert 0 == grow(parameters, 2.0, 45, 0.005, rng)
    assert {45} == {len(part[name]) for part in (parameters.values, parameters.first) for name in GROUPS}


def test_noise_only_moves_transparent_splats(parameters):
    parameters.values["logits"][:20] = 3.0
    parameters.values["logits"][20:] = -8.0
    before = parameters.values["means"].copy()
    add_noise(parameters, 1.0, np.random.default_rng(0).standard_normal(before.shape).astype(np.float32))
    moved = (before != parameters.values["means"]).any(axis=1)
    assert not moved[:20].any()
    assert moved[20:].all()


def test_densification_clones_small_splits_large_and_prunes(parameters):
    parameters.values["logits"][:] = 1.0
    parameters.values["logits"][5] = -9.0
    parameters.values["scales"][:] = np.log(1e-3)
    parameters.values["scales"][1] = np.log(0.5)
    screen = ScreenGradients.none(40)
    screen.add(np.where(np.arange(40) < 2, 1.0, 0.0).astype(np.float32), np.ones(40, bool))
    first, second = parameters.values["means"][:2].copy()
    assert 1 == densify(parameters, screen, 1.0, 1e-3, 100, 0.005, np.random.default_rng(0))
    means, scales = parameters.values["means"], parameters.values["scales"]
    assert np.array_equal(first, means[0])
    assert np.array_equal(first, means[-2])
    assert not np.array_equal(second, means[1])
    assert np.allclose(scales[[1, -1]], np.log(0.5 / 1.6))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_needle_is_split_along_its_axis(parameters, axis):
    w, u, along = 0.4, np.array([0.2, -0.6, np.sqrt(0.44)]), np.eye(3)[axis]
    direction = along + 2.0 * w * np.cross(u, along) + 2.0 * np.cross(u, np.cross(u, along))
    parameters.values["logits"][:] = 1.0
    parameters.values["scales"][:] = np.log(np.where(along > 0.0, 0.5, 1e-6))
    parameters.values["quats"][:] = (w, *u)
    screen = ScreenGradients.none(40)
    screen.add(np.ones(40, np.float32), np.ones(40, bool))
    means = parameters.values["means"].copy()
    assert 40 == densify(parameters, screen, 1.0, 1e-3, 100, 0.005, np.random.default_rng(0))
    moved = parameters.values["means"] - np.concatenate([means, means])
    assert np.abs(moved @ direction).mean() > 0.1
    np.testing.assert_allclose(moved, np.outer(moved @ direction, direction), atol=1e-4)


def test_densification_stops_at_the_cap(parameters):
    parameters.values["logits"][:] = 1.0
    screen = ScreenGradients.none(40)
    screen.add(np.ones(40, np.float32), np.ones(40, bool))
    densify(parameters, screen, 1.0, 1e-3, 50, 0.005, np.random.default_rng(0))
    assert 50 == len(parameters)
    parameters.values["logits"][0] = -9.0
    reset_opacities(parameters)
    np.testing.assert_allclose(0.01, parameters.alphas[1:], rtol=1e-3)
    assert np.float32(-9.0) == parameters.values["logits"][0]


def checkpoint_of(parameters: Parameters) -> TrainingCheckpoint:
    return TrainingCheckpoint(
        7, parameters, np.random.default_rng(0).bit_generator.state, [3, 1], {"seed": 0}, {"losses": []}
    )


def test_a_checkpoint_is_saved_and_loaded(parameters, tmp_path):
    save_checkpoint(tmp_path / "run.npz", checkpoint_of(parameters))
    again = load_checkpoint(tmp_path / "run.npz")
    assert (7, [3, 1]) == (again.iteration, again.queue)
    for name in GROUPS:
        assert np.array_equal(parameters.values[name], again.parameters.values[name])
        assert np.array_equal(parameters.second[name], again.parameters.second[name])


@pytest.mark.parametrize("damage", ["text", "empty", "cut", "other"])
def test_a_damaged_checkpoint_is_refused(parameters, tmp_path, damage):
    path = tmp_path / "run.npz"
    save_checkpoint(path, checkpoint_of(parameters))
    whole = path.read_bytes()
    path.write_bytes({"text": b"hello", "empty": b"", "cut": whole[: len(whole) // 2], "other": whole}[damage])
    if damage == "other":
        np.savez(path, facts=np.frombuffer(json.dumps({"version": 99}).encode(), np.uint8))
    with pytest.raises(InputError, match=r"checkpoint"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    ("cap", "degree", "strategy", "count"), [(25, 1, "mcmc", 25), (60, 3, "fixed", 60), (60, 0, "mcmc", 40)]
)
def test_a_checkpoint_adapts_to_other_options(parameters, cap, degree, strategy, count):
    options = TrainOptions(max_splats=cap, sh_degree=degree, strategy=strategy)
    adapted = fit_to_options(parameters, options, np.random.default_rng(0))
    assert count == len(adapted)
    assert (count, (degree + 1) ** 2 - 1, 3) == adapted.values["shN"].shape == adapted.second["shN"].shape


def test_the_moving_average_covers_the_last_values():
    assert [1.0, 1.5, 2.5, 3.5] == moving_average([1, 2, 3, 4], 2).tolist()


def test_options_out_of_range_are_refused():
    wrong = {"max_splats": 0, "device": "mps", "sh_degree": 4, "loss": "l2", "lr_means": np.nan, "lr_means_final": 1.0}
    for name, value in wrong.items():
        with pytest.raises(InputError, match=r"expected|mps is not supported"):
            TrainOptions(**{name: value})


def test_the_learning_rate_of_means_decays_to_its_final_value():
    options = TrainOptions(iterations=100)
    assert options.lr_means_final * 2 == pytest.approx(options.learning_rates(100, 2.0)["means"])
    assert options.lr_means * 2 == pytest.approx(options.learning_rates(0, 2.0)["means"])


def test_other_learning_rates_decay_after_refinement():
    options = TrainOptions(iterations=100, refine_stop=0.6, lr_decay=0.2)
    shares = [options.learning_rates(step, 2.0)["scales"] / options.lr_scales for step in (1, 60, 80, 100)]
    assert [1.0, 1.0, 0.6, 0.2] == pytest.approx(shares)
    assert TrainOptions(refine_stop=1.0, lr_decay=0.2).learning_rates(7000, 2.0)["shN"] == TrainOptions.lr_shN


@pytest.mark.parametrize("channels", [3, 4])
def test_a_halved_image_agrees_with_its_camera(channels):
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (7, 10, channels), dtype=np.uint8)
    mask = np.ones((7, 10), bool)
    mask[3, 4] = False
    camera = Camera(intrinsics(10, 7, 8.0), np.eye(4), 10, 7)
    half, behind = halve(PosedImage(camera, pixels, mask)), np.array([0.2, 0.5, 0.9], np.float32)
    whole = compose(PosedImage(camera, pixels), behind, np.empty((7, 10, 3), np.float32))
    means = whole[:6].reshape(3, 2, 5, 2, 3).mean(axis=(1, 3))
    assert np.abs(compose(half, behind, np.empty((3, 5, 3), np.float32)) - means).max() <= 1.01 / 255
    point = np.array([0.1, -0.05, 1.0])
    assert np.allclose(half.camera.K @ point, [0.5, 0.5, 1.0] * (camera.K @ point))
    assert [[1, 2]] == np.argwhere(~half.mask).tolist()


def test_an_image_without_pixels_at_half_the_size_is_kept():
    lines, narrow = np.zeros((6, 8), bool), Camera(intrinsics(1, 6, 8.0), np.eye(4), 1, 6)
    lines[:, ::2] = True
    camera = Camera(intrinsics(8, 6, 8.0), np.eye(4), 8, 6)
    for picture in (
        PosedImage(camera, np.zeros((6, 8, 3), np.uint8), lines),
        PosedImage(narrow, np.zeros((6, 1, 3), np.uint8)),
    ):
        assert halve(picture) is picture


def test_growth_reaches_the_cap_halfway():
    options = TrainOptions(max_splats=1000, iterations=2000, refine_start=100)
    count = 10.0
    for step in range(1, options.refine_end // 2 + 1):
        if options.refines_after(step):
            count *= options.growth_from(10)
    assert 1000 == pytest.approx(count)
    assert 1.05 == options.growth_from(1000)
    assert 1.5 == TrainOptions(growth=1.5).growth_from(10)


def test_sh_degrees_are_activated_one_by_one():
    options = TrainOptions(iterations=1500, sh_degree=2)
    assert [0, 1, 2, 2] == [options.active_degree(step) for step in (0, 100, 200, 1400)]


def test_prunings_are_spread_and_end_early():
    options = TrainOptions(max_splats=1000, final_share=0.4, iterations=1000, refine_stop=0.6)
    left = {step: options.prunings_left(step) for step in range(1, 1001) if options.prunings_left(step)}
    assert dict(zip(range(624, 841, 24), range(10, 0, -1), strict=True)) == left  # splats move until step 600
    for stop, last in ((0.5, 8), (0.8, 9), (1.0, 10)):  # few steps: fewer prunings
        short = TrainOptions(final_share=0.4, iterations=10, refine_stop=stop)
        assert [last] == [step for step in range(11) if short.prunings_left(step) == 1]
    assert not any(TrainOptions(iterations=1000).prunings_left(step) for step in range(1, 1001))


def test_splats_with_the_least_effect_are_pruned(make_model):
    cameras = orbit((0, 0, 0), 6.0, (0, 0, 1), 6, intrinsics(40, 40, 50.0), 40, 40)
    pictures = [PosedImage(camera, np.zeros((40, 40, 3), np.uint8)) for camera in cameras]
    values = from_model(make_model(40, 1, seed=3, scales=np.full((40, 3), -1.2, np.float32)), 1)
    values["logits"][5:15] = -7.0
    parameters = Parameters.starting_at(values)
    parameters.second["means"][:] = np.arange(40, dtype=np.float32)[:, None]
    prune_least_needed(parameters, pictures, np.ones(3, np.float32), 30, antialiased=False)
    wanted = [*range(5), *range(15, 40)]
    assert wanted == parameters.second["means"][:, 0].tolist()


def random_images(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(height * width)
    x = rng.random((height, width, 3), dtype=np.float32)
    y = np.clip(x + 0.2 * rng.standard_normal((height, width, 3)), 0, 1).astype(np.float32)
    return x, y


@pytest.mark.parametrize("size", [(1, 1), (3, 40), (37, 21), (64, 48)])
@pytest.mark.parametrize("weights", LOSS_WEIGHTS.values(), ids=LOSS_WEIGHTS.keys())
def test_the_loss_equals_its_twin(size, weights):
    x, y = random_images(*size)
    value, gradient = PhotometricLoss(*size, *weights)(x, y)
    expected, slope = photometric_loss_twin(x, y, *weights)
    assert value.loss == pytest.approx(expected.loss, rel=1e-5)
    assert value.mse == pytest.approx(expected.mse, rel=1e-5)
    assert np.abs(gradient - slope).max() <= 1e-5 * np.abs(slope).max()


def test_the_gradient_of_the_twin_agrees_with_finite_differences():
    x, y = (picture.astype(np.float64) for picture in random_images(13, 9))
    _, slope = photometric_loss_twin(x, y)
    direction = np.random.default_rng(1).standard_normal(x.shape)
    step = 1e-6
    up, down = (photometric_loss_twin(x + sign * step * direction, y)[0].loss for sign in (1, -1))
    assert (slope * direction).sum() == pytest.approx((up - down) / (2 * step), rel=1e-6)


def test_the_ssim_of_the_loss_agrees_with_the_metric():
    from csplat_render.metrics import ssim

    x, y = random_images(40, 30)
    value, _ = PhotometricLoss(40, 30)(x, y)
    assert value.ssim == pytest.approx(ssim(y, x), abs=1e-5)


def test_equal_images_have_no_loss_and_no_gradient():
    x, _ = random_images(20, 20)
    value, gradient = PhotometricLoss(20, 20)(x, x.copy())
    assert (value.l1, value.mse) == (0.0, 0.0)
    assert value.ssim == pytest.approx(1.0, abs=1e-6)
    assert np.abs(gradient).max() <= 1e-6


def test_calls_of_a_loss_are_independent():
    x, y = random_images(24, 24)
    loss = PhotometricLoss(24, 24)
    first = loss(x, y)[1].copy()
    loss(y, x)
    assert np.array_equal(first, loss(x, y)[1])


@pytest.mark.parametrize("weights", LOSS_WEIGHTS.values(), ids=LOSS_WEIGHTS.keys())
def test_masked_pixels_do_not_change_the_loss(weights):
    x, y = random_images(32, 24)
    mask = np.ones((32, 24), bool)
    mask[5:20, 3:12] = False
    other = np.where(mask[..., None], y, 1.0 - y)
    value, gradient = PhotometricLoss(32, 24, *weights)(x, y.copy(), mask)
    again, slope = PhotometricLoss(32, 24, *weights)(x, other, mask)
    assert again == value or np.isnan(value.ssim)
    assert np.array_equal(gradient, slope)
    assert not gradient[~mask].any()
    assert gradient[mask].all()
    assert value.mse == pytest.approx(float(np.square(x - y)[mask].mean()), rel=1e-5)


GAINS = np.array([0.7, 1.3, 0.8, 1.2, 0.9, 1.1, 0.75, 1.25, 1.0])  # of training images; of test images: 1
LONGER = {**QUICK, "iterations": 300, "refine_every": 50, "lr_means": 2e-3, "background": "black"}


@pytest.fixture
def data(make_model):
    return training_images(make_model)


@pytest.fixture
def uneven(data):
    shots = [
        replace(one, source=np.rint(np.clip(one.pixels * [gain, gain, gain, 1.0], 0, 255)).astype(np.uint8))
        for one, gain in zip(data.train, GAINS, strict=True)
    ]
    return DataSet("uneven", shots, data.test)


def test_gradients_of_gains_agree_with_finite_differences():
    rng = np.random.default_rng(0)
    seen, photograph = (rng.random((20, 24, 3)).astype(np.float32) for _ in range(2))
    exposures, loss = ImageGains(2), PhotometricLoss(20, 24)
    exposures.values[0] = rng.uniform(-0.3, 0.3, (2, 3))
    one, moved = ImageGain(exposures, 0, 0.0), []
    exposures.step = lambda number, slope, rate: moved.append((number, slope, rate))  # type: ignore[method-assign]
    slope = one.backward(seen, loss(one.apply(seen), photograph.copy())[1].copy()).copy()

    def value(seen) -> float:
        return float(loss(one.apply(seen), photograph.copy())[0].loss)

    expected = np.zeros((2, 3))
    for place in np.ndindex(2, 3):
        for sign in (1.0, -1.0):
            exposures.values[0][place] += sign * 1e-3
            expected[place] += sign * value(seen) / 2e-3
            exposures.values[0][place] -= sign * 1e-3
    np.testing.assert_allclose(moved[0][1], expected, rtol=0.02, atol=2e-4)
    step = np.float32(1e-3) * rng.standard_normal(seen.shape).astype(np.float32)
    assert value(seen + step) - value(seen - step) == pytest.approx(2.0 * float(np.sum(slope * step)), rel=0.1)


@pytest.mark.slow
def test_gains_are_estimated_with_a_mean_of_0(uneven):
    options = TrainOptions(**{**LONGER, "iterations": 450})
    plain, corrected = (train(uneven, replace(options, lr_exposure=rate)) for rate in (0.0, 0.05))
    assert corrected.log["entries"][-1]["psnr"] > plain.log["entries"][-1]["psnr"]  # of training images
    found = np.array(corrected.log["exposures"])
    assert np.abs(found.mean(axis=0)).max() < 1e-4
    assert np.corrcoef(np.exp(found[:, 0].mean(axis=1)), GAINS)[0, 1] > 0.5  # 80 splats represent the scene poorly
    assert "exposures" not in plain.log


def test_a_resumed_run_keeps_its_gains(uneven, tmp_path):
    options = TrainOptions(**QUICK, lr_exposure=0.02)
    whole, stopped = assert_resumes_identically(uneven, options, tmp_path)
    assert np.abs(whole.log["exposures"]).max() > 0.0
    with pytest.raises(InputError, match="the checkpoint has exposures of 9 images, expected 8"):
        train(DataSet("fewer", uneven.train[:8], uneven.test), options, outputs=Outputs(resume=stopped))


def test_gains_are_refused_on_a_gpu(uneven):
    with pytest.raises(InputError, match="--device cpu"):
        train(uneven, TrainOptions(**QUICK, lr_exposure=0.02, device="cuda"))


@pytest.mark.slow
def test_tuning_corrects_gains(make_model, uneven):
    scene = make_model(30, 1, seed=3, scales=np.full((30, 3), -1.2, np.float32))  # the scene of the images
    fixed = fix_quantisation(EncodePlan.of(scene, EncodeOptions(sh_coding="scalar", attribute_psnr=60.0)))
    training, validation = ([TuningView(one.camera, one) for one in part] for part in (uneven.train, uneven.test))
    views = TuningViews(training, validation, np.zeros(3, np.float32))
    plain, corrected = (
        tune(fixed, views, FinetuneOptions(iterations=200, validate_every=50, patience=0, lr_exposure=rate)).log
        for rate in (0.0, 0.05)
    )
    assert corrected["validations"][-1]["psnr"] > plain["validations"][-1]["psnr"] + 0.5
    assert np.corrcoef(np.exp(np.array(corrected["exposures"])[:, 0].mean(axis=1)), GAINS)[0, 1] > 0.95
