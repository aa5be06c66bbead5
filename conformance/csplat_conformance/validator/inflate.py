"""Inflate DEFLATE (RFC 1951, spec 6.2) bit by bit: slow, but it identifies the clause that a stream violates."""

from __future__ import annotations

from collections.abc import Sequence

_STORED, _FIXED, _DYNAMIC = 0, 1, 2
_END_OF_BLOCK = 256
_LITERALS_MAX, _DISTANCES_MAX = 286, 30
_BITS_MAX = 15
_ORDER = (16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15)
_LONGEST_SYMBOL, _LONGEST = 285, 258
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
        self._at = 0  # bits
        self._out = bytearray()

    def inflate(self, size: int) -> bytes:
        """Inflate to the end of the final block, or until there are more than `size` bytes.

        Raises:
            CodedError: COD-2 if the stream is truncated or not DEFLATE; COD-5 to COD-8.
        """
        final = 0
        while not final:
            final, kind = self._number(1), self._number(2)
            if kind == _STORED:
                self._read_stored()
            elif kind == _FIXED:
                self._matches(_Code(_FIXED_LENGTHS), _Code(_FIXED_DISTANCES), size)
            elif kind == _DYNAMIC:
                self._matches(*self._codes(), size)
            else:
                raise CodedError("COD-2", "a block of type 3")
            if len(self._out) > size:
                break
        return bytes(self._out)

    @property
    def used(self) -> int:
        """Number of bytes that were read at least in part."""
        return (self._at + 7) // 8

    def refuse(self, clause: str, message: str) -> None:
        """Raise the error of a clause from COD-5 on."""
        raise CodedError(clause, message)

    def _number(self, count: int) -> int:
        """Read an integer of `count` bits, the lowest first."""
        at, end = self._at, self._at + count
        if end > 8 * len(self._coded):
            raise CodedError("COD-2", "the DEFLATE stream has no end")
        self._at = end
        piece = int.from_bytes(self._coded[at >> 3 : (end + 7) >> 3], "little")
        return piece >> (at & 7) & (1 << count) - 1

    def _read_stored(self) -> None:
        """Read a stored block, which begins at the next whole byte."""
        self._at = 8 * self.used
        size, complement = self._number(16), self._number(16)
        if size ^ complement != 0xFFFF:
            raise CodedError("COD-2", "the length of a stored block and its complement differ")
        start = self._at // 8
        if start + size > len(self._coded):
            raise CodedError("COD-2", "the DEFLATE stream has no end")
        self._out += self._coded[start : start + size]
        self._at += 8 * size

    def _codes(self) -> tuple[_Code, _Code]:
        """Read the header of a dynamic block."""
        literals, distances = self._number(5) + 257, self._number(5) + 1
        if literals > _LITERALS_MAX or distances > _DISTANCES_MAX:
            self.refuse(
                "COD-5", f"{literals} literal/length and {distances} distance codes, expected at most 286 and 30"
            )
        lengths = [0] * len(_ORDER)
        for symbol in _ORDER[: self._number(4) + 4]:
            lengths[symbol] = self._number(3)
        if not _is_complete(lengths):
            self.refuse("COD-6", "the code of the code lengths is not complete")
        lengths = self._lengths(_Code(lengths), literals + distances)
        if not lengths[_END_OF_BLOCK]:
            self.refuse("COD-7", "symbol 256 has no codeword")
        of_literals, of_distances = lengths[:literals], lengths[literals:]
        if not _is_complete(of_literals) and not _is_lone(of_literals):
            self.refuse("COD-6", "the literal/length code is not complete")
        if any(of_distances) and not _is_complete(of_distances) and not _is_lone(of_distances):
            self.refuse("COD-6", "the distance code is not complete")
        return _Code(of_literals), _Code(of_distances)

    def _lengths(self, code: _Code, count: int) -> list[int]:
        """Read `count` code lengths, which `code` compresses."""
        lengths: list[int] = []
        while len(lengths) < count:
            symbol = self._symbol(code)
            if symbol <= _BITS_MAX:
                lengths.append(symbol)
                continue
            if symbol == 16 and not lengths:
                self.refuse("COD-7", "the first code length repeats a previous one")
            value = lengths[-1] if symbol == 16 and lengths else 0
            repeat = (3, 3, 11)[symbol - 16] + self._number((2, 3, 7)[symbol - 16])
            if len(lengths) + repeat > count:
                self.refuse("COD-7", f"code lengths repeat beyond the last of {count}")
            lengths += [value] * repeat
        return lengths[:count]

    def _matches(self, literals: _Code, distances: _Code, size: int) -> None:
        """Read the body of a block to its end, or until there are more than `size` bytes."""
        out = self._out
        while len(out) <= size:
            symbol = self._symbol(literals)
            if symbol < _END_OF_BLOCK:
                out.append(symbol)
                continue
            if symbol == _END_OF_BLOCK:
                return
            if symbol > _LONGEST_SYMBOL:
                self.refuse("COD-8", f"literal/length symbol {symbol}")
            length = 3 + self._value(symbol - 257, 4) if symbol < _LONGEST_SYMBOL else _LONGEST
            symbol = self._symbol(distances)
            if symbol >= _DISTANCES_MAX:
                self.refuse("COD-8", f"distance symbol {symbol}")
            distance = 1 + self._value(min(symbol, _DISTANCES_MAX - 1), 2)
            if distance > len(out):
                self.refuse("COD-8", f"distance {distance} after {len(out)} bytes")
            pattern = out[-distance:].rjust(distance, b"\0")
            out += (pattern * (length // distance + 1))[:length]

    def _value(self, symbol: int, group: int) -> int:
        """Return length - 3 (`group` is 4 symbols per number of extra bits) or distance - 1 (`group` is 2)."""
        extra = max(0, symbol // group - 1)
        first = symbol if symbol < group else (group + symbol % group) << extra
        return first + self._number(extra)

    def _symbol(self, code: _Code) -> int:
        """Read a codeword (RFC 1951, 3.2.2)."""
        word = first = index = 0
        for count in code.counts:
            word |= self._number(1)
            if word - first < count:
                return code.symbols[index + word - first]
            index += count
            first = first + count << 1
            word <<= 1
        self.refuse("COD-8", "a codeword without a symbol")
        return code.symbols[0] if code.symbols else 0


class _Code:
    """A canonical code: the number of codewords of each length, and the symbols in codeword order."""

    def __init__(self, lengths: Sequence[int]) -> None:
        used = [length for length in lengths if length]
        self.counts = [used.count(length) for length in range(1, max(used, default=0) + 1)]
        self.symbols = sorted((s for s, length in enumerate(lengths) if length), key=lambda s: lengths[s])


def _is_complete(lengths: Sequence[int]) -> bool:
    return sum(1 << _BITS_MAX - length for length in lengths if length) == 1 << _BITS_MAX


def _is_lone(lengths: Sequence[int]) -> bool:
    """Return True if the only codeword has one bit."""
    return [length for length in lengths if length] == [1]
