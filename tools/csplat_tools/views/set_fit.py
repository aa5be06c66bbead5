# SPDX-License-Identifier: Apache-2.0
"""Decide if a scene fits a data set: if its renders look like the photographs.

Programs that normalise coordinates (gsplat, nerfstudio) write scenes that no longer fit the poses of the set. All
commands use this rule: a scene does not fit if its renders are farther from the photographs than their mean is, and no
better than a single colour by `_MARGIN_DB`. Measured at most 128 pixels wide on lego200, fox, desk29 and two synthetic
sets, in dB above the single colour: scenes after 200 steps of training 3.6 to 10.4, trained to their end 9.1 to 50; of
60 copies that were turned, moved and scaled at random at most 0.0, of other sets' scenes at most −0.9, and of quarter
turns 1.4. Turns by 10 degrees and scales of 0.8 are hardly ever found: their renders resemble the photographs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.disk_files import read_json
from csplat.errors import InputError, counted
from csplat.model import SplatModel
from csplat.types import F64, null_progress
from csplat_render.camera import Camera
from csplat_render.metrics import psnr_of_mse
from csplat_tools.views.virtual_views import evenly_spaced

if TYPE_CHECKING:
    from csplat_trainer.posed_images import PosedImage

#: File in which nerfstudio writes how it normalised coordinates.
NORMALISATION = "dataparser_transforms.json"

_IMAGES = 12  # images to compare, at most
_SIDE = 128  # pixels; largest width and height of the images to compare
_MARGIN_DB = 2.0  # least advantage of a scene over a single colour
_FLAT = 1e-4  # mean squared error of a single colour below which images show nothing to compare
_ROTATION_TOLERANCE = 1e-3  # largest deviation of R Rᵀ from the identity, for numbers that a file rounds


@dataclass(frozen=True)
class SetFit:
    """How well a scene shows the photographs of a data set, as mean squared errors of values from 0 to 1.

    Attributes:
        count: number of images compared.
        scene: error of the scene's renders.
        colour: error of the mean colour of all images.
        mean_image: error of the mean of the images; infinite for images of several sizes.
    """

    count: int
    scene: float
    colour: float
    mean_image: float

    @property
    def fits(self) -> bool:
        """True if the scene fits the set, or nothing can be said."""
        if self.colour < _FLAT:
            return True
        return self.scene <= self.mean_image or psnr_of_mse(self.scene) > psnr_of_mse(self.colour) + _MARGIN_DB

    def describe(self, name: str) -> str:
        """Return a sentence on a scene that does not fit the set of a name."""
        own, colour = (psnr_of_mse(error) for error in (self.scene, self.colour))
        return (
            f"the scene does not fit {name}: it shows {counted(self.count, 'image')} at {own:.1f} dB, where a single"
            f" colour has {colour:.1f} dB; expected a scene in the coordinates of the set, on the background of its"
            f" training. Training with gsplat or nerfstudio normalises coordinates: put nerfstudio's {NORMALISATION}"
            " next to the scene"
        )


def measure_fit(
    model: SplatModel,
    images: Sequence[PosedImage],
    background: Sequence[float],
    *,
    context: Context = DEFAULT_CONTEXT,
) -> SetFit:
    """Compare a scene with some images of a set, evenly spread.

    Args:
        model: the scene.
        images: at least one, with cameras relative to the scene's origin.
        background: red, green, blue, 0 to 1.
        context: threads.
    """
    from csplat_trainer.posed_images import image_scorer

    chosen = [_shrunk(image) for image in evenly_spaced(images, _IMAGES)]
    scorer = image_scorer(chosen, background, origin=model.origin, context=replace(context, progress=null_progress))
    references = [scorer.reference(number) for number in range(len(chosen))]
    values = [one.rgb.astype(np.float64) for one in references]
    counted_pixels = [np.ones(one.rgb.shape[:2], np.bool_) if one.mask is None else one.mask for one in references]
    pixels = np.concatenate([value[mask] for value, mask in zip(values, counted_pixels, strict=True)])
    colour, mean_image = float(np.mean((pixels - pixels.mean(axis=0)) ** 2)), np.inf
    if len({value.shape for value in values}) == 1 and len(values) > 1:
        middle = np.mean(values, axis=0)
        differences = [(value - middle)[mask] for value, mask in zip(values, counted_pixels, strict=True)]
        mean_image = float(np.mean(np.concatenate(differences) ** 2))
    return SetFit(len(chosen), scorer.pooled(scorer.errors(model)), colour, mean_image)


def normalised_images(images: Sequence[PosedImage], scene: str, data: str) -> list[list[PosedImage]]:
    """Return a set's images in normalised coordinates, by the file of nerfstudio next to a scene.

    Args:
        images: the images, in the coordinates of the set.
        scene: path of the scene.
        data: path of the set. A `transforms.json` of ns-process-data has an `applied_transform`, which the file of
            nerfstudio may contain once more.

    Returns:
        Images for each way of reading the file; none if there is no such file.

    Raises:
        InputError: the file is damaged, or has no rotation, translation and scale.
    """
    path = Path(scene).parent / NORMALISATION
    if not path.is_file():
        return []
    document = read_json(path)
    matrix = _read_matrix(path, document, "transform")
    scale = document.get("scale", 1.0)
    if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 0.0 < scale < np.inf:
        raise InputError(f"{path}: scale is {scale!r}, expected a number above 0")
    matrices, frames = [matrix], Path(data)
    frames = frames / "transforms.json" if frames.is_dir() else frames
    applied = read_json(frames) if frames.suffix == ".json" and frames.is_file() else {}
    if isinstance(applied, dict) and "applied_transform" in applied:
        matrices.append(matrix @ np.linalg.inv(_read_matrix(frames, applied, "applied_transform")))
    return [
        [replace(image, camera=_normalised(image.camera, one, float(scale))) for image in images] for one in matrices
    ]


def _shrunk(image: PosedImage) -> PosedImage:
    """Return an image, halved until it is small enough to compare."""
    from csplat_trainer.posed_images import halve

    while max(image.camera.W, image.camera.H) > _SIDE:
        smaller = halve(image)
        if smaller is image:
            break
        image = smaller
    return image


def _read_matrix(path: Path, document: Any, key: str) -> F64:
    """Return a rotation and translation, [4, 4], of three or four rows in a document."""
    rows = document.get(key) if isinstance(document, dict) else None
    try:
        matrix = np.array(rows, np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise InputError(f"{path}: {key} is no matrix of 3 × 4 numbers")
    R = matrix[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(R) < 0.0:
        raise InputError(f"{path}: {key} is no rotation and translation")
    return np.vstack([matrix[:3], [0.0, 0.0, 0.0, 1.0]])


def _normalised(camera: Camera, matrix: F64, scale: float) -> Camera:
    """Return the camera for coordinates scale · (R x + t) of the scene, where `matrix` [4, 4] is R and t."""
    viewmat = camera.viewmat @ np.linalg.inv(matrix)
    viewmat[:3, 3] *= scale
    return replace(camera, viewmat=viewmat, near=camera.near * scale)
