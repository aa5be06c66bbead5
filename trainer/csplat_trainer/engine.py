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
from csplat_render.kernels import lane_range, parallel_kernel
from csplat_render.pruning_error import PruningError, measure_pruning_error
from csplat_render.rasteriser import Rasteriser
from csplat_trainer.image_gains import ImageGain
from csplat_trainer.losses import LossValue, PendingLoss, PerceptualLoss, SizedLosses
from csplat_trainer.parameters import Parameters, adam_step, to_model
from csplat_trainer.posed_images import PosedImage, compose
from csplat_trainer.strategies import ScreenGradients, add_noise
from csplat_trainer.training_options import TrainOptions

_MAX_LOG_SCALE = 40.0  # largest log scale whose gradient Adam can square in float32


class Engine(Protocol):
    """A training engine, with numba kernels on the CPU or gsplat on a GPU."""

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
    """A training engine in numba, which reuses its buffers.

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
        self._rasteriser = Rasteriser("standard", np.float32, context=self._context)
        self._losses = SizedLosses(options.loss)
        self._alphas = np.empty(0, np.float32)
        self._logit_gradient = np.empty(0, np.float32)
        self._normals = np.empty((0, 3), np.float32)

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
        rgb = self._forward(camera, background, degree)
        shown = rgb if gain is None else gain.apply(rgb)
        value, slope = loss(shown, target, image.mask)
        if self._perceptual is not None:
            slope += self._perceptual.gradient(shown, target, options.lpips_weight)
        if gain is not None:
            slope = gain.backward(rgb, slope)
        gradients = self._rasteriser.backward(slope)
        values, count = self.parameters.values, max(1, len(self.parameters))
        _propagate_to_logits(
            self._alphas,
            gradients.opacities,
            values["scales"],
            gradients.scales,
            np.float32(options.opacity_weight / count if self._samples else 0.0),
            np.float32(options.scale_weight / (3 * count) if self._samples else 0.0),
            self._logit_gradient,
        )
        if self.screen is not None:
            self.screen.add(_per_half_image(gradients.means2d, camera), gradients.radii > 0)
        steps = {
            "means": gradients.means,
            "quats": gradients.quats,
            "scales": gradients.scales,
            "logits": self._logit_gradient,
            "sh0": gradients.sh0,
            "shN": gradients.shN,
        }
        adam_step(self.parameters, steps, rates)
        if self._samples and options.noise > 0.0:
            if self._normals.shape != values["means"].shape:
                self._normals = np.empty_like(values["means"])
            rng.standard_normal(out=self._normals, dtype=np.float32)
            add_noise(self.parameters, options.noise * rates["means"], self._normals)
        return value

    def render(self, camera: Camera, background: F32, degree: int) -> F32:
        """Render the current state, [H, W, 3], into a buffer that the next render overwrites."""
        return self._forward(camera, background, degree)

    def measure_pruning(self, cameras: Sequence[Camera], background: F32) -> PruningError:
        """Measure the pruning errors of the splats in some views; arguments as for `measure_pruning_error`."""
        model = to_model(self.parameters.values, antialiased=self._options.antialiased)
        return measure_pruning_error(model, cameras, background=background, context=self._context)

    def _forward(self, camera: Camera, background: F32, degree: int) -> F32:
        """Render the current state, [H, W, 3], for `backward`; sets the opacities, which `step` uses afterwards."""
        v = self.parameters.values
        if len(self._alphas) != len(v["logits"]):
            self._alphas, self._logit_gradient = np.empty_like(v["logits"]), np.empty_like(v["logits"])
        _activate(v["logits"], self._alphas)
        splats = UncheckedSplats(v["means"], v["quats"], v["scales"], self._alphas, v["sh0"], v["shN"])
        result = self._rasteriser.forward(
            splats, camera, background=background, antialiased=self._options.antialiased, sh_degree=degree
        )
        return result.rgb


def _per_half_image(norms: F32, camera: Camera) -> F32:
    """Convert gradient norms [N] per pixel into norms per half an image, the unit of `grad_threshold`."""
    return norms * np.float32(0.5 * max(camera.W, camera.H))


@parallel_kernel(relaxed=True)
def _activate(lane: int, lanes: int, logits: F32, alphas: F32) -> None:
    """Compute opacities [N] from logits [N]; vectorises over splats."""
    one = np.float32(1.0)
    first, end = lane_range(lane, lanes, len(logits))
    x, y = logits[first:end], alphas[first:end]
    for i in range(len(x)):
        y[i] = one / (one + np.exp(-x[i]))


@parallel_kernel(relaxed=True)
def _propagate_to_logits(
    lane: int,
    lanes: int,
    alphas: F32,
    by_alpha: F32,
    scales: F32,
    by_scale: F32,
    opacity_weight: np.float32,
    scale_weight: np.float32,
    by_logit: F32,
) -> None:
    """Propagate gradients to logits, and add the gradients of both regularisers; vectorises over splats.

    Args:
        alphas: [N].
        by_alpha: [N], gradient by opacity.
        scales: [N, 3], logarithms.
        by_scale: [N, 3], gradient by log-scale; the regulariser's is added.
        opacity_weight: weight of the sum of opacities.
        scale_weight: weight of the sum of standard deviations.
        by_logit: [N], written.
    """
    first, end = lane_range(lane, lanes, len(alphas))
    alphas, by_alpha, by_logit = alphas[first:end], by_alpha[first:end], by_logit[first:end]
    scales, by_scale = scales[first:end], by_scale[first:end]
    for i in range(end - first):
        alpha = alphas[i]
        by_logit[i] = (by_alpha[i] + opacity_weight) * alpha * (np.float32(1.0) - alpha)
        if scale_weight > np.float32(0.0):
            for k in range(3):
                by_scale[i, k] += scale_weight * np.exp(min(scales[i, k], np.float32(_MAX_LOG_SCALE)))
