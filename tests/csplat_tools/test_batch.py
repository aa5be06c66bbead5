# SPDX-License-Identifier: Apache-2.0
"""`csplat batch`: selection of scenes, repetition, files of others, interrupts, and clusters.

Also: csplat_tools.cli.batch.
"""

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from unittest.mock import Mock

import pytest
from command_line import InThisProcess, call

import csplat
from csplat import InputError
from csplat.system import map_in_processes
from csplat_tools import batch, run_batch
from csplat_tools.batch import find_tasks

FAST = ("encode", "--preset", "fast")


@pytest.fixture(autouse=True)
def _here(monkeypatch):
    monkeypatch.setattr(batch, "ProcessPoolExecutor", InThisProcess)


@pytest.fixture
def scenes(tmp_path, make_model):
    """A folder with two scenes, one of them in a subfolder, and a text file named like a scene."""
    folder = tmp_path / "scenes"
    (folder / "sub").mkdir(parents=True)
    csplat.write_ply(folder / "a.ply", make_model(20, 1))
    csplat.write(folder / "sub" / "b.spz", make_model(20, 0))
    (folder / "text.splat").write_text("no scene")
    return folder


def names(path, command="encode", match="*", out="out"):
    return [one.output for one in find_tasks(path, [command], None, match, path / out)]


def states(*how, **options):
    return [one.state for one in run_batch(*how, **options).results]


def test_scenes_of_a_folder_without_parts_of_others(scenes):
    assert ["a.csplat", "sub/b.csplat", "text.csplat"] == names(scenes)
    assert (["a.csplat"], ["a.csplat", "text.csplat"]) == (names(scenes, match="*.ply"), names(scenes, out="sub"))
    (scenes / "inria" / "point_cloud").mkdir(parents=True)
    (scenes / "statue").mkdir()
    others = "a.splat c.csplat .d.ply inria/input.ply inria/point_cloud/p.ply statue/meta.json x_rank0.pt x_rank1.pt"
    for name in others.split():
        (scenes / name).write_bytes(b"")
    found = ["a.ply", "a.splat", "inria/point_cloud/p", "statue", "sub/b", "text", "x_rank0"]
    assert ([f"{name}.csplat" for name in found], ["c.ply"]) == (names(scenes), names(scenes, "decode"))


def test_a_manifest_names_scenes_outputs_and_options(scenes):
    manifests = {
        "l.jsonl": '{"path": "a.ply", "options": "--preset fast"}\n{"path": "sub/b.spz", "output": "x/y.csplat"}',
        "l.csv": "sep=;\r\na.ply;;--preset fast\r\nsub/b.spz;x/y.csplat;\r\n",
        "m.csv": "# two\nOutput,Path,Options\n,a.ply,--preset fast\nx/y.csplat,sub/b.spz\n",
    }
    for name, text in manifests.items():
        (scenes / name).write_text(text, "utf-16" if ";" in text else "utf-8")
        tasks = find_tasks(scenes / name, ["encode"], None, "*", scenes)
        assert [("a.csplat", ("--preset", "fast")), ("x/y.csplat", ())] == [(one.output, one.options) for one in tasks]
        assert [str(scenes / "a.ply"), str(scenes / "sub/b.spz")] == [one.source for one in tasks]
    wrong = ["{", "[]", '{"path": 5}', '{"path": "a", "output": "../a"}', '{"path": "a", "options": "\\"--x"}']
    cases = {**dict.fromkeys(wrong, "line 1: expected a path"), "": "no scenes", '{"path": "a"}\n' * 2: "of 2"}
    for text, message in cases.items():
        (scenes / "l.jsonl").write_text(text)
        with pytest.raises(InputError, match=message):
            names(scenes / "l.jsonl")


def test_outputs_that_cannot_be_are_refused_before_any_work(scenes):
    (scenes / "l.jsonl").write_text('{"path": "a.ply", "output": "x"}\n{"path": "sub/b.spz", "output": "./x"}')
    (scenes / "m.jsonl").write_text('{"path": "a.ply", "output": "index.html"}')
    for where, command, ending, message in (
        ("l.jsonl", "encode", None, "x is the output of 2 scenes"),
        ("m.jsonl", "encode", None, "index.html is the page of the batch"),
        ("", "encode --dry-run", None, "--dry-run writes no output"),
        ("", "convert", "spz", "expected a file name ending"),
        ("", "encode", "/../x.csplat", "expected a file name ending"),
        (".", "decode", None, "has no scenes for `csplat decode` outside of"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            find_tasks(scenes / where, command.split(), ending, "*", scenes)


@pytest.mark.slow
def test_outputs_equal_those_of_the_command_and_are_not_made_again(scenes, tmp_path):
    out, alone = tmp_path / "out", tmp_path / "alone.csplat"
    assert "2 done, 0 done before, 1 failed" in call("batch", scenes, out, "--", *FAST, status=1).stdout
    assert ["a.csplat", "index.html", "sub"] == sorted(one.name for one in out.iterdir())
    page = (out / "index.html").read_text()
    assert ("2 of 3" in page, "PSNR" in page) == (True, False)
    assert '<a href="a.csplat">a.csplat</a>' in page
    call(*FAST, scenes / "a.ply", alone, "--quiet")
    assert alone.read_bytes() == (out / "a.csplat").read_bytes()
    (out / "sub" / "b.csplat").unlink()
    assert ["done_before", "done", "failed"] == states(scenes, out, FAST)
    assert [1, 1] == [(out / "index.html").read_text().count(word) for word in (">seconds", ">–<")]
    assert ["done_before", "done_before", "failed"] == states(scenes, out, FAST)
    assert ">seconds" not in (out / "index.html").read_text()
    assert ["done", "done"] == states(out, tmp_path / "plys", ("decode", "--sh-degree", "0"))
    assert 0 == csplat.read(tmp_path / "plys" / "a.ply").sh_degree


def test_other_damaged_and_old_files_are_kept(scenes, tmp_path):
    out = tmp_path / "out"
    run_batch(scenes, out, FAST)
    whole, page = (out / "a.csplat").read_bytes(), out / "index.html"
    page.write_text("mine")
    for data, age, message in [(b"mine", 0, "invalid"), (whole[:-1] + b"?", 0, "invalid"), (whole, -9e3, "older")]:
        (out / "a.csplat").write_bytes(data)
        os.utime(out / "a.csplat", (time.time() + age,) * 2)
        done = run_batch(scenes, out, FAST, match="a.ply")
        assert (message in done.results[0].error, False) == (True, done.has_page)
        assert (data, "mine") == ((out / "a.csplat").read_bytes(), page.read_text())
    printed = call("batch", scenes, out, "--match", "a.ply", "--", *FAST, status=1)
    assert ("index.html" in printed.stdout, "no page was written" in printed.stderr) == (False, True)
    assert ["done"] == states(scenes, out, FAST, match="a.ply", force=True)
    assert (whole, True) == ((out / "a.csplat").read_bytes(), "1 of 1" in page.read_text())


def test_a_system_without_semaphores_is_named(scenes, tmp_path, monkeypatch):
    monkeypatch.setattr(batch, "ProcessPoolExecutor", ProcessPoolExecutor)
    refuse = Mock(side_effect=PermissionError(13, "No"))
    monkeypatch.setattr("multiprocessing.synchronize._multiprocessing.SemLock", refuse)
    line = r"error: worker processes need semaphores, but (/dev/shm is not writable|there are none): No \(EACCES\)\n"
    assert re.fullmatch(line, call("batch", scenes, tmp_path / "out", "--", *FAST, status=1).stderr)
    with pytest.raises(PermissionError, match="need semaphores"):
        list(map_in_processes(int, 0, [1, 2], workers=2))


@pytest.mark.slow
def test_a_wrong_command_line_ends_the_batch(scenes, tmp_path):
    for words in ("encode --preset tiny", "encode --target-psnr 4 --target-size 1MB", "convert", "info"):
        assert 1 == call("batch", scenes, tmp_path / "out", "--", *words.split(), status=2).stderr.count("\n")
    assert not list(tmp_path.rglob("out/*.*"))


@pytest.mark.remote
def test_scenes_may_be_read_from_and_written_to_urls(scenes, tmp_path):
    store = pytest.importorskip("fsspec", reason="URLs require the extra [remote]").filesystem("memory")
    store.pipe("/in/a.ply", (scenes / "a.ply").read_bytes())
    (tmp_path / "l.csv").write_text("memory://in/a.ply,memory://out/a.csplat\nmemory://in/a.ply\nmemory://in/none.ply")
    for state in ("done", "done_before"):
        assert [state, state, "failed"] == states(tmp_path / "l.csv", tmp_path / "out")
    assert store.cat("/out/a.csplat") == (tmp_path / "out" / "a.csplat").read_bytes()


@pytest.mark.slow
def test_a_killed_process_fails_its_scene_alone_and_an_interrupt_is_not_lost(scenes, tmp_path, monkeypatch):
    killed, submit = Future(), InThisProcess.submit
    killed.set_exception(BrokenProcessPool())
    kill = lambda pool, make, task: killed if "a.ply" in task.source else submit(pool, make, task)  # noqa: E731
    monkeypatch.setattr(InThisProcess, "submit", kill)
    assert ["failed", "done", "failed"] == states(scenes, tmp_path / "out", FAST)
    monkeypatch.setattr(InThisProcess, "submit", lambda *_: signal.raise_signal(signal.SIGINT) or Future())
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with pytest.raises(KeyboardInterrupt):
        run_batch(scenes, tmp_path / "out", FAST)
    signal.signal(signal.SIGINT, before)


def open_when_read(pipe, process, seconds=60):
    """Open a named pipe when another process reads it, or fail; `open` would wait for ever."""
    for _ in range(10 * seconds):
        try:
            return os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
        except OSError as error:
            if error.errno != errno.ENXIO:
                raise
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.1)
    process.kill()
    raise AssertionError(f"nobody has read {pipe} for {seconds} s: {process.communicate()[1]}")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_an_ended_batch_leaves_no_processes_and_is_continued(scenes, tmp_path, number):
    out, stuck = tmp_path / "out", scenes / "stuck.ply"
    os.mkfifo(stuck)  # without a size it comes last
    line = [sys.executable, "-m", "csplat_tools", "batch", str(scenes), str(out), "--workers", "2"]
    running = subprocess.Popen(line, stderr=subprocess.PIPE, text=True)
    end = open_when_read(stuck, running)
    running.send_signal(number)
    error = running.communicate(timeout=60)[1]  # its processes have the same pipe
    os.close(end)
    assert (-number if number == signal.SIGKILL else 128 + number) == running.returncode
    assert ("Traceback" in error, []) == (False, list(out.rglob(".*")))
    stuck.unlink()
    again = json.loads(subprocess.run([*line, "--json"], capture_output=True, check=False).stdout)
    assert (2, 1) == (again["done"] + again["done_before"], again["failed"])


@pytest.mark.slow
@pytest.mark.remote
def test_the_workers_of_a_cluster_write_the_same_bytes(scenes, tmp_path):
    distributed = pytest.importorskip("distributed", reason="a cluster requires the extra [scale]")
    out, alone = tmp_path / "out", tmp_path / "alone.csplat"
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
        call("batch", scenes, out, "--scheduler", cluster.scheduler_address, "--", *FAST, status=1)
    call(*FAST, scenes / "a.ply", alone, "--quiet")
    assert alone.read_bytes() == (out / "a.csplat").read_bytes()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_names_that_are_not_utf_8_are_links_on_the_page(scenes, tmp_path):
    (scenes / "a.ply").rename(scenes / "a\udcff.ply")
    done = run_batch(scenes, tmp_path / "out", FAST, match="*.ply")
    assert [("a\udcff.csplat", "done")] == [(one.output, one.state) for one in done.results if one.state == "done"]
    assert b'<a href="a%FF.csplat">a\xff.csplat</a>' in (tmp_path / "out" / "index.html").read_bytes()
