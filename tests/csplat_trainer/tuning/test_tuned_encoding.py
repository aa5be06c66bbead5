# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_trainer.tuning.tuned_encoding."""

from dataclasses import replace

import numpy as np
import pytest
from captures import photograph
from command_line import change_options, invoke
from finetune_cases import BARE, BRIEF, COARSE, COMMAND_OPTIONS, QUICK, SOURCE, psnr, views_of_source

import csplat
import csplat_trainer
from csplat import Context, decode


@pytest.mark.slow
def test_finetune_takes_a_model_and_views_and_reports_every_step():
    steps, stages, views = [], [], views_of_source()
    tuned = csplat_trainer.finetune(
        SOURCE,
        views,
        COARSE,
        QUICK,
        on_step=steps.append,
        context=Context(progress=lambda *stage: stages.append(stage)),
    )
    assert len(tuned.data) < len(csplat.encode(SOURCE))
    assert psnr(tuned.decoded, views.validation) > psnr(decode(tuned.plain.data), views.validation)
    assert np.array_equal(decode(tuned.data).sh0, tuned.decoded.sh0)
    assert [2, *range(5, 31, 5)] == [step.iteration for step in steps]
    assert ("tuning", 1.0) == stages[-1]


@pytest.mark.slow
def test_finetune_takes_a_data_set_and_writes_no_file_that_decodes_differently(tmp_path, monkeypatch):
    model, data = csplat.read(photograph(SOURCE, tmp_path) / "scene.ply"), csplat_trainer.load(tmp_path)
    tuned = csplat_trainer.finetune(model, data, COARSE, replace(QUICK, iterations=2))
    assert (len(data.train), 2) == (tuned.log["train_views"], tuned.log["steps"])

    def wrong(data, **_):
        return replace(decode(data), sh0=decode(data).sh0 + np.float32(1e-6))

    monkeypatch.setattr("csplat_trainer.tuning.tuned_encoding.decode", wrong)
    change_options(monkeypatch, COMMAND_OPTIONS, **BARE)
    out = tmp_path / "s.csplat"
    result = invoke("finetune", tmp_path / "scene.ply", "--data", tmp_path, out, *BRIEF)
    assert "sh0 of the file differ from the tuned" in str(result.exception)
    assert not out.exists()
