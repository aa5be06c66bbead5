"""The page about a training and its file: what it shows, and that it fetches nothing."""

import json
import re

import pytest

pytest.importorskip("numba", reason="training wants the extra [render]")
pytest.importorskip("scipy", reason="data sets want the extra [render]")
pytest.importorskip("matplotlib", reason="plots want the extra [render]")

from posed_sets import write_blender
from typer.testing import CliRunner

from csplat_tools.cli.app import app


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("set")
    write_blender(path)
    return path


def call(*words):
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, (result.stderr, result.exception)


def headings(page):
    return re.findall("<h2>(.*?)</h2>", page)


@pytest.mark.slow
def test_a_page_about_a_training_and_its_file(file_runs):
    page = file_runs.page.read_text()
    assert [
        "How near it comes", "What it looks like", "The training", "The tuning", "Where the bytes are",
        "How it was made",
    ] == headings(page)  # fmt: skip
    for scores in file_runs.report["file"]["scores"].values():
        assert f"<td>{scores['psnr_mean']:.2f}</td>" in page
    assert ["photograph", "source", "before tuning", "file"] * 2 == re.findall("<figcaption>(.*?)</figcaption>", page)
    assert 8 == page.count('src="data:image/')
    assert not re.search("(src|href)=.http", page)


@pytest.mark.slow
def test_a_training_alone_has_a_page_and_the_scores_of_its_scene_are_those_of_compare(file_runs, tmp_path):
    compared, path = tmp_path / "compared.json", tmp_path / "page.html"
    file_runs.made("a.ply", "--resume", file_runs.checkpoint, "--page", path)
    page = path.read_text()
    assert ["How near it comes", "What it looks like", "The training", "How it was made"] == headings(page)
    assert ["photograph", "trained scene"] * 2 == re.findall("<figcaption>(.*?)</figcaption>", page)
    both = (file_runs.folder / name for name in ("a.ply", "a.csplat"))
    call("compare", *both, "--data", file_runs.data, "--report", compared)
    judged = json.loads(compared.read_text())["photographs"]
    for name, one in (("source", "a"), ("file", "b")):
        scores = file_runs.report["file"]["scores"][name]
        for score in ("psnr", "psnr_mean", "ssim"):
            assert scores[score] == pytest.approx(judged[one][score], abs=1e-3)


def test_a_page_is_not_replaced_without_being_told(folder, tmp_path):
    (tmp_path / "page.html").write_text("mine")
    words = ["train", str(folder), "-o", str(tmp_path / "a.ply"), "--page", str(tmp_path / "page.html")]
    result = CliRunner().invoke(app, words)
    assert (1, "mine") == (result.exit_code, (tmp_path / "page.html").read_text())
    assert "page.html exists" in result.stderr
