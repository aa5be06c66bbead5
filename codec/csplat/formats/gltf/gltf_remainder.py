# SPDX-License-Identifier: Apache-2.0
"""List the contents of a glTF other than the splats that are read.

Names of objects, the generator, and objects without contents count as nothing; so do accessors without values, which
stand for the attributes of splats in other forms.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from csplat.errors import counted
from csplat.formats.gltf.gltf_document import EXTENSION, INSTANCING, VISIBILITY, GltfDocument, PlacedPrimitive
from csplat.lint import list_names

#: Lists of a document whose objects are not splats, with the noun of one.
_OBJECTS = {
    "animations": "animation",
    "cameras": "camera",
    "skins": "skin",
    "materials": "material",
    "textures": "texture",
    "images": "image",
    "samplers": "sampler",
}
_ROOT = {"asset", "scene", "scenes", "nodes", "meshes", "accessors", "bufferViews", "buffers", "extensions", "extras"}
_ROOT |= {"extensionsUsed", "extensionsRequired", *_OBJECTS}
_ASSET = {"version", "minVersion", "generator", "copyright", "extras", "extensions"}
#: Members of KHR_gaussian_splatting. Its only way of sorting is by distance, which csplat uses, too.
_SPLATS = {"kernel", "colorSpace", "projection", "sortingMethod", "extensions", "extras"}
#: Members that hold indices of accessors, and members that hold objects or lists of such members' values.
_ACCESSORS, _ATTRIBUTES = {"indices", "input", "output", "inverseBindMatrices"}, {"attributes", "targets"}
_NOTHING: tuple[object, ...] = (None, {}, [], "")
_COMMENTS = "csplat"  # member of the extras of the asset, which `ply.comments` reads
_TRS = {"TRANSLATION", "ROTATION", "SCALE"}
_DEPTH = 64  # nesting of the JSON that is searched


@dataclass(frozen=True)
class ReadPrimitive:
    """A primitive of splats.

    Attributes:
        placed: the primitive.
        attributes: the names of its attributes that are read.
    """

    placed: PlacedPrimitive
    attributes: frozenset[str]


def list_remainder(
    document: GltfDocument, primitives: Sequence[ReadPrimitive], extensions: Sequence[str], *, comments: bool
) -> list[str]:
    """Describe what the reader leaves out, in a few words each.

    Args:
        document: the glTF.
        primitives: the primitives that are read.
        extensions: names of the extensions that are read.
        comments: the comments in the extras of the asset are read.
    """
    root = document.root
    parts = [*_meshes(document, primitives), *_scenes(root)]
    parts += [counted(number, noun) for key, noun in _OBJECTS.items() if (number := len(_objects(root, key)))]
    parts += _attributes(document, primitives)
    found = list(_members(root, (), 0))
    names = [
        name
        for _, key, value in found
        if key == "extensions" and isinstance(value, dict)
        for name in value
        if name not in extensions
    ]
    parts += [f"extensions {list_names(sorted(set(names)))}"] if names else []
    hidden = [path for path, key, value in found if (key, value) == ("visible", False) and VISIBILITY in path]
    parts += [counted(len(hidden), "hidden node")] if hidden else []
    extras = [path for path, key, value in found if key == "extras" and _holds_extras(path, value, comments=comments)]
    parts += [f"extras of {list_names(['/'.join(path) or 'the document' for path in extras])}"] if extras else []
    asset = root["asset"]
    other = [key for key, value in root.items() if key not in _ROOT and value not in _NOTHING]
    other += [f"asset {key}" for key, value in asset.items() if key not in _ASSET and value not in _NOTHING]
    if not isinstance(asset.get("copyright", ""), str):
        other.append("asset copyright")
    other += [
        f"{EXTENSION} {key}"
        for path, key, _ in found
        if path and path[-1] == EXTENSION and key not in _SPLATS and "primitives" in path
    ]
    parts += [f"members {list_names(other)}"] if other else []
    parts += [f"chunks {list_names(document.chunks)}"] if document.chunks else []
    return [*parts, *_unused(root, found), *_after_buffer(document)]


def _meshes(document: GltfDocument, primitives: Sequence[ReadPrimitive]) -> Iterator[str]:
    """Describe the meshes with primitives that are not read."""
    read = {one.placed.json_path for one in primitives}
    plain = splats = 0
    for index, mesh in enumerate(_objects(document.root, "meshes")):
        rest = [
            primitive
            for at, primitive in enumerate(_list(mesh, "primitives"))
            if ("meshes", index, "primitives", at) not in read and _has_rows(document, primitive)
        ]
        extensions = [primitive.get("extensions") for primitive in rest]
        of_splats = {isinstance(one, dict) and EXTENSION in one for one in extensions}
        splats += True in of_splats
        plain += False in of_splats
    if plain:
        yield counted(plain, "mesh", "meshes")
    if splats:
        yield f"{counted(splats, 'mesh', 'meshes')} of splats that the scene does not show"
    if any(_list(one.placed.primitive, "targets") for one in primitives):
        yield "morph targets"


def _has_rows(document: GltfDocument, primitive: object) -> bool:
    """Return True unless the positions of a primitive are absent or have no rows."""
    attributes = primitive.get("attributes") if isinstance(primitive, dict) else None
    if not isinstance(attributes, dict):
        return False
    accessors, index = _list(document.root, "accessors"), attributes.get("POSITION")
    if not (isinstance(index, int) and 0 <= index < len(accessors) and isinstance(accessors[index], dict)):
        return True
    return bool(accessors[index].get("count") != 0)


def _scenes(root: dict[str, Any]) -> Iterator[str]:
    """Describe the scenes with nodes that are not read if the document names a default scene; others have a finding."""
    scenes = _objects(root, "scenes")
    if "scene" in root and (
        others := [one for at, one in enumerate(scenes) if at != root["scene"] and one.get("nodes")]
    ):
        yield counted(len(others), "other scene")


def _attributes(document: GltfDocument, primitives: Sequence[ReadPrimitive]) -> Iterator[str]:
    """Describe the attributes with values that are not read."""
    names: dict[str, None] = {}
    instances: dict[str, None] = {}
    for one in primitives:
        attributes = one.placed.primitive.get("attributes")
        for name, index in attributes.items() if isinstance(attributes, dict) else ():
            if name not in one.attributes and _has_values(document, index):
                names[name] = None
        extensions = one.placed.node.get("extensions")
        instancing = extensions.get(INSTANCING) if isinstance(extensions, dict) else None
        of_instances = instancing.get("attributes") if isinstance(instancing, dict) else None
        instances |= dict.fromkeys(set(of_instances) - _TRS) if isinstance(of_instances, dict) else {}
    if names:
        yield f"attributes {list_names(list(names))}"
    if instances:
        yield f"attributes {list_names(sorted(instances))} of instances"


def _has_values(document: GltfDocument, index: object) -> bool:
    """Return True unless an accessor exists that stands for zeros."""
    accessors = _list(document.root, "accessors")
    if not (isinstance(index, int) and 0 <= index < len(accessors) and isinstance(accessors[index], dict)):
        return True
    return "bufferView" in accessors[index] or "sparse" in accessors[index]


def _unused(root: dict[str, Any], found: Sequence[tuple[tuple[str, ...], str, Any]]) -> Iterator[str]:
    """Describe accessors, buffer views and buffers to which nothing refers."""
    accessors = {value for _, key, value in found if key in _ACCESSORS and isinstance(value, int)}
    for path, _, value in found:
        if _ATTRIBUTES.intersection(path[-2:]) and isinstance(value, int):
            accessors.add(value)
    views = {value for _, key, value in found if key == "bufferView" and isinstance(value, int)}
    buffers = {value for _, key, value in found if key == "buffer" and isinstance(value, int)}
    for key, noun, used in (
        ("accessors", "accessor", accessors),
        ("bufferViews", "buffer view", views),
        ("buffers", "buffer", buffers),
    ):
        if unused := len(_list(root, key)) - len(used & set(range(len(_list(root, key))))):
            yield f"{counted(unused, noun)} to which nothing refers"


def _after_buffer(document: GltfDocument) -> Iterator[str]:
    """Describe bytes of the chunk BIN after the buffer in it, except for zeros, which pad it."""
    buffers = _objects(document.root, "buffers")
    length = buffers[0].get("byteLength") if buffers and "uri" not in buffers[0] else 0
    if (
        document.binary is not None
        and isinstance(length, int)
        and any(rest := bytes(document.binary[max(length, 0) :]))
    ):
        yield f"{counted(len(rest), 'byte')} after the buffer"


def _members(value: object, json_path: tuple[str, ...], depth: int) -> Iterator[tuple[tuple[str, ...], str, Any]]:
    """Yield all members of objects with their path in the JSON, except within extras."""
    if depth > _DEPTH:
        return
    items: Any = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inside in items:
        yield json_path, str(key), inside
        if key != "extras" and isinstance(inside, dict | list):
            yield from _members(inside, (*json_path, str(key)), depth + 1)


def _holds_extras(json_path: tuple[str, ...], value: Any, *, comments: bool) -> bool:
    """Return True if extras hold anything that is not read."""
    if json_path == ("asset",) and comments and isinstance(value, dict):
        value = {key: inside for key, inside in value.items() if key != _COMMENTS}
    return value not in _NOTHING


def _list(holder: object, key: str) -> list[Any]:
    """Return a member that is a list, otherwise an empty list."""
    value = holder.get(key) if isinstance(holder, dict) else None
    return value if isinstance(value, list) else []


def _objects(root: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """Return the objects of a top-level list."""
    return [one if isinstance(one, dict) else {} for one in _list(root, key)]
