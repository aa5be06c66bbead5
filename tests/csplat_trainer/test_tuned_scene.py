"""Tests of csplat_trainer.tuned_scene."""

import math
from dataclasses import replace

import numpy as np
import pytest
from captures import H, W
from finetune_cases import BLACK, FEW, SOURCE, coarse, fixed_by, unchecked, views_of_source

from csplat import EncodeOptions
from csplat.encoder.quantisation import quantise_sh
from csplat.errors import InputError
from csplat_render.rasteriser import Rasteriser
from csplat_trainer import tuned_scene
from csplat_trainer.losses import PhotometricLoss
from csplat_trainer.training_options import Outputs
from csplat_trainer.tuned_scene import TunedScene
from csplat_trainer.tuning import FinetuneOptions, tune

pytest.importorskip("numba", reason="requires the extra [render]")


@pytest.mark.long
def test_the_gradient_of_an_entry_is_the_sum_over_its_users():
    # The sum over users, against finite differences of the loss by an entry's values.
    fixed = fixed_by(EncodeOptions(attribute_psnr=60.0, sh_coding="codebook", codebook_size=16))
    scene, view = TunedScene(fixed), views_of_source().train[0]
    rasteriser = Rasteriser(dtype=np.float64)
    seen, _ = scene.dequantise()

    def rendered(shN):
        return rasteriser.forward(unchecked(replace(seen, shN=shN)), view.camera, background=np.ones(3)).rgb

    picture = rendered(seen.shN).astype(np.float32)
    _, slope = PhotometricLoss(H, W, 1.0, 0.0)(picture, np.zeros((H, W, 3), np.float32))
    by_row = scene._by_row(rasteriser.backward(slope.astype(np.float64)).shN.astype(np.float32))
    entry = int(np.argmax(np.abs(by_row[:16]).sum(axis=(1, 2))))
    users, h = fixed.book.index == entry, 1e-3
    assert users.sum() > 1
    for k in range(3):
        high, low = (seen.shN.astype(np.float64) for _ in range(2))
        high[users, k, 1] += h
        low[users, k, 1] -= h
        difference = float((slope * (rendered(high) - rendered(low))).sum()) / (2 * h)
        assert by_row[entry, k, 1] == pytest.approx(difference, rel=2e-2, abs=1e-6)


def test_sums_by_entry_agree_with_their_twin():
    rng = np.random.default_rng(0)
    index = rng.integers(0, 9, 200)
    order, starts = np.argsort(index, kind="stable"), np.searchsorted(np.sort(index), np.arange(9))
    values = rng.standard_normal((200, 7)).astype(np.float32)
    fast, slow = np.empty((8, 7), np.float32), np.empty((8, 7), np.float32)
    tuned_scene.sum_by_entry(values, order, starts, fast)
    tuned_scene.sum_by_entry_twin(values, order, starts, slow)
    assert np.allclose(slow, fast, atol=1e-5)
    assert np.allclose(slow[3], values[index == 3].sum(axis=0), atol=1e-5)


def test_a_step_moves_values_through_their_quantisers():
    scene, rasteriser, view = TunedScene(coarse()), Rasteriser(), views_of_source().train[0]
    before = {name: values.copy() for name, values in scene.parameters.values.items()}
    seen, alphas = scene.dequantise()
    wanted = view.image(BLACK, np.empty((H, W, 3), np.float32))
    _, slope = PhotometricLoss(H, W)(rasteriser.forward(unchecked(seen), view.camera, background=BLACK).rgb, wanted)
    moving = ("quats", "scales", "logits", "sh0", "shN")
    scene.step(rasteriser.backward(slope), seen, alphas, dict.fromkeys(before, 0.0) | dict.fromkeys(moving, 1e-4), None)
    after = scene.parameters.values
    assert np.array_equal(before["means"], after["means"])
    for name in ("scales", "logits", "sh0", "shN"):
        assert 0 < np.abs(after[name] - before[name]).max() <= 1.01e-4, name  # Adam's first step is the rate


def test_costs_are_the_entropy_with_slopes_away_from_common_values():
    columns = np.repeat([0, 1, -1, 2], [800, 100, 90, 10])[:, None]
    slopes, bits = tuned_scene.slopes_of(tuned_scene.count_integers([columns[:700], columns[700:]]))
    shares = np.array([800, 100, 90, 10]) / 1000
    assert bits == pytest.approx(-1000 * (shares * np.log2(shares)).sum())
    assert slopes[0, 128 + 1] > 0.5  # towards 2 the cost rises
    assert slopes[0, 128 - 1] < -0.5
    assert abs(slopes[0, 128]) < 0.2
    assert np.abs(slopes).max() <= 4.0


def test_costs_use_the_encoded_integers_and_lambda_is_loss_per_bit_and_splat():
    fixed = fixed_by(EncodeOptions(sh_coding="scalar", chroma_shift=1))
    seen, _ = TunedScene(fixed).dequantise()
    columns, _, _ = quantise_sh(fixed.start().sh, fixed.parameters, None)
    integers = tuned_scene.colour_integers_of(seen.shN, fixed.parameters.sh_step, 1)
    assert np.array_equal(columns.transpose(2, 1, 0), integers)
    scene = TunedScene(coarse())
    costs = tuned_scene.RateTerm.count(scene.fixed, scene.stream_values(scene.dequantise()[0]), 2e-4)
    assert costs.loss == pytest.approx(2e-4 * costs.bits / 300)
    assert 5 < costs.bits / 300 < 200


@pytest.mark.parametrize("group", ["scales", "sh0", "logits", "quats", "shN"])
def test_gradients_of_costs_agree_with_the_definition(group):
    # The slopes of a cost that is quadratic in the integers are known.
    fixed = fixed_by(EncodeOptions(sh_coding="scalar", attribute_psnr=60.0))
    scene, plan = TunedScene(fixed), fixed.parameters
    seen, _ = scene.dequantise()
    stored = scene.stream_values(seen)
    costs = scene.count(seen, weight=float(len(SOURCE)))
    costs.tables = {key: np.zeros_like(table) for key, table in costs.tables.items()}
    costs.tables["opacities" if group == "logits" else group] += 0.01 * np.arange(-128, 129)  # the slope of 0.005 n²
    steps = {key: np.zeros_like(values) for key, values in scene.parameters.values.items()}
    costs.add_to(steps, stored)
    assert [group] == [name for name, slopes in steps.items() if slopes.any()]
    if group == "scales":
        assert np.allclose(steps["scales"], 0.01 * stored.scales / plan.scale_step**2, rtol=1e-4)
    elif group == "quats":
        assert not steps["quats"][:, 0].any()
        unit = 1.0 / (math.sqrt(2.0) * plan.quat_levels)
        expected = 0.01 * np.clip(stored.quats[:, 1:] / unit, -128, 128) / unit  # the range of the table
        assert np.allclose(steps["quats"][:, 1:], expected, rtol=1e-3, atol=1e-3)
    elif group == "logits":
        level = np.sqrt(stored.opacities) * plan.opacity_levels
        expected = 0.01 * level * 0.5 * level * (1 - stored.opacities)
        small = level < 127
        assert np.allclose(steps["logits"][small], expected[small], rtol=1e-3, atol=1e-4)
    else:
        values, step = (stored.sh0[:, None], plan.sh0_step) if group == "sh0" else (stored.sh, plan.sh_step)
        r, g, b = np.moveaxis((values / step).astype(np.float64), -1, 0)
        scale = 2.0**plan.chroma_shift
        by_y, by_co, by_cg = 0.01 * (r + 2 * g + b) / 4, 0.01 * (r - b) / scale**2, 0.01 * (g - (r + b) / 2) / scale**2
        expected = np.stack([by_y / 4 + by_co - by_cg / 2, by_y / 2 + by_cg, by_y / 4 - by_co - by_cg / 2], axis=-1)
        gradient = steps[group].reshape(values.shape)
        assert np.abs(gradient - expected / step).max() < 0.05 / step  # the expected values are not rounded


def test_non_finite_values_end_a_run_with_an_error(monkeypatch):
    # Kernels survive NaN, so the loss may be finite; a file cannot represent it.
    step = TunedScene.step

    def spoilt(self, *arguments):
        step(self, *arguments)
        self.parameters.values["means"][7] = np.nan

    monkeypatch.setattr(TunedScene, "step", spoilt)
    with np.errstate(invalid="ignore"), pytest.raises(InputError, match="a value is not finite at step 4"):
        tune(coarse(), views_of_source(), FEW)


@pytest.mark.slow
def test_every_learning_rate_warms_up(tmp_path):
    fixed, file, moved = coarse(), tmp_path / "c.npz", []
    start = {name: values.copy() for name, values in TunedScene(fixed).parameters.values.items() if values.size}
    for warm_up in (0, 100):
        options = FinetuneOptions(iterations=1, warm_up=warm_up, byte_cost=0.0)
        tune(fixed, views_of_source(), options, outputs=Outputs(file))
        with np.load(file) as stored:
            steps = {name: np.abs(stored[f"values_{name}"] - start[name]).max() for name in start}
            moved.append({name: step / options.learning_rate_factor(1) for name, step in steps.items()})
    assert {"means", "quats", "scales", "logits", "sh0", "shN"} <= moved[0].keys()
    assert moved[0] == pytest.approx(moved[1], rel=0.05)
