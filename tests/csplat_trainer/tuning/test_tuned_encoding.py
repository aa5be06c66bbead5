"""Tests of csplat_trainer.tuning.tuned_encoding."""

from dataclasses import replace

import numpy as np
import pytest
from captures import cameras, photograph, shell
from command_line import change_options, invoke
from finetune_cases import BLACK, BRIEF, COARSE, QUICK, psnr

import csplat
import csplat_trainer
from csplat import decode
from csplat_trainer.tuning import renders_of, split_views

pytest.importorskip("numba", reason="requires the extra [render]")


@pytest.fixture(scope="module")
def source():
    return shell(8)


@pytest.fixture(scope="module")
def views(source):
    return split_views(renders_of(source, cameras(14), BLACK, None), BLACK, validation_count=3)


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
def test_a_file_that_decodes_differently_is_not_written(capture, tmp_path, monkeypatch):
    def wrong(data):
        model = decode(data)
        return replace(model, sh0=model.sh0 + np.float32(1e-6))

    monkeypatch.setattr("csplat_trainer.tuning.tuned_encoding.decode", wrong)
    out = tmp_path / "s.csplat"
    result = invoke("finetune", capture / "scene.ply", "--data", capture, out, *BRIEF)
    assert "sh0 of the file differ from the tuned" in str(result.exception)
    assert not out.exists()
