# SPDX-License-Identifier: CC0-1.0
"""Inflate DEFLATE (RFC 1951, spec 6.2) bit by bit: slow, but it identifies the clause that a stream violates."""

from __future__ import annotations

from collections.abc import Sequence

# Block types, symbols and limits of RFC 1951, 3.2.3 to 3.2.7.
_STORED, _FIXED, _DYNAMIC = 0, 1, 2
_END_OF_BLOCK = 256  # symbol; smaller symbols are literals
_FIRST_LENGTH, _LENGTH_MIN = 257, 3  # smallest symbol of a match, and the length that it stands for
_LITERALS_MAX, _DISTANCES_MAX = 286, 30  # symbols of each code
_CODEWORD_BITS_MAX = 15
_COPY_PREVIOUS = 16  # smallest symbol that repeats code lengths; it repeats the previous one, 17 and 18 repeat 0
_REPEATS = ((3, 2), (3, 3), (11, 7))  # smallest number of repetitions and its extra bits, for symbols 16 to 18
_LENGTHS_ORDER = (16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15)
_LONGEST_MATCH_SYMBOL, _LONGEST_MATCH = 285, 258  # the only length symbol outside the regular series
_FIXED_LENGTHS = [8] * 144 + [9] * 112 + [7] * 24 + [8] * 8
_FIXED_DISTANCES = [5] * 32


class CodedError(Exception):
    """Raised if coded bytes violate a clause.

    Args:
        clause: COD-1, COD-2, COD-5 to COD-8.
        message: the defect.
        within: offset of the defect in the coded bytes.
    """

    def __init__(self, clause: str, message: str, within: int = 0) -> None:
        super().__init__(message)
        self.clause = clause
        self.within = within


class Inflater:
    """A decoder of one DEFLATE stream.

    Args:
        coded: the stream.
    """

    def __init__(self, coded: bytes) -> None:
        self._coded = coded
        self._bit_offset = 0
        self._out = bytearray()

    def inflate(self, size: int) -> bytes:
        """Inflate to the end of the final block, or until there are more than `size` bytes.

        Raises:
            CodedError: COD-2 if the stream is truncated or not DEFLATE; COD-5 to COD-8.
        """
        final = 0
        while not final:
            final, kind = self._read_bits(1), self._read_bits(2)
            if kind == _STORED:
                self._read_stored()
            elif kind == _FIXED:
                self._read_body(_Code(_FIXED_LENGTHS), _Code(_FIXED_DISTANCES), size)
            elif kind == _DYNAMIC:
                self._read_body(*self._read_codes(), size)
            else:
                raise CodedError("COD-2", "a block of type 3")
            if len(self._out) > size:
                break
        return bytes(self._out)

    @property
    def used(self) -> int:
        """Number of bytes that were read at least in part."""
        return (self._bit_offset + 7) // 8

    def refuse(self, clause: str, message: str) -> None:
        """Raise the error of a clause from COD-5 on. A subclass may return instead, so callers can go on."""
        raise CodedError(clause, message)

    def _read_bits(self, count: int) -> int:
        """Read an integer of `count` bits, the lowest first.

        Raises:
            CodedError: COD-2 if fewer bits are left.
        """
        at, end = self._bit_offset, self._bit_offset + count
        if end > 8 * len(self._coded):
            raise CodedError("COD-2", "the DEFLATE stream has no end")
        self._bit_offset = end
        piece = int.from_bytes(self._coded[at >> 3 : (end + 7) >> 3], "little")
        return piece >> (at & 7) & (1 << count) - 1

    def _read_stored(self) -> None:
        """Append a stored block, which begins at the next whole byte, to the output; COD-2 if it is invalid."""
        self._bit_offset = 8 * self.used
        size, complement = self._read_bits(16), self._read_bits(16)
        if size ^ complement != 0xFFFF:
            raise CodedError("COD-2", "the length of a stored block and its complement differ")
        start = self._bit_offset // 8
        if start + size > len(self._coded):
            raise CodedError("COD-2", "the DEFLATE stream has no end")
        self._out += self._coded[start : start + size]
        self._bit_offset += 8 * size

    def _read_codes(self) -> tuple[_Code, _Code]:
        """Read the header of a dynamic block (RFC 1951, 3.2.7); return its literal/length and its distance code.

        Checks COD-5 to COD-7.
        """
        # The header stores each count less its minimum: HLIT, HDIST, and HCLEN below.
        literal_count, distance_count = self._read_bits(5) + 257, self._read_bits(5) + 1
        if literal_count > _LITERALS_MAX or distance_count > _DISTANCES_MAX:
            counts = f"{literal_count} literal/length and {distance_count} distance codes"
            self.refuse("COD-5", f"{counts}, expected at most {_LITERALS_MAX} and {_DISTANCES_MAX}")
        lengths = [0] * len(_LENGTHS_ORDER)
        for symbol in _LENGTHS_ORDER[: self._read_bits(4) + 4]:
            lengths[symbol] = self._read_bits(3)
        if not _is_complete(lengths):
            self.refuse("COD-6", "the code of the code lengths is not complete")
        lengths = self._read_lengths(_Code(lengths), literal_count + distance_count)
        if not lengths[_END_OF_BLOCK]:
            self.refuse("COD-7", "symbol 256 has no codeword")
        of_literals, of_distances = lengths[:literal_count], lengths[literal_count:]
        if not _is_complete(of_literals) and not _is_one_bit_code(of_literals):
            self.refuse("COD-6", "the literal/length code is not complete")
        if any(of_distances) and not _is_complete(of_distances) and not _is_one_bit_code(of_distances):
            self.refuse("COD-6", "the distance code is not complete")
        return _Code(of_literals), _Code(of_distances)

    def _read_lengths(self, code: _Code, count: int) -> list[int]:
        """Read `count` code lengths, which `code` compresses, and check COD-7."""
        lengths: list[int] = []
        while len(lengths) < count:
            symbol = self._read_symbol(code)
            if symbol <= _CODEWORD_BITS_MAX:
                lengths.append(symbol)
                continue
            if symbol == _COPY_PREVIOUS and not lengths:
                self.refuse("COD-7", "the first code length repeats a previous one")
            value = lengths[-1] if symbol == _COPY_PREVIOUS and lengths else 0
            least, extra_bits = _REPEATS[symbol - _COPY_PREVIOUS]
            repeat = least + self._read_bits(extra_bits)
            if len(lengths) + repeat > count:
                self.refuse("COD-7", f"code lengths repeat beyond the last of {count}")
            lengths += [value] * repeat
        return lengths[:count]

    def _read_body(self, literals: _Code, distances: _Code, size: int) -> None:
        """Append the literals and matches of a block to the output, and check COD-8.

        Returns after the end of the block, or once the output has more than `size` bytes.
        """
        out = self._out
        while len(out) <= size:
            symbol = self._read_symbol(literals)
            if symbol < _END_OF_BLOCK:
                out.append(symbol)
                continue
            if symbol == _END_OF_BLOCK:
                return
            if symbol > _LONGEST_MATCH_SYMBOL:
                self.refuse("COD-8", f"literal/length symbol {symbol}")
            length = (
                _LENGTH_MIN + self._read_value(symbol - _FIRST_LENGTH, 4)
                if symbol < _LONGEST_MATCH_SYMBOL
                else _LONGEST_MATCH
            )
            symbol = self._read_symbol(distances)
            if symbol >= _DISTANCES_MAX:
                self.refuse("COD-8", f"distance symbol {symbol}")
            distance = 1 + self._read_value(min(symbol, _DISTANCES_MAX - 1), 2)
            if distance > len(out):
                self.refuse("COD-8", f"distance {distance} after {len(out)} bytes")
            pattern = out[-distance:].rjust(distance, b"\0")  # zeros before the output, if COD-8 is ignored
            out += (pattern * (length // distance + 1))[:length]

    def _read_value(self, symbol: int, group: int) -> int:
        """Read the extra bits of a symbol and return length - 3 or distance - 1 (RFC 1951, 3.2.5).

        Args:
            symbol: symbol, counted from the first length or the first distance.
            group: symbols for each number of extra bits: 4 for lengths, 2 for distances.
        """
        extra = max(0, symbol // group - 1)
        first = symbol if symbol < group else (group + symbol % group) << extra
        return first + self._read_bits(extra)

    def _read_symbol(self, code: _Code) -> int:
        """Read a codeword and return its symbol (RFC 1951, 3.2.2); COD-8 if there is none."""
        word = first = 0  # the bits so far, and the first codeword of that length
        index = 0  # index of the first symbol with a codeword of that length
        for count in code.counts:
            word |= self._read_bits(1)
            if word - first < count:
                return code.symbols[index + word - first]
            index += count
            first = first + count << 1
            word <<= 1
        self.refuse("COD-8", "a codeword without a symbol")
        return code.symbols[0] if code.symbols else 0  # only if COD-8 is ignored


class _Code:
    """A canonical code: the number of codewords of each length, and the symbols in codeword order."""

    def __init__(self, lengths: Sequence[int]) -> None:
        used = [length for length in lengths if length]
        self.counts = [used.count(length) for length in range(1, max(used, default=0) + 1)]
        self.symbols = sorted((s for s, length in enumerate(lengths) if length), key=lambda s: lengths[s])


def _is_complete(lengths: Sequence[int]) -> bool:
    """Return True if the codewords fill the code exactly: their Kraft sum is 1. False for a code without codewords."""
    return sum(1 << _CODEWORD_BITS_MAX - length for length in lengths if length) == 1 << _CODEWORD_BITS_MAX


def _is_one_bit_code(lengths: Sequence[int]) -> bool:
    """Return True if there is a single codeword, of one bit."""
    return [length for length in lengths if length] == [1]
