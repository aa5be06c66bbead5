"""numba, with types that a type checker understands, and the options that every kernel shares."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

import numba as typed_numba
import numpy as np
from numba import extending as typed_extending
from numba.core import compiler as typed_compiler
from numba.core import event as typed_event

from csplat.errors import InputError

# The types that numba states for itself differ from version to version.
numba: Any = typed_numba
extending: Any = typed_extending
compiler: Any = typed_compiler
event: Any = typed_event

P = ParamSpec("P")
R = TypeVar("R")

#: Held while threads run a kernel, by the one caller that they have.
LOCK = threading.RLock()

# Bytes of arrays below which waking threads (80 µs) takes longer than what one of them does alone.
_SERIAL_BYTES = 1 << 17

# Without nnan and ninf: the kernels test for NaN and infinity, and may meet them.
_LN2 = math.log(2.0)
_RELAXED = {"reassoc", "nsz", "arcp", "contract", "afn"}


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of one thread, in strict IEEE arithmetic."""
    compiled: Callable[P, R] = numba.njit(function, cache=True, nogil=True, error_model="numpy")
    return compiled


def device_function(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small function that kernels call; it takes on their arithmetic."""
    compiled: Callable[P, R] = numba.njit(function, inline="never", cache=True, nogil=True, error_model="numpy")
    return compiled


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Copy a few lines into the kernels that call them, before anything is compiled: loops vectorise all the same."""
    copied: Callable[P, R] = numba.njit(function, inline="always", nogil=True, error_model="numpy")
    return copied


def relaxed_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of one thread that may reassociate and contract: the inside of a loop over pixels."""
    compiled: Callable[P, R] = numba.njit(function, cache=True, nogil=True, error_model="numpy", fastmath=_RELAXED)
    return compiled


@dataclass(frozen=True, eq=False)
class ParallelKernel(Generic[P]):
    """A function that every thread calls once; callers leave out its first two arguments, lane and number of lanes.

    Threads of Python run it, not numba's `prange`: that compiles a kernel four times over, as the function that was
    written, as two wrappers, and as part of their caller. A call costs 10 µs more, and compiling half as much.

    Attributes:
        compiled: the kernel; lane, number of lanes, arguments.
    """

    compiled: Any

    @property
    def signatures(self) -> list[Any]:
        """Signatures that it was compiled for."""
        signatures: list[Any] = self.compiled.signatures
        return signatures

    def __call__(self, *arguments: P.args, **named: P.kwargs) -> None:
        """Run it on as many threads as `thread_count` sets, on one if arrays are small; return when all are done."""
        assert not named
        with LOCK:
            _threads.run(self.compiled, arguments)


class _NoAliasCompiler(compiler.Compiler):  # type: ignore[misc]  # numba's types are those of each version
    """Compiles kernels whose arrays do not overlap: without that many a loop is not vectorised."""

    def define_pipelines(self) -> Any:
        """Return numba's pipelines for this compilation, with its noalias flag set."""
        self.state.flags.noalias = True
        return super().define_pipelines()


def parallel_kernel(
    *, relaxed: bool = False
) -> Callable[[Callable[Concatenate[int, int, P], None]], ParallelKernel[P]]:
    """Compile a function that does one lane of some work, (lane, lanes, ...), and is run for all lanes at once.

    No two of the arrays that it is given may overlap.

    Args:
        relaxed: reassociate and contract, for the loops over pixels.
    """
    options: dict[str, Any] = {"fastmath": _RELAXED} if relaxed else {}

    def decorate(function: Callable[Concatenate[int, int, P], None]) -> ParallelKernel[P]:
        return ParallelKernel(
            numba.njit(
                function, cache=True, nogil=True, error_model="numpy", pipeline_class=_NoAliasCompiler, **options
            )
        )

    return decorate


class _FirstCompilation(event.Listener):  # type: ignore[misc]  # numba's types are those of each version
    """Calls something when the first kernel is compiled. Owns whether that was."""

    def __init__(self, call: Callable[[], object]) -> None:
        self._call, self._called = call, False

    def on_start(self, event: Any) -> None:  # noqa: ARG002  # numba's
        if not self._called:
            self._called = True
            self._call()

    def on_end(self, event: Any) -> None:
        """Nothing is to be done."""


@contextmanager
def on_compiling(call: Callable[[], object]) -> Iterator[None]:
    """Call something once if a kernel is compiled meanwhile: not if all of them come from numba's cache."""
    with event.install_listener("numba:compile", _FirstCompilation(call)):
        yield


def is_cached(kernel: Any) -> bool:
    """Return True if numba holds the kernel compiled, in this process or in its cache."""
    compiled = getattr(kernel, "compiled", kernel)
    if compiled.signatures:
        return True
    # There is no public name for it: the index of the cache, empty if the source is newer.
    load = getattr(getattr(compiled._cache, "_cache_file", None), "_load_index", None)  # noqa: SLF001
    return load is not None and bool(load())


def fast_exp2(x: float) -> float:
    """2**x for x < 128 in kernels: in float32 a polynomial (2e-7) that vectorises, in float64 exact."""
    return math.exp(x * _LN2)


def _fast_exp2(x: Any) -> Callable[[Any], Any]:
    def exact(x: Any) -> Any:
        return math.exp(x * _LN2)

    if x != numba.types.float32:
        return exact

    lowest, half = np.float32(-120.0), np.float32(0.5)
    # 2**f for |f| <= 1/2, fitted for the smallest relative error.
    c0, c1, c2 = np.float32(1.0000001353333114), np.float32(0.6931468253392489), np.float32(0.24021906575261626)
    c3, c4, c5 = np.float32(0.05550791318132806), np.float32(0.009684186484357147), np.float32(0.0013275470569714626)

    def polynomial(x: Any) -> Any:
        t = x if x > lowest else lowest
        whole = np.int32(t - half)
        f = t - np.float32(whole)
        power = np.float32(c0 + f * (c1 + f * (c2 + f * (c3 + f * (c4 + f * c5)))))
        # The whole part of the exponent goes straight into the bits.
        return np.int32(power.view(np.int32) + (whole << np.int32(23))).view(np.float32)

    return polynomial


extending.overload(fast_exp2, jit_options={"fastmath": _RELAXED}, inline="always")(_fast_exp2)


@device_function
def lane_range(lane: int, lanes: int, count: int) -> tuple[int, int]:
    """First and last + 1 of a thread's run of `count` things."""
    return count * lane // lanes, count * (lane + 1) // lanes


def python_function(compiled: Callable[P, R]) -> Callable[P, R]:
    """Return the Python function that was compiled; it accepts arrays in place of a kernel's numbers."""
    function: Callable[P, R] = getattr(compiled, "py_func", compiled)
    return function


def available_threads() -> int:
    """Return the number of threads for kernels: the processors of this process, or NUMBA_NUM_THREADS."""
    return int(numba.config.NUMBA_NUM_THREADS)


@contextmanager
def thread_count(threads: int | None) -> Iterator[int]:
    """Run kernels on this many threads, one caller at a time: a thread that waits inside for another one that calls a
    kernel waits for ever.

    Args:
        threads: 1 or more, no more than there are, whatever there is to do; None for what was said before, at first
            nothing: all, but one where arrays are small.

    Yields:
        The number, at most.

    Raises:
        InputError: `threads` is below 1.
    """
    if threads is not None and threads < 1:
        raise InputError(f"threads is {threads}, wanted 1 or more")
    with LOCK:
        before = _threads.wanted
        if threads is not None:
            _threads.wanted = min(threads, available_threads())
        try:
            yield _threads.wanted or available_threads()
        finally:
            _threads.wanted = before


class _HelperThread:
    """A thread that sleeps until it is given something to call. Owns two locks that take turns.

    Locks wake a thread in half the time that a queue or a future takes.
    """

    def __init__(self) -> None:
        self._begun, self._ended = threading.Lock(), threading.Lock()
        self._begun.acquire()
        self._ended.acquire()
        self._job: tuple[Any, tuple[Any, ...]] = (None, ())
        self._error: BaseException | None = None
        threading.Thread(target=self._serve, name="csplat kernel", daemon=True).start()

    def start(self, function: Any, arguments: tuple[Any, ...]) -> None:
        """Begin a call."""
        self._job = function, arguments
        self._begun.release()

    def wait(self) -> None:
        """Wait for the end of the call, and raise what it raised."""
        self._ended.acquire()
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _serve(self) -> None:
        while True:
            self._begun.acquire()
            function, arguments = self._job
            self._job = (None, ())
            try:
                function(*arguments)
            except BaseException as error:  # noqa: BLE001  # whatever it is, the caller is to have it
                self._error = error
            del function, arguments  # buffers are not to live until the next call
            self._ended.release()


class _ThreadPool:
    """The threads that run kernels, in addition to the calling one. Owns them and the number of threads to use."""

    def __init__(self) -> None:
        self.wanted: int | None = None
        self._helpers: list[_HelperThread] = []

    def run(self, function: Any, arguments: tuple[Any, ...]) -> None:
        """Call `function(lane, lanes, *arguments)` for every lane."""
        lanes = self.wanted or (1 if _bytes_of(arguments) < _SERIAL_BYTES else available_threads())
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
            self._quit(waiting)
            raise
        except BaseException:
            self._quit(waiting)
            self.forget()  # an interrupt may have come between a start and its note: new threads the next time
            raise

    def _quit(self, waiting: list[_HelperThread]) -> None:
        """Wait for lanes that still write into the buffers; what they raise is not the first mistake."""
        try:
            while waiting:
                with suppress(Exception):
                    waiting.pop().wait()
        except BaseException:
            self.forget()  # somebody is in a hurry: new threads the next time
            raise

    def forget(self) -> None:
        """Leave the threads to themselves."""
        self._helpers = []


def _bytes_of(arguments: tuple[Any, ...]) -> int:
    """Return the size of all arrays together."""
    return sum(one.nbytes for one in arguments if isinstance(one, np.ndarray))


def _after_fork() -> None:
    """A child has no other threads: nobody holds the lock, and there are no helpers."""
    global LOCK  # noqa: PLW0603  # it may be held for ever by a thread that is not there
    LOCK = threading.RLock()
    _threads.wanted = None
    _threads.forget()


_threads = _ThreadPool()
if hasattr(os, "register_at_fork"):  # work at import, because nobody else would tell a child that it has no threads
    os.register_at_fork(after_in_child=_after_fork)
