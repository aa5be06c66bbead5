"""The command line in the process of the tests, a batch worker without a process, and SIGINT in child processes."""

from __future__ import annotations

import json
import signal
import threading

from typer.testing import CliRunner

from csplat_tools.cli.app import app
from csplat_tools.cli.batch_protocol import answer


def invoke(*words):
    """Run `csplat WORDS` and return the result, with its output and exit code."""
    return CliRunner().invoke(app, [str(word) for word in words])


def call(*words, status=0):
    """Run `csplat WORDS`, assert its exit status, and return the result."""
    result = invoke(*words)
    assert status == result.exit_code, (result.output, result.exception)
    return result


class InThisProcess:
    """A worker of `csplat batch` without a process, which counts its runs."""

    ran = 0
    pid = None
    lock = threading.Lock()  # commands replace standard output while they run

    def ask(self, what, **values):
        with InThisProcess.lock:
            InThisProcess.ran += what == "run"
            return answer({"ask": what, **json.loads(json.dumps(values))})

    def close(self):
        pass


def heed_interrupts():
    """Restore SIGINT in a child process: a shell that runs the tests in the background makes it ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
