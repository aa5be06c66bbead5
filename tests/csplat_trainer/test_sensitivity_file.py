"""Tests of csplat_trainer.sensitivity_file."""

from dataclasses import replace

import numpy as np
import pytest
from command_line import change_views, invoke
from sensitivity_cases import cameras, small_scene

from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat.ply import read_ply, write_ply
from csplat_tools.encode_file import encode_file
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.sensitivity_file import GROUPS, read_sensitivity, write_sensitivity

pytest.importorskip("numba", reason="rendering needs numba: pip install 'csplat[render]'")


pytestmark = pytest.mark.usefixtures("small_views")


@pytest.fixture
def stored(tmp_path):
    model = small_scene(30, 2)
    found = measure_sensitivity(model, cameras(), metric=True)
    path = tmp_path / "scene.npz"
    with path.open("wb") as stream:
        write_sensitivity(stream, model, found, "cameras")
    return path, model, found


def test_a_file_is_written_and_read(stored):
    path, model, found = stored
    read = read_sensitivity(path, model)
    assert ("cameras", 2) == (read.source, read.view_count)
    assert np.isnan(read.missed_share)
    for name in GROUPS:
        np.testing.assert_array_equal(getattr(found, name).astype(np.float32), read.groups[name], name)
    importance = read.importance()
    assert ((30, 36), (30, 21)) == (importance.sh_metric.shape, importance.shape_metric.shape)
    rows, columns = np.triu_indices(8)
    np.testing.assert_allclose(1.0, importance.sh_metric[:, rows == columns].mean(axis=1), rtol=1e-3)
    np.testing.assert_allclose(importance.blocks.means, found.means_squares / 3.0, rtol=1e-5)
    np.testing.assert_allclose(importance.blocks.shapes, found.shape_metric / 3.0, rtol=1e-4, atol=1e-9)


def test_a_file_is_refused_for_another_scene(stored):
    path, model, _ = stored
    with pytest.raises(InputError, match="of 30 splats, but the scene has 29"):
        read_sensitivity(path, model.select(np.arange(29)))
    with pytest.raises(InputError, match="another scene"):
        read_sensitivity(path, replace(model, sh0=model.sh0 + np.float32(0.5)))


def test_damaged_files_are_refused(stored):
    path, model, _ = stored
    data = path.read_bytes()
    np.savez(path, colour=np.ones(30))
    for bad in (path.read_bytes(), b"", b"PK", data[: len(data) // 2], data[:-30], b"nonsense" * 10):
        path.write_bytes(bad)
        with pytest.raises(InputError, match="not a file of sensitivities"):
            read_sensitivity(path, model)


@pytest.mark.slow
@pytest.mark.parametrize("packed", [False, True], ids=["as written", "deflated"])
def test_flipped_bits_are_refused_or_read(tmp_path, packed):
    # Bits of the archive's directory at a small stride, bits of the arrays at a large one.
    model, path = small_scene(1, 1), tmp_path / "one.npz"
    with path.open("wb") as stream:
        write_sensitivity(stream, model, measure_sensitivity(model, cameras(), metric=True), "cameras")
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


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("views", np.array(["1"] * 30)), ("colour", np.ones(30, np.complex64)), ("view_count", np.array(np.inf)),
        ("shape_matrices", np.ones((29, 21), np.float32)), ("matrices", np.ones(30, np.float16)),
        ("views", np.array(1)), ("colour", np.full(30, np.nan, np.float32)),
    ],
)  # fmt: skip
def test_invalid_arrays_are_refused(stored, name, array):
    path, model, _ = stored
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **(arrays | {name: array}))
    with pytest.raises(InputError, match="not a file of sensitivities"):
        read_sensitivity(path, model)


def test_unseen_splats_have_a_small_weight(stored):
    path, model, _ = stored
    away = np.where(np.arange(30)[:, None] < 3, np.float32(100.0), model.means)
    model = replace(model, means=away)
    with path.open("wb") as stream:
        write_sensitivity(stream, model, measure_sensitivity(model, cameras(), metric=True), "virtual")
    read = read_sensitivity(path, model)
    weights = read.importance().sh
    assert 3 == np.count_nonzero(~read.seen)
    assert 0.0 < weights[:3].max() < np.median(weights[3:])
    assert np.isfinite(read.importance().sh_metric).all()


@pytest.fixture
def seen_in_part(tmp_path):
    """A PLY of opaque splats that a few views see only in part."""
    model = small_scene(400, 0)
    means = model.means / np.linalg.norm(model.means, axis=1, keepdims=True)
    write_ply(tmp_path / "part.ply", replace(model, means=means, opacities=np.full(400, 0.999, np.float32)))
    return tmp_path / "part.ply"


@pytest.mark.slow
def test_pruning_reports_the_share_that_other_views_see(tmp_path, seen_in_part, monkeypatch):
    npz, out = tmp_path / "s.npz", tmp_path / "o.csplat"
    change_views(monkeypatch, 2, None)
    invoke("sensitivity", seen_in_part, npz)
    missed = read_sensitivity(npz, read_ply(seen_in_part)).missed_share
    assert missed > 0.0
    pruned = encode_file(str(seen_in_part), str(out), EncodeOptions(), importance=str(npz), prune_unseen=True)
    assert f"{100 * missed:.1f} % of the splats were pruned although" in " ".join(pruned.report.notes)
    assert "left out" not in invoke("encode", seen_in_part, out, "--importance", npz, "--force", "-q").stderr
