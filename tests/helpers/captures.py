"""A small scene and images of it, for training, tuning and searches; a trained and a tuned scene.

`make_trained` and `FileRuns` train on images drawn by NumPy, independent of csplat, by the command line alone.
Requires the extra [render].
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from checked import cloud
from command_line import call, change_options
from PIL import Image
from posed_sets import to_opengl
from scipy.spatial.transform import Rotation

from csplat import EncodeOptions, Target, write_ply
from csplat.model import SplatModel, normalise_quats
from csplat_render import render
from csplat_render.camera import intrinsics, look_at, orbit, resized
from csplat_render.rasteriser import Rasteriser
from csplat_render.scorer import renderer
from csplat_tools.optimise.simplify import SimplifyOptions
from csplat_tools.optimise.target_encoding import meet_target
from csplat_tools.training import training_run
from csplat_tools.training.training_run import tuning_after
from csplat_tools.views import BLACK, ViewSet, camera_sequence, find_view_set, with_validation_views
from csplat_trainer.data import DataSet
from csplat_trainer.posed_images import PosedImage

W, H = 48, 40


def cameras(count):
    K, angles = intrinsics(W, H, 60.0), np.linspace(0.2, 5.9, count)
    return [look_at((4 * np.cos(a), 4 * np.sin(a), 1.0), (0, 0, 0), (0, 0, 1), K, W, H) for a in angles]


def views_of(seen_from, photographs=()):
    """Return training views and every eighth as a validation view, without test views."""
    return with_validation_views(ViewSet("cameras", BLACK, seen_from, (), (), photographs))


def training_images(make_model, *, alpha: bool = True) -> DataSet:
    """Return twelve images of thirty splats, nine of them for training."""
    scene = make_model(30, 1, seed=3, scales=np.full((30, 3), -1.2, np.float32))
    rasteriser = Rasteriser(gradients=False)
    shots = []
    for elevation in (10.0, 45.0):
        seen_from = orbit((0, 0, 0), 6.0, (0, 0, 1), 6, intrinsics(32, 32, 50.0), 32, 32, elevation=elevation)
        for camera in seen_from:
            seen = rasteriser.forward(scene, camera)
            cover = np.maximum(seen.alpha, 1e-6)[..., None]
            colour = np.clip(seen.rgb / cover, 0, 1)
            pixels = np.concatenate([colour, seen.alpha[..., None]], axis=2) if alpha else np.clip(seen.rgb, 0, 1)
            shots.append(PosedImage(camera, np.rint(pixels * 255).astype(np.uint8)))
    return DataSet("made", shots[:9], shots[9:])


def shell(coefficients):
    """Return 300 overlapping splats on a sphere with smoothly varying colours; `coefficients` of SH beyond degree 0."""
    rng = np.random.default_rng(0)
    means = rng.standard_normal((300, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    return SplatModel(
        means=means.astype(np.float32),
        quats=normalise_quats(rng.standard_normal((300, 4))),
        scales=rng.uniform(-2.5, -1.3, (300, 3)).astype(np.float32),
        opacities=rng.uniform(0.1, 0.95, 300).astype(np.float32),
        sh0=(np.sin(3.0 * means) + 0.5).astype(np.float32),
        shN=(0.1 * rng.standard_normal((300, coefficients, 3))).astype(np.float32),
    )


def photograph(scene, folder):
    """Write sixteen images on black, and a PLY with an additional splat far behind all cameras."""
    (folder / "images").mkdir()
    frames = []
    for number, camera in enumerate(cameras(16)):
        pixels = np.clip(render(scene, camera).rgb, 0.0, 1.0)
        Image.fromarray(np.rint(pixels * 255).astype(np.uint8)).save(folder / "images" / f"view{number:02}.png")
        frames.append({"file_path": f"images/view{number:02}.png", "transform_matrix": to_opengl(camera)})
    K = intrinsics(W, H, 60.0)
    document = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": W / 2, "cy": H / 2, "w": W, "h": H, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    hidden = scene.select(np.concatenate([[0], np.arange(len(scene))]))
    hidden = replace(hidden, means=np.concatenate([np.full((1, 3), 400.0, np.float32), scene.means]))
    write_ply(folder / "scene.ply", hidden)
    return folder


def as_colmap(folder):
    """Replace the poses of such a folder by COLMAP's files."""
    (folder / "transforms.json").unlink()
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    K, lines = cameras(1)[0].K, []
    for number, camera in enumerate(cameras(16)):
        x, y, z, w = Rotation.from_matrix(camera.viewmat[:3, :3]).as_quat()
        values = " ".join(str(value) for value in (w, x, y, z, *camera.viewmat[:3, 3]))
        lines.append(f"{number + 1} {values} 1 view{number:02}.png\n\n")
    (model / "images.txt").write_text("".join(lines))
    (model / "cameras.txt").write_text(f"1 PINHOLE {W} {H} {K[0, 0]} {K[1, 1]} {W / 2} {H / 2}\n")
    return folder


def photograph_object(scene, folder):
    """Write a Blender set of sixteen transparent images, twelve of them for training."""
    for part, seen_from in (("train", cameras(16)[1:13]), ("test", [*cameras(16)[:1], *cameras(16)[13:]])):
        (folder / part).mkdir()
        frames = []
        for number, camera in enumerate(seen_from):
            seen = render(scene, camera)
            straight = np.clip(seen.rgb / np.maximum(seen.alpha, 1e-6)[..., None], 0.0, 1.0)
            pixels = np.concatenate([straight, seen.alpha[..., None]], axis=2)
            Image.fromarray(np.rint(pixels * 255).astype(np.uint8)).save(folder / part / f"r_{number}.png")
            frames.append({"file_path": f"./{part}/r_{number}", "transform_matrix": to_opengl(camera)})
        angle = 2.0 * math.atan(W / 2 / cameras(1)[0].K[0, 0])
        (folder / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return folder


SMALL = (32, 24)  # pixels of a view; a search then takes a second


def crowded():
    """Return a shell and 600 nearly invisible splats."""
    rng, scene = np.random.default_rng(1), shell(3)
    faint = cloud(
        0.5 * rng.standard_normal((600, 3)), scales=np.full((600, 3), -4.0, np.float32),
        opacities=np.full(600, 0.02, np.float32), shN=np.zeros((600, 3, 3), np.float32),
    )  # fmt: skip
    arrays = ("means", "quats", "scales", "opacities", "sh0", "shN")
    return SplatModel(**{name: np.concatenate([getattr(scene, name), getattr(faint, name)]) for name in arrays})


def around(source, count=24):
    """Return small virtual views of a scene."""
    views = find_view_set(source, count=count, size=SMALL)
    test, validation = ([resized(camera, 48, 36) for camera in part] for part in (views.test, views.validation))
    return replace(views, test=test, validation=validation)


def judged_by(seen_from):
    """Return training views, and every fourth as a test view."""
    training = [camera for number, camera in enumerate(seen_from) if number % 4]
    return ViewSet("cameras", BLACK, training, (), seen_from[::4])


def photographed(scene):
    """Return views with images that differ from the scene by 25 dB; every eighth is a test view."""
    seen_from = camera_sequence(scene, 48, SMALL, seed=3)
    rng, draw = np.random.default_rng(1), renderer(scene, BLACK)
    noisy = [np.clip(draw(c).rgb + 0.06 * rng.standard_normal((c.H, c.W, 3)), 0, 1) for c in seen_from]
    pictures = [PosedImage(c, np.rint(255.0 * p).astype(np.uint8)) for c, p in zip(seen_from, noisy, strict=True)]
    training = [camera for number, camera in enumerate(seen_from) if number % 8]
    return ViewSet("made", BLACK, training, (), seen_from[::8], pictures)


def found_within(source, views=None, encoding=None, *, no_prune=False, importance=None, refit=True, **goal):
    """Return the file at a target by a brief search in small views, by default of forty cameras."""
    views = views or judged_by(cameras(40))
    # Larger views take fewer steps of a fit. The size only matters if virtual views are added.
    size = SMALL if views.virtual else (960, 720)
    simplifying = SimplifyOptions(effort=1, view_size=size, refit=refit)
    target = Target(prune=not no_prune, **goal)
    chosen = {"importance": importance, "simplifying": simplifying}
    return meet_target(source, encoding or EncodeOptions(), target=target, views=views, **chosen)


FOCAL = 42.0  # pixels
VIEWS = 16  # every eighth is a test view
DISTANCE = 3.2  # distance of the cameras from the centre of a ball of radius 1
_SAMPLES = 3  # rays per pixel and axis
TRAIN = ("--max-splats", 300, "--sh-degree", 1, "--iterations", 300, "--seed", 1)


@dataclass(frozen=True)
class TrainedScene:
    """A trained scene and its sources."""

    data: Path
    ply: Path
    report: Path
    checkpoint: Path
    messages: str


@dataclass(frozen=True)
class TunedFile:
    """A tuned file and its sources."""

    source: TrainedScene
    path: Path
    report: Path
    messages: str


def write_photographs(folder: Path) -> None:
    """Write a transforms.json set of a ball with coloured stripes on a transparent background."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for number in range(VIEWS):
        turn, height = 2.4 * number, 0.5 * np.sin(1.7 * number)
        eye = np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)]) * DISTANCE
        back = eye / DISTANCE
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)  # OpenGL: looks along -z
        Image.fromarray(_photograph(pose)).save(folder / f"{number:02}.png")
        frames.append({"file_path": f"{number:02}.png", "transform_matrix": pose.tolist()})
    document = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": W / 2, "cy": H / 2, "w": W, "h": H, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))


def _photograph(pose: np.ndarray) -> np.ndarray:
    """Return an image of the ball, [H, W, 4] uint8, straight RGBA."""
    ticks = [(np.arange(_SAMPLES * size) + 0.5) / _SAMPLES for size in (W, H)]
    x, y = np.meshgrid((ticks[0] - W / 2) / FOCAL, (H / 2 - ticks[1]) / FOCAL)
    rays = np.stack([x, y, -np.ones_like(x)], axis=2) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    along, eye = rays @ pose[:3, 3], pose[:3, 3]
    root = along**2 - (eye @ eye - 1.0)
    points = eye + (-along - np.sqrt(np.maximum(root, 0.0)))[..., None] * rays
    colours = 0.5 + 0.4 * np.sin(3.0 * points + np.array([0.0, 1.0, 2.0]))
    shown = np.where(root[..., None] > 0.0, np.concatenate([colours, np.ones_like(x)[..., None]], axis=2), 0.0)
    means = shown.reshape(H, _SAMPLES, W, _SAMPLES, 4).mean(axis=(1, 3))
    means[..., :3] /= np.maximum(means[..., 3:], 1e-9)
    return np.rint(255.0 * means).astype(np.uint8)


def make_trained(folder: Path) -> TrainedScene:
    """Write the images and train the scene."""
    data, ply, report, checkpoint = (folder / name for name in ("photographs", "a.ply", "train.json", "train.npz"))
    write_photographs(data)
    with pytest.MonkeyPatch.context() as patch:
        change_options(patch, "csplat_tools.cli.train.TrainOptions", refine_start=50, refine_every=25, lr_means=1e-3)
        words = ("train", data, ply, *TRAIN, "--report", report, "--checkpoint", checkpoint)
        messages = call(*words).stderr
    return TrainedScene(data, ply, report, checkpoint, messages)


def make_tuned(folder: Path, source: TrainedScene) -> TunedFile:
    """Tune a file of the trained scene."""
    path, report = folder / "a.csplat", folder / "finetune.json"
    with pytest.MonkeyPatch.context() as patch:
        change_options(patch, "csplat_tools.cli.finetune.EncodeOptions", attribute_psnr=28.0, seed=1, threads=1)
        change_options(patch, "csplat_trainer.tuning.tuning_options.FinetuneOptions", seed=1)
        words = ("finetune", source.ply, path, "--data", source.data, "--iterations", 100, "--report", report)
        messages = call(*words).stderr
    return TunedFile(source, path, report, messages)


class FileRuns:
    """Runs of `csplat train` to files, with little training and tuning.

    The first keeps all splats and writes checkpoints of training and tuning, a report and a page.
    """

    WORDS = ("--max-splats", 40, "--sh-degree", 0, "--iterations", 30)
    TUNED = 30  # steps; the default is 1,000

    def __init__(self, folder: Path) -> None:
        self.folder, self.data = folder, folder / "photographs"
        self.checkpoint, self.page = folder / "run.npz", folder / "page.html"
        write_photographs(self.data)
        outputs = ("--checkpoint", self.checkpoint, "--page", self.page)
        self.report, self.messages = self.made("a.csplat", "--keep", 1, *outputs)

    def made(self, name: str, *more: object, **options: object) -> tuple[dict, str]:
        """Make a file or a PLY, with options of the training; return the report and the messages."""
        report = self.folder / f"{name}.json"
        with pytest.MonkeyPatch.context() as patch:
            change_options(patch, "csplat_tools.cli.train.TrainOptions", log_every=10, **options)
            patch.setattr("csplat_trainer.data.loader.load", None)  # a training opens its data set by another name
            brief = lambda **given: replace(tuning_after(**given), iterations=self.TUNED)  # noqa: E731
            patch.setattr(training_run, "tuning_after", brief)
            words = ("train", self.data, self.folder / name, *self.WORDS, "--report", report, *more)
            messages = call(*words).stderr
        return json.loads(report.read_text()), messages


def shell_with_hidden_splats():
    """Return a shell of opaque splats with hidden ones inside, and ten that are too transparent to be drawn."""
    rng = np.random.default_rng(0)
    n, count = 300, 450
    at = rng.standard_normal((n, 3))
    at /= np.linalg.norm(at, axis=1, keepdims=True)
    means = np.concatenate([at, 0.3 * rng.standard_normal((n // 2, 3))])
    quats = normalise_quats(rng.standard_normal((count, 4)))
    opacities = rng.uniform(0.6, 1.0, count)
    opacities[:10] = 0.003
    arrays = {"opacities": opacities, "scales": rng.uniform(-2.3, -1.7, (count, 3))}
    arrays["sh0"] = np.sin(3.0 * means) + rng.uniform(0.0, 1.0, (count, 3))
    arrays["shN"] = 0.05 * rng.standard_normal((count, 8, 3))
    return cloud(means, quats=quats, **{name: values.astype(np.float32) for name, values in arrays.items()})
