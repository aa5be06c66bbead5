# torch and gsplat may be absent:
# pyright: reportMissingImports=false
"""The rasteriser as a differentiable function of torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd import Function

from csplat.errors import InputError
from csplat_render.camera import Camera
from csplat_render.conventions import UncheckedSplats
from csplat_render.rasteriser import Rasteriser

_GROUPS = ("means", "quats", "scales", "opacities", "sh0", "shN")


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
        means: [N, 3]. All tensors are on the CPU, and all float32 or all float64, which is the type of computations.
        quats: [N, 4], w x y z, of any length.
        scales: [N, 3], logarithms.
        opacities: [N], alpha.
        sh0: [N, 3].
        shN: [N, K, 3].
        camera: the camera to render from.
        background: background colour.
        antialiased: apply the mip-splatting low-pass filter.
        sh_degree: highest degree of the SH bands; `None`: the degree of `shN`.

    Returns:
        [H, W, 3], not clipped.

    Raises:
        InputError: the tensors are on another device or of different types.
    """
    tensors = (means, quats, scales, opacities, sh0, shN)
    for name, tensor in zip(_GROUPS, tensors, strict=True):
        if tensor.device.type != "cpu":
            raise InputError(f"{name} is on device {tensor.device.type}, expected cpu")
        if tensor.dtype != means.dtype or tensor.dtype not in (torch.float32, torch.float64):
            raise InputError(f"{name} is {tensor.dtype}, expected all float32 or all float64")
    image: Tensor = _Render.apply(*tensors, camera, background, antialiased, sh_degree)  # type: ignore[no-untyped-call]  # untyped in torch
    return image


class _Render(Function):
    """The autograd function; its context owns the rasteriser with the state for backward."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        tensors, (camera, background, antialiased, sh_degree) = inputs[:6], inputs[6:]
        arrays = tuple(np.ascontiguousarray(tensor.detach().numpy()) for tensor in tensors)
        dtype = arrays[0].dtype.type
        ctx.rasteriser = Rasteriser("standard", dtype)
        result = ctx.rasteriser.forward(
            UncheckedSplats(*arrays), camera, background=background, antialiased=antialiased, sh_degree=sh_degree
        )
        ctx.shapes = [tensor.shape for tensor in tensors]
        return torch.from_numpy(result.rgb.astype(dtype, copy=True))

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        gradients = ctx.rasteriser.backward(np.ascontiguousarray(slopes[0].numpy()))
        tensors = [
            torch.from_numpy(getattr(gradients, name).copy()).reshape(shape)
            for name, shape in zip(_GROUPS, ctx.shapes, strict=True)
        ]
        return (*tensors, None, None, None, None)
