"""How alike two pictures are: PSNR, SSIM, pooled over views.

Conventions, which a number means nothing without:

* Pictures are clipped to [0, 1] and compared in float64; the peak is 1.
* `psnr` of several views is one PSNR of the squared error pooled over views, pixels and channels;
  `psnr_mean` is the mean of the views' PSNRs, which is what papers print. Both end at 99 dB.
* Over *covered* pixels only counts where the reference's alpha is at least `COVERED_ALPHA`: a plain
  background that both pictures share inflates the PSNR of an object, a white one no less than a
  black one, by 3 dB where half of the picture is empty.
* SSIM is INRIA's: a Gaussian window of 11×11, σ 1.5, zeros beyond the border, C1 = 0.01²,
  C2 = 0.03², mean over all pixels and channels. (Wang's original leaves the border out; scikit-image
  does so too.)

Published tables of Blender scenes are made on a white background, those of photographs have none.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError

__all__ = ["COVERED_ALPHA", "PSNR_CAP", "Scorer", "Scores", "psnr", "psnr_of_mse", "squared_error", "ssim"]

F64 = NDArray[np.float64]

#: Decibels that stand for "no difference".
PSNR_CAP = 99.0

#: A pixel counts as covered from this alpha on.
COVERED_ALPHA = 0.5


@dataclass(frozen=True)
class Scores:
    """How alike two sets of pictures are.

    Attributes:
        views: how many pairs.
        psnr: dB, of the error pooled over all views.
        psnr_mean: dB, mean of the views'.
        psnr_worst: dB, the lowest of the views'.
        worst_view: which one that was, from 0.
        ssim: mean of the views'.
        psnr_covered: dB, pooled over covered pixels only; `None` where cover is not known or 0.
        cover: share of the pixels that are covered, over all views; `None` where not known.
    """

    views: int
    psnr: float
    psnr_mean: float
    psnr_worst: float
    worst_view: int
    ssim: float
    psnr_covered: float | None = None
    cover: float | None = None

    def to_json(self) -> dict[str, Any]:
        """The scores as a JSON object."""
        return asdict(self)


class Scorer:
    """Collects pairs of pictures, one view after the other, and scores them all."""

    def __init__(self) -> None:
        self._errors: list[float] = []  # sums of squares
        self._counts: list[int] = []  # values, three for a pixel
        self._ssims: list[float] = []
        self._covered_error = 0.0
        self._covered_count = 0
        self._cover_known = True

    def add(self, reference: NDArray[Any], image: NDArray[Any], alpha: NDArray[Any] | None = None) -> float:
        """Add a view.

        Args:
            reference: [H, W, 3], floating.
            image: [H, W, 3], floating.
            alpha: [H, W], of the reference; `None`: not known.

        Returns:
            This view's PSNR, dB.
        """
        error = squared_error(reference, image)
        self._errors.append(float(np.sum(error)))
        self._counts.append(error.size)
        self._ssims.append(ssim(reference, image))
        if alpha is None:
            self._cover_known = False
        else:
            if alpha.shape != error.shape[:2]:
                raise InputError(f"alpha has shape {list(alpha.shape)}, wanted {list(error.shape[:2])}")
            covered = alpha >= COVERED_ALPHA
            self._covered_error += float(np.sum(error[covered]))
            self._covered_count += 3 * int(np.count_nonzero(covered))
        return psnr_of_mse(self._errors[-1] / self._counts[-1])

    def scores(self) -> Scores:
        """Score everything added so far.

        Raises:
            InputError: nothing was.
        """
        if not self._errors:
            raise InputError("no pictures to compare")
        each = [psnr_of_mse(error / count) for error, count in zip(self._errors, self._counts, strict=True)]
        known = self._cover_known
        return Scores(
            views=len(each),
            psnr=psnr_of_mse(math.fsum(self._errors) / sum(self._counts)),
            psnr_mean=math.fsum(each) / len(each),
            psnr_worst=min(each),
            worst_view=int(np.argmin(each)),
            ssim=math.fsum(self._ssims) / len(each),
            psnr_covered=psnr_of_mse(self._covered_error / self._covered_count)
            if known and self._covered_count
            else None,
            cover=self._covered_count / sum(self._counts) if known else None,
        )


def squared_error(reference: NDArray[Any], image: NDArray[Any]) -> F64:
    """Squared difference of two pictures, [H, W, 3] float64, both clipped to [0, 1]."""
    a, b = _clipped(reference, image)
    result: F64 = (a - b) ** 2
    return result


def psnr_of_mse(mean_squared_error: float) -> float:
    """Decibels of a mean squared error, `PSNR_CAP` at most."""
    if mean_squared_error <= 0.0:
        return PSNR_CAP
    return min(PSNR_CAP, -10.0 * math.log10(mean_squared_error))


def psnr(reference: NDArray[Any], image: NDArray[Any]) -> float:
    """PSNR of one pair of pictures, [H, W, 3] each, dB."""
    return psnr_of_mse(float(np.mean(squared_error(reference, image))))


def ssim(reference: NDArray[Any], image: NDArray[Any]) -> float:
    """SSIM of one pair of pictures, [H, W, 3] each; 1 where they are the same."""
    from csplat_render.similarity import mean_ssim  # numba takes a second to import

    return mean_ssim(*_clipped(reference, image))


def _clipped(reference: NDArray[Any], image: NDArray[Any]) -> tuple[F64, F64]:
    for name, picture in (("reference", reference), ("image", image)):
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.size == 0:
            raise InputError(f"the {name} has shape {list(picture.shape)}, wanted [H, W, 3]")
        if picture.dtype.kind != "f":
            raise InputError(f"the {name} is {picture.dtype}, wanted floating values in 0 to 1")
    if reference.shape != image.shape:
        raise InputError(f"pictures of sizes {list(reference.shape)} and {list(image.shape)} cannot be compared")
    a = np.clip(np.ascontiguousarray(reference, np.float64), 0.0, 1.0)
    b = np.clip(np.ascontiguousarray(image, np.float64), 0.0, 1.0)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise InputError("a picture holds NaN")
    return a, b
