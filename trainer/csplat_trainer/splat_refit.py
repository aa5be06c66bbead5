# SPDX-License-Identifier: Apache-2.0
"""Refit kept splats to renders of the source by gradient descent.

Colours, opacities, scales and rotations are fitted together, one small view per step, so that neighbours of pruned
splats cover for them, and other values compensate for quantisation. The step length is proportional to the error. Least
squares over all views at once (linear for colours alone) overfit the training views. Descent does not, and gains the
same on held-out views after three passes over the views. Centres are fixed unless the caller frees them, since scenes
with few views get worse if they move.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder import FixedQuantisation, FreeValues
from csplat.encoder.entropy import morton_codes
from csplat.model import SplatModel
from csplat.portable_math import exp
from csplat.scene import join_blocks
from csplat.types import F16, F32, I64
from csplat_render import Camera
from csplat_render.conventions import Gradients, HasSplats, UncheckedSplats
from csplat_render.metrics import squared_error
from csplat_render.rasteriser import AdamStep, Rasteriser
from csplat_trainer.fitter import COUNT_EVERY, Fitter
from csplat_trainer.losses import LossValue
from csplat_trainer.parameters import Parameters, from_model
from csplat_trainer.tuned_scene import TunedScene

#: Learning rates of the first steps per unit of the root mean square error, which is limited to `_LARGEST_ERROR`.
_RATES = {"logits": 1.95, "scales": 0.39, "quats": 0.023, "sh0": 0.1, "shN": 0.04, "offsets": 0.39}
_SH_FACTOR = 2.0  # factor of the step length for scenes without SH; not used through quantisers
_LARGEST_ERROR = 0.04  # root mean square error, 0 to 1, above which steps do not get longer
_BETA2 = 0.98  # Adam's decay rate of squared gradients; errors fall too fast for a longer memory
_LAST_RATE = 0.02  # fraction of the learning rates in the last steps
_RATE_EXPONENT = 0.07 * 10.0 / math.log(10.0)  # k of bytes ∝ error^-k, for 7 % of the bytes per dB after a refit
_LEAST_QUANTISED = 0.1  # least fraction of a file's error that is attributed to quantisation
_CENTRE_BITS = 24.0  # typical bits of a splat's centre, which is fixed
_SIZE_LIMIT = 60.0  # largest logarithm of a size, so that exponentials stay finite
_CELLS = float(2**20 - 1)  # cells per axis of the Morton curve along which splats are sorted
_SAMPLE = 8  # every Nth view is rendered to measure the error


def refit_splats(
    model: SplatModel,
    cameras: Sequence[Camera],
    references: Sequence[F32 | F16],
    *,
    steps: int,
    background: ArrayLike = (0.0, 0.0, 0.0),
    backdrop: SplatModel | None = None,
    moves: bool = False,
    context: Context = DEFAULT_CONTEXT,
) -> SplatModel:
    """Move colours, opacities, scales and rotations along the gradient of the squared error, view by view.

    Args:
        model: the scene.
        cameras: the views.
        references: [H, W, 3] float32 or float16, the reference image of each view.
        steps: number of steps, one view each.
        background: red, green, blue behind the splats.
        backdrop: splats of the rest of the scene, which are rendered with it and not changed.
        moves: fit the centres instead of `shN`, whose values codebooks then still have; `means_double` is dropped.
        context: threads, progress, and the seed of the order of the views.

    Returns:
        The scene; splats that no view shows are unchanged.
    """
    views = _TrainingViews(cameras, references, background, model.metadata.antialiased, context)
    order = _order_in_space(model.means)  # makes a step up to a fifth faster
    shown = model.select(order)
    if backdrop is not None:
        shown = join_blocks(shown, [shown, backdrop])
    refit = _FloatRefit(views, steps, context, shown, moves=moves, fitted_count=len(model))
    factor = 1.0 if model.sh_degree else _SH_FACTOR
    refit.run(factor * _step_length(views.rms(refit.splats())))
    return refit.applied_to(shown).select(np.argsort(order))


def _order_in_space(means: F32) -> I64:
    """Return the rows [N] of finite means [N, 3] along a Morton curve, so that neighbours are close in memory."""
    places = means.astype(np.float64) - means.min(axis=0, initial=0.0)
    places *= _CELLS / max(float(places.max(initial=0.0)), float(np.finfo(np.float32).tiny))
    return np.argsort(morton_codes(places.T.astype(np.int32)), kind="stable")


def quantisation_aware_refit(
    fixed: FixedQuantisation,
    cameras: Sequence[Camera],
    references: Sequence[F32 | F16],
    *,
    steps: int,
    before: SplatModel,
    background: ArrayLike = (0.0, 0.0, 0.0),
    context: Context = DEFAULT_CONTEXT,
) -> FreeValues:
    """Refit splats through the quantisers of a file, as the decoded file would render them; weigh its bytes.

    Args:
        fixed: the encoder's quantisation.
        cameras, references, steps, background, context: as for `refit_splats`.
        before: the same splats before any refit through quantisers; their error is not due to quantisation.

    Returns:
        Values for `FixedQuantisation.encode`.
    """
    model = fixed.encode_plan.model
    views = _TrainingViews(cameras, references, background, model.metadata.antialiased, context)
    refit = _QuantisedRefit(views, steps, context, fixed)
    rms, pruning_rms = views.rms(refit.scene.dequantise()[0]), views.rms(before)
    quantised = max(rms**2 - pruning_rms**2, _LEAST_QUANTISED * rms**2)
    if math.isfinite(quantised):
        value_count = sum(image.size for image in references) / len(references)
        # Growth of the error per saved fraction of the bytes; halved, since views give half of the gradient.
        refit.lambda_ = 0.5 * quantised * value_count / _RATE_EXPONENT
    refit.run(_step_length(rms))
    return refit.scene.free_values.copy()


class _TrainingViews:
    """Training views with their reference images."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        references: Sequence[F32 | F16],
        background: ArrayLike,
        antialiased: bool,
        context: Context,
    ) -> None:
        self._cameras, self._references = cameras, references
        self._background, self._antialiased = background, antialiased
        self._rasteriser = Rasteriser(context=context)

    def __len__(self) -> int:
        return len(self._cameras)

    def _reference(self, view: int) -> F32:
        """Return the reference image of a view, [H, W, 3] float32."""
        return np.asarray(self._references[view], np.float32)

    def rms(self, splats: HasSplats) -> float:
        """Return the root mean square error over a sample of the views."""
        errors = []
        for view in range(0, len(self), _SAMPLE):
            render = self._rasteriser.forward(
                splats, self._cameras[view], background=self._background, antialiased=self._antialiased
            )
            errors.append(np.mean(squared_error(self._reference(view), render.rgb)))
        return math.sqrt(np.mean(errors))

    def gradients(self, splats: HasSplats, view: int) -> tuple[float, Gradients]:
        """Return the mean squared error of a view's render, and the gradients of half its sum."""
        reference = self._reference(view)
        error, gradients = self._rasteriser.error_gradients(
            splats, self._cameras[view], reference, background=self._background, antialiased=self._antialiased
        )
        return error / max(1, reference.size), gradients

    def refit(self, splats: UncheckedSplats, view: int, step: AdamStep) -> float:
        """Make a step on splats with logits along the gradient of half the squared error; return the mean before."""
        reference = self._reference(view)
        error = self._rasteriser.refit(
            splats, self._cameras[view], reference, step, background=self._background, antialiased=self._antialiased
        )
        return error / max(1, reference.size)


def _step_length(rms: float) -> float:
    """Return the length of the first steps for a root mean square error, 0 if that is not finite."""
    return min(rms, _LARGEST_ERROR) if math.isfinite(rms) else 0.0


class _Refit:
    """A refit to training views by a `Fitter`, with steps that become shorter along half a cosine.

    Args:
        views: at least one.
        steps: number of steps; each pass over the views has a random order of its own.
        context: progress, and the seed of these orders.
    """

    def __init__(self, views: _TrainingViews, steps: int, context: Context) -> None:
        self._views, self._context = views, context
        self._length = 0.0  # length of the first steps, set by `run`
        self._fitter = Fitter(len(views), steps, context.seed)
        passes = [self._fitter.rng.permutation(len(views)) for _ in range(-(-steps // len(views)))]
        self._fitter.queue = np.concatenate(passes)[:steps][::-1].tolist()  # the last is the next

    def run(self, length: float) -> None:
        """Make all steps, the first of this length."""
        self._length = length
        self._fitter.run(self)

    def step(self, view: int) -> LossValue:
        fitter = self._fitter
        factor = max(_LAST_RATE, 0.5 + 0.5 * math.cos(math.pi * fitter.iteration / fitter.iterations))
        error = self._make_step(view, {name: self._length * factor * rate for name, rate in _RATES.items()})
        return LossValue(error, math.nan, math.nan, error)

    def after_step(self) -> None:
        self._context.progress("refitting splats", self._fitter.iteration / self._fitter.iterations)

    def _make_step(self, view: int, rates: dict[str, float]) -> float:
        """Make a step on a view, and return its mean squared error before."""
        raise NotImplementedError


class _FloatRefit(_Refit):
    """A refit of values without quantisation.

    Args:
        views, steps, context: as for `_Refit`.
        model: the scene.
        moves: fit the centres instead of `shN`.
        fitted_count: number of splats to fit, the first ones.
    """

    def __init__(
        self,
        views: _TrainingViews,
        steps: int,
        context: Context,
        model: SplatModel,
        *,
        moves: bool,
        fitted_count: int,
    ) -> None:
        super().__init__(views, steps, context)
        self._start, self._moves, self._fitted_count = model, moves, fitted_count
        values = _values_to_fit(model)
        if moves:
            del values["shN"]
            values["means"] = model.means.copy()
            limited = np.clip(model.scales.mean(axis=1), -_SIZE_LIMIT, _SIZE_LIMIT)
            self._sizes = exp(limited).astype(np.float32)  # unit of their steps
        self._parameters = Parameters.starting_at(values)
        self._parameters.beta2 = _BETA2

    def splats(self) -> UncheckedSplats:
        """Return the splats to render."""
        return replace(self._fitted(), opacities=self._parameters.alphas)

    def _fitted(self) -> UncheckedSplats:
        """Return the splats with logits for opacities, in the arrays that steps change."""
        v, start = self._parameters.values, self._start
        return UncheckedSplats(
            v.get("means", start.means), v["quats"], v["scales"], v["logits"], v["sh0"], v.get("shN", start.shN)
        )

    def _make_step(self, view: int, rates: dict[str, float]) -> float:
        sizes = self._sizes if self._moves else None
        step = self._parameters.next_step(
            {**rates, "means": rates["offsets"]}, mean_sizes=sizes, fitted_count=self._fitted_count
        )
        return self._views.refit(self._fitted(), view, step)

    def applied_to(self, before: SplatModel) -> SplatModel:
        """Return the scene with the changed values; unchanged and overflowed splats are kept bit for bit.

        This releases the optimiser's state, so no step may follow.
        """
        self._parameters.first, self._parameters.second = {}, {}  # each as large as the scene
        values, alphas, start = self._parameters.values, self._parameters.alphas, _values_to_fit(before)
        moved = np.zeros(len(before), bool)
        for name in values.keys() & {"logits", "scales", "sh0", "shN"}:
            moved |= (values[name] != start[name]).reshape(len(before), -1).any(axis=1)
        means = self.splats().means
        moved &= np.isfinite(means).all(axis=1)
        for array in values.values():
            moved &= np.isfinite(array).reshape(len(before), -1).all(axis=1)
        rows = moved[:, None]
        if self._moves:
            before = replace(before, means=np.where(rows, means, before.means), means_double=None)
        else:
            before = replace(before, shN=np.where(rows[:, :, None], values["shN"], before.shN))
        return replace(
            before,
            opacities=np.where(moved, alphas, before.opacities),
            quats=np.where(rows, values["quats"], before.quats),
            scales=np.where(rows, values["scales"], before.scales),
            sh0=np.where(rows, values["sh0"], before.sh0),
        )


def _values_to_fit(model: SplatModel) -> dict[str, F32]:
    """Return the parameters of a model's splats but for the means."""
    values = from_model(model, model.sh_degree)
    del values["means"]
    return values


class _QuantisedRefit(_Refit):
    """A refit through quantisers; `lambda_` is the squared error of a render that all bits are worth."""

    def __init__(self, views: _TrainingViews, steps: int, context: Context, fixed: FixedQuantisation) -> None:
        super().__init__(views, steps, context)
        self.lambda_ = 0.0
        self.scene = TunedScene(fixed)
        self.scene.parameters.beta2 = _BETA2

    def _make_step(self, view: int, rates: dict[str, float]) -> float:
        fitter, (seen, alphas) = self._fitter, self.scene.dequantise()
        error, gradients = self._views.gradients(seen, view)
        if self.lambda_ and (fitter.iteration - 1) % COUNT_EVERY == 0:
            fitter.rate = self.scene.count(seen, 1.0)
            fitter.rate.weight = self.lambda_ * len(alphas) / (fitter.rate.bits + _CENTRE_BITS * len(alphas))
        rates = {**rates, "means": 0.0, "sizes": rates["scales"]}
        self.scene.step(gradients, seen, alphas, rates, fitter.rate)
        return error
