# SPDX-License-Identifier: Apache-2.0
"""csplat in glTF: the assets against their values, the pseudo-code of `spec/gltf.md`, writing, and violations.

Also: csplat.formats.gltf.csplat_payload.
"""

import itertools
import json
import re
import struct
import zlib
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from checked import assert_damage_is_refused_or_read, checked
from models import with_facts

import csplat
from csplat import _spec
from csplat.editing.transform import axes_rotation, rotate_scene
from csplat.errors import FormatError, InputError
from csplat.formats import format_by_name, formats, write_scene
from csplat.portable_math import exp

ROOT = Path(__file__).parents[3]
ASSETS = ROOT / "conformance" / "gltf"
NAME, PREFIX = "CSPLAT_gaussian_splatting_compression_1", "KHR_gaussian_splatting"
ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
SCHEMA = json.loads((ROOT / "spec" / "schema" / f"{NAME}.schema.json").read_text("utf-8"))
COMPRESSED = format_by_name("gltf-csplat")


def unpack(data):
    """Return the JSON and the buffer of a .glb."""
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def pack(root, buffer):
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def payload_of(data):
    """Return the .csplat file in a .glb with one primitive."""
    root, buffer = unpack(data)
    return buffer[: root["bufferViews"][0]["byteLength"]]


def columns_of(data):
    """Return the bytes of the accessors of each primitive of a .glb with plain accessors, by attribute."""
    root, buffer = unpack(data)
    sizes = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
    result = []
    for mesh in root["meshes"]:
        found = {}
        for name, index in mesh["primitives"][0]["attributes"].items():
            accessor = root["accessors"][index]
            view = root["bufferViews"][accessor["bufferView"]]
            if accessor["componentType"] == 5126:
                count = accessor["count"] * sizes[accessor["type"]]
                found[name] = buffer[view["byteOffset"] : view["byteOffset"] + 4 * count]
        result.append(found)
    return result


def same(model, other):
    return all(getattr(model, name).tobytes() == getattr(other, name).tobytes() for name in ARRAYS)


@pytest.fixture(scope="module")
def rules():
    """The pseudo-code of the page, as functions."""
    text = (ROOT / "spec" / "gltf.md").read_text(encoding="utf-8")
    names = {}
    for block in re.findall(r"```python spec-test\n(.*?)```", text, re.DOTALL):
        exec(block, names)  # noqa: S102 - the text is the project's own
    return SimpleNamespace(**names)


@pytest.mark.parametrize("name", ["axes", "sh_degrees", "extra_column", "large_coordinates"])
def test_assets_have_the_bits_of_their_plain_accessors(tmp_path, name):
    ours, plain = checked(ASSETS / f"{name}.glb"), checked(ASSETS / f"{name}_plain.glb")
    for array in set(ARRAYS) - {"scales"}:
        assert getattr(plain, array).tobytes() == getattr(ours, array).tobytes()
    assert plain.origin == ours.origin
    if name != "sh_degrees":  # our writer makes one primitive
        csplat.write(tmp_path / "plain.glb", csplat.read(ASSETS / f"{name}.glb"))
        (found,) = columns_of((tmp_path / "plain.glb").read_bytes())
        (expected,) = columns_of((ASSETS / f"{name}_plain.glb").read_bytes())
        assert found == {key: column for key, column in expected.items() if not key.startswith("_")}


def test_levels_are_refused_by_their_clause():
    with pytest.raises(InputError, match=r"levels\.glb, bufferViews/0: .*GLT-8: it has levels"):
        csplat.read(ASSETS / "levels.glb")


def test_objects_fit_the_schema():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    validator = jsonschema.Draft202012Validator(SCHEMA)
    for path in ASSETS.glob("*.glb"):
        root, _ = unpack(path.read_bytes())
        for mesh in root["meshes"]:
            within = mesh["primitives"][0]["extensions"][PREFIX].get("extensions", {})
            assert all(validator.is_valid(found) for found in within.values())
    good = {"bufferView": 0, "profile": 0, "level": "A"}
    bad = [{"level": "D"}, {"profile": "base"}, {"bufferView": -1}]
    assert [True, False, False, False] == [validator.is_valid(good | change) for change in ({}, *bad)]


@pytest.mark.parametrize("axes", ["unspecified", *map("".join, itertools.product("RL", "UD", "FB"))])
def test_the_pseudo_code_converts_as_we_do(rules, make_model, axes):
    model = make_model(5, 3, coordinate_system=axes)
    known = "RDF" if axes == "unspecified" else axes
    turned = rotate_scene(with_facts(model, coordinate_system=known), axes_rotation(known, "LUF"))
    signs = rules.axis_signs(known)
    assert turned.means.tolist() == [rules.position(mean, signs) for mean in model.means.tolist()]
    assert turned.quats[:, [1, 2, 3, 0]].tolist() == [[*rules.rotation(q, signs)] for q in model.quats.tolist()]
    assert model.scales.tolist() == turned.scales.tolist()
    for degree in (1, 2, 3):
        for n in range(2 * degree + 1):
            sign, at = rules.sh_sign(degree, n - degree, signs), degree * degree - 1 + n
            assert (turned.shN[:, at] == sign * model.shN[:, at]).all()


def test_scales_are_the_nearest_numbers_to_exponentials():
    close = np.float32([0.0, -88.0, 88.72283, 1e-8, -1e-8, -103.9, *np.linspace(-95, 88, 300)])
    for scale, found in zip(close, exp(close).astype(np.float32), strict=True):
        exact = Decimal(float(scale)).exp()
        others = np.nextafter(found, np.float32([-np.inf, np.inf]))
        assert abs(Decimal(float(found)) - exact) <= min(abs(Decimal(float(one)) - exact) for one in others)


def test_a_file_is_embedded_as_it_is(tmp_path, make_model):
    model = make_model(300, 3, origin=(1.5, -2.0, 0.25), antialiased=True, entries={"licence": "CC0"})
    model = replace(model, extra={"label": np.arange(300, dtype="<u2"), "é id": np.ones(300, "<f8")})
    columns = {"n": np.ones((300, 3), "<f4"), "wide": np.ones((300, 5), "<u1")}
    model = replace(model, extra={**model.extra, **columns})
    csplat.encode(model, csplat.EncodeOptions(keep_extra=True), out=tmp_path / "a.csplat")
    with csplat.open(tmp_path / "a.csplat") as scene:
        assert [] == write_scene(tmp_path / "a.csplat.glb", scene)
    data = (tmp_path / "a.csplat.glb").read_bytes()
    assert (tmp_path / "a.csplat").read_bytes() == payload_of(data)
    root, _ = unpack(data)
    assert [PREFIX, NAME] == root["extensionsUsed"] == root["extensionsRequired"]
    assert "CC0" == root["asset"]["copyright"]
    assert [-1.5, 2.0, 0.25] == root["nodes"][0]["translation"]
    attributes = root["meshes"][0]["primitives"][0]["attributes"]
    assert {"count": 300, "type": "SCALAR", "componentType": 5123} == root["accessors"][attributes["_label"]]
    assert {"count": 300, "type": "SCALAR", "componentType": 5126} == root["accessors"][attributes["_é id"]]
    assert {"count": 300, "type": "VEC3", "componentType": 5126} == root["accessors"][attributes["_n"]]
    assert [f"_wide_{k}" for k in range(5)] == [name for name in attributes if name.startswith("_wide")]
    decoded, back = csplat.decode(tmp_path / "a.csplat"), csplat.read(tmp_path / "a.csplat.glb", keep_extra=True)
    assert same(decoded, back)
    assert (decoded.origin, "CC0", True) == (back.origin, back.metadata.licence, back.metadata.antialiased)
    assert all((decoded.extra[name] == back.extra[name]).all() for name in model.extra)


def test_levels_and_far_origins_are_left_out_without_a_change_of_values(tmp_path, make_model):
    model = make_model(3000, 1, origin=(4e6, 1.25, -3e5), unit_metres=1.0)
    csplat.encode(model, csplat.EncodeOptions(tile_splats=400), out=tmp_path / "a.csplat", levels=1)
    with csplat.open(tmp_path / "a.csplat") as scene:
        assert 2 == len(scene.levels)
        write_scene(tmp_path / "a.glb", scene, "gltf-csplat")
        finest = scene.read()
    payload = csplat.open(payload_of((tmp_path / "a.glb").read_bytes()))
    assert () == payload.levels
    assert (0.0, 0.0, 0.0) == payload.origin
    assert payload.declared_bounds is not None
    back = csplat.read(tmp_path / "a.glb")
    assert same(finest, back)
    assert finest.origin == back.origin


def test_other_scenes_are_encoded(tmp_path, make_model):
    path = tmp_path / "a.glb"
    model = make_model(200, 4, coordinate_system="RFU", unit_metres=0.5)  # z up: other axes than GLT-9 allows
    (finding,) = csplat.write(path, model, "gltf-csplat")
    assert "SH band 4" in finding.text
    root, _ = unpack(path.read_bytes())
    assert 0.5 == root["nodes"][0]["matrix"][0]
    back = checked(path)
    assert (3, "LUF", 1.0) == (back.sh_degree, back.metadata.coordinate_system, back.metadata.unit_metres)
    csplat.write(tmp_path / "plain.glb", model)
    plain = checked(tmp_path / "plain.glb")
    middle = [np.sort(one.means, axis=0)[[0, 99, 199]] for one in (plain, back)]
    assert np.abs(middle[0] - middle[1]).max() < 0.01 * np.ptp(plain.means)
    upright = make_model(50, 0, entries={"up": [0.0, 0.6, 0.8]})
    csplat.write(path, upright, "gltf-csplat")
    assert np.allclose(checked(path).metadata.up, [0, 1, 0], atol=1e-5)
    root, _ = unpack(path.read_bytes())
    assert np.allclose([0, 1, 0], np.reshape(root["nodes"][0]["matrix"], (4, 4)).T[:3, :3] @ [0, -0.6, 0.8])
    linear = make_model(9, 0, colour_space="lin_rec709_display")
    csplat.write(path, linear, "gltf-csplat")
    assert b"lin_rec709_display" in path.read_bytes()
    with csplat.open(path) as scene:
        assert "linear-colours" in {finding.id for finding in scene.findings}


def test_scenes_that_gltf_cannot_describe_are_refused(tmp_path, make_model):
    for model, name, message in (
        (make_model(9, 0, colour_space="130"), "a.glb", "colour space is 130, which has no name in glTF"),
        (make_model(0, 0), "a.glb", "no splats are left"),
        (make_model(9, 0), "a.gltf", r"name it a\.glb"),
    ):
        with pytest.raises(InputError, match=message):
            csplat.write(tmp_path / name, model, "gltf-csplat")
    assert [] == list(tmp_path.iterdir())
    csplat.encode(make_model(50, 1), out=tmp_path / "a.csplat")
    data = bytearray((tmp_path / "a.csplat").read_bytes())
    data[-9] ^= 1
    with csplat.open(bytes(data)) as scene, pytest.raises(FormatError):
        write_scene(tmp_path / "a.glb", scene, "gltf-csplat")
    assert not (tmp_path / "a.glb").exists()


EXTENSIONS = f"meshes/0/primitives/0/extensions/{PREFIX}"
OBJECT = f"{EXTENSIONS}/extensions/{NAME}"
ATTRIBUTES = "meshes/0/primitives/0/attributes"


@pytest.mark.parametrize(("place", "value", "message"), [
    ("meshes/0/primitives/0/mode", 4, "mode: found 4, expected 0"),
    (f"{OBJECT}/bufferView", 9, "bufferViews/9: there is no such object"),
    (f"{OBJECT}/bufferView", None, "bufferView: found None"),
    (f"{OBJECT}/profile", 1, r"profile: found 1, its .csplat file has 0 \(GLT-5\)"),
    (f"{OBJECT}/profile", False, "profile: found False"),
    (f"{OBJECT}/level", "B", r"level: found 'B', its .csplat file has 'A' \(GLT-5\)"),
    (OBJECT, 3, "found 3"),
    (f"{EXTENSIONS}/kernel", "beta", "kernel: found 'beta'"),
    (f"{EXTENSIONS}/colorSpace", "lin_rec709_display", r"colorSpace: found .* has 'srgb_rec709_display' \(GLT-6\)"),
    (f"{EXTENSIONS}/projection", "fisheye", "projection: found 'fisheye'"),
    ("bufferViews/0/byteOffset", 2, "byteOffset: it is no multiple of 4"),
    ("bufferViews/0/byteStride", 4, "byteStride: a .csplat file has none"),
    ("bufferViews/0/byteLength", 10**6, "of a buffer of"),
    ("accessors/1/count", 3, "accessors/1/count: found 3, its .csplat file has 4 splats"),
    ("accessors/2/type", "VEC4", "found VEC4 of 5126, expected VEC3 of 5126"),
    ("accessors/3/componentType", 5121, "found SCALAR of 5121, expected SCALAR of 5126"),
    ("accessors/0/max", [1, 2], "max: found"), ("accessors/0/min", [0, 0, 1e39], r"min: found .* \(GLT-12\)"),
    ("accessors/1/bufferView", 0, "some accessors of splats have a bufferView"),
    (f"{ATTRIBUTES}/{PREFIX}:SH_DEGREE_2_COEF_0", 0, "its .csplat file has no such attribute"),
    (f"{ATTRIBUTES}/_mine", 99, "accessors/99: there is no such object"),
    (f"{ATTRIBUTES}/{PREFIX}:SCALE", None, f"there is no {PREFIX}:SCALE, which its .csplat file has"),
])  # fmt: skip
def test_violations_are_refused_with_their_place(place, value, message):
    root, buffer = unpack((ASSETS / "large_coordinates.glb").read_bytes())
    *above, key = place.split("/")
    holder = root
    for step in above:
        holder = holder[int(step) if isinstance(holder, list) else step]
    if value is None:
        del holder[key]
    else:
        holder[int(key) if isinstance(holder, list) else key] = value
    with pytest.raises(InputError, match=rf"^data.*{message}[^\n]*$"):
        csplat.read(pack(root, buffer))


def sealed(payload, **changes):
    """Return a .csplat file with other fields of its index head, and correct CRCs."""
    data = bytearray(payload)
    size = _spec.unpack_header(payload).index_size
    head = _spec.unpack_index_head(payload, _spec.HEADER_SIZE)
    packed = _spec.pack_index_head(head._replace(**changes))
    data[_spec.HEADER_SIZE : _spec.HEADER_SIZE + len(packed)] = packed
    end = _spec.HEADER_SIZE + size - 4
    data[end : end + 4] = struct.pack("<I", zlib.crc32(data[_spec.HEADER_SIZE : end]))
    return bytes(data)


def test_payloads_that_break_a_clause_are_refused_by_it():
    data = (ASSETS / "large_coordinates.glb").read_bytes()
    root, buffer = unpack(data)
    payload = payload_of(data)
    for changes, message in (
        ({"origin": (2.0**20 + 1, 0.0, 0.0)}, "GLT-10: its origin"),
        ({"axes": bytes([1, 5, 3])}, "GLT-9: its axes are RFU"),
        ({"colour_space": 130}, "GLT-6: its colour space is 130"),
        ({"projection": 130}, "GLT-6: its projection is 130"),
    ):
        with pytest.raises(InputError, match=message):
            csplat.read(pack(root, sealed(payload, **changes) + buffer[len(payload) :]))


def test_errors_of_the_payload_keep_their_code(tmp_path):
    data = (ASSETS / "large_coordinates.glb").read_bytes()
    root, buffer = unpack(data)
    last = len(payload_of(data)) - 1
    changed = ((0, "E_MAGIC"), (40, "E_CRC"), (last, "E_CRC"))
    for broken, code in ((buffer[:at] + bytes([buffer[at] ^ 8]) + buffer[at + 1 :], code) for at, code in changed):
        (tmp_path / "a.glb").write_bytes(pack(root, broken))
        with pytest.raises(FormatError) as caught:
            csplat.read(tmp_path / "a.glb")
        assert (code, f"{tmp_path / 'a.glb'}, buffer view 0") == (caught.value.code, caught.value.path)


def test_damage_is_refused_or_read(tmp_path):
    def read(path):
        try:
            return csplat.read(path)
        except FormatError as error:
            raise InputError(f"{path.name}: {error}") from None

    whole = (ASSETS / "axes.glb").read_bytes()
    places = range(0, len(whole), 7)
    assert_damage_is_refused_or_read(tmp_path / "a.glb", whole, range(0, len(whole), 97), places, read)


def test_further_attributes_and_fallbacks_are_allowed():
    ours, plain = ((ASSETS / f"large_coordinates{end}.glb").read_bytes() for end in ("", "_plain"))
    (root, buffer), (other, more) = unpack(ours), unpack(plain)
    root["accessors"].append({**root["accessors"][3], "bufferView": 1})
    root["bufferViews"].append({"buffer": 0, "byteOffset": len(buffer), "byteLength": 16})
    root["meshes"][0]["primitives"][0]["attributes"]["_FEATURE_ID_0"] = len(root["accessors"]) - 1
    root["buffers"][0]["byteLength"] = len(buffer) + 16
    assert same(csplat.read(ours), csplat.read(pack(root, buffer + bytes(16))))
    root, _ = unpack(ours)
    root["bufferViews"] += [{**view, "byteOffset": view["byteOffset"] + len(buffer)} for view in other["bufferViews"]]
    root["accessors"] = [{**one, "bufferView": one["bufferView"] + 1} for one in other["accessors"]]
    root["buffers"][0]["byteLength"] = len(buffer) + len(more)
    del root["extensionsRequired"]
    assert same(csplat.read(ours), csplat.read(pack(root, buffer + more)))


def test_one_file_may_be_shown_twice():
    root, buffer = unpack((ASSETS / "extra_column.glb").read_bytes())
    root["nodes"].append({"mesh": 0, "translation": [1, 0, 0], "scale": [2, 2, 2]})
    root["scenes"][0]["nodes"].append(1)
    model = checked(pack(root, buffer))
    assert 6 == len(model)
    assert np.allclose(model.means[:3] * 2 + [1, 0, 0], model.means[3:])
    assert (model.extra["id"][:3] == model.extra["id"][3:]).all()


def test_the_format_is_listed():
    assert COMPRESSED in formats()
    assert COMPRESSED.carries > format_by_name("gltf").carries
