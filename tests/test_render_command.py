"""`csplat render`: which files it writes, what is in them, and what it refuses."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from command_line import invoke
from typer.testing import CliRunner

from csplat import EncodeOptions, encode, read_ply, write_ply
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_tools.cli.app import app
from csplat_tools.cli.shared_options import parse_colour, parse_size
from csplat_tools.render_files import image_names, make_output_folder, side_by_side, to_uint8


@pytest.fixture
def ply(tmp_path):
    """One red, opaque ball of radius 0.2 around the origin."""
    model = SplatModel(
        means=np.zeros((1, 3), np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.full((1, 3), np.log(0.2), np.float32),
        opacities=np.ones(1, np.float32),
        sh0=np.array([[1.7, -1.8, -1.8]], np.float32),
        shN=np.zeros((1, 3, 3), np.float32),
        metadata={"up": [0, -1, 0]},  # otherwise it would be searched for
    )
    path = tmp_path / "ball.ply"
    write_ply(path, model)
    return path


def camera(image=None, width=64, height=48):
    """Two units in front of the origin."""
    entry = {
        "K": [[60.0, 0.0, width / 2], [0.0, 60.0, height / 2], [0.0, 0.0, 1.0]],
        "viewmat": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]],
        "W": width,
        "H": height,
    }
    return entry if image is None else {**entry, "image": image}


@pytest.fixture
def cameras(tmp_path):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([camera("images/left.jpg"), camera("images/right.jpg")]))
    return path


def call(*words):
    pytest.importorskip("numba", reason="the renderer needs numba: pip install 'csplat[render]'")
    pytest.importorskip("PIL", reason="pictures need pillow: pip install 'csplat[render]'")
    result = invoke(*words)
    assert result.exit_code == 0, (result.stderr, result.exception)
    assert "" == result.stdout
    return result.stderr


def refused(*words):
    result = invoke(*words)
    assert result.exit_code == 1, (result.stdout, result.stderr, result.exception)
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


def pixels(path):
    from PIL import Image

    with Image.open(path) as picture:
        return np.asarray(picture)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_pictures_take_the_names_of_the_photographs(ply, cameras, tmp_path):
    call("render", ply, "--cameras", cameras, "-o", tmp_path / "out")
    assert ["left.png", "right.png"] == names(tmp_path / "out")


def test_a_ball_is_red_in_the_middle_and_the_background_around_it(ply, cameras, tmp_path):
    call("render", ply, "--cameras", cameras, "-o", tmp_path / "out", "--background", "0,0,1")
    picture = pixels(tmp_path / "out" / "left.png")
    assert (48, 64, 3) == picture.shape
    assert picture[24, 32, 0] > 240
    assert picture[24, 32, 2] < 10
    assert [0, 0, 255] == picture[0, 0].tolist()
    trained = replace(read_ply(ply), metadata={"training": {"background": [1, 1, 1]}})
    write_ply(ply, trained)
    call("render", ply, "--cameras", cameras, "-o", tmp_path / "trained")
    assert [255, 255, 255] == pixels(tmp_path / "trained" / "left.png")[0, 0].tolist()


def test_alpha_and_depth_lie_beside_the_picture(ply, cameras, tmp_path):
    call("render", ply, "--cameras", cameras, "-o", tmp_path / "out", "--alpha", "--depth")
    assert ["left.alpha.png", "left.depth.npy", "left.png"] == names(tmp_path / "out")[:3]
    alpha, depth = pixels(tmp_path / "out" / "left.alpha.png"), np.load(tmp_path / "out" / "left.depth.npy")
    assert alpha[24, 32] > 240
    assert 0 == alpha[0, 0]
    assert np.float32 == depth.dtype
    assert depth[24, 32] == pytest.approx(2.0, rel=1e-4)
    assert 0.0 == depth[0, 0]


def test_an_orbit_is_numbered_and_of_the_size_asked_for(ply, tmp_path):
    call("render", ply, "--orbit", 3, "--size", "40x30", "-o", tmp_path / "out")
    assert ["0000.png", "0001.png", "0002.png"] == names(tmp_path / "out")
    picture = pixels(tmp_path / "out" / "0002.png")
    assert (30, 40, 3) == picture.shape
    assert picture[15, 20, 0] > 200


def test_an_orbit_with_cameras_leads_along_them(ply, cameras, tmp_path):
    call("render", ply, "--orbit", 2, "--cameras", cameras, "--size", "64x48", "-o", tmp_path / "along")
    call("render", ply, "--orbit", 2, "--size", "64x48", "-o", tmp_path / "around")
    ball = {name: np.count_nonzero(pixels(tmp_path / name / "0001.png")[..., 0] > 128) for name in ("along", "around")}
    assert 1.5 * ball["along"] < ball["around"]  # the cameras stand ten radii away: a small ball


def test_a_csplat_file_shows_what_its_ply_shows(cameras, tmp_path, make_model):
    model = make_model(300, 1)
    write_ply(tmp_path / "many.ply", model)
    (tmp_path / "many.csplat").write_bytes(encode(model, EncodeOptions(preset="fast")))
    for kind in ("ply", "csplat"):
        call("render", tmp_path / f"many.{kind}", "--cameras", cameras, "-o", tmp_path / kind)
    a, b = (pixels(tmp_path / kind / "left.png").astype(int) for kind in ("ply", "csplat"))
    assert a.max() > 50
    assert np.abs(a - b).mean() < 2.0


def test_a_resized_camera_takes_the_same_picture(ply, cameras, tmp_path):
    call("render", ply, "--cameras", cameras, "-o", tmp_path / "out", "--size", "128x96")
    picture = pixels(tmp_path / "out" / "left.png")
    assert (96, 128, 3) == picture.shape
    assert picture[48, 64, 0] > 240


def test_the_same_command_writes_the_same_bytes(ply, cameras, tmp_path):
    for name in ("one", "two"):
        call("render", ply, "--cameras", cameras, "-o", tmp_path / name)
    assert (tmp_path / "one" / "left.png").read_bytes() == (tmp_path / "two" / "left.png").read_bytes()


def test_nothing_is_replaced_without_force(ply, cameras, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "right.png").write_bytes(b"mine")
    pytest.importorskip("numba", reason="the renderer needs numba")
    pytest.importorskip("PIL", reason="pictures need pillow")
    assert "right.png exists: --force replaces it" in refused(
        "render", ply, "--cameras", cameras, "-o", tmp_path / "out"
    )
    assert ["right.png"] == names(tmp_path / "out")
    call("render", ply, "--cameras", cameras, "-o", tmp_path / "out", "--force")
    assert (48, 64, 3) == pixels(tmp_path / "out" / "right.png").shape


def test_a_camera_file_of_another_program_is_reported(ply, tmp_path):
    rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    entry = {
        "img_name": "a",
        "width": 64,
        "height": 48,
        "position": [0, 0, -4],
        "rotation": rotation,
        "fx": 60,
        "fy": 60,
    }
    (tmp_path / "inria.json").write_text(json.dumps([entry]))
    told = call("render", ply, "--cameras", tmp_path / "inria.json", "-o", tmp_path / "out")
    assert "cameras.json of INRIA: 1 camera" in told
    assert ["a.png"] == names(tmp_path / "out")


def test_a_distorting_size_is_refused(ply, cameras, tmp_path):
    pytest.importorskip("numba", reason="the renderer needs numba")
    assert "distorted" in refused("render", ply, "--cameras", cameras, "-o", tmp_path / "out", "--size", "64x64")


@pytest.mark.parametrize(
    "words",
    [
        (),
        ("--data", "set", "--cameras", "x.json"),
        ("--cameras", "x.json", "--up", "z"),
        ("--orbit", "0"),
        ("--orbit", "3", "--size", "12"),
        ("--orbit", "3", "--mode", "wrong"),
    ],
)
def test_a_wrong_command_line_has_status_2(ply, tmp_path, words):
    assert 2 == invoke("render", ply, "-o", tmp_path / "out", *words).exit_code


@pytest.mark.parametrize(("module", "package"), [("numba", "numba"), ("PIL", "pillow")])
def test_without_the_extra_packages_one_line_says_what_to_install(ply, cameras, tmp_path, monkeypatch, module, package):
    pytest.importorskip("numba", reason="one of the two is absent anyway")
    monkeypatch.setitem(sys.modules, module, None)
    line = f"error: this needs {package}: pip install 'csplat[render]' (E_INPUT)\n"
    assert line == refused("render", ply, "--cameras", cameras, "-o", tmp_path / "out")


def test_a_report_never_takes_the_place_of_the_film(ply, tmp_path):
    film = tmp_path / "turn.webp"
    result = CliRunner().invoke(app, ["render", str(ply), str(film), "--orbit", "2", "--report", str(film)])
    assert 1 == result.exit_code
    assert "is given for two outputs" in result.stderr
    assert not film.exists()


def test_names_that_are_not_unique_are_numbered():
    assert ["0000_a", "0001_a", "0002"] == image_names(["left/a.png", "right/A.png".lower(), None])


@pytest.mark.parametrize("image", ["../../evil.png", "..\\..\\evil.png", "/etc/evil.png", "C:\\evil.jpg"])
def test_a_name_never_leads_out_of_the_folder(image):
    assert ["evil"] == image_names([image])


@pytest.mark.parametrize("image", ["", "..", "/", "...png", ".png"])
def test_a_name_of_nothing_becomes_a_number_or_stays_harmless(image):
    (name,) = image_names([image])
    assert name in {"0000", "png"}


def test_a_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="not a folder"):
        make_output_folder(str(tmp_path / "file"), ["a.png"], force=True)


def test_bytes_are_rounded_and_clipped():
    values = np.array([-1.0, 0.0, 0.5, 1.0, 7.0, np.nan, np.inf], np.float32)
    assert [0, 0, 128, 255, 255, 0, 255] == to_uint8(values).tolist()


def test_panels_show_both_and_the_amplified_difference():
    a, b = np.full((1, 1, 3), 0.5, np.float32), np.full((1, 1, 3), 0.45, np.float32)
    assert [[128] * 3, [115] * 3, [128] * 3] == side_by_side(a, b, 10.0)[0].tolist()


def test_sizes_and_colours_are_parsed():
    assert (640, 480) == parse_size("640x480")
    assert (0.0, 0.25, 1.0) == parse_colour("0,0.25,1")
    assert (1.0, 1.0, 1.0) == parse_colour("white")


@pytest.mark.parametrize("text", ["1,1", "0,0,2", "red", "nan,0,0", "0,0,0,0"])
def test_other_colours_are_refused(text):
    import typer

    with pytest.raises(typer.BadParameter, match="wanted red,green,blue"):
        parse_colour(text)
