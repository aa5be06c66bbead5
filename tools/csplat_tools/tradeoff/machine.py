"""What times were taken on: every report says so."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import csplat
from csplat._spec import VERSION_MAJOR, VERSION_MINOR

__all__ = ["describe_machine"]

_PACKAGES = ("numpy", "numba", "scipy", "deflate", "zstandard", "matplotlib", "pillow")


def describe_machine(threads: int | None) -> dict[str, Any]:
    """Describe processor, cores, threads in use, system, and versions, JSON-compatible.

    Args:
        threads: that were asked for; `None` for all.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return {
        "processor": _processor(),
        "cores": cores,
        "threads": threads or cores,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "csplat": csplat.__version__,
        "format": f"{VERSION_MAJOR}.{VERSION_MINOR}",
        "packages": {name: _version(name) for name in _PACKAGES},
    }


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text("utf-8", "replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"
