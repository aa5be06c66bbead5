"""Coders (spec 6.2): complete, nothing before, nothing after, and the size that the head states."""

from __future__ import annotations

import zlib

from csplat import _spec
from csplat_conformance.validator.inflate import CodedError, Inflater

__all__ = ["CodedError", "uncoded"]

_FRAME_MAGIC = 0xFD2FB528  # RFC 8878, 3.1.1
_CHECKSUM_SIZE = 4
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
        CodedError: by COD-1 to COD-3 or COD-5 to COD-8.
    """
    if coder == _spec.CODER_STORED:
        if len(coded) != size:
            raise CodedError("COD-1", f"{len(coded)} bytes are stored, packed_size is {size}")
        return bytes(coded), False
    if coder == _spec.CODER_DEFLATE:
        return _inflated(coded, size)
    return _unframed(coded, size), False


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
    """Whether bits of the last byte are set behind the end of the final block.

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


def _unframed(coded: memoryview, size: int) -> bytes:
    """COD-3. The frame is walked block by block before it is decompressed, so that its extent is known."""
    import zstandard  # files of the profile base do without it

    _check_frame(coded, size)
    try:
        packed: bytes = zstandard.ZstdDecompressor().decompress(bytes(coded), max_output_size=size)
    except zstandard.ZstdError as error:
        raise CodedError("COD-3", f"not a Zstandard frame: {error}") from None
    if len(packed) != size:
        raise CodedError("COD-3", f"{len(packed)} bytes come out, packed_size is {size}")
    return packed


def _check_frame(coded: memoryview, size: int) -> None:
    """Walk a frame (RFC 8878, 3.1.1): header, blocks, checksum, end."""
    if len(coded) < 5 or int.from_bytes(coded[:4], "little") != _FRAME_MAGIC:
        raise CodedError("COD-3", "the bytes do not begin with a Zstandard frame")
    descriptor = coded[4]
    single_segment, has_checksum = descriptor >> 5 & 1, descriptor >> 2 & 1
    if descriptor >> 3 & 1:
        raise CodedError("COD-3", "the reserved bit of the frame header is set")
    window_size = 1 - single_segment
    dictionary_size = (0, 1, 2, 4)[descriptor & 3]
    content_field = (single_segment, 2, 4, 8)[descriptor >> 6]
    at = 5 + window_size + dictionary_size
    end = at + content_field
    if len(coded) < end:
        raise CodedError("COD-3", "the frame header is cut")
    if not content_field:
        raise CodedError("COD-3", "the frame does not state its content size")
    content = int.from_bytes(coded[at:end], "little") + (256 if content_field == 2 else 0)
    if content != size:
        raise CodedError("COD-3", f"the frame states {content} bytes, packed_size is {size}")
    if int.from_bytes(coded[at - dictionary_size : at], "little"):
        raise CodedError("COD-3", "the frame wants a dictionary")
    window = content if single_segment else _window(coded[5])
    if window > _spec.ZSTD_WINDOW_MAX:
        raise CodedError("COD-3", f"a window of {window} bytes, {_spec.ZSTD_WINDOW_MAX} is the most")
    end = _blocks_end(coded, end) + (_CHECKSUM_SIZE if has_checksum else 0)
    if end != len(coded):
        where = "is cut" if end > len(coded) else f"ends after {end} bytes, {len(coded) - end} follow it"
        raise CodedError("COD-3", f"the frame {where}")


def _window(descriptor: int) -> int:
    # RFC 8878, 3.1.1.1.2
    base = 1 << 10 + (descriptor >> 3)
    return base + (base >> 3) * (descriptor & 7)


def _blocks_end(coded: memoryview, at: int) -> int:
    """Return where the last block ends; beyond the bytes if they are cut."""
    while at + 3 <= len(coded):
        header = int.from_bytes(coded[at : at + 3], "little")
        last, kind, size = header & 1, header >> 1 & 3, header >> 3
        if kind == 3:
            raise CodedError("COD-3", "a block of the reserved type")
        at += 3 + (1 if kind == 1 else size)  # an RLE block holds one byte
        if last:
            return at
    return len(coded) + 1
