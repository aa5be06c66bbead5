# SPDX-License-Identifier: Apache-2.0
"""Training: the loop, resumed runs, `csplat train` to a PLY or a file; checkpoints, gains of images.

Also: csplat_tools.cli.train, csplat_tools.training.training_run, csplat_trainer.engine,
csplat_trainer.fit_checkpoint, csplat_trainer.fitter, csplat_trainer.image_gains, csplat_trainer.initial_splats,
csplat_trainer.pruning.
"""

from __future__ import annotations

import json
import shlex
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest
from captures import training_images
from command_line import call
from PIL import Image
from posed_sets import to_opengl
from train_cases import QUICK, SIZE, assert_resumes_identically

from csplat import decode, write_ply
from csplat.encoder import EncodeOptions, EncodePlan, Target, fix_quantisation
from csplat.errors import InputError
from csplat.ply import read_ply
from csplat_render.camera import Camera, relative_to
from csplat_tools.training.training_run import explain_size, plan_training, tuning_after, tuning_checkpoint
from csplat_trainer.data import DataSet
from csplat_trainer.engine import CpuEngine
from csplat_trainer.fit_checkpoint import FitCheckpoint, load_checkpoint, save_checkpoint
from csplat_trainer.fitter import Fitter
from csplat_trainer.image_gains import ImageGain, ImageGains
from csplat_trainer.initial_splats import measure_extent, place_splats
from csplat_trainer.losses import PhotometricLoss
from csplat_trainer.parameters import GROUPS, Parameters, from_model
from csplat_trainer.training_loop import fit_to_options, train
from csplat_trainer.training_options import Outputs, TrainOptions
from csplat_trainer.tuning import FinetuneOptions, TuningView, TuningViews, tune


def brief(iterations=1, **options):
    return TrainOptions(**{**QUICK, "iterations": iterations, **options})


@pytest.fixture
def data(make_model):
    return training_images(make_model)


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["mcmc", "gradient"])
def test_training_prunes_to_the_final_share(data, strategy):
    options = TrainOptions(**QUICK, strategy=strategy, final_share=0.5, refine_stop=0.5)
    pruned, whole = (train(data, replace(options, final_share=share)) for share in (0.5, 1.0))
    counts = {entry["iteration"]: entry["splat_count"] for entry in pruned.log["entries"]}
    assert counts[40] == counts[60] == len(pruned.model)
    assert len(whole.model) / 2 == pytest.approx(counts[60], abs=3)


@pytest.mark.slow
def test_training_starts_with_images_of_half_the_size(data, tmp_path, monkeypatch):
    widths, step = [], CpuEngine.step
    watched = lambda engine, picture, *rest: widths.append(picture.camera.W) or step(engine, picture, *rest)  # noqa: E731
    monkeypatch.setattr(CpuEngine, "step", watched)
    assert_resumes_identically(data, TrainOptions(**QUICK, half_size=0.5), tmp_path)
    assert [SIZE // 2] * 30 + [SIZE] * 30 == widths[:60]  # sizes in the run without interruption


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["mcmc", "fixed", "gradient", "none"])
def test_training_reduces_the_loss(data, strategy):
    result = train(data, brief(150, refine_every=30, strategy=strategy, lr_means=4e-3))
    losses = result.log["losses"]
    assert np.mean(losses[-20:]) < 0.5 * np.mean(losses[:20])
    assert result.metrics["psnr_mean"] > 15
    assert len(result.model) <= 80


@pytest.mark.slow
def test_the_same_seed_gives_the_same_file(data, tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        write_ply(tmp_path / name, train(data, brief(30, seed=seed, background="random")).model)
    first, second, other = ((tmp_path / name).read_bytes() for name in "abc")
    assert first == second
    assert first != other


def test_a_scene_has_the_origin_of_its_data_set_and_an_extent_without_outlier_cameras(data, tmp_path):
    # Also if the run is resumed with images that have another origin.
    place, shift = np.array((500123.0, 4649876.0, 214.0)), np.array((1.0, -2.0, 0.5))
    plain = train(data, brief(30)).model
    placed = replace(data, origin=tuple(place), coordinate_system="RFU")
    moved = train(placed, brief(30), outputs=Outputs(tmp_path / "c.npz")).model
    assert (tuple(place), "RFU") == (moved.origin, moved.metadata.coordinate_system)
    assert np.array_equal(plain.means, moved.means)
    shifted = [replace(one, camera=relative_to(shift, one.camera)) for one in data.train]
    other = DataSet("other", shifted, [], origin=tuple(place + shift))
    again = train(other, brief(30), outputs=Outputs(resume=tmp_path / "c.npz")).model
    assert tuple(place + shift) == again.origin
    assert np.allclose(plain.means - shift, again.means, atol=1e-5)
    far = replace(data.train[0], camera=relative_to((3e4, 0.0, 0.0), data.train[0].camera))
    with_outlier = replace(data, train=[far, *data.train[1:]])
    assert (data.train, data.train[1:]) == (data.inliers, with_outlier.inliers)
    extent = train(with_outlier, brief()).log["scene_extent"]
    assert measure_extent(data.train).extent == pytest.approx(extent, rel=0.2)


def test_splats_start_within_the_hull_of_all_masks_or_in_a_box(data, make_model):
    scene = measure_extent(data.train)
    assert np.linalg.norm(scene.focus) < 0.1
    hull, box = (
        np.linalg.norm(place_splats(data.train, scene, 300, 0, np.random.default_rng(0), init=init)["means"], axis=1)
        for init in ("hull", "box")
    )
    assert hull.mean() < box.mean()
    opaque = training_images(make_model, alpha=False)
    model = train(opaque, brief(60)).model
    assert np.isfinite(model.means).all()
    assert (0.0, 0.0, 0.0) == model.metadata.training.background
    for init, message in (("hull", "requires images with alpha"), ("points", "requires points")):
        with pytest.raises(InputError, match=message):
            train(opaque, brief(init=init))


def test_the_first_view_of_surroundings_is_a_training_camera(data):
    assert "estimate" == train(data, brief(strategy="none")).model.metadata.entries["view"]["from"]  # an object
    rng = np.random.default_rng(0)
    far = rng.standard_normal((60, 3)) * 40.0
    points = np.concatenate([0.1 * rng.standard_normal((200, 3)), far]).astype(np.float32)
    given = DataSet("surrounded", data.train, data.test, points, np.full((260, 3), 0.5, np.float32))
    given = replace(given, up=(0.0, 0.6, -0.8))
    metadata = train(given, brief(strategy="none", max_splats=260)).model.metadata
    view = Camera.from_json(metadata.entries["view"])
    assert ("training", ["up"]) == (metadata.entries["view"]["from"], metadata.estimated)  # up by the cameras
    taken = [one.camera for one in data.train]
    assert 1 == sum(np.allclose(view.viewmat, one.viewmat, atol=1e-5) for one in taken)
    assert (SIZE, SIZE, taken[0].near) == (view.W, view.H, view.near)


def test_splats_start_at_the_points_unless_they_are_outside_all_images(data):
    points = np.random.default_rng(0).standard_normal((20, 3)).astype(np.float32)
    given = DataSet("made", data.train, [], points, np.full((20, 3), 0.25, np.float32))
    result = train(given, brief(lr_means=0.0, lr_means_final=0.0, noise=0.0))
    assert {tuple(row) for row in points.tolist()} == {tuple(row) for row in result.model.means.tolist()}
    assert result.metrics is None
    away = replace(data, points=np.full((5, 3), 4e6, np.float32))
    with pytest.raises(InputError, match="no camera sees any of the data set's 5 points, expected both in the same"):
        train(away, brief())
    assert train(away, brief(init="box")).log["losses"]


def write_set(folder, data):
    """Write the images as a transforms.json set without a split."""
    frames = []
    for number, picture in enumerate((*data.train, *data.test)):
        Image.fromarray(picture.pixels).save(folder / f"{number:02}.png")
        frames.append({"file_path": f"{number:02}.png", "transform_matrix": to_opengl(picture.camera)})
    document = {"fl_x": data.train[0].camera.K[0, 0], "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


FEW_WORDS = ("--max-splats", 40, "--sh-degree", 0, "--iterations", 5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("alpha", "background", "every", "size"),
    [(True, "random", 5, "24x20"), (False, "auto", 10, None), (False, "white", 8, None)],
)
def test_compare_agrees_with_the_metrics_of_train(make_model, tmp_path, alpha, background, every, size):
    folder = write_set(tmp_path, training_images(make_model, alpha=alpha))
    reading = ["--test-every", every, *(() if size is None else ("--size", size))]
    ply, log = tmp_path / "a.ply", tmp_path / "log.json"
    result = call("train", folder, ply, "--background", background, "--report", log, *reading, *FEW_WORDS)
    assert ("", 5) == (result.stdout, len(json.loads(log.read_text())["losses"]))
    record = read_ply(ply).metadata.training
    assert (every, size) == (record.test_every, None if record.size is None else "{}x{}".format(*record.size))
    assert record.background == ((1.0, 1.0, 1.0) if alpha or background == "white" else (0.0, 0.0, 0.0))
    assert str(record) in result.stderr
    untested = call("train", folder, tmp_path / "b.ply", "--test-every", 0, *FEW_WORDS)
    assert "; no test images" in untested.stderr
    colour = ",".join(str(value) for value in record.background)
    again = call("compare", ply, ply, "--data", folder, "--background", colour, "--json", "--test-every", every)
    scores, metrics = json.loads(again.stdout)["images"]["a"], json.loads(log.read_text())["metrics"]
    for name in ("psnr", "psnr_mean"):
        assert scores[name] == pytest.approx(metrics[name], abs=0.01)


@pytest.mark.slow
def test_the_command_trains_to_a_file_and_resumes(file_runs, tmp_path, monkeypatch):
    first, report = (file_runs.folder / "a.csplat").read_bytes(), file_runs.report
    model = decode(first)
    assert 30 == len(report["training"]["losses"])
    assert (len(model), len(first)) == (report["file"]["splats"], report["file"]["size_bytes"])
    assert {"source", "before_tuning", "file"} == set(report["file"]["scores"])
    assert "held-out images" in file_runs.messages
    record = model.metadata.training
    assert (1.0, 1.0, 1.0) == record.background
    assert str(record) in call("info", file_runs.folder / "a.csplat").stdout
    assert not (file_runs.folder / "run.tuning.npz").exists()
    run, other = tmp_path / "run.npz", tmp_path / "other.npz"
    shutil.copy(file_runs.checkpoint, run)
    with monkeypatch.context() as patch:
        interrupt_after(patch, 17)
        _, messages = file_runs.made("again.csplat", "--keep", 1, "--checkpoint", run, "--resume", run, status=130)
    assert f"{run} holds 30 of 30 steps, {tuning_checkpoint(run)} holds 17 of 30 steps; to continue" in messages
    for path in (run, tuning_checkpoint(run)):
        shutil.copy(path, tmp_path / path.name.replace("run", "other"))
    file_runs.made("again.csplat", "--keep", 1, "--checkpoint", run, "--resume", run)
    file_runs.made("further.csplat", "--keep", 1, "--checkpoint", other, "--resume", other, "--iterations", 40)
    assert {run, other} == {*tmp_path.iterdir()}
    again, further = ((file_runs.folder / f"{name}.csplat").read_bytes() for name in ("again", "further"))
    assert first == again
    assert first != further  # another scene: the existing tuning does not apply


def interrupt_after(patch, iteration):
    """Let Ctrl-C interrupt trainings and tunings after a step."""
    step = Fitter.step

    def interrupted(fitter, fit):
        step(fitter, fit)
        if fitter.iteration == iteration:
            signal.raise_signal(signal.SIGINT)

    patch.setattr(Fitter, "step", interrupted)


@pytest.mark.slow
def test_ctrl_c_leaves_a_checkpoint_beside_the_output_from_which_the_run_ends_as_if_uninterrupted(
    file_runs, tmp_path, monkeypatch
):
    whole, part = tmp_path / "whole.ply", tmp_path / "part.ply"
    words, left = ("--max-splats", 40, "--sh-degree", 0, "--iterations", 30), tmp_path / "part.ply.npz"
    call("train", file_runs.data, whole, *words)
    with monkeypatch.context() as patch:
        interrupt_after(patch, 17)
        preview = tmp_path / "part.png"
        messages = call("train", file_runs.data, part, *words, "--preview", preview, status=130).stderr
    (line,) = (line for line in messages.splitlines() if f"{left} holds 17 of 30 steps; to continue: " in line)
    continued = shlex.split(line.partition("to continue: csplat ")[2])
    assert {whole, left, preview} == {*tmp_path.iterdir()}
    assert 17 == load_checkpoint(left).iteration
    assert "is left from an earlier run" in call("train", file_runs.data, part, *words, status=1).stderr
    both = ("--resume", left, "--preview", tmp_path / "p", "--report", tmp_path / "p")
    assert "is given for two outputs" in call("train", file_runs.data, part, *words, *both, status=1).stderr
    stopped = preview.read_bytes()
    call(*continued)
    assert whole.read_bytes() == part.read_bytes()
    assert stopped != preview.read_bytes()
    assert {whole, part, left, preview} == {*tmp_path.iterdir()}  # an option named the checkpoint
    again = call("train", file_runs.data, tmp_path / "b.ply", *words, "--preview", preview, status=1)
    assert f"{preview} exists: --force replaces it" in again.stderr


@pytest.mark.slow
def test_one_training_gives_several_files(file_runs):
    trained, usual = file_runs.checkpoint.read_bytes(), file_runs.report["file"]
    resume = f"`--resume {shlex.quote(str(file_runs.checkpoint))} --target-size …` makes other sizes"
    assert f"`csplat view {shlex.quote(str(file_runs.folder / 'a.csplat'))}` shows it; {resume}\n" in file_runs.messages

    def made(name, *more, **options):
        return file_runs.made(name, "--resume", file_runs.checkpoint, *more, **options)[0]["file"]

    few = made("few.csplat", "--keep", 0.75)
    assert 0.75 * usual["splats"] == pytest.approx(few["splats"], abs=2)
    bound = usual["size_bytes"] + 200
    assert usual["size_bytes"] < made("larger.csplat", "--target-size", f"{bound}B")["size_bytes"] <= bound
    wanted = usual["validation"]["psnr"] - 0.75  # of twenty splats, nearer goals are out of reach
    good = made("good.csplat", "--target-psnr", wanted, final_share=1.0)
    assert wanted <= good["validation"]["psnr"] <= usual["validation"]["psnr"] + 0.05
    assert trained == file_runs.checkpoint.read_bytes()
    kept = file_runs.folder / "bad.csplat.npz"
    _, messages = file_runs.made("bad.csplat", "--target-size", "90B", status=1)
    assert f"{kept} holds 30 of 30 steps: --resume {kept} continues from" in messages  # no file is that small
    _, messages = file_runs.made("bad.csplat", "--resume", kept, "--keep", 1)
    assert kept.exists()
    kept.unlink()
    _, messages = file_runs.made("unnamed.csplat", "--keep", 1)
    assert "; with `--checkpoint run.npz`, `--resume run.npz --target-size …` makes other sizes of a" in messages
    assert [] == [*file_runs.folder.glob("unnamed.csplat*.npz")]


def test_a_training_is_planned_by_its_target_and_its_tuning_by_its_length():
    for target, max_splats, planned in (
        (None, None, (20_000, 0.8)), (None, 500, (500, 0.8)), (Target(keep=0.5), 500, (500, 0.5)),
        (Target(psnr=30.0), None, (20_000, 1.0)), (Target(size=80_000), None, (10_000, 0.8)),
        (Target(size=80_000), 16_000, (16_000, 0.5)), (Target(size=80_000), 4_000, (4_000, 1.0)),
    ):  # fmt: skip
        options = plan_training(TrainOptions(seed=7), target, max_splats=max_splats)
        assert (*planned, 7) == (options.max_splats, options.final_share, options.seed)
    with pytest.raises(InputError, match="max_psnr_drop is no target of train"):
        plan_training(TrainOptions(), Target(max_psnr_drop=1.0))
    short, usual = (tuning_after(TrainOptions(iterations=steps, lr_exposure=0.01)) for steps in (2_000, 12_000))
    assert FinetuneOptions(iterations=500, warm_up=50, lr_exposure=0.01) == short
    assert [1, 8, 1_000, 1_167] == [tuning_after(TrainOptions(iterations=n)).iterations for n in (5, 30, 4_000, 7_000)]
    assert (2_000, 0.01) == (usual.iterations, usual.lr_exposure)
    assert usual.lr_scales / short.lr_scales == pytest.approx(1 / 3)


def test_a_file_much_smaller_than_its_largest_size_is_explained_by_splats_or_steps():
    for grown, most, size_bytes, text in (
        (20_000, 25_000, 150_000, "the 20,000 splats; more need a larger --max-splats than 25,000"),
        (9_000, 9_000, 90_000, "the 9,000 splats that --max-splats allows, the size 20,000"),
        (700, 25_000, 7_000, "the 700 splats to which 30 steps grew the scene"),
        (20_000, 25_000, 199_000, None),
    ):  # fmt: skip
        training = {"splats": grown, "options": {"max_splats": most, "iterations": 30}}
        result = {"training": training, "file": {"size_bytes": size_bytes, "splats": grown}}
        lines = explain_size(result, Target(size=200_000))
        assert [text] == [None for _ in range(not lines)] + [text for line in lines if text and text in line]
        assert [] == explain_size(result, Target(psnr=30.0))


def test_damaged_images_and_options_of_a_file_for_a_ply_are_refused_before_training(data, tmp_path, monkeypatch):
    file, damaged = write_set(tmp_path, data) / "transforms.json", tmp_path / "11.png"
    damaged.write_bytes(damaged.read_bytes()[:100])
    monkeypatch.setattr("csplat_trainer.train", lambda *_, **__: pytest.fail("training began"))
    words = ("--iterations", 5)  # with a time, steps would be timed
    assert "11.png is a PNG that is truncated" in call("train", tmp_path, tmp_path / "a.ply", *words, status=1).stderr
    document = json.loads(file.read_text())
    for part, rows in (("train", slice(9)), ("val", slice(9, 12))):
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps({**document, "frames": document["frames"][rows]}))
    found = call("train", tmp_path, tmp_path / "a.csplat", *words, status=1).stderr
    assert "11.png is a PNG that is truncated" in found
    for words in (("--keep", 0.5), ("--preset", "small"), ("--target-size", "1MB"), ("--target-psnr", 30)):
        refused = call("train", tmp_path, tmp_path / "a.ply", *words, status=2).stderr
        assert "expected OUT.csplat" in " ".join(refused.split())
    for name in ("a", "a.", "a.v2"):
        refused = call("train", tmp_path, tmp_path / name, status=2).stderr
        assert "ends in neither .ply nor .csplat, expected OUT.ply or OUT.csplat" in " ".join(refused.split())
    assert [] == [*tmp_path.glob("a*")]


def test_a_checkpoint_is_loaded_and_adapts_to_other_options_and_is_refused_in_another_version(make_model, tmp_path):
    parameters = Parameters.starting_at(from_model(make_model(40, 2), 2))
    path, state = tmp_path / "run.npz", np.random.default_rng(0).bit_generator.state
    save_checkpoint(path, FitCheckpoint("train", 7, False, state, [3, 1], [], {"seed": 0}, {"losses": []}, parameters))
    again = load_checkpoint(path)
    assert (7, [3, 1]) == (again.iteration, again.queue)
    for name in GROUPS:
        assert np.array_equal(parameters.values[name], again.parameters.values[name])
        assert np.array_equal(parameters.second[name], again.parameters.second[name])
    for cap, degree, strategy, count in ((25, 1, "mcmc", 25), (60, 3, "fixed", 60), (60, 0, "mcmc", 40)):
        options = TrainOptions(max_splats=cap, sh_degree=degree, strategy=strategy)
        adapted = fit_to_options(load_checkpoint(path).parameters, options, np.random.default_rng(0))
        assert count == len(adapted)
        assert (count, (degree + 1) ** 2 - 1, 3) == adapted.values["shN"].shape == adapted.second["shN"].shape
    arrays = dict(np.load(path))
    facts = json.loads(arrays["facts"].tobytes()) | {"version": 1}
    np.savez(path, **{**arrays, "facts": np.frombuffer(json.dumps(facts).encode(), np.uint8)})
    with pytest.raises(InputError, match=r"run\.npz is a checkpoint of version 1, expected 2: begin a new run$"):
        load_checkpoint(path)


GAINS = np.array([0.7, 1.3, 0.8, 1.2, 0.9, 1.1, 0.75, 1.25, 1.0])  # gains of training images


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
    options = brief(450, refine_every=50, lr_means=2e-3, background="black")
    plain, corrected = (train(uneven, replace(options, lr_exposure=rate)) for rate in (0.0, 0.05))
    found = np.array(corrected.log["exposures"])
    assert np.abs(found.mean(axis=0)).max() < 1e-4
    assert np.corrcoef(np.exp(found[:, 0].mean(axis=1)), GAINS)[0, 1] > 0.5  # 80 splats represent the scene poorly
    assert "exposures" not in plain.log


@pytest.mark.slow
def test_a_resumed_run_keeps_its_gains(uneven, tmp_path):
    options = TrainOptions(**QUICK, lr_exposure=0.02)
    whole, stopped = assert_resumes_identically(uneven, options, tmp_path)
    assert np.abs(whole.log["exposures"]).max() > 0.0
    with pytest.raises(InputError, match="the checkpoint has exposures of 9 images, expected 8"):
        train(DataSet("fewer", uneven.train[:8], uneven.test), options, outputs=Outputs(resume=stopped))


@pytest.mark.slow
def test_tuning_corrects_gains(make_model, uneven):
    scene = make_model(30, 1, seed=3, scales=np.full((30, 3), -1.2, np.float32))  # the scene of the images
    fixed = fix_quantisation(EncodePlan.of(scene, EncodeOptions(sh_coding="scalar", attribute_psnr=60.0)))
    training, validation = ([TuningView(one.camera, one) for one in part] for part in (uneven.train, uneven.test))
    views = TuningViews(training, validation, np.zeros(3, np.float32))
    options = FinetuneOptions(iterations=200, validate_every=50, patience=0)
    plain, corrected = (tune(fixed, views, replace(options, lr_exposure=rate)).log for rate in (0.0, 0.05))
    assert corrected["validations"][-1]["psnr"] > plain["validations"][-1]["psnr"] + 0.5
    assert np.corrcoef(np.exp(np.array(corrected["exposures"])[:, 0].mean(axis=1)), GAINS)[0, 1] > 0.95
