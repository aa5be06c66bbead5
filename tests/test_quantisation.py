"""Quantisers stay within half a step; a fixed quantisation returns bit for bit what a decoder of the file returns."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from checked import covariances, measure_errors, quaternion_of
from hypothesis import given
from hypothesis import strategies as st

from csplat import EncodeOptions, decode, encode, read_ply
from csplat.decoder import decode_scene, read_declared_bounds, read_options
from csplat.encoder import EncodePlan, Origin, encode_with_report, fix_quantisation, quantisation
from csplat.encoder.quantisation import canonicalise_shape
from csplat.errors import InputError


@pytest.mark.parametrize("square", [False, True])
@pytest.mark.parametrize("levels", [1, 2, 63, 255, 65535])
def test_opacity_keeps_zero_and_one_and_stays_in_range(levels, square):
    alpha = np.linspace(0, 1, 1001, dtype=np.float32)
    q = quantisation.opacity_levels(alpha, levels, square=square)
    values = quantisation.opacity_values(q, levels, square=square)
    assert (0.0, 1.0) == (values[0], values[-1])
    assert ((q >= 0) & (q <= levels)).all()
    domain = np.sqrt if square else np.asarray
    assert float(np.abs(domain(values) - domain(alpha)).max()) <= 0.5 / levels + 1e-6


@pytest.mark.parametrize("levels", [3, 4, 5, 31, 127, 32767])
def test_rotations_stay_legal_and_near(levels):
    rng = np.random.default_rng(levels)
    quats = rng.standard_normal((4, 20000))
    corner = np.array([0.5, 0.5, 0.5, 0.5])[:, None] + rng.normal(0, 1e-3, (4, 2000))
    quats = np.concatenate([quats, corner], axis=1)
    quats /= np.linalg.norm(quats, axis=0)
    order = np.argsort(-np.abs(quats), axis=0)
    quats = np.take_along_axis(quats, order, axis=0)
    quats[0] = np.abs(quats[0])
    q = quantisation.quat_levels(quats.astype(np.float32), levels)
    assert np.abs(q).max() <= levels
    assert int((q.astype(np.int64) ** 2).sum(axis=0).max()) <= 2 * levels * levels
    values = quantisation.quat_values(q, levels)
    np.testing.assert_allclose(np.linalg.norm(values, axis=0), 1.0, atol=1e-6)
    assert float(np.abs(values[1:] - quats[1:]).max()) <= 1.0 / levels


@pytest.mark.parametrize("shift", [0, 1, 2, 5])
@pytest.mark.parametrize("scale", [1.0, 100.0, 2.0**25])
def test_colours_stay_within_a_step_and_a_chroma_step(shift, scale):
    rgb = np.random.default_rng(shift).normal(0, scale, (3, 5000))
    columns = quantisation.colour_integers(rgb if scale > 1e6 else rgb.astype(np.float32), shift)
    error = np.abs(quantisation.lift_colour(columns, shift) - rgb)
    assert float(error.max()) <= 1.5 + 0.75 * 2**shift


@pytest.mark.slow
@given(st.integers(-(2**20), 2**20), st.integers(-(2**20), 2**20), st.integers(-(2**20), 2**20))
def test_without_a_shift_colours_stay_within_one_step(r, g, b):
    rgb = np.array([[r], [g], [b]], np.float64)
    columns = quantisation.colour_integers(rgb, 0)
    assert float(np.abs(quantisation.lift_colour(columns, 0) - rgb).max()) <= 1


def test_coarse_colours_are_multiples_on_the_same_lattice():
    rgb = np.random.default_rng(0).normal(0, 50, (3, 1000)).astype(np.float32)
    coarse = np.arange(1000, dtype=np.int32) % 5
    columns = quantisation.colour_integers(rgb, 1, coarse)
    assert (columns % (1 << coarse) == 0).all()


@pytest.mark.parametrize("largest", [0.0, 1.0, 1e6, 1e20, 3e38])
def test_lattice_exponents_keep_integers_within_the_range_of_the_format(largest):
    exponent = quantisation.lattice_exponent(largest, 1e-3)
    assert largest / math.ldexp(1e-3, exponent) <= 2**21
    assert exponent == 0 or largest / math.ldexp(1e-3, exponent - 2) >= 2**20


def test_means_at_the_end_of_float32_do_not_become_infinite():
    top = np.finfo(np.float32).max
    means = np.array([[top, -top], [0, 1], [1e30, 0]], np.float32)
    n = quantisation.quantise_means(means, 1.7e36)
    assert np.isfinite(quantisation.lattice_values(n, 1.7e36)).all()


def random_shapes(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    quats = rng.standard_normal((count, 4))
    quats /= np.linalg.norm(quats, axis=1)[:, None]
    return quats.astype(np.float32), rng.normal(0, 2, (count, 3)).astype(np.float32)


def test_canonical_axis_order_keeps_the_covariance():
    quats, scales = random_shapes(5000, 0)
    rotation, ordered = canonicalise_shape(quats, scales)
    before, after = covariances(quats, scales), covariances(rotation.T, ordered.T)
    size = np.linalg.norm(before, axis=(1, 2))
    assert float((np.linalg.norm(after - before, axis=(1, 2)) / size).max()) < 1e-5


def test_canonical_axis_order_sorts_scales_and_makes_w_largest():
    quats, scales = random_shapes(5000, 1)
    rotation, ordered = canonicalise_shape(quats, scales)
    assert (np.diff(ordered, axis=0) <= 0).all()
    assert (rotation[0] >= np.abs(rotation).max(axis=0)).all()
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=0), 1.0, atol=1e-6)
    np.testing.assert_array_equal(np.sort(scales, axis=1)[:, ::-1], ordered.T)


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("sign", [1, -1])
def test_equivalent_shapes_get_the_same_canonical_form(order, sign):
    quats, scales = random_shapes(64, 2)
    axes = np.eye(3)[list(order)].T
    if np.linalg.det(axes) < 0:
        axes = -axes
    turn = quaternion_of(axes)
    again = np.stack([product(quat, turn) for quat in quats.astype(np.float64)]) * sign
    first = canonicalise_shape(quats, scales)
    second = canonicalise_shape(again.astype(np.float32), scales[:, list(order)])
    np.testing.assert_allclose(second[0], first[0], atol=2e-6)
    np.testing.assert_array_equal(second[1], first[1])


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate([[scalar], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])


ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")

OPTIONS = {
    "scalar": {"sh_coding": "scalar"},
    "adaptive": {"sh_coding": "scalar", "adaptive": 0.7},
    "codebook": {"sh_coding": "codebook", "codebook_size": 16},
    "escapes": {"sh_coding": "codebook", "codebook_size": 16, "escape_fraction": 0.2},
    "all escaped": {"sh_coding": "codebook", "codebook_size": 16, "escape_fraction": 1.0},
    "no SH": {"sh_coding": "none"},
    "fewer bands": {"sh_degree": 1},
    "tiles, axis": {"tile_splats": 50, "means_coding": "axis"},
    "coarse": {"attribute_psnr": 30.0},
    "position bits": {"position_bits": 8},
    "shapes": {"shape_codebook_size": 32},
    "shapes and all": {"shape_codebook_size": 32, "sh_coding": "codebook", "codebook_size": 16, "tile_splats": 90},
}


def moved(fixed, seed=1, share=0.3):
    """Return values after a random walk, which goes further than any tuning."""
    values, rng = fixed.start(), np.random.default_rng(seed)
    for name in ("means", "quats", "scales", "sh0", "sh", "sizes"):
        array = getattr(values, name)
        if array.size:
            array += (share * array.std() * rng.standard_normal(array.shape)).astype(np.float32)
    values.opacities[:] = np.clip(values.opacities + 0.2 * rng.standard_normal(len(values.opacities)), 0.0, 1.0)
    values.quats /= np.linalg.norm(values.quats, axis=1, keepdims=True)
    fixed.constrain(values)
    return values


def assert_dequantised_as_decoded(fixed, values, result):
    places = np.full(len(fixed.source), -1)
    places[fixed.source_index] = np.arange(len(fixed.source_index))
    rows, expected, decoded = places[result.source_index], fixed.dequantise(values), decode(result.data)
    assert sorted(rows) == list(range(len(rows)))
    for name in ARRAYS:
        assert getattr(decoded, name).tobytes() == getattr(expected, name)[rows].tobytes(), name


@pytest.mark.parametrize("options_name", OPTIONS)
def test_values_are_decoded_as_dequantised_at_the_start_and_moved(make_model, options_name):
    model = make_model(260, 3)
    fixed = fix_quantisation(EncodePlan.of(model, EncodeOptions(**OPTIONS[options_name])))
    for values in (fixed.start(), moved(fixed)):
        assert_dequantised_as_decoded(fixed, values, fixed.encode(values).write())


@pytest.mark.parametrize("options_name", ["scalar", "codebook", "escapes", "tiles, axis", "shapes"])
def test_unmoved_values_have_the_file_of_encode(make_model, options_name):
    model, options = make_model(260, 3), EncodeOptions(**OPTIONS[options_name])
    plain, fixed = encode_with_report(model, options), fix_quantisation(EncodePlan.of(model, options))
    result = fixed.encode(fixed.start()).write()
    before, after = decode(plain.data), decode(result.data)
    for name in ARRAYS:
        assert np.array_equal(getattr(before, name), getattr(after, name)), name
    assert np.array_equal(plain.source_index, result.source_index)


def test_rotations_are_not_reordered_after_they_moved(make_model):
    fixed = fix_quantisation(EncodePlan.of(make_model(200, 0)))
    values = fixed.start()
    quat = np.array([0.55, 0.6, -0.4, 0.42], np.float32)
    values.quats[:] = quat / np.float32(np.linalg.norm(quat))
    values.scales[:] = np.array([-5.0, -4.0, -3.0], np.float32)
    expected = fixed.dequantise(values)
    assert np.abs(expected.quats - values.quats).max() < 0.05
    assert (np.diff(expected.scales, axis=1) > 0).all()
    assert_dequantised_as_decoded(fixed, values, fixed.encode(values).write())


def test_negative_w_is_the_same_rotation_with_the_other_sign(make_model):
    fixed = fix_quantisation(EncodePlan.of(make_model(50, 0)))
    values = fixed.start()
    before = fixed.dequantise(values)
    values.quats *= np.float32(-1.0)
    fixed.constrain(values)
    assert np.array_equal(before.quats, fixed.dequantise(values).quats)


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


def test_errors_are_declared_against_the_source(make_model):
    source = make_model(300, 2)
    rows = np.arange(0, 300, 3)
    fixed = fix_quantisation(EncodePlan.of(source.select(rows), origin=Origin(300, rows)), source)
    values = moved(fixed, share=0.05)
    result = fixed.encode(values).write({"finetuned": {"steps": 7}})
    assert_dequantised_as_decoded(fixed, values, result)
    stated = read_declared_bounds(result.data)
    assert (300, 200, True) == (stated.source_count, stated.pruned_count, stated.refitted)
    truth = measure_errors(source, decode(result.data), result.source_index)
    assert {"means", "covariance", "opacities"} == {record.measure for record in stated.records}
    for record in stated.records:
        assert truth[record.measure][0] <= record.max <= truth[record.measure][0] * 1.0001 + 1e-12
        assert truth[record.measure][1] <= record.rms <= truth[record.measure][1] * 1.0001 + 1e-12
    assert {"steps": 7} == read_options(result.data)["finetuned"]


def test_extra_columns_follow_their_splats(make_model):
    model = make_model(100, 0, extra={"id": np.arange(100, dtype=np.int32)})
    fixed = fix_quantisation(EncodePlan.of(model, EncodeOptions(keep_extra=True)))
    result = fixed.encode(fixed.start()).write()
    assert np.array_equal(result.source_index, decode_scene(result.data).model.extra["id"])


def test_no_splats_or_a_part_without_its_source_are_refused(make_model):
    with pytest.raises(InputError, match="without splats"):
        fix_quantisation(EncodePlan.of(make_model(0, 0)))
    with pytest.raises(InputError, match="source"):
        fix_quantisation(EncodePlan.of(make_model(5, 0), origin=Origin(9, np.arange(5))))


def assert_moved_as_decoded(model, options):
    fixed = fix_quantisation(EncodePlan.of(model, EncodeOptions(**options)))
    values = moved(fixed, share=0.02)
    assert_dequantised_as_decoded(fixed, values, fixed.encode(values).write())


@pytest.mark.slow
def test_the_sample_is_decoded_as_dequantised(sample_path):
    model = read_ply(sample_path).select(slice(0, None, 15))
    scalar = {"sh_coding": "scalar", "attribute_psnr": 40.0}
    for options in ({}, {"preset": "small"}, scalar, {"shape_codebook_size": 200}, {"tile_splats": 160}):
        assert_moved_as_decoded(model, options)


@pytest.mark.parametrize(("name", "options"), [
    ("lego60k", {"preset": "small"}),
    ("fox60k_noreg", {"sh_coding": "scalar", "attribute_psnr": 40.0}),
    ("plane3", {"shape_codebook_size": 512}),
    ("train1000", {}),
    ("donut", {"tile_splats": 10_000}),
])  # fmt: skip
def test_shared_scenes_are_decoded_as_dequantised(data_dir, name, options):
    assert_moved_as_decoded(read_ply(data_dir / "ply" / f"{name}.ply"), options)


def test_bytes_do_not_depend_on_threads(make_model):
    model = make_model(400, 3)
    files = []
    for threads in (1, 2):
        fixed = fix_quantisation(EncodePlan.of(model, EncodeOptions(tile_splats=100, threads=threads)))
        files.append(fixed.encode(moved(fixed)).write().data)
    assert files[0] == files[1]
    assert files[0] != encode(model, EncodeOptions(tile_splats=100))
