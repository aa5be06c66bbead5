"""Refit kept splats to renders of the source by gradient descent, and choose the SH bands that they need.

Colours, opacities, scales and rotations are fitted together, one small view per step, so that neighbours of pruned
splats cover for them, and other values compensate for quantisation. The step length is proportional to the error. Least
squares over all views at once (linear for colours alone) overfit the training views; descent does not, and after three
passes over the views gains the same on held-out views. Centres are fixed, since otherwise scenes with few views get
worse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import FixedQuantisation, FreeValues
from csplat.model import SplatModel
from csplat.types import F32, Mask, Progress
from csplat_render import Camera
from csplat_render.conventions import Gradients, HasSplats, UncheckedSplats
from csplat_render.metrics import squared_error
from csplat_render.pruning_error import PruningError, measure_pruning_error
from csplat_render.rasteriser import Rasteriser
from csplat_tools.optimise.pruning_order import SimplifyOptions
from csplat_tools.optimise.rate_distortion import LEAST_QUANTISED, rate_exponent
from csplat_trainer.parameters import Parameters, adam_step, from_model
from csplat_trainer.tuning.tuned_scene import RateTerm, TunedScene

#: Steps of a refit, and of the one after bands were dropped.
FIT_STEPS, BAND_STEPS = 960, 160
#: Largest errors of bands 1, 2, 3 that are not worth their bits, as fractions of the scene's error per splat. At the
#: optimum, every bit reduces the error by the same amount. A splat has some 30 quantised values, whose error is half of
#: the total, and a bit reduces its value's error by 2 ln 2; bands of 9, 15 and 21 values take 1.5 bits per value.
BAND_COST = (0.25, 0.4, 0.55)


def choose_bands(pruning_error: PruningError, error: float) -> Mask:
    """Return a mask of the bands to keep, [N, d].

    Args:
        pruning_error: errors of removing each band from the scene.
        error: squared error of the scene per splat, summed over the views of `pruning_error`.

    Splats that no view saw keep all bands.
    """
    costs = np.array(BAND_COST[: pruning_error.bands.shape[1]])
    kept_bands: Mask = (pruning_error.bands > error * costs) | ~pruning_error.seen[:, None]
    return kept_bands


def coefficient_mask(kept_bands: Mask) -> Mask:
    """Return a mask of the SH coefficients beyond the first that belong to kept bands, [N, (d + 1)² − 1]."""
    columns = [np.zeros((len(kept_bands), 0), bool)]
    columns += [
        np.repeat(kept_bands[:, band - 1 : band], 2 * band + 1, axis=1) for band in range(1, kept_bands.shape[1] + 1)
    ]
    return np.concatenate(columns, axis=1)


def drop_bands(model: SplatModel, kept_bands: Mask) -> SplatModel:
    """Return the scene with zeros in the bands that are not kept."""
    return replace(model, shN=model.shN * coefficient_mask(kept_bands)[:, :, None].astype(np.float32))


#: Learning rates of the first steps per unit of the root mean square error, which is limited to `_LARGEST_ERROR`.
_RATES = {"logits": 1.95, "scales": 0.39, "quats": 0.023, "sh0": 0.1, "shN": 0.04}
_SH_FACTOR = 2.0  # factor of the step length for scenes without SH; not used through quantisers
_LARGEST_ERROR = 0.04  # root mean square error, 0 to 1, above which steps do not get longer
_BETA2 = 0.98  # Adam's decay rate of squared gradients; errors fall too fast for a longer memory
_LAST_RATE = 0.02  # fraction of the learning rates in the last steps
_SLOPE = 0.07  # typical fraction of the bytes that a decibel costs after a refit
_COUNT_EVERY = 50  # steps between counts of a file's integers
_CENTRE_BITS = 24.0  # typical bits of a splat's centre, which is fixed
_SAMPLE = 8  # every Nth view is rendered to measure the error


def refit_splats(
    model: SplatModel,
    cameras: Sequence[Camera],
    references: Sequence[F32],
    options: SimplifyOptions,
    *,
    steps: int,
    free: Mask | None = None,
    progress: Progress | None = None,
) -> SplatModel:
    """Move colours, opacities, scales and rotations along the gradient of the squared error, view by view.

    Args:
        model: the scene.
        cameras: the views.
        references: [H, W, 3], the reference image of each view.
        options: background, seed of the order of views, threads.
        steps: number of steps, one view each.
        free: [N, K], mask of the SH coefficients beyond the first that may change; `None` for all.
        progress: progress callback.

    Returns:
        The scene; splats that no view shows are unchanged.
    """
    values, views = _FloatValues.of(model, free), _TrainingViews(cameras, references, options, model.antialiased)
    factor = 1.0 if model.sh_degree else _SH_FACTOR
    _descend(values, views, steps, factor * _step_length(views.rms(values.splats())), progress)
    return values.applied_to(model)


def quantisation_aware_refit(
    fixed: FixedQuantisation,
    cameras: Sequence[Camera],
    references: Sequence[F32],
    options: SimplifyOptions,
    *,
    steps: int,
    progress: Progress | None = None,
) -> FreeValues:
    """Refit splats through the quantisers of a file, so that renders are those of the decoded file; weigh its bytes.

    Args:
        fixed: the encoder's quantisation.
        cameras, references, options, steps, progress: as for `refit_splats`.

    Returns:
        Values for `FixedQuantisation.encode`.
    """
    model, values = fixed.encode_plan.model, _QuantisedValues(TunedScene(fixed))
    values.tuned.parameters.beta2 = _BETA2
    views = _TrainingViews(cameras, references, options, model.antialiased)
    rms, pruning_rms = views.rms(values.splats()), views.rms(model)
    quantised = max(rms**2 - pruning_rms**2, LEAST_QUANTISED * rms**2)
    if math.isfinite(quantised):
        value_count = sum(image.size for image in references) / len(references)
        # Growth of the error per saved fraction of the bytes; halved, since views give half of the gradient.
        values.lambda_ = 0.5 * quantised * value_count / rate_exponent(_SLOPE)
    _descend(values, views, steps, _step_length(rms), progress)
    return values.tuned.free_values.copy()


def unrounded_model(fixed: FixedQuantisation, values: FreeValues) -> SplatModel:
    """Return the splats with values as they are before quantisation, from which another `EncodePlan` may start.

    Args:
        fixed: the encoder's quantisation.
        values: its values, for example of `quantisation_aware_refit`.

    Returns:
        The splats in the order of their indices in the source, in canonical axis order. Splats of a codebook's entry
        share its values; SH bands beyond the degree kept are zero.
    """
    model, book, shapes = fixed.encode_plan.model, fixed.book, fixed.shapes
    sh, quats, scales = values.sh, values.quats, values.scales
    if book is not None:
        sh = sh[_rows_of(book.index, book.size)]
    if shapes is not None:
        rows = _rows_of(shapes.index, shapes.size)
        quats, scales = quats[rows], scales[rows] + values.sizes[:, None]
    shN = np.zeros_like(model.shN)
    shN[:, : sh.shape[1]] = sh
    model = replace(
        model, means=values.means, quats=quats, scales=scales, opacities=values.opacities, sh0=values.sh0, shN=shN,
        means_double=None,
    )  # fmt: skip
    return model.select(np.argsort(fixed.source_index))


def _rows_of(index: NDArray[np.int32], size: int) -> NDArray[np.int64]:
    """Return each splat's row of `FreeValues`: its entry, or its own row behind the entries if it is escaped."""
    escaped = index == size
    return np.where(escaped, size - 1 + np.cumsum(escaped), index)


@dataclass(frozen=True, eq=False)
class RefitResult:
    """A refitted scene.

    Attributes:
        model: the scene.
        kept_bands: [N, d], mask of the kept SH bands; `None` if bands were not chosen.
    """

    model: SplatModel
    kept_bands: Mask | None


def refit_with_bands(
    model: SplatModel,
    cameras: Sequence[Camera],
    references: Sequence[F32],
    options: SimplifyOptions,
    *,
    band_views: int | None = None,
    progress: Progress | None = None,
) -> RefitResult:
    """Refit the splats, set bands to zero that are not worth their bits, and refit the others again.

    Args:
        model: the scene, with the source's values.
        cameras: the views.
        references: [H, W, 3], the source's render of each view.
        options: `refit` and `bands`, effort, background.
        band_views: choose bands by the first views, of this number; `None`: all.
        progress: progress callback.
    """
    if options.refit:
        model = refit_splats(model, cameras, references, options, steps=options.steps(FIT_STEPS), progress=progress)
    if not options.bands or not model.sh_degree:
        return RefitResult(model, None)
    error = 0.0

    def add(number: int, render: NDArray[np.float32]) -> None:
        nonlocal error
        error += float(np.sum(squared_error(references[number], render)))

    pruning_error = measure_pruning_error(
        model,
        cameras[:band_views],
        background=options.background,
        on_render=add,
        threads=options.threads,
        progress=progress,
    )
    kept_bands = choose_bands(pruning_error, error / max(1, len(model)))
    if not kept_bands.all():
        model = drop_bands(model, kept_bands)
        if options.refit:
            free = coefficient_mask(kept_bands)
            model = refit_splats(
                model, cameras, references, options, steps=options.steps(BAND_STEPS), free=free, progress=progress
            )
    return RefitResult(model, kept_bands)


class _FittedValues(Protocol):
    """The fitted values, and the splats to render."""

    def splats(self) -> UncheckedSplats: ...

    def step(self, gradients: Gradients, rates: dict[str, float]) -> None: ...


class _TrainingViews:
    """Training views with their reference images."""

    def __init__(
        self, cameras: Sequence[Camera], references: Sequence[F32], options: SimplifyOptions, antialiased: bool
    ) -> None:
        self.cameras, self.references, self.seed = cameras, references, options.seed
        self.rasteriser = Rasteriser(threads=options.threads)
        self._background, self._antialiased = options.background, antialiased

    def error_image(self, splats: HasSplats, view: int) -> F32:
        """Return the error of a view's render, [H, W, 3]; positive if it is too bright."""
        render = self.rasteriser.forward(
            splats, self.cameras[view], background=self._background, antialiased=self._antialiased
        )
        # Straight-through gradient of the clipping: a colour above 1 is reduced only if the reference is darker.
        return np.clip(render.rgb, 0.0, 1.0) - np.clip(self.references[view], 0.0, 1.0)

    def rms(self, splats: HasSplats) -> float:
        """Return the root mean square error over a sample of the views."""
        sample = range(0, len(self.cameras), _SAMPLE)
        errors = [np.mean(np.square(self.error_image(splats, view), dtype=np.float64)) for view in sample]
        return math.sqrt(np.mean(errors))


def _step_length(rms: float) -> float:
    """Return the length of the first steps for a root mean square error, 0 if that is not finite."""
    return min(rms, _LARGEST_ERROR) if math.isfinite(rms) else 0.0


def _descend(
    values: _FittedValues, views: _TrainingViews, steps: int, length: float, progress: Progress | None
) -> None:
    """Fit the values of a scene by Adam."""
    count = len(views.cameras)
    rng = np.random.default_rng(views.seed)
    order = np.concatenate([rng.permutation(count) for _ in range(-(-steps // count))])
    for step, view in enumerate(order[:steps]):
        gradients = views.rasteriser.backward(views.error_image(values.splats(), view))
        rate_factor = max(_LAST_RATE, 0.5 + 0.5 * math.cos(math.pi * (step + 1) / steps))
        values.step(gradients, {name: length * rate_factor * rate for name, rate in _RATES.items()})
        if progress is not None:
            progress("adjusting splats", (step + 1) / steps)


@dataclass(eq=False)
class _FloatValues:
    """Values without quantisation."""

    means: F32
    parameters: Parameters
    free: Mask | None

    @classmethod
    def of(cls, model: SplatModel, free: Mask | None) -> _FloatValues:
        parameters = Parameters.starting_at(_values_to_fit(model))
        parameters.beta2 = _BETA2
        return cls(model.means, parameters, free)

    def splats(self) -> UncheckedSplats:
        v = self.parameters.values
        return UncheckedSplats(self.means, v["quats"], v["scales"], self.parameters.alphas, v["sh0"], v["shN"])

    def step(self, gradients: Gradients, rates: dict[str, float]) -> None:
        alphas = self.parameters.alphas
        slopes: dict[str, Any] = {name: getattr(gradients, name) for name in ("quats", "scales", "sh0", "shN")}
        slopes["logits"] = gradients.opacities * alphas * (np.float32(1.0) - alphas)
        if self.free is not None:
            gradients.shN[:] *= self.free[:, :, None]  # the rasteriser's buffer, valid until its next pass
        adam_step(self.parameters, slopes, rates)

    def applied_to(self, before: SplatModel) -> SplatModel:
        """Return the scene with the changed values; unchanged and overflowed splats are kept bit for bit.

        This releases the optimiser's state, so no step may follow.
        """
        self.parameters.first, self.parameters.second = {}, {}  # each as large as the scene
        values, alphas, start = self.parameters.values, self.parameters.alphas, _values_to_fit(before)
        moved = np.zeros(len(before), bool)
        for name in ("logits", "scales", "sh0", "shN"):
            moved |= (values[name] != start[name]).reshape(len(before), -1).any(axis=1)
        for array in values.values():
            moved &= np.isfinite(array).reshape(len(before), -1).all(axis=1)
        rows = moved[:, None]
        return replace(
            before,
            opacities=np.where(moved, alphas, before.opacities),
            quats=np.where(rows, values["quats"], before.quats),
            scales=np.where(rows, values["scales"], before.scales),
            sh0=np.where(rows, values["sh0"], before.sh0),
            shN=np.where(rows[:, :, None], values["shN"], before.shN),
        )


def _values_to_fit(model: SplatModel) -> dict[str, F32]:
    values = from_model(model, model.sh_degree)
    del values["means"]
    return values


@dataclass(eq=False)
class _QuantisedValues:
    """Values that pass through quantisers; `lambda_` is the squared error of a render that all bits are worth."""

    tuned: TunedScene
    lambda_: float = 0.0
    _alphas: F32 | None = None
    _seen: Any = None
    _costs: RateTerm | None = None

    def splats(self) -> UncheckedSplats:
        self._seen = None  # as large as the scene
        self._seen, self._alphas = self.tuned.dequantise()
        s = self._seen
        return UncheckedSplats(s.means, s.quats, s.scales, s.opacities, s.sh0, s.shN)

    def step(self, gradients: Gradients, rates: dict[str, float]) -> None:
        assert self._alphas is not None
        if self.tuned.parameters.step % _COUNT_EVERY == 0:
            costs, splats = self.tuned.count(self._seen, 1.0), len(self._alphas)
            costs.weight = self.lambda_ * splats / (costs.bits + _CENTRE_BITS * splats)
            self._costs = costs
        rates = {**rates, "means": 0.0, "sizes": rates["scales"]}
        self.tuned.step(gradients, self._seen, self._alphas, rates, self._costs if self.lambda_ else None)
