"""Scores of a scene on fixed views, one number for each view, so that tables can say how far views differ."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from csplat.model import SplatModel
from csplat.types import F32
from csplat_bench.study.records import Scored
from csplat_render import Camera
from csplat_render.metrics import psnr_of_mse, squared_error, ssim
from csplat_render.scorer import renderer

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

    def score(self, model: SplatModel, *, quick: bool = False) -> Scored:
        """Mean and standard deviation over views (of these views: divided by their number) of each figure.

        Args:
            model: the model to judge.
            quick: PSNR alone.
        """
        errors, alike, distances = list[float](), list[float](), list[float]()
        for picture, wanted in zip(_pictures(model, self.cameras, self.background), self.wanted, strict=True):
            errors.append(float(np.mean(squared_error(wanted, picture))))
            if not quick:
                alike.append(ssim(wanted, picture))
                if self.lpips is not None:
                    distances.append(self.lpips(wanted, picture))
        mean, std = _spread([psnr_of_mse(error) for error in errors])
        (alike_mean, alike_std), (distance, distance_std) = _spread(alike), _spread(distances)
        assert mean is not None
        assert std is not None
        return {
            "views": len(errors),
            "psnr": psnr_of_mse(math.fsum(errors) / len(errors)),
            "psnr_mean": mean,
            "psnr_std": std,
            "ssim": alike_mean,
            "ssim_std": alike_std,
            "lpips": distance,
            "lpips_std": distance_std,
        }


def renders_at(
    model: SplatModel, cameras: Sequence[Camera], background: tuple[float, float, float], lpips: Distance | None
) -> Views:
    """Views of a scene itself: whoever is judged by them is compared with it."""
    return Views(cameras, list(_pictures(model, cameras, background)), background, lpips)


def _pictures(model: SplatModel, cameras: Sequence[Camera], background: tuple[float, float, float]) -> Iterator[F32]:
    draw = renderer(model, background)
    return (np.clip(draw(camera).rgb, 0.0, 1.0) for camera in cameras)


def _spread(values: Sequence[float]) -> tuple[float | None, float | None]:
    return (float(np.mean(values)), float(np.std(values))) if values else (None, None)
