"""DEFLATE streams of the suite and the validator's own inflate, against zlib."""

import random
import zlib

import pytest
from tables import failures

from csplat_authoring.coders import Deflate, deflate_dynamic, deflate_fixed, deflate_stored
from csplat_authoring.recipes.deflate_streams import broken_streams, sound_streams
from csplat_conformance.validator.inflate import CodedError, Inflater
from csplat_conformance.validator.streams import undo_coder

DEFLATE = 1
SIZE = 2000


def by_zlib(coded, size=SIZE):
    """Output and bytes read, or what is wrong, or that there is more output than `size`."""
    inflater = zlib.decompressobj(-15)
    try:
        out = inflater.decompress(coded, size + 1)
    except zlib.error:
        return "refused"
    if len(out) > size:
        return "long"
    return (out, len(coded) - len(inflater.unused_data)) if inflater.eof else "refused"


def by_validator(coded, size=SIZE):
    inflater = Inflater(coded)
    try:
        out = inflater.inflate(size)
    except CodedError:
        return "refused"
    return "long" if len(out) > size else (out, inflater.used)


def test_sound_streams_give_their_output():
    def check(case):
        size = len(case.output)
        assert (case.output, len(case.coded)) == by_zlib(case.coded, size)
        assert (case.output, len(case.coded)) == by_validator(case.coded, size)

    assert [] == failures(sound_streams(), check)


def test_broken_streams_are_refused_for_their_clause():
    def check(case):
        assert "refused" == by_zlib(case.coded, len(case.output))
        with pytest.raises(CodedError) as caught:
            undo_coder(memoryview(case.coded), DEFLATE, len(case.output))
        assert case.clause == caught.value.clause

    assert [] == failures(broken_streams(), check)


def damaged(count):
    """Yield streams with a few bits flipped, most of them in the header of the first block."""
    rng = random.Random(1)  # noqa: S311 - damage is no secret
    cases = [case.coded for case in sound_streams() + broken_streams() if len(case.output) < SIZE]
    text = bytes(rng.choice(b"aaaabbcdefgh") for _ in range(300))
    packers = [zlib.compressobj(9, zlib.DEFLATED, -15, 9, way) for way in (0, 2, 3, 4)]
    texts = [packer.compress(text) + packer.flush() for packer in packers]
    texts += [deflate_dynamic(text), deflate_fixed(text), deflate_stored(text, 90)]
    for _ in range(count):
        coded = bytearray(rng.choice(rng.choice((cases, texts))))
        for _ in range(rng.choice((1, 1, 2, 3))):
            bit = rng.randrange(min(8 * len(coded), rng.choice((40, 120, 3000))))
            coded[bit >> 3] ^= 1 << (bit & 7)
        yield bytes(coded)


@pytest.mark.slow
def test_the_slow_inflate_reads_what_zlib_reads_and_refuses_the_rest():
    verdicts = [(by_zlib(coded), by_validator(coded)) for coded in damaged(1500)]

    assert [] == [pair for pair in verdicts if pair[0] != pair[1]]
    refused = sum(zlib_says == "refused" for zlib_says, _ in verdicts)
    assert 375 < refused < 1300


def test_a_code_of_code_lengths_without_codewords_is_refused():
    nothing = Deflate().number(1, 1).number(2, 2).number(0, 14 + 4 * 3 + 258 + 3).end()

    assert "refused" == by_zlib(nothing) == by_validator(nothing)
