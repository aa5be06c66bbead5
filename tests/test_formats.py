"""Any format in, any format out: detection, reading in blocks, writing, refusals."""

import io
import zipfile

import numpy as np
import pytest

import csplat
from csplat.errors import InputError
from csplat.formats import assume_format, formats, open_scene, write_scene
from csplat.formats import lint_file as formats_lint
from csplat.ply import read_ply, write_ply
from csplat.scene_source import BLOCK_SPLATS, SceneSource, source_from_model

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def same(a, b):
    assert all((getattr(a, name) == getattr(b, name)).all() for name in ARRAYS)
    assert (a.origin, a.coordinate_system, a.antialiased, a.flat, a.metadata) == (
        b.origin, b.coordinate_system, b.antialiased, b.flat, b.metadata,
    )  # fmt: skip


@pytest.fixture
def large(make_model):
    """More splats than a block has."""
    model = make_model(60, 1)
    return model.select(np.arange(BLOCK_SPLATS + 1000) % 60)


def test_a_ply_in_blocks_is_the_ply_at_once(tmp_path, large):
    write_ply(tmp_path / "a.ply", large)
    with open_scene(tmp_path / "a.ply") as scene:
        assert len(large) == scene.count
        assert 0 == len(scene.metadata_model)
        assert [BLOCK_SPLATS, 1000] == [len(block) for block in scene.blocks()]
        same(read_ply(tmp_path / "a.ply"), scene.model())
        write_scene(tmp_path / "b.ply", scene)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_rows_that_are_dropped_are_not_counted(tmp_path, large):
    write_ply(tmp_path / "a.ply", large)
    data = bytearray((tmp_path / "a.ply").read_bytes())
    data[-4:] = np.float32(np.nan).tobytes()
    (tmp_path / "a.ply").write_bytes(data)
    with open_scene(tmp_path / "a.ply") as scene:
        assert len(large) - 1 == scene.count == sum(map(len, scene.blocks()))
        assert ["nonfinite-rows"] == [one.id for one in scene.findings if one.kind == "repair"]


@pytest.mark.parametrize("far", [1e6 + 0.123, 0.0])
def test_positions_in_doubles_keep_their_origin_in_every_block(tmp_path, large, far):
    origin = (far, -far, 0.0)
    model = csplat.SplatModel(**{**vars(large), "origin": origin})
    write_ply(tmp_path / "a.ply", model, absolute=True)
    with open_scene(tmp_path / "a.ply") as scene:
        assert origin == scene.metadata_model.origin
        same(read_ply(tmp_path / "a.ply"), scene.model())


def test_formats_are_told_apart_by_content_first(tmp_path, make_model):
    model = make_model(40, 0)
    csplat.write(tmp_path / "a.ply", model)
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.csplat").write_bytes(data)
    same(csplat.read(tmp_path / "a.ply"), csplat.read(tmp_path / "a.csplat"))
    same(csplat.read(data), csplat.read(io.BytesIO(data)))


def test_a_csplat_file_is_read_and_written(tmp_path, make_model):
    csplat.write(tmp_path / "a.csplat", make_model(40, 2))
    same(csplat.decode(tmp_path / "a.csplat"), csplat.read(tmp_path / "a.csplat"))


def test_what_a_format_has_no_place_for_is_told(make_model):
    model = make_model(10, 2, antialiased=True, origin=(1.0, 2.0, 3.0), metadata={"licence": "CC0"})
    (ply,) = (one for one in formats() if one.name == "ply")
    assert () == ply.losses(model)
    bare = type(ply)("splat", degree=0)
    assert ("SH bands 1 and 2", "that it is antialiased", "the origin", "metadata") == bare.losses(model)


def test_each_format_has_a_name_of_its_own():
    names, endings = [one.name for one in formats()], [end for one in formats() for end in one.suffixes]
    assert len(set(names)) == len(names)
    assert len(set(endings)) == len(endings)


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("a.ply", b"", "empty"),
        ("a.txt", b"hello, this is no scene", "no format that csplat knows"),
        ("a.ply", b"hello, this is no scene", "not a PLY"),
        ("a.spx", b"hello", "gsbox"),
        ("a.gz", b"\x1f\x8b\x08\x00hello", "gunzip"),
        ("a.glb", b"b3dm\1\0\0\0", "3D Tiles"),
        ("a.ply", b"\x89PNG\r\n\x1a\n", "is a PNG, an image"),
        ("a.json", b'{"cameras": []}', "is JSON"),
        ("a.csplat", b"<?xml version='1.0'?><Error/>", "XML, as servers"),
        ("a.ply", b"\xef\xbb\xbf<html>", "a web page"),
        ("a.ply", b"<!-- saved from url=(0030)https://example.org/ -->\n<html>", "a web page"),
        ("a.spz", " <!DOCTYPE html><html>".encode("utf-16"), "a web page"),
        ("a.splat", b"<title>Sign in</title>".ljust(64), "a web page"),
        ("a.splat", b" " * 100 + b"<html>", "a web page"),
        ("a.spz", b"\xef\xbb\xbfversion https://git-lfs.github.com/spec/v1\noid", "Git LFS"),
        ("a.ply", b"/annex/objects/SHA256E-s1234--abc.ply\n", "a pointer of git-annex, .* run `git annex get`"),
        ("a.splat", b"{\\rtf1\\ansi hello}".ljust(64), "is RTF, a text"),
        ("a.splat", b"\x93NUMPY\1\0v\0{'descr': '<f4'", "is an array of NumPy, no scene"),
        ("a.ckpt", b'\x3c\0\0\0\0\0\0\0{"means":{', "is safetensors, which csplat does not read"),
        ("a.xz", b"\xfd7zXZ\0\0", "is xz, unpack it first, with unxz"),
        ("a.ply", b"BZh91AY&SY", "is bzip2, unpack it first"),
        ("a.csplat", b"\x1f\x8b\x08\0hello", "is gzip, unpack it first, with gunzip"),
    ],
)
def test_other_files_are_refused_by_what_they_are(tmp_path, name, data, says):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=says):
        csplat.read(tmp_path / name)


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 63327587\n"


def test_pointers_of_git_lfs_are_named_whatever_reads_them(tmp_path):
    says = "is a pointer of Git LFS, not the file itself: run `git lfs pull`"
    ends = [end for one in formats() for end in one.suffixes]
    for path in [tmp_path / ("a" + end if end.startswith(".") else end) for end in [*ends, ".txt"]]:
        path.write_bytes(LFS)
        for read in (csplat.read, read_ply, formats_lint):
            with pytest.raises(InputError, match=says):
                read(path)
        with assume_format("splat"), pytest.raises(InputError, match=says):
            csplat.read(path)
    (tmp_path / "meta.json").write_text('{"version": 2, "count": 1}')
    for decode in (csplat.decode, csplat.open):
        with pytest.raises(csplat.FormatError, match="git lfs pull"):
            decode(tmp_path / "a.csplat")


def test_pointers_of_git_lfs_are_named_within_scenes_of_several_files(tmp_path, make_model):
    (tmp_path / "sog").mkdir()
    csplat.write(tmp_path / "sog" / "meta.json", make_model(20, 0))
    (tmp_path / "sog" / "quats.webp").write_bytes(LFS)
    with pytest.raises(InputError, match=r"quats\.webp is a pointer of Git LFS"):
        csplat.read(tmp_path / "sog")


def test_a_zip_is_told_by_what_is_in_it(tmp_path):
    for name, says in (
        ("x.npy", "NumPy"),
        ("scene.ply", r"a zip that holds scene\.ply: unzip it"),
        ("a.usdc", "USD"),
        ("a/data.pkl", "checkpoint"),
    ):
        with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
            archive.writestr(name, "")
        with pytest.raises(InputError, match=says):
            csplat.read(tmp_path / "a.sog")


def test_insisting_counts_where_the_content_is_that_of_no_format(tmp_path, make_model):
    model = make_model(9, 0)
    csplat.write(tmp_path / "a.splat", model)
    csplat.write(tmp_path / "a.ply", model)
    (tmp_path / "b").write_bytes((tmp_path / "a.splat").read_bytes())
    with pytest.raises(InputError, match="--from splat reads it"):
        csplat.read(tmp_path / "b")
    with assume_format("splat"):
        assert (csplat.read(tmp_path / "b").scales == csplat.read(tmp_path / "a.splat").scales).all()
        assert len(csplat.read(tmp_path / "a.ply")) == 9
    with pytest.raises(InputError, match="the format is 'xyz'"), assume_format("xyz"):
        pass


def test_names_that_no_format_has_are_refused(tmp_path, make_model):
    with pytest.raises(InputError, match=r"wanted one of .*\.ply"):
        csplat.write(tmp_path / "a.xyz", make_model(3, 0))
    with pytest.raises(InputError, match=r"wanted one of .*\bply\b"):
        csplat.read(tmp_path, format="xyz")
    with pytest.raises(InputError, match="no scene"):
        csplat.read(tmp_path)


def test_a_scene_in_memory_is_read_in_blocks(large):
    scene = source_from_model(large)
    assert [BLOCK_SPLATS, 1000] == [len(one) for one in scene.blocks()]
    same(large, scene.model())
    assert 0 == len(SceneSource(0, scene.metadata_model, lambda: iter(())).model())


def test_scenes_in_a_zip_are_named(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for name in ("a/scene.ply", "__MACOSX/a/._scene.ply", "b.spz", "readme.txt"):
            archive.writestr(name, "x")
    with pytest.raises(InputError, match=r"a.zip is a zip that holds a/scene.ply, b.spz: unzip it"):
        csplat.read(tmp_path / "a.zip")
    (tmp_path / "b.zip").write_bytes((tmp_path / "a.zip").read_bytes()[:-30])
    with pytest.raises(InputError, match=r"b\.zip is a zip, and damaged"):
        csplat.read(tmp_path / "b.zip")
    np.savez(tmp_path / "c.npz", means=np.zeros((2, 3)), quats=np.zeros((2, 4)))
    with pytest.raises(InputError, match=r"c\.npz is an archive of NumPy arrays \(means, quats\), no scene"):
        csplat.read(tmp_path / "c.npz")


def test_of_a_folder_that_a_trainer_wrote_the_newest_scene_is_named(tmp_path):
    for name in ("input.ply", *(f"point_cloud/iteration_{count}/point_cloud.ply" for count in (7000, 30000))):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    says = r"is a folder, and no scene: name point_cloud/iteration_30000/point_cloud\.ply, the last of 2 scenes in it"
    with pytest.raises(InputError, match=says):
        csplat.read(tmp_path)
    (tmp_path / "splat").mkdir()
    (tmp_path / "splat" / "a.spz").write_bytes(b"")
    with pytest.raises(InputError, match=r"splat is a folder, and no scene: name a\.spz$"):
        csplat.read(tmp_path / "splat")


def test_fewer_bands_are_read_of_any_format(tmp_path, make_model):
    model = make_model(40, 2)
    for name in ("a.ply", "a.compressed.ply", "a.spz", "a.v4.spz", "a.sog", "a.glb", "a.csplat"):
        csplat.write(tmp_path / name, model)
        whole, part = csplat.read(tmp_path / name), csplat.read(tmp_path / name, sh_degree=1)
        assert (2, 1) == (whole.sh_degree, part.sh_degree)
        assert np.array_equal(whole.shN[:, :3], part.shN)
        assert 1 == csplat.read(tmp_path / name, sh_degree=1).sh_degree
