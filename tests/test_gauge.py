"""The gauge keeps the ellipsoid and leaves one description of it."""

import itertools

import numpy as np
import pytest

from csplat.encoder.quantisation import canonicalise_shape


def covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """[n, 3, 3] from [n, 4] and [n, 3], in float64."""
    w, x, y, z = (quats.astype(np.float64) / np.linalg.norm(quats.astype(np.float64), axis=1)[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rotation = np.moveaxis(np.array(rows), 2, 0)
    return np.einsum("nij,nj,nkj->nik", rotation, np.exp(2 * scales.astype(np.float64)), rotation)


def random_shapes(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    quats = rng.standard_normal((count, 4))
    quats /= np.linalg.norm(quats, axis=1)[:, None]
    return quats.astype(np.float32), rng.normal(0, 2, (count, 3)).astype(np.float32)


def test_keeps_the_covariance():
    quats, scales = random_shapes(5000, 0)
    rotation, ordered = canonicalise_shape(quats, scales)
    before, after = covariances(quats, scales), covariances(rotation.T, ordered.T)
    size = np.linalg.norm(before, axis=(1, 2))
    assert float((np.linalg.norm(after - before, axis=(1, 2)) / size).max()) < 1e-5


def test_sorts_the_scales_and_makes_w_largest():
    quats, scales = random_shapes(5000, 1)
    rotation, ordered = canonicalise_shape(quats, scales)
    assert (np.diff(ordered, axis=0) <= 0).all()
    assert (rotation[0] >= np.abs(rotation).max(axis=0)).all()
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=0), 1.0, atol=1e-6)
    np.testing.assert_array_equal(np.sort(scales, axis=1)[:, ::-1], ordered.T)


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("sign", [1, -1])
def test_descriptions_of_one_ellipsoid_become_one(order, sign):
    quats, scales = random_shapes(64, 2)
    axes = np.eye(3)[list(order)].T
    if np.linalg.det(axes) < 0:
        axes = -axes
    turn = quaternion_of(axes)
    again = np.stack([product(quat, turn) for quat in quats.astype(np.float64)]) * sign
    first = canonicalise_shape(quats, scales)
    second = canonicalise_shape(again.astype(np.float32), scales[:, list(order)])
    np.testing.assert_allclose(second[0], first[0], atol=2e-6)
    np.testing.assert_array_equal(second[1], first[1])


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    symmetric = np.zeros((4, 4))
    r = rotation
    symmetric[0] = [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    symmetric[1, 1:] = [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[0, 2] + r[2, 0]]
    symmetric[2, 2:] = [r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2]]
    symmetric[3, 3] = r[2, 2] - r[0, 0] - r[1, 1]
    full = np.triu(symmetric) + np.triu(symmetric, 1).T
    return np.linalg.eigh(full)[1][:, -1]


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate([[scalar], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])
