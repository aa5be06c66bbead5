"""Scores of a scene on photographs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from csplat.types import F32
from csplat_render.camera import Camera
from csplat_render.conventions import Mode
from csplat_render.metrics import COVERED_ALPHA, Distance, Scores
from csplat_render.scorer import ReferenceImage, Scorer
from csplat_trainer.pictures import Picture, compose


def photograph_judge(
    pictures: Sequence[Picture],
    background: ArrayLike,
    *,
    mode: Mode = "standard",
    threads: int | None = None,
    origin: Sequence[float] | None = None,
) -> Scorer:
    """Return a judge by photographs; each is composed when its turn comes.

    Args:
        pictures: at least one.
        background: red, green, blue, behind renders and behind photographs that have an alpha channel.
        mode, threads, origin: as in `Scorer`.
    """
    colour = np.asarray(background, np.float32)
    cameras = [picture.camera for picture in pictures]
    looks = [partial(_look, one, colour) for one in pictures]
    masked = any(one.masked is not None for one in pictures)
    return Scorer(cameras, looks, colour, mode, threads, origin, [_count(one) for one in pictures] if masked else None)


def evaluate(
    render: Callable[[Camera], F32],
    pictures: Sequence[Picture],
    background: F32,
    lpips: Distance | None = None,
) -> dict[str, Any]:
    """Compare renders with photographs.

    Args:
        render: renders a camera's view, [H, W, 3].
        pictures: at least one.
        background: [3], behind photographs that have an alpha channel; `render` uses the same.
        lpips: the perceptual distance, or `None`.

    Returns:
        The fields of `csplat_render.metrics.Scores` for all images together.
    """
    judge = photograph_judge(pictures, background)
    each = [judge.score(number, render(camera), lpips=lpips) for number, camera in enumerate(judge.cameras)]
    return Scores.of(each).as_json()


def _look(picture: Picture, background: F32) -> ReferenceImage:
    shown = compose(picture, background, np.empty((picture.camera.H, picture.camera.W, 3), np.float32))
    covered = picture.pixels[..., 3] >= COVERED_ALPHA * 255.0 if picture.has_alpha else None
    return ReferenceImage(shown, covered, counts=picture.mask)


def _count(picture: Picture) -> int:
    """Return the number of pixels that count."""
    return picture.camera.W * picture.camera.H if picture.mask is None else int(picture.mask.sum())
