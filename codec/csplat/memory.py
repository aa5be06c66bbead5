"""Available memory."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

_SHARE = 0.5  # share of the free memory: other programs need some, too
_UNKNOWN = 4 << 30  # bytes, if the system does not report it
_LIMITS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def available_bytes() -> int:
    """Bytes that programs can still take: of the machine, or of the control group that this process runs in."""
    found = [_of_machine()]
    for limit, current in _LIMITS:
        with suppress(OSError, ValueError):
            found.append(int(Path(limit).read_text("ascii")) - int(Path(current).read_text("ascii")))
    return max(0, min(found))


def default_bytes() -> int:
    """Return the memory that a command uses by default: half of what is free."""
    return int(_SHARE * available_bytes())


def _of_machine() -> int:
    with suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text("ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    with suppress(ValueError, OSError):
        if sys.platform != "win32" and hasattr(os, "sysconf"):
            return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    return _UNKNOWN
