"""Prune a scene and refit the kept splats: how many to keep, and subsets for candidates."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import (
    EncodedTiles,
    EncodeOptions,
    EncodePlan,
    Importance,
    Origin,
    encode_tiles,
    fix_quantisation,
    max_class_count,
)
from csplat.model import SplatModel
from csplat.types import F64, I64, Mask, Progress
from csplat_render.pruning_error import PruningError, measure_pruning_error
from csplat_tools.optimise.candidates import Candidate
from csplat_tools.optimise.pruning import PruningSession, prepare_pruning
from csplat_tools.optimise.pruning_order import SimplifyOptions, find_pruning_order
from csplat_tools.optimise.rate_distortion import (
    LEAST_QUANTISED,
    error_at_size,
    error_of_psnr,
    log_bytes_at_error,
    rate_exponent,
)
from csplat_tools.views import ViewSet, evenly_spaced
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.sensitivity_file import StoredSensitivity
from csplat_trainer.splat_refit import (
    BAND_STEPS,
    FIT_STEPS,
    choose_bands,
    coefficient_mask,
    drop_bands,
    quantisation_aware_refit,
    refit_splats,
)

Cost = Callable[[F64, F64], F64]
PsnrOf = Callable[[SplatModel], float]

_USUAL_BYTES = (8.0, 11.0)  # bytes per splat of files of useful quality, without and with SH
_FRAME_BYTES = 1_000  # bytes of a file without splats: header, index, options, declared errors
_MOST_PRUNED = 0.7  # largest fraction of the allowed error that pruning may take
_LEAST_PRUNED = 0.01  # least fraction of the error that is attributed to pruning
_REFIT_GAIN = (8.0, 1.0)  # typical gain of a refit over the pruning error, dB; increase for twice the work
_FAR = 2.0  # multiple of the allowed error at which an order ends; errors of several splats exceed their sum
_FARTHER = 4.0  # factor of its error to which an order that was too short is continued
_CALIBRATIONS = 3  # largest number of corrections of the first splat count by validation views
_AGREED = 0.05  # fraction of the splats; a smaller correction ends them
_ERROR_POWER = 0.85  # typical power of the pruning error with which the error after a refit grows
_ERROR_POWERS = (0.5, 1.1)  # range of that power if it is measured on two refits
_NOTHING = 1e-12  # least mean squared error, to divide by
_LEAST_FOR_CLASSES = 4_000  # least number of splats for quantisation classes; fewer are too similar
_LEAST_REST = 0.2  # least fraction of the refit's error that is left to bands and quantisation
_MOST_BANDS = 0.7  # largest fraction of the error left by the refit that dropping bands may take
_BAND_TRIES, _FEWER_BANDS = 2, 4.0  # number of further tries if they take more, and the divisor of the bound
_CARRIED_STEPS = 480  # steps of a refit that starts from the result of another
_FILE_STEPS = 480  # steps of a refit through the quantisers of a file
_SENSITIVITY_VIEWS = (120, 40)  # number of views to measure the sensitivity of splats, without and with SH


@dataclass(eq=False)
class Pruner:
    """Prunes a scene and refits the kept splats. Owns views, renders of the source and pruning order, made lazily.

    Attributes:
        source: the scene.
        views: the training and validation views.
        options: options of pruning and fitting.
        use_classes: kept splats may be sorted into quantisation classes.
        progress: progress callback.
        psnr: target PSNR, dB, which limits the length of the order; `None` for another kind of target.
        kept_count: number of splats to keep if the target specifies it.
    """

    source: SplatModel
    views: ViewSet
    options: SimplifyOptions
    use_classes: bool
    progress: Progress | None
    psnr: float | None
    kept_count: int | None = None
    _session: PruningSession | None = field(default=None, init=False)
    _fitted_subset: RefittedSubset | None = field(default=None, init=False)
    _before: tuple[int, float] | None = field(default=None, init=False)

    @property
    def session(self) -> PruningSession:
        """The views, renders and pruning order, shared by all splat counts."""
        if self._session is None:
            allowed = math.inf if self.psnr is None else _FAR * error_of_psnr(self.psnr)
            self._session = prepare_pruning(
                self.source, self.views, self.kept_count, self.options, self.progress, allowed=allowed
            )
        return self._session

    @property
    def view_count(self) -> int:
        """Number of small renders in which pruning errors were measured, over all passes."""
        if self._session is None:
            return 0
        views, later = self._session.views, max(0, len(self._session.order.rounds) - 1)
        return len(self._session.training_cameras) + len(views.used) * later + len(views.check)

    def refit(self, kept_count: int, allowed: float | None, psnr_of: PsnrOf) -> RefittedSubset:
        """Return `kept_count` refitted splats; more if some can never be pruned, such as unseen ones.

        Args:
            kept_count: number of splats to keep.
            allowed, psnr_of: as for `RefittedSubset`.
        """
        pruned_count = len(self.source) - kept_count
        if pruned_count > len(self.session.order.rows):
            self._extend(kept_count, math.inf)
        pruned_count = min(pruned_count, len(self.session.order.rows))
        self._fitted_subset = RefittedSubset(
            self.session, pruned_count, allowed, psnr_of, self.use_classes, self.progress, self._fitted_subset
        )
        return self._fitted_subset

    def first_at_psnr(self, psnr: float, slope: float, psnr_of: PsnrOf) -> int:
        """Return the first splat count to try for the smallest file of a PSNR.

        Pruning errors on validation views differ from those on training views; this is measured and corrected.

        Args:
            psnr: target PSNR, dB.
            slope: fraction of the bytes that a decibel costs.
            psnr_of: measures the PSNR of a subset of the source on the validation views, dB.
        """
        return self._calibrate(_at_psnr(psnr, slope), psnr_of)

    def first_at_size(self, size_bytes: int, near: tuple[int, float] | None, slope: float, psnr_of: PsnrOf) -> int:
        """Return the first splat count to try for the best file of a size.

        Args:
            size_bytes: size of the file.
            near: number of splats and PSNR in dB of a file of about that size, if any.
            slope, psnr_of: as for `first_at_psnr`.
        """
        if near is None:
            usual = (size_bytes - _FRAME_BYTES) / _USUAL_BYTES[self.source.sh_degree > 0]
            return max(1, min(len(self.source), int(usual)))
        return self._calibrate(_at_size(near[0], error_of_psnr(near[1]), slope), psnr_of)

    def next_at_psnr(self, kept_count: int, fitted_psnr: float, psnr: float, slope: float) -> tuple[int, float]:
        """Predict the splat count for the smallest file of a PSNR, and the saving in log bytes.

        Args:
            kept_count: number of splats of the last fit.
            fitted_psnr: their PSNR before quantisation, dB.
            psnr, slope: as for `first_at_psnr`.
        """
        removed = max(error_of_psnr(fitted_psnr), _LEAST_PRUNED * error_of_psnr(psnr))
        before, self._before = self._before, (kept_count, removed)
        return self._next(
            _at_psnr(psnr, slope), (kept_count, removed), self._error_growth(before, (kept_count, removed))
        )

    def next_at_size(self, kept_count: int, fitted_psnr: float, psnr: float, slope: float) -> tuple[int, float]:
        """Predict the splat count for the best file of a size, and the gain in log bytes.

        Args:
            kept_count: number of splats of a file of that size.
            fitted_psnr: their PSNR before quantisation, dB.
            psnr: PSNR of the file, dB.
            slope: as for `first_at_psnr`.
        """
        error = error_of_psnr(psnr)
        removed = max(min(error_of_psnr(fitted_psnr), error), _LEAST_PRUNED * error)
        quantised = max(error - removed, LEAST_QUANTISED * error)
        return self._next(_at_size(kept_count, quantised, slope), (kept_count, removed), _ERROR_POWER)

    def _next(self, cost: Cost, known: tuple[int, float], power: float) -> tuple[int, float]:
        """Return the splat count with the least cost, and by how much it is below that of a known one."""
        kept_count, least = self._least(cost, known, power)
        return kept_count, float(cost(*map(np.atleast_1d, known))[0]) - least

    def _calibrate(self, cost: Cost, psnr_of: PsnrOf) -> int:
        gain = error_of_psnr(self._refit_gain)
        kept_count, _ = self._least(cost, None)
        for _ in range(_CALIBRATIONS):
            if kept_count == len(self.source):
                break
            rows = self.session.kept_rows(len(self.source) - kept_count)
            validation_error = gain * error_of_psnr(psnr_of(self.source.select(rows)))
            before, (kept_count, _) = kept_count, self._least(cost, (kept_count, validation_error))
            if abs(kept_count - before) <= _AGREED * before:
                break
        return kept_count

    def _error_growth(self, before: tuple[int, float] | None, known: tuple[int, float]) -> float:
        """Return the power with which the error after a refit grows with the pruning error, from two refits.

        Args:
            before, known: number of splats and mean squared error of each; `before` is `None` for the first refit.
        """
        if before is None or before[0] == known[0]:
            return _ERROR_POWER
        removed = math.log(self._error(known[0]) / self._error(before[0]))
        if not removed:
            return _ERROR_POWER
        return min(max(math.log(known[1] / before[1]) / removed, _ERROR_POWERS[0]), _ERROR_POWERS[1])

    def _least(self, cost: Cost, known: tuple[int, float] | None, power: float = _ERROR_POWER) -> tuple[int, float]:
        """Return the splat count with the least cost, and that cost.

        Args:
            cost: called with splat counts and their errors after a refit.
            known: number of splats and mean squared error of a refit; `None`: the usual gain is assumed.
            power: power of the pruning error with which the error after a refit grows.
        """
        while True:
            errors = self._errors()
            kept_count = len(self.source) - np.arange(len(errors), dtype=np.float64)
            fitted = error_of_psnr(self._refit_gain) * errors
            if known is not None:
                fitted = known[1] * np.power(errors / self._error(known[0]), power)
            costs = cost(kept_count, fitted)
            best = int(np.argmin(costs))
            if best < len(errors) - 1 or not self._try_extending():
                return int(kept_count[best]), float(costs[best])

    @property
    def _refit_gain(self) -> float:
        return _REFIT_GAIN[0] + _REFIT_GAIN[1] * math.log2(self.options.work)

    def _try_extending(self) -> bool:
        """Continue the pruning order to several times its error; return False if it has ended."""
        before = self.session.order
        self._extend(None, _FARTHER * float(before.errors.sum()))
        return len(self.session.order.rows) > len(before.rows)

    def _extend(self, kept_count: int | None, enough: float) -> None:
        """Continue the pruning order, see `find_pruning_order`."""
        session = self.session
        order = find_pruning_order(
            self.source, session.view_groups, session.options, kept_count, self.progress, enough=enough,
            start=session.order,
        )  # fmt: skip
        self._session = replace(session, order=order)

    def _error(self, kept_count: int) -> float:
        """Return the predicted mean squared error of pruning all but `kept_count` splats."""
        errors = self._errors()
        return max(float(errors[min(len(self.source) - kept_count, len(errors) - 1)]), _NOTHING)

    def _errors(self) -> F64:
        session = self.session
        sums = np.concatenate([[0.0], np.cumsum(session.order.errors)]) / session.value_count
        return sums[: len(self.source)]  # at least one splat is kept


def _at_psnr(psnr: float, slope: float) -> Cost:
    return lambda kept_count, removed: log_bytes_at_error(kept_count, removed, error_of_psnr(psnr), _MOST_PRUNED, slope)


def _at_size(splats: int, quantised: float, slope: float) -> Cost:
    # In log bytes, like the cost for a PSNR.
    power = rate_exponent(slope)
    return lambda kept_count, removed: power * np.log(error_at_size(kept_count / splats, removed, quantised, slope))


@dataclass(eq=False)
class RefittedSubset:
    """The splats of a scene that are kept after pruning, refitted.

    Attributes:
        session: the scene, its views, and the pruning order of its splats.
        pruned_count: number of pruned splats.
        allowed: PSNR goal of files on the validation views, dB. The error that the refit leaves below it determines
            which SH bands are worth their bits; `None`: the refit's own error does.
        psnr_of: measures the PSNR of splats on the validation views, dB.
        use_classes: the splats may be sorted into quantisation classes, if there are enough.
        progress: progress callback.
        before: a refit with another splat count, from which this one starts.
    """

    session: PruningSession
    pruned_count: int
    allowed: float | None
    psnr_of: PsnrOf
    use_classes: bool
    progress: Progress | None
    before: RefittedSubset | None = None
    refits: bool = True

    def __post_init__(self) -> None:
        self._check_psnr = 0.0

    @cached_property
    def rows(self) -> I64:
        """[N] int64, the indices in the source of the kept splats."""
        return self.session.kept_rows(self.pruned_count)

    @property
    def classifiable(self) -> bool:
        """True if the splats may be sorted into quantisation classes: `use_classes` is set, and there are enough."""
        return self.use_classes and len(self.rows) >= _LEAST_FOR_CLASSES

    @property
    def model(self) -> SplatModel:
        """The refitted splats before quantisation."""
        return self._fitted_model

    @cached_property
    def fitted_psnr(self) -> float:
        """PSNR of the refitted splats, with all bands, on the validation views, dB."""
        return self.psnr_of(self.model)

    @cached_property
    def banded(self) -> tuple[SplatModel, Mask | None]:
        """The splats without SH bands that are not worth their bits, and the mask of kept bands; `None`: all."""
        session, model = self.session, self.model
        if not session.options.bands or not model.sh_degree:
            return model, None
        error, most = error_of_psnr(session.check_scorer.psnr(model)), math.inf
        if self.allowed is not None:  # errors differ between training and validation views
            fitted, allowed = error_of_psnr(self.fitted_psnr), error_of_psnr(self.allowed)
            error *= max(allowed / fitted - 1.0, _LEAST_REST)
            most = max(fitted + _MOST_BANDS * (allowed - fitted), (1.0 + _LEAST_REST) * fitted)
        banded, kept_bands = self._without_bands(error)
        for _ in range(0 if self.allowed is None else _BAND_TRIES):
            if error_of_psnr(self.psnr_of(banded)) <= most:
                break
            error /= _FEWER_BANDS
            del banded  # as large as the scene
            banded, kept_bands = self._without_bands(error)
        return banded, kept_bands

    @property
    def unquantised(self) -> SplatModel:
        """The refitted splats without the dropped bands."""
        return self.banded[0]

    @property
    def psnr(self) -> float:
        """PSNR of `unquantised` on the validation views, dB."""
        return self._banded_psnr  # pyright does not accept a cached property for the protocol's

    def coded(self, options: EncodeOptions, *, use_classes: bool, quick: bool) -> EncodedTiles:
        """Quantise and code the splats, after a quantisation-aware refit unless `quick`."""
        session, refit = self.session, self.session.options.refit
        start = self.banded[0]
        plan = EncodePlan.of(
            start, options, importance=self._importance(options, use_classes=use_classes),
            origin=Origin(len(session.source), self.rows, refitted=refit, adjusted=refit),
            progress=self.progress,
        )  # fmt: skip
        if quick or not refit:
            return encode_tiles(plan, progress=self.progress)
        fixed = fix_quantisation(plan, session.source, self.progress)
        values = quantisation_aware_refit(
            fixed, session.training_cameras, session.references, steps=session.options.steps(_FILE_STEPS),
            background=session.options.background, seed=session.options.seed, threads=session.options.threads,
            progress=self.progress,
        )  # fmt: skip
        models = [replace(start, **vars(fixed.dequantise(one)), means_double=None) for one in (fixed.start(), values)]
        if self.psnr_of(models[1]) < self.psnr_of(models[0]):  # steps may be too long for very few splats
            values, models = fixed.start(), models[:1]
        self._check_psnr = session.check_scorer.psnr(models[-1])
        return fixed.encode(values, self.progress)

    def options_entry(self, candidate: Candidate | None) -> Mapping[str, Any]:
        """Return the entry for the file's options: splats of the source, number of views, PSNRs of the file."""
        session = self.session
        entry = {"splats": len(session.source), "views": len(session.training_cameras)}
        figures = {} if candidate is None else {"validation_psnr": round(candidate.validation_psnr, 3)}
        if candidate is not None and candidate.is_final:
            figures["check_psnr"] = round(self._check_psnr, 3)
        return {"simplified": {**entry, **figures}}

    @cached_property
    def _banded_psnr(self) -> float:
        return self.psnr_of(self.banded[0])

    @cached_property
    def _fitted_model(self) -> SplatModel:
        session, steps = self.session, FIT_STEPS
        start = session.source.select(self.rows)
        if not (session.options.refit and self.pruned_count):
            return start
        if self.before is not None:
            start, steps = _with_values_of(self.before.model, self.before.rows, start, self.rows), _CARRIED_STEPS
        self.before = None  # frees memory: as large as the scene
        return self._refit(start, steps)

    def _without_bands(self, error: float) -> tuple[SplatModel, Mask]:
        """Return the splats without bands that are not worth their bits at a squared error, and the kept bands."""
        session, model = self.session, self.model
        kept_bands = choose_bands(self._pruning_error, error * self._pruning_error.value_count / max(1, len(model)))
        banded = drop_bands(model, kept_bands)
        if session.options.refit and not kept_bands.all():
            banded = self._refit(banded, BAND_STEPS, coefficient_mask(kept_bands))
        return banded, kept_bands

    def _refit(self, model: SplatModel, steps: int, free: Mask | None = None) -> SplatModel:
        """Refit the splats; with `free`, only these SH coefficients beyond the first."""
        session = self.session
        return refit_splats(
            model, session.training_cameras, session.references, steps=session.options.steps(steps), free=free,
            background=session.options.background, seed=session.options.seed, threads=session.options.threads,
            progress=self.progress,
        )  # fmt: skip

    def _importance(self, options: EncodeOptions, *, use_classes: bool) -> NDArray[Any] | Importance:
        has_classes = use_classes and max_class_count(len(self.rows), options) > 1
        if has_classes and (self.classifiable or options.max_classes is not None):
            return self._measured_importance
        weights = self._pruning_error.squared_weight
        return replace(self._measured_importance, blocks=None) if options.shape_codebook_size else weights

    @cached_property
    def _pruning_error(self) -> PruningError:
        """The error of removing each splat and each of its SH bands, and the weights of colours."""
        session = self.session
        return measure_pruning_error(
            self.model, session.views.used, background=session.options.background, threads=session.options.threads,
            progress=self.progress,
        )  # fmt: skip

    @cached_property
    def _measured_importance(self) -> Importance:
        """The importance of the splats, with Gauss–Newton blocks of the other attributes."""
        session, count = self.session, _SENSITIVITY_VIEWS[self.model.sh_degree > 0]
        found = measure_sensitivity(
            self.model, evenly_spaced(session.views.used, count), background=session.options.background,
            magnitudes=False, threads=session.options.threads, progress=self.progress,
        )  # fmt: skip
        return replace(StoredSensitivity.of(self.model, found).importance(), sh=self._pruning_error.squared_weight)


def _with_values_of(before: SplatModel, its_rows: I64, start: SplatModel, rows: I64) -> SplatModel:
    """Return splats of the source with the values of another refit if it has them; `rows` ascend."""
    _, there, here = np.intersect1d(its_rows, rows, assume_unique=True, return_indices=True)

    def carry(own: NDArray[np.float32], its: NDArray[np.float32]) -> NDArray[np.float32]:
        own = own.copy()
        own[here] = its[there]
        return own

    return replace(
        start,
        quats=carry(start.quats, before.quats),
        scales=carry(start.scales, before.scales),
        opacities=carry(start.opacities, before.opacities),
        sh0=carry(start.sh0, before.sh0),
        shN=carry(start.shN, before.shN),
    )
