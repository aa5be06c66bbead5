"""What numbers were taken on: every table says so."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence

from csplat_tools.tradeoff.machine import package_version, processor_name

__all__ = ["describe_machine"]


def describe_machine(packages: Sequence[str] = ("numpy", "zstandard", "deflate", "plyfile")) -> dict[str, str]:
    """Describe processor, system, and the versions of csplat and of these packages."""
    return {
        "machine": f"{processor_name()}, {os.cpu_count()} cores, {_memory()}",
        "system": f"{platform.system()} {platform.release()}, Python {platform.python_version()}",
        "packages": ", ".join(f"{name} {package_version(name)}" for name in ("csplat", *packages)),
    }


def _memory() -> str:
    try:
        pages, page_bytes = os.sysconf("SC_PHYS_PAGES"), os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return "memory unknown"
    return f"{pages * page_bytes / 2**30:.0f} GiB"
