# SPDX-License-Identifier: Apache-2.0
"""glTF with splats: files built byte by byte, round trips, refusals.

Also: csplat.formats.gltf.gltf_document, csplat.formats.gltf.gltf_reader, csplat.formats.gltf.gltf_writer.
"""

import base64
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from checked import assert_damage_is_refused_or_read, checked, refusals
from models import with_facts

import csplat
from csplat.editing.transform import rotate_scene
from csplat.errors import InputError
from csplat.formats import formats, lint_file

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
    primitive = {"mode": 0, "attributes": attributes, "extensions": {PREFIX: splats}}
    whole = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}], "accessors": accessors, "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }  # fmt: skip
    return {**whole, **root}, data


def glb(said, data, padding=b" "):
    text = json.dumps(said, separators=(",", ":")).encode()
    text += padding * (-len(text) % 4 + 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def read(said, data):
    return checked(glb(said, data))


def linted(path, said, data):
    """Lint a file; return the findings by id, and the model along the axes of the file."""
    path.write_bytes(glb(said, data))
    return {one.id: one for one in lint_file(path)}, checked(path)


def many(**changed):
    """Return attributes of 40 splats, some of them replaced."""
    rng = np.random.default_rng(0)
    arrays = {name: np.resize(array, (40, array.shape[1])).copy() for name, array in TWO.items()}
    arrays[f"{PREFIX}:SCALE"] = rng.uniform(0.01, 0.1, (40, 3)).astype("<f4")
    arrays[f"{PREFIX}:SH_DEGREE_0_COEF_0"] = rng.uniform(-1.5, 1.5, (40, 3)).astype("<f4")
    return arrays | {f"{PREFIX}:{name}": value for name, value in changed.items()}


def test_attributes_are_read():
    said, data = document(TWO | BAND)
    model = read(said, data)
    assert "LUF" == model.metadata.coordinate_system
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
    said, data = document(TWO | {
        "POSITION": np.array([[-32768, -32767, 0], [32767, 1, 2]], "<i2"),
        f"{PREFIX}:ROTATION": np.array([[0, 0, 0, 127], [-127, 0, 0, 0]], "<i1"),
        f"{PREFIX}:SCALE": np.array([[255, 51, 0], [1, 1, 1]], "<u1"),
        f"{PREFIX}:OPACITY": np.array([[65535], [13107]], "<u2"),
    })  # fmt: skip
    model = read(said, data)
    assert [-1, -1, 0] == model.means[0].tolist()
    assert np.float32(1 / 32767) == model.means[1, 1]
    assert [[1, 0, 0, 0], [0, -1, 0, 0]] == model.quats.tolist()
    assert np.allclose([0, np.log(0.2)], model.scales[0, :2])
    assert np.allclose([1, 0.2], model.opacities)
    said["accessors"][0]["normalized"] = False
    assert [-32768, -32767, 0] == read(said, data).means[0].tolist()


def test_transforms_of_nodes_and_instances_are_applied():
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
    offsets, sizes = np.diag([1, 5, 9]).astype("<f4"), np.repeat(np.float32([[1], [2], [1]]), 3, 1)
    said, data = document(TWO | {"T": offsets, "S": sizes})
    for name in "TS":
        del said["meshes"][0]["primitives"][0]["attributes"][name]
    said["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 5, "SCALE": 6}}}
    wanted = np.tile(TWO["POSITION"], (3, 1)) * sizes.repeat(2, 0) + offsets.repeat(2, 0)
    assert np.allclose(wanted, read(said, data).means)
    said["accessors"][6]["count"] = 2
    with pytest.raises(InputError, match=r"rows, expected one number of instances"):
        read(said, data)


def test_nodes_that_are_shown_are_read_whatever_the_file_requires():
    said, data = document(TWO, nodes=[{"mesh": 0}, {"children": [0], "translation": [1, 0, 0]}])
    said["extensionsRequired"] = ["KHR_materials_unlit", "KHR_texture_basisu", "KHR_draco_mesh_compression", "X_y"]
    said["meshes"].append({"primitives": [{"extensions": {"KHR_draco_mesh_compression": {"bufferView": 9}}}]})
    said["nodes"] += [{"mesh": 1}, {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": False}}}]
    said["scenes"] = [{"nodes": [1, 2, 3]}]
    assert [2, 0] == read(said, data).means[:, 0].tolist()
    del said["scenes"]  # all nodes are read
    assert [2, 0] == read(said, data).means[:, 0].tolist()


def test_linear_colours_are_written_as_such_and_read_as_srgb(tmp_path, make_model):
    for space, written in (("lin_rec709_display", "lin_rec709_display"), ("130", "srgb_rec709_display")):
        csplat.write(tmp_path / "a.glb", make_model(9, 0, colour_space=space))
        assert f'"colorSpace":"{written}"'.encode() in (tmp_path / "a.glb").read_bytes().replace(b'": "', b'":"')
        with csplat.open(tmp_path / "a.glb") as scene:
            assert scene.metadata.colour_space == ("130" if space == "130" else "srgb_rec709_display")
            assert ("linear-colours" in {finding.id for finding in scene.findings}) == (space != "130")


def test_a_written_scene_reads_back(tmp_path, make_model):
    path, origin = tmp_path / "a.glb", (1.5, -2.0, 0.1)
    for degree in (0, 3):
        model = make_model(50, degree, origin=origin, antialiased=True, entries={"licence": "CC0"})
        csplat.write(path, model)
        back = checked(path)
        facts = back.metadata
        assert ("LUF", True, "CC0") == (facts.coordinate_system, facts.antialiased, facts.licence)
        turned = rotate_scene(back, np.diag([-1.0, -1.0, 1.0]))
        assert model.origin == turned.origin
        assert all((getattr(model, name) == getattr(turned, name)).all() for name in ARRAYS)
        assert np.abs(model.scales - turned.scales).max() < 1e-6
        csplat.write(tmp_path / "b.glb", back)
        assert path.read_bytes() == (tmp_path / "b.glb").read_bytes()
    assert set(ARRAYS) <= set(FORMAT.exact)
    colours = (np.float32([0.0, 0.5, 1.0]) - 0.5) / np.float32(0.28209479)  # as of points, for other programs
    csplat.write(path, replace(model, sh0=np.tile(colours, (50, 1)), opacities=np.full(50, 0.2, "f4")))
    assert bytes([0, 55, 255, 51]) * 50 in path.read_bytes()
    csplat.write(path, with_facts(replace(model, origin=(0.0, 0.0, 0.0)), unit_metres=0.5, coordinate_system="LUF"))
    metres = checked(path)
    assert 1.0 == metres.metadata.unit_metres
    assert (model.means * np.float32(0.5) == metres.means).all()
    assert np.abs(model.scales + np.log(0.5) - metres.scales).max() < 1e-6


def test_buffers_may_be_text_or_files_next_to_it(tmp_path):
    said, data = document(TWO)
    path, out = tmp_path / "in" / "a.gltf", tmp_path / "out.bin"
    path.parent.mkdir()
    for place in (path.parent / "a b.bin", out):
        place.write_bytes(data)
    (path.parent / "link.bin").symlink_to(out)
    (path.parent / "lfs.bin").write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    embedded = "data:application/octet-stream;base64," + base64.b64encode(data).decode()

    def read_from(uri, encoding="utf-8"):
        said["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(said), encoding=encoding)
        return checked(path).means.tolist()

    for uri, encoding in (("a%20b.bin", "utf-8-sig"), ("a%20b.bin", "utf-16"), (".\\a%20b.bin", "utf-8"),
                          (embedded, "utf-8")):  # fmt: skip
        assert TWO["POSITION"].tolist() == read_from(uri, encoding)
    refused = dict.fromkeys(("../out.bin", "link.bin", str(out), "http://a/b.bin", "no.bin", "", ".", "a\0b",
        "%2e%2e/out.bin", "data:,xx", "data:;base64,?", "x" * 5000), r"a\.gltf, buffers/0/uri: ")  # fmt: skip
    refused["lfs.bin"] = r"lfs\.bin' is a pointer of Git LFS"
    refused["LFS.bin"] = r"there is no file 'LFS\.bin', but 'lfs\.bin': rename it"
    for uri, message in refused.items():
        with pytest.raises(InputError, match=message):
            read_from(uri)


@pytest.mark.parametrize(("place", "value", "message"), [
    ("asset/version", "1.0", "expected 2.0"), ("asset", 3, "no asset"),
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
    ("accessors/0/count", 10**12, "in a view of"), ("accessors/0/count", 1, "POSITION 1"),
    ("accessors/0/count", -1, "whole number"), ("accessors/0/count", True, "found True"),
    ("accessors/0/byteOffset", 2**52, "in a view of"), ("accessors/0/componentType", [], "componentType: found"),
    ("accessors/0/type", {}, "type: found"), ("accessors/0/sparse", {}, "sparse"),
    ("bufferViews/0/byteLength", 10**9, "of a buffer"), ("bufferViews/0/byteStride", 4, "stride of 4"),
    ("bufferViews/0/extensions", {"EXT_meshopt_compression": {}}, "packed buffers"),
    ("bufferViews/0/buffer", 7, "buffers/7: there is no such object"),
    ("bufferViews/4/byteOffset", 5000, "of a buffer of"), ("buffers/0/uri", [], "uri: found"),
    ("nodes/0/children", [0], "more than one parent"), ("nodes/0/scale", [1, 0, 1], "singular"),
    ("nodes/0/scale", [1e200, 1e200, 1e200], "exceeds float32"), ("nodes/0/children", [1], "splats 0 to 1: "),
    ("nodes/0/rotation", [0, 0, 0, 0], "unit quaternion"), ("nodes/0/matrix", [1, 2], "expected 16 numbers"),
    ("nodes/0/translation", [1, 2, float("nan")], "expected 3 numbers"),
    ("scenes/0/nodes", [[]], "there is no such object"), ("scenes/0/nodes", "abc", "nodes: found"),
    ("scene", 5, "scenes/5"),
    ("nodes", [{"children": list(range(1, 99))}, *[{"mesh": 0}] * 98], "more than it has bytes"),
    ("meshes/0/primitives", [0] * 5, "found 0"),
])  # fmt: skip
def test_invalid_documents_are_refused_with_the_path(place, value, message):
    said, data = document(TWO)
    said["nodes"].append({"mesh": 0, "translation": [1, 2, 1e39]})
    said["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    *above, key = place.split("/")
    holder = said
    for step in above:
        holder = holder[int(step) if isinstance(holder, list) else step]
    holder[int(key) if isinstance(holder, list) else key] = value
    with pytest.raises(InputError, match=rf"^data.*{message}[^\n]*$"):
        read(said, data)


def test_drafts_and_too_many_instances_are_refused():
    draft, data = document({name.replace(f"{PREFIX}:", "_"): array for name, array in TWO.items()})
    draft["meshes"][0]["primitives"][0]["extensions"][PREFIX] = {}
    many_times, _ = document(TWO, nodes=[{"mesh": 1}] * 200, scenes=[{"nodes": [*range(200)]}])
    many_times["meshes"].append({"primitives": [{}] * 200})
    for said, message in ((draft, "an early draft of KHR_gaussian_splatting"), (many_times, "number 16385")):
        with pytest.raises(InputError, match=message):
            read(said, data)


def test_splats_that_are_not_finite_are_dropped_and_counted(tmp_path):
    path, whole = tmp_path / "a.glb", read(*document(many()))
    for name, value in (*((name, np.nan) for name in TWO), ("POSITION", np.inf)):
        arrays = many()
        arrays[name][3, 0] = value
        found, model = linted(path, *document(arrays))
        assert [("nonfinite-rows", "repair", 1)] == [(one.id, one.kind, one.count) for one in found.values()]
        assert np.delete(whole.means, 3, 0).tolist() == model.means.tolist()
        assert np.delete(whole.opacities, 3, 0).tolist() == model.opacities.tolist()
        arrays[name][:, 0] = value
        with pytest.raises(InputError, match="40 splats with NaN or infinity: none is left"):
            csplat.read(glb(*document(arrays)))


def test_huge_values_trailing_bytes_and_other_scenes_are_reported(tmp_path):
    arrays, path = many(), tmp_path / "a.glb"
    arrays[f"{PREFIX}:SH_DEGREE_0_COEF_0"][2] = 1e7
    arrays[f"{PREFIX}:SCALE"][7] = 3e38
    said, data = document(arrays, scenes=[{"nodes": [0]}, {"name": "roof", "nodes": []}])
    path.write_bytes(glb(said, data) * 2)
    found = {one.id: one for one in lint_file(path)}
    counts = {"huge-values": 2, "trailing-bytes": len(glb(said, data)), "other-scenes": 1}
    assert counts == {name: one.count for name, one in found.items()}
    assert "scene 0 is read, 1 ('roof') not" in found["other-scenes"].text
    assert ["huge-values"] == list(linted(path, said | {"scene": 0}, data)[0])


def test_short_buffers_and_rotations_of_length_0_are_reported(tmp_path):
    said, data = document(TWO | {f"{PREFIX}:ROTATION": np.zeros((2, 4), "<f4")})
    said["buffers"][0]["byteLength"] += 1000
    found, model = linted(tmp_path / "a.glb", said, data)
    assert {"short-buffer": 1, "zero-quats": 2} == {name: one.count for name, one in found.items()}
    assert [[1, 0, 0, 0]] * 2 == model.quats.tolist()
    assert TWO["POSITION"].tolist() == model.means.tolist()
    with pytest.raises(InputError, match="truncated"):
        read(said, data[:-8])


def test_logarithms_of_scales_are_recognised_by_their_sign(tmp_path):
    path, right = tmp_path / "a.glb", many()[f"{PREFIX}:SCALE"]
    for writer, scales, logs, findings in (
        ("writer 1", np.log(right), np.log(right), {"log-scales": "repair"}),
        ("other", np.full((40, 3), 5, "<f4"), np.log(5), {}),
        ("splat-transform 2.3.1", np.full((40, 3), 5, "<f4"), np.log(5), {"unclear-scales": "note"}),
    ):
        said = document(many(SCALE=scales), asset={"version": "2.0", "generator": writer})
        found, model = linted(path, *said)
        assert findings == {name: one.kind for name, one in found.items()}
        np.testing.assert_allclose(np.broadcast_to(logs, (40, 3)), model.scales, atol=1e-6)
        if writer == "writer 1":
            assert 40 == found["log-scales"].count
            assert "written by writer 1" in found["log-scales"].text
            with pytest.raises(InputError, match="log-scales"):
                csplat.read(path, strict=True)
    for values in ([-0.5], [-40.0] * 39):  # neither sizes nor logarithms
        scales = right.copy()
        scales[1 : 1 + len(values), 2] = values
        path.write_bytes(glb(*document(many(SCALE=scales))))
        with pytest.raises(InputError, match=rf"SCALE of splat 1 is {values[0]:g}, expected"):
            csplat.read(path)
        assert ["error"] == [one.kind for one in lint_file(path) if one.id == "negative-scales"]


def test_opacities_out_of_range_are_clipped_read_as_logits_or_refused(tmp_path):
    clipped, logits, wrong = (np.linspace(*ends, 40, dtype="<f4") for ends in ((0, 1.4), (-6, 6), (0, 255)))
    infinite = logits.copy()
    infinite[[4, 5]] = np.inf, -np.inf
    for values, wanted, findings in (
        (clipped, np.minimum(clipped, 1), {"out-of-range-opacities": 12}),
        (logits, 1 / (1 + np.exp(-logits)), {"logit-opacities": 37}),
        (infinite, 1 / (1 + np.exp(-infinite)), {"logit-opacities": 35, "infinite-logits": 2}),
    ):
        found, model = linted(tmp_path / "a.glb", *document(many(OPACITY=values[:, None])))
        assert findings == {name: one.count for name, one in found.items()}
        assert "repair" == next(iter(found.values())).kind
        np.testing.assert_allclose(wanted, model.opacities, atol=1e-6)
    with pytest.raises(InputError, match=r"OPACITY of splat 1 is 6\.53846, expected 0 to 1"):
        csplat.read(glb(*document(many(OPACITY=wrong[:, None]))))


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


def test_degree_5_is_refused_unless_fewer_bands_are_requested():
    names = [f"SH_DEGREE_{one}_COEF_{m}" for one in (1, 2, 3, 4, 5) for m in range(2 * one + 1)]
    data = glb(*document(TWO | {f"{PREFIX}:{name}": np.ones((2, 3), "<f4") for name in names}))
    with pytest.raises(InputError, match="SH degree 5, expected at most 4: --sh-degree 4"):
        csplat.read(data)
    assert [4, 1] == [csplat.read(data, sh_degree=degree).sh_degree for degree in (4, 1)]


OLD, NEW = "KHR_spz_gaussian_splats_compression", f"{PREFIX}_compression_spz_2"


def packed(tmp_path, model, name=NEW, *, bounds=None, draft=False):
    """Return the JSON and buffer of a GLB with an SPZ, under one of the extension's names, and the model in it."""
    csplat.write(tmp_path / "a.spz", with_facts(model, coordinate_system="RUB"))
    data, inner = (tmp_path / "a.spz").read_bytes(), {name: {"bufferView": 0}}
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
    if bounds is not None:
        said["accessors"][0] |= {"min": bounds.min(0).tolist(), "max": bounds.max(0).tolist()}
    return said, data, checked(data)


@pytest.mark.parametrize("name", [NEW, OLD])
@pytest.mark.parametrize("degree", [0, 3])
def test_spz_in_a_glb_is_read(tmp_path, make_model, name, degree):
    model = make_model(50, degree)
    model = replace(model, means=np.abs(model.means), means_double=None)  # so that a turned model leaves its bounds
    said, data, alone = packed(tmp_path, model, name, bounds=model.means)
    said["nodes"][0]["translation"] = [10, 20, 30]
    found, back = linted(tmp_path / "a.glb", said, data)
    assert ["spz-axes"] == list(found)
    assert ("LUF", degree, 50) == (back.metadata.coordinate_system, back.sh_degree, len(back))
    assert np.allclose(alone.means + np.array([10, 20, 30]), back.means, atol=1e-5)
    assert (alone.shN == back.shN).all()
    assert (alone.scales == back.scales).all()
    with pytest.raises(InputError, match=r"data, bufferViews/0 is not SPZ"):
        read(said, b"x" * len(data))
    said["accessors"][0]["count"] = 49
    with pytest.raises(InputError, match="POSITION: 49 rows, its SPZ has 50"):
        read(said, data)


def test_spz_in_a_glb_is_turned_if_its_bounds_allow_it(tmp_path, make_model):
    model, flip = replace(make_model(50, 1), means_double=None), np.float32([-1, 1, -1])
    for bounds in (model.means * flip, None):
        said, data, alone = packed(tmp_path, model, bounds=bounds)
        found, back = linted(tmp_path / "a.glb", said, data)
        assert {} == found
        assert np.allclose(alone.means * flip, back.means)
    said, data, _ = packed(tmp_path, model, draft=True)
    assert "CesiumJS" in linted(tmp_path / "a.glb", said, data)[0]["spz-axes"].text


@pytest.mark.slow
def test_damage_is_refused_or_read(tmp_path):
    whole, path = glb(*document(TWO)), tmp_path / "a.glb"
    texts = (b"[" * 100_000, b"{}", b"null", b'{"asset":{"version":"2.0"}}', b"9" * 5000, b"\xff")
    heads = [struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text for text in texts]
    assert all("a.glb" in one for one in refusals(path, heads, checked))
    assert_damage_is_refused_or_read(path, whole, range(0, len(whole), 3), range(0, len(whole), 3), checked)


def test_other_names_and_empty_scenes_are_not_written(tmp_path, make_model):
    for name, count, message in (("a.gltf", 2, r"name it a\.glb"), ("a.glb", 0, "no empty meshes")):
        with pytest.raises(InputError, match=message):
            csplat.write(tmp_path / name, make_model(count, 0))
    assert [] == list(tmp_path.iterdir())
