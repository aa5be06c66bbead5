"""LPIPS and its convolution kernel."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

pytest.importorskip("numba", reason="the convolution wants the extra [render]")

from csplat.errors import InputError
from csplat_render import lpips as module
from csplat_render.lpips import Lpips, load_lpips, load_torch_lpips, save_lpips
from csplat_render.metric_kernels import convolve, convolve_twin


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


@pytest.mark.area(name="rasteriser")
def test_the_published_pictures_have_their_published_distances(data_dir):
    Image = pytest.importorskip("PIL.Image", reason="reading PNG files needs pillow: pip install 'csplat[render]'")
    folder = data_dir / "lpips"
    distance = load_lpips(folder / "lpips_alex.npz")

    def picture(name):
        with Image.open(folder / f"ex_{name}.png") as image:
            return np.asarray(image.convert("RGB"), np.float32) / np.float32(255.0)

    reference = picture("ref")
    assert abs(distance(reference, picture("p0")) - 0.7219) < 1e-4
    assert abs(distance(reference, picture("p1")) - 0.1376) < 1e-4
    assert 0.0 == distance(reference, reference)


@pytest.mark.area(name="rasteriser")
def test_the_distance_is_symmetric_positive_and_grows(random_weights):
    rng = np.random.default_rng(1)
    a = rng.random((48, 40, 3))
    noise = rng.standard_normal(a.shape)
    near, far = random_weights(a, a + 0.02 * noise), random_weights(a, a + 0.2 * noise)
    assert 0.0 < near < far
    assert np.isclose(near, random_weights(a + 0.02 * noise, a), rtol=1e-4)


def test_weights_survive_their_file(tmp_path, random_weights):
    save_lpips(tmp_path / "w.npz", random_weights)
    back = load_lpips(tmp_path / "w.npz")
    for name in ("kernels", "biases", "heads"):
        for a, b in zip(getattr(random_weights, name), getattr(back, name), strict=True):
            assert (a == b).all()


def test_the_environment_and_the_cache_name_weights(tmp_path, monkeypatch, random_weights):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("CSPLAT_LPIPS", raising=False)
    (tmp_path / "csplat").mkdir()
    save_lpips(tmp_path / "csplat" / "lpips_alex.npz", random_weights)
    assert load_lpips().source == str(tmp_path / "csplat" / "lpips_alex.npz")
    save_lpips(tmp_path / "other.npz", random_weights)
    monkeypatch.setenv("CSPLAT_LPIPS", str(tmp_path / "other.npz"))
    assert load_lpips().source == str(tmp_path / "other.npz")


def test_absent_weights_are_said_to_be_absent(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("CSPLAT_LPIPS", raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", {}.get)  # torch is absent
    with pytest.raises(InputError, match="no LPIPS weights"):
        load_lpips()


def test_without_torch_its_cache_is_not_looked_for(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", {}.get)
    assert load_torch_lpips() is None


@pytest.mark.area(name="torch")
def test_torch_files_hold_the_same_weights(tmp_path, random_weights):
    torch = pytest.importorskip(
        "torch", reason="its cache is read where torch is installed: pip install 'csplat[train]'"
    )
    checkpoints = tmp_path / "checkpoints"
    checkpoints.mkdir()
    backbone = {}
    for i, kernel, bias in zip(module._TORCH_INDEX, random_weights.kernels, random_weights.biases, strict=True):
        backbone[f"features.{i}.weight"] = torch.from_numpy(kernel.transpose(3, 2, 0, 1).copy())
        backbone[f"features.{i}.bias"] = torch.from_numpy(bias)
    torch.save(backbone, checkpoints / "alexnet-owt-7be5be79.pth")
    heads = {
        f"lin{i}.model.1.weight": torch.from_numpy(h).reshape(1, -1, 1, 1) for i, h in enumerate(random_weights.heads)
    }
    torch.save(heads, tmp_path / "alex.pth")
    found = load_torch_lpips(tmp_path, tmp_path / "alex.pth")
    assert found is not None
    a = np.random.default_rng(0).random((40, 40, 3))
    assert random_weights(a, a * 0.9) == found(a, a * 0.9)


def test_refuses_what_is_no_weights_file(tmp_path, random_weights):
    (tmp_path / "text.npz").write_text("no zip file")
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    for name in ("text.npz", "other.npz", "absent.npz"):
        with pytest.raises(InputError, match=name):
            load_lpips(tmp_path / name)
    with np.errstate(all="ignore"), pytest.raises(InputError, match="kernel 0"):
        Lpips(random_weights.kernels[::-1], random_weights.biases, random_weights.heads, "wrong")


def test_refuses_pictures_that_are_too_small_or_differ(random_weights):
    a = np.zeros((40, 40, 3))
    assert random_weights(np.zeros((31, 31, 3)), np.ones((31, 31, 3))) > 0.0
    for x, y in ((a, a[1:]), (a[:30], a[:30]), (a[..., 0], a[..., 0]), (a.astype(np.uint8), a.astype(np.uint8))):
        with pytest.raises(InputError):
            random_weights(x, y)


SHAPES_AND_STRIDES = [
    # picture, kernel (height, width, in, out), stride, padding
    ((13, 11, 3), (5, 3, 3, 4), 1, 2),
    ((13, 11, 3), (5, 3, 3, 4), 4, 2),
    ((13, 11, 3), (5, 3, 3, 4), 2, 0),
    ((31, 31, 3), (11, 11, 3, 64), 4, 2),
    ((9, 14, 64), (5, 5, 64, 192), 1, 2),
    ((3, 3, 8), (3, 3, 8, 16), 1, 1),
    ((1, 1, 8), (3, 3, 8, 16), 1, 1),
    ((4, 7, 1), (4, 7, 1, 1), 1, 0),
]


def convolution_case(picture, kernel, seed=0):
    rng = np.random.default_rng(seed)
    weights = rng.standard_normal(kernel) / np.sqrt(np.prod(kernel[:3]))
    return (
        array.astype(np.float32) for array in (rng.standard_normal(picture), weights, rng.standard_normal(kernel[3]))
    )


@pytest.mark.area(name="rasteriser")
@pytest.mark.parametrize(("picture", "kernel", "stride", "padding"), SHAPES_AND_STRIDES)
def test_the_convolution_equals_its_twin(picture, kernel, stride, padding):
    x, weights, bias = convolution_case(picture, kernel)
    found = convolve(x, weights, bias, stride, padding)
    wanted = convolve_twin(x, weights, bias, stride, padding)
    assert found.dtype == np.float32
    assert wanted.shape == found.shape
    np.testing.assert_allclose(found, wanted, atol=2e-5)


@pytest.mark.area(name="rasteriser")
@pytest.mark.parametrize(("stride", "padding"), [(1, 2), (4, 2), (2, 0)])
def test_the_twin_is_the_sum_written_out(stride, padding):
    x, kernel, bias = convolution_case((13, 11, 3), (5, 3, 3, 4))
    padded = np.pad(x, ((padding, padding), (padding, padding), (0, 0))).astype(np.float64)
    rows, columns = (padded.shape[0] - 5) // stride + 1, (padded.shape[1] - 3) // stride + 1
    expected = np.array(
        [
            [
                np.einsum("hwi,hwio->o", padded[r * stride :][:5, c * stride :][:, :3], kernel.astype(np.float64))
                for c in range(columns)
            ]
            for r in range(rows)
        ]
    )
    np.testing.assert_allclose(convolve_twin(x, kernel, bias, stride, padding), expected + bias, atol=1e-12)


@pytest.mark.area(name="rasteriser")
def test_the_number_of_threads_changes_nothing():
    from csplat_render.kernels import thread_count

    x, weights, bias = convolution_case((33, 20, 8), (3, 3, 8, 24))
    found = []
    for threads in (1, 2):
        with thread_count(threads):
            found.append(convolve(x, weights, bias, 1, 1))
    np.testing.assert_array_equal(*found)
