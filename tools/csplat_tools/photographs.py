"""Photographs of a data set and where they were taken, for commands that look at finished scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat_render import Camera
from csplat_render.metrics import Scorer
from csplat_tools.extras import need_photographs

if TYPE_CHECKING:
    from collections.abc import Callable

    from csplat_trainer.pictures import Picture

__all__ = ["SPLITS", "DataViews", "PhotographScores", "relative_to", "show_photograph"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Colour = tuple[float, float, float]

#: Parts of a data set: the pictures that were held out of training, and the others.
SPLITS = ("test", "train")


@dataclass(frozen=True)
class DataViews:
    """Some photographs of a data set, by what a command line says.

    Attributes:
        path: the set's folder, or its transforms.json.
        split: one of `SPLITS`.
        size: width and height to bring them to; `None`: as they are.
        images: COLMAP sets: which folder of pictures; `None`: the reader chooses.
        test_every: which are held out where the set does not say so; must be that of the training.
    """

    path: str
    split: str = "test"
    size: tuple[int, int] | None = None
    images: str | None = None
    test_every: int = 8

    def read(self) -> list[Picture]:
        """Find them, undistorted, with their cameras in the coordinates of the set; each is read when it is looked at.

        Raises:
            InputError: there is no data set, it is damaged, or has no such pictures; or a package is not installed.
        """
        need_photographs()
        from csplat_trainer.data import load

        if self.split not in SPLITS:
            raise InputError(f"the split is {self.split!r}, wanted one of {', '.join(SPLITS)}")
        data = load(self.path, self.size, images=self.images, test_every=self.test_every)
        pictures = data.test if self.split == "test" else data.train
        if not pictures:
            raise InputError(f"{data.name} has no {self.split} pictures")
        return pictures


class PhotographScores:
    """Judges renders by photographs, one view after the other.

    Args:
        pictures: the photographs.
        background: behind those that have an alpha channel.
        lpips: measures the perceptual distance, if wanted.
    """

    def __init__(
        self, pictures: Sequence[Picture], background: Colour, lpips: Callable[[F32, F32], float] | None
    ) -> None:
        self._pictures, self._background, self._lpips = pictures, background, lpips
        self._scorer = Scorer()
        self._distances: list[float] = []

    def add(self, number: int, rendered: F32) -> None:
        """Score the render of a view.

        Args:
            number: of the photograph.
            rendered: [H, W, 3].
        """
        picture = self._pictures[number]
        photograph = show_photograph(picture, self._background)
        alpha = picture.pixels[..., 3] / 255.0 if picture.has_alpha else None
        self._scorer.add(photograph, rendered, alpha)
        if self._lpips is not None:
            self._distances.append(self._lpips(photograph, rendered))

    def as_json(self) -> dict[str, Any]:
        """PSNR pooled and as the mean over views, SSIM, LPIPS (`None` if not measured), covered pixels alone."""
        distances = self._distances
        return {
            **self._scorer.scores().to_json(),
            "lpips": sum(distances) / len(distances) if distances else None,
        }


def show_photograph(picture: Picture, background: Colour) -> F32:
    """A photograph as floats, [H, W, 3] in 0..1, in front of a colour where it has an alpha channel."""
    pixels = picture.pixels.astype(np.float32) / np.float32(255.0)
    if not picture.has_alpha:
        return pixels
    colours, alpha = pixels[..., :3], pixels[..., 3:]
    behind = (np.float32(1.0) - alpha) * np.array(background, np.float32)
    composed: F32 = (alpha * colours + behind).astype(np.float32, copy=False)
    return composed


def relative_to(origin: Sequence[float] | F64, camera: Camera) -> Camera:
    """The same camera for a scene whose coordinates are relative to an origin.

    Args:
        origin: [3], in the camera's coordinates.
        camera: where the photograph was taken.
    """
    shift = np.asarray(origin, np.float64)
    if not shift.any():
        return camera
    viewmat = camera.viewmat.copy()
    viewmat[:3, 3] += viewmat[:3, :3] @ shift
    return replace(camera, viewmat=viewmat)
