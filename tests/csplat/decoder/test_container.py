# SPDX-License-Identifier: Apache-2.0
"""Damaged files, fields, streams and JSON texts: each is refused by a typed error with code, offset and clause.

Also: csplat.decoder.entropy, csplat.decoder.index, csplat.decoder.reconstruct, csplat.decoder.tiles.
"""

from __future__ import annotations

import os
import random
import struct
import tracemalloc
import zlib

import pytest
from damage_cases import BUILT, RICH, SMALL, flipped

from csplat import _spec
from csplat.decoder import Limits, decode, decode_integers, read_header
from csplat.decoder.container import Cursor
from csplat.decoder.decode_api import ONE_THREAD
from csplat.decoder.entropy import read_stream
from csplat.errors import FormatError, LimitError, UnsupportedError
from csplat_authoring.builder import repair


@pytest.mark.slow
def test_flipped_bits_of_a_part_are_refused_by_its_reader():
    # HDR-12; every third bit, so that each bit position within a byte occurs.
    layer = read_header(SMALL).tiles[0].layers[0]
    for bit in range(8 * layer.offset, 8 * (layer.offset + layer.size), 3):
        with pytest.raises(FormatError) as caught:
            decode(flipped(SMALL, bit), tiles=[0], sh_degree=0, context=ONE_THREAD)
        assert ("E_CRC", layer.offset, "CHK-1") == (caught.value.code, caught.value.offset, caught.value.clause)


EXTREMES = {
    "B": (0, 1, 2, 127, 128, 255),
    "H": (0, 1, 255, 32768, 65535),
    "I": (0, 1, 2**24, 2**31, 2**32 - 1),
    "Q": (0, 1, 2**53, 2**63, 2**64 - 1),
    "h": (-32768, -1100, -1, 1, 1100, 32767),
    "i": (-(2**31), -(2**22) - 1, -1, 1, 2**22, 2**31 - 1),
    "q": (-(2**63), -(2**53) - 1, -(2**50), -1, 1, 2**50, 2**53, 2**63 - 1),
    "f": (0.0, -0.0, -1.0, 1e-45, 3e38, float("inf"), float("nan")),
    "d": (0.0, -0.0, -1.0, 5e-324, 2.0**-1022, 1e308, float("inf"), float("nan")),
}


def extremes(field):
    """Yield a field's bytes with its first or last component at each extreme."""
    now = RICH[field.offset : field.offset + field.size]
    if field.format.endswith("s"):
        yield from (bytes(field.size), b"\xff" * field.size)
        return
    values = struct.unpack(field.format, now)
    for i in sorted({0, len(values) - 1}):
        for value in EXTREMES[field.format[-1]]:
            yield struct.pack(field.format, *values[:i], value, *values[i + 1 :])


@pytest.mark.slow
def test_every_field_at_its_extremes_is_refused_or_decoded_within_limits():
    fields = [(name, field) for name, field in BUILT.fields.items() if not name.endswith("crc")]
    last = {(field.structure, name.rpartition(".")[2]): name for name, field in fields}
    first = {(field.structure, name.rpartition(".")[2]): name for name, field in reversed(fields)}
    values = [(name, value) for name in first.values() for value in extremes(BUILT.fields[name])]
    for name in {*last.values()} - {*first.values()}:  # with every other value
        values += [(name, value) for value in [*extremes(BUILT.fields[name])][::2]]
    for name, value in values:
        check_one(BUILT.patched({name: value}))
    assert len(values) > 600


def check_one(data: bytes) -> None:
    """Decode to floats and to integers; both succeed or both fail with an error of csplat."""
    errors = []
    for function in (decode, decode_integers):
        try:
            function(data, limits=Limits(bytes=50_000_000, json_bytes=100_000), context=ONE_THREAD)
        except (FormatError, UnsupportedError, LimitError) as error:
            errors.append(error)
    assert len(errors) in (0, 2)
    assert all(error.clause and 0 <= error.offset <= len(data) for error in errors)


@pytest.mark.slow
def test_mutations_with_all_checksums_repaired_are_refused_or_decoded():
    rng = random.Random(0)  # noqa: S311 - no secrets here
    for _ in range(int(os.environ.get("CSPLAT_MUTATIONS", "250"))):
        data = bytearray(RICH)
        for _ in range(rng.choice((1, 1, 2, 4))):
            at = rng.randrange(_spec.HEADER_SIZE, len(data) - 8)
            if rng.random() < 0.5:
                data[at] ^= 1 << rng.randrange(8)
            elif rng.random() < 0.6:
                data[at] = rng.choice((0, 1, 2, 3, 4, 5, 127, 128, 255))
            else:
                data[at : at + 4] = rng.choice((b"\xff" * 4, bytes(4), rng.randbytes(4)))
        check_one(repair(bytes(data), BUILT.records))


def test_the_header_reader_checks_the_whole_index():
    for name, value in (("sh_degree", 255), ("scene_flags", 255), ("axes", b"\7\7\7")):
        with pytest.raises((FormatError, UnsupportedError)):
            read_header(BUILT.patched({f"index.{name}": value}))


DEFLATE, RUNS = _spec.CODER_DEFLATE, bytes([_spec.TRANSFORM_RUN_LENGTH, 0, 0, 0])


def deflate(data: bytes) -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(data) + packer.flush()


def read(coded=b"abcd", *, expected=4, width_max=4, signed=False, json_bytes=None, **fields):
    """Read a stream of these bytes, with changed fields in its head."""
    head = {"width": 1, "coder": _spec.CODER_STORED, "transforms": bytes(4), "reserved": 0, "count": 4, "packed": 4}
    head = {**head, "coded_size": len(coded), **fields}
    data = memoryview(b"...." + _spec.pack_stream_head(_spec.StreamHead(*head.values())) + coded)
    more = {} if json_bytes is None else {"json_bytes": json_bytes}
    return read_stream(Cursor(data, 4, len(data), "TLE-3"), expected, width_max, signed=signed, **more)


def test_stored_deflated_and_run_length_streams_are_read():
    assert list(b"abcd") == read().tolist()
    signed = {"width": 3, "coder": DEFLATE, "count": 2, "packed": 6, "expected": 2, "signed": True}
    assert [-1, -(2**23)] == read(deflate(b"\xff\xff\xff\x00\x00\x80"), **signed).tolist()
    assert 0 == read(b"\0\xff\xff", transforms=RUNS, count=65536, packed=3, expected=65536).max()


@pytest.mark.parametrize(("fields", "clause", "place"), [
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
])  # fmt: skip
def test_inconsistent_stream_heads_are_refused(fields, clause, place):
    with pytest.raises(FormatError) as caught:
        read(**fields)
    assert (clause, 4 + _spec.STREAM_HEAD_OFFSETS[place]) == (caught.value.clause, caught.value.offset)


def test_unsupported_coders_and_transforms_and_a_truncated_head_are_refused():
    for fields in ({"coder": 2}, {"coder": 255}, {"transforms": b"\5\0\0\0"}):
        with pytest.raises(UnsupportedError, match="RES-2"):
            read(**fields)
    with pytest.raises(FormatError, match="TLE-3"):
        read_stream(Cursor(memoryview(bytes(19)), 0, 19, "TLE-3"), 1, 1)


@pytest.mark.parametrize(("fields", "clause"), [
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
])  # fmt: skip
def test_coded_bytes_of_another_size_or_coder_are_refused(fields, clause):
    with pytest.raises(FormatError, match=rf"E_CODER at byte \d+ \({clause}\)"):
        read(**fields)


def test_inflating_stops_at_the_announced_size_and_a_text_at_the_budget():
    bomb = deflate(bytes(20_000_000))
    tracemalloc.start()
    with pytest.raises(FormatError, match="more than 4 bytes"):
        read(bomb, coder=DEFLATE)
    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()
    with pytest.raises(LimitError, match=r"E_LIMIT at byte 12 \(STR-8\)"):
        read(count=2**32 - 1, packed=2**32 - 1, expected=None, json_bytes=80)
