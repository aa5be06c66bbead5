# SPDX-License-Identifier: Apache-2.0
"""Formats: detection, reading in blocks, writing, refusals; archives; plug-ins of other packages; notebooks.

Also: csplat.archives, csplat.detect, csplat.file_source, csplat.formats.common, csplat.plugins,
csplat_tools.present.notebook.
"""

from __future__ import annotations

import base64
import html
import io
import json
import re
import subprocess
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from formats_cases import header_of, npy, same, with_size, zip_of
from tables import failures

import csplat
from csplat.archives import read_archive
from csplat.errors import InputError
from csplat.formats import detect_format, formats
from csplat.formats import lint_file as formats_lint
from csplat.ply import read_ply, write_ply
from csplat.scene import BLOCK_SPLATS, Scene
from csplat_tools.present.notebook import most_visible, scene_html


@pytest.mark.slow
@pytest.mark.parametrize("far", [1e6 + 0.123, 0.0])
def test_positions_in_doubles_keep_their_origin_in_every_block(tmp_path, make_model, far):
    model = replace(make_model(60, 1).select(np.arange(BLOCK_SPLATS + 1000) % 60), origin=(far, -far, 0.0))
    write_ply(tmp_path / "a.ply", model, absolute=True)
    with csplat.open(tmp_path / "a.ply") as scene:
        assert model.origin == scene.origin
        same(read_ply(tmp_path / "a.ply"), scene.model())


def test_formats_are_recognised_by_content_first(tmp_path, make_model):
    ply, file = tmp_path / "a.ply", tmp_path / "a.csplat"
    csplat.write(ply, make_model(40, 2))
    data = ply.read_bytes()
    file.write_bytes(data)
    for source in (file, data, io.BytesIO(data)):
        same(csplat.read(ply), csplat.read(source))
    csplat.write(file, make_model(40, 2))
    same(csplat.decode(file), csplat.read(file))


def test_losses_of_a_format_are_reported(make_model):
    facts = {"antialiased": True, "colour_space": "lin_rec709_display", "entries": {"licence": "CC0"}}
    model = make_model(10, 2, **facts, origin=(1.0, 2.0, 3.0))
    (ply,) = (one for one in formats() if one.name == "ply")
    assert () == ply.losses(Scene.of(model))
    bare = type(ply)("splat", degree=0)
    lost = ("SH bands 1 and 2", "that it is antialiased", "the origin", "the colour space", "metadata")
    assert lost == bare.losses(Scene.of(model))


@pytest.mark.parametrize(("name", "data", "message"), [
    ("a.ply", b"", "empty"), ("a.txt", b"hello, this is no scene", "no format that csplat knows"),
    ("a.ply", b"hello, this is no scene", "not a PLY"), ("a.spx", b"hello", "gsbox"),
    ("a.gz", b"\x1f\x8b\x08\x00hello", "gunzip"), ("a.glb", b"b3dm\1\0\0\0", "3D Tiles"),
    ("a.ply", b"\x89PNG\r\n\x1a\n", "is a PNG, an image"), ("a.json", b'{"cameras": []}', "is JSON"),
    ("a.csplat", b"<?xml version='1.0'?><Error/>", "XML, probably"), ("a.ply", b"\xef\xbb\xbf<html>", "a web page"),
    ("a.ply", b"<!-- saved from url=(0030)https://example.org/ -->\n<html>", "a web page"),
    ("a.spz", " <!DOCTYPE html><html>".encode("utf-16"), "a web page"),
    ("a.splat", b"<title>Sign in</title>".ljust(64), "a web page"), ("a.splat", b" " * 100 + b"<html>", "a web page"),
    ("a.spz", b"\xef\xbb\xbfversion https://git-lfs.github.com/spec/v1\noid", "Git LFS"),
    ("a.ply", b"/annex/objects/SHA256E-s1234--abc.ply\n", "a pointer of git-annex, .* run `git annex get`"),
    ("a.splat", b"{\\rtf1\\ansi hello}".ljust(64), "is RTF, a text"),
    ("a.splat", b"\x93NUMPY\1\0v\0{'descr': '<f4'", "is a NumPy array, not a scene"),
    ("a.ckpt", b'\x3c\0\0\0\0\0\0\0{"means":{', "is safetensors, which csplat does not read"),
    ("a.xz", b"\xfd7zXZ\0\0", "is xz, unpack it first, with unxz"),
    ("a.ply", b"BZh91AY&SY", "is bzip2, unpack it first"),
    ("a.csplat", b"\x1f\x8b\x08\0hello", "is gzip, unpack it first, with gunzip"),
    ("a.ply", b"PAR1\0\0\0\0PAR1", "is Parquet, which csplat does not read: convert it to PLY first"),
    ("a.splat", b"\x4b\x67\0\0\x64\0\0\0[{}]".ljust(64), "is .splatv of splaTV, splats that move"),
    ("a.psht", b"hello", "is a project of Postshot, not a scene: export the splats as PLY"),
    ("a.licht", b"hello", "is a project of LichtFeld Studio, not a scene: export the splats as PLY"),
    ("a.ply", b"BLENDER-v300", "is a file of Blender, not a scene: export the splats as PLY"),
])  # fmt: skip
def test_other_files_are_refused_with_their_type(tmp_path, name, data, message):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=message):
        csplat.read(tmp_path / name)


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 63327587\n"


def test_pointers_of_git_lfs_are_named_whatever_reads_them(tmp_path):
    message = "is a pointer of Git LFS, not the file itself: run `git lfs pull`"
    ends = [end for one in formats() for end in one.suffixes]
    for path in [tmp_path / ("a" + end if end.startswith(".") else end) for end in [*ends, ".txt"]]:
        path.write_bytes(LFS)
        for read in (csplat.read, read_ply, formats_lint):
            with pytest.raises(InputError, match=message):
                read(path)
        with pytest.raises(InputError, match=message):
            csplat.read(path, "splat")
    for decode in (csplat.decode, csplat.open):
        with pytest.raises(csplat.CsplatError, match="git lfs pull"):
            decode(tmp_path / "a.csplat")


def test_scenes_of_other_programs_are_named_with_the_way_out(tmp_path, make_model):
    png = {"shape": [50, 3], "dtype": "float32", "mins": [-1, -1, -1], "maxs": [1, 1, 1]}
    meta = json.dumps({"means": png, "scales": png, "opacities": {**png, "mins": 0}, "sh0": png})
    cases = {  # a file and its text, and what is said of it; an empty name stands for the folder
        "png/meta.json": (meta, "PNG compression"), "png/": (None, "PNG compression, .*PngCompr"),
        "png.zip": (zip_of([("compression/meta.json", meta)]), "PNG compression"),
        "lcc/scene.lcc": ('{"version": "1", "cellLengthX": 30, "fileType": "Quality"}', "is LCC, "),
        "lcc/data.bin": ("\1" * 64, ".* takes the .lcc file"), "lcc/": (None, "is LCC, .*splat-transform"),
        "lcc2/scene.lcc2": ('{"version": "2.0", "splatType": "sog", "root": {}}', "is LCC2, "),
        "lcc2/": (None, "is LCC2, .* in data/3dgs"),
        "bare/renamed.json": ('{"version": "1.1", "cellLengthX": 30}', "is LCC, "),
        "bare/a.drc": ("DRACO\2\2", "is Draco, a mesh"), "bare/a.splatv": ("Kg\0\0\1\2\3", "splats that move"),
        "sog/quats.webp": (LFS, "of Git LFS"), "sog/": (None, r"quats\.webp is a pointer of Git LFS"),
        "trained/input.ply": ("", "empty"), "trained/point_cloud/iteration_7000/point_cloud.ply": ("", "empty"),
        "trained/point_cloud/iteration_30000/point_cloud.ply": ("", "empty"),
        "trained/": (None, r"a folder, not a scene: name point_cloud/iteration_30000/point_cloud\.ply, the last of 2 "),
        "one/a.spz": ("", "empty"), "one/": (None, r"one is a folder, not a scene: name a\.spz$"),
    }  # fmt: skip
    csplat.write(tmp_path / "sog" / "meta.json", make_model(5, 0))
    assert "sog" == detect_format(tmp_path / "sog").name
    for name, (text, _) in cases.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        if text is not None:
            (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())

    def check(case):
        name, message = case
        with pytest.raises(InputError, match=message):
            csplat.read(tmp_path / name)

    assert [] == failures({name: (name, message) for name, (_, message) in cases.items()}, check)


@pytest.mark.slow
def test_a_zip_is_recognised_by_its_contents(tmp_path):
    np.savez(tmp_path / "c.npz", means=np.zeros((2, 3)), quats=np.zeros((2, 4)))
    several = ("a/scene.ply", "__MACOSX/a/._scene.ply", "b.spz", "readme.txt")
    zips = {names: zip_of([(name, "x") for name in names]) for names in (
        ("x.npy",), ("scene.ply",), ("a.usdc",), ("a/data.pkl",), several)}  # fmt: skip
    messages = ("NumPy", r"a zip that contains scene\.ply: unzip it", "USD", "checkpoint",
        "contains a/scene.ply, b.spz: unzip it")  # fmt: skip
    for data, message in (
        *zip(zips.values(), messages, strict=True),
        (zips[several][:-30], "is a damaged zip"),
        ((tmp_path / "c.npz").read_bytes(), r"is an archive of NumPy arrays \(means, quats\), not a scene"),
    ):
        with pytest.raises(InputError, match=message):
            csplat.read(data)


def test_a_given_format_counts_where_the_content_is_that_of_none(tmp_path, make_model):
    model = make_model(9, 0)
    for name in ("a.splat", "a.ply"):
        csplat.write(tmp_path / name, model)
    (tmp_path / "b").write_bytes((tmp_path / "a.splat").read_bytes())
    with pytest.raises(InputError, match="--from splat reads it"):
        csplat.read(tmp_path / "b")
    assert (csplat.read(tmp_path / "b", "splat").scales == csplat.read(tmp_path / "a.splat").scales).all()
    assert len(csplat.read(tmp_path / "a.ply", "splat")) == 9
    with pytest.raises(InputError, match=r"expected one of .*\bply\b"):
        csplat.read(tmp_path, format="xyz")
    with pytest.raises(InputError, match=r"expected one of .*\.ply"):
        csplat.write(tmp_path / "a.xyz", model)


@pytest.mark.slow
def test_fewer_bands_are_read_of_any_format(tmp_path, make_model):
    model = make_model(40, 2)
    for name in ("a.ply", "a.compressed.ply", "a.spz", "a.v4.spz", "a.sog", "a.glb", "a.csplat"):
        csplat.write(tmp_path / name, model)
        whole, part = csplat.read(tmp_path / name), csplat.read(tmp_path / name, sh_degree=1)
        assert (2, 1) == (whole.sh_degree, part.sh_degree)
        assert np.array_equal(whole.shN[:, :3], part.shN)
        with csplat.open(tmp_path / name, sh_degree=1) as scene:
            assert (40, 1) == (scene.count, scene.sh_degree)


PLUGIN = """
from csplat.formats import Format, format_by_name

FORMAT = Format("lcc", open=format_by_name("splat").open)


def html(model):
    return f"<p>{len(model)}</p>"
"""
PROGRAM = """
import sys, warnings, csplat, csplat.formats

model = csplat.read("a.ply")
print("other_plugin" in sys.modules, model._repr_html_())
with warnings.catch_warnings(record=True) as seen:
    print(len(csplat.read("a.lcc")), {"lcc", "gltf"} <= {one.name for one in csplat.formats.formats()})
print(seen[-1].message)
"""
ENTRY_POINTS = """
[csplat.formats]
lcc = other_plugin:FORMAT
xyz = other_plugin:NOTHING
[csplat.display]
html = other_plugin:html
"""


@pytest.mark.slow
def test_plug_ins_are_loaded_when_they_are_needed_or_left_out_with_a_warning(tmp_path, make_model):
    # A distribution of this name hides the metadata of the installed one, which has a display and formats, too.
    metadata = tmp_path / "csplat-1.dist-info"
    metadata.mkdir()
    for path, text in (
        (metadata / "METADATA", "Metadata-Version: 2.1\nName: csplat\nVersion: 1\n"),
        (metadata / "entry_points.txt", ENTRY_POINTS),
        (tmp_path / "other_plugin.py", PLUGIN),
        (tmp_path / "program.py", PROGRAM),
    ):
        path.write_text(text, "utf-8")
    (tmp_path / "a.lcc").write_bytes(bytes(32))
    csplat.write(tmp_path / "a.ply", make_model(2, 0))
    words = [sys.executable, "program.py"]
    lines = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.splitlines()
    assert ["False <p>2</p>", "1 True"] == lines[:2]
    message = "other_plugin:NOTHING, installed as 'xyz' of csplat.formats, cannot be loaded: module"
    assert lines[2].startswith(message)


def scene_in(shown):
    """The model inside of a frame."""
    page = html.unescape(re.search(r'srcdoc="([^"]*)"', shown)[1])
    coded = re.search(r'<script type="application/octet-stream" id="csplat-scene">([^<]*)</script>', page)[1]
    return csplat.decode(base64.b64decode(coded))


@pytest.mark.slow
def test_models_show_themselves_reduced_to_the_largest_splats(make_model, monkeypatch):
    model = make_model(40, 1)
    shown = model._repr_html_()
    assert (40, 1) == (len(scene_in(shown)), scene_in(shown).sh_degree)
    assert not any(tag in shown for tag in ("<small>", ' src="'))
    assert make_model(0)._repr_html_() is None
    model = make_model(1200, 0)
    model.opacities[::3] = 0.0
    shown, kept = scene_html(model, most_splats=200), most_visible(model, 200)
    assert 200 == len(scene_in(shown))
    assert "200 of 1,200 splats, the most visible ones" in shown
    assert kept.opacities.min() > 0.0
    areas, all_areas = (np.exp(np.sort(one.scales, axis=1)[:, 1:].sum(axis=1)) for one in (kept, model))
    assert np.median(areas) > np.median(all_areas)
    monkeypatch.setitem(sys.modules, "csplat_tools.present.notebook", None)
    assert model._repr_html_() is None


@pytest.mark.slow
def test_the_frame_draws_and_is_kept_from_the_notebook(tab, site, make_model):
    shown = make_model(200, 0)._repr_html_()
    head = '<!doctype html><link rel="icon" href="data:,"><title>kept</title>'
    tab.page.set_viewport_size({"width": 200, "height": 500})
    tab.page.goto(site.add("/notebook.html", f"{head}{shown}".encode()))
    frame = next(one for one in tab.page.frames if one is not tab.page.main_frame)
    frame.wait_for_load_state()
    frame.evaluate("csplatViewer.ready")
    brightest = "(all) => all.filter((_, at) => at % 4 < 3).reduce((a, b) => Math.max(a, b), 0)"
    assert frame.evaluate(f"csplatViewer.engine.readPixels().then({brightest})") > 100
    with pytest.raises(Exception, match="cross-origin"):
        frame.evaluate("parent.document.title")


KIND = "a file of tests"
BROKEN = b"\x93NUMPY\x01\x00v\x00{'descr': '<f4', 'fortran_order': False, 'shape': ("


def test_an_archive_has_arrays_and_facts(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, one=np.arange(3), facts=np.frombuffer(b'{"n": 1}', np.uint8))
    found = read_archive(path, KIND)
    assert np.array_equal(np.arange(3), found["one"])
    assert {"n": 1} == found.facts()
    found.check({"n": 1}, {"n": int})
    with pytest.raises(InputError, match="has no two"):
        found["two"]
    with pytest.raises(InputError, match="its n is not of type int"):
        found.check({"n": "1"}, {"n": int})
    for text in (b"[1]", b"{", b"[" * 100_000, b"\xff"):
        np.savez(path, facts=np.frombuffer(text, np.uint8))
        with pytest.raises(InputError, match="not a file of tests"):
            read_archive(path, KIND).facts()
    with pytest.raises(FileNotFoundError, match="absent"):
        read_archive(tmp_path / "absent.npz", KIND)


DEFLATED = zip_of([("a.npy", npy(header_of("'<f8'", "(400,)"), np.random.default_rng(1).normal(size=400).tobytes()))],
    zipfile.ZIP_DEFLATED)  # fmt: skip
LARGE = zip_of([("a.npy", npy(header_of(shape="(300000000,)"), bytes(1000)))], zipfile.ZIP_DEFLATED)
HOSTILE_ARCHIVES = {
    "no array": (zip_of([("facts.npy", b"hello")]), "facts is not an array"),
    **{f"damage at {place}": (DEFLATED[:place] + bytes([DEFLATED[place] ^ 0x55]) + DEFLATED[place + 1 :], "")
        for place in range(60, 1000, 74)},
    "an open bracket": (zip_of([("a.npy", BROKEN.ljust(128, b" "))]), ""),
    "a later version": (zip_of([("a.npy", b"\x93NUMPY\x09\x09")]), ""),
    "no bytes": (zip_of([("a.npy", b"")]), ""),
    "a pickle": (zip_of([("a.npy", npy(header_of("'|O'", "(1,)"), b"\x80\4N."))]), "pickled objects are not read"),
    "bzip2": (zip_of([("a.npy", npy(header_of(), b"abcd"))], zipfile.ZIP_BZIP2), "by method 12, expected 8"),
    "LZMA": (zip_of([("a.npy", npy(header_of(), b"abcd"))], zipfile.ZIP_LZMA), "by method 14, expected 8"),
    "larger than its size allows": (with_size(LARGE, 300_000_070), "declares an unpacked size of 300,000,070"),
    "more than it declares": (
        with_size(zip_of([("a.npy", npy(header_of(), bytes(9999)))], zipfile.ZIP_DEFLATED), 69), "Bad CRC-32",
    ),
    "shape larger than the data": (zip_of([("a.npy", npy(header_of(shape="(4, 9999999999)")))]), "does not fit its 0"),
    "shape smaller than the data": (zip_of([("a.npy", npy(header_of(), b"abcde"))]), "does not fit its 5 bytes"),
    "shape below zero": (zip_of([("a.npy", npy(header_of(shape="(-1, -4)"), b"abcd"))]), "does not fit its 4 bytes"),
    "side of 5,000 digits": (zip_of([("a.npy", npy(header_of(shape=f"({'9' * 5000},)")))]), "."),
    "values without bytes": (zip_of([("a.npy", npy(header_of("'|V0'", "(1000000000000,)")))]), "expected numbers"),
    "header of brackets": (zip_of([("a.npy", npy(b"[" * 9000))]), "a is not an array"),
    "header of 1 MB": (zip_of([("a.npy", npy(b"{" + b" " * (1 << 20), version=2))]), "a is not an array"),
    "header of version 3": (zip_of([("a.npy", npy(header_of(), b"abcd", version=3))]), "version 3.0, expected 1.0"),
    "two arrays of a name": (zip_of([("a.npy", npy(header_of(), b"abcd"))] * 2), "two arrays a"),
    "5,000 arrays": (zip_of([(f"{index}", b"") for index in range(5000)]), "5,000 members, expected at most"),
}  # fmt: skip


@pytest.mark.slow
def test_archives_that_need_more_than_their_size_allows_are_refused(tmp_path):
    def check(case):
        data, message = case
        (tmp_path / "a.npz").write_bytes(data)
        with pytest.raises(InputError, match=rf"a\.npz is not a file of tests: .*{message}") as caught:
            read_archive(tmp_path / "a.npz", KIND)
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 300

    assert [] == failures(HOSTILE_ARCHIVES, check)
