# SPDX-License-Identifier: Apache-2.0
"""Similarity of two images: PSNR and SSIM, pooled over views.

Conventions:

* Images are clipped to [0, 1] and compared in float64; the peak is 1.
* `psnr` of several views is the PSNR of the squared error pooled over views, pixels and channels; `psnr_mean` is the
  mean of the views' PSNRs, which papers report. Both are at most 99 dB.
* A pixel is *covered* if the reference's alpha is at least `COVERED_ALPHA`. Some scores include covered pixels only,
  because a plain background of any colour inflates the PSNR of an object, by 3 dB if half of the image is empty.
* SSIM follows INRIA: a Gaussian window of 11×11, σ 1.5, zeros beyond the border, C1 = 0.01², C2 = 0.03², mean over all
  pixels and channels. (Wang's original and scikit-image omit the border.)

Published results for Blender scenes use a white background; photographs have none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat.errors import InputError
from csplat.types import F32, F64, PSNR_CAP
from csplat_render.metric_kernels import mean_ssim

#: Minimum alpha of a covered pixel.
COVERED_ALPHA = 0.5


#: A function that returns the distance between a reference and a render, [H, W, 3] in 0..1.
Distance = Callable[[F32, F32], float]


@dataclass(frozen=True)
class ViewScore:
    """The similarity of two images of a view.

    Attributes:
        image: name of the view's image file; `None`: there is none.
        pixels: number of compared pixels.
        mse: mean squared error over pixels and channels.
        psnr: PSNR, dB.
        covered_mse: mean squared error over covered pixels; `None` if cover is unknown or 0.
        cover: fraction of covered pixels; `None` if unknown.
        ssim, lpips: `None` if not requested.
    """

    image: str | None
    pixels: int
    mse: float
    psnr: float
    covered_mse: float | None = None
    cover: float | None = None
    ssim: float | None = None
    lpips: float | None = None


@dataclass(frozen=True)
class Scores:
    """The similarity of two sets of images.

    Attributes:
        each: scores of each view.
        psnr: dB, of the error pooled over all views.
        psnr_mean: dB, mean over views.
        psnr_worst: dB, minimum over views.
        worst_view: index of that view, from 0.
        worst_image: name of its image file; `None`: it has none.
        ssim, lpips: means over views; `None` if not requested.
        psnr_covered: dB, pooled over covered pixels; `None` if cover is unknown or 0.
        cover: fraction of covered pixels over all views; `None` if unknown.
        ignored: number of splats that were not drawn because they contain NaN or infinity.
    """

    each: tuple[ViewScore, ...]
    psnr: float
    psnr_mean: float
    psnr_worst: float
    worst_view: int
    worst_image: str | None
    ssim: float | None
    lpips: float | None
    psnr_covered: float | None
    cover: float | None
    ignored: int = 0

    @classmethod
    def of(cls, each: Sequence[ViewScore], ignored: int = 0) -> Scores:
        """Pool the scores of views.

        Raises:
            InputError: there are no views.
        """
        if not each:
            raise InputError("found no images to compare")
        pixels = [view.pixels for view in each]
        covers = [view.cover for view in each if view.cover is not None]
        known = len(covers) == len(each)
        covered = [share * count for share, count in zip(covers, pixels, strict=True)] if known else []
        missed = math.fsum(count * (view.covered_mse or 0.0) for count, view in zip(covered, each, strict=known))
        worst = min(range(len(each)), key=lambda number: each[number].psnr)
        return cls(
            each=tuple(each),
            psnr=psnr_of_mse(pooled([view.mse for view in each], pixels)),
            psnr_mean=math.fsum(view.psnr for view in each) / len(each),
            psnr_worst=each[worst].psnr,
            worst_view=worst,
            worst_image=each[worst].image,
            ssim=_mean_of_known([view.ssim for view in each]),
            lpips=_mean_of_known([view.lpips for view in each]),
            psnr_covered=psnr_of_mse(missed / math.fsum(covered)) if any(covered) else None,
            cover=math.fsum(covered) / sum(pixels) if known else None,
            ignored=ignored,
        )

    def as_json(self) -> dict[str, Any]:
        """Return the pooled scores and the number of views, JSON-compatible."""
        names = [one.name for one in fields(self) if one.name not in ("each", "ignored")]
        return {"views": len(self.each), **{name: getattr(self, name) for name in names}}


def score_view(
    reference: NDArray[Any],
    render: NDArray[Any],
    covered: NDArray[np.bool_] | None = None,
    mask: NDArray[np.bool_] | None = None,
    *,
    image: str | None = None,
    with_ssim: bool = True,
    lpips: Distance | None = None,
) -> ViewScore:
    """Compare a render with the reference image of its view.

    Args:
        reference, render: [H, W, 3], floating.
        covered: [H, W], True for covered pixels of the reference; `None`: unknown.
        mask: [H, W], True for pixels to compare, at least one; elsewhere, SSIM and LPIPS use the render as reference.
            `None`: compare all pixels.
        image: name of the view's image file.
        with_ssim: compute SSIM, which takes about as long as rendering.
        lpips: the LPIPS distance; `None`: it is not computed.

    Raises:
        InputError: the images cannot be compared.
    """
    pair = _clipped_pair(reference, render)
    squares = _squared_difference(*pair)
    for name, pixels in (("cover", covered), ("mask", mask)):
        if pixels is not None and pixels.shape != squares.shape[:2]:
            raise InputError(f"the {name} has shape {list(pixels.shape)}, expected {list(squares.shape[:2])}")
    if mask is not None:
        reference, squares = np.where(mask[..., None], reference, render), squares[mask]
        np.copyto(*pair, where=~mask[..., None])
        covered = None if covered is None else covered[mask]
    mse = float(np.mean(squares))
    inside = None if covered is None else squares[covered]
    return ViewScore(
        image=image,
        pixels=squares.size // 3,
        mse=mse,
        psnr=psnr_of_mse(mse),
        covered_mse=float(np.mean(inside)) if inside is not None and len(inside) else None,
        cover=None if covered is None else float(np.mean(covered)),
        ssim=mean_ssim(*pair) if with_ssim else None,
        lpips=None if lpips is None else lpips(np.clip(reference, 0.0, 1.0), np.clip(render, 0.0, 1.0)),
    )


def pooled(errors: ArrayLike, pixels: Sequence[int]) -> float:
    """Return the mean squared error over all pixels.

    Args:
        errors: [V], mean squared errors of the views.
        pixels: [V], numbers of pixels of the views.
    """
    counts = np.asarray(pixels, np.float64)
    return float(np.sum(np.asarray(errors, np.float64) * counts) / np.sum(counts))


def squared_error(reference: NDArray[Any], image: NDArray[Any]) -> F64:
    """Return the squared difference of two images, [H, W, 3] float64, both clipped to [0, 1]."""
    return _squared_difference(*_clipped_pair(reference, image))


def psnr_of_mse(mean_squared_error: float) -> float:
    """Return the PSNR of a mean squared error, −10 log10(MSE) dB, at most `PSNR_CAP`."""
    if mean_squared_error <= 0.0:
        return PSNR_CAP
    return min(PSNR_CAP, -10.0 * math.log10(mean_squared_error))


def psnr(reference: NDArray[Any], image: NDArray[Any]) -> float:
    """Return the PSNR of two images, [H, W, 3] each, dB."""
    return psnr_of_mse(float(np.mean(squared_error(reference, image))))


def ssim(reference: NDArray[Any], image: NDArray[Any]) -> float:
    """Return the SSIM of two images, [H, W, 3] each; 1 if they are equal."""
    return mean_ssim(*_clipped_pair(reference, image))


def _mean_of_known(values: Sequence[float | None]) -> float | None:
    """Return the mean of the known values; `None` if there are none."""
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def _clipped_pair(reference: NDArray[Any], image: NDArray[Any]) -> tuple[F64, F64]:
    """Return two images as [H, W, 3] float64, C-contiguous, clipped to 0..1; infinities become 0 or 1.

    Raises:
        InputError: an image is not [H, W, 3] or has no pixels, is not of floats or contains NaN, or the shapes differ.
    """
    for name, array in (("reference", reference), ("image", image)):
        if array.ndim != 3 or array.shape[2] != 3 or array.size == 0:
            raise InputError(f"the {name} has shape {list(array.shape)}, expected [H, W, 3]")
        if array.dtype.kind != "f":
            raise InputError(f"the {name} is {array.dtype}, expected floating values in 0 to 1")
    if reference.shape != image.shape:
        raise InputError(f"images of shapes {list(reference.shape)} and {list(image.shape)} cannot be compared")
    a, b = (np.array(array, np.float64, order="C") for array in (reference, image))
    for array in (a, b):
        np.clip(array, 0.0, 1.0, out=array)
        if math.isnan(array.min()):
            raise InputError("an image contains NaN")
    return a, b


def _squared_difference(a: F64, b: F64) -> F64:
    """Return (a − b)², of the same shape."""
    difference = a - b
    return np.square(difference, out=difference)
