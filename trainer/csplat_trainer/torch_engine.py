# SPDX-License-Identifier: Apache-2.0
# torch may be absent:
# pyright: reportMissingImports=false
"""Training steps in torch, with the interface of `CpuEngine`: on a GPU, and as a readable reference on a CPU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from csplat.types import F32, F64
from csplat_render.camera import Camera
from csplat_render.pruning_error import PruningError
from csplat_trainer.device_measurements import measure_pruning
from csplat_trainer.image_gains import ImageGain
from csplat_trainer.losses import PendingLoss
from csplat_trainer.parameters import Parameters, to_model
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.strategies import GATE_CENTRE, GATE_SLOPE, MAX_NOISE, ScreenGradients
from csplat_trainer.torch_losses import DeviceImages, TorchLoss, corrected, through_gain
from csplat_trainer.torch_parameters import (
    DeviceParameters,
    Tensors,
    as_leaves,
    gradients_of,
    memory_errors,
    rotations,
    upload,
)
from csplat_trainer.torch_rasteriser import SplatTensors, TorchRasteriser, TorchRender
from csplat_trainer.training_options import TrainOptions


class TorchEngine:
    """A training engine in torch, on the device of its rasteriser.

    Args:
        parameters: initial state, in arrays of NumPy.
        options: weights of the loss, antialiasing, noise.
        rasteriser: renders, with gradients.

    Attributes:
        parameters: the state of the optimisation, on the device.
        screen: gradients on screen since the last densification, if the strategy uses them.
    """

    def __init__(self, parameters: Parameters, options: TrainOptions, rasteriser: TorchRasteriser) -> None:
        self._rasteriser, self._device = rasteriser, rasteriser.device
        self._options = options
        self._samples = options.strategy in ("mcmc", "fixed")  # Markov chain: noise and regularisers
        self.parameters = DeviceParameters(parameters, self._device)
        self.screen = _DeviceScreenGradients(len(parameters), self._device) if options.strategy == "gradient" else None
        self._images = DeviceImages(self._device)
        self._loss = TorchLoss(options.loss, self._device)

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
        behind = upload(background, self._device)
        target = self._images.reference(image, behind)
        values = as_leaves(self.parameters.tensors)
        render = self._rasteriser.render(_splats_of(values), image.camera, behind, degree)
        rendered = render.image.detach()
        value, slope = self._loss(corrected(gain, rendered), target, self._images.mask(image.mask))
        render.image.backward(through_gain(gain, rendered, slope))  # type: ignore[no-untyped-call]  # untyped in torch
        if self._samples:
            self._regulariser(values).backward()  # type: ignore[no-untyped-call]  # untyped in torch
        if self.screen is not None:
            self.screen.add_render(render, image.camera)
        self.parameters.adam_step(gradients_of(values), rates)
        if self._samples and self._options.noise > 0.0:
            self._add_noise(self._options.noise * rates["means"], rng)
        return value

    @torch.no_grad()
    def render(self, camera: Camera, background: F32, degree: int) -> F32:
        """Render the current state, [H, W, 3]."""
        splats, behind = _splats_of(self.parameters.tensors), upload(background, self._device)
        image: F32 = self._rasteriser.render(splats, camera, behind, degree).image.cpu().numpy()
        return image

    def measure_pruning(self, cameras: Sequence[Camera], background: F32) -> PruningError:
        """Measure the pruning errors of the splats in some views; on a GPU, estimate them."""
        values = {name: tensor.cpu().numpy() for name, tensor in self.parameters.tensors.items()}
        model = to_model(values, antialiased=self._options.antialiased)
        return measure_pruning(model, cameras, background, self._options.device)

    def _regulariser(self, values: Tensors) -> Tensor:
        """Return the weighted mean opacity and mean standard deviation."""
        opacity = self._options.opacity_weight * torch.sigmoid(values["logits"]).mean()
        return opacity + self._options.scale_weight * values["scales"].exp().mean()

    @torch.no_grad()
    def _add_noise(self, strength: float, rng: Generator) -> None:
        """Move splats at random inside their own shapes, as `strategies.add_noise`; means that would overflow stay."""
        v = self.parameters.tensors
        gate = strength * torch.sigmoid(GATE_SLOPE * (1.0 - torch.sigmoid(v["logits"]) - GATE_CENTRE))
        rotation, sizes = rotations(v["quats"]), v["scales"].exp()
        normals = _normals(v["means"], rng)
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

    def state(self) -> dict[str, NDArray[Any]]:
        total, count = self._sums.cpu().numpy()
        return {"screen_total": total, "screen_count": count}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        total, count = arrays.get("screen_total"), arrays.get("screen_count")
        if total is not None and count is not None and total.shape == count.shape == self._sums.shape[1:]:
            self._sums = torch.from_numpy(np.stack([total, count]).astype(np.float32)).to(self._device)

    def add_render(self, render: TorchRender, camera: Camera) -> None:
        """Add the gradients of a render, in units of half an image."""
        assert render.means2d.grad is not None
        norms = render.means2d.grad.norm(dim=-1).reshape(-1) * (0.5 * max(camera.W, camera.H))
        self._sums += torch.stack([norms * render.drawn, render.drawn.float()])

    @property
    def mean(self) -> F64:
        """The mean, 0 for splats that no render shows."""
        mean: F64 = (self._sums[0] / self._sums[1].clamp(min=1.0)).double().cpu().numpy()
        return mean


def _splats_of(v: Tensors) -> SplatTensors:
    """Return the splats of values named as in `Parameters`."""
    return SplatTensors(v["means"], v["quats"], v["scales"], torch.sigmoid(v["logits"]), v["sh0"], v["shN"])


def _normals(means: Tensor, rng: Generator) -> Tensor:
    """Return standard normal numbers [N, 3] on the device of the means; on a CPU, those that `CpuEngine` draws."""
    if means.device.type == "cpu":
        return torch.from_numpy(rng.standard_normal(means.shape, np.float32))
    generator = torch.Generator(means.device).manual_seed(int(rng.integers(2**62)))
    return torch.randn(means.shape, generator=generator, device=means.device)
