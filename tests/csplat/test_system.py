# SPDX-License-Identifier: Apache-2.0
"""Systems other than Linux, whose calls are hidden here: each missing one has a replacement or a clear refusal."""

import mmap
import multiprocessing
import operator
import os
import shlex
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PureWindowsPath
from unittest.mock import Mock

import numpy as np
import pytest

import csplat
from csplat import system
from csplat.disk_files import atomic_writer
from csplat.errors import InputError
from csplat.file_source import PageReleaser
from csplat.formats.sog.sog_files import SogParts
from csplat_conformance.conformance_report import Status
from csplat_conformance.protocol import run_program
from csplat_tools.batch import leads_out
from csplat_trainer.training_report import peak_memory


@pytest.fixture
def elsewhere(monkeypatch):
    """Hide from product code what Windows lacks."""
    for module, names in {
        mmap: ("MAP_PRIVATE", "MAP_ANONYMOUS", "MAP_NORESERVE", "MADV_DONTNEED"),
        os: ("fork", "killpg", "link", "pread", "preadv", "sched_getaffinity", "sysconf"),
        signal: ("pthread_kill",),
    }.items():
        for name in names:
            monkeypatch.delattr(module, name, raising=False)
    for name in ("fcntl", "resource"):
        monkeypatch.setitem(sys.modules, name, None)


@pytest.mark.usefixtures("elsewhere")
def test_a_file_is_read_in_parts(make_model, tmp_path):
    path = tmp_path / "scene.csplat"
    path.write_bytes(csplat.encode(make_model(300, 1), csplat.EncodeOptions(preset="fast", tile_splats=100)))
    whole = csplat.decode(path).means
    with csplat.open(path) as file:
        tiles = [tile.means for tile in file.tiles()]  # each batch is discarded before the next one
        assert np.array_equal(whole, file.read().means)
    assert len(tiles) == 3
    assert np.array_equal(whole, np.concatenate(tiles))


@pytest.mark.usefixtures("elsewhere")
def test_threads_read_a_file_at_the_same_time(tmp_path, monkeypatch):
    seek = os.lseek

    def slow_seek(*where):
        seek(*where)
        time.sleep(1e-4)  # lets another thread run

    monkeypatch.setattr(os, "lseek", slow_seek)
    data = np.random.default_rng(0).bytes(40 * 500)
    (tmp_path / "data").write_bytes(data)
    buffer, places = memoryview(bytearray(len(data))), range(0, len(data), 500)
    with (tmp_path / "data").open("rb") as stream, ThreadPoolExecutor(4) as pool:
        number = stream.fileno()
        read = list(pool.map(lambda at: system.read_at(number, 500, at), places))
        counts = set(pool.map(lambda at: system.read_into(number, buffer[at : at + 500], at), places))
        assert system.read_into(number, memoryview(bytearray(9)), len(data)) == 0
    assert (data, data, {500}) == (b"".join(read), bytes(buffer), counts)


@pytest.mark.usefixtures("elsewhere")
def test_a_mapped_file_without_advice_is_read(tmp_path):
    (tmp_path / "data").write_bytes(bytes(1 << 10))
    with (tmp_path / "data").open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        view = memoryview(mapped)
        PageReleaser(view).after(1 << 30)
        assert view[-1] == 0
        view.release()


@pytest.mark.usefixtures("elsewhere")
def test_one_of_two_writers_of_a_name_fails_without_hard_links(tmp_path):
    path = tmp_path / "out"

    def write_late():
        with atomic_writer(path, replace=False) as stream:
            stream.write(b"late")
            path.write_bytes(b"first")

    with pytest.raises(FileExistsError):
        write_late()
    with atomic_writer(tmp_path / "other", replace=False) as stream:
        stream.write(b"alone")
    assert {"out": b"first", "other": b"alone"} == {one.name: one.read_bytes() for one in tmp_path.iterdir()}


def test_paths_of_windows_do_not_lead_out_of_a_folder(tmp_path):
    (tmp_path / "C:x").write_bytes(b"")  # the file x of the current folder of drive C
    with pytest.raises(InputError, match="outside"):
        SogParts(tmp_path, "scene").read("C:x")
    names = {"sub/a.csplat": False, "../a": True, "..\\a": True, "C:a": True, "C:\\a": True, "\\a": True, "/a": True}
    assert names == {name: leads_out(name, PureWindowsPath) for name in names}


@pytest.mark.usefixtures("elsewhere")
def test_the_memory_has_a_default_size(monkeypatch):
    monkeypatch.setattr(Path, "read_text", Mock(side_effect=FileNotFoundError))
    assert system.available_memory_bytes() > 1 << 30
    assert peak_memory() is None
    assert system.core_count() == os.cpu_count()


@pytest.mark.slow
def test_spawned_processes_share_the_work(monkeypatch):
    starts, context = [], multiprocessing.get_context
    monkeypatch.setattr(system, "CAN_FORK", False)
    monkeypatch.setattr(multiprocessing, "get_context", lambda start: (starts.append(start), context(start))[1])
    done = dict(system.map_in_processes(operator.mul, 3, [1, 2, 3], workers=2))
    assert {1: 3, 2: 6, 3: 9} == done
    assert ["spawn"] == starts


def test_command_lines_of_windows_keep_their_backslashes():
    line = r""" C:\tools\decode.exe "C:\my files\{input}" '--out=D:\x y' # {outdir}"""
    words = [r"C:\tools\decode.exe", r"C:\my files\{input}", r"--out=D:\x y", "#", "{outdir}"]
    assert words == system.split_words(line, is_posix=False)
    assert ["a b", "c d", "#"] == system.split_words(r"a\ b 'c d' #", is_posix=True)
    with pytest.raises(ValueError, match="quotation"):
        system.split_words("'", is_posix=False)


@pytest.mark.slow
@pytest.mark.usefixtures("elsewhere")
def test_programs_end_or_are_killed_without_process_groups():
    python = shlex.quote(sys.executable)
    ended = run_program(f"{python} -S -c 'print(5)'", {}, 20)
    assert (None, b"5\n") == (ended.status, ended.stdout)
    assert run_program(f"{python} -S -c 'import time; time.sleep(60)'", {}, 0.3).status is Status.HUNG


def test_interrupts_are_held_back_if_the_system_can(monkeypatch):
    passed, before = [], signal.signal(signal.SIGINT, signal.default_int_handler)

    def interrupt():
        with system.interrupts_held():
            signal.raise_signal(signal.SIGINT)
            passed.append("held")
        passed.append("lost")

    try:
        with pytest.raises(KeyboardInterrupt):
            interrupt()
        assert ["held"] == passed
        monkeypatch.delattr(signal, "pthread_sigmask")
        with system.interrupts_held():
            pass
    finally:
        signal.signal(signal.SIGINT, before)
