"""Processes that tests start: benchmarks, and programs that are interrupted."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parent.parent / "tools" / "benchmarks"


def bench(topic, *words, check=True):
    """Run `python -m csplat_bench.TOPIC WORDS` in a process of its own."""
    path = os.pathsep.join(filter(None, (str(BENCHMARKS), os.environ.get("PYTHONPATH"))))
    command = [sys.executable, "-m", f"csplat_bench.{topic}", *map(str, words)]
    return subprocess.run(command, check=check, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path})


def heed_interrupts():
    """Make a child process heed SIGINT, also when the tests run in the background of a shell, which ignores it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
