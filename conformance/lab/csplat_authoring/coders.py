# SPDX-License-Identifier: CC0-1.0
"""Transforms and coders of streams for vectors: simple and slow, with the same bytes on every machine.

No compression library is used, so that vectors do not change with library versions. DEFLATE streams (RFC 1951) can be
valid or invalid.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Self

from csplat import _spec


def to_bytes(values: Sequence[int], width: int) -> bytes:
    """Write integers little-endian, modulo 2^(8·width)."""
    data = bytearray(width * len(values))
    for plane in range(width):
        data[plane::width] = bytes([value >> (8 * plane) & 255 for value in values])
    return bytes(data)


def apply_transforms(values: Sequence[int], width: int, transforms: Sequence[int]) -> bytes:
    """Apply transforms in order and return the bytes for the coder (spec 6.3)."""
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
            packed = bytes([x >> (8 * plane) & 255 for plane in range(width) for x in elements])
        elif transform == _spec.TRANSFORM_RUN_LENGTH:
            packed = _run_length(to_bytes(elements, width) if packed is None else packed)
    return to_bytes(elements, width) if packed is None else packed


def _run_length(data: bytes) -> bytes:
    runs: list[tuple[int, int]] = []
    for value, equal in groupby(data):
        whole, rest = divmod(len([*equal]), _spec.RUN_MAX)
        runs += [(value, _spec.RUN_MAX)] * whole + [(value, rest)] * (rest > 0)
    values = bytes(value for value, _ in runs)
    low = bytes((length - 1) & 255 for _, length in runs)
    return values + low + bytes((length - 1) >> 8 for _, length in runs)


#: The literal/length symbol that ends a block.
END_OF_BLOCK = 256

_FIXED, _DYNAMIC = 1, 2
_ORDER = (16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15)
_REPEATS = {16: (3, 2), 17: (3, 3), 18: (11, 7)}  # by symbol of the code length code: minimum count, extra bits
_FIXED_LITERALS = {s: 8 if s < 144 else 9 if s < 256 else 7 if s < 280 else 8 for s in range(288)}
_FIXED_DISTANCES = dict.fromkeys(range(32), 5)


class Deflate:
    """A writer of a DEFLATE stream, symbol by symbol and without checks. Each method returns the writer.

    Codes are maps from symbols to code lengths.
    """

    def __init__(self) -> None:
        self._bits: list[int] = []
        self._literals: dict[int, tuple[int, int]] = {}
        self._distances: dict[int, tuple[int, int]] = {}

    def number(self, value: int, count: int) -> Self:
        """Append a number of `count` bits, lowest bit first, such as a header field or extra bits."""
        self._bits += [value >> i & 1 for i in range(count)]
        return self

    def code(self, value: int, count: int) -> Self:
        """Append a codeword of `count` bits, highest bit first."""
        self._bits += [value >> i & 1 for i in reversed(range(count))]
        return self

    def fixed(self, final: int = 1) -> Self:
        """Begin a block of fixed codes."""
        self._literals, self._distances = _codes(_FIXED_LITERALS), _codes(_FIXED_DISTANCES)
        return self.number(final, 1).number(_FIXED, 2)

    def dynamic(
        self,
        literals: Mapping[int, int],
        distances: Mapping[int, int],
        final: int = 1,
        *,
        counts: tuple[int, int] = (257, 1),
        header: Sequence[int] = (),
        meta: Mapping[int, int] | None = None,
    ) -> Self:
        """Begin a block of dynamic codes.

        Args:
            literals: the literal/length code.
            distances: the distance code.
            final: 1 for the last block.
            counts: HLIT + 257 and HDIST + 1.
            header: symbols of the code length code, each repetition followed by its count; default: one symbol for
                each length.
            meta: the code length code; default: a complete one for the symbols that occur.
        """
        self._literals, self._distances = _codes(literals), _codes(distances)
        plain = [literals.get(s, 0) for s in range(counts[0])] + [distances.get(s, 0) for s in range(counts[1])]
        pairs = _with_repeats(header or plain)
        lengths = flat_lengths(sorted({symbol for symbol, _ in pairs})) if meta is None else meta
        self.number(final, 1).number(_DYNAMIC, 2).number(counts[0] - 257, 5).number(counts[1] - 1, 5).number(15, 4)
        for symbol in _ORDER:
            self.number(lengths.get(symbol, 0), 3)
        codes = _codes(lengths)
        for symbol, repeat in pairs:
            self.code(*codes[symbol])
            if symbol in _REPEATS:
                least, extra = _REPEATS[symbol]
                self.number(repeat - least, extra)
        return self

    def literals(self, *symbols: int) -> Self:
        """Append symbols of the literal/length code, without extra bits."""
        for symbol in symbols:
            self.code(*self._literals[symbol])
        return self

    def distance(self, symbol: int) -> Self:
        """Append a symbol of the distance code, without extra bits."""
        return self.code(*self._distances[symbol])

    def match(self, length: int, distance: int = 0) -> Self:
        """Append a match of 3 to 258 bytes.

        Args:
            length: number of bytes.
            distance: symbol of the distance code; the caller appends its extra bits.
        """
        if length == 258:
            self.literals(285)
        else:
            # RFC 1951, 3.2.5: from length 11 on, there are four symbols for each number of extra bits.
            extra = max(0, (length - 3).bit_length() - 3)
            base = length - 3 >> extra
            self.literals(257 + 4 * extra + base).number(length - 3 & (1 << extra) - 1, extra)
        return self.distance(distance)

    def end(self, last_bits: int = 0) -> bytes:
        """Fill the last byte with `last_bits`, 0 or 1, and return the bytes."""
        bits = self._bits + [last_bits] * (-len(self._bits) % 8)
        groups = zip(*[iter(bits)] * 8, strict=True)
        return bytes(sum(bit << i for i, bit in enumerate(group)) for group in groups)


def _codes(lengths: Mapping[int, int]) -> dict[int, tuple[int, int]]:
    """Return the canonical code (RFC 1951, 3.2.2): codeword and length by symbol."""
    codes, code = {}, 0
    for length in range(1, 16):
        for symbol in sorted(s for s, bits in lengths.items() if bits == length):
            codes[symbol] = (code, length)
            code += 1
        code <<= 1
    return codes


def _with_repeats(header: Sequence[int]) -> list[tuple[int, int]]:
    rest = iter(header)
    return [(symbol, next(rest) if symbol in _REPEATS else 0) for symbol in rest]


def flat_lengths(symbols: Sequence[int]) -> dict[int, int]:
    """Return the code lengths of a complete code for the symbols, as equal as possible."""
    longest = max(1, (len(symbols) - 1).bit_length())
    short = (1 << longest) - len(symbols) if len(symbols) > 1 else 0
    return {symbol: longest - (i < short) for i, symbol in enumerate(symbols)}


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
        data: the bytes to code.
        last_bits: value of the unused bits after the block; the spec requires writers to use 0.
    """
    stream = Deflate().fixed()
    at = 0
    while at < len(data):
        run = 0
        while at and at + run < len(data) and run < 258 and data[at + run] == data[at - 1]:
            run += 1
        if run >= 3:
            stream.match(run)
            at += run
        else:
            stream.literals(data[at])
            at += 1
    return stream.literals(END_OF_BLOCK).end(last_bits)


def deflate_dynamic(data: bytes) -> bytes:
    """Return one block of dynamic Huffman codes without matches, with code lengths as equal as possible."""
    table = flat_lengths(sorted({*data, END_OF_BLOCK}))
    return Deflate().dynamic(table, {}).literals(*data, END_OF_BLOCK).end()
