# SPDX-License-Identifier: Apache-2.0
"""Fixed quantisations, which equal the decoded file bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from checked import measure_errors
from quantisation_cases import ARRAYS, COUNT, assert_dequantised_as_decoded, important, moved

from csplat import decode
from csplat.decoder import decode_scene, read_declared_bounds, read_options
from csplat.encode_api import encode_with_report
from csplat.encoder import EncodeOptions, EncodePlan, Origin, fix_quantisation
from csplat.errors import InputError
from csplat.model import normalise_quats

CODEBOOK = {"sh_coding": "codebook", "codebook_size": 16}
OPTIONS = {
    "scalar": {"sh_coding": "scalar"},
    "escapes": {**CODEBOOK, "escape_fraction": 0.2},
    "shapes and all": {**CODEBOOK, "shape_codebook_size": 32, "tile_splats": 90},
}
SLOW = {
    "adaptive": {"sh_coding": "scalar", "adaptive": 0.7},
    "codebook": CODEBOOK,
    "all escaped": {**CODEBOOK, "escape_fraction": 1.0},
    "no SH": {"sh_coding": "none"},
    "fewer bands": {"sh_degree": 1},
    "tiles, axis": {"tile_splats": 50, "means_coding": "axis", "position_bits": 8},
    "coarse shapes": {"shape_codebook_size": 32, "attribute_psnr": 30.0},
    "small": {"preset": "small"},
    "buckets": {**CODEBOOK, "bucket_splats": 100},
    "buckets, adaptive": {"sh_coding": "scalar", "adaptive": 0.7, "bucket_splats": 100},
}


@pytest.mark.parametrize("options", [
    *OPTIONS.values(), *(pytest.param(options, marks=pytest.mark.slow) for options in SLOW.values())
], ids=[*OPTIONS, *SLOW])  # fmt: skip
def test_values_are_decoded_as_dequantised_at_the_start_and_moved(make_model, options):
    model, options = make_model(260, 3), EncodeOptions(**options)
    plain, fixed = encode_with_report(model, options), fix_quantisation(EncodePlan.of(model, options))
    unmoved = fixed.encode(fixed.start()).write()
    assert_dequantised_as_decoded(fixed, fixed.start(), unmoved)
    before, after = decode(plain.data), decode(unmoved.data)
    assert all(np.array_equal(getattr(before, name), getattr(after, name)) for name in ARRAYS)
    assert np.array_equal(plain.source_index, unmoved.source_index)
    values = moved(fixed)
    assert_dequantised_as_decoded(fixed, values, fixed.encode(values).write())


def test_rotations_are_not_reordered_after_they_moved(make_model):
    fixed = fix_quantisation(EncodePlan.of(make_model(200, 0)))
    values = fixed.start()
    values.quats[:] = normalise_quats(np.array([[0.55, 0.6, -0.4, 0.42]], np.float32))
    values.scales[:] = [-5.0, -4.0, -3.0]
    expected = fixed.dequantise(values)
    assert np.abs(expected.quats - values.quats).max() < 0.05
    assert (np.diff(expected.scales, axis=1) > 0).all()
    assert_dequantised_as_decoded(fixed, values, fixed.encode(values).write())
    values.quats *= np.float32(-1.0)  # the same rotation
    fixed.constrain(values)
    assert np.array_equal(expected.quats, fixed.dequantise(values).quats)


def test_means_stay_in_their_tiles(make_model):
    fixed = fix_quantisation(EncodePlan.of(make_model(300, 0), EncodeOptions(tile_splats=100, position_bits=16)))
    values = fixed.start()
    values.means *= np.float32(50.0)
    fixed.constrain(values)
    assert ((values.means >= fixed.low) & (values.means <= fixed.high)).all()
    assert_dequantised_as_decoded(fixed, values, fixed.encode(values).write())


def test_bands_that_are_zero_stay_zero(make_model):
    model = make_model(300, 3)
    model.shN[::2, 3:] = 0.0
    fixed = fix_quantisation(EncodePlan.of(model, EncodeOptions(sh_coding="scalar")))
    kept = fixed.dequantise(moved(fixed)).shN[:, 3:].any(axis=(1, 2))
    assert np.array_equal(fixed.source_index % 2 == 1, kept)


def test_entries_move_all_their_users(make_model):
    fixed = fix_quantisation(EncodePlan.of(make_model(260, 2), EncodeOptions(**CODEBOOK)))
    values = fixed.start()
    before, users = fixed.dequantise(values).shN, fixed.book.index == 3
    values.sh[3] += np.float32(1.0)
    after = fixed.dequantise(values).shN
    assert users.any()
    assert (before[users] != after[users]).all(axis=(1, 2)).all()
    assert np.array_equal(before[~users], after[~users])


def test_extra_columns_follow_their_splats(make_model):
    model = make_model(100, 0, extra={"id": np.arange(100, dtype=np.int32)})
    fixed = fix_quantisation(EncodePlan.of(model, EncodeOptions(keep_extra=True)))
    result = fixed.encode(fixed.start()).write()
    assert np.array_equal(result.source_index, decode_scene(result.data).model.extra["id"])


def test_errors_are_declared_against_the_source(make_model):
    source, rows = make_model(300, 2), np.arange(0, 300, 3)
    fixed = fix_quantisation(EncodePlan.of(source.select(rows), origin=Origin(300, rows)), source)
    values = moved(fixed, share=0.05)
    result = fixed.encode(values).write({"finetuned": {"steps": 7}})
    assert_dequantised_as_decoded(fixed, values, result)
    declared = read_declared_bounds(result.data)
    assert (300, 200, True) == (declared.source_count, declared.pruned_count, declared.refitted)
    truth = measure_errors(source, decode(result.data), result.source_index)
    assert {"means", "covariance", "opacities"} == {record.measure for record in declared.records}
    for record in declared.records:
        for error, bound in zip(truth[record.measure], (record.max, record.rms), strict=True):
            assert error <= bound <= error * 1.0001 + 1e-12
    assert {"steps": 7} == read_options(result.data)["finetuned"]


def test_no_splats_or_a_part_without_its_source_are_refused(make_model):
    with pytest.raises(InputError, match="without splats"):
        fix_quantisation(EncodePlan.of(make_model(0, 0)))
    with pytest.raises(InputError, match="source"):
        fix_quantisation(EncodePlan.of(make_model(5, 0), origin=Origin(9, np.arange(5))))


def test_plans_and_fixed_values_of_several_classes_equal_the_decoded_ones(make_model):
    model = make_model(COUNT, 0)
    draft = EncodePlan.of(model, importance=important(model))
    fixed = fix_quantisation(draft)
    result = fixed.encode(fixed.start()).write()
    assert_dequantised_as_decoded(fixed, fixed.start(), result)
    for name in ("means", "quats", "scales", "opacities"):
        decoded = getattr(decode(result.data), name)
        assert np.array_equal(getattr(draft.scene, name)[result.source_index], decoded), name
    plain = fix_quantisation(EncodePlan.of(model, importance=important(model), allow_classes=False)).encode_plan
    assert plain.classes is plain.options.max_classes is None
