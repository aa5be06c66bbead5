"""How good a simplified scene is: against the source's renders, or against photographs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.metrics import psnr_of_mse
from csplat_render.rasterise import Rasteriser

__all__ = ["Judge", "loss_as_psnr", "render_pictures"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


def render_pictures(
    model: SplatModel,
    cameras: Sequence[Camera],
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    threads: int | None = None,
) -> list[F32]:
    """Render a scene, [H, W, 3] float32 per camera, not clipped."""
    rasteriser = Rasteriser(gradients=False, threads=threads)
    return [
        rasteriser.forward(model, camera, background=background, antialiased=model.antialiased).rgb
        for camera in cameras
    ]


@dataclass(frozen=True, eq=False)
class Judge:
    """Views and what they ought to look like.

    Attributes:
        cameras: the views.
        wanted: [H, W, 3] each: the source's renders, or photographs.
        background: red, green, blue behind everything.
        threads: of the renderer.
    """

    cameras: Sequence[Camera]
    wanted: Sequence[F32]
    background: ArrayLike = (0.0, 0.0, 0.0)
    threads: int | None = None

    @classmethod
    def of_source(
        cls, source: SplatModel, cameras: Sequence[Camera], background: ArrayLike, threads: int | None = None
    ) -> Judge:
        """Judge by what the source looks like."""
        wanted = render_pictures(source, cameras, background=background, threads=threads)
        return cls(cameras, wanted, background, threads)

    def psnr(self, model: SplatModel) -> float:
        """PSNR of the error pooled over views, pixels and channels, pictures clipped to 0..1; 99 dB at most."""
        return psnr_of_mse(self.pooled(self.view_errors(model)))

    def view_errors(self, model: SplatModel) -> F64:
        """[V] mean squared error by view, pictures clipped to 0..1."""
        errors = np.zeros(len(self.cameras))
        rasteriser = Rasteriser(gradients=False, threads=self.threads)
        for number, (camera, wanted) in enumerate(zip(self.cameras, self.wanted, strict=True)):
            picture = rasteriser.forward(model, camera, background=self.background, antialiased=model.antialiased).rgb
            difference = np.clip(picture, 0.0, 1.0) - np.clip(wanted, 0.0, 1.0)
            errors[number] = np.sum(np.square(difference), dtype=np.float64) / difference.size
        return errors

    def pooled(self, errors: F64) -> float:
        """The mean squared error over all pixels, of those by view."""
        pixels = np.array([picture.size for picture in self.wanted], np.float64)
        return float(np.sum(errors * pixels) / np.sum(pixels))

    def some(self, views: Sequence[int]) -> Judge:
        """A judge by some of the views."""
        return replace(self, cameras=[self.cameras[i] for i in views], wanted=[self.wanted[i] for i in views])


def loss_as_psnr(loss: float, photo_psnr: float) -> float:
    """The PSNR against the source's renders at which photographs are missed by so much more.

    The source misses photographs by an error of its own; what simplification adds is taken as independent of it, so
    that the two squared errors add up.

    Args:
        loss: dB, above 0.
        photo_psnr: of the source against photographs, dB.

    Raises:
        InputError: the loss is not above 0.
    """
    if not loss > 0.0:
        raise InputError(f"a loss of {loss:g} dB, wanted above 0")
    return photo_psnr - 10.0 * math.log10(10.0 ** (loss / 10.0) - 1.0)
