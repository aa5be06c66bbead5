"""The axes table: wherever a scene comes from, all that shows it agrees on up, also after its way through files."""

import base64
import functools
import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from csplat import decode, read_ply, write_ply
from csplat.editing.transform import rotate_scene
from csplat.editing.up_axis import up_of
from csplat.model import SplatModel
from csplat_tools.cli.app import app

pytest.importorskip("numba", reason="the renderer needs numba: pip install 'csplat[render]'")
pytest.importorskip("scipy", reason="the trainer needs scipy: pip install 'csplat[render]'")
pytest.importorskip("PIL", reason="pictures need pillow: pip install 'csplat[render]'")

# Importing them needs what is looked for above.
from posed_sets import write_blender, write_colmap_set, write_transforms

from csplat_render import render
from csplat_render.camera_paths import orbit_cameras
from csplat_trainer.data import load
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import TrainOptions

pytestmark = pytest.mark.slow  # each case takes a third of a second

ALMOST_NONE = {"max_splats": 40, "sh_degree": 0, "iterations": 1, "strategy": "none"}
TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # -y to z


def call(*words):
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert 0 == done.exit_code, (done.stderr, done.exception)
    return done.stdout


def trained(write, up):
    @functools.cache
    def known(folder):
        folder.mkdir()
        write(folder, up=up)
        return train(load(folder), TrainOptions(**ALMOST_NONE)).model

    return lambda folder, _make_model: known(folder.parent / write.__name__)


TRANSFORMS = trained(write_transforms, (1, 0, 0))


def untold(**fields):
    return lambda _folder, make_model: make_model(60, 1, **fields)


@pytest.mark.parametrize(
    ("make", "words", "axes", "up"),
    [
        (trained(write_blender, (0, 0, 1)), [], "RFU", (0, 0, 1)),
        (trained(write_colmap_set, (0, -1, 0)), [], "unspecified", (0, -1, 0)),
        (TRANSFORMS, [], "unspecified", (1, 0, 0)),
        (TRANSFORMS, ["--up", "-y"], "unspecified", (0, -1, 0)),
        (untold(), [], "unspecified", None),
        (untold(), ["--up", "0,-2,2"], "unspecified", (0, -0.707107, 0.707107)),
        (untold(), ["--axes", "LUF"], "LUF", (0, 1, 0)),
        (untold(metadata={"up": [1, 0, 0]}), ["--axes", "RDF"], "RDF", (0, -1, 0)),
        (untold(coordinate_system="RDF"), ["--up", "z"], "unspecified", (0, 0, 1)),
        (lambda _folder, make_model: rotate_scene(make_model(60, 1), TURN), ["--up", "z"], "unspecified", (0, 0, 1)),
    ],
    ids=[
        "blender", "colmap", "transforms", "transforms-told", "ply", "ply-told", "ply-axes", "up-axes",
        "axes-up", "turned",
    ],
)  # fmt: skip
def test_all_that_shows_a_scene_agrees_on_up(tmp_path, make_model, make, words, axes, up):
    write_ply(tmp_path / "scene.ply", make(tmp_path, make_model))
    call("encode", tmp_path / "scene.ply", tmp_path / "a.csplat", *words, "--preset", "fast", "-q")
    call("decode", tmp_path / "a.csplat", tmp_path / "b.ply")
    call("encode", tmp_path / "b.ply", tmp_path / "b.csplat", "--preset", "fast", "-q")
    for path in (tmp_path / "a.csplat", tmp_path / "b.csplat"):
        told = json.loads(call("info", path, "--json"))
        assert (axes, None if up is None else list(up)) == (told["coordinate_system"], told["up"])
    scene, wishes = in_page(path)
    assert (up, {}) == (up_of(scene.metadata, scene.coordinate_system), wishes)
    shown = "unknown" if up is None else " ".join(f"{value:g}" for value in up)
    assert f"\nup           {shown}\n" in call("info", tmp_path / "b.csplat")
    model = read_ply(tmp_path / "b.ply")
    assert (scene.coordinate_system, scene.metadata.get("up")) == (model.coordinate_system, model.metadata.get("up"))
    upright(orbit_cameras(model, 2, 64, 48), up or (0, -1, 0))  # without a recorded up: as in a PLY


def in_page(path):
    """Return the scene in its page, and the parameters that the page has in addition."""
    page = path.with_suffix(".html")
    call("export-html", path, page, "--force")
    text = page.read_text("utf-8")
    said = json.loads(re.search(r'id="csplat-page">(.*?)</script>', text, re.DOTALL)[1])
    scene = decode(base64.b64decode(re.search(r'id="csplat-scene">(.*?)</script>', text, re.DOTALL)[1]))
    return scene, said["wishes"]


def upright(cameras, up):
    direction = np.array(up) / np.linalg.norm(up)
    for camera in cameras:
        assert abs(camera.viewmat[0, :3] @ direction) < 1e-6
        assert -camera.viewmat[1, :3] @ direction > 0.5


def test_the_page_is_told_what_the_user_says(tmp_path, make_model):
    write_ply(tmp_path / "scene.ply", make_model(60, 0))
    call("export-html", tmp_path / "scene.ply", tmp_path / "scene.html", "--up", "0,-1,0.1", "--axes", "RDF")
    text = (tmp_path / "scene.html").read_text("utf-8")
    said = json.loads(re.search(r'id="csplat-page">(.*?)</script>', text, re.DOTALL)[1])
    assert {"axes": "RDF", "up": "0,-0.995037,0.099504"} == said["wishes"]


def test_a_scene_that_is_turned_with_its_sh_looks_the_same_on_its_orbit(make_model):
    model = make_model(60, 1, scales=np.full((60, 3), -0.7, np.float32) - np.arange(3, dtype=np.float32))
    lying = rotate_scene(model, TURN)
    told = [
        SplatModel(**{**vars(one), "metadata": {"up": up}}) for one, up in ((model, [0, -1, 0]), (lying, [0, 0, 1]))
    ]
    films = [[render(one, camera).rgb for camera in orbit_cameras(one, 3, 64, 48)] for one in told]
    untold = [render(lying, camera).rgb for camera in orbit_cameras(lying, 3, 64, 48)]
    for before, after, guessed in zip(*films, untold, strict=True):
        # Not nearer: the orbit is laid about points drawn along the axes of the splats, which have changed places.
        assert np.abs(after - before).mean() < 0.15 * np.abs(before).mean()
        assert np.abs(guessed - before).mean() > 0.3 * np.abs(before).mean()
