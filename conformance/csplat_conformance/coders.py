"""Forward transforms and coders (spec 6.2, 6.3), written for vectors: plain, slow, the same bytes everywhere.

No compression library takes part, so that a vector never changes because a library did.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from csplat import _spec

__all__ = [
    "apply_transforms",
    "deflate_dynamic",
    "deflate_fixed",
    "deflate_stored",
    "to_bytes",
]

_DEFLATE_ORDER = (16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15)
_END_OF_BLOCK = 256


def to_bytes(values: Sequence[int], width: int) -> bytes:
    """Write integers little-endian, modulo 2^(8·width): what a sequence is when no byte transform follows."""
    modulus = 1 << (8 * width)
    return b"".join((value % modulus).to_bytes(width, "little") for value in values)


def apply_transforms(values: Sequence[int], width: int, transforms: Sequence[int]) -> bytes:
    """Apply transforms in their order and return the bytes that reach the coder (spec 6.3)."""
    modulus = 1 << (8 * width)
    elements = [value % modulus for value in values]
    packed: bytes | None = None
    for transform in transforms:
        if transform == _spec.TRANSFORM_DELTA:
            before = [0, *elements[:-1]]
            elements = [(x - last) % modulus for x, last in zip(elements, before, strict=True)]
        elif transform == _spec.TRANSFORM_ZIGZAG:
            signed = [x - modulus if x >= modulus // 2 else x for x in elements]
            elements = [2 * v if v >= 0 else -2 * v - 1 for v in signed]
        elif transform == _spec.TRANSFORM_BYTE_PLANES:
            packed = bytes(x >> (8 * plane) & 255 for plane in range(width) for x in elements)
        elif transform == _spec.TRANSFORM_RUN_LENGTH:
            packed = _run_length(to_bytes(elements, width) if packed is None else packed)
    return to_bytes(elements, width) if packed is None else packed


def _run_length(data: bytes) -> bytes:
    runs: list[list[int]] = []
    for value in data:
        if runs and runs[-1][0] == value and runs[-1][1] < _spec.RUN_MAX:
            runs[-1][1] += 1
        else:
            runs.append([value, 1])
    values = bytes(value for value, _ in runs)
    low = bytes((length - 1) & 255 for _, length in runs)
    return values + low + bytes((length - 1) >> 8 for _, length in runs)


class _Bits:
    """Bits of a DEFLATE stream, lowest first."""

    def __init__(self) -> None:
        self.bits: list[int] = []

    def put(self, value: int, count: int) -> None:
        """Append a number, lowest bit first."""
        self.bits += [value >> i & 1 for i in range(count)]

    def code(self, value: int, count: int) -> None:
        """Append a Huffman code, highest bit first."""
        self.bits += [value >> i & 1 for i in reversed(range(count))]

    def done(self, last_bits: int = 0) -> bytes:
        """Fill up with bits of `last_bits` and return the bytes."""
        while len(self.bits) % 8:
            self.bits.append(last_bits)
        groups = zip(*[iter(self.bits)] * 8, strict=True)
        return bytes(sum(bit << i for i, bit in enumerate(group)) for group in groups)


def deflate_stored(data: bytes, block: int = 65535) -> bytes:
    """Return a DEFLATE stream of stored blocks of at most `block` bytes."""
    pieces = [data[i : i + block] for i in range(0, len(data), block)] or [b""]
    out = b""
    for i, piece in enumerate(pieces):
        out += struct.pack("<BHH", i == len(pieces) - 1, len(piece), len(piece) ^ 0xFFFF) + piece
    return out


def deflate_fixed(data: bytes, last_bits: int = 0) -> bytes:
    """Return one block of fixed Huffman codes; runs become matches at distance 1.

    Args:
        data: what to code.
        last_bits: the unused bits after the block, 0 where a writer obeys the spec.
    """
    bits = _Bits()
    bits.put(1, 1)
    bits.put(1, 2)
    at = 0
    while at < len(data):
        run = 0
        while at and at + run < len(data) and run < 258 and data[at + run] == data[at - 1]:
            run += 1
        if run >= 3:
            _match(bits, run)
            at += run
        else:
            _fixed_code(bits, data[at])
            at += 1
    _fixed_code(bits, _END_OF_BLOCK)
    return bits.done(last_bits)


def _fixed_code(bits: _Bits, symbol: int) -> None:
    # RFC 1951, 3.2.6
    if symbol < 144:
        bits.code(0x30 + symbol, 8)
    elif symbol < 256:
        bits.code(0x190 + symbol - 144, 9)
    elif symbol < 280:
        bits.code(symbol - 256, 7)
    else:
        bits.code(0xC0 + symbol - 280, 8)


def _match(bits: _Bits, length: int) -> None:
    if length == 258:
        _fixed_code(bits, 285)
    else:
        # RFC 1951, 3.2.5: from length 11 on, four symbols per number of extra bits
        extra = max(0, (length - 3).bit_length() - 3)
        base = length - 3 >> extra
        _fixed_code(bits, 257 + 4 * extra + base)
        bits.put(length - 3 & (1 << extra) - 1, extra)
    bits.code(0, 5)


def deflate_dynamic(data: bytes) -> bytes:
    """Return one block of dynamic Huffman codes without matches; lengths are as equal as a complete code allows."""
    symbols = sorted({*data, _END_OF_BLOCK})
    lengths = dict.fromkeys(range(_END_OF_BLOCK + 1), 0) | _flat_lengths(symbols)
    codes = _canonical(lengths)
    header = [*lengths.values(), 0]  # and one distance code of length 0: no matches
    meta_lengths = dict.fromkeys(range(19), 0) | _flat_lengths(sorted(set(header)))
    meta_codes = _canonical(meta_lengths)
    bits = _Bits()
    bits.put(1, 1)
    bits.put(2, 2)
    bits.put(0, 5)
    bits.put(0, 5)
    bits.put(15, 4)
    for symbol in _DEFLATE_ORDER:
        bits.put(meta_lengths[symbol], 3)
    for length in header:
        bits.code(meta_codes[length], meta_lengths[length])
    for symbol in [*data, _END_OF_BLOCK]:
        bits.code(codes[symbol], lengths[symbol])
    return bits.done()


def _flat_lengths(symbols: Sequence[int]) -> dict[int, int]:
    longest = max(1, (len(symbols) - 1).bit_length())
    short = (1 << longest) - len(symbols) if len(symbols) > 1 else 0
    return {symbol: longest - (i < short) for i, symbol in enumerate(symbols)}


def _canonical(lengths: dict[int, int]) -> dict[int, int]:
    codes, code = {}, 0
    for length in range(1, 16):
        for symbol in sorted(s for s, bits in lengths.items() if bits == length):
            codes[symbol] = code
            code += 1
        code <<= 1
    return codes
