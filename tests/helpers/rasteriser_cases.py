# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of rasteriser, which several files share."""

import numpy as np
from oracle import facing

from csplat.model import SplatModel
from csplat.spherical_harmonics import SH_C0


def camera(width=64, height=48, focal=60.0, distance=4.0):
    return facing(focal, distance=distance, width=width, height=height)


def one_splat(alpha=0.5, scale=-2.0, colour=(1.0, 0.5, 0.25), mean=(0.0, 0.0, 0.0), quat=(1.0, 0.0, 0.0, 0.0)):
    scales = np.broadcast_to(np.asarray(scale, np.float32), (3,))
    return SplatModel(
        means=np.array([mean], np.float32),
        quats=np.array([quat], np.float32),
        scales=scales[None].copy(),
        opacities=np.array([alpha], np.float32),
        sh0=((np.array([colour], np.float32) - 0.5) / SH_C0).astype(np.float32),
    )
