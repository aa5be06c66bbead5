# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.decoder.metadata."""

from __future__ import annotations

import pytest
from damage_cases import declared
from tables import failures

from csplat import _spec
from csplat.decoder import decode, decode_scene, read_declared_bounds, read_metadata, read_options
from csplat.decoder.metadata import parse_json
from csplat.errors import FormatError
from csplat.scene_metadata import SceneMetadata
from csplat_authoring.builder import build
from csplat_authoring.samples import scene
from csplat_authoring.scene import Chunk

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
    assert SceneMetadata(entries={"licence": "CC0"}, cameras=[{"W": 2}]) == model.metadata == read_metadata(data)
    assert {"preset": "small"} == read_options(data) == decode_scene(data).options
    assert read_declared_bounds(data) is None


def test_declared_errors_are_read():
    data = declared(source_count=5, pruned_count=3, flags=1, records=((1, 0.5, 0.25), (4, 1.0, 1.7)))
    errors = read_declared_bounds(data)
    assert errors == decode_scene(data).declared_bounds
    assert (5, 3, True) == (errors.source_count, errors.pruned_count, errors.refitted)
    assert [("means", 0.5, 0.25), ("sh0", 1.0, 1.7)] == [(e.measure, e.max, e.rms) for e in errors.records]
