"""Tests of csplat.encoder.fixed_quantisation."""

from __future__ import annotations

import numpy as np
import pytest
from quantisation_cases import ARRAYS, COUNT, assert_dequantised_as_decoded, important, moved

import csplat
from csplat import decode, encode, read_ply
from csplat.decoder import decode_scene
from csplat.encoder import (
    EncodeOptions,
    EncodePlan,
    encode_with_report,
    fix_quantisation,
)
from csplat.model import normalise_quats

OPTIONS = {
    "scalar": {"sh_coding": "scalar"},
    "adaptive": {"sh_coding": "scalar", "adaptive": 0.7},
    "codebook": {"sh_coding": "codebook", "codebook_size": 16},
    "escapes": {"sh_coding": "codebook", "codebook_size": 16, "escape_fraction": 0.2},
    "all escaped": {"sh_coding": "codebook", "codebook_size": 16, "escape_fraction": 1.0},
    "no SH": {"sh_coding": "none"},
    "fewer bands": {"sh_degree": 1},
    "tiles, axis": {"tile_splats": 50, "means_coding": "axis", "position_bits": 8},
    "coarse shapes": {"shape_codebook_size": 32, "attribute_psnr": 30.0},
    "shapes and all": {"shape_codebook_size": 32, "sh_coding": "codebook", "codebook_size": 16, "tile_splats": 90},
}


QUICK = ("scalar", "escapes", "shapes and all")


@pytest.mark.parametrize("name", [
    *QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in OPTIONS if name not in QUICK)
])  # fmt: skip
def test_values_are_decoded_as_dequantised_at_the_start_and_moved(make_model, name):
    model, options = make_model(260, 3), EncodeOptions(**OPTIONS[name])
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
    assert (values.means >= fixed.low).all()
    assert (values.means <= fixed.high).all()
    assert_dequantised_as_decoded(fixed, values, fixed.encode(values).write())


def test_bands_that_are_zero_stay_zero(make_model):
    model = make_model(300, 3)
    model.shN[::2, 3:] = 0.0
    fixed = fix_quantisation(EncodePlan.of(model, EncodeOptions(sh_coding="scalar")))
    expected = fixed.dequantise(moved(fixed))
    came_from = fixed.source_index % 2 == 0
    assert not expected.shN[came_from, 3:].any()
    assert expected.shN[~came_from, 3:].any()


def test_entries_move_all_their_users(make_model):
    fixed = fix_quantisation(EncodePlan.of(make_model(260, 2), EncodeOptions(**OPTIONS["codebook"])))
    values = fixed.start()
    before = fixed.dequantise(values).shN
    users = fixed.book.index == 3
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


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"preset": "small"}, {"shape_codebook_size": 200, "tile_splats": 160}])
def test_the_sample_is_decoded_as_dequantised(sample_path, options):
    model = read_ply(sample_path).select(slice(0, None, 15))
    fixed = fix_quantisation(EncodePlan.of(model, EncodeOptions(**options)))
    values = moved(fixed, share=0.02)
    assert_dequantised_as_decoded(fixed, values, fixed.encode(values).write())


@pytest.mark.slow
def test_bytes_do_not_depend_on_threads(make_model):
    files = []
    for threads in (1, 2):
        options = EncodeOptions(tile_splats=100, threads=threads)
        fixed = fix_quantisation(EncodePlan.of(make_model(300, 3), options))
        files.append(fixed.encode(moved(fixed)).write().data)
    assert bool(files[0] == files[1])
    assert bool(files[0] != encode(make_model(300, 3), options))


@pytest.fixture
def model(make_model):
    return make_model(COUNT, 0)


def test_classes_may_be_disallowed(model):
    fixed = fix_quantisation(EncodePlan.of(model, importance=important(model), allow_classes=False))
    assert fixed.encode_plan.classes is None
    assert fixed.encode_plan.options.max_classes is None


def test_plans_and_fixed_values_of_several_classes_equal_the_decoded_ones(model):
    draft = EncodePlan.of(model, importance=important(model))
    fixed = fix_quantisation(draft)
    values = fixed.start()
    result = fixed.encode(values).write()
    decoded, seen = csplat.decode(result.data), fixed.dequantise(values)
    order = np.argsort(fixed.source_index)[result.source_index]
    for name in ARRAYS:
        assert np.array_equal(getattr(seen, name)[order], getattr(decoded, name)), name
    for name in ("means", "quats", "scales", "opacities"):
        assert np.array_equal(getattr(draft.scene, name)[result.source_index], getattr(decoded, name)), name
