"""Metrics of images: PSNR, SSIM and LPIPS with their kernels."""

from __future__ import annotations

import importlib.util
import math

import numpy as np
import pytest

from csplat.errors import InputError
from csplat.types import PSNR_CAP

pytest.importorskip("numba", reason="SSIM requires the extra [render]")


from csplat_render import lpips as module
from csplat_render.kernels import thread_count
from csplat_render.lpips import Lpips, load_lpips, load_torch_lpips, save_lpips
from csplat_render.metric_kernels import (
    RADIUS,
    WINDOW,
    blur_across,
    blur_down,
    blur_twin,
    convolve,
    convolve_twin,
    mean_ssim,
    mean_ssim_twin,
)
from csplat_render.metrics import Scores, psnr, score_view, ssim


def two_images(seed=0, height=30, width=41, noise=0.1):
    rng = np.random.default_rng(seed)
    a = rng.random((height, width, 3), np.float32)
    return a, np.clip(a + noise * rng.standard_normal(a.shape), 0.0, 1.0).astype(np.float32)


def slow_ssim(a, b):
    """Compute SSIM pixel by pixel with the full 11×11 window, and zeros beyond the border."""
    g = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    window = np.outer(g, g) / np.outer(g, g).sum()
    values = []
    for c in range(3):
        x, y = (np.pad(p[..., c].astype(np.float64), 5) for p in (a, b))
        for i in range(a.shape[0]):
            for j in range(a.shape[1]):
                p, q = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
                mp, mq = (window * p).sum(), (window * q).sum()
                pp, qq, pq = ((window * s).sum() for s in (p * p, q * q, p * q))
                up = (2 * mp * mq + 0.01**2) * (2 * (pq - mp * mq) + 0.03**2)
                values.append(up / ((mp**2 + mq**2 + 0.01**2) * (pp - mp**2 + qq - mq**2 + 0.03**2)))
    return np.mean(values)


def test_psnr_is_that_of_clipped_images_and_has_a_largest_value():
    flat = np.full((4, 5, 3), 0.5, np.float64)
    assert math.isclose(20.0, psnr(flat, flat + 0.1))
    a, b = two_images()
    assert PSNR_CAP == psnr(a, a) == psnr(a, a + np.float32(1e-9))
    assert psnr(a, b) == psnr(a, np.where(b == 1.0, 7.0, b))


def test_ssim_agrees_with_explicit_sums():
    for height, width in ((14, 17), (3, 2)):  # larger and smaller than the window
        a, b = two_images(height=height, width=width)
        assert math.isclose(slow_ssim(a, b), ssim(a, b), rel_tol=1e-12)


def test_errors_are_pooled_and_a_mean_psnr_is_reported():
    zero = np.zeros((4, 4, 3))
    scores = Scores.of([score_view(zero, zero + 0.1), score_view(zero, zero + 0.01)])
    assert np.allclose([20.0, 40.0], [one.psnr for one in scores.each])
    assert math.isclose(30.0, scores.psnr_mean)
    assert math.isclose(-10.0 * math.log10((0.01 + 0.0001) / 2.0), scores.psnr)
    assert (0, 2) == (scores.worst_view, scores.as_json()["views"])
    assert math.isclose(20.0, scores.psnr_worst)
    assert (None, None, None) == (scores.cover, scores.psnr_covered, scores.lpips)
    wide = score_view(np.zeros((1, 3, 3)), np.full((1, 3, 3), 0.1))  # weighted by its pixels
    one = score_view(np.zeros((1, 1, 3)), np.zeros((1, 1, 3)))
    assert math.isclose(-10.0 * math.log10(0.01 * 3 / 4), Scores.of([wide, one]).psnr)


def test_psnr_of_covered_pixels_excludes_the_background():
    reference, image = np.ones((10, 10, 3)), np.ones((10, 10, 3))
    reference[:5], image[:5] = 0.5, 0.6
    covered = np.zeros((10, 10), bool)
    covered[:5] = True
    scores = Scores.of([score_view(reference, image, covered)])
    assert math.isclose(0.5, scores.cover)
    assert math.isclose(20.0, scores.psnr_covered)
    assert math.isclose(20.0 + 10.0 * math.log10(2.0), scores.psnr)
    assert {"psnr", "psnr_mean", "psnr_worst", "ssim", "cover"} <= scores.as_json().keys()


def test_incomparable_images_are_refused():
    a, b = two_images()
    for reference, image in ((a, b[1:]), (a[..., 0], b[..., 0]), ((a * 255).astype(np.uint8), b), (a * np.nan, b)):
        with pytest.raises(InputError):
            psnr(reference, image)
    with pytest.raises(InputError, match="found no images"):
        Scores.of([])
    with pytest.raises(InputError, match="cover"):
        score_view(a, b, np.zeros((2, 2), bool))


def noise_pair(height, width, dtype=np.float64):
    rng = np.random.default_rng(height * width)
    x = rng.random((height, width, 3))
    return x.astype(dtype), np.clip(x + 0.2 * rng.standard_normal(x.shape), 0.0, 1.0).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_both_passes_of_the_blur_equal_the_window(dtype):
    x, _ = noise_pair(24, 17, dtype)
    flat = x.reshape(24, 51)
    taps = WINDOW[RADIUS:].astype(dtype)
    across = np.zeros((24 + 2 * RADIUS, 51), dtype)
    for r in range(24):
        blur_across(np.pad(flat[r], 3 * RADIUS), taps, across[r + RADIUS])
    found = np.empty_like(flat)
    for r in range(24):
        blur_down(across, r, taps, found[r])
    tolerance = 1e-6 if dtype == np.float32 else 1e-14
    np.testing.assert_allclose(found.reshape(x.shape), blur_twin(x.astype(np.float64)), atol=tolerance)


def in_threads(make):
    """Return the results of a call in one thread and in two."""
    found = []
    for threads in (1, 2):
        with thread_count(threads):
            found.append(make())
    return found


@pytest.mark.parametrize("size", [(1, 1), (2, 40), (11, 11), (37, 21), (61, 80)])
def test_mean_ssim_equals_its_twin_in_any_number_of_threads(size):
    x, y = noise_pair(*size)
    one, two = in_threads(lambda: mean_ssim(x, y))
    assert one == two == pytest.approx(mean_ssim_twin(x, y), rel=1e-12)
    for flat in (x, 0.0 * x):
        assert mean_ssim(flat, flat) == pytest.approx(1.0, abs=1e-12)
    x, y = np.full_like(x, 0.5), np.full_like(x, 0.7)
    assert mean_ssim(x, y) == pytest.approx(mean_ssim_twin(x, y), rel=1e-12)


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


def test_weights_are_saved_and_loaded(tmp_path, random_weights):
    save_lpips(tmp_path / "w.npz", random_weights)
    back = load_lpips(tmp_path / "w.npz")
    for name in ("kernels", "biases", "heads"):
        for a, b in zip(getattr(random_weights, name), getattr(back, name), strict=True):
            assert (a == b).all()


def test_weights_are_read_from_the_environment_before_the_cache(tmp_path, monkeypatch, random_weights):
    monkeypatch.setattr(importlib.util, "find_spec", {}.get)  # torch is absent
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("CSPLAT_LPIPS", raising=False)
    assert load_torch_lpips() is None
    with pytest.raises(InputError, match="no LPIPS weights"):
        load_lpips()
    (tmp_path / "csplat").mkdir()
    for path in (tmp_path / "csplat" / "lpips_alex.npz", tmp_path / "other.npz"):
        save_lpips(path, random_weights)
        assert str(path) == load_lpips().source
        monkeypatch.setenv("CSPLAT_LPIPS", str(tmp_path / "other.npz"))


@pytest.mark.torch
def test_weights_of_torch_files_are_equal(tmp_path, random_weights):
    torch = pytest.importorskip("torch", reason="reading its cache needs torch: pip install 'csplat[train]'")
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


def test_invalid_files_of_weights_are_refused(tmp_path, random_weights):
    (tmp_path / "text.npz").write_text("no zip file")
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    for name in ("text.npz", "other.npz", "absent.npz"):
        with pytest.raises(InputError, match=name):
            load_lpips(tmp_path / name)
    with np.errstate(all="ignore"), pytest.raises(InputError, match="kernel 0"):
        Lpips(random_weights.kernels[::-1], random_weights.biases, random_weights.heads, "wrong")


def test_lpips_refuses_small_or_different_images(random_weights):
    a = np.zeros((40, 40, 3))
    for x, y in ((a, a[1:]), (a[:30], a[:30]), (a[..., 0], a[..., 0]), (a.astype(np.uint8), a.astype(np.uint8))):
        with pytest.raises(InputError):
            random_weights(x, y)


@pytest.mark.slow
def test_lpips_of_the_smallest_images_is_symmetric_and_grows(random_weights):
    rng = np.random.default_rng(1)
    a = rng.random((31, 31, 3))
    noise = rng.standard_normal(a.shape)
    near, far = random_weights(a, a + 0.02 * noise), random_weights(a, a + 0.2 * noise)
    assert 0.0 < near < far
    assert np.isclose(near, random_weights(a + 0.02 * noise, a), rtol=1e-4)


SHAPES_AND_STRIDES = [
    # image, kernel (height, width, in, out), stride, padding
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
    arrays = (rng.standard_normal(picture), weights, rng.standard_normal(kernel[3]))
    return (array.astype(np.float32) for array in arrays)


@pytest.mark.long
@pytest.mark.parametrize(("picture", "kernel", "stride", "padding"), SHAPES_AND_STRIDES)
def test_the_convolution_equals_its_twin(picture, kernel, stride, padding):
    x, weights, bias = convolution_case(picture, kernel)
    found, again = in_threads(lambda: convolve(x, weights, bias, stride, padding))
    wanted = convolve_twin(x, weights, bias, stride, padding)
    assert found.dtype == np.float32
    assert wanted.shape == found.shape
    np.testing.assert_array_equal(found, again)
    np.testing.assert_allclose(found, wanted, atol=2e-5)


@pytest.mark.long
@pytest.mark.parametrize(("stride", "padding"), [(1, 2), (4, 2), (2, 0)])
def test_the_twin_agrees_with_explicit_sums(stride, padding):
    x, kernel, bias = convolution_case((13, 11, 3), (5, 3, 3, 4))
    padded = np.pad(x, ((padding, padding), (padding, padding), (0, 0))).astype(np.float64)
    rows, columns = (padded.shape[0] - 5) // stride + 1, (padded.shape[1] - 3) // stride + 1
    windows = [[padded[r * stride :][:5, c * stride :][:, :3] for c in range(columns)] for r in range(rows)]
    expected = np.einsum("rchwi,hwio->rco", np.array(windows), kernel.astype(np.float64))
    np.testing.assert_allclose(convolve_twin(x, kernel, bias, stride, padding), expected + bias, atol=1e-12)
