# SPDX-License-Identifier: Apache-2.0
"""Plans of files, their colours and origins, and what the files that they give declare."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from checked import measure_errors
from quantisation_cases import COUNT, important

from csplat import EncodeOptions, decode, encode
from csplat.decoder import decode_scene, read_options
from csplat.encode_api import encode_planned, encode_with_report
from csplat.encoder import EncodePlan, Origin, encode_tiles
from csplat.encoder.coding_parameters import tile_limit
from csplat.errors import InputError
from csplat_conformance.declared_bounds import Source, verify_bounds
from csplat_tools.inspect.file_description import describe_file

GEOMETRY = ("means", "quats", "scales", "opacities")
COLOURS = ("sh0", "shN")


@pytest.mark.slow
@pytest.mark.parametrize("options", [
    {}, {"means_coding": "axis", "tile_splats": 50}, {"attribute_psnr": 30.0},
    {"shape_codebook_size": 32},
])  # fmt: skip
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


def test_tiles_have_an_eighth_of_the_splats_within_limits(make_model):
    for count, most in ((0, 16384), (131_072, 16384), (131_073, 16385), (289_444, 36181), (600_000, 65536)):
        assert most == tile_limit(count, EncodeOptions())
        assert 100 == tile_limit(count, EncodeOptions(tile_splats=100))
    model = make_model(40_000, 0)
    assert [13333, 13333, 13334] == sorted(len(tile.rows) for tile in EncodePlan.of(model).tiles)
    assert 1 == len(EncodePlan.of(model.select(slice(0, 16384))).tiles)


def test_the_tiles_of_classes_are_cut_only_if_they_are_full(make_model):
    model = make_model(COUNT, 0)
    for options, most in ((EncodeOptions(), 65536), (EncodeOptions(tile_splats=400), 400)):
        plan = EncodePlan.of(model, options, importance=important(model))
        assert plan.classes is not None
        assert most == plan.parameters.tile_splats


def test_an_origin_of_other_splats_is_refused(make_model):
    model = make_model(4, 1)
    with pytest.raises(InputError, match="origin has 5 splats, expected 4"):
        EncodePlan.of(model, origin=Origin(9, np.arange(5)))


@pytest.mark.slow
def test_a_part_with_other_colours_or_shapes_declares_the_errors_of_the_rest(make_model):
    source, rows = make_model(400, 3), np.arange(100, 300)
    colours = replace(source, sh0=source.sh0 + 1).select(rows)
    refitted = encode_planned(EncodePlan.of(colours, origin=Origin(400, rows, refitted=True)))
    shapes = replace(source, scales=source.scales + np.float32(0.1)).select(rows)
    adjusted = encode_planned(EncodePlan.of(shapes, origin=Origin(400, rows, refitted=True, adjusted=True)))
    for result, declared in ((refitted, ["means", "covariance", "opacities"]), (adjusted, ["means"])):
        scene = decode_scene(result.data)

        def verify(source, index=None, scene=scene):
            return verify_bounds(Source.of(source), scene.model, scene.header, scene.declared_bounds, index)

        whole = verify(source, result.source_index)
        assert (True, True) == (whole.holds, whole.rms_verified)
        assert declared == [one.name for one in whole.measures if one.holds]
        assert declared == [record.measure for record in scene.declared_bounds.records]
        assert {"sh0", "sh1", "sh2", "sh3"} <= {*whole.unverified}
        assert verify(source).holds
        moved = replace(source, means=source.means + np.float32(0.1))
        assert not any(verify(moved, index).holds for index in (None, result.source_index))
        assert "the file declares 400" in verify(source.select(slice(0, 399))).failures[0]


def test_errors_may_be_declared_against_another_scene(make_model):
    source = make_model(150, 1)
    drawn = replace(source, means=source.means + np.float32(0.25))
    coded = encode_tiles(EncodePlan.of(drawn))
    decoded = decode(coded.write().data)
    result = coded.against(source, decoded).write()
    truth = measure_errors(source, decoded, result.source_index)
    assert 0.4 < truth["means"][0] < 0.5
    for name, pair in truth.items():
        for error, declared in zip(pair, result.report.errors[name], strict=True):
            assert error <= declared <= error * 1.0001 + 1e-11


def test_a_file_is_written_twice_with_the_same_splats(make_model):
    coded = encode_tiles(EncodePlan.of(make_model(200, 2), EncodeOptions(tile_splats=70)))
    first, second = coded.write(), coded.write({"fitted": {"psnr": 41.5}})
    assert first.data == coded.write().data
    assert {"fitted": {"psnr": 41.5}, **read_options(first.data)} == read_options(second.data)
    one, other = decode(first.data), decode(second.data)
    for name in (*GEOMETRY, *COLOURS):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    assert np.array_equal(first.source_index, second.source_index)


def sparse_model(source, share):
    """Return the model with bands 2 and 3 of some splats set to zero."""
    shN = 0.1 * source.shN
    shN[np.random.default_rng(0).random(len(source)) < share, 3:] = 0.0
    return replace(source, shN=shN.astype(np.float32))


@pytest.mark.slow
def test_absent_bands_are_decoded_as_zeros_and_cost_almost_nothing(make_model):
    def codings(data):
        return set(describe_file(data).as_json()["attributes"]["sh2"]["codings"])

    model, scalar = sparse_model(make_model(400, 3), 0.9), {"sh_coding": "scalar"}
    for options in ({}, {"tile_splats": 50}, {"deflate_level": 1}, {"adaptive": 0.5}):
        result = encode_with_report(model, EncodeOptions(**scalar, **options), importance=np.ones(400))
        decoded, expected = decode(result.data), model.shN[result.source_index]
        np.testing.assert_allclose(expected, decoded.shN, atol=0.2)
        assert not decoded.shN[~expected[:, 3:].any(axis=(1, 2)), 3:].any()
        assert {"sparse"} == codings(result.data)
    assert {"signed"} == codings(encode(make_model(400, 3), EncodeOptions(**scalar)))
    big, options = make_model(6_000, 3), EncodeOptions(sh_coding="scalar")
    full, few, none = (len(encode(sparse_model(big, share), options)) for share in (0.0, 0.95, 1.0))
    # One twentieth of the values, and for each of two bands a mask of at most half a bit per splat.
    assert few - none < 0.05 * (full - none) + 2 * 6_000 * 0.5 / 8
