"""The benchmark of simple strategies: its arithmetic, and a whole run on a small data set."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba", reason="the study wants the extra [render]")
pytest.importorskip("scipy", reason="data sets want the extra [render]")
pytest.importorskip("matplotlib", reason="plots want the extra [render]")
pytest.importorskip("PIL.Image", reason="pictures want the extra [render]")

from captures import cameras, photograph, shell

from csplat_bench.common.captures import Capture
from csplat_bench.common.command import run as command
from csplat_bench.study import __main__ as study
from csplat_bench.study import scenes as study_scenes
from csplat_bench.study.judge import Views, renders_at
from csplat_bench.study.rows import Row, measure_row, measure_taus, rows_of_baseline
from csplat_bench.study.scenes import Subject, baselines, larger
from csplat_bench.study.tables import MIB, PUBLISHED
from csplat_render.metrics import psnr
from csplat_tools.study import Reduction

pytestmark = pytest.mark.area(name="benchmarks")

BLACK = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def subject():
    source = shell(3)
    source = replace(source, shN=3.0 * source.shN)
    views = renders_at(source, cameras(4), BLACK, None)
    return Subject("shell", source, Path("shell.ply"), {}, views, None, "4 views of the source itself")


def test_published_sizes_follow_from_the_rule_that_is_said():
    for name, floats in (("baseline", 23), ("SH 0", 14), ("SH 0, τ 0.005", 14), ("SH 0, τ 0.02", 14)):
        row = PUBLISHED[name]
        assert row.mib == pytest.approx(4 * floats * row.splats / MIB, abs=6e-5)
        assert row.ratio == pytest.approx(92_000 / (4 * floats * row.splats), abs=0.01)


def test_our_codebooks_are_as_large_as_the_published_row(make_model):
    source = make_model(1000, 1)
    row = next(row for row in rows_of_baseline() if row.name == "k-means")
    views = renders_at(source, cameras(1), BLACK, None)
    found = measure_row(Subject("", source, Path(), {}, views, None, ""), row)
    assert found["study_bytes"] / MIB == pytest.approx(PUBLISHED["k-means"].mib, abs=5e-5)


def test_every_published_row_is_repeated():
    names = [row.name for row in rows_of_baseline()]
    assert set(PUBLISHED) <= set(names)
    assert len(names) == len(set(names))


def test_figures_are_means_and_deviations_over_views(subject):
    pictures = [picture + np.float32(0.01 * (number + 1)) for number, picture in enumerate(subject.views.wanted)]
    found = Views(subject.views.cameras, pictures, BLACK).score(subject.source)
    each = [psnr(a, b) for a, b in zip(subject.views.wanted, pictures, strict=True)]
    assert found["psnr_mean"] == pytest.approx(np.mean(each), abs=1e-4)
    assert found["psnr_std"] == pytest.approx(np.std(each), abs=1e-4)
    assert found["ssim"] < 1.0
    assert found["lpips"] is None


def test_a_row_has_both_sizes_and_scores_of_scene_and_file(subject):
    raw = measure_row(subject, Row("pruned", Reduction(0.5, sh_degree=0)))
    file = measure_row(subject, Row("pruned", Reduction(0.5, sh_degree=0), "small", decoded=True))
    left = int(np.sum(subject.source.opacities > 0.5))
    assert (left, 56 * left) == (raw["splats"], raw["study_bytes"])
    assert raw["psnr_mean"] != raw["file_psnr_mean"]
    assert file["psnr_mean"] == file["file_psnr_mean"]
    assert file["csplat_bytes"] < raw["csplat_bytes"]


def test_more_is_pruned_at_higher_thresholds(subject):
    found = measure_taus(subject.source, subject.views)
    counts = [point["splats"] for point in found]
    assert counts == sorted(counts, reverse=True)
    assert [300, int(np.sum(subject.source.opacities > 0.5))] == [counts[0], counts[-1]]
    assert found[0]["psnr"] > found[-1]["psnr"]


def test_renders_of_another_size_show_the_same(subject):
    wide = larger(subject, 96, 2)
    assert (80, 96, 3) == wide.views.wanted[0].shape
    assert wide.views.wanted[0].mean() == pytest.approx(subject.views.wanted[0].mean(), rel=0.05)
    assert 99.0 == wide.views.score(wide.source, quick=True)["psnr"]


@pytest.fixture
def small(tmp_path, monkeypatch):
    """The baselines on a capture of sixteen small photographs."""
    (tmp_path / "capture").mkdir()
    folder = photograph(shell(3), tmp_path / "capture")

    def known(iterations, count):
        return {
            name: Capture(name, folder, None, training=one.training)
            for name, one in baselines(iterations, count).items()
        }

    monkeypatch.setattr(study, "baselines", known)
    monkeypatch.setattr(study, "RENDERED", {64: 2})
    monkeypatch.setattr(study_scenes, "RENDERED", {64: 2})
    monkeypatch.setattr(study_scenes.importlib.util, "find_spec", {}.get)  # torch is absent
    return tmp_path


def run(folder, *words):
    quick = ("--iterations", "30", "--splats", "80", "--lpips", "none", "--scenes", "")
    return command(study.main, [*words, *quick, "--out", str(folder / "out"), "--plots", str(folder / "plots")])


def test_everything_is_trained_measured_printed_and_drawn(small, capsys):
    assert 1 == run(small)  # rows that require torch are left out, with a message
    said = capsys.readouterr()
    assert "study1k-lpips: a loss with LPIPS needs torch" in said.err
    assert "80 (1,000)" in said.out  # ours, and theirs
    for name in (*PUBLISHED, "SH 0, τ 0.02, k-means residual", "study1k@64"):
        assert name in said.out
    known = json.loads((small / "out" / "study1k.json").read_text())
    assert 80 == known["facts"]["splats"]
    assert known["facts"]["training_seconds"] > 0.0
    assert 80 * 92 == known["rows"]["baseline"]["study_bytes"]
    assert {"float32", "balanced", "small", "small, SH 0, τ 0.02"} == set(known["attributes"]["all"])
    sizes = known["attributes"]["all"]["balanced"]
    assert known["rows"]["file, balanced"]["csplat_bytes"] == sum(sizes.values())
    assert ["attributes.svg", "pruning.svg", "sh.svg"] == sorted(path.name for path in (small / "plots").iterdir())
    before = {path.name: path.read_bytes() for path in (small / "plots").iterdir()}

    assert 0 == run(small, "baseline", "variants", "renders", "plots", "--markdown")  # nothing is done again
    again = capsys.readouterr()
    assert "rows" not in again.err
    assert "| SH 0 | 80 (1,000) |" in again.out
    assert before == {path.name: path.read_bytes() for path in (small / "plots").iterdir()}


def test_a_row_that_is_told_otherwise_is_measured_again(small, monkeypatch, capsys):
    monkeypatch.setattr(study, "rows_of_baseline", lambda: [Row("baseline"), Row("τ", Reduction(0.02))])
    assert 0 == run(small, "baseline")
    monkeypatch.setattr(study, "rows_of_baseline", lambda: [Row("baseline"), Row("τ", Reduction(0.3))])
    capsys.readouterr()
    assert 0 == run(small, "baseline")
    assert ["rows τ"] == [
        line.removeprefix("study1k ").partition(":")[0]
        for line in capsys.readouterr().err.splitlines()
        if " rows " in line
    ]


def test_wrong_words_are_refused(small, capsys):
    assert 2 == run(small, "bseline")
    assert "bseline cannot be measured" in capsys.readouterr().err
    assert 1 == command(study.main, ["scenes", "--scenes", "nowhere", "--lpips", "none", "--out", str(small / "out")])
    assert "no scene is called nowhere" in capsys.readouterr().err
