"""Tests of csplat.encoder.entropy."""

from __future__ import annotations

import itertools
import zlib

import numpy as np
import pytest

from csplat import _spec
from csplat.encoder.entropy import DeflateSettings, signed_stream, unsigned_stream
from csplat.errors import InputError


def read(stream: bytes) -> tuple[_spec.StreamHead, list[int]]:
    """Undo a stream by section 6 of the spec, one integer at a time."""
    head = _spec.unpack_stream_head(stream)
    coded = stream[_spec.STREAM_HEAD_SIZE :]
    assert head.coded_size == len(coded)
    packed = {_spec.CODER_STORED: lambda: coded, _spec.CODER_DEFLATE: lambda: zlib.decompress(coded, -15)}[head.coder]()
    assert head.packed_size == len(packed)
    transforms = [step for step in head.transforms if step]
    assert transforms == sorted(set(transforms))
    if _spec.TRANSFORM_RUN_LENGTH in transforms:
        runs = len(packed) // 3
        lengths = [1 + packed[runs + i] + 256 * packed[2 * runs + i] for i in range(runs)]
        packed = b"".join(bytes([packed[i]]) * lengths[i] for i in range(runs))
    n, w = head.count, head.width
    assert n * w == len(packed)
    if _spec.TRANSFORM_BYTE_PLANES in transforms:
        values = [sum(packed[plane * n + i] << (8 * plane) for plane in range(w)) for i in range(n)]
    else:
        values = [int.from_bytes(packed[i * w : i * w + w], "little") for i in range(n)]
    if _spec.TRANSFORM_ZIGZAG in transforms:
        values = [v >> 1 if v % 2 == 0 else 2 ** (8 * w) - 1 - (v >> 1) for v in values]
    if _spec.TRANSFORM_DELTA in transforms:
        for i in range(1, n):
            values[i] = (values[i] + values[i - 1]) % 2 ** (8 * w)
    return head, values


RNG = np.random.default_rng(0)
UNSIGNED = (
    np.array([7]), np.zeros(600, np.int64), np.repeat([3, 200], [70_000, 300]), RNG.integers(0, 255, 300),
    RNG.integers(0, 65535, 300), RNG.integers(0, 2**24, 300), RNG.integers(0, 2**51, 300),
    np.sort(RNG.integers(0, 2**48, 300)),
)  # fmt: skip


@pytest.mark.slow
def test_unsigned_streams_read_back():
    for values, library in itertools.product(UNSIGNED, ("libdeflate", "zlib")):
        for mode in ({}, {"delta": True}, {"signed_delta": True}):
            stream = unsigned_stream(values.astype(np.int64), DeflateSettings(6, library), **mode)
            assert bool(values.tolist() == read(stream)[1]), (values[:9], library, mode)


def test_signed_streams_read_back_at_every_width():
    for dtype, level in itertools.product((np.int8, np.int16, np.int32), (1, 6, 12)):
        limits = np.iinfo(dtype)
        values = np.array([0, 1, -1, limits.min, limits.max, 5, -5] * 50, dtype)
        head, read_back = read(signed_stream(values, DeflateSettings(level)))
        assert np.dtype(dtype).itemsize == head.width
        assert [int(v) % 2 ** (8 * head.width) for v in values] == read_back


def test_elements_have_the_smallest_sufficient_width_and_constant_planes_cost_a_few_bytes():
    for values, width in (([-128, 127], 1), ([-129], 2)):
        assert width == read(signed_stream(np.array(values, np.int32), DeflateSettings()))[0].width
    assert 3 == read(unsigned_stream(np.array([1 << 16]), DeflateSettings()))[0].width
    assert len(unsigned_stream(np.full(65536, 200), DeflateSettings(1))) <= _spec.STREAM_HEAD_SIZE + 3


def test_run_lengths_are_used_if_smaller_and_by_the_lowest_level():
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
