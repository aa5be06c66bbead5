# SPDX-License-Identifier: Apache-2.0
"""`PosedImage`: an image of a data set with its camera, stored as bytes and converted to float on demand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat.types import F32, F64, U8, Mask
from csplat_render import kernels
from csplat_render.camera import Camera
from csplat_render.conventions import Mode
from csplat_render.metrics import COVERED_ALPHA, Distance, Scores
from csplat_render.scorer import ReferenceImage, Scorer


@dataclass(frozen=True, eq=False)
class UnreadPixels:
    """Pixels that are read on first access and cached.

    Attributes:
        has_alpha: True if there is an alpha channel.
        read: returns the array for `PosedImage`.
    """

    has_alpha: bool
    read: Callable[[], U8]

    @cached_property
    def pixels(self) -> U8:
        """The result of `read`, which may raise."""
        return self.read()


@dataclass(frozen=True, eq=False)
class UnreadMask:
    """A mask that is read on first access and cached.

    Attributes:
        read: returns the array for `PosedImage`.
    """

    read: Callable[[], Mask]

    @cached_property
    def mask(self) -> Mask:
        """The result of `read`, which may raise."""
        return self.read()


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image of a data set with its camera.

    Attributes:
        camera: its camera; W and H are the size of the image.
        source: [H, W, 3] or [H, W, 4] uint8, C-contiguous, RGB or RGBA with straight (not premultiplied) alpha; or
            unread pixels.
        masked: [H, W], True for pixels that count in training and scores; or an unread mask. `None`: all count.

    Raises:
        InputError: pixels have another shape or dtype.
    """

    camera: Camera
    source: U8 | UnreadPixels
    masked: Mask | UnreadMask | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.source, UnreadPixels):
            self._check(self.source)

    @property
    def pixels(self) -> U8:
        """Pixels of the image, read on first access.

        Raises:
            InputError: the file is damaged.
        """
        if not isinstance(self.source, UnreadPixels):
            return self.source
        self._check(self.source.pixels)
        return self.source.pixels

    @property
    def mask(self) -> Mask | None:
        """Mask of the pixels that count, read on first access; `None`: all of them.

        Raises:
            InputError: the file is damaged, has another size, or no pixel counts.
        """
        mask = self.masked.mask if isinstance(self.masked, UnreadMask) else self.masked
        if mask is not None and (mask.dtype != np.bool_ or mask.shape != (self.camera.H, self.camera.W)):
            raise InputError(f"a mask is {mask.dtype} {list(mask.shape)}, expected bool and the size of its image")
        if mask is not None and not mask.any():
            raise InputError(f"the mask of {self.camera.image} hides all of it: remove the image")
        return mask

    @property
    def has_alpha(self) -> bool:
        """True if there is an alpha channel; pixels are not read."""
        return self.source.has_alpha if isinstance(self.source, UnreadPixels) else self.source.shape[2] == 4

    def at(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> F64:
        """Return some pixels, RGBA in 0..1, [M, 4]; alpha is 1 without an alpha channel."""
        values = self.pixels[rows, columns].astype(np.float64) / 255.0
        return values if self.has_alpha else np.concatenate([values, np.ones((len(values), 1))], axis=1)

    def _check(self, pixels: U8) -> None:
        """Raise an `InputError` unless pixels are uint8, RGB or RGBA, and of the camera's size."""
        shape = (self.camera.H, self.camera.W)
        if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
            raise InputError(f"an image is {pixels.dtype} {list(pixels.shape)}, expected uint8 [H, W, 3 or 4]")
        if pixels.shape[:2] != shape:
            raise InputError(f"an image has {pixels.shape[:2]} pixels, expected {shape} (height, width of its camera)")


def compose(image: PosedImage, background: F32, out: F32) -> F32:
    """Convert an image to floats, in front of a background, [3].

    Returns:
        `out`, [H, W, 3] float32, overwritten.
    """
    assert background.dtype == out.dtype == np.float32
    pixels = np.ascontiguousarray(image.pixels)
    kernels.call("compose", pixels, pixels[..., 0].size, pixels.shape[2], np.ascontiguousarray(background), out)
    return out


def halve(image: PosedImage) -> PosedImage:
    """Return the image at half its width and height: each pixel is the mean of four, weighted by their alpha.

    A last odd row or column is dropped. A pixel counts if all four do. If no pixel would count, or the image is one
    pixel wide or high, it is returned unchanged.
    """
    camera = image.camera
    W, H = camera.W // 2, camera.H // 2
    corners = [(slice(y, 2 * H, 2), slice(x, 2 * W, 2)) for y in (0, 1) for x in (0, 1)]
    mask: Mask | None = None
    if image.mask is not None:
        mask = np.asarray(np.stack([image.mask[corner] for corner in corners]).all(axis=0))
    if min(W, H) == 0 or (mask is not None and not mask.any()):
        return image
    smaller = replace(camera, K=np.diag([0.5, 0.5, 1.0]) @ camera.K, W=W, H=H)
    four = np.stack([image.pixels[corner] for corner in corners]).astype(np.uint32)
    alphas = four[..., 3:] if image.has_alpha else np.ones((4, H, W, 1), np.uint32)
    weights = alphas.sum(axis=0)
    colours = ((alphas * four[..., :3]).sum(axis=0) + weights // 2) // np.maximum(weights, 1)
    pixels = np.concatenate([colours, (weights + 2) // 4], axis=2) if image.has_alpha else colours
    return PosedImage(smaller, np.ascontiguousarray(pixels, np.uint8), mask)


def image_scorer(
    images: Sequence[PosedImage],
    background: ArrayLike,
    *,
    mode: Mode = "standard",
    origin: Sequence[float] | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> Scorer:
    """Return a scorer on images of a data set; each is composed on use.

    Args:
        images: at least one.
        background: background colour of renders, and of images with an alpha channel.
        mode, origin: as in `Scorer`.
        context: threads.
    """
    colour = np.asarray(background, np.float32)
    cameras = [image.camera for image in images]
    references = [partial(_reference_image, image, colour) for image in images]
    masked = any(image.masked is not None for image in images)
    pixel_counts = [_pixel_count(image) for image in images] if masked else None
    return Scorer(cameras, references, colour, mode, context, origin, pixel_counts)


def evaluate(
    render: Callable[[Camera], F32],
    images: Sequence[PosedImage],
    background: F32,
    lpips: Distance | None = None,
) -> dict[str, Any]:
    """Compare renders with images of a data set.

    Args:
        render: renders a camera's view, [H, W, 3].
        images: at least one.
        background: [3], background of images with an alpha channel; `render` uses the same.
        lpips: the perceptual distance, or `None`.

    Returns:
        The JSON of `csplat_render.metrics.Scores` over all images.
    """
    scorer = image_scorer(images, background)
    scores = [scorer.score(number, render(camera), lpips=lpips) for number, camera in enumerate(scorer.cameras)]
    return Scores.of(scores).as_json()


def _reference_image(image: PosedImage, background: F32) -> ReferenceImage:
    """Return an image in front of a background [3], with the pixels that its alpha, if any, marks as covered."""
    shown = compose(image, background, np.empty((image.camera.H, image.camera.W, 3), np.float32))
    covered = image.pixels[..., 3] >= COVERED_ALPHA * 255.0 if image.has_alpha else None
    return ReferenceImage(shown, covered, mask=image.mask)


def _pixel_count(image: PosedImage) -> int:
    """Return the number of pixels that count."""
    return image.camera.W * image.camera.H if image.mask is None else int(image.mask.sum())
