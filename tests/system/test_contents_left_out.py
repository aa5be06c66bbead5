# SPDX-License-Identifier: Apache-2.0
"""Everything that a file holds is converted or listed as lost: a part of each kind, in each format.

Also: csplat.formats.gltf.gltf_remainder.
"""

import gzip
import io
import json
import re
import struct
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import call, invoke
from formats_cases import zip_of
from models import with_facts
from tables import failures

import csplat
from csplat.formats import write_levels
from csplat.interop import to_gsplat
from csplat.scene import Scene
from csplat_conformance.manifest import VECTORS

pytest.importorskip("PIL", reason="SOG is images")

GUIDE = Path(__file__).parents[2] / "tools" / "docs" / "guide" / "formats.md"
COUNT = 40
PREFIX = "KHR_gaussian_splatting"
CHECKPOINT = Path(__file__).parents[1] / "helpers" / "checkpoints" / "gsplat.pt"
LEVELS = VECTORS / "valid" / "levels_of_the_rich_scene.csplat"


def written(name, model):
    """Return the bytes of a model in the format of a file name."""
    with TemporaryDirectory() as folder:
        csplat.write(Path(folder) / name, model)
        return (Path(folder) / name).read_bytes()


# PLY: changes of the lines of the header, and of the rows


def ply(model, *, columns=(), values=None, elements=(), tail=b"", comments=(), kinds=None, edit=lambda data: data):
    """Return a binary PLY of a model with further columns, elements, comments, and bytes after its rows.

    `columns` are lines `float name`, with `values` as bytes of each row; `kinds` replaces types of columns.
    """
    head, _, rows = written("a.ply", model).partition(b"end_header\n")
    width = len(rows) // COUNT
    lines = head.decode().splitlines()
    if kinds:
        names = [line.split()[2] for line in lines if line.startswith("property")]
        dtype = np.dtype([(name, "<f8" if name in kinds else "<f4") for name in names])
        table = np.frombuffer(rows, np.dtype([(name, "<f4") for name in names])).astype(dtype)
        for name in kinds:
            table[name] += 1e-12
        lines = [line.replace("float", "double") if line.split()[-1] in kinds else line for line in lines]
        rows, width = table.tobytes(), dtype.itemsize
    values = values or [b""] * COUNT
    rows = b"".join(rows[at * width : (at + 1) * width] + values[at] for at in range(COUNT))
    lines += [f"property {column}" for column in columns]
    comments = [b"comment " + one if isinstance(one, bytes) else one.encode() for one in comments]
    head = [line.encode() for line in [*lines, *elements]]
    text = b"\n".join([*head[:2], *comments, *head[2:], b"end_header\n"])
    return edit(text + rows + tail)


def with_normals(model, normals):
    """Return a PLY whose columns nx, ny and nz have these values [N, 3]."""
    head, _, rows = written("a.ply", model).partition(b"end_header\n")
    table = np.frombuffer(rows, "<f4").reshape(COUNT, -1).copy()
    table[:, 3:6] = normals
    return head + b"end_header\n" + table.tobytes()


def with_nan(model):
    head, _, rows = written("a.ply", model).partition(b"end_header\n")
    table = np.frombuffer(rows, "<f4").reshape(COUNT, -1).copy()
    table[3, 0] = np.nan
    return head + b"end_header\n" + table.tobytes()


def compressed(model, *, elements=(), column="", tail=b"", comments=()):
    """Return a compressed PLY with further elements, a column of the splats, comments, and bytes after its rows."""
    head, _, rows = written("a.compressed.ply", model).partition(b"end_header\n")
    if column:
        at = 4 * 18
        packed = [rows[at + 16 * row : at + 16 * row + 16] + bytes([row, 0, 0, 0]) for row in range(COUNT)]
        rows = rows[:at] + b"".join(packed) + rows[at + 16 * COUNT :]
        head = head.replace(b"property uint packed_color\n", b"property uint packed_color\nproperty uint %s\n" % column)
    lines = b"".join(line.encode() + b"\n" for line in (*comments, *elements))
    return head + lines + b"end_header\n" + rows + tail


# SPZ


def spz(model, *, version=3, flags=0, extensions=b"", reserved=b"", tail=b""):
    """Return an SPZ with further flags, extensions, reserved bytes of the header, and bytes after the splats."""
    data = bytearray(written("a.v4.spz" if version == 4 else "a.spz", model))
    if version < 4:
        data = bytearray(gzip.decompress(data))
        data[14] |= flags
        data[15] = reserved[0] if reserved else data[15]
        return gzip.compress(bytes(data) + extensions + tail)
    data[14] |= flags
    data[20 : 20 + len(reserved)] = reserved
    struct.pack_into("<I", data, 16, 32 + len(extensions))
    return bytes(data[:32]) + extensions + bytes(data[32:]) + tail


# SOG


def sog(model, *, keys=None, files=(), section=None):
    """Return a SOG with further keys of its JSON, or of its section `means`, and files in its zip."""
    with zipfile.ZipFile(io.BytesIO(written("a.sog", model))) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(members["meta.json"]) | (keys or {})
    meta["means"] |= section or {}
    return zip_of([*(members | {"meta.json": json.dumps(meta)} | dict(files)).items()])


def streamed(model, **files):
    """Return a zip of a streamed SOG with two levels, and further files."""
    with TemporaryDirectory() as folder:
        root = Path(folder) / "lod"
        write_levels(root / "lod-meta.json", [Scene.of(model), Scene.of(model.select(slice(0, 9)))])
        members = [(path.relative_to(root).as_posix(), path.read_bytes()) for path in root.rglob("*") if path.is_file()]
    return zip_of([*members, *files.items()])


# .ksplat


def ksplat(model, *, reserved=0, section=0, centre=0.0, spare=b"", tail=b""):
    head = bytearray(4096 + 1024)
    struct.pack_into("<BBxxIIIIHxx3fff", head, 0, 0, 1, 1, 1, COUNT, COUNT, 0, centre, 0, 0, -1.5, 1.5)
    struct.pack_into("<IIIIfHxxIIIIH", head, 4096, COUNT, COUNT + len(spare) // 44, 0, 0, 0, 12, 0, 0, 0, 0, 0)
    head[100], head[4096 + 100] = reserved, section
    rows = np.zeros(COUNT, [("means", "<f4", 3), ("scales", "<f4", 3), ("quats", "<f4", 4), ("colours", "u1", 4)])
    rows["means"], rows["scales"], rows["quats"] = model.means, np.exp(model.scales), model.quats
    rows["colours"] = 99
    return bytes(head) + rows.tobytes() + spare + tail


def splat(model, *, bad=False):
    rows = np.frombuffer(written("a.splat", model), "u1").reshape(COUNT, 32).copy()
    rows[5, :4] = np.frombuffer(np.float32(np.nan).tobytes(), "u1") if bad else rows[5, :4]
    return rows.tobytes()


# glTF: changes of the JSON, with columns of numbers appended to the buffer


def glb(model, change=lambda _root, _add: None, *, name="a.glb", chunk=b"", more=b"", tail=b""):
    """Return a .glb whose JSON `change` changes; it is called with it and a function that adds an accessor."""
    data = written(name, model)
    size = struct.unpack_from("<I", data, 12)[0]
    root, buffer = json.loads(data[20 : 20 + size]), bytearray(data[28 + size :])

    def add(values):
        values = np.ascontiguousarray(values, "<f4")
        width = values.shape[1] if values.ndim > 1 else 1
        root["bufferViews"].append({"buffer": 0, "byteOffset": len(buffer), "byteLength": values.nbytes})
        kind = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[width]
        root["accessors"].append({
            "bufferView": len(root["bufferViews"]) - 1, "componentType": 5126, "count": len(values), "type": kind
        })  # fmt: skip
        buffer.extend(values.tobytes())
        root["buffers"][0]["byteLength"] = len(buffer)
        return len(root["accessors"]) - 1

    change(root, add)
    text = json.dumps(root, ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    buffer += more
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    chunks += struct.pack("<I4s", len(chunk), b"MORE") + chunk if chunk else b""
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks + tail


def mesh(root, add):
    """Add a triangle in a node of the scene."""
    root["meshes"].append({"primitives": [{"attributes": {"POSITION": add(np.eye(3))}}]})
    root["nodes"].append({"mesh": len(root["meshes"]) - 1})
    root["scenes"][0]["nodes"].append(len(root["nodes"]) - 1)


def of_primitive(name, values):
    def change(root, add):
        root["meshes"][0]["primitives"][0]["attributes"][name] = add(values)

    return change


def animated(root, add):
    sampler = {"input": add(np.arange(2.0)), "output": add(np.zeros((2, 3)))}
    channel = {"sampler": 0, "target": {"node": 0, "path": "translation"}}
    root["animations"] = [{"samplers": [sampler], "channels": [channel]}]


def morphed(root, add):
    root["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": add(np.zeros((COUNT, 3)))}]


def instanced(root, add):
    attributes = {"TRANSLATION": add(np.ones((2, 3))), "_ID": add(np.arange(2.0))}
    root["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}


def hidden(root, add):
    mesh(root, add)
    root["nodes"][-1]["extensions"] = {"KHR_node_visibility": {"visible": False}}


def second_scene(root, add):
    mesh(root, add)
    root["scenes"].append({"nodes": [root["scenes"][0]["nodes"].pop()]})


def placed(path, **members):
    """Return a change that adds members to the object at a path of the JSON."""

    def change(root, _add):
        inside = root
        for key in path:
            inside = inside.setdefault(key, {}) if isinstance(inside, dict) else inside[key]
        inside |= members

    return change


FIRST = ("meshes", 0, "primitives", 0)
GLTF = {
    "mesh": (mesh, "1 mesh"),
    "hidden node": (hidden, "1 hidden node"),
    "other scene": (second_scene, "1 other scene"),
    "mesh outside the scene": (lambda root, add: (mesh(root, add), root["scenes"][0]["nodes"].pop()), "1 mesh"),
    "camera": (placed((), cameras=[{"type": "perspective"}]), "1 camera"),
    "light": (placed(("extensions",), KHR_lights_punctual={"lights": [{"type": "point"}]}), "KHR_lights_punctual"),
    "animation": (animated, "1 animation"),
    "skin": (placed((), skins=[{"joints": [0]}]), "1 skin"),
    "morph targets": (morphed, "morph targets"),
    "material": (placed((), materials=[{"doubleSided": True}]), "1 material"),
    "image": (placed((), images=[{"uri": "data:image/png;base64,AA=="}]), "1 image"),
    "attribute": (of_primitive("_FOO", np.ones((COUNT, 2))), "attributes _FOO"),
    "colours of points": (of_primitive("COLOR_0", np.zeros((COUNT, 4))), "attributes COLOR_0"),
    "normals that differ": (of_primitive("NORMAL", np.eye(COUNT, 3)), "attributes NORMAL"),
    "attribute of instances": (instanced, "attributes _ID of instances"),
    "extras": (placed(("nodes", 0), extras={"a": 1}), "extras of nodes/0"),
    "extras of the asset": (placed(("asset", "extras"), made="by hand"), "extras of asset"),
    "extension": (placed((*FIRST, "extensions"), EXT_foo={}), "extensions EXT_foo"),
    "extension of a node": (placed(("nodes", 0, "extensions"), EXT_foo={"a": 1}), "extensions EXT_foo"),
    "member": (placed((), foo=[1]), "members foo"),
    "accessor": (lambda _root, add: add(np.ones(5)), "1 accessor to which nothing refers"),
    "contradicting licence": (
        placed(("asset",), copyright="A", extras={"csplat": ["csplat licence B"]}), "the licence B, which"),
}  # fmt: skip
NOTHING = {
    "normals that are alike": of_primitive("NORMAL", np.ones((COUNT, 3))),
    "names": placed(("nodes", 0), name="floor"),
    "empty lists": placed((), cameras=[], animations=[]),
    "mesh without rows": lambda root, add: (mesh(root, add), root["accessors"][-1].update(count=0)),
    "generator": placed(("asset",), generator="another"),
}


# Checkpoints, as torch would load them


class PlainTensor(np.ndarray):
    """An array with the one tensor method that the reader calls."""

    def numel(self):
        return self.size


def tensor(values):
    return np.asarray(values, np.float32).view(PlainTensor)


def gsplat(model, beside=None, **tensors):
    splats = {name: tensor(values) for name, values in to_gsplat(model).items()}
    return {"splats": splats | {name: tensor(values) for name, values in tensors.items()}, **(beside or {})}


def inria(model, *behind, parts=("radii", "gradients", "denominator")):
    splats = to_gsplat(model)
    names = ("means", "sh0", "shN", "scales", "quats", "opacities")
    statistics = {"radii": np.ones(COUNT), "gradients": np.ones((COUNT, 1)), "denominator": np.ones((COUNT, 1))}
    tensors = [*(splats[name] for name in names), *behind, *(statistics[part] for part in parts)]
    return ((1, *map(tensor, tensors), {"state": {}}, 1.0), 30_000)


def cases(model):
    """Yield format, part, what becomes of it, and the file: bytes, a path, or what torch loads."""
    rng = np.random.default_rng(0)
    random = rng.standard_normal((COUNT, 3))
    face = ["element face 1", "property list uchar int vertex_indices"]
    lists = [struct.pack("<Bf", 1, at) for at in range(COUNT)]
    yield "ply", "normals that differ", "normals", with_normals(model, random)
    yield "ply", "normals that are alike", "", with_normals(model, [0.0, 0.0, 1.0])
    yield "ply", "normals that are alike", "", with_normals(model, np.nan)
    yield "ply", "extra columns", "kept", ply(model, columns=["float a"], values=[bytes(4)] * COUNT)
    widths = [struct.pack("<f", 0.01)] * COUNT
    yield "ply", "filter_3D", "kept", ply(model, columns=["float filter_3D"], values=widths)
    yield "ply", "lists", "list properties a", ply(model, columns=["list uchar float a"], values=lists)
    tail = struct.pack("<B3i", 3, 0, 1, 2)
    yield "ply", "elements", "elements face", ply(model, elements=face, tail=tail)
    yield "ply", "elements without rows", "", ply(model, elements=["element face 0", face[1]])
    yield "ply", "elements without rows", "", ply(model, elements=["element face 0"])
    yield "ply", "comments", "kept", ply(model, comments=["comment naïve © 2026", "obj_info two  words"])
    yield "ply", "comments outside UTF-8", "3 bytes of names", ply(model, comments=[b"\xff\xfe\xfd"])
    foreign = ply(
        model,
        columns=["float a", "float xy"],
        values=[bytes(8)] * COUNT,
        edit=lambda b: b.replace(b" xy", b" \xc3\xbc"),
    )
    yield "ply", "names outside ASCII", "2 bytes of names", foreign
    for name in ("f_dc_0", "f_rest_1", "opacity", "scale_2", "rot_3"):
        yield "ply", "doubles", f"doubles of {name}", ply(model, kinds=[name])
    yield "ply", "positions in doubles", "precision of means", ply(model, kinds=["x", "y"])
    yield "ply", "splats with NaN", "1 splat with NaN", with_nan(model)
    yield "ply", "bytes after the splats", "7 bytes after", ply(model, tail=bytes(7))
    yield (
        "compressed-ply",
        "elements",
        "elements other",
        compressed(model, elements=["element other 1", "property int a"], tail=bytes(4)),
    )
    yield (
        "compressed-ply",
        "elements without rows",
        "",
        compressed(model, elements=["element other 0", "property int a"]),
    )
    yield "compressed-ply", "extra columns", "columns label of vertex", compressed(model, column=b"label")
    yield "compressed-ply", "comments", "kept", compressed(model, comments=["comment naïve", "obj_info two"])
    yield "compressed-ply", "bytes after the splats", "7 bytes after", compressed(model, tail=bytes(7))
    entries = with_facts(model, entries={"source": "a drone", "licence": "© Zoë"})
    yield "csplat", "metadata without a comment", "metadata source", written("a.csplat", entries)
    yield (
        "csplat",
        "metadata",
        "kept",
        written("a.csplat", with_facts(model, entries={"licence": "© Zoë", "comments": ["ü\n"]})),
    )
    camera = {"K": np.eye(3).tolist(), "viewmat": np.eye(4).tolist(), "W": 9, "H": 9, "near": 0.1, "image": "a"}
    yield "csplat", "cameras", "cameras", written("a.csplat", with_facts(model, cameras=[camera]))
    yield (
        "csplat",
        "extra columns",
        "kept",
        written("a.csplat", replace(model, extra={"label": np.arange(COUNT, dtype="i4")})),
    )
    yield "csplat", "levels of detail", "coarser level", LEVELS
    record = struct.pack("<II", 0xADBE0002, 12) + bytes(12)
    axes = struct.pack("<III", 0xADBE0003, 4, 6)
    for version in (3, 4):
        yield "spz", "axes", "kept", spz(model, version=version, flags=2, extensions=axes)
        yield "spz", "antialiased", "kept", spz(model, version=version, flags=1)
        yield (
            "spz",
            "extensions",
            "extension SPZ_ADOBE_safe_orbit_camera (12 bytes)",
            spz(model, version=version, flags=2, extensions=record + axes),
        )
        yield (
            "spz",
            "extensions",
            "extension 0x00000005 (0 bytes)",
            spz(model, version=version, flags=2, extensions=struct.pack("<II", 5, 0)),
        )
        yield "spz", "flags", "flag 0x10", spz(model, version=version, flags=0x10)
        yield "spz", "reserved bytes", "the reserved byte", spz(model, version=version, reserved=b"\1")
    yield "spz", "bytes after the splats", "5 bytes after", spz(model, tail=bytes(5))
    yield "spz", "bytes after the splats", "5 bytes before the table", spz(model, version=4, extensions=bytes(5))
    yield "sog", "antialiased", "kept", sog(model, keys={"antialias": True})
    yield "sog", "keys", "keys foo of the JSON", sog(model, keys={"foo": 1})
    yield "sog", "keys", "keys means foo of the JSON", sog(model, section={"foo": 1})
    yield "sog", "keys", "keys asset copyright of the JSON", sog(model, keys={"asset": {"copyright": "me"}})
    yield "sog", "keys without values", "", sog(model, keys={"foo": None, "bar": {}, "asset": {"generator": "me"}})
    yield (
        "sog",
        "files in its zip",
        "files extra.webp, notes/read.me of the zip",
        sog(model, files={"extra.webp": b"1", "notes/read.me": b"2"}.items()),
    )
    yield "sog", "files in its zip", "files b.ply of the zip", sog(model, files={"b.ply": b"1"}.items())
    yield (
        "sog",
        "empty files in its zip",
        "",
        sog(model, files={"a": b"", "__MACOSX/b": b"1", ".DS_Store": b"1"}.items()),
    )
    yield "sog", "levels of detail", "1 coarser level of detail", streamed(model)
    yield "sog", "files in its zip", "files notes of the zip", streamed(model, notes=b"1")
    yield "splat", "splats with NaN", "1 splat with NaN", splat(model, bad=True)
    yield "ksplat", "centre of the scene", "", ksplat(model, centre=2.0)
    yield "ksplat", "reserved bytes", "reserved bytes of the header of the file", ksplat(model, reserved=1)
    yield "ksplat", "reserved bytes", "reserved bytes of the header of section 0", ksplat(model, section=1)
    yield "ksplat", "rows after the splats", "rows after the splats of section 0", ksplat(model, spare=b"\1" * 44)
    yield "ksplat", "empty rows after the splats", "", ksplat(model, spare=bytes(88))
    yield "ksplat", "bytes after the splats", "3 bytes after", ksplat(model, tail=bytes(3))
    for part, (change, words) in GLTF.items():
        yield "gltf", part, words, glb(model, change)
        if part not in ("attribute of instances", "morph targets", "contradicting licence", "colours of points"):
            yield "gltf-csplat", part, words, glb(model, change, name="a.csplat.glb")
    for part, change in NOTHING.items():
        yield "gltf", part, "", glb(model, change)
    yield "gltf", "colours of points that follow from SH", "", glb(model)
    yield "gltf", "chunk", "chunks MORE", glb(model, chunk=bytes(8))
    yield "gltf", "bytes after the splats", "3 bytes after", glb(model, tail=bytes(3))
    yield "gltf", "bytes after the splats", "8 bytes after the buffer", glb(model, more=b"\1" * 8)
    yield "gltf", "licence", "kept", glb(with_facts(model, entries={"licence": "© Zoë"}))
    damaged = placed(("asset",), copyright="© Zoë", extras={"csplat": ["csplat licence ? Zo?"]})
    yield "gltf", "licence", "kept", glb(model, damaged)
    yield "gltf-csplat", "licence", "kept", glb(with_facts(model, entries={"licence": "© Zoë"}), name="a.csplat.glb")
    yield "checkpoint", "tensors of splats", "tensors features (40 × 32)", gsplat(model, features=np.ones((COUNT, 32)))
    yield "checkpoint", "tensors of splats", "tensors colours (40)", gsplat(model, {"colours": tensor(np.ones(COUNT))})
    yield "checkpoint", "tensors of splats", "tensors item 7 (40 × 3)", inria(model, np.ones((COUNT, 3)))
    yield (
        "checkpoint",
        "tensors of splats",
        "tensors item 7 (40 × 1), item 8 (40)",
        inria(model, np.ones((COUNT, 1)), np.ones(COUNT)),
    )
    splats = gsplat(model)
    splats["splats"]["quats"] = splats["splats"]["quats"].astype("f8")
    splats["splats"]["quats"] += 1e-12
    yield "checkpoint", "doubles", "doubles of quats", splats
    yield "checkpoint", "filter_3D", "filter_3D", gsplat(model, filter_3D=np.ones((COUNT, 1)))
    yield "checkpoint", "statistics and optimisers", "", inria(model)
    yield "checkpoint", "statistics and optimisers", "", gsplat(model, {"step": 7, "optimizers": [{}]})
    yield "checkpoint", "networks and cameras", "", gsplat(model, {"pose_adjust": tensor(np.ones((3, 6)))})


ENDINGS = {
    "compressed-ply": ".compressed.ply", "gltf": ".glb", "gltf-csplat": ".csplat.glb", "checkpoint": ".pt",
}  # fmt: skip


@pytest.fixture
def model(make_model):
    made = make_model(COUNT, 1)
    return replace(made, scales=made.scales.clip(-5, -2), sh0=made.sh0.clip(-1, 1), shN=made.shN.clip(-0.9, 0.9))


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Return a function that stores the file of a case and returns its path."""

    def stored(form, content):
        if isinstance(content, bytes):
            path = tmp_path / f"in{ENDINGS.get(form, '.' + form)}"
            path.write_bytes(content)
            return path
        if isinstance(content, Path):
            return content
        torch = SimpleNamespace(__version__="2.5.0", load=lambda *_, **__: content)
        monkeypatch.setitem(sys.modules, "torch", torch)
        return CHECKPOINT

    return stored


def test_each_part_of_a_file_is_kept_or_lost(model, load, tmp_path):
    def check(case):
        form, _part, becomes, content = case
        path, out = load(form, content), tmp_path / "out.ply"
        said = json.loads(call("convert", path, out, "--json", "--quiet", "--force").stdout)
        assert form.removesuffix("-csplat") == said["source_format"].removesuffix("4").removesuffix("-csplat")
        words = [*said["lost"], *(f"precision of {name}" for name in said["rounded"])]
        out.unlink()
        strict = invoke("convert", path, out, "--no-loss")
        if becomes in ("", "kept"):
            assert ([], 0) == (words, strict.exit_code), (words, strict.output)
            if becomes:
                before, after = csplat.read(path), csplat.read(out)
                assert before.extra.keys() == after.extra.keys()
                assert before.metadata.entries == after.metadata.entries
                assert before.metadata.antialiased == after.metadata.antialiased
            return
        assert [one for one in words if becomes in one], words
        assert (1, False) == (strict.exit_code, out.exists())
        assert becomes.split()[-1] in strict.stderr
        assert f"lost on the way: {'; '.join(words)}" in call("convert", path, out, "--force").stderr

    table = {}
    for case in cases(model):
        table.setdefault(" ".join(case[:2]), []).append(case)
    named = {f"{name} {at}": case for name, group in table.items() for at, case in enumerate(group)}
    assert [] == failures(named, check)


def test_the_guide_lists_the_parts(model):
    rows = re.findall(
        r"^\| ([a-z-]+) \| ([^|]+) \| (kept|lost|nothing)[^|]* \|$", GUIDE.read_text("utf-8"), re.MULTILINE
    )
    fates = {"": "nothing", "kept": "kept"}
    assert {(form, part, fates.get(becomes, "lost")) for form, part, becomes, _ in cases(model)} == {
        (form, part.strip(), fate) for form, parts, fate in rows for part in parts.split(",")
    }
