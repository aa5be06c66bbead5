# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_trainer.training_options.

Also: csplat_trainer.training_report.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from captures import training_images
from PIL import Image
from train_cases import QUICK, SIZE, assert_resumes_identically

from csplat.errors import InputError
from csplat_trainer import training_loop
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import Outputs, TrainOptions
from csplat_trainer.training_report import moving_average
from csplat_trainer.tuning import FinetuneOptions


@pytest.fixture
def data(make_model):
    return training_images(make_model)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [38, 60])  # while splats are pruned, at the end
def test_a_run_resumed_late_prunes_to_the_final_share(data, tmp_path, steps):
    trunk = TrainOptions(**{**QUICK, "iterations": steps}, refine_stop=0.5)
    whole = train(data, trunk, outputs=Outputs(tmp_path / "trunk.npz"))
    options = TrainOptions(**QUICK, refine_stop=0.5, final_share=0.75)  # two prunings
    left = train(data, options, outputs=Outputs(resume=tmp_path / "trunk.npz"))
    assert 0.75 * len(whole.model) == pytest.approx(len(left.model), abs=3)


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["mcmc", "gradient"])
def test_a_resumed_run_equals_an_uninterrupted_one(data, tmp_path, strategy):
    assert_resumes_identically(data, TrainOptions(**QUICK, strategy=strategy), tmp_path)


@pytest.mark.parametrize(("seconds", "count"), [(0.0, 60), (1e9, 2)])
def test_the_preview_is_renewed_by_time_and_after_the_last_step(data, tmp_path, monkeypatch, seconds, count):
    written, preview = [], tmp_path / "p.png"
    write = training_loop.save_image
    monkeypatch.setattr(training_loop, "save_image", lambda *one: (written.append(one), write(*one)))
    outputs = Outputs(preview=preview, preview_seconds=seconds)
    shown, plain = (train(data, TrainOptions(**QUICK), outputs=one).model for one in (outputs, Outputs()))
    assert np.array_equal(plain.means, shown.means)
    assert count == len(written)
    with Image.open(preview) as image:
        assert (2 * SIZE, SIZE) == image.size


def test_progress_and_log_are_written(data):
    seen = []
    result = train(data, TrainOptions(**QUICK), on_step=seen.append)
    assert [2, 10, 20, 30, 40, 60] == [now.iteration for now in seen]
    assert [1.0, 1.5, 2.5, 3.5] == moving_average([1, 2, 3, 4], 2).tolist()
    log = json.loads(json.dumps(result.log, allow_nan=False))
    assert 60 == len(log["losses"])
    assert {"psnr", "ssim", "lpips", "psnr_mean"} <= set(log["metrics"])


def test_learning_rates_decay_and_options_out_of_range_are_refused():
    options = TrainOptions(iterations=100, refine_stop=0.6, lr_decay=0.2)
    ends = [options.learning_rates(step, 2.0)["means"] for step in (0, 100)]
    assert [options.lr_means * 2, options.lr_means_final * 2] == pytest.approx(ends)
    shares = [options.learning_rates(step, 2.0)["scales"] / options.lr_scales for step in (1, 60, 80, 100)]
    assert [1.0, 1.0, 0.6, 0.2] == pytest.approx(shares)  # after refinement
    assert TrainOptions(refine_stop=1.0, lr_decay=0.2).learning_rates(7000, 2.0)["shN"] == TrainOptions.lr_shN
    wrong = {
        "max_splats": 0,
        "device": "mps",
        "sh_degree": 5,
        "loss": "l2",
        "lr_means": np.nan,
        "lr_means_final": 1.0,
        "engine": "gsplat",
    }
    for name, value in wrong.items():
        with pytest.raises(InputError, match=r"expected|mps is not supported"):
            TrainOptions(**{name: value})


@pytest.mark.parametrize("options", [TrainOptions, FinetuneOptions])
def test_the_native_engine_is_refused_on_a_gpu(options):
    with pytest.raises(InputError, match="engine is native, expected auto or torch with device cuda"):
        options(device="cuda", engine="native")


def test_growth_reaches_the_cap_halfway_and_sh_degrees_are_activated_one_by_one():
    options, count = TrainOptions(max_splats=1000, iterations=2000), 10.0
    for step in range(1, options.refine_end // 2 + 1):
        if options.refines_after(step):
            count *= options.growth_from(10)
    assert 1000 == pytest.approx(count)
    assert (250, 500, 2) == tuple(TrainOptions(iterations=steps).refine_begin for steps in (2_000, 30_000, 20))
    assert (50, 100, 10) == tuple(TrainOptions(iterations=steps).refine_period for steps in (2_000, 30_000, 20))
    assert (1.05, 1.5) == (options.growth_from(1000), TrainOptions(growth=1.5).growth_from(10))
    degrees = TrainOptions(iterations=1500, sh_degree=2)
    assert [0, 1, 2, 2] == [degrees.active_degree(step) for step in (0, 100, 200, 1400)]


def test_prunings_are_spread_and_end_early():
    options = TrainOptions(max_splats=1000, final_share=0.4, iterations=1000, refine_stop=0.6)
    left = {step: options.prunings_left(step) for step in range(1, 1001) if options.prunings_left(step)}
    assert dict(zip(range(624, 841, 24), range(10, 0, -1), strict=True)) == left  # splats move until step 600
    for stop, last in ((0.5, 8), (0.8, 9), (1.0, 10)):  # few steps: fewer prunings
        short = TrainOptions(final_share=0.4, iterations=10, refine_stop=stop)
        assert [last] == [step for step in range(11) if short.prunings_left(step) == 1]
    assert not any(TrainOptions(iterations=1000).prunings_left(step) for step in range(1, 1001))
