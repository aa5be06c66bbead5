"""One scene, one data set, one score: every command that compares a scene with photographs agrees with `train`."""

import json

import pytest
from typer.testing import CliRunner

pytest.importorskip("numba", reason="training needs numba: pip install 'csplat[render]'")
pytest.importorskip("scipy", reason="data sets need scipy: pip install 'csplat[render]'")
pytest.importorskip("PIL.Image", reason="pictures need pillow: pip install 'csplat[render]'")

# Importing them needs what is looked for above.
from captures import as_colmap, photograph, photograph_object, shell

from csplat import read_ply
from csplat.training_record import TrainingRecord
from csplat_tools.cli.app import app

SIZE = (24, 20)


def call(*words):
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, (result.stderr, result.exception)
    return result.stdout


def photographs(kind, folder):
    folder.mkdir()
    if kind == "blender":
        return photograph_object(shell(3), folder)
    return as_colmap(photograph(shell(3), folder)) if kind == "colmap" else photograph(shell(3), folder)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "every", "held_out", "commands"),
    [
        ("blender", 5, 4, ("compare", "finetune", "simplify", "tradeoff", "encode")),
        ("transforms", 10, 2, ("compare", "finetune", "simplify", "tradeoff")),
        ("colmap", 5, 4, ("compare", "finetune", "simplify", "tradeoff")),
    ],
)
def test_every_command_reports_the_score_of_the_training(tmp_path, kind, every, held_out, commands):
    """None is called with background, split or size: the PLY names them. `encode` searches, which takes long."""
    data, ply, log = photographs(kind, tmp_path / "data"), tmp_path / "s.ply", tmp_path / "log.json"
    quick = ("--max-splats", 60, "--sh-degree", 0, "--iterations", 10, "--set", "init=box")
    size = "x".join(map(str, SIZE))
    call("train", data, "-o", ply, *quick, "--size", size, "--test-every", every, "--report", log, "-q")
    said = TrainingRecord.of(read_ply(ply).metadata)
    assert ((1.0, 1.0, 1.0) if kind == "blender" else (0.0, 0.0, 0.0), SIZE) == (said.background, said.size)
    trained = json.loads(log.read_text())["metrics"]
    found = {name: SCORES[name](ply, data, tmp_path) for name in commands}
    assert {held_out} == {trained["views"]} | {views for views, _ in found.values() if views is not None}
    scores = {"train": trained["psnr"], **{name: psnr for name, (_, psnr) in found.items()}}
    assert max(scores.values()) - min(scores.values()) < 0.01, scores


def compared(ply, data, _):
    scores = json.loads(call("compare", ply, ply, "--data", data, "--json"))["photographs"]["a"]
    return scores["views"], scores["psnr"]


def tuned(ply, data, folder):
    report = folder / "tuned.json"
    words = ("finetune", ply, "--data", data, "-o", folder / "t.csplat", "--iterations", 1, "--set", "sh-coding=none")
    call(*words, "--report", report, "-q")
    return None, json.loads(report.read_text())["scores"]["source"]["psnr"]


def simplified(ply, data, folder):
    report = folder / "simplified.json"
    words = ("simplify", ply, folder / "less.ply", "--data", data, "--keep", 0.9, "--set", "rounds=1,refit=no")
    call(*words, "--report", report, "-q")
    return None, json.loads(report.read_text())["photographs"]["source"]


def swept(ply, data, _):
    scores = json.loads(call("tradeoff", ply, "--data", data, "--what", "presets", "--json", "-q"))
    return scores["source"]["photographs"]["views"], scores["source"]["photographs"]["psnr"]


def targeted(ply, data, folder):
    words = ("encode", ply, folder / "e.csplat", "--data", data, "--max-psnr-drop", 3, "--no-prune", "--preset", "fast")
    report = json.loads(call(*words, "--json"))["target"]
    return report["views"], report["photographs"]["source"]


SCORES = {"compare": compared, "finetune": tuned, "simplify": simplified, "tradeoff": swept, "encode": targeted}
