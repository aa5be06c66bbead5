"""Streams and JSON texts that a decoder must refuse."""

from __future__ import annotations

import tracemalloc
import zlib

import pytest

from csplat import _spec
from csplat.decoder import decode, decode_scene, read_cameras, read_declared_bounds, read_metadata, read_options
from csplat.decoder.container import Cursor
from csplat.decoder.entropy import read_stream
from csplat.decoder.metadata import parse_json
from csplat.errors import FormatError, LimitError, UnsupportedError
from csplat_authoring.builder import build
from csplat_authoring.samples import scene
from csplat_authoring.scene import Chunk

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
    ("fields", "clause"), [({"coder": 2}, "RES-2"), ({"coder": 255}, "RES-2"), ({"transforms": b"\5\0\0\0"}, "RES-2")]
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


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"[]",
        b"1",
        b"{} x",
        b"\xef\xbb\xbf{}",
        b'{"a": NaN}',
        b'{"a": Infinity}',
        b'{"a": -Infinity}',
        b'{"a": 1e999}',
        b'{"a": ' + b"9" * 5000 + b"}",
        b'{"a": 1, "a": 2}',
        b'{"b": {"a": 1, "a": 2}}',
        b'{"a": "\xff"}',
        b'{"a": "\\ud800"}',
        b'{"\\udfff": 1}',
        b'{"a": "\x01"}',
        b'{"a": 01}',
        b"{'a': 1}",
        b'{"a": ' + b"[" * 64 + b"]" * 64 + b"}",
        b'{"a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}",
        b'{"a":' * 5000 + b"1" + b"}" * 5000,
    ],
    ids=lambda text: repr(text[:16]),
)
def test_what_is_not_strict_json_is_refused(text):
    with pytest.raises(FormatError, match=r"E_JSON at byte 99 \(JSN-1\)"):
        parse_json(text, dict, 99)


def test_what_is_strict_json_is_read():
    deep = b'{"a": ' + b"[" * 63 + b"]" * 63 + b"}"
    assert "a" in parse_json(deep, dict, 0)
    assert {"a": "😀", "b": 10**200} == parse_json(b'{"a": "\\ud83d\\ude00", "b": 1' + b"0" * 200 + b"}", dict, 0)
    with pytest.raises(FormatError, match="an array of objects"):
        parse_json(b"[1]", list, 0)


def test_the_three_texts_reach_their_places():
    data = build(
        scene(
            chunks=(
                Chunk(_spec.CHUNK_METADATA, b'{"licence": "CC0"}'),
                Chunk(_spec.CHUNK_CAMERAS, b'[{"W": 2}]'),
                Chunk(_spec.CHUNK_OPTIONS, b'{"preset": "small"}'),
            )
        )
    ).data
    model = decode(data)
    assert ({"licence": "CC0"}, [{"W": 2}]) == (model.metadata, model.cameras)
    assert ({"licence": "CC0"}, [{"W": 2}]) == (read_metadata(data), read_cameras(data))
    assert {"preset": "small"} == read_options(data) == decode_scene(data).options
    assert read_declared_bounds(data) is None


def stated(source_count=2, pruned_count=0, flags=0, records=()):
    head = _spec.pack_stated_errors_head(_spec.StatedErrorsHead(source_count, pruned_count, 0, flags, len(records)))
    body = [
        _spec.pack_stated_error_record(_spec.StatedErrorRecord(measure, 0, 0, 0, largest, rms))
        for measure, largest, rms in records
    ]
    return build(scene(chunks=(Chunk(_spec.CHUNK_STATED_ERRORS, payload=head + b"".join(body)),))).data


def test_stated_errors():
    data = stated(source_count=5, pruned_count=3, flags=1, records=((1, 0.5, 0.25), (4, 1.0, 1.7)))
    errors = read_declared_bounds(data)
    assert errors == decode_scene(data).declared_bounds
    assert (5, 3, True) == (errors.source_count, errors.pruned_count, errors.refitted)
    assert [("means", 0.5, 0.25), ("sh0", 1.0, 1.7)] == [(e.measure, e.max, e.rms) for e in errors.records]


@pytest.mark.parametrize(
    ("fields", "clause"),
    [
        ({"records": ((0, 1.0, 1.0),)}, "SER-1"),
        ({"records": ((8, 1.0, 1.0),)}, "SER-1"),
        ({"records": ((2, 1.0, 1.0), (2, 1.0, 1.0))}, "SER-1"),
        ({"records": ((1, 1.0, 1.1),)}, "SER-2"),
        ({"records": ((4, 1.0, 1.8),)}, "SER-2"),
        ({"records": ((1, float("nan"), 0.0),)}, "SER-2"),
        ({"records": ((1, float("inf"), 0.0),)}, "SER-2"),
        ({"records": ((1, 1.0, -1.0),)}, "SER-2"),
        ({"pruned_count": 1}, "SER-4"),
        ({"flags": 2}, "RES-1"),
    ],
)
def test_stated_errors_that_cannot_be(fields, clause):
    with pytest.raises(FormatError, match=clause):
        decode(stated(**fields))
