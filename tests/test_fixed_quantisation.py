"""`FixedQuantisation.dequantise` returns, bit for bit, what a decoder of the file returns, however values move."""

import numpy as np
import pytest
from checked import measure_errors

from csplat import EncodeOptions, decode, encode, read_ply
from csplat.decoder import decode_scene, read_declared_bounds, read_options
from csplat.encoder import EncodePlan, Origin, encode_with_report, fix_quantisation
from csplat.errors import InputError

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
    """Return values after a random walk, further than any tuning goes."""
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
def test_dequantised_values_are_decoded_at_the_start_and_moved(make_model, options_name):
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


def test_centres_stay_in_their_tiles(make_model):
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


def test_refuses_a_scene_without_splats(make_model):
    with pytest.raises(InputError, match="without splats"):
        fix_quantisation(EncodePlan.of(make_model(0, 0)))


def test_refuses_a_part_without_its_source(make_model):
    with pytest.raises(InputError, match="source"):
        fix_quantisation(EncodePlan.of(make_model(5, 0), origin=Origin(9, np.arange(5))))


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"preset": "small"},
        {"sh_coding": "scalar", "attribute_psnr": 40.0},
        {"shape_codebook_size": 200},
        {},
        {"tile_splats": 160},
    ],
)
def test_the_sample_is_decoded_as_dequantised(sample_path, options):
    fixed = fix_quantisation(EncodePlan.of(read_ply(sample_path).select(slice(0, None, 15)), EncodeOptions(**options)))
    values = moved(fixed, share=0.02)
    assert_dequantised_as_decoded(fixed, values, fixed.encode(values).write())


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("lego60k", {"preset": "small"}),
        ("fox60k_noreg", {"sh_coding": "scalar", "attribute_psnr": 40.0}),
        ("plane3", {"shape_codebook_size": 512}),
        ("train1000", {}),
        ("donut", {"tile_splats": 10_000}),
    ],
)
def test_shared_scenes_are_decoded_as_dequantised(data_dir, name, options):
    fixed = fix_quantisation(EncodePlan.of(read_ply(data_dir / "ply" / f"{name}.ply"), EncodeOptions(**options)))
    values = moved(fixed, share=0.02)
    assert_dequantised_as_decoded(fixed, values, fixed.encode(values).write())


def test_bytes_do_not_depend_on_threads(make_model):
    model = make_model(400, 3)
    files = []
    for threads in (1, 2):
        fixed = fix_quantisation(EncodePlan.of(model, EncodeOptions(tile_splats=100, threads=threads)))
        files.append(fixed.encode(moved(fixed)).write().data)
    assert files[0] == files[1]
    assert files[0] != encode(model, EncodeOptions(tile_splats=100))
