"""`csplat_bench.datasets`: which scenes it finds, which pictures it uses, and what its tables say."""

import json

import numpy as np
import pytest

from csplat import read_ply, write_ply
from csplat.errors import InputError

pytest.importorskip("numba", reason="the trainer needs numba: pip install 'csplat[render]'")
pytest.importorskip("scipy", reason="data sets need scipy: pip install 'csplat[render]'")
pytest.importorskip("PIL.Image", reason="pictures need pillow: pip install 'csplat[render]'")

from PIL import Image

from csplat_bench.common.command import run as command
from csplat_bench.datasets import __main__ as datasets
from csplat_bench.datasets import folders as dataset_folders
from csplat_bench.datasets import protocols as dataset_protocols
from csplat_bench.datasets import tables as dataset_tables
from csplat_render.camera import intrinsics, look_at

pytestmark = pytest.mark.area(name="benchmarks")

W, H = 48, 32
QUICK = ("--iterations", "20", "--max-splats", "60", "--sh-degree", "1")


def cameras(count):
    K, angles = intrinsics(W, H, 50.0), np.linspace(0.3, 5.0, count)
    return [look_at((3 * np.cos(a), 3 * np.sin(a), 1), (0, 0, 0), (0, 0, 1), K, W, H) for a in angles]


def write_picture(path, number, size, mode="RGB"):
    """A bright square that stands somewhere else in each picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.full((size[1], size[0], len(mode)), 40, np.uint8)
    pixels[size[1] // 4 : -size[1] // 4, number : number + size[0] // 3] = 220
    Image.fromarray(pixels).save(path)


def quaternion(rotation):
    """w x y z of a rotation by less than half a turn, up to its sign."""
    w = 0.5 * np.sqrt(max(1e-12, 1.0 + np.trace(rotation)))
    x, y, z = rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    return w, x / (4 * w), y / (4 * w), z / (4 * w)


def write_colmap(folder, count=9, folders=(("images", 1),)):
    """A COLMAP set of `count` pictures, in folders of smaller and smaller ones."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    K = cameras(1)[0].K
    (model / "cameras.txt").write_text(f"1 PINHOLE {W} {H} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")
    lines = []
    for number, camera in enumerate(cameras(count)):
        pose = (*quaternion(camera.viewmat[:3, :3]), *camera.viewmat[:3, 3])
        lines.append(f"{number + 1} {' '.join(f'{value:.17g}' for value in pose)} 1 im{number:02}.png\n\n")
        for name, factor in folders:
            write_picture(folder / name / f"im{number:02}.png", number, (W // factor, H // factor))
    (model / "images.txt").write_text("".join(lines))
    points = "".join(f"{i} {x} 0 0 200 100 50 0.5\n" for i, x in enumerate(np.linspace(-0.5, 0.5, 20)))
    (model / "points3D.txt").write_text(points)
    return folder


def write_blender(folder, train=4, test=2):
    for part, count in (("train", train), ("test", test)):
        frames = []
        for number, camera in enumerate(cameras(count)):
            write_picture(folder / part / f"r_{number}.png", number, (W, W), "RGBA")
            pose = np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
            frames.append({"file_path": f"./{part}/r_{number}", "transform_matrix": pose.tolist()})
        document = {"camera_angle_x": 0.9, "frames": frames}
        (folder / f"transforms_{part}.json").write_text(json.dumps(document))
    return folder


def touch_colmap(folder, *pictures):
    """Create only the files and folders that discovery looks at."""
    for name in ("cameras.bin", "images.bin"):
        (folder / "sparse" / "0").mkdir(parents=True, exist_ok=True)
        (folder / "sparse" / "0" / name).touch()
    for name in pictures:
        (folder / name).mkdir()


def find(root):
    return dataset_folders.find_scene_folders(root)


# discovery


@pytest.fixture
def disk(tmp_path):
    """Sets as people unpack them."""
    for name in ("garden", "bicycle", "kitchen"):
        touch_colmap(tmp_path / "360_v2" / name, "images", "images_2", "images_4")
    touch_colmap(tmp_path / "tandt_db" / "tandt" / "truck", "images")
    touch_colmap(tmp_path / "tandt_db" / "tandt" / "train", "images")
    touch_colmap(tmp_path / "tandt_db" / "db" / "playroom", "images")
    touch_colmap(tmp_path / "nerf_llff_data" / "room", "images")
    touch_colmap(tmp_path / "mine" / "room2", "images")
    touch_colmap(tmp_path / "mine" / "models_alone")
    (tmp_path / "mine" / "phone").mkdir()
    (tmp_path / "mine" / "phone" / "transforms.json").touch()
    for name in ("lego", "ship_400x400"):
        (tmp_path / "nerf_synthetic" / name / "train").mkdir(parents=True)
        (tmp_path / "nerf_synthetic" / name / "transforms_train.json").touch()
    return tmp_path


def test_finds_the_sets_of_the_tables_first_and_in_their_order(disk):
    found = find(disk)
    assert [
        ("mipnerf360", "bicycle"), ("mipnerf360", "garden"), ("mipnerf360", "kitchen"),
        ("tandt", "train"), ("tandt", "truck"), ("db", "playroom"),
        ("synthetic", "lego"), ("synthetic", "ship"),
        ("other", "phone"), ("other", "room2"), ("other", "room"),
    ] == [(one.protocol.slug, one.scene) for one in found]  # fmt: skip


def test_a_model_without_pictures_is_left_out_and_said(disk, capsys):
    find(disk)
    (warned,) = capsys.readouterr().err.splitlines()
    assert "models_alone is left out" in warned


def test_a_scene_itself_may_be_named(disk):
    (one,) = find(disk / "360_v2" / "garden")
    assert ("garden", "mipnerf360-garden") == (one.title, one.key)


def test_two_scenes_of_one_name_have_two_keys(tmp_path):
    for parent in ("a", "b"):
        touch_colmap(tmp_path / parent / "garden", "images")
    assert ["mipnerf360-garden", "mipnerf360-garden-2"] == [one.key for one in find(tmp_path)]


@pytest.mark.parametrize(
    ("names", "expected"),
    [("garden", ["garden"]), ("SHIP, train", ["train", "ship_400x400"]), ("other-room", ["room"])],
)
def test_scenes_are_chosen_by_name(disk, names, expected):
    assert expected == [one.title for one in dataset_folders.choose_scenes(find(disk), names)]


def test_a_scene_that_is_not_there_is_refused_with_those_that_are(disk):
    with pytest.raises(InputError, match="no scene bonsai; found bicycle, garden"):
        dataset_folders.choose_scenes(find(disk), "garden,bonsai")


@pytest.mark.parametrize("root", ["empty", "absent"])
def test_nothing_found_is_one_line_and_status_1(tmp_path, capsys, root):
    (tmp_path / "empty" / "inside").mkdir(parents=True)
    assert 1 == command(datasets.main, [str(tmp_path / root), "--out", str(tmp_path / "out")])
    told = capsys.readouterr()
    assert "" == told.out
    assert told.err.startswith("error: ")
    assert 1 == told.err.count("\n")
    assert not (tmp_path / "out").exists()


# pictures


def chosen(folder, size=None, downscale=1.0):
    (one,) = find(folder)
    return dataset_folders.choose_pictures(one, size, downscale)


def test_outdoors_uses_images_4_and_indoors_images_2(tmp_path):
    folders = (("images", 1), ("images_2", 2), ("images_4", 4))
    for name, images, size in (
        ("garden", "images_4", (12, 8)),
        ("room", "images_2", (24, 16)),
        ("mine", "images", (W, H)),
    ):
        choice = chosen(write_colmap(tmp_path / name, folders=folders))
        assert (images, None, size) == (choice.images, choice.size, choice.protocol_size)


def test_missing_small_pictures_are_made_of_the_large_ones(tmp_path):
    choice = chosen(write_colmap(tmp_path / "garden"))
    assert ("images", (12, 8), (12, 8)) == (choice.images, choice.size, choice.protocol_size)
    assert ("there is no images_4: the pictures are scaled down here",) == choice.remarks


def test_size_and_downscale_change_what_the_papers_use(tmp_path):
    folder = write_colmap(tmp_path / "truck")
    assert ((24, 16), (W, H)) == (chosen(folder, None, 2.0).size, chosen(folder, None, 2.0).protocol_size)
    assert (30, 20) == chosen(folder, (30, 20)).size


def test_pictures_wider_than_1600_pixels_are_scaled_down(tmp_path):
    folder = write_colmap(tmp_path / "playroom", count=2)
    for number in range(2):
        write_picture(folder / "images" / f"im{number:02}.png", number, (2000, 10))
    assert (1600, 8) == chosen(folder).size


def test_pictures_of_several_sizes_are_said(tmp_path):
    folder = write_colmap(tmp_path / "mine")
    write_picture(folder / "images" / "im03.png", 3, (W, H + 2))
    assert (None, ("pictures of 2 sizes, used as they are",)) == (chosen(folder).size, chosen(folder).remarks)
    assert ("pictures of 2 sizes are all brought to 24×16",) == chosen(folder, None, 2.0).remarks


# runs


def run(root, out, *words):
    return command(datasets.main, [str(root), "--out", str(out), *QUICK, *words])


def test_trains_scores_and_encodes_whatever_is_there(tmp_path, capsys):
    write_colmap(tmp_path / "data" / "room", folders=(("images_2", 1),))
    write_blender(tmp_path / "data" / "nerf_synthetic" / "lego")
    assert 0 == run(tmp_path / "data", tmp_path / "out", "--json", str(tmp_path / "log.json"))
    told = capsys.readouterr()
    for word in (
        "room",
        "lego",
        "fast",
        "balanced",
        "small",
        "3DGS, published",
        "c3dgs, published, 9",
        "30.63",
        "NOT THE",
    ):
        assert word in told.out
    room, lego = json.loads((tmp_path / "log.json").read_text())["scenes"]
    for scene, train_views, pixels, background in ((room, 7, [W, H], [0.0] * 3), (lego, 4, [W, W], [1.0] * 3)):
        assert (2, train_views) == (scene["test_views"], scene["train_views"])
        assert (pixels, background) == (scene["pixels"], scene["background"])
    assert ["PLY", "fast", "balanced", "small"] == [one["file"] for one in room["files"]]
    ply, *packed = room["files"]
    assert ply["size_bytes"] == (tmp_path / "out" / "mipnerf360-room.ply").stat().st_size
    assert all(one["size_bytes"] < ply["size_bytes"] for one in packed)
    assert all(abs(one["psnr_mean"] - ply["psnr_mean"]) < 3.0 for one in packed)


def test_a_trained_scene_is_kept_until_force(tmp_path, capsys):
    write_colmap(tmp_path / "data" / "desk")
    ply = tmp_path / "out" / "other-desk.ply"
    assert 0 == run(tmp_path / "data", tmp_path / "out")
    first, table = ply.read_bytes(), capsys.readouterr().out
    assert 0 == run(tmp_path / "data", tmp_path / "out")
    again = capsys.readouterr()
    assert "desk: trained before\ndesk: scored before" in again.err
    assert (first, table) == (ply.read_bytes(), again.out)
    assert 0 == run(tmp_path / "data", tmp_path / "out", "--iterations", "25", "--rescore")
    other = capsys.readouterr()
    assert "other settings (20 steps, at most 60 splats)" in other.err
    assert "desk: small " in other.err
    assert first == ply.read_bytes()
    assert 0 == run(tmp_path / "data", tmp_path / "out", "--iterations", "25", "--force", "--presets", "fast")
    assert first != ply.read_bytes()
    record = json.loads(ply.with_suffix(".json").read_text())
    assert (25, ["PLY", "fast"]) == (record["settings"]["iterations"], [one["file"] for one in record["files"]])


def test_a_ply_of_another_trainer_is_scored(tmp_path, capsys, make_model):
    write_colmap(tmp_path / "data" / "desk")
    (tmp_path / "out").mkdir()
    write_ply(tmp_path / "out" / "other-desk.ply", make_model(40, 2))
    assert 0 == run(tmp_path / "data", tmp_path / "out", "--presets", "fast")
    told = capsys.readouterr()
    assert "trained elsewhere" in told.err
    assert 2 == read_ply(tmp_path / "out" / "other-desk.ply").sh_degree
    assert "?" in told.out
    assert 0 == run(tmp_path / "data", tmp_path / "out", "--presets", "fast")
    assert "desk: trained elsewhere\ndesk: scored before" in capsys.readouterr().err


def test_a_scene_that_fails_does_not_stop_the_others(tmp_path, capsys):
    write_colmap(tmp_path / "data" / "good")
    bad = write_colmap(tmp_path / "data" / "bad")
    (bad / "images" / "im04.png").write_bytes(b"no picture")
    assert 1 == run(tmp_path / "data", tmp_path / "out", "--presets", "fast")
    told = capsys.readouterr()
    assert "error: bad: " in told.err
    assert "good" in told.out
    assert "bad" not in told.out


@pytest.mark.parametrize(
    "words",
    [
        ("--size", "12"),
        ("--size", "24x16", "--downscale", "2"),
        ("--downscale", "0.5"),
        ("--presets", "tiny"),
        ("--iterations", "0"),
        ("--device", "mps"),
    ],
)
def test_a_wrong_command_line_has_status_2(tmp_path, words):
    assert 2 == run(tmp_path, tmp_path / "out", *words)


# tables


def row(scene="garden", slug="mipnerf360", iterations=30_000, max_splats=5_000_000, pixels=(1297, 840), **changes):
    scores = {"psnr_mean": 27.0, "ssim": 0.86, "lpips": 0.11, "size_bytes": 248_000_000}
    small = {"psnr_mean": 26.5, "ssim": 0.85, "lpips": 0.12, "size_bytes": 9_000_000}
    return {
        "title": scene, "scene": scene, "set": slug, "pixels": list(pixels), "protocol_size": [1297, 840],
        "settings": {"iterations": iterations, "max_splats": max_splats}, "train_seconds": 60.0, "splats": 1_000_000,
        "sh_degree": 3, "test_views": 24, "files": [{"file": "PLY", **scores}, {"file": "small", **small}], **changes,
    }  # fmt: skip


def test_each_scene_stands_beside_what_was_published():
    text = dataset_tables.scenes_table([row()], markdown=True)
    head, _, ply, small, paper = (line.strip("| ").split(" | ") for line in text.splitlines())
    assert list(dataset_tables.HEADER) == head
    assert ["garden", "PLY", "27.00", "0.860", "0.110", "-", "248.00", "1000000", "3", "1297×840", "24"] == ply[:11]
    assert ["garden", "small", "26.50", "0.850", "0.120", "-", "9.00"] == small[:7]
    assert ["garden", "3DGS, published", "27.41", "0.868", "-", "0.103", "-"] == paper[:7]
    assert {len(head)} == {len(line) for line in (ply, small, paper)}


def test_means_are_over_scenes_and_so_are_the_papers():
    rows = [row("train", "tandt"), row("truck", "tandt")]
    rows[1]["files"][0]["psnr_mean"] = 25.0
    text = dataset_tables.means_table(rows, markdown=True)
    assert "| Tanks and Temples, 2 of 2 | PLY | 26.00 |" in text
    assert "| 3DGS, published, 2 | 23.14 | 0.841 | - | 0.183 | 411.0 |" in text
    assert "| c3dgs, published, 2 | 23.32 | 0.832 | - | 0.194 | 17.3 |" in text
    part = dataset_tables.means_table(rows[:1], markdown=True)
    assert "| 3DGS, published, 1 | 21.10 | 0.802 | - | 0.218 | - |" in part


def test_sets_of_no_table_have_neither_means_nor_notes():
    rows = [row("desk", "other")]
    assert "" == dataset_tables.means_table(rows, markdown=False)
    assert [] == dataset_tables.notes(rows)
    assert "published" not in dataset_tables.scenes_table(rows, markdown=False)


def test_a_mean_of_what_is_not_known_is_not_made_up():
    rows = [row("train", "tandt"), row("truck", "tandt")]
    rows[1]["files"][0]["lpips"] = None
    assert "| PLY | 27.00 | 0.860 | - |" in dataset_tables.means_table(rows, markdown=True)


def test_lesser_settings_are_said_loudly_and_the_papers_own_are_not():
    assert "NOT THE PAPERS' SETTINGS" not in "\n".join(dataset_tables.notes([row()]))
    for changes, says in (
        ({"iterations": 7000}, "- steps, the papers' 30000: garden 7000"),
        ({"max_splats": 200_000}, "garden 200000 (3DGS, mean of its set: 3.0 million)"),
        ({"pixels": (640, 420)}, "garden 640×420 for 1297×840"),
    ):
        text = "\n".join(dataset_tables.notes([row(**changes)]))
        assert text.startswith("NOT THE PAPERS' SETTINGS")
        assert says in text


def test_small_copies_of_synthetic_scenes_are_smaller_than_the_papers():
    lego = row("lego", "synthetic", pixels=(200, 200), protocol_size=[200, 200])
    assert any("lego 200×200 for 800×800" in line for line in dataset_tables.notes([lego]))


def test_published_figures_of_scenes_give_the_published_means():
    """Table 1 of 3DGS prints the means that its appendix prints by scene: a slip of a digit shows."""
    printed = {"mipnerf360": (27.21, 0.815, 0.214), "tandt": (23.14, 0.841, 0.183), "db": (29.41, 0.903, 0.243)}
    for protocol in dataset_protocols.PROTOCOLS:
        means = dataset_protocols.published_means(protocol, list(protocol.factors))
        if protocol.slug == "synthetic":
            assert (33.32, None) == (pytest.approx(means.psnr, abs=0.01), means.ssim)
            continue
        values = (means.psnr, means.ssim, means.lpips_vgg)
        for expected, value, tolerance in zip(printed[protocol.slug], values, (0.006, 0.0006, 0.0006), strict=True):
            assert value == pytest.approx(expected, abs=tolerance)
