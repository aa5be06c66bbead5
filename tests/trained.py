"""Images drawn by NumPy, a scene trained on them by `csplat train`, and its file by `csplat finetune`.

The images are independent of csplat, and the rest only uses the command line.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from command_line import call, change_options
from PIL import Image

from csplat_tools.training import training_run
from csplat_tools.training.training_run import tuning_after

W, H = 48, 40
FOCAL = 42.0  # pixels
VIEWS = 16  # every eighth is a test view
DISTANCE = 3.2  # distance of the cameras from the centre of a ball of radius 1
_SAMPLES = 3  # rays per pixel and axis
TRAIN = ("--max-splats", 300, "--sh-degree", 1, "--iterations", 300, "--seed", 1)
Run = Callable[..., str]


@dataclass(frozen=True)
class TrainedScene:
    """A trained scene and its sources.

    Attributes:
        data: folder of the images.
        ply: the scene.
        report: report of `csplat train`.
        checkpoint: the checkpoint of the last step.
        messages: what the command wrote to stderr.
    """

    data: Path
    ply: Path
    report: Path
    checkpoint: Path
    messages: str


@dataclass(frozen=True)
class TunedFile:
    """A tuned file and its sources.

    Attributes:
        source: the scene.
        path: the file.
        report: report of `csplat finetune`.
        messages: what the command wrote to stderr.
    """

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


def run_here(*words: object) -> str:
    """Run `csplat WORDS` in this process, which has its kernels loaded, and return its stderr."""
    return call(*words).stderr


def make_trained(folder: Path, run: Run = run_here) -> TrainedScene:
    """Write the images and train the scene."""
    data, ply, report, checkpoint = (folder / name for name in ("photographs", "a.ply", "train.json", "train.npz"))
    write_photographs(data)
    with pytest.MonkeyPatch.context() as patch:
        change_options(patch, "csplat_tools.cli.train.TrainOptions", refine_start=50, refine_every=25, lr_means=1e-3)
        messages = run("train", data, ply, *TRAIN, "--report", report, "--checkpoint", checkpoint)
    return TrainedScene(data, ply, report, checkpoint, messages)


def make_tuned(folder: Path, source: TrainedScene, run: Run = run_here) -> TunedFile:
    """Tune a file of the trained scene."""
    path, report = folder / "a.csplat", folder / "finetune.json"
    with pytest.MonkeyPatch.context() as patch:
        change_options(patch, "csplat_tools.cli.finetune.EncodeOptions", attribute_psnr=28.0, seed=1, threads=1)
        change_options(patch, "csplat_trainer.tuning.tuning_options.FinetuneOptions", seed=1)
        messages = run("finetune", source.ply, path, "--data", source.data, "--iterations", 100, "--report", report)
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
            brief = lambda **given: replace(tuning_after(**given), iterations=self.TUNED)  # noqa: E731
            patch.setattr(training_run, "tuning_after", brief)
            messages = run_here("train", self.data, self.folder / name, *self.WORDS, "--report", report, *more)
        return json.loads(report.read_text()), messages
