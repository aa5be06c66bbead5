"""Covariances over their trace, and back to rotations and scales."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.measure import covariance_entries
from csplat.types import F32, F64

Floats = NDArray[Any]

_FLATTEST = 1e-30  # of a trace: rounding may leave an eigenvalue at 0 or below


def unit_covariances(quats: Floats, scales: Floats) -> tuple[F64, F64]:
    """Return covariances over their trace, and half the logarithm of the trace.

    Args:
        quats: [4, n], w x y z.
        scales: [3, n], log standard deviations.

    Returns:
        [6, n] float64, xx, yy, zz, xy, xz, yz; [n] float64.
    """
    wide = scales.astype(np.float64)
    top = wide.max(axis=0)
    variances = np.exp(2.0 * (wide - top))
    trace = variances.sum(axis=0)
    return covariance_entries(quats, variances / trace), top + 0.5 * np.log(trace)


def mean_axes(covariances: F64) -> tuple[F32, F32]:
    """Return rotations [n, 4] and log standard deviations [n, 3] of covariances [6, n], in no particular gauge."""
    xx, yy, zz, xy, xz, yz = covariances
    matrices = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    values, axes = np.linalg.eigh(matrices)
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]  # a rotation, no reflection
    scales = 0.5 * np.log(np.maximum(values, _FLATTEST))
    return _quaternions(axes).astype(np.float32), scales.astype(np.float32)


def _quaternions(R: F64) -> F64:
    """[n, 4] quaternions of rotation matrices [n, 3, 3]: of four formulas the one that divides by the largest."""
    xx, yy, zz = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    x, y, z = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    xy, xz, yz = R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 1, 2] + R[:, 2, 1]
    rows = np.stack(
        [
            np.stack([1.0 + xx + yy + zz, x, y, z], axis=1),
            np.stack([x, 1.0 + xx - yy - zz, xy, xz], axis=1),
            np.stack([y, xy, 1.0 - xx + yy - zz, yz], axis=1),
            np.stack([z, xz, yz, 1.0 - xx - yy + zz], axis=1),
        ],
        axis=1,
    )
    best = np.einsum("nii->ni", rows).argmax(axis=1)
    chosen = rows[np.arange(len(rows)), best]
    return np.asarray(chosen / np.linalg.norm(chosen, axis=1, keepdims=True))
