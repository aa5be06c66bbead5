"""The benchmark of trainings and the files made of them: a whole run on a small data set."""

import json
import shutil

import pytest

pytest.importorskip("numba", reason="training wants the extra [render]")
pytest.importorskip("scipy", reason="data sets want the extra [render]")
pytest.importorskip("matplotlib", reason="plots want the extra [render]")

from posed_sets import write_blender
from typer.testing import CliRunner

from csplat.ply import read_ply
from csplat_bench.common.command import run
from csplat_bench.photographs.__main__ import main
from csplat_tools.cli.app import app

pytestmark = pytest.mark.area(name="benchmarks")

CONFIG = """
title = "dots"
size = "24x16"
[trainings.few]
words = ["--max-splats", "40", "--sh-degree", "0", "--iterations", "30"]
[trainings.more]
after = "few"
words = ["--max-splats", "60", "--sh-degree", "0", "--iterations", "60"]
[files]
"trained" = { of = "more", words = ["--keep", "0.5"] }
"encoded" = { of = "more", by = "encode", words = ["--preset", "small"] }
"tuned" = { of = "few", by = "finetune", words = ["--data", "FOLDER", "--iterations", "20"] }
[files.free]
of = "few"
by = "finetune"
without = "a price"
words = ["--data", "FOLDER", "--iterations", "20", "--lambda", "0"]
"""


def test_files_of_trainings_are_made_judged_and_drawn(tmp_path, capsys):
    data, config, work = tmp_path / "dots", tmp_path / "lego800.toml", tmp_path / "work"
    write_blender(data)
    config.write_text(CONFIG)
    assert not run(main, [str(config), str(data), "--work", str(work)])
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("trained: few", "trained, of more", "HAC++", "RDO-Gaussian"))
    known = json.loads((tmp_path / "lego800.json").read_text())
    assert ["few", "more"] == sorted(known["trainings"])
    assert ["encoded", "free", "trained", "tuned"] == sorted(known["files"])
    for name, one in known["files"].items():
        path = work / f"lego800-{name}.csplat"
        assert one["size_bytes"] == path.stat().st_size
        words = ["compare", str(work / f"lego800-{one['training']}.ply"), str(path), "--data", str(data), "--json"]
        compared = json.loads(CliRunner().invoke(app, words).stdout)["photographs"]  # at the training's size
        assert one["psnr_mean"] == pytest.approx(compared["b"]["psnr_mean"], abs=1e-6)
        assert known["trainings"][one["training"]]["psnr"] == pytest.approx(compared["a"]["psnr"], abs=1e-6)
    assert len(read_ply(work / "lego800-more.ply")) == known["trainings"]["more"]["splats"]
    assert known["files"]["trained"]["splats"] < known["files"]["encoded"]["splats"]
    assert known["trainings"]["more"]["command"].endswith("--resume lego800-few.npz")
    assert str(tmp_path) not in json.dumps(known)
    drawn = (tmp_path / "lego800.svg").read_text()
    assert "csplat train" in drawn
    assert "csplat finetune, without a price" in drawn
    shutil.rmtree(work)  # known results are not made again
    assert not run(main, [str(config), str(data), "--work", str(work), "--files", "tuned"])
    assert printed == capsys.readouterr().out
