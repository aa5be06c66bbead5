"""Kernels: threads run every lane once and pass errors on; a fork gets its own; warming up compiles everything.

Also: csplat_render.warmup.
"""

import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from csplat.errors import InputError
from csplat_render import kernels
from csplat_render.kernels import ParallelKernel, available_threads, kernel, lane_range, parallel_kernel, thread_count

pytest.importorskip("numba", reason="the renderer requires the extra [render]")


@parallel_kernel()
def note(lane, lanes, seen):
    first, end = lane_range(lane, lanes, len(seen))
    for i in range(first, end):
        seen[i] += lane + 1


@parallel_kernel()
def fail_at(lane, lanes, which):
    if lane == min(which, lanes):
        raise ValueError("this lane")


def test_every_lane_runs_once_and_little_work_in_one_thread_by_default():
    # Every lane adds its number plus 1, so the largest value is the number of lanes that ran.
    several = available_threads()
    for threads, count, used in (
        (1, 1000, 1), (2, 5, None), (2, 1000, None), (several, 1000, several), (None, 1000, 1),
        (None, 100_000, several), (1, 0, None),
    ):  # fmt: skip
        seen = np.zeros(count, np.int64)
        with thread_count(threads) as lanes:
            note(seen)
        assert count == np.count_nonzero((seen > 0) & (seen <= lanes))
        assert used in (None, seen.max(initial=0))


@pytest.mark.slow
def test_the_error_of_any_lane_reaches_the_caller():
    with thread_count(available_threads()) as lanes:
        for lane in range(lanes):
            with pytest.raises(ValueError, match="this lane"):
                fail_at(lane)
        fail_at(-1)


def test_an_error_waits_for_the_other_lanes():
    # Nothing is written after the error, and no thread is left.
    def slow(lane, _lanes, written):
        if lane == 0:
            raise MemoryError("the first lane")
        time.sleep(0.05)
        written[0] += 1

    written, before = [0], threading.active_count()
    with thread_count(available_threads()) as lanes:
        with pytest.raises(MemoryError, match="the first lane"):
            ParallelKernel(slow)(written)
        assert [lanes - 1] == written
        assert threading.active_count() <= before + lanes - 1


def test_the_number_of_threads_is_restored():
    with thread_count(1):
        with pytest.raises(InputError), thread_count(0):
            pass
        with thread_count(available_threads() + 1) as lanes:
            assert lanes == available_threads()
        with thread_count(None) as lanes:
            assert lanes == 1


def in_child(call):
    """Return the exit status of a forked child that calls a function; a child that waits for ever is ended."""
    if child := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    signal.alarm(20)
    try:
        call()
        os._exit(7)
    finally:
        os._exit(1)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*fork")  # Python warns of forks among threads, which are the point
@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork on this system")
def test_a_forked_child_has_its_own_threads_and_locks():
    def note_all():
        with thread_count(available_threads()):
            note(seen := np.zeros(1000, np.int64))
        assert seen.all()

    def hold():
        with thread_count(1):
            held.set()
            done.wait()

    held, done = threading.Event(), threading.Event()
    note_all()
    assert 7 == in_child(note_all)
    holder = threading.Thread(target=hold)
    holder.start()
    held.wait()
    status = in_child(note_all)
    done.set()
    holder.join()
    assert 7 == status


@pytest.mark.slow
def test_compilation_is_reported_once():
    calls = []
    plain = kernels.numba.njit(lambda x: x + 1)
    with kernels.on_compiling(lambda: calls.append(1)):
        assert (2, 2.5) == (plain(1), plain(1.5))  # two types, two compilations
    with kernels.on_compiling(lambda: calls.append(2)):
        plain(3)
    assert [1] == calls


def unlucky(x):
    return x + 1


def kernel_with_cache(folder, monkeypatch):
    monkeypatch.setattr(kernels.numba.config, "CACHE_DIR", str(folder))
    return kernel(unlucky)


@pytest.mark.slow
def test_an_unusable_cache_costs_a_compilation_not_the_run(tmp_path, monkeypatch):
    damages = {
        "an empty index": lambda index, _: index.write_bytes(b""),
        "an index that ends early": lambda index, _: index.write_bytes(index.read_bytes()[:-9]),
        "an index of an older numba": lambda index, _: index.write_bytes(b"\x80\x04\x8c\x060.60.0\x94.garbage"),
        "an index of another pickle": lambda index, _: index.write_bytes(index.read_bytes()[:-30] + b"N."),
        "an index that is a folder": lambda index, _: (index.unlink(), index.mkdir()),
        "data that are absent": lambda _, data: data.unlink(),
        "data that end early": lambda _, data: data.write_bytes(data.read_bytes()[:-100]),
        "data of another pickle": lambda _, data: data.write_bytes(b"\x80\x04K\x01."),
    }
    whole = tmp_path / "whole"
    assert 2 == kernel_with_cache(whole, monkeypatch)(1)
    unhealed = []
    for number, (what, damage) in enumerate(damages.items()):
        folder = shutil.copytree(whole, tmp_path / str(number))
        damage(next(folder.rglob("*.nbi")), next(folder.rglob("*.nbc")))
        assert 2 == kernel_with_cache(folder, monkeypatch)(1), what
        third = kernel_with_cache(folder, monkeypatch)
        third(1)
        if not third.stats.cache_hits:
            unhealed.append((what, kernels.cache_failure().split(": ")[-1]))
    assert [("an index that is a folder", "Is a directory")] == unhealed
    file = tmp_path / "file"
    file.write_bytes(b"")
    for folder in (file, file / "below"):  # the cache is next to the source instead, or in the home
        assert 2 == kernel_with_cache(folder, monkeypatch)(1)


@pytest.mark.skipif(sys.platform == "win32", reason="limits the sizes of files by RLIMIT_FSIZE")
def test_a_full_disk_costs_the_cache_not_the_run(tmp_path, monkeypatch):
    from resource import RLIM_INFINITY, RLIMIT_FSIZE, setrlimit

    full = kernel_with_cache(tmp_path, monkeypatch)
    setrlimit(RLIMIT_FSIZE, (0, RLIM_INFINITY))
    try:
        assert 2 == full(1)
    finally:
        setrlimit(RLIMIT_FSIZE, (RLIM_INFINITY, RLIM_INFINITY))
    assert kernels.cache_failure().endswith("File too large")
    assert [] == [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.skipif(sys.platform == "win32", reason="a home of Windows is not found by HOME")
def test_without_a_home_kernels_are_compiled_without_a_cache(tmp_path, monkeypatch):
    # numba would create a folder of the name ~ in the working folder.
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "__pycache__").write_bytes(b"")  # not even root can write below a file
    (tmp_path / "package" / "uncached.py").write_text("def f(x):\n    return x + 1\n")
    (tmp_path / "work").mkdir()
    monkeypatch.syspath_prepend(tmp_path / "package")
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setattr(kernels.numba.config, "CACHE_DIR", "")
    function = importlib.import_module("uncached").f
    for name, value in (("HOME", "relative"), ("XDG_CACHE_HOME", ""), ("XDG_CACHE_HOME", "relative")):
        monkeypatch.setenv(name, value)
        compiled = kernel(function)
        assert "no folder for numba's cache can be written" == kernels.cache_failure()
        assert [] == list((tmp_path / "work").iterdir())
    assert 2 == compiled(1)


# The compiled versions of each kernel after warming up, and after using them for a scene.
WARM = """
import json, sys
import numpy as np
import csplat
from csplat_render.lpips import SCALE
from csplat_render.metric_kernels import convolve
from csplat_render.scorer import Scorer
from csplat_render.virtual_cameras import virtual_cameras
from csplat_render.warmup import warm_up
from csplat_tools.optimise.simplify import SimplifyOptions, simplify
from csplat_tools.optional_packages import prepare_renderer

def compiled():
    return {
        f"{name}.{key}": len(value.signatures)
        for name, module in list(sys.modules.items()) if name.startswith(("csplat_render", "csplat_trainer"))
        for key, value in vars(module).items() if isinstance(getattr(value, "signatures", None), list)
    }

def lpips(a, b):
    kernel = np.full((11, 11, 3, 64), 0.1, np.float32)
    return float(convolve((a - b) / SCALE, kernel, np.zeros(64, np.float32), 4, 2).mean())

model = csplat.read(sys.argv[1]).select(np.arange(40))
prepare_renderer(quiet=True, simplify=True)
warm_up(gradients=False, ssim=True, lpips=True)
before = compiled()
simplify(model, csplat.Target(keep=0.5), options=SimplifyOptions(views=2, view_size=(32, 24), effort=1))
judge = Scorer.of_source(model, virtual_cameras(model, 1, 64, 48), (0.0, 0.0, 0.0))
judge.scores(model.select(np.arange(30)), lpips=lpips)
print(json.dumps([before, compiled()]))
"""


@pytest.mark.long
def test_warming_up_compiles_all_kernels_of_simplify_and_compare(sample_path):
    output = subprocess.check_output([sys.executable, "-c", WARM, str(sample_path)], text=True)
    before, after = json.loads(output.splitlines()[-1])
    assert before["csplat_render.contributions.sum_pruning"] > 0
    assert before == after
