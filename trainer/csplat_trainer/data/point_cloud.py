"""Points of a scene that splats may start at: checked, and read from a PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from csplat.errors import InputError
from csplat.lint import Finding
from csplat.ply.ply_reader import parse_ply
from csplat.types import F32, F64

_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_GREY = 127.5


def finite_points(points: F64, colours: F64) -> tuple[F64, F32]:
    """Leave out points that are not finite or beyond float32.

    Args:
        points: [P, 3].
        colours: [P, 3], 0 to 255; clipped to that.

    Returns:
        Points, [P, 3] float64, and their colours, [P, 3] float32 in 0..1.
    """
    good = (np.abs(points) <= np.finfo(np.float32).max).all(axis=1) & np.isfinite(colours).all(axis=1)
    return points[good], (np.clip(colours[good], 0.0, 255.0) / 255.0).astype(np.float32)


def read_point_cloud(path: Path) -> tuple[F64, F32]:
    """Read the points of a PLY, with or without colours; without, all are grey.

    Args:
        path: the file: columns x, y, z; red, green, blue as bytes, 16-bit integers, or floats from 0 to 1.

    Returns:
        As `finite_points`.

    Raises:
        InputError: it is no whole PLY, or has no points.
    """
    findings: list[Finding] = []
    try:
        content = parse_ply(path, findings)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    if content is None:
        raise InputError(f"{path}: {next(one.text for one in findings if not one.repairable)}")
    rows = content[0]
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"{path} has columns {', '.join(names) or 'none'}, expected x, y, z")
    points = np.stack([rows[name].astype(np.float64) for name in ("x", "y", "z")], axis=1)
    columns = next((columns for columns in _COLOURS if set(columns) <= set(names)), None)
    if columns is None:
        return finite_points(points, np.full_like(points, _GREY))
    kind = rows.dtype[columns[0]]
    scale = 255.0 if kind.kind == "f" else 255.0 / np.iinfo(kind).max
    return finite_points(points, np.stack([rows[name].astype(np.float64) * scale for name in columns], axis=1))
