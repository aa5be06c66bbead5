"""The benchmark of trainings and the files made of them: a whole run on a small data set."""

import json

import pytest

pytest.importorskip("numba", reason="training wants the extra [render]")
pytest.importorskip("scipy", reason="data sets want the extra [render]")
pytest.importorskip("matplotlib", reason="plots want the extra [render]")

from posed_sets import write_blender

from csplat.ply import read_ply
from csplat_bench.common.command import run
from csplat_bench.photographs.__main__ import main

CONFIG = """
title = "dots"
[trainings.few]
words = ["--max-splats", "40", "--sh-degree", "0", "--iterations", "30"]
[trainings.more]
after = "few"
words = ["--max-splats", "60", "--sh-degree", "0", "--iterations", "60"]
[files]
"trained" = { of = "more", words = ["--keep", "0.5"] }
"encoded" = { of = "more", by = "encode", words = ["--preset", "small"] }
"tuned" = { of = "few", by = "finetune", words = ["--data", "FOLDER", "--iterations", "20"] }
"""


def test_files_of_trainings_are_made_judged_and_drawn(tmp_path, capsys):
    data, config, work = tmp_path / "dots", tmp_path / "dots.toml", tmp_path / "work"
    write_blender(data)
    config.write_text(CONFIG)
    assert not run(main, [str(config), str(data), "--work", str(work)])
    known = json.loads((tmp_path / "dots.json").read_text())
    assert ["few", "more"] == list(known["trainings"])
    assert ["encoded", "trained", "tuned"] == sorted(known["files"])
    for name, one in known["files"].items():
        assert one["size_bytes"] == (work / f"dots-{name}.csplat").stat().st_size
        assert one["psnr_mean"] > 10
    assert len(read_ply(work / "dots-more.ply")) == known["trainings"]["more"]["splats"]
    assert known["files"]["trained"]["splats"] < known["files"]["encoded"]["splats"]
    assert known["trainings"]["more"]["command"].endswith("--resume dots-few.npz")
    assert str(tmp_path) not in json.dumps(known)
    assert "csplat" in (tmp_path / "dots.svg").read_text()
    capsys.readouterr()
    assert not run(main, [str(config), "--tables"])  # nothing is made again
    assert "trained, of more" in capsys.readouterr().out
