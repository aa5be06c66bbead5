# SPDX-License-Identifier: Apache-2.0
"""The caller's limits on what a file may require."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from csplat import _spec
from csplat.decoder.container import HIGHEST_LEVEL
from csplat.errors import InputError


@dataclass(frozen=True)
class Limits:
    """Limits of a decode, by default the registry's.

    Attributes:
        splats: maximum number of splats decoded; default: no limit.
        bytes: maximum size of the returned arrays and the codebooks.
        json_bytes: maximum memory of a JSON text, estimated from its bytes and values (spec STR-8).
        resource_level: highest resource level of a file (spec 8.1), `A`, `B` or `C`.
    """

    splats: int = sys.maxsize
    bytes: int = _spec.BUDGET_BYTES
    json_bytes: int = _spec.BUDGET_JSON_BYTES
    resource_level: str = HIGHEST_LEVEL

    def __post_init__(self) -> None:
        for name in ("splats", "bytes", "json_bytes"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 0:
                raise InputError(f"limit {name} is {value!r}, expected a whole number, 0 or more")
        if self.resource_level not in _spec.RESOURCE_LEVEL_NAMES.values():
            raise InputError(f"limit resource_level is {self.resource_level!r}, expected A, B or C")
