# SPDX-License-Identifier: CC0-1.0
"""The strict validator: report every violation of a file by clause, not only the first (spec 9.1, CNF-1).

    >>> from csplat_conformance.validator import validate
    >>> for violation in validate(open("scene.csplat", "rb").read()).violations:     # doctest: +SKIP
    ...     print(violation)
    CHK-1 E_CRC at byte 244, TILE.0.0: tile[0].layer[0].crc is 0x00000007, computed 0x15ca0d03

It is written from the spec and shares only the numbers of the registry with the decoder. It continues after a
violation: it still reads a chunk with a wrong CRC, and skips a damaged stream by the size in its head. It also checks
parts that decoders may ignore: texts that were not requested, codebooks that no tile uses, impossible error bounds.
Parts whose position or type is unknown after a violation are listed as not checked.
"""

from __future__ import annotations

from csplat_conformance.validator.validation import validate
from csplat_conformance.validator.violation_log import Unread, Validation, Violation

__all__ = ["Unread", "Validation", "Violation", "validate"]
