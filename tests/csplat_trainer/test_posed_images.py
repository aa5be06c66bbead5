# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_trainer.posed_images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from captures import training_images
from train_cases import QUICK, SIZE

from csplat_render.camera import Camera, intrinsics
from csplat_trainer.data import DataSet
from csplat_trainer.posed_images import PosedImage, compose, halve
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import TrainOptions


def test_masked_pixels_do_not_influence_training(make_model):
    data, mask = training_images(make_model, alpha=False), np.ones((SIZE, SIZE), bool)
    mask[10:30, :20] = False

    def hidden(pictures, value):
        values = (np.where(mask[..., None], picture.pixels, np.uint8(value)) for picture in pictures)
        return [PosedImage(one.camera, pixels, mask) for one, pixels in zip(pictures, values, strict=True)]

    options = TrainOptions(**{**QUICK, "iterations": 20}, init="box")
    first, second = (
        train(DataSet("masked", hidden(data.train, value), hidden(data.test, value)), options) for value in (0, 200)
    )
    assert np.array_equal(first.model.means, second.model.means)
    assert np.array_equal(first.model.shN, second.model.shN)
    assert first.metrics == second.metrics
    assert first.log["entries"][-1]["psnr"] == second.log["entries"][-1]["psnr"]


@pytest.mark.slow
def test_large_units_do_not_change_the_scene(make_model):
    def larger(picture):
        viewmat = picture.camera.viewmat.copy()
        viewmat[:3, 3] *= 1e5
        return replace(picture, camera=replace(picture.camera, viewmat=viewmat))

    data = training_images(make_model)
    millimetres = replace(data, train=[*map(larger, data.train)], test=[*map(larger, data.test)])
    options = TrainOptions(**{**QUICK, "iterations": 200})
    usual, large = (train(one, options).metrics["psnr"] for one in (data, millimetres))
    assert large == pytest.approx(usual, abs=1.0)


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
    mask[:, ::2] = False  # an image without pixels at half the size is kept
    masked = PosedImage(camera, pixels, mask)
    narrow = PosedImage(Camera(intrinsics(1, 6, 8.0), np.eye(4), 1, 6), pixels[:6, :1])
    assert all(halve(picture) is picture for picture in (masked, narrow))
