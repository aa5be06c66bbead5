# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.encoder.source_lattices: values of SPZ and SOG are kept, and presets know that they are quantised."""

from dataclasses import replace

import numpy as np
import pytest

import csplat
from csplat.encoder.source_lattices import colour_step, power_of_two_step, rotation_levels
from csplat.errors import InputError

ALL = dict.fromkeys(["means", "covariance", "opacities", "sh0", "sh1", "sh2", "sh3"], 0.0)


@pytest.fixture
def model(make_model):
    """Return 600 splats with SH of degree 3, within the ranges of SPZ."""
    made = make_model(600, 3, coordinate_system="RUB")
    return replace(made, sh0=np.clip(made.sh0, -3, 3), shN=np.clip(made.shN / 4, -0.9, 0.9))


def through(tmp_path, model, name):
    """Return the model as a file of another format has it."""
    csplat.write(tmp_path / name, model)
    return csplat.read(tmp_path / name)


@pytest.mark.parametrize("name", ["a.spz", "a.v4.spz"])
def test_errors_of_zero_keep_the_values_of_spz(tmp_path, model, name):
    source = through(tmp_path, model, name)
    result = csplat.encode_with_report(source, target=csplat.Target(max_error=ALL))
    decoded, expected = csplat.decode(result.data), source.select(result.source_index)
    for array in ("means", "scales", "opacities", "shN"):
        assert np.array_equal(getattr(expected, array), getattr(decoded, array)), array
    np.testing.assert_allclose(decoded.sh0, expected.sh0, atol=1e-6, rtol=0)
    assert result.largest_error("covariance") < 2e-6
    assert ALL == result.report.search.goal["max_error"]


def test_errors_of_zero_keep_alpha_of_sog_and_are_refused_for_its_means(tmp_path, model):
    source = through(tmp_path, model, "a.sog")
    result = csplat.encode_with_report(source, target=csplat.Target(max_error={"opacities": 0, "sh0": 0.01}))
    assert 0.0 == result.largest_error("opacities")
    assert 0.005 < result.largest_error("sh0") <= 0.01
    with pytest.raises(InputError, match="a largest error of 0 for means"):
        csplat.encode(source, target=csplat.Target(max_error={"means": 0}))


def test_errors_of_zero_are_refused_for_values_on_no_lattice(model):
    for name, bound in ALL.items():
        with pytest.raises(InputError, match="lattice"):
            csplat.encode(model, target=csplat.Target(max_error={name: bound}))
    with pytest.raises(InputError, match="a PSNR excludes a largest error of 0"):
        csplat.Target(psnr=30.0, max_error={"means": 0})


def test_lattices_are_recognised(tmp_path, model):
    spz, sog = through(tmp_path, model, "a.spz"), through(tmp_path, model, "a.sog")
    assert [511, 255] == [rotation_levels(spz), rotation_levels(sog)]
    assert rotation_levels(model) is None
    assert [2.0**-12, 1 / 16, 1 / 32] == [power_of_two_step(one) for one in (spz.means, spz.scales, spz.shN)]
    assert power_of_two_step(model.means) is None
    assert pytest.approx(1 / 76.5) == colour_step(spz.sh0)
    assert colour_step(model.sh0) is None


def test_fast_is_no_larger_than_balanced_for_quantised_scenes(tmp_path, model):
    rows = np.arange(6000) % 600  # many splats share SH, as by the palette of SOG
    wide = np.random.default_rng(1).normal(size=(6000, 3)).astype("f4")
    source = through(tmp_path, replace(model.select(rows), means=wide), "a.sog")
    assert source.metadata.quantised
    assert not model.metadata.quantised
    sizes = {}
    for preset in ("fast", "balanced"):
        report = csplat.encode_with_report(source, csplat.EncodeOptions(preset=preset)).report
        sizes[preset] = report.size_bytes
        assert 128 >= report.options["codebook_size"] > 0
    assert sizes["fast"] <= sizes["balanced"]
