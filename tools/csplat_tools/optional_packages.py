# SPDX-License-Identifier: Apache-2.0
"""Load the renderer and optional packages, or raise an error with the remedy; describe the machine."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import csplat
from csplat._spec import VERSION_MAJOR, VERSION_MINOR
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import missing_package
from csplat.system import core_count
from csplat_render.kernels import require_library

_SPIN_COUNT = "1000"  # see `_limit_spinning`


def require_renderer() -> None:
    """Load the renderer, to fail early.

    Raises:
        InputError: it is not installed, or does not support this processor.
    """
    require_library()


def require_trainer(*, plots: bool = False) -> None:
    """Import the packages for training on the CPU (not torch), and limit how long OpenMP threads spin.

    Args:
        plots: import the package for plots, too.

    Raises:
        InputError: a package is not installed.
    """
    _limit_spinning()
    require_data_sets()
    if plots:
        require_plots()


def require_images() -> None:
    """Import the package for writing images.

    Raises:
        InputError: pillow is not installed.
    """
    _need("PIL", "pillow")


def require_film() -> None:
    """Import the package for writing MP4.

    Raises:
        InputError: PyAV is not installed.
    """
    _need("av", extra="film")


def require_plots() -> None:
    """Import the package for plots.

    Raises:
        InputError: matplotlib is not installed.
    """
    _need("matplotlib")
    with _silent_stderr():  # fontconfig, which lists the fonts, complains about a cache that it cannot write
        import_module("matplotlib.font_manager")


def require_data_sets() -> None:
    """Load what reads data sets.

    Raises:
        InputError: the renderer, which straightens images, or pillow is not installed.
    """
    require_renderer()
    require_images()


def _need(module: str, package: str | None = None, *, extra: str = "render") -> None:
    """Import a module of an optional package.

    Raises:
        InputError: it is not installed; the message names the package and the extra that has it.
    """
    try:
        import_module(module)
    except ModuleNotFoundError as error:
        raise missing_package(error, package, extra=extra) from None


_STDERR = 2  # file descriptor of standard error


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Discard what this process and its children write to standard error, until the context ends; it may be closed."""
    try:
        original = os.dup(_STDERR)
    except OSError:  # it is closed
        yield
        return
    try:
        with open(os.devnull, "wb") as null:  # noqa: PTH123  # no path of ours
            os.dup2(null.fileno(), _STDERR)
        yield
    finally:
        os.dup2(original, _STDERR)
        os.close(original)


def _limit_spinning() -> None:
    """Let waiting threads of GNU OpenMP sleep soon, unless the user has set the variable.

    By default they spin for milliseconds, which blocks cores if another program uses them, too: 57 instead of 470 ms
    per training step, measured. The variable must be set before the library is loaded.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", _SPIN_COUNT)


_PACKAGES = ("numpy", "deflate", "zstandard", "matplotlib", "pillow")


def describe_machine(context: Context = DEFAULT_CONTEXT) -> dict[str, Any]:
    """Return processor, cores, threads in use, system and versions as JSON-compatible values."""
    return {
        "processor": processor_name(),
        "cores": core_count(),
        "threads": context.thread_count,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "csplat": csplat.__version__,
        "format": f"{VERSION_MAJOR}.{VERSION_MINOR}",
        "packages": {name: package_version(name) for name in _PACKAGES},
    }


def processor_name() -> str:
    """Return the processor's model, as far as the system reports it."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text("utf-8", "replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def package_version(name: str) -> str:
    """Return the version of an installed package, or `absent`."""
    from importlib.metadata import PackageNotFoundError, version  # 20 ms, for reports and errors alone

    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"
