"""Tests of csplat.encoder.pipeline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from checked import measure_errors

from csplat import EncodeOptions, decode, encode
from csplat.decoder import decode_scene
from csplat.encoder import EncodePlan, Origin, encode_tiles
from csplat_conformance.declared_bounds import Source, verify_bounds

GEOMETRY = ("means", "quats", "scales", "opacities")
COLOURS = ("sh0", "shN")


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"means_coding": "axis", "tile_splats": 50, "threads": 2},
        {"attribute_psnr": 30.0},
        {"shape_codebook_size": 32},
    ],
)
def test_a_plan_holds_decoded_geometry_and_the_source_colours(make_model, options):
    model = make_model(260, 2)
    plan = EncodePlan.of(model, EncodeOptions(**options))
    result = encode_tiles(plan).write()
    assert bool(encode(model, EncodeOptions(**options)) == result.data)
    decoded = decode(result.data)
    for name in GEOMETRY:
        assert getattr(decoded, name).tobytes() == getattr(plan.scene, name)[result.source_index].tobytes(), name
    for name in COLOURS:
        assert getattr(model, name).tobytes() == getattr(plan.scene, name).tobytes(), name


@pytest.mark.slow
def test_new_colours_change_only_colours(make_model):
    model = make_model(260, 2)
    plan = EncodePlan.of(model, EncodeOptions(attribute_psnr=80.0))
    fitted = plan.with_colours(model.sh0 + 1, 0 * model.shN)
    before, after = (decode_scene(encode_tiles(one).write().data) for one in (plan, fitted))
    for name in GEOMETRY:
        assert np.array_equal(getattr(before.model, name), getattr(after.model, name)), name
    np.testing.assert_allclose(before.model.sh0 + 1, after.model.sh0, atol=0.02)
    assert not after.model.shN.any()
    assert (False, True) == (before.declared_bounds.refitted, after.declared_bounds.refitted)
    assert ["means", "covariance", "opacities"] == [record.measure for record in after.declared_bounds.records]
    assert model.sh0 is plan.model.sh0  # the plan is unchanged


def test_the_geometry_of_a_refitted_file_is_verified(make_model):
    source, rows = make_model(400, 3), np.arange(100, 300)
    plan = EncodePlan.of(source.select(rows), origin=Origin(len(source), rows))
    result = encode_tiles(plan.with_colours(plan.scene.sh0 + 1, plan.scene.shN)).write()
    scene = decode_scene(result.data)

    def verify(source, index=None):
        return verify_bounds(Source.of(source), scene.model, scene.header, scene.declared_bounds, index)

    whole = verify(source, result.source_index)
    assert whole.holds
    assert whole.rms_verified
    assert ["means", "covariance", "opacities"] == [one.name for one in whole.measures if one.holds]
    assert ("sh0", "sh1", "sh2", "sh3") == whole.unverified
    assert verify(source).holds
    assert not verify(replace(source, means=source.means + np.float32(0.1)), result.source_index).holds
    assert "the file states 400" in verify(source.select(slice(0, 399))).failures[0]


def test_errors_may_be_declared_against_another_scene(make_model):
    source = make_model(150, 1)
    drawn = replace(source, means=source.means + np.float32(0.25))
    coded = encode_tiles(EncodePlan.of(drawn))
    decoded = decode(coded.write().data)
    result = coded.against(source, decoded).write()
    truth = measure_errors(source, decoded, result.source_index)
    assert 0.4 < truth["means"][0] < 0.5
    for name, (largest, rms) in truth.items():
        stated = result.report.errors[name]
        assert largest <= stated[0] <= largest * 1.0001 + 1e-11
        assert rms <= stated[1] <= rms * 1.0001 + 1e-11
