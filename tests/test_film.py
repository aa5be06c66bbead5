"""`csplat render -o NAME.webp`: films of an orbit, in the formats that pillow writes, and as MP4."""

import sys

import numpy as np
import pytest
from command_line import invoke

from csplat import write_ply
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_tools.render_files import _durations, check_film, is_film, write_film

pytest.importorskip("numba", reason="the renderer needs numba: pip install 'csplat[render]'")
Image = pytest.importorskip("PIL.Image", reason="films need pillow: pip install 'csplat[render]'")


ORBIT = ("--orbit", 4, "--size", "64x48")


@pytest.fixture(scope="module")
def ply(tmp_path_factory):
    """Return a scene with a recorded up direction, which would otherwise be searched for."""
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("film") / "scene.ply"
    model = SplatModel(
        means=rng.standard_normal((200, 3)).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (200, 1)),
        scales=np.full((200, 3), -2.0, np.float32),
        opacities=rng.random(200).astype(np.float32),
        sh0=rng.standard_normal((200, 3)).astype(np.float32),
        metadata={"up": [0, -1, 0]},
    )
    write_ply(path, model)
    return path


@pytest.fixture(scope="module")
def pictures(ply, tmp_path_factory):
    """The pictures of an orbit."""
    folder = tmp_path_factory.mktemp("pictures") / "turn"
    assert 0 == invoke("render", ply, *ORBIT, "-o", folder).exit_code
    return [read_picture(folder / f"{number:04d}.png") for number in range(4)]


def read_picture(path):
    with Image.open(path) as picture:
        return np.asarray(picture).astype(int)


def frames_of(path):
    """Every frame as RGB, and how long it stays, ms."""
    with Image.open(path) as film:
        frames, times = [], []
        for number in range(film.n_frames):
            film.seek(number)
            frames.append(np.asarray(film.convert("RGB")).astype(int))
            times.append(film.info.get("duration", 0))
        return frames, times, film.info.get("loop")


@pytest.mark.parametrize(("ending", "tolerance"), [("webp", 6.0), ("gif", 8.0), ("png", 0.0), ("apng", 0.0)])
def test_a_film_shows_what_the_pictures_show(ply, pictures, tmp_path, ending, tolerance):
    film = tmp_path / f"turn.{ending}"
    done = invoke("render", ply, *ORBIT, "-o", film, "--fps", 20)
    assert (0, "") == (done.exit_code, done.stdout), done.stderr
    assert f"4 frames in {film}\n" == done.stderr
    frames, times, loop = frames_of(film)
    assert (4, [50] * 4, 0) == (len(frames), times, loop)
    for expected, frame in zip(pictures, frames, strict=True):
        assert (48, 64, 3) == frame.shape
        assert np.abs(expected - frame).mean() <= tolerance
    assert [] == [path.name for path in tmp_path.iterdir() if "tmp" in path.name]


def test_the_same_command_writes_the_same_film(ply, tmp_path):
    for name in ("one.webp", "two.webp"):
        assert 0 == invoke("render", ply, "--orbit", 2, "--size", "32x24", "-o", tmp_path / name).exit_code
    assert (tmp_path / "one.webp").read_bytes() == (tmp_path / "two.webp").read_bytes()


@pytest.mark.slow
def test_an_mp4_shows_what_the_pictures_show_and_is_the_same_again(ply, tmp_path):
    av = pytest.importorskip("av", reason="MP4 needs PyAV: pip install 'csplat[film]'")
    words = ("render", ply, "--orbit", 3, "--size", "65x49", "--background", "0.9,0.2,0.1", "--fps", 12.5)
    for name in ("one.mp4", "two.mp4", "turn"):
        assert 0 == invoke(*words, "-o", tmp_path / name).exit_code
    assert (tmp_path / "one.mp4").read_bytes() == (tmp_path / "two.mp4").read_bytes()
    with av.open(tmp_path / "one.mp4") as film:
        stream = film.streams.video[0]
        said = (stream.codec_context.name, stream.pix_fmt, stream.width, stream.height, stream.average_rate)
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in film.decode(stream)]
    assert ("h264", "yuv420p", 64, 48, 12.5) == said
    assert 3 == len(frames)
    for number, frame in enumerate(frames):
        expected = read_picture(tmp_path / "turn" / f"{number:04d}.png")[:48, :64]
        assert np.abs(expected[0, 0] - frame[0, 0]).max() < 5
        assert np.abs(expected - frame).mean() < 8.0


def test_without_pyav_one_line_says_what_to_install(ply, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    done = invoke("render", ply, "--orbit", 2, "-o", tmp_path / "turn.mp4")
    assert (1, "error: this needs av: pip install 'csplat[film]' (E_INPUT)\n") == (done.exit_code, done.stderr)
    assert not (tmp_path / "turn.mp4").exists()


def test_an_existing_film_is_kept_without_force(ply, tmp_path):
    film = tmp_path / "turn.gif"
    film.write_bytes(b"mine")
    words = ("render", ply, "--orbit", 2, "--size", "32x24", "-o", film)
    refused = invoke(*words)
    assert 1 == refused.exit_code
    assert "turn.gif exists: --force replaces it" in refused.stderr
    assert b"mine" == film.read_bytes()
    assert 0 == invoke(*words, "--force").exit_code
    assert film.read_bytes().startswith(b"GIF89a")


def test_a_film_of_one_picture_is_a_picture(tmp_path):
    for ending in ("webp", "gif", "png"):
        film = tmp_path / f"still.{ending}"
        write_film(str(film), [np.full((24, 32, 3), 9, np.uint8)], 25.0)
        (frame,), _, _ = frames_of(film)
        assert (9, 9) == (frame.min(), frame.max())


@pytest.mark.parametrize(
    ("words", "status", "says"),
    [
        (("--depth",), 2, "want a folder"),
        (("--fps", "0"), 2, "fps"),
        (("--fps", "101"), 2, "fps"),
        (("--size", "20000x10"), 1, "at most 16383 pixels a side"),
    ],
)
def test_what_a_film_cannot_be_is_refused(ply, tmp_path, words, status, says):
    refused = invoke("render", ply, "--orbit", 2, "-o", tmp_path / "turn.webp", *words)
    assert status == refused.exit_code
    assert says in " ".join(refused.stderr.split())


def test_pictures_of_two_sizes_make_no_film():
    with pytest.raises(InputError, match="one size, the cameras have 2"):
        check_film("a.gif", [(4, 4), (5, 4)], 25.0)


def test_a_film_larger_than_memory_allows_is_refused():
    with pytest.raises(InputError, match=r"more than 2 GiB: render into a folder"):
        check_film("a.webp", [(1920, 1080)] * 400, 25.0)


def test_durations_do_not_drift():
    assert [33, 34, 33] == _durations(3, 30.0, 1000)
    assert 10_000 == sum(_durations(300, 30.0, 1000))
    assert [30, 40, 30] == _durations(3, 30.0, 100)
    assert 10_000 == sum(_durations(300, 30.0, 100))


def test_names_tell_films_from_folders():
    assert [True, True, True, True, False, False] == [
        is_film(name) for name in ("a.webp", "b.GIF", "c.png", "d.mp4", "e", "f.mkv")
    ]


def test_a_film_that_pillow_cannot_write_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(Image, "SAVE_ALL", {})
    monkeypatch.setattr(Image, "SAVE", {})
    monkeypatch.setattr(Image, "init", lambda: None)
    with pytest.raises(InputError, match="cannot write WEBP"):
        write_film(str(tmp_path / "a.webp"), [np.zeros((2, 2, 3), np.uint8)] * 2, 25.0)
    assert [] == list(tmp_path.iterdir())
