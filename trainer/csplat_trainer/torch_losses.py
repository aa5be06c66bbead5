# SPDX-License-Identifier: Apache-2.0
# torch may be absent:
# pyright: reportMissingImports=false
"""The photometric loss in torch, with its gradient, as `losses.PhotometricLoss`; and images in the memory of a GPU."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv2d

from csplat.types import F32
from csplat_render.metric_kernels import C1, C2, RADIUS, WINDOW
from csplat_trainer.image_gains import ImageGain
from csplat_trainer.losses import LOSS_WEIGHTS, LossValue
from csplat_trainer.posed_images import PosedImage

_IMAGE_SHARE = 0.3  # fraction of a GPU's memory for images; further images are copied to it in each step


class TorchLoss:
    """L1 + SSIM of images on a device.

    Args:
        name: name of the weights in `LOSS_WEIGHTS`.
        device: device of the images.
    """

    def __init__(self, name: str, device: torch.device) -> None:
        self.l1_weight, self.ssim_weight = LOSS_WEIGHTS[name]
        self._taps = torch.from_numpy(WINDOW.astype(np.float32)).to(device)

    def __call__(self, rendered: Tensor, target: Tensor, mask: Tensor | None = None) -> tuple[TorchLossValue, Tensor]:
        """Compare two images; arguments and results as for `PhotometricLoss`, on the device."""
        if mask is not None:
            target = torch.where(mask[..., None], target, rendered)
        x, y = rendered.permute(2, 0, 1).contiguous(), target.permute(2, 0, 1).contiguous()
        difference = x - y
        l1, mse = difference.abs().mean(), difference.square().mean()
        slope = difference.sign() * (self.l1_weight / x.numel())
        ssim = torch.full_like(l1, torch.nan)
        if self.ssim_weight:
            ssim, by_x = self._ssim(x, y)
            slope -= (self.ssim_weight / x.numel()) * by_x
        slope = slope.permute(1, 2, 0)
        if mask is not None:
            slope = slope * mask[..., None]
            mse = mse / mask.float().mean()
        loss = self.l1_weight * l1 + (self.ssim_weight * (1.0 - ssim) if self.ssim_weight else 0.0)
        return TorchLossValue(torch.stack([loss, l1, ssim, mse])), slope.contiguous()

    def _ssim(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean SSIM of images [3, H, W], and the gradient [3, H, W] of its sum by the first."""
        m1, m2, e11, e22, e12 = self._blur(torch.cat([x, y, x * x, y * y, x * y])).reshape(5, *x.shape)
        a, b = 2.0 * m1 * m2 + C1, 2.0 * (e12 - m1 * m2) + C2
        c, d = m1 * m1 + m2 * m2 + C1, (e11 - m1 * m1) + (e22 - m2 * m2) + C2
        over_cd = 1.0 / (c * d)
        ssim = a * b * over_cd
        by_square, by_product = -ssim / d, 2.0 * a * over_cd
        by_mean = 2.0 * m2 * b * over_cd - 2.0 * m1 * ssim / c - 2.0 * m1 * by_square - m2 * by_product
        # The window is symmetric, so the blur is its own transpose.
        partials = self._blur(torch.cat([by_mean, 2.0 * by_square, by_product])).reshape(3, *x.shape)
        by_mean, by_square, by_product = partials
        return ssim.mean(), by_mean + x * by_square + y * by_product

    def _blur(self, planes: Tensor) -> Tensor:
        """Blur planes [C, H, W], with zeros beyond the border."""
        window = self._taps.expand(len(planes), 1, 1, -1)
        across = conv2d(planes[None], window, padding=(0, RADIUS), groups=len(planes))
        return conv2d(across, window.transpose(2, 3), padding=(RADIUS, 0), groups=len(planes))[0]


@dataclass(frozen=True, eq=False)
class TorchLossValue:
    """The loss of a step, [4], on the device until it is read."""

    figures: Tensor

    def read(self) -> LossValue:
        """Wait for the loss, and return it."""
        return LossValue(*self.figures.tolist())


class DeviceImages:
    """Reference images on a device, as bytes; those that exceed a fraction of a GPU's memory stay on the CPU.

    Args:
        device: the device.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._bytes_left: float = np.inf
        if device.type == "cuda":
            self._bytes_left = _IMAGE_SHARE * torch.cuda.get_device_properties(device).total_memory
        self._kept: dict[int, tuple[Any, Tensor]] = {}  # by identity; the image is kept, so that no other takes its id

    def reference(self, image: PosedImage | NDArray[Any], background: Tensor) -> Tensor:
        """Return an image [H, W, 3] float32, or the values of an array, in front of a background [3]."""
        pixels = self._on_device(image, image.pixels if isinstance(image, PosedImage) else image)
        if pixels.dtype != torch.uint8:
            return pixels.float()
        values = pixels.float() * (1.0 / 255.0)
        if values.shape[2] == 3:
            return values
        alpha = values[..., 3:]
        return alpha * values[..., :3] + (1.0 - alpha) * background

    def mask(self, mask: NDArray[np.bool_] | None) -> Tensor | None:
        """Return a mask [H, W]."""
        return None if mask is None else self._on_device(mask, mask)

    def _on_device(self, key: Any, array: NDArray[Any]) -> Tensor:
        """Return an array on the device, where it stays while there is room; `key` is the object it belongs to."""
        kept = self._kept.get(id(key))
        if kept is not None:
            return kept[1]
        tensor = torch.from_numpy(np.require(array, requirements=["C", "W"])).to(self._device)
        if array.nbytes <= self._bytes_left:
            self._bytes_left -= array.nbytes
            self._kept[id(key)] = (key, tensor)
        return tensor


def corrected(gain: ImageGain | None, rendered: Tensor) -> Tensor:
    """Apply the correction of an image to a render, [H, W, 3]; see `ImageGain.apply`."""
    if gain is None:
        return rendered
    values = torch.from_numpy(gain.values.astype(np.float32)).to(rendered.device)
    return rendered * values[0].exp() + values[1]


def through_gain(gain: ImageGain | None, rendered: Tensor, slope: Tensor) -> Tensor:
    """Update the correction of an image, and propagate the gradient of the loss to the render; see `ImageGain`."""
    if gain is None:
        return slope
    sums: F32 = torch.stack([(slope * rendered).sum(dim=(0, 1)), slope.sum(dim=(0, 1))]).cpu().numpy()
    factor = np.exp(gain.values[0])
    gain.update(np.stack([factor * sums[0], sums[1].astype(np.float64)]))
    return slope * torch.from_numpy(factor.astype(np.float32)).to(slope.device)
