# SPDX-License-Identifier: Apache-2.0
"""Write glTF 2.0 with the extension KHR_gaussian_splatting as a single .glb file."""

from __future__ import annotations

import json
import math
import struct
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import atomic_writer
from csplat.editing.transform import convert_axes, scale_scene
from csplat.errors import InputError
from csplat.formats.gltf.gltf_document import BIN, GLB_HEAD, JSON, MAGIC
from csplat.formats.gltf.gltf_reader import AXES, EXTENSION, sh_names
from csplat.model import SplatModel
from csplat.ply.comments import format_comments
from csplat.scene import Scene
from csplat.scene_metadata import LINEAR, SRGB
from csplat.spherical_harmonics import SH_C0
from csplat.types import F32, F64

_FLOAT, _BYTE, _ARRAY_BUFFER = 5126, 5121, 34962
_LARGEST_FILE = (1 << 32) - 1  # bytes; the size of a .glb is a u32


def write_gltf(path: Path, scene: Scene) -> None:
    """Write a scene (`Format.write`)."""
    if path.suffix.lower() == ".gltf":
        raise InputError(f"{path.name}: glTF is written as a single file, name it {path.with_suffix('.glb').name}")
    if not scene.count:
        raise InputError(f"{path.name}: no splats are left to write, and glTF has no empty meshes")
    unit = scene.metadata.unit_metres
    if unit not in (None, 1.0):
        metres = float(unit)
        scene = scene.map(lambda block: scale_scene(block, metres))
    scene = convert_axes(scene, AXES)
    attributes = _attributes(scene.empty())  # empty arrays: their names, dtypes and widths
    row_sizes = [column.dtype.itemsize * math.prod(column.shape[1:]) for column in attributes.values()]
    lowest, highest = np.full(3, np.inf), np.full(3, -np.inf)
    for block in scene.blocks():
        lowest = np.minimum(lowest, block.means.min(axis=0, initial=np.inf))
        highest = np.maximum(highest, block.means.max(axis=0, initial=-np.inf))
    offsets = np.cumsum([0, *(size * scene.count for size in row_sizes)]).tolist()
    text = json.dumps(_build_json(scene, attributes, offsets, (lowest, highest)), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    start = GLB_HEAD.size + 8 + len(text) + 8
    if start + offsets[-1] > _LARGEST_FILE:
        raise InputError(
            f"{path.name} would have {start + offsets[-1]:,} bytes, a .glb has at most {_LARGEST_FILE:,}:"
            f" write fewer splats or fewer SH bands"
        )
    with atomic_writer(path, seekable=True) as stream:
        stream.write(GLB_HEAD.pack(MAGIC, 2, start + offsets[-1]) + struct.pack("<I4s", len(text), JSON) + text)
        stream.write(struct.pack("<I4s", offsets[-1], BIN))
        done = 0
        for block in scene.blocks():
            for column, offset, size in zip(_attributes(block).values(), offsets, row_sizes, strict=False):
                stream.seek(start + offset + done * size)
                stream.write(np.ascontiguousarray(column).view(np.uint8).data)
            done += len(block)


def _attributes(model: SplatModel) -> dict[str, NDArray[Any]]:
    """Compute the vertex attributes of some splats by name, in the order of the file."""
    with np.errstate(over="ignore", under="ignore"):
        scales = np.exp(model.scales.astype(np.float64))
    names = [name for band in range(1, model.sh_degree + 1) for name in sh_names(band)]
    return {
        "POSITION": model.means.astype("<f4"),
        "ROTATION": model.quats[:, [1, 2, 3, 0]].astype("<f4"),
        "SCALE": np.minimum(scales, np.finfo(np.float32).max).astype("<f4"),
        "OPACITY": model.opacities.astype("<f4"),
        "COLOR_0": _point_colours(model),
        "SH_DEGREE_0_COEF_0": model.sh0.astype("<f4"),
        **{name: model.shN[:, index].astype("<f4") for index, name in enumerate(names)},
    }


def _point_colours(model: SplatModel) -> NDArray[np.uint8]:
    """Compute linear RGB and alpha [N, 4] for programs that only draw points."""
    colours = np.clip(model.sh0 * np.float32(SH_C0) + np.float32(0.5), 0.0, 1.0)
    linear: F32 = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    if model.metadata.colour_space == LINEAR:
        linear = colours
    return np.rint(255.0 * np.concatenate([linear, model.opacities[:, None]], axis=1)).astype(np.uint8)


def _build_json(
    scene: Scene, attributes: dict[str, NDArray[Any]], offsets: list[int], bounds: tuple[F64, F64]
) -> dict[str, Any]:
    """Return the JSON of a file with a single mesh.

    Args:
        scene: the scene.
        attributes: columns of all splats by name, POSITION first; only shapes and types are used.
        offsets: offsets of the columns in the buffer, and its size, bytes.
        bounds: least and largest position, [3] each.
    """
    asset: dict[str, Any] = {"version": "2.0", "generator": "csplat"}
    lines = format_comments(scene.metadata, scene.origin, absolute=False)
    if scene.metadata.licence is not None:
        asset["copyright"] = scene.metadata.licence
    kinds = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
    accessors: list[dict[str, Any]] = []
    for index, column in enumerate(attributes.values()):
        is_float = column.dtype.kind == "f"
        component, kind = _FLOAT if is_float else _BYTE, kinds[math.prod(column.shape[1:])]
        accessors.append({"bufferView": index, "componentType": component, "count": scene.count, "type": kind})
        accessors[index] |= {} if is_float else {"normalized": True}
    accessors[0] |= {"min": bounds[0].tolist(), "max": bounds[1].tolist()}
    names = [name if name in ("POSITION", "COLOR_0") else f"{EXTENSION}:{name}" for name in attributes]
    space = scene.metadata.colour_space
    splats = {"kernel": "ellipse", "colorSpace": space if space in (SRGB, LINEAR) else SRGB}
    primitive = {
        "attributes": {name: index for index, name in enumerate(names)},
        "mode": 0,
        "extensions": {EXTENSION: splats},
    }
    return {
        "asset": {**asset, "extras": {"csplat": lines}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **({"translation": list(scene.origin)} if any(scene.origin) else {})}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": stop - start, "target": _ARRAY_BUFFER}
            for start, stop in pairwise(offsets)
        ],
        "buffers": [{"byteLength": offsets[-1]}],
    }
