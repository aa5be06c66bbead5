"""Tests of csplat_tools.training.tuning_run."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from captures import cameras, photograph, shell
from command_line import call, change_options, invoke
from finetune_cases import BLACK, BRIEF, tuned_subset, tuner_of

from csplat import write_ply
from csplat_render.camera_files import save_cameras
from csplat_tools.training import tuning_run
from csplat_trainer.tuning import renders_of, split_views

pytest.importorskip("numba", reason="requires the extra [render]")


@pytest.fixture(scope="module")
def source():
    return shell(8)


@pytest.fixture(scope="module")
def views(source):
    return split_views(renders_of(source, cameras(14), BLACK, None), BLACK, validation_count=3)


# the command
ENCODE_OPTIONS = "csplat_tools.cli.finetune.EncodeOptions"


@pytest.fixture(autouse=True)
def bare(monkeypatch):
    """Make the command encode neither SH nor codebooks, which take time."""
    change_options(monkeypatch, ENCODE_OPTIONS, sh_coding="none", shape_codebook_size=0)


@pytest.fixture(scope="module")
def capture(source, tmp_path_factory):
    return photograph(source, tmp_path_factory.mktemp("capture"))


@pytest.mark.slow
def test_renders_for_tuning_may_use_a_camera_file(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(tuning_run, "run_finetuning", partial(tuning_run.run_finetuning, prune_unseen=True))
    save_cameras(tmp_path / "cameras.json", cameras(40))
    words = ("finetune", capture / "scene.ply", "--self", "--cameras", tmp_path / "cameras.json")
    facts = json.loads(call(*words, tmp_path / "s.csplat", *BRIEF, "--json", "-q").stdout)
    assert (301, 300, 4) == (facts["source_splats"], facts["splats"], facts["validation"]["views"])


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


@pytest.mark.slow
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


def test_cameras_without_splats_in_view_are_refused(source, tmp_path, monkeypatch):
    away = [replace(camera, viewmat=np.diag([-1.0, 1.0, -1.0, 1.0]) @ camera.viewmat) for camera in cameras(40)]
    save_cameras(tmp_path / "away.json", away)
    write_ply(tmp_path / "scene.ply", source)
    monkeypatch.setattr(tuning_run, "run_finetuning", partial(tuning_run.run_finetuning, prune_unseen=True))
    words = ("finetune", tmp_path / "scene.ply", tmp_path / "s.csplat", "--self")
    result = invoke(*words, "--cameras", tmp_path / "away.json")
    assert 1 == result.exit_code
    assert "no view shows any splat" in result.stderr
