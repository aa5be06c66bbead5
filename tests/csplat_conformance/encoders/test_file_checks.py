# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_conformance.encoders.file_checks."""

import re
from dataclasses import replace

import numpy as np
import pytest
from encoder_runs_cases import INPUTS, PLAIN, judged
from models import model_of

import csplat
from csplat.decoder import decode_scene
from csplat.errors import InputError
from csplat_conformance.conformance_report import Status
from csplat_conformance.encoders.file_checks import check_content, check_stream, pair_splats


@pytest.mark.slow
def test_pairs_are_found_however_the_file_is_ordered():
    source = INPUTS["ordinary/two_tiles"].source().means.astype(np.float64)
    order = np.random.default_rng(1).permutation(len(source))[:60_000]
    moved = source[order] + np.random.default_rng(2).uniform(-0.01, 0.01, (60_000, 3))
    found = pair_splats(source, moved, 0.06)
    np.testing.assert_array_equal(order, found.source_index)
    assert (0, 0, len(source) - 60_000) == (found.strays, found.surplus, found.missing)
    duplicates = pair_splats(np.zeros((3, 3)), np.full((3, 3), 0.01), 1.0)  # each with its own
    assert [0, 1, 2] == sorted(duplicates.source_index)


@pytest.mark.parametrize(("source", "decoded", "counts"), [
    ([[0, 0, 0], [1, 0, 0], [5, 0, 0]], [[0.1, 0, 0], [0.9, 0, 0], [1.1, 0, 0], [3, 0, 0]], (1, 1, 1)),
    ([[0, 0, 0]] * 3, [[0, 0, 0]] * 4, (0, 1, 0)),
    ([[0, 0, 0]] * 3, [[0, 0, 0]], (0, 0, 2)),
    ([[0, 0, 0]], [[np.inf, 0, 0], [-1e300, 1e300, 0], [0, 0, 0]], (2, 0, 0)),
    ([], [[np.inf, 0, 0], [-1e300, 1e300, 0], [0, 0, 0]], (3, 0, 0)),
    ([[0, 0, 0]] * 5, [], (0, 0, 5)),
])  # fmt: skip
def test_strays_surplus_and_missing_splats_are_distinguished(source, decoded, counts):
    found = pair_splats(np.reshape(source, (-1, 3)).astype(float), np.reshape(decoded, (-1, 3)).astype(float), 1.0)
    assert counts == (found.strays, found.surplus, found.missing)


def test_splats_without_a_near_source_are_named(plain):
    moved = plain.means.copy()
    moved[:3, 0] += 7.0
    moved[5] = moved[6]
    content, errors, _ = judged(PLAIN, replace(plain, means=moved))
    assert (Status.FAILED, ("CNF-6", "SER-5")) == (content.status, content.clauses)
    assert Status.SKIPPED is errors.status
    assert re.match(
        r"3 splats of the file, the first splat \d+, are not within 0.03 of a splat of the source; "
        r"splat \d+ of the file is near a splat of the source that another splat already represents; [^;]*$",
        content.message,
    )


@pytest.mark.parametrize(("fact", "message"), [
    ({"coordinate_system": "RDF"}, "axes is RDF"),
    ({"unit_metres": 1.0}, "unit_metres is 1.0"),
    ({"antialiased": True}, "antialiased is True"),
    ({"colour_space": "lin_rec709_display"}, "colour_space is lin_rec709_display"),
    ({"extra": {"id": np.zeros(216, "<u4")}}, "the source has no extra column 'id'"),
])  # fmt: skip
def test_facts_that_differ_from_the_source_break_their_clause(plain, fact, message):
    content, *_ = judged(PLAIN, model_of(**{**vars(plain), **fact}), keep_extra=True)
    assert (Status.FAILED, ("SRC-3",)) == (content.status, content.clauses)
    assert message in content.message


def test_leaving_much_out_causes_a_warning():
    one = INPUTS["ordinary/degree_0"]
    for kept, status in ((100, Status.WARNED), (200, Status.PASSED)):
        scene = decode_scene(csplat.encode(one.source().to_model((0.0, 0.0, 0.0)).select(np.arange(kept))))
        declared = replace(scene.declared_bounds, source_count=216, pruned_count=216 - kept)
        content, _ = check_content(one, one.source(), replace(scene, declared_bounds=declared), None)
        assert status is content.status
        assert str(216 - kept) in content.message


def test_centres_in_doubles_are_compared_in_doubles():
    # Four million units away binary32 is a quarter of a unit off, more than splats are apart.
    one, origin = INPUTS[PLAIN], (4e6, -4e6, 0.1)
    near = one.source()
    far = replace(near, means=near.means.astype(np.float64) + np.array(origin))
    model = replace(csplat.decode(csplat.encode(near.to_model((0.0, 0.0, 0.0)))), origin=origin, extra={})
    content, pairs = check_content(replace(one, source=lambda: far), far, decode_scene(csplat.encode(model)), None)
    assert (Status.PASSED, 0) == (content.status, pairs.missing)


def test_a_file_that_the_validator_passes_and_the_decoder_refuses_is_a_failure(monkeypatch, plain):
    def refuse(_data):
        raise InputError("no")

    monkeypatch.setattr("csplat_conformance.encoders.file_checks.decode_scene", refuse)
    verdict, scene = check_stream(csplat.encode(plain))
    assert (Status.FAILED, None) == (verdict.status, scene)
    assert "csplat's decoder refuses it" in verdict.message
