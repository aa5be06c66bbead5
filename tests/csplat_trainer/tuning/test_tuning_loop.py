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
from captures import cameras, photograph, shell
from command_line import call, change_options, invoke
from finetune_cases import BLACK, BRIEF, COARSE, FEW, QUICK, psnr, tuned_subset, tuner_of, unchecked

import csplat
from csplat import EncodeOptions, decode, write_ply
from csplat.decoder import read_declared_bounds, read_options
from csplat.encoder import EncodePlan, fix_quantisation
from csplat.errors import InputError
from csplat_render.rasteriser import Rasteriser
from csplat_tools.optimise.pruning import PrunedSubset
from csplat_tools.optimise.simplify import SimplifyOptions
from csplat_tools.training import tuning_run
from csplat_tools.training.tuning_report import ply_splat_bytes
from csplat_trainer.training_options import Outputs
from csplat_trainer.tuning import FinetuneOptions, renders_of, split_views, tune
from csplat_trainer.tuning.tuning_loop import RateController

pytest.importorskip("numba", reason="requires the extra [render]")


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


@pytest.fixture(scope="module")
def fine():
    """A few splats, coded so finely that tuning gains nothing, and views of them."""
    few = shell(3).select(slice(0, 40))
    fixed = fix_quantisation(EncodePlan.of(few, EncodeOptions(preset="fast", attribute_psnr=90.0, sh_coding="scalar")))
    return fixed, split_views(renders_of(few, cameras(8), BLACK, None), BLACK, validation_count=3)


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


# the command
ENCODE_OPTIONS = "csplat_tools.cli.finetune.EncodeOptions"


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
def test_verify_names_undeclared_attributes_of_a_tuned_file(tuned_file):
    proof = call("verify", tuned_file.path, "--source", tuned_file.source.ply)
    assert "not proved: sh0, sh1: the file states no error of them, compare renders" in proof.stdout


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


@pytest.mark.slow
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
