"""Workers that code the buckets: this process, several of this machine, or those of a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from csplat.errors import missing
from csplat.large.coding import Bucket, Coding, code_bucket
from csplat.processes import each_apart


def code_here(folder: Path, buckets: Sequence[Bucket], coding: Coding, workers: int) -> Iterator[Bucket]:
    """Code buckets on this machine, and give each when it is done.

    Args:
        folder: the working folder.
        buckets: the buckets that are not done.
        coding: the decisions that all buckets share.
        workers: number of processes; 1: only this one.

    Raises:
        CsplatError: as in `code_bucket`.
        OSError: likewise; or a process was killed.
    """
    for bucket, _ in each_apart(_code, (folder, coding), buckets, workers):
        yield bucket


def _code(shared: tuple[Path, Coding], bucket: Bucket) -> None:
    folder, coding = shared
    code_bucket(folder, bucket, coding)


def code_on_cluster(folder: Path, buckets: Sequence[Bucket], coding: Coding, address: str) -> Iterator[Bucket]:
    """Code buckets on a Dask cluster, whose workers see the working folder under the same name.

    Dask runs again what a lost worker had begun.

    Args:
        folder, buckets, coding: as in `code_here`.
        address: address of the scheduler.

    Raises:
        InputError: `dask.distributed` is not installed.
        CsplatError: as in `code_bucket`.
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
