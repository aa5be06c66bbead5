# SPDX-License-Identifier: Apache-2.0
"""`csplat render`: images, and films in the formats that Pillow writes and as MP4; refusals.

Also: csplat_tools.cli.render, csplat_tools.present.scene_renders.
"""

import json
import sys

import numpy as np
import pytest
import typer
from checked import cloud
from command_line import call, hide_renderer
from models import with_facts
from PIL import Image

import csplat
from csplat import InputError, write_ply
from csplat.ply import read_ply
from csplat_render import Camera, render
from csplat_render.camera import fitted, resized
from csplat_render.first_view import first_view
from csplat_render.metrics import psnr
from csplat_tools import render_files
from csplat_tools.cli.shared_options import parse_colour
from csplat_tools.inspect import comparison
from csplat_tools.present import scene_renders


@pytest.fixture
def ply(tmp_path):
    """One red, opaque ball of radius 0.2 around the origin."""
    red, path = np.array([[1.7, -1.8, -1.8]], np.float32), tmp_path / "ball.ply"
    write_ply(path, cloud([[0, 0, 0]], 0.2, opacities=np.ones(1, np.float32), sh0=red, entries={"up": [0, -1, 0]}))
    return path


@pytest.fixture
def cameras(tmp_path):
    """Two cameras two units in front of the origin."""
    viewmat = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
    one = {"K": [[60, 0, 32], [0, 60, 24], [0, 0, 1]], "viewmat": viewmat, "W": 64, "H": 48}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([{**one, "image": f"images/{side}.jpg"} for side in ("left", "right")]))
    return path


def refused(*words):
    stderr = call(*words, status=1).stderr
    assert stderr.startswith("error: ")
    assert stderr.count("\n") == 1
    return stderr


def pixels(path):
    with Image.open(path) as picture:
        return np.asarray(picture).astype(int)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_background_surrounds_the_scene_with_alpha_and_depth_next_to_the_render(ply, cameras, tmp_path):
    out = tmp_path / "out"
    call("render", ply, "--cameras", cameras, out, "--background", "0,0,1", "--alpha", "--depth")
    assert ["left.alpha.png", "left.depth.npy", "left.png"] == names(out)[:3]
    picture, alpha, depth = pixels(out / "left.png"), pixels(out / "left.alpha.png"), np.load(out / "left.depth.npy")
    assert (48, 64, 3) == picture.shape
    assert picture[24, 32, 0] > 240
    assert picture[24, 32, 2] < 10
    assert ([0, 0, 255], 0, 0.0) == (picture[0, 0].tolist(), alpha[0, 0], depth[0, 0])
    assert alpha[24, 32] > 240
    assert np.float32 == depth.dtype
    assert depth[24, 32] == pytest.approx(2.0, rel=1e-4)
    write_ply(ply, with_facts(read_ply(ply), entries={"training": {"background": [1, 1, 1]}}))
    call("render", ply, "--cameras", cameras, tmp_path / "trained", "--size", "128x96")
    picture = pixels(tmp_path / "trained" / "left.png")
    assert ((96, 128, 3), [255, 255, 255]) == (picture.shape, picture[0, 0].tolist())
    assert picture[48, 64, 0] > 240


def test_renders_of_an_orbit_are_numbered_and_follow_cameras(ply, cameras, tmp_path):
    call("render", ply, "--orbit", 3, "--size", "64x48", tmp_path / "around")
    call("render", ply, "--orbit", 2, "--cameras", cameras, "--size", "64x48", tmp_path / "along")
    assert ["0000.png", "0001.png", "0002.png"] == names(tmp_path / "around")
    pictures = {name: pixels(tmp_path / name / "0001.png") for name in ("along", "around")}
    assert {(48, 64, 3)} == {picture.shape for picture in pictures.values()}
    assert pictures["around"][24, 32, 0] > 200
    ball = {name: np.count_nonzero(picture[..., 0] > 128) for name, picture in pictures.items()}
    assert 1.5 * ball["along"] < ball["around"]  # the cameras are ten radii away: the ball is small


def test_nothing_is_replaced_without_force(ply, cameras, film_scene, tmp_path):
    out, film = tmp_path / "out", tmp_path / "turn.gif"
    out.mkdir()
    (out / "right.png").write_bytes(b"mine")
    film.write_bytes(b"mine")
    assert "right.png exists: --force replaces it" in refused("render", ply, "--cameras", cameras, out)
    assert ["right.png"] == names(out)
    call("render", ply, "--cameras", cameras, out, "--force")
    assert (48, 64, 3) == pixels(out / "right.png").shape
    words = ("render", film_scene, "--orbit", 1, "--size", "32x24", film)
    assert "turn.gif exists: --force replaces it" in refused(*words)
    assert b"mine" == film.read_bytes()
    assert "is given for two outputs" in refused(*words, "--force", "--report", film)
    call(*words, "--force")
    (frame,), _, _ = frames_of(film)  # a still image
    assert (24, 32, 3) == frame.shape


def test_without_cameras_the_first_view_is_rendered(ply, tmp_path):
    call("render", ply, tmp_path / "poster.webp", "--size", "60x40")
    (poster,), _, _ = frames_of(tmp_path / "poster.webp")
    camera = first_view(csplat.read(ply))
    wide = fitted(camera, 60, 40)
    assert (pytest.approx(camera.K[0, 0] * 40 / camera.H), 30.0, 20.0) == (wide.K[1, 1], *wide.K[:2, 2])
    assert psnr(poster / 255.0, render(csplat.read(ply), wide).rgb) > 30.0  # WebP loses a little
    call("render", ply, tmp_path / "out")
    assert (480, 640, 3) == pixels(tmp_path / "out" / "0000.png").shape


@pytest.mark.slow
def test_a_wrong_command_line_is_refused(ply, cameras, tmp_path):
    for words in (
        "turn.mp4", "turn.gif", "out --data set --cameras x.json", "out --cameras x.json --up z", "out --orbit 0",
        "out --orbit 3 --size 12", "out --orbit 3 --backend wrong", "a.tif --orbit 3", "turn.webp --orbit 2 --depth",
        "turn.webp --orbit 2 --fps 101",
    ):  # fmt: skip
        name, *options = words.split()
        call("render", ply, tmp_path / name, *options, status=2)
    assert "distorted" in refused("render", ply, "--cameras", cameras, tmp_path / "no", "--size", "64x64")
    resized(Camera(np.eye(3), np.eye(4), 391, 261), 1200, 800)  # a rounded 3:2
    assert ["ball.ply", "cameras.json"] == names(tmp_path)
    with pytest.raises(InputError, match="not a folder"):
        render_files.make_output_folder(str(cameras), ["a.png"], force=True)


def test_missing_packages_are_named(ply, cameras, tmp_path, monkeypatch):
    for module, package, extra, output in (("av", "av", "film", "turn.mp4"), ("PIL", "pillow", "render", "out")):
        monkeypatch.setitem(sys.modules, module, None)
        line = f"error: this needs {package}, of the extra {extra}: pip install {package} (E_INPUT)\n"
        assert line == refused("render", ply, "--cameras", cameras, tmp_path / output)
    assert hide_renderer(monkeypatch) == refused("render", ply, "--cameras", cameras, tmp_path / "out")


def test_names_of_renders_are_unique_and_stay_inside_the_folder():
    assert ["0000_a", "0001_a", "0002"] == render_files.image_names(["left/a.png", "right/a.png", None])
    for image in ("../../evil.png", "..\\..\\evil.png", "/etc/evil.png", "C:\\evil.jpg"):
        assert ["evil"] == render_files.image_names([image])
    for image in ("", "..", "/", "...png", ".png"):
        assert render_files.image_names([image])[0] in {"0000", "png"}


def test_colours_are_parsed_rounded_and_clipped_and_differences_amplified():
    assert [(0.0, 0.25, 1.0), (1.0, 1.0, 1.0)] == [parse_colour(text) for text in ("0,0.25,1", "white")]
    for text in ("1,1", "0,0,2", "red", "nan,0,0", "0,0,0,0"):
        with pytest.raises(typer.BadParameter, match="expected red,green,blue"):
            parse_colour(text)
    values = np.array([-1.0, 0.0, 0.5, 1.0, 7.0, np.nan, np.inf], np.float32)
    assert [0, 0, 128, 255, 255, 0, 255] == render_files.to_uint8(values).tolist()
    a, b = np.full((1, 1, 3), 0.5, np.float32), np.full((1, 1, 3), 0.45, np.float32)
    assert [[128] * 3, [115] * 3, [128] * 3] == render_files.side_by_side(a, b, 10.0)[0].tolist()


ORBIT = ("--orbit", 4, "--size", "64x48")


@pytest.fixture(scope="module")
def film_scene(tmp_path_factory):
    """A PLY with a recorded up direction, which would otherwise be estimated."""
    path, rng = tmp_path_factory.mktemp("film") / "scene.ply", np.random.default_rng(0)
    colours = rng.standard_normal((200, 3)).astype(np.float32)
    write_ply(path, cloud(rng.standard_normal((200, 3)), 0.14, sh0=colours, entries={"up": [0, -1, 0]}))
    return path


@pytest.fixture(scope="module")
def pictures(film_scene, tmp_path_factory):
    """The renders of an orbit."""
    folder = tmp_path_factory.mktemp("pictures") / "turn"
    call("render", film_scene, *ORBIT, folder)
    return [pixels(folder / f"{number:04d}.png") for number in range(4)]


def frames_of(path):
    """Return every frame as RGB, its duration in ms, and the loop count."""
    with Image.open(path) as film:
        frames, times = [], []
        for number in range(film.n_frames):
            film.seek(number)
            frames.append(np.asarray(film.convert("RGB")).astype(int))
            times.append(film.info.get("duration", 0))
        return frames, times, film.info.get("loop")


@pytest.mark.slow
@pytest.mark.parametrize(("ending", "tolerance"), [("webp", 6.0), ("gif", 8.0), ("png", 0.0), ("apng", 0.0)])
def test_a_film_equals_the_renders_and_is_reproducible(film_scene, pictures, tmp_path, ending, tolerance):
    films = [tmp_path / f"{name}.{ending}" for name in ("one", "two")]
    for film in films:
        call("render", film_scene, *ORBIT, film, "--fps", 20)
    assert films[0].read_bytes() == films[1].read_bytes()
    assert [film.name for film in films] == names(tmp_path)
    frames, times, loop = frames_of(films[0])
    assert ([50] * 4, 0) == (times, loop)
    for expected, frame in zip(pictures, frames, strict=True):
        assert (48, 64, 3) == frame.shape
        assert np.abs(expected - frame).mean() <= tolerance


@pytest.mark.slow
def test_an_mp4_resembles_the_renders_and_is_reproducible(film_scene, tmp_path):
    av = pytest.importorskip("av", reason="MP4 needs PyAV: pip install av")
    words = ("render", film_scene, "--orbit", 3, "--size", "65x49", "--background", "0.9,0.2,0.1", "--fps", 12.5)
    for name in ("one.mp4", "two.mp4", "turn"):
        call(*words, tmp_path / name)
    assert (tmp_path / "one.mp4").read_bytes() == (tmp_path / "two.mp4").read_bytes()
    with av.open(tmp_path / "one.mp4") as film:
        stream = film.streams.video[0]
        said = (stream.codec_context.name, stream.pix_fmt, stream.width, stream.height, stream.average_rate)
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in film.decode(stream)]
    assert ("h264", "yuv420p", 64, 48, 12.5) == said
    assert 3 == len(frames)
    for number, frame in enumerate(frames):
        expected = pixels(tmp_path / "turn" / f"{number:04d}.png")[:48, :64]
        assert np.abs(expected[0, 0] - frame[0, 0]).max() < 5
        assert np.abs(expected - frame).mean() < 8.0


def test_films_of_invalid_sizes_or_formats_are_refused_and_durations_do_not_drift(tmp_path, monkeypatch):
    for name, sizes, message in (
        ("a.gif", [(4, 4), (5, 4)], "the cameras have 2 sizes"), ("a.webp", [(20_000, 10)] * 2, "at most 16383"),
        ("a.webp", [(1920, 1080)] * 400, "more than 2 GiB: render into a folder"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            render_files.check_film(name, sizes, 25.0)
    for unit, expected in ((1000, [33, 34, 33]), (100, [30, 40, 30])):
        assert expected == render_files._durations(3, 30.0, unit)
        assert 10_000 == sum(render_files._durations(300, 30.0, unit))
    for name, value in {"SAVE_ALL": {}, "SAVE": {}, "init": lambda: None}.items():
        monkeypatch.setattr(Image, name, value)
    with pytest.raises(InputError, match="cannot write WEBP"):
        render_files.write_film(str(tmp_path / "a.webp"), [np.zeros((2, 2, 3), np.uint8)] * 2, 25.0)
    assert [] == names(tmp_path)


def test_images_are_removed_if_not_all_are_made(ply, tmp_path, monkeypatch):
    write, out = scene_renders.write_png, tmp_path / "out"
    for module, words in (
        (scene_renders, ("render", ply, out, "--orbit", 3, "--size", "16x16")),
        (comparison, ("compare", ply, ply, "--pictures", out)),
    ):

        def fail_at_the_second(path, image):
            if "0001" in path.name:
                raise OSError(28, "No space left on device", str(path))
            write(path, image)

        monkeypatch.setattr(module, "write_png", fail_at_the_second)
        call(*words, status=1)
        assert not out.exists()


def test_files_beside_a_manifest_are_not_replaced(ply, tmp_path):
    (tmp_path / "sh0.webp").write_text("mine")
    assert "sh0.webp exists" in call("convert", ply, tmp_path / "meta.json", status=1).stderr
    call("convert", ply, tmp_path / "meta.json", "--force", "--quiet")
    assert "is the input" in call("convert", tmp_path, tmp_path / "meta.json", "--force", status=1).stderr
