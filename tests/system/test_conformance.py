import contextlib
import io
import json
import shlex
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from conformance_runner_cases import FAULTY, FAULTY_CUTS, RECORDED, VECTOR_LIST
from typer.testing import CliRunner

import csplat
from csplat.encoder import encode_with_report
from csplat.errors import InputError
from csplat_conformance import adapter
from csplat_conformance.decoder_suite import parse_levels
from csplat_conformance.encoders import all_inputs
from csplat_conformance.manifest import VECTORS
from csplat_tools.cli.app import app
from encoder_faults.run import FAULTS

INPUTS = {one.name: one for one in all_inputs()}


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


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A folder with the answers of our decoder: files of a vector, with its status and output as JSON next to them."""
    folder = tmp_path_factory.mktemp("decoder")
    for vector in VECTOR_LIST:
        if vector.name in RECORDED:
            outdir = folder / "recorded" / vector.name.split("/")[1]
            outdir.mkdir(parents=True)
            words = io.StringIO()
            with contextlib.redirect_stdout(words):
                status = adapter.main([str(VECTORS / vector.file), str(outdir)])
            outdir.with_suffix(".json").write_text(json.dumps([status, words.getvalue()]))
    (folder / "decoder.py").write_text(FAULTY)
    cuts = {one.name.split("/")[1]: dict(one.expect["cuts"]) for one in VECTOR_LIST if "cuts" in one.expect}
    (folder / "cuts.json").write_text(json.dumps(cuts))
    (folder / "cuts.py").write_text(FAULTY_CUTS)
    return folder


@pytest.fixture(scope="module")
def faulty(recorded):
    """Return a function for the command line of our decoder with a fault."""
    return lambda fault: f"{sys.executable} -I -S {recorded / 'decoder.py'} '{fault}' {{input}} {{outdir}}"


@pytest.fixture(scope="module")
def faulty_cuts(recorded):
    """Return a function for the command line of a program for cuts with a fault."""
    return lambda fault: f"{sys.executable} -I -S {recorded / 'cuts.py'} '{fault}' {{input}} {{cuts}}"


def test_a_level_includes_the_lower_levels_and_a_list_names_its_own():
    texts = {"1": (1,), "3": (1, 2, 3), "1,3": (1, 3), "L4": (1, 2, 3, 4), "5": (1, 2, 3, 4, 5), "3,1": (1, 3)}
    assert texts == {text: parse_levels(text) for text in texts}
    for text in ("0", "6", "x", "1,9", ""):
        with pytest.raises(InputError):
            parse_levels(text)
    result = invoke_of_conformance_runner("--level", "9")
    assert (2, 1) == (result.exit_code, len(result.stderr.splitlines()))


def invoke_of_conformance_runner(*words):
    return CliRunner().invoke(app, ["conformance", "decoder", *map(str, words)])


@pytest.mark.slow
def test_the_command_writes_table_json_and_junit(faulty, tmp_path):
    reports = ("--report", tmp_path / "r.json", "--junit", tmp_path / "r.xml")
    result = invoke_of_conformance_runner("--cmd", faulty("rounding"), "--filter", "valid/quats", *reports)
    assert 1 == result.exit_code
    assert "L3  FAILED  valid/quats  floats.means differs" in result.stdout
    found = json.loads((tmp_path / "r.json").read_text())
    assert (False, 1) == (found["passed"], found["levels"]["L3"]["failed"])
    suites = ET.parse(tmp_path / "r.xml").getroot()  # noqa: S314 - ours
    assert ("3", "1") == (suites.get("tests"), suites.get("failures"))
    assert "exists" in invoke_of_conformance_runner("--filter", "valid/quats", *reports).stderr
    assert 0 == invoke_of_conformance_runner("--filter", "valid/quats", *reports, "--force").exit_code
    assert invoke_of_conformance_runner("--filter", "valid/quats", "--junit", "-").stdout.startswith("<?xml")
    assert 2 == invoke_of_conformance_runner("--filter", "valid/quats", "--json", "--junit", "-").exit_code


def chosen(*words):
    """Return the names of the vectors that the command runs, at level 1."""
    report = invoke_of_conformance_runner(*words, "--level", "1", "--json").stdout
    return {outcome["name"] for outcome in json.loads(report)["outcomes"]}


def test_a_filter_repeats_and_combines_patterns_of_names_and_of_clauses():
    valid = {vector.name for vector in VECTOR_LIST if "MOR-1" in vector.clauses and vector.name.startswith("valid/")}
    assert {"valid/one_splat", "valid/quats", "valid/rich"} == chosen(
        "--filter", "valid/quats,valid/one_*", "--filter", "valid/rich"
    )
    assert valid == chosen("--filter", "valid/*", "--filter", "MOR-1,LIM")
    assert "no vector is chosen" in invoke_of_conformance_runner("--filter", "valid/empty,MOR-*").stderr


def test_a_command_for_cuts_alone_is_tested_at_l5_alone(faulty_cuts):
    result = invoke_of_conformance_runner(
        "--cmd", faulty_cuts("one wrong"), "--filter", "valid/levels,valid/rich", "--json"
    )
    assert 1 == result.exit_code
    assert {"L5"} == {outcome["level"] for outcome in json.loads(result.stdout)["outcomes"]}
    assert 0 == invoke_of_conformance_runner("--filter", "valid/levels", "--level", "5").exit_code  # our own


def test_reports_for_one_place_are_refused_before_anything_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = f"touch {tmp_path / 'ran'}"
    result = invoke_of_conformance_runner(
        "--cmd", command + " {input} {outdir}", "--report", "same.json", "--junit", "same.json"
    )
    assert 1 == result.exit_code
    assert "is given for two outputs" in result.stderr
    assert [] == list(tmp_path.iterdir())
