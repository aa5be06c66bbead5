"""Parse sizes in bytes as people write them."""

from __future__ import annotations

import re

from csplat.errors import InputError

#: A regular expression for a number, which is its first group.
NUMBER = r"([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)"

_UNITS = {"": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": 2**20, "gib": 2**30}
_LEAST_FILE = 64  # bytes of a file's header: no file is smaller


def parse_size_bytes(text: str) -> int:
    """Parse a number of bytes from `5MB`, `300 kB`, `1.5MiB` or `123456`; MB is 10⁶, MiB is 2²⁰.

    Raises:
        InputError: the text is not a size, or is smaller than any file.
    """
    found = re.fullmatch(NUMBER + r"\s*([kmg]?i?b?)", text.strip(), re.IGNORECASE)
    unit = None if found is None else _UNITS.get(found[2].lower())
    size = None if found is None or unit is None else float(found[1]) * unit
    if size is None or not 1.0 <= size < 2.0**63:
        raise InputError(f"a size is {text!r}, wanted bytes, or a number with kB, MB, GB, KiB, MiB or GiB")
    if size < _LEAST_FILE:
        raise InputError(f"no file has {size:.0f} bytes or fewer; did you mean {text.strip()}MB?")
    return int(size)
