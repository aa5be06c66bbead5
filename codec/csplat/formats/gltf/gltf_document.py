# SPDX-License-Identifier: Apache-2.0
"""The parts of glTF 2.0 that splats need: containers, buffers, accessors and the transforms of nodes.

Files are not trusted: every index, length and number is checked before it is used. A violation of glTF raises an
`InputError` with its path in the JSON.
"""

from __future__ import annotations

import base64
import binascii
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import parse_json, path_inside
from csplat.errors import InputError, counted
from csplat.file_source import describe_substitute, map_file
from csplat.types import F32, F64

JsonPath = tuple[str | int, ...]  # path of a value in the JSON, for example ("nodes", 3, "mesh")

EXTENSION = "KHR_gaussian_splatting"
#: Directions of +x, +y and +z: left, up, front.
AXES = "LUF"
MAGIC = b"glTF"
GLB_HEAD = struct.Struct("<4sII")  # magic, version, file size
_CHUNK_HEAD = struct.Struct("<I4s")
JSON, BIN = b"JSON", b"BIN\0"
_VERSION = 2

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TRANSFORM = {"matrix", "rotation", "scale", "translation"}  # properties of a node
_NUMBER_MAX = 1e300  # refuses NaN, infinity and integers that exceed float64
_MAX_PRIMITIVES = 1 << 14  # primitives shown by all nodes: a small file could reference a mesh very often
_MAX_CHUNKS = 64  # chunks of a .glb that are listed; two are read
_NO_TRANSLATION = (0.0, 0.0, 0.0)
#: Extensions of nodes: copies of a mesh, and whether a node is shown.
INSTANCING, VISIBILITY = "EXT_mesh_gpu_instancing", "KHR_node_visibility"


@dataclass(frozen=True)
class Accessor:
    """An accessor: a view of numbers in a buffer.

    Attributes:
        rows: [N, width], a view of the file.
        normalised: integers represent fractions of the largest integer of their type.
    """

    rows: NDArray[Any]
    normalised: bool

    def values(self, part: slice) -> F32:
        """Return some rows as float32 [n, width]; normalised integers become fractions."""
        rows = self.rows[part]
        if not self.normalised or rows.dtype.kind == "f":
            return np.array(rows, np.float32)
        fractions = rows.astype(np.float32) / np.float32(np.iinfo(rows.dtype).max)
        clipped: F32 = np.maximum(fractions, np.float32(-1.0))
        return clipped


@dataclass(frozen=True)
class PlacedPrimitive:
    """A primitive and the node that shows it.

    Attributes:
        primitive: JSON of the primitive.
        json_path: path of the primitive in the JSON.
        matrix: [4, 4] from the primitive to the world, for column vectors.
        node: JSON of the node.
        node_path: path of the node in the JSON.
    """

    primitive: dict[str, Any]
    json_path: JsonPath
    matrix: F64
    node: dict[str, Any]
    node_path: JsonPath


@dataclass(frozen=True)
class GltfDocument:
    """A glTF file with parsed JSON.

    Attributes:
        path: path of the file; buffers in separate files are in its folder.
        root: the JSON.
        binary: the chunk BIN; `None` if there is none.
        tail: number of bytes after the declared end of a .glb.
        chunks: types of the chunks of a .glb that are not read.
        short: by index, messages about used buffers that are shorter than declared.
    """

    path: Path
    root: dict[str, Any]
    binary: memoryview | None
    tail: int = 0
    chunks: tuple[str, ...] = ()
    short: dict[int, str] = field(default_factory=dict)
    _buffers: dict[int, memoryview] = field(default_factory=dict)

    def error(self, json_path: JsonPath, reason: str) -> InputError:
        """Return the error for a path in the JSON."""
        return InputError(f"{self.path.name}, {'/'.join(map(str, json_path))}: {reason}")

    def get(
        self, holder: dict[str, Any], json_path: JsonPath, key: str, kind: type | tuple[type, ...], default: Any = None
    ) -> Any:
        """Return a member of a JSON object, or `default` if it is absent.

        Raises:
            InputError: the member has another type.
        """
        value = holder.get(key, default)
        if value is not default and (not isinstance(value, kind) or (type(value) is bool) != (kind is bool)):
            raise self.error((*json_path, key), f"found {_shorten(value)}")
        return value

    def integer(self, holder: dict[str, Any], json_path: JsonPath, key: str, default: int | None = None) -> int:
        """Return an integer member >= 0, which is required unless there is a default.

        Raises:
            InputError: the member is absent or has another value.
        """
        value: Any = self.get(holder, json_path, key, int, default)
        if value is None or not 0 <= value < 1 << 53:
            raise self.error((*json_path, key), f"found {_shorten(value)}, expected a whole number")
        number: int = value
        return number

    def item(self, key: str, index: object) -> dict[str, Any]:
        """Return an object from a top-level list.

        Raises:
            InputError: there is no object with that index.
        """
        values = self.root.get(key)
        if isinstance(values, list) and isinstance(index, int) and 0 <= index < len(values):
            value = values[index]
            if isinstance(value, dict):
                return value
        raise self.error((key, _shorten(index)), "there is no such object")

    def accessor(self, index: object, width: int) -> Accessor:
        """Return an accessor with rows of `width` numbers.

        Raises:
            InputError: the accessor does not exist, has another type, or exceeds its buffer.
        """
        record = self.item("accessors", index)
        json_path = ("accessors", _shorten(index))
        dtype = _DTYPES.get(self.integer(record, json_path, "componentType"))
        kind = self.get(record, json_path, "type", str)
        if dtype is None or _WIDTHS.get(kind) != width:
            raise self.error(
                json_path, f"found {_shorten(kind)} of {record['componentType']}, expected {width} numbers"
            )
        if "sparse" in record or "bufferView" not in record:
            raise self.error(
                json_path, "sparse accessors are not supported" if "sparse" in record else "found no bufferView"
            )
        count, offset = self.integer(record, json_path, "count"), self.integer(record, json_path, "byteOffset", 0)
        data, stride = self.view(record["bufferView"])
        size = np.dtype(dtype).itemsize * width
        stride = stride or size
        if stride < size:
            raise self.error(json_path, f"rows of {size} bytes have a stride of {stride}")
        if offset + stride * (count - 1) + size > len(data) and count:
            raise self.error(json_path, f"{counted(count, 'row')} of {size} bytes in a view of {len(data)} bytes")
        rows: NDArray[Any] = np.zeros((0, width), dtype)
        if count:
            rows = np.ndarray((count, width), dtype, data, offset, (stride, size // width))
        return Accessor(rows, self.get(record, json_path, "normalized", bool, False))

    def view(self, index: object) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view and its stride, 0 if rows are adjacent."""
        record, json_path = self.item("bufferViews", index), ("bufferViews", _shorten(index))
        if record.get("extensions"):
            raise self.error(
                (*json_path, "extensions"),
                f"{_list_names(record['extensions'])}: packed buffers are not supported, gltf-transform unpacks them",
            )
        buffer = self._buffer(self.integer(record, json_path, "buffer"))
        start, length = self.integer(record, json_path, "byteOffset", 0), self.integer(record, json_path, "byteLength")
        if start + length > len(buffer):
            short = ": the file is truncated" if record["buffer"] in self.short else ""
            raise self.error(json_path, f"bytes {start} to {start + length} of a buffer of {len(buffer)}{short}")
        return buffer[start : start + length], self.integer(record, json_path, "byteStride", 0)

    def _buffer(self, index: int) -> memoryview:
        """Return a buffer, at most `byteLength` bytes; a buffer with fewer bytes is noted in `short`."""
        if index not in self._buffers:
            record, json_path = self.item("buffers", index), ("buffers", index)
            uri, length = self.get(record, json_path, "uri", str), self.integer(record, json_path, "byteLength")
            if uri is not None:
                data = self._read_uri(uri, (*json_path, "uri"))
            elif index == 0 and self.binary is not None:
                data = self.binary
            else:
                raise self.error(json_path, "it has neither a uri nor a BIN chunk")
            if length > len(data):  # the part that splats use may still be present
                self.short[index] = f"found {len(data):,} bytes, expected {length:,}"
            self._buffers[index] = data[:length]
        return self._buffers[index]

    def _read_uri(self, uri: str, json_path: JsonPath) -> memoryview:
        """Return the bytes of a base64 data URI, or of a file in the folder of the document.

        Raises:
            InputError: the URI is invalid, leads out of the folder, or names a file that cannot be read.
        """
        if uri.startswith("data:"):
            kind, _, text = uri.partition(",")
            if not kind.endswith(";base64"):
                raise self.error(json_path, "found a data URI of another encoding, expected base64")
            try:
                return memoryview(base64.b64decode(text, validate=True))
            except (binascii.Error, ValueError) as error:
                raise self.error(json_path, f"found invalid base64: {error}") from None
        folder = self.path.resolve().parent
        name = unquote(uri)
        if "\\" in name and not (folder / name).exists():  # written on Windows
            name = name.replace("\\", "/")
        if not name.isprintable() or ":" in name or "\\" in name:
            raise self.error(json_path, f"found {_shorten(uri)}, expected a file in the same folder")
        try:
            target = path_inside(folder, name)
            if target is None:  # refuses .., absolute paths and links that lead out
                raise self.error(json_path, f"{_shorten(uri)} leads outside the folder of {self.path.name}")
            if not target.is_file():
                same = [path.name for path in folder.iterdir() if path.name.casefold() == target.name.casefold()]
                hint = f", but {_shorten(same[0])}: rename it" if same else ""
                raise self.error(json_path, f"there is no file {_shorten(uri)}{hint}")
            data = memoryview(map_file(target))
        except (OSError, RuntimeError) as error:  # RuntimeError: circular links
            raise self.error(json_path, f"{_shorten(uri)} cannot be read: {error}") from None
        if instead := describe_substitute(bytes(data[:64])):
            raise self.error(json_path, f"{_shorten(uri)} is {instead}")
        return data

    def size(self) -> int:
        """Return the total size in bytes of all buffers used so far."""
        return sum(map(len, self._buffers.values()))

    def placed_primitives(self) -> Iterator[PlacedPrimitive]:
        """Yield all primitives that the scene shows, in the order of its nodes.

        Raises:
            InputError: a node is missing, or has several parents.
        """
        nodes = self._list(self.root, (), "nodes")
        if "scenes" in self.root:
            index = self.integer(self.root, (), "scene", 0)
            roots = self._list(self.item("scenes", index), ("scenes", index), "nodes")
        else:
            children = [child for node in nodes if isinstance(node, dict) for child in _as_list(node.get("children"))]
            below = {child for child in children if isinstance(child, int)}
            roots = [index for index in range(len(nodes)) if index not in below]
        seen: set[int] = set()
        shown = 0
        stack = [(index, np.eye(4)) for index in reversed(roots)]
        while stack:
            index, above = stack.pop()
            node, json_path = self.item("nodes", index), ("nodes", _shorten(index))
            if _extension(node, VISIBILITY).get("visible") is False:
                continue
            if index in seen:
                raise self.error(json_path, "it has more than one parent")
            seen.add(index)
            matrix = above
            if not _TRANSFORM.isdisjoint(node):
                with np.errstate(all="ignore"):
                    matrix = above @ self._transform(node, json_path)
            stack += [(child, matrix) for child in reversed(self._list(node, json_path, "children"))]
            if "mesh" in node:
                mesh = self.item("meshes", node["mesh"])
                for at, primitive in enumerate(self._list(mesh, ("meshes", node["mesh"]), "primitives")):
                    spot = ("meshes", node["mesh"], "primitives", at)
                    shown += 1
                    if not isinstance(primitive, dict):
                        raise self.error(spot, f"found {_shorten(primitive)}, expected an object")
                    if shown > _MAX_PRIMITIVES:
                        raise self.error(spot, f"it is number {shown}, the scene may show {_MAX_PRIMITIVES}")
                    yield PlacedPrimitive(primitive, spot, matrix, node, json_path)

    def other_scenes(self) -> str:
        """Describe the scenes that `placed_primitives` ignores because no default is set; "" if there are none."""
        scenes = self.root.get("scenes")
        if not isinstance(scenes, list) or len(scenes) < 2 or "scene" in self.root:
            return ""
        names = [scene.get("name") if isinstance(scene, dict) else None for scene in scenes]
        labels = [f"{index}{f' ({_shorten(name)})' if name else ''}" for index, name in enumerate(names)]
        shown = ", ".join(labels[1:4]) + (", ..." if len(labels) > 4 else "")
        return f"{len(scenes)} scenes and no default: scene {labels[0]} is read, {shown} not"

    def instances(self, placed: PlacedPrimitive) -> NDArray[np.float64]:
        """Return the matrices [I, 4, 4] from a primitive to the world, for each instance of EXT_mesh_gpu_instancing."""
        extension = _extension(placed.node, INSTANCING)
        if not extension:
            return placed.matrix[None]
        json_path = (*placed.node_path, "extensions", INSTANCING)
        attributes = self.get(extension, json_path, "attributes", dict, {})
        widths = {"TRANSLATION": 3, "ROTATION": 4, "SCALE": 3}
        rows = {name: self.accessor(attributes[name], width) for name, width in widths.items() if name in attributes}
        counts = {len(accessor.rows) for accessor in rows.values()}
        if len(counts) != 1:
            raise self.error(json_path, f"its attributes have {sorted(counts)} rows, expected one number of instances")
        values = {name: accessor.values(slice(None)).astype(np.float64) for name, accessor in rows.items()}
        matrices = np.tile(np.eye(4), (counts.pop(), 1, 1))
        for index, quat in enumerate(values.get("ROTATION", ())):
            matrices[index, :3, :3] = self._rotation(quat.tolist(), (*json_path, "attributes", "ROTATION"))
        matrices[:, :3, :3] *= values.get("SCALE", np.ones((len(matrices), 3)))[:, None]
        matrices[:, :3, 3] = values.get("TRANSLATION", 0.0)
        to_world: NDArray[np.float64] = placed.matrix @ matrices
        return to_world

    def _list(self, holder: dict[str, Any], json_path: JsonPath, key: str) -> list[Any]:
        """Return the list that a member holds, empty if it is absent; raise an `InputError` for another type."""
        values: list[Any] = self.get(holder, json_path, key, list, [])
        return values

    def _transform(self, node: dict[str, Any], json_path: JsonPath) -> F64:
        """Return the matrix [4, 4] of a node, from its `matrix` or its rotation, scale and translation."""
        if "matrix" in node:
            return self.numbers(node, json_path, "matrix", np.eye(4).ravel()).reshape(4, 4).T
        matrix = np.eye(4)
        quat = self.numbers(node, json_path, "rotation", (0.0, 0.0, 0.0, 1.0)).tolist()
        matrix[:3, :3] = self._rotation(quat, (*json_path, "rotation"))
        matrix[:3, :3] *= self.numbers(node, json_path, "scale", (1.0, 1.0, 1.0))
        matrix[:3, 3] = self.numbers(node, json_path, "translation", _NO_TRANSLATION)
        return matrix

    def _rotation(self, quat: list[float], json_path: JsonPath) -> list[list[float]]:
        """Return the rotation matrix, [3, 3], of a quaternion x y z w of any finite length above 0."""
        length = math.hypot(*quat)
        if not 0.0 < length < math.inf:
            raise self.error(json_path, f"found {quat}, expected a unit quaternion")
        x, y, z, w = (component / length for component in quat)
        return [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]

    def numbers(self, holder: dict[str, Any], json_path: JsonPath, key: str, default: Any) -> F64:
        """Return a list of numbers, float64, as many as the default has; raise an `InputError` for anything else."""
        values = holder.get(key, list(default))
        good = isinstance(values, list) and len(values) == len(default)
        if not good or not all(type(value) in (int, float) and abs(value) < _NUMBER_MAX for value in values):
            raise self.error((*json_path, key), f"found {_shorten(values)}, expected {len(default)} numbers")
        return np.array(values, np.float64)


def sh_names(degree: int) -> list[str]:
    """Return the attribute names of an SH band, without the prefix."""
    return [f"SH_DEGREE_{degree}_COEF_{index}" for index in range(2 * degree + 1)]


def attribute_name(name: str) -> str:
    """Return the name of a splat attribute with its prefix; POSITION has none."""
    return name if name == "POSITION" else f"{EXTENSION}:{name}"


def open_document(path: Path) -> GltfDocument:
    """Read the JSON of a .glb or .gltf.

    Raises:
        InputError: the file is not glTF, incomplete, or of another version.
        OSError: the file cannot be read.
    """
    data = memoryview(map_file(path))
    text, binary, tail, chunks = _split_chunks(path, data) if data[:4] == MAGIC else (data, None, 0, ())
    try:
        root = parse_json(bytes(text))
    except InputError as error:
        raise InputError(f"{path.name}: its JSON cannot be read: {error}") from None
    if not isinstance(root, dict) or not isinstance(root.get("asset"), dict):
        raise InputError(f"{path.name} is not glTF: its JSON has no asset")
    version = root["asset"].get("version")
    if not isinstance(version, str) or version.partition(".")[0] != str(_VERSION):
        raise InputError(f"{path.name} is glTF {_shorten(version)}, expected {_VERSION}.0")
    return GltfDocument(path, root, binary, tail, chunks)


def _split_chunks(path: Path, data: memoryview) -> tuple[memoryview, memoryview | None, int, tuple[str, ...]]:
    """Return the chunks JSON and BIN of a .glb, the number of bytes after its end, and the types of other chunks.

    BIN is `None` if it is not the second chunk. Zeros after the JSON are removed.

    Raises:
        InputError: the file is truncated, of another version, or does not begin with JSON.
    """
    if len(data) < GLB_HEAD.size:
        raise InputError(f"{path.name} is truncated: {counted(len(data), 'byte')}")
    _, version, size = GLB_HEAD.unpack_from(data)
    if version != _VERSION:
        raise InputError(f"{path.name} is binary glTF {version}, expected {_VERSION}")
    if size > len(data):
        raise InputError(f"{path.name} is truncated: found {len(data)} bytes, expected {size}")
    chunks: list[tuple[bytes, memoryview]] = []
    at = GLB_HEAD.size
    while at + _CHUNK_HEAD.size <= size and len(chunks) < _MAX_CHUNKS:
        length, kind = _CHUNK_HEAD.unpack_from(data, at)
        at += _CHUNK_HEAD.size
        if length > size - at:
            raise InputError(
                f"{path.name}, byte {at - _CHUNK_HEAD.size}: a chunk of {length} bytes, {size - at} remain"
            )
        chunks.append((kind, data[at : at + length]))
        at += length
    if not chunks or chunks[0][0] != JSON:
        raise InputError(f"{path.name}: the first chunk is not JSON")
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == BIN else None
    text = bytes(chunks[0][1]).rstrip(b"\0")  # some exporters pad with zeros instead of spaces
    others = tuple(kind.decode("ascii", "replace") for kind, part in chunks[1 if binary is None else 2 :] if len(part))
    return memoryview(text), binary, len(data) - size, others


def _extension(holder: dict[str, Any], name: str) -> dict[str, Any]:
    """Return an extension object; {} if it is absent."""
    extensions = holder.get("extensions")
    extension = extensions.get(name) if isinstance(extensions, dict) else None
    return extension if isinstance(extension, dict) else {}


def _as_list(value: object) -> list[Any]:
    """Return a value if it is a list, otherwise an empty list."""
    return value if isinstance(value, list) else []


def _list_names(value: object) -> str:
    """Format the member names of an object for messages; another value is shortened."""
    return ", ".join(map(str, value)) if isinstance(value, dict) else _shorten(value)


def _shorten(value: object) -> str:
    """Format a JSON value for messages in at most 60 characters."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
