# SPDX-License-Identifier: Apache-2.0
"""A small scene and images of it, for training, tuning and searches; a trained and a tuned scene, by the command line.

Requires the extra [render].
"""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from checked import cloud, quaternion_of
from command_line import call, change_options
from PIL import Image
from posed_sets import to_opengl, write_document

from csplat import EncodeOptions, Target, write_ply
from csplat.context import DEFAULT_CONTEXT
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


def with_alpha(seen):
    """Return the straight RGBA pixels of a render on black, [H, W, 4] uint8."""
    straight = np.clip(seen.rgb / np.maximum(seen.alpha, 1e-6)[..., None], 0.0, 1.0)
    return as_bytes(np.concatenate([straight, seen.alpha[..., None]], axis=2))


def as_bytes(pixels):
    return np.rint(255.0 * np.clip(pixels, 0.0, 1.0)).astype(np.uint8)


def training_images(make_model, *, alpha=True):
    """Return twelve images of thirty splats, nine of them for training."""
    scene = make_model(30, 1, seed=3, scales=np.full((30, 3), -1.2, np.float32))
    rasteriser, shots, K = Rasteriser(), [], intrinsics(32, 32, 50.0)
    for elevation in (10.0, 45.0):
        for camera in orbit((0, 0, 0), 6.0, (0, 0, 1), 6, K, 32, 32, elevation=elevation):
            seen = rasteriser.forward(scene, camera)
            shots.append(PosedImage(camera, with_alpha(seen) if alpha else as_bytes(seen.rgb)))
    return DataSet("made", shots[:9], shots[9:])


def shell(coefficients):
    """Return 300 overlapping splats on a sphere with smoothly varying colours; `coefficients` of SH beyond degree 0."""
    rng = np.random.default_rng(0)
    means = rng.standard_normal((300, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    arrays = {
        "means": means, "quats": normalise_quats(rng.standard_normal((300, 4))),
        "scales": rng.uniform(-2.5, -1.3, (300, 3)), "opacities": rng.uniform(0.1, 0.95, 300),
        "sh0": np.sin(3.0 * means) + 0.5, "shN": 0.1 * rng.standard_normal((300, coefficients, 3)),
    }  # fmt: skip
    return SplatModel(**{name: array.astype(np.float32) for name, array in arrays.items()})


def photograph(scene, folder):
    """Write sixteen images on black, and a PLY with an additional splat far behind all cameras."""
    (folder / "images").mkdir()
    frames = []
    for number, camera in enumerate(cameras(16)):
        name = f"images/view{number:02}.png"
        Image.fromarray(as_bytes(render(scene, camera).rgb)).save(folder / name)
        frames.append({"file_path": name, "transform_matrix": to_opengl(camera)})
    write_document(folder, intrinsics(W, H, 60.0), W, H, frames)
    hidden = scene.select(np.concatenate([[0], np.arange(len(scene))]))
    hidden = replace(hidden, means=np.concatenate([np.full((1, 3), 400.0, np.float32), scene.means]))
    write_ply(folder / "scene.ply", hidden)
    return folder


def as_colmap(folder):
    (folder / "transforms.json").unlink()
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    K, lines = cameras(1)[0].K, []
    for number, camera in enumerate(cameras(16)):
        values = " ".join(map(str, (*quaternion_of(camera.viewmat[:3, :3]), *camera.viewmat[:3, 3])))
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
            Image.fromarray(with_alpha(render(scene, camera))).save(folder / part / f"r_{number}.png")
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


def found_within(
    source, views=None, encoding=None, *, no_prune=False, importance=None, refit=True, context=DEFAULT_CONTEXT, **goal
):
    """Return the file at a target by a brief search in small views, by default of forty cameras."""
    views = views or judged_by(cameras(40))
    # Larger views take fewer steps of a fit. The size only matters if virtual views are added.
    size = SMALL if views.virtual else (960, 720)
    simplifying = SimplifyOptions(effort=1, view_size=size, refit=refit)
    target = Target(prune=not no_prune, **goal)
    chosen = {"importance": importance, "simplifying": simplifying, "context": context}
    return meet_target(source, encoding or EncodeOptions(), target=target, views=views, **chosen)


FOCAL = 42.0  # pixels
VIEWS = 16  # every eighth is a test view
DISTANCE = 3.2  # distance of the cameras from the centre of a ball of radius 1
_SAMPLES = 3  # rays per pixel and axis
TRAIN = ("--max-splats", 300, "--sh-degree", 1, "--iterations", 300, "--seed", 1)


def write_photographs(folder):
    """Write a transforms.json set of a ball with coloured stripes on a transparent background, drawn by NumPy."""
    folder.mkdir(parents=True, exist_ok=True)
    K, frames = np.array([[FOCAL, 0.0, W / 2], [0.0, FOCAL, H / 2], [0.0, 0.0, 1.0]]), []
    for number in range(VIEWS):
        turn, height = 2.4 * number, 0.5 * np.sin(1.7 * number)
        eye = DISTANCE * np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
        camera = look_at(eye, (0, 0, 0), (0, 0, 1), K, W, H)
        Image.fromarray(_photograph(eye, camera.viewmat[:3, :3])).save(folder / f"{number:02}.png")
        frames.append({"file_path": f"{number:02}.png", "transform_matrix": to_opengl(camera)})
    write_document(folder, K, W, H, frames)


def _photograph(eye, rotation):
    ticks = [((np.arange(_SAMPLES * size) + 0.5) / _SAMPLES - size / 2) / FOCAL for size in (W, H)]
    x, y = np.meshgrid(*ticks)
    rays = np.stack([x, y, np.ones_like(x)], axis=2) @ rotation
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    along = rays @ eye
    root = along**2 - (eye @ eye - 1.0)
    points = eye + (-along - np.sqrt(np.maximum(root, 0.0)))[..., None] * rays
    colours = 0.5 + 0.4 * np.sin(3.0 * points + np.array([0.0, 1.0, 2.0]))
    shown = np.where(root[..., None] > 0.0, np.concatenate([colours, np.ones_like(x)[..., None]], axis=2), 0.0)
    means = shown.reshape(H, _SAMPLES, W, _SAMPLES, 4).mean(axis=(1, 3))
    means[..., :3] /= np.maximum(means[..., 3:], 1e-9)
    return np.rint(255.0 * means).astype(np.uint8)


def make_trained(folder):
    """Write the images and train the scene; return the paths and the messages."""
    data, ply, report, checkpoint = (folder / name for name in ("photographs", "a.ply", "train.json", "train.npz"))
    write_photographs(data)
    with pytest.MonkeyPatch.context() as patch:
        change_options(patch, "csplat_tools.cli.train.TrainOptions", refine_start=50, refine_every=25, lr_means=1e-3)
        words = ("train", data, ply, *TRAIN, "--report", report, "--checkpoint", checkpoint)
        messages = call(*words).stderr
    return SimpleNamespace(data=data, ply=ply, report=report, checkpoint=checkpoint, messages=messages)


def make_tuned(folder, source):
    path, report = folder / "a.csplat", folder / "finetune.json"
    with pytest.MonkeyPatch.context() as patch:
        change_options(patch, "csplat_tools.cli.finetune.EncodeOptions", attribute_psnr=28.0)
        change_options(patch, "csplat_tools.cli.finetune.Context", seed=1, threads=1)
        change_options(patch, "csplat_trainer.tuning.tuning_options.FinetuneOptions", seed=1)
        words = ("finetune", source.ply, path, "--data", source.data, "--iterations", 100, "--report", report)
        messages = call(*words).stderr
    return SimpleNamespace(source=source, path=path, report=report, messages=messages)


class FileRuns:
    """Runs of `csplat train` to files, with little training and tuning.

    The first keeps all splats and writes checkpoints of training and tuning, a report and a page.
    """

    WORDS = ("--max-splats", 40, "--sh-degree", 0, "--iterations", 30)
    TUNED = 30  # steps; the default is 1,000

    def __init__(self, folder):
        self.folder, self.data = folder, folder / "photographs"
        self.checkpoint, self.page = folder / "run.npz", folder / "page.html"
        write_photographs(self.data)
        outputs = ("--checkpoint", self.checkpoint, "--page", self.page)
        self.report, self.messages = self.made("a.csplat", "--keep", 1, *outputs)

    def made(self, name, *more, status=0, **options):
        """Make a file or a PLY, with options of the training; return the report, if there is one, and the messages."""
        report = self.folder / f"{name}.json"
        with pytest.MonkeyPatch.context() as patch:
            change_options(patch, "csplat_tools.cli.train.TrainOptions", log_every=10, **options)
            patch.setattr("csplat_trainer.data.loader.load", None)  # a training opens its data set by another name
            brief = lambda **given: replace(tuning_after(**given), iterations=self.TUNED)  # noqa: E731
            patch.setattr(training_run, "tuning_after", brief)
            words = ("train", self.data, self.folder / name, *self.WORDS, "--report", report, *more)
            messages = call(*words, status=status).stderr
        return None if status else json.loads(report.read_text()), messages


def shell_with_hidden_splats():
    """Return a shell of opaque splats with hidden ones inside, and ten that are too transparent to be drawn."""
    rng, count = np.random.default_rng(0), 450
    at = rng.standard_normal((300, 3))
    means = np.concatenate([at / np.linalg.norm(at, axis=1, keepdims=True), 0.3 * rng.standard_normal((150, 3))])
    arrays = {
        "quats": normalise_quats(rng.standard_normal((count, 4))), "opacities": rng.uniform(0.6, 1.0, count),
        "scales": rng.uniform(-2.3, -1.7, (count, 3)), "sh0": np.sin(3.0 * means) + rng.uniform(0.0, 1.0, (count, 3)),
        "shN": 0.05 * rng.standard_normal((count, 8, 3)),
    }  # fmt: skip
    arrays["opacities"][:10] = 0.003
    return cloud(means, **{name: values.astype(np.float32) for name, values in arrays.items()})
