"""The encoder suite's runs of a program: places, traces, repetitions, refusals, the source index; inputs as files."""

import json
import shlex
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

import csplat
from csplat_conformance.conformance_report import Status
from csplat_conformance.declared_bounds import verify_bounds
from csplat_conformance.encoders import EncoderSuiteOptions, all_inputs, run_encoder, write_inputs
from csplat_conformance.encoders.encoder_run import REPEAT_SECONDS
from csplat_conformance.encoders.file_checks import pair_splats
from csplat_conformance.protocol import ProcessEnd, run_program
from csplat_tools.cli.app import app

pytestmark = pytest.mark.area(name="suite")

INPUTS = {one.name: one for one in all_inputs()}
COMMAND = "encoder {ply} {out} {index}"
PLAIN = "ordinary/degree_1"
FILES = EncoderSuiteOptions(PLAIN, ("L1",), jobs=1)
MAPS = EncoderSuiteOptions(PLAIN, ("L2",), jobs=1)


def invoke(*words):
    return CliRunner().invoke(app, ["conformance", "encoder", *map(str, words)])


def program(code):
    """Return a command line that runs Python code on {ply} and {out}."""
    return f"{shlex.quote(sys.executable)} -c {shlex.quote(code)} {{ply}} {{out}}"


@pytest.fixture(scope="module")
def encoded(tmp_path_factory):
    """The plain input, encoded by our encoder, and its source index."""
    folder = tmp_path_factory.mktemp("encoded")
    (folder / "in.ply").write_bytes(INPUTS[PLAIN].make())
    words = ["encode", folder / "in.ply", folder / "out.csplat", "--source-index", folder / "out.npy", "--quiet"]
    assert 0 == CliRunner().invoke(app, list(map(str, words))).exit_code
    return (folder / "out.csplat").read_bytes(), np.load(folder / "out.npy")


def running(encoded, change):
    """Return an encoder in this process: our own, then `change` on the paths `ply`, `out` and `index`."""

    def run(_command, places, _seconds):
        at = SimpleNamespace(**{name: Path(place) for name, place in places.items()})
        at.out.write_bytes(encoded[0])
        np.save(at.index, encoded[1])
        code = change(at) or 0
        return ProcessEnd(None, code, b"", b"error: no" if code else b"", 0.0)

    return run


def first(report):
    outcome = report.outcomes[0]
    return outcome.status, outcome.clauses, outcome.message


# Traces --------------------------------------------------------------------------------------------
def test_ours_passes_in_this_process(encoded):
    report = run_encoder(COMMAND, EncoderSuiteOptions(PLAIN, ("L1", "L2", "L3")), run=running(encoded, lambda _: None))
    assert [Status.PASSED] * 3 == [one.status for one in report.outcomes]


@pytest.mark.parametrize(("change", "message"), [
    (lambda at: at.ply.write_bytes(at.ply.read_bytes() + b"\n") and None, "the input was modified"),
    (lambda at: at.ply.unlink(), "the input is gone"),
    (lambda at: (at.out.parent / "x.tmp").touch(), "left x.tmp next to the output"),
    (lambda at: (at.out.parent / "cache").mkdir(), "left cache next to the output"),
])  # fmt: skip
def test_side_effects_of_a_run_are_failures(encoded, change, message):
    report = run_encoder(COMMAND, FILES, run=running(encoded, change))
    assert (Status.FAILED, (), message) == first(report)


@pytest.mark.parametrize("name", ["nasty/empty", "broken/cut"])
def test_a_refusal_leaves_nothing(encoded, name):
    def refuse(at):
        at.out.unlink()
        (at.out.parent / "x.tmp").touch()
        return 1

    report = run_encoder(COMMAND, EncoderSuiteOptions(name, ("L1",)), run=running(encoded, refuse))
    message = "refused, but left out.npy next to the output; refused, but left x.tmp next to the output"
    assert (Status.FAILED, (), message) == first(report)


def test_the_working_directory_stays_empty():
    writes = program("import sys; open('core', 'w'); open(sys.argv[2], 'w'); sys.exit(0)")
    refuses = program("import sys; open('log', 'w'); sys.exit('error: no')")
    assert "file is empty" in first(run_encoder(writes, FILES))[2]  # an invalid file needs no further report
    assert (
        "refused, but left log in its working directory"
        == first(run_encoder(refuses, EncoderSuiteOptions("nasty/empty", ("L1",))))[2]
    )
    assert not Path("core").exists()


def test_files_in_the_command_are_found_from_another_directory(tmp_path, monkeypatch):
    (tmp_path / "tools").mkdir()
    (tmp_path / "tools" / "a b.py").write_text("import os, sys; print(*sys.argv[1:], sep='|'); print(os.getcwd())")
    (tmp_path / "small").touch()
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    python = shlex.quote(sys.executable)
    command = f"{python} 'tools/a b.py' --lib=tools/ small none.txt {{ply}}"
    ended = run_program(command, {"ply": "in.ply"}, 30.0, cwd=tmp_path / "other")
    lines = ended.stdout.decode().splitlines()
    assert [f"--lib={tmp_path}/tools|small|none.txt|in.ply", f"{tmp_path}/other"] == lines


def test_a_program_with_a_slash_is_one_of_the_callers_directory(tmp_path, monkeypatch):
    (tmp_path / "enc").write_text("#!/bin/sh\npwd\n")
    (tmp_path / "enc").chmod(0o755)
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    assert (
        f"{tmp_path}/other\n".encode() == run_program("./enc {ply}", {"ply": "x"}, 30.0, cwd=tmp_path / "other").stdout
    )


# Repetitions ---------------------------------------------------------------------------------------
def changed_the_second_time(change):
    turns = []

    def run(at):
        turns.append(1)
        return change(at) if len(turns) > 1 else None

    return run


def flip(place):
    def run(at):
        data = bytearray(at.out.read_bytes())
        data[place] ^= 1
        at.out.write_bytes(data)

    return run


def test_a_second_run_gives_the_same_bytes(encoded):
    differs = run_encoder(COMMAND, FILES, run=running(encoded, changed_the_second_time(flip(150))))
    status, clauses, message = first(differs)
    assert (Status.FAILED, ("CNF-10",)) == (status, clauses)
    assert message.startswith("two runs gave different files: first at byte 150, in attribute[")


def test_the_chunk_that_differs_is_named(encoded):
    for place, name in ((-1, "TILE.0.1"), (encoded[0].rfind(b"SERR") + 30, "SERR (directory[")):
        report = run_encoder(COMMAND, FILES, run=running(encoded, changed_the_second_time(flip(place))))
        assert f"in the chunk {name}" in first(report)[2]


def test_differing_lengths_are_reported(encoded):
    longer = changed_the_second_time(lambda at: at.out.write_bytes(encoded[0] + b"12345") and None)
    message = first(run_encoder(COMMAND, FILES, run=running(encoded, longer)))[2]
    assert f"({len(encoded[0]):,} and {len(encoded[0]) + 5:,} bytes): first at byte {len(encoded[0])}" in message


def test_a_second_run_gives_the_same_index(encoded):
    other = changed_the_second_time(lambda at: np.save(at.index, encoded[1][::-1]))
    assert (Status.FAILED, ("CNF-10",), "two runs gave the same file but different source indices") == first(
        run_encoder(COMMAND, FILES, run=running(encoded, other))
    )


def test_a_second_run_ends_as_the_first(encoded):
    def refuse(at):
        at.out.unlink()
        return 1

    report = run_encoder(COMMAND, FILES, run=running(encoded, changed_the_second_time(refuse)))
    assert "a second run ended differently: exit status 1, no file; its last line: error: no" == first(report)[2]


def test_processes_run_again_in_another_second(encoded, tmp_path):
    (tmp_path / "sound.csplat").write_bytes(encoded[0])
    code = f"""import sys, time
data = open({str(tmp_path / "sound.csplat")!r}, "rb").read()
open(sys.argv[2], "wb").write(data + str(int(time.time())).encode() if ".again" in sys.argv[2] else data)
"""
    began = time.monotonic()
    report = run_encoder(program(code), EncoderSuiteOptions(PLAIN, ("L1",), keep=tmp_path / "kept"))
    assert time.monotonic() - began >= REPEAT_SECONDS
    assert ("CNF-10",) == first(report)[1]
    # Kept files include both.
    assert ["ordinary-degree_1", "ordinary-degree_1.again"] == sorted(
        path.name for path in (tmp_path / "kept").iterdir()
    )


def test_only_kept_files_remain_in_folders_of_their_own(encoded, tmp_path):
    choice = EncoderSuiteOptions(PLAIN, ("L1",), keep=tmp_path)
    for _ in range(2):  # a second time over what the first one left
        assert run_encoder(COMMAND, choice, run=running(encoded, lambda _: None)).passed
        assert ["in.ply", "out.csplat", "out.npy"] == sorted(path.name for path in tmp_path.glob("*/*"))


def test_files_of_an_earlier_run_are_not_accepted(encoded, tmp_path):
    choice = EncoderSuiteOptions(PLAIN, ("L1",), keep=tmp_path)
    for _ in range(2):
        report = run_encoder(
            COMMAND, choice, run=running(encoded, lambda at: (at.out.parent / "tmp").write_text("") and None)
        )
        assert "left tmp next to the output" in first(report)[2]


# The source index ----------------------------------------------------------------------------------
@pytest.mark.parametrize(("change", "message"), [
    (lambda index: index + 1, "splat "),
    (np.argsort, "numbers of the index are wrong"),
    (lambda index: index[:-1], "expected integers of shape [216]"),
    (lambda index: index.astype(np.float64), "the source index is float64"),
    (lambda index: index[:, None], "shape [216, 1]"),
    (lambda index: np.where(np.arange(216) == 5, index[6], index), "splats 5 and 6 both have the source index"),
    (lambda index: np.where(np.arange(216) == 5, -1, index), "the source index of splat 5 is -1, expected 0 to"),
    (lambda index: np.where(np.arange(216) == 5, 2**40, index), "is 1099511627776, expected 0 to 215"),
])  # fmt: skip
def test_a_wrong_index_is_reported(encoded, change, message):
    report = run_encoder(COMMAND, MAPS, run=running(encoded, lambda at: np.save(at.index, change(encoded[1]))))
    status, clauses, found = first(report)
    assert (Status.FAILED, ("SRC-4",)) == (status, clauses)
    assert message in found


def test_a_wrong_number_names_splat_claim_and_nearest(encoded):
    wrong = encoded[1].copy()
    wrong[[3, 7]] = wrong[[7, 3]]
    report = run_encoder(COMMAND, MAPS, run=running(encoded, lambda at: np.save(at.index, wrong)))
    assert (
        f"the source index of splat 3 is {wrong[3]}, but the nearest source splat is {wrong[7]}"
        " (2 of 216 numbers of the index are wrong)"
    ) == first(report)[2]


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
    report = run_encoder(COMMAND, MAPS, run=running(encoded, lambda at: write(at.index) and None))
    assert ("SRC-4",) == first(report)[1]
    assert message in first(report)[2]


def test_any_integer_type_is_accepted(encoded):
    for dtype in ("<u1", ">i8", "<u8"):
        written = encoded[1].astype(dtype)
        report = run_encoder(COMMAND, MAPS, run=running(encoded, lambda at, w=written: np.save(at.index, w)))
        assert report.passed


def test_errors_are_proved_by_the_encoders_own_index(monkeypatch, tmp_path):
    # Centres are equal: only the encoder knows the pairs.
    ran = []

    def seen(*args):
        ran.append(args[-1])
        return verify_bounds(*args)

    monkeypatch.setattr("csplat_conformance.encoders.error_checks.verify_bounds", seen)
    (tmp_path / "in.ply").write_bytes(INPUTS["nasty/duplicates"].make())
    result = csplat.encode(csplat.read_ply(tmp_path / "in.ply"))

    def run(_command, places, _seconds):
        Path(places["out"]).write_bytes(result)
        np.save(places["index"], exchanged)
        return ProcessEnd(None, 0, b"", b"", 0.0)

    one = INPUTS["nasty/duplicates"]
    exchanged = pair_splats(
        one.source().means.astype(np.float64), csplat.decode(result).means.astype(np.float64), one.separation
    )
    exchanged = exchanged.source_index.copy()
    same = np.flatnonzero((one.source().means[exchanged] == one.source().means[exchanged[0]]).all(axis=1))
    exchanged[same] = np.roll(exchanged[same], 1)
    assert run_encoder(COMMAND, EncoderSuiteOptions(one.name, ("L3",)), run=run).passed
    np.testing.assert_array_equal(exchanged, ran[0])


# Refusals ------------------------------------------------------------------------------------------
def test_refusing_all_unusual_inputs_is_reported():
    refuses = program("import sys; print('error: unusual'); sys.exit(1)")
    report = run_encoder(refuses, EncoderSuiteOptions("nasty/empty,nasty/outlier,nasty/duplicates,broken/cut", ("L1",)))
    assert report.passed
    assert ["warning: nasty: 3 of 3 declined"] == list(report.notes)
    assert {"checks": 4, "passed": 1, "warned": 0, "declined": 3, "not proved": 0, "failed": 0, "skipped": 0} == (
        report.levels()["L1"]
    )
    assert {"refused: error: unusual"} == {
        one.message for one in report.outcomes
    }  # from standard output, as standard error is empty


def test_one_refusal_is_counted():
    def run(_command, places, _seconds):
        if Path(places["ply"]).read_bytes() == INPUTS["nasty/empty"].make():
            return ProcessEnd(None, 1, b"done", b"error: no splats\n", 0.0)
        Path(places["out"]).write_bytes(b"csplat?")
        return ProcessEnd(None, 0, b"", b"", 0.0)

    report = run_encoder("encoder {ply} {out}", EncoderSuiteOptions("nasty/empty*", ("L1",)), run=run)
    assert ["nasty: 1 of 2 declined"] == list(report.notes)
    assert (Status.DECLINED, (), "refused: error: no splats") == first(report)


# Inputs as files -----------------------------------------------------------------------------------
def test_inputs_are_written_as_files_with_a_list(tmp_path):
    listed = write_inputs(tmp_path)["inputs"]
    assert listed == json.loads((tmp_path / "inputs.json").read_text())["inputs"]
    assert list(INPUTS) == [entry["name"] for entry in listed]
    for entry in listed:
        one = INPUTS[entry["name"]]
        assert one.make() == (tmp_path / entry["file"]).read_bytes()
        assert one.why == entry["why"]
        assert (entry["expected"] is None) == (entry["refusal"] == "must") == one.must_refuse
        if entry["expected"]:
            assert len(one.source()) == entry["expected"]["splats"] <= entry["expected"]["rows"]
    by_name = {entry["name"]: entry for entry in listed}
    assert {"splats": 61, "rows": 64, "renders": False, "psnr_min": None}.items() <= (
        by_name["nasty/not_a_number"]["expected"].items()
    )
    assert {"sh_degree": 1, "extra_columns": ["confidence", "object_id", "red"], "psnr_min": 30.0}.items() <= (
        by_name["ordinary/extra_columns"]["expected"].items()
    )
    assert ("no", "may", "must") == tuple(
        by_name[name]["refusal"] for name in ("ordinary/plane", "nasty/empty", "broken/cut")
    )


def test_the_command_writes_inputs_and_runs_nothing(tmp_path):
    result = invoke("--write-inputs", tmp_path / "new", "--filter", "ordinary/degree_*,broken/cut")
    assert (0, f"5 inputs in {tmp_path / 'new'}\n") == (result.exit_code, result.stdout)
    files = {path.relative_to(tmp_path / "new").as_posix() for path in (tmp_path / "new").rglob("*.*")}
    assert {*(f"ordinary/degree_{d}.ply" for d in range(4)), "broken/cut.ply", "inputs.json"} == files
    assert "is not empty" in invoke("--write-inputs", tmp_path / "new").stderr
    assert 0 == invoke("--write-inputs", tmp_path / "new", "--force", "--filter", "broken/*").exit_code


@pytest.mark.parametrize("words", [("--cmd", "x {ply} {out}"), ("--level", 2), ("--keep", "y"), ("--jobs", 2)])
def test_writing_inputs_accepts_no_option_of_a_run(tmp_path, words):
    result = invoke("--write-inputs", tmp_path / "new", *words)
    assert 2 == result.exit_code
    assert not (tmp_path / "new").exists()
