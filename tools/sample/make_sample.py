"""Make the sample scene that ships with the project: a still life on a checkered disc.

Nobody trained or photographed it: splats are laid on analytic surfaces with a low-discrepancy
sequence, lit by one lamp, and their gloss is written as spherical harmonics of degree 3. So the
scene has no owner: it is dedicated to the public domain (CC0-1.0).

The same bytes on every machine: every value is rounded to a binary grid, much coarser than the
last digits in which mathematical libraries differ.

Usage:
    python tools/sample/make_sample.py [OUT.ply]
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

SEED = 20
SAMPLE = Path(__file__).resolve().parent.parent / "csplat_tools" / "data" / "sample.ply"
COMMENTS = (
    "made by tools/sample/make_sample.py",
    "csplat coordinate_system RDF",
    "csplat licence CC0-1.0",
)

#: y points down, as in every capture: the lamp is up, to the left and in front.
LAMP = np.array([-0.45, -0.8, -0.4]) / np.sqrt(0.45**2 + 0.8**2 + 0.4**2)
AMBIENT = 0.35
SH_C0 = 0.28209479177387814
GLOSS_OF_BAND = (0.0, 0.5, 0.35, 0.22)


def make_scene() -> F64:
    """Lay out the whole scene.

    Returns:
        [N, 59] float64: x y z, f_dc (3), f_rest (45, channel by channel), opacity (logit),
        scales (3, logarithms), rotation (4, w x y z).
    """
    rng = np.random.Generator(np.random.PCG64(SEED))
    parts = [
        _ground(rng, 2600),
        _torus(rng, 2300, centre=(0.75, -0.22, 0.25), radii=(0.42, 0.2)),
        _vase(rng, 2000, centre=(-0.75, 0.0, 0.35)),
        _ball(rng, 1500, centre=(0.05, -0.4, -0.55), radius=0.4, colour=(0.75, 0.12, 0.1)),
        _ball(rng, 300, centre=(-0.6, -0.16, -0.75), radius=0.16, colour=(0.95, 0.75, 0.15)),
        _ball(rng, 300, centre=(0.9, -0.14, -0.75), radius=0.14, colour=(0.15, 0.45, 0.85)),
    ]
    return np.concatenate(parts)


def write_scene(path: Path, scene: F64) -> None:
    """Write a scene in INRIA's layout, little-endian, with zero normals.

    Args:
        path: the file.
        scene: as `make_scene` returns it.
    """
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{index}" for index in range(45)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(scene)}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"comment {comment}" for comment in COMMENTS]
    rows = np.zeros((len(scene), len(names)), "<f4")
    rows[:, :3] = _on_grid(scene[:, :3], 20)
    rows[:, 6:] = _on_grid(scene[:, 3:], 16)
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode("ascii") + rows.tobytes())


def _ground(rng: np.random.Generator, count: int) -> F64:
    u, v = _low_discrepancy(count)
    radius, angle = 1.6 * np.sqrt(u), 2 * np.pi * v
    points = np.stack([radius * np.cos(angle), np.zeros(count), radius * np.sin(angle)], 1)
    normals = np.tile([0.0, -1.0, 0.0], (count, 1))
    dark = (np.floor(points[:, 0] / 0.4) + np.floor(points[:, 2] / 0.4)) % 2 == 0
    albedo = np.where(dark[:, None], [0.22, 0.25, 0.3], [0.72, 0.7, 0.64])
    return _splats(rng, points, normals, albedo, area=np.pi * 1.6**2, gloss=0.12)


def _ball(
    rng: np.random.Generator,
    count: int,
    *,
    centre: Sequence[float],
    radius: float,
    colour: Sequence[float],
) -> F64:
    u, v = _low_discrepancy(count)
    height, angle = 2 * u - 1, 2 * np.pi * v
    ring = np.sqrt(1 - height**2)
    normals = np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], 1)
    albedo = np.tile(np.asarray(colour), (count, 1))
    area = 4 * np.pi * radius**2
    return _splats(rng, np.asarray(centre) + radius * normals, normals, albedo, area=area, gloss=0.9)


def _torus(rng: np.random.Generator, count: int, *, centre: Sequence[float], radii: tuple[float, float]) -> F64:
    around, tube = radii
    u, v = _low_discrepancy(count)
    phi = 2 * np.pi * u
    theta = 2 * np.pi * v
    for _ in range(4):  # equal areas: theta + (tube / around) sin(theta) is uniform
        theta = 2 * np.pi * v - tube / around * np.sin(theta)
    out = np.stack([np.cos(phi), np.zeros(count), np.sin(phi)], 1)
    normals = np.cos(theta)[:, None] * out
    normals[:, 1] = -np.sin(theta)
    points = np.asarray(centre) + around * out + tube * normals
    stripes = 0.5 + 0.5 * np.sin(9 * phi + 2 * theta)
    albedo = stripes[:, None] * [0.1, 0.5, 0.45] + (1 - stripes[:, None]) * [0.85, 0.85, 0.75]
    area = 4 * np.pi**2 * around * tube
    return _splats(rng, points, normals, albedo, area=area, gloss=0.5)


def _vase(rng: np.random.Generator, count: int, *, centre: Sequence[float]) -> F64:
    u, v = _low_discrepancy(count)
    height, angle = 1.1 * u, 2 * np.pi * v
    radius = 0.3 + 0.12 * np.sin(5.2 * height + 0.4)
    slope = 0.12 * 5.2 * np.cos(5.2 * height + 0.4)
    out = np.stack([np.cos(angle), np.zeros(count), np.sin(angle)], 1)
    points = np.asarray(centre) + radius[:, None] * out
    points[:, 1] -= height
    normals = out.copy()
    normals[:, 1] = slope
    normals /= np.sqrt(np.sum(normals**2, 1))[:, None]
    band = (np.floor(height * 9 + angle / np.pi) % 3)[:, None]
    albedo = np.where(band == 0, [0.75, 0.4, 0.2], [0.9, 0.8, 0.6])
    return _splats(rng, points, normals, albedo, area=2 * np.pi * 0.3 * 1.1 * 1.15, gloss=0.35)


def _splats(rng: np.random.Generator, points: F64, normals: F64, albedo: F64, *, area: float, gloss: float) -> F64:
    """Cover a surface with flat splats: the scatter of size, shape and colour of a trained scene.

    Args:
        points: [n, 3], on the surface.
        normals: [n, 3], unit, outwards.
        albedo: [n, 3], linear red green blue.
        area: of the surface.
        gloss: strength of the highlight, 0 to 1.

    Returns:
        [n, 59], as `make_scene`.
    """
    count = len(points)
    noise = rng.random((count, 8))
    size = np.log(0.62 * np.sqrt(area / count))
    scales = np.stack(
        [
            size + 0.7 * (noise[:, 0] - 0.35),
            size + 0.7 * (noise[:, 1] - 0.65),
            size - 2.2 - 0.8 * noise[:, 2],
        ],
        1,
    )
    opacity = 5.5 * np.sqrt(noise[:, 3]) - 1.5
    lit = AMBIENT + (1 - AMBIENT) * np.maximum(np.sum(normals * LAMP, 1), 0.0)
    colour = np.clip(albedo * lit[:, None] + 0.06 * (noise[:, 4:7] - 0.5), 0.0, 1.0)
    # Looking along `axis` one sees the lamp mirrored.
    axis = LAMP - 2 * np.sum(normals * LAMP, 1)[:, None] * normals
    faces_lamp = np.maximum(np.sum(normals * LAMP, 1), 0.0)
    lobe = (gloss * faces_lamp)[:, None] * _sh_bands_1_to_3(axis)
    tint = np.array([1.0, 0.95, 0.85])
    rest = (tint[None, :, None] * lobe[:, None, :]).reshape(count, 45)
    rest += 0.012 * (rng.random((count, 45)) - 0.5)
    rotation = _frames(normals, 2 * np.pi * noise[:, 7])
    points = points + (0.004 * (rng.random((count, 1)) - 0.5)) * normals
    return np.concatenate([points, (colour - 0.5) / SH_C0, rest, opacity[:, None], scales, rotation], 1)


def _frames(normals: F64, angle: F64) -> F64:
    """Quaternions that turn +z to the normal, after a turn by `angle` about +z; w x y z."""
    towards = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))], 1)
    towards[towards[:, 0] < 1e-6] = [0.0, 1.0, 0.0, 0.0]
    towards /= np.sqrt(np.sum(towards**2, 1))[:, None]
    w, x, y, z = towards.T
    c, s = np.cos(angle / 2), np.sin(angle / 2)
    return np.stack([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], 1)


def _sh_bands_1_to_3(directions: F64) -> F64:
    """Coefficients of a lobe around each direction: the basis itself, weighted by band.

    Args:
        directions: [n, 3], unit.

    Returns:
        [n, 15], in the order and with the signs of Kerbl et al. 2023.
    """
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    band_1 = [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    band_2 = [
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
    ]
    band_3 = [
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    bands = (band_1, band_2, band_3)
    weighted = [GLOSS_OF_BAND[i] * row for i, band in enumerate(bands, 1) for row in band]
    return np.stack(weighted, 1)


def _low_discrepancy(count: int) -> tuple[F64, F64]:
    """Spread `count` points evenly over the unit square (Roberts' R2 sequence)."""
    index = np.arange(1, count + 1)
    return (0.5 + 0.7548776662466927 * index) % 1.0, (0.5 + 0.5698402909980532 * index) % 1.0


def _on_grid(values: F64, bits: int) -> F64:
    return np.round(values * 2.0**bits) / 2.0**bits


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else SAMPLE
    write_scene(target, make_scene())
    print(f"{target}: {target.stat().st_size} bytes")
