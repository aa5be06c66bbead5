# SPDX-License-Identifier: Apache-2.0
"""Provide operating-system services on every platform: files, memory, locks, signals and processes.

Checks of `sys.platform` are for type checkers; `hasattr` decides whether a system has a call.
"""

from __future__ import annotations

import errno
import mmap
import os
import shlex
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

#: True if a process may be forked. On macOS, system libraries are unsafe after a fork.
CAN_FORK = sys.platform == "linux" and hasattr(os, "fork")

_SHARE = 0.5  # fraction of the free memory that a command uses; the rest is for other programs
_STATUS_OF_SIGNAL = 128  # exit status of a process that a signal ends, apart from the number of the signal
_UNKNOWN = 4 << 30  # bytes assumed if the system does not report its memory
#: Files with limit and usage of the control group, versions 2 and 1.
_LIMITS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)
_SPAWNED_MAX = 61  # maximum number of processes that Windows can wait for

Shared = TypeVar("Shared")
Item = TypeVar("Item")
Result = TypeVar("Result")

_reading = threading.Lock()  # without pread, seek and read are two calls
_task: list[Any] = []  # set in worker processes only: [function, shared value]


def core_count() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading. A pipe or a device, whose reader may wait forever, is refused unread.

    Raises:
        OSError: the file cannot be opened, or is not a regular file.
    """
    flags = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
    descriptor = os.open(path, flags)  # does not wait for the writer of a pipe
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", os.fspath(path))
        return os.fdopen(descriptor, "rb")
    except OSError:
        os.close(descriptor)
        raise


def take_permissions(descriptor: int, old: os.stat_result) -> None:
    """Give a file the permissions, and if possible owner and group, of the file that it replaces.

    A file in another group gives that group only the rights of all others, because the group may have had no more.
    """
    if sys.platform == "win32" or not hasattr(os, "fchown"):
        return
    for owner, group in ((-1, old.st_gid), (old.st_uid, -1)):
        with suppress(OSError):
            os.fchown(descriptor, owner, group)
    new, mode = os.fstat(descriptor), stat.S_IMODE(old.st_mode)
    if new.st_gid != old.st_gid:
        mode = mode & ~stat.S_IRWXG | (mode & stat.S_IRWXO) << 3
    if (new.st_uid, new.st_gid) != (old.st_uid, old.st_gid):
        mode &= ~(stat.S_ISUID | stat.S_ISGID)
    with suppress(OSError):  # a file system without permissions
        os.fchmod(descriptor, mode)


def read_at(descriptor: int, size: int, offset: int) -> bytes:
    """Read from an offset of a file, fewer bytes at its end. Thread-safe.

    Raises:
        OSError: the file cannot be read.
    """
    if sys.platform != "win32" and hasattr(os, "pread"):
        return os.pread(descriptor, size, offset)
    with _reading:  # Windows
        os.lseek(descriptor, offset, os.SEEK_SET)
        return os.read(descriptor, size)


def read_into(descriptor: int, buffer: memoryview, offset: int) -> int:
    """Read from an offset of a file into a buffer; return the number of bytes read, 0 at the end of the file.

    Raises:
        OSError: the file cannot be read.
    """
    if sys.platform != "win32" and hasattr(os, "preadv"):
        return os.preadv(descriptor, [buffer], offset)
    data = read_at(descriptor, len(buffer), offset)
    buffer[: len(data)] = data
    return len(data)


class Pages:
    """Zeroed memory whose pages take space only once written, if the system supports it.

    Attributes:
        buffer: the memory.

    Args:
        size_bytes: size, at least 1.

    Raises:
        OSError, OverflowError: the address space is too small.
    """

    def __init__(self, size_bytes: int) -> None:
        if sys.platform != "win32" and hasattr(mmap, "MAP_ANONYMOUS"):
            flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | getattr(mmap, "MAP_NORESERVE", 0)
            self.buffer = mmap.mmap(-1, size_bytes, flags=flags)
        else:  # Windows reserves all of it in the page file
            self.buffer = mmap.mmap(-1, size_bytes)

    def discard(self) -> None:
        """Return the memory to the system if possible; the content is undefined afterwards."""
        if hasattr(self.buffer, "madvise") and hasattr(mmap, "MADV_DONTNEED"):
            self.buffer.madvise(mmap.MADV_DONTNEED)


def split_words(command: str, *, is_posix: bool = os.sep == "/") -> list[str]:
    """Split a command line into words as a shell does. On Windows the backslash is not an escape character.

    Raises:
        ValueError: a quote is not closed.
    """
    lexer = shlex.shlex(command, posix=True, punctuation_chars=False)
    lexer.whitespace_split, lexer.commenters = True, ""
    if not is_posix:
        lexer.escape = ""
    return list(lexer)


def kill_group(process: subprocess.Popen[Any]) -> None:
    """Kill a process and, on POSIX, its children; it must have been started with `start_new_session`."""
    if sys.platform != "win32" and hasattr(os, "killpg"):
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.wait()


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold back SIGINT in this thread. Processes started within the context never receive it, except on Windows."""
    if sys.platform == "win32" or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def interrupts_noted(*numbers: int) -> Iterator[list[int]]:
    """Note signals in a list, and raise them only at the end: callbacks and destructors swallow KeyboardInterrupt.

    A second signal acts at once.

    Args:
        numbers: the signals; default: SIGINT.

    Yields:
        Numbers of the signals that arrived.

    Raises:
        KeyboardInterrupt: SIGINT arrived.
        SystemExit: another signal arrived; the status is that of a process that it ends.
    """
    noted = list[int]()
    # Only the main thread can set a handler. None is a handler that was not set from Python, and cannot be restored.
    usual = {number: signal.getsignal(number) for number in numbers or (signal.SIGINT,)}
    if threading.current_thread() is not threading.main_thread():
        usual = {}
    usual = {number: handler for number, handler in usual.items() if handler not in (None, signal.SIG_IGN)}

    def note(number: int, _: object) -> None:
        noted.append(number)
        signal.signal(number, usual[number])

    for number in usual:
        signal.signal(number, note)
    try:
        yield noted
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
    if signal.SIGINT in noted:
        raise KeyboardInterrupt
    if noted:
        raise SystemExit(_STATUS_OF_SIGNAL + noted[0])


def available_memory_bytes() -> int:
    """Return the free memory of the machine or of the process's control group, whichever is less."""
    free = [_free_machine_bytes()]
    for limit, current in _LIMITS:
        with suppress(OSError, ValueError):
            free.append(int(Path(limit).read_text("ascii")) - int(Path(current).read_text("ascii")))
    return max(0, min(free))


def default_memory_bytes() -> int:
    """Return the memory that a command uses by default: half of the free memory."""
    return int(_SHARE * available_memory_bytes())


def _free_machine_bytes() -> int:
    """Return the available memory of the machine in bytes.

    Without /proc/meminfo, half of the physical memory counts as available; `_UNKNOWN` if that is unknown, too.
    """
    with suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text("ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    with suppress(ValueError, OSError):
        if sys.platform != "win32" and hasattr(os, "sysconf"):
            return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    return _UNKNOWN


def map_in_processes(
    work: Callable[[Shared, Item], Result], shared: Shared, items: Sequence[Item], workers: int
) -> Iterator[tuple[Item, Result]]:
    """Call a function for each item in worker processes; yield (item, result) in order of completion.

    Args:
        work: a top-level function, called with `shared` and an item.
        shared: a value for all calls, not to be modified.
        items: arguments; items and results must be picklable.
        workers: number of processes; 1 runs everything in this process.

    Raises:
        OSError: a worker process was killed, or the system has no semaphores.
    """
    if workers == 1 or len(items) < 2:
        for item in items:
            yield item, work(shared, item)
        return
    import multiprocessing  # with its queues 20 ms of every start; hardly any command has worker processes
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from concurrent.futures.process import BrokenProcessPool

    start = "forkserver" if CAN_FORK else "spawn"
    workers = min(workers, _SPAWNED_MAX) if start == "spawn" else workers
    with semaphore_errors_named():
        pool = ProcessPoolExecutor(workers, multiprocessing.get_context(start), _begin_worker, (work, shared))
    try:
        futures = {pool.submit(_call_in_worker, item): item for item in items}
        for future in as_completed(futures):
            yield futures.pop(future), future.result()
    except BrokenProcessPool:
        raise OSError(errno.ENOMEM, "a worker process was killed, perhaps for lack of memory") from None
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def semaphore_errors_named() -> Iterator[None]:
    """Say what is missing if a pool of processes cannot be made, of which Python says `Permission denied` alone.

    Raises:
        OSError: the system has no semaphores for processes.
    """
    try:
        yield
    except (PermissionError, FileNotFoundError) as error:
        where = "/dev/shm is not writable" if sys.platform == "linux" else "there are none"  # noqa: S108  # a message
        raise OSError(error.errno, f"worker processes need semaphores, but {where}: {error.strerror}") from None


def _begin_worker(work: Callable[..., Any], shared: Any) -> None:
    """Set up a worker process: ignore SIGINT and keep the arguments that all calls share in `_task`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent receives it and ends its workers
    _task[:] = [work, shared]


def _call_in_worker(item: Any) -> Any:
    """Return the result for an item, in a worker process that `_begin_worker` has set up."""
    work, shared = _task
    return work(shared, item)
