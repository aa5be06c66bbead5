# SPDX-License-Identifier: Apache-2.0
"""One training step: render, loss, gradients, Adam, noise; on the CPU, without torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.random import Generator

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.types import F32, null_progress
from csplat_render.camera import Camera
from csplat_render.conventions import UncheckedSplats
from csplat_render.pruning_error import PruningError, measure_pruning_error
from csplat_render.rasteriser import Rasteriser
from csplat_trainer.image_gains import ImageGain
from csplat_trainer.losses import LossValue, PendingLoss, PerceptualLoss, SizedLosses
from csplat_trainer.parameters import Parameters, to_model
from csplat_trainer.posed_images import PosedImage, compose
from csplat_trainer.strategies import ScreenGradients, add_noise
from csplat_trainer.training_options import TrainOptions


class Engine(Protocol):
    """A training engine, with compiled kernels on the CPU or gsplat on a GPU."""

    @property
    def parameters(self) -> Parameters:
        """The state of the optimisation, which strategies change."""
        ...

    @property
    def screen(self) -> ScreenGradients | None:
        """Gradients on screen since the last densification, if the strategy uses them."""
        ...

    def step(
        self,
        image: PosedImage,
        background: F32,
        degree: int,
        rates: dict[str, float],
        rng: Generator,
        gain: ImageGain | None = None,
    ) -> PendingLoss:
        """Make a training step on an image."""
        ...

    def render(self, camera: Camera, background: F32, degree: int) -> F32:
        """Render the current state, [H, W, 3]."""
        ...

    def measure_pruning(self, cameras: Sequence[Camera], background: F32) -> PruningError:
        """Measure the pruning errors of the splats in some views."""
        ...


class CpuEngine:
    """A training engine on the CPU, which reuses its buffers.

    Args:
        parameters: initial state; changed in place by `step`.
        options: weights of the loss, antialiasing, noise.
        perceptual: an additional term of the loss.
        context: threads.

    Attributes:
        parameters: the state of the optimisation.
        screen: gradients on screen since the last densification, if the strategy uses them.
    """

    def __init__(
        self,
        parameters: Parameters,
        options: TrainOptions,
        perceptual: PerceptualLoss | None = None,
        *,
        context: Context = DEFAULT_CONTEXT,
    ) -> None:
        self.parameters = parameters
        self.screen = ScreenGradients.none(len(parameters)) if options.strategy == "gradient" else None
        self._options = options
        self._perceptual = perceptual
        self._context = replace(context, progress=null_progress)
        self._samples = options.strategy in ("mcmc", "fixed")  # Markov chain: noise and regularisers
        self._rasteriser = Rasteriser(context=self._context)
        self._losses = SizedLosses(options.loss)
        self._normals = np.empty((0, 3), np.float32)
        self._radii = np.empty(0, np.float32)  # [N], radii in the last render, pixels

    def step(
        self,
        image: PosedImage,
        background: F32,
        degree: int,
        rates: dict[str, float],
        rng: Generator,
        gain: ImageGain | None = None,
    ) -> LossValue:
        """Make a training step on an image.

        Args:
            image: the image to fit.
            background: [3], background of image and render.
            degree: active SH degree.
            rates: learning rate of each group of parameters.
            rng: source of the noise.
            gain: gain and bias of the image, if they are trained.

        Returns:
            The photometric loss before the step.
        """
        options, camera = self._options, image.camera
        loss, target = self._losses.of(camera)
        compose(image, background, target)
        rgb = self.render(camera, background, degree)
        shown = rgb if gain is None else gain.apply(rgb)
        value, slope = loss(shown, target, image.mask)
        if self._perceptual is not None:
            slope += self._perceptual.gradient(shown, target, options.lpips_weight)
        if gain is not None:
            slope = gain.backward(rgb, slope)
        values, count = self.parameters.values, max(1, len(self.parameters))
        norms = None if self.screen is None else np.empty_like(values["logits"])
        step = self.parameters.next_step(
            rates,
            opacity_weight=options.opacity_weight / count if self._samples else 0.0,
            scale_weight=options.scale_weight / (3 * count) if self._samples else 0.0,
            means2d=norms,
        )
        self._rasteriser.descend(step, slope)
        if self.screen is not None and norms is not None:
            self.screen.add(_per_half_image(norms, camera), self._radii > 0)
        if self._samples and options.noise > 0.0:
            if self._normals.shape != values["means"].shape:
                self._normals = np.empty_like(values["means"])
            rng.standard_normal(out=self._normals, dtype=np.float32)
            add_noise(self.parameters, options.noise * rates["means"], self._normals)
        return value

    def render(self, camera: Camera, background: F32, degree: int) -> F32:
        """Render the current state, [H, W, 3]; keeps the radii for `step`."""
        v = self.parameters.values
        splats = UncheckedSplats(v["means"], v["quats"], v["scales"], v["logits"], v["sh0"], v["shN"])
        result = self._rasteriser.forward(
            splats, camera, background=background, antialiased=self._options.antialiased, sh_degree=degree, logits=True
        )
        self._radii = result.radii
        return result.rgb

    def measure_pruning(self, cameras: Sequence[Camera], background: F32) -> PruningError:
        """Measure the pruning errors of the splats in some views; arguments as for `measure_pruning_error`."""
        model = to_model(self.parameters.values, antialiased=self._options.antialiased)
        return measure_pruning_error(model, cameras, background=background, context=self._context)


def _per_half_image(norms: F32, camera: Camera) -> F32:
    """Convert gradient norms [N] per pixel into norms per half an image, the unit of `grad_threshold`."""
    return norms * np.float32(0.5 * max(camera.W, camera.H))
