"""glTF 2.0 as far as splats want it: containers, buffers, accessors, and where nodes place meshes.

Nothing of a file is believed: every index, length and number is looked at before it is used, and whatever breaks the
rules of glTF is an `InputError` that names its place in the JSON.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError, counted
from csplat.inputs import mapped, stand_in
from csplat.types import F32, F64

Place = tuple[str | int, ...]  # of a value in the JSON: ("nodes", 3, "mesh")

MAGIC = b"glTF"
GLB_HEAD = struct.Struct("<4sII")  # magic, version, bytes of the file
_CHUNK_HEAD = struct.Struct("<I4s")
JSON, BIN = b"JSON", b"BIN\0"
_VERSION = 2

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MOST_PRIMITIVES = 1 << 14  # that nodes show: a small file may name one mesh very often
_NO_TRANSLATION = (0.0, 0.0, 0.0)
_INSTANCING = "EXT_mesh_gpu_instancing"


@dataclass(frozen=True)
class Accessor:
    """Numbers of a buffer, not yet taken out of it.

    Attributes:
        rows: [N, width], a view of the file.
        normalised: whole numbers stand for shares of the largest one.
    """

    rows: NDArray[Any]
    normalised: bool

    def values(self, part: slice) -> F32:
        """Some of the rows, by glTF's rule for whole numbers: [n, width]."""
        rows = self.rows[part]
        if not self.normalised or rows.dtype.kind == "f":
            return np.array(rows, np.float32)
        shares = rows.astype(np.float32) / np.float32(np.iinfo(rows.dtype).max)
        clipped: F32 = np.maximum(shares, np.float32(-1.0))
        return clipped


@dataclass(frozen=True)
class Placed:
    """A primitive and where it is.

    Attributes:
        primitive: its JSON.
        place: of that in the file.
        matrix: [4, 4] to the world, of columns.
        node: the JSON of the node that shows it.
        node_place: of that in the file.
    """

    primitive: dict[str, Any]
    place: Place
    matrix: F64
    node: dict[str, Any]
    node_place: Place


@dataclass(frozen=True)
class GltfFile:
    """A file whose JSON was read.

    Attributes:
        path: of it; buffers in files of their own stand in its folder.
        root: the JSON.
        binary: the chunk BIN, if there is one.
        tail: bytes behind the end that a .glb declares.
        short: of buffers that were looked at and are shorter than they say, how much.
    """

    path: Path
    root: dict[str, Any]
    binary: memoryview | None
    tail: int = 0
    short: dict[int, str] = field(default_factory=dict)
    _buffers: dict[int, memoryview] = field(default_factory=dict)

    def wrong(self, place: Place, wrong: str) -> InputError:
        """The error that says what is wrong where."""
        return InputError(f"{self.path.name}, {'/'.join(map(str, place))}: {wrong}")

    def get(
        self, holder: dict[str, Any], place: Place, key: str, kind: type | tuple[type, ...], default: Any = None
    ) -> Any:
        """A member of a JSON object, or `default` where it is absent.

        Raises:
            InputError: it is of another kind.
        """
        value = holder.get(key, default)
        if value is not default and (not isinstance(value, kind) or (type(value) is bool) != (kind is bool)):
            raise self.wrong((*place, key), f"found {_shown(value)}")
        return value

    def whole(self, holder: dict[str, Any], place: Place, key: str, default: int | None = None) -> int:
        """A whole number of at least 0, which has to be there without a default.

        Raises:
            InputError: it is none.
        """
        value: Any = self.get(holder, place, key, int, default)
        if value is None or not 0 <= value < 1 << 53:
            raise self.wrong((*place, key), f"found {_shown(value)}, wanted a whole number")
        number: int = value
        return number

    def item(self, key: str, index: object) -> dict[str, Any]:
        """An object of one of the file's lists.

        Raises:
            InputError: there is no such.
        """
        values = self.root.get(key)
        if isinstance(values, list) and isinstance(index, int) and 0 <= index < len(values):
            found = values[index]
            if isinstance(found, dict):
                return found
        raise self.wrong((key, _shown(index)), "there is none")

    def accessor(self, index: object, width: int) -> Accessor:
        """Numbers in rows of `width`.

        Raises:
            InputError: they are not there, or not so.
        """
        said = self.item("accessors", index)
        place = ("accessors", _shown(index))
        dtype, kind = _DTYPES.get(self.whole(said, place, "componentType")), self.get(said, place, "type", str)
        if dtype is None or _WIDTHS.get(kind) != width:
            raise self.wrong(place, f"found {_shown(kind)} of {said['componentType']}, wanted {width} numbers")
        if "sparse" in said or "bufferView" not in said:
            what = "sparse accessors are not read" if "sparse" in said else "it has no bufferView: an extension has it"
            raise self.wrong(place, what)
        count, offset = self.whole(said, place, "count"), self.whole(said, place, "byteOffset", 0)
        data, stride = self.view(said["bufferView"])
        size = np.dtype(dtype).itemsize * width
        stride = stride or size
        if stride < size:
            raise self.wrong(place, f"rows of {size} bytes every {stride}")
        if offset + stride * (count - 1) + size > len(data) and count:
            raise self.wrong(place, f"{counted(count, 'row')} of {size} bytes, and {len(data)} bytes are there")
        rows: NDArray[Any] = np.zeros((0, width), dtype)
        if count:
            rows = np.ndarray((count, width), dtype, data, offset, (stride, size // width))
        return Accessor(rows, self.get(said, place, "normalized", bool, False))

    def view(self, index: object) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and how far apart its rows are, 0: no further than they are long."""
        said, place = self.item("bufferViews", index), ("bufferViews", _shown(index))
        if said.get("extensions"):
            raise self.wrong(
                (*place, "extensions"),
                f"{_names(said['extensions'])}: packed buffers are not read, gltf-transform unpacks them",
            )
        buffer = self._buffer(self.whole(said, place, "buffer"))
        start, length = self.whole(said, place, "byteOffset", 0), self.whole(said, place, "byteLength")
        if start + length > len(buffer):
            short = ": the file is truncated" if said["buffer"] in self.short else ""
            raise self.wrong(place, f"bytes {start} to {start + length} of a buffer of {len(buffer)}{short}")
        return buffer[start : start + length], self.whole(said, place, "byteStride", 0)

    def _buffer(self, index: int) -> memoryview:
        if index not in self._buffers:
            said, place = self.item("buffers", index), ("buffers", index)
            uri, length = self.get(said, place, "uri", str), self.whole(said, place, "byteLength")
            if uri is not None:
                data = self._fetched(uri, (*place, "uri"))
            elif index == 0 and self.binary is not None:
                data = self.binary
            else:
                raise self.wrong(place, "there are no bytes of it")
            if length > len(data):  # what is used of it may be there all the same
                self.short[index] = f"found {len(data):,} bytes, wanted {length:,}"
            self._buffers[index] = data[:length]
        return self._buffers[index]

    def _fetched(self, uri: str, place: Place) -> memoryview:
        if uri.startswith("data:"):
            kind, _, text = uri.partition(",")
            if not kind.endswith(";base64"):
                raise self.wrong(place, "wanted a data URI in base64")
            try:
                return memoryview(base64.b64decode(text, validate=True))
            except (binascii.Error, ValueError) as error:
                raise self.wrong(place, f"no base64: {error}") from None
        folder = self.path.resolve().parent
        name = unquote(uri)
        if "\\" in name and not (folder / name).exists():  # written on Windows
            name = name.replace("\\", "/")
        if not name.isprintable() or ":" in name or "\\" in name:
            raise self.wrong(place, f"found {_shown(uri)}, wanted a file beside it")
        try:
            target = (folder / name).resolve()
            if not target.is_relative_to(folder):  # neither .., nor absolute, nor by a link
                raise self.wrong(place, f"{_shown(uri)} is outside of the folder of {self.path.name}")
            if not target.is_file():
                same = [path.name for path in folder.iterdir() if path.name.casefold() == target.name.casefold()]
                hint = f", but {_shown(same[0])}: rename it" if same else ""
                raise self.wrong(place, f"there is no file {_shown(uri)}{hint}")
            data = memoryview(mapped(target))
        except (OSError, RuntimeError) as error:  # the latter of links in a circle
            raise self.wrong(place, f"{_shown(uri)} cannot be read: {error}") from None
        if instead := stand_in(bytes(data[:64])):
            raise self.wrong(place, f"{_shown(uri)} is {instead}")
        return data

    def size(self) -> int:
        """Bytes of all buffers that were looked at."""
        return sum(map(len, self._buffers.values()))

    def placed(self) -> Iterator[Placed]:
        """All primitives that the scene shows, in the order of its nodes.

        Raises:
            InputError: nodes are missing, or have several parents.
        """
        nodes = self._list(self.root, (), "nodes")
        if "scenes" in self.root:
            index = self.whole(self.root, (), "scene", 0)
            roots = self._list(self.item("scenes", index), ("scenes", index), "nodes")
        else:
            children = [child for node in nodes if isinstance(node, dict) for child in _listed(node.get("children"))]
            below = {child for child in children if isinstance(child, int)}
            roots = [index for index in range(len(nodes)) if index not in below]
        seen: set[int] = set()
        shown = 0
        stack = [(index, np.eye(4)) for index in reversed(roots)]
        while stack:
            index, above = stack.pop()
            node, place = self.item("nodes", index), ("nodes", _shown(index))
            if _extension(node, "KHR_node_visibility").get("visible") is False:
                continue
            if index in seen:
                raise self.wrong(place, "it has more than one parent")
            seen.add(index)
            with np.errstate(all="ignore"):
                matrix = above @ self._transform(node, place)
            stack += [(child, matrix) for child in reversed(self._list(node, place, "children"))]
            if "mesh" in node:
                mesh = self.item("meshes", node["mesh"])
                for at, primitive in enumerate(self._list(mesh, ("meshes", node["mesh"]), "primitives")):
                    spot = ("meshes", node["mesh"], "primitives", at)
                    shown += 1
                    if not isinstance(primitive, dict) or shown > _MOST_PRIMITIVES:
                        raise self.wrong(spot, f"found {_shown(primitive)}, number {shown} of those that are shown")
                    yield Placed(primitive, spot, matrix, node, place)

    def other_scenes(self) -> str:
        """Name the scenes that `placed` leaves out although no default scene is set; "" if there are none."""
        scenes = self.root.get("scenes")
        if not isinstance(scenes, list) or len(scenes) < 2 or "scene" in self.root:
            return ""
        names = [one.get("name") if isinstance(one, dict) else None for one in scenes]
        said = [f"{index}{f' ({_shown(name)})' if name else ''}" for index, name in enumerate(names)]
        shown = ", ".join(said[1:4]) + (", ..." if len(said) > 4 else "")
        return f"{len(scenes)} scenes and no default: scene {said[0]} is read, {shown} not"

    def instances(self, placed: Placed) -> NDArray[np.float64]:
        """Matrices to the world [I, 4, 4] of a primitive: one, or those of EXT_mesh_gpu_instancing."""
        said = _extension(placed.node, _INSTANCING)
        if not said:
            return placed.matrix[None]
        place = (*placed.node_place, "extensions", _INSTANCING)
        attributes = self.get(said, place, "attributes", dict, {})
        widths = {"TRANSLATION": 3, "ROTATION": 4, "SCALE": 3}
        rows = {name: self.accessor(attributes[name], width) for name, width in widths.items() if name in attributes}
        counts = {len(one.rows) for one in rows.values()}
        if len(counts) != 1:
            raise self.wrong(place, f"its attributes have {sorted(counts)} rows, wanted one number of instances")
        values = {name: one.values(slice(None)).astype(np.float64) for name, one in rows.items()}
        matrices = np.tile(np.eye(4), (counts.pop(), 1, 1))
        for index, quat in enumerate(values.get("ROTATION", ())):
            matrices[index, :3, :3] = self._rotation(quat.tolist(), (*place, "attributes", "ROTATION"))
        matrices[:, :3, :3] *= values.get("SCALE", np.ones((len(matrices), 3)))[:, None]
        matrices[:, :3, 3] = values.get("TRANSLATION", 0.0)
        found: NDArray[np.float64] = placed.matrix @ matrices
        return found

    def _list(self, holder: dict[str, Any], place: Place, key: str) -> list[Any]:
        values: list[Any] = self.get(holder, place, key, list, [])
        return values

    def _transform(self, node: dict[str, Any], place: Place) -> F64:
        if "matrix" in node:
            return self._numbers(node, place, "matrix", np.eye(4).ravel()).reshape(4, 4).T
        matrix = np.eye(4)
        quat = self._numbers(node, place, "rotation", (0.0, 0.0, 0.0, 1.0)).tolist()
        matrix[:3, :3] = self._rotation(quat, (*place, "rotation"))
        matrix[:3, :3] *= self._numbers(node, place, "scale", (1.0, 1.0, 1.0))
        matrix[:3, 3] = self._numbers(node, place, "translation", _NO_TRANSLATION)
        return matrix

    def _rotation(self, quat: list[float], place: Place) -> list[list[float]]:
        length = math.hypot(*quat)
        if not 0.0 < length < math.inf:
            raise self.wrong(place, "wanted a unit quaternion")
        x, y, z, w = (one / length for one in quat)
        return [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]

    def _numbers(self, holder: dict[str, Any], place: Place, key: str, default: Any) -> F64:
        values = holder.get(key, list(default))
        good = isinstance(values, list) and len(values) == len(default)
        if not good or not all(type(value) in (int, float) and abs(value) < 1e300 for value in values):
            raise self.wrong((*place, key), f"found {_shown(values)}, wanted {len(default)} numbers")
        return np.array(values, np.float64)


def opened(path: Path) -> GltfFile:
    """Read the JSON of a .glb or .gltf.

    Raises:
        InputError: it is none, not whole, or of another version.
        OSError: it cannot be read.
    """
    data = memoryview(mapped(path))
    text, binary, tail = _chunks(path, data) if data[:4] == MAGIC else (data, None, 0)
    try:
        root = json.loads(bytes(text))  # UTF-8, with or without a mark, or UTF-16
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path.name}: its JSON cannot be read: {error}") from None
    if not isinstance(root, dict) or not isinstance(root.get("asset"), dict):
        raise InputError(f"{path.name} is no glTF: its JSON has no asset")
    version = root["asset"].get("version")
    if not isinstance(version, str) or version.partition(".")[0] != str(_VERSION):
        raise InputError(f"{path.name} is glTF {_shown(version)}, wanted {_VERSION}.0")
    return GltfFile(path, root, binary, tail)


def _chunks(path: Path, data: memoryview) -> tuple[memoryview, memoryview | None, int]:
    """The chunks JSON and BIN of a .glb, and the number of bytes behind its end."""
    if len(data) < GLB_HEAD.size:
        raise InputError(f"{path.name} is truncated: {counted(len(data), 'byte')}")
    _, version, size = GLB_HEAD.unpack_from(data)
    if version != _VERSION:
        raise InputError(f"{path.name} is binary glTF {version}, wanted {_VERSION}")
    if size > len(data):
        raise InputError(f"{path.name} is truncated: found {len(data)} bytes, wanted {size}")
    found: list[tuple[bytes, memoryview]] = []
    at = GLB_HEAD.size
    while at + _CHUNK_HEAD.size <= size and len(found) < 2:  # others may follow, and mean nothing here
        length, kind = _CHUNK_HEAD.unpack_from(data, at)
        at += _CHUNK_HEAD.size
        if length > size - at:
            raise InputError(
                f"{path.name}, byte {at - _CHUNK_HEAD.size}: a chunk of {length} bytes, {size - at} are left"
            )
        found.append((kind, data[at : at + length]))
        at += length
    if not found or found[0][0] != JSON:
        raise InputError(f"{path.name} does not begin with its JSON")
    binary = found[1][1] if len(found) > 1 and found[1][0] == BIN else None
    return found[0][1], binary, len(data) - size


def _extension(holder: dict[str, Any], name: str) -> dict[str, Any]:
    """An extension object, empty where there is none."""
    extensions = holder.get("extensions")
    said = extensions.get(name) if isinstance(extensions, dict) else None
    return said if isinstance(said, dict) else {}


def _listed(value: object) -> list[Any]:
    return value if isinstance(value, list) else []


def _names(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, dict) else _shown(value)


def _shown(value: object) -> str:
    """A value of the JSON, cut for messages."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
