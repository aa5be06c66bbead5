"""Who codes the buckets: this process, several of this machine, or those of a Dask cluster."""

from __future__ import annotations

import errno
import multiprocessing
import signal
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from pathlib import Path
from typing import Any

from csplat.errors import missing
from csplat.large.coding import Bucket, Coding, code_bucket

__all__ = ["code_here", "code_on_cluster"]

_shared: dict[str, Any] = {}  # of a worker process: what all of its buckets share


def code_here(folder: Path, buckets: Sequence[Bucket], coding: Coding, workers: int) -> Iterator[Bucket]:
    """Code buckets on this machine, and give each when it is done.

    Args:
        folder: the working folder.
        buckets: that are not done.
        coding: what was decided.
        workers: processes; 1: none beside this one.

    Raises:
        CsplatError: as of `code_bucket`.
        OSError: likewise; or a process was killed.
    """
    if workers == 1 or len(buckets) < 2:
        for bucket in buckets:
            code_bucket(folder, bucket, coding)
            yield bucket
        return
    context = multiprocessing.get_context("forkserver" if sys.platform == "linux" else "spawn")
    pool = ProcessPoolExecutor(workers, context, _begin, (folder, coding))
    try:
        futures = {pool.submit(_code, bucket): bucket for bucket in buckets}
        for future in as_completed(futures):
            future.result()
            yield futures[future]
    except BrokenProcessPool:
        raise OSError(errno.ENOMEM, "a worker process was killed, perhaps for want of memory", str(folder)) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(folder: Path, coding: Coding) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is told, and says what to do
    _shared.update(folder=folder, coding=coding)


def _code(bucket: Bucket) -> None:
    code_bucket(_shared["folder"], bucket, _shared["coding"])


def code_on_cluster(folder: Path, buckets: Sequence[Bucket], coding: Coding, address: str) -> Iterator[Bucket]:
    """Code buckets on a Dask cluster, whose workers see the working folder under the same name.

    Dask runs again what a lost worker had begun.

    Args:
        folder, buckets, coding: as of `code_here`.
        address: of the scheduler.

    Raises:
        InputError: `dask.distributed` is not installed.
        CsplatError: as of `code_bucket`.
        OSError: likewise; or the scheduler does not answer.
    """
    try:
        distributed: Any = import_module("distributed")  # it has no types
    except ModuleNotFoundError as error:
        raise missing(error, extra="scale") from None
    with distributed.Client(address, set_as_default=False) as client, client.as_current():
        shared = client.scatter(coding, broadcast=True)
        futures = {client.submit(code_bucket, folder, bucket, shared, pure=False): bucket for bucket in buckets}
        for future in distributed.as_completed(list(futures)):
            future.result()
            yield futures[future]
