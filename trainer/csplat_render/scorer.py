# SPDX-License-Identifier: Apache-2.0
"""`Scorer`: compare renders of scenes with reference images, which are renders of a source or images of a data set.

`metrics` defines PSNR.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32, F64, Mask, Progress
from csplat_render import metrics
from csplat_render.camera import Camera, relative_to
from csplat_render.conventions import Mode, Render

#: Called for each view with its index, the reference image and the render, [H, W, 3] in 0..1.
OnView = Callable[[int, F32, F32], None]


class Renderable(Protocol):
    """A scene that renders itself because it is not in memory, or is in the memory of a GPU."""

    @property
    def origin(self) -> tuple[float, float, float]:
        """Origin of the camera coordinates."""
        ...

    def renderer(
        self, background: ArrayLike, *, mode: Mode = "standard", context: Context = DEFAULT_CONTEXT
    ) -> Callable[[Camera], Render]:
        """Return a function that renders the scene, like `renderer` of this module."""
        ...


@dataclass(frozen=True, eq=False)
class ReferenceImage:
    """The reference image of a view.

    Attributes:
        rgb: [H, W, 3] floats.
        covered: [H, W], True for covered pixels, see `metrics`; `None`: unknown.
        ignored: number of splats that are not drawn because they contain NaN or infinity.
        mask: [H, W], True for pixels to compare; `None`: all pixels.
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
        references: the reference image of each view, or a function that returns it on demand.
        background: red, green, blue of the background.
        mode: mode of the renderer.
        context: threads; and progress, which a scene that is not in memory reports during each render.
        origin: origin of the camera coordinates; `None`: the origin of the scored scene.
        pixels: number of pixels to compare in each view; `None`: all pixels.

    Raises:
        InputError: there is no view, or the number of references differs.
    """

    cameras: Sequence[Camera]
    references: Sequence[ReferenceImage | Callable[[], ReferenceImage]]
    background: ArrayLike = (0.0, 0.0, 0.0)
    mode: Mode = "standard"
    context: Context = DEFAULT_CONTEXT
    origin: Sequence[float] | None = None
    pixels: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if not self.cameras:
            raise InputError("a scorer requires at least one camera")
        if len(self.cameras) != len(self.references):
            raise InputError(
                f"found {len(self.cameras)} cameras and {len(self.references)} reference images, expected one for each"
            )

    @classmethod
    def of_source(
        cls,
        source: SplatModel | Renderable,
        cameras: Sequence[Camera],
        background: ArrayLike = (0.0, 0.0, 0.0),
        *,
        mode: Mode = "standard",
        kept_bytes: int = 1 << 30,
        context: Context = DEFAULT_CONTEXT,
    ) -> Scorer:
        """Create a scorer whose references are renders of a source.

        Args:
            source: the scene to compare with.
            cameras: cameras of the views, relative to the source's origin.
            background, mode: see `Scorer`.
            kept_bytes: maximum memory for the source's renders; if it does not suffice, they are rendered again for
                each scored scene.
            context: threads and progress.
        """
        render = renderer(source, background, mode=mode, context=context)
        references: list[ReferenceImage | Callable[[], ReferenceImage]]
        references = [partial(_render_reference, render, camera) for camera in cameras]
        if sum(12 * camera.W * camera.H for camera in cameras) <= kept_bytes:
            references = []
            for camera in cameras:
                context.progress("drawing the source", len(references) / len(cameras))
                references.append(_render_reference(render, camera))
            context.progress("drawing the source", 1.0)
        return cls(cameras, references, background, mode, context, source.origin)

    def every(self, step: int) -> Scorer:
        """Return a scorer on every Nth of the views, which shares their reference images."""
        pixels = None if self.pixels is None else self.pixels[::step]
        return replace(self, cameras=self.cameras[::step], references=self.references[::step], pixels=pixels)

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
        """Return the mean squared error over all pixels from the errors of the views."""
        return metrics.pooled(errors, self.pixels or [camera.W * camera.H for camera in self.cameras])

    def psnr(self, model: SplatModel) -> float:
        """Return the PSNR of the error pooled over views, pixels and channels, dB."""
        return metrics.psnr_of_mse(self.pooled(self.errors(model)))

    def score(
        self, number: int, render: F32, *, ssim: bool = True, lpips: metrics.Distance | None = None
    ) -> metrics.ViewScore:
        """Score a render [H, W, 3] of a view by any renderer."""
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
            model: the scene. Its origin may differ from the origin of the cameras.
            ssim: compute SSIM, which takes about as long as rendering.
            lpips: the LPIPS distance; `None`: it is not computed.
            on_view: called with the images of each view.
            progress: called with the stage and the completed fraction.
        """
        render, scores, ignored = self._renderer(model), [], 0
        for number, camera in enumerate(self.cameras):
            if progress is not None:
                progress("comparing", number / len(self.cameras))
            reference, result = self.reference(number), render(camera)
            ignored = max(ignored, result.ignored)
            scores.append(
                metrics.score_view(
                    reference.rgb, result.rgb, reference.covered, reference.mask, image=camera.image, with_ssim=ssim,
                    lpips=lpips,
                )
            )  # fmt: skip
            if on_view is not None:
                on_view(number, np.clip(reference.rgb, 0.0, 1.0), np.clip(result.rgb, 0.0, 1.0))
        if progress is not None:
            progress("comparing", 1.0)
        return metrics.Scores.of(scores, ignored)

    def _renderer(self, model: SplatModel | Renderable) -> Callable[[Camera], Render]:
        """Return a function that renders a scene for cameras relative to `origin`, or to its own for `None`."""
        render = renderer(model, self.background, mode=self.mode, context=self.context)
        if self.origin is None:
            return render
        shift = np.subtract(model.origin, self.origin)
        return lambda camera: render(relative_to(shift, camera))


def renderer(
    model: SplatModel | Renderable,
    background: ArrayLike,
    *,
    mode: Mode = "standard",
    context: Context = DEFAULT_CONTEXT,
) -> Callable[[Camera], Render]:
    """Return a function that renders a scene for a camera and reuses its memory between calls.

    Args:
        model: the scene. Cameras are relative to its origin.
        background: red, green, blue of the background.
        mode: `exact`, `standard` or `fast`.
        context: threads; and progress, which a scene that is not in memory reports during each render.
    """
    if not isinstance(model, SplatModel):
        return model.renderer(background, mode=mode, context=context)
    # Imported lazily, because code that uses only the classes does not need them.
    from csplat_render.rasteriser import Rasteriser
    from csplat_render.reference_rasteriser import render_exact

    if mode == "exact":
        return lambda camera: render_exact(model, camera, background=background, antialiased=model.metadata.antialiased)
    rasteriser = Rasteriser(mode, context=context)
    return lambda camera: rasteriser.forward(
        model, camera, background=background, antialiased=model.metadata.antialiased
    )


def _render_reference(render: Callable[[Camera], Render], camera: Camera) -> ReferenceImage:
    """Render a view of the source as its reference, with the cover but without a mask."""
    result = render(camera)
    return ReferenceImage(result.rgb, result.alpha >= metrics.COVERED_ALPHA, result.ignored)
