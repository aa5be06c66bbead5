"""JSON chunks (JSN-1) and stated errors."""

import pytest

from csplat import _spec
from csplat.decoder import decode, decode_scene, read_cameras, read_declared_bounds, read_metadata, read_options
from csplat.decoder.metadata import parse_json
from csplat.errors import FormatError
from csplat_authoring.builder import build
from csplat_authoring.samples import scene
from csplat_authoring.scene import Chunk


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
