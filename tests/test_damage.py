"""Damaged files, fields, streams and JSON texts: each is refused by a typed error with code, offset and clause."""

from __future__ import annotations

import os
import random
import struct
import tracemalloc
import zlib

import pytest
from tables import failures

import csplat
from csplat import _spec
from csplat.decoder import (
    Limits,
    decode,
    decode_integers,
    decode_scene,
    read_cameras,
    read_declared_bounds,
    read_header,
    read_metadata,
    read_options,
)
from csplat.decoder.container import Cursor
from csplat.decoder.entropy import read_stream
from csplat.decoder.metadata import parse_json
from csplat.errors import CsplatError, FormatError, LimitError, UnsupportedError
from csplat_authoring.builder import build, chunk_records, repair
from csplat_authoring.samples import rich_scene, scene
from csplat_authoring.scene import Chunk
from csplat_conformance.manifest import VECTORS

SMALL = (VECTORS / "valid" / "worked_example.csplat").read_bytes()
BUILT = build(rich_scene())
RICH = BUILT.data
SMALL_LIMITS = Limits(bytes=50_000_000, json_bytes=100_000)


def flipped(data, bit):
    """Return a copy of the data with another value of a bit."""
    damaged = bytearray(data)
    damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


@pytest.mark.parametrize("data", [SMALL, RICH], ids=["small", "rich"])
def test_every_prefix_is_refused_as_truncated(data):
    # CNF-3
    for size in range(len(data)):
        with pytest.raises(csplat.FormatError) as caught:
            csplat.decode(data[:size], threads=1)
        assert "E_TRUNCATED" == caught.value.code, size
        assert caught.value.clause
        assert 0 <= caught.value.offset <= size
    assert "E_MAGIC" == refusal(b"ply\n").code


def test_every_prefix_with_its_size_and_checksums_repaired_is_refused():
    for size in range(_spec.HEADER_SIZE, len(SMALL)):
        cut = bytearray(SMALL[:size])
        cut[20:28] = size.to_bytes(8, "little")
        with pytest.raises(csplat.CsplatError):
            csplat.decode(repair(bytes(cut)), threads=1)


@pytest.mark.slow
@pytest.mark.parametrize(("data", "stride"), [(SMALL, 1), (RICH, 73)], ids=["small", "rich"])
def test_every_flipped_bit_is_refused(data, stride):
    # CNF-3; every 73rd bit of the larger file, so that each bit position within a byte occurs. After magic and
    # version a CRC refuses (HDR-12).
    named = range(8 * _spec.HEADER_OFFSETS["profile"])
    for bit in range(0, 8 * len(data), stride):
        with pytest.raises(csplat.CsplatError) as caught:
            csplat.decode(flipped(data, bit), threads=1)
        assert caught.value.code in ({"E_MAGIC", "E_VERSION"} if bit in named else {"E_CRC"}), bit
        assert 0 <= caught.value.offset <= len(data)


@pytest.mark.slow
def test_flipped_bits_of_a_part_are_refused_by_its_reader():
    # HDR-12; every third bit, so that each bit position within a byte occurs.
    layer = read_header(SMALL).tiles[0].layers[0]
    for bit in range(8 * layer.offset, 8 * (layer.offset + layer.size), 3):
        with pytest.raises(csplat.FormatError) as caught:
            csplat.decode(flipped(SMALL, bit), tiles=[0], sh_degree=0, threads=1)
        assert ("E_CRC", layer.offset, "CHK-1") == (caught.value.code, caught.value.offset, caught.value.clause)


@pytest.mark.slow
def test_flipped_bits_with_all_checksums_repaired_are_refused_or_decoded():
    records = chunk_records(SMALL)
    # Every seventh bit, so that each bit position within a byte occurs.
    for bit in range(0, 8 * len(SMALL), 7):
        try:
            model = csplat.decode(repair(flipped(SMALL, bit), records), threads=1)
        except csplat.CsplatError:
            continue
        assert 2 == len(model)


@pytest.mark.parametrize("extra", [b"\0", b"\n", SMALL], ids=["zero", "line feed", "itself"])
def test_trailing_bytes_are_refused(extra):
    with pytest.raises(csplat.FormatError) as caught:
        csplat.decode(SMALL + extra)
    assert ("E_TRAILING", len(SMALL)) == (caught.value.code, caught.value.offset)


def refusal(data, **arguments) -> CsplatError:
    with pytest.raises((FormatError, UnsupportedError, LimitError)) as caught:
        decode(data, **arguments)
    error = caught.value
    assert error.clause
    assert 0 <= error.offset <= len(data)
    return error


def test_the_version_error_names_both_versions():
    data = bytearray(RICH)
    data[8:12] = struct.pack("<HH", 3, 7)
    error = refusal(data)
    assert "E_VERSION" == error.code
    assert "3.7" in str(error)
    assert "reads 0.3" in str(error)


def test_a_crc_error_names_the_stored_and_computed_values():
    data = bytearray(RICH)
    data[16] ^= 1
    computed = zlib.crc32(data[:28])
    stored = int.from_bytes(data[28:32], "little")
    assert f"E_CRC at byte 28 (HDR-3): found {stored:#010x}, computed {computed:#010x}" == str(refusal(data))


def test_huge_counts_in_a_small_index_cost_nothing():
    for name in ("tile_count", "directory_count", "codebook_count", "extra_count", "attribute_count"):
        wide = {"tile_count": 2**32 - 1, "attribute_count": 255}.get(name, 65535)
        error = refusal(BUILT.patched({f"index.{name}": wide}))
        assert ("E_INDEX", "IDX-2") == (error.code, error.clause)
    assert "IDX-7" == refusal(BUILT.patched({"index.splat_count": 2**63})).clause


_EXTREMES = {
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
        code = field.format[-1]
        for value in _EXTREMES[code]:
            yield struct.pack(field.format, *values[:i], value, *values[i + 1 :])


@pytest.mark.slow
def test_every_field_at_its_extremes_is_refused_or_decoded_within_limits():
    # The first and the last occurrence of each field of a structure.
    places = {}
    for name, field in BUILT.fields.items():
        if not name.endswith("crc"):
            places.setdefault((field.structure, name.rpartition(".")[2]), []).append(name)
    tried = 0
    first = {names[0] for names in places.values()}
    for name in first | {names[-1] for names in places.values()}:
        # Every other value at the last occurrence.
        for value in [*extremes(BUILT.fields[name])][:: 1 if name in first else 2]:
            check_one(BUILT.patched({name: value}))
            tried += 1
    assert tried > 600


def check_one(data: bytes) -> None:
    """Decode to floats and to integers; both succeed or both fail with an error of csplat."""
    errors = [error_of(function, data) for function in (decode, decode_integers)]
    assert (errors[0] is None) == (errors[1] is None)
    for error in filter(None, errors):
        assert error.clause
        assert 0 <= error.offset <= len(data)


def error_of(function, data: bytes) -> FormatError | UnsupportedError | LimitError | None:
    try:
        function(data, limits=SMALL_LIMITS, threads=1)
    except (FormatError, UnsupportedError, LimitError) as error:
        return error
    return None


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
    for name in ("index.sh_degree", "index.scene_flags", "index.axes"):
        with pytest.raises((FormatError, UnsupportedError)):
            read_header(BUILT.patched({name: b"\7\7\7" if name.endswith("axes") else 255}))


STORED, DEFLATE = _spec.CODER_STORED, _spec.CODER_DEFLATE
RUNS = bytes([_spec.TRANSFORM_RUN_LENGTH, 0, 0, 0])
NONE = bytes(4)


def deflate(data: bytes) -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(data) + packer.flush()


def read(coded=b"abcd", *, expected=4, width_max=4, signed=False, json_bytes=None, **fields):
    """Read a stream of these bytes, with changed fields in its head."""
    head = {"width": 1, "coder": STORED, "transforms": NONE, "reserved": 0, "count": 4, "packed": 4}
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


def test_inflating_stops_at_the_announced_size():
    bomb = deflate(bytes(20_000_000))
    tracemalloc.start()
    with pytest.raises(FormatError, match="more than 4 bytes"):
        read(bomb, coder=DEFLATE)
    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()


def test_a_text_beyond_the_budget_is_refused():
    with pytest.raises(LimitError, match=r"E_LIMIT at byte 12 \(STR-8\)"):
        read(count=2**32 - 1, packed=2**32 - 1, expected=None, json_bytes=80)


NOT_JSON = (
    b"", b"{", b"[]", b"1", b"{} x", b"\xef\xbb\xbf{}", b'{"a": NaN}', b'{"a": Infinity}', b'{"a": -Infinity}',
    b'{"a": 1e999}', b'{"a": ' + b"9" * 5000 + b"}", b'{"a": 1, "a": 2}', b'{"b": {"a": 1, "a": 2}}', b'{"a": "\xff"}',
    b'{"a": "\\ud800"}', b'{"\\udfff": 1}', b'{"a": "\x01"}', b'{"a": 01}', b"{'a': 1}",
    b'{"a": ' + b"[" * 64 + b"]" * 64 + b"}", b'{"a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    b'{"a":' * 5000 + b"1" + b"}" * 5000,
)  # fmt: skip


def test_invalid_json_is_refused():
    def check(text):
        with pytest.raises(FormatError, match=r"E_JSON at byte 99 \(JSN-1\)"):
            parse_json(text, dict, 99)

    assert [] == failures({repr(text[:40]): text for text in NOT_JSON}, check)


def test_valid_json_is_read():
    deep = b'{"a": ' + b"[" * 63 + b"]" * 63 + b"}"
    assert "a" in parse_json(deep, dict, 0)
    assert {"a": "😀", "b": 10**200} == parse_json(b'{"a": "\\ud83d\\ude00", "b": 1' + b"0" * 200 + b"}", dict, 0)
    with pytest.raises(FormatError, match="an array of objects"):
        parse_json(b"[1]", list, 0)


def test_the_three_json_texts_are_read():
    texts = {
        _spec.CHUNK_METADATA: b'{"licence": "CC0"}',
        _spec.CHUNK_CAMERAS: b'[{"W": 2}]',
        _spec.CHUNK_OPTIONS: b'{"preset": "small"}',
    }
    data = build(scene(chunks=tuple(Chunk(*one) for one in texts.items()))).data
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


def test_declared_errors_are_read():
    data = stated(source_count=5, pruned_count=3, flags=1, records=((1, 0.5, 0.25), (4, 1.0, 1.7)))
    errors = read_declared_bounds(data)
    assert errors == decode_scene(data).declared_bounds
    assert (5, 3, True) == (errors.source_count, errors.pruned_count, errors.refitted)
    assert [("means", 0.5, 0.25), ("sh0", 1.0, 1.7)] == [(e.measure, e.max, e.rms) for e in errors.records]


@pytest.mark.parametrize(("fields", "clause"), [
    ({"records": ((0, 1.0, 1.0),)}, "SER-1"),
    ({"records": ((9, 1.0, 1.0),)}, "SER-1"),
    ({"records": ((2, 1.0, 1.0), (2, 1.0, 1.0))}, "SER-1"),
    ({"records": ((1, 1.0, 1.1),)}, "SER-2"),
    ({"records": ((4, 1.0, 1.8),)}, "SER-2"),
    ({"records": ((1, float("nan"), 0.0),)}, "SER-2"),
    ({"records": ((1, float("inf"), 0.0),)}, "SER-2"),
    ({"records": ((1, 1.0, -1.0),)}, "SER-2"),
    ({"pruned_count": 1}, "SER-4"),
    ({"flags": 2}, "RES-1"),
])  # fmt: skip
def test_impossible_declared_errors_are_refused(fields, clause):
    with pytest.raises(FormatError, match=clause):
        decode(stated(**fields))
