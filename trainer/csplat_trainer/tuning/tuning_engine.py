# SPDX-License-Identifier: Apache-2.0
"""Steps of fine-tuning: render decoded values, compare, and move the values of the file; on the CPU, without torch."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder import DecodedValues, FixedQuantisation, FreeValues
from csplat.types import F32
from csplat_render.rasteriser import Rasteriser
from csplat_trainer.image_gains import ImageGain
from csplat_trainer.losses import LossValue, PendingLoss, SizedLosses
from csplat_trainer.parameters import Parameters
from csplat_trainer.tuned_scene import RateTerm, TunedScene
from csplat_trainer.tuning.tuning_options import FinetuneOptions
from csplat_trainer.tuning.tuning_views import TuningView


class TuningEngine(Protocol):
    """An engine of fine-tuning, on the CPU, or with gsplat on a GPU."""

    @property
    def parameters(self) -> Parameters:
        """The state of the optimisation."""
        ...

    def count(self, weight: float) -> RateTerm:
        """Count the bits of the file's integers; `weight` is lambda, loss per bit and splat."""
        ...

    def step(
        self, view: TuningView, gain: ImageGain | None, rates: dict[str, float], costs: RateTerm | None
    ) -> PendingLoss:
        """Make a step on a view, and return the loss before, without the rate term."""
        ...

    def score(self, view: TuningView, gain: ImageGain | None) -> tuple[LossValue, float]:
        """Return the loss of a view, and the squared error summed over the values that count, clipped to 0..1."""
        ...

    def free_values(self) -> FreeValues:
        """Return a copy of the values for the encoder."""
        ...


class CpuTuning:
    """An engine on the CPU.

    Args:
        fixed: the encoder's decisions.
        options: options of the tuning.
        background: [3].
        parameters: state to continue from; `None`: the values that the encoder found.
        context: threads.
    """

    def __init__(
        self,
        fixed: FixedQuantisation,
        options: FinetuneOptions,
        background: F32,
        parameters: Parameters | None = None,
        context: Context = DEFAULT_CONTEXT,
    ) -> None:
        self._scene = TunedScene(fixed, parameters)
        self._background, self._antialiased = background, fixed.encode_plan.model.metadata.antialiased
        self._rasteriser = Rasteriser(context=context)
        self._losses = SizedLosses(options.loss)

    @property
    def parameters(self) -> Parameters:
        """The state of the optimisation."""
        return self._scene.parameters

    def count(self, weight: float) -> RateTerm:
        """Count the bits of the file's integers; `weight` is lambda, loss per bit and splat."""
        return self._scene.count(self._scene.dequantise()[0], weight)

    def step(
        self, view: TuningView, gain: ImageGain | None, rates: dict[str, float], costs: RateTerm | None
    ) -> LossValue:
        """Make a step on a view, and return the loss before, without the rate term.

        Args:
            view: the view.
            gain: gain and bias of the image, if they are trained.
            rates: learning rate of each group.
            costs: the rate term, if any.
        """
        seen, alphas = self._scene.dequantise()
        rendered = self._render(seen, view)
        loss, buffer = self._losses.of(view.camera)
        shown = rendered if gain is None else gain.apply(rendered)
        value, slope = loss(shown, view.image(self._background, buffer), view.mask)
        if gain is not None:
            slope = gain.backward(rendered, slope)
        self._scene.step(self._rasteriser.backward(slope), seen, alphas, rates, costs)
        return value

    def score(self, view: TuningView, gain: ImageGain | None) -> tuple[LossValue, float]:
        """Return the loss of a view, and the squared error summed over the values that count, clipped to 0..1."""
        (loss, buffer), rendered = self._losses.of(view.camera), self._render(self._scene.dequantise()[0], view)
        if gain is not None:
            rendered = gain.apply(rendered)
        reference = view.image(self._background, buffer)
        value = loss(rendered, reference, view.mask)[0]  # copies pixels that do not count from the render
        error = np.square(np.clip(rendered, 0, 1) - np.clip(reference, 0, 1)).sum(dtype=np.float64)
        return value, float(error)

    def free_values(self) -> FreeValues:
        """Return a copy of the values for the encoder."""
        return self._scene.free_values.copy()

    def _render(self, seen: DecodedValues, view: TuningView) -> F32:
        """Render decoded values in a view, [H, W, 3], for `backward`; the next render overwrites the result."""
        return self._rasteriser.forward(
            seen, view.camera, background=self._background, antialiased=self._antialiased
        ).rgb
