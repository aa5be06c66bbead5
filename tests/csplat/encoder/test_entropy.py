# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.encoder.entropy: streams are read back by the pseudo-code of the spec."""

from __future__ import annotations

import itertools
import zlib

import numpy as np
import pytest

from csplat import _spec
from csplat.encoder.entropy import DeflateSettings, signed_stream, unsigned_stream
from csplat.errors import InputError


@pytest.fixture(scope="module")
def read(spec):
    """Return a function that undoes a stream by the pseudo-code of the spec, to its head and integers."""

    def undo(stream: bytes) -> tuple[_spec.StreamHead, list[int]]:
        head, coded = _spec.unpack_stream_head(stream), stream[_spec.STREAM_HEAD_SIZE :]
        assert head.coder in (_spec.CODER_STORED, _spec.CODER_DEFLATE)
        packed = coded if head.coder == _spec.CODER_STORED else zlib.decompress(coded, -15)
        assert (head.coded_size, head.packed_size) == (len(coded), len(packed))
        n, w, used = head.count, head.width, [step for step in head.transforms if step]
        assert used == sorted(set(used))
        data = spec.undo_run_length(packed) if _spec.TRANSFORM_RUN_LENGTH in used else packed
        assert n * w == len(data)
        values = [int.from_bytes(data[at : at + w], "little") for at in range(0, n * w, w)]
        values = spec.undo_byte_planes(data, n, w) if _spec.TRANSFORM_BYTE_PLANES in used else values
        values = spec.undo_zigzag(values, w) if _spec.TRANSFORM_ZIGZAG in used else values
        return head, spec.undo_delta(values, w) if _spec.TRANSFORM_DELTA in used else values

    return undo


RNG = np.random.default_rng(0)
UNSIGNED = (
    np.array([7]), np.zeros(600, np.int64), np.repeat([3, 200], [70_000, 300]), RNG.integers(0, 255, 300),
    RNG.integers(0, 65535, 300), RNG.integers(0, 2**24, 300), RNG.integers(0, 2**51, 300),
    np.sort(RNG.integers(0, 2**48, 300)),
)  # fmt: skip


@pytest.mark.slow
def test_unsigned_streams_read_back(read):
    for values, library in itertools.product(UNSIGNED, ("libdeflate", "zlib")):
        for mode in ({}, {"delta": True}, {"signed_delta": True}):
            stream = unsigned_stream(values.astype(np.int64), DeflateSettings(6, library), **mode)
            assert bool(values.tolist() == read(stream)[1]), (values[:9], library, mode)


def test_signed_streams_read_back_at_every_width(read):
    for dtype, level in itertools.product((np.int8, np.int16, np.int32), (1, 6, 12)):
        limits = np.iinfo(dtype)
        values = np.array([0, 1, -1, limits.min, limits.max, 5, -5] * 50, dtype)
        head, read_back = read(signed_stream(values, DeflateSettings(level)))
        assert np.dtype(dtype).itemsize == head.width
        assert [int(v) % 2 ** (8 * head.width) for v in values] == read_back


def test_elements_have_the_smallest_sufficient_width_and_constant_planes_cost_a_few_bytes(read):
    for values, width in (([-128, 127], 1), ([-129], 2)):
        assert width == read(signed_stream(np.array(values, np.int32), DeflateSettings()))[0].width
    assert 3 == read(unsigned_stream(np.array([1 << 16]), DeflateSettings()))[0].width
    assert len(unsigned_stream(np.full(65536, 200), DeflateSettings(1))) <= _spec.STREAM_HEAD_SIZE + 3


def test_run_lengths_are_used_if_smaller_and_by_the_lowest_level(read):
    noise = RNG.integers(-20, 20, 15_000).astype(np.int8)
    pairs = np.repeat(RNG.integers(-100, 100, 6_000).astype(np.int8), RNG.integers(1, 4, 6_000))
    for values, used in ((pairs, True), (noise, False)):
        assert used == (_spec.TRANSFORM_RUN_LENGTH in read(signed_stream(values, DeflateSettings(12)))[0].transforms)
    # Like the SH of a scene where some splats have none: noise interrupted by runs of zeros.
    cut = np.where(np.repeat(RNG.random(5_000) < 0.6, 3), np.int8(0), noise)
    for values, most in ((cut, 1.15), (noise, 1.05)):
        low, high = (len(signed_stream(values, DeflateSettings(level))) for level in (1, 12))
        assert low < most * high


def test_unknown_levels_and_libraries_are_refused():
    for arguments in ((0,), (13,), (6, "gzip")):
        with pytest.raises(InputError):
            DeflateSettings(*arguments)
