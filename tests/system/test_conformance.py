# SPDX-License-Identifier: Apache-2.0
"""`csplat conformance`: reports for people, programs and CI.

Also: csplat_tools.cli.conformance.
"""

import json
import re
import shlex
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from command_line import hide_renderer
from typer.testing import CliRunner

import csplat
from csplat.encode_api import encode_with_report
from csplat_conformance.encoders import all_inputs
from csplat_tools.cli.app import app

INPUTS = {one.name: one for one in all_inputs()}
FILES = ("sound.csplat", "sound.npy")


def invoke(*words):
    return CliRunner().invoke(app, ["conformance", "encoder", *map(str, words)])


def copying(folder, name):
    """Return the command line of an encoder that copies our file of an input, and its source index."""
    (folder / "sound.ply").write_bytes(INPUTS[name].make())
    result = encode_with_report(csplat.read(folder / "sound.ply"))
    (folder / "sound.csplat").write_bytes(result.data)
    np.save(folder / "sound.npy", result.source_index)
    code = "import shutil, sys\n"
    code += "".join(f"shutil.copy({str(folder / one)!r}, sys.argv[{n}])\n" for n, one in enumerate(FILES, 2))
    # The standard library alone starts quickly.
    return f"{shlex.quote(sys.executable)} -I -S -c {shlex.quote(code)} {{ply}} {{out}} {{index}}"


@pytest.mark.slow
def test_reports_are_written_for_people_programs_and_ci(tmp_path):
    command = copying(tmp_path, "ordinary/one_splat")
    one = ("--cmd", command, "--filter", "*/one_splat", "--save", tmp_path / "kept", "--level")
    reports = ("--report", tmp_path / "r.json", "--junit", tmp_path / "r.xml")
    result = invoke(*one, 3, *reports)
    assert 0 == result.exit_code, result.output
    assert "all         3       3       0         0           0       0        0" in result.stdout
    report = json.loads((tmp_path / "r.json").read_text())
    assert ("encoder", True) == (report["suite"], report["passed"])
    assert ["L1", "L2", "L3"] == [one["level"] for one in report["outcomes"]]
    assert 0.0 == report["outcomes"][2]["details"]["means"]["declared_max"]
    root = ET.fromstring((tmp_path / "r.xml").read_text())  # noqa: S314 - our own file
    assert {"tests": "3", "failures": "0"}.items() <= root.attrib.items()
    kept = {path.relative_to(tmp_path / "kept").as_posix() for path in (tmp_path / "kept").rglob("*.*")}
    assert {f"ordinary-one_splat/{name}" for name in ("in.ply", "out.csplat", "out.npy")} == kept
    assert 1 == invoke(*one, 1).exit_code  # what was kept is not overwritten, nor is a report
    assert 1 == invoke(*one[:4], "--level", 1, "--report", tmp_path / "r.json").exit_code
    assert "testcase" in invoke(*one[:4], "--level", 1, "--junit", "-").stdout


@pytest.mark.slow
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
    (error,) = [line for line in result.stderr.splitlines() if not re.search("so far$", line)]  # besides progress
    assert (2 if "--level" in words else 1, True) == (result.exit_code, message in error)


@pytest.mark.slow
def test_without_a_renderer_pictures_are_skipped_with_a_note(tmp_path, monkeypatch):
    hide_renderer(monkeypatch)
    result = invoke("--cmd", copying(tmp_path, "ordinary/degree_1"), "--filter", "*/degree_1")
    assert 0 == result.exit_code
    assert "L4 SKIPPED: this installation of csplat has no compiled renderer" in result.stdout
