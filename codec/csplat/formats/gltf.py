"""glTF 2.0 with the extension KHR_gaussian_splatting (release candidate of 2026): .glb, and .gltf with its buffers.

glTF says that y is up, that z is where a model looks, and that its right hand is at -x: LUF. What it has no place for
stands in `asset.extras.csplat`, in the lines that a PLY has as comments. An origin is the translation of the node.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError, counted
from csplat.files import atomic_writer
from csplat.formats.format import Format
from csplat.formats.gltf_file import BIN, GLB_HEAD, JSON, MAGIC, Accessor, GltfFile, Placed, opened
from csplat.model import F32, SplatModel, normalise_quats
from csplat.ply_comments import SceneFacts, format_comments, parse_comments
from csplat.scene import BLOCK, Scene
from csplat.turning import in_axes, scaled, stretched

__all__ = ["FORMAT"]

F64 = NDArray[np.float64]

_AXES = "LUF"
_EXTENSION = "KHR_gaussian_splatting"
_UNDERSTOOD = {_EXTENSION, "KHR_mesh_quantization"}
_COLOURS = "srgb_rec709_display"  # linear ones no SH hold that are read as sRGB
_SH_C0 = 0.28209479177387814
_FLOAT, _BYTE, _ARRAY_BUFFER = 5126, 5121, 34962
_LARGEST_FILE = (1 << 32) - 1  # of a .glb: its length is a u32
_THINNEST = np.float32(np.finfo(np.float32).tiny)  # what a scale of 0 is read as: its logarithm is finite
_FAR = 4096.0  # a translation as large as that stays an origin: float32 would have less than half a thousandth left


@dataclass(frozen=True)
class _Part:
    """A primitive of splats.

    Attributes:
        arrays: by their names in glTF, without prefixes.
        degree: of its SH.
        linear: what the node does to directions and lengths, [3, 3].
        translation: where the node is, [3].
    """

    arrays: dict[str, Accessor]
    count: int
    degree: int
    linear: F64
    translation: F64


@contextmanager
def _open(path: Path) -> Iterator[Scene]:
    file = opened(path)
    _check_extensions(file)
    parts = [_part(file, placed) for placed in file.placed() if _extended(file, placed)]
    if not parts:
        raise InputError(f"{path.name} shows no splats: no mesh of its scene has {_EXTENSION}")
    count = sum(part.count for part in parts)
    if count > file.size():  # nodes may show one mesh many times
        raise InputError(f"{path.name} shows {counted(count, 'splat')}, which is more than it has bytes")
    degree = max(part.degree for part in parts)
    try:
        said = _said(file)
        origin = np.array(said.origin or (0.0, 0.0, 0.0))
        if said.origin is None and np.abs(parts[0].translation).max() >= _FAR:
            origin = parts[0].translation
        x, y, z = origin.tolist()
        nothing = _block(parts[0], slice(0, 0), degree)
        facts = replace(nothing, origin=(x, y, z), **{**said.fields(), "coordinate_system": _AXES})
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None

    def blocks() -> Iterator[SplatModel]:
        for part in parts:
            for start in range(0, part.count, BLOCK):
                rows = slice(start, min(start + BLOCK, part.count))
                try:
                    yield _placed(_block(part, rows, degree), part, facts)
                except InputError as error:
                    raise InputError(f"{path.name}, splats {rows.start} to {rows.stop - 1}: {error}") from None

    yield Scene(count, facts, blocks)


def _check_extensions(file: GltfFile) -> None:
    wanted = file.get(file.root, (), "extensionsRequired", list, [])
    unknown = [str(name) for name in wanted if str(name) not in _UNDERSTOOD]
    if unknown:
        raise file.wrong(("extensionsRequired",), f"{', '.join(unknown)} is not understood")


def _extended(file: GltfFile, placed: Placed) -> bool:
    """Whether a primitive is of splats, which has to be such as is read here."""
    place = (*placed.place, "extensions")
    extensions = file.get(placed.primitive, placed.place, "extensions", dict, {})
    said = file.get(extensions, place, _EXTENSION, dict)
    if said is None:
        return False
    place = (*place, _EXTENSION)
    if file.get(said, place, "extensions", dict, {}):
        raise file.wrong((*place, "extensions"), f"{', '.join(said['extensions'])} is not understood")
    for key, known in (("kernel", {"ellipse"}), ("colorSpace", {_COLOURS}), ("projection", {"perspective", None})):
        if file.get(said, place, key, str) not in known:
            raise file.wrong((*place, key), f"found {said.get(key)!r}, which is not understood")
    return True


def _part(file: GltfFile, placed: Placed) -> _Part:
    place = (*placed.place, "attributes")
    attributes = file.get(placed.primitive, placed.place, "attributes", dict, {})

    def array(name: str, width: int) -> Accessor:
        key = name if name == "POSITION" else f"{_EXTENSION}:{name}"
        if key not in attributes:
            raise file.wrong(place, f"there is no {key}")
        return file.accessor(attributes[key], width)

    widths = {"POSITION": 3, "ROTATION": 4, "SCALE": 3, "OPACITY": 1, **dict.fromkeys(_sh_names(0), 3)}
    degree = 0
    while degree < 3 and any(f"{_EXTENSION}:{name}" in attributes for name in _sh_names(degree + 1)):
        degree += 1
        widths |= dict.fromkeys(_sh_names(degree), 3)
    arrays = {name: array(name, width) for name, width in widths.items()}
    count = len(arrays["POSITION"].rows)
    for name, accessor in arrays.items():
        if len(accessor.rows) != count:
            raise file.wrong(place, f"{name} has {len(accessor.rows)} rows, POSITION {count}")
    linear, translation = placed.matrix[:3, :3], placed.matrix[:3, 3]
    with np.errstate(all="ignore"):
        lengths = np.linalg.svd(linear)[1] if np.isfinite(placed.matrix).all() else np.zeros(3)
    if not 1e-30 < lengths.max() < 1e30 or lengths.min() < 1e-9 * lengths.max():
        raise file.wrong(placed.place, "the node that shows it flattens it, or leaves float32")
    return _Part(arrays, count, degree, linear, translation)


def _sh_names(degree: int) -> list[str]:
    return [f"SH_DEGREE_{degree}_COEF_{index}" for index in range(2 * degree + 1)]


def _block(part: _Part, rows: slice, degree: int) -> SplatModel:
    """Some splats as their node has them."""
    values = {name: accessor.values(rows) for name, accessor in part.arrays.items()}
    quats = values["ROTATION"][:, [3, 0, 1, 2]]
    if not np.isfinite(quats).all():
        raise InputError("rotations hold values that are NaN or infinite")
    shN = np.zeros((len(quats), (degree + 1) ** 2 - 1, 3), np.float32)
    names = [name for band in range(1, part.degree + 1) for name in _sh_names(band)]
    for index, name in enumerate(names):
        shN[:, index] = values[name]
    return SplatModel(
        means=values["POSITION"],
        quats=normalise_quats(quats),
        scales=np.log(np.maximum(np.abs(values["SCALE"]), _THINNEST)),
        opacities=np.clip(values["OPACITY"][:, 0], 0.0, 1.0),
        sh0=values["SH_DEGREE_0_COEF_0"],
        shN=shN,
    )


def _placed(block: SplatModel, part: _Part, facts: SplatModel) -> SplatModel:
    """Some splats as the scene has them."""
    if not np.array_equal(part.linear, np.eye(3)):
        block = stretched(block, part.linear)
    offset = part.translation - np.array(facts.origin)
    if offset.any():
        with np.errstate(over="ignore"):
            block = replace(block, means=(block.means.astype(np.float64) + offset).astype(np.float32))
    fields = ("origin", "coordinate_system", "unit_metres", "antialiased", "flat", "metadata")
    return replace(block, **{name: getattr(facts, name) for name in fields})


def _said(file: GltfFile) -> SceneFacts:
    """What the file says of the scene beyond its splats."""
    extras = file.root["asset"].get("extras")
    lines = extras.get("csplat", []) if isinstance(extras, dict) else []
    if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
        raise InputError("asset/extras/csplat: wanted lines of text")
    said = parse_comments(lines)
    holder = file.root["asset"].get("copyright")
    if isinstance(holder, str):
        said.metadata.setdefault("licence", holder)
    return said


def _write(path: Path, scene: Scene) -> None:
    if path.suffix.lower() == ".gltf":
        raise InputError(f"{path.name}: glTF is written as one file, name it {path.with_suffix('.glb').name}")
    if not scene.count:
        raise InputError(f"{path.name}: the scene has no splats, and glTF has no empty meshes")
    unit = scene.facts.unit_metres
    if unit not in (None, 1.0):
        before, metres = scene, float(unit)
        scene = Scene(
            scene.count, scaled(scene.facts, metres), lambda: (scaled(one, metres) for one in before.blocks())
        )
    scene = in_axes(scene, _AXES)
    columns = _columns(scene.facts.sh_degree)
    lowest, highest = np.full(3, np.inf), np.full(3, -np.inf)
    for block in scene.blocks():
        lowest = np.minimum(lowest, block.means.min(axis=0, initial=np.inf))
        highest = np.maximum(highest, block.means.max(axis=0, initial=-np.inf))
    offsets = np.cumsum([0, *(column.row_size * scene.count for column in columns)]).tolist()
    text = json.dumps(_json(scene, columns, offsets, (lowest, highest)), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    start = GLB_HEAD.size + 8 + len(text) + 8
    if start + offsets[-1] > _LARGEST_FILE:
        raise InputError(
            f"{path.name} would have {start + offsets[-1]:,} bytes, and a .glb has at most {_LARGEST_FILE:,}:"
            f" write fewer splats, or fewer SH bands"
        )
    with atomic_writer(path) as stream:
        stream.write(GLB_HEAD.pack(MAGIC, 2, start + offsets[-1]) + struct.pack("<I4s", len(text), JSON) + text)
        stream.write(struct.pack("<I4s", offsets[-1], BIN))
        done = 0
        for block in scene.blocks():
            rows = _rows(block)
            for column, offset in zip(columns, offsets, strict=False):
                stream.seek(start + offset + done * column.row_size)
                stream.write(np.ascontiguousarray(rows[column.name]).view(np.uint8).data)
            done += len(block)


@dataclass(frozen=True)
class _Column:
    """One attribute as it is written."""

    name: str
    width: int
    component: int = _FLOAT

    @property
    def row_size(self) -> int:
        return self.width * (4 if self.component == _FLOAT else 1)


def _columns(degree: int) -> list[_Column]:
    names = [name for band in range(degree + 1) for name in _sh_names(band)]
    first = [_Column("POSITION", 3), _Column("ROTATION", 4), _Column("SCALE", 3), _Column("OPACITY", 1)]
    return [*first, _Column("COLOR_0", 4, _BYTE), *(_Column(name, 3) for name in names)]


def _rows(model: SplatModel) -> dict[str, NDArray[Any]]:
    """All attributes of some splats."""
    with np.errstate(over="ignore", under="ignore"):
        scales = np.exp(model.scales.astype(np.float64))
    names = [name for band in range(1, model.sh_degree + 1) for name in _sh_names(band)]
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
    """What programs show that know points alone: linear colour, alpha."""
    srgb = np.clip(model.sh0 * np.float32(_SH_C0) + np.float32(0.5), 0.0, 1.0)
    linear: F32 = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.rint(255.0 * np.concatenate([linear, model.opacities[:, None]], axis=1)).astype(np.uint8)


def _json(scene: Scene, columns: list[_Column], offsets: list[int], bounds: tuple[F64, F64]) -> dict[str, Any]:
    facts = scene.facts
    asset: dict[str, Any] = {"version": "2.0", "generator": "csplat"}
    lines = format_comments(facts, absolute=False)
    licence = facts.metadata.get("licence")
    if isinstance(licence, str):
        asset["copyright"] = licence
    kinds = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
    accessors: list[dict[str, Any]] = [
        {"bufferView": index, "componentType": column.component, "count": scene.count, "type": kinds[column.width]}
        for index, column in enumerate(columns)
    ]
    accessors[0] |= {"min": bounds[0].tolist(), "max": bounds[1].tolist()}
    plain = ("POSITION", "COLOR_0")
    for index, column in enumerate(columns):
        if column.component == _BYTE:
            accessors[index]["normalized"] = True
    names = [column.name if column.name in plain else f"{_EXTENSION}:{column.name}" for column in columns]
    splats = {"kernel": "ellipse", "colorSpace": _COLOURS}
    primitive = {
        "attributes": {name: index for index, name in enumerate(names)},
        "mode": 0,
        "extensions": {_EXTENSION: splats},
    }
    return {
        "asset": {**asset, "extras": {"csplat": lines}},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **({"translation": list(facts.origin)} if any(facts.origin) else {})}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": stop - start, "target": _ARRAY_BUFFER}
            for start, stop in pairwise(offsets)
        ],
        "buffers": [{"byteLength": offsets[-1]}],
    }


FORMAT = Format(
    name="gltf",
    title="glTF",
    suffixes=(".glb", ".gltf"),
    sniff=lambda _path, head: head.startswith(MAGIC),
    open=_open,
    write=_write,
    axes=_AXES,
    exact=frozenset({"means", "quats", "opacities", "sh0", "shN"}),
    splat_bytes=(60.0, 96.0, 156.0, 240.0),
    carries=frozenset({"antialiased", "origin", "coordinate_system", "unit_metres", "flat", "metadata"}),
)
