"""Work on several cores, where threads of one Python process would wait for each other."""

from __future__ import annotations

import errno
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from csplat.system import CAN_FORK

Shared = TypeVar("Shared")
Item = TypeVar("Item")
Result = TypeVar("Result")

#: Whether a process can go on as a copy of this one that has all of its memory.
CAN_COPY = CAN_FORK

_SPAWNED_MAX = 61  # processes of one pool that Windows can wait for

_begun: list[Any] = []  # of a worker process: the function, and what all calls share


def each_apart(
    work: Callable[[Shared, Item], Result], shared: Shared, items: Sequence[Item], workers: int, *, copied: bool = False
) -> Iterator[tuple[Item, Result]]:
    """Call a function for each item, and give each with its result when it is done.

    Args:
        work: a function of a module, called with `shared` and an item.
        shared: what all calls share; they do not see what others do to it.
        items: that can be pickled, as results can.
        workers: processes; 1: none beside this one.
        copied: the processes are copies of this one, where `CAN_COPY`: `shared` is not pickled, and takes no memory.
            They may use no lock that another thread of this process may hold, such as that of a stream.

    Raises:
        OSError: a process was killed.
    """
    if workers == 1 or len(items) < 2:
        for item in items:
            yield item, work(shared, item)
        return
    start = ("fork" if copied else "forkserver") if CAN_COPY else "spawn"
    workers = min(workers, _SPAWNED_MAX) if start == "spawn" else workers
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context(start), _begin, (work, shared))
    try:
        futures = {pool.submit(_call, item): item for item in items}
        for future in as_completed(futures):
            yield futures.pop(future), future.result()
    except BrokenProcessPool:
        raise OSError(errno.ENOMEM, "a worker process was killed, perhaps for want of memory") from None
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(work: Callable[..., Any], shared: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is told, and says what to do
    _begun[:] = [work, shared]


def _call(item: Any) -> Any:
    work, shared = _begun
    return work(shared, item)
