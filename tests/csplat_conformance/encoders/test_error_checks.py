"""Tests of csplat_conformance.encoders.error_checks."""

import types
from contextlib import contextmanager
from unittest import mock

import numpy as np
import pytest
from encoder_runs_cases import COMMAND, INPUTS, judged, model_of, running

import csplat
from csplat.decoder import decode_scene
from csplat.encoder import quantisation, shape_codebook
from csplat_conformance.declared_bounds import verify_bounds
from csplat_conformance.encoders import EncoderSuiteOptions, run_encoder
from csplat_conformance.encoders.error_checks import find_truncation
from csplat_conformance.encoders.file_checks import check_content, pair_splats


def test_errors_are_proved_by_the_encoders_own_index(monkeypatch):
    # Centres are equal: only the encoder knows the pairs.
    ran = []
    monkeypatch.setattr(
        "csplat_conformance.encoders.error_checks.verify_bounds",
        lambda *args: ran.append(args[-1]) or verify_bounds(*args),
    )
    one = INPUTS["nasty/duplicates"]
    means = one.source().means
    result = csplat.encode(one.source().to_model((0.0, 0.0, 0.0)))
    pairs = pair_splats(means.astype(np.float64), csplat.decode(result).means.astype(np.float64), one.separation)
    exchanged = pairs.source_index.copy()
    same = np.flatnonzero((means[exchanged] == means[exchanged[0]]).all(axis=1))
    exchanged[same] = np.roll(exchanged[same], 1)
    run = running((result, exchanged), lambda _: None)
    assert run_encoder(COMMAND, EncoderSuiteOptions(one.name, ("L3",)), run=run).passed
    np.testing.assert_array_equal(exchanged, ran[0])


@contextmanager
def rounding(rint):
    """Make our encoder round in another way."""
    numpy = types.ModuleType("numpy")
    vars(numpy).update(vars(np), rint=rint)
    with mock.patch.object(quantisation, "np", numpy), mock.patch.object(shape_codebook, "np", numpy):
        yield


@pytest.mark.parametrize("cut", [np.floor, np.trunc])
@pytest.mark.parametrize("name", ["ordinary/degree_3", "ordinary/quaternions"])
def test_cut_values_are_distinguished_from_rounded_values(tmp_path, name, cut):
    one, model = INPUTS[name], model_of(name, tmp_path)
    with rounding(lambda values, out=None: cut(values, out=out)):
        scene = decode_scene(csplat.encode(model, csplat.EncodeOptions(sh_coding="scalar", threads=1)))
    _, pairs = check_content(one, one.source(), scene, None)
    every = frozenset(("means", "covariance", "opacities", "sh0", "sh1", "sh2", "sh3"))
    lines = find_truncation(one.source(), scene.model, scene.header, pairs.source_index, every)
    assert ["means", "opacities", "scales", "quats", "sh0"] == [line.partition(":")[0] for line in lines][:5]
    assert all(line.endswith("truncated instead of rounded?") for line in lines), lines
    assert [] == find_truncation(one.source(), scene.model, scene.header, pairs.source_index, frozenset())


@pytest.mark.parametrize("name", ["ordinary/strong_colours", "ordinary/needles_and_discs"])
def test_coarse_steps_are_not_cuts(tmp_path, name):
    model = model_of(name, tmp_path)
    for preset, psnr in (("fast", 20.0), ("balanced", 30.0), ("small", 20.0), ("small", 90.0)):
        _, errors, _ = judged(name, model, preset=preset, attribute_psnr=psnr)
        assert "truncated" not in errors.message
