"""Scores of a scene on fixed views, one number for each view, so that tables can say how far views differ."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.metrics import psnr_of_mse, squared_error, ssim
from csplat_render.rasterise import Rasteriser

__all__ = ["Views", "renders_at"]

F32 = NDArray[np.float32]
Distance = Callable[[F32, F32], float]


@dataclass(frozen=True, eq=False)
class Views:
    """Cameras and what is to be seen there.

    Attributes:
        cameras: relative to the scene's origin.
        wanted: [H, W, 3] float32 in 0..1: photographs, or renders of a source.
        background: red, green, blue behind everything.
        lpips: measures the perceptual distance; None: it is left out.
    """

    cameras: Sequence[Camera]
    wanted: Sequence[F32]
    background: tuple[float, float, float]
    lpips: Distance | None = None

    def score(self, model: SplatModel, *, quick: bool = False) -> dict[str, Any]:
        """Mean and standard deviation over views (of these views: divided by their number) of each figure.

        Args:
            model: what is judged.
            quick: PSNR alone.

        Returns:
            psnr: pooled over views, dB; psnr_mean, psnr_std, ssim, ssim_std, lpips, lpips_std; None where not measured.
        """
        rasteriser = Rasteriser(gradients=False)
        errors, alike, distances = list[float](), list[float](), list[float]()
        for camera, wanted in zip(self.cameras, self.wanted, strict=True):
            drawn = rasteriser.forward(model, camera, background=self.background, antialiased=model.antialiased).rgb
            picture = np.clip(drawn, 0.0, 1.0)
            errors.append(float(np.mean(squared_error(wanted, picture))))
            if not quick:
                alike.append(ssim(wanted, picture))
                if self.lpips is not None:
                    distances.append(self.lpips(wanted, picture))
        mean, std = _spread([psnr_of_mse(error) for error in errors])
        scores = {"views": len(errors), "psnr": psnr_of_mse(math.fsum(errors) / len(errors))}
        scores |= {"psnr_mean": mean, "psnr_std": std}
        for name, values in (("ssim", alike), ("lpips", distances)):
            scores[name], scores[f"{name}_std"] = _spread(values) if values else (None, None)
        return scores


def renders_at(
    model: SplatModel, cameras: Sequence[Camera], background: tuple[float, float, float], lpips: Distance | None
) -> Views:
    """Views of a scene itself: whoever is judged by them is compared with it."""
    rasteriser = Rasteriser(gradients=False)
    wanted = [
        np.clip(rasteriser.forward(model, one, background=background, antialiased=model.antialiased).rgb, 0.0, 1.0)
        for one in cameras
    ]
    return Views(cameras, wanted, background, lpips)


def _spread(values: Sequence[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values))
