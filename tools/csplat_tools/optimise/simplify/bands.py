"""Which SH bands a splat needs: those whose loss would cost more than their bits are worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat_render.removal import Removal

__all__ = ["BAND_COST", "band_mask", "free_coefficients", "without"]

Mask = NDArray[np.bool_]

#: Largest errors of bands 1, 2, 3 that are not worth their bits, as shares of the error of a whole scene per splat. At
#: the best point a bit takes as much off the error wherever it is spent: of a splat's some 30 quantised values each
#: bit takes 2 ln 2 of its error, half of the whole, and bands of 9, 15 and 21 values take a bit and a half for each.
BAND_COST = (0.25, 0.4, 0.55)


def band_mask(removal: Removal, error: float) -> Mask:
    """Which bands stay, [N, d].

    Args:
        removal: of the scene that the bands belong to.
        error: squared error of the scene, removal's views together, per splat.

    A band that no view saw anything of stays.
    """
    costs = np.array(BAND_COST[: removal.bands.shape[1]])
    stays: Mask = (removal.bands > error * costs) | ~removal.seen[:, None]
    return stays


def free_coefficients(stays: Mask) -> Mask:
    """Which coefficients beyond the first belong to bands that stay, [N, (d + 1)² − 1]."""
    columns = [np.zeros((len(stays), 0), bool)]
    columns += [np.repeat(stays[:, band - 1 : band], 2 * band + 1, axis=1) for band in range(1, stays.shape[1] + 1)]
    return np.concatenate(columns, axis=1)


def without(model: SplatModel, stays: Mask) -> SplatModel:
    """The scene with zeros in the bands that do not stay."""
    return replace(model, shN=model.shN * free_coefficients(stays)[:, :, None].astype(np.float32))
