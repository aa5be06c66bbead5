"""`csplat batch`: selection of scenes, repetition, interruption, and reports."""

import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import InThisProcess, heed_interrupts
from typer.testing import CliRunner

import csplat
import csplat_tools
from csplat.errors import InputError, LimitError
from csplat_tools.batches import batch_run
from csplat_tools.batches.batch_page import make_batch_page
from csplat_tools.batches.batch_run import MemoryBudget
from csplat_tools.batches.batch_scenes import find_tasks, starting_points
from csplat_tools.batches.journal import JOURNAL, Record, open_journal, read_journal
from csplat_tools.batches.scene_job import (
    RENDERER_BYTES,
    SceneFile,
    Worker,
    WorkerLostError,
    content_hash,
    estimate_job,
    inspect_scene,
)
from csplat_tools.cli.app import app

FAST = ("encode", "--preset", "fast")


@pytest.fixture
def scenes(tmp_path, make_model):
    """A folder with two scenes, one of them in a subfolder, and a text file named like a scene."""
    folder = tmp_path / "scenes"
    (folder / "sub").mkdir(parents=True)
    csplat.write_ply(folder / "a.ply", make_model(40, 1))
    csplat.write(folder / "sub" / "b.spz", make_model(30, 0))
    (folder / "text.splat").write_text("no scene")
    return folder


@pytest.fixture
def here(monkeypatch):
    """Run one scene at a time in this process."""
    monkeypatch.setattr(batch_run, "Worker", InThisProcess)
    monkeypatch.setattr(InThisProcess, "ran", 0)
    return InThisProcess


def run(scenes, out, command=FAST, **how):
    return csplat_tools.batch(scenes, out, command, workers=1, thumbnails=False, **how)


def names(tasks):
    return [one.output for one in tasks]


# Selection of scenes.
def test_a_folder_is_searched_and_keeps_its_paths(scenes):
    assert ["a.csplat", "sub/b.csplat", "text.csplat"] == names(find_tasks(str(scenes), "encode", ".csplat"))
    assert ["a.csplat"] == names(find_tasks(str(scenes), "encode", ".csplat", match="*.ply"))


def test_scenes_of_one_name_keep_their_endings(scenes):
    (scenes / "a.splat").write_bytes(b"")
    assert {"a.ply.csplat", "a.splat.csplat"} <= set(names(find_tasks(str(scenes), "encode", ".csplat")))


def test_a_folder_that_is_a_scene_names_the_output(scenes):
    (scenes / "statue").mkdir()
    (scenes / "statue" / "meta.json").write_text("{}")
    assert "statue.csplat" in names(find_tasks(str(scenes), "encode", ".csplat"))


def test_initial_points_and_parts_of_checkpoints_are_no_scenes(scenes):
    (scenes / "inria" / "point_cloud" / "iteration_30000").mkdir(parents=True)
    for name in ("inria/input.ply", "inria/point_cloud/iteration_30000/point_cloud.ply", "sub/input.ply"):
        (scenes / name).write_bytes(b"")
    for rank in (0, 1, 12):
        (scenes / f"ckpt_29_rank{rank}.pt").write_bytes(b"")
    (scenes / "ckpt_6_rank1.pt").write_bytes(b"")
    found = names(find_tasks(str(scenes), "encode", ".csplat"))
    assert {"inria/point_cloud/iteration_30000/point_cloud.csplat", "sub/input.csplat"} <= set(found)
    assert ["ckpt_29_rank0.csplat", "ckpt_6_rank1.csplat"] == [one for one in found if "rank" in one]
    assert "inria/input.csplat" not in found
    assert ["inria/input.ply"] == starting_points(scenes)


def test_encode_skips_csplat_files_and_decode_takes_only_those(scenes):
    (scenes / "c.csplat").write_bytes(b"")
    assert "c.csplat" not in names(find_tasks(str(scenes), "encode", ".csplat"))
    assert ["c.ply"] == names(find_tasks(str(scenes), "decode", ".ply"))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (
            "list.jsonl",
            '{"path": "a.ply", "options": "--preset fast"}\n\n{"path": "sub/b.spz", "output": "x/y.csplat"}\n',
        ),
        ("list.csv", "path,output,options\na.ply,,--preset fast\nsub/b.spz,x/y.csplat\n"),
        ("list.txt", "# two\na.ply, , --preset fast\nsub/b.spz, x/y.csplat\n"),
        ("list.csv", "path;output;options\r\na.ply;;--preset fast\r\nsub/b.spz;x/y.csplat;\r\n"),
        ("list.csv", "sep=;\na.ply;;--preset fast\nsub\\b.spz;x\\y.csplat\n"),
        ("list.csv", "Output,Path,Options\n,a.ply,--preset fast\nx/y.csplat,sub/b.spz,\n"),
        ("list.txt", "path\toutput\toptions\na.ply\t\t--preset fast\nsub/b.spz\tx/y.csplat\n"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_manifest_names_scenes_outputs_and_options(scenes, name, text, encoding):
    (scenes / name).write_text(text, encoding)
    tasks = find_tasks(str(scenes / name), "encode", ".csplat")
    assert ["a.csplat", "x/y.csplat"] == names(tasks)
    assert [("--preset", "fast"), ()] == [one.options for one in tasks]
    assert [str(scenes / "a.ply"), str(scenes / "sub/b.spz")] == [one.source for one in tasks]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "line 1: expected a JSON object"),
        ('{"output": "a"}', "line 1: expected a path"),
        ('{"path": "a", "output": "../a"}', "outside the folder"),
        ('{"path": "a", "options": "\\"--x"}', "options"),
        ('{"path": "a.ply", "output": "c"}\n{"path": "b.ply", "output": "c"}', "the output of 2 scenes"),
        ("", "no scene"),
    ],
)
def test_an_invalid_manifest_is_refused(tmp_path, text, message):
    (tmp_path / "list.jsonl").write_text(text)
    with pytest.raises(InputError, match=message):
        find_tasks(str(tmp_path / "list.jsonl"), "encode", ".csplat")


def test_a_manifest_in_another_encoding_is_refused(tmp_path):
    (tmp_path / "list.csv").write_bytes("K\xf6ln.ply;;".encode("cp1252"))
    with pytest.raises(InputError, match=r"list\.csv is not a text file in UTF-8 \(byte 1 is 0xf6"):
        find_tasks(str(tmp_path / "list.csv"), "encode", ".csplat")


# Repeated batches.
@pytest.mark.usefixtures("here")
def test_files_equal_those_of_the_command_and_failures_are_listed(scenes, tmp_path):
    out = tmp_path / "out"
    done = run(scenes, out)
    assert ["text.splat"] == [Path(one.path).name for one in done.failures]
    assert "E_INPUT" == done.failures[0].code
    alone = tmp_path / "alone.csplat"
    assert 0 == CliRunner().invoke(app, [*FAST, str(scenes / "sub" / "b.spz"), str(alone), "--quiet"]).exit_code
    assert alone.read_bytes() == (out / "sub" / "b.csplat").read_bytes()
    lines = [json.loads(line) for line in (out / JOURNAL).read_text().splitlines()]
    assert [("a.csplat", "done", 40), ("sub/b.csplat", "done", 30), ("text.csplat", "failed", None)] == sorted(
        (one["output"], one["state"], one["splats"]) for one in lines
    )
    assert all(one["output_bytes"] == (out / one["output"]).stat().st_size for one in lines if one["state"] == "done")
    page = (out / "index.html").read_text()
    assert "2 of 3" in page
    assert "E_INPUT" in page


def test_only_failed_or_changed_scenes_are_repeated(scenes, tmp_path, here, make_model):
    out = tmp_path / "out"
    run(scenes, out)
    here.ran = 0
    again = run(scenes, out)
    assert (1, {"a.csplat", "sub/b.csplat"}) == (here.ran, set(again.done_before))  # the text file is tried again
    csplat.write_ply(scenes / "text.splat", make_model(5, 0))  # the content determines the format
    csplat.write_ply(scenes / "a.ply", make_model(41, 1))
    (out / "sub" / "b.csplat").unlink()
    again = run(scenes, out)
    assert (4, (), [41, 30, 5]) == (here.ran, tuple(again.done_before), [one.splats for one in again.records])
    assert not run(scenes, out, ("encode", "--preset", "balanced")).done_before


@pytest.mark.usefixtures("here")
def test_files_of_others_are_kept(scenes, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "a.csplat").write_bytes(b"precious")
    assert "--force replaces it" in run(scenes, out).failures[0].error
    assert b"precious" == (out / "a.csplat").read_bytes()
    assert 1 == len(run(scenes, out, force=True).failures)
    (out / "a.csplat").write_bytes(b"precious")  # a file of a batch that the user changed is the user's
    assert 2 == len(run(scenes, out).failures)
    assert b"precious" == (out / "a.csplat").read_bytes()


@pytest.mark.usefixtures("here")
def test_options_are_refused_before_any_work(scenes, tmp_path):
    def refused(*words):
        result = CliRunner().invoke(app, ["batch", str(scenes), str(tmp_path / "out"), "--", *words])
        assert (2, 1) == (result.exit_code, result.stderr.count("\n")), result.stderr
        return result.stderr

    assert "not one of" in refused("encode", "--preset", "tiny")
    assert "--report is not for all" in refused("encode", "--report", "a.json")
    assert "--ending" in refused("convert")
    assert "IN and OUT" in refused("info")
    assert "not a command" in refused("nonsense")
    assert "--help" in refused("encode", "--help")
    assert not (tmp_path / "out").exists()
    line = refused("encode", "--target-psnr", "40", "--target-size", "1MB")  # the first scene finds it out
    assert "error: csplat batch: csplat encode: --target-psnr and --target-size: give one of them; `csplat b" in line
    assert [] == list((tmp_path / "out").rglob("*.csplat"))


def test_a_dry_run_writes_nothing(scenes, tmp_path, here):
    words = ["batch", str(scenes), str(tmp_path / "out"), "--dry-run", "--json", "--workers", "1", "--", *FAST]
    result = CliRunner().invoke(app, words)
    assert 0 == result.exit_code
    planned = json.loads(result.stdout)
    assert [(False, 40), (False, 30), (False, None)] == [(one["done"], one["splats"]) for one in planned]
    assert (0, False) == (here.ran, (tmp_path / "out").exists())


@pytest.mark.usefixtures("here")
def test_other_commands_are_run(scenes, tmp_path):
    run(scenes, tmp_path / "out", match="*.ply")
    done = run(tmp_path / "out", tmp_path / "plys", ("decode", "--sh-degree", "0"))
    assert [("done", 40)] == [(one.state, one.splats) for one in done.records]
    assert 0 == csplat.read(tmp_path / "plys" / "a.ply").sh_degree
    done = run(scenes, tmp_path / "splats", ("convert",), ending=".splat", match="*.ply")
    assert ["a.splat"] == [one.output for one in done.records]


@pytest.mark.remote
@pytest.mark.usefixtures("here")
def test_scenes_may_be_read_from_and_written_to_urls(scenes, tmp_path):
    fsspec = pytest.importorskip("fsspec", reason="URLs require the extra [remote]")
    store = fsspec.filesystem("memory")
    store.pipe("/in/a.ply", (scenes / "a.ply").read_bytes())
    rows = [("memory://in/a.ply", "memory://out/a.csplat"), ("memory://in/a.ply", ""), ("memory://in/absent.ply", "")]
    (tmp_path / "list.csv").write_text("".join(f"{path},{output}\n" for path, output in rows))
    done = run(tmp_path / "list.csv", tmp_path / "out")
    assert ["done", "done", "failed"] == [one.state for one in done.records]
    assert "ENOENT" == done.records[2].code
    assert store.cat("/out/a.csplat") == (tmp_path / "out" / "a.csplat").read_bytes()


# The journal.
def test_an_incomplete_line_of_the_journal_is_ignored(tmp_path):
    record = Record("a.ply", "a.csplat", FAST, "1", "done", sha256="0")
    with open_journal(tmp_path) as journal:
        journal.begin(["a.csplat", "b.csplat"])
        journal.add(record)
    with (tmp_path / JOURNAL).open("a") as stream:
        stream.write('{"path": "b.ply", "output": "b.cs')
    with open_journal(tmp_path) as journal:
        assert ({"a.csplat": record}, {"b.csplat"}) == (journal.records, journal.pending)
        journal.add(replace(record, output="c.csplat"))
    assert ["a.csplat", "c.csplat"] == list(read_journal(tmp_path)[0])


def test_one_batch_at_a_time_writes_to_a_folder(tmp_path):
    with open_journal(tmp_path), pytest.raises(InputError, match="another batch"), open_journal(tmp_path):
        pass


# Memory and inspection.
def test_scenes_wait_for_memory_or_are_refused():
    budget, order = MemoryBudget(100), []
    with budget.gate(60):
        thread = threading.Thread(target=lambda: [order.append("in") for _ in [budget.gate(50).__enter__()]])
        thread.start()
        with budget.gate(40):  # does not wait for the thread
            order.append("first")
    thread.join()
    assert ["first", "in"] == order
    with pytest.raises(LimitError, match="needs 101, allowed 100"), budget.gate(101):
        pass
    with MemoryBudget(10**9, has_option=True).gate(10**9 + 1) as options:
        assert ("--memory", str(10**9 - RENDERER_BYTES)) == options
    with MemoryBudget(None, 100).gate(101) as options:  # without an explicit limit it runs alone
        assert () == options


@pytest.mark.usefixtures("here")
def test_a_scene_beyond_the_memory_limit_fails(scenes, tmp_path):
    done = run(scenes, tmp_path / "out", ("convert",), ending=".ply", match="*.spz", memory_bytes=10**6)
    assert ["E_LIMIT"] == [one.code for one in done.failures]
    done = run(scenes, tmp_path / "out", match="*.ply", memory_bytes=10**6)  # the limit is passed on to encode
    assert ["E_INPUT"] == [one.code for one in done.failures]


def test_an_inspection_finds_splats_and_a_content_hash(scenes):
    found = inspect_scene(scenes / "sub" / "b.spz")
    assert (30, "spz") == (found.splats, found.format)
    assert inspect_scene(scenes / "text.splat").splats is None
    folder = scenes / "statue"
    folder.mkdir()
    (folder / "meta.json").write_text("{}")
    before = content_hash(folder / "meta.json")
    (folder / "quats.webp").write_bytes(b"1")
    assert before != content_hash(folder / "meta.json")
    assert estimate_job("encode", SceneFile("", 0, 10**6, "")).memory_bytes > estimate_job("encode", found).memory_bytes


def test_the_page_escapes_names_of_scenes(tmp_path):
    record = Record("<b>.ply", "<b>.csplat", FAST, "1", "done", source_bytes=10, output_bytes=1, splats=1)
    failed = replace(record, state="failed", error="<i>", code="E_INPUT")
    page = make_batch_page([record, failed], tmp_path)
    assert "<b>" not in page
    assert "<i>" not in page


# Processes that end.
@pytest.mark.slow
def test_a_killed_worker_is_reported_and_replaced(scenes, tmp_path):
    os.mkfifo(tmp_path / "stuck.ply")
    worker = Worker()
    try:
        threading.Thread(target=lambda: _killed_at(tmp_path / "stuck.ply", lambda: worker.pid)).start()
        with pytest.raises(WorkerLostError, match="SIGKILL"):
            worker.ask("look", path=str(tmp_path / "stuck.ply"))
        assert 40 == worker.ask("look", path=str(scenes / "a.ply"))["splats"]
    finally:
        worker.close()
    with pytest.raises(WorkerLostError):
        worker.ask("look", path=str(scenes / "a.ply"))


@pytest.mark.slow
def test_the_journal_of_a_killed_process_is_continued(tmp_path):
    code = (
        "import os, signal, sys; from pathlib import Path; from csplat_tools.batches.journal import *\n"
        "with open_journal(Path(sys.argv[1])) as journal:\n"
        "    journal.begin(['a.csplat', 'b.csplat'])\n"
        "    journal.add(Record('a.ply', 'a.csplat', ('encode',), '1', 'done', sha256='0'))\n"
        "    os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert -signal.SIGKILL == subprocess.run([sys.executable, "-c", code, tmp_path], check=False).returncode
    with open_journal(tmp_path) as journal:
        assert (["a.csplat"], {"b.csplat"}) == (list(journal.records), journal.pending)


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_an_interrupted_batch_is_continued(scenes, tmp_path, make_model):
    stuck, out = scenes / "stuck.ply", tmp_path / "out"
    os.mkfifo(stuck)  # without a size it comes last
    command = [sys.executable, "-m", "csplat_tools", "batch", str(scenes), str(out), "--workers", "1"]
    batch = subprocess.Popen(
        [*command, "--", *FAST],
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heed_interrupts,  # noqa: PLW1509  # it sets one signal
    )
    with stuck.open("wb"):  # waits for the process to read it
        batch.send_signal(signal.SIGINT)
        batch.wait(timeout=60)
    assert 130 == batch.returncode
    assert "Traceback" not in batch.communicate()[1]
    noted = [name for name, one in read_journal(out)[0].items() if one.state == "done"]
    stuck.unlink()
    csplat.write_ply(stuck, make_model(7, 0))
    done = run(scenes, out)
    assert set(noted) <= set(done.done_before)
    assert ["text.csplat"] == [one.output for one in done.failures]
    assert not list(out.rglob(".*"))


@pytest.mark.slow
@pytest.mark.remote
def test_a_cluster_reassigns_the_scenes_of_a_lost_worker(scenes, tmp_path, make_model):
    distributed = pytest.importorskip("distributed", reason="a cluster requires the extra [scale]")
    stuck, whole = scenes / "stuck.ply", tmp_path / "whole.ply"
    os.mkfifo(stuck)
    csplat.write_ply(whole, make_model(7, 0))
    how = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0", "host": "127.0.0.1"}
    with distributed.LocalCluster(**how) as cluster, distributed.Client(cluster) as client:
        numbers = client.run(os.getpid)

        def kill():
            with stuck.open("wb"):
                [at] = [at for at, keys in client.processing().items() if any("stuck" in str(key) for key in keys)]
                whole.rename(stuck)
                os.kill(numbers[at], signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        done = csplat_tools.batch(scenes, tmp_path / "out", FAST, thumbnails=False, dask=cluster.scheduler_address)
        killer.join()
        assert numbers != client.run(os.getpid)
    assert [("a.csplat", 40), ("stuck.csplat", 7), ("sub/b.csplat", 30), ("text.csplat", None)] == sorted(
        (one.output, one.splats) for one in done.records
    )
    assert ["text.csplat"] == [one.output for one in done.failures]


def _killed_at(pipe, pid):
    with pipe.open("wb"):
        os.kill(pid(), signal.SIGKILL)
