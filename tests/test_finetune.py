"""Fine-tuning: learning, determinism, resumed runs, ends of a run, and the reports and files of the command.

The fixture `tuned_file` was tuned for a hundred steps; other tests use as few steps as possible.
"""

import json
import math
import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("numba", reason="requires the extra [render]")

from captures import H, W, cameras, photograph, shell
from command_line import call, change_options, invoke

import csplat
import csplat_trainer
from csplat import EncodeOptions, decode, write_ply
from csplat.decoder import read_declared_bounds, read_options
from csplat.encoder import EncodePlan, fix_quantisation
from csplat.encoder.quantisation import quantise_sh
from csplat.errors import InputError
from csplat_render import render
from csplat_render.camera_files import save_cameras
from csplat_render.conventions import UncheckedSplats
from csplat_render.rasteriser import Rasteriser
from csplat_tools.optimise.pruning import PrunedSubset
from csplat_tools.optimise.simplify import SimplifyOptions
from csplat_tools.training import tuning_run
from csplat_tools.training.tuning_report import ply_splat_bytes
from csplat_tools.views import ViewSet
from csplat_trainer.losses import PhotometricLoss
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.training_options import Outputs
from csplat_trainer.tuned_scene import (
    RateTerm,
    TunedScene,
    colour_integers_of,
    count_integers,
    slopes_of,
    sum_by_entry,
    sum_by_entry_twin,
)
from csplat_trainer.tuning import FinetuneOptions, TuningView, TuningViews, renders_of, split_views, tune
from csplat_trainer.tuning.tuning_loop import RateController

BLACK = np.zeros(3, np.float32)
QUICK = FinetuneOptions(iterations=30, warm_up=5, validate_every=10, log_every=5)
FEW = FinetuneOptions(iterations=12, warm_up=2, validate_every=4, log_every=2)
COARSE = EncodeOptions(attribute_psnr=28.0, sh_coding="codebook", codebook_size=16)


@pytest.fixture(scope="module")
def source():
    return shell(8)


@pytest.fixture(scope="module")
def coarse(source):
    """The fixed quantisation of a coarse file with a codebook."""
    return fix_quantisation(EncodePlan.of(source, COARSE))


@pytest.fixture(scope="module")
def views(source):
    return split_views(renders_of(source, cameras(14), BLACK, None), BLACK, validation_count=3)


def psnr(model, views):
    error = [np.square(render(model, view.camera).rgb - view.reference).mean() for view in views]
    return -10.0 * math.log10(float(np.mean(error)))


def unchecked(seen):
    return UncheckedSplats(seen.means, seen.quats, seen.scales, seen.opacities, seen.sh0, seen.shN)


# From a program.
@pytest.mark.slow
def test_finetune_takes_a_model_and_views_and_reports_every_step(source, views):
    steps, stages = [], []
    tuned = csplat_trainer.finetune(
        source, views, COARSE, QUICK, on_step=steps.append, progress=lambda *stage: stages.append(stage)
    )
    assert len(tuned.data) < len(csplat.encode(source))
    assert psnr(tuned.decoded, views.validation) > psnr(decode(tuned.plain.data), views.validation)
    assert np.array_equal(decode(tuned.data).sh0, tuned.decoded.sh0)
    assert list(range(5, 31, 5)) == [step.iteration for step in steps]
    assert ("tuning", 1.0) == stages[-1]


@pytest.mark.slow
def test_finetune_takes_a_data_set(capture):
    model, data = csplat.read_ply(capture / "scene.ply"), csplat_trainer.load(capture)
    tuned = csplat_trainer.finetune(model, data, COARSE, replace(QUICK, iterations=2))
    assert (len(data.train), 2) == (tuned.log["train_views"], tuned.log["steps"])


@pytest.fixture(scope="module")
def fine():
    """A few splats, coded so finely that tuning gains nothing, and views of them."""
    few = shell(3).select(slice(0, 40))
    fixed = fix_quantisation(EncodePlan.of(few, EncodeOptions(preset="fast", attribute_psnr=90.0, sh_coding="scalar")))
    return fixed, split_views(renders_of(few, cameras(8), BLACK, None), BLACK, validation_count=3)


# Learning.
@pytest.mark.slow
@pytest.mark.parametrize(
    "encoding",
    [
        COARSE, EncodeOptions(attribute_psnr=28.0, sh_coding="scalar"), replace(COARSE, shape_codebook_size=32),
        EncodeOptions(attribute_psnr=28.0, sh_coding="none", tile_splats=80),
    ],
    ids=["codebook", "scalar", "shapes", "no SH"],
)  # fmt: skip
def test_tuning_increases_the_psnr_at_nearly_the_same_size(source, views, encoding):
    fixed = fix_quantisation(EncodePlan.of(source, encoding))
    before = fixed.encode(fixed.start()).write().data
    tuned = tune(fixed, views, QUICK)
    after = fixed.encode(tuned.best_values).write().data
    assert psnr(decode(after), views.validation) > psnr(decode(before), views.validation) + 0.5
    assert len(after) < 1.1 * len(before)


@pytest.mark.slow
def test_masked_pixels_do_not_influence_tuning(coarse, views):
    taken = [one.camera for one in views.train]
    mask = np.ones((taken[0].H, taken[0].W), bool)
    mask[:, ::3] = False

    def hidden(value):
        shown = []
        for one in views.train:
            buffer = np.empty((*mask.shape, 3), np.float32)
            pixels = np.rint(255.0 * np.clip(one.image(BLACK, buffer), 0.0, 1.0)).astype(np.uint8)
            pixels[~mask] = value
            shown.append(TuningView(one.camera, PosedImage(one.camera, pixels, mask)))
        return TuningViews(shown, shown[:2], BLACK)

    first, second = (tune(coarse, hidden(value), FEW) for value in (0, 250))
    assert np.array_equal(first.best_values.sh0, second.best_values.sh0)
    assert first.log["validations"] == second.log["validations"]


@pytest.mark.slow
def test_the_decoded_file_has_the_psnr_of_the_tuning(coarse, views):
    tuned = tune(coarse, views, FEW)
    encoded = coarse.encode(tuned.best_values).write()
    decoded, seen = decode(encoded.data), coarse.dequantise(tuned.best_values)
    order, rows = np.argsort(encoded.source_index), np.argsort(coarse.source_index)
    for name in ("means", "shN"):
        assert np.array_equal(getattr(decoded, name)[order], getattr(seen, name)[rows])
    rasteriser, error = Rasteriser(), []
    for view in views.validation:
        picture = rasteriser.forward(unchecked(seen), view.camera, background=BLACK).rgb
        error.append(np.square(np.clip(picture, 0, 1) - np.clip(view.reference, 0, 1)).mean(dtype=np.float64))
    assert tuned.log["best_psnr"] == pytest.approx(-10.0 * math.log10(np.mean(error)), abs=1e-6)


@pytest.mark.slow
def test_a_run_without_gain_ends_early_and_keeps_the_start(fine):
    fixed, views = fine
    options = replace(FEW, iterations=30, patience=2, byte_cost=0.0).scaled(5.0)
    tuned = tune(fixed, views, options)
    assert tuned.log["converged"]
    assert 2 / 3 * 30 < tuned.log["steps"] < 30  # not before the learning rates are small
    assert 0 == tuned.log["best_iteration"]
    assert np.array_equal(fixed.start().sh, tuned.best_values.sh)
    assert not tune(fixed, views, replace(options, patience=0)).log["converged"]


@pytest.mark.slow
def test_a_run_with_too_large_files_does_not_end_early(fine, monkeypatch):
    fixed, views = fine
    options = replace(FEW, iterations=30, patience=2, byte_cost=0.0).scaled(5.0)
    assert tune(fixed, views, options, size_bytes=10**9).log["converged"]
    monkeypatch.setattr(RateController, "excess", lambda *_: 1e-3)
    assert 30 == tune(fixed, views, options, size_bytes=10**9).log["steps"]


# Gradients.
@pytest.mark.long
def test_the_gradient_of_an_entry_is_the_sum_over_its_users(source, views):
    # The sum over users, against finite differences of the loss by an entry's values.
    encoding = EncodeOptions(attribute_psnr=60.0, sh_coding="codebook", codebook_size=16)
    fixed = fix_quantisation(EncodePlan.of(source, encoding))
    scene, view = TunedScene(fixed), views.train[0]
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
    sum_by_entry(values, order, starts, fast)
    sum_by_entry_twin(values, order, starts, slow)
    assert np.allclose(slow, fast, atol=1e-5)
    assert np.allclose(slow[3], values[index == 3].sum(axis=0), atol=1e-5)


def test_a_step_moves_values_through_their_quantisers(coarse, views):
    scene = TunedScene(coarse)
    before = {name: values.copy() for name, values in scene.parameters.values.items()}
    rasteriser, view = Rasteriser(), views.train[0]
    seen, alphas = scene.dequantise()
    wanted = view.image(BLACK, np.empty((H, W, 3), np.float32))
    _, slope = PhotometricLoss(H, W)(rasteriser.forward(unchecked(seen), view.camera, background=BLACK).rgb, wanted)
    moving = ("quats", "scales", "logits", "sh0", "shN")
    scene.step(rasteriser.backward(slope), seen, alphas, dict.fromkeys(before, 0.0) | dict.fromkeys(moving, 1e-4), None)
    after = scene.parameters.values
    assert np.array_equal(before["means"], after["means"])
    for name in ("scales", "logits", "sh0", "shN"):
        assert 0 < np.abs(after[name] - before[name]).max() <= 1.01e-4, name  # Adam's first step is the rate


# The cost of bytes.
def test_costs_are_the_entropy_with_slopes_away_from_common_values():
    columns = np.repeat([0, 1, -1, 2], [800, 100, 90, 10])[:, None]
    slopes, bits = slopes_of(count_integers([columns[:700], columns[700:]]))
    shares = np.array([800, 100, 90, 10]) / 1000
    assert bits == pytest.approx(-1000 * (shares * np.log2(shares)).sum())
    assert slopes[0, 128 + 1] > 0.5  # towards 2 the cost rises
    assert slopes[0, 128 - 1] < -0.5
    assert abs(slopes[0, 128]) < 0.2
    assert np.abs(slopes).max() <= 4.0


def test_costs_use_the_encoded_integers(source):
    fixed = fix_quantisation(EncodePlan.of(source, EncodeOptions(sh_coding="scalar", chroma_shift=1)))
    seen, _ = TunedScene(fixed).dequantise()
    columns, _, _ = quantise_sh(fixed.start().sh, fixed.parameters, None)
    integers = colour_integers_of(seen.shN, fixed.parameters.sh_step, 1)
    assert np.array_equal(columns.transpose(2, 1, 0), integers)


@pytest.mark.parametrize("group", ["scales", "sh0", "logits", "quats", "shN"])
def test_gradients_of_costs_agree_with_the_definition(source, group):
    # The slopes of a cost that is quadratic in the integers are known.
    fixed = fix_quantisation(EncodePlan.of(source, EncodeOptions(sh_coding="scalar", attribute_psnr=60.0)))
    scene = TunedScene(fixed)
    seen, _ = scene.dequantise()
    stored = scene.stream_values(seen)
    name = {"logits": "opacities"}.get(group, group)
    integers = np.arange(-128, 129, dtype=np.float32)
    costs = scene.count(seen, weight=float(len(source)))
    costs.tables = {key: np.zeros_like(table) for key, table in costs.tables.items()}
    costs.tables[name] += 0.01 * integers  # the slope of 0.005 n²
    steps = {key: np.zeros_like(values) for key, values in scene.parameters.values.items()}
    costs.add_to(steps, stored)
    for other, slopes in steps.items():
        assert slopes.any() == (other == group)
    plan = fixed.parameters
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
        gradient = steps[group].reshape(values.shape)
        n = (values / step).astype(np.float64)
        y, co, cg = (n[..., 0] + 2 * n[..., 1] + n[..., 2]) / 4, n[..., 0] - n[..., 2], 0.0
        cg = n[..., 1] - (n[..., 0] + n[..., 2]) / 2
        scale = 2.0**plan.chroma_shift
        by_y, by_co, by_cg = 0.01 * y, 0.01 * co / scale**2, 0.01 * cg / scale**2
        expected = np.stack([by_y / 4 + by_co - by_cg / 2, by_y / 2 + by_cg, by_y / 4 - by_co - by_cg / 2], axis=-1)
        assert np.abs(gradient - expected / step).max() < 0.05 / step  # the expected values are not rounded


def test_lambda_is_loss_per_bit_and_splat(coarse):
    scene = TunedScene(coarse)
    seen, _ = scene.dequantise()
    costs = RateTerm.count(scene.fixed, scene.stream_values(seen), 2e-4)
    assert costs.loss == pytest.approx(2e-4 * costs.bits / 300)
    assert 5 < costs.bits / 300 < 200


# Determinism and resumed runs.
@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_at_any_number_of_threads(source, views):
    files = []
    for seed, threads in ((1, 1), (1, 2), (2, 1)):
        fixed = fix_quantisation(EncodePlan.of(source, COARSE))
        tuned = tune(fixed, views, replace(FEW, seed=seed), threads=threads)
        files.append(fixed.encode(tuned.best_values).write().data)
    assert files[0] == files[1]
    assert files[0] != files[2]


@pytest.mark.parametrize("share", [None, pytest.param(0.9, marks=pytest.mark.slow)], ids=["fixed lambda", "size"])
def test_a_killed_run_resumes_as_if_uninterrupted(source, coarse, views, tmp_path, share):
    shapes = replace(COARSE, shape_codebook_size=32)
    fixed = coarse if share is None else fix_quantisation(EncodePlan.of(source, shapes))
    size_bytes = None if share is None else int(share * len(fixed.encode(fixed.start()).write().data))
    file, options = tmp_path / "c.npz", replace(FEW, lr_exposure=0.01)

    def kill(now):
        if now.iteration == 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tune(fixed, views, options, size_bytes=size_bytes, progress=kill, outputs=Outputs(file, 3))
    whole, rest = (
        tune(fixed, views, options, size_bytes=size_bytes, outputs=Outputs(resume=one)) for one in (None, file)
    )
    assert fixed.encode(whole.best_values).write().data == fixed.encode(rest.best_values).write().data
    for name in ("losses", "validations", "exposures", "byte_cost"):
        assert whole.log[name] == rest.log[name]


@pytest.mark.slow
def test_lambda_is_controlled_to_meet_a_size(source, views):
    fixed = fix_quantisation(EncodePlan.of(source, EncodeOptions(attribute_psnr=34.0)))
    before = len(fixed.encode(fixed.start()).write().data)
    options, costs = replace(QUICK, byte_cost=4e-3), []
    for share, steps in ((0.93, 120), (1.5, 60)):
        tuned = tune(fixed, views, replace(options, iterations=steps), size_bytes=int(share * before))
        size = len(fixed.encode(tuned.best_values).write().data)
        assert size <= share * before
        best = next(look for look in tuned.log["validations"] if look["iteration"] == tuned.log["best_iteration"])
        assert best["size_bytes"] == size
        costs.append(tuned.log["byte_cost"])
    assert costs[0] > options.byte_cost > costs[1]


def test_the_excess_of_a_file_is_added_to_the_loss():
    budget = RateController(1_000, 1e-4)
    assert (0.0, 0.0, 0.25) == tuple(budget.excess(size, 4_000.0) for size in (900, 1_000, 1_250))


def test_the_rate_controller_raises_lambda_in_time():
    # A scene whose bits grow while learning rates are large, unless they cost the initial lambda.
    budget, bits = RateController(100_000, 1e-4), 470_000.0
    for count in range(20):
        done = count / 20
        budget.excess(round(37_500 + bits / 8), bits)
        budget.update(bits, done, 1e-4)
        moves = 0.5 + 0.5 * math.cos(math.pi * done)
        bits *= 1.0 - 0.003 * moves * math.log2(budget.byte_cost / 1e-4)
    assert 0.0 == budget.excess(round(37_500 + bits / 8), bits)
    assert 0.98 * 100_000 < 37_500 + bits / 8


def test_a_checkpoint_of_another_run_is_refused(source, coarse, views, tmp_path):
    file = tmp_path / "c.npz"
    tune(coarse, views, replace(QUICK, iterations=5), outputs=Outputs(file))
    other = fix_quantisation(EncodePlan.of(source, replace(COARSE, attribute_psnr=29.0)))
    lighter = replace(views, background=views.background + np.float32(0.5))
    for message, scene, seen, options, size_bytes in (
        ("another byte_cost", coarse, views, replace(QUICK, byte_cost=0.5), None),
        ("another target", coarse, views, QUICK, 10_000),
        ("other views", coarse, replace(views, train=views.train[1:]), QUICK, None),
        ("other views", coarse, lighter, QUICK, None),
        ("another scene", other, views, QUICK, None),
    ):
        with pytest.raises(InputError, match=message):
            tune(scene, seen, options, size_bytes=size_bytes, outputs=Outputs(resume=file))


def test_a_damaged_checkpoint_is_refused(coarse, views, tmp_path):
    file, bad = tmp_path / "c.npz", tmp_path / "bad.npz"
    tune(coarse, views, replace(QUICK, iterations=1), outputs=Outputs(file))
    np.savez(tmp_path / "n.npz", facts=np.frombuffer(b'{"version": 2}', np.uint8))
    np.save(tmp_path / "n.npy", np.zeros(3))
    data, entry = file.read_bytes(), file.read_bytes().index(b"PK\x01\x02")
    locked = data[: entry + 8] + bytes([data[entry + 8] | 1]) + data[entry + 9 :]
    unknown = data[: entry + 10] + bytes([77]) + data[entry + 11 :]
    arrays = [(tmp_path / name).read_bytes() for name in ("n.npz", "n.npy")]
    for content in (b"", b"no checkpoint", data[:-500], locked, unknown, *arrays):
        bad.write_bytes(content)
        with pytest.raises(InputError, match="not a checkpoint") as caught:
            tune(coarse, views, QUICK, outputs=Outputs(resume=bad))
        assert "pickle" not in str(caught.value)


def test_non_finite_values_end_a_run_with_an_error(coarse, views, monkeypatch):
    # Kernels survive NaN, so the loss may be finite; a file cannot represent it.
    step = TunedScene.step

    def spoilt(self, *arguments):
        step(self, *arguments)
        self.parameters.values["means"][7] = np.nan

    monkeypatch.setattr(TunedScene, "step", spoilt)
    with np.errstate(invalid="ignore"), pytest.raises(InputError, match="a value is not finite at step 4"):
        tune(coarse, views, FEW)


# Options and views.
@pytest.mark.parametrize("wrong", [{"iterations": 0}, {"lr_sh0": -1.0}, {"byte_cost": float("nan")}, {"loss": "l3"}])
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        FinetuneOptions(**wrong)


def test_learning_rates_rise_and_fall():
    options = FinetuneOptions(iterations=1000, warm_up=100, decay=0.01)
    shares = [options.learning_rate_factor(step) for step in range(1, 1001)]
    assert shares[0] == pytest.approx(1 / 101)
    assert 90 < int(np.argmax(shares)) < 110
    assert shares[-1] == pytest.approx(0.01, rel=0.01)
    assert 2.0 * options.lr_sh0 == options.scaled(2.0).lr_sh0
    assert options.byte_cost == options.scaled(2.0).byte_cost


def test_every_learning_rate_warms_up(coarse, views, tmp_path):
    fixed, file, moved = coarse, tmp_path / "c.npz", []
    start = {name: values.copy() for name, values in TunedScene(fixed).parameters.values.items() if values.size}
    for warm_up in (0, 100):
        options = FinetuneOptions(iterations=1, warm_up=warm_up, byte_cost=0.0)
        tune(fixed, views, options, outputs=Outputs(file))
        with np.load(file) as stored:
            steps = {name: np.abs(stored[f"values_{name}"] - start[name]).max() for name in start}
            moved.append({name: step / options.learning_rate_factor(1) for name, step in steps.items()})
    assert {"means", "quats", "scales", "logits", "sh0", "shN"} <= moved[0].keys()
    for name in start:
        assert moved[0][name] == pytest.approx(moved[1][name], rel=0.05), name


def test_training_renders_are_those_of_the_source(source):
    bright = replace(source, sh0=source.sh0 * np.float32(1e6))
    for model in (source, bright):
        camera = cameras(1)[0]
        wanted = render(model, camera, background=BLACK).rgb
        view = renders_of(model, [camera], BLACK, None)[0]
        found = view.image(BLACK, np.empty((H, W, 3), np.float32))
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


# the command

ENCODE_OPTIONS = "csplat_tools.cli.finetune.EncodeOptions"
BRIEF = ("--preset", "fast", "--iterations", 1)  # for tests that do not depend on learning


@pytest.fixture(autouse=True)
def bare(monkeypatch):
    """Make the command encode neither SH nor codebooks, which take time."""
    change_options(monkeypatch, ENCODE_OPTIONS, sh_coding="none", shape_codebook_size=0)


@pytest.fixture(scope="module")
def capture(source, tmp_path_factory):
    return photograph(source, tmp_path_factory.mktemp("capture"))


@pytest.fixture
def brief_fits(monkeypatch):
    """Refit kept splats once, in a quarter of the usual steps."""
    brief = partial(SimplifyOptions, effort=1)
    monkeypatch.setattr("csplat_tools.training.tuning_run.SimplifyOptions", brief)


@pytest.fixture
def no_fits(monkeypatch):
    """Do not refit kept splats, in tests of their number."""
    bare = partial(SimplifyOptions, refit=False)
    monkeypatch.setattr("csplat_tools.training.tuning_run.SimplifyOptions", bare)


def tuned_facts(capture, out, *words):
    """Tune the scene of the capture to its images; return the JSON of the command."""
    return json.loads(call("finetune", capture / "scene.ply", "--data", capture, out, *words, "--json").stdout)


@pytest.mark.slow
def test_the_command_tunes_and_reports(tuned_file):
    facts, data = json.loads(tuned_file.report.read_text()), tuned_file.path.read_bytes()
    assert "14 training and 2 test images" in tuned_file.messages
    source, decoded = csplat.read_ply(tuned_file.source.ply), decode(data)
    assert (len(source), len(decoded)) == (facts["source_splats"], facts["splats"])
    assert facts["unseen"] == len(source) - len(decoded)
    assert len(data) == facts["size_bytes"]
    assert facts["ratio"] == pytest.approx(len(source) * ply_splat_bytes(facts["sh_degree"]) / len(data))
    assert sum(facts["bytes_by_attribute"].values()) + facts["overhead_bytes"] == len(data)
    assert {"choosing", "encoding", "tuning", "judging"} == set(facts["seconds"])
    assert 100 == len(facts["log"]["losses"])
    options = read_options(data)
    assert (facts["unseen"], 4096) == (options["finetuned"]["unseen"], options["asked"]["shape_codebook_size"])


@pytest.mark.slow
def test_tuning_increases_the_psnr_of_test_images(tuned_file):
    scores = json.loads(tuned_file.report.read_text())["scores"]
    source, before, after = (scores[name]["psnr"] for name in ("source", "before tuning", "file"))
    assert after > before + 1.0
    assert source > before
    scene, path, data = tuned_file.source.ply, tuned_file.path, tuned_file.source.data
    compared = json.loads(call("compare", scene, path, "--data", data, "--json").stdout)["photographs"]
    assert (source, after) == pytest.approx((compared["a"]["psnr"], compared["b"]["psnr"]), abs=1e-4)


@pytest.mark.slow
def test_verify_names_undeclared_attributes_of_a_tuned_file(tuned_file):
    proof = call("verify", tuned_file.path, "--source", tuned_file.source.ply)
    assert "not proved: sh0, sh1: the file states no error of them, compare renders" in proof.stdout


def test_a_file_that_decodes_differently_is_not_written(capture, tmp_path, monkeypatch):
    def wrong(data):
        model = decode(data)
        return replace(model, sh0=model.sh0 + np.float32(1e-6))

    monkeypatch.setattr("csplat_trainer.tuning.tuned_encoding.decode", wrong)
    out = tmp_path / "s.csplat"
    result = invoke("finetune", capture / "scene.ply", "--data", capture, out, *BRIEF)
    assert "sh0 of the file differ from the tuned" in str(result.exception)
    assert not out.exists()


@pytest.mark.slow
@pytest.mark.usefixtures("small_views")
def test_a_scene_is_tuned_to_its_own_renders_with_a_report_page(capture, tmp_path, monkeypatch):
    out, report, page = (tmp_path / name for name in ("s.csplat", "report.json", "page.html"))
    change_options(monkeypatch, ENCODE_OPTIONS, attribute_psnr=28.0)
    for name, value in {"VIEWS": 16, "VIEW_SIZE": (48, 36), "LEARNING_FACTOR": {True: 1.0}}.items():
        monkeypatch.setattr(tuning_run, name, value)
    words = ("finetune", capture / "scene.ply", "--self", out, "--iterations", 60)
    call(*words, "--report", report, "-q", "--page", page)
    facts = json.loads(report.read_text())
    assert (301, 301) == (facts["source_splats"], facts["splats"])
    assert (True, 2) == (facts["validation"]["held_out"], facts["validation"]["views"])
    assert {"before tuning", "file"} == set(facts["scores"])
    assert facts["scores"]["file"]["psnr"] > facts["scores"]["before tuning"]["psnr"] + 0.2
    pictures = re.findall("<figcaption>(.*?)</figcaption>", page.read_text())
    assert ["the source", "before tuning", "file"] * 3 == pictures[:9]
    compared = json.loads(call("compare", capture / "scene.ply", out, "--json").stdout)
    assert compared["psnr"] == pytest.approx(facts["scores"]["file"]["psnr"], abs=1e-4)


@pytest.mark.slow
def test_renders_for_tuning_may_use_a_camera_file(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(tuning_run, "run_finetuning", partial(tuning_run.run_finetuning, prune_unseen=True))
    save_cameras(tmp_path / "cameras.json", cameras(40))
    words = ("finetune", capture / "scene.ply", "--self", "--cameras", tmp_path / "cameras.json")
    facts = json.loads(call(*words, tmp_path / "s.csplat", *BRIEF, "--json", "-q").stdout)
    assert (301, 300, 4) == (facts["source_splats"], facts["splats"], facts["validation"]["views"])


@pytest.mark.slow
@pytest.mark.usefixtures("brief_fits")
def test_keep_prunes_splats_with_the_least_effect(capture, tmp_path):
    out = tmp_path / "s.csplat"
    facts = tuned_facts(capture, out, "--keep", 0.5, *BRIEF)
    assert (301, 150, 1) == (facts["source_splats"], facts["splats"], facts["unseen"])
    stated = read_declared_bounds(out.read_bytes())
    assert (301, 151) == (stated.source_count, stated.pruned_count)
    call("verify", out, "--source", capture / "scene.ply")


SMALL = ("--preset", "small", "--iterations", 10)
SCALAR = {"sh_coding": "scalar", "shape_codebook_size": 0}


@pytest.fixture(scope="module")
def whole(capture, tmp_path_factory):
    """Return the report on a file that was tuned without a target."""
    with pytest.MonkeyPatch.context() as patch:
        change_options(patch, ENCODE_OPTIONS, **SCALAR)
        return tuned_facts(capture, tmp_path_factory.mktemp("whole") / "w.csplat", *SMALL)


@pytest.mark.slow
@pytest.mark.usefixtures("no_fits")
@pytest.mark.parametrize(("share", "splats"), [(0.5, (50, 270)), (1.15, (300, 300))], ids=["fewer splats", "finer"])
def test_a_target_size_is_met(capture, whole, tmp_path, share, splats, monkeypatch):
    change_options(monkeypatch, ENCODE_OPTIONS, **SCALAR)
    size, out = int(share * whole["size_bytes"]), tmp_path / "s.csplat"
    facts = tuned_facts(capture, out, *SMALL, "--target-size", f"{size}B")
    assert 0.85 * size < out.stat().st_size == facts["size_bytes"] <= size
    assert splats[0] <= facts["splats"] <= splats[1]


@pytest.mark.slow
def test_an_impossible_target_size_is_refused(capture, source, tmp_path):
    write_ply(tmp_path / "one.ply", source.select(slice(0, 1)))
    words = ("finetune", tmp_path / "one.ply", "--data", capture, *BRIEF)
    result = invoke(*words, tmp_path / "x.csplat", "--target-size", "300B")
    assert (1, False) == (result.exit_code, (tmp_path / "x.csplat").exists())
    assert "more than 300 (E_INPUT)" in result.stderr


@pytest.mark.slow
@pytest.mark.usefixtures("brief_fits")
def test_a_target_psnr_is_met(capture, whole, tmp_path, monkeypatch):
    change_options(monkeypatch, ENCODE_OPTIONS, **SCALAR)
    out, wanted = tmp_path / "s.csplat", whole["validation"]["psnr"] + 1.0
    facts = tuned_facts(capture, out, *SMALL, "--target-psnr", wanted)
    assert wanted <= facts["validation"]["psnr"]
    assert out.stat().st_size == facts["size_bytes"]


class StubTuner(tuning_run.Tuner):
    """Tunes files without rendering: their error is that of their draft plus a constant, their size times a factor."""

    excess, overrun = 0.0, 1.0

    def _tune(self, _, __, error, size_bytes, **___):
        size = self.overrun * (self.goals[-1].size_bytes or size_bytes)
        return tuned_subset(size, best_psnr=-10.0 * math.log10(error + self.excess))

    def _image_error(self, _):
        return 4e-4


def tuned_subset(size, **log):
    return tuning_run.TunedSubset(SimpleNamespace(data=bytes(round(size)), log=log), {}, {})


def tuner_of(kind, source, **options):
    training = cameras(14)
    views = ViewSet("virtual", (0.0, 0.0, 0.0), training[:10], training[10:], (), virtual=True)
    return kind(source, views, EncodeOptions(), FEW, Outputs(), prune_unseen=False, effort=1, **options)


@pytest.fixture
def stub_tuner(source, monkeypatch):
    """A tuner whose drafts have the error of the goal, or its size; the goals are listed in `goals`."""
    tuner = tuner_of(StubTuner, source)
    tuner.goals = []

    def best_draft(search):
        tuner.goals.append(search.goal)
        error = min(search.goal.error, 2e-3)
        subset = PrunedSubset(search.pruner, source, np.arange(len(source)), 0.0, 0.0, refit_refused=False)
        size = round(100 / error) if search.goal.size_bytes is None else search.goal.size_bytes
        return SimpleNamespace(size_bytes=size, subset=subset, options=error), error

    monkeypatch.setattr(tuning_run.TargetSearch, "best_draft", best_draft)
    return tuner


@pytest.mark.parametrize("excess", [0.0, 4e-4, -4e-4, 8e-4])
def test_what_a_tuning_adds_to_the_error_of_its_draft_is_allowed_for(stub_tuner, excess):
    stub_tuner.excess = excess
    found = stub_tuner.tune_to(csplat.Target(psnr=30.0))
    assert 30.0 <= found.psnr <= 30.1
    assert len(stub_tuner.goals) <= 3


def test_a_psnr_below_what_tuning_adds_cannot_be_reached(stub_tuner):
    stub_tuner.excess = 1.1e-3
    with pytest.raises(InputError, match=r"30 dB cannot be reached: [\d,]+ bytes have 29\.\d\d dB"):
        stub_tuner.tune_to(csplat.Target(psnr=30.0))


def test_a_tuned_file_that_is_too_large_is_tuned_from_a_smaller_draft(stub_tuner):
    stub_tuner.overrun = 1.1
    assert 8_500 <= stub_tuner.tune_to(csplat.Target(size_bytes=10_000)).size_bytes <= 10_000
    assert [10_000, 8_016] == [goal.size_bytes for goal in stub_tuner.goals]


class GrowingTuner(tuning_run.Tuner):
    """Tunes without rendering; files grow by a tenth, so that values of the first steps alone may fit."""

    def _precise(self, _, __, size_bytes):
        self.untuned = [*getattr(self, "untuned", []), size_bytes]
        return self.encoding

    def _tune(self, _, __, ___, size_bytes, **____):
        last = round(1.1 * self.untuned[-1])
        log = {"steps": 10, "validations": [{"size_bytes": last}]}
        if last <= size_bytes:
            return tuned_subset(last, best_iteration=10, best_psnr=30.0, **log)
        return tuned_subset(self.untuned[-1], best_iteration=0, best_psnr=29.0, **log)


def test_a_tuning_that_outgrows_its_size_begins_smaller(source):
    tuner = tuner_of(GrowingTuner, source, importance=np.ones(len(source)))
    made = tuner.tune_to_size(10_000)
    assert 9_500 <= made.size_bytes <= 10_000
    assert (30.0, 2) == (made.psnr, len(tuner.untuned))


def test_importance_is_per_source_splat(capture, tmp_path, monkeypatch):
    words = ("finetune", capture / "scene.ply", "--data", capture, tmp_path / "s.csplat", *BRIEF)
    weighted = partial(tuning_run.run_finetuning, importance=str(tmp_path / "w.npy"))
    monkeypatch.setattr(tuning_run, "run_finetuning", weighted)
    np.save(tmp_path / "w.npy", np.ones(300))
    result = invoke(*words)
    assert 1 == result.exit_code
    assert "expected (301,)" in result.stderr
    np.save(tmp_path / "w.npy", np.arange(301.0))
    call(*words)


@pytest.mark.slow
def test_sensitivities_agree_with_the_command_sensitivity(capture, tmp_path, monkeypatch):
    call("sensitivity", capture / "scene.ply", tmp_path / "s.npz", "--data", capture)
    words = ("finetune", capture / "scene.ply", "--data", capture, *BRIEF, "--lambda", 0)
    call(*words, tmp_path / "b.csplat")
    weighted = partial(tuning_run.run_finetuning, importance=str(tmp_path / "s.npz"))
    monkeypatch.setattr(tuning_run, "run_finetuning", weighted)
    call(*words, tmp_path / "a.csplat")
    assert (tmp_path / "a.csplat").read_bytes() == (tmp_path / "b.csplat").read_bytes()


@pytest.mark.slow
def test_unseen_splats_are_pruned_and_counted_and_left_out_of_the_source_index(capture, tmp_path):
    out, index = tmp_path / "s.csplat", tmp_path / "index.npy"
    facts = tuned_facts(capture, out, *BRIEF, "--source-index", index)
    assert (301, 300, 1) == (facts["source_splats"], facts["splats"], facts["unseen"])
    stated = read_declared_bounds(out.read_bytes())
    assert (301, 1) == (stated.source_count, stated.pruned_count)
    assert 1 == read_options(out.read_bytes())["finetuned"]["unseen"]
    call("verify", out, "--source", capture / "scene.ply", "--source-index", index)
    assert np.array_equal(np.arange(1, 301), np.sort(np.load(index)))  # all except the one behind the cameras


@pytest.mark.slow
def test_without_test_images_nothing_is_scored(capture, tmp_path, monkeypatch):
    change_options(monkeypatch, "csplat_tools.cli.shared_options.DataOptions", test_every=0)
    monkeypatch.setattr(tuning_run, "default_validation_count", lambda *_, **__: 2)
    facts = tuned_facts(capture, tmp_path / "s.csplat", *BRIEF)
    assert ({}, None) == (facts["scores"], facts["test_reference"])
    assert (True, 2) == (facts["validation"]["held_out"], facts["validation"]["views"])


@pytest.mark.slow
def test_the_command_resumes(capture, tmp_path, monkeypatch):
    monkeypatch.setattr("csplat_tools.cli.shared_options.CHECKPOINT_EVERY", 4)
    words, run = ("finetune", capture / "scene.ply", "--data", capture, "--iterations", 6), tmp_path / "run.npz"
    call(*words, tmp_path / "a.csplat", "--checkpoint", run)
    call(*words, tmp_path / "b.csplat", "--resume", run)
    assert (tmp_path / "a.csplat").read_bytes() == (tmp_path / "b.csplat").read_bytes()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "expected --data or --self"),
        (("--self", "--data", "x"), "--data and --self: give one of them"),
        (("--data", "x", "--cameras", "y"), "--cameras and --data: give one of them"),
        (("--self", "--keep", "1.5"), "the kept fraction is 1.5"),
        (("--self", "--background", "white"), "--background requires --cameras or --data"),
        (("--self", "--lambda", "0", "--target-size", "1MB"), "--lambda and --target-size: give one of them"),
        (("--self", "--keep", "0.5", "--target-size", "1MB"), "--target-size and --keep: give one of them"),
        (("--self", "--lambda", "2"), "byte_cost is 2.0, expected 0 to 1"),
    ],
)
def test_invalid_options_have_status_2(capture, tmp_path, words, message):
    result = invoke("finetune", capture / "scene.ply", tmp_path / "s.csplat", *words)
    assert 2 == result.exit_code
    assert message in " ".join(result.stderr.replace("│", " ").split())


@pytest.mark.parametrize(
    ("out", "words", "message"),
    [
        ("new", "--self --report r.json --source-index ./r.json", "is given for two outputs"),
        ("new", "--self --report r --checkpoint r --force", "is given for two outputs"),
        ("old", "--self", "--force replaces it"),
        ("new", "--self --checkpoint scene.ply --force", "is the input"),
        ("new", "--data . --resume absent.npz", "absent.npz: No such file"),
    ],
)
def test_a_refused_run_writes_and_replaces_nothing(source, tmp_path, monkeypatch, out, words, message):
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "scene.ply", source)
    (tmp_path / "old.csplat").write_bytes(b"old")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    result = invoke("finetune", "scene.ply", f"{out}.csplat", *words.split(), *BRIEF)
    assert 1 == result.exit_code
    assert message in result.stderr
    assert before == {path.name: path.read_bytes() for path in tmp_path.iterdir()}


def test_cameras_without_splats_in_view_are_refused(source, tmp_path, monkeypatch):
    away = [replace(camera, viewmat=np.diag([-1.0, 1.0, -1.0, 1.0]) @ camera.viewmat) for camera in cameras(40)]
    save_cameras(tmp_path / "away.json", away)
    write_ply(tmp_path / "scene.ply", source)
    monkeypatch.setattr(tuning_run, "run_finetuning", partial(tuning_run.run_finetuning, prune_unseen=True))
    words = ("finetune", tmp_path / "scene.ply", tmp_path / "s.csplat", "--self")
    result = invoke(*words, "--cameras", tmp_path / "away.json")
    assert 1 == result.exit_code
    assert "no view shows any splat" in result.stderr
