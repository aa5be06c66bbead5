"""The errors of paired splats by the definitions of spec 5.5, straight from the matrices.

Inputs are small: clarity before speed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel

__all__ = ["contradictions", "measured"]

F64 = NDArray[np.float64]

_EXCESS, _EXCESS_FLOOR = 1e-4, 1e-12  # SER-5: by how much a statement may exceed what is true
_ROUNDING = 1e-9  # relative: sums in binary64 in another order
#: What a PLY leaves open: whether alpha and unit quaternions are rounded to binary32 before they are compared.
_OPEN = {"opacities": 2e-7, "covariance": 2e-6}


def measured(source: SplatModel, decoded: SplatModel, index: NDArray[Any]) -> dict[str, tuple[float, float]]:
    """Return (max, rms) by measure of the spec.

    Args:
        source: what was encoded.
        decoded: what came of it; its origin may be another one.
        index: [N], which source splat each decoded one is.
    """
    shift = np.subtract(decoded.origin, source.origin)
    moved = decoded.means.astype(np.float64) + shift - source.means[index]
    distances = np.sqrt(np.square(moved).sum(axis=1))
    errors = {
        "means": distances[:, None],
        "covariance": _covariance_errors(source, decoded, index)[:, None],
        "opacities": (decoded.opacities.astype(np.float64) - source.opacities[index])[:, None],
        "sh0": decoded.sh0.astype(np.float64) - source.sh0[index],
    }
    for band in range(1, max(source.sh_degree, decoded.sh_degree) + 1):
        rows = slice(band * band - 1, (band + 1) ** 2 - 1)
        theirs, ours = _band(source, rows)[index], _band(decoded, rows)
        errors[f"sh{band}"] = (ours - theirs).reshape(len(index), 3 * (2 * band + 1))
    return {name: _reduced(values) for name, values in errors.items()}


def _band(model: SplatModel, rows: slice) -> F64:
    """A band's coefficients; zeros where the model has none."""
    if rows.stop > model.shN.shape[1]:
        return np.zeros((len(model), rows.stop - rows.start, 3))
    return model.shN[:, rows].astype(np.float64)


def _reduced(values: F64) -> tuple[float, float]:
    if not values.size:
        return 0.0, 0.0
    return float(np.abs(values).max()), math.sqrt(float(np.square(values).sum()) / len(values))


def _covariance_errors(source: SplatModel, decoded: SplatModel, index: NDArray[Any]) -> F64:
    """‖Σi − Σj‖ / ‖Σj‖, both divided by the source's largest variance; scales clipped to ± 88."""
    clipped = np.clip(source.scales[index], -88.0, 88.0).astype(np.float64)
    top = clipped.max(axis=1, keepdims=True)
    theirs = _covariances(source.quats[index], clipped - top)
    ours = _covariances(decoded.quats, np.clip(decoded.scales, -88.0, 88.0) - top)
    errors: F64 = np.linalg.norm(ours - theirs, axis=(1, 2)) / np.linalg.norm(theirs, axis=(1, 2))
    return errors


def _covariances(quats: NDArray[Any], scales: F64) -> F64:
    """R diag(e^(2 scales)) Rᵀ, [n, 3, 3]."""
    unit = quats.astype(np.float64)
    w, x, y, z = (unit / np.linalg.norm(unit, axis=1, keepdims=True)).T
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    product: F64 = np.einsum("nij,nkj->nik", rotation * np.exp(2.0 * scales)[:, None, :], rotation)
    return product


def contradictions(found: dict[str, tuple[float, float]], stated: dict[str, tuple[float, float]]) -> list[str]:
    """Say where a statement is below what is true, or above it by more than SER-5 allows; a line each.

    Args:
        found: (max, rms) by measure, as they are.
        stated: the same as the file has it; measures that it does not state are no contradiction.
    """
    lines = []
    for name, values in found.items():
        if name not in stated:
            continue
        for kind, true, said in zip(("max", "rms"), values, stated[name], strict=True):
            room = _OPEN.get(name, 0.0) + true * _ROUNDING
            if said < true - room:
                lines.append(f"{name}: {kind} is {true:.6g}, stated {said:.6g}")
            elif said > true * (1.0 + _EXCESS) + _EXCESS_FLOOR + room:
                lines.append(f"{name}: {kind} is {true:.6g}, stated {said:.6g}, which is too much")
    return lines
