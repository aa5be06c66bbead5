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

WORDS = ("--max-splats", 40, "--sh-degree", 1, "--iterations", 5, "--set", "log_every=2")


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


@pytest.fixture(scope="module")
def made(folder):
    """The folder of a file with its scene, page and report."""
    call("train", folder, "-o", folder / "a.ply", *WORDS, "--page", folder / "scene.html")
    words = ("--keep", 1, "--page", folder / "file.html", "--report", folder / "file.json")
    call("train", folder, "-o", folder / "a.csplat", *WORDS, *words)
    return folder


@pytest.mark.slow
def test_a_page_about_a_training_and_its_file(made):
    page, said = (made / "file.html").read_text(), json.loads((made / "file.json").read_text())
    assert [
        "How near it comes", "What it looks like", "The training", "The tuning", "Where the bytes are",
        "How it was made",
    ] == headings(page)  # fmt: skip
    for scores in said["file"]["scores"].values():
        assert f"<td>{scores['psnr_mean']:.2f}</td>" in page
    assert ["photograph", "source", "before tuning", "file"] * 3 == re.findall("<figcaption>(.*?)</figcaption>", page)
    assert 12 == page.count('src="data:image/')
    assert not re.search("(src|href)=.http", page)


@pytest.mark.slow
def test_a_page_about_a_training_alone(made):
    page = (made / "scene.html").read_text()
    assert ["How near it comes", "What it looks like", "The training", "How it was made"] == headings(page)
    assert ["photograph", "trained scene"] * 3 == re.findall("<figcaption>(.*?)</figcaption>", page)


@pytest.mark.slow
def test_the_scene_s_scores_in_a_report_of_a_file_are_those_of_compare(made, tmp_path):
    compared = tmp_path / "compared.json"
    call("compare", made / "a.ply", made / "a.csplat", "--data", made, "--report", compared)
    judged = json.loads(compared.read_text())["photographs"]
    for name, one in (("source", "a"), ("file", "b")):
        scores = json.loads((made / "file.json").read_text())["file"]["scores"][name]
        for score in ("psnr", "psnr_mean", "ssim"):
            assert scores[score] == pytest.approx(judged[one][score], abs=1e-3)


@pytest.mark.slow
def test_a_page_about_a_tuned_file(tmp_path, make_model):
    from csplat import write_ply

    write_ply(tmp_path / "a.ply", make_model(20, 1))
    path = tmp_path / "page.html"
    words = ("--self", "--views", 16, "--view-size", "40x30", "--iterations", 2, "--page", path)
    call("finetune", tmp_path / "a.ply", tmp_path / "a.csplat", *words)
    page = path.read_text()
    assert "by 8 renders of the source" in page.lower()
    assert "The tuning" in headings(page)
    assert "The training" not in headings(page)
    assert ["the source", "before tuning", "file"] * 3 == re.findall("<figcaption>(.*?)</figcaption>", page)[:9]


def test_a_page_is_not_replaced_without_being_told(folder, tmp_path):
    (tmp_path / "page.html").write_text("mine")
    words = ["train", str(folder), "-o", str(tmp_path / "a.ply"), "--page", str(tmp_path / "page.html")]
    result = CliRunner().invoke(app, words)
    assert (1, "mine") == (result.exit_code, (tmp_path / "page.html").read_text())
    assert "page.html exists" in result.stderr
