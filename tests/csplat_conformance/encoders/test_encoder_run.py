# SPDX-License-Identifier: Apache-2.0
"""The encoder suite's runs of a program: what a program may not do, and what is kept, counted and written.

Also: csplat_conformance.encoders.reference_ply, csplat_conformance.fields.
"""

import itertools
import json
import shlex
import sys
from pathlib import Path

import encoder_runs_cases as runs
import numpy as np
import pytest
from tables import failures
from typer.testing import CliRunner

from csplat_conformance.conformance_report import Status
from csplat_conformance.encoders import EncoderSuiteOptions, run_encoder, write_inputs
from csplat_conformance.protocol import ProcessEnd, run_program
from csplat_tools.cli.app import app


def invoke(*words):
    return CliRunner().invoke(app, ["conformance", "encoder", *map(str, words)])


def rewritten(name, make):
    """Return a change of the bytes of a file of the run: `ply`, `out` or `index`."""

    def change(at):
        path = getattr(at, name)
        path.write_bytes(make(path.read_bytes()))

    return change


def indexed(make):
    """Return a change of the source index."""
    return lambda at: np.save(at.index, make(np.load(at.index)))


def npy(text):
    """Return a file of version 1.0 whose header is some text."""
    return b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text


ROWS = np.arange(216)
NOT_NPY = "is not a NumPy array file"


@pytest.mark.parametrize(("message", "change"), [
    ("the input was modified", rewritten("ply", lambda data: data + b"\n")),
    ("the input is gone", lambda at: at.ply.unlink()),
    ("left x.tmp next to the output", lambda at: (at.out.parent / "x.tmp").touch()),
    ("left cache next to the output", lambda at: (at.out.parent / "cache").mkdir()),
])  # fmt: skip
def test_a_run_fails_if_it_has_side_effects(encoded, message, change):
    assert (Status.FAILED, (), message) == runs.outcome_of(encoded, change)


@pytest.mark.parametrize(("change", "message"), [
    (indexed(lambda index: index + 1), "splat "),
    (indexed(np.argsort), "numbers of the index are wrong"),
    (indexed(lambda index: index[:-1]), "expected integers of shape [216]"),
    (indexed(lambda index: index[:, None]), "shape [216, 1]"),
    (indexed(lambda index: index.astype(np.float64)), "the source index is float64"),
    (indexed(lambda index: np.where(ROWS == 5, index[6], index)), "splats 5 and 6 both have the source index"),
    (indexed(lambda index: np.where(ROWS == 5, -1, index)), "of splat 5 is -1, expected 0 to"),
    (indexed(lambda index: np.where(ROWS == 5, 2**40, index)), "is 1099511627776, expected 0 to 215"),
    (lambda at: at.index.unlink(), "no source index was written"),
    (lambda at: np.save(at.index, np.array([None] * 216)), NOT_NPY),
    (rewritten("index", lambda _: b"\x93NUMPY"), NOT_NPY),
    (rewritten("index", lambda _: b""), NOT_NPY),
    (rewritten("index", lambda _: b"PK\3\4" * 9), NOT_NPY),
    (rewritten("index", lambda _: npy(b"{'descr': '<u4', 'shape': (216,),")), NOT_NPY),
    (rewritten("index", lambda _: npy(b"{[]: 1}")), NOT_NPY),
])  # fmt: skip
def test_a_wrong_index_is_reported(encoded, change, message):
    status, clauses, found = runs.outcome_of(encoded, change, runs.MAPS)
    assert (Status.FAILED, ("SRC-4",)) == (status, clauses)
    assert message in found


def test_an_index_may_have_any_integer_type_and_wrong_numbers_are_named(encoded):
    wrong = encoded[1].copy()
    wrong[[3, 7]] = wrong[[7, 3]]
    message = (
        f"the source index of splat 3 is {wrong[3]}, but the nearest source splat is {wrong[7]}"
        " (2 of 216 numbers of the index are wrong)"
    )
    for dtype in ("<u1", ">i8", "<u8"):
        assert (
            Status.PASSED is runs.outcome_of(encoded, indexed(lambda index, to=dtype: index.astype(to)), runs.MAPS)[0]
        )
        assert message == runs.outcome_of(encoded, indexed(lambda _, to=dtype: wrong.astype(to)), runs.MAPS)[2]


def flip(place):
    return rewritten("out", lambda data: data[:place] + bytes([data[place] ^ 1]) + data[place:][1:])


def test_a_second_run_must_give_the_same_file_and_index(encoded):
    data, _ = encoded
    size = len(data)
    cases = {
        "two runs gave different files: first at byte 150, in attribute[": flip(150),
        "in the chunk TILE.0.1": flip(size - 1),
        "in the chunk SERR (directory[": flip(data.rfind(b"SERR") + 30),
        f"({size:,} and {size + 5:,} bytes): first at byte {size}": rewritten("out", lambda data: data + b"12345"),
        "two runs gave the same file but different source indices": indexed(lambda index: index[::-1]),
        "a second run ended differently: exit status 1, no file; its last line: error: no": runs.refuse,
    }

    def check(case):
        expected, change = case
        turns = itertools.count()
        status, clauses, message = runs.outcome_of(encoded, lambda at: change(at) if next(turns) else None)
        assert (Status.FAILED, ("CNF-10",)) == (status, clauses)
        assert expected in message

    assert [] == failures({case[0]: case for case in cases.items()}, check)


def test_a_refusal_leaves_nothing(encoded):
    def leave(at):
        (at.out.parent / "x.tmp").touch()
        return runs.refuse(at)

    message = "refused, but left out.npy next to the output; refused, but left x.tmp next to the output"
    for name in ("nasty/empty", "broken/cut"):
        assert (Status.FAILED, (), message) == runs.outcome_of(encoded, leave, EncoderSuiteOptions(name, ("L1",)))


@pytest.mark.slow
def test_the_working_directory_stays_empty():
    writes = runs.program("import sys; open('core', 'w'); open(sys.argv[2], 'w'); sys.exit(0)")
    refuses = runs.program("import sys; open('log', 'w'); sys.exit('error: no')")
    assert "file is empty" in runs.first(run_encoder(writes, runs.FILES))[2]  # an invalid file needs no further report
    refusal = run_encoder(refuses, EncoderSuiteOptions("nasty/empty", ("L1",)))
    assert "refused, but left log in its working directory" == runs.first(refusal)[2]
    assert not Path("core").exists()


def test_a_command_may_name_files_relative_to_the_callers_directory(tmp_path, monkeypatch):
    for folder in ("tools", "other"):
        (tmp_path / folder).mkdir()
    (tmp_path / "tools" / "a b.py").write_text("import os, sys; print(*sys.argv[1:], os.getcwd(), sep='|')")
    (tmp_path / "enc").write_text("#!/bin/sh\npwd\n")
    (tmp_path / "enc").chmod(0o755)
    (tmp_path / "small").touch()
    monkeypatch.chdir(tmp_path)
    for command, output in {
        f"{shlex.quote(sys.executable)} 'tools/a b.py' --lib=tools/ small none.txt {{ply}}":
            f"--lib={tmp_path}/tools|small|none.txt|in.ply|{tmp_path}/other\n",
        "./enc {ply}": f"{tmp_path}/other\n",
    }.items():  # fmt: skip
        assert output == run_program(command, {"ply": "in.ply"}, 30.0, cwd=tmp_path / "other").stdout.decode()


@pytest.mark.slow
def test_processes_run_again_in_another_second(encoded, tmp_path):
    (tmp_path / "sound.csplat").write_bytes(encoded[0])
    code = f"""import sys, time
data = open({str(tmp_path / "sound.csplat")!r}, "rb").read()
open(sys.argv[2], "wb").write(data + str(int(time.time())).encode() if ".again" in sys.argv[2] else data)
"""
    report = run_encoder(runs.program(code), EncoderSuiteOptions(runs.PLAIN, ("L1",), keep=tmp_path / "kept"))
    assert ("CNF-10",) == runs.first(report)[1]
    assert {"ordinary-degree_1", "ordinary-degree_1.again"} == {path.name for path in (tmp_path / "kept").iterdir()}


def test_files_are_kept_in_folders_emptied_before_each_run(encoded, tmp_path):
    choice = EncoderSuiteOptions(runs.PLAIN, ("L1",), keep=tmp_path)
    assert "left tmp next" in runs.outcome_of(encoded, lambda at: (at.out.parent / "tmp").touch(), choice)[2]
    assert run_encoder(runs.COMMAND, choice, run=runs.running(encoded, lambda _: None)).passed
    assert ["in.ply", "out.csplat", "out.npy"] == sorted(path.name for path in tmp_path.glob("*/*"))


def test_declined_unusual_inputs_are_counted():
    unusual = ("nasty/empty", "nasty/outlier", "broken/cut")
    declined = {runs.INPUTS[name].make() for name in unusual}

    def run(_command, places, _seconds):
        refuses = Path(places["ply"]).read_bytes() in declined
        if not refuses:
            Path(places["out"]).write_bytes(b"csplat?")
        return ProcessEnd(None, int(refuses), b"error: unusual\n", b"", 0.0)  # on standard output: the error is empty

    report, some = (
        run_encoder("x {ply} {out}", EncoderSuiteOptions(pattern, ("L1",)), run=run)
        for pattern in (",".join(unusual), "nasty/empty*")
    )
    assert report.passed
    assert {"checks": 3, "passed": 1, "declined": 2}.items() <= report.levels()["L1"].items()
    assert {"refused: error: unusual"} == {one.message for one in report.outcomes}
    assert ["warning: nasty: 2 of 2 declined", "nasty: 1 of 2 declined"] == [*report.notes, *some.notes]
    assert (Status.DECLINED, (), "refused: error: unusual") == runs.first(some)


@pytest.mark.slow
def test_inputs_are_written_as_files_with_a_list(tmp_path):
    listed = write_inputs(tmp_path)["inputs"]
    assert listed == json.loads((tmp_path / "inputs.json").read_text())["inputs"]
    assert list(runs.INPUTS) == [entry["name"] for entry in listed]
    for entry in listed:
        one = runs.INPUTS[entry["name"]]
        refusal = "must" if one.must_refuse else "may" if one.may_refuse else "no"
        assert (one.why, refusal, one.must_refuse) == (entry["why"], entry["refusal"], entry["expected"] is None)
        assert one.make() == (tmp_path / entry["file"]).read_bytes()
    (nan,) = (entry["expected"] for entry in listed if entry["name"] == "nasty/not_a_number")
    assert {"splats": 61, "rows": 64, "renders": False, "psnr_min": None}.items() <= nan.items()


def test_the_command_writes_inputs_and_runs_nothing(tmp_path):
    new = tmp_path / "new"
    for words in (("--cmd", "x {ply} {out}"), ("--level", 2), ("--save", "y"), ("--jobs", 2)):
        assert 2 == invoke("--write-inputs", new, *words).exit_code
        assert not new.exists()
    result = invoke("--write-inputs", new, "--filter", "ordinary/degree_*,broken/cut")
    assert (0, f"6 inputs in {new}\n") == (result.exit_code, result.stdout)
    assert 7 == len([*new.rglob("*.*")])
    assert "is not empty" in invoke("--write-inputs", new).stderr
    assert 0 == invoke("--write-inputs", new, "--force", "--filter", "broken/*").exit_code


def test_sizes_and_figures_of_others_stand_next_to_the_picture(altered, monkeypatch):
    def outcome(figures, psnr=41.2, **fields):
        monkeypatch.setattr("csplat_conformance.encoders.render_checks.peer_figures", lambda _: figures)
        return altered(lambda scene: scene, ("L4",), lambda *_: psnr, **fields).outcomes[0]

    ours, spz = {"bytes": 4800, "psnr": 40.9}, {"bytes": 7900, "psnr": 39.1}
    whole = outcome({"csplat": ours, "spz": spz})
    size = whole.details["bytes"]
    assert f"41.20 dB in {size:,} bytes (csplat 40.90 in 4,800, SPZ 39.10 in 7,900)" == whole.message
    assert {"psnr": 41.2, "wanted": 30.0, "bytes": size, "beside": {"csplat": ours, "spz": spz}} == whole.details
    assert f"41.20 dB in {size:,} bytes" == outcome({}).message
    low = outcome({"csplat": ours}, 25.0, psnr_min=26.0).message
    assert "25.00 dB, expected at least 26, in" in low
    assert "with the source's means 25.0, shapes 25.0, opacities 25.0, colours 25.0" in low
