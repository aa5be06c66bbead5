# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_trainer.tuned_scene."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from captures import H, W
from finetune_cases import BLACK, FEW, SOURCE, coarse, fixed_by, unchecked, views_of_source
from quantisation_cases import COUNT, important, moved

from csplat import EncodeOptions
from csplat.encoder import EncodePlan, fix_quantisation
from csplat.encoder.quantisation import quantise_sh
from csplat.errors import InputError
from csplat_render import kernels
from csplat_render.rasteriser import Rasteriser
from csplat_trainer import tuned_scene
from csplat_trainer.losses import PhotometricLoss
from csplat_trainer.parameters import logits_of
from csplat_trainer.training_options import Outputs
from csplat_trainer.tuned_scene import TunedScene
from csplat_trainer.tuning import FinetuneOptions, tune

CODINGS = {
    "codebook": EncodeOptions(sh_coding="codebook", codebook_size=16, escape_fraction=0.2),
    "scalar": EncodeOptions(sh_coding="scalar", adaptive=0.7, chroma_shift=1, tile_splats=90),
    "shapes": EncodeOptions(sh_coding="codebook", codebook_size=16, shape_codebook_size=32, tile_splats=90),
    "coarse shapes": EncodeOptions(shape_codebook_size=32, attribute_psnr=30.0),
    "no SH": EncodeOptions(sh_coding="none"),
    "fine": EncodeOptions(attribute_psnr=110.0),
}


def scene_of(make_model, coding):
    """Return a scene whose values have moved from the start."""
    if coding == "classes":
        model = make_model(COUNT, 0)
        plan = EncodePlan.of(model, importance=important(model))
    else:
        plan = EncodePlan.of(make_model(300, 3), CODINGS[coding], importance=np.logspace(-2, 2, 300))
    scene = TunedScene(fix_quantisation(plan))
    assert coding != "classes" or len(np.unique(scene._tiles[:, 1:], axis=0)) > 1
    assert coding != "scalar" or len(np.unique(scene._coarse)) > 1
    values, own = moved(scene.fixed), scene.parameters.values
    own["logits"][:] = logits_of(values.opacities)
    own["shN"][:] = values.sh
    for name in ("means", "quats", "scales", "sh0", "sizes"):
        own[name][:] = getattr(values, name)
    return scene


def assert_decoded_by_the_encoder(scene):
    """Assert that decoded values and streams are the encoder's, bit for bit."""
    (seen, alphas), expected = scene.dequantise(), scene._dequantise_unusual(scene.free_values)
    assert np.array_equal(scene.free_values.opacities, alphas)
    for found, wanted in ((seen, scene.fixed.dequantise(scene.free_values)), (seen.stored, expected.stored)):
        for name, array in vars(wanted).items():
            assert array.tobytes() == getattr(found, name).tobytes(), name


@pytest.mark.parametrize("coding", [*CODINGS, "classes"])
def test_decoded_values_are_the_encoders_bit_for_bit(make_model, coding):
    scene = scene_of(make_model, coding)
    assert scene._dequantise(scene.free_values) is not None
    assert_decoded_by_the_encoder(scene)
    quats = scene.parameters.values["quats"]
    quats[::2, 0] = 0.0  # many of these are rounded towards 0
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    assert_decoded_by_the_encoder(scene)


@pytest.mark.parametrize("name", ["means", "quats", "scales", "logits", "sh0", "shN"])
def test_unusual_values_are_decoded_by_the_encoder(make_model, name):
    scene = scene_of(make_model, "scalar")
    scene.parameters.values[name].reshape(-1)[7] = np.nan
    with np.errstate(invalid="ignore"):
        assert scene._dequantise(scene.free_values) is None
    if name in ("scales", "sh0", "shN"):  # their tile has a coarser lattice
        scene.parameters.values[name].reshape(-1)[7] = 1e6
        assert scene._dequantise(scene.free_values) is None
        assert_decoded_by_the_encoder(scene)


@pytest.mark.parametrize("coding", ["shapes", "scalar"])
def test_values_are_constrained_as_by_the_encoder(make_model, coding):
    scene, rng = scene_of(make_model, coding), np.random.default_rng(0)
    for array in scene.parameters.values.values():
        array[:] += rng.standard_normal(array.shape)
    expected = scene.free_values.copy()
    scene.fixed.constrain(expected)
    scene._constrain()
    for name, array in vars(expected).items():
        assert np.array_equal(array, getattr(scene.free_values, name)), name


@pytest.mark.parametrize("coding", ["shapes", "scalar", "classes"])
def test_steps_do_not_depend_on_the_number_of_threads(make_model, monkeypatch, coding):
    monkeypatch.setattr(kernels, "available_threads", lambda: 8)
    results = []
    for threads in (1, 2, 8):
        scene, rng = scene_of(make_model, coding), np.random.default_rng(0)
        with kernels.thread_count(threads):
            for _ in range(3):
                seen, alphas = scene.dequantise()
                gradients = {name: rng.standard_normal(array.shape).astype(np.float32) for name, array in
                             vars(seen).items() if name != "stored"}  # fmt: skip
                rates = dict.fromkeys(scene.parameters.values, 1e-2)
                scene.step(SimpleNamespace(**gradients), seen, alphas, rates, scene.count(seen, 1.0))
        results.append({name: array.tobytes() for name, array in scene.parameters.values.items()})
    assert results[0] == results[1] == results[2]


@pytest.mark.long
def test_the_gradient_of_an_entry_is_the_sum_over_its_users():
    # The sum over users, against finite differences of the loss by an entry's values.
    fixed = fixed_by(EncodeOptions(attribute_psnr=60.0, sh_coding="codebook", codebook_size=16))
    scene, view = TunedScene(fixed), views_of_source().train[0]
    rasteriser = Rasteriser()
    seen, _ = scene.dequantise()

    def rendered(shN):
        return rasteriser.forward(unchecked(replace(seen, shN=shN)), view.camera, background=np.ones(3)).rgb.copy()

    picture = rendered(seen.shN)
    _, slope = PhotometricLoss(H, W, 1.0, 0.0)(picture, np.zeros((H, W, 3), np.float32))
    by_row = scene._sh_rows.sum(rasteriser.backward(slope).shN)
    entry = int(np.argmax(np.abs(by_row[:16]).sum(axis=(1, 2))))
    users, h = fixed.book.index == entry, np.float32(1e-2)
    assert users.sum() > 1
    for k in range(3):
        high, low = seen.shN.copy(), seen.shN.copy()
        high[users, k, 1] += h
        low[users, k, 1] -= h
        difference = np.vdot(slope, rendered(high).astype(np.float64) - rendered(low)) / (2 * h)
        assert by_row[entry, k, 1] == pytest.approx(difference, rel=2e-2, abs=1e-6)


def test_rows_are_entries_and_escaped_splats():
    rng = np.random.default_rng(0)
    index = rng.integers(0, 9, 200).astype(np.int32)  # 8 entries, of which one has no splats, and escaped splats
    index[index == 5] = 4
    rows, escaped = tuned_scene.CodebookRows.of(index, 8), np.flatnonzero(index == 8)
    for shape in ((200, 3), (200, 4), (200, 15, 3), (200, 7)):
        values = rng.standard_normal(shape).astype(np.float32)
        entries = [values[index == entry].astype(np.float64).sum(axis=0) for entry in range(8)]
        by_row = rows.sum(values)
        assert np.allclose([*entries, *values[escaped]], by_row, atol=1e-5)
        assert np.array_equal(rows.take(by_row), by_row[np.where(index < 8, index, 8 + np.cumsum(index == 8) - 1)])


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
    costs = scene.count(scene.dequantise()[0], 2e-4)
    assert costs.loss == pytest.approx(2e-4 * costs.bits / 300)
    assert 5 < costs.bits / 300 < 200


@pytest.mark.parametrize("group", ["scales", "sh0", "logits", "quats", "shN"])
def test_gradients_of_costs_agree_with_the_definition(group):
    # The slopes of a cost that is quadratic in the integers are known.
    fixed = fixed_by(EncodeOptions(sh_coding="scalar", attribute_psnr=60.0))
    scene, plan = TunedScene(fixed), fixed.parameters
    seen, _ = scene.dequantise()
    stored = seen.stored
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
        options = FinetuneOptions(iterations=1, warm_up=warm_up, lambda_=0.0)
        tune(fixed, views_of_source(), options, outputs=Outputs(file))
        with np.load(file) as stored:
            steps = {name: np.abs(stored[f"values_{name}"] - start[name]).max() for name in start}
            moved.append({name: step / options.learning_rate_factor(1) for name, step in steps.items()})
    assert {"means", "quats", "scales", "logits", "sh0", "shN"} <= moved[0].keys()
    assert moved[0] == pytest.approx(moved[1], rel=0.05)
