# SPDX-License-Identifier: Apache-2.0
"""A .csplat file as the splats of a glTF primitive: the rules of `spec/gltf.md` that reader and writer share.

A .csplat file in a buffer view is called a payload. Its values are turned to glTF's axes by `csplat.editing.transform`,
which changes signs alone for the axes that GLT-9 allows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.byte_store import MemoryStore
from csplat.decoder import Limits, SceneHeader
from csplat.editing.transform import DEFAULT_AXES, axes_rotation
from csplat.formats.gltf.gltf_document import (
    AXES,
    EXTENSION,
    GltfDocument,
    JsonPath,
    PlacedPrimitive,
    attribute_name,
    sh_names,
)
from csplat.scene_metadata import UNSPECIFIED
from csplat.splat_file import SplatFile
from csplat.types import F64

#: Name of the extension; a later major version gets another name.
COMPRESSION = "CSPLAT_gaussian_splatting_compression_1"
#: Highest SH degree of KHR_gaussian_splatting.
SH_DEGREE_MAX = 3

_POINTS, _TRIANGLES = 0, 4  # values of `mode`; the default is triangles
_ALIGNMENT = 4  # bytes (GLT-16)
_DEFAULTS = {"projection": _spec.PROJECTION_NAMES[_spec.PROJECTION_PERSPECTIVE]}  # of KHR_gaussian_splatting
_FLOAT32_MAX = float(np.finfo(np.float32).max)
_ORIGIN_MAX = 2.0**20  # scene units (GLT-10)
_FLOAT = 5126  # componentType
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123}  # glTF has no other integers for attributes
_LINES = ("RL", "UD", "FB")  # directions that x, y and z may have


def payload_matrix(axes: str) -> F64:
    """Return the matrix [3, 3] of signs from the axes of a file to glTF's (GLT-9); without axes, RDF is assumed."""
    return axes_rotation(DEFAULT_AXES if axes == UNSPECIFIED else axes, AXES)


def has_payload_axes(axes: str) -> bool:
    """Return True if the axes of a file differ from glTF's by signs alone (GLT-9)."""
    return axes == UNSPECIFIED or all(letter in line for letter, line in zip(axes, _LINES, strict=True))


def undrawable(header: SceneHeader) -> str:
    """Return a reason why no glTF can specify how the splats are drawn (GLT-6); "" if it can."""
    if header.colour_space not in _spec.COLOUR_SPACE_NAMES:
        return f"its colour space is {header.colour_space}, which has no name in glTF"
    if header.projection not in _spec.PROJECTION_NAMES:
        return f"its projection is {header.projection}, which has no name in glTF"
    return ""


def violation(header: SceneHeader) -> str:
    """Return the clause that a file violates as a payload, as "GLT-7: its SH degree is 4, ..."; "" if it is valid."""
    if reason := undrawable(header):
        return f"GLT-6: {reason}"
    if not header.splat_count:
        return "GLT-7: it has no splats"
    if header.sh_degree > SH_DEGREE_MAX:
        return f"GLT-7: its SH degree is {header.sh_degree}, expected at most {SH_DEGREE_MAX}"
    if header.coarse_tiles:
        return "GLT-8: it has levels of detail, expected level 0 alone"
    if not has_payload_axes(header.coordinate_system):
        return f"GLT-9: its axes are {header.coordinate_system}, expected R or L, U or D, F or B"
    if not is_near(header.origin):
        return f"GLT-10: its origin is {list(header.origin)}, expected components of at most 2^20"
    return ""


def is_copyable(header: SceneHeader) -> bool:
    """Return True if a file is valid as a payload, but perhaps for its levels and its origin."""
    near = replace(header, coarse_tiles=(), origin=(0.0, 0.0, 0.0))
    return not violation(near)


def is_near(origin: Sequence[float]) -> bool:
    """Return True if a file may have this origin (GLT-10)."""
    return max(map(abs, origin)) <= _ORIGIN_MAX


def properties(header: SceneHeader) -> dict[str, str]:
    """Return the properties of KHR_gaussian_splatting that a file determines (GLT-6)."""
    return {
        "kernel": header.kernel,
        "colorSpace": _spec.COLOUR_SPACE_NAMES[header.colour_space],
        "projection": _spec.PROJECTION_NAMES[header.projection],
    }


def attribute_types(header: SceneHeader) -> dict[str, tuple[str, int]]:
    """Return type and componentType of each attribute of a payload, by its name in the primitive (GLT-11, GLT-13)."""
    widths = {"POSITION": 3, "ROTATION": 4, "SCALE": 3, "OPACITY": 1}
    widths |= {name: 3 for degree in range(header.sh_degree + 1) for name in sh_names(degree)}
    types = {attribute_name(name): (_KINDS[width], _FLOAT) for name, width in widths.items()}
    for column in header.extras:
        if column.dtype is not None:
            types |= _extra_types(column.name, column.splat_dtype)
    return types


def _extra_types(name: str, dtype: np.dtype[Any]) -> dict[str, tuple[str, int]]:
    """Return type and componentType of the attributes of an extra column, whose rows have the shape of `dtype`."""
    width, component = math.prod(dtype.shape), _COMPONENTS.get(dtype.base.str[1:], _FLOAT)
    if width in _KINDS:
        return {f"_{name}": (_KINDS[width], component)}
    return {f"_{name}_{index}": (_KINDS[1], component) for index in range(width)}


def payload_bounds(file: SplatFile) -> NDArray[np.float64]:
    """Return the least and largest position [2, 3] of a file along glTF's axes, which are binary32 (GLT-12).

    The boxes of the tiles, which the decoder checks, have the same numbers as the decoded means.
    """
    corners = np.stack([file.boxes[:, 0].min(axis=0), file.boxes[:, 1].max(axis=0)])
    return np.sort(corners @ payload_matrix(file.header.coordinate_system).T, axis=0) + 0.0


def extension_object(header: SceneHeader, view: int) -> dict[str, int | str]:
    """Return the object of the extension for a file in a buffer view (GLT-4)."""
    profile = next(number for number, name in _spec.PROFILE_NAMES.items() if name == header.profile)
    return {"bufferView": view, "profile": profile, "level": header.resource_level}


def payload_view(document: GltfDocument, placed: PlacedPrimitive) -> int:
    """Return the index of the buffer view of a primitive with the extension.

    Raises:
        InputError: the primitive is no cloud of points, or the extension names no buffer view.
    """
    mode = document.integer(placed.primitive, placed.json_path, "mode", _TRIANGLES)
    if mode != _POINTS:
        raise document.error((*placed.json_path, "mode"), f"found {mode}, expected {_POINTS}, points (GLT-2)")
    record, json_path = _extension_object(document, placed)
    return document.integer(record, json_path, "bufferView")


def open_payload(document: GltfDocument, view: int) -> SplatFile:
    """Open the .csplat file in a buffer view.

    Raises:
        FormatError, UnsupportedError, LimitError: as in `csplat.open`; the error has the path of the buffer view.
        InputError: there is no such buffer view, or it or the file violates a clause.
    """
    record = document.item("bufferViews", view)
    if document.integer(record, ("bufferViews", view), "byteOffset", 0) % _ALIGNMENT:
        raise document.error(("bufferViews", view, "byteOffset"), f"it is no multiple of {_ALIGNMENT} (GLT-16)")
    for key in ("byteStride", "target"):
        if key in record:
            raise document.error(("bufferViews", view, key), "a .csplat file has none (GLT-16)")
    data, _ = document.view(view)
    store = MemoryStore(data)
    store.name = f"{document.path}, buffer view {view}"
    opened = SplatFile(store, Limits())
    if broken := violation(opened.header):
        raise document.error(("bufferViews", view), f"a glTF cannot have this .csplat file, {broken}")
    return opened


def check_primitive(
    document: GltfDocument, placed: PlacedPrimitive, header: SceneHeader, bounds: NDArray[np.float64]
) -> None:
    """Check that a primitive agrees with its .csplat file.

    Args:
        document: the glTF.
        placed: the primitive.
        header: header of the file.
        bounds: least and largest position [2, 3], as from `payload_bounds`.

    Raises:
        InputError: a property, an attribute or an accessor does not agree.
    """
    record, json_path = _extension_object(document, placed)
    outer = json_path[:-2]
    splats = _DEFAULTS | placed.primitive["extensions"][EXTENSION]
    stated = ((record, json_path, extension_object(header, record["bufferView"]), "GLT-5"),)
    for holder, place, expected, clause in (*stated, (splats, outer, properties(header), "GLT-6")):
        for key, value in expected.items():
            found = document.get(holder, place, key, type(value))
            if found != value:
                raise document.error((*place, key), f"found {found!r}, its .csplat file has {value!r} ({clause})")
    attributes = document.get(placed.primitive, placed.json_path, "attributes", dict, {})
    at = (*placed.json_path, "attributes")
    types = attribute_types(header)
    for name in attributes:
        if name.startswith(f"{EXTENSION}:") and name not in types:
            raise document.error((*at, name), "its .csplat file has no such attribute (GLT-11)")
    for name in (*types, *(name for name in attributes if name not in types)):
        if name not in attributes:
            raise document.error(at, f"there is no {name}, which its .csplat file has (GLT-11)")
        _check_accessor(document, attributes[name], header.splat_count, types.get(name))
    place = ("accessors", attributes["POSITION"])
    positions = document.item(*place)
    of_splats = [name for name in types if not name.startswith("_")]
    have_values = {"bufferView" in document.item("accessors", attributes[name]) for name in of_splats}
    if len(have_values) > 1:
        raise document.error(at, "some accessors of splats have a bufferView, expected all or none (GLT-20)")
    if have_values == {True}:
        return
    for key, corner in zip(("min", "max"), bounds, strict=True):
        found = document.numbers(positions, place, key, np.full(3, np.nan))
        if (np.abs(found) > _FLOAT32_MAX).any() or (found.astype(np.float32) != corner).any():
            reason = f"found {found.tolist()}, its .csplat file has {corner.tolist()} (GLT-12)"
            raise document.error((*place, key), reason)


def _check_accessor(document: GltfDocument, index: object, count: int, types: tuple[str, int] | None) -> None:
    """Check the accessor of an attribute.

    Args:
        document: the glTF.
        index: index of the accessor.
        count: N.
        types: type and componentType of the attribute; `None` if the .csplat file does not have it.

    Raises:
        InputError: the accessor has other rows than the file.
    """
    record = document.item("accessors", index)
    json_path: JsonPath = ("accessors", str(index))
    rows = document.integer(record, json_path, "count")
    if rows != count:
        raise document.error((*json_path, "count"), f"found {rows}, its .csplat file has {count} splats (GLT-19)")
    if types is None:
        return
    found = (record.get("type"), record.get("componentType"))
    if found[0] != types[0] or ("bufferView" not in record and found[1] != types[1]):
        raise document.error(json_path, f"found {found[0]} of {found[1]}, expected {types[0]} of {types[1]} (GLT-18)")


def _extension_object(document: GltfDocument, placed: PlacedPrimitive) -> tuple[dict[str, Any], JsonPath]:
    """Return the object of the extension, and its path in the JSON."""
    within = placed.primitive["extensions"][EXTENSION]["extensions"]
    json_path = (*placed.json_path, "extensions", EXTENSION, "extensions")
    record: dict[str, Any] = document.get(within, json_path, COMPRESSION, dict)
    return record, (*json_path, COMPRESSION)
