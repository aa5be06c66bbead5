# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_trainer.sensitivity_file.

Also: csplat_tools.importance_file.
"""

from dataclasses import replace

import numpy as np
import pytest
from command_line import change_views, hide_renderer, invoke
from sensitivity_cases import cameras, small_scene

import csplat
from csplat import Context
from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat.ply import read_ply, write_ply
from csplat_render.scene_frame import scene_frame
from csplat_render.scorer import Scorer
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.encode_file import encode_file
from csplat_tools.importance_file import encoder_importance
from csplat_tools.scene_files import load_scene, with_first_view
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.sensitivity_file import GROUPS, read_sensitivity, write_sensitivity

pytestmark = pytest.mark.usefixtures("small_views")


def written(path, model, source="cameras"):
    """Measure a scene and write the file; return the sensitivities."""
    found = measure_sensitivity(model, cameras(), metric=True)
    with path.open("wb") as stream:
        write_sensitivity(stream, model, found, source)
    return found


@pytest.fixture
def stored(tmp_path):
    path, model = tmp_path / "scene.npz", small_scene(30, 2)
    return path, model, written(path, model)


def test_virtual_views_in_surroundings_give_no_blocks(stored):
    path, model, _ = stored
    read = read_sensitivity(path, model)
    angles = np.linspace(0.0, 20.0 * np.pi, len(model))[:, None]
    ring = 500.0 * np.concatenate([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    near = np.arange(len(model))[:, None] % 2 == 1
    scales = np.repeat(np.where(near, np.float32(-5.0), np.float32(3.0)), 3, axis=1)
    inside = replace(model, means=np.where(near, model.means, ring).astype(np.float32), scales=scales)
    assert scene_frame(inside).kind == "surrounding"
    virtual = replace(read, source="virtual")
    assert encoder_importance(virtual, inside).blocks is None
    assert encoder_importance(read, inside).blocks is not None
    assert encoder_importance(virtual, model).blocks is not None


@pytest.mark.slow
def test_fewer_bands_are_projected_if_the_renderer_is_installed(sample_path, tmp_path, monkeypatch):
    model, options = read_ply(sample_path).select(slice(0, 900)), EncodeOptions(sh_degree=1, attribute_psnr=60.0)
    scorer = Scorer.of_source(model, virtual_cameras(model, 3, 96, 72))
    projected = encode_file(load_scene(model), str(tmp_path / "projected.csplat"), options).result
    assert "projected onto the others, for the directions of " in projected.report.notes[-1]
    cut = csplat.encode(with_first_view(load_scene(model)).model(), options)
    assert scorer.psnr(csplat.decode(cut)) + 0.5 < scorer.psnr(csplat.decode(projected.data))
    bounded = encode_file(load_scene(model), str(tmp_path / "bounded.csplat"), options, context=Context(memory=10**9))
    assert "bands are cut off: " in bounded.result.report.notes[-1]
    hide_renderer(monkeypatch)
    without = encode_file(load_scene(model), str(tmp_path / "without.csplat"), options).result
    assert bool(cut == without.data)
    assert "are not projected onto the others: this installation" in without.report.notes[-1]


def test_a_file_is_written_and_read(stored):
    path, model, found = stored
    read = read_sensitivity(path, model)
    assert ("cameras", 2) == (read.source, read.view_count)
    assert np.isnan(read.missed_share)
    for name in GROUPS:
        np.testing.assert_array_equal(getattr(found, name).astype(np.float32), read.groups[name], name)
    importance = read.importance()
    assert ((30, 45), (30, 21)) == (importance.sh_metric.shape, importance.shape_metric.shape)
    rows, columns = np.triu_indices(9)
    above = (rows == columns) & (rows > 0)
    np.testing.assert_allclose(1.0, importance.sh_metric[:, above].mean(axis=1), rtol=1e-3)
    np.testing.assert_allclose(importance.blocks.means, found.means_squares / 3.0, rtol=1e-5)
    np.testing.assert_allclose(importance.blocks.shapes, found.shape_metric / 3.0, rtol=1e-4, atol=1e-9)


def test_damaged_files_and_those_of_another_scene_are_refused(stored):
    path, model, _ = stored
    with pytest.raises(InputError, match="of 30 splats, but the scene has 29"):
        read_sensitivity(path, model.select(np.arange(29)))
    with pytest.raises(InputError, match="another scene"):
        read_sensitivity(path, replace(model, sh0=model.sh0 + np.float32(0.5)))
    data, contents = path.read_bytes(), []
    with np.load(path) as file:
        arrays = dict(file)
    for changed in (
        {"views": np.array(["1"] * 30)}, {"colour": np.ones(30, np.complex64)}, {"view_count": np.array(np.inf)},
        {"shape_matrices": np.ones((29, 21), np.float32)}, {"matrices": np.ones(30, np.float16)},
        {"views": np.array(1)}, {"colour": np.full(30, np.nan, np.float32)},
    ):  # fmt: skip
        np.savez(path, **(arrays | changed))
        contents.append(path.read_bytes())
    np.savez(path, colour=np.ones(30))
    for bad in (*contents, path.read_bytes(), b"", b"PK", data[: len(data) // 2], data[:-30], b"nonsense" * 10):
        path.write_bytes(bad)
        with pytest.raises(InputError, match="not a file of sensitivities"):
            read_sensitivity(path, model)


@pytest.mark.slow
@pytest.mark.parametrize("packed", [False, True], ids=["as written", "deflated"])
def test_flipped_bits_are_refused_or_read(tmp_path, packed):
    # Bits of the archive's directory at a small stride, bits of the arrays at a large one.
    model, path = small_scene(1, 1), tmp_path / "one.npz"
    written(path, model)
    if packed:
        with np.load(path) as file:
            arrays = dict(file)
        np.savez_compressed(path, **arrays)
    data = path.read_bytes()
    directory, refused = data.index(b"PK\x01\x02"), 0
    for bit in (*range(0, 8 * directory, 1201), *range(8 * directory, 8 * len(data), 211)):
        bad = bytearray(data)
        bad[bit // 8] ^= 1 << bit % 8
        path.write_bytes(bad)
        try:
            read_sensitivity(path, model)
        except (InputError, OSError):  # zipfile seeks to before the file
            refused += 1
    assert refused > 0.3 * directory * 8 / 1201


def test_unseen_splats_have_no_sensitivity_and_a_small_weight(stored):
    path, model, _ = stored
    away = np.where(np.arange(30)[:, None] < 3, np.float32(100.0), model.means)
    model = replace(model, means=away)
    found, read = written(path, model, "virtual"), read_sensitivity(path, model)
    assert [False] * 3 + [True] * 27 == found.seen.tolist() == read.seen.tolist()
    assert 0.1 == pytest.approx(found.unseen_share)
    assert 0.0 == max(found.colour[:3].max(), found.shape[:3].max(), found.opacity[:3].max())
    weights = read.importance().sh
    assert 0.0 < weights[:3].max() < np.median(weights[3:])
    assert np.isfinite(read.importance().sh_metric).all()


@pytest.mark.slow
def test_pruning_reports_the_share_that_other_views_see(tmp_path, monkeypatch):
    ply, npz, out = (tmp_path / name for name in ("part.ply", "s.npz", "o.csplat"))
    model = small_scene(400, 0)  # opaque splats on a sphere, which a few views see only in part
    means = model.means / np.linalg.norm(model.means, axis=1, keepdims=True)
    write_ply(ply, replace(model, means=means, opacities=np.full(400, 0.999, np.float32)))
    monkeypatch.setattr("csplat_tools.views.view_sets.render_seconds", lambda *_, **__: 4.0)
    change_views(monkeypatch, 2, None)
    announced = invoke("sensitivity", ply, npz).stderr
    assert "2 virtual views" in announced
    assert "this takes about" in announced
    missed = read_sensitivity(npz, read_ply(ply)).missed_share
    assert missed > 0.0
    pruned = encode_file(str(ply), str(out), EncodeOptions(), importance=str(npz), prune_unseen=True)
    assert f"{100 * missed:.1f} % of the splats were pruned although" in " ".join(pruned.result.report.notes)
    assert "left out" not in invoke("encode", ply, out, "--importance", npz, "--force", "-q").stderr
