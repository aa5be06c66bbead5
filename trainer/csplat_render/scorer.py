"""`Scorer`: scores of scenes against reference images, which are renders of a source or images of a data set.

The definition of PSNR is in `metrics`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32, F64, Mask, Progress
from csplat_render import metrics
from csplat_render.camera import Camera, relative_to
from csplat_render.conventions import Mode, RenderResult

#: Called for each view with its number, the reference image and the render, [H, W, 3] in 0..1.
OnView = Callable[[int, F32, F32], None]


class Renderable(Protocol):
    """A scene that renders itself, because it is not in memory."""

    @property
    def origin(self) -> tuple[float, float, float]:
        """The point that cameras are relative to."""
        ...

    def renderer(
        self, background: ArrayLike, *, mode: Mode = "standard", threads: int | None = None
    ) -> Callable[[Camera], RenderResult]:
        """Return a function that renders, like `renderer` of this module."""
        ...


@dataclass(frozen=True, eq=False)
class ReferenceImage:
    """The reference image of a view.

    Attributes:
        rgb: [H, W, 3] floats.
        covered: [H, W], True for pixels that show more than the background; `None`: not known.
        ignored: number of splats that are not drawn because they hold NaN or infinities.
        mask: [H, W], True for pixels that count; `None`: all of them.
    """

    rgb: F32
    covered: Mask | None = None
    ignored: int = 0
    mask: Mask | None = None


@dataclass(frozen=True, eq=False)
class Scorer:
    """Views and their reference images.

    Attributes:
        cameras: the views, at least one.
        references: the reference image of each view, or a function that makes it on demand.
        background: red, green, blue behind everything.
        mode: mode of the renderer.
        threads: number of threads; `None` for all. No score depends on it.
        origin: point that the cameras are relative to; `None`: the origin of the scene that is scored.
        pixels: number of pixels that count in each view; `None`: all of them.

    Raises:
        InputError: there is no view, or not one reference for each.
    """

    cameras: Sequence[Camera]
    references: Sequence[ReferenceImage | Callable[[], ReferenceImage]]
    background: ArrayLike = (0.0, 0.0, 0.0)
    mode: Mode = "standard"
    threads: int | None = None
    origin: Sequence[float] | None = None
    pixels: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if not self.cameras:
            raise InputError("there is no camera to judge from")
        if len(self.cameras) != len(self.references):
            raise InputError(f"{len(self.cameras)} cameras and {len(self.references)} pictures do not belong together")

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
        progress: Progress | None = None,
    ) -> Scorer:
        """Make a scorer whose references are renders of a source.

        Args:
            source: the scene that others are compared with.
            cameras: cameras of the views, relative to the source's origin.
            background, mode, threads: see above.
            kept_bytes: limit on the size of the source's renders; if they are larger, they are rendered again for
                each scene.
            progress: called with the fraction that is rendered.
        """
        render = renderer(source, background, mode=mode, threads=threads)
        references: list[ReferenceImage | Callable[[], ReferenceImage]]
        references = [partial(_render_reference, render, camera) for camera in cameras]
        if sum(12 * camera.W * camera.H for camera in cameras) <= kept_bytes:
            references = []
            for camera in cameras:
                if progress is not None:
                    progress("drawing the source", len(references) / len(cameras))
                references.append(_render_reference(render, camera))
            if progress is not None:
                progress("drawing the source", 1.0)
        return cls(cameras, references, background, mode, threads, source.origin)

    def reference(self, number: int) -> ReferenceImage:
        """Return the reference image of a view."""
        reference = self.references[number]
        return reference if isinstance(reference, ReferenceImage) else reference()

    def errors(self, model: SplatModel) -> F64:
        """Return the mean squared error of each view, [V]."""
        render, errors = self._renderer(model), np.empty(len(self.cameras), np.float64)
        for number, camera in enumerate(self.cameras):
            reference = self.reference(number)
            squares = metrics.squared_error(reference.rgb, render(camera).rgb)
            errors[number] = np.mean(squares if reference.mask is None else squares[reference.mask])
        return errors

    def pooled(self, errors: F64) -> float:
        """Return the mean squared error over all pixels, given those of the views."""
        return metrics.pooled(errors, self.pixels or [camera.W * camera.H for camera in self.cameras])

    def psnr(self, model: SplatModel) -> float:
        """Return the PSNR of the error pooled over views, pixels and channels, dB."""
        return metrics.psnr_of_mse(self.pooled(self.errors(model)))

    def subset(self, numbers: Sequence[int]) -> Scorer:
        """Return a scorer of some of the views."""
        pixels = None if self.pixels is None else [self.pixels[i] for i in numbers]
        cameras, references = [self.cameras[i] for i in numbers], [self.references[i] for i in numbers]
        return replace(self, cameras=cameras, references=references, pixels=pixels)

    def score(
        self, number: int, render: F32, *, ssim: bool = True, lpips: metrics.Distance | None = None
    ) -> metrics.ViewScore:
        """Score a render of a view, [H, W, 3], from any renderer."""
        reference, image = self.reference(number), self.cameras[number].image
        return metrics.score_view(
            reference.rgb, render, reference.covered, reference.mask, image=image, with_ssim=ssim, lpips=lpips
        )

    def scores(
        self,
        model: SplatModel | Renderable,
        *,
        ssim: bool = True,
        lpips: metrics.Distance | None = None,
        on_view: OnView | None = None,
        progress: Progress | None = None,
    ) -> metrics.Scores:
        """Score a scene by all metrics.

        Args:
            model: the scene. Its origin may differ from that of the cameras.
            ssim: compute SSIM; it takes about as long as rendering.
            lpips: the LPIPS distance, if it is needed.
            on_view: called with the images of each view.
            progress: called with the fraction done.
        """
        render, each, ignored = self._renderer(model), [], 0
        for number, camera in enumerate(self.cameras):
            if progress is not None:
                progress("comparing", number / len(self.cameras))
            reference, result = self.reference(number), render(camera)
            ignored = max(ignored, result.ignored)
            each.append(
                metrics.score_view(
                    reference.rgb, result.rgb, reference.covered, reference.mask, image=camera.image, with_ssim=ssim,
                    lpips=lpips,
                )
            )  # fmt: skip
            if on_view is not None:
                on_view(number, np.clip(reference.rgb, 0.0, 1.0), np.clip(result.rgb, 0.0, 1.0))
        if progress is not None:
            progress("comparing", 1.0)
        return metrics.Scores.of(each, ignored)

    def _renderer(self, model: SplatModel | Renderable) -> Callable[[Camera], RenderResult]:
        render = renderer(model, self.background, mode=self.mode, threads=self.threads)
        if self.origin is None:
            return render
        shift = np.subtract(model.origin, self.origin)
        return lambda camera: render(relative_to(shift, camera))


def renderer(
    model: SplatModel | Renderable, background: ArrayLike, *, mode: Mode = "standard", threads: int | None = None
) -> Callable[[Camera], RenderResult]:
    """Return a function that renders a scene from camera after camera, and keeps its memory in between.

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


def _render_reference(render: Callable[[Camera], RenderResult], camera: Camera) -> ReferenceImage:
    result = render(camera)
    return ReferenceImage(result.rgb, result.alpha >= metrics.COVERED_ALPHA, result.ignored)
