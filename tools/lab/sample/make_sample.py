# SPDX-License-Identifier: Apache-2.0
"""Make the sample scene that ships with the project: photograph the garden, then train splats on the images.

The scene is procedural (`garden.py`), rendered here (`photograph.py`), trained by `csplat_trainer`.
It contains no third-party work: scene, images and splats are dedicated to the public domain (CC0-1.0).
The output is reproducible on one machine at any number of threads. Other machines may round
differently, which training amplifies.

Takes a few minutes on two cores; requires the packages of the render extra.

Usage:
    python tools/lab/sample/make_sample.py [OUT.ply] [--keep FOLDER]
    python tools/lab/sample/make_sample.py --photographs FOLDER [--views 48] [--size 200]     # only the images
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from garden import BOUND, make_garden
from photograph import photograph
from PIL import Image

from csplat import SplatModel, write_ply
from csplat.types import F32, F64
from csplat_render.camera import Camera, intrinsics, look_at
from csplat_render.kernels import available_threads
from csplat_trainer.data import load
from csplat_trainer.fitter import FitStep
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import TrainOptions, TrainResult

SAMPLE = Path(__file__).resolve().parents[2] / "csplat_tools" / "data" / "sample.ply"
COMMENTS = ("made by tools/sample/make_sample.py",)  # as in the sample that ships, whose bytes stay

_SEED = 20
_FIELD_OF_VIEW = 42.0
_FAR, _NEAR = 3.4, 2.3  # scene units; the garden has a radius of 1
_LOWEST, _HIGHEST = -38.0, 82.0  # degrees
# Since training is short, geometry learns at twice the default rates. The higher SH bands learn at half of theirs and
# so keep less noise in unobserved directions: 4 dB more after `csplat encode` for 0.7 dB less on test images.
_TRAINING = TrainOptions(
    max_splats=9000,
    iterations=8000,
    seed=_SEED,
    background="random",
    lr_means=6.4e-4,
    lr_quats=2e-3,
    lr_scales=1e-2,
    lr_sh0=5e-3,
    lr_shN=1.25e-4,
)
_FAINT = 0.01  # alpha; fainter splats are invisible


@dataclass(frozen=True)
class Recipe:
    """The sizes of a sample: views, pixels, points, and training.

    Attributes:
        train_views: number of training images.
        test_views: number of test images.
        size: width and height of the images, pixels.
        points: number of points on surfaces that training starts from.
        training: options of the training.
    """

    train_views: int = 90
    test_views: int = 15
    size: int = 320
    points: int = 6000
    training: TrainOptions = _TRAINING


def make_sample(output: Path, folder: Path, recipe: Recipe | None = None) -> TrainResult:
    """Photograph the garden, train splats and write them.

    Args:
        output: the PLY.
        folder: folder for the images.
        recipe: sizes of the sample.

    Returns:
        The scene as written, with the log of its training.
    """
    recipe = recipe or Recipe()
    points, colours = photograph_all(folder, recipe)
    data = replace(load(folder), points=points, points_rgb=colours)
    result = train(data, recipe.training, on_step=_show)
    result = replace(result, model=finish(result.model))
    write_ply(output, result.model)
    return result


def finish(model: SplatModel) -> SplatModel:
    """Remove invisible splats and add metadata."""
    shown = np.flatnonzero(model.opacities >= _FAINT)
    facts = {"licence": "CC0-1.0", "comments": list(COMMENTS)}
    metadata = replace(model.metadata, coordinate_system="RDF", entries=facts)
    return model.select(shown).with_metadata(metadata)


def photograph_all(folder: Path, recipe: Recipe) -> tuple[F32, F32]:
    """Write a data set of posed images in the layout of NeRF-synthetic.

    Args:
        folder: an existing folder.
        recipe: number and size of the images.

    Returns:
        Points on the surfaces in the training images, [P, 3], with colours, [P, 3] in 0..1, like those of structure
        from motion.
    """
    garden, points, colours = make_garden(), [], []
    rng = np.random.Generator(np.random.PCG64(_SEED))
    for split, count in (("train", recipe.train_views), ("test", recipe.test_views)):
        (folder / split).mkdir(exist_ok=True)
        frames, views = [], cameras(count, recipe.size, between=split == "test")
        with ThreadPoolExecutor(available_threads()) as pool:
            for number, (pixels, places) in enumerate(pool.map(partial(photograph, garden), views)):
                name = f"{split}/{number:03d}"
                Image.fromarray(pixels).save(folder / f"{name}.png")
                frames.append({"file_path": f"./{name}", "transform_matrix": camera_to_world(views[number]).tolist()})
                if split == "train":
                    solid = np.flatnonzero(pixels[..., 3] == 255)
                    chosen = rng.choice(solid, min(len(solid), recipe.points // count), replace=False)
                    points.append(places.reshape(-1, 3)[chosen])
                    colours.append(pixels.reshape(-1, 4)[chosen, :3] / 255.0)
                if number % 10 == 9 or number + 1 == count:
                    _say(f"{number + 1} of {count} {split} pictures")
        document = {"camera_angle_x": math.radians(_FIELD_OF_VIEW), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document, indent=1))
    return np.concatenate(points).astype(np.float32), np.concatenate(colours).astype(np.float32)


def cameras(count: int, size: int, *, between: bool) -> list[Camera]:
    """Return cameras spread evenly around the garden; every third is nearer and aims off-centre.

    Args:
        count: number of cameras.
        size: width and height of their images, pixels.
        between: place them between the training cameras, none of them nearer.
    """
    rng = np.random.Generator(np.random.PCG64(_SEED))
    K = intrinsics(size, size, _FIELD_OF_VIEW)
    low, high = math.sin(math.radians(_LOWEST)), math.sin(math.radians(_HIGHEST))
    middle = np.array([0.0, -BOUND[0], 0.0])  # y points down
    made = []
    for i in range(count):
        height = low + (high - low) * (i + 0.5) / count
        turn = math.pi * (3.0 - math.sqrt(5.0)) * i + (1.0 if between else 0.0)  # the golden angle
        ring = math.sqrt(1.0 - height * height)
        away = np.array([ring * math.cos(turn), -height, ring * math.sin(turn)])
        near = i % 3 == 2 and not between
        target = middle + (rng.uniform((-0.5, -0.45, -0.5), (0.5, 0.05, 0.5)) if near else 0.0)
        made.append(look_at(target + (_NEAR if near else _FAR) * away, target, (0, -1, 0), K, size, size))
    return made


def camera_to_world(camera: Camera) -> F64:
    """Return the pose in the convention of NeRF-synthetic: camera to world, x right, y up, z backwards.

    Returns:
        [4, 4].
    """
    pose = np.asarray(np.linalg.inv(camera.viewmat), np.float64)
    pose[:3, 1:3] *= -1.0
    return pose


def main(words: Sequence[str] | None = None) -> None:
    """Parse the command line and make the sample."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", nargs="?", type=Path, default=SAMPLE, metavar="OUT.ply")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the images in this folder")
    parser.add_argument("--photographs", type=Path, metavar="FOLDER", help="only write images to this folder")
    parser.add_argument(
        "--views",
        type=int,
        default=48,
        metavar="N",
        help="training images; a sixth more are test images",
    )
    parser.add_argument("--size", type=int, default=200, metavar="PIXELS", help="width and height of --photographs")
    arguments = parser.parse_args(words)
    if arguments.photographs is not None:
        arguments.photographs.mkdir(parents=True, exist_ok=True)
        held_out = -(-arguments.views // 6)
        photograph_all(arguments.photographs, Recipe(arguments.views, held_out, arguments.size))
        return
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        result = make_sample(arguments.output, folder)
    m = result.metrics
    assert m is not None, "there are test images"
    print(f"{m['views']} test images: PSNR {m['psnr']:.2f} dB pooled, SSIM {m['ssim']:.4f}")
    print(f"{arguments.output}: {len(result.model)} splats, {arguments.output.stat().st_size} bytes")


def _show(now: FitStep) -> None:
    if now.iteration % 500 == 0:
        _say(f"step {now.iteration} of {now.iterations}: PSNR {now.psnr:.2f} dB, {now.seconds_left:.0f} s left")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
