# SPDX-License-Identifier: Apache-2.0
"""L4: reference pictures, and renderers within and beyond the tolerance."""

import json
import shlex
import sys

import numpy as np
import pytest
from tables import failures

from csplat.errors import InputError
from csplat_authoring.recipes.rendered import rendered_recipes
from csplat_authoring.reference import expected
from csplat_conformance import reference_renders
from csplat_conformance.conformance_report import Status
from csplat_conformance.decoder_suite import DecoderSuiteOptions, run_builtin, run_command
from csplat_conformance.manifest import VECTORS, load
from csplat_conformance.reference_renders import PSNR_CAP, psnr, read_png, write_png

#: `make test` renders these pictures with our decoder and rasteriser, by the command.
pytestmark = pytest.mark.long
RENDERED = [vector for vector in load() if vector.views]

# Copies the picture of a camera, with a selectable fault; no slow imports.
COPIER = """
import json, pathlib, sys

fault, _, camera, out = sys.argv[1:]
if fault == "status":
    sys.exit(1)
folder = pathlib.Path(__file__).parent
wanted = json.loads(pathlib.Path(camera).read_text())
(number,) = [number for number, one in enumerate(json.loads((folder / "cameras.json").read_text())) if [one] == wanted]
if fault == "text":
    pathlib.Path(out).write_text("P3")
elif fault != "nothing":
    pathlib.Path(out).write_bytes((folder / f"{fault}.{number}.png").read_bytes())
"""
PICTURES = {
    "none": lambda picture: picture,
    "shifted": lambda picture: np.roll(picture, -1, axis=1),
    "small": lambda picture: picture[1:],
}


@pytest.fixture(scope="module")
def copier(tmp_path_factory):
    """Return a function for the command line of a renderer of `render/ellipsoids` with a fault."""
    folder = tmp_path_factory.mktemp("renderer")
    (vector,) = [vector for vector in RENDERED if vector.name == "render/ellipsoids"]
    (folder / "cameras.json").write_text(json.dumps([view["camera"] for view in vector.views]))
    for number, view in enumerate(vector.views):
        picture = read_png((VECTORS / view["picture"]).read_bytes())
        for fault, change in PICTURES.items():
            (folder / f"{fault}.{number}.png").write_bytes(write_png(np.ascontiguousarray(change(picture))))
    script = folder / "renderer.py"
    script.write_text(COPIER)
    return lambda fault: f"{shlex.join([sys.executable, '-I', '-S', str(script)])} {fault} {{input}} {{camera}} {{out}}"


def test_a_scene_is_seen_by_two_cameras_of_a_camera_file_and_not_dark():
    from csplat_render.camera import Camera

    def check(vector):
        assert 2 == len(vector.views)
        for view in vector.views:
            camera, picture = view["camera"], read_png((VECTORS / view["picture"]).read_bytes())
            assert (camera["H"], camera["W"], 3) == picture.shape
            assert psnr(picture, np.zeros_like(picture)) < 25
            assert camera == json.loads(json.dumps(Camera.from_json(camera).as_json()))

    assert [] == failures(RENDERED, check)


def test_our_renderer_is_within_the_tolerance():
    report = run_builtin(DecoderSuiteOptions(pattern="render/*", levels=(4,)))
    assert report.passed
    assert 8 == len(report.outcomes)
    assert min(outcome.details["psnr"] for outcome in report.outcomes) > 60


@pytest.mark.parametrize(("name", "change"), [
    ("render/harmonics", lambda floats: {"shN": floats["shN"][:, :0]}),
    ("render/harmonics_4", lambda floats: {"shN": floats["shN"][:, :15]}),  # no band 4
    ("render/ellipsoids", lambda floats: {"quats": np.roll(floats["quats"], 1, axis=1)}),  # x, y, z, w
    ("render/ellipsoids", lambda floats: {"quats": floats["quats"] * np.float32([-1, 1, 1, 1])}),
    ("render/ellipsoids", lambda floats: {"scales": floats["scales"] + 0.05}),
    ("render/antialiased", None),  # no low-pass filter
])  # fmt: skip
def test_a_faulty_renderer_is_below_the_required_psnr(name, change):
    recipe = next(recipe for recipe in rendered_recipes() if recipe.name == name)
    made = expected(recipe.scene, 0)
    floats = made.floats | (change(made.floats) if change else {})
    antialiased = bool(made.header["antialiasing"]) and change is not None

    def score(number, view):
        reference = read_png((VECTORS / f"{name}.{number}.png").read_bytes())
        return psnr(reference, reference_renders.reference_render(floats, view.camera, antialiased))

    assert any(score(number, view) < view.psnr for number, view in enumerate(recipe.views))


@pytest.mark.parametrize(("fault", "status", "message"), [
    ("none", Status.PASSED, ""),
    ("shifted", Status.FAILED, "expected 45"),
    ("small", Status.WRONG_ANSWER, "128x127 pixels, expected 128x128"),
    ("text", Status.WRONG_ANSWER, "not a PNG"),
    ("nothing", Status.NO_OUTPUT, "0 PNG files"),
    ("status", Status.REFUSED, "exit status 1"),
])  # fmt: skip
def test_each_fault_of_a_renderer_has_its_status(copier, fault, status, message):
    report = run_command(None, DecoderSuiteOptions(pattern="render/ellipsoids", levels=(4,)), render=copier(fault))
    assert {status} == {outcome.status for outcome in report.outcomes}
    assert all(message in outcome.message for outcome in report.outcomes)


def test_without_a_renderer_pictures_are_skipped_with_a_note(monkeypatch):
    monkeypatch.setattr(reference_renders, "can_render", lambda: False)
    (outcome, _) = run_builtin(DecoderSuiteOptions(pattern="render/ellipsoids", levels=(4,))).outcomes
    assert (Status.SKIPPED, "needs csplat's compiled renderer") == (outcome.status, outcome.message)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "LA"])
def test_pictures_of_other_writers_and_of_ours_are_read(tmp_path, mode):
    image = pytest.importorskip("PIL.Image", reason="pictures require the extra [render]")
    noise = np.random.default_rng(1).integers(0, 256, (40, 30, 3), np.uint8)
    noise[10:] = np.arange(90, dtype=np.uint8).reshape(30, 3)  # the writer then chooses every filter
    picture = image.fromarray(noise).convert(mode)
    picture.save(tmp_path / "a.png")
    pixels = np.asarray(picture.convert("RGB"))
    assert np.array_equal(pixels, read_png((tmp_path / "a.png").read_bytes()))
    assert np.array_equal(pixels, read_png(write_png(pixels)))


def test_equal_pictures_score_the_cap_and_other_sizes_and_data_are_refused():
    picture = np.zeros((2, 2, 3), np.uint8)
    assert PSNR_CAP == psnr(picture, picture)
    assert 0.0 == psnr(picture, picture + np.uint8(255))
    with pytest.raises(InputError):
        psnr(picture, picture[:1])
    for data in (b"", b"GIF89a", write_png(picture)[:40]):
        with pytest.raises(InputError):
            read_png(data)
