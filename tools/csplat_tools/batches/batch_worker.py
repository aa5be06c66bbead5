"""Worker processes that run commands one after the other; a crash of one leaves the rest of the batch running."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from csplat.errors import CsplatError
from csplat.system import NEW_GROUP_FLAGS, interrupt_process

#: The program of a process, started by its name: `cli` is above this package and may not be imported here.
_PROGRAM = "csplat_tools.cli.batch_protocol"
_PATIENCE = 10.0  # seconds that an interrupted process has to tidy up before it is killed

Process = subprocess.Popen[str]


class WorkerLostError(CsplatError):
    """A process ended before it answered. Its text tells how, in a few words."""

    code = "E_WORKER"


class Worker:
    """A process that is started with the first request, and again after it was lost. Owns the process.

    Requests come from one thread; `close` may be called by another.
    """

    def __init__(self) -> None:
        self._process: Process | None = None
        self._said = TemporaryFile()  # noqa: SIM115  # as long as this object
        self._lock = threading.Lock()
        self._closed = False

    def ask(self, what: str, **values: Any) -> dict[str, Any]:
        """Send a request, and return the answer of `csplat_tools.cli.batch_protocol.answer`.

        Raises:
            WorkerLostError: the process ended, or was closed. Files that it had begun to write remain, see `pid`.
        """
        process = self._started()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps({"ask": what, **values}) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except (BrokenPipeError, ValueError):
            line = ""
        if not line.endswith("\n"):
            raise WorkerLostError(self._lost(process))
        answer: dict[str, Any] = json.loads(line)
        return answer

    @property
    def pid(self) -> int | None:
        """Number of the process, or of the one that was lost last; names of its temporary files contain it."""
        return None if self._process is None else self._process.pid

    def close(self) -> None:
        """End the process, which has some seconds to remove unfinished files. No request is possible any more."""
        with self._lock:
            self._closed = True
            _end(self._process)
            self._said.close()

    def _started(self) -> Process:
        with self._lock:
            if self._closed:
                raise WorkerLostError("closed")
            if self._process is None or self._process.poll() is not None:
                _end(self._process)
                self._process = subprocess.Popen(  # noqa: S603  # this interpreter
                    [sys.executable, "-m", _PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._said,
                    encoding="utf-8", start_new_session=True,  # an interrupt at the terminal is for the parent alone
                    creationflags=NEW_GROUP_FLAGS,
                )  # fmt: skip
            return self._process

    def _lost(self, process: Process) -> str:
        """Describe how a process ended, with the last line of its standard error."""
        status = process.wait()
        with self._lock:
            if self._closed:
                return "closed"
            self._said.seek(0)
            said = self._said.read().decode(errors="replace").strip().splitlines()[-1:]
        if status >= 0:
            return ": ".join([f"its process ended with status {status}", *said])
        name = signal.Signals(-status).name if -status in set(signal.Signals) else str(-status)
        return f"its process was ended by {name}" + ("; was memory short?" if name == "SIGKILL" else "")


def _end(process: Process | None) -> None:
    """End a process, and close the pipes to it."""
    if process is None:
        return
    interrupt_process(process)
    try:
        process.wait(_PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):  # data that could not be sent to it
                pipe.close()


def remove_left(output: Path, pid: int) -> None:
    """Remove temporary files that a lost process had begun to write for an output; see `atomic_writer`."""
    for left in output.parent.glob(f".*.{pid}.*.tmp"):
        if left.name.startswith(f".{output.name}."):
            left.unlink(missing_ok=True)
