# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_conformance.validator.inflate."""

import pytest
from tables import failures
from validator_cases import by_validator, by_zlib, damaged

from csplat_authoring.coders import Deflate
from csplat_authoring.recipes.deflate_streams import invalid_streams, valid_streams
from csplat_conformance.validator.inflate import CodedError
from csplat_conformance.validator.streams import undo_coder

DEFLATE = 1


def test_valid_deflate_streams_give_their_output():
    def check(case):
        size = len(case.output)
        assert (case.output, len(case.coded)) == by_zlib(case.coded, size)
        assert (case.output, len(case.coded)) == by_validator(case.coded, size)

    assert [] == failures(valid_streams(), check)


@pytest.mark.slow
def test_inflate_accepts_the_same_streams_as_zlib():
    verdicts = [(by_zlib(coded), by_validator(coded)) for coded in damaged(600)]
    assert [] == [pair for pair in verdicts if pair[0] != pair[1]]
    assert 150 < sum(expected == "refused" for expected, _ in verdicts) < 520


def test_a_code_of_code_lengths_without_codewords_is_refused():
    nothing = Deflate().number(1, 1).number(2, 2).number(0, 14 + 4 * 3 + 258 + 3).end()
    assert "refused" == by_zlib(nothing) == by_validator(nothing)


def test_invalid_deflate_streams_are_refused_with_their_clause():
    def check(case):
        assert "refused" == by_zlib(case.coded, len(case.output))
        with pytest.raises(CodedError) as caught:
            undo_coder(memoryview(case.coded), DEFLATE, len(case.output))
        assert case.clause == caught.value.clause

    assert [] == failures(invalid_streams(), check)
