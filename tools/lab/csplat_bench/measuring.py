# SPDX-License-Identifier: Apache-2.0
"""Clocks and memory: of calls, of calls in processes of their own, and of other programs.

The growth of a process is its largest resident size during a call less its size before. On Linux the kernel's
high-water mark is reset before the call; on other systems what `ru_maxrss` gained is a lower bound.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

_RSS_UNIT = 1 if sys.platform == "darwin" else 1024  # bytes per unit of ru_maxrss
_SAMPLE_SECONDS = 0.2  # from one sample of a process tree's memory to the next


@dataclass(frozen=True)
class Timing:
    """Wall-clock seconds, and CPU seconds of all threads."""

    wall: float
    cpu: float


@dataclass(frozen=True)
class Usage:
    """Time and memory of a program.

    Attributes:
        wall, cpu: seconds; CPU seconds include the program's children.
        peak_bytes: largest resident size of the largest of its processes.
        tree_bytes: largest sum over all its processes (PSS), sampled; 0 unless asked for.
        stdout: its output.
    """

    wall: float
    cpu: float
    peak_bytes: int
    tree_bytes: int
    stdout: str


def timed(call: Callable[P, T], /, *args: P.args, **named: P.kwargs) -> tuple[T, Timing]:
    """Call a function; return its result and the time it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = call(*args, **named)
    return result, Timing(time.perf_counter() - wall, time.process_time() - cpu)


def alone(call: Callable[P, T], /, *args: P.args, **named: P.kwargs) -> T:
    """Call a module's function in a new process, where no memory is in use yet."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(call, *args, **named).result()


def run_program(command: Sequence[object], cap_seconds: float | None = None, *, sample_tree: bool = False) -> Usage:
    """Run a program.

    Args:
        command: its words.
        cap_seconds: time limit; `None` for none.
        sample_tree: sample the memory of all its processes, which takes some CPU time.

    Raises:
        subprocess.CalledProcessError: it failed; `stderr` holds its messages.
        subprocess.TimeoutExpired: it reached the time limit.
    """
    words = [str(word) for word in command]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        start, tree = time.perf_counter(), 0
        process = subprocess.Popen(words, stdout=out, stderr=err, start_new_session=True)
        killer = threading.Timer(cap_seconds or 1e6, os.killpg, (process.pid, signal.SIGKILL))
        killer.daemon = True
        killer.start()
        while sample_tree and os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            tree = max(tree, _tree_bytes(process.pid))
            time.sleep(_SAMPLE_SECONDS)
        _, status, used = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start
        killer.cancel()
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        err.seek(0)
        stdout, stderr = (stream.read().decode(errors="replace") for stream in (out, err))
    if cap_seconds is not None and wall >= cap_seconds:
        raise subprocess.TimeoutExpired(words, cap_seconds)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, words, stdout, stderr)
    return Usage(wall, used.ru_utime + used.ru_stime, used.ru_maxrss * _RSS_UNIT, tree, stdout)


def reset_peak(process: int | None = None) -> int:
    """Reset the high-water mark of a process if the kernel allows it.

    Args:
        process: its id; `None` for this process.

    Returns:
        Its resident size before, bytes; 0 if it is another process and there is no /proc.
    """
    with contextlib.suppress(OSError):
        (_proc(process) / "clear_refs").write_text("5")
        resident = _status("VmRSS", process)
        if resident is not None and _status("VmHWM", process) is not None:
            return resident
    return 0 if process else _max_rss()


def peak_bytes(process: int | None = None) -> int:
    """Return the largest resident size since the mark was reset, or ever if it cannot be reset; 0 if unknown."""
    return _status("VmHWM", process) or (0 if process else _max_rss())


def _proc(process: int | None) -> Path:
    return Path("/proc") / str(process or "self")


def _status(key: str, process: int | None) -> int | None:
    with contextlib.suppress(OSError):
        for line in (_proc(process) / "status").read_text().splitlines():
            name, _, value = line.partition(":")
            if name == key:
                return int(value.split()[0]) * 1024
    return None


def _max_rss() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _RSS_UNIT


def _tree_bytes(root: int) -> int:
    """Return the memory of a process and its descendants; each counts its share of what they have in common (PSS)."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError, IndexError, ValueError):
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
                parents.setdefault(parent, []).append(int(entry.name))
    total, pending = 0, [root]
    while pending:
        process = pending.pop()
        pending += parents.get(process, [])
        with contextlib.suppress(OSError, ValueError):
            text = Path(f"/proc/{process}/smaps_rollup").read_text("ascii", "replace")
            total += sum(int(line.split()[1]) * 1024 for line in text.splitlines() if line.startswith("Pss:"))
    return total
