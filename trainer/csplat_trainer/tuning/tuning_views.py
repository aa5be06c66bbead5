# SPDX-License-Identifier: Apache-2.0
"""The views of fine-tuning, with images of a data set or renders of the source."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32
from csplat_render.camera import Camera
from csplat_render.rasteriser import Rasteriser
from csplat_trainer.posed_images import PosedImage, compose

_MAX_VALIDATION = 16  # largest number of validation views that are also training views
_FLOAT16_MAX = np.float32(6e4)  # largest value for float16


@dataclass(frozen=True, eq=False)
class TuningView:
    """A camera and its reference image.

    Attributes:
        camera: relative to the scene's origin.
        reference: an image of a data set, or a render, [H, W, 3] float16 or float32.

    Raises:
        InputError: the reference has another size than the camera's image.
    """

    camera: Camera
    reference: PosedImage | NDArray[np.floating[Any]]

    def __post_init__(self) -> None:
        shape = (self.camera.H, self.camera.W, 3)
        if not isinstance(self.reference, PosedImage) and self.reference.shape != shape:
            raise InputError(f"the reference image has shape {list(self.reference.shape)}, expected {list(shape)}")

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """Mask of the pixels that count, [H, W]; `None`: all of them."""
        return self.reference.mask if isinstance(self.reference, PosedImage) else None

    def image(self, background: F32, out: F32) -> F32:
        """Return the reference image, [H, W, 3] float32; `out` may be overwritten and returned."""
        if isinstance(self.reference, PosedImage):
            return compose(self.reference, background, out)
        np.copyto(out, self.reference)
        return out


@dataclass(frozen=True, eq=False)
class TuningViews:
    """Training views, validation views, and their background.

    Attributes:
        train: training views, at least one.
        validation: validation views, at least one; they are also training views unless they are held out.
        background: [3].

    Raises:
        InputError: there are no training or no validation views.
    """

    train: Sequence[TuningView]
    validation: Sequence[TuningView]
    background: F32

    def __post_init__(self) -> None:
        if not self.train or not self.validation:
            raise InputError("fine-tuning requires at least one training view and one validation view")

    @property
    def digest(self) -> str:
        """Hash of the training cameras, the split and the background."""
        cameras = [(c.W, c.H, c.K.tolist(), c.viewmat.tolist()) for c in (view.camera for view in self.train)]
        identity = repr((cameras, len(self.validation), self.is_held_out, self.background.tolist()))
        return hashlib.sha256(identity.encode()).hexdigest()

    @property
    def is_held_out(self) -> bool:
        """True if no validation view is a training view."""
        return not any(view is trained for view in self.validation for trained in self.train)


def split_views(views: Sequence[TuningView], background: F32, validation_count: int = 0) -> TuningViews:
    """Split views into training and validation views.

    A scene fits its training images better than others. If some of them were held out, their scores would fall with
    every step, whatever is gained on others. So by default all views are training views, and up to `_MAX_VALIDATION` of
    them are validation views, too.

    Args:
        views: the views, in the order of capture.
        background: [3], their background.
        validation_count: number of views to hold out for validation, if the scene was not trained on them; 0: hold
            out none.

    Raises:
        InputError: `validation_count` leaves no training view.
    """
    if validation_count >= len(views):
        raise InputError(f"{validation_count} of {len(views)} views for validation leave none for training")
    count = validation_count or min(len(views), _MAX_VALIDATION)
    # The views in the middle of `count` equal parts of the sequence; they are distinct, since count <= len(views).
    validation_numbers = {(2 * part + 1) * len(views) // (2 * count) for part in range(count)}
    training = [view for number, view in enumerate(views) if not validation_count or number not in validation_numbers]
    return TuningViews(training, [views[number] for number in sorted(validation_numbers)], background)


def renders_of(
    source: SplatModel, cameras: Sequence[Camera], background: F32, context: Context = DEFAULT_CONTEXT
) -> list[TuningView]:
    """Render a scene as views, which are the reference of a tuning without images.

    Hundreds of renders are kept, so they are stored in float16: at least 72 dB for values up to 1.

    Args:
        source: the scene.
        cameras: the views, relative to the scene's origin.
        background: [3], the background of the renders.
        context: threads.
    """
    rasteriser = Rasteriser(context=context)
    views = []
    for camera in cameras:
        render = rasteriser.forward(source, camera, background=background, antialiased=source.metadata.antialiased).rgb
        views.append(TuningView(camera, np.clip(render, -_FLOAT16_MAX, _FLOAT16_MAX).astype(np.float16)))
    return views
