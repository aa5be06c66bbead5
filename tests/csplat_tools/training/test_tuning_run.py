# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_tools.training.tuning_run.

Also: csplat_trainer.device_measurements.
"""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from captures import cameras, photograph, shell
from command_line import call, change_options
from finetune_cases import BRIEF, tuned_subset, tuner_of

from csplat import write_ply
from csplat_render.camera_files import save_cameras
from csplat_tools.training import tuning_run


@pytest.fixture(scope="module")
def source():
    return shell(8)


@pytest.fixture(autouse=True)
def bare(monkeypatch):
    """Make the command encode neither SH nor codebooks, which take time."""
    change_options(monkeypatch, "csplat_tools.cli.finetune.EncodeOptions", sh_coding="none", shape_codebook_size=0)


@pytest.fixture(scope="module")
def capture(source, tmp_path_factory):
    return photograph(source, tmp_path_factory.mktemp("capture"))


def change_run(patch, **options):
    """Let the command tune with other options, which the command line does not have."""
    patch.setattr(tuning_run, "run_finetuning", partial(tuning_run.run_finetuning, **options))


@pytest.mark.slow
def test_renders_for_tuning_may_use_a_camera_file(source, capture, tmp_path, monkeypatch):
    change_run(monkeypatch, prune_unseen=True)
    save_cameras(tmp_path / "cameras.json", cameras(40))
    away = [replace(camera, viewmat=np.diag([-1.0, 1.0, -1.0, 1.0]) @ camera.viewmat) for camera in cameras(40)]
    save_cameras(tmp_path / "away.json", away)
    write_ply(tmp_path / "seen.ply", source)
    words = (tmp_path / "s.csplat", "--self", *BRIEF, "--json", "-q", "--cameras")
    facts = json.loads(call("finetune", capture / "scene.ply", *words, tmp_path / "cameras.json").stdout)
    assert (301, 300, 4) == (facts["source_splats"], facts["splats"], facts["validation"]["views"])
    refused = call("finetune", tmp_path / "seen.ply", *words, tmp_path / "away.json", "--force", status=1)
    assert "no view shows any splat" in refused.stderr


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
def test_importance_is_per_source_splat_and_measured_as_by_the_command_sensitivity(capture, tmp_path, monkeypatch):
    call("sensitivity", capture / "scene.ply", tmp_path / "s.npz", "--data", capture)
    words = ("finetune", capture / "scene.ply", "--data", capture, *BRIEF, "--lambda", 0)
    call(*words, tmp_path / "b.csplat")
    change_run(monkeypatch, importance=str(tmp_path / "s.npz"))
    call(*words, tmp_path / "a.csplat")
    assert (tmp_path / "a.csplat").read_bytes() == (tmp_path / "b.csplat").read_bytes()
    change_run(monkeypatch, importance=str(tmp_path / "w.npy"))
    np.save(tmp_path / "w.npy", np.ones(300))
    assert "expected (301,)" in call(*words, tmp_path / "s.csplat", status=1).stderr
    np.save(tmp_path / "w.npy", np.arange(301.0))
    call(*words, tmp_path / "s.csplat")
