# SPDX-License-Identifier: Apache-2.0
"""The real spherical-harmonics basis of the colours of splats, with the order and the signs of INRIA, gsplat and SPZ.

With P the associated Legendre functions including the Condon–Shortley phase, the function of degree l and order m is

    √((2l + 1) / 4π · (l − |m|)! / (l + |m|)!) · P_l^|m|(z) · (√2 sin |m|φ if m < 0; 1 if m = 0; √2 cos mφ if m > 0)

in the direction (x, y, z) of azimuth φ. Its index is l² + l + m: band l has 2l + 1 functions, from m = −l to l. This
is the order of Sloan, "Efficient Spherical Harmonic Evaluation" (JCGT 2013), which gsplat evaluates.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from csplat.types import F64

#: Number of functions of degrees 0 to 4.
BASIS_SIZE = 25

#: Basis function of degree 0: colour per coefficient.
SH_C0 = 0.28209479177387814

_C1 = 0.4886025119029199
_C20, _C21, _C22, _C23, _C24 = (
    1.0925484305920792,
    -1.0925484305920792,
    0.31539156525252005,
    -1.0925484305920792,
    0.5462742152960396,
)
_C30, _C31, _C32, _C33, _C34, _C35, _C36 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
_C40, _C41, _C42, _C43, _C44, _C45, _C46, _C47, _C48 = (
    2.5033429417967046,
    -1.7701307697799304,
    0.9461746957575601,
    -0.6690465435572892,
    0.10578554691520431,
    -0.6690465435572892,
    0.47308734787878004,
    -1.7701307697799304,
    0.6258357354491761,
)


def evaluate_sh(degree: int, directions: F64) -> F64:
    """Return the basis [D, (degree + 1)**2] in unit directions [D, 3]."""
    basis = np.empty(((degree + 1) ** 2, len(directions)))
    x, y, z = directions.T
    sh_basis(degree, x, y, z, basis)
    return basis.T


def sh_basis(degree: int, x: Any, y: Any, z: Any, basis: Any) -> None:
    """Evaluate the basis; the renderer compiles this function.

    Args:
        degree: 0 to 4.
        x, y, z: unit direction: numbers, or arrays for several directions.
        basis: [(degree + 1)**2, ...], written.
    """
    basis[0] = SH_C0
    if degree >= 1:
        basis[1] = -_C1 * y
        basis[2] = _C1 * z
        basis[3] = -_C1 * x
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis[4] = _C20 * x * y
        basis[5] = _C21 * y * z
        basis[6] = _C22 * (2.0 * zz - xx - yy)
        basis[7] = _C23 * x * z
        basis[8] = _C24 * (xx - yy)
        if degree >= 3:
            basis[9] = _C30 * y * (3.0 * xx - yy)
            basis[10] = _C31 * x * y * z
            basis[11] = _C32 * y * (4.0 * zz - xx - yy)
            basis[12] = _C33 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
            basis[13] = _C34 * x * (4.0 * zz - xx - yy)
            basis[14] = _C35 * z * (xx - yy)
            basis[15] = _C36 * x * (xx - 3.0 * yy)
        if degree >= 4:
            basis[16] = _C40 * x * y * (xx - yy)
            basis[17] = _C41 * y * z * (3.0 * xx - yy)
            basis[18] = _C42 * x * y * (7.0 * zz - 1.0)
            basis[19] = _C43 * y * z * (7.0 * zz - 3.0)
            basis[20] = _C44 * (zz * (35.0 * zz - 30.0) + 3.0)
            basis[21] = _C45 * x * z * (7.0 * zz - 3.0)
            basis[22] = _C46 * (xx - yy) * (7.0 * zz - 1.0)
            basis[23] = _C47 * x * z * (xx - 3.0 * yy)
            basis[24] = _C48 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy))


def sh_basis_gradient(degree: int, x: float, y: float, z: float, g: Any) -> tuple[float, float, float]:
    """Return the gradient of Σ g[k] · basis[k] with respect to x, y and z as independent variables.

    The component along (x, y, z) has no meaning, because the basis is defined on the sphere.

    Args:
        degree: 0 to 4.
        x, y, z: unit direction.
        g: [(degree + 1)**2], factors of the basis functions.
    """
    gx, gy, gz = 0.0, 0.0, 0.0
    if degree >= 1:
        gx, gy, gz = -_C1 * g[3], -_C1 * g[1], _C1 * g[2]
    if degree >= 2:
        gx += _C20 * y * g[4] - 2.0 * _C22 * x * g[6] + _C23 * z * g[7] + 2.0 * _C24 * x * g[8]
        gy += _C20 * x * g[4] + _C21 * z * g[5] - 2.0 * _C22 * y * g[6] - 2.0 * _C24 * y * g[8]
        gz += _C21 * y * g[5] + 4.0 * _C22 * z * g[6] + _C23 * x * g[7]
    if degree >= 3:
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        gx += (
            6.0 * _C30 * xy * g[9]
            + _C31 * yz * g[10]
            - 2.0 * _C32 * xy * g[11]
            - 6.0 * _C33 * xz * g[12]
            + _C34 * (4.0 * zz - 3.0 * xx - yy) * g[13]
            + 2.0 * _C35 * xz * g[14]
            + 3.0 * _C36 * (xx - yy) * g[15]
        )
        gy += (
            3.0 * _C30 * (xx - yy) * g[9]
            + _C31 * xz * g[10]
            + _C32 * (4.0 * zz - xx - 3.0 * yy) * g[11]
            - 6.0 * _C33 * yz * g[12]
            - 2.0 * _C34 * xy * g[13]
            - 2.0 * _C35 * yz * g[14]
            - 6.0 * _C36 * xy * g[15]
        )
        gz += (
            _C31 * xy * g[10]
            + 8.0 * _C32 * yz * g[11]
            + _C33 * (6.0 * zz - 3.0 * xx - 3.0 * yy) * g[12]
            + 8.0 * _C34 * xz * g[13]
            + _C35 * (xx - yy) * g[14]
        )
        if degree >= 4:
            gx += (
                _C40 * y * (3.0 * xx - yy) * g[16]
                + 6.0 * _C41 * xy * z * g[17]
                + _C42 * y * (7.0 * zz - 1.0) * g[18]
                + _C45 * z * (7.0 * zz - 3.0) * g[21]
                + 2.0 * _C46 * x * (7.0 * zz - 1.0) * g[22]
                + 3.0 * _C47 * z * (xx - yy) * g[23]
                + 4.0 * _C48 * x * (xx - 3.0 * yy) * g[24]
            )
            gy += (
                _C40 * x * (xx - 3.0 * yy) * g[16]
                + 3.0 * _C41 * z * (xx - yy) * g[17]
                + _C42 * x * (7.0 * zz - 1.0) * g[18]
                + _C43 * z * (7.0 * zz - 3.0) * g[19]
                - 2.0 * _C46 * y * (7.0 * zz - 1.0) * g[22]
                - 6.0 * _C47 * xy * z * g[23]
                + 4.0 * _C48 * y * (yy - 3.0 * xx) * g[24]
            )
            gz += (
                _C41 * y * (3.0 * xx - yy) * g[17]
                + 14.0 * _C42 * xy * z * g[18]
                + _C43 * y * (21.0 * zz - 3.0) * g[19]
                + _C44 * z * (140.0 * zz - 60.0) * g[20]
                + _C45 * x * (21.0 * zz - 3.0) * g[21]
                + 14.0 * _C46 * z * (xx - yy) * g[22]
                + _C47 * x * (xx - 3.0 * yy) * g[23]
            )
    return gx, gy, gz
