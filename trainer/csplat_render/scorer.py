"""`Scorer`: the only scorer of renders, against a source's renders or against photographs.

A `Scorer` holds views and the reference image of each. The definition of PSNR is in `metrics`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32, F64
from csplat_render import metrics
from csplat_render.camera import Camera, relative_to
from csplat_render.conventions import Mode, RenderResult

#: Called for each view with its number, the reference image and the render, [H, W, 3] in 0..1.
OnView = Callable[[int, F32, F32], None]


class Renderable(Protocol):
    """A scene that draws itself, because it is not in memory."""

    @property
    def origin(self) -> tuple[float, float, float]:
        """The point that cameras are relative to."""
        ...

    def renderer(
        self, background: ArrayLike, *, mode: Mode = "standard", threads: int | None = None
    ) -> Callable[[Camera], RenderResult]:
        """As `renderer` of this module."""
        ...


@dataclass(frozen=True, eq=False)
class ReferenceImage:
    """The reference image of a view.

    Attributes:
        picture: [H, W, 3] floats.
        covered: [H, W], True for pixels that show more than the background; `None`: not known.
        ignored: splats that it does not show because they hold NaN or infinities.
        counts: [H, W], True for pixels that count; `None`: all of them.
    """

    picture: F32
    covered: NDArray[np.bool_] | None = None
    ignored: int = 0
    counts: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class Scorer:
    """Views and their reference images.

    Attributes:
        cameras: the views, at least one.
        looks: the reference image of each view, or a function that makes it on demand.
        background: red, green, blue behind everything.
        mode: mode of the renderer.
        threads: number of threads; `None` for all. No score depends on it.
        origin: point that the cameras are relative to; `None`: the origin of the scene that is scored.
        pixels: number of pixels that count in each view; `None`: all of them.

    Raises:
        InputError: there is no view, or not one look for each.
    """

    cameras: Sequence[Camera]
    looks: Sequence[ReferenceImage | Callable[[], ReferenceImage]]
    background: ArrayLike = (0.0, 0.0, 0.0)
    mode: Mode = "standard"
    threads: int | None = None
    origin: Sequence[float] | None = None
    pixels: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if not self.cameras:
            raise InputError("there is no camera to judge from")
        if len(self.cameras) != len(self.looks):
            raise InputError(f"{len(self.cameras)} cameras and {len(self.looks)} pictures do not belong together")

    @classmethod
    def of_source(
        cls,
        source: SplatModel | Renderable,
        cameras: Sequence[Camera],
        background: ArrayLike = (0.0, 0.0, 0.0),
        *,
        mode: Mode = "standard",
        threads: int | None = None,
        kept_bytes: int = 1 << 30,
        progress: Callable[[str, float], None] | None = None,
    ) -> Scorer:
        """Score against renders of the source.

        Args:
            source: the scene that others are compared with.
            cameras: cameras of the views, relative to the source's origin.
            background, mode, threads: see above.
            kept_bytes: limit on the size of the source's renders; larger ones are rendered again for each scene.
            progress: called with the fraction that is drawn.
        """
        draw = renderer(source, background, mode=mode, threads=threads)
        looks: list[ReferenceImage | Callable[[], ReferenceImage]] = [
            partial(_rendered, draw, camera) for camera in cameras
        ]
        if sum(12 * camera.W * camera.H for camera in cameras) <= kept_bytes:
            looks = []
            for camera in cameras:
                if progress is not None:
                    progress("drawing the source", len(looks) / len(cameras))
                looks.append(_rendered(draw, camera))
            if progress is not None:
                progress("drawing the source", 1.0)
        return cls(cameras, looks, background, mode, threads, source.origin)

    def look(self, number: int) -> ReferenceImage:
        """Return the reference image of a view."""
        look = self.looks[number]
        return look if isinstance(look, ReferenceImage) else look()

    def errors(self, model: SplatModel) -> F64:
        """[V] mean squared error by view."""
        draw, errors = self._renderer(model), np.empty(len(self.cameras), np.float64)
        for number, camera in enumerate(self.cameras):
            look = self.look(number)
            squares = metrics.squared_error(look.picture, draw(camera).rgb)
            errors[number] = np.mean(squares if look.counts is None else squares[look.counts])
        return errors

    def pooled(self, errors: F64) -> float:
        """The mean squared error over all pixels, of those by view."""
        return metrics.pooled(errors, self.pixels or [camera.W * camera.H for camera in self.cameras])

    def psnr(self, model: SplatModel) -> float:
        """PSNR of the error pooled over views, pixels and channels, dB."""
        return metrics.psnr_of_mse(self.pooled(self.errors(model)))

    def some(self, places: Sequence[int]) -> Scorer:
        """Return a judge for some of the views."""
        pixels = None if self.pixels is None else [self.pixels[i] for i in places]
        cameras, looks = [self.cameras[i] for i in places], [self.looks[i] for i in places]
        return replace(self, cameras=cameras, looks=looks, pixels=pixels)

    def score(
        self, number: int, seen: F32, *, ssim: bool = True, lpips: metrics.Distance | None = None
    ) -> metrics.ViewScore:
        """Score a render of a view, [H, W, 3], from any renderer."""
        look = self.look(number)
        image = self.cameras[number].image
        return metrics.score_view(
            look.picture, seen, look.covered, look.counts, image=image, with_ssim=ssim, lpips=lpips
        )

    def scores(
        self,
        model: SplatModel | Renderable,
        *,
        ssim: bool = True,
        lpips: metrics.Distance | None = None,
        on_view: OnView | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> metrics.Scores:
        """Score a scene in everything.

        Args:
            model: the scene. Its origin may be another one than that of the cameras.
            ssim: compute SSIM; it takes about as long as rendering.
            lpips: the LPIPS distance, if it is needed.
            on_view: called with the images of each view.
            progress: called with the fraction done.
        """
        draw, each, ignored = self._renderer(model), [], 0
        for number, camera in enumerate(self.cameras):
            if progress is not None:
                progress("comparing", number / len(self.cameras))
            look, result = self.look(number), draw(camera)
            ignored = max(ignored, result.ignored)
            one = metrics.score_view(
                look.picture, result.rgb, look.covered, look.counts, image=camera.image, with_ssim=ssim, lpips=lpips
            )
            each.append(one)
            if on_view is not None:
                on_view(number, np.clip(look.picture, 0.0, 1.0), np.clip(result.rgb, 0.0, 1.0))
        if progress is not None:
            progress("comparing", 1.0)
        return metrics.Scores.of(each, ignored)

    def _renderer(self, model: SplatModel | Renderable) -> Callable[[Camera], RenderResult]:
        draw = renderer(model, self.background, mode=self.mode, threads=self.threads)
        if self.origin is None:
            return draw
        shift = np.subtract(model.origin, self.origin)
        return lambda camera: draw(relative_to(shift, camera))


def renderer(
    model: SplatModel | Renderable, background: ArrayLike, *, mode: Mode = "standard", threads: int | None = None
) -> Callable[[Camera], RenderResult]:
    """Return a function that draws a scene from camera after camera, and keeps its memory in between.

    Args:
        model: the scene. The cameras are relative to its origin.
        background: red, green, blue behind everything.
        mode: `exact`, `standard` or `fast`.
        threads: number of threads; `None` for all.
    """
    if not isinstance(model, SplatModel):
        return model.renderer(background, mode=mode, threads=threads)
    # numba takes a second to import: code that needs only the classes does not wait for it.
    from csplat_render.rasteriser import Rasteriser
    from csplat_render.reference_rasteriser import render_exact

    if mode == "exact":
        return lambda camera: render_exact(model, camera, background=background, antialiased=model.antialiased)
    rasteriser = Rasteriser(mode, gradients=False, threads=threads)
    return lambda camera: rasteriser.forward(model, camera, background=background, antialiased=model.antialiased)


def _rendered(draw: Callable[[Camera], RenderResult], camera: Camera) -> ReferenceImage:
    result = draw(camera)
    return ReferenceImage(result.rgb, result.alpha >= metrics.COVERED_ALPHA, result.ignored)
