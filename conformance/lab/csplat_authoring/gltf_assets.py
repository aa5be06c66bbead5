# SPDX-License-Identifier: CC0-1.0
"""Assets of csplat in glTF (`spec/gltf.md`): .glb files with .csplat files, and the same values as plain accessors.

Bytes and values are computed from recipes, as those of the vectors: neither encoder nor decoder has a part in them.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, getcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat_authoring.builder import build
from csplat_authoring.reference import expected
from csplat_authoring.samples import MEANS, OPACITIES, QUATS, SCALES, SH0, axis, levels, offset, scene, signed, tile
from csplat_authoring.scene import Block, Extra, Node, Scene, Stream

PREFIX, EXTENSION = "KHR_gaussian_splatting", "CSPLAT_gaussian_splatting_compression_1"

_COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "f4": 5126}
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_ONE = 0x3F800000  # bits of the binary32 number 1
_POSITIVE = {_spec.DIRECTION_LEFT, _spec.DIRECTION_UP, _spec.DIRECTION_FORWARD}
_RDF = (_spec.DIRECTION_RIGHT, _spec.DIRECTION_DOWN, _spec.DIRECTION_FORWARD)
_FLOAT32_MAX = np.finfo(np.float32).max

Array = NDArray[Any]


@dataclass(frozen=True)
class _Shown:
    """A scene, and the translation of the node that shows it."""

    scene: Scene
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)


def gltf_assets() -> dict[str, bytes]:
    """Return the files by name: `NAME.glb`, and `NAME_plain.glb` unless readers refuse the asset."""
    right, up, back = _spec.DIRECTION_RIGHT, _spec.DIRECTION_UP, _spec.DIRECTION_BACK
    far = (500000.25, -1000000.5, 100.0)
    shown = {
        "axes": [_Shown(replace(scene(tiles=[_axes_tile()]), axes=(right, up, back)))],
        "sh_degrees": [
            _Shown(scene(degree, [tile(degree, 3, degree)]), (2.0 * degree, 0.0, 0.0)) for degree in range(4)
        ],
        "extra_column": [_Shown(_extra_scene())],
        "large_coordinates": [_Shown(scene(1, [tile(9, 4, 1)], origin=far), (-far[0], -far[1], far[2]))],
        "levels": [_Shown(scene(tiles=[tile(3), tile(4, 1, level=1)], nodes=(Node(1), Node(_spec.NO_PARENT, 1, 1.0))))],
    }
    files = {}
    for name, primitives in shown.items():
        files[f"{name}.glb"] = _glb(primitives, compressed=True)
        if name != "levels":
            files[f"{name}_plain.glb"] = _glb(primitives, compressed=False)
    return files


def _axes_tile() -> Any:
    """Return a tile with a splat on each axis, long along it, and one with SH and any rotation at zero."""
    rows = {
        MEANS: axis([[1000, 0, 0], [0, 1000, 0], [0, 0, 1000], [0, 0, 0]], Stream(2)),
        SCALES: offset([[-10, -30, -30], [-30, -10, -30], [-30, -30, -10], [-20, -25, -30]]),
        QUATS: signed([[0, 0, 0], [0, 0, 0], [0, 0, 0], [30, -50, 70]]),
        OPACITIES: levels([255, 255, 255, 128]),
        SH0: offset([[50, -50, -50], [-50, 50, -50], [-50, -50, 50], [0, 0, 0]]),
    }
    return tile(changes=rows, corner=(0, 0, 0))


def _extra_scene() -> Scene:
    """Return a scene with extra columns; the bits of `weight` are 0.5, NaN and infinity."""
    columns: list[tuple[Extra, list[list[int]], int]] = [
        (Extra("label", _spec.EXTRA_DTYPE_U8, 1, "label"), [[3], [0], [255]], 1),
        (Extra("count", _spec.EXTRA_DTYPE_I16), [[5], [0x8000], [0xFFFF]], 2),
        (Extra("id", _spec.EXTRA_DTYPE_U32), [[1], [16777217], [4294967295]], 4),
        (Extra("weight", _spec.EXTRA_DTYPE_F32), [[0x3F000000], [0x7FC00000], [0xFF800000]], 4),
        (Extra("normal", _spec.EXTRA_DTYPE_F32, 3, "normal"), [[0, 0, _ONE], [_ONE | 1 << 31, 0, 0], [0, _ONE, 0]], 4),
        (Extra("five", _spec.EXTRA_DTYPE_U8, 5), [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9], [255, 254, 253, 252, 251]], 1),
    ]
    blocks = tuple(Block(_spec.CODING_RAW, rows, Stream(width)) for _, rows, width in columns)
    return scene(tiles=[tile(7, 3, extras=blocks)], extras=tuple(extra for extra, _, _ in columns))


def _attributes(shown: Scene) -> dict[str, Array]:
    """Return the values of all attributes of a scene (GLT-14): [N, C] by name."""
    made = expected(shown, 0)
    means, quats, scales = (made.floats[name] for name in ("means", "quats", "scales"))
    signs = np.array([1 if one in _POSITIVE else -1 for one in (shown.axes if any(shown.axes) else _RDF)], "<f4")
    product = signs.prod()
    result = {
        "POSITION": means * signs,
        f"{PREFIX}:ROTATION": quats[:, [1, 2, 3, 0]] * np.array([*(product * signs), 1], "<f4"),
        f"{PREFIX}:SCALE": np.vectorize(_nearest_exp, ["<f4"])(scales),
        f"{PREFIX}:OPACITY": made.floats["opacities"][:, None],
        f"{PREFIX}:SH_DEGREE_0_COEF_0": made.floats["sh0"],
    }
    for degree in range(1, shown.sh_degree + 1):
        for order in range(-degree, degree + 1):
            values = made.floats["shN"][:, degree * degree + degree + order - 1]
            sign = _sh_sign(degree, order, signs)
            result[f"{PREFIX}:SH_DEGREE_{degree}_COEF_{order + degree}"] = values * sign
    for name, column in made.extra.items():
        values = column
        if column.dtype.str[1:] not in _COMPONENTS or column.dtype.kind == "f":
            near = column.astype("<f4")
            values = np.where(np.isfinite(near), near, np.float32(0))
        rows = values.reshape(len(values), -1)
        if rows.shape[1] in _KINDS:
            result[f"_{name}"] = rows
        else:
            result |= {f"_{name}_{index}": rows[:, index : index + 1] for index in range(rows.shape[1])}
    return result


def _nearest_exp(scale: np.float32) -> np.float32:
    """Return the binary32 number nearest to the exponential, at most the largest finite one."""
    getcontext().prec = 50
    exact = Decimal(float(scale)).exp()
    near = np.float32(float(exact))
    around = (near, np.nextafter(near, np.float32(0)), np.nextafter(near, np.float32(np.inf)))
    nearest = min((one for one in around if np.isfinite(one)), key=lambda one: abs(Decimal(float(one)) - exact))
    return min(nearest, _FLOAT32_MAX)


def _sh_sign(degree: int, order: int, signs: Array) -> np.float32:
    """Return the sign of a coefficient from the parity of its function in x, y and z."""
    odd = (abs(order) % 2 != (order < 0), order < 0, (degree + order) % 2 != 0)
    return np.float32(np.prod([sign for sign, is_odd in zip(signs, odd, strict=True) if is_odd]))


def _glb(shown: Sequence[_Shown], *, compressed: bool) -> bytes:
    """Return a .glb with a mesh and a node for each scene, with .csplat files or with plain accessors."""
    data, meshes = bytearray(), []
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []

    def add_view(content: bytes, **rest: int) -> int:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(content), **rest})
        data.extend(content + bytes(-len(content) % 4))
        return len(views) - 1

    for one in shown:
        attributes = {}
        for name, values in _attributes(one.scene).items():
            accessor: dict[str, Any] = {"componentType": _COMPONENTS[values.dtype.str[1:]], "count": len(values)}
            accessor["type"] = _KINDS[values.shape[1]]
            if name == "POSITION":
                accessor |= {"min": (values.min(0) + 0.0).tolist(), "max": (values.max(0) + 0.0).tolist()}
            if not compressed:
                rows = _padded_rows(values)
                accessor["bufferView"] = add_view(rows, byteStride=len(rows) // len(values))
            attributes[name] = len(accessors)
            accessors.append(accessor)
        splats: dict[str, Any] = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        if compressed:
            payload = build(one.scene).data
            header = _spec.unpack_header(payload)
            level = _spec.RESOURCE_LEVEL_NAMES[header.resource_level]
            record = {"bufferView": add_view(payload), "profile": header.profile, "level": level}
            splats["extensions"] = {EXTENSION: record}
        meshes.append({"primitives": [{"mode": 0, "attributes": attributes, "extensions": {PREFIX: splats}}]})
    names = [PREFIX, EXTENSION] if compressed else [PREFIX]
    nodes = [{"mesh": index, "translation": list(one.translation)} for index, one in enumerate(shown)]
    return _pack({
        "asset": {"version": "2.0", "copyright": "CC0-1.0"},
        "extensionsUsed": names,
        **({"extensionsRequired": names} if compressed else {}),
        "scene": 0, "scenes": [{"nodes": [*range(len(nodes))]}], "nodes": nodes, "meshes": meshes,
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(data)}],
    }, bytes(data))  # fmt: skip


def _padded_rows(values: Array) -> bytes:
    """Return rows that are multiples of four bytes, which glTF requires."""
    raw = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)
    return np.pad(raw, ((0, 0), (0, -raw.shape[1] % 4))).tobytes()


def _pack(root: dict[str, Any], data: bytes) -> bytes:
    """Return a .glb of a JSON and its buffer."""
    text = json.dumps(root, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
