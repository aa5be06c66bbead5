"""What fine-tuning looks at: photographs, or renders of the source; some of them to learn from, some to decide by."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render.camera import Camera
from csplat_render.rasterise import Rasteriser
from csplat_trainer.pictures import Picture, compose

__all__ = ["View", "Views", "renders_of", "split_views"]

F32 = NDArray[np.float32]

_JUDGES = 16  # views at most, of those that teach
_BRIGHTEST = np.float32(6e4)  # what float16 holds


@dataclass(frozen=True, eq=False)
class View:
    """A camera and what it is to see.

    Attributes:
        camera: relative to the scene's origin.
        wanted: a photograph, or [H, W, 3] float16 or float32.

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
        """Which pixels count, [H, W]; `None`: all of them."""
        return self.wanted.mask if isinstance(self.wanted, Picture) else None

    def picture(self, background: F32, out: F32) -> F32:
        """The wanted picture, [H, W, 3] float32; `out` may be overwritten and returned."""
        if isinstance(self.wanted, Picture):
            return compose(self.wanted, background, out)
        np.copyto(out, self.wanted)
        return out


@dataclass(frozen=True, eq=False)
class Views:
    """Views to learn from, views to decide by, and the colour behind all of them.

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
        """Of the cameras and the background: what tells these views from others."""
        cameras = [(c.W, c.H, c.K.tolist(), c.viewmat.tolist()) for c in (one.camera for one in self.train)]
        said = repr((cameras, len(self.validation), self.kept_aside, self.background.tolist()))
        return hashlib.sha256(said.encode()).hexdigest()

    @property
    def kept_aside(self) -> bool:
        """Whether the views to decide by are not learnt from."""
        return not any(one is other for one in self.validation for other in self.train)


def split_views(views: Sequence[View], background: F32, aside: int = 0) -> Views:
    """Say which views teach and which decide.

    A scene fits the pictures that it was trained on better than any others. Those of them that are kept aside look
    worse with every step, whatever is gained elsewhere; so by default all teach, and some of them decide.

    Args:
        views: in the order of their taking.
        background: [3], behind all of them.
        aside: how many decide and do not teach: pictures that the scene was not trained on, or renders of it. 0: none.

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
    """Views of a scene itself: what its file is to look like where there are no photographs.

    They are kept in float16, 66 dB and more from what they were up to white; there are hundreds of them.
    """
    rasteriser = Rasteriser(gradients=False, threads=threads)
    views = []
    for camera in cameras:
        seen = rasteriser.forward(source, camera, background=background, antialiased=source.antialiased).rgb
        views.append(View(camera, np.clip(seen, -_BRIGHTEST, _BRIGHTEST).astype(np.float16)))
    return views
