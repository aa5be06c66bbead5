"""Frozen scenes: `Frozen.seen` returns, bit for bit, what a decoder of the file returns, however values move."""

import numpy as np
import pytest

from csplat import EncodeOptions, decode, encode, read_ply
from csplat.decoder import decode_scene, read_declared_bounds, read_options
from csplat.encoder import EncodePlan, Origin, encode_with_report, fix_quantisation
from csplat.encoder.error_bounds import measure_errors
from csplat.errors import InputError

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
WAYS = {
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


def moved(frozen, seed=1, share=0.3):
    """Values of a frozen scene after a walk; further than any tuning goes."""
    held, rng = frozen.start(), np.random.default_rng(seed)
    for name in ("means", "quats", "scales", "sh0", "sh", "sizes"):
        values = getattr(held, name)
        if values.size:
            values += (share * values.std() * rng.standard_normal(values.shape)).astype(np.float32)
    held.opacities[:] = np.clip(held.opacities + 0.2 * rng.standard_normal(len(held.opacities)), 0.0, 1.0)
    held.quats /= np.linalg.norm(held.quats, axis=1, keepdims=True)
    frozen.constrain(held)
    return held


def assert_seen_is_decoded(frozen, held, result):
    places = np.full(len(frozen.source), -1)
    places[frozen.source_index] = np.arange(len(frozen.source_index))
    rows, seen, decoded = places[result.source_index], frozen.dequantise(held), decode(result.data)
    assert sorted(rows) == list(range(len(rows)))
    for name in ARRAYS:
        assert getattr(decoded, name).tobytes() == getattr(seen, name)[rows].tobytes(), name


@pytest.mark.parametrize("way", WAYS)
def test_what_is_seen_is_what_is_decoded_at_the_start_and_moved(make_model, way):
    model = make_model(260, 3)
    frozen = fix_quantisation(EncodePlan.of(model, EncodeOptions(**WAYS[way])))
    for held in (frozen.start(), moved(frozen)):
        assert_seen_is_decoded(frozen, held, frozen.encode(held).write())


@pytest.mark.parametrize("way", ["scalar", "codebook", "escapes", "tiles, axis", "shapes"])
def test_a_scene_that_did_not_move_decodes_as_if_it_had_not_been_frozen(make_model, way):
    model, options = make_model(260, 3), EncodeOptions(**WAYS[way])
    plain, frozen = encode_with_report(model, options), fix_quantisation(EncodePlan.of(model, options))
    result = frozen.encode(frozen.start()).write()
    before, after = decode(plain.data), decode(result.data)
    for name in ARRAYS:
        assert np.array_equal(getattr(before, name), getattr(after, name)), name
    assert np.array_equal(plain.source_index, result.source_index)


def test_rotations_stay_as_they_are_where_the_gauge_would_turn_them(make_model):
    frozen = fix_quantisation(EncodePlan.of(make_model(200, 0)))
    held = frozen.start()
    held.quats[:] = np.array([0.55, 0.6, -0.4, 0.42], np.float32) / np.float32(np.linalg.norm([0.55, 0.6, -0.4, 0.42]))
    held.scales[:] = np.array([-5.0, -4.0, -3.0], np.float32)
    seen = frozen.dequantise(held)
    assert np.abs(seen.quats - held.quats).max() < 0.05
    assert (np.diff(seen.scales, axis=1) > 0).all()
    assert_seen_is_decoded(frozen, held, frozen.encode(held).write())


def test_negative_w_is_the_same_rotation_with_the_other_sign(make_model):
    frozen = fix_quantisation(EncodePlan.of(make_model(50, 0)))
    held = frozen.start()
    before = frozen.dequantise(held)
    held.quats *= np.float32(-1.0)
    frozen.constrain(held)
    assert np.array_equal(before.quats, frozen.dequantise(held).quats)


def test_centres_stay_in_their_tiles(make_model):
    frozen = fix_quantisation(EncodePlan.of(make_model(300, 0), EncodeOptions(tile_splats=100, position_bits=16)))
    held = frozen.start()
    held.means *= np.float32(50.0)
    frozen.constrain(held)
    assert (held.means >= frozen.low).all()
    assert (held.means <= frozen.high).all()
    assert_seen_is_decoded(frozen, held, frozen.encode(held).write())


def test_bands_that_are_zero_stay_zero(make_model):
    model = make_model(300, 3)
    model.shN[::2, 3:] = 0.0
    frozen = fix_quantisation(EncodePlan.of(model, EncodeOptions(sh_coding="scalar")))
    seen = frozen.dequantise(moved(frozen))
    came_from = frozen.source_index % 2 == 0
    assert not seen.shN[came_from, 3:].any()
    assert seen.shN[~came_from, 3:].any()


def test_entries_serve_all_their_users(make_model):
    frozen = fix_quantisation(EncodePlan.of(make_model(260, 2), EncodeOptions(**WAYS["codebook"])))
    held = frozen.start()
    before = frozen.dequantise(held).shN
    users = frozen.book.index == 3
    held.sh[3] += np.float32(1.0)
    after = frozen.dequantise(held).shN
    assert users.any()
    assert (before[users] != after[users]).all(axis=(1, 2)).all()
    assert np.array_equal(before[~users], after[~users])


def test_errors_are_stated_against_the_source(make_model):
    source = make_model(300, 2)
    rows = np.arange(0, 300, 3)
    frozen = fix_quantisation(EncodePlan.of(source.select(rows), origin=Origin(300, rows)), source)
    held = moved(frozen, share=0.05)
    result = frozen.encode(held).write({"finetuned": {"steps": 7}})
    assert_seen_is_decoded(frozen, held, result)
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
    frozen = fix_quantisation(EncodePlan.of(model, EncodeOptions(keep_extra=True)))
    result = frozen.encode(frozen.start()).write()
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
def test_the_sample_is_decoded_as_it_was_seen(sample_path, options):
    frozen = fix_quantisation(EncodePlan.of(read_ply(sample_path).select(slice(0, None, 15)), EncodeOptions(**options)))
    held = moved(frozen, share=0.02)
    assert_seen_is_decoded(frozen, held, frozen.encode(held).write())


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
def test_shared_scenes_are_decoded_as_they_were_seen(data_dir, name, options):
    frozen = fix_quantisation(EncodePlan.of(read_ply(data_dir / "ply" / f"{name}.ply"), EncodeOptions(**options)))
    held = moved(frozen, share=0.02)
    assert_seen_is_decoded(frozen, held, frozen.encode(held).write())


def test_bytes_do_not_depend_on_threads(make_model):
    model = make_model(400, 3)
    files = []
    for threads in (1, 2):
        frozen = fix_quantisation(EncodePlan.of(model, EncodeOptions(tile_splats=100, threads=threads)))
        files.append(frozen.encode(moved(frozen)).write().data)
    assert files[0] == files[1]
    assert files[0] != encode(model, EncodeOptions(tile_splats=100))
