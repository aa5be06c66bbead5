"""Spherical harmonics up to degree 3, real, in the order and with the signs of the splatting literature."""

from __future__ import annotations

from typing import Any

from csplat_render.jit import inline

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


@inline
def sh_basis(degree: int, x: Any, y: Any, z: Any, basis: Any) -> None:
    """Values of the basis functions in the direction (x, y, z), of unit length, one per coefficient.

    Args:
        degree: 0 to 3.
        x: one number, or an array for many directions at once (the twin).
        y: as x.
        z: as x.
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


@inline
def sh_basis_gradient(degree: int, x: float, y: float, z: float, g: Any) -> tuple[float, float, float]:
    """Gradient with respect to x, y, z of the sum of g[k] · basis[k], as if they were independent.

    Args:
        degree: 0 to 3.
        x: direction, of unit length.
        y: the same.
        z: the same.
        g: [(degree + 1)**2], one factor per basis function.
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
    return gx, gy, gz
