"""Plans of files, tiles of a scene, and streams read back by the definition of the transforms in the spec."""

from __future__ import annotations

import itertools
import math
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from checked import measure_errors

from csplat import EncodeOptions, _spec, decode, encode
from csplat.decoder import decode_scene, read_options
from csplat.encoder import EncodePlan, Origin, encode_tiles, encode_with_report
from csplat.encoder.coding_parameters import Lattice
from csplat.encoder.entropy import DeflateSettings, signed_stream, unsigned_stream
from csplat.encoder.quantisation import quantise_means
from csplat.encoder.tiling import cut_tiles
from csplat.errors import InputError
from csplat_conformance.declared_bounds import Source, verify_bounds
from csplat_tools.inspect.file_description import describe_file

ROOT = Path(__file__).resolve().parent.parent
GEOMETRY = ("means", "quats", "scales", "opacities")
COLOURS = ("sh0", "shN")


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


def test_colours_and_an_origin_of_other_splats_are_refused(make_model):
    model = make_model(4, 1)
    with pytest.raises(InputError):
        EncodePlan.of(model).with_colours(model.sh0[:-1], model.shN)
    with pytest.raises(InputError, match="origin has 5 splats, expected 4"):
        EncodePlan.of(model, origin=Origin(9, np.arange(5)))


def test_a_file_is_written_twice_with_the_same_splats(make_model):
    model = make_model(200, 2)
    coded = encode_tiles(EncodePlan.of(model, EncodeOptions(tile_splats=70)))
    first = coded.write()
    second = coded.write({"fitted": {"psnr": 41.5}})
    assert first.data == coded.write().data
    assert {"fitted": {"psnr": 41.5}, **read_options(first.data)} == read_options(second.data)
    one, other = decode(first.data), decode(second.data)
    for name in (*GEOMETRY, *COLOURS):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    assert np.array_equal(first.source_index, second.source_index)


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


def test_a_file_with_adjusted_shapes_declares_only_errors_of_means(make_model):
    source, rows = make_model(400, 3), np.arange(100, 300)
    adjusted = replace(source, scales=source.scales + np.float32(0.1)).select(rows)
    result = encode_with_report(adjusted, origin=Origin(len(source), rows, refitted=True, adjusted=True))
    scene = decode_scene(result.data)

    def holds(source, index=None):
        return verify_bounds(Source.of(source), scene.model, scene.header, scene.declared_bounds, index).holds

    assert ["means"] == [record.measure for record in scene.declared_bounds.records]
    assert holds(source, result.source_index)
    assert holds(source)
    assert not holds(replace(source, means=source.means + np.float32(0.1)))


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


def sparse_model(source, share):
    """Return the model with bands 2 and 3 of some splats set to zero."""
    shN = 0.1 * source.shN
    shN[np.random.default_rng(0).random(len(source)) < share, 3:] = 0.0
    return replace(source, shN=shN.astype(np.float32))


def test_absent_bands_are_decoded_as_zeros(make_model):
    model, scalar = sparse_model(make_model(400, 3), 0.9), {"sh_coding": "scalar"}
    for options in ({}, {"tile_splats": 50}, {"deflate_level": 1}, {"adaptive": 0.5}):
        result = encode_with_report(model, EncodeOptions(**scalar, **options), importance=np.ones(400))
        decoded, expected = decode(result.data), model.shN[result.source_index]
        np.testing.assert_allclose(expected, decoded.shN, atol=0.2)
        assert not decoded.shN[~expected[:, 3:].any(axis=(1, 2)), 3:].any()
        assert {"sparse"} == codings_of_band_2(result.data)
    assert {"signed"} == codings_of_band_2(encode(make_model(400, 3), EncodeOptions(**scalar)))


def codings_of_band_2(data):
    return set(describe_file(data).as_json()["attributes"]["sh2"]["codings"])


@pytest.mark.slow
def test_absent_bands_cost_almost_nothing(make_model):
    big, sizes, scalar = make_model(6_000, 3), {}, EncodeOptions(sh_coding="scalar")
    for share in (0.0, 0.95, 1.0):
        sizes[share] = len(encode(sparse_model(big, share), scalar))
    full = sizes[0.0] - sizes[1.0]
    # One twentieth of the values, and for each of two bands a mask of at most half a bit per splat.
    assert sizes[0.95] - sizes[1.0] < 0.05 * full + 2 * 6_000 * 0.5 / 8


def test_other_packages_import_no_modules_of_the_encoder():
    places = [ROOT / "trainer", ROOT / "tools" / "csplat_tools", ROOT / "conformance" / "csplat_conformance"]
    uses = re.compile(r"^\s*(?:from|import) csplat\.encoder\..*", re.MULTILINE)
    files = [path for place in places for path in sorted(place.rglob("*.py"))]
    assert {} == {str(path): lines for path in files if (lines := uses.findall(path.read_text("utf-8")))}


def cloud(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)).astype(np.float32)


def test_every_splat_is_in_one_of_the_fewest_tiles():
    for count in (0, 1, 2, 99, 100, 101, 1000):
        tiles = cut_tiles(cloud(count), Lattice(1e-3, 16), 100)
        rows = np.concatenate([np.zeros(0, np.intp), *(tile.rows for tile in tiles)])
        assert list(range(count)) == sorted(rows.tolist())
        assert all(len(tile.rows) <= 100 for tile in tiles)
        assert math.ceil(count / 100) == len(tiles)


def test_an_outlier_gets_a_tile_of_its_own():
    means = np.concatenate([cloud(1000), [[1000, 0, 0]]]).astype(np.float32)
    tiles = cut_tiles(means, Lattice(1e-4, 16), 65536)
    assert [0, 0] == [tile.exponent for tile in tiles]
    assert sorted([1, 1000]) == sorted(len(tile.rows) for tile in tiles)


def test_no_tile_exceeds_its_bits():
    for bits, scale, finest in itertools.product((2, 8, 16), (1e-30, 1.0, 1e30), (False, True)):
        means = (cloud(300) * scale).astype(np.float32)
        lattice = Lattice(scale / 2**bits, bits, finest)
        for tile in cut_tiles(means, lattice, 60):
            n = quantise_means(means[tile.rows].T.copy(), math.ldexp(lattice.step, tile.exponent))
            extent = int((n.max(axis=1) - n.min(axis=1)).max())
            assert extent < 2**bits
            assert np.abs(n).max() <= 2**53
            if finest and bits > 2:
                assert extent >= 2 ** (bits - 2)


def test_means_from_denormal_to_huge_are_tiled():
    rng = np.random.default_rng(0)
    magnitudes = 10.0 ** rng.uniform(-38, 38, (2000, 1))
    means = (rng.choice([-1, 1], (2000, 3)) * magnitudes).astype(np.float32)
    tiles = cut_tiles(means, Lattice(1e-3, 16), 65536)
    assert 2000 == sum(len(tile.rows) for tile in tiles)
    for tile in tiles:
        step = math.ldexp(1e-3, tile.exponent)
        assert np.isfinite(quantise_means(means[tile.rows].T.copy(), step)).all()


def read(stream: bytes) -> tuple[_spec.StreamHead, list[int]]:
    """Undo a stream by section 6 of the spec, one integer at a time."""
    head = _spec.unpack_stream_head(stream)
    coded = stream[_spec.STREAM_HEAD_SIZE :]
    assert head.coded_size == len(coded)
    packed = {_spec.CODER_STORED: lambda: coded, _spec.CODER_DEFLATE: lambda: zlib.decompress(coded, -15)}[head.coder]()
    assert head.packed_size == len(packed)
    transforms = [step for step in head.transforms if step]
    assert transforms == sorted(set(transforms))
    if _spec.TRANSFORM_RUN_LENGTH in transforms:
        runs = len(packed) // 3
        lengths = [1 + packed[runs + i] + 256 * packed[2 * runs + i] for i in range(runs)]
        packed = b"".join(bytes([packed[i]]) * lengths[i] for i in range(runs))
    n, w = head.count, head.width
    assert n * w == len(packed)
    if _spec.TRANSFORM_BYTE_PLANES in transforms:
        values = [sum(packed[plane * n + i] << (8 * plane) for plane in range(w)) for i in range(n)]
    else:
        values = [int.from_bytes(packed[i * w : i * w + w], "little") for i in range(n)]
    if _spec.TRANSFORM_ZIGZAG in transforms:
        values = [v >> 1 if v % 2 == 0 else 2 ** (8 * w) - 1 - (v >> 1) for v in values]
    if _spec.TRANSFORM_DELTA in transforms:
        for i in range(1, n):
            values[i] = (values[i] + values[i - 1]) % 2 ** (8 * w)
    return head, values


RNG = np.random.default_rng(0)

UNSIGNED = {
    "one": np.array([7]),
    "zeros": np.zeros(600, np.int64),
    "long runs": np.repeat([3, 200], [70_000, 300]),
    "bytes": RNG.integers(0, 255, 300),
    "two bytes": RNG.integers(0, 65535, 300),
    "three bytes": RNG.integers(0, 2**24, 300),
    "seven bytes": RNG.integers(0, 2**51, 300),
    "ascending": np.sort(RNG.integers(0, 2**48, 300)),
}


def test_unsigned_streams_read_back():
    for values, library in itertools.product(UNSIGNED.values(), ("libdeflate", "zlib")):
        for mode in ({}, {"delta": True}, {"signed_delta": True}):
            stream = unsigned_stream(values.astype(np.int64), DeflateSettings(6, library), **mode)
            assert bool(values.tolist() == read(stream)[1]), (values[:9], library, mode)


def test_signed_streams_read_back_at_every_width():
    for dtype, level in itertools.product((np.int8, np.int16, np.int32), (1, 6, 12)):
        limits = np.iinfo(dtype)
        values = np.array([0, 1, -1, limits.min, limits.max, 5, -5] * 50, dtype)
        head, read_back = read(signed_stream(values, DeflateSettings(level)))
        assert np.dtype(dtype).itemsize == head.width
        assert [int(v) % 2 ** (8 * head.width) for v in values] == read_back


def test_elements_have_the_smallest_sufficient_width():
    assert 1 == read(signed_stream(np.array([-128, 127], np.int32), DeflateSettings()))[0].width
    assert 2 == read(signed_stream(np.array([-129], np.int32), DeflateSettings()))[0].width
    assert 3 == read(unsigned_stream(np.array([1 << 16]), DeflateSettings()))[0].width


def test_a_constant_plane_costs_a_few_bytes():
    assert len(unsigned_stream(np.full(65536, 200), DeflateSettings(1))) <= _spec.STREAM_HEAD_SIZE + 3


#: Like the SH of a scene where some splats have none: noise interrupted by runs of zeros.
NOISE = RNG.integers(-20, 20, 15_000).astype(np.int8)
CUT = np.where(np.repeat(RNG.random(5_000) < 0.6, 3), np.int8(0), NOISE)


def test_run_lengths_are_used_if_smaller():
    pairs = np.repeat(RNG.integers(-100, 100, 6_000).astype(np.int8), RNG.integers(1, 4, 6_000))
    assert _spec.TRANSFORM_RUN_LENGTH in read(signed_stream(pairs, DeflateSettings(12)))[0].transforms
    assert _spec.TRANSFORM_RUN_LENGTH not in read(signed_stream(NOISE, DeflateSettings(12)))[0].transforms


def test_the_lowest_level_finds_runs_and_no_matches_in_noise():
    assert len(signed_stream(CUT, DeflateSettings(1))) < 1.15 * len(signed_stream(CUT, DeflateSettings(12)))
    assert len(signed_stream(NOISE, DeflateSettings(1))) < 1.05 * len(signed_stream(NOISE, DeflateSettings(12)))


def test_unknown_levels_and_libraries_are_refused():
    for arguments in ((0,), (13,), (6, "gzip")):
        with pytest.raises(InputError):
            DeflateSettings(*arguments)
