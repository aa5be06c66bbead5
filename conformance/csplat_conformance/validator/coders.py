"""Coders (spec 6.2): complete, nothing before, nothing after, and the size that the head states."""

from __future__ import annotations

import zlib

from csplat import _spec
from csplat_conformance.validator.inflate import CodedError, Inflater

_RAW_DEFLATE = -15


def uncoded(coded: memoryview, coder: int, size: int) -> tuple[bytes, bool]:
    """Undo a coder.

    Args:
        coded: `coded_size` bytes.
        coder: registry value, a used one.
        size: `packed_size`.

    Returns:
        `size` bytes, and whether the unused bits behind a DEFLATE stream are not 0.

    Raises:
        CodedError: by COD-1, COD-2 or COD-5 to COD-8.
    """
    if coder == _spec.CODER_STORED:
        if len(coded) != size:
            raise CodedError("COD-1", f"{len(coded)} bytes are stored, packed_size is {size}")
        return bytes(coded), False
    return _inflated(coded, size)


def _inflated(coded: memoryview, size: int) -> tuple[bytes, bool]:
    """COD-2, COD-5 to COD-8. The last byte is held back, so that its unused bits can be told from the others."""
    body, last = coded[:-1], bytes(coded[-1:])
    inflater = zlib.decompressobj(_RAW_DEFLATE)
    try:
        packed = inflater.decompress(body, size + 1)
        if inflater.eof:
            left = len(inflater.unused_data) + len(last)
            raise CodedError("COD-2", f"{left} bytes follow the final block", len(coded) - left)
        if len(packed) > size:
            raise CodedError("COD-2", f"more than {size} bytes come out, packed_size is {size}")
        before = inflater.copy()
        rest = inflater.decompress(last, size + 1 - len(packed))
    except zlib.error as error:
        Inflater(bytes(coded)).inflate(size)  # names the clause
        raise CodedError("COD-2", f"not a DEFLATE stream: {error}") from None
    packed += rest
    if len(packed) != size:
        amount = f"more than {size}" if len(packed) > size else len(packed)
        raise CodedError("COD-2", f"{amount} bytes come out, packed_size is {size}")
    if not inflater.eof:
        raise CodedError("COD-2", "the DEFLATE stream has no end")
    return packed, _has_spare_bits(before, last[0], rest)


def _has_spare_bits(before: zlib._Decompress, last: int, rest: bytes) -> bool:
    """Return True if bits of the last byte are set after the end of the final block.

    A byte whose bits from k on are cleared still gives the same end as soon as k is where the block ends; a smaller k
    does so only if the bits in between were 0 anyway.
    """
    for k in range(8):
        trial = before.copy()
        try:
            same = trial.decompress(bytes([last & (1 << k) - 1]), len(rest) + 1) == rest
        except zlib.error:
            continue
        if same and trial.eof:
            return bool(last >> k)
    return False
