"""Describe the machine on which times were measured, for reports."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import csplat
from csplat._spec import VERSION_MAJOR, VERSION_MINOR
from csplat.system import core_count

_PACKAGES = ("numpy", "numba", "scipy", "deflate", "zstandard", "matplotlib", "pillow")


def describe_machine(threads: int | None) -> dict[str, Any]:
    """Describe processor, cores, threads in use, system, and versions, JSON-compatible.

    Args:
        threads: number of threads in use; `None` for all.
    """
    cores = core_count()
    return {
        "processor": processor_name(),
        "cores": cores,
        "threads": threads or cores,
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
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"
