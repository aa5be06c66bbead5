# SPDX-License-Identifier: Apache-2.0
"""Fine-tuning: learning, determinism, resumed runs, ends of a run, and the reports and files of the command.

Also: csplat_tools.cli.finetune, csplat_tools.training.tuning_report, csplat_trainer.tuning.tuning_engine,
csplat_trainer.tuning.tuning_options.
"""

import json
import math
import re
import shlex
import signal
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import finetune_cases as cases
import numpy as np
import pytest
from captures import cameras, photograph, shell
from command_line import call, change_options, invoke
from finetune_cases import BLACK, BRIEF, COARSE, FEW, QUICK, SOURCE, coarse, fixed_by, views_of_source

import csplat
from csplat import EncodeOptions, decode, write_ply
from csplat.context import Context
from csplat.decoder import read_declared_bounds, read_options
from csplat.errors import InputError
from csplat_render.rasteriser import Rasteriser
from csplat_tools.optimise.pruning import PrunedSubset
from csplat_tools.optimise.simplify import SimplifyOptions
from csplat_tools.training import tuning_run
from csplat_tools.training.tuning_report import ply_splat_bytes
from csplat_trainer.training_options import Outputs
from csplat_trainer.tuning import FinetuneOptions, renders_of, split_views, tune
from csplat_trainer.tuning.tuning_loop import RateController


def written(fixed, values):
    return fixed.encode(values).write().data


@pytest.mark.slow
@pytest.mark.parametrize(
    "encoding",
    [
        COARSE, EncodeOptions(attribute_psnr=28.0, sh_coding="scalar"), replace(COARSE, shape_codebook_size=32),
        EncodeOptions(attribute_psnr=28.0, sh_coding="none", tile_splats=80),
    ],
    ids=["codebook", "scalar", "shapes", "no SH"],
)  # fmt: skip
def test_tuning_increases_the_psnr_at_nearly_the_same_size(encoding):
    fixed, views = fixed_by(encoding), views_of_source()
    before, after = written(fixed, fixed.start()), written(fixed, tune(fixed, views, QUICK).best_values)
    assert cases.psnr(decode(after), views.validation) > cases.psnr(decode(before), views.validation) + 0.5
    assert len(after) < 1.1 * len(before)


@pytest.mark.slow
def test_the_decoded_file_has_the_psnr_of_the_tuning():
    fixed, views = coarse(), views_of_source()
    tuned = tune(fixed, views, FEW)
    encoded = fixed.encode(tuned.best_values).write()
    decoded, seen = decode(encoded.data), fixed.dequantise(tuned.best_values)
    order, rows = np.argsort(encoded.source_index), np.argsort(fixed.source_index)
    for name in ("means", "shN"):
        assert np.array_equal(getattr(decoded, name)[order], getattr(seen, name)[rows])
    rasteriser, error = Rasteriser(), []
    for view in views.validation:
        picture = rasteriser.forward(cases.unchecked(seen), view.camera, background=BLACK).rgb
        error.append(np.square(np.clip(picture, 0, 1) - np.clip(view.reference, 0, 1)).mean(dtype=np.float64))
    assert tuned.log["best_psnr"] == pytest.approx(-10.0 * math.log10(np.mean(error)), abs=1e-6)


@pytest.mark.slow
def test_a_run_without_gain_ends_early_unless_files_are_too_large(monkeypatch):
    few = shell(3).select(slice(0, 40))  # coded so finely that tuning gains nothing
    fixed = fixed_by(EncodeOptions(preset="fast", attribute_psnr=90.0, sh_coding="scalar"), few)
    views = split_views(renders_of(few, cameras(8), BLACK), BLACK, validation_count=3)
    options = replace(FEW, iterations=30, patience=2, lambda_=0.0).scaled(5.0)
    tuned = tune(fixed, views, options)
    assert tuned.log["converged"]
    assert 2 / 3 * 30 < tuned.log["steps"] < 30  # not before the learning rates are small
    assert 0 == tuned.log["best_iteration"]
    assert np.array_equal(fixed.start().sh, tuned.best_values.sh)
    assert not tune(fixed, views, replace(options, patience=0)).log["converged"]
    assert tune(fixed, views, options, size_bytes=10**9).log["converged"]
    monkeypatch.setattr(RateController, "excess", lambda *_: 1e-3)
    assert 30 == tune(fixed, views, options, size_bytes=10**9).log["steps"]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_at_any_number_of_threads():
    files = []
    for seed, threads in ((1, 1), (1, 2), (2, 1)):
        fixed = fixed_by(COARSE)
        tuned = tune(fixed, views_of_source(), replace(FEW, seed=seed), context=Context(threads=threads))
        files.append(written(fixed, tuned.best_values))
    assert files[0] == files[1]
    assert files[0] != files[2]


@pytest.mark.parametrize("share", [None, pytest.param(0.9, marks=pytest.mark.slow)], ids=["fixed lambda", "size"])
def test_an_ended_run_resumes_as_if_uninterrupted(tmp_path, share):
    fixed = coarse() if share is None else fixed_by(replace(COARSE, shape_codebook_size=32))
    size_bytes = None if share is None else int(share * len(written(fixed, fixed.start())))
    file, options = tmp_path / "c.npz", replace(FEW, lr_exposure=0.01)
    run = partial(tune, fixed, views_of_source(), options, size_bytes=size_bytes)

    def interrupt(now):
        if now.iteration == 8:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(SystemExit, match=str(128 + signal.SIGTERM)):
        run(on_step=interrupt, outputs=Outputs(file, 1e9))
    whole, rest = run(), run(outputs=Outputs(resume=file))
    assert written(fixed, whole.best_values) == written(fixed, rest.best_values)
    for name in ("losses", "validations", "exposures", "lambda_"):
        assert whole.log[name] == rest.log[name]


@pytest.mark.slow
def test_lambda_is_controlled_to_meet_a_size():
    fixed = fixed_by(EncodeOptions(attribute_psnr=34.0))
    before = len(written(fixed, fixed.start()))
    options, costs = replace(QUICK, lambda_=4e-3), []
    for share, steps in ((0.92, 120), (1.5, 60)):
        tuned = tune(fixed, views_of_source(), replace(options, iterations=steps), size_bytes=int(share * before))
        size = len(written(fixed, tuned.best_values))
        assert size <= share * before
        best = next(look for look in tuned.log["validations"] if look["iteration"] == tuned.log["best_iteration"])
        assert best["size_bytes"] == size
        costs.append(tuned.log["lambda_"])
    assert costs[0] > options.lambda_ > costs[1]


def test_the_rate_controller_adds_the_excess_of_a_file_to_the_loss_and_raises_lambda_in_time():
    budget = RateController(1_000, 1e-4)
    assert (0.0, 0.0, 0.25) == tuple(budget.excess(size, 4_000.0) for size in (900, 1_000, 1_250))
    # A scene whose bits grow while learning rates are large, unless they cost the initial lambda.
    budget, bits = RateController(100_000, 1e-4), 470_000.0
    for count in range(20):
        done = count / 20
        budget.excess(round(37_500 + bits / 8), bits)
        budget.update(bits, done, 1e-4)
        bits *= 1.0 - 0.003 * (0.5 + 0.5 * math.cos(math.pi * done)) * math.log2(budget.lambda_ / 1e-4)
    assert 0.0 == budget.excess(round(37_500 + bits / 8), bits)
    assert 0.98 * 100_000 < 37_500 + bits / 8


def test_a_damaged_checkpoint_and_those_of_other_runs_are_refused(tmp_path):
    file, bad, fixed, views = tmp_path / "c.npz", tmp_path / "bad.npz", coarse(), views_of_source()
    tune(fixed, views, replace(QUICK, iterations=1), outputs=Outputs(file))
    lighter = replace(views, background=views.background + np.float32(0.5))
    for message, scene, seen, options, size_bytes in (
        ("another lambda", fixed, views, replace(QUICK, lambda_=0.5), None),
        ("another target", fixed, views, QUICK, 10_000),
        ("other views", fixed, replace(views, train=views.train[1:]), QUICK, None),
        ("other views", fixed, lighter, QUICK, None),
        ("another scene", fixed_by(replace(COARSE, attribute_psnr=29.0)), views, QUICK, None),
    ):
        with pytest.raises(InputError, match=message):
            tune(scene, seen, options, size_bytes=size_bytes, outputs=Outputs(resume=file))
    np.savez(tmp_path / "n.npz", facts=np.frombuffer(b'{"version": 2}', np.uint8))
    np.save(tmp_path / "n.npy", np.zeros(3))
    data, entry = file.read_bytes(), file.read_bytes().index(b"PK\x01\x02")
    locked = data[: entry + 8] + bytes([data[entry + 8] | 1]) + data[entry + 9 :]
    unknown = data[: entry + 10] + bytes([77]) + data[entry + 11 :]
    arrays = [(tmp_path / name).read_bytes() for name in ("n.npz", "n.npy")]
    for content in (b"", b"no checkpoint", data[:-500], locked, unknown, *arrays):
        bad.write_bytes(content)
        with pytest.raises(InputError, match="not a checkpoint") as caught:
            tune(fixed, views, QUICK, outputs=Outputs(resume=bad))
        assert "pickle" not in str(caught.value)


def test_learning_rates_rise_and_fall_and_options_out_of_range_are_refused():
    options = FinetuneOptions(iterations=1000, warm_up=100, decay=0.01)
    shares = [options.learning_rate_factor(step) for step in range(1, 1001)]
    assert (1 / 101, 0.01) == pytest.approx((shares[0], shares[-1]), rel=0.01)
    assert 90 < int(np.argmax(shares)) < 110
    assert 2.0 * options.lr_sh0 == options.scaled(2.0).lr_sh0
    assert options.lambda_ == options.scaled(2.0).lambda_
    for name, wrong in {"iterations": 0, "lr_sh0": -1.0, "lambda_": float("nan"), "loss": "l3"}.items():
        with pytest.raises(InputError, match=name.rstrip("_")):
            FinetuneOptions(**{name: wrong})


# the command
@pytest.fixture(autouse=True)
def bare(monkeypatch):
    change_options(monkeypatch, cases.COMMAND_OPTIONS, **cases.BARE)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return photograph(SOURCE, tmp_path_factory.mktemp("capture"))


def tuned_facts(capture, out, *words):
    """Tune the scene of the capture to its images; return the JSON of the command."""
    return json.loads(call("finetune", capture / "scene.ply", "--data", capture, out, *words, "--json").stdout)


@pytest.mark.slow
def test_the_command_tunes_and_reports(tuned_file):
    facts, data = json.loads(tuned_file.report.read_text()), tuned_file.path.read_bytes()
    assert "14 training and 2 test images" in tuned_file.messages
    source, decoded = csplat.read(tuned_file.source.ply), decode(data)
    assert (len(source), len(decoded)) == (facts["source_splats"], facts["splats"])
    assert facts["unseen"] == len(source) - len(decoded)
    assert len(data) == facts["size_bytes"] == sum(facts["bytes_by_attribute"].values()) + facts["overhead_bytes"]
    assert facts["ratio"] == pytest.approx(len(source) * ply_splat_bytes(facts["sh_degree"]) / len(data))
    assert {"choosing", "encoding", "tuning", "judging"} == set(facts["seconds"])
    assert 100 == len(facts["log"]["losses"])
    options = read_options(data)
    assert (facts["unseen"], 4096) == (options["finetuned"]["unseen"], options["asked"]["shape_codebook_size"])
    verified = call("verify", tuned_file.path, "--source", tuned_file.source.ply)
    assert "not proved: sh0, sh1: the file declares no bounds for them, compare renders" in verified.stdout


@pytest.mark.slow
@pytest.mark.usefixtures("small_views")
def test_a_scene_is_tuned_to_its_own_renders_with_a_report_page(capture, tmp_path, monkeypatch):
    out, report, page = (tmp_path / name for name in ("s.csplat", "report.json", "page.html"))
    change_options(monkeypatch, cases.COMMAND_OPTIONS, attribute_psnr=28.0)
    for name, value in {"VIEWS": 16, "VIEW_SIZE": (48, 36), "LEARNING_FACTOR": {True: 1.0}}.items():
        monkeypatch.setattr(tuning_run, name, value)
    words = ("finetune", capture / "scene.ply", "--self", out, "--iterations", 60)
    call(*words, "--report", report, "-q", "--page", page)
    facts = json.loads(report.read_text())
    assert (301, 301) == (facts["source_splats"], facts["splats"])
    assert (True, 2) == (facts["validation"]["held_out"], facts["validation"]["views"])
    assert {"before_tuning", "file"} == set(facts["scores"])
    assert facts["scores"]["file"]["psnr"] > facts["scores"]["before_tuning"]["psnr"] + 0.2
    pictures = re.findall("<figcaption>(.*?)</figcaption>", page.read_text())
    assert ["the source", "before tuning", "file"] * 3 == pictures[:9]
    compared = json.loads(call("compare", capture / "scene.ply", out, "--json").stdout)
    assert compared["psnr"] == pytest.approx(facts["scores"]["file"]["psnr"], abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("keep", [0.5, None])
def test_unseen_splats_and_those_with_the_least_effect_are_pruned_and_counted(capture, tmp_path, keep, monkeypatch):
    monkeypatch.setattr(tuning_run, "SimplifyOptions", partial(SimplifyOptions, effort=1))  # a quarter of the steps
    out, index, left = tmp_path / "s.csplat", tmp_path / "index.npy", 300 if keep is None else 150
    more = () if keep is None else ("--keep", keep)
    facts = tuned_facts(capture, out, *BRIEF, "--source-index", index, *more)
    assert (301, left, 1) == (facts["source_splats"], facts["splats"], facts["unseen"])
    declared = read_declared_bounds(out.read_bytes())
    assert (301, 301 - left) == (declared.source_count, declared.pruned_count)
    assert 1 == read_options(out.read_bytes())["finetuned"]["unseen"]
    call("verify", out, "--source", capture / "scene.ply", "--source-index", index)
    assert left == len({*np.load(index).tolist()} & {*range(1, 301)})  # never the splat behind the cameras


SMALL = ("--preset", "small", "--iterations", 10)
SCALAR = {"sh_coding": "scalar", "shape_codebook_size": 0}


@pytest.fixture(scope="module")
def whole(capture, tmp_path_factory):
    """Return the report on a file that was tuned without a target."""
    with pytest.MonkeyPatch.context() as patch:
        change_options(patch, cases.COMMAND_OPTIONS, **SCALAR)
        return tuned_facts(capture, tmp_path_factory.mktemp("whole") / "w.csplat", *SMALL)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.5, 1.15, None], ids=["fewer splats", "finer", "psnr"])
def test_a_target_is_met(capture, whole, tmp_path, share, monkeypatch):
    fits = partial(SimplifyOptions, effort=1) if share is None else partial(SimplifyOptions, refit=False)
    monkeypatch.setattr(tuning_run, "SimplifyOptions", fits)
    change_options(monkeypatch, cases.COMMAND_OPTIONS, **SCALAR)
    out, size, wanted = tmp_path / "s.csplat", int((share or 0) * whole["size_bytes"]), whole["validation"]["psnr"] + 1
    target = ("--target-psnr", wanted) if share is None else ("--target-size", f"{size}B")
    facts = tuned_facts(capture, out, *SMALL, *target)
    assert out.stat().st_size == facts["size_bytes"]
    if share is None:
        assert wanted <= facts["validation"]["psnr"]
    else:
        assert 0.85 * size < facts["size_bytes"] <= size
        assert 50 <= facts["splats"] <= 270 if share < 1 else 300 == facts["splats"]


class StubTuner(tuning_run.Tuner):
    """Tunes files without rendering: their error is that of their draft plus a constant, their size times a factor."""

    excess, overrun = 0.0, 1.0

    def _tune(self, _, __, error, size_bytes, **___):
        size = self.overrun * (self.goals[-1].size_bytes or size_bytes)
        return cases.tuned_subset(size, best_psnr=-10.0 * math.log10(error + self.excess))

    def _image_error(self, _):
        return 4e-4


@pytest.fixture
def stub_tuner(monkeypatch):
    """A tuner whose drafts have the error of the goal, or its size; the goals are listed in `goals`."""
    tuner = cases.tuner_of(StubTuner, SOURCE)
    tuner.goals = []

    def best_draft(search):
        tuner.goals.append(search.goal)
        error = min(search.goal.error, 2e-3)
        subset = PrunedSubset(search.pruner, SOURCE, np.arange(len(SOURCE)), 0.0, 0.0, refit_refused=False)
        size = round(100 / error) if search.goal.size_bytes is None else search.goal.size_bytes
        return SimpleNamespace(size_bytes=size, subset=subset, options=error), error

    monkeypatch.setattr(tuning_run.TargetSearch, "best_draft", best_draft)
    return tuner


@pytest.mark.parametrize("excess", [0.0, 4e-4, -4e-4, 8e-4, 1.1e-3])
def test_what_a_tuning_adds_to_the_error_of_its_draft_is_allowed_for(stub_tuner, excess):
    stub_tuner.excess = excess
    if excess > 1e-3:
        with pytest.raises(InputError, match=r"30 dB cannot be reached: [\d,]+ bytes have 29\.\d\d dB"):
            stub_tuner.tune_to(csplat.Target(psnr=30.0))
        return
    assert 30.0 <= stub_tuner.tune_to(csplat.Target(psnr=30.0)).psnr <= 30.1
    assert len(stub_tuner.goals) <= 3


def test_a_tuned_file_that_is_too_large_is_tuned_from_a_smaller_draft(stub_tuner):
    stub_tuner.overrun = 1.1
    assert 8_500 <= stub_tuner.tune_to(csplat.Target(size=10_000)).size_bytes <= 10_000
    assert [10_000, 8_700] == [goal.size_bytes for goal in stub_tuner.goals]


@pytest.mark.slow
def test_the_command_resumes_and_scores_nothing_without_test_images(capture, tmp_path, monkeypatch):
    monkeypatch.setattr("csplat_trainer.training_options.Outputs.checkpoint_seconds", 0.0)
    change_options(monkeypatch, "csplat_tools.cli.shared_options.DataOptions", test_every=0)
    monkeypatch.setattr(tuning_run, "default_validation_count", lambda *_, **__: 2)
    run = tmp_path / "run.npz"
    facts = tuned_facts(capture, tmp_path / "a.csplat", "--iterations", 6, "--checkpoint", run)
    assert ({}, None) == (facts["scores"], facts["test_reference"])
    assert (True, 2) == (facts["validation"]["held_out"], facts["validation"]["views"])
    tuned_facts(capture, tmp_path / "b.csplat", "--iterations", 6, "--resume", run)
    assert (tmp_path / "a.csplat").read_bytes() == (tmp_path / "b.csplat").read_bytes()


@pytest.mark.slow
def test_a_refused_run_writes_and_replaces_nothing(capture, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "scene.ply", SOURCE)
    write_ply(tmp_path / "one.ply", SOURCE.select(slice(0, 1)))
    (tmp_path / "old.csplat").write_bytes(b"old")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for status, files, words, message in (
        (1, "scene.ply a.csplat", "--self --report r.json --source-index ./r.json", "is given for two outputs"),
        (1, "scene.ply a.csplat", "--self --report r --checkpoint r --force", "is given for two outputs"),
        (1, "scene.ply old.csplat", "--self", "--force replaces it"),
        (1, "scene.ply a.csplat", "--self --checkpoint scene.ply --force", "is the input"),
        (1, "scene.ply a.csplat", "--data . --resume absent.npz", "absent.npz: No such file"),
        (1, "one.ply a.csplat", f"--data {shlex.quote(str(capture))} --target-size 300B", "does not fit capture"),
        (2, "scene.ply a.csplat", "", "expected --data or --self"),
        (2, "scene.ply a.csplat", "--self --data x", "--data and --self: give one of them"),
        (2, "scene.ply a.csplat", "--data x --cameras y", "--cameras and --data: give one of them"),
        (2, "scene.ply a.csplat", "--self --keep 1.5", "the kept fraction is 1.5"),
        (2, "scene.ply a.csplat", "--self --background white", "--background requires --cameras or --data"),
        (2, "scene.ply a.csplat", "--self --lambda 0 --target-size 1MB", "--lambda and --target-size: give one of"),
        (2, "scene.ply a.csplat", "--self --keep 0.5 --target-size 1MB", "--target-size and --keep: give one of"),
        (2, "scene.ply a.csplat", "--self --lambda 2", "lambda is 2.0, expected 0 to 1"),
    ):
        result = invoke("finetune", *files.split(), *shlex.split(words), *BRIEF)
        assert status == result.exit_code, words
        assert message in " ".join(result.stderr.replace("│", " ").split())
        assert before == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
