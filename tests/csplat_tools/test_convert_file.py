# SPDX-License-Identifier: Apache-2.0
"""`csplat convert`: conversion between all formats, filters, reports of losses.

Also: csplat_tools.cli.convert, csplat_tools.cli.decode.
"""

import io
import json
import os
import re
import sys
import tempfile
import threading
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from checked import checked, cloud
from command_line import call, invoke
from models import with_facts
from tables import failures
from typer.testing import CliRunner

import csplat
from csplat import Context, CsplatError, EncodeOptions, InputError, LimitError, decode, formats, write_ply
from csplat.editing.transform import convert_axes
from csplat.formats import spz
from csplat.formats.format import ARRAYS
from csplat.ply import read_ply
from csplat.scene import Scene
from csplat_conformance.manifest import load
from csplat_tools import scene_files
from csplat_tools.cli.app import app
from csplat_tools.convert_file import Filters, convert_file, decode_file, find_floaters
from csplat_tools.encode_file import encode_file
from csplat_tools.scene_files import open_scenes

needs_pipes = pytest.mark.skipif(sys.platform == "win32", reason="there are no named pipes")


@pytest.fixture
def ply(tmp_path, make_model):
    write_ply(tmp_path / "in.ply", make_model(200, 2))
    return tmp_path / "in.ply"


def calm(model):
    """Return the model with values that every format holds."""
    return replace(
        model, scales=model.scales.clip(-5.9, -2), sh0=model.sh0.clip(-1, 1), shN=model.shN.clip(-0.9, 0.9)
    )  # fmt: skip


def with_values(model, name, rows, value):
    """Return the calm model with another value of an attribute in the first rows."""
    model = calm(model)
    values = getattr(model, name).copy()
    values[:rows] = value
    return replace(model, **{name: values})


def test_a_ply_is_converted_to_csplat_and_back(tmp_path, ply):
    said = json.loads(call("convert", ply, tmp_path / "a.csplat", "--json").stdout)
    assert ("ply", "csplat", 200, 2) == (said["source_format"], said["format"], said["splats"], said["sh_degree"])
    assert ((tmp_path / "a.csplat").stat().st_size, []) == (said["size_bytes"], said["lost"])
    assert {"means", "shN"} <= set(said["rounded"])
    call("convert", tmp_path / "a.csplat", tmp_path / "b.ply")
    assert (csplat.decode(tmp_path / "a.csplat").means == read_ply(tmp_path / "b.ply").means).all()


def test_losses_are_reported_refused_and_predicted(tmp_path, ply, make_model):
    out, far = tmp_path / "out.csplat", tmp_path / "far.ply"
    assert "lost on the way: precision of means" in call("convert", ply, out, "--dry-run").stderr
    assert "does not keep all of" in call("convert", ply, out, "--no-loss", status=1).stderr
    assert not out.exists()
    assert "lost" not in call("convert", ply, tmp_path / "out.ply", "--no-loss").stderr
    header, _, rows = ply.read_bytes().partition(b"end_header\n")
    more, extra = b"element face 1\nproperty float a\nend_header\n", tmp_path / "more.ply"
    extra.write_bytes(header + more + rows + bytes(4))
    assert "other-elements: " in call("convert", extra, tmp_path / "b.ply", "--no-loss", status=1).stderr
    expected = json.loads(call("convert", ply, tmp_path / "x.ply", "--dry-run", "--json").stdout)["size_bytes"]
    assert expected == pytest.approx((tmp_path / "out.ply").stat().st_size, rel=0.05)
    write_ply(far, with_values(make_model(40, 1), "sh0", 5, np.float32(5.0)))
    for more in ("--dry-run", "--quiet"):
        said = call("convert", far, tmp_path / "a.spz", more).stderr
        assert "lost on the way: precision of means, quats, scales, opacities, shN" in said
        assert "loss: clamped-values: 15 values of sh0 in 5 splats outside -3.333 to 3.333, the range of SPZ" in said
    (loss,) = json.loads(call("convert", far, tmp_path / "b.splat", "--json").stdout)["losses"]
    assert ("clamped-values", "sh0", 5) == (loss["id"], loss["attribute"], loss["count"])
    assert 5 - 0.5 / 0.28209479 == pytest.approx(loss["largest_error"])


CLAMPED = [
    # attribute, value in three splats, suffix, largest error
    ("scales", 7.0, "spz", 1.0625), ("scales", -20.0, "v4.spz", 10.0), ("scales", -30.0, "compressed.ply", 10.0),
    ("scales", 95.0, "splat", 7.0), ("scales", 95.0, "glb", 95 - np.log(np.finfo("f4").max)),
    ("scales", -95.0, "csplat", 7.0),
    ("sh0", 5.0, "spz", 5 - 0.5 / 0.15), ("sh0", -5.0, "splat", 5 - 0.5 / 0.28209479),
    ("shN", 1.5, "spz", 1.5 - 127 / 128), ("shN", -4.5, "compressed.ply", 0.5),
]  # fmt: skip


@pytest.mark.slow
def test_clamped_values_are_counted_by_attribute_with_the_largest_error(tmp_path, make_model):
    ordinary = calm(make_model(40, 1, seed=1))

    def check(case):
        name, value, suffix, error = case
        found = csplat.write(tmp_path / f"a.{suffix}", with_values(ordinary, name, 3, np.float32(value)))
        (clamped,) = (one for one in found if one.id == "clamped-values")
        assert ("loss", name, 3) == (clamped.kind, clamped.attribute, clamped.count)
        assert error == pytest.approx(clamped.largest_error, abs=1e-4)
        decoded = getattr(csplat.read(tmp_path / f"a.{suffix}"), name)
        assert np.abs(decoded).max() == pytest.approx(np.abs(value) - error, abs=0.02) or suffix == "csplat"
        assert not [one for one in csplat.write(tmp_path / f"b.{suffix}", ordinary) if one.attribute]

    assert [] == failures({f"{one[:3]}": one for one in CLAMPED}, check)
    model = with_values(ordinary, "shN", 40, np.float32(1.0))  # rounded to 127/128, the largest of SPZ
    assert not [one for one in csplat.write(tmp_path / "a.spz", model) if one.attribute]


def test_splats_that_rounding_moves_visibly_are_counted(tmp_path, make_model):
    model = with_values(make_model(200, 1), "scales", 200, np.float32(-3.0))
    model.means[0] = 5e5, 0, 0
    (found,) = csplat.write(tmp_path / "a.spz", model)
    error = np.abs(csplat.read(tmp_path / "a.spz").means - model.means).max(axis=1)
    assert ("moved-splats", np.count_nonzero(error > np.exp(-3.0) / 8)) == (found.id, found.count)
    assert error.max() == pytest.approx(found.largest_error, rel=1e-4)
    assert "--drop-floaters" in found.text
    assert not csplat.write(tmp_path / "b.spz", model.select(slice(1, None)))
    model.means[0] = 9e6, 0, 0
    with pytest.raises(InputError, match="SPZ stores up to 8,388,607: --drop-floaters drops"):
        csplat.write(tmp_path / "c.spz", model)


@pytest.mark.slow
def test_sog_reports_what_its_codes_do_not_reach(tmp_path, make_model):
    colours = np.random.default_rng(0).normal(0, 1, (3000, 3)).astype("f4")
    model = replace(calm(make_model(3000, 0)), sh0=colours, opacities=np.ones(3000, "f4"))
    assert not csplat.write(tmp_path / "a.sog", model)
    colours[:2, 0] = 500, 1000
    found = csplat.write(tmp_path / "b.sog", replace(model, opacities=np.full(3000, 1e-3, "f4"), sh0=colours))
    error = np.abs(np.sort(csplat.read(tmp_path / "b.sog").sh0[:, 0])[-1] - 1000)
    assert bool(found) == (error > 125)
    (found,) = csplat.write(tmp_path / "c.sog", with_facts(model, antialiased=True, flat=True))
    assert "SOG cannot hold that splats are discs and antialiased" == found.text


@pytest.mark.slow
def test_extra_columns_and_degree_4_are_converted_encoded_or_reported_by_every_command(tmp_path, make_model):
    source, rich, a = tmp_path / "4.ply", tmp_path / "rich.ply", tmp_path / "a.csplat"
    write_ply(rich, replace(make_model(40, 0), extra={"motion_0": np.ones(40, np.float32)}))
    assert "lost on the way: extra columns motion_0" in call("convert", rich, tmp_path / "a.spz").stderr
    for words in (("encode", rich, a), ("compare", rich, rich), ("lint", rich)):
        assert "extra columns motion_0 are dropped: --keep-extra of csplat encode" in call(*words).output
    assert "extra columns" not in call("lint", rich, "--fix", tmp_path / "fixed.ply").output
    assert {"motion_0"} == csplat.read(tmp_path / "fixed.ply").extra.keys()
    write_ply(source, make_model(60, 4))
    for more, degree in (("--sh-degree", 3), 3), ((), 4):
        call("encode", source, a, "--force", *more)
        call("verify", a, "--source", source)
        call("convert", source, tmp_path / "a.ply", "--force", *more)
        assert degree == csplat.decode(a).sh_degree == read_ply(tmp_path / "a.ply").sh_degree
    assert np.array_equal(read_ply(source).shN, read_ply(tmp_path / "a.ply").shN)
    for suffix in ("sog", "spz", "glb"):
        assert "SH band 4" in call("convert", source, tmp_path / f"c.{suffix}").stderr
        assert 3 == csplat.read(tmp_path / f"c.{suffix}").sh_degree


@pytest.mark.slow
def test_invalid_arguments_are_refused(tmp_path, ply, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = ply.read_bytes()

    def check(case):
        result = invoke("convert", "in.ply", *case[0].split())
        assert result.exit_code in (1, 2)
        assert case[1] in result.stderr
        assert (before, [ply]) == (ply.read_bytes(), [*tmp_path.iterdir()])

    cases = [
        ("a.xyz", "no format has that ending"), ("a.html", "`csplat export-html` writes pages"),
        (".", ".: a folder, not the name of a file"), ("-", "standard output"), ("in.ply --force", "is the input"),
        ("a.ply --to zzz", "expected one of "), ("a.ply --rotate 1,2", "expected 3 numbers"),
        ("a.ply --crop 0,0,0,-1", "radius"), ("a.ply --crop 0,0,0,1,2", "expected 6 or 4 numbers"),
        ("a.ply --scale 0", "above 0"), ("a.ply --to-axes XYZ", "axes are"),
    ]  # fmt: skip
    assert [] == failures({one[0]: one for one in cases}, check)


@contextmanager
def piped(path):
    """Yield the name of a pipe with the contents of a file; it can be read once."""
    pipe = path.with_name("pipe")
    os.mkfifo(pipe)
    threading.Thread(target=lambda: pipe.write_bytes(path.read_bytes()), daemon=True).start()
    yield pipe
    pipe.unlink()


@pytest.mark.slow
@needs_pipes
def test_commands_read_pipes(tmp_path, make_model):
    def check(case):
        command, suffix, status, message = case
        path = tmp_path / f"a.{suffix}"
        csplat.write(path, calm(make_model(20, 0)))
        words = [str(tmp_path / word) if "." in word else word for word in command.split()]
        with piped(path) as pipe:
            of_pipe = invoke(*[pipe if word == "IN" else word for word in words])
        of_input = CliRunner().invoke(app, ["-" if word == "IN" else word for word in words], input=path.read_bytes())
        for result in (of_pipe, of_input):
            assert (status, True) == (result.exit_code, message in result.output), result.output
        assert str(tempfile.gettempdir()) not in of_pipe.output.replace(str(tmp_path), "")

    cases = [
        *(("info IN", suffix, 0, "20") for suffix in ("ply", "csplat", "spz", "glb", "sog", "compressed.ply")),
        *(("lint IN", suffix, 0, "nothing found") for suffix in ("spz", "sog")),
        *((f"{words} IN", "sog", 1, "is SOG, expected") for words in ("verify", "merge a.csplat -o b.csplat")),
        ("convert IN b.ply --force", "glb", 0, "20 splats: gltf"), ("info IN", "splat", 1, "--from splat reads it"),
        ("convert IN b.ply --force --from splat", "splat", 0, "20 splats: splat"),
    ]  # fmt: skip
    assert not failures({f"{one[0]}, {one[1]}": one for one in cases}, check)


@pytest.mark.slow
@needs_pipes
def test_every_format_is_written_to_a_pipe_and_to_a_device(tmp_path, ply):
    pipe, copy = tmp_path / "pipe", tmp_path / "copy"
    os.mkfifo(pipe)

    def check(name):
        reader = threading.Thread(target=lambda: copy.write_bytes(pipe.read_bytes()), daemon=True)
        reader.start()
        call("convert", ply, pipe, "--to", name)
        reader.join(10)
        assert pipe.is_fifo()
        with csplat.open(copy, name) as scene:
            assert 200 == scene.count
        call("convert", ply, os.devnull, "--to", name)
        assert Path(os.devnull).is_char_device()

    names = ["ply", "csplat", "compressed-ply", "spz", "splat", "gltf", "sog"]
    assert [] == failures(dict(zip(names, names, strict=True)), check)


def test_commands_take_the_format_of_a_file(tmp_path, ply):
    assert "E_INPUT" in call("info", ply, "--page", tmp_path / "p.html", status=1).stderr
    call("convert", ply, tmp_path / "a.splat")
    bare = (tmp_path / "a.splat").rename(tmp_path / "bare")
    call("encode", bare, tmp_path / "b.csplat", "--from", "splat")
    assert "the format is 'x', expected one of" in call("encode", bare, "-", "--from", "x", status=1).stderr


UP = np.array([0, 1, 0])
TILT = np.array([[1, 0, 0], [0, np.sqrt(0.75), -0.5], [0, 0.5, np.sqrt(0.75)]])  # by 30 degrees
CHANGES = {
    "--translate 0,1,0": lambda means: means + UP,
    "--rotate 30,0,0": lambda means: means @ TILT.T,
    "--crop -9,0,-9,9,9,9": lambda means: means[means[:, 1] >= 0],
    "--crop 0,1,0,1.5": lambda means: means[np.linalg.norm(means - UP, axis=1) <= 1.5],
}


@pytest.mark.slow
def test_changes_are_along_the_axes_of_the_file_or_of_to_axes(tmp_path, make_model):
    def check(case):
        (suffix, axes), (words, change) = case
        source, target = tmp_path / f"in.{suffix}", tmp_path / f"out.{suffix}"
        csplat.write(source, with_facts(make_model(30, 1), coordinate_system="RDF"))
        said = call("convert", source, target, "--force", *words.split()).stderr
        assert f"{words.split()[0]}: along the axes" in said
        assert ("= RDF of --to-axes" if "--to-axes" in words else f"x, y, z = {axes}; --to-axes") in said
        np.testing.assert_allclose(checked(target).means, change(checked(source).means), atol=1e-3)

    of_formats = {"glb": "LUF", "spz": "RUB", "ply": "RDF"}.items()
    cases = {f"{one[0]} {change[0]}": (one, change) for one, change in product(of_formats, CHANGES.items())}
    down = ("--translate 0,1,0 --to-axes RDF", lambda means: means - UP)
    cases |= {f"{one[0]} down": (one, down) for one in of_formats if one[0] != "ply"}
    assert not failures(cases, check)


@pytest.mark.slow
def test_axes_are_converted_and_recorded(tmp_path, ply):
    call("convert", ply, tmp_path / "a.ply", "--to-axes", "RUB")
    call("convert", tmp_path / "a.ply", tmp_path / "b.ply", "--to-axes", "RDF")
    source, there, back = (read_ply(path) for path in (ply, tmp_path / "a.ply", tmp_path / "b.ply"))
    assert ("RUB", "RDF") == (there.metadata.coordinate_system, back.metadata.coordinate_system)
    assert (source.means * np.float32([1, -1, -1]) == there.means).all()
    assert all((getattr(source, name) == getattr(back, name)).all() for name in ("means", "quats", "shN"))
    to = json.loads(call("convert", ply, tmp_path / "a.spz", "--json").stdout)  # which has fixed axes
    of = json.loads(call("convert", tmp_path / "a.spz", tmp_path / "c.ply", "--json").stdout)
    assert (["unspecified", "RUB"], ["RDF", "RDF"]) == (to["axes"], of["axes"])
    found = read_ply(tmp_path / "c.ply")
    assert np.allclose(source.means, found.means, atol=1e-3)
    assert (np.abs(np.sum(source.quats * found.quats, axis=1)) > 0.999).all()
    assert "axes         RUB, read as RDF" in call("info", tmp_path / "a.spz").stdout
    assert "RUB" == json.loads(call("info", tmp_path / "a.spz", "--json").stdout)["file_axes"]


@pytest.mark.slow
def test_a_crop_that_keeps_nothing_is_a_warning(tmp_path, ply):
    nothing = ("--crop", "90,90,90,1", "--quiet", "--json")
    for suffix in ("ply", "csplat", "spz", "compressed.ply", "sog"):
        done, out = call("convert", ply, tmp_path / f"a.{suffix}", *nothing), tmp_path / f"a.{suffix}"
        assert f"warning: --crop keeps none of 200 splats: {out} has no splats" in done.stderr
        result = json.loads(done.stdout)
        assert (200, 0) == (result["source_splats"], result["splats"])
    for suffix in ("glb", "splat"):
        assert "no splats are left" in call("convert", ply, tmp_path / f"a.{suffix}", *nothing, status=1).stderr
    assert "warning" not in call("convert", ply, tmp_path / "b.ply", "--crop", "0,0,0,1").stderr


def test_filters_are_applied_in_the_documented_order_a_crop_sphere_in_world_coordinates(tmp_path, ply, make_model):
    words = "--rotate 0,0,90 --scale 2 --translate 1,0,0 --crop -1,-1,-1,3,1,1 --sh-degree 1"
    call("convert", ply, tmp_path / "out.ply", *words.split())
    source, found = read_ply(ply), read_ply(tmp_path / "out.ply")
    wanted = 2.0 * source.means @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + [1, 0, 0]
    inside = ((wanted >= [-1, -1, -1]) & (wanted <= [3, 1, 1])).all(axis=1)
    assert 0 < inside.sum() < 200
    assert np.allclose(wanted[inside], found.means, atol=1e-5)
    assert np.allclose(source.scales[inside] + np.log(2.0), found.scales, atol=1e-5)
    assert 1 == found.sh_degree
    model = make_model(200, 0, origin=(100.0, 0.0, 0.0))
    kept = Filters(crop_sphere=(100.0, 0.0, 0.0, 0.7)).apply(Scene.of(model))
    assert (np.linalg.norm(model.means, axis=1) <= 0.7).sum() == kept.count == len(kept.model())


def test_floaters_are_splats_without_neighbours():
    ball = np.random.default_rng(0).standard_normal((3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    points = np.concatenate([ball, [[3, 0, 0], [0, 50.0, 0], [2.5, 0, 0]]])
    sizes = np.r_[np.full(3002, 0.03), 1.0]  # the last touches the ball
    assert [3000, 3001] == np.flatnonzero(find_floaters(points, sizes)).tolist()
    assert not find_floaters(points[:5], sizes[:5]).any()
    assert not find_floaters(np.zeros((20, 3)), np.ones(20)).any()
    left = Filters(drop_floaters=True).apply(Scene.of(cloud(points, sizes)))
    assert 3001 == left.count == len(left.model())


def test_the_number_of_dropped_floaters_is_reported_apart_from_a_crop(tmp_path):
    ball = np.random.default_rng(0).standard_normal((3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    points = np.concatenate([ball, [[30, 0, 0], [0, 50.0, 0], [900, 0, 0]]])
    write_ply(tmp_path / "in.ply", cloud(points, np.full(3003, 0.03)))
    words = ("convert", tmp_path / "in.ply", tmp_path / "out.ply", "--crop", "0,0,0,99", "--drop-floaters", "--json")
    made = call(*words)
    result = json.loads(made.stdout)
    assert (3003, 2, 3000) == (result["source_splats"], result["floaters"], result["splats"])
    assert "--drop-floaters: 2 of 3,002 splats dropped" in made.stderr
    assert "--crop: 1 of 3,003 splats dropped" in made.stderr
    assert f"--crop: along x, y, z as {tmp_path / 'in.ply'} stores them" in made.stderr


def test_a_preset_of_csplat_is_refused_with_the_command_that_has_it(ply, tmp_path):
    line = call("convert", ply, tmp_path / "out.csplat", "--preset", "small", status=1).stderr
    assert "run `csplat encode IN OUT.csplat --preset small`" in line


@pytest.mark.slow
@pytest.mark.parametrize("name", ["meta.json", "lod-meta.json"])
def test_sog_is_written_to_a_folder_of_its_own(tmp_path, ply, name):
    out = tmp_path / "new" / name
    call("convert", ply, out)
    assert 200 == len(csplat.read(out.parent))
    assert "exists: --force" in call("convert", ply, out, status=1).stderr
    if name == "meta.json":
        (out.parent / "other.bin").write_bytes(bytes(9_999_999))
    else:
        assert "is in the folder of" in call("convert", ply, ply.parent / name, status=1).stderr
    assert " MB" not in call("convert", ply, out, "--sh-degree", "0", "--force").stderr
    assert " MB" not in call("info", out.parent).stdout
    assert 0 == csplat.read(out.parent).sh_degree
    call("convert", ply, tmp_path / "no" / "such" / name, status=1)
    assert not (tmp_path / "no").exists()


def test_compress_makes_a_glb_of_a_csplat_file(tmp_path, make_model):
    source, output = tmp_path / "a.csplat", tmp_path / "a.glb"
    csplat.encode(make_model(30, 2), out=source)
    done = invoke("convert", source, output, "--compress", "--no-loss")
    assert 0 == done.exit_code, done.output
    assert source.read_bytes() in output.read_bytes()
    for words in (("info", output), ("lint", output), ("convert", output, tmp_path / "b.ply")):
        assert 0 == invoke(*words).exit_code
    assert 0 == invoke("convert", output, tmp_path / "plain.glb").exit_code
    assert 0 == invoke("convert", tmp_path / "plain.glb", tmp_path / "again.glb", "--compress").exit_code
    for words, message in (
        ((source, tmp_path / "c.spz", "--compress"), "--compress compresses the splats of a .glb, but OUT is"),
        ((source, tmp_path / "c.glb", "--compress", "--to", "spz"), "but --to is spz"),
    ):
        refused = invoke("convert", *words)
        assert (2, True) == (refused.exit_code, message in " ".join(refused.output.split()))


def directions_of(model):
    """Return what normals and displacements mean: where they point to, relative to the means, and squared lengths."""
    return {name: model.extra[name].reshape(len(model), -1, 3).astype("f8") for name in ("normal", "motion", "flow")}


def test_normals_and_displacements_change_with_the_options_and_nodes(tmp_path, make_model):
    rng = np.random.default_rng(4)
    extra = {"normal": rng.standard_normal((30, 3)).astype("f4"), "motion": rng.standard_normal((30, 6)).astype("f4")}
    extra |= {"flow": rng.standard_normal((30, 3)).astype("f4"), "other": rng.standard_normal((30, 3)).astype("f4")}
    model = make_model(30, 0, extra=extra, semantics={"flow": "motion"}, coordinate_system="RDF")
    write_ply(tmp_path / "a.ply", model)

    def check(path, changed, linear, atol=1e-5):
        before, after = directions_of(path), directions_of(changed)
        mapped = {name: before[name] @ linear.T for name in ("motion", "flow")}
        normals = before["normal"] @ np.linalg.inv(linear)
        lengths = np.linalg.norm(before["normal"], axis=2) / np.linalg.norm(normals, axis=2)
        for name, values in (mapped | {"normal": normals * lengths[..., None]}).items():
            np.testing.assert_allclose(after[name], values, rtol=1e-4, atol=atol)
        assert (path.extra["other"] == changed.extra["other"]).all()

    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for words, linear in (
        (("--to-axes", "RUB"), np.diag([1, -1, -1])), (("--to-axes", "LUF"), np.diag([-1, -1, 1])),
        (("--to-axes", "FRU"), np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0]])), (("--rotate", "0,0,90"), quarter),
        (("--scale", "3"), 3 * np.eye(3)), (("--translate", "1,2,3"), np.eye(3)), (("--axes", "RUB"), np.eye(3)),
        (("--rotate", "0,0,90", "--scale", "0.5", "--to-axes", "RUB"), 0.5 * quarter @ np.diag([1, -1, -1])),
    ):  # fmt: skip
        call("convert", tmp_path / "a.ply", tmp_path / "b.ply", *words, "--force")
        check(model, read_ply(tmp_path / "b.ply", keep_extra=True), linear)
        call("encode", tmp_path / "b.ply", tmp_path / "b.csplat", "--keep-extra", "--force")
        check(model, decode(tmp_path / "b.csplat").select(order_of(tmp_path / "b.ply", tmp_path / "b.csplat")), linear)
    call("convert", tmp_path / "a.ply", tmp_path / "b.glb", "--compress")
    data = (tmp_path / "b.glb").read_bytes()
    size = int.from_bytes(data[12:16], "little")
    plain, turn = csplat.read(tmp_path / "b.glb"), np.diag([-1.0, -1, 1])  # RDF to glTF's axes and back
    for at in range(12):
        nodes = np.linalg.qr(rng.standard_normal((3, 3)))[0] if at % 3 == 0 else rng.standard_normal((3, 3)) * (1 + at)
        root, columns = json.loads(data[20 : 20 + size]), np.eye(4)
        columns[:3, :3], columns[3, :3] = nodes.T, rng.standard_normal(3)
        root["nodes"][0]["matrix"] = columns.ravel().tolist()
        if at % 2:  # shown twice
            root["nodes"].append(dict(root["nodes"][0]))
            root["scenes"][0]["nodes"].append(1)
        text = json.dumps(root).encode()
        text += b" " * (-len(text) % 4)
        chunks = len(text).to_bytes(4, "little") + b"JSON" + text + data[20 + size :]
        (tmp_path / "c.glb").write_bytes(data[:8] + (12 + len(chunks)).to_bytes(4, "little") + chunks)
        changed = csplat.read(tmp_path / "c.glb")
        assert {"flow": "motion", "normal": "normal", "motion": "motion"} == changed.metadata.semantics
        check(plain, changed.select(slice(len(changed) - 30, None)), turn @ nodes @ turn, atol=1e-4)


def order_of(ply, file):
    """Return the index in a .csplat file of each splat of a PLY, whose extra columns are kept bit for bit."""
    rows = [model.extra["other"] for model in (read_ply(ply, keep_extra=True), decode(file))]
    return np.lexsort(rows[1].T)[np.argsort(np.lexsort(rows[0].T))]


#: Contents that the help and the guide call `header`.
HEADER = {"coordinate_system", "origin", "unit_metres", "metadata", "antialiased", "flat", "colour_space"}


@pytest.mark.slow
def test_the_help_and_the_guide_list_all_formats(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    helped = call("convert", "--help").stdout.replace("│", "")
    guide = (Path(__file__).parents[2] / "tools" / "docs" / "guide" / "formats.md").read_text("utf-8")
    table = guide.partition("also holds |\n|---")[2].partition("\n\n")[0].splitlines()[1:]
    rows = {cells[0]: cells for cells in ([cell.strip() for cell in row.strip("|").split("|")] for row in table)}
    assert len(formats.formats()) == len(rows) == len(table)
    for one in formats.formats():
        use = "read, write" if one.write else "read"
        assert [", ".join(one.suffixes), use, str(one.degree), one.axes] == rows[one.name][1:5]
        exact, holds = (set(re.findall(r"\w+", cell)) for cell in rows[one.name][5:])
        assert exact == ({"all"} if one.exact >= set(ARRAYS) else set(one.exact))
        assert holds == (one.carries - HEADER | {"header"} if one.carries >= HEADER else one.carries)
        assert re.search(rf"^ +{one.name} +\..* {use} +{one.degree} +{rows[one.name][6]} *$", helped, re.MULTILINE)


BOTH = [one.name for one in formats.formats() if one.open is not None and one.write is not None]


@pytest.mark.slow
def test_arrays_that_are_exact_in_two_formats_are_converted_exactly(tmp_path, make_model):
    def check(case):
        number, (first, second) = case
        one, other = formats.format_by_name(first), formats.format_by_name(second)
        a, b = tmp_path / f"a{one.suffixes[0]}", tmp_path / f"b{other.suffixes[0]}"
        model = calm(make_model(1 + number % 5, number % 4, number))
        formats.write(a, replace(model, means=model.means * np.float32((1e-3, 1.0, 50.0)[number % 3])), first)
        filters = Filters(to_axes=other.axes or "RDF")
        converted = convert_file(str(a), str(b), read_as=first, write_as=second, filters=filters)
        source, found = (
            convert_axes(Scene.of(formats.read(path, name)), "RDF").model() for path, name in ((a, first), (b, second))
        )
        assert len(source) == converted.count == len(found)
        for name in one.exact & other.exact:
            left, right = getattr(source, name), getattr(found, name)
            if name == "shN":
                left = left[:, : right.shape[1]]
            if name == "quats":
                left, right = (rows * np.sign(rows[:, :1] + 1e-30) for rows in (left, right))
            np.testing.assert_allclose(left, right, rtol=2e-7 if name == "opacities" else 0, err_msg=name)
        places = (np.sort(one.means, axis=0) for one in (source, found))  # some formats reorder splats
        assert np.allclose(*places, atol=1e-2 * max(1.0, np.abs(source.means).max()))
        assert min(source.sh_degree, other.degree) == found.sh_degree

    assert [] == failures({str(case): case for case in enumerate(product(BOTH, BOTH))}, check)


VECTORS = load()
#: Vectors of several tiles or with extra columns, and some others; none with many splats.
VALID = [
    vector
    for number, vector in enumerate(vector for vector in VECTORS if not vector.error)
    if vector.expect["header"]["splat_count"] < 10_000
    and (vector.expect["header"]["tile_count"] != 1 or vector.expect["extra"] or number % 4 == 0)
]
#: Too large for memory at once, which decoding by tiles accepts; damage of coarser levels, which neither way reads.
UNLIKE = ("invalid/arrays_beyond_budget", "invalid/coarse_tile_box", "invalid/coarse_tile_stream")
#: Two of each clause.
INVALID = {
    (vector.error["clause"], turn): vector
    for turn, order in enumerate((VECTORS, VECTORS[::-1]))
    for vector in order
    if vector.error and vector.name not in UNLIKE
}


def ply_of(model):
    buffer = io.BytesIO()
    try:
        write_ply(buffer, model)
    except InputError as error:  # some column names are impossible in a PLY
        return str(error)
    return buffer.getvalue()


@pytest.mark.slow
def test_tile_wise_scenes_and_plys_equal_those_of_one_decode(tmp_path):
    path, ply = tmp_path / "scene.csplat", tmp_path / "scene.ply"

    def check(vector):
        path.write_bytes(vector.data)
        expected = decode(vector.data, context=Context(threads=1))
        with csplat.open(path) as scene:
            assert len(expected) == scene.count
            np.testing.assert_equal(asdict(scene.model()), asdict(expected))
        wanted = ply_of(expected)
        with pytest.raises(InputError, match=re.escape(wanted)) if isinstance(wanted, str) else nullcontext():
            assert (len(expected), expected.sh_degree) == decode_file(str(path), str(ply))
            assert bool(wanted == ply.read_bytes())

    assert [] == failures(VALID, check)


@pytest.mark.slow
def test_invalid_files_give_the_same_error_and_leave_no_ply(tmp_path):
    path, ply = tmp_path / "scene.csplat", tmp_path / "scene.ply"

    def check(vector):
        path.write_bytes(vector.data)
        errors = []
        for read in (lambda: decode(vector.data, context=Context(threads=1)), lambda: decode_file(str(path), str(ply))):
            with pytest.raises(CsplatError) as error:
                read()
            errors.append(str(error.value))
        assert errors[0] == errors[1]
        assert [path] == [*tmp_path.iterdir()]

    assert [] == failures({vector.name: vector for vector in INVALID.values()}, check)


def test_a_packed_scene_is_unpacked_once_and_one_that_exceeds_the_memory_refused(tmp_path, ply, monkeypatch):
    packed, encoded, unpacked, read = tmp_path / "a.spz", tmp_path / "a.csplat", [], spz.read_spz_file
    csplat.write(packed, read_ply(ply))
    monkeypatch.setattr(spz, "read_spz_file", lambda *words: unpacked.append(words) or read(*words))
    encode_file(str(packed), str(encoded), EncodeOptions(), context=Context(workers=1))
    assert 1 == len(unpacked)
    with open_scenes((packed, packed), Context(memory=1 << 30)) as (one, _):
        assert 200 == one.count
    assert 3 == len(unpacked)
    assert csplat.decode(encoded).sh_degree == 2
    monkeypatch.setattr(scene_files, "available_memory_bytes", lambda: 4000)
    for path in (encoded, ply):
        with pytest.raises(LimitError, match="allowed 4000"):
            scene_files.load_scene(path)
