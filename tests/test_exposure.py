"""Photographs of one scene that were exposed differently."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("numba", reason="the trainer wants the extra [train]")

from test_train_loop import QUICK, photographs, resumed_as_if_never_stopped

from csplat.encoder import EncodeOptions, EncodePlan, fix_quantisation
from csplat.errors import InputError
from csplat_trainer.data import DataSet
from csplat_trainer.image_gains import ImageGain, ImageGains
from csplat_trainer.losses import PhotometricLoss
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import Outputs, TrainOptions
from csplat_trainer.tuning import FinetuneOptions, TuningView, TuningViews, tune

GAINS = np.array([0.7, 1.3, 0.8, 1.2, 0.9, 1.1, 0.75, 1.25, 1.0])  # of training photographs; test: 1
LONGER = {**QUICK, "iterations": 300, "refine_every": 50, "lr_means": 2e-3, "background": "black"}


@pytest.fixture
def data(make_model):
    return photographs(make_model)


@pytest.fixture
def uneven(data):
    shots = [
        replace(one, source=np.rint(np.clip(one.pixels * [gain, gain, gain, 1.0], 0, 255)).astype(np.uint8))
        for one, gain in zip(data.train, GAINS, strict=True)
    ]
    return DataSet("uneven", shots, data.test)


def test_slopes_are_those_of_the_loss_with_the_correction():
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
def test_gains_are_found_and_the_scene_is_as_bright_as_the_mean(uneven):
    options = TrainOptions(**{**LONGER, "iterations": 450})
    plain, corrected = (train(uneven, replace(options, lr_exposure=rate)) for rate in (0.0, 0.05))
    assert corrected.log["entries"][-1]["psnr"] > plain.log["entries"][-1]["psnr"]  # PSNR on the training photographs
    found = np.array(corrected.log["exposures"])
    assert np.abs(found.mean(axis=0)).max() < 1e-4
    assert np.corrcoef(np.exp(found[:, 0].mean(axis=1)), GAINS)[0, 1] > 0.5  # 80 splats hardly hold the scene
    assert "exposures" not in plain.log


def test_a_resumed_run_goes_on_with_its_exposures(uneven, tmp_path):
    options = TrainOptions(**QUICK, lr_exposure=0.02)
    whole, stopped = resumed_as_if_never_stopped(uneven, options, tmp_path)
    assert np.abs(whole.log["exposures"]).max() > 0.0
    with pytest.raises(InputError, match="exposures of 9 photographs are stored, wanted those of 8"):
        train(DataSet("fewer", uneven.train[:8], uneven.test), options, outputs=Outputs(resume=stopped))


def test_a_gpu_learns_none(uneven):
    with pytest.raises(InputError, match="on the CPU alone"):
        train(uneven, TrainOptions(**QUICK, lr_exposure=0.02, device="cuda"))


@pytest.mark.slow
def test_tuning_corrects_exposures_too(make_model, uneven):
    scene = make_model(30, 1, seed=3, scales=np.full((30, 3), -1.2, np.float32))  # that was photographed
    fixed = fix_quantisation(EncodePlan.of(scene, EncodeOptions(sh_coding="scalar", attribute_psnr=60.0)))
    teach, judge = ([TuningView(one.camera, one) for one in part] for part in (uneven.train, uneven.test))
    views = TuningViews(teach, judge, np.zeros(3, np.float32))
    plain, corrected = (
        tune(fixed, views, FinetuneOptions(iterations=200, validate_every=50, patience=0, lr_exposure=rate)).log
        for rate in (0.0, 0.05)
    )
    assert corrected["validations"][-1]["psnr"] > plain["validations"][-1]["psnr"] + 0.5
    assert np.corrcoef(np.exp(np.array(corrected["exposures"])[:, 0].mean(axis=1)), GAINS)[0, 1] > 0.95
