# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_trainer.tuning.tuning_views."""

import json
from dataclasses import replace

import numpy as np
import pytest
from captures import H, W, cameras
from command_line import call
from finetune_cases import BLACK, FEW, SOURCE, coarse, views_of_source

from csplat.errors import InputError
from csplat_render import render
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.tuning import TuningView, TuningViews, renders_of, split_views, tune


@pytest.mark.slow
def test_masked_pixels_do_not_influence_tuning():
    mask = np.ones((H, W), bool)
    mask[:, ::3] = False

    def hidden(value):
        shown = []
        for one in views_of_source().train:
            pixels = np.rint(255.0 * np.clip(one.image(BLACK, np.empty((H, W, 3), np.float32)), 0.0, 1.0))
            pixels[~mask] = value
            shown.append(TuningView(one.camera, PosedImage(one.camera, pixels.astype(np.uint8), mask)))
        return TuningViews(shown, shown[:2], BLACK)

    first, second = (tune(coarse(), hidden(value), FEW) for value in (0, 250))
    assert np.array_equal(first.best_values.sh0, second.best_values.sh0)
    assert first.log["validations"] == second.log["validations"]


def test_training_renders_are_those_of_the_source():
    camera = cameras(1)[0]
    for model in (SOURCE, replace(SOURCE, sh0=SOURCE.sh0 * np.float32(1e6))):
        wanted = render(model, camera, background=BLACK).rgb
        found = renders_of(model, [camera], BLACK)[0].image(BLACK, np.empty((H, W, 3), np.float32))
        assert np.allclose(found, np.clip(wanted, -6e4, 6e4), rtol=6e-4, atol=1e-6)
    with pytest.raises(InputError, match="reference image has shape"):
        TuningView(camera, np.zeros((1, 1, 3), np.float32))


def test_validation_views_are_training_views_by_default():
    views = [TuningView(camera, np.zeros((H, W, 3), np.float32)) for camera in cameras(20)]
    together, apart = split_views(views, BLACK), split_views(views, BLACK, validation_count=4)
    assert (20, 16, False) == (len(together.train), len(together.validation), together.is_held_out)
    assert (16, 4, True) == (len(apart.train), len(apart.validation), apart.is_held_out)
    with pytest.raises(InputError, match="leave none"):
        split_views(views, BLACK, validation_count=20)
    with pytest.raises(InputError, match="at least one training view"):
        TuningViews([], [], BLACK)


@pytest.mark.slow
def test_tuning_increases_the_psnr_of_test_images(tuned_file):
    scores = json.loads(tuned_file.report.read_text())["scores"]
    source, before, after = (scores[name]["psnr"] for name in ("source", "before_tuning", "file"))
    assert after > before + 1.0
    assert source > before
    scene, path, data = tuned_file.source.ply, tuned_file.path, tuned_file.source.data
    compared = json.loads(call("compare", scene, path, "--data", data, "--json").stdout)["images"]
    assert (source, after) == pytest.approx((compared["a"]["psnr"], compared["b"]["psnr"]), abs=1e-4)
