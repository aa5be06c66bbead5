# SPDX-License-Identifier: Apache-2.0
"""The command line: output, statuses, messages; no partial files, no tracebacks.

Also: csplat_tools.cli.app.
"""

import json
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
from command_line import PROGRAM, invoke, printed, refused, status_of

import csplat
from csplat import _spec
from csplat.errors import InputError
from csplat.ply import read_ply
from csplat_tools.file_streams import check_output, write_bytes

pytestmark = pytest.mark.usefixtures("no_first_view")


def test_decodes_fewer_bands(tmp_path, csplat_file):
    printed("decode", csplat_file, tmp_path / "d1.ply", "--sh-degree", 1)
    printed("decode", csplat_file, tmp_path / "d2.ply", "--sh-degree", 3)
    one, two = read_ply(tmp_path / "d1.ply"), read_ply(tmp_path / "d2.ply")
    assert (1, 2) == (one.sh_degree, two.sh_degree)
    np.testing.assert_array_equal(one.shN, two.shN[:, :3])


def test_the_second_of_two_writers_of_a_name_is_refused(tmp_path, monkeypatch):
    target, written, both = str(tmp_path / "new"), os.fsync, threading.Barrier(2, timeout=20)

    def meet(number):
        written(number)
        both.wait()  # both files are complete, and neither has its name

    monkeypatch.setattr(os, "fsync", meet)
    check_output(target, force=False)
    lost = {}

    def write(data):
        try:
            write_bytes(target, data)
        except InputError as error:
            lost[data] = str(error)

    writers = [threading.Thread(target=write, args=(data,)) for data in (b"one", b"two")]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    ((data, message),) = lost.items()
    assert "and it was not replaced; --force replaces it" in message
    assert {b"one": b"two", b"two": b"one"}[data] == (tmp_path / "new").read_bytes()
    assert ["new"] == [path.name for path in tmp_path.iterdir()]


@pytest.mark.parametrize("links", [True, False])
def test_a_name_that_was_taken_meanwhile_is_replaced_only_by_force(tmp_path, monkeypatch, links):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    if not links:  # a file system without hard links, such as FAT
        monkeypatch.setattr(os, "link", refuse)
    target = tmp_path / "new"
    check_output(str(target), force=False)
    target.write_bytes(b"theirs")
    with pytest.raises(InputError, match="another program wrote it meanwhile"):
        write_bytes(str(target), b"ours")
    assert b"theirs" == target.read_bytes()
    check_output(str(target), force=True)
    write_bytes(str(target), b"ours")
    assert b"ours" == target.read_bytes()
    target.unlink()
    check_output(str(target), force=False)
    for data in (b"first", b"second"):  # the name is ours now
        write_bytes(str(target), data)
        assert data == target.read_bytes()
    assert ["new"] == [path.name for path in tmp_path.iterdir()]


def test_files_of_the_other_kind_are_refused_with_the_command_for_them(tmp_path, ply, csplat_file):
    renamed, out = tmp_path / "renamed.ply", tmp_path / "out"
    renamed.write_bytes(csplat_file.read_bytes())
    for words in (("encode", csplat_file, out), ("encode", renamed, out), ("lint", csplat_file), ("lint", renamed)):
        assert "csplat decode" in refused(*words)
    for words in (("decode", ply, out), ("verify", ply)):
        assert "csplat encode" in refused(*words)


def test_lint_names_defects_with_their_counts_and_repairs_what_it_need_not_guess(tmp_path, damaged_ply, ply):
    path, good = damaged_ply, tmp_path / "good.ply"
    result = invoke("lint", path, "--json")
    report = json.loads(result.stdout)
    assert (1, False) == (result.exit_code, report["clean"])
    assert {"trailing-bytes": 8, "nonfinite-rows": 1} == {one["id"]: one["count"] for one in report["findings"]}
    assert "nonfinite-rows" in invoke("lint", path).stdout
    printed("lint", path, "--fix", good)
    assert len(read_ply(good, strict=True)) == 49
    assert printed("lint", good) == "nothing found\n"
    assert json.loads(printed("lint", good, "--json"))["clean"]
    ply.write_bytes(ply.read_bytes().replace(b"property float opacity\n", b"property float opaqueness\n"))
    result = invoke("lint", ply, "--fix", tmp_path / "guessed.ply")
    assert (1, True) == (result.exit_code, "missing-columns" in result.stdout)
    assert not (tmp_path / "guessed.ply").exists()


def test_runs_the_conformance_suite():
    report = json.loads(invoke("conformance", "decoder", "--filter", "valid/q*", "--json").stdout)
    assert (True, ["L1", "L2", "L3"]) == (report["passed"], list(report["levels"]))
    assert invoke("conformance", "decoder", "--filter", "nothing").exit_code == 1


def test_completes_commands_and_options_and_corrects_misspelt_ones(monkeypatch, capfd):
    result = invoke("enocde")
    assert (2, True) == (result.exit_code, "'encode'" in result.stderr)
    for words, expected in (("csplat enc", "encode"), ("csplat encode --pre", "--preset")):
        monkeypatch.setenv("_CSPLAT_COMPLETE", "complete_bash")
        monkeypatch.setenv("COMP_WORDS", words)
        monkeypatch.setenv("COMP_CWORD", str(words.count(" ")))
        assert 0 == status_of()
        assert [expected] == capfd.readouterr().out.split()


@pytest.mark.slow
def test_csplat_as_a_module_is_the_program_and_prints_its_version():
    done = subprocess.run([sys.executable, "-m", "csplat", "--version"], capture_output=True, text=True, check=True)
    assert printed("--version") == done.stdout
    assert done.stdout.startswith(f"csplat {csplat.__version__}, format 1.0")


@pytest.mark.slow
@pytest.mark.usefixtures("ply")
def test_a_closed_or_full_standard_stream_is_an_error_of_one_line(tmp_path):
    full = "error: standard output: No space left on device; the output is incomplete (ENOSPC)\n"
    cases = {
        "info scene.ply >&-": "error: standard output: Bad file descriptor; the output is incomplete (EBADF)\n",
        "lint - <&-": "error: standard input: Bad file descriptor (EBADF)\n",
        "encode scene.ply new.csplat <&- >&- 2>&-": "",
        "lint absent.ply 2>/dev/full": "",
        "--version >/dev/full": full,  # and nothing is added when the process ends
    }
    # Unbuffered streams have nothing left that the interpreter could fail to write at its end.
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    for line, message in cases.items():
        words = ["/bin/sh", "-c", f'exec "{sys.executable}" -m csplat_tools {line}']
        run = subprocess.run(words, cwd=tmp_path, env=buffered, capture_output=True, text=True, check=False)
        assert (int("encode" not in line), message) == (run.returncode, run.stderr), line
    assert (tmp_path / "new.csplat").read_bytes().startswith(_spec.MAGIC)


def test_inputs_without_a_name_and_addresses_without_a_port_are_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, line in (
        (("encode", "."), ". is a folder, not a scene"), (("export-html", "/"), "/ is a folder, not a scene"),
        (("decode", ""), "an empty name is a folder"),
        (("batch", ".", "out", "--scheduler", "here"), "expected an address such as tcp://host:8786"),
        (("compare", "a.ply", "b.ply", "--pictures", "c.png"), "expected a folder or a page"),
    ):  # fmt: skip
        done = invoke(*words)
        assert done.exit_code, words
        assert (1, True) == (done.stderr.count("\n"), line in done.stderr), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_is_status_of_its_signal_and_leaves_nothing(tmp_path, number):
    with child([*PROGRAM, "encode", "-", str(tmp_path / "out.csplat")]) as running:
        running.stdin.write(bytes(1 << 20))  # more than a pipe holds: it has begun to read
        running.send_signal(number)
        assert 128 + number == running.wait(20)
        assert b"interrupted\n" == running.stderr.read()
    assert [] == list(tmp_path.iterdir())


def child(command, **options):
    streams = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    return subprocess.Popen(command, **streams, **options)  # one signal


#: A module in whose import the interrupt becomes another error.
INTERRUPTED = """
import sys, time
print('loading', flush=True)
try:
    time.sleep(20)
except KeyboardInterrupt as error:
    raise ImportError('half of it') from error
"""


@pytest.mark.slow
@pytest.mark.parametrize(("module", "before", "expected"), [
    ("contextlib", "import sys; sys.modules.pop('contextlib', None); ", (-signal.SIGINT, b"")),
    ("typer", "", (130, b"interrupted\n")),
])  # fmt: skip
def test_an_interrupt_while_the_program_loads_is_no_traceback(tmp_path, module, before, expected):
    (tmp_path / f"{module}.py").write_text(INTERRUPTED)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)])}
    script = f"{before}from csplat_program import main; main()"
    with child([sys.executable, "-c", script, "info"], env=environment) as running:
        assert b"loading\n" == running.stdout.readline()
        running.send_signal(signal.SIGINT)
        _, errors = running.communicate(timeout=20)
    assert expected == (running.returncode, errors)
