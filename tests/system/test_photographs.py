# SPDX-License-Identifier: Apache-2.0
"""`csplat compare --data` and `csplat render --data`; both check their inputs before they render."""

import json
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from captures import as_bytes, with_alpha
from checked import cloud
from command_line import call, invoke
from PIL import Image
from posed_sets import to_opengl, write_document

import csplat
from csplat import EncodeOptions, encode, write_ply
from csplat.errors import InputError
from csplat_render import render
from csplat_render.camera import intrinsics, look_at
from csplat_render.camera_files import save_cameras
from csplat_tools.inspect.comparison import compare
from csplat_tools.views import DataOptions, find_view_set
from csplat_trainer.posed_images import PosedImage, image_scorer

W, H = 64, 48


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(0)
    fields = {"scales": rng.normal(-2.7, 0.3, (300, 3)), "opacities": rng.random(300)}
    fields |= {"sh0": 0.2 * rng.normal(size=(300, 3)), "shN": 0.2 * rng.normal(size=(300, 3, 3))}  # no colour beyond 1
    return cloud(rng.normal(size=(300, 3)), **{name: values.astype(np.float32) for name, values in fields.items()})


def cameras(count):
    K, angles = intrinsics(W, H, 60.0), np.linspace(0.2, 5.5, count)
    return [look_at((5 * np.cos(a), 5 * np.sin(a), 1.0), (0, 0, 0), (0, 0, 1), K, W, H) for a in angles]


def write_set(folder, scene, *, alpha, shift=(0.0, 0.0, 0.0)):
    """Write nine images of the scene and a transforms.json whose world is shifted by `shift` against the scene."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for number, camera in enumerate(cameras(9)):
        seen, pose = render(scene, camera, background=(0.0, 0.0, 0.0)), np.array(to_opengl(camera))
        name = f"images/view{number}.png"
        Image.fromarray(with_alpha(seen) if alpha else as_bytes(seen.rgb)).save(folder / name)
        pose[:3, 3] += shift
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    write_document(folder, intrinsics(W, H, 60.0), W, H, frames)
    return folder


@pytest.fixture(scope="module")
def files(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    write_ply(folder / "a.ply", scene)
    worse = replace(scene, sh0=scene.sh0 + np.float32(0.2))
    (folder / "b.csplat").write_bytes(encode(worse, EncodeOptions(preset="fast")))
    return folder / "a.ply", folder / "b.csplat"


@pytest.fixture(scope="module")
def data(scene, tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("set") / "capture", scene, alpha=False)


def compared(*words):
    return json.loads(call("compare", *words, "--json").stdout)


@pytest.mark.slow
def test_both_scenes_are_scored_on_the_test_images(files, data):
    result = compared(*files, "--data", data)
    assert ["images/view0.png", "images/view8.png"] == [view["image"] for view in result["views"]]
    assert ["capture", [0.0, 0.0, 0.0]] == [result["cameras"], result["background"]]
    scores = result["images"]
    a, b = scores["a"], scores["b"]
    assert ("test", 2, 2, None) == (scores["split"], a["views"], b["views"], a["lpips"])
    assert a["psnr"] > 50.0  # rounding to bytes is the only error
    assert b["psnr"] == pytest.approx(result["psnr"], abs=0.2)
    assert b["ssim"] < a["ssim"]
    table = call("compare", *files, "--data", data).stdout
    assert f"the worst image is {a['worst_image']} in A, {b['worst_image']} in B" in table
    assert min(a["psnr_worst"], b["psnr_worst"]) == b["psnr_worst"]
    again = csplat.compare(*map(str, files), data=data)
    assert (scores, result["psnr"]) == (again.images, again.psnr)
    with pytest.raises(InputError, match="only one of them"):
        csplat.compare(*map(str, files), data=data, views=Mock())
    training = compared(*files, "--data", data, "--split", "train", "--test-every", 3)
    assert [1, 2, 4, 5, 7, 8] == [int(view["image"][-5]) for view in training["views"]]
    assert 6 == training["images"]["a"]["views"]


def test_a_background_is_composited_behind_images_and_scene(scene, files, tmp_path):
    data = write_set(tmp_path / "object", scene, alpha=True)
    for words, background in (((), [0.0, 0.0, 0.0]), (("--background", "white"), [1.0, 1.0, 1.0])):
        result = compared(*files, "--data", data, *words)
        assert background == result["background"]
        assert result["images"]["a"]["psnr"] > 45.0
        assert result["images"]["a"]["psnr_covered"] is not None


def test_cameras_are_moved_to_the_origin_of_the_scene(scene, tmp_path):
    shift = (100.0, -20.0, 7.0)
    data = write_set(tmp_path / "capture", scene, alpha=False, shift=shift)
    write_ply(tmp_path / "moved.ply", replace(scene, origin=shift))
    result = compared(tmp_path / "moved.ply", tmp_path / "moved.ply", "--data", data)
    assert result["images"]["a"]["psnr"] > 50.0
    call("render", tmp_path / "moved.ply", "--data", data, tmp_path / "out")
    assert ["view0.png", "view8.png"] == sorted(path.name for path in (tmp_path / "out").iterdir())
    with Image.open(tmp_path / "out" / "view0.png") as one, Image.open(data / "images" / "view0.png") as two:
        assert (W, H) == one.size
        assert np.abs(np.asarray(one).astype(int) - np.asarray(two)).max() <= 1


def test_lpips_is_computed_with_weights(files, data, data_dir):
    weights = data_dir / "lpips" / "lpips_alex.npz"
    scores = compared(*files, "--data", data, "--lpips", weights)["images"]
    assert 0.0 <= scores["a"]["lpips"] < scores["b"]["lpips"] < 1.0


def test_cameras_and_data_exclude_each_other(scene, files, data, tmp_path):
    for words in (
        ("compare", *files, "--cameras", "x.json", "--data", data),
        ("render", files[0], "--cameras", "x.json", "--data", data, tmp_path / "o"),
        ("compare", *files, "--test-every", "5"),
        ("compare", *files, "--data", data, "--split", "val"),
    ):
        call(*words, status=2)
    with pytest.raises(InputError, match="exclude each other"):
        find_view_set(scene, cameras="x.json", data=DataOptions(str(data)))
    with pytest.raises(InputError, match="has no test views"):
        compare(scene, scene, views=find_view_set(scene, data=DataOptions(str(data), test_every=0)))


def test_an_image_with_alpha_is_composited_over_the_background():
    pixels = np.array([[[0, 0, 0, 0], [255, 0, 0, 51]]], np.uint8)
    picture = PosedImage(replace(cameras(1)[0], W=2, H=1), pixels)
    reference = image_scorer([picture], (0.0, 1.0, 1.0)).reference(0)
    assert [[False, False]] == reference.covered.tolist()
    assert np.float32 == reference.rgb.dtype
    assert np.allclose([[[0, 1, 1], [0.2, 0.8, 0.8]]], reference.rgb)


def test_masked_pixels_are_not_scored(scene):
    taken = cameras(2)
    seen = [np.clip(render(scene, camera).rgb, 0.0, 1.0) for camera in taken]
    images, mask = [as_bytes(one + 0.1) for one in seen], np.zeros((H, W), bool)
    mask[:, : W // 4] = True
    images[0][~mask] = 255
    scorer = image_scorer([PosedImage(taken[0], images[0], mask), PosedImage(taken[1], images[1])], (0.0, 0.0, 0.0))
    squares = [np.square(one - two / 255.0) for one, two in zip(seen, images, strict=True)]
    errors = np.array([squares[0][mask].mean(), squares[1].mean()])
    expected = np.average(errors, weights=[mask.sum(), H * W])
    assert np.allclose(errors, scorer.errors(scene), rtol=1e-4)
    scores = scorer.scores(scene)
    assert scorer.psnr(scene) == pytest.approx(scores.psnr) == pytest.approx(-10.0 * np.log10(expected), abs=1e-3)
    assert [mask.sum(), H * W] == [one.pixels for one in scores.each]


@pytest.mark.slow
def test_an_invalid_input_is_reported_before_rendering(files, tmp_path, monkeypatch):
    fail = Mock(side_effect=AssertionError("rendered before the inputs were checked"))
    monkeypatch.setattr("csplat_render.rasteriser.Rasteriser.forward", fail)
    monkeypatch.chdir(tmp_path)
    for name, path in zip("AB", files, strict=True):
        (tmp_path / name).symlink_to(path)
    (tmp_path / "capture").mkdir()
    save_cameras("cameras.json", cameras(1))
    for words, message in {
        "compare absent.ply B": "absent.ply",
        "compare A absent.csplat": "absent.csplat",
        "compare A B --cameras absent.json": "absent.json",
        "compare A B --data absent": "absent",
        "compare A B --lpips absent.npz": "absent.npz",
        "compare A B --source-index absent.npy": "absent.npy",
        "compare A B --cameras cameras.json --pictures A": "not a folder",
        "render A --cameras absent.json o": "absent.json",
        "render A --orbit 2 A": "not a folder",
        "render A --orbit 2 nowhere/film.gif": "nowhere",
        "train capture o.ply --resume absent.npz": "absent.npz",
    }.items():
        done = invoke(*words.split())
        assert done.exit_code in (1, 2), (words, done.stdout, done.exception)
        assert message in done.stderr, words
