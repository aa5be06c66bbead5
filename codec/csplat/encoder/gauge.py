"""One description per splat: of the 24 that mean the same ellipsoid, and of each quaternion's two signs, one.

Permuting the axes of an ellipsoid, or turning it by half a turn about one of them, changes rotation and scales but
not the covariance. Scales sorted descending and the largest |w| leave one choice (up to ties), whose w needs no index
to be found again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from csplat.types import F32

Columns = tuple[F32, F32, F32, F32]


def fix_gauge(quats: F32, scales: F32) -> tuple[F32, F32]:
    """Sort the scales descending and make w the largest component of the rotation.

    Args:
        quats: [n, 4] float32, w x y z, unit length within 1e-3.
        scales: [n, 3] float32, log standard deviations.

    Returns:
        [4, n] float32 rotation in columns, unit length, w >= |x|, |y|, |z|; [3, n] float32 scales in columns.
        The covariance of each splat is that of the arguments.
    """
    w, x, y, z = (np.ascontiguousarray(quats[:, i]) for i in range(4))
    a, b, c = (np.ascontiguousarray(scales[:, i]) for i in range(3))
    # Half turns about (x+y), (y+z), (x+y) exchange two axes and keep the rotation proper. Right products with
    # (0, 1, 1, 0) and (0, 0, 1, 1); their length, sqrt 2 each, is taken out by the last normalisation.
    for axes in ((0, 1), (1, 2), (0, 1)):
        first, second = (a, b) if axes == (0, 1) else (b, c)
        swap = first < second
        low, high = np.minimum(first, second), np.maximum(first, second)
        if axes == (0, 1):
            a, b = high, low
            turned = (-(x + y), w - z, w + z, x - y)
        else:
            b, c = high, low
            turned = (-(y + z), y - z, w - x, w + x)
        w, x, y, z = _exchanged(swap, turned, (w, x, y, z))
    w, x, y, z = _largest_first(w, x, y, z)
    length = np.sqrt(w * w + x * x + y * y + z * z)
    np.copysign(length, w, out=length)
    rotation = np.stack([w, x, y, z])
    rotation /= length
    return rotation, np.stack([a, b, c])


def _exchanged(swap: NDArray[np.bool_], turned: Columns, kept: Columns) -> Columns:
    """The turned rotation, at unit length, where axes are exchanged, and the one that was elsewhere."""
    root = np.float32(np.sqrt(0.5))
    w, x, y, z = (np.where(swap, new * root, old) for new, old in zip(turned, kept, strict=True))
    return w, x, y, z


def _largest_first(w: F32, x: F32, y: F32, z: F32) -> Columns:
    """Multiply from the right by 1, i, j or k so that the component of largest magnitude becomes w."""
    aw, ax, ay, az = np.abs(w), np.abs(x), np.abs(y), np.abs(z)
    x_leads = ax > np.maximum(aw, np.maximum(ay, az))
    y_leads = ~x_leads & (ay > np.maximum(aw, az))
    z_leads = ~x_leads & ~y_leads & (az > aw)
    flat = np.where(x_leads, -x, np.where(y_leads, -y, np.where(z_leads, -z, w)))
    new_x = np.where(x_leads, w, np.where(y_leads, -z, np.where(z_leads, y, x)))
    new_y = np.where(x_leads, z, np.where(y_leads, w, np.where(z_leads, -x, y)))
    new_z = np.where(x_leads, -y, np.where(y_leads, x, np.where(z_leads, w, z)))
    return flat, new_x, new_y, new_z
