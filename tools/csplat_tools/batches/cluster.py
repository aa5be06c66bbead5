"""A batch on a Dask cluster: each scene is a task, run in a process of its own next to that of Dask's worker."""

from __future__ import annotations

import threading
from asyncio import CancelledError
from collections.abc import Generator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any
from uuid import uuid4

from csplat.errors import missing
from csplat_tools.batches.records import Record
from csplat_tools.batches.scene import Job, do_job
from csplat_tools.batches.workers import Worker

_here = threading.local()  # holds the process of each thread of a Dask worker; it ends with the worker


def on_cluster(jobs: Sequence[Job], dask: Any) -> Generator[tuple[Record, bool], None, None]:
    """Process scenes on a cluster; yield the record of each when it ends, and whether anything was done.

    Dask moves the scenes of a lost machine to others, a limited number of times.

    Args:
        jobs: scenes, under paths that all machines have.
        dask: the address of a scheduler, or a client.

    Raises:
        InputError: Dask is not installed.
        OSError: there is no scheduler.
    """
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise missing(error, "dask[distributed]", extra="scale") from None
    dasks: Any = distributed  # the package has no types
    with dasks.Client(dask, set_as_default=False) if isinstance(dask, str) else nullcontext(dask) as client:
        run = uuid4().hex  # Dask identifies tasks by name; those of an earlier batch must not be taken for these
        tasks = {client.submit(_do, job, key=f"{job.task.output}-{run}"): job for job in jobs}
        try:
            for future in dasks.as_completed(list(tasks), loop=client.loop):
                yield _result(future, tasks[future])
        finally:
            client.cancel(list(tasks))


def _do(job: Job) -> tuple[Record, bool]:
    if not hasattr(_here, "worker"):
        _here.worker = Worker()
    return do_job(job, _here.worker)


def _result(future: Any, job: Job) -> tuple[Record, bool]:
    try:
        record, worked = future.result()
    except (Exception, CancelledError) as error:  # noqa: BLE001  # any error of a task that the cluster gave up
        words = " ".join(str(error).split()) or type(error).__name__
        return replace(job.record, code="E_CLUSTER", error=words), True
    return record, worked
