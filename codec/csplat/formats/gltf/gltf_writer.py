# SPDX-License-Identifier: Apache-2.0
"""Write glTF 2.0 with the extension KHR_gaussian_splatting as a single .glb file.

Splats are plain accessors, or a .csplat file by the rules of `spec/gltf.md`.
"""

from __future__ import annotations

import json
import math
import struct
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from csplat.context import Context
from csplat.disk_files import atomic_writer, work_folder
from csplat.editing.transform import convert_axes, rotation_to_axes, scale_scene
from csplat.errors import InputError
from csplat.formats.gltf.csplat_payload import (
    COMPRESSION,
    attribute_types,
    extension_object,
    has_payload_axes,
    is_copyable,
    is_near,
    payload_bounds,
    payload_matrix,
    properties,
    undrawable,
    violation,
)
from csplat.formats.gltf.gltf_document import (
    AXES,
    BIN,
    EXTENSION,
    GLB_HEAD,
    JSON,
    MAGIC,
    attribute_name,
    sh_names,
)
from csplat.model import SplatModel
from csplat.ply.comments import format_comments
from csplat.portable_math import exp
from csplat.scene import Scene
from csplat.scene_metadata import LINEAR, SRGB, SceneMetadata
from csplat.spherical_harmonics import SH_C0
from csplat.splat_file import SplatFile
from csplat.types import F32, F64

_FLOAT, _BYTE, _ARRAY_BUFFER = 5126, 5121, 34962
_ZERO = (0.0, 0.0, 0.0)
_LARGEST_FILE = (1 << 32) - 1  # bytes; the size of a .glb is a u32


def write_gltf(path: Path, scene: Scene) -> None:
    """Write a scene with plain accessors (`Format.write`)."""
    _check_target(path, scene)
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
    root = _build_json(scene, attributes, offsets, (lowest, highest))
    with _glb_writer(path, root, offsets[-1]) as stream:
        start = stream.tell()
        done = 0
        for block in scene.blocks():
            for column, offset, size in zip(_attributes(block).values(), offsets, row_sizes, strict=False):
                stream.seek(start + offset + done * size)
                stream.write(np.ascontiguousarray(column).view(np.uint8).data)
            done += len(block)


def write_compressed_gltf(path: Path, scene: Scene) -> None:
    """Write a scene whose splats are a .csplat file (`Format.write`), by the rules of `spec/gltf.md`.

    The splats of a `SplatFile` are copied without a change. Others are encoded with the default options.
    """
    _check_target(path, scene)
    space = scene.metadata.colour_space
    reason = undrawable(scene.header) if isinstance(scene, SplatFile) else ""
    if reason or space not in (SRGB, LINEAR):
        reason = reason or f"its colour space is {space}, which has no name in glTF"
        raise InputError(f"{path.name} cannot have the scene: {reason}; write a .csplat file")
    if not has_payload_axes(scene.metadata.coordinate_system):
        scene = convert_axes(scene, AXES)
    with _open_payload(scene, path) as payload:
        root = _compressed_json(payload, _node_transform(scene.metadata, scene.origin))
        with _glb_writer(path, root, payload.size_bytes) as stream:
            stream.writelines(payload.pieces())


def keeps_file(scene: Scene) -> bool:
    """Return True if `write_compressed_gltf` copies the splats of a scene without a change (`Format.keeps`)."""
    return isinstance(scene, SplatFile) and is_copyable(scene.header)


@contextmanager
def _open_payload(scene: Scene, path: Path) -> Iterator[SplatFile]:
    """Open a .csplat file of a scene for a .glb of this path; a file made for it is removed on exit."""
    from csplat.editing.extract import extract_finest  # imported lazily: reading does not load the encoder
    from csplat.encode_api import encode
    from csplat.encoder import EncodeOptions

    origin = scene.origin if is_near(scene.origin) else _ZERO
    with ExitStack() as stack:
        prefix, parent = ".csplat-", work_folder(path)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=prefix, dir=parent)))
        made = folder / "scene.csplat"
        if not isinstance(scene, SplatFile) or not keeps_file(scene):
            near = scene if origin == scene.origin else scene.map(_without_origin)
            encode(near, EncodeOptions(keep_extra=True), out=made, context=Context(folder=folder / "work"))
            yield stack.enter_context(SplatFile.open(made))
            return
        for _ in scene.blocks():  # a damaged file is refused
            pass
        if not violation(scene.header):
            yield scene
            return
        extract_finest(scene, made, origin=origin)
        yield stack.enter_context(SplatFile.open(made))


def _without_origin(model: SplatModel) -> SplatModel:
    """Return the splats relative to the origin, as a scene of its own."""
    doubles = None if model.means_double is None else model.means_double - np.array(model.origin)
    return replace(model, origin=_ZERO, means_double=doubles)


def _node_transform(metadata: SceneMetadata, origin: Sequence[float]) -> dict[str, Any]:
    """Return the transform of the node that shows a .csplat file (GLT-10, GLT-15): metres, y up, at its origin."""
    matrix = payload_matrix(metadata.coordinate_system)
    linear = rotation_to_axes(metadata, AXES) @ matrix.T * (metadata.unit_metres or 1.0)
    translation = linear @ (matrix @ np.array(origin)) + 0.0
    if (linear == np.eye(3)).all():
        return {"translation": translation.tolist()} if translation.any() else {}
    columns = np.eye(4)
    columns[:3, :3], columns[3, :3] = linear.T, translation
    return {"matrix": columns.ravel().tolist()}


def _compressed_json(payload: SplatFile, transform: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON of a file with a .csplat file as its only buffer, and with a transform of its node."""
    header, licence = payload.header, payload.metadata.licence
    types = attribute_types(header)
    accessors: list[dict[str, Any]] = [
        {"componentType": component, "count": header.splat_count, "type": kind} for kind, component in types.values()
    ]
    least, largest = payload_bounds(payload).tolist()
    accessors[list(types).index("POSITION")] |= {"min": least, "max": largest}
    splats = {**properties(header), "extensions": {COMPRESSION: extension_object(header, 0)}}
    primitive = {
        "attributes": {name: index for index, name in enumerate(types)},
        "mode": 0,
        "extensions": {EXTENSION: splats},
    }
    size = payload.size_bytes
    return {
        "asset": {"version": "2.0", "generator": "csplat", **({} if licence is None else {"copyright": licence})},
        "extensionsUsed": [EXTENSION, COMPRESSION],
        "extensionsRequired": [EXTENSION, COMPRESSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **transform}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": size}],
        "buffers": [{"byteLength": size}],
    }


def _check_target(path: Path, scene: Scene) -> None:
    """Check that a scene can be written to a path.

    Raises:
        InputError: the name is not that of a single file, or there are no splats.
    """
    if path.suffix.lower() == ".gltf":
        raise InputError(f"{path.name}: glTF is written as a single file, name it {path.with_suffix('.glb').name}")
    if not scene.count:
        raise InputError(f"{path.name}: no splats are left to write, and glTF has no empty meshes")


@contextmanager
def _glb_writer(path: Path, root: dict[str, Any], size_bytes: int) -> Iterator[BinaryIO]:
    """Write a .glb up to its buffer, which the caller writes; zeros are appended to it.

    Raises:
        InputError: the file would be too large.
    """
    text = json.dumps(root, ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    padding = -size_bytes % 4
    start = GLB_HEAD.size + 8 + len(text) + 8
    size = start + size_bytes + padding
    if size > _LARGEST_FILE:
        raise InputError(
            f"{path.name} would have {size:,} bytes, a .glb has at most {_LARGEST_FILE:,}:"
            f" write fewer splats or fewer SH bands"
        )
    with atomic_writer(path, seekable=True) as stream:
        stream.write(GLB_HEAD.pack(MAGIC, 2, size) + struct.pack("<I4s", len(text), JSON) + text)
        stream.write(struct.pack("<I4s", size_bytes + padding, BIN))
        yield stream
        stream.seek(start + size_bytes)
        stream.write(bytes(padding))


def _attributes(model: SplatModel) -> dict[str, NDArray[Any]]:
    """Compute the vertex attributes of some splats by name, in the order of the file."""
    with np.errstate(over="ignore", under="ignore"):
        scales = exp(model.scales)  # its binary32 is the nearest to the exponential for every scale (GLT-14)
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
    lines = format_comments(scene.metadata.with_entries(licence=None), scene.origin, absolute=False)
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
    names = [name if name == "COLOR_0" else attribute_name(name) for name in attributes]
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
