# torch and gsplat may be absent:
# pyright: reportMissingImports=false
"""Training steps on a GPU with the gsplat package as rasteriser; the interface is that of `CpuEngine`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv2d

from csplat.errors import InputError
from csplat.types import F32
from csplat_render.camera import Camera
from csplat_trainer.image_gains import ImageGain
from csplat_trainer.losses import LOSS_WEIGHTS, LossValue
from csplat_trainer.parameters import GROUPS, ParameterArrays, Parameters
from csplat_trainer.posed_images import PosedImage, compose
from csplat_trainer.strategies import ScreenGradients
from csplat_trainer.training_options import TrainOptions

_BETAS, _EPSILON = (0.9, 0.999), 1e-15
_C1, _C2, _TAPS, _SIGMA = 0.01**2, 0.03**2, 11, 1.5
_LOGIT_LIMIT = 14.0
_GATE_SLOPE, _GATE_CENTRE = 100.0, 0.995  # as in csplat_trainer.strategies


def gsplat_rasterization() -> Callable[..., Any]:
    """Return the entry point of gsplat.

    Raises:
        InputError: there is no GPU, or the package is not installed.
    """
    if not torch.cuda.is_available():
        raise InputError("device cuda: torch finds no GPU; use --device cpu")
    try:
        from gsplat import rasterization
    except ImportError:
        raise InputError("device cuda: the gsplat package is not installed (pip install gsplat)") from None
    found: Callable[..., Any] = rasterization
    return found


class GsplatEngine:
    """A training engine in torch.

    Args:
        parameters: initial state.
        options: weights of the loss, antialiasing, noise.
        rasterization: rasteriser with gsplat's arguments; `None`: gsplat.
        device: `cuda`; tests use `cpu` and their own `rasterization`.

    Attributes:
        screen: gradients on screen since the last densification, if the strategy uses them.
    """

    def __init__(
        self,
        parameters: Parameters,
        options: TrainOptions,
        rasterization: Callable[..., Any] | None = None,
        device: str = "cuda",
    ) -> None:
        self._rasterization = rasterization or gsplat_rasterization()
        self._device = torch.device(device)
        self._options = options
        self._samples = options.strategy in ("mcmc", "fixed")
        self.screen = ScreenGradients.none(len(parameters)) if options.strategy == "gradient" else None
        taps = torch.exp(-((torch.arange(_TAPS) - _TAPS // 2) ** 2) / (2.0 * _SIGMA**2))
        self._window = (taps / taps.sum()).to(self._device).expand(3, 1, 1, _TAPS).contiguous()
        self.parameters = parameters

    @property
    def parameters(self) -> Parameters:
        """The state of the optimisation, copied into the memory of the CPU."""
        values, first, second = (self._download(part) for part in (self._values, self._first, self._second))
        return Parameters(values, first, second, self._count)

    @parameters.setter
    def parameters(self, parameters: Parameters) -> None:
        self._values = {name: self._upload(parameters.values[name]).requires_grad_() for name in GROUPS}
        self._first = {name: self._upload(parameters.first[name]) for name in GROUPS}
        self._second = {name: self._upload(parameters.second[name]) for name in GROUPS}
        self._count = parameters.step

    def step(
        self,
        image: PosedImage,
        background: F32,
        degree: int,
        rates: dict[str, float],
        rng: Generator,
        gain: ImageGain | None = None,
    ) -> LossValue:
        """Make a training step on an image, see `CpuEngine.step`; gains are not trained."""
        assert gain is None
        camera = image.camera
        target = self._upload(compose(image, background, np.empty((camera.H, camera.W, 3), np.float32)))
        rendered, info = self._draw(camera, background, degree)
        if self.screen is not None:
            info["means2d"].retain_grad()
        if image.mask is not None:  # pixels that do not count are set to the render
            counts = torch.from_numpy(image.mask).to(target.device)[..., None]
            target = torch.where(counts, target, rendered.detach())
        total, value = self._loss(rendered, target)
        total.backward()  # type: ignore[no-untyped-call]  # untyped in torch
        if self.screen is not None:
            self._gather(info, camera)
        self._adam(rates)
        if self._samples and self._options.noise > 0.0:
            self._noise(self._options.noise * rates["means"], int(rng.integers(2**62)))
        return value

    def render(self, camera: Camera, background: F32, degree: int) -> F32:
        """Render the current state, [H, W, 3]."""
        with torch.no_grad():
            image: F32 = self._draw(camera, background, degree)[0].cpu().numpy()
        return image

    def _draw(self, camera: Camera, background: F32, degree: int) -> tuple[Tensor, dict[str, Any]]:
        v = self._values
        images, _, info = self._rasterization(
            means=v["means"],
            quats=v["quats"],
            scales=torch.exp(v["scales"]),
            opacities=torch.sigmoid(v["logits"]),
            colors=torch.cat([v["sh0"][:, None], v["shN"]], dim=1),
            viewmats=self._upload(camera.viewmat.astype(np.float32))[None],
            Ks=self._upload(camera.K.astype(np.float32))[None],
            width=camera.W,
            height=camera.H,
            near_plane=camera.near,
            sh_degree=degree,
            packed=False,
            backgrounds=self._upload(background)[None],
            rasterize_mode="antialiased" if self._options.antialiased else "classic",
        )
        return images[0], info

    def _loss(self, x: Tensor, y: Tensor) -> tuple[Tensor, LossValue]:
        l1_weight, ssim_weight = LOSS_WEIGHTS[self._options.loss]
        l1, mse, ssim = (x - y).abs().mean(), (x - y).square().mean(), self._ssim(x, y)
        photometric = l1_weight * l1 + (ssim_weight * (1.0 - ssim) if ssim_weight else 0.0)
        total = photometric
        if self._samples:
            alphas, deviations = torch.sigmoid(self._values["logits"]), torch.exp(self._values["scales"])
            total = (
                total + self._options.opacity_weight * alphas.mean() + self._options.scale_weight * deviations.mean()
            )
        figures = torch.stack([photometric, l1, ssim, mse]).tolist()
        return total, LossValue(*figures)

    def _ssim(self, x: Tensor, y: Tensor) -> Tensor:
        a, b = x.permute(2, 0, 1)[None], y.permute(2, 0, 1)[None]
        m1, m2 = self._blur(a), self._blur(b)
        s11, s22 = self._blur(a * a) - m1 * m1, self._blur(b * b) - m2 * m2
        s12 = self._blur(a * b) - m1 * m2
        top = (2 * m1 * m2 + _C1) * (2 * s12 + _C2)
        return (top / ((m1 * m1 + m2 * m2 + _C1) * (s11 + s22 + _C2))).mean()

    def _blur(self, x: Tensor) -> Tensor:
        across = conv2d(x, self._window, padding=(0, _TAPS // 2), groups=3)
        return conv2d(across, self._window.transpose(2, 3), padding=(_TAPS // 2, 0), groups=3)

    def _gather(self, info: dict[str, Any], camera: Camera) -> None:
        assert self.screen is not None
        slopes = info["means2d"].grad[0] * (0.5 * max(camera.W, camera.H))
        drawn = (info["radii"][0] > 0).reshape(len(slopes), -1).all(dim=1)
        self.screen.add(slopes.norm(dim=1).cpu().numpy(), drawn.cpu().numpy())

    @torch.no_grad()
    def _adam(self, rates: dict[str, float]) -> None:
        self._count += 1
        correction1 = 1.0 - _BETAS[0] ** self._count
        correction2 = math.sqrt(1.0 - _BETAS[1] ** self._count)
        for name in GROUPS:
            value, m, v = self._values[name], self._first[name], self._second[name]
            if value.grad is None:
                continue
            m.lerp_(value.grad, 1.0 - _BETAS[0])
            v.mul_(_BETAS[1]).addcmul_(value.grad, value.grad, value=1.0 - _BETAS[1])
            value.addcdiv_(m, v.sqrt().div_(correction2).add_(_EPSILON), value=-rates[name] / correction1)
            value.grad = None
        quats, logits = self._values["quats"], self._values["logits"]
        quats.div_(quats.norm(dim=1, keepdim=True).clamp_(min=1e-12))
        logits.clamp_(-_LOGIT_LIMIT, _LOGIT_LIMIT)

    @torch.no_grad()
    def _noise(self, strength: float, seed: int) -> None:
        v = self._values
        gate = strength * torch.sigmoid(_GATE_SLOPE * (1.0 - torch.sigmoid(v["logits"]) - _GATE_CENTRE))
        rotation = _rotations(v["quats"])
        generator = torch.Generator(self._device).manual_seed(seed)
        normals = torch.randn(v["means"].shape, generator=generator, device=self._device)
        local = torch.einsum("nji,nj->ni", rotation, normals) * torch.exp(2.0 * v["scales"])
        v["means"].add_(gate[:, None] * torch.einsum("nij,nj->ni", rotation, local))

    def _upload(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.array(array)).to(self._device)

    @staticmethod
    def _download(part: dict[str, Tensor]) -> ParameterArrays:
        return {name: part[name].detach().cpu().numpy().copy() for name in GROUPS}


def _rotations(quats: Tensor) -> Tensor:
    """Return the rotation matrices of unit quaternions, [N, 3, 3]."""
    w, x, y, z = quats.unbind(dim=1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, dim=1).reshape(-1, 3, 3)
