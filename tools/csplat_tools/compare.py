"""How much of a scene a smaller one keeps, judged by pictures of both: the one meaning of `psnr`.

Where no cameras are given, they are the eight virtual ones of the source alone (seed 0, 640 by 480, black background).
Pictures are clipped to 0..1 and compared as floats. `psnr` is one number of the squared error pooled over views,
pixels and channels, 99 at most. Distances, background and size are part of it: compare only what agrees in them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera, metrics, render
from csplat_render.virtual import virtual_cameras
from csplat_tools.extras import need_renderer
from csplat_tools.photographs import relative_to

__all__ = ["Comparison", "SourceView", "ViewQuality", "compare_models", "comparison_cameras", "render_source"]

F32 = NDArray[np.float32]
Colour = tuple[float, float, float]
#: A distance of two pictures, [H, W, 3] in 0..1: the source's and the other's.
Distance = Callable[[F32, F32], float]
#: Is shown each view: its number, the source's picture, the other's.
OnView = Callable[[int, F32, F32], None]

BLACK: Colour = (0.0, 0.0, 0.0)
WHITE: Colour = (1.0, 1.0, 1.0)

_VIEWS = 8
_SIZE = (640, 480)
_SEED = 0


@dataclass(frozen=True, eq=False)
class SourceView:
    """A picture of the source, to compare many scenes with.

    Attributes:
        camera: where it was taken.
        picture: [H, W, 3] float32, 0..1.
        covered: [H, W], where the source's alpha is at least one half.
        ignored_count: splats of the source that were not drawn because they hold NaN or infinities.
    """

    camera: Camera
    picture: F32
    covered: NDArray[np.bool_]
    ignored_count: int


@dataclass(frozen=True)
class ViewQuality:
    """One view.

    Attributes:
        image: name of the camera's photograph, if it has one.
        mse: mean squared error over pixels and channels.
        covered_mse: the same over the pixels that the source covers; `None` where it covers none.
        psnr: of this view, dB.
        cover: share of the pixels that the source covers.
        ssim, lpips: of this view; `None` where they were not asked for.
        pixels: of the picture.
    """

    image: str | None
    mse: float
    covered_mse: float | None
    psnr: float
    cover: float
    ssim: float | None
    lpips: float | None
    pixels: int


@dataclass(frozen=True)
class Comparison:
    """What pictures of both scenes say.

    Attributes:
        views: one by one.
        psnr: of the error pooled over views, pixels and channels, dB, 99 at most.
        psnr_mean: mean over the views' own.
        psnr_worst: that of the worst view, whose number is `worst_view`.
        psnr_covered: pooled over the pixels that the source covers; `None` where it covers none.
        ssim, lpips: means over views; `None` where they were not asked for.
        cover: share of the pixels where the source's alpha is at least one half.
        ignored_counts: splats of source and other that were not drawn because they hold NaN or infinities.
        seconds: for everything.
    """

    views: tuple[ViewQuality, ...]
    psnr: float
    psnr_mean: float
    psnr_worst: float
    worst_view: int
    psnr_covered: float | None
    ssim: float | None
    lpips: float | None
    cover: float
    ignored_counts: tuple[int, int]
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {
            "psnr": self.psnr,
            "psnr_mean": self.psnr_mean,
            "psnr_worst": self.psnr_worst,
            "worst_view": self.worst_view,
            "psnr_covered": self.psnr_covered,
            "ssim": self.ssim,
            "lpips": self.lpips,
            "cover": self.cover,
            "ignored": {"a": self.ignored_counts[0], "b": self.ignored_counts[1]},
            "seconds": round(self.seconds, 3),
            "views": [
                {"image": one.image, "psnr": one.psnr, "ssim": one.ssim, "lpips": one.lpips, "cover": one.cover}
                for one in self.views
            ],
        }


def comparison_cameras(source: SplatModel) -> list[Camera]:
    """The cameras of `psnr`: virtual ones, chosen from the source alone."""
    return virtual_cameras(source, _VIEWS, *_SIZE, seed=_SEED)


def render_source(
    source: SplatModel,
    cameras: Sequence[Camera] | None = None,
    *,
    background: Colour = BLACK,
    mode: str = "standard",
) -> Iterator[SourceView]:
    """Render the source, view by view; a list of them serves for comparing many scenes with it.

    Args:
        source: the scene that others are compared with.
        cameras: where to stand; the virtual ones if left out.
        background: red, green, blue, 0..1.
        mode: of the renderer.
    """
    need_renderer()
    for camera in comparison_cameras(source) if cameras is None else cameras:
        result = render(source, camera, background=background, mode=mode)
        yield SourceView(camera, _clipped(result.rgb), result.alpha >= metrics.COVERED_ALPHA, result.ignored)


def compare_models(
    source: SplatModel,
    other: SplatModel,
    cameras: Sequence[Camera] | None = None,
    *,
    source_views: Sequence[SourceView] | None = None,
    background: Colour = BLACK,
    mode: str = "standard",
    ssim: bool = True,
    lpips: Distance | None = None,
    on_view: OnView | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Comparison:
    """Compare pictures of two scenes.

    Args:
        source: the scene that counts as right.
        other: what became of it. Its origin may be another one.
        cameras: where to stand, relative to the source's origin; the virtual ones if left out.
        source_views: what `render_source` made of the source, with this background and mode; instead of `cameras`.
        background: red, green, blue, 0..1.
        mode: of the renderer.
        ssim: whether to compute it; it takes about as long as rendering.
        lpips: computes it, if wanted.
        on_view: is shown the pictures.
        progress: is told how much is done.

    Raises:
        InputError: there is no camera; or the renderer is not installed.
    """
    start = time.perf_counter()
    need_renderer()
    if source_views is None and cameras is None:
        cameras = comparison_cameras(source)
    count = len(source_views if source_views is not None else cameras or ())
    if not count:
        raise InputError("there is no camera to compare from")
    views = iter(source_views or render_source(source, cameras, background=background, mode=mode))
    shift = np.subtract(other.origin, source.origin)
    measured, ignored = [], (0, 0)
    for number, view in enumerate(views):
        if progress is not None:
            progress("comparing", number / count)
        result = render(other, relative_to(shift, view.camera), background=background, mode=mode)
        picture = _clipped(result.rgb)
        measured.append(_measure(view, picture, ssim=ssim, lpips=lpips))
        ignored = (max(ignored[0], view.ignored_count), max(ignored[1], result.ignored))
        if on_view is not None:
            on_view(number, view.picture, picture)
    if progress is not None:
        progress("comparing", 1.0)
    return _pooled(measured, ignored, start)


def _measure(view: SourceView, picture: F32, *, ssim: bool, lpips: Distance | None) -> ViewQuality:
    squares = np.mean(metrics.squared_error(view.picture, picture), axis=2)
    mse = float(np.mean(squares))
    covered = squares[view.covered]
    return ViewQuality(
        image=view.camera.image,
        mse=mse,
        covered_mse=float(np.mean(covered)) if len(covered) else None,
        psnr=metrics.psnr_of_mse(mse),
        cover=len(covered) / squares.size,
        ssim=metrics.ssim(view.picture, picture) if ssim else None,
        lpips=None if lpips is None else lpips(view.picture, picture),
        pixels=squares.size,
    )


def _pooled(views: list[ViewQuality], ignored: tuple[int, int], start: float) -> Comparison:
    pixels = np.array([one.pixels for one in views], np.float64)
    covered = pixels * [one.cover for one in views]
    covered_error = float(np.sum(covered * [one.covered_mse or 0.0 for one in views]))
    worst = int(np.argmin([one.psnr for one in views]))
    return Comparison(
        views=tuple(views),
        psnr=metrics.psnr_of_mse(float(np.sum(pixels * [one.mse for one in views]) / np.sum(pixels))),
        psnr_mean=float(np.mean([one.psnr for one in views])),
        psnr_worst=views[worst].psnr,
        worst_view=worst,
        psnr_covered=metrics.psnr_of_mse(covered_error / float(np.sum(covered))) if covered.any() else None,
        ssim=_mean([one.ssim for one in views]),
        lpips=_mean([one.lpips for one in views]),
        cover=float(np.sum(covered) / np.sum(pixels)),
        ignored_counts=ignored,
        seconds=time.perf_counter() - start,
    )


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _clipped(picture: F32) -> F32:
    return np.clip(picture, 0.0, 1.0)
