# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.disk_files."""

from __future__ import annotations

import json
import math
import warnings

import numpy as np
import pytest
from formats_cases import header_of, npy

from csplat.disk_files import parse_json, read_array
from csplat.errors import InputError


def test_arrays_are_read_and_refused_unless_they_fit_their_file(tmp_path):
    path = tmp_path / "a.npy"
    for shape, data in (("(1000000000000,)", b"abcd"), ("(4,)", b"abc"), ("(4,)", b"abcde")):
        path.write_bytes(npy(header_of(shape=shape), data))
        with pytest.raises(InputError, match="does not fit its"):
            read_array(path)
    for array in (np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6).reshape(2, 3)), np.array("text")):
        np.save(path, array)
        assert np.array_equal(array, read_array(path))
    assert read_array(path).flags.writeable
    path.write_bytes(npy(header_of(shape="(4L,)"), b"abcd"))  # as Python 2 wrote it
    with warnings.catch_warnings(action="error"):
        assert 4 == len(read_array(path))


@pytest.mark.parametrize(("text", "message"), [
    ("[" * 100_000, "nested too deep"),
    ('{"a": [' * 251 + "]}" * 251, "nested too deep"),
    ("1" * 5000, "an integer has 5,000 digits, expected at most 300"),
    ('{"a": -%s}' % ("1" * 400), "an integer has 401 digits"),
    (r'["\ud800"]', "half of a surrogate pair"),
    (rb'{"\uDC00": 1}', "half of a surrogate pair"),
    (b'"\xed\xa0\x80"', "can't decode"),
    (b"{", "Expecting property name"),
])  # fmt: skip
def test_json_that_python_accepts_or_fails_on_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        parse_json(text)


def test_brackets_of_json_count_outside_strings_alone():
    text = "[" * 500 + r'"[{\"[", "' + "[" * 1000 + '"' + "]" * 500
    assert text == json.dumps(parse_json(text))


def test_json_is_parsed_in_each_encoding():
    for encoding in ("utf-8", "utf-8-sig", "utf-16", "utf-32"):
        assert {"é": [1e300, math.inf, "😀"]} == parse_json('{"é": [1e300, 1e999, "\\ud83d\\ude00"]}'.encode(encoding))
