# torch and gsplat may be absent:
# pyright: reportMissingImports=false
"""Training steps on a GPU with the gsplat package as rasteriser, with the interface of `CpuEngine`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.random import Generator

from csplat.types import F32, F64
from csplat_render.camera import Camera
from csplat_render.pruning_error import PruningError
from csplat_trainer.gsplat_derivatives import estimate_pruning, rotations
from csplat_trainer.gsplat_rasteriser import DeviceParameters, GsplatRasteriser, SplatTensors, memory_errors
from csplat_trainer.image_gains import ImageGain
from csplat_trainer.losses import PendingLoss
from csplat_trainer.parameters import Parameters
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.strategies import GATE_CENTRE, GATE_SLOPE, MAX_NOISE, ScreenGradients
from csplat_trainer.torch_losses import DeviceImages, TorchLoss, corrected, through_gain
from csplat_trainer.training_options import TrainOptions


class GsplatEngine:
    """A training engine in torch.

    Args:
        parameters: initial state, in arrays of NumPy.
        options: weights of the loss, antialiasing, noise.
        rasterization, device: as for `GsplatRasteriser`.

    Attributes:
        parameters: the state of the optimisation, on the device.
        screen: gradients on screen since the last densification, if the strategy uses them.
    """

    def __init__(
        self,
        parameters: Parameters,
        options: TrainOptions,
        rasterization: Callable[..., Any] | None = None,
        device: str = "cuda",
    ) -> None:
        self._rasteriser = GsplatRasteriser(antialiased=options.antialiased, rasterization=rasterization, device=device)
        self._options = options
        self._samples = options.strategy in ("mcmc", "fixed")  # Markov chain: noise and regularisers
        self.parameters = DeviceParameters(parameters, self._rasteriser.device)
        self.screen: ScreenGradients | None = None
        if options.strategy == "gradient":
            self.screen = _DeviceScreenGradients(len(parameters), self._rasteriser.device)
        self._images = DeviceImages(self._rasteriser.device)
        self._loss = TorchLoss(options.loss, self._rasteriser.device)

    @memory_errors()
    def step(
        self,
        image: PosedImage,
        background: F32,
        degree: int,
        rates: dict[str, float],
        rng: Generator,
        gain: ImageGain | None = None,
    ) -> PendingLoss:
        """Make a training step on an image, see `CpuEngine.step`."""
        behind = self._rasteriser.upload(background)
        target = self._images.reference(image, behind)
        alphas = torch.sigmoid(self.parameters.tensors["logits"])
        splats = SplatTensors.of(self.parameters.tensors, alphas)
        rendered, info = self._rasteriser.render(splats, image.camera, behind, degree)
        if self.screen is not None:
            info["means2d"].retain_grad()
        shown = rendered.detach()
        value, slope = self._loss(corrected(gain, shown), target, self._images.mask(image.mask))
        rendered.backward(through_gain(gain, shown, slope))  # type: ignore[no-untyped-call]  # untyped in torch
        gradients = splats.gradients()
        if isinstance(self.screen, _DeviceScreenGradients):
            self.screen.add_render(info, image.camera)
        opacities = gradients.pop("opacities")
        if self._samples:
            count = max(1, len(self.parameters))
            opacities += self._options.opacity_weight / count
            gradients["scales"] += self._options.scale_weight / (3 * count) * splats.scales.detach()
        gradients["logits"] = opacities * alphas * (1.0 - alphas)
        self.parameters.adam_step(gradients, rates)
        if self._samples and self._options.noise > 0.0:
            self._add_noise(self._options.noise * rates["means"], int(rng.integers(2**62)))
        return value

    @torch.no_grad()
    def render(self, camera: Camera, background: F32, degree: int) -> F32:
        """Render the current state, [H, W, 3]."""
        splats = SplatTensors.of(self.parameters.tensors, self.parameters.device_alphas)
        image: F32 = (
            self._rasteriser.render(splats, camera, self._rasteriser.upload(background), degree)[0].cpu().numpy()
        )
        return image

    def measure_pruning(self, cameras: Sequence[Camera], background: F32) -> PruningError:
        """Estimate the pruning errors of the splats in some views."""
        splats = SplatTensors.of(self.parameters.tensors, self.parameters.device_alphas)
        return estimate_pruning(self._rasteriser, splats, cameras, background)

    @torch.no_grad()
    def _add_noise(self, strength: float, seed: int) -> None:
        """Move splats at random inside their own shapes, as `strategies.add_noise`; means that would overflow stay."""
        v = self.parameters.tensors
        gate = strength * torch.sigmoid(GATE_SLOPE * (1.0 - torch.sigmoid(v["logits"]) - GATE_CENTRE))
        rotation, sizes = rotations(v["quats"]), v["scales"].exp()
        generator = torch.Generator(self._rasteriser.device).manual_seed(seed)
        normals = torch.randn(v["means"].shape, generator=generator, device=self._rasteriser.device)
        local = (rotation * normals[:, :, None]).sum(dim=1) * (gate[:, None] * sizes).clamp(max=MAX_NOISE) * sizes
        moved = v["means"] + (rotation * local[:, None]).sum(dim=2)
        torch.where(moved.isfinite().all(dim=1, keepdim=True), moved, v["means"], out=v["means"])


class _DeviceScreenGradients(ScreenGradients):
    """Gradients on screen, summed on a device."""

    def __init__(self, splats: int, device: torch.device) -> None:
        super().__init__(np.zeros(0), np.zeros(0, np.int64))
        self._device = device
        self.clear(splats)

    def clear(self, splats: int) -> None:
        """Start anew, for another number of splats."""
        self._sums = torch.zeros((2, splats), device=self._device)

    def add_render(self, info: dict[str, Any], camera: Camera) -> None:
        """Add the gradients of a render, in units of half an image."""
        slopes = info["means2d"].grad[0] * (0.5 * max(camera.W, camera.H))
        drawn = (info["radii"][0] > 0).reshape(len(slopes), -1).all(dim=1)
        self._sums += torch.stack([slopes.norm(dim=1) * drawn, drawn.float()])

    @property
    def mean(self) -> F64:
        """The mean, 0 for splats that no render shows."""
        mean: F64 = (self._sums[0] / self._sums[1].clamp(min=1.0)).double().cpu().numpy()
        return mean
