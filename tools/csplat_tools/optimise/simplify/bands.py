"""Choose the SH bands that each splat keeps: those whose loss would cost more than their bits are worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from csplat.model import SplatModel
from csplat.types import Mask
from csplat_render.pruning_error import PruningError

#: Largest errors of bands 1, 2, 3 that are not worth their bits, as fractions of the scene's error per splat. At the
#: optimum, a bit reduces the error by the same amount wherever it is spent: a splat has some 30 quantised values, whose
#: error is half of the whole, and each bit takes 2 ln 2 of its value's error; bands of 9, 15 and 21 values take one and
#: a half bits for each value.
BAND_COST = (0.25, 0.4, 0.55)


def band_mask(removal: PruningError, error: float) -> Mask:
    """Return a mask of the bands to keep, [N, d].

    Args:
        removal: removal errors of the scene that the bands belong to.
        error: squared error of the scene per splat, summed over the views of `removal`.

    All bands of a splat that no view saw are kept.
    """
    costs = np.array(BAND_COST[: removal.bands.shape[1]])
    stays: Mask = (removal.bands > error * costs) | ~removal.seen[:, None]
    return stays


def free_coefficients(stays: Mask) -> Mask:
    """Return a mask of the SH coefficients beyond the first that belong to kept bands, [N, (d + 1)² − 1]."""
    columns = [np.zeros((len(stays), 0), bool)]
    columns += [np.repeat(stays[:, band - 1 : band], 2 * band + 1, axis=1) for band in range(1, stays.shape[1] + 1)]
    return np.concatenate(columns, axis=1)


def without(model: SplatModel, stays: Mask) -> SplatModel:
    """Return the scene with zeros in the bands that are not kept."""
    return replace(model, shN=model.shN * free_coefficients(stays)[:, :, None].astype(np.float32))
