"""Verification of declared errors, in memory and tile by tile, and descriptions of files."""

import json
import re
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import cycle
from mmap import mmap

import numpy as np
import pytest
from checked import covariances, disturbed, measure_errors
from tables import failures
from typer.testing import CliRunner

from csplat import _spec
from csplat.decoder import decode, decode_scene, open_tiles, read_header
from csplat.disk_files import read_array
from csplat.encoder import EncodeOptions, encode, encode_with_report
from csplat.errors import CsplatError, InputError
from csplat.ply import write_ply
from csplat.scene_source import source_from_model
from csplat_conformance.declared_bounds import Source, check_source_index, verify_bounds, verify_bounds_by_tile
from csplat_conformance.declared_bounds.measurement import measure_pairs as measured
from csplat_conformance.declared_bounds.measurement import pair_differences as differences_of
from csplat_conformance.declared_bounds.partners import UNDECIDED, UNMATCHED
from csplat_conformance.declared_bounds.partners import find_partners as match_source
from csplat_tools.cli.app import app
from csplat_tools.inspect.file_description import describe_file
from csplat_tools.inspect.verification import verify_file


def differences(source, *rest):
    return differences_of(Source.of(source), *rest)


def match(source, *rest, **options):
    return match_source(Source.of(source), *rest, **options)


def measure_pairs(source, *rest, **options):
    """Return (max, rms) by measure."""
    return {name: found[:2] for name, found in measured(Source.of(source), *rest, **options).items()}


# Errors of pairs ----------------------------------------------------------------------------------
def test_covariance_errors_agree_with_the_definition(make_model):
    source, rows = make_model(60, 0), np.arange(60)
    decoded = disturbed(source, np.random.default_rng(1), 0.1)
    found = differences(source, decoded, rows, rows)["covariance"][:, 0]
    theirs, ours = (covariances(one.quats, one.scales) for one in (source, decoded))
    expected = np.linalg.norm(ours - theirs, axis=(1, 2)) / np.linalg.norm(theirs, axis=(1, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    negated = replace(source, quats=-source.quats)  # the same rotations
    assert measure_pairs(source, negated, rows)["covariance"][0] < 1e-15


def test_log_scales_of_any_size_have_covariance_errors(make_model):
    source = make_model(3, 0, scales=np.array([[60, 60, 60], [-60, -60, -60], [60, -60, 0]], np.float32))
    decoded = replace(source, scales=source.scales + np.float32(0.0078125))
    found = differences(source, decoded, np.arange(3), np.arange(3))["covariance"]
    np.testing.assert_allclose(found, np.expm1(2 * 0.0078125), rtol=1e-12)
    # An RMS beyond float64 is infinite.
    low, high = (make_model(9000, 0, scales=np.full((9000, 3), scale, np.float32)) for scale in (-88.0, 88.0))
    assert measure_pairs(low, high, np.arange(9000))["covariance"][1] == np.inf


@pytest.mark.parametrize(
    ("source", "decoded", "clipped"), [(-1e6, 1e6, (-88, 88)), (90, 3e38, (1, 1)), (-1, 99, (-1, 88))]
)
def test_scales_beyond_float32_are_clipped_to_its_range(make_model, source, decoded, clipped):
    def error(*scales):
        pair = [make_model(1, 0, scales=np.full((1, 3), scale, np.float32)) for scale in scales]
        return [measure(*pair, np.zeros(1, int))["covariance"] for measure in (measure_pairs, measure_errors)]

    found, expected = error(source, decoded), error(*clipped)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)


def test_agrees_with_the_encoder_in_any_number_of_threads(make_model):
    source = make_model(9000, 3)
    rng = np.random.default_rng(2)
    index = rng.permutation(9000)[:8500]
    decoded = disturbed(source.select(index), rng)
    ours, theirs = measure_pairs(source, decoded, index, threads=1), measure_errors(source, decoded, index)
    assert ours == measure_pairs(source, decoded, index, threads=3)
    assert set(ours) == set(theirs)
    for name, pair in ours.items():
        assert pair == pytest.approx(theirs[name], rel=1e-5), name


def test_bands_that_one_model_lacks_are_zero_there(make_model):
    source = make_model(30, 2)
    decoded = replace(source, shN=np.ascontiguousarray(source.shN[:, :3]))
    errors = measure_pairs(source, decoded, np.arange(30))
    assert errors["sh1"] == (0.0, 0.0)
    assert errors["sh2"][0] == np.abs(source.shN[:, 3:]).max()


def test_an_index_beyond_the_source_is_refused(make_model):
    model = make_model(5, 0)
    for index in (np.array([0, 1, 2, 3, 5]), np.array([-1, 0, 1, 2, 3]), np.arange(4), np.arange(5.0)):
        with pytest.raises(InputError, match="source index"):
            measure_pairs(model, model, index)


# Partners without an index ------------------------------------------------------------------------
def bounds_of(source, decoded, index):
    return {name: pair[0] for name, pair in measure_pairs(source, decoded, index).items()}


@pytest.mark.parametrize("sigma", [0.0, 1e-4, 0.1])
def test_finds_partners(make_model, sigma):
    source, count = make_model(1500, 1), 1500
    rng = np.random.default_rng(4)
    index = rng.permutation(count)
    decoded = disturbed(source.select(index), rng, sigma)
    bounds = bounds_of(source, decoded, index)
    found = match(source, decoded, bounds, np.full(count, sigma))
    assert (found >= 0).all()
    errors = differences(source, decoded, found, np.arange(count))
    assert all(np.abs(errors[name]).max() <= bounds[name] * (1 + 1e-9) + 1e-12 for name in bounds)
    # A radius that is too small only costs time.
    some = decoded.select(slice(0, 100))
    assert all((match(source, some, bounds, np.full(100, radius)) >= 0).all() for radius in (0.0, 1e-9))
    assert {UNMATCHED} == {*match(make_model(0, 1), some, bounds, np.zeros(100)).tolist()}


@pytest.mark.parametrize("attribute", ["means", "scales", "opacities", "sh0", "shN"])
def test_a_splat_without_a_partner_is_reported(make_model, attribute):
    source = make_model(300, 1)
    decoded = disturbed(source, np.random.default_rng(6))
    bounds = bounds_of(source, decoded, np.arange(300))
    array = getattr(decoded, attribute).copy()
    array[17] = 0.5 * array[17] + 0.3
    found = match(source, replace(decoded, **{attribute: array}), bounds, np.full(300, 1e-3))
    assert list(np.flatnonzero(found == UNMATCHED)) == [17]


def test_coordinates_of_all_magnitudes_find_partners(make_model):
    means = np.array([[1e30, 0, 0], [1e-30, 0, 0], [0, -1e7, 1e7], [0, 0, 0], [1e-45, 1, 1]], np.float32)
    source = make_model(5, 0, means=means)
    bounds = bounds_of(source, source, np.arange(5))
    assert list(match(source, source, bounds, np.zeros(5))) == list(range(5))
    assert list(match(source, source, {**bounds, "means": 1e-3}, np.full(5, 1e-30))) == [0, 1, 2, 3, 4]


def test_the_search_gives_up_on_equal_splats(make_model):
    count = 120
    ones = {
        "quats": np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        "opacities": np.ones(count, np.float32),
        **dict.fromkeys(("means", "scales", "sh0"), np.zeros((count, 3), np.float32)),
    }
    source = make_model(count, 1, **ones)
    decoded = replace(source, shN=source.shN[::-1].copy())
    bounds = bounds_of(source, source, np.arange(count))
    assert (match(source, decoded, bounds, np.zeros(count)) == np.arange(count)[::-1]).all()
    found = match(source, decoded, bounds, np.zeros(count), candidates_max=20)
    assert set(found[found < 0]) == {UNDECIDED}


def verify(source, scene, index=None, declared=True):
    """Verify the errors that a scene declares, or others."""
    return verify_bounds(
        Source.of(source), scene.model, scene.header, scene.declared_bounds if declared is True else declared, index
    )


# Verification -------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("preset", ["fast", "balanced", "small"])
def test_errors_declared_by_the_encoder_are_verified(make_model, preset):
    source = make_model(1500, 3)
    result = encode_with_report(source, EncodeOptions(preset=preset, tile_splats=400))
    scene = decode_scene(result.data)
    for index in (result.source_index, None):
        proof = verify(source, scene, index)
        assert ((), index is not None) == (proof.failures, proof.rms_verified)


def test_declared_errors_that_are_too_small_or_inexact_are_not_verified(make_model):
    # SER-5
    source = make_model(200, 1)
    result = encode_with_report(source)
    scene, index = decode_scene(result.data), result.source_index
    bounds = scene.declared_bounds

    def holds(index, number, **wrong):
        records = list(bounds.records)
        records[number] = replace(records[number], **wrong)
        return verify(source, scene, index, replace(bounds, records=tuple(records))).holds

    assert len(bounds.records) == 5
    for number, record in enumerate(bounds.records):
        assert not holds(None, number, max=record.max * 0.99)
        for wrong in (
            {"max": record.max * 0.99}, {"max": record.max * 1.001}, {"rms": record.rms * 0.999},
            {"rms": record.rms * 1.001},
        ):  # fmt: skip
            assert not holds(index, number, **wrong)
    for factor, held in ((0.5, False), (1e200, True)):  # RMS needs an index
        records = tuple(replace(one, max=one.max * factor, rms=one.rms * factor) for one in bounds.records)
        for refitted in (False, True):
            stated = replace(bounds, refitted=refitted, records=records)
            assert held == verify(source, scene, declared=stated).holds
            assert not verify(source, scene, index, stated).holds


def test_refitted_or_undeclared_attributes_are_not_verified(make_model):
    # SER-6
    source = make_model(50, 0)
    scene = decode_scene(encode(source))
    assert scene.declared_bounds is not None
    fewer = replace(scene.declared_bounds, records=scene.declared_bounds.records[:2])
    refitted = verify(source, scene, declared=replace(fewer, refitted=True))
    assert refitted.holds
    assert refitted.unverified == ("opacities", "sh0")
    assert "renders" in refitted.notes[-1]
    silent = verify(source, scene, declared=fewer)
    assert silent.failures == ("the file states no error of opacities", "the file states no error of sh0")
    nothing = verify(source, scene, declared=None)
    assert nothing.failures == ("the file states no errors",)


@pytest.mark.parametrize("indexed", [True, False])
def test_a_failure_names_splat_tile_source_and_error(make_model, indexed):
    source = make_model(1500, 1)
    result = encode_with_report(source, EncodeOptions(tile_splats=400))
    scene = decode_scene(result.data)
    sh0 = scene.model.sh0.copy()
    sh0[700] += np.float32(5.0)
    index = result.source_index if indexed else None
    proof = verify(source, replace(scene, model=replace(scene.model, sh0=sh0)), index)
    wrong = [one for one in proof.measures if one.holds is False]
    assert ["sh0"] == [one.name for one in wrong]
    worst = wrong[0].worst
    tile = scene.header.tiles[worst.tile]
    assert (700, result.source_index[700]) == (worst.splat, worst.source_splat)
    assert tile.start <= 700 < tile.start + tile.splat_count
    assert worst.found == pytest.approx(5.0, rel=0.1)
    line = next(line for line in proof.failures if line.startswith("sh0: "))
    assert f"splat 700 (tile {worst.tile})" in line
    assert f"source splat {worst.source_splat}" in line
    assert f"above the stated {wrong[0].declared_max:.9g}" in line


def test_extra_columns_but_no_normals_are_verified(make_model):
    label = {"label": np.arange(50, dtype=np.int16)}
    source = make_model(50, 0, extra={**label, "nx": np.zeros(50, np.float32)})
    result = encode_with_report(source, EncodeOptions(keep_extra=True))
    scene = decode_scene(result.data)
    assert verify(replace(source, extra=label), scene, result.source_index).holds
    proof = verify(replace(source, extra={"label": np.zeros(50, np.int16)}), scene, result.source_index)
    assert proof.failures == ("the extra column 'label' differs from that of the source",)
    assert proof.clauses == ("SRC-3",)


# Descriptions ----------------------------------------------------------------------
@pytest.mark.parametrize("options", [
    EncodeOptions(),
    EncodeOptions(preset="fast", tile_splats=64),
    EncodeOptions(sh_coding="codebook", codebook_size=16, escape_fraction=0.1),
    EncodeOptions(sh_coding="none"),
    EncodeOptions(means_coding="axis", keep_extra=True),
])  # fmt: skip
def test_a_description_accounts_for_every_byte(make_model, options):
    model = make_model(300, 3, extra={"label": np.arange(300, dtype=np.uint16)})
    data = encode(model, options)
    described = describe_file(data).as_json()
    sizes = sum(one["size_bytes"] for one in described["attributes"].values())
    assert sizes + sum(described["overhead"].values()) == len(data)
    header = read_header(data)
    frames = sum(len(tile.layers) for tile in header.tiles) * (_spec.CHUNK_HEADER_SIZE + _spec.TILE_HEAD_SIZE)
    assert described["overhead"]["tile_frames"] == frames
    layers = sum(one["size_bytes"] for one in described["layers"].values())
    others = sum(chunk.size for chunk in header.directory if chunk.type != b"CODB")
    assert layers + others + _spec.HEADER_SIZE + header.index_size == len(data)


@pytest.mark.slow
def test_damaged_files_are_described_or_refused(make_model):
    data = encode(make_model(4, 1), EncodeOptions(sh_coding="codebook", codebook_size=2))
    for place, change in zip(range(0, len(data), 2), cycle((0x01, 0xFF, 0x80)), strict=False):
        damaged = bytearray(data)
        damaged[place] ^= change
        with suppress(CsplatError):
            describe_file(bytes(damaged)).as_json()
    for length in range(0, len(data), 11):
        with pytest.raises(CsplatError):
            describe_file(data[:length])


OPTIONS = EncodeOptions(preset="fast", tile_splats=300, keep_extra=True)


def both(source, data, index):
    """Verify in memory and tile by tile, with equal results; return them as JSON, numbers rounded to nine digits."""
    opened = open_tiles(data)

    def blocks():
        return (source.select(slice(start, start + 170)) for start in range(0, len(source), 170))

    at_once = verify_bounds(Source.of(source), decode(data), opened.header, opened.declared_bounds, index)
    by_tile = verify_bounds_by_tile(replace(source_from_model(source), blocks=blocks), opened, index, 400)
    assert at_once.clauses == by_tile.clauses
    found = rounded(at_once.as_json())
    assert found == rounded(by_tile.as_json())
    return found


def rounded(value):
    if isinstance(value, dict):
        return {name: rounded(one) for name, one in value.items()}
    return float(f"{value:.9g}") if isinstance(value, float) else value


@pytest.mark.slow
def test_files_are_verified_tile_by_tile(make_model):
    model, origin = make_model(500, 0), (5e5, 4e6, 30.0)
    doubles = model.means.astype(np.float64) + np.array(origin)
    near = (doubles - origin).astype(np.float32)
    scenes = {
        "ordinary": make_model(950, 1, origin=(1e6, -2.0, 3.5), extra={"label": np.arange(950, dtype=np.int32)}),
        "means in doubles": replace(model, means_double=doubles, means=near, origin=origin),
        "empty": make_model(0, 1),
    }

    def check(source):
        result = encode_with_report(source, OPTIONS)
        found = both(source, result.data, result.source_index)
        assert not found["failures"]
        assert found["rms_and_counts_proved"] == bool(found["measures"])

    assert [] == failures(scenes, check)


@pytest.mark.slow
@pytest.mark.parametrize("attribute", ["means", "sh0", "extra", "count"])
def test_failures_are_reported_tile_by_tile(make_model, attribute):
    source = make_model(450, 1, extra={"label": np.arange(450, dtype=np.int32)})
    result = encode_with_report(source, OPTIONS)
    if attribute == "extra":
        changed = replace(source, extra={"label": source.extra["label"] // 2})
    elif attribute == "count":
        changed = make_model(451, 0)
    else:
        array = getattr(source, attribute).copy()
        array[[3, 200, 449]] += np.float32(0.7)
        changed = replace(source, **{attribute: array})
    assert both(changed, result.data, result.source_index)["failures"]


@pytest.mark.parametrize(("index", "message"), [
    (np.array([0, 1, 1]), "splats 1 and 2 both have the source index 1"),
    (np.array([2, 0, 2]), "splats 0 and 2 both have the source index 2"),
    (np.array([0, 1, 5]), "splat 2 is 5"),
])  # fmt: skip
def test_invalid_source_indices_are_found_in_blocks(index, message):
    for block in (1, 2, 3):
        with pytest.raises(InputError, match=message):
            check_source_index(index, 5, 3, block=block)


@pytest.mark.slow
def test_a_source_index_may_be_memory_mapped(make_model, tmp_path):
    source = make_model(500, 1)
    result = encode_with_report(source, OPTIONS)
    np.save(tmp_path / "index.npy", result.source_index)
    mapped = read_array(str(tmp_path / "index.npy"), most_bytes=0)
    assert isinstance(mapped.base, mmap)
    assert both(source, result.data, result.source_index) == both(source, result.data, mapped)


@pytest.mark.slow
def test_a_scene_beyond_the_memory_is_verified_with_an_index_alone(make_model, tmp_path):
    ply, file, index = tmp_path / "scene.ply", tmp_path / "scene.csplat", tmp_path / "index.npy"
    source = make_model(700, 1)
    result = encode_with_report(source, OPTIONS)
    write_ply(ply, source)
    file.write_bytes(result.data)
    np.save(index, result.source_index)
    command = ["verify", str(file), "--source", str(ply), "--json", "--quiet"]
    indexed = [*command, "--source-index", str(index)]
    assert 0 == CliRunner().invoke(app, command).exit_code
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("csplat_tools.cli.verify.verify_file", partial(verify_file, memory_bytes=100_000))
        alone, by_tile = (CliRunner().invoke(app, words) for words in (command, indexed))
    assert 1 == alone.exit_code
    assert re.search(
        r"not checked: this takes 0 MB of memory, expected at most 0 MB; give --source-index", alone.stderr
    )
    assert 0 == by_tile.exit_code, by_tile.output
    assert rounded(json.loads(CliRunner().invoke(app, indexed).stdout)) == rounded(json.loads(by_tile.stdout))
