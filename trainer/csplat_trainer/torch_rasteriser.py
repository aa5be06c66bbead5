# SPDX-License-Identifier: Apache-2.0
# torch may be absent:
# pyright: reportMissingImports=false
"""csplat's rasteriser as a differentiable function of torch, and the interface of rasterisers to `TorchEngine`."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.autograd import Function

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat_render.camera import Camera
from csplat_render.conventions import UncheckedSplats
from csplat_render.rasteriser import Rasteriser


class SplatTensors(NamedTuple):
    """Splats in tensors, float32, on the device of a rasteriser.

    Attributes:
        means: [N, 3].
        quats: [N, 4], w x y z, of any length.
        scales: [N, 3], logarithms.
        opacities: [N], alpha.
        sh0: [N, 3].
        shN: [N, K, 3].
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh0: Tensor
    shN: Tensor


class TorchRender(NamedTuple):
    """A render.

    Attributes:
        image: [H, W, 3], not clipped; differentiable by each tensor of the splats.
        drawn: [N] bool, True for splats that touch the image.
        means2d: [..., N, C], a tensor whose rows of `grad` have, after a backward pass, the norms of the gradients by
            the positions on screen, per pixel.
    """

    image: Tensor
    drawn: Tensor
    means2d: Tensor


class TorchRasteriser(Protocol):
    """A rasteriser with gradients by autograd: `CpuRasteriser` or `GsplatRasteriser`."""

    device: torch.device

    def render(self, splats: SplatTensors, camera: Camera, background: Tensor, degree: int) -> TorchRender:
        """Render a view.

        Args:
            splats: the splats.
            camera: the camera.
            background: [3].
            degree: highest SH degree to evaluate.
        """
        ...


class CpuRasteriser:
    """csplat's rasteriser, on the CPU.

    Args:
        antialiased: apply the mip-splatting low-pass filter.
        context: threads.
    """

    def __init__(self, *, antialiased: bool, context: Context = DEFAULT_CONTEXT) -> None:
        self.device = torch.device("cpu")
        self._antialiased, self._context = antialiased, context

    def render(self, splats: SplatTensors, camera: Camera, background: Tensor, degree: int | None) -> TorchRender:
        """Render a view, see `TorchRasteriser.render`; degree `None`: the degree of `shN`."""
        means2d = torch.zeros((len(splats.means), 1), requires_grad=torch.is_grad_enabled())
        settings = {"background": background.numpy(), "antialiased": self._antialiased, "sh_degree": degree}
        image, drawn = _Render.apply(self._context, camera, settings, means2d, *splats)  # type: ignore[no-untyped-call]  # untyped in torch
        return TorchRender(image, drawn, means2d)


def render(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    antialiased: bool = False,
    sh_degree: int | None = None,
) -> Tensor:
    """Render splats, with gradients by each of the six tensors.

    Args:
        means, quats, scales, opacities, sh0, shN: see `SplatTensors`; on the CPU.
        camera: the camera to render from.
        background: background colour.
        antialiased: apply the mip-splatting low-pass filter.
        sh_degree: highest degree of the SH bands; `None`: the degree of `shN`.

    Returns:
        [H, W, 3], not clipped.

    Raises:
        InputError: a tensor is on another device, or of another type.
    """
    splats = SplatTensors(means, quats, scales, opacities, sh0, shN)
    for name, tensor in splats._asdict().items():
        if tensor.device.type != "cpu":
            raise InputError(f"{name} is on device {tensor.device.type}, expected cpu")
        if tensor.dtype != torch.float32:
            raise InputError(f"{name} is {tensor.dtype}, expected torch.float32")
    rasteriser = CpuRasteriser(antialiased=antialiased)
    return rasteriser.render(splats, camera, torch.tensor(background), sh_degree).image


class _Render(Function):
    """The autograd function; its context owns the rasteriser with the state for backward.

    Like the first implementation of splatting, it takes zeros as positions on screen, to return gradients for them.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor]:
        (context, camera, settings), tensors = inputs[:3], inputs[3:]
        ctx.save_for_backward(*tensors)
        ctx.rasteriser = Rasteriser(context=context)
        arrays = (np.ascontiguousarray(tensor.detach().numpy()) for tensor in tensors[1:])
        result = ctx.rasteriser.forward(UncheckedSplats(*arrays), camera, **settings)
        drawn = torch.from_numpy(result.radii > 0)
        ctx.mark_non_differentiable(drawn)
        return torch.from_numpy(result.rgb), drawn

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        gradients = ctx.rasteriser.backward(slopes[0].numpy())
        by_tensor = (
            torch.from_numpy(getattr(gradients, name).copy()).reshape(tensor.shape)
            for name, tensor in zip(("means2d", *SplatTensors._fields), ctx.saved_tensors, strict=True)
        )
        return (None, None, None, *by_tensor)
