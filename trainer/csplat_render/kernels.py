"""Compile kernels with numba by typed decorators, and run them on threads."""

from __future__ import annotations

import errno
import math
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

import numba as typed_numba
import numpy as np
from numba import extending as typed_extending
from numba.core import caching as typed_caching
from numba.core import compiler as typed_compiler
from numba.core import event as typed_event

from csplat.errors import InputError

# Typed as Any because numba's own types differ between versions.
numba: Any = typed_numba
extending: Any = typed_extending
caching: Any = typed_caching
compiler: Any = typed_compiler
event: Any = typed_event

P = ParamSpec("P")
R = TypeVar("R")

#: Held by the caller whose kernel the threads run.
LOCK = threading.RLock()

# Bytes of all arrays; smaller work runs on one thread, because waking threads takes 80 µs.
_SERIAL_BYTES = 1 << 17

# Without nnan and ninf, because the kernels test for NaN and infinity.
_LN2 = math.log(2.0)
_RELAXED = {"reassoc", "nsz", "arcp", "contract", "afn"}


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a single-threaded kernel with strict IEEE arithmetic."""
    compiled: Callable[P, R] = _compile(function)
    return compiled


def device_function(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small function that kernels call; if LLVM inlines it, it uses the kernel's arithmetic."""
    compiled: Callable[P, R] = _compile(function, inline="never")
    return compiled


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Inline a few lines into the calling kernels before compilation so that their loops still vectorise."""
    copied: Callable[P, R] = numba.njit(function, inline="always", nogil=True, error_model="numpy")
    return copied


def relaxed_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a single-threaded kernel with relaxed arithmetic (reassociation, contraction), for loops over pixels."""
    compiled: Callable[P, R] = _compile(function, fastmath=_RELAXED)
    return compiled


def cache_failure() -> str:
    """Return why kernels that this process compiles are not kept for the next run; "" if they are."""
    return _failures[-1] if _failures else ""


_failures: list[str] = []  # reasons why numba's cache could not be used


def _compile(function: Any, **options: Any) -> Any:
    """Return a function that numba compiles at its first call for each signature, and keeps on disk if possible.

    If there is no folder for the cache, the reason is added to `_failures`.
    """
    compiled = numba.njit(function, nogil=True, error_model="numpy", **options)
    try:
        compiled._cache = _KernelCache(function)  # noqa: SLF001  # `cache=True` raises if there is no folder
    except (RuntimeError, OSError):
        _failures.append("no folder for numba's cache can be written")
    return compiled


class _UserCacheLocator(caching.UserWideCacheLocator):  # type: ignore[misc]  # numba's types differ between versions
    """A locator of numba's cache in the user's home that refuses a relative path, as results if there is no home."""

    def ensure_cache_path(self) -> None:
        """Create the folder.

        Raises:
            OSError: it cannot be created, or there is no home.
        """
        if not Path(self.get_cache_path()).is_absolute():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), self.get_cache_path())
        super().ensure_cache_path()


class _CacheFiles(caching.FunctionCache._impl_class):  # type: ignore[misc]  # noqa: SLF001  # as above
    """The files of a kernel's cache. Knows the folders that are tried for them."""

    _locator_classes = [  # noqa: RUF012  # numba's
        _UserCacheLocator if locator is caching.UserWideCacheLocator else locator
        for locator in caching.FunctionCache._impl_class._locator_classes  # noqa: SLF001
    ]


class _KernelCache(caching.FunctionCache):  # type: ignore[misc]  # numba's types differ between versions
    """A kernel in numba's cache. Files that are damaged or cannot be accessed cost a compilation, not the run."""

    _impl_class = _CacheFiles

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load a compiled version of the kernel; `None` if there is none, or if the files are unusable."""
        try:
            return super().load_overload(sig, target_context)
        except OSError as error:
            self._give_up(error)
        except Exception:  # noqa: BLE001  # unpickling a damaged file raises anything
            self._repair()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save a compiled version of the kernel, if possible."""
        try:
            super().save_overload(sig, data)
        except Exception as error:  # noqa: BLE001  # the kernel works without
            self._give_up(error)

    def _repair(self) -> None:
        """Replace a damaged index by an empty index, so that compiled versions can be saved again."""
        try:
            self.flush()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: Exception) -> None:
        """Use the files no more, and note why."""
        self.disable()
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error) or type(error).__name__
        _failures.append(f"numba's cache in {self.cache_path}: {reason}")


@dataclass(frozen=True, eq=False)
class ParallelKernel(Generic[P]):
    """A kernel that every thread calls once; callers omit its first two arguments, lane and number of lanes.

    It runs on Python threads instead of numba's `prange`, which compiles a kernel four times: as the written function,
    as two wrappers, and as part of its caller. A call takes 10 µs longer, compilation takes half the time.

    Attributes:
        compiled: the compiled function; its arguments are lane, number of lanes, and the arguments of the call.
    """

    compiled: Any

    @property
    def signatures(self) -> list[Any]:
        """Signatures for which the kernel is compiled."""
        signatures: list[Any] = self.compiled.signatures
        return signatures

    def __call__(self, *arguments: P.args, **named: P.kwargs) -> None:
        """Run the kernel on the threads set by `thread_count`, by default a single thread if arrays are small; wait."""
        assert not named
        with LOCK:
            _threads.run(self.compiled, arguments)


class _NoAliasCompiler(compiler.Compiler):  # type: ignore[misc]  # numba's types differ between versions
    """A compiler for kernels whose arrays do not overlap, which allows more loops to be vectorised."""

    def define_pipelines(self) -> Any:
        """Return numba's pipelines after setting the noalias flag."""
        self.state.flags.noalias = True
        return super().define_pipelines()


def parallel_kernel(
    *, relaxed: bool = False
) -> Callable[[Callable[Concatenate[int, int, P], None]], ParallelKernel[P]]:
    """Compile a function that does one lane of the work; its first arguments are the lane and the number of lanes.

    Its arrays must not overlap.

    Args:
        relaxed: use relaxed arithmetic, see `relaxed_kernel`.
    """
    options: dict[str, Any] = {"fastmath": _RELAXED} if relaxed else {}

    def decorate(function: Callable[Concatenate[int, int, P], None]) -> ParallelKernel[P]:
        return ParallelKernel(_compile(function, pipeline_class=_NoAliasCompiler, **options))

    return decorate


class _FirstCompilation(event.Listener):  # type: ignore[misc]  # numba's types differ between versions
    """A listener that calls a function when the first kernel is compiled."""

    def __init__(self, call: Callable[[], object]) -> None:
        self._call, self._called = call, False

    def on_start(self, event: Any) -> None:  # noqa: ARG002  # numba's
        """Call the function, unless it was called before."""
        if not self._called:
            self._called = True
            self._call()

    def on_end(self, event: Any) -> None:
        """Do nothing."""


@contextmanager
def on_compiling(call: Callable[[], object]) -> Iterator[None]:
    """Within the context, call a function when a kernel is first compiled rather than loaded from numba's cache."""
    with event.install_listener("numba:compile", _FirstCompilation(call)):
        yield


def fast_exp2(x: float) -> float:
    """Return 2**x for x < 128: in float32 by a polynomial (relative error 2e-7) that vectorises, in float64 exactly."""
    return math.exp(x * _LN2)


def _fast_exp2(x: Any) -> Callable[[Any], Any]:
    """Return the implementation of `fast_exp2` for a type of numba: a polynomial for float32, else exp."""

    def exact(x: Any) -> Any:
        """Return 2**x."""
        return math.exp(x * _LN2)

    if x != numba.types.float32:
        return exact

    lowest = np.float32(-120.0)  # smaller x count as this, so that the result's exponent does not underflow
    half = np.float32(0.5)
    # 2**x = 2**n · 2**f with n an integer and |f| <= 1/2; 2**f = Σ c_k f**k, fitted for minimal relative error.
    c0, c1, c2 = np.float32(1.0000001353333114), np.float32(0.6931468253392489), np.float32(0.24021906575261626)
    c3, c4, c5 = np.float32(0.05550791318132806), np.float32(0.009684186484357147), np.float32(0.0013275470569714626)

    def polynomial(x: Any) -> Any:
        t = x if x > lowest else lowest
        whole = np.int32(t - half)
        f = t - np.float32(whole)
        power = np.float32(c0 + f * (c1 + f * (c2 + f * (c3 + f * (c4 + f * c5)))))
        # Multiply by 2**n by adding n to the exponent bits.
        return np.int32(power.view(np.int32) + (whole << np.int32(23))).view(np.float32)

    return polynomial


extending.overload(fast_exp2, jit_options={"fastmath": _RELAXED}, inline="always")(_fast_exp2)


@device_function
def lane_range(lane: int, lanes: int, count: int) -> tuple[int, int]:
    """Return the range of a lane's share of `count` items."""
    return count * lane // lanes, count * (lane + 1) // lanes


def available_threads() -> int:
    """Return the maximum number of threads for kernels: the processors of this process, or NUMBA_NUM_THREADS."""
    return int(numba.config.NUMBA_NUM_THREADS)


@contextmanager
def thread_count(threads: int | None) -> Iterator[int]:
    """Set the number of threads for kernels within the context, for one caller at a time.

    Within the context, waiting for another thread that calls a kernel is a deadlock.

    Args:
        threads: number of threads, at least 1, limited to `available_threads`; `None`: unchanged. Initially kernels use
            all threads, or a single thread if arrays are small.

    Yields:
        The maximum number of threads in use.

    Raises:
        InputError: `threads` is below 1.
    """
    if threads is not None and threads < 1:
        raise InputError(f"threads is {threads}, expected 1 or more")
    with LOCK:
        before = _threads.limit
        if threads is not None:
            _threads.limit = min(threads, available_threads())
        try:
            yield _threads.limit or available_threads()
        finally:
            _threads.limit = before


class _HelperThread:
    """A thread that sleeps until it gets a call to make. Owns two locks, which wake it twice as fast as a queue."""

    def __init__(self) -> None:
        self._begun, self._ended = threading.Lock(), threading.Lock()
        self._begun.acquire()
        self._ended.acquire()
        self._job: tuple[Any, tuple[Any, ...]] = (None, ())
        self._error: BaseException | None = None
        threading.Thread(target=self._serve, name="csplat kernel", daemon=True).start()

    def start(self, function: Any, arguments: tuple[Any, ...]) -> None:
        """Start a call; `wait` must be called before the next."""
        self._job = function, arguments
        self._begun.release()

    def wait(self) -> None:
        """Wait for the end of the call, and re-raise its exception."""
        self._ended.acquire()
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _serve(self) -> None:
        """Make the calls of `start` one after the other, for ever, and keep the exception of each for `wait`."""
        while True:
            self._begun.acquire()
            function, arguments = self._job
            self._job = (None, ())
            try:
                function(*arguments)
            except BaseException as error:  # noqa: BLE001  # `wait` raises it again
                self._error = error
            del function, arguments  # frees the buffers before the next call
            self._ended.release()


class _ThreadPool:
    """The threads that run kernels in addition to the calling thread. Owns them and the number of threads to use."""

    def __init__(self) -> None:
        self.limit: int | None = None
        self._helpers: list[_HelperThread] = []

    def run(self, function: Any, arguments: tuple[Any, ...]) -> None:
        """Call `function(lane, lanes, *arguments)` for every lane, lane 0 on this thread, and wait for all.

        The number of lanes is `limit`; without a limit, all available threads, or 1 if the arrays are small. Missing
        helpers are started. An exception of a lane is raised after all lanes have ended; a second interrupt
        ends the wait.
        """
        lanes = self.limit or (1 if _bytes_of(arguments) < _SERIAL_BYTES else available_threads())
        while len(self._helpers) < lanes - 1:
            self._helpers.append(_HelperThread())
        waiting: list[_HelperThread] = []
        try:
            for lane, helper in enumerate(self._helpers[: lanes - 1]):
                helper.start(function, (lane + 1, lanes, *arguments))
                waiting.append(helper)
            function(0, lanes, *arguments)
            while waiting:
                waiting.pop().wait()
        except Exception:
            self._await_lanes(waiting)
            raise
        except BaseException:
            self._await_lanes(waiting)
            self.forget()  # a started helper may be missing in `waiting`: use new threads next time
            raise

    def _await_lanes(self, waiting: list[_HelperThread]) -> None:
        """Wait for lanes that still write into the buffers, ignoring their errors; empties `waiting`."""
        try:
            while waiting:
                with suppress(Exception):
                    waiting.pop().wait()
        except BaseException:
            self.forget()  # a second interrupt: use new threads next time
            raise

    def forget(self) -> None:
        """Abandon the threads."""
        self._helpers = []


def _bytes_of(arguments: tuple[Any, ...]) -> int:
    """Return the size of all arrays among the arguments, bytes."""
    return sum(argument.nbytes for argument in arguments if isinstance(argument, np.ndarray))


def _after_fork() -> None:
    """Reset the lock and the threads in a child process, which does not inherit threads."""
    global LOCK  # noqa: PLW0603  # a thread of the parent may hold it, and would never release it here
    LOCK = threading.RLock()
    _threads.limit = None
    _threads.forget()


_threads = _ThreadPool()
if hasattr(os, "register_at_fork"):  # work at import: forked processes must reset the threads
    os.register_at_fork(after_in_child=_after_fork)
