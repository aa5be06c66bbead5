# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.decoder.limits.

Also: csplat.decoder.budget, csplat.decoder.codebooks.
"""

from dataclasses import replace

import pytest

from csplat import _spec
from csplat.decoder import Limits, decode, iter_tiles
from csplat.errors import FormatError, LimitError
from csplat_authoring.builder import build
from csplat_authoring.samples import rich_scene, rows_of, scene
from csplat_authoring.scene import Codebook

RICH = build(rich_scene()).data


def test_limits_are_enforced():
    for name, most in (("splats", 4), ("bytes", 5 * (14 + 24) * 4), ("json_bytes", 255)):
        with pytest.raises(LimitError, match="E_LIMIT at byte") as caught:
            decode(RICH, limits=Limits(**{name: most}))
        assert name == caught.value.limit
    decode(RICH, limits=Limits(splats=5, json_bytes=256))
    assert 2 == len(decode(RICH, limits=Limits(splats=2), tiles=[1]))
    assert 2 == len(list(iter_tiles(RICH, limits=Limits(splats=5))))
    with pytest.raises(LimitError, match="splats"):
        iter_tiles(RICH, limits=Limits(splats=4))


def test_the_budget_includes_codebooks():
    sh, every = _spec.CODEBOOK_KIND_SH, {1: 9, 2: 15, 3: 21, 4: 27}
    shape = _spec.CODEBOOK_KIND_SHAPE
    for kind, bands, columns in ((shape, (0, 0), {0: 6}), (sh, (1, 4), every), (sh, (2, 2), {2: 15})):
        entries = {layer: [[0] * c] * 7 for layer, c in columns.items()}
        data = build(replace(scene(4), codebooks=(Codebook(4, kind, entries, bands),))).data
        limit = 2 * 4 * (3 + 4 + 3 + 1 + 3 * 25) + 4 * 7 * sum(columns.values())
        decode(data, limits=Limits(bytes=limit))
        with pytest.raises(LimitError, match=f"{limit}"):
            decode(data, limits=Limits(bytes=limit - 1))


def test_unused_codebooks_are_checked_and_counted():
    entries = {1: rows_of(1, 40, 9, -60, 60)}
    built = build(replace(scene(1), codebooks=(Codebook(4, _spec.CODEBOOK_KIND_SH, entries, (1, 1)),)))
    assert 2 == len(decode(built.data))
    with pytest.raises(LimitError):
        decode(built.data, limits=Limits(bytes=1600))
    decode(built.data, limits=Limits(bytes=1600), tiles=[0])
    name = next(name for name in built.fields if name.startswith("CODB") and name.endswith("count"))
    with pytest.raises(FormatError):
        decode(built.patched({name: 7}))
