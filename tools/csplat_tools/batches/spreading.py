"""Distribute scenes over the processes of this machine."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from csplat.remote import is_url
from csplat_tools.batches.scene import Job
from csplat_tools.batches.workers import Worker
from csplat_tools.files.scenes import size_of

T = TypeVar("T")


def spread(
    jobs: Sequence[Job],
    workers: Sequence[Worker],
    do: Callable[[Job, Worker], T],
    stop: Callable[[], object] = lambda: None,
) -> Generator[T, None, None]:
    """Process jobs, the largest first, and yield each result; the processes end with the generator, or its closing.

    Args:
        jobs: the scenes.
        workers: the processes, each with a thread; as many scenes are processed at a time.
        do: called by a thread with a scene and the thread's process.
        stop: called when the generator ends.
    """
    todo: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
    ended: queue.SimpleQueue[T | Exception] = queue.SimpleQueue()
    for job in (*sorted(jobs, key=source_bytes, reverse=True), *[None] * len(workers)):
        todo.put(job)
    stopped = threading.Event()

    def work(worker: Worker) -> None:
        while (job := todo.get()) is not None and not stopped.is_set():
            try:
                ended.put(do(job, worker))
            except Exception as error:  # noqa: BLE001  # a defect of csplat, raised in the thread that waits
                ended.put(error)

    with ThreadPoolExecutor(len(workers)) as pool:
        try:
            for worker in workers:
                pool.submit(work, worker)
            for _ in jobs:
                one = ended.get()
                if isinstance(one, Exception):
                    raise one
                yield one
        finally:
            stopped.set()
            stop()
            ends = [threading.Thread(target=one.close) for one in workers]
            for thread in ends:
                thread.start()
            for thread in ends:
                thread.join()


def source_bytes(job: Job) -> int:
    """Return the size of a source in bytes; 0 if it is a URL or cannot be read."""
    with suppress(OSError):
        return 0 if is_url(job.task.source) else size_of(Path(job.task.source))
    return 0
