"""Views of fine-tuning: photographs, or renders of the source, for training and for validation."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32
from csplat_render.camera import Camera
from csplat_render.rasteriser import Rasteriser
from csplat_trainer.pictures import Picture, compose

_JUDGES = 16  # validation views at most, if they are training views too
_BRIGHTEST = np.float32(6e4)  # largest value for float16


@dataclass(frozen=True, eq=False)
class View:
    """A camera and its reference image.

    Attributes:
        camera: relative to the scene's origin.
        wanted: a photograph, or [H, W, 3] float16 or float32: the reference image.

    Raises:
        InputError: a picture of another size.
    """

    camera: Camera
    wanted: Picture | NDArray[np.floating[Any]]

    def __post_init__(self) -> None:
        shape = (self.camera.H, self.camera.W, 3)
        if not isinstance(self.wanted, Picture) and self.wanted.shape != shape:
            raise InputError(f"a wanted picture has shape {list(self.wanted.shape)}, wanted {list(shape)}")

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """Pixels that count, [H, W]; `None`: all of them."""
        return self.wanted.mask if isinstance(self.wanted, Picture) else None

    def picture(self, background: F32, out: F32) -> F32:
        """Return the reference image, [H, W, 3] float32; `out` may be overwritten and returned."""
        if isinstance(self.wanted, Picture):
            return compose(self.wanted, background, out)
        np.copyto(out, self.wanted)
        return out


@dataclass(frozen=True, eq=False)
class Views:
    """Training views, validation views, and the colour behind all of them.

    Attributes:
        train: at least one.
        validation: at least one; they are among `train` unless they were kept aside.
        background: [3].

    Raises:
        InputError: one of the two is empty.
    """

    train: Sequence[View]
    validation: Sequence[View]
    background: F32

    def __post_init__(self) -> None:
        if not self.train or not self.validation:
            raise InputError("fine-tuning wants at least one view to learn from and one to decide by")

    @property
    def digest(self) -> str:
        """Hash of the training cameras, the split and the background, which identifies these views."""
        cameras = [(c.W, c.H, c.K.tolist(), c.viewmat.tolist()) for c in (one.camera for one in self.train)]
        said = repr((cameras, len(self.validation), self.kept_aside, self.background.tolist()))
        return hashlib.sha256(said.encode()).hexdigest()

    @property
    def kept_aside(self) -> bool:
        """True if no validation view is a training view."""
        return not any(one is other for one in self.validation for other in self.train)


def split_views(views: Sequence[View], background: F32, aside: int = 0) -> Views:
    """Split views into training and validation views.

    A scene fits the images that it was trained on better than any others. Those of them that are held out look worse
    with every step, whatever is gained elsewhere; so by default all are training views, and some of them are
    validation views, too.

    Args:
        views: the views, in the order of their taking.
        background: [3], behind all of them.
        aside: number of validation views that are held out: images that the scene was not trained on, or renders of
            it. 0: none.

    Raises:
        InputError: there are not as many views.
    """
    if aside >= len(views):
        raise InputError(f"{aside} of {len(views)} views to decide by leave none to learn from")
    count = aside or min(len(views), _JUDGES)
    judges = {(2 * number + 1) * len(views) // (2 * count) for number in range(count)}
    teachers = [view for number, view in enumerate(views) if not aside or number not in judges]
    return Views(teachers, [views[number] for number in sorted(judges)], background)


def renders_of(source: SplatModel, cameras: Sequence[Camera], background: F32, threads: int | None) -> list[View]:
    """Return views of a scene itself: the reference for its file if there are no photographs.

    They are kept in float16, 66 dB and more from what they were up to white; there are hundreds of them.
    """
    rasteriser = Rasteriser(gradients=False, threads=threads)
    views = []
    for camera in cameras:
        seen = rasteriser.forward(source, camera, background=background, antialiased=source.antialiased).rgb
        views.append(View(camera, np.clip(seen, -_BRIGHTEST, _BRIGHTEST).astype(np.float16)))
    return views
