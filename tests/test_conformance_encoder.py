"""The encoder suite: our encoder at every preset, faulty encoders, refusals, inputs, and the command."""

import json
import shlex
import sys
import tempfile
import xml.etree.ElementTree as ET
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import plyfile
import pytest
from tables import failures
from typer.testing import CliRunner

import csplat
from csplat.encoder import PRESETS, encode_with_report
from csplat.errors import InputError
from csplat_conformance import encoders
from csplat_conformance.conformance_report import Status
from csplat_conformance.declared_bounds import Source
from csplat_conformance.encoders import EncoderSuiteOptions, all_inputs, run_encoder
from csplat_conformance.encoders.file_checks import check_stream, pair_splats
from csplat_conformance.protocol import ProcessEnd, run_program
from csplat_tools.cli.app import app
from csplat_tools.encode_file import encode_file
from encoder_faults.run import FAULTS, psnr

INPUTS = {one.name: one for one in all_inputs()}
ENCODABLE = {name: one for name, one in INPUTS.items() if one.source is not None}
PLACES = "{ply} {out} {index}"
INTEGRITY = ("L1", "L2", "L3")
HAS_RENDERER = find_spec("numba") is not None
DEGREE_5 = "nasty/degree_5"  # ours refuses it, and nothing else that can be encoded


def invoke(*words):
    return CliRunner().invoke(app, ["conformance", "encoder", *map(str, words)])


def program(code):
    """Return a command line that runs Python code on {ply} and {out}; the standard library alone starts quickly."""
    return f"{shlex.quote(sys.executable)} -I -S -c {shlex.quote(code)} {{ply}} {{out}}"


def copying(folder, name, change=lambda data: data):
    """Return the command line of an encoder that copies our file of an input, and its source index."""
    (folder / "sound.ply").write_bytes(INPUTS[name].make())
    result = encode_with_report(csplat.read_ply(folder / "sound.ply"))
    (folder / "sound.csplat").write_bytes(change(result.data))
    np.save(folder / "sound.npy", result.source_index)
    code = (
        f"import shutil, sys; shutil.copy({str(folder / 'sound.csplat')!r}, sys.argv[2]);"
        f"shutil.copy({str(folder / 'sound.npy')!r}, sys.argv[3])"
    )
    return f"{program(code)} {{index}}"


# Pairs and errors ----------------------------------------------------------------------------------
def test_pairs_are_found_however_the_file_is_ordered():
    source = ENCODABLE["ordinary/two_tiles"].source().means.astype(np.float64)
    order = np.random.default_rng(1).permutation(len(source))[:60_000]
    moved = source[order] + np.random.default_rng(2).uniform(-0.01, 0.01, (60_000, 3))
    found = pair_splats(source, moved, 0.06)
    np.testing.assert_array_equal(order, found.source_index)
    assert (0, 0, len(source) - 60_000) == (found.strays, found.surplus, found.missing)


@pytest.mark.parametrize(("source", "decoded", "counts"), [
    ([[0, 0, 0], [1, 0, 0], [5, 0, 0]], [[0.1, 0, 0], [0.9, 0, 0], [1.1, 0, 0], [3, 0, 0]], (1, 1, 1)),
    ([[0, 0, 0]] * 3, [[0, 0, 0]] * 4, (0, 1, 0)),
    ([[0, 0, 0]] * 3, [[0, 0, 0]], (0, 0, 2)),
    ([[0, 0, 0]], [[np.inf, 0, 0], [-1e300, 1e300, 0], [0, 0, 0]], (2, 0, 0)),
    ([], [[np.inf, 0, 0], [-1e300, 1e300, 0], [0, 0, 0]], (3, 0, 0)),
    ([[0, 0, 0]] * 5, [], (0, 0, 5)),
])  # fmt: skip
def test_strays_surplus_and_missing_splats_are_distinguished(source, decoded, counts):
    found = pair_splats(np.reshape(source, (-1, 3)).astype(float), np.reshape(decoded, (-1, 3)).astype(float), 1.0)
    assert counts == (found.strays, found.surplus, found.missing)


def test_duplicates_are_paired_each_with_its_own():
    assert [0, 1, 2] == sorted(pair_splats(np.zeros((3, 3)), np.full((3, 3), 0.01), 1.0).source_index)


# Ours ----------------------------------------------------------------------------------------------
@cache
def made_of(ply, preset):
    """Return the bytes of `csplat encode` for a PLY and of its source index, or the reason for a refusal."""
    with tempfile.TemporaryDirectory() as folder:
        source, out, index = (Path(folder) / name for name in ("in.ply", "out.csplat", "out.npy"))
        source.write_bytes(ply)
        try:
            encode_file(str(source), str(out), csplat.EncodeOptions(preset), source_index=str(index))
        except InputError as error:
            return f"error: {error}\n"
        return out.read_bytes(), index.read_bytes()


#: Bytes of a PLY that is encoded only once: the other inputs show whether a second run gives the same.
LARGE = 20_000


def encoder_here(preset="balanced"):
    """Our encoder in this process, by the function of its command; `tests/run.sh` starts the command."""

    def run(_command, places, _seconds):
        ply = Path(places["ply"]).read_bytes()
        made = (made_of if len(ply) > LARGE else made_of.__wrapped__)(ply, preset)
        if isinstance(made, str):
            return ProcessEnd(None, 1, b"", made.encode(), 0.0)
        for name, data in zip(("out", "index"), made, strict=True):
            Path(places[name]).write_bytes(data)
        return ProcessEnd(None, 0, b"", b"", 0.0)

    return run


#: Inputs whose SH, tiles, columns or ranges reach other code of the encoder with another preset.
PRESET_DEPENDENT = (
    "ordinary/degree_3", "ordinary/glossy", "ordinary/strong_colours", "ordinary/one_splat", "ordinary/extra_columns",
    "nasty/far_doubles", "nasty/huge_colours", "nasty/empty_degree_3", "nasty/duplicates",
)  # fmt: skip


@pytest.mark.slow
def test_our_encoder_passes_on_every_input():
    # CNF-5, CNF-6, SRC-3
    names = [name for name in INPUTS if name != "ordinary/surfaces"]  # another 3,644 splats like those of "glossy"
    report = run_encoder(PLACES, EncoderSuiteOptions(",".join(names), INTEGRITY, jobs=1), run=encoder_here())
    assert [] == report.failures
    assert len(report.outcomes) >= 150
    taken = [one for one in report.outcomes if one.name != DEGREE_5]
    assert all(one.status is Status.PASSED for one in taken)  # ours refuses nothing else that it can encode


@pytest.mark.slow
@pytest.mark.parametrize("preset", [preset for preset in PRESETS if preset != csplat.EncodeOptions().preset])
def test_our_encoder_passes_at_other_presets(preset):
    # CNF-5, CNF-6, SRC-3
    choice = EncoderSuiteOptions(",".join(PRESET_DEPENDENT), INTEGRITY, jobs=1)
    report = run_encoder(PLACES, choice, run=encoder_here(preset))
    assert [] == report.failures
    assert {*PRESET_DEPENDENT} == {one.name for one in report.outcomes if one.status is Status.PASSED}


@pytest.mark.slow
@pytest.mark.skipif(not HAS_RENDERER, reason="pictures require the extra [render]")
@pytest.mark.parametrize(("preset", "decibels"), [("fast", 34), ("balanced", 34), ("small", 31)])
def test_our_encoder_keeps_the_picture(preset, decibels):
    names = {"ordinary/degree_3"} | ({"ordinary/needles_and_discs"} if preset == "balanced" else set())
    choice = EncoderSuiteOptions(",".join(names), ("L4",), psnr_min=decibels, jobs=1)
    report = run_encoder(PLACES, choice, render_score=psnr, run=encoder_here(preset))
    assert [] == report.failures
    assert names == {one.name for one in report.outcomes}


# Refusals ------------------------------------------------------------------------------------------
def test_refusing_everything_passes_only_where_that_is_allowed():
    refuses = program("import sys; sys.exit('error: not today')")
    report = run_encoder(refuses, EncoderSuiteOptions("*/empty,broken/nothing"))
    assert report.passed
    assert {"nasty/empty", "broken/nothing"} == {one.name for one in report.outcomes}
    assert "refused: error: not today" in {one.message for one in report.outcomes}
    ordinary = run_encoder(refuses, EncoderSuiteOptions("ordinary/one_splat"))
    assert [Status.REFUSED] == [one.status for one in ordinary.failures]


def test_a_traceback_is_a_crash():
    report = run_encoder(program("raise ValueError('oh')"), EncoderSuiteOptions("nasty/empty"))
    assert [(Status.CRASHED, "a traceback; its last line: ValueError: oh")] == [
        (one.status, one.message) for one in report.failures
    ]


def test_broken_inputs_must_not_be_accepted():
    def take(_command, places, _seconds):
        Path(places["out"]).write_bytes(b"csplat?")
        return ProcessEnd(None, 0, b"", b"", 0.0)

    report = run_encoder(PLACES, EncoderSuiteOptions("broken/*"), run=take)
    assert {name for name in INPUTS if name.startswith("broken/")} == {one.name for one in report.failures}
    assert {"accepted an input without splats"} == {one.message for one in report.outcomes}


def test_a_remaining_child_process_is_ended():
    lingering = program("import subprocess, sys; subprocess.Popen(['sleep', '600']); sys.exit('no')")
    ended = run_program(lingering, {"ply": "a", "out": "b"}, 30.0)
    assert (None, 1) == (ended.status, ended.returncode)


def test_a_file_that_the_validator_passes_and_the_decoder_refuses_is_a_failure(monkeypatch):
    def refuse(_data):
        raise InputError("no")

    monkeypatch.setattr("csplat_conformance.encoders.file_checks.decode_scene", refuse)
    verdict, scene = check_stream(csplat.encode(ENCODABLE["ordinary/one_splat"].source().to_model((0.0, 0.0, 0.0))))
    assert (Status.FAILED, None) == (verdict.status, scene)
    assert "csplat's decoder refuses it" in verdict.message


# The command ---------------------------------------------------------------------------------------
@pytest.mark.slow
def test_reports_are_written_for_people_programs_and_ci(tmp_path):
    command = copying(tmp_path, "ordinary/one_splat")
    one = ("--cmd", command, "--filter", "*/one_splat", "--keep", tmp_path / "kept", "--level")
    reports = ("--report", tmp_path / "r.json", "--junit", tmp_path / "r.xml")
    result = invoke(*one, 3, *reports)
    assert 0 == result.exit_code, result.output
    assert "all         3       3       0         0           0       0        0" in result.stdout
    report = json.loads((tmp_path / "r.json").read_text())
    assert ("encoder", True) == (report["suite"], report["passed"])
    assert ["L1", "L2", "L3"] == [one["level"] for one in report["outcomes"]]
    assert 0.0 == report["outcomes"][2]["details"]["means"]["stated_max"]
    root = ET.fromstring((tmp_path / "r.xml").read_text())  # noqa: S314 - our own file
    assert {"tests": "3", "failures": "0"}.items() <= root.attrib.items()
    kept = {path.relative_to(tmp_path / "kept").as_posix() for path in (tmp_path / "kept").rglob("*.*")}
    assert {f"ordinary-one_splat/{name}" for name in ("in.ply", "out.csplat", "out.npy")} == kept
    assert 1 == invoke(*one, 1).exit_code  # what was kept is not overwritten, nor is a report
    assert 1 == invoke(*one[:4], "--level", 1, "--report", tmp_path / "r.json").exit_code


@pytest.mark.slow
def test_failures_are_shown_with_their_clause(tmp_path):
    command = copying(tmp_path, "ordinary/degree_1", FAULTS["max_scale_linear"].data)
    result = invoke("--cmd", command, "--filter", "ordinary/degree_1", "--level", "1", "--junit", "-")
    assert 1 == result.exit_code
    (case,) = ET.fromstring(result.stdout).iter("testcase")  # noqa: S314 - our own text
    assert "TIL-11 E_BOX" in case[0].attrib["message"]


@pytest.mark.parametrize(("words", "message"), [
    (("--filter", "nothing"), "no input matches 'nothing'"),
    (("--filter", "*/degree_0", "--filter", "nothing"), "no input matches 'nothing'"),
    (("--cmd", "true {ply}"), "lacks {out}"),
    (("--cmd", "true '{ply} {out}"), "cannot be used"),
    (("--cmd", "true {ply} {out} {what}"), "cannot be used"),
    (("--cmd", "/no/such/encoder {ply} {out}", "--filter", "broken/cut"), "No such file"),
    (("--level", "5"), "level is '5'"),
])  # fmt: skip
def test_wrong_arguments_are_reported_in_one_line(words, message):
    result = invoke(*words)
    assert (2 if "--level" in words else 1) == result.exit_code
    assert message in result.stderr
    assert 1 == len(result.stderr.strip().splitlines())


@pytest.mark.slow
def test_without_a_renderer_pictures_are_skipped_with_a_note(tmp_path, monkeypatch):
    def absent():
        raise InputError("this needs numba: pip install 'csplat[render]'")

    monkeypatch.setattr("csplat_tools.cli.conformance.require_renderer", absent)
    result = invoke("--cmd", copying(tmp_path, "ordinary/degree_1"), "--filter", "*/degree_1")
    assert 0 == result.exit_code
    assert "L4 SKIPPED: this needs numba" in result.stdout
    assert "L4  skipped  ordinary/degree_1  this needs numba" in result.stdout


# Inputs --------------------------------------------------------------------------------------------
def test_inputs_have_unique_names_a_reason_and_a_duty():
    assert len(all_inputs()) == len(INPUTS)
    for name, one in INPUTS.items():
        assert one.why
        assert {"ordinary": (0, 0), "nasty": (1, 0), "broken": (0, 1)}[name.split("/")[0]] == (
            one.may_refuse, one.must_refuse
        )  # fmt: skip


@pytest.mark.long
def test_an_input_equals_its_scene(tmp_path):
    # Written there by hand, read here by our reader: the two share no code.
    def check(one):
        path = written(tmp_path, one.name)
        found, wanted = Source.of(csplat.read_ply(path, keep_extra=True)), one.source()
        for array in ("means", "opacities", "sh0", "shN"):
            np.testing.assert_array_equal(getattr(found, array), getattr(wanted, array), array)
        np.testing.assert_array_equal(found.scales, np.where(np.isneginf(wanted.scales), -88, wanted.scales))
        np.testing.assert_allclose(found.quats, wanted.quats, atol=1e-7)
        assert {key: column.tobytes() for key, column in wanted.extra.items()} == {
            key: column.tobytes() for key, column in found.extra.items()
        }

    assert [] == failures([one for name, one in ENCODABLE.items() if name != DEGREE_5], check)


def test_our_encoder_refuses_degree_5(tmp_path):
    one = ENCODABLE[DEGREE_5]
    (tmp_path / "in.ply").write_bytes(one.make())
    rows = plyfile.PlyData.read(tmp_path / "in.ply")["vertex"].data
    source = one.source()
    assert (5, (64, 35, 3)) == (source.sh_degree, source.shN.shape)
    np.testing.assert_array_equal(rows["f_rest_71"], source.shN[:, 1, 2])  # blue comes after 70 of red and green
    with pytest.raises(InputError, match="SH degree 5, expected at most 4: --sh-degree 4"):
        csplat.read_ply(tmp_path / "in.ply")


@pytest.mark.parametrize(
    ("name", "left_out"),
    [("nasty/not_a_number", 3), ("nasty/infinities", 4), ("nasty/infinite_scales", 1), ("nasty/beyond_float", 2)],
)
def test_invalid_rows_are_not_in_the_source(name, left_out):
    # SRC-1
    assert 64 - left_out == len(ENCODABLE[name].source())
    assert {64} == {len(ENCODABLE[name].source()) for name in ("nasty/nan_normals", "nasty/nan_extra")}


@pytest.mark.long
def test_different_splats_keep_their_distance():
    def check(one):
        means = np.unique(one.source().means.astype(np.float64), axis=0)  # sorted by x
        least = one.separation * (1 - 1e-5)  # the lattice of float32
        for step in range(1, len(means)):
            away = means[step:] - means[:-step]
            if away[:, 0].min() >= least:
                break
            assert np.linalg.norm(away, axis=1).min() >= least

    assert [] == failures([one for name, one in ENCODABLE.items() if name != "ordinary/two_tiles"], check)


def test_broken_inputs_are_broken(tmp_path):
    def check(one):
        with pytest.raises(InputError):
            csplat.read_ply(written(tmp_path, one.name))

    assert [] == failures([one for one in INPUTS.values() if one.must_refuse], check)


def test_another_quality_moves_the_required_psnr_of_all_pictures():
    def required(name, quality):
        return INPUTS[f"ordinary/{name}"].psnr_required(quality)

    assert [30.0, 28.0, 32.0] == [required(name, 30.0) for name in ("degree_3", "needles_and_discs", "surfaces")]
    assert [25.0, 27.0] == [required(name, 25.0) for name in ("degree_3", "glossy")]


def test_figures_for_comparison_are_of_the_inputs_and_of_this_encoder(tmp_path):
    # Written by `python -m csplat_bench figures`
    figures = json.loads((files(encoders) / "figures.json").read_text("utf-8"))
    assert set(ENCODABLE) - {DEGREE_5} == set(figures)
    for name, by in figures.items():
        assert {"csplat"} <= set(by) <= {"csplat", "spz"}, name
        assert all((numbers["psnr"] is not None) == ENCODABLE[name].renders for numbers in by.values()), name
    for name in ("ordinary/degree_3", "nasty/far_doubles"):
        size = len(csplat.encode(csplat.read_ply(written(tmp_path, name))))
        assert size == pytest.approx(figures[name]["csplat"]["bytes"], rel=0.01)


def written(folder, name):
    path = folder / "in.ply"
    path.write_bytes(INPUTS[name].make())
    return path
