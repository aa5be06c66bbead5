# SPDX-License-Identifier: Apache-2.0
# torch and gsplat may be absent:
# pyright: reportMissingImports=false
"""The gsplat package as rasteriser of `TorchEngine`, and of measurements on a GPU."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from csplat.errors import InputError, missing_package
from csplat_render.camera import Camera
from csplat_trainer.torch_parameters import upload
from csplat_trainer.torch_rasteriser import SplatTensors, TorchRender


class GsplatRasteriser:
    """Renders splats by gsplat, with gradients by autograd. Owns copies of the cameras on the device.

    gsplat limits the alpha of a splat at a pixel to 0.999 instead of 0.99, which changes renders invisibly.

    Args:
        antialiased: apply the mip-splatting filter.
        rasterization: function with gsplat's arguments; `None`: gsplat.
        device: `cuda`; tests use `cpu` and their own `rasterization`.
    """

    def __init__(
        self, *, antialiased: bool, rasterization: Callable[..., Any] | None = None, device: str = "cuda"
    ) -> None:
        self._rasterization = rasterization or gsplat_rasterization()
        self.device = torch.device(device)
        self._mode = "antialiased" if antialiased else "classic"
        self._cameras: dict[int, tuple[Camera, Tensor, Tensor]] = {}

    def render(self, splats: SplatTensors, camera: Camera, background: Tensor, degree: int) -> TorchRender:
        """Render a view, see `TorchRasteriser.render`."""
        image, info = self._draw(
            camera, background, means=splats.means, quats=splats.quats, scales=splats.scales.exp(),
            opacities=splats.opacities, colors=torch.cat([splats.sh0[:, None], splats.shN], dim=1), sh_degree=degree,
        )  # fmt: skip
        if info["means2d"].requires_grad:
            info["means2d"].retain_grad()
        drawn = (info["radii"][0] > 0).reshape(len(splats.means), -1).all(dim=1)
        return TorchRender(image, drawn, info["means2d"])

    def render_covariances(
        self, means: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor, camera: Camera, background: Tensor
    ) -> Tensor:
        """Render splats of given covariances [N, 3, 3] and colours [N, 3], [H, W, 3]."""
        return self._draw(
            camera, background, means=means, quats=None, scales=None, covars=covariances, opacities=opacities,
            colors=colours, sh_degree=None,
        )[0]  # fmt: skip

    def _draw(self, camera: Camera, background: Tensor, **splats: Any) -> tuple[Tensor, dict[str, Any]]:
        """Call gsplat for one view; the matrices of a camera stay on the device.

        Args:
            camera: the camera.
            background: [3].
            splats: the arguments of `rasterization` that differ between the kinds of splats.

        Returns:
            [H, W, 3], and what gsplat returns besides.
        """
        stored = self._cameras.get(id(camera))
        if stored is None:
            viewmat, K = (upload(array.astype(np.float32), self.device) for array in (camera.viewmat, camera.K))
            stored = (camera, viewmat[None], K[None])
            self._cameras[id(camera)] = stored
        images, _, info = self._rasterization(
            **splats,
            viewmats=stored[1],
            Ks=stored[2],
            width=camera.W,
            height=camera.H,
            near_plane=camera.near,
            packed=False,
            backgrounds=background[None],
            rasterize_mode=self._mode,
        )
        return images[0], info


def gsplat_rasterization() -> Callable[..., Any]:
    """Return the entry point of gsplat.

    Raises:
        InputError: there is no GPU, the package is not installed, or its kernels cannot be compiled.
    """
    if not torch.cuda.is_available():
        raise InputError("device cuda: torch finds no GPU; use --device cpu")
    try:
        from gsplat import rasterization
        from gsplat.cuda._backend import _C
    except ModuleNotFoundError as error:
        raise missing_package(error, extra="cuda") from None
    except (OSError, RuntimeError) as error:  # from the compiler
        raise InputError(f"device cuda: gsplat cannot be compiled: {_last_line(error)}") from None
    if _C is None:
        raise InputError("device cuda: gsplat finds no CUDA compiler: install nvcc of the CUDA version of torch")
    function: Callable[..., Any] = rasterization
    return function


def _last_line(error: Exception) -> str:
    """Return the last line of an error's message that is not blank; its type if there is none."""
    lines = [line for line in re.split(r"\s*\n\s*", str(error)) if line]
    return lines[-1] if lines else type(error).__name__
