"""Extreme scenes on the command line: exit codes, one-line errors, no partial output, no warnings."""

import json
import re

import numpy as np
import pytest
from extremes import CONDITIONS, DRAWN, NAMES, write_columns, write_scene
from typer.testing import CliRunner

pytest.importorskip("numba", reason="rendering needs numba: pip install 'csplat[render]'")
pytest.importorskip("PIL.Image", reason="rendering needs pillow: pip install 'csplat[render]'")

from command_line import change_views

from csplat import read_ply
from csplat.errors import CsplatError
from csplat_tools.cli.app import app

pytestmark = [pytest.mark.extremes, pytest.mark.slow, pytest.mark.usefixtures("small_views")]

LONG = pytest.mark.area(name="extremes")
QUICK = ("half the rows NaN",)  # conditions that are tested outside the area, too


@pytest.fixture
def without_estimate(monkeypatch):
    """Skip the PSNR estimate after encoding."""
    monkeypatch.setattr("csplat_tools.cli.encode.estimate_psnr", lambda *_args, **_options: None)


def run(*words):
    """Run a command. Warnings of NumPy are errors, and exceptions other than ours are raised."""
    done = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert "Traceback" not in done.stderr
    assert "Warning" not in done.stderr
    return done


def refused(*words):
    """Run a command that fails with one line on standard error; return that line."""
    done = run(*words)
    assert 1 == done.exit_code
    errors = [line for line in done.stderr.splitlines() if not line.startswith(("note: ", "repair: "))]
    assert 1 == len(errors)
    assert errors[0].startswith("error: ")
    return errors[0]


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if name in QUICK else LONG) for name in DRAWN])
def test_the_whole_chain(name, tmp_path):
    ply, file, back = write_scene(tmp_path, name), tmp_path / "scene.csplat", tmp_path / "back.ply"
    condition = CONDITIONS[name]
    done = run("encode", ply, file, "--source-index", tmp_path / "index.npy")
    assert 0 == done.exit_code
    assert condition.repairs == tuple(re.findall(r"^repair: ([a-z-]+):", done.stderr, re.MULTILINE))
    assert ("huge values coarsen" in done.stderr) == (name == "exploded")

    done = run("verify", file, "--source", ply, "--source-index", tmp_path / "index.npy", "--json")
    assert 0 == done.exit_code
    assert json.loads(done.stdout)["proof"]["rms_and_counts_proved"]

    assert 0 == run("decode", file, back).exit_code
    assert len(condition.make()["means"]) - condition.dropped == len(read_ply(back, strict=True))

    done = run("info", file, "--json")
    assert (0, json.loads(done.stdout)["size_bytes"]) == (done.exit_code, file.stat().st_size)

    assert 0 == run("render", file, "--orbit", 2, "--size", "64x48", tmp_path / "pictures", "--depth").exit_code
    assert ["0000.depth.npy", "0000.png", "0001.depth.npy", "0001.png"] == names_in(tmp_path / "pictures")
    assert np.isfinite(np.load(tmp_path / "pictures" / "0000.depth.npy")).all()

    with pytest.MonkeyPatch.context() as patch:
        change_views(patch, 3, (40, 30))
        done = run("simplify", ply, tmp_path / "half.ply", "--keep", 0.5, "--effort", 1, "--json")
    assert 0 == done.exit_code
    assert json.loads(done.stdout)["splats"] == len(read_ply(tmp_path / "half.ply", strict=True))


@pytest.mark.parametrize("name", [name for name in NAMES if CONDITIONS[name].repairs])
def test_strict_reading_refuses_what_lint_reports(name, tmp_path):
    ply = write_scene(tmp_path, name)
    with pytest.raises(CsplatError, match=CONDITIONS[name].repairs[0]):
        read_ply(ply, strict=True)
    assert 1 == run("lint", ply).exit_code


@LONG
def test_a_million_identical_splats_are_encoded_but_not_rendered(tmp_path):
    ply, file = write_scene(tmp_path, "a million identical"), tmp_path / "scene.csplat"
    assert 0 == run("encode", ply, file, "--preset", "fast").exit_code
    assert file.stat().st_size < 6_000
    assert 0 == run("verify", file, "--source", ply).exit_code
    assert "MAX_INTERSECTIONS" in refused("render", file, "--orbit", 1, tmp_path / "pictures")
    assert ["scene.csplat", "scene.ply"] == names_in(tmp_path)
    assert 1 == run("decode", file, tmp_path / "back.ply", "--max-splats", 999_999).exit_code
    assert ["scene.csplat", "scene.ply"] == names_in(tmp_path)


@pytest.mark.usefixtures("without_estimate")
def test_a_splat_with_huge_and_small_scales_has_declared_bounds(tmp_path):
    """A lattice that contains a log scale of -3e38 rounds one of -1000 to 0."""
    columns = CONDITIONS["exploded"].make()
    columns["scales"][50] = [-3e38, -1000.0, -1000.0]
    ply = write_columns(tmp_path / "scene.ply", columns)
    file = tmp_path / "scene.csplat"
    done = run("encode", ply, file)
    assert 0 == done.exit_code
    assert "huge values coarsen" in done.stderr
    assert 0 == run("verify", file, "--source", ply).exit_code


@pytest.mark.usefixtures("without_estimate")
def test_a_scene_without_splats_gives_an_empty_file_and_one_of_nan_is_refused(tmp_path):
    columns = CONDITIONS["needles"].make()
    ply, file = tmp_path / "scene.ply", tmp_path / "scene.csplat"
    write_columns(ply, {name: array[:0] for name, array in columns.items()})
    assert 0 == run("encode", ply, file).exit_code
    assert 0 == run("verify", file, "--source", ply).exit_code
    assert "without splats cannot be simplified" in refused("simplify", ply, tmp_path / "half.ply", "--keep", 0.5)
    assert 0 == run("render", file, "--orbit", 1, "--size", "32x24", tmp_path / "pictures").exit_code
    columns["means"][:] = np.nan
    write_columns(ply, columns)
    assert "300 splats with NaN or infinity: none is left" in refused("encode", ply, tmp_path / "none.csplat")
    assert ["pictures", "scene.csplat", "scene.ply"] == names_in(tmp_path)


def test_quiet_encoding_prints_only_repairs(tmp_path):
    ply = write_scene(tmp_path, "half the rows NaN")
    done = run("encode", ply, tmp_path / "scene.csplat", "-q")
    assert (0, "") == (done.exit_code, done.stdout)
    assert "repair: nonfinite-rows: 150 splats with NaN or infinity: dropped" == done.stderr.strip()
