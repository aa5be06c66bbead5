# SPDX-License-Identifier: Apache-2.0
"""SOG, versions 1 and 2, in folders, zips and levels: files built byte by byte, and round trips.

Also: csplat.formats.sog.sog_files, csplat.formats.sog.sog_reader, csplat.formats.sog.sog_writer,
csplat.formats.sog.streamed_writer.
"""

import io
import json
import os
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from checked import assert_damage_is_refused_or_read, flipped, refusals
from formats_cases import same, zip_of
from models import with_facts
from tables import failures

import csplat
from csplat.errors import InputError
from csplat.formats import detect_format, read_scene, write_levels
from csplat.formats.sog.sog_reader import read_leaf_numbers
from csplat.model import SplatModel, normalise_quats
from csplat.scene import Scene
from csplat.scene_metadata import SceneMetadata
from csplat_conformance.manifest import VECTORS
from csplat_conformance.validator import validate
from csplat_tools.convert_file import Filters, convert_file
from csplat_tools.encode_file import encode_file

Image = pytest.importorskip("PIL.Image", reason="SOG is pictures")
COUNT = 5
RICH = VECTORS / "valid" / "levels_of_the_rich_scene.csplat"


def webp(pixels, *, lossless=True):
    buffer = io.BytesIO()
    Image.fromarray(pixels, "RGBA").save(buffer, "WEBP", lossless=lossless, exact=True)
    return buffer.getvalue()


def pixels(seed, shape=(4, 4)):
    return np.random.default_rng(seed).integers(0, 256, (*shape, 4), np.uint8)


def splats(version=2, sh=True):
    """Return the metadata and images of a SOG of five splats."""
    names = ("means_l", "means_u", "quats", "scales", "sh0")
    pictures = {f"{name}.webp": pixels(seed) for seed, name in enumerate(names)}
    pictures["quats.webp"][..., 3] = 252 + np.arange(16).reshape(4, 4) % 4
    meta = {name: {"files": [f"{name}.webp"]} for name in ("scales", "quats", "sh0")}
    meta["means"] = {"mins": [-1, 0, 2.5], "maxs": [1, 0, 3], "files": ["means_l.webp", "means_u.webp"]}
    if version == 2:
        meta |= {"version": 2, "count": COUNT, "model": "antialiased"}
        meta["scales"]["codebook"] = [index / 16 - 12 for index in range(256)]
        meta["sh0"]["codebook"] = [index / 64 - 2 for index in range(256)]
        rest = {"count": 64, "bands": 1, "codebook": [index / 128 - 1 for index in range(256)]}
    else:
        meta["means"]["shape"] = [COUNT, 3]
        meta["scales"] |= {"mins": [-9, -8, -7], "maxs": [-3, -2, -1]}
        meta["sh0"] |= {"mins": [-2, -1, 0, -5], "maxs": [2, 1, 3, 5]}
        rest = {"mins": -0.5, "maxs": 0.5}
    if sh:
        pictures |= {"palette.webp": pixels(7, (1, 192)), "labels.webp": pixels(8)}
        pictures["labels.webp"][..., :2] = [63, 0]
        meta["shN"] = {"files": ["palette.webp", "labels.webp"], **rest}
    return meta, pictures


def files_of(meta, pictures):
    return {"meta.json": json.dumps(meta).encode(), **{name: webp(one) for name, one in pictures.items()}}


def zipped(path, files, folder="", how=zipfile.ZIP_STORED):
    path.write_bytes(zip_of([(folder + name, data) for name, data in files.items()], how))
    return path


def foldered(path, files):
    for name, data in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(data)
    return path


@pytest.mark.parametrize("version", [1, 2])
def test_both_versions_are_read(tmp_path, version):
    meta, pictures = splats(version)
    model = csplat.read(zipped(tmp_path / "a.sog", files_of(meta, pictures)))
    flat = {name: one.reshape(-1, 4)[:COUNT].astype(int) for name, one in pictures.items() if name != "palette.webp"}
    scales, colours, palette = flat["scales.webp"][:, :3], flat["sh0.webp"], pictures["palette.webp"][0, -3:, :3]
    if version == 2:
        scales, sh0, shN = scales / 16 - 12, colours[:, :3] / 64 - 2, palette / 128 - 1
        opacities = colours[:, 3] / 255
    else:
        scales, shN = scales / 255 * 6 + [-9, -8, -7], palette / 255 - 0.5
        sh0 = colours[:, :3] / 255 * [4, 2, 3] - [2, 1, 0]
        opacities = 1 / (1 + np.exp(5 - colours[:, 3] / 25.5))
    low, high = (flat[f"means_{end}.webp"][:, :3] for end in "lu")
    logs = [-1, 0, 2.5] + (low + 256 * high) / 65535 * [2, 0, 0.5]
    np.testing.assert_allclose(model.means, np.sign(logs) * np.expm1(np.abs(logs)), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(model.scales, scales, rtol=1e-6)
    np.testing.assert_allclose(model.sh0, sh0, atol=1e-6)
    np.testing.assert_allclose(model.opacities, opacities, rtol=1e-5)
    np.testing.assert_allclose(model.shN[[0, 4]], [shN, shN], atol=1e-6)
    three = (flat["quats.webp"][1, :3] / 255 * 2 - 1) / 2**0.5  # x of splat 1 is omitted
    quat = np.array([three[0], np.sqrt(max(0, 1 - (three**2).sum())), *three[1:]])
    np.testing.assert_allclose(model.quats[1], quat / np.linalg.norm(quat), atol=1e-6)
    assert (version == 2, False) == (model.metadata.antialiased, model.metadata.flat)


def test_folder_json_and_zip_give_the_same_scene(tmp_path):
    files = files_of(*splats())
    folder = foldered(tmp_path / "a", files)
    paths = [folder, folder / "meta.json", zipped(tmp_path / "b", files, "inside/", zipfile.ZIP_DEFLATED)]
    assert ["sog"] * 3 == [detect_format(path).name for path in paths]
    for path in paths[1:]:
        same(csplat.read(folder), csplat.read(path))


def test_tags_of_rotations_and_the_first_entry_of_a_codebook_may_be_missing(tmp_path):
    meta, pictures = splats()
    pictures["quats.webp"][0, 0, 3] = 17
    meta["scales"]["codebook"][0] = None
    pictures["scales.webp"][:] = 0
    with csplat.open(zipped(tmp_path / "a.sog", files_of(meta, pictures))) as scene:
        assert [1, 0, 0, 0] == scene.model().quats[0].tolist()
        assert [("zero-quats", 1)] == [(one.id, one.count) for one in scene.findings]
        np.testing.assert_allclose(scene.model().scales, 1 / 16 - 12 - 254 / 16 / 255, rtol=1e-6)  # extrapolated


def all_of(folder):
    """Return all files of a folder by name."""
    return {one.relative_to(folder).as_posix(): one.read_bytes() for one in folder.rglob("*") if one.is_file()}


def levels(tmp_path, **changes):
    """Write a streamed SOG: two files of the finest level, a coarser one, and an environment."""
    files = {}
    for number, name in enumerate(("0_0", "0_1", "1_0", "env")):
        meta, pictures = splats(sh=number == 1)
        meta["sh0"]["codebook"] = [float(number)] * 256
        files |= {f"{name}/{part}": data for part, data in files_of(meta, pictures).items()}
    one = {"0": {"file": 0, "offset": 0, "count": 5}, "1": {"file": 2, "offset": 0, "count": 3}}
    two = {"0": {"file": 1, "offset": 1, "count": 3}, "1": {"file": 2, "offset": 3, "count": 2}}
    meta = {
        "lodLevels": 2, "environment": "env/meta.json",
        "filenames": [f"{name}/meta.json" for name in ("0_0", "0_1", "1_0")],
        "tree": {"children": [{"lods": one}, {"lods": two}]}, **changes,
    }  # fmt: skip
    return foldered(tmp_path / "a", {**files, "lod-meta.json": json.dumps(meta).encode()})


@pytest.mark.slow
def test_leaves_of_streamed_sog_are_numbered_and_become_nodes_of_a_file(tmp_path):
    path, out = levels(tmp_path), tmp_path / "out.csplat"
    assert [0] * 5 + [1] * 3 + [2] * 5 == read_leaf_numbers(path).tolist()
    assert [0] * 3 + [1] * 2 + [2] * 5 == read_leaf_numbers(path / "lod-meta.json", 1).tolist()
    with pytest.raises(InputError, match="it is not streamed SOG"):
        read_leaf_numbers(foldered(tmp_path / "b", files_of(*splats())))
    encode_file(str(path), str(out), csplat.EncodeOptions(), levels=1)
    assert () == tuple(validate(out.read_bytes()).violations)
    with csplat.open(out) as file:
        nodes = [(node.level, node.parent, node.splat_count) for node in file.nodes]
        assert [(0, 3, 5), (0, 4, 3), (0, None, 5), (1, None, 3), (1, None, 2)] == nodes
        assert 10 == len(file.read(tiles=file.cut(level=1)))
        assert all(node.error > 0 for node in file.nodes if node.level)


def files_read(path, level):
    """Return the file of `levels` from which each splat comes, by its first colour."""
    with csplat.open(path, level=level) as scene:
        return scene.model().sh0[:, 0].tolist()


@pytest.mark.slow
def test_a_level_is_read_with_the_nearest_of_parts_without_it(tmp_path):
    path, finest = levels(tmp_path), [0] * 5 + [1] * 3 + [3] * 5
    files = all_of(path)
    junk = {"__MACOSX/meta.json": b"", "__MACOSX/0_0/._meta.json": b""}
    below = {f"a/b/{name}": data for name, data in files.items()}
    zips = [zipped(tmp_path / f"{number}.zip", one | junk) for number, one in enumerate((files, below))]
    for place in (path, path / "lod-meta.json", *zips):
        assert (finest, [2] * 5 + [3] * 5) == (files_read(place, 0), files_read(place, 1))
    with csplat.open(path) as scene:
        model = scene.model()
        assert (13, (13, 10), 1, True) == (scene.count, scene.levels, model.sh_degree, model.metadata.antialiased)
    assert [5, 6, 7] == np.flatnonzero(model.shN.any(axis=(1, 2))).tolist()
    with pytest.raises(InputError, match="level is 2, expected 0 to 1"):
        files_read(path, 2)
    (path / "env" / "meta.json").unlink()
    with pytest.raises(InputError, match=r"there is no env/meta\.json"):
        csplat.read(path)
    one, two = {"1": {"file": 0, "offset": 0, "count": 5}}, {"0": {"file": 1, "offset": 1, "count": 3}}
    path = levels(tmp_path, tree={"children": [{"lods": one}, {"lods": two}]})
    assert finest == files_read(path, 0) == files_read(path, 1)


def test_zips_of_several_scenes_and_of_other_programs_are_refused(tmp_path):
    folder, other = levels(tmp_path), files_of(*splats())
    files = all_of(folder)
    nested = files | {"lod-meta.json": files["lod-meta.json"].replace(b"0_0/meta.json", b"0_0.sog")}
    within = {name: data for name, data in nested.items() if name != "0_0/meta.json"}
    foreign = {"meta.json": b'{"app": "a scanner"}', "room.ply": b"ply"}
    not_sog = "meta.json is not the one of SOG, which has means, quats, scales, sh0; .*"
    scene, again = ({f"{place}/{name}": data for name, data in other.items()} for place in ("a", "b"))
    for contents, message in (
        (scene | again, r"2 scenes, expected one \(a/meta.json, b/meta.json\): unpack it"),
        (again | files, r"2 scenes, .*b/meta.json, lod-meta"),
        (nested, r"0_0/meta.json, lod-meta.json"),
        (within, r"0_0.sog is not a .json; a SOG within a zip cannot be a zip itself: unpack a.zip"),
        ({"lod-meta.json": b'{"filenames": 3}', "x/meta.json": b"{}"}, "2 scenes"),
        (scene | {"scene.ply": b"ply"}, r"it contains 2 scenes, expected one \(a/meta.json, scene.ply\)"),
        (foreign, not_sog + r"a zip that contains room\.ply: unzip it"),
    ):
        with pytest.raises(InputError, match=message):
            csplat.read(zipped(tmp_path / "a.zip", contents))
    found = read_scene(zipped(tmp_path / "a.zip", {**scene, "a/b/scene.PLY": b"ply"}))
    assert COUNT == found.count
    assert [("note", "the zip also holds a/b/scene.PLY: not read")] == [(one.kind, one.text) for one in found.findings]
    with pytest.raises(InputError, match=not_sog + r"a folder, not a scene: name room\.ply"):
        csplat.read(foldered(tmp_path / "foreign", foreign))
    foldered(folder, other)
    with pytest.raises(InputError, match=r"lod-meta.json, meta.json\): name one of these files"):
        csplat.read(folder)
    assert [COUNT, 13] == [len(csplat.read(folder / name)) for name in ("meta.json", "lod-meta.json")]


def test_names_in_a_zip_may_contain_backslashes_and_capitals(tmp_path):
    folder = levels(tmp_path, filenames=[rf"{name}\meta.json" for name in ("0_0", "0_1", "1_0")])
    files = files_of(*splats())
    loud = {name.upper() if name == "meta.json" else name: data for name, data in files.items()}
    slashes, capitals = "backslashes in {}, read as slashes", "META.JSON is read as meta.json"
    for path, message in (
        (folder, slashes.format("filenames")),
        (zipped(tmp_path / "a.zip", all_of(folder)), slashes.format("filenames")),
        (zipped(tmp_path / "b.zip", files, "scene\\"), slashes.format("the names of the zip")),
        (zipped(tmp_path / "c.sog", loud), capitals),
        (zipped(tmp_path / "d.zip", loud, "scene/"), capitals),
    ):
        found = read_scene(path)
        model, report = found.model(), found.findings
        assert [("note", message)] == [(one.kind, one.text) for one in report]
        assert (13 if "filenames" in message else COUNT) == len(model)
    two = {**{name: data for name, data in files.items() if name != "sh0.webp"}, "SH0.webp": b"", "Sh0.webp": b""}
    for contents, message in (
        ({**files, "META.JSON": files["meta.json"]}, "2 scenes"),
        (two, r"SH0\.webp and Sh0\.webp would both be sh0\.webp"),
    ):
        with pytest.raises(InputError, match=message):
            csplat.read(zipped(tmp_path / "e.sog", contents))


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "message"), [
    ({"version": 2}, "version 2 of streamed"), ({"tree": {"lods": 3}}, "not an object"),
    ({"filenames": ["../a", "b", "c"]}, "outside"), ({"filenames": []}, "integer from 0"),
    ({"tree": {"children": 3}}, "not a list"),
    ({"tree": {"lods": {"0": {"file": 0, "offset": 4, "count": 2}}}}, "up to 6"),
    ({"tree": {"lods": {"x": {"file": 0, "offset": 4, "count": 2}}}}, "level is 'x'"),
    ({"tree": {"children": [{"lods": {"0": {"file": 0, "offset": 0, "count": 2}}}] * 2}}, "meta.json twice"),
])  # fmt: skip
def test_inconsistent_levels_are_refused(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        csplat.read(levels(tmp_path, **changes))


FILES = {version: files_of(*splats(version)) for version in (1, 2)}
GOOD = FILES[2]


def changed(place, value, version=2):
    """Return the files of a SOG with another value at a place of its metadata; `None` leaves it out."""
    meta, _ = splats(version)
    *above, key = place.split("/")
    holder = meta[above[0]] if above else meta
    holder[key] = value
    if value is None:
        del holder[key]
    return FILES[version] | {"meta.json": json.dumps(meta).encode()}


BAD = (
    ("version", 3, "version 3"), ("count", 17, "pixels"), ("count", 200_000_000, "declares 200,000,000 splats"),
    ("count", 10**400, "an integer has 401 digits"), ("count", 5.0, "expected an integer"),
    ("count", True, "expected an integer"), ("count", None, "count is missing"),
    ("quats/files", [], "quats files has 0 names"), ("quats/files", [7], "not a string"),
    ("quats/files", ["../quats.webp"], "outside"), ("quats/files", ["q.webp"], "no q"),
    ("means", [], "means mins is missing"), ("means/mins", [1, 2], "means mins has 2 numbers"),
    ("means/mins", [0, 0, float("inf")], "finite"), ("means/mins", [0, 0, "0"], "finite"),
    ("means/maxs", [0, 0, 300], "float32"), ("means/mins", [9, 9, 9], "means has mins 9, expected at most maxs"),
    ("scales/codebook", [1.0], "codebook is shorter"), ("sh0/codebook", [], "codebook has 0 numbers"),
    ("shN/codebook", [1.0], "beyond the codebook"), ("shN/bands", 4, "from 0 to 3"),
    ("shN/bands", 2, "192 x 1 pixels"), ("shN/count", 63, "SH label 63 in a palette of 63"),
    ("shN/count", 65, "192 x 1 pixels"),
)  # fmt: skip
BAD_FILES = (
    ("quats.webp", b"version https://git-lfs.github.com/spec/v1\noid", "quats.webp is a pointer of"),
    ("quats.webp", webp(pixels(1, (8, 4))), "4 x 8 pixels"),
    ("means_l.webp", webp(np.zeros((900, 900, 4), np.uint8)), "900 x 900"),
    ("means_l.webp", b"no picture", "means_l.webp is not an image"),
    ("scales.webp", webp(pixels(3), lossless=False), "scales.webp is a lossy WebP, expected"),
    ("means_l.webp", webp(pixels(0))[:50], "means_l.webp is a WebP that is damaged"),
    ("meta.json", b"[" * 100_000, "nested too deep"), ("meta.json", b"{", "not JSON"),
    ("meta.json", b"3", "is missing"), ("meta.json", b"\xff\xff\xff", "not JSON"),
)  # fmt: skip


@pytest.mark.slow
def test_inconsistent_files_are_refused(tmp_path):
    cases = [(changed(place, value), message) for place, value, message in BAD]
    cases += [(changed("scales/mins", [9, 9, 9], version=1), "scales has mins 9")]
    cases += [(GOOD | {name: data}, message) for name, data, message in BAD_FILES]

    def check(case):
        files, message = case
        with pytest.raises(InputError, match=rf"^a\.sog: .*{message}"):
            csplat.read(zipped(tmp_path / "a.sog", files))

    assert [] == failures({f"{number}, {case[1]}": case for number, case in enumerate(cases)}, check)
    path, data = tmp_path / "b.sog", zip_of(GOOD.items())
    for size in (len(data) // 2, len(data) - 5):
        path.write_bytes(data[:size])
        with pytest.raises(InputError, match=r"b\.sog: a damaged zip: its end is missing, .*: copy or download it aga"):
            csplat.read(path)
    with pytest.raises(InputError, match="unpacked size of 30,000,000"):
        csplat.read(zipped(path, GOOD | {"meta.json": b" " * 30_000_000}, how=zipfile.ZIP_DEFLATED))


@pytest.mark.slow
def test_damage_is_refused_or_read(tmp_path):
    files = files_of(*splats(1, sh=False))
    path, folder = zipped(tmp_path / "a.sog", files), foldered(tmp_path / "b", files)
    whole, picture = path.read_bytes(), files["sh0.webp"]
    sizes, places = range(0, len(whole), 97), range(0, len(whole), 31)
    assert_damage_is_refused_or_read(path, whole, sizes, places, lambda path: csplat.read(path, "sog"))
    damaged = flipped(picture, range(0, len(picture), 5), lambda at: 1 << at // 5 % 8)
    messages = refusals(folder / "sh0.webp", damaged, lambda _: csplat.read(folder))
    assert all(not one or one.startswith("b: sh0.webp") for one in messages)


def assert_within_a_step(model, back, means):
    """Assert that splats in the same order differ by the steps of SOG, in `means` by this tolerance."""
    assert np.abs(model.means - back.means).max() < means
    assert np.abs(model.opacities - back.opacities).max() <= 0.5 / 255 + 1e-7
    assert np.abs((model.quats * back.quats).sum(axis=1)).min() > 1 - 4e-5
    for name, most in (("scales", 0.02), ("sh0", 0.02), ("shN", 0.6)):
        assert np.sqrt(np.mean((getattr(model, name) - getattr(back, name)) ** 2)) < most


@pytest.mark.slow
def test_written_files_read_back_within_a_step_and_equal_a_folder(tmp_path, make_model):
    model, path, folder = make_model(600, 1, antialiased=True), tmp_path / "a.sog", tmp_path / "c"
    csplat.write(path, model)
    csplat.write(folder / "meta.json", model)
    back, first = csplat.read(path), path.read_bytes()
    assert back.metadata.antialiased
    rows = np.array([np.argmin(((model.means - one) ** 2).sum(1)) for one in back.means])
    assert 600 == len(set(rows))
    # Half of the largest step: 65,535 steps divide the logarithms.
    reach = np.abs(model.means.astype(float)).max()
    assert_within_a_step(model.select(rows), back, np.log1p(reach) / 65535 * (1 + reach))
    with zipfile.ZipFile(path) as archive:
        assert all_of(folder) == {name: archive.read(name) for name in archive.namelist()}
    csplat.write(path, model)
    assert first == path.read_bytes()
    csplat.write(path, with_facts(model, antialiased=False, flat=True))
    assert csplat.read(path).metadata.flat


@pytest.mark.slow
def test_few_splats_are_written_and_read(tmp_path, make_model):
    path, one_place = tmp_path / "a.sog", make_model(3, 0, means=np.full((3, 3), 2.5, np.float32))
    for model in (make_model(1, 0), make_model(1, 3), make_model(17, 1), one_place):
        csplat.write(path, model)
        back, count = csplat.read(path), len(model)
        assert (count, model.sh_degree) == (len(back), back.sh_degree)
        for name in ("means", "scales", "sh0", "shN"):
            wanted, found = (np.sort(getattr(one, name).reshape(count, -1), 0) for one in (model, back))
            np.testing.assert_allclose(wanted, found, atol=1e-3 if name == "shN" else 1e-4)
    csplat.write(path, make_model(0, 3))
    assert (0, 0) == (len(csplat.read(path)), csplat.read(path).sh_degree)


SIDE = 64  # positions are integers below, so that a splat is known by its place


def places_of(model):
    return np.rint(model.means).astype(int) @ [1, SIDE, SIDE**2]


@pytest.fixture(scope="module")
def streamed(tmp_path_factory):
    """Three levels of a scene, the coarsest without splats in three quarters of space, and their streamed SOG."""
    rng, count = np.random.default_rng(8), 18_000
    cells = rng.permutation(SIDE**3)[:count]
    means = np.stack([cells % SIDE, cells // SIDE % SIDE, cells // SIDE**2], axis=1).astype(np.float32)
    quats, scales, sh0, *shN = (rng.standard_normal((count, size), np.float32) for size in (4, 3, 3, 3, 3, 3))
    opacities, shN = rng.random(count, np.float32), np.stack(shN, axis=1)
    finest = SplatModel(
        means, normalise_quats(quats), scales - 4, opacities, sh0, shN, metadata=SceneMetadata(antialiased=True)
    )
    levels = [finest, finest.select(slice(0, 4_000)), finest.select((means[:, :2] < SIDE / 4).all(axis=1))]
    path = tmp_path_factory.mktemp("streamed") / "scene" / "lod-meta.json"
    write_levels(path, [Scene.of(one) for one in levels])
    return path, levels


def leaves_of(node):
    """Return the leaves of a tree; each other node has two children, and its bounds are theirs."""
    if "lods" in node:
        return [node]
    assert 2 == len(node["children"])
    for side, extreme in (("min", min), ("max", max)):
        low, high = (one["bound"][side] for one in node["children"])
        assert node["bound"][side] == [extreme(pair) for pair in zip(low, high, strict=True)]
    return [leaf for child in node["children"] for leaf in leaves_of(child)]


@pytest.mark.slow
def test_levels_of_streamed_sog_read_back_within_a_step(streamed):
    path, levels = streamed
    for number, level in enumerate(levels):
        with csplat.open(path.parent, level=number) as scene:
            back = scene.model()
        assert (tuple(map(len, levels)), 1, True) == (scene.levels, back.sh_degree, back.metadata.antialiased)
        wanted, found = (one.select(np.argsort(places_of(one))) for one in (level, back))
        assert np.array_equal(places_of(wanted), places_of(found))
        assert_within_a_step(wanted, found, SIDE * np.log1p(SIDE) / 65535)


@pytest.mark.slow
def test_leaves_of_streamed_sog_divide_space_and_chunks(streamed):
    path, levels = streamed
    meta = json.loads(path.read_text())
    leaves = leaves_of(meta["tree"])
    counts = list(map(len, levels))
    assert (1, 3, counts, sum(counts)) == (meta["version"], meta["lodLevels"], meta["counts"], meta["count"])
    assert {"lod-meta.json", "0_0", "1_0", "2_0"} == {one.name for one in path.parent.iterdir()}
    assert 2 == len(leaves)
    assert all(5_000 < leaf["lods"]["0"]["count"] <= 1 << 14 for leaf in leaves)
    assert 0 in [leaf["lods"]["2"]["count"] for leaf in leaves]
    for number in range(3):
        runs = [leaf["lods"][str(number)] for leaf in leaves]
        assert {number} == {run["file"] for run in runs}
        ends = np.cumsum([0, *(run["count"] for run in runs)]).tolist()
        assert ends == [*(run["offset"] for run in runs), counts[number]]
        chunk = csplat.read(path.parent / meta["filenames"][number])
        for leaf, run in zip(leaves, runs, strict=True):
            splats = chunk.select(slice(run["offset"], run["offset"] + run["count"]))
            # At least the centres; a large splat reaches further.
            assert (splats.means >= np.array(leaf["bound"]["min"]) - 0.01).all()
            assert (splats.means <= np.array(leaf["bound"]["max"]) + 0.01).all()
    reach = max(np.exp(level.scales).max() for level in levels)
    assert -reach <= min(meta["tree"]["bound"]["min"]) < 0


@pytest.mark.long
def test_chunks_of_streamed_sog_have_about_equal_sizes(tmp_path, make_model):
    path, count = tmp_path / "a" / "lod-meta.json", 530_000
    csplat.write(path, make_model(count, 0))
    meta, sizes = json.loads(path.read_text()), [0, 0]
    assert ["0_0/meta.json", "0_1/meta.json"] == meta["filenames"]
    for run in (leaf["lods"]["0"] for leaf in leaves_of(meta["tree"])):
        assert sizes[run["file"]] == run["offset"]
        sizes[run["file"]] += run["count"]
    assert count == sum(sizes)
    assert abs(sizes[0] - sizes[1]) < 2 << 14
    with csplat.open(tmp_path / "a") as scene:
        assert count == sum(map(len, scene.blocks()))


@pytest.mark.slow
def test_splats_at_one_point_are_one_leaf(tmp_path, make_model):
    path = tmp_path / "a" / "lod-meta.json"
    csplat.write(path, make_model(17_000, 0, means=np.full((17_000, 3), 2.5, np.float32)))
    assert "lods" in json.loads(path.read_text())["tree"]
    assert 17_000 == len(csplat.read(path))


@pytest.mark.slow
def test_all_levels_of_a_file_are_converted(tmp_path):
    out = tmp_path / "a" / "lod-meta.json"
    made = convert_file(str(RICH), str(out), filters=Filters(scale=2.0))
    assert len(made.levels) > 1
    assert () == made.findings
    for number, count in enumerate(made.levels):
        with csplat.open(RICH) as file, csplat.open(out, level=number) as scene:
            cut, back = file.read(tiles=file.cut(level=number)), scene.model()
        assert count == len(cut) == len(back)
        np.testing.assert_allclose(np.sort(2 * cut.means, axis=0), np.sort(back.means, axis=0), rtol=1e-3, atol=1e-3)
    assert made.levels[1:] == convert_file(str(RICH), str(tmp_path / "b" / "lod-meta.json"), level=1).levels
    with pytest.raises(InputError, match="floaters cannot be dropped from several levels"):
        convert_file(str(RICH), str(tmp_path / "c" / "lod-meta.json"), filters=Filters(drop_floaters=True))
    with pytest.raises(InputError, match="which has one level, found 2"), csplat.open(RICH) as scene:
        write_levels(tmp_path / "d.ply", [scene, scene])
    assert {"a", "b"} == {one.name for one in tmp_path.iterdir()}


def test_streamed_sog_replaces_only_streamed_sog_and_only_if_it_succeeds(tmp_path, make_model):
    path = tmp_path / "a" / "lod-meta.json"
    with pytest.raises(InputError, match="no splats"):
        csplat.write(path, make_model(0, 0))
    path.parent.mkdir()
    csplat.write(path, make_model(20, 1))  # an empty folder
    csplat.write(path, make_model(10, 0))
    assert 10 == len(csplat.read(path))
    with pytest.raises(InputError, match="is in the folder of"):
        convert_file(str(path.parent / "0_0"), str(path))
    scene = Scene.of(make_model(20, 0))
    reads = []

    def blocks():
        reads.append(1)
        yield from scene.blocks()
        if len(reads) == 3:
            raise InputError("the disk was removed")

    for target in (path, tmp_path / "b" / "lod-meta.json"):
        reads.clear()
        with pytest.raises(InputError, match="was removed"):
            write_levels(target, [replace(scene, reader=blocks)])
    (tmp_path / "a" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"a contains notes\.txt, and a new folder replaces it: name another"):
        csplat.write(path, make_model(10, 0))
    assert ["a"] == [one.name for one in tmp_path.iterdir()]
    assert 10 == len(csplat.read(path))


def test_real_files_are_read(data_dir):
    for name, count, degree in (("angel.sog", 71_359, 0), ("statue", 289_444, 3)):
        with csplat.open(data_dir / "sog" / name) as scene:
            assert (count, degree) == (scene.count, scene.sh_degree)
            assert count == sum(map(len, scene.blocks()))


@pytest.mark.skipif(os.name == "nt", reason="links require privileges on Windows")
def test_parts_of_a_folder_are_webp_within_it(tmp_path):
    folder = foldered(tmp_path / "scene", files_of(*splats()))
    part, inside = folder / "sh0.webp", folder / "inside" / "sh0.webp"
    inside.parent.mkdir()
    part.rename(inside)
    part.symlink_to("inside/sh0.webp")  # a link within the folder is followed
    assert COUNT == len(csplat.read(folder))
    inside.rename(tmp_path / "secret")
    for target in ("../secret", str(tmp_path / "secret"), "inside/../../secret", "sh0.webp"):
        part.unlink()
        part.symlink_to(target)
        with pytest.raises(InputError, match=r"a link that leads out of it|cannot be read|there is no sh0"):
            csplat.read(folder)
    part.unlink()
    for data, title in ((b"%!PS-Adobe-3.0 EPSF-3.0\n", r"PostScript \(EPS\)"), (b"\x89PNG\r\n\x1a\n", "a PNG")):
        part.write_bytes(data)
        with pytest.raises(InputError, match=rf"scene: sh0\.webp is {title}, .*expected WebP"):
            csplat.read(folder)
