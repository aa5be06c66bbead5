"""The strict validator: every violation of a file, by clause, not only the first (spec 9.1, CNF-1).

    >>> from csplat_conformance.validator import validate
    >>> for violation in validate(open("scene.csplat", "rb").read()).violations:     # doctest: +SKIP
    ...     print(violation)
    CHK-1 E_CRC at byte 244, TILE.0.0: tile[0].layer[0].crc is 0x00000007, computed 0x15ca0d03

It is written from the spec and shares nothing with the decoder but the numbers of the registry. When a decoder stops
it goes on: a chunk whose CRC is wrong is still read, a stream that is damaged is stepped over by the size in its head.
It looks at what decoders need not look at, too: texts that nobody asked for, codebooks that no tile uses, stated errors
that no scene can have. What can no longer be told apart is listed as not looked at.
"""

from __future__ import annotations

from csplat_conformance.validator.findings import Unread, Validation, Violation
from csplat_conformance.validator.validation import validate

__all__ = ["Unread", "Validation", "Violation", "validate"]
