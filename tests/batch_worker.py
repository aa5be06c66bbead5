"""A worker of `csplat batch` that is no process, for tests of what batches do."""

import json
import threading

from csplat_tools.cli.batch_protocol import answer


class InThisProcess:
    """Answers as a worker does, without a process. Counts what it ran."""

    ran = 0
    pid = None
    lock = threading.Lock()  # commands replace standard output while they run

    def ask(self, what, **values):
        with InThisProcess.lock:
            InThisProcess.ran += what == "run"
            return answer({"ask": what, **json.loads(json.dumps(values))})

    def close(self):
        pass
