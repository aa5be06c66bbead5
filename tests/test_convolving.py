"""The convolution of LPIPS, against its NumPy twin, and that against the sum written out."""

import numpy as np
import pytest

pytest.importorskip("numba", reason="the kernel wants the extra [render]")

from csplat_render.metric_kernels import convolve, convolve_twin

pytestmark = pytest.mark.area(name="rasteriser")

CASES = [
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


def case(picture, kernel, seed=0):
    rng = np.random.default_rng(seed)
    weights = rng.standard_normal(kernel) / np.sqrt(np.prod(kernel[:3]))
    return (
        array.astype(np.float32) for array in (rng.standard_normal(picture), weights, rng.standard_normal(kernel[3]))
    )


@pytest.mark.parametrize(("picture", "kernel", "stride", "padding"), CASES)
def test_the_convolution_equals_its_twin(picture, kernel, stride, padding):
    x, weights, bias = case(picture, kernel)
    found = convolve(x, weights, bias, stride, padding)
    wanted = convolve_twin(x, weights, bias, stride, padding)
    assert found.dtype == np.float32
    assert wanted.shape == found.shape
    np.testing.assert_allclose(found, wanted, atol=2e-5)


@pytest.mark.parametrize(("stride", "padding"), [(1, 2), (4, 2), (2, 0)])
def test_the_twin_is_the_sum_written_out(stride, padding):
    x, kernel, bias = case((13, 11, 3), (5, 3, 3, 4))
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


def test_the_number_of_threads_changes_nothing():
    from csplat_render.kernels import thread_count

    x, weights, bias = case((33, 20, 8), (3, 3, 8, 24))
    found = []
    for threads in (1, 2):
        with thread_count(threads):
            found.append(convolve(x, weights, bias, 1, 1))
    np.testing.assert_array_equal(*found)
