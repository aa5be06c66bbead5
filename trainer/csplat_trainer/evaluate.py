"""How good a scene is on pictures that it was not trained on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat_render.camera import Camera
from csplat_render.lpips import Lpips
from csplat_render.metrics import Scorer
from csplat_trainer.pictures import Picture, compose

__all__ = ["evaluate"]

F32 = NDArray[np.float32]


def evaluate(
    render: Callable[[Camera], F32],
    pictures: Sequence[Picture],
    background: F32,
    lpips: Lpips | None = None,
) -> dict[str, Any]:
    """Compare renders with photographs.

    Args:
        render: makes the picture of a camera, [H, W, 3].
        pictures: at least one.
        background: [3], behind photographs that have an alpha channel; `render` uses the same.
        lpips: weights of the perceptual distance, or `None`.

    Returns:
        The fields of `csplat_render.metrics.Scores`, and `lpips`: the mean over the pictures, or `None`.
    """
    scorer, distances = Scorer(), []
    for picture in pictures:
        photograph = compose(picture, background, np.empty((picture.camera.H, picture.camera.W, 3), np.float32))
        rendered = render(picture.camera)
        alpha = picture.pixels[..., 3] / 255.0 if picture.has_alpha else None
        scorer.add(photograph, rendered, alpha)
        if lpips is not None:
            distances.append(lpips(photograph, rendered))
    return {**scorer.scores().to_json(), "lpips": float(np.mean(distances)) if distances else None}
