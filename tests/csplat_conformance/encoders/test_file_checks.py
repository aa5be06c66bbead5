"""Tests of csplat_conformance.encoders.file_checks."""

import numpy as np
import pytest

import csplat
from csplat.errors import InputError
from csplat_conformance.conformance_report import Status
from csplat_conformance.encoders import all_inputs
from csplat_conformance.encoders.file_checks import check_stream, pair_splats

INPUTS = {one.name: one for one in all_inputs()}
ENCODABLE = {name: one for name, one in INPUTS.items() if one.source is not None}


@pytest.mark.slow
def test_pairs_are_found_however_the_file_is_ordered():
    source = ENCODABLE["ordinary/two_tiles"].source().means.astype(np.float64)
    order = np.random.default_rng(1).permutation(len(source))[:60_000]
    moved = source[order] + np.random.default_rng(2).uniform(-0.01, 0.01, (60_000, 3))
    found = pair_splats(source, moved, 0.06)
    np.testing.assert_array_equal(order, found.source_index)
    assert (0, 0, len(source) - 60_000) == (found.strays, found.surplus, found.missing)


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


def test_duplicates_are_paired_each_with_its_own():
    assert [0, 1, 2] == sorted(pair_splats(np.zeros((3, 3)), np.full((3, 3), 0.01), 1.0).source_index)


def test_a_file_that_the_validator_passes_and_the_decoder_refuses_is_a_failure(monkeypatch):
    def refuse(_data):
        raise InputError("no")

    monkeypatch.setattr("csplat_conformance.encoders.file_checks.decode_scene", refuse)
    verdict, scene = check_stream(csplat.encode(ENCODABLE["ordinary/one_splat"].source().to_model((0.0, 0.0, 0.0))))
    assert (Status.FAILED, None) == (verdict.status, scene)
    assert "csplat's decoder refuses it" in verdict.message
