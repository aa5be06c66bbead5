# SPDX-License-Identifier: Apache-2.0
"""Training, validation and test views: none has two roles, and the same test views score the same scene alike."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from captures import H, W, as_colmap, cameras, photograph, photograph_object, shell
from command_line import call, change_options
from models import with_facts
from PIL import Image

from csplat import InputError
from csplat.ply import read_ply
from csplat.scene_metadata import TRAINING, TrainingRecord
from csplat_render.camera import relative_to, resized
from csplat_render.camera_files import save_cameras
from csplat_tools.views import BLACK, WHITE, DataOptions, ViewSet, find_view_set
from csplat_tools.views.view_sets import pose_key
from csplat_trainer.data import load


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """Write the same sixteen images as transforms.json without and with alpha, and as COLMAP."""
    folders = {kind: tmp_path_factory.mktemp(kind) for kind in ("rgb", "rgba", "colmap")}
    photograph(shell(3).select(slice(0, 100)), folders["rgb"])
    for kind in ("rgba", "colmap"):
        shutil.copytree(folders["rgb"], folders[kind], dirs_exist_ok=True)
    for path in (folders["rgba"] / "images").iterdir():
        with Image.open(path) as picture:
            picture.convert("RGBA").save(path)
    as_colmap(folders["colmap"])
    return folders


@pytest.fixture(scope="module")
def scene(sets):
    return read_ply(sets["rgb"] / "scene.ply")


def poses(views):
    return [{pose_key(camera) for camera in role} for role in (views.training, views.validation, views.test)]


def numbers(seen_from):
    return [int(camera.image[-6:-4]) for camera in seen_from]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "every", "size"), [("rgb", 5, None), ("rgba", 10, (24, 20)), ("colmap", 5, (24, 20))])
def test_each_image_has_one_role(sets, scene, kind, every, size):
    views = find_view_set(scene, data=DataOptions(str(sets[kind]), size, test_every=every))
    assert list(range(0, 16, every)) == numbers(views.test) == numbers(views.image_test_scorer().cameras)
    roles = poses(views)
    assert sum(map(len, roles)) == len(set.union(*roles)) == 16
    assert all(roles)
    assert {size or (W, H)} == {(camera.W, camera.H) for camera in views.test}
    assert (BLACK, False) == (views.background, views.virtual)


@pytest.mark.slow
def test_a_camera_file_is_split_if_it_has_enough_views(scene, tmp_path):
    for count, judging, virtual in ((3, 3, True), (39, 39, True), (40, 10, False), (120, 24, False)):
        save_cameras(tmp_path / "cameras.json", cameras(count))
        views = find_view_set(scene, cameras=str(tmp_path / "cameras.json"), count=20)
        assert (judging, virtual) == (len(views.test), views.virtual)
        roles = poses(views)
        assert sum(map(len, roles)) == len(set.union(*roles)) == (36 + 48 + count if virtual else count)
        assert not virtual or (36, 48) == (len(views.training), len(views.validation))


def test_the_number_of_validation_views_may_be_chosen(sets, scene):
    data = DataOptions(str(sets["rgb"]))
    for chosen, sizes in (
        ({"validation_count": 0}, [14, 0, 2]), ({"validation_count": 4}, [10, 4, 2]), ({"split": "train"}, [0, 0, 14]),
    ):  # fmt: skip
        assert sizes == [*map(len, poses(find_view_set(scene, data=data, **chosen)))]
    with pytest.raises(InputError, match=r"none of .* for training"):
        find_view_set(scene, data=data, validation_count=14)
    one, other = cameras(2)
    ViewSet("own", BLACK, [one], [], [other], origin=scene.origin)
    with pytest.raises(InputError, match="own: a view is both a training and a test view"):
        ViewSet("own", BLACK, [one], [], [other, resized(one, 2 * W, 2 * H)])


def test_a_folder_of_images_and_an_opened_set_have_the_same_views(sets, scene):
    opened, folder = load(sets["rgb"]), sets["rgb"]
    given = (DataOptions(str(folder)), DataOptions(str(folder / "images")), opened)
    wanted, named, found = (find_view_set(scene, data=data) for data in given)
    assert (wanted.name, poses(wanted)) == (named.name, poses(named))
    assert (poses(wanted), wanted.background) == (poses(found), found.background)
    assert found.images[0].source is opened.train[0].source  # pixels are read once


def test_validation_images_of_a_set_are_validation_views(sets, scene, tmp_path):
    shutil.copytree(sets["rgb"], tmp_path, dirs_exist_ok=True)
    document = json.loads((tmp_path / "transforms.json").read_text())
    for part, rows in (("train", slice(8)), ("val", slice(8, 12)), ("test", slice(12, 16))):
        frames = document["frames"][rows]
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps({**document, "frames": frames}))
    data = DataOptions(str(tmp_path))
    for validation_count in (None, 0):
        views = find_view_set(scene, data=data, validation_count=validation_count)
        roles = [list(range(8)), [8, 9, 10, 11], [12, 13, 14, 15]]
        assert roles == [numbers(role) for role in (views.training, views.validation, views.test)]
    assert 4 == len(views.image_validation_scorer().references)
    for chosen, sizes in (({"validation_count": 2}, [6, 2, 4]), ({"split": "train"}, [0, 0, 8])):
        assert sizes == [*map(len, poses(find_view_set(scene, data=data, **chosen)))]


def test_recorded_training_options_are_the_defaults(sets, scene):
    record = TrainingRecord((0.0, 1.0, 0.0), 5, (24, 20), 0.05)
    trained = with_facts(scene, entries={**scene.metadata.entries, TRAINING: record.as_json()})
    views = find_view_set(trained, data=DataOptions(str(sets["rgba"])))
    assert [0, 5, 10, 15] == numbers(views.test)
    assert ((0.0, 1.0, 0.0), 24, 0.05) == (views.background, views.test[0].W, views.test[0].near)
    assert not any("trained" in line for line in views.notes)
    views = find_view_set(trained, data=DataOptions(str(sets["rgba"]), test_every=10), background=WHITE)
    assert [0, 10] == numbers(views.test)
    notes = [line for line in views.notes if "trained" in line]
    assert "test_every is 10, but the scene was trained with 5" == notes[0]
    assert ["background is white, but the scene was trained on 0,1,0"] == notes[1:]


@pytest.mark.slow
def test_virtual_test_views_are_on_black_and_a_missing_training_record_is_noted_once(sets, scene):
    views = find_view_set(scene, count=5, validation_count=2, background=WHITE)
    assert (21, 2, 8) == tuple(map(len, poses(views)))
    assert (BLACK, WHITE) == (views.test_scorer(scene).background, views.validation_scorer(scene).background)
    assert () == find_view_set(scene, count=2).notes
    for kind in ("rgb", "rgba"):
        views = find_view_set(scene, data=DataOptions(str(sets[kind])))
        assert BLACK == views.background
        assert 1 == sum("the training background" in line for line in views.notes)


@pytest.mark.slow
def test_map_coordinates_of_a_set_do_not_change_scores(sets, scene, tmp_path):
    # The scene has another origin than the set, and the camera file has none.
    def psnr_by(data, model, other=None):
        return find_view_set(model, data=DataOptions(str(data))).image_test_scorer().psnr(other or model)

    place, near = np.array((500123.25, 4649876.5, 214.75)), sets["rgb"]
    shutil.copytree(near, tmp_path / "set")
    document = json.loads((near / "transforms.json").read_text())
    for frame in document["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] += place
        frame["transform_matrix"] = pose.tolist()
    (tmp_path / "set" / "transforms.json").write_text(json.dumps(document))
    far = replace(scene, origin=tuple(place))
    moved = replace(scene, means=scene.means - np.float32((10.0, -20.0, 5.0)), origin=(10.0, -20.0, 5.0))
    others = [psnr_by(tmp_path / "set", far), psnr_by(near, scene, moved), psnr_by(near, moved)]
    assert others == pytest.approx([psnr_by(near, scene)] * 3, abs=0.01)
    own = cameras(3)
    save_cameras(tmp_path / "own.json", own)
    save_cameras(tmp_path / "far.json", [relative_to(-place, camera) for camera in own])
    one, other = (find_view_set(far, cameras=str(tmp_path / f"{name}.json")) for name in ("own", "far"))
    assert all(np.allclose(a.viewmat, b.viewmat) for a, b in zip(one.test, other.test, strict=True))
    assert [False, True] == [any("around the scene's origin" in line for line in v.notes) for v in (one, other)]


#: A command, and where its JSON has the scores of the source on the test images.
SCORES = {
    "compare PLY PLY": ("images", "a"),
    "finetune PLY OUT/t.csplat --iterations 1 --keep 0.7": ("scores", "source"),
    "simplify PLY OUT/less.ply --keep 0.9": ("images", "source"),
    "simplify PLY OUT/few.ply --max-psnr-drop 1 --effort 1": ("images", "source"),
    "tradeoff PLY --what presets": ("points", 0, "images", "a"),
    "encode PLY OUT/e.csplat --max-psnr-drop 3 --no-prune --preset fast": ("target", "images", "source"),
    "sensitivity PLY OUT/s.npz": (),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "every", "held_out", "commands"), [("blender", 5, 4, list(SCORES)), ("colmap", 10, 2, ["compare PLY PLY"])]
)
def test_every_command_reports_the_score_of_the_training(tmp_path, kind, every, held_out, commands, monkeypatch):
    # No command gets a background, split or size: the PLY records them. None decides by test views.
    data, ply, log, made, check = (
        tmp_path / "data",
        tmp_path / "s.ply",
        tmp_path / "log.json",
        [],
        ViewSet.__post_init__,
    )
    data.mkdir()
    data = photograph_object(shell(3), data) if kind == "blender" else as_colmap(photograph(shell(3), data))
    quick = ("--max-splats", 60, "--sh-degree", 0, "--iterations", 150, "--size", "24x20", "--test-every", every)
    change_options(monkeypatch, "csplat_tools.cli.train.TrainOptions", init="box")
    change_options(monkeypatch, "csplat_tools.optimise.simplify.SimplifyOptions", refit=False)
    change_options(monkeypatch, "csplat_tools.cli.finetune.EncodeOptions", sh_coding="none")
    monkeypatch.setattr(ViewSet, "__post_init__", lambda views: check(views) or made.append(views))

    def run(words):
        made.clear()
        given = [word.replace("PLY", str(ply)).replace("OUT", str(tmp_path)) for word in words.split()]
        result = json.loads(call(*given, "--data", data, "--json").stdout)
        assert any(views.images for views in made), words
        for views in made:
            roles = poses(views)
            assert sum(map(len, roles)) == len(set.union(*roles)), words
            assert not views.images or len(views.test) in (0, held_out), words
            if kind == "blender":
                assert all("test" not in (one.image or "") for one in (*views.training, *views.validation)), words
        return result

    call("train", data, ply, *quick, "--report", log, "-q")
    record = read_ply(ply).metadata.training
    assert ((1.0, 1.0, 1.0) if kind == "blender" else BLACK, (24, 20)) == (record.background, record.size)
    trained = json.loads(log.read_text())["metrics"]
    scores, counts, reports = {"train": trained["psnr"]}, {trained["views"]}, {words: run(words) for words in commands}
    for words in commands[: len(SCORES) - 1]:
        found = reports[words]
        for key in SCORES[words]:
            found = found[key]
        scores[words] = found["psnr"] if isinstance(found, dict) else found
        counts |= {found["views"]} if isinstance(found, dict) and "views" in found else set()
    assert {held_out} == counts
    assert max(scores.values()) - min(scores.values()) < 0.01, scores
    if kind == "blender":
        simplified = reports["simplify PLY OUT/less.ply --keep 0.9"]["images"]["psnr"]
        assert simplified == pytest.approx(run("compare PLY OUT/less.ply")["images"]["b"]["psnr"], abs=0.01)
