"""Streams made by hand: heads at their extremes, coders that end early, late or with something behind."""

import tracemalloc
import zlib

import pytest

from csplat import _spec
from csplat.decoder.container import Cursor
from csplat.decoder.entropy import read_stream
from csplat.errors import FormatError, LimitError, UnsupportedError

STORED, DEFLATE = _spec.CODER_STORED, _spec.CODER_DEFLATE
RUNS = bytes([_spec.TRANSFORM_RUN_LENGTH, 0, 0, 0])
NONE = bytes(4)


def deflate(data: bytes) -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(data) + packer.flush()


def read(
    coded=b"abcd",
    *,
    width=1,
    coder=STORED,
    transforms=NONE,
    reserved=0,
    count=4,
    packed=4,
    coded_size=None,
    wanted=4,
    width_max=4,
    **arguments,
):
    head = _spec.StreamHead(
        width, coder, transforms, reserved, count, packed, len(coded) if coded_size is None else coded_size
    )
    data = memoryview(b"...." + _spec.pack_stream_head(head) + coded)
    cursor = Cursor(data, 4, len(data), "TLE-3")
    return read_stream(cursor, wanted, width_max, **arguments)


def test_a_stored_stream():
    assert list(b"abcd") == read().tolist()


def test_a_deflated_stream_of_three_byte_elements_is_signed():
    data = b"\xff\xff\xff\x00\x00\x80"
    expected = [-1, -(2**23)]
    assert expected == read(deflate(data), width=3, coder=DEFLATE, count=2, packed=6, wanted=2, signed=True).tolist()


@pytest.mark.parametrize(
    ("fields", "clause", "place"),
    [
        ({"count": 3}, "STR-1", "count"),
        ({"count": 0, "packed": 0}, "STR-1", "count"),
        ({"count": 2**32 - 1, "packed": 2**32 - 1}, "STR-1", "count"),
        ({"width": 0}, "STR-2", "width"),
        ({"width": 5, "packed": 20}, "STR-2", "width"),
        ({"transforms": b"\2\1\0\0"}, "STR-3", "transforms"),
        ({"transforms": b"\1\1\0\0"}, "STR-3", "transforms"),
        ({"transforms": b"\1\0\2\0"}, "STR-3", "transforms"),
        ({"packed": 5}, "STR-4", "packed_size"),
        ({"packed": 2**32 - 1}, "STR-4", "packed_size"),
        ({"transforms": RUNS, "packed": 4}, "STR-5", "packed_size"),
        ({"transforms": RUNS, "packed": 0}, "STR-5", "packed_size"),
        ({"transforms": RUNS, "packed": 15}, "STR-5", "packed_size"),
        ({"coded_size": 5}, "STR-6", "coded_size"),
        ({"coded_size": 2**32 - 1}, "STR-6", "coded_size"),
        ({"reserved": 1}, "RES-1", "reserved_0"),
    ],
)
def test_heads_that_contradict_their_place(fields, clause, place):
    with pytest.raises(FormatError) as caught:
        read(**fields)
    assert (clause, 4 + _spec.STREAM_HEAD_OFFSETS[place]) == (caught.value.clause, caught.value.offset)


@pytest.mark.parametrize(
    ("fields", "clause"),
    [
        ({"coder": 2}, "RES-2"),
        ({"coder": 255}, "RES-2"),
        ({"transforms": b"\5\0\0\0"}, "RES-2"),
    ],
)
def test_what_this_version_lacks(fields, clause):
    with pytest.raises(UnsupportedError, match=clause):
        read(**fields)


def test_a_head_that_is_cut():
    with pytest.raises(FormatError, match="TLE-3"):
        read_stream(Cursor(memoryview(bytes(19)), 0, 19, "TLE-3"), 1, 1)


@pytest.mark.parametrize(
    ("fields", "clause"),
    [
        ({"coded": b"abc"}, "COD-1"),
        ({"coded": b"abcde"}, "COD-1"),
        ({"coder": DEFLATE, "coded": b""}, "COD-2"),
        ({"coder": DEFLATE, "coded": b"\xff\xff"}, "COD-2"),
        ({"coder": DEFLATE, "coded": deflate(b"abc")}, "COD-2"),
        ({"coder": DEFLATE, "coded": deflate(b"abcde")}, "COD-2"),
        ({"coder": DEFLATE, "coded": deflate(b"abcd")[:-1]}, "COD-2"),
        ({"coder": DEFLATE, "coded": deflate(b"abcd") + b"\0"}, "COD-2"),
        ({"coder": DEFLATE, "coded": deflate(b"abcd") * 2}, "COD-2"),
        ({"coder": DEFLATE, "coded": zlib.compress(b"abcd")}, "COD-2"),
        ({"coded": b"a\1\1", "transforms": RUNS, "packed": 3}, "TRF-1"),
        ({"coded": b"a\2\0", "transforms": RUNS, "packed": 3}, "TRF-1"),
    ],
)
def test_coded_bytes_that_do_not_give_what_they_should(fields, clause):
    with pytest.raises(FormatError, match=rf"E_CODER at byte \d+ \({clause}\)"):
        read(**fields)


def test_inflating_stops_at_the_announced_size():
    bomb = deflate(bytes(20_000_000))
    tracemalloc.start()
    with pytest.raises(FormatError, match="more than 4 bytes"):
        read(bomb, coder=DEFLATE)
    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()


def test_a_text_that_exceeds_the_budget():
    with pytest.raises(LimitError, match=r"E_LIMIT at byte 12 \(STR-8\)"):
        read(count=2**32 - 1, packed=2**32 - 1, wanted=None, count_max=10)


def test_the_longest_runs():
    assert 0 == read(b"\0\xff\xff", transforms=RUNS, count=65536, packed=3, wanted=65536).max()
