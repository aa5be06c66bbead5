# SPDX-License-Identifier: CC0-1.0
"""DEFLATE streams at the limits of section 6.2: just valid and just invalid."""

from __future__ import annotations

from dataclasses import dataclass, replace

from csplat_authoring.coders import END_OF_BLOCK, Deflate, flat_lengths
from csplat_authoring.recipe import Recipe, invalid_recipe, valid_recipe
from csplat_authoring.samples import MEANS, OPACITIES, QUATS, SCALES, SH0, axis, levels, scene, signed, tile
from csplat_authoring.scene import Scene, Stream

_LENGTH_3 = 257
_TABLE = {7: 2, 8: 2, END_OF_BLOCK: 2, _LENGTH_3: 2}  # complete
_BOTH = {0: 1, 1: 1}
_SH3, _WIDTH = SH0 + 3, 4  # the band with the most bytes per splat, for long outputs of few splats
_FAR, _FARTHEST = 24577, 32768  # smallest and largest distance of symbol 29, for which some take symbols 30 and 31


@dataclass(frozen=True)
class DeflateCase:
    """One stream.

    Attributes:
        name: name of the vector, without `deflate_`.
        why: purpose of the vector, one line.
        clause: the clause that it violates or demonstrates.
        coded: the stream.
        output: its decoded bytes; for an invalid stream, those of a decoder without the check.
    """

    name: str
    why: str
    clause: str
    coded: bytes
    output: bytes


def valid_deflate_recipes() -> list[Recipe]:
    """Return recipes of valid streams."""
    return [_valid(case, _scene(case)) for case in valid_streams()]


def invalid_deflate_recipes() -> list[Recipe]:
    """Return recipes of invalid streams."""
    return [
        invalid_recipe(
            f"deflate_{case.name}", case.why, case.clause, "E_CODER", _scene(case), at=f"{_place(case)}.coded"
        )
        for case in invalid_streams()
    ]


def _valid(case: DeflateCase, made: Scene) -> Recipe:
    return valid_recipe("extreme", f"deflate_{case.name}", case.why, case.clause, made)


def _place(case: DeflateCase) -> str:
    return "TILE.0.0/opacities.stream" if len(case.output) < _FAR else "TILE.0.3/sh3.stream"


def _scene(case: DeflateCase) -> Scene:
    """Return a scene with the stream as opacities or, if it is long, as band 3."""
    stream_coding = Stream(coder="deflate", coded=case.coded)
    if len(case.output) < _FAR:
        n = len(case.output)
        return scene(tiles=[tile(n=n, changes={OPACITIES: levels(list(case.output), stream_coding)})])
    elements = [int.from_bytes(case.output[at : at + _WIDTH], "little") for at in range(0, len(case.output), _WIDTH)]
    n = len(elements) // 21
    rows = [elements[i::n] for i in range(n)]
    few = Stream(coder="deflate_fixed")
    changes = {SH0 + band: signed([[0] * (6 * band + 3)] * n, few) for band in range(3)}
    changes |= {attribute: signed([[0] * 3] * n, few) for attribute in (SCALES, QUATS)}
    changes |= {OPACITIES: levels([9] * n, few), MEANS: axis([[0] * 3] * n, few)}
    return scene(3, [tile(n=n, degree=3, changes=changes | {_SH3: signed(rows, replace(stream_coding, width=_WIDTH))})])


def valid_streams() -> list[DeflateCase]:
    """Return valid streams."""
    crossing = (18, 138, 18, 117, 2, 2, 16, 6)  # 255 zeros, 2, 2, and the 2 six times more
    literals = {7: 1, 8: 2, _LENGTH_3: 15, END_OF_BLOCK: 15} | {9 + i: 3 + i for i in range(12)}
    distances = {i: min(15, 1 + i) for i in range(16)}

    def case(name: str, why: str, clause: str, stream: Deflate, output: bytes) -> DeflateCase:
        return DeflateCase(name, why, clause, stream.literals(END_OF_BLOCK).end(), output)

    every = Deflate().dynamic(flat_lengths(range(286)), flat_lengths(range(30)), counts=(286, 30))
    longest = Deflate().dynamic(literals, distances, counts=(258, 16))
    crossed = Deflate().dynamic(
        dict.fromkeys(range(255, 259), 2), dict.fromkeys(range(4), 2), counts=(259, 4), header=crossing
    )
    return [
        case(
            "most_symbols",
            "HLIT + 257 is 286, HDIST + 1 is 30, and each symbol has a code",
            "COD-5",
            every.literals(7).match(258),
            bytes([7] * 259),
        ),
        case(
            "lone_end",
            "a literal/length code of one codeword: an empty block",
            "COD-6",
            Deflate().dynamic({END_OF_BLOCK: 1}, {}, 0).literals(END_OF_BLOCK).fixed().literals(7, 8),
            bytes([7, 8]),
        ),
        case(
            "lone_distance",
            "a distance code of one codeword, of symbol 0",
            "COD-6",
            Deflate().dynamic(_TABLE, {0: 1}, counts=(258, 1)).literals(7).match(3),
            bytes([7] * 4),
        ),
        case(
            "lone_distance_2",
            "a distance code of one codeword, of symbol 1",
            "COD-6",
            Deflate().dynamic(_TABLE, {1: 1}, counts=(258, 2)).literals(7, 8).match(3, 1),
            bytes([7, 8, 7, 8, 7]),
        ),
        case(
            "no_distance",
            "thirty distance symbols without a code, and a length symbol that has one",
            "COD-6",
            Deflate().dynamic(_TABLE, {}, counts=(258, 30)).literals(7, 8),
            bytes([7, 8]),
        ),
        case(
            "longest_codewords",
            "codewords of 15 bits",
            "COD-6",
            longest.literals(7, 20, 8).match(3).literals(7).match(3, 1),
            bytes([7, 20, 8, 8, 8, 8, 7, 8, 7, 8]),
        ),
        case(
            "repeat_crosses",
            "a repetition that begins among the literal/length codes and ends among those of distances",
            "COD-7",
            crossed.literals(255).match(3),
            bytes([255] * 4),
        ),
        case(
            "whole_output_back",
            "a distance that reaches the first byte, which another block gave",
            "COD-8",
            Deflate().fixed(0).literals(7, 8, 9, END_OF_BLOCK).fixed().match(3, 2),
            bytes([7, 8, 9, 7, 8, 9]),
        ),
        case(
            "farthest",
            "a distance of 32,768",
            "COD-8",
            _zeros(_FARTHEST, 5).match(76, 29).number(8191, 13),
            _long(_FARTHEST, 76, 5),
        ),
        case(
            "copies", "matches that overlap what they copy, and such that do not, of some length", "COD-8", *_copies()
        ),
        case(
            "length_258_as_284",
            "a length of 258 as symbol 284 and 31",
            "COD-8",
            Deflate().fixed().literals(7, 284).number(31, 5).distance(0),
            bytes([7] * 259),
        ),
        DeflateCase(
            "stored_padding",
            "ones before the length of a stored block: ignored",
            "COD-2",
            Deflate().number(1, 1).number(0, 2).number(31, 5).end() + b"\x02\x00\xfd\xff\x07\x08",
            bytes([7, 8]),
        ),
    ]


def _copies() -> tuple[Deflate, bytes]:
    """Return a stream of forty literals and matches, and its output."""
    stream, output = Deflate().fixed().literals(*range(40)), bytearray(range(40))
    for distance, length in ((2, 20), (15, 40), (16, 17), (17, 33), (31, 48), (40, 35)):
        extra = max(0, (distance - 1).bit_length() - 2)
        symbol = 2 * extra + (distance - 1 >> extra)
        stream.match(length, symbol).number(distance - 1 & (1 << extra) - 1, extra)
        for _ in range(length):
            output.append(output[-distance])
    return stream, bytes(output)


def invalid_streams() -> list[DeflateCase]:
    """Return invalid streams."""
    return [*_counts(), *_codes(), *_lengths(), *_symbols()]


def _counts() -> list[DeflateCase]:
    def case(name: str, why: str, literals: dict[int, int], distances: dict[int, int], *counts: int) -> DeflateCase:
        stream = Deflate().dynamic(literals, distances, counts=(counts[0], counts[1]))
        return DeflateCase(name, why, "COD-5", stream.literals(7, 8, END_OF_BLOCK).end(), bytes([7, 8]))

    with_286 = {7: 2, 8: 2, END_OF_BLOCK: 2, 286: 2}
    return [
        case("hlit_287", "287 literal/length symbols, the last without a code", _TABLE, _BOTH, 287, 2),
        case("hlit_288", "288 literal/length symbols, the last two without a code", _TABLE, _BOTH, 288, 2),
        case("hlit_287_coded", "symbol 286 has a code, which does not occur", with_286, _BOTH, 287, 2),
        case("hdist_31", "31 distance symbols, the last without a code", _TABLE, _BOTH, 258, 31),
        case("hdist_32", "32 distance symbols, the last two without a code", _TABLE, _BOTH, 258, 32),
        case("hdist_31_coded", "symbol 30 has a code, which does not occur", _TABLE, {0: 1, 30: 1}, 258, 31),
    ]


def _codes() -> list[DeflateCase]:
    def case(name: str, why: str, literals: dict[int, int], distances: dict[int, int], matches: int = 0) -> DeflateCase:
        stream = Deflate().dynamic(literals, distances, counts=(258, 30)).literals(7, 8)
        for _ in range(matches):
            stream.match(3)
        return DeflateCase(name, why, "COD-6", stream.literals(END_OF_BLOCK).end(), bytes([7, 8] + [8] * (3 * matches)))

    def lengths(name: str, why: str, meta: dict[int, int]) -> DeflateCase:
        stream = Deflate().dynamic({7: 1, 8: 2, END_OF_BLOCK: 2}, _BOTH, counts=(257, 2), meta=meta)
        return DeflateCase(name, why, "COD-6", stream.literals(7, 8, END_OF_BLOCK).end(), bytes([7, 8]))

    alone = Deflate().dynamic({END_OF_BLOCK: 2}, _BOTH, 0, counts=(257, 2)).literals(END_OF_BLOCK)
    nearly = {7: 1, 8: 2, END_OF_BLOCK: 3} | {9 + i: 4 + i for i in range(12)}
    nines = Deflate().dynamic(dict.fromkeys(range(257), 9), {0: 9}, meta={9: 1}).literals(7, 8, END_OF_BLOCK)
    return [
        case("literals_over", "five literal/length codewords of 2 bits", _TABLE | {9: 2}, _BOTH),
        case("literals_incomplete", "three literal/length codewords of 2 bits", {7: 2, 8: 2, 256: 2}, _BOTH),
        case("literals_nearly", "of the literal/length code one codeword of 15 bits is missing", nearly, _BOTH),
        DeflateCase(
            "literals_one_of_2_bits",
            "a literal/length code of one codeword of 2 bits: an empty block",
            "COD-6",
            alone.fixed().literals(7, 8, END_OF_BLOCK).end(),
            bytes([7, 8]),
        ),
        case("distances_over", "three distance codewords of 1 bit", _TABLE, _BOTH | {2: 1}, 1),
        case("distances_incomplete", "three distance codewords of 2 bits", _TABLE, {0: 2, 1: 2, 2: 2}, 1),
        case("distances_incomplete_unused", "the same without a match", _TABLE, {0: 2, 1: 2, 2: 2}),
        case("distances_one_of_2_bits", "a distance code of one codeword of 2 bits", _TABLE, {0: 2}, 1),
        case("distances_one_of_15_bits", "one codeword of 15 bits, without a match", _TABLE, {0: 15}),
        lengths("lengths_over", "an oversubscribed code of code lengths", {0: 1, 1: 2, 2: 2, 3: 2}),
        lengths("lengths_incomplete", "an incomplete code of code lengths", {0: 1, 1: 2, 2: 3}),
        DeflateCase("lengths_one", "a single code length, 9, in one bit", "COD-6", nines.end(), bytes([7, 8])),
    ]


def _lengths() -> list[DeflateCase]:
    pair = {7: 1, END_OF_BLOCK: 1}
    before = [17, 7, 1, 18, 138, 18, 110, 1]  # the lengths of this pair

    def case(name: str, why: str, header: list[int]) -> DeflateCase:
        stream = Deflate().dynamic(pair, {}, header=header).literals(7, 7, END_OF_BLOCK)
        return DeflateCase(name, why, "COD-7", stream.end(), bytes([7, 7]))

    endless = Deflate().dynamic({7: 1, 8: 1}, {}, header=[17, 7, 1, 1, 18, 138, 18, 110, 0]).literals(7, 7)
    nothing = Deflate().dynamic({}, {}, header=[18, 138, 18, 119, 0]).number(0, 3)
    return [
        case("repeat_first", "code 16 before any length, as if a 0 came before", [16, 3, 17, 4, *before[2:], 0]),
        case("repeat_16_beyond", "code 16 goes on behind the last length", [*before, 16, 3]),
        case("repeat_17_beyond", "code 17 goes on behind the last length", [*before, 17, 3]),
        case("repeat_18_beyond", "code 18 goes on behind the last length", [*before, 18, 138]),
        DeflateCase("no_end", "symbol 256 has no code", "COD-7", endless.end(), bytes([7, 7])),
        DeflateCase("no_literals", "no literal/length symbol has a code", "COD-7", nothing.end(), bytes([7, 7])),
    ]


def _symbols() -> list[DeflateCase]:
    def case(name: str, why: str, stream: Deflate, output: bytes) -> DeflateCase:
        return DeflateCase(name, why, "COD-8", stream.literals(END_OF_BLOCK).end(), output)

    def fixed(*literals: int) -> Deflate:
        return Deflate().fixed().literals(*literals)

    def distances(lengths: dict[int, int]) -> Deflate:
        return Deflate().dynamic(_TABLE, lengths, counts=(258, 1)).literals(7, _LENGTH_3)

    lone = Deflate().dynamic({END_OF_BLOCK: 1}, {}, 0).code(1, 1).fixed().literals(7, 8)
    far = [_zeros(_FAR).match(35, symbol).number(0, 13) for symbol in (30, 31)]
    return [
        case(
            "symbol_286", "literal/length symbol 286, as a length of 258", fixed(7, 286).distance(0), bytes([7] * 259)
        ),
        case(
            "symbol_287", "literal/length symbol 287, as a length of 258", fixed(7, 287).distance(0), bytes([7] * 259)
        ),
        case("symbol_286_as_nothing", "literal/length symbol 286, passed over", fixed(7, 286, 8), bytes([7, 8])),
        case("distance_30", "distance symbol 30, as 24,577", far[0], _long(_FAR, 35)),
        case("distance_31", "distance symbol 31, as 24,577", far[1], _long(_FAR, 35)),
        case("no_such_literal", "the codeword 1 where 0 is the only one", lone, bytes([7, 8])),
        case(
            "no_such_distance",
            "the distance 1 where 0 is the only codeword",
            distances({0: 1}).code(1, 1),
            bytes([7] * 4),
        ),
        case(
            "match_without_distances",
            "a match where there is no distance code, and no bit for it",
            distances({}),
            bytes([7] * 4),
        ),
        case("match_without_distances_1", "the same with a bit for it", distances({}).code(0, 1), bytes([7] * 4)),
        case(
            "distance_beyond", "a match that begins a byte before the first", fixed(7).match(3, 1), bytes([0, 7, 0, 7])
        ),
        case("distance_at_once", "a match before any byte", fixed().match(3), bytes(3)),
    ]


def _zeros(count: int, first: int = 0) -> Deflate:
    """Return a block of fixed codes whose output is a byte followed by zeros, `count` bytes in total."""
    stream = Deflate().fixed().literals(first, 0)
    left = count - 2
    while left:
        stream.match(min(258, left))
        left -= min(258, left)
    return stream


def _long(before: int, length: int, first: int = 0) -> bytes:
    """Return the output of `_zeros`, followed by a copy from `before` bytes back."""
    begun = bytes([first])
    return begun.ljust(before, b"\0") + begun.ljust(length, b"\0")
