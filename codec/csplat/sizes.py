# SPDX-License-Identifier: Apache-2.0
"""Parse sizes, which options and commands spell alike."""

from __future__ import annotations

import re

from csplat.errors import InputError

Size = int | str
"""Number of bytes, or text such as "60kB"."""

_UNITS = {"": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": 2**20, "gib": 2**30}


def parse_size(size: Size) -> int:
    """Return the number of bytes of a size such as `5MB`, `300 kB`, `1.5MiB` or 123456; MB is 10⁶, MiB is 2²⁰ bytes.

    Raises:
        InputError: it is not a size.
    """
    match = re.fullmatch(r"([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*([kmg]?i?b?)", str(size).strip(), re.IGNORECASE)
    unit = None if match is None else _UNITS.get(match[2].lower())
    count = None if match is None or unit is None else float(match[1]) * unit
    if count is None or not 1.0 <= count < 2.0**63:
        raise InputError(f"a size is {size!r}, expected bytes, or a number with kB, MB, GB, KiB, MiB or GiB")
    return int(count)
