"""The encoder suite's runs of a program and its verdicts on the file, and their form in reports."""

import json
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from encoder_runs_cases import COMMAND, FILES, INPUTS, MAPS, PLAIN, first, outcome_of, running
from typer.testing import CliRunner

import csplat
from csplat.decoder import decode_scene
from csplat_conformance.conformance_report import Status
from csplat_conformance.encoders import EncoderSuiteOptions, run_encoder, write_inputs
from csplat_conformance.encoders.file_checks import check_content
from csplat_conformance.protocol import ProcessEnd, run_program
from csplat_tools.cli.app import app


def invoke(*words):
    return CliRunner().invoke(app, ["conformance", "encoder", *map(str, words)])


def program(code):
    """Return a command line that runs Python code on {ply} and {out}."""
    return f"{shlex.quote(sys.executable)} -c {shlex.quote(code)} {{ply}} {{out}}"


@pytest.mark.parametrize("name", ["nasty/empty", "broken/cut"])
def test_a_refusal_leaves_nothing(encoded, name):
    def refuse(at):
        at.out.unlink()
        (at.out.parent / "x.tmp").touch()
        return 1

    message = "refused, but left out.npy next to the output; refused, but left x.tmp next to the output"
    assert (Status.FAILED, (), message) == outcome_of(encoded, refuse, EncoderSuiteOptions(name, ("L1",)))


@pytest.mark.slow
def test_the_working_directory_stays_empty():
    writes = program("import sys; open('core', 'w'); open(sys.argv[2], 'w'); sys.exit(0)")
    refuses = program("import sys; open('log', 'w'); sys.exit('error: no')")
    assert "file is empty" in first(run_encoder(writes, FILES))[2]  # an invalid file needs no further report
    refusal = run_encoder(refuses, EncoderSuiteOptions("nasty/empty", ("L1",)))
    assert "refused, but left log in its working directory" == first(refusal)[2]
    assert not Path("core").exists()


def test_a_command_may_name_files_relative_to_the_callers_directory(tmp_path, monkeypatch):
    (tmp_path / "tools").mkdir()
    (tmp_path / "tools" / "a b.py").write_text("import os, sys; print(*sys.argv[1:], os.getcwd(), sep='|')")
    (tmp_path / "enc").write_text("#!/bin/sh\npwd\n")
    (tmp_path / "enc").chmod(0o755)
    (tmp_path / "small").touch()
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    script = f"{shlex.quote(sys.executable)} 'tools/a b.py' --lib=tools/ small none.txt {{ply}}"
    script_output, program_output = (
        run_program(command, {"ply": "in.ply"}, 30.0, cwd=tmp_path / "other").stdout.decode()
        for command in (script, "./enc {ply}")
    )
    assert f"--lib={tmp_path}/tools|small|none.txt|in.ply|{tmp_path}/other\n" == script_output
    assert f"{tmp_path}/other\n" == program_output


@pytest.mark.slow
def test_processes_run_again_in_another_second(encoded, tmp_path):
    (tmp_path / "sound.csplat").write_bytes(encoded[0])
    code = f"""import sys, time
data = open({str(tmp_path / "sound.csplat")!r}, "rb").read()
open(sys.argv[2], "wb").write(data + str(int(time.time())).encode() if ".again" in sys.argv[2] else data)
"""
    report = run_encoder(program(code), EncoderSuiteOptions(PLAIN, ("L1",), keep=tmp_path / "kept"))
    assert ("CNF-10",) == first(report)[1]
    assert ["ordinary-degree_1", "ordinary-degree_1.again"] == sorted(
        path.name for path in (tmp_path / "kept").iterdir()
    )


def test_files_are_kept_in_folders_emptied_before_each_run(encoded, tmp_path):
    choice = EncoderSuiteOptions(PLAIN, ("L1",), keep=tmp_path)
    assert "left tmp next" in outcome_of(encoded, lambda at: (at.out.parent / "tmp").write_text("") and None, choice)[2]
    assert run_encoder(COMMAND, choice, run=running(encoded, lambda _: None)).passed
    assert ["in.ply", "out.csplat", "out.npy"] == sorted(path.name for path in tmp_path.glob("*/*"))


def npy(text):
    """A file of version 1.0 whose header is some text."""
    return b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize(("write", "message"), [
    (lambda path: path.unlink(), "no source index was written"),
    (lambda path: path.write_bytes(b"\x93NUMPY"), "is not a NumPy array file"),
    (lambda path: path.write_bytes(b""), "is not a NumPy array file"),
    (lambda path: path.write_bytes(b"PK\3\4" * 9), "is not a NumPy array file"),
    (lambda path: np.save(path, np.array([None] * 216)), "is not a NumPy array file"),
    (lambda path: path.write_bytes(npy(b"{'descr': '<u4', 'shape': (216,),")), "is not a NumPy array file"),
    (lambda path: path.write_bytes(npy(b"{[]: 1}")), "is not a NumPy array file"),
])  # fmt: skip
def test_an_index_is_an_npy_file(encoded, write, message):
    _, clauses, found = outcome_of(encoded, lambda at: write(at.index) and None, MAPS)
    assert ("SRC-4",) == clauses
    assert message in found


def test_declined_unusual_inputs_are_counted():
    unusual = ("nasty/empty", "nasty/outlier", "broken/cut")
    declined = {INPUTS[name].make() for name in unusual}

    def run(_command, places, _seconds):
        refuses = Path(places["ply"]).read_bytes() in declined
        Path(places["out"]).write_bytes(b"csplat?") if not refuses else None
        return ProcessEnd(None, int(refuses), b"error: unusual\n", b"", 0.0)  # on standard output: the error is empty

    report = run_encoder("x {ply} {out}", EncoderSuiteOptions(",".join(unusual), ("L1",)), run=run)
    assert report.passed
    assert ["warning: nasty: 2 of 2 declined"] == list(report.notes)
    assert {"checks": 3, "passed": 1, "warned": 0, "declined": 2, "not proved": 0, "failed": 0, "skipped": 0} == (
        report.levels()["L1"]
    )
    assert {"refused: error: unusual"} == {one.message for one in report.outcomes}
    some = run_encoder("x {ply} {out}", EncoderSuiteOptions("nasty/empty*", ("L1",)), run=run)
    assert ["nasty: 1 of 2 declined"] == list(some.notes)
    assert (Status.DECLINED, (), "refused: error: unusual") == first(some)


@pytest.mark.slow
def test_inputs_are_written_as_files_with_a_list(tmp_path):
    listed = write_inputs(tmp_path)["inputs"]
    assert listed == json.loads((tmp_path / "inputs.json").read_text())["inputs"]
    assert list(INPUTS) == [entry["name"] for entry in listed]
    for entry in listed:
        one = INPUTS[entry["name"]]
        assert one.make() == (tmp_path / entry["file"]).read_bytes()
        assert one.why == entry["why"]
        assert ("must" if one.must_refuse else "may" if one.may_refuse else "no") == entry["refusal"]
        assert one.must_refuse == (entry["expected"] is None)
    by_name = {entry["name"]: entry["expected"] for entry in listed}
    for name, facts in {
        "nasty/not_a_number": {"splats": 61, "rows": 64, "renders": False, "psnr_min": None},
        "ordinary/extra_columns": {"sh_degree": 1, "extra_columns": ["confidence", "object_id", "red"], "psnr_min": 30},
    }.items():
        assert facts.items() <= by_name[name].items()


def test_the_command_writes_inputs_and_runs_nothing(tmp_path):
    result = invoke("--write-inputs", tmp_path / "new", "--filter", "ordinary/degree_*,broken/cut")
    assert (0, f"6 inputs in {tmp_path / 'new'}\n") == (result.exit_code, result.stdout)
    files = {path.relative_to(tmp_path / "new").as_posix() for path in (tmp_path / "new").rglob("*.*")}
    assert {*(f"ordinary/degree_{d}.ply" for d in range(5)), "broken/cut.ply", "inputs.json"} == files
    assert "is not empty" in invoke("--write-inputs", tmp_path / "new").stderr
    assert 0 == invoke("--write-inputs", tmp_path / "new", "--force", "--filter", "broken/*").exit_code


@pytest.mark.parametrize("words", [("--cmd", "x {ply} {out}"), ("--level", 2), ("--keep", "y"), ("--jobs", 2)])
def test_writing_inputs_accepts_no_option_of_a_run(tmp_path, words):
    result = invoke("--write-inputs", tmp_path / "new", *words)
    assert 2 == result.exit_code
    assert not (tmp_path / "new").exists()


def test_centres_in_doubles_are_compared_in_doubles():
    # Four million units away binary32 is a quarter of a unit off, more than splats are apart.
    one = INPUTS[PLAIN]
    near = one.source()
    far = replace(near, means=near.means.astype(np.float64) + np.array([4e6, -4e6, 0.1]))
    model = replace(csplat.decode(csplat.encode(near.to_model((0.0, 0.0, 0.0)))), origin=(4e6, -4e6, 0.1), extra={})
    scene = decode_scene(csplat.encode(model))
    content, pairs = check_content(replace(one, source=lambda: far), far, scene, None)
    assert (Status.PASSED, 0) == (content.status, pairs.missing)


def test_sizes_and_figures_of_others_stand_next_to_the_picture(altered, monkeypatch):
    def outcome(figures, psnr=41.2, **fields):
        monkeypatch.setattr("csplat_conformance.encoders.render_checks.peer_figures", lambda _: figures)
        return altered(lambda scene: scene, ("L4",), lambda *_: psnr, **fields).outcomes[0]

    ours, spz = {"bytes": 4800, "psnr": 40.9}, {"bytes": 7900, "psnr": 39.1}
    whole = outcome({"csplat": ours, "spz": spz})
    size = whole.details["bytes"]
    assert f"41.20 dB in {size:,} bytes (csplat 40.90 in 4,800, SPZ 39.10 in 7,900)" == whole.message
    assert {"psnr": 41.2, "wanted": 30.0, "bytes": size, "beside": {"csplat": ours, "spz": spz}} == whole.details
    assert f"41.20 dB in {size:,} bytes (SPZ in 7,900)" == outcome({"spz": {"bytes": 7900}}).message
    assert f"41.20 dB in {size:,} bytes" == outcome({}).message
    assert (
        f"25.00 dB, expected at least 26, in {size:,} bytes (csplat 40.90 in 4,800); with the source's means 25.0,"
        " shapes 25.0, opacities 25.0, colours 25.0"
    ) == outcome({"csplat": ours}, 25.0, psnr_min=26.0).message
