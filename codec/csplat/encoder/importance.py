"""How much each splat matters to pictures: given by the caller, or opacity × projected size."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel

__all__ = ["splat_weights"]

F32 = NDArray[np.float32]

_BLOCK = 1 << 16
_LARGEST_LOG = 80.0  # log sizes beyond ± this are not told apart: float32 holds the weights


def splat_weights(model: SplatModel, importance: NDArray[Any] | None) -> F32:
    """Return the weight of each splat's squared error, [N] float32, >= 0; only ratios matter.

    The cheap weight is alpha · √(σ1 σ2) with the two larger standard deviations, alpha times the size of its shadow:
    alpha times its area would follow from the pictures' error if nothing were hidden, but in captures the largest
    splats are background that little is seen of; the root served all scenes tried better.

    Args:
        model: the scene.
        importance: [N], finite, >= 0, or None.

    Raises:
        InputError: an importance of another shape or type, negative or not finite.
    """
    if importance is None:
        weights = np.empty(len(model), np.float32)
        for at in range(0, len(model), _BLOCK):
            part = slice(at, at + _BLOCK)
            scales = model.scales[part]
            with np.errstate(over="ignore"):  # infinity is clipped like all that is too large
                size = (scales.sum(axis=1) - scales.min(axis=1)) * np.float32(0.5)
            np.clip(size, -_LARGEST_LOG, _LARGEST_LOG, out=size)
            weights[part] = model.opacities[part] * np.exp(size)
        return weights
    given = np.asarray(importance)
    if given.shape != (len(model),):
        raise InputError(f"importance has shape {given.shape}, wanted ({len(model)},)")
    if given.dtype.kind not in "biuf":
        raise InputError(f"importance has dtype {given.dtype}, wanted real numbers")
    values = given.astype(np.float64)
    if not (np.isfinite(values).all() and (values >= 0).all()):
        raise InputError("importance has negative or non-finite values")
    top = float(values.max(initial=0.0))
    return (values / top if top > 0 else values + 1.0).astype(np.float32)
