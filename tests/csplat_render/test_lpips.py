# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_render.lpips."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from csplat.errors import InputError
from csplat_render import lpips as module
from csplat_render.lpips import Lpips, load_lpips, load_torch_lpips, save_lpips


@pytest.fixture
def random_weights():
    rng = np.random.default_rng(0)
    shapes = [shape for shape, *_ in module._LAYERS]
    return Lpips(
        kernels=tuple(rng.standard_normal(s).astype(np.float32) / np.float32(np.sqrt(np.prod(s[:3]))) for s in shapes),
        biases=tuple(rng.standard_normal(s[3]).astype(np.float32) for s in shapes),
        heads=tuple(rng.random(s[3]).astype(np.float32) for s in shapes),
        source="random",
    )


@pytest.mark.long
def test_lpips_of_the_published_images_agrees(data_dir):
    Image = pytest.importorskip("PIL.Image", reason="reading PNG files needs pillow: pip install pillow")
    distance = load_lpips(data_dir / "lpips" / "lpips_alex.npz")
    images = (Image.open(data_dir / "lpips" / f"ex_{name}.png").convert("RGB") for name in ("ref", "p0", "p1"))
    reference, *others = (np.asarray(image, np.float32) / np.float32(255.0) for image in images)
    assert np.allclose([0.7219, 0.1376], [distance(reference, other) for other in others], rtol=0, atol=1e-4)
    assert 0.0 == distance(reference, reference)


def test_weights_are_saved_and_read_from_the_environment_before_the_cache(tmp_path, monkeypatch, random_weights):
    monkeypatch.setattr(importlib.util, "find_spec", {}.get)  # torch is absent
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("CSPLAT_LPIPS", raising=False)
    assert load_torch_lpips() is None
    with pytest.raises(InputError, match="no LPIPS weights"):
        load_lpips()
    (tmp_path / "csplat").mkdir()
    for path in (tmp_path / "csplat" / "lpips_alex.npz", tmp_path / "other.npz"):
        save_lpips(path, random_weights)
        found = load_lpips()
        assert str(path) == found.source
        for name in ("kernels", "biases", "heads"):
            assert all(map(np.array_equal, getattr(random_weights, name), getattr(found, name)))
        monkeypatch.setenv("CSPLAT_LPIPS", str(tmp_path / "other.npz"))


@pytest.mark.torch
def test_weights_of_torch_files_are_equal(tmp_path, random_weights):
    torch = pytest.importorskip("torch", reason="reading its cache needs torch: pip install torch")
    (tmp_path / "checkpoints").mkdir()
    backbone = {}
    for i, kernel, bias in zip(module._TORCH_INDEX, random_weights.kernels, random_weights.biases, strict=True):
        backbone[f"features.{i}.weight"] = torch.from_numpy(kernel.transpose(3, 2, 0, 1).copy())
        backbone[f"features.{i}.bias"] = torch.from_numpy(bias)
    torch.save(backbone, tmp_path / "checkpoints" / "alexnet-owt-7be5be79.pth")
    heads = [torch.from_numpy(head).reshape(1, -1, 1, 1) for head in random_weights.heads]
    torch.save({f"lin{i}.model.1.weight": head for i, head in enumerate(heads)}, tmp_path / "alex.pth")
    found = load_torch_lpips(tmp_path, tmp_path / "alex.pth")
    assert found is not None
    a = np.random.default_rng(0).random((40, 40, 3))
    assert random_weights(a, a * 0.9) == found(a, a * 0.9)


def test_invalid_weights_and_small_or_different_images_are_refused(tmp_path, random_weights):
    (tmp_path / "text.npz").write_text("no zip file")
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    for name in ("text.npz", "other.npz", "absent.npz"):
        with pytest.raises(InputError, match=name):
            load_lpips(tmp_path / name)
    with np.errstate(all="ignore"), pytest.raises(InputError, match="kernel 0"):
        Lpips(random_weights.kernels[::-1], random_weights.biases, random_weights.heads, "wrong")
    a = np.zeros((40, 40, 3))
    for x, y in ((a, a[1:]), (a[:30], a[:30]), (a[..., 0], a[..., 0]), (a.astype(np.uint8), a.astype(np.uint8))):
        with pytest.raises(InputError):
            random_weights(x, y)


@pytest.mark.slow
def test_lpips_of_the_smallest_images_is_symmetric_and_grows(random_weights):
    a, noise = np.random.default_rng(1).random((2, 31, 31, 3))
    near, far = random_weights(a, a + 0.02 * noise), random_weights(a, a + 0.2 * noise)
    assert 0.0 < near < far
    assert np.isclose(near, random_weights(a + 0.02 * noise, a), rtol=1e-4)
