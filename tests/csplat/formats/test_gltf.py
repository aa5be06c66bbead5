"""glTF with splats: files built byte by byte, round trips, refusals."""

import base64
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from checked import checked

import csplat
from csplat.editing.transform import rotate_scene
from csplat.errors import InputError
from csplat.formats import formats, lint_file
from csplat.formats.gltf import gltf_document

ARRAYS = ("means", "quats", "opacities", "sh0", "shN")
PREFIX = "KHR_gaussian_splatting"
TYPES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "f4": 5126}
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
FORMAT = next(one for one in formats() if one.name == "gltf")
TWO = {
    "POSITION": np.array([[1, 2, 3], [-1, 0, 0.5]], "<f4"),
    f"{PREFIX}:ROTATION": np.array([[0, 0, 0, 1], [1, 0, 0, 0]], "<f4"),  # x y z w
    f"{PREFIX}:SCALE": np.array([[1, 2, 0.5], [0, 1, 1]], "<f4"),
    f"{PREFIX}:OPACITY": np.array([[0.25], [1]], "<f4"),
    f"{PREFIX}:SH_DEGREE_0_COEF_0": np.array([[0.1, 0.2, 0.3], [0, 0, 0]], "<f4"),
}


BAND = {f"{PREFIX}:SH_DEGREE_1_COEF_{m}": np.full((2, 3), m + 1, "<f4") for m in range(3)}


def document(arrays, **root):
    """Return the JSON of a file with these arrays in one mesh, and its buffer."""
    data, views, accessors = b"", [], []
    for array in arrays.values():
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        accessors.append({
            "bufferView": len(accessors), "componentType": TYPES[array.dtype.str[1:]],
            "normalized": array.dtype.kind != "f", "count": len(array), "type": KINDS[array.shape[1]],
        })  # fmt: skip
        data += array.tobytes() + bytes(-array.nbytes % 4)
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    attributes = {name: index for index, name in enumerate(arrays)}
    whole = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": attributes, "extensions": {PREFIX: splats}}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    return {**whole, **root}, data


def glb(said, data, padding=b" "):
    text = json.dumps(said, separators=(",", ":")).encode()
    text += padding * (-len(text) % 4 + 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def read(said, data):
    return checked(glb(said, data))


def test_attributes_are_read():
    said, data = document(TWO | BAND)
    model = read(said, data)
    assert "LUF" == model.coordinate_system
    assert TWO["POSITION"].tolist() == model.means.tolist()
    assert [[1, 0, 0, 0], [0, 1, 0, 0]] == model.quats.tolist()
    assert np.log(np.float32([1, 2, 0.5])).tolist() == model.scales[0].tolist()
    assert -88 == model.scales[1, 0]  # log scale of 0
    assert [0.25, 1] == model.opacities.tolist()
    assert TWO[f"{PREFIX}:SH_DEGREE_0_COEF_0"].tolist() == model.sh0.tolist()
    assert [[[1] * 3, [2] * 3, [3] * 3]] * 2 == model.shN.tolist()
    assert model.means.tolist() == checked(glb(said, data, padding=b"\0")).means.tolist()
    apart = np.zeros((2, 5), "<f4")  # rows may have a stride
    apart[:, 1:4] = TWO["POSITION"]
    said["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": 40, "byteStride": 20})
    said["accessors"][0] |= {"bufferView": len(said["bufferViews"]) - 1, "byteOffset": 4}
    said["buffers"][0]["byteLength"] += 40
    assert TWO["POSITION"].tolist() == read(said, data + apart.tobytes()).means.tolist()


def test_normalised_integers_are_read():
    arrays = TWO | {
        "POSITION": np.array([[-32768, -32767, 0], [32767, 1, 2]], "<i2"),
        f"{PREFIX}:ROTATION": np.array([[0, 0, 0, 127], [-127, 0, 0, 0]], "<i1"),
        f"{PREFIX}:SCALE": np.array([[255, 51, 0], [1, 1, 1]], "<u1"),
        f"{PREFIX}:OPACITY": np.array([[65535], [13107]], "<u2"),
    }
    said, data = document(arrays)
    model = read(said, data)
    assert [-1, -1, 0] == model.means[0].tolist()
    assert np.float32(1 / 32767) == model.means[1, 1]
    assert [[1, 0, 0, 0], [0, -1, 0, 0]] == model.quats.tolist()
    assert np.allclose([0, np.log(0.2)], model.scales[0, :2])
    assert np.allclose([1, 0.2], model.opacities)
    said["accessors"][0]["normalized"] = False
    assert [-32768, -32767, 0] == read(said, data).means[0].tolist()


def test_transforms_of_nodes_are_applied():
    nodes = [
        {"children": [1], "translation": [10, 0, 0], "rotation": [0, 0, 0.5**0.5, 0.5**0.5]},
        {"mesh": 0, "scale": [2, 2, 2], "children": [2]},
        {"mesh": 0, "matrix": [0.5, 0, 0, 0, 0, 0.5, 0, 0, 0, 0, 1, 0, 1, 0, 0, 1]},
    ]
    model = read(*document(TWO | BAND, nodes=nodes))
    x, y, z = TWO["POSITION"].T
    assert np.allclose(np.stack([10 - 2 * y, 2 * x, 2 * z], 1), model.means[:2])
    assert np.allclose(np.stack([10 - y, x + 2, 2 * z], 1), model.means[2:])
    assert np.allclose([[2, 4, 1], [1, 2, 1]], np.sort(np.exp(model.scales[[0, 2]]), axis=1)[:, [1, 2, 0]])
    assert np.allclose([3, 2, -1], model.shN[0, :, 0])  # -y z -x of the colours turn with them
    far = read(*document(TWO, nodes=[{"mesh": 0, "translation": [4e6, 1.25, -3e5]}]))
    assert (4e6, 1.25, -3e5) == far.origin
    assert TWO["POSITION"].tolist() == far.means.tolist()


def test_nodes_that_are_shown_are_read_whatever_the_file_requires():
    said, data = document(TWO, nodes=[{"mesh": 0}, {"children": [0], "translation": [1, 0, 0]}])
    said["extensionsRequired"] = ["KHR_materials_unlit", "KHR_texture_basisu", "KHR_draco_mesh_compression", "X_y"]
    said["meshes"].append({"primitives": [{"extensions": {"KHR_draco_mesh_compression": {"bufferView": 9}}}]})
    said["nodes"] += [{"mesh": 1}, {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": False}}}]
    for scenes in ([{"nodes": [1, 2, 3]}], None):
        said |= {"scenes": scenes}
        if scenes is None:
            del said["scenes"]  # all nodes are read
        assert [2, 0] == read(said, data).means[:, 0].tolist()


@pytest.mark.parametrize("degree", [0, 3])
def test_a_written_scene_reads_back(tmp_path, make_model, degree):
    model = make_model(50, degree, origin=(1.5, -2.0, 0.1), antialiased=True, metadata={"licence": "CC0"})
    csplat.write(tmp_path / "a.glb", model)
    back = checked(tmp_path / "a.glb")
    assert ("LUF", True, "CC0") == (back.coordinate_system, back.antialiased, back.metadata["licence"])
    flipped = rotate_scene(back, np.diag([-1.0, -1.0, 1.0]))
    assert model.origin == flipped.origin
    assert all((getattr(model, name) == getattr(flipped, name)).all() for name in ARRAYS)
    assert np.abs(model.scales - flipped.scales).max() < 1e-6
    csplat.write(tmp_path / "b.glb", back)
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()
    assert set(ARRAYS) <= set(FORMAT.exact)
    colours = (np.float32([0.0, 0.5, 1.0]) - 0.5) / np.float32(0.28209479)  # as of points, for other programs
    csplat.write(tmp_path / "c.glb", replace(model, sh0=np.tile(colours, (50, 1)), opacities=np.full(50, 0.2, "f4")))
    assert bytes([0, 55, 255, 51]) * 50 in (tmp_path / "c.glb").read_bytes()
    csplat.write(tmp_path / "a.glb", replace(model, unit_metres=0.5, coordinate_system="LUF", origin=(0.0, 0.0, 0.0)))
    metres = checked(tmp_path / "a.glb")
    assert 1.0 == metres.unit_metres
    assert (model.means * np.float32(0.5) == metres.means).all()
    assert np.abs(model.scales + np.log(0.5) - metres.scales).max() < 1e-6


def test_buffers_may_be_text_or_files_next_to_it(tmp_path):
    said, data = document(TWO)
    path = tmp_path / "in" / "a.gltf"
    path.parent.mkdir()
    (path.parent / "a b.bin").write_bytes(data)
    (tmp_path / "out.bin").write_bytes(data)
    (path.parent / "link.bin").symlink_to(tmp_path / "out.bin")

    def read_from(uri):
        said["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(said))
        return checked(path)

    said["buffers"][0]["uri"] = "a%20b.bin"
    for encoding in ("utf-8-sig", "utf-16"):
        path.write_text(json.dumps(said), encoding=encoding)
        assert 2 == len(checked(path))
    (path.parent / "lfs.bin").write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    with pytest.raises(InputError, match=r"lfs\.bin' is a pointer of Git LFS"):
        read_from("lfs.bin")
    with pytest.raises(InputError, match=r"there is no file 'LFS\.bin', but 'lfs\.bin': rename it"):
        read_from("LFS.bin")
    for uri in (".\\a%20b.bin", "a%20b.bin", "data:application/octet-stream;base64," + base64.b64encode(data).decode()):
        assert TWO["POSITION"].tolist() == read_from(uri).means.tolist()
    for uri in ("../out.bin", "link.bin", str(tmp_path / "out.bin"), "http://a/b.bin", "no.bin", "", ".", "a\0b",
                "%2e%2e/out.bin", "data:,xx", "data:;base64,?", "x" * 5000):  # fmt: skip
        with pytest.raises(InputError, match=r"a\.gltf, buffers/0/uri: "):
            read_from(uri)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("asset/version", "1.0", "expected 2.0"),
        ("asset", 3, "no asset"),
        ("asset/extras", {"csplat": ["csplat origin 1"]}, "origin"),
        ("extensionsRequired", 3, "extensionsRequired: found 3"),
        ("meshes/0/primitives/0/extensions/KHR_draco_mesh_compression", {}, "draco_mesh_compression, which is not"),
        ("meshes/0/primitives/0/extensions", {}, "no splats"),
        (f"meshes/0/primitives/0/extensions/{PREFIX}/kernel", "sphere", "kernel: found 'sphere'"),
        (f"meshes/0/primitives/0/extensions/{PREFIX}/colorSpace", "acescg", "colorSpace: found"),
        (f"meshes/0/primitives/0/extensions/{PREFIX}/extensions", {"packed": {}}, "packed, which is not supported"),
        ("meshes/0/primitives/0/attributes/POSITION", 99, "accessors/99: there is no such object"),
        ("meshes/0/primitives/0/attributes/POSITION", 3, "expected 3 numbers"),
        ("meshes/0/primitives/0/attributes", {"POSITION": 0}, "there is no KHR_gaussian_splatting:ROTATION"),
        (f"meshes/0/primitives/0/attributes/{PREFIX}:SH_DEGREE_1_COEF_1", 0, "SH_DEGREE_1_COEF_0"),
        ("accessors/0/count", 10**12, "in a view of"),
        ("accessors/0/count", 1, "POSITION 1"),
        ("accessors/0/count", -1, "whole number"),
        ("accessors/0/count", True, "found True"),
        ("accessors/0/byteOffset", 2**52, "in a view of"),
        ("accessors/0/componentType", [], "componentType: found"),
        ("accessors/0/type", {}, "type: found"),
        ("accessors/0/sparse", {}, "sparse"),
        ("bufferViews/0/byteLength", 10**9, "of a buffer"),
        ("bufferViews/0/byteStride", 4, "stride of 4"),
        ("bufferViews/0/extensions", {"EXT_meshopt_compression": {}}, "packed buffers"),
        ("bufferViews/0/buffer", 7, "buffers/7: there is no such object"),
        ("bufferViews/4/byteOffset", 5000, "of a buffer of"),
        ("buffers/0/uri", [], "uri: found"),
        ("nodes/0/children", [0], "more than one parent"),
        ("nodes/0/scale", [1, 0, 1], "singular"),
        ("nodes/0/scale", [1e200, 1e200, 1e200], "exceeds float32"),
        ("nodes/0/children", [1], "splats 0 to 1: "),
        ("nodes/0/rotation", [0, 0, 0, 0], "unit quaternion"),
        ("nodes/0/matrix", [1, 2], "expected 16 numbers"),
        ("nodes/0/translation", [1, 2, float("nan")], "expected 3 numbers"),
        ("scenes/0/nodes", [[]], "there is no such object"),
        ("scenes/0/nodes", "abc", "nodes: found"),
        ("scene", 5, "scenes/5"),
        ("nodes", [{"children": list(range(1, 99))}, *[{"mesh": 0}] * 98], "more than it has bytes"),
        ("meshes/0/primitives", [0] * 5, "found 0"),
    ],
)  # fmt: skip
def test_invalid_documents_are_refused_with_the_path(place, value, message):
    said, data = document(TWO)
    said["nodes"].append({"mesh": 0, "translation": [1, 2, 1e39]})
    said["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    *above, key = place.split("/")
    holder = said
    for step in above:
        holder = holder[int(step) if isinstance(holder, list) else step]
    if isinstance(holder, list):
        holder[int(key)] = value
    else:
        holder[key] = value
    with pytest.raises(InputError, match=rf"^data.*{message}[^\n]*$"):
        read(said, data)


def test_drafts_and_too_many_instances_are_refused():
    said, data = document({name.replace(f"{PREFIX}:", "_"): array for name, array in TWO.items()})
    said["meshes"][0]["primitives"][0]["extensions"][PREFIX] = {}
    with pytest.raises(InputError, match="an early draft of KHR_gaussian_splatting"):
        read(said, data)
    said, data = document(TWO)
    said["meshes"].append({"primitives": [{}] * 200})
    said |= {"nodes": [{"mesh": 1}] * 200, "scenes": [{"nodes": list(range(200))}]}
    with pytest.raises(InputError, match="number 16385"):
        read(said, data)


@pytest.mark.parametrize(("name", "value"), [*((name, np.nan) for name in TWO), ("POSITION", np.inf)])
def test_splats_that_are_not_finite_are_dropped_and_counted(tmp_path, name, value):
    arrays = many()
    whole = checked(glb(*document(arrays)))
    arrays[name][3, 0] = value
    found, model = linted(tmp_path / "a.glb", *document(arrays))
    assert ("repair", 1) == (found["nonfinite-rows"].kind, found["nonfinite-rows"].count)
    assert ["nonfinite-rows"] == list(found)
    assert np.delete(whole.means, 3, 0).tolist() == model.means.tolist()
    assert np.delete(whole.opacities, 3, 0).tolist() == model.opacities.tolist()
    arrays[name][:, 0] = value
    (tmp_path / "a.glb").write_bytes(glb(*document(arrays)))
    with pytest.raises(InputError, match="40 splats with NaN or infinity: none is left"):
        csplat.read(tmp_path / "a.glb")


def test_huge_values_trailing_bytes_and_other_scenes_are_reported(tmp_path):
    arrays = many()
    arrays[f"{PREFIX}:SH_DEGREE_0_COEF_0"][2] = 1e7
    arrays[f"{PREFIX}:SCALE"][7] = 3e38
    said, data = document(arrays, scenes=[{"nodes": [0]}, {"name": "roof", "nodes": []}])
    path = tmp_path / "a.glb"
    path.write_bytes(glb(said, data) * 2)
    found = {one.id: one for one in lint_file(path)}
    assert {"huge-values": 2, "trailing-bytes": len(glb(said, data)), "other-scenes": 1} == {
        name: one.count for name, one in found.items()
    }
    assert "scene 0 is read, 1 ('roof') not" in found["other-scenes"].text
    path.write_bytes(glb(said | {"scene": 0}, data))
    assert ["huge-values"] == [one.id for one in lint_file(path)]


def test_short_buffers_and_rotations_of_length_0_are_reported(tmp_path):
    said, data = document(TWO | {f"{PREFIX}:ROTATION": np.zeros((2, 4), "<f4")})
    said["buffers"][0]["byteLength"] += 1000
    found, model = linted(tmp_path / "a.glb", said, data)
    assert {"short-buffer", "zero-quats"} == set(found)
    assert 2 == found["zero-quats"].count
    assert [[1, 0, 0, 0]] * 2 == model.quats.tolist()
    assert TWO["POSITION"].tolist() == model.means.tolist()
    with pytest.raises(InputError, match="truncated"):
        read(said, data[:-8])


def linted(path, said, data):
    """Lint a file; return the findings by id, and the model along the axes of the file."""
    path.write_bytes(glb(said, data))
    return {one.id: one for one in lint_file(path)}, checked(path)


def many(count=40, **changed):
    """Return attributes of several splats, some of them replaced."""
    rng = np.random.default_rng(0)
    arrays = {name: np.resize(array, (count, array.shape[1])).copy() for name, array in TWO.items()}
    arrays[f"{PREFIX}:SCALE"] = rng.uniform(0.01, 0.1, (count, 3)).astype("<f4")
    arrays[f"{PREFIX}:SH_DEGREE_0_COEF_0"] = rng.uniform(-1.5, 1.5, (count, 3)).astype("<f4")
    return arrays | {f"{PREFIX}:{name}": value for name, value in changed.items()}


def test_logarithms_of_scales_are_recognised_by_their_sign(tmp_path):
    path, arrays = tmp_path / "a.glb", many()
    right = checked(glb(*document(arrays)))
    logs = np.log(arrays[f"{PREFIX}:SCALE"])
    found, model = linted(path, *document(many(SCALE=logs), asset={"version": "2.0", "generator": "writer 1"}))
    assert ("repair", 40) == (found["log-scales"].kind, found["log-scales"].count)
    assert "written by writer 1" in found["log-scales"].text
    np.testing.assert_allclose(right.scales, model.scales, atol=1e-6)
    with pytest.raises(InputError, match="log-scales"):
        csplat.read(path, strict=True)
    for writer, findings in (("other", []), ("splat-transform 2.3.1", ["unclear-scales"])):
        asset = {"version": "2.0", "generator": writer}
        found, model = linted(path, *document(many(SCALE=np.full((40, 3), 5, "<f4")), asset=asset))
        assert findings == list(found)
        np.testing.assert_allclose(np.log(5), model.scales, rtol=1e-6)
    for values in ([-0.5], [-40.0] * 39):  # neither sizes nor logarithms
        scales = many()[f"{PREFIX}:SCALE"]
        scales[1 : 1 + len(values), 2] = values
        path.write_bytes(glb(*document(many(SCALE=scales))))
        with pytest.raises(InputError, match=rf"SCALE of splat 1 is {values[0]:g}, expected"):
            csplat.read(path)
        assert ["error"] == [one.kind for one in lint_file(path) if one.id == "negative-scales"]


def test_opacities_out_of_range_are_clipped_read_as_logits_or_refused(tmp_path):
    opacities = np.linspace(0, 1.4, 40, dtype="<f4")[:, None]
    found, model = linted(tmp_path / "a.glb", *document(many(OPACITY=opacities)))
    assert ("repair", 12) == (found["out-of-range-opacities"].kind, found["out-of-range-opacities"].count)
    assert np.minimum(opacities[:, 0], 1).tolist() == model.opacities.tolist()
    logits = np.linspace(-6, 6, 40, dtype="<f4")[:, None]
    found, model = linted(tmp_path / "a.glb", *document(many(OPACITY=logits)))
    assert {"logit-opacities": "repair"} == {name: one.kind for name, one in found.items()}
    np.testing.assert_allclose(1 / (1 + np.exp(-logits[:, 0])), model.opacities, atol=1e-6)
    logits[[4, 5], 0] = np.inf, -np.inf
    found, model = linted(tmp_path / "a.glb", *document(many(OPACITY=logits)))
    assert {"logit-opacities", "infinite-logits"} == set(found)
    assert [1, 0] == model.opacities[4:6].tolist()
    (tmp_path / "a.glb").write_bytes(glb(*document(many(OPACITY=np.linspace(0, 255, 40, dtype="<f4")[:, None]))))
    with pytest.raises(InputError, match=r"OPACITY of splat 1 is 6\.53846, expected 0 to 1"):
        csplat.read(tmp_path / "a.glb")


@pytest.mark.parametrize("bands", [{}, BAND])
def test_linear_colours_are_fitted_and_the_error_is_reported(tmp_path, bands):
    said, data = document(TWO | {name: array * np.float32(0.02) for name, array in bands.items()})
    raw = checked(glb(said, data))
    said["meshes"][0]["primitives"][0]["extensions"][PREFIX]["colorSpace"] = "lin_rec709_display"
    found, model = linted(tmp_path / "a.glb", said, data)
    assert "repair" == found["linear-colours"].kind
    error = float(found["linear-colours"].text.split("rms error ")[1].split()[0])
    assert (error == 0) if not bands else (0 < error < 2)
    view = np.array([-0.6, 0, -0.8], "f4") * np.float32(0.48860251)  # the first band, seen along .8 .6 0

    def colours(scene):
        return 0.5 + 0.28209479 * scene.sh0 + (np.einsum("nkc,k->nc", scene.shN, view) if bands else 0)

    linear = colours(raw)
    wanted = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(wanted, colours(model), atol=0.01 if bands else 1e-6)


def test_bands_above_the_requested_degree_are_left_out():
    names = [f"SH_DEGREE_{one}_COEF_{m}" for one in (1, 2, 3, 4, 5) for m in range(2 * one + 1)]
    bands = {f"{PREFIX}:{name}": np.ones((2, 3), "<f4") for name in names}
    data = glb(*document(TWO | bands))
    with pytest.raises(InputError, match="SH degree 5, expected at most 4: --sh-degree 4"):
        csplat.read(data)
    assert [4, 1] == [csplat.read(data, sh_degree=degree).sh_degree for degree in (4, 1)]


def test_every_instance_is_read():
    offsets, sizes = np.diag([1, 5, 9]).astype("<f4"), np.repeat(np.float32([[1], [2], [1]]), 3, 1)
    arrays = TWO | {"T": offsets, "S": sizes}
    said, data = document(arrays)
    for name in "TS":
        del said["meshes"][0]["primitives"][0]["attributes"][name]
    said["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 5, "SCALE": 6}}}
    model = read(said, data)
    assert np.allclose(np.tile(TWO["POSITION"], (3, 1)) * sizes.repeat(2, 0) + offsets.repeat(2, 0), model.means)
    said["accessors"][6]["count"] = 2
    with pytest.raises(InputError, match=r"rows, expected one number of instances"):
        read(said, data)


def packed(tmp_path, model, name, *, bounds=True, draft=False):
    """Return the JSON and buffer of a GLB with an SPZ, under one of the extension's names."""
    csplat.write(tmp_path / "a.spz", replace(model, coordinate_system="RUB"))
    data = (tmp_path / "a.spz").read_bytes()
    inner = {name: {"bufferView": 0}}
    splats = {} if draft else {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    extensions = inner if name == OLD else {PREFIX: {**splats, "extensions": inner}}
    said, _ = document({})
    said["meshes"][0]["primitives"][0] |= {"attributes": {"POSITION": 0}, "extensions": extensions}
    said |= {
        "accessors": [{"componentType": 5126, "count": len(model), "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "buffers": [{"byteLength": len(data)}],
        "extensionsRequired": [PREFIX, name],
    }
    if bounds:
        said["accessors"][0] |= {"min": model.means.min(0).tolist(), "max": model.means.max(0).tolist()}
    return said, data


OLD = "KHR_spz_gaussian_splats_compression"


@pytest.mark.parametrize("name", [f"{PREFIX}_compression_spz_2", OLD])
@pytest.mark.parametrize("degree", [0, 3])
def test_spz_in_a_glb_is_read(tmp_path, make_model, name, degree):
    model = make_model(50, degree)
    model = replace(model, means=np.abs(model.means), means_double=None)  # so that a turned model leaves its bounds
    said, data = packed(tmp_path, model, name)
    said["nodes"][0]["translation"] = [10, 20, 30]
    found, back = linted(tmp_path / "a.glb", said, data)
    alone = checked(tmp_path / "a.spz")
    assert ["spz-axes"] == list(found)
    assert ("LUF", degree, 50) == (back.coordinate_system, back.sh_degree, len(back))
    assert np.allclose(alone.means + np.array([10, 20, 30]), back.means, atol=1e-5)
    assert (alone.shN == back.shN).all()
    assert (alone.scales == back.scales).all()
    with pytest.raises(InputError, match=r"data, bufferViews/0 is not SPZ"):
        read(said, b"x" * len(data))
    said["accessors"][0]["count"] = 49
    with pytest.raises(InputError, match="POSITION: 49 rows, its SPZ has 50"):
        read(said, data)


def test_spz_in_a_glb_is_turned_if_its_bounds_allow_it(tmp_path, make_model):
    model = replace(make_model(50, 1), means_double=None)
    name = f"{PREFIX}_compression_spz_2"
    flip = np.float32([-1, 1, -1])
    ends = np.sort(np.stack([model.means.min(0), model.means.max(0)]) * flip, axis=0)
    turned_bounds = {"min": ends[0].tolist(), "max": ends[1].tolist()}
    said, data = packed(tmp_path, model, name)
    said["accessors"][0] |= turned_bounds
    for one in (said, packed(tmp_path, model, name, bounds=False)[0]):
        found, back = linted(tmp_path / "a.glb", one, data)
        assert {} == found
        assert np.allclose(checked(tmp_path / "a.spz").means * flip, back.means)
    found, back = linted(tmp_path / "a.glb", *packed(tmp_path, model, name, bounds=False, draft=True))
    assert "CesiumJS" in found["spz-axes"].text


@pytest.mark.slow
def test_damage_is_refused_or_read(monkeypatch):
    whole = glb(*document(TWO))

    def refused(data):
        monkeypatch.setattr(gltf_document, "map_file", lambda _path: data)
        try:
            with FORMAT.open(Path("a.glb")) as scene:
                scene.model()
        except InputError as error:
            return "a.glb" in str(error)
        return False

    assert not refused(whole)
    assert all(refused(whole[:size]) for size in range(0, len(whole), 3))
    for at in range(len(whole)):
        refused(whole[:at] + bytes([whole[at] ^ (1 << at % 8)]) + whole[at + 1 :])
    for text in (b"[" * 100_000, b"{}", b"null", b'{"asset":{"version":"2.0"}}', b"9" * 5000, b"\xff"):
        assert refused(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text)


def test_other_names_and_empty_scenes_are_not_written(tmp_path, make_model):
    with pytest.raises(InputError, match=r"name it a\.glb"):
        csplat.write(tmp_path / "a.gltf", make_model(2, 0))
    with pytest.raises(InputError, match="no empty meshes"):
        csplat.write(tmp_path / "a.glb", make_model(0, 0))
    assert [] == list(tmp_path.iterdir())
