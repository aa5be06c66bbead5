# SPDX-License-Identifier: Apache-2.0
# torch may be absent:
# pyright: reportMissingImports=false
"""The photometric loss, L1 and SSIM in one pass, with its gradient; and LPIPS as an additional term.

    loss = l1_weight · mean |x − y| + ssim_weight · (1 − mean SSIM(x, y))

SSIM is defined as in the INRIA trainer: an 11×11 Gaussian window of σ 1.5, zeros beyond the border, C1 = 0.01²,
C2 = 0.03², the mean over all pixels and channels. With m1, m2 the blurred images, s11, s22, s12 their blurred
(co)variances and

    a = 2 m1 m2 + C1,  b = 2 s12 + C2,  c = m1² + m2² + C1,  d = s11 + s22 + C2,  ssim = a b / (c d)

the gradient by x is blur(∂/∂m1) + 2 x blur(∂/∂s11) + y blur(∂/∂s12), because the blur is its own transpose. Published
weights of L1 and SSIM: 0.8 and 0.2 (INRIA), 1 and 0.2 (the study of simple strategies).

LPIPS runs in torch, since the renderer's metric has no gradient; torch is imported on use.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError, missing_package
from csplat.types import F32, F64
from csplat_render import kernels
from csplat_render.camera import Camera
from csplat_render.lpips import MIN_SIZE, SCALE, SHIFT, Lpips
from csplat_render.metric_kernels import C1, C2, blur_twin

#: Weights of L1 and of 1 − SSIM, by the name of the option.
LOSS_WEIGHTS = {"inria": (0.8, 0.2), "study": (1.0, 0.2), "l1": (1.0, 0.0)}


@dataclass(frozen=True)
class LossValue:
    """Result of one call of `PhotometricLoss`.

    Attributes:
        loss: the weighted sum.
        l1: mean absolute difference.
        ssim: mean SSIM.
        mse: mean squared difference over the pixels that count.
    """

    loss: float
    l1: float
    ssim: float
    mse: float

    def read(self) -> LossValue:
        """Return itself."""
        return self


class PendingLoss(Protocol):
    """A loss that may not be computed yet: a GPU works while the CPU goes on."""

    def read(self) -> LossValue:
        """Wait for the loss, and return it."""
        ...


class PhotometricLoss:
    """L1 + SSIM of images of one size.

    Args:
        height, width: size of the images, pixels.
        l1_weight: factor of the mean absolute difference.
        ssim_weight: factor of 1 − SSIM.
    """

    def __init__(self, height: int, width: int, l1_weight: float = 0.8, ssim_weight: float = 0.2) -> None:
        self.l1_weight, self.ssim_weight = float(l1_weight), float(ssim_weight)
        self._shape = (height, width, 3)
        self._gradient = np.empty(self._shape, np.float32)

    def __call__(self, rendered: F32, target: F32, mask: NDArray[np.bool_] | None = None) -> tuple[LossValue, F32]:
        """Compare two images.

        Args:
            rendered: [H, W, 3], C-contiguous.
            target: [H, W, 3], C-contiguous.
            mask: [H, W], pixels that count; all other pixels of `target` are copied from `rendered`. `None`: all
                count.

        Returns:
            The terms, and the gradient of `loss` by `rendered`, [H, W, 3], in a buffer that the next call overwrites.
            It is 0 for pixels that do not count.
        """
        assert rendered.shape == self._shape == target.shape
        if mask is not None:
            np.copyto(target, rendered, where=~mask[..., None])
        assert rendered.dtype == target.dtype == np.float32
        (height, width, channels), gradient, count = self._shape, self._gradient, rendered.size
        steps = self.l1_weight / count, -self.ssim_weight / count
        sums = np.empty(3, np.float64)
        kernels.call("photometric_loss", rendered, target, height, channels * width, *steps, gradient, sums)
        l1, ssim, mse = (float(value) / count for value in sums)
        if self.ssim_weight == 0.0:
            ssim = math.nan  # not computed
        if mask is not None:
            gradient[~mask] = np.float32(0.0)
            mse /= float(np.mean(mask))
        loss = self.l1_weight * l1 + (self.ssim_weight * (1.0 - ssim) if self.ssim_weight != 0.0 else 0.0)
        return LossValue(loss, l1, ssim, mse), gradient


class SizedLosses:
    """A loss for each size of images, with a buffer for the image to compare with.

    Args:
        name: name of the weights in `LOSS_WEIGHTS`.
    """

    def __init__(self, name: str) -> None:
        self._weights = LOSS_WEIGHTS[name]
        self._by_size: dict[tuple[int, int], tuple[PhotometricLoss, F32]] = {}

    def of(self, camera: Camera) -> tuple[PhotometricLoss, F32]:
        """Return the loss and the buffer, [H, W, 3], for images of a camera's size."""
        size = (camera.H, camera.W)
        if size not in self._by_size:
            self._by_size[size] = PhotometricLoss(*size, *self._weights), np.empty((*size, 3), np.float32)
        return self._by_size[size]


def photometric_loss_twin(
    rendered: F64, target: F64, l1_weight: float = 0.8, ssim_weight: float = 0.2
) -> tuple[LossValue, F64]:
    """Compute `PhotometricLoss` in float64 NumPy, for tests.

    Returns:
        The terms, and the gradient of `loss` by `rendered`, [H, W, 3].
    """
    x, y = rendered.astype(np.float64), target.astype(np.float64)
    m1, m2 = blur_twin(x), blur_twin(y)
    s11, s22, s12 = blur_twin(x * x) - m1 * m1, blur_twin(y * y) - m2 * m2, blur_twin(x * y) - m1 * m2
    a, b, c, d = 2 * m1 * m2 + C1, 2 * s12 + C2, m1 * m1 + m2 * m2 + C1, s11 + s22 + C2
    ssim = a * b / (c * d)
    by_square, by_product = -ssim / d, 2 * a / (c * d)
    by_mean = 2 * m2 * b / (c * d) - 2 * m1 * ssim / c - 2 * m1 * by_square - m2 * by_product
    # The window is symmetric, so the blur is its own transpose.
    ssim_gradient = blur_twin(by_mean) + 2 * x * blur_twin(by_square) + y * blur_twin(by_product)
    gradient = (l1_weight * np.sign(x - y) - ssim_weight * ssim_gradient) / x.size
    l1, mean_ssim, mse = float(np.abs(x - y).mean()), float(ssim.mean()), float(np.square(x - y).mean())
    return LossValue(l1_weight * l1 + ssim_weight * (1 - mean_ssim), l1, mean_ssim, mse), gradient


# torch and gsplat may be absent:
# pyright: reportMissingImports=false


_STRIDES, _PADDINGS = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)  # pixels; stride and padding of AlexNet's five convolutions
_POOLED = (1, 2)  # indices of layers after a 3×3 pooling of stride 2
_LPIPS_EPSILON = 1e-10  # added to the squared length, so that the gradient of a zero vector is finite


class PerceptualLoss:
    """LPIPS v0.1 with the AlexNet backbone (https://arxiv.org/abs/1801.03924).

    Args:
        weights: weights of the five layers and of their heads.

    Raises:
        InputError: torch is not installed.
    """

    def __init__(self, weights: Lpips) -> None:
        torch = _import_torch()
        self._kernels = [
            torch.from_numpy(np.ascontiguousarray(kernel.transpose(3, 2, 0, 1))) for kernel in weights.kernels
        ]
        self._biases = [torch.from_numpy(np.array(bias)) for bias in weights.biases]
        self._heads = [torch.from_numpy(np.array(head)).reshape(1, -1, 1, 1) for head in weights.heads]
        self._shift, self._scale = (
            torch.from_numpy(constants.copy()).reshape(1, 3, 1, 1) for constants in (SHIFT, SCALE)
        )

    def distance(self, first: F32, second: F32) -> float:
        """Return LPIPS of two images, [H, W, 3] in 0..1."""
        torch = _import_torch()
        with torch.no_grad():
            return float(self._distance(self._tensor(first), self._tensor(second)))

    def gradient(self, rendered: F32, target: F32, weight: float) -> F32:
        """Return the gradient of `weight` · LPIPS by the rendered image, [H, W, 3]."""
        x = self._tensor(rendered).requires_grad_(requires_grad=True)
        (weight * self._distance(x, self._tensor(target))).backward()
        slope: F32 = x.grad[0].permute(1, 2, 0).contiguous().numpy()
        return slope

    def _tensor(self, image: F32) -> Any:
        """Copy an image [H, W, 3] to a tensor [1, 3, H, W]; raise an `InputError` if a side is below `MIN_SIZE`."""
        if min(image.shape[:2]) < MIN_SIZE:
            raise InputError(f"an image has {image.shape[:2]} pixels, expected at least {MIN_SIZE} per side for LPIPS")
        return _import_torch().from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None].clone()

    def _distance(self, x: Any, y: Any) -> Any:
        """Return LPIPS of two tensors [1, 3, H, W], a tensor [] with a gradient."""
        total: Any = 0.0
        for first, second, head in zip(self._features(x), self._features(y), self._heads, strict=True):
            total = total + (head * (_unit(first) - _unit(second)).square()).sum(dim=1).mean()
        return total

    def _features(self, image: Any) -> list[Any]:
        """Return the activations of the five layers, [1, C, h, w] each, of an image [1, 3, H, W] in 0..1."""
        functional = _import_torch().nn.functional
        layers = []
        x = (2.0 * image - 1.0 - self._shift) / self._scale
        for k, (kernel, bias) in enumerate(zip(self._kernels, self._biases, strict=True)):
            if k in _POOLED:
                x = functional.max_pool2d(x, 3, 2)
            x = functional.relu(functional.conv2d(x, kernel, bias, _STRIDES[k], _PADDINGS[k]))
            layers.append(x)
        return layers


def _unit(x: Any) -> Any:
    """Scale feature vectors [1, C, h, w] to unit length over the channels; zero vectors stay zero."""
    return x / (x.square().sum(dim=1, keepdim=True) + _LPIPS_EPSILON).sqrt()


def _import_torch() -> Any:
    """Return the module torch, imported on use; raise an `InputError` if it is not installed."""
    try:
        import torch
    except ModuleNotFoundError as error:
        raise missing_package(error, extra="train") from None
    return torch
