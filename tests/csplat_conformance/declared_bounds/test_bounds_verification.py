# SPDX-License-Identifier: Apache-2.0
"""Verification of declared errors, in memory and tile by tile, and descriptions of files.

Also: csplat_conformance.declared_bounds.tile_pairs.
"""

import json
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import cycle
from mmap import mmap

import numpy as np
import pytest
from checked import flipped
from tables import failures
from typer.testing import CliRunner

from csplat import _spec
from csplat.decoder import decode, decode_scene, read_header
from csplat.disk_files import read_array
from csplat.encode_api import encode, encode_with_report
from csplat.encoder import EncodeOptions
from csplat.errors import CsplatError
from csplat.ply import write_ply
from csplat.scene import Scene
from csplat.splat_file import SplatFile
from csplat_conformance.declared_bounds import Source, verify_bounds, verify_bounds_by_tile
from csplat_tools.cli.app import app
from csplat_tools.inspect.file_description import describe_file
from csplat_tools.inspect.verification import verify_file


def verify(source, scene, index=None, declared=True):
    """Verify the errors that a scene declares, or others."""
    return verify_bounds(
        Source.of(source), scene.model, scene.header, scene.declared_bounds if declared is True else declared, index
    )


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["fast", "balanced", "small"])
def test_errors_declared_by_the_encoder_are_verified(make_model, preset):
    source = make_model(1000, 3)
    result = encode_with_report(source, EncodeOptions(preset=preset, tile_splats=400))
    scene = decode_scene(result.data)
    for index in (result.source_index, None):
        verified = verify(source, scene, index)
        assert ((), index is not None) == (verified.failures, verified.rms_verified)


@pytest.mark.slow
def test_declared_errors_that_are_too_small_or_inexact_are_not_verified(make_model):
    # SER-5
    source = make_model(200, 1)
    result = encode_with_report(source)
    scene, index = decode_scene(result.data), result.source_index
    bounds = scene.declared_bounds

    def holds(index, number, **factors):
        records = list(bounds.records)
        wrong = {name: getattr(records[number], name) * factor for name, factor in factors.items()}
        records[number] = replace(records[number], **wrong)
        return verify(source, scene, index, replace(bounds, records=tuple(records))).holds

    assert len(bounds.records) == 5
    for number in range(5):
        assert not holds(None, number, max=0.99)
        for factors in ({"max": 0.99}, {"max": 1.001}, {"rms": 0.999}, {"rms": 1.001}):
            assert not holds(index, number, **factors)
    for factor, held in ((0.5, False), (1e200, True)):  # RMS needs an index
        records = tuple(replace(one, max=one.max * factor, rms=one.rms * factor) for one in bounds.records)
        for refitted in (False, True):
            declared = replace(bounds, refitted=refitted, records=records)
            assert held == verify(source, scene, declared=declared).holds
            assert not verify(source, scene, index, declared).holds


def test_refitted_or_undeclared_attributes_are_not_verified(make_model):
    # SER-6
    source = make_model(50, 0)
    scene = decode_scene(encode(source))
    fewer = replace(scene.declared_bounds, records=scene.declared_bounds.records[:2])
    refitted, silent, nothing = (
        verify(source, scene, declared=declared) for declared in (replace(fewer, refitted=True), fewer, None)
    )
    assert (True, ("opacities", "sh0")) == (refitted.holds, refitted.unverified)
    assert "renders" in refitted.notes[-1]
    assert silent.failures == ("the file declares no bound for opacities", "the file declares no bound for sh0")
    assert nothing.failures == ("the file declares no bounds",)


@pytest.mark.slow
@pytest.mark.parametrize("indexed", [True, False])
def test_a_failure_names_splat_tile_source_and_error(make_model, indexed):
    source = make_model(1000, 1)
    result = encode_with_report(source, EncodeOptions(tile_splats=400))
    scene = decode_scene(result.data)
    sh0 = scene.model.sh0.copy()
    sh0[700] += np.float32(5.0)
    changed = replace(scene, model=replace(scene.model, sh0=sh0))
    verified = verify(source, changed, result.source_index if indexed else None)
    (wrong,) = (one for one in verified.measures if one.holds is False)
    worst, partner = wrong.worst, result.source_index[700]
    tile = scene.header.tiles[worst.tile]
    assert ("sh0", 700, partner) == (wrong.name, worst.splat, worst.source_splat)
    assert tile.start <= 700 < tile.start + tile.splat_count
    assert worst.found == pytest.approx(5.0, rel=0.1)
    line = next(line for line in verified.failures if line.startswith("sh0: "))
    for words in (
        f"splat 700 (tile {worst.tile})",
        f"source splat {partner}",
        f"the declared {wrong.declared_max:.9g}",
    ):
        assert words in line


def test_extra_columns_but_no_normals_are_verified(make_model):
    label = {"label": np.arange(50, dtype=np.int16)}
    source = make_model(50, 0, extra={**label, "nx": np.zeros(50, np.float32)})
    result = encode_with_report(source, EncodeOptions(keep_extra=True))
    scene = decode_scene(result.data)
    assert verify(replace(source, extra=label), scene, result.source_index).holds
    verified = verify(replace(source, extra={"label": np.zeros(50, np.int16)}), scene, result.source_index)
    assert verified.failures == ("the extra column 'label' differs from that of the source",)
    assert verified.clauses == ("SRC-3",)


@pytest.mark.slow
@pytest.mark.parametrize("options", [
    EncodeOptions(),
    EncodeOptions(preset="fast", tile_splats=64),
    EncodeOptions(sh_coding="codebook", codebook_size=16, escape_fraction=0.1),
    EncodeOptions(sh_coding="none"),
    EncodeOptions(means_coding="axis", keep_extra=True),
])  # fmt: skip
def test_a_description_accounts_for_every_byte(make_model, options):
    data = encode_with_report(make_model(300, 3, extra={"label": np.arange(300, dtype=np.uint16)}), options).data
    described, header = describe_file(data).as_json(), read_header(data)
    attributes, layers = (sum(one["size_bytes"] for one in described[by].values()) for by in ("attributes", "layers"))
    assert attributes + sum(described["overhead"].values()) == len(data)
    frames = sum(len(tile.layers) for tile in header.tiles) * (_spec.CHUNK_HEADER_SIZE + _spec.TILE_HEAD_SIZE)
    assert described["overhead"]["tile_frames"] == frames
    others = sum(chunk.size for chunk in header.directory if chunk.type != b"CODB")
    assert layers + others + _spec.HEADER_SIZE + header.index_size == len(data)


@pytest.mark.slow
def test_damaged_files_are_described_or_refused(make_model):
    data = encode(make_model(4, 1), EncodeOptions(sh_coding="codebook", codebook_size=2))
    masks = dict(zip(range(0, len(data), 2), cycle((0x01, 0xFF, 0x80)), strict=False))
    for damaged in flipped(data, masks, masks.get):
        with suppress(CsplatError):
            describe_file(damaged).as_json()
    for length in range(0, len(data), 11):
        with pytest.raises(CsplatError):
            describe_file(data[:length])


OPTIONS = EncodeOptions(preset="fast", tile_splats=300, keep_extra=True)


def both(source, data, index):
    """Verify in memory and tile by tile, with equal results; return them as JSON, numbers rounded to nine digits."""
    opened = SplatFile.open(data)

    def blocks():
        return (source.select(slice(start, start + 170)) for start in range(0, len(source), 170))

    at_once = verify_bounds(Source.of(source), decode(data), opened.header, opened.declared_bounds, index)
    by_tile = verify_bounds_by_tile(Scene.of(source).changed(reader=blocks), opened, index, 400)
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
        assert found["rms_and_counts_verified"] == bool(found["measures"])

    assert [] == failures(scenes, check)


@pytest.mark.slow
def test_failures_are_reported_tile_by_tile(make_model):
    source = make_model(450, 1, extra={"label": np.arange(450, dtype=np.int32)})
    result = encode_with_report(source, OPTIONS)
    bump = np.zeros((450, 1), np.float32)
    bump[[3, 200, 449]] = 0.7
    for changed in (
        replace(source, means=source.means + bump),
        replace(source, sh0=source.sh0 + bump),
        replace(source, extra={"label": source.extra["label"] // 2}),
        make_model(451, 0),
    ):
        assert both(changed, result.data, result.source_index)["failures"]


@pytest.mark.slow
def test_a_scene_beyond_the_memory_is_verified_with_an_index_alone(make_model, tmp_path):
    ply, file, index = tmp_path / "scene.ply", tmp_path / "scene.csplat", tmp_path / "index.npy"
    source = make_model(700, 1)
    result = encode_with_report(source, OPTIONS)
    write_ply(ply, source)
    file.write_bytes(result.data)
    np.save(index, result.source_index)
    mapped = read_array(str(index), most_bytes=0)
    assert isinstance(mapped.base, mmap)
    assert both(source, result.data, result.source_index) == both(source, result.data, mapped)
    command = ["verify", str(file), "--source", str(ply), "--json", "--quiet"]
    indexed = [*command, "--source-index", str(index)]
    assert 0 == CliRunner().invoke(app, command).exit_code
    with pytest.MonkeyPatch.context() as patch:
        small = partial(replace, memory=100_000)
        patch.setattr(
            "csplat_tools.cli.verify.verify_file",
            lambda *words, context, **options: verify_file(*words, context=small(context), **options),
        )
        alone, by_tile = (CliRunner().invoke(app, words) for words in (command, indexed))
    assert (1, 0) == (alone.exit_code, by_tile.exit_code), by_tile.output
    assert "takes 0 MB of memory, expected at most 0 MB; give --source-index" in " ".join(alone.stderr.split())
    assert rounded(json.loads(CliRunner().invoke(app, indexed).stdout)) == rounded(json.loads(by_tile.stdout))
