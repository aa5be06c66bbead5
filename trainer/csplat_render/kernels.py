# SPDX-License-Identifier: Apache-2.0
"""Call the functions of the compiled library `native`, on threads.

No result depends on the number of threads; nor, for finite numbers, on the instruction set of the processor.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from csplat.errors import InputError

#: Environment variable with the name of an instruction set to use instead of the fastest, for tests.
SET_VARIABLE = "CSPLAT_INSTRUCTION_SET"

#: Environment variable with the folder of another library, such as one with sanitizers, for tests.
FOLDER_VARIABLE = "CSPLAT_NATIVE_FOLDER"

#: Instruction sets, the fastest first.
INSTRUCTION_SETS = ("avx512", "avx2", "neon")

_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")


def call(name: str, *arguments: Any) -> int:
    """Call a function of the library that runs on threads, and wait.

    Args:
        name: name of the function, without `csplat_`.
        arguments: C-contiguous arrays, structures of `ctypes`, pointers, integers and floats; `None` is a null pointer.
            The number of threads is put in front of them.

    Returns:
        The result of the function, at least 0.

    Raises:
        InputError: the library is missing, or does not support this processor.
        MemoryError: there is not enough memory.
    """
    result = int(_function(name)(ctypes.c_int64(_limit()), *map(_argument, arguments)))
    if result < 0:
        raise MemoryError("the renderer found not enough memory")
    return result


def create(kind: str) -> ctypes.c_void_p:
    """Create an object of the library, for `call`; raises the errors of `call`."""
    function = getattr(_library()[1], f"csplat_new_{kind}")
    function.restype = ctypes.c_void_p
    handle = function()
    if not handle:
        raise MemoryError("the renderer found not enough memory")
    return ctypes.c_void_p(handle)


def destroy(kind: str, handle: ctypes.c_void_p) -> None:
    """Free an object of the library."""
    getattr(_library()[1], f"csplat_delete_{kind}")(handle)


def require_library() -> str:
    """Load the library, and return the name of its instruction set.

    Raises:
        InputError: the library is missing, or does not support this processor.
    """
    return _library()[0]


def address(array: np.ndarray[Any, Any] | None) -> int:
    """Return the address of a C-contiguous array; 0 for `None`."""
    if array is None:
        return 0
    assert array.flags.c_contiguous
    return int(array.ctypes.data)


def available_threads() -> int:
    """Return the number of processors of this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def thread_count(threads: int | None) -> Iterator[int]:
    """Set the number of threads for calls by this thread within the context.

    Args:
        threads: number of threads, at least 1, limited to `available_threads`; `None`: unchanged, initially all.

    Yields:
        The number of threads in use.

    Raises:
        InputError: `threads` is below 1.
    """
    if threads is not None and threads < 1:
        raise InputError(f"threads is {threads}, expected 1 or more")
    before = getattr(_local, "limit", None)
    if threads is not None:
        _local.limit = min(threads, available_threads())
    try:
        yield _limit()
    finally:
        _local.limit = before


_local = threading.local()


def _limit() -> int:
    """Return the number of threads for calls by this thread."""
    limit: int = getattr(_local, "limit", None) or available_threads()
    return limit


def _argument(value: Any) -> Any:
    """Convert an argument for C."""
    if isinstance(value, np.ndarray):
        return ctypes.c_void_p(address(value))
    if isinstance(value, (bool, int, np.integer, np.bool_)):
        return ctypes.c_int64(int(value))
    if isinstance(value, (float, np.floating)):
        return ctypes.c_double(float(value))
    if isinstance(value, ctypes.Structure):
        return ctypes.byref(value)
    return value


@cache
def _function(name: str) -> Any:
    """Return a function of the library."""
    try:
        function = getattr(_library()[1], f"csplat_{name}")
    except AttributeError:
        raise InputError("the compiled renderer is out of date: run trainer/csplat_render/native/build.py") from None
    function.restype = ctypes.c_int64
    return function


@cache
def _library() -> tuple[str, ctypes.CDLL]:
    """Load the library for the fastest instruction set of the processor, and return both."""
    folder = Path(os.environ.get(FOLDER_VARIABLE) or Path(__file__).parent / "native")
    wanted = os.environ.get(SET_VARIABLE)
    paths = {name: folder / f"csplat_native_{name}{_SUFFIX}" for name in ([wanted] if wanted else INSTRUCTION_SETS)}
    paths = {name: path for name, path in paths.items() if path.exists()}
    for name, path in paths.items():
        try:
            library = ctypes.CDLL(str(path))
        except OSError as error:
            raise InputError(f"the compiled renderer cannot be loaded: {error}") from None
        if library.csplat_supported():
            if hasattr(os, "register_at_fork"):
                os.register_at_fork(after_in_child=library.csplat_forget_threads)
            return name, library
    if wanted:
        raise InputError(f"{SET_VARIABLE} is {wanted!r}, expected one that this installation and processor have")
    if paths:
        raise InputError("the renderer requires a processor with AVX2 and FMA (x86-64-v3), or with NEON")
    raise InputError(
        "this installation of csplat has no compiled renderer: install a wheel for this platform, or a C++ compiler "
        "and csplat again"
    )
