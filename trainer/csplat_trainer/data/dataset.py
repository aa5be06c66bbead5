"""`DataSet`, and what all readers share: shots that are not read yet, the near plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from csplat.model import UNSPECIFIED
from csplat.training_record import TrainingRecord
from csplat.types import F32, F64
from csplat.upright import Direction
from csplat_render.camera import DEFAULT_NEAR, camera_outliers, nearest_point
from csplat_trainer.data.lens import Lens
from csplat_trainer.pictures import Picture

_BLACK, _WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
_NEAR = 0.03  # fraction of the cameras' distance from what they look at


@dataclass(frozen=True, eq=False)
class DataSet:
    """Posed images to train on and to score with.

    Attributes:
        name: kind and place, for messages: `COLMAP set /data/garden`.
        train: pictures to learn from, at least one.
        test: pictures that were held out; none if the set is too small or names none.
        points: [P, 3] float32, points of the scene, relative to `origin`; `None` if the set has none.
        points_rgb: [P, 3] float32 in 0..1, their colours; `None` if they have none of their own.
        report: what was found, left out and changed, a line each.
        coordinate_system: as in `SplatModel`, if there is a convention for this kind of set.
        up: direction that is up; `None` if neither the kind of set nor its cameras determine it.
        test_every: every Nth image was held out; `None` if the set names its test images.
        size: width and height that the images are scaled to; `None`: they are not.
        images: the folder of images that was requested; `None`: the reader chose.
        val: validation images that the set names; they are neither training nor test images.
        origin: [3] float64, the point that points and cameras are relative to, in the coordinates of the set's files;
            other than 0 if these lie so far from 0 that float32 would lose visible detail.
    """

    name: str
    train: list[Picture]
    test: list[Picture]
    points: F32 | None = None
    points_rgb: F32 | None = None
    report: tuple[str, ...] = ()
    coordinate_system: str = UNSPECIFIED
    up: Direction | None = None
    test_every: int | None = None
    size: tuple[int, int] | None = None
    images: str | None = None
    val: list[Picture] = field(default_factory=list)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def background(self) -> tuple[float, float, float]:
        """Colour behind the splats: white if images have alpha, as in published tables; else black."""
        images = (*self.train, *self.test)
        return _WHITE if 2 * sum(image.has_alpha for image in images) >= len(images) else _BLACK

    def trained_on(self, background: tuple[float, float, float]) -> TrainingRecord:
        """Return the record for a scene that was trained on this set.

        Args:
            background: red, green, blue behind the splats when the scene was scored.
        """
        return TrainingRecord(background, self.test_every, self.size, self.train[0].camera.near, self.images)

    @cached_property
    def outliers(self) -> list[Picture]:
        """Images whose cameras are far away from all others (`camera_outliers`)."""
        images = [*self.train, *self.test, *self.val]
        outliers = camera_outliers(np.stack([image.camera.viewmat for image in images]), self.points)
        return [image for image, outlier in zip(images, outliers, strict=True) if outlier]

    @property
    def counted(self) -> list[Picture]:
        """Training images that determine where the scene lies: all but outliers, or all if only outliers are left."""
        outliers = {id(image) for image in self.outliers}
        return [image for image in self.train if id(image) not in outliers] or self.train

    def read(self) -> None:
        """Read all training and test images now: a damaged one is found before anything is done with the others.

        Raises:
            InputError: a file is no image, or is cut short.
        """
        for picture in (*self.train, *self.test):
            _ = picture.pixels, picture.mask


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture that is known but not read.

    Attributes:
        name: as the set writes it.
        path: the file.
        lens: how it was taken.
        viewmat: [4, 4] float64, world to camera, OpenCV axes.
        mask: path of an image that is black for pixels that do not count.
    """

    name: str
    path: Path
    lens: Lens
    viewmat: F64
    mask: Path | None = None


@dataclass(frozen=True, eq=False)
class Found:
    """Result of a reader: everything but the pixels.

    Attributes:
        kind: `Blender set`, …
        train: shots to train on.
        test: shots that are held out.
        points: [P, 3] float64 or `None`.
        points_rgb: [P, 3] float32 in 0..1 or `None`.
        report: lines for the user.
        test_every: as in `DataSet`.
        coordinate_system: as in `DataSet`.
        val: validation shots.
    """

    kind: str
    train: list[Shot]
    test: list[Shot]
    points: F64 | None = None
    points_rgb: F32 | None = None
    report: list[str] = field(default_factory=list)
    test_every: int | None = None
    coordinate_system: str = UNSPECIFIED
    val: list[Shot] = field(default_factory=list)


def near_plane(shots: Sequence[Shot], points: F64 | None = None) -> float:
    """A near plane that suits a set: a small part of the distance to what its cameras look at.

    Scene units are arbitrary where poses come from photographs; the renderer's default, which it
    never exceeds, may lie beyond the scene.

    Args:
        shots: at least one; outliers do not count.
        points: [P, 3], points of the scene, if they are known.
    """
    viewmats = np.stack([shot.viewmat for shot in shots])
    viewmats = viewmats[~camera_outliers(viewmats, points)]
    positions = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    focus = nearest_point(positions, viewmats[:, 2, :3])
    distance = float(np.median(np.linalg.norm(positions - focus, axis=1)))
    return min(DEFAULT_NEAR, _NEAR * distance) if distance > 0.0 else DEFAULT_NEAR
