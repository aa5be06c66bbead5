"""Clocks, and memory: of calls, of calls in a process of their own, of other programs.

Growth is the process's largest resident size during a call, less its size before: on Linux the kernel's high-water mark
is reset before the call; elsewhere what `ru_maxrss` gained is a lower bound.
"""

from __future__ import annotations

import contextlib
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

_PROC = Path("/proc")


@dataclass(frozen=True)
class Timing:
    """Seconds by the clock on the wall, and of all threads together."""

    wall: float
    cpu: float


def timed(call: Callable[P, T], /, *args: P.args, **named: P.kwargs) -> tuple[T, Timing]:
    """Call a function; return its result and the time it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = call(*args, **named)
    return result, Timing(time.perf_counter() - wall, time.process_time() - cpu)


def medians(timings: Sequence[Timing]) -> Timing:
    """The median of either time."""
    return Timing(statistics.median(one.wall for one in timings), statistics.median(one.cpu for one in timings))


def alone(call: Callable[P, T], /, *args: P.args, **named: P.kwargs) -> T:
    """Call a function of a module in a new process: nothing was compiled there yet, and nothing takes memory."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(call, *args, **named).result()


def run_timed(command: Sequence[str], runs: int, cap_seconds: float) -> Timing | None:
    """Run another program and take medians; `None` if a run reached the cap. CPU seconds include its children.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    timings = []
    for _ in range(runs):
        before, start = os.times(), time.perf_counter()
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=cap_seconds)
        except subprocess.TimeoutExpired:
            return None
        wall, after = time.perf_counter() - start, os.times()
        cpu = after.children_user + after.children_system - before.children_user - before.children_system
        timings.append(Timing(wall, cpu))
    return medians(timings)


def reset_peak(process: int | None = None) -> int:
    """Reset the high-water mark if the kernel allows it; return the size before the call, bytes.

    Args:
        process: its number; this one if left out. Of another nothing but 0 is known if there is no /proc.
    """
    with contextlib.suppress(OSError):
        (_of(process) / "clear_refs").write_text("5")
        resident = _status("VmRSS", process)
        if resident is not None and _status("VmHWM", process) is not None:
            return resident
    return 0 if process else _max_rss()


def peak_bytes(process: int | None = None) -> int:
    """Largest resident size since the mark was reset, or ever if it cannot be reset."""
    return _status("VmHWM", process) or (0 if process else _max_rss())


def _of(process: int | None) -> Path:
    return _PROC / str(process or "self")


def _status(key: str, process: int | None) -> int | None:
    with contextlib.suppress(OSError):
        for line in (_of(process) / "status").read_text().splitlines():
            name, _, value = line.partition(":")
            if name == key:
                return int(value.split()[0]) * 1024
    return None


def _max_rss() -> int:
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
