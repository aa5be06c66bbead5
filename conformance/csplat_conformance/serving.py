"""A decoder in a process of its own that is asked file after file, a line for an answer."""

from __future__ import annotations

import mmap
import os
import queue
import select
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Self

from csplat_conformance.answers import Answer
from csplat_conformance.report import Status

_READ = 1 << 16


class Served:
    """A process that is started when it is first asked, and anew after a crash.

    Args:
        words: its command line.
        timeout: seconds for one file.
        environment: environment of the process; None for ours.
    """

    def __init__(self, words: Sequence[str], timeout: float, environment: Mapping[str, str] | None = None) -> None:
        self._words = words
        self._timeout = timeout
        self._environment = environment
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def ask(self, data: bytes) -> Answer:
        """Decode one file, as floats and as integers."""
        raise NotImplementedError

    def close(self) -> None:
        """Let the process end."""
        if self._process is not None and self._process.stdin:
            self._process.stdin.close()
            try:
                self._process.wait(self._timeout)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            if self._process.stdout:
                self._process.stdout.close()
        self._process = None

    def resident_bytes(self) -> int:
        """Return what the process holds in memory now; 0 if nobody can tell."""
        if self._process is None:
            return 0
        try:
            pages = int(Path(f"/proc/{self._process.pid}/statm").read_text(encoding="ascii").split()[1])
        except OSError:
            return 0
        return pages * mmap.PAGESIZE

    def _answered(self, request: bytes) -> bytes | Answer:
        """Return the line with which the process answers, or what went wrong."""
        began = time.monotonic()
        process = self._started()
        assert process.stdin
        try:
            process.stdin.write(request)
            process.stdin.flush()
            line = self._line(process, began)
        except OSError:  # a broken pipe, which Windows calls an invalid argument
            line = b""
        if line is None:
            self._end(process)
            return Answer(Status.HUNG, f"no answer after {self._timeout:g} s", seconds=time.monotonic() - began)
        if not line.endswith(b"\n"):
            self._end(process)
            return Answer(Status.CRASHED, f"the process ended with status {process.returncode}")
        return line

    def _started(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            self._process = subprocess.Popen(  # noqa: S603 - the decoder's own adapter
                self._words,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=self._environment,
            )
        return self._process

    def _line(self, process: subprocess.Popen[bytes], began: float) -> bytes | None:
        """Return a line, what there is of it when the process ended, or None when it takes too long."""
        assert process.stdout
        if not hasattr(select, "poll"):
            return _line_of_thread(process.stdout, began + self._timeout - time.monotonic())
        line = b""
        while not line.endswith(b"\n"):
            left = began + self._timeout - time.monotonic()
            if left <= 0 or not select.select([process.stdout], [], [], left)[0]:
                return None
            part = os.read(process.stdout.fileno(), _READ)
            if not part:
                return line
            line += part
        return line

    def _end(self, process: subprocess.Popen[bytes]) -> None:
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            try:
                if stream:
                    stream.close()
            except OSError:  # as above
                continue
        self._process = None


def _line_of_thread(stream: IO[bytes], seconds: float) -> bytes | None:
    """Return a line as `Served._line` does. Windows cannot wait for pipes; the thread ends with the process."""
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=lambda: lines.put(stream.readline()), daemon=True).start()
    try:
        return lines.get(timeout=max(0.0, seconds))
    except queue.Empty:
        return None
