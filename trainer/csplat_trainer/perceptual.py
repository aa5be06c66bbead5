# torch and gsplat may be absent:
# pyright: reportMissingImports=false
"""LPIPS-Alex as a term of the loss, in torch: it needs the gradient that the renderer's metric has not."""

from __future__ import annotations

from typing import Any

import numpy as np

from csplat.errors import InputError
from csplat.types import F32
from csplat_render.lpips import MIN_SIZE, SCALE, SHIFT, Lpips

_STRIDES, _PADDINGS = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
_POOLED = (1, 2)  # layers that a 3×3 pooling of stride 2 precedes
_EPSILON = 1e-10


class PerceptualLoss:
    """LPIPS v0.1 with the AlexNet backbone (https://arxiv.org/abs/1801.03924).

    Args:
        weights: of the five layers and of their differences.

    Raises:
        InputError: torch is not installed.
    """

    def __init__(self, weights: Lpips) -> None:
        torch = _torch()
        self._kernels = [torch.from_numpy(np.ascontiguousarray(one.transpose(3, 2, 0, 1))) for one in weights.kernels]
        self._biases = [torch.from_numpy(np.array(one)) for one in weights.biases]
        self._heads = [torch.from_numpy(np.array(one)).reshape(1, -1, 1, 1) for one in weights.heads]
        self._shift, self._scale = (torch.from_numpy(one.copy()).reshape(1, 3, 1, 1) for one in (SHIFT, SCALE))

    def distance(self, first: F32, second: F32) -> float:
        """LPIPS of two pictures, [H, W, 3] in 0..1."""
        torch = _torch()
        with torch.no_grad():
            return float(self._distance(self._tensor(first), self._tensor(second)))

    def gradient(self, rendered: F32, photograph: F32, weight: float) -> F32:
        """Gradient of `weight` · LPIPS by the rendered picture, [H, W, 3]."""
        x = self._tensor(rendered).requires_grad_(requires_grad=True)
        (weight * self._distance(x, self._tensor(photograph))).backward()
        slope: F32 = x.grad[0].permute(1, 2, 0).contiguous().numpy()
        return slope

    def _tensor(self, picture: F32) -> Any:
        if min(picture.shape[:2]) < MIN_SIZE:
            raise InputError(f"LPIPS wants pictures of at least {MIN_SIZE} pixels a side, found {picture.shape[:2]}")
        return _torch().from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1)))[None].clone()

    def _distance(self, x: Any, y: Any) -> Any:
        total: Any = 0.0
        for one, other, head in zip(self._features(x), self._features(y), self._heads, strict=True):
            total = total + (head * (_unit(one) - _unit(other)).square()).sum(dim=1).mean()
        return total

    def _features(self, picture: Any) -> list[Any]:
        functional = _torch().nn.functional
        layers = []
        x = (2.0 * picture - 1.0 - self._shift) / self._scale
        for k, (kernel, bias) in enumerate(zip(self._kernels, self._biases, strict=True)):
            if k in _POOLED:
                x = functional.max_pool2d(x, 3, 2)
            x = functional.relu(functional.conv2d(x, kernel, bias, _STRIDES[k], _PADDINGS[k]))
            layers.append(x)
        return layers


def _unit(x: Any) -> Any:
    """Feature vectors at unit length."""
    return x / (x.square().sum(dim=1, keepdim=True) + _EPSILON).sqrt()


def _torch() -> Any:
    try:
        import torch
    except ImportError:
        raise InputError("torch is not installed: pip install csplat[train]") from None
    return torch
