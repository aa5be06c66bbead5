# torch and gsplat may be absent:
# pyright: reportMissingImports=false
"""The gsplat package as rasteriser, and Adam on its device: what training, tuning and measuring on a GPU share."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.adam import adam

from csplat.errors import InputError
from csplat.types import F32
from csplat_render.camera import Camera
from csplat_trainer.parameters import GROUPS, Parameters

_BETAS, _EPSILON = (0.9, 0.999), 1e-15
_LOGIT_LIMIT = 14.0  # as in `parameters`
_SHORTEST = 1e-12  # least length to divide by

Tensors = Mapping[str, Tensor]


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
    except ImportError:
        raise InputError("device cuda: the gsplat package is not installed (pip install 'csplat[cuda]')") from None
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


@contextmanager
def memory_errors() -> Iterator[None]:
    """Turn a full GPU into an `InputError` that names the options."""
    try:
        yield
    except torch.OutOfMemoryError:
        raise InputError(
            "the memory of the GPU is full: train fewer splats (--max-splats), or smaller images (--size)"
        ) from None


@dataclass(frozen=True, eq=False)
class SplatTensors:
    """Splats on a device, as they are rendered.

    Attributes:
        means: [N, 3].
        quats: [N, 4], w x y z, of any length.
        scales: [N, 3], standard deviations, not logarithms.
        opacities: [N], alpha.
        colours: [N, B, 3], SH coefficients from degree 0 on.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colours: Tensor

    @classmethod
    def of(cls, v: Tensors, opacities: Tensor) -> SplatTensors:
        """Return the splats of values named as in `Parameters`, whose gradients are to be computed."""
        arrays = (
            v["means"], v["quats"], v["scales"].exp(), opacities, torch.cat([v["sh0"][:, None], v["shN"]], dim=1),
        )  # fmt: skip
        return cls(*(array.detach().requires_grad_() for array in arrays))

    def gradients(self) -> dict[str, Tensor]:
        """Return the gradients by means, quats, log scales, opacities, sh0 and shN, 0 where there is none."""
        means, quats, scales, opacities, colours = (
            torch.zeros_like(tensor) if tensor.grad is None else tensor.grad
            for tensor in (self.means, self.quats, self.scales, self.opacities, self.colours)
        )
        return {
            "means": means,
            "quats": quats,
            "scales": scales * self.scales.detach(),
            "opacities": opacities,
            "sh0": colours[:, 0].contiguous(),
            "shN": colours[:, 1:].contiguous(),
        }


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

    def render(
        self, splats: SplatTensors, camera: Camera, background: Tensor, degree: int
    ) -> tuple[Tensor, dict[str, Any]]:
        """Render a view.

        Args:
            splats: the splats.
            camera: the camera.
            background: [3].
            degree: highest SH degree to evaluate.

        Returns:
            [H, W, 3], and what gsplat returns besides.
        """
        return self._draw(
            camera, background, means=splats.means, quats=splats.quats, scales=splats.scales,
            opacities=splats.opacities, colors=splats.colours, sh_degree=degree,
        )  # fmt: skip

    def render_covariances(
        self, means: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor, camera: Camera, background: Tensor
    ) -> Tensor:
        """Render splats of given covariances [N, 3, 3] and colours [N, 3], [H, W, 3]."""
        return self._draw(
            camera, background, means=means, quats=None, scales=None, covars=covariances, opacities=opacities,
            colors=colours, sh_degree=None,
        )[0]  # fmt: skip

    def upload(self, array: NDArray[Any]) -> Tensor:
        """Copy an array to the device."""
        return torch.from_numpy(np.array(array)).to(self.device)

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
            stored = (
                camera,
                self.upload(camera.viewmat.astype(np.float32))[None],
                self.upload(camera.K.astype(np.float32))[None],
            )
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


class DeviceParameters(Parameters):
    """The state of an optimisation in the memory of a device; arrays are tensors.

    Args:
        parameters: the state, in arrays of NumPy.
        device: the device.
    """

    def __init__(self, parameters: Parameters, device: torch.device) -> None:
        self._device = device
        copies: Any = [
            {name: torch.from_numpy(np.array(array)).to(device) for name, array in part.items()}
            for part in (parameters.values, parameters.first, parameters.second)
        ]
        super().__init__(copies[0], copies[1], copies[2], parameters.step, parameters.beta2)

    @property
    def alphas(self) -> F32:
        """Opacities, [N], in an array of NumPy."""
        alphas: F32 = self.device_alphas.cpu().numpy()
        return alphas

    @property
    def device_alphas(self) -> Tensor:
        """Opacities, [N], computed in float64 and rounded once."""
        return torch.sigmoid(self.tensors["logits"].double()).float()

    @property
    def tensors(self) -> dict[str, Tensor]:
        """The values."""
        return cast("dict[str, Tensor]", self.values)

    def on_cpu(self) -> Parameters:
        """Return a copy in arrays of NumPy."""
        values, first, second = (
            {name: tensor.cpu().numpy().copy() for name, tensor in part.items()}
            for part in (self.tensors, *self._moments)
        )
        return Parameters(values, first, second, self.step, self.beta2)

    def read(self, name: str, rows: NDArray[np.int64]) -> F32:
        """Return a group's values of some splats, in an array of NumPy."""
        values: F32 = self.tensors[name][self._upload(rows)].cpu().numpy()
        return values

    def write(self, name: str, rows: NDArray[np.int64], values: F32) -> None:
        """Replace a group's values of some splats."""
        self.tensors[name][self._upload(rows)] = self._upload(values)

    def copy_rows(self, sources: NDArray[np.int64], targets: NDArray[np.int64]) -> None:
        """Copy the values of some splats to others."""
        origin, goal = self._upload(sources), self._upload(targets)
        for name in GROUPS:
            self.tensors[name][goal] = self.tensors[name][origin]

    def forget(self, rows: NDArray[np.int64]) -> None:
        """Reset Adam's moments of some splats."""
        chosen = self._upload(rows)
        for memory in self._moments:
            for name in GROUPS:
                memory[name][chosen] = 0.0

    def keep(self, rows: NDArray[np.int64]) -> None:
        """Keep some splats, in this order."""
        chosen = self._upload(rows)
        for part in (self.tensors, *self._moments):
            for name in GROUPS:
                part[name] = part[name][chosen]

    def append_copies(self, sources: NDArray[np.int64]) -> None:
        """Add copies of some splats, with zero moments."""
        chosen = self._upload(sources)
        for name in GROUPS:
            copies = self.tensors[name][chosen]
            self.tensors[name] = torch.cat([self.tensors[name], copies])
            for memory in self._moments:
                memory[name] = torch.cat([memory[name], torch.zeros_like(copies)])

    @torch.no_grad()
    def adam_step(self, gradients: Tensors, rates: Mapping[str, float]) -> None:
        """Make a step of Adam; then normalise quaternions and clip logits, as `parameters.adam_step`."""
        first, second = self._moments
        for name, gradient in gradients.items():
            value = self.tensors[name]
            if value.numel():
                count = torch.full((), float(self.step), device=self._device)
                adam(
                    [value], [gradient.contiguous()], [first[name]], [second[name]], [], [count], fused=True,
                    amsgrad=False, beta1=_BETAS[0], beta2=self.beta2, lr=rates[name], weight_decay=0.0, eps=_EPSILON,
                    maximize=False,
                )  # fmt: skip
        self.step += 1
        quats = self.tensors["quats"]
        length = quats.norm(dim=1, keepdim=True)
        quats.div_(length.clamp_(min=_SHORTEST))
        self.tensors["logits"].clamp_(-_LOGIT_LIMIT, _LOGIT_LIMIT)

    @property
    def _moments(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Adam's running means of gradients and of their squares, on the device."""
        return cast("dict[str, Tensor]", self.first), cast("dict[str, Tensor]", self.second)

    def _upload(self, array: NDArray[Any]) -> Tensor:
        """Copy an array to the device; on a CPU, the tensor may share its memory."""
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._device)
