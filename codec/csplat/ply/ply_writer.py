# SPDX-License-Identifier: Apache-2.0
"""Write a scene as a PLY in INRIA's layout, which all splat viewers open."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import BinaryWriter, open_writer
from csplat.errors import InputError
from csplat.model import SplatModel, check_model
from csplat.ply.column_names import property_names
from csplat.ply.columns import logits_of_alpha
from csplat.ply.comments import format_comments
from csplat.scene import Scene

_BLOCK_SIZE = 1 << 20  # bytes of rows that are built at a time; they fit in the cache

_PLY_TYPES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}


def write_ply(file: str | os.PathLike[str] | BinaryWriter, model: SplatModel, *, absolute: bool = False) -> None:
    """Write a binary little-endian PLY: INRIA's columns in INRIA's order, normals zero.

    Opacities 0 and 1 become finite logits whose sigmoids are exactly 0 and 1. Extra columns follow the others. Only the
    metadata comments, licence, training, up and view is written; cameras are not.

    Args:
        file: path of the file, which appears when complete and replaces an older file; or an open binary file.
        model: the scene.
        absolute: write x, y and z as doubles with the origin added, for programs that read doubles. By default they
            are floats relative to the origin, which is stored in a comment.

    Examples:
        >>> import csplat
        >>> model = csplat.read("scene.ply")
        >>> csplat.write_ply("half.ply", model.select(slice(0, None, 2)))

    Raises:
        InputError: an extra column has a name or type that PLY does not support; or `model` is not a `SplatModel`.
        OSError: the file cannot be written.
    """
    check_model("write_ply", model)
    write_scene_ply(file, Scene.like(model, len(model), lambda: iter([model])), absolute=absolute)


def write_scene_ply(file: str | os.PathLike[str] | BinaryWriter, scene: Scene, *, absolute: bool = False) -> None:
    """Write a scene block by block; arguments as in `write_ply`."""
    dtype = _row_dtype(scene, absolute=absolute)
    step = max(1, _BLOCK_SIZE // dtype.itemsize)
    with open_writer(file) as stream:
        stream.write(_build_header(scene, absolute=absolute))
        rows = np.zeros(min(step, scene.count), dtype)
        for model in scene.blocks():
            for start in range(0, len(model), step):
                part = slice(start, min(start + step, len(model)))
                block = rows[: part.stop - part.start]
                _fill_rows(block, model, part, absolute=absolute)
                stream.write(block.view(np.uint8).data)


def _row_dtype(scene: Scene, *, absolute: bool) -> np.dtype[Any]:
    """Return the type of a row as the writer stores it; `absolute` positions are doubles."""
    coefficients = (scene.sh_degree + 1) ** 2 - 1
    return np.dtype(
        [
            ("means", "<f8" if absolute else "<f4", 3),
            ("normals", "<f4", 3),
            ("sh0", "<f4", 3),
            ("shN", "<f4", (3, coefficients)),
            ("logits", "<f4"),
            ("scales", "<f4", 3),
            ("quats", "<f4", 4),
            *((f"extra {name}", dtype.base.newbyteorder("<"), dtype.shape) for name, dtype in scene.extra.items()),
        ]
    )


def _build_header(scene: Scene, *, absolute: bool) -> bytes:
    """Return the header of a PLY with its comments; raise an `InputError` for an extra column that it cannot name."""
    # Comments come last because SIBR's viewer expects the element on the third line.
    position = "double" if absolute else "float"
    rest_count = 3 * ((scene.sh_degree + 1) ** 2 - 1)
    floats = ["nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    floats += [f"f_rest_{index}" for index in range(rest_count)]
    floats += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {scene.count}"]
    lines += [f"property {position} {name}" for name in ("x", "y", "z")]
    lines += [f"property float {name}" for name in floats]
    taken = {"x", "y", "z", *floats}
    for column, dtype in scene.extra.items():
        kind = _ply_type(column, dtype.base)
        for name in property_names(column, math.prod(dtype.shape)):
            if name in taken:
                raise InputError(f"extra column {column!r}: the PLY has a column {name!r} already")
            taken.add(name)
            lines.append(f"property {kind} {name}")
    lines += [f"comment {line}" for line in format_comments(scene.metadata, scene.origin, absolute=absolute)]
    return "\n".join([*lines, "end_header\n"]).encode("ascii")


def _ply_type(name: str, dtype: np.dtype[Any]) -> str:
    """Return the PLY type of an extra column; raise an `InputError` for a name or a type that PLY lacks."""
    if not name.isascii() or name.split() != [name]:
        raise InputError(f"extra column {name!r}: a PLY property is one word of ASCII")
    kind = _PLY_TYPES.get(f"{dtype.kind}{dtype.itemsize}")
    if kind is None:
        raise InputError(f"extra column {name!r} is {dtype}, which is not a PLY type")
    return kind


def _fill_rows(block: NDArray[Any], model: SplatModel, part: slice, *, absolute: bool) -> None:
    """Copy some splats of a model into rows whose normals are zero."""
    if absolute:
        doubles = model.means_double
        block["means"] = model.means[part] + np.array(model.origin) if doubles is None else doubles[part]
    else:
        block["means"] = model.means[part]
    block["sh0"] = model.sh0[part]
    for channel in range(3):
        block["shN"][:, channel] = model.shN[part, :, channel]
    block["logits"] = logits_of_alpha(model.opacities[part])
    block["scales"] = model.scales[part]
    block["quats"] = model.quats[part]
    for name, column in model.extra.items():
        block[f"extra {name}"] = column[part]
