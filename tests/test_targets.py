"""Targets on the command line: what it accepts, what it refuses, its messages; largest errors."""

import json
from dataclasses import replace

import numpy as np
import pytest
from checked import measure_errors
from command_line import call, change_views, invoke

from csplat import EncodeOptions, decode, write_ply
from csplat.encoder import encode_with_report
from csplat.errors import InputError
from csplat_tools.console import parse_size_bytes
from csplat_tools.optimise.target_encoding import encode_to, meet_bounds
from csplat_tools.optimise.targets import Target, parse_max_error

pytest.importorskip("numba", reason="targets of size and PSNR require the extra [render]")

from captures import cameras, photograph, shell

from csplat_render.camera import intrinsics, look_at
from csplat_render.camera_files import save_cameras
from csplat_tools.cli.command_output import Output

pytestmark = pytest.mark.usefixtures("small_views")


@pytest.fixture(scope="module")
def scene():
    return shell(8)


# Options.
def test_sizes_are_parsed():
    sizes = {"5MB": 5_000_000, "1.5 MiB": 1_572_864, "300kB": 300_000, "300KiB": 307_200, "123456": 123_456}
    assert sizes == {text: parse_size_bytes(text) for text in sizes}


@pytest.mark.parametrize("text", ["", "MB", "5 apples", "-3MB", "0", "1e30GB", "5 M B"])
def test_invalid_sizes_are_refused(text):
    with pytest.raises(InputError, match="a size is"):
        parse_size_bytes(text)


def test_bounds_are_parsed():
    assert {"means": 0.001, "opacities": 0.01} == parse_max_error("means=0.001,opacities=1e-2", None)


def test_a_length_with_a_unit_requires_a_scene_with_a_unit():
    with pytest.raises(InputError, match="--unit-metres"):
        parse_max_error("means=1mm", None)
    assert {"means": 0.002} == parse_max_error("means=1mm", 0.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("means", "is not an error bound"),
        ("means=", "is not an error bound"),
        ("weight=1", "not a measure"),
        ("means=0", "above 0"),
        ("means=1,means=2", "twice"),
        ("sh0=1mm", "not a length"),
        ("means=1parsec", "expected one of"),
    ],
)
def test_invalid_bounds_are_refused(text, message):
    with pytest.raises(InputError, match=message):
        parse_max_error(text, 1.0)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({}, "no target"),
        ({"size_bytes": 1000, "psnr": 40.0}, "one of them"),
        ({"keep": 0.5, "max_psnr_drop": 1.0}, "one of them"),
        ({"keep": 0.5, "max_error": {"means": 1.0}}, "no bounds"),
        ({"max_psnr_drop": 0.5, "max_error": {"means": 1.0}}, "no bounds"),
        ({"size_bytes": 0}, "expected at least 1"),
        ({"psnr": 99.5}, "at most 99"),
        ({"psnr": float("nan")}, "above 0"),
        ({"max_psnr_drop": 0.0}, "0.001 to 60"),
        ({"max_psnr_drop": 1e-16}, "0.001 to 60"),
        ({"max_psnr_drop": 4000.0}, "0.001 to 60"),
        ({"keep": 1.5}, "at most 1"),
        ({"keep": 0.0}, "above 0"),
        ({"psnr": -1.0}, "above 0"),
        ({"keep": 0.5, "psnr": 40.0}, "one of them"),
    ],
)
def test_invalid_targets_are_refused(asked, message):
    with pytest.raises(InputError, match=message):
        Target(**asked)


# Largest errors.
@pytest.mark.parametrize(
    "bounds", [{"means": 1e-4}, {"opacities": 0.004, "covariance": 0.02}, {"sh0": 0.01}, {"sh1": 0.02, "sh2": 0.05}]
)
def test_bounds_hold_for_every_splat(scene, bounds):
    found = encode_to(scene, errors=bounds)
    proof = measure_errors(scene, decode(found.result.data), found.result.source_index)
    for name, bound in bounds.items():
        assert 0.3 * bound < proof[name][0] <= bound
        assert found.report.reached[name] == found.result.report.errors[name][0] <= bound
    assert (300, 0) == (found.report.splats, found.report.renders)


@pytest.mark.slow
def test_a_bound_of_the_means_holds_for_outliers(scene):
    away = (scene.means[:20] * 3000.0).astype(np.float32)
    far = replace(scene, means=np.concatenate([away, scene.means[20:]]))
    coarse = encode_with_report(far, EncodeOptions(position_step=1e-4)).report.errors["means"][0]
    bounded = meet_bounds(far, EncodeOptions(), {"means": 1e-4}).result
    assert bounded.report.errors["means"][0] <= 1e-4 < coarse
    assert any("tiles" in note for note in meet_bounds(far, EncodeOptions(), {"means": 1e-6}).result.report.notes)


def test_an_impossible_bound_is_refused(scene):
    with pytest.raises(InputError, match="no lattice keeps the error of opacities within 1e-09"):
        meet_bounds(scene, EncodeOptions(), {"opacities": 1e-9})


def test_an_option_that_contradicts_a_bound_is_refused(scene):
    with pytest.raises(InputError, match="position_step is determined"):
        meet_bounds(scene, EncodeOptions(position_step=0.1), {"means": 0.1})
    for fixed in (EncodeOptions(sh_coding="none"), EncodeOptions(adaptive=0.5)):
        with pytest.raises(InputError, match="error"):
            meet_bounds(scene, fixed, {"sh1": 0.1})
    with pytest.raises(InputError, match="codebook excludes a bound"):
        meet_bounds(scene, EncodeOptions(sh_coding="codebook"), {"sh1": 0.1})


# The command.
@pytest.fixture
def ply(tmp_path, scene):
    write_ply(tmp_path / "scene.ply", scene)
    return tmp_path / "scene.ply"


@pytest.mark.slow
def test_the_command_meets_a_size_with_reasons(tmp_path, ply, monkeypatch):
    out = tmp_path / "scene.csplat"
    change_views(monkeypatch, 16, (48, 36))
    done = call("encode", ply, out, "--target-size", "5kB", "--no-prune")
    assert 4850 <= out.stat().st_size <= 5000
    for text in ("target: 5.0 kB", "chosen: SH degree", "measured on the file itself"):
        assert text in done.stderr


@pytest.mark.slow
def test_the_command_reports_a_share_as_json_and_its_file_is_verified(tmp_path, ply):
    out, index = tmp_path / "scene.csplat", tmp_path / "index.npy"
    save_cameras(tmp_path / "cameras.json", cameras(40))
    words = ("encode", ply, out, "--keep", "0.5", "--effort", "1", "--cameras", tmp_path / "cameras.json")
    report = json.loads(call(*words, "--source-index", index, "--json").stdout)
    assert (150, {"keep": 0.5}) == (report["splats"], report["target"]["goal"])
    assert report["target"]["size_bytes"] == report["size_bytes"] == out.stat().st_size
    assert report["target"]["splats"] == report["splats"]
    call("verify", out, "--source", ply, "--source-index", index)
    call("verify", out, "--source", ply)
    assert "150 pruned" in call("info", out).stdout


@pytest.mark.slow
def test_the_command_meets_largest_errors(tmp_path, ply):
    out, index = tmp_path / "scene.csplat", tmp_path / "index.npy"
    arguments = ["encode", ply, out, "--max-error", "means=2mm,sh0=0.01", "--unit-metres", "0.5", "--json", "-q"]
    report = json.loads(call(*arguments, "--source-index", index).stdout)
    assert report["stated_errors"]["means"]["max"] <= 0.004
    assert report["stated_errors"]["sh0"]["max"] <= 0.01
    call("verify", out, "--source", ply, "--source-index", index)


@pytest.mark.slow
def test_the_command_meets_a_psnr_drop(tmp_path):
    folder = photograph(shell(0), tmp_path)  # without SH there is only one coding
    words = ("encode", folder / "scene.ply", tmp_path / "s.csplat", "--max-psnr-drop", "1dB", "--data", folder)
    target = json.loads(call(*words, "--no-prune", "--json").stdout)["target"]
    scores = target["photographs"]
    # The validation images decide. At 62 dB, the limit of 8 bits, the two test images differ by more than the drop.
    assert scores["source"] - 1.0 - target["spread"] <= scores["file"] < scores["source"]


def test_only_long_work_is_announced(capsys):
    messages = {}
    for name, quiet, seconds in (("long", False, 170.0), ("short", False, 5.0), ("quiet", True, 170.0)):
        Output(quiet=quiet).announce_time(lambda seconds=seconds: seconds, "a preset takes seconds")
        messages[name] = capsys.readouterr().err
    assert "this takes about 2 to 5 minutes here; a preset takes seconds" in messages.pop("long")
    assert {"short": "", "quiet": ""} == messages


def test_the_command_announces_the_time_of_a_search(tmp_path, ply, monkeypatch):
    # The search itself fails: the test view shows nothing.
    monkeypatch.setattr("csplat_tools.optimise.target_search.render_seconds", lambda *_, **__: 170.0 / 520.0)
    K = intrinsics(48, 40, 60.0)
    save_cameras(tmp_path / "away.json", [look_at((40.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0, 0, 1), K, 48, 40)])
    words = ("encode", ply, tmp_path / "s.csplat", "--target-psnr", "30", "--cameras", tmp_path / "away.json")
    change_views(monkeypatch, 8, None)
    done = invoke(*words, "--no-prune")
    assert "this takes about 2 to 5 minutes here" in done.stderr
    assert "cameras belong to the scene" in done.stderr


REFUSED = [
    (["--target-size", "5kB", "--target-psnr", "30"], 2, "one of them"),
    (["--keep", "0.5", "--target-psnr", "30"], 2, "one of them"),
    (["--target-size", "many"], 2, "a size is"),
    (["--target-psnr", "120"], 2, "at most 99"),
    (["--keep", "2"], 2, "at most 1"),
    (["--max-error", "means=1mm"], 1, "--unit-metres"),
    (["--keep", "0.5", "--max-error", "means=1"], 2, "no bounds"),
    (["--target-size", "5kB", "--attribute-psnr", "40"], 2, "--attribute-psnr and --target-size: give one of them"),
    (["--effort", "2"], 2, "--effort requires --target-psnr or"),
    (["--effort", "12", "--target-size", "5kB"], 2, "--effort is 12, expected 1 to 9"),
    (["--no-prune"], 2, "--no-prune requires --target-psnr or"),
    (["--keep", "0.5", "--no-prune"], 2, "--keep and --no-prune: give one of them"),
    (["--keep", "0.5", "--importance", "w.npy"], 2, "--keep and --importance: give one of them"),
    (["--max-psnr-drop", "1"], 2, "--max-psnr-drop requires --data"),
    (["--max-psnr-drop", "1", "--cameras", "c.json"], 2, "--max-psnr-drop requires --data"),
    (["--background", "white"], 2, "--background requires --cameras or --data"),
    (["--background", "white", "--max-error", "means=1"], 2, "--background requires --cameras or --data"),
    (["--cameras", "c.json"], 2, "--cameras requires --target-psnr or"),
    (["--max-error", "means=1", "--data", "d"], 2, "--data requires --target-psnr or"),
    (["--target-size", "10", "--no-prune"], 2, "no file"),
    (["--target-psnr", "30", "--target-size", "5kB"], 2, "--target-psnr and --target-size: give one of them"),
    (["--kmeans", "16"], 2, "No such option"),
    (["--prune"], 2, "No such option"),
]


@pytest.mark.slow
def test_the_command_refuses_options_without_effect(tmp_path, ply):
    out, wrong = tmp_path / "scene.csplat", {}
    for words, status, message in REFUSED:
        done = invoke("encode", ply, out, *words)
        text = " ".join(done.stderr.replace("│", " ").split())
        if (status, False) != (done.exit_code, out.exists()) or message not in text:
            wrong[" ".join(words)] = (done.exit_code, text)
    assert {} == wrong
