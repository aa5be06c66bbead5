"""Choose how many splats to prune, from exact pruning errors, the gain of a refit, and the rate-distortion model."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from csplat.model import SplatModel
from csplat.types import F64, Progress
from csplat_tools.optimise.exchange import (
    LEAST_QUANTISED,
    error_at_size,
    error_of_psnr,
    log_bytes_at_error,
    price_of_bytes,
)
from csplat_tools.optimise.fitted import FittedSplats
from csplat_tools.optimise.simplify.options import SimplifyOptions
from csplat_tools.optimise.simplify.order import removal_order
from csplat_tools.optimise.simplify.simplify import Session, prepare
from csplat_tools.views import ViewSet

Cost = Callable[[F64, F64], F64]
Seen = Callable[[SplatModel], float]

_USUAL_BYTES = (8.0, 11.0)  # bytes per splat of files of useful quality, without and with SH
_FRAME_BYTES = 1_000  # bytes of a file without splats: header, index, options, declared errors
_MOST_REMOVED = 0.7  # largest fraction of the error allowed by a PSNR that pruning may take
_LEAST_REMOVED = 0.01  # least fraction of the error that is attributed to pruning
_MENDED, _MENDS_MORE = 8.0, 1.0  # dB by which a refit reduces the pruning error, about, and more with twice the work
_FAR = 2.0  # multiple of the error allowed by a PSNR at which an order ends: splats together err by more than the sum
_FARTHER = 4.0  # multiple of its error to which an order that was too short is continued
_CALIBRATIONS = 3  # largest number of times that a first number of splats is corrected by validation views
_AGREED = 0.05  # fraction of the splats: a correction below this ends them
_GROWS = 0.85  # power of the pruning error with which the error after a refit grows, about
_GROW = (0.5, 1.1)  # range of that power if it is taken from two fits
_NOTHING = 1e-12  # least mean squared error, to divide by


@dataclass(eq=False)
class Removal:
    """Prunes a scene and refits the kept splats. Owns views, renders of the source and pruning order, made when needed.

    Attributes:
        source: the scene.
        views: the training and validation views.
        options: options of pruning and fitting.
        grades: kept splats may be sorted into quantisation classes.
        progress: progress callback.
        psnr: target PSNR, dB: the order ends far below it; `None`: another kind of target.
        left: number of splats to keep, if the target specifies it: the order is made for that number.
    """

    source: SplatModel
    views: ViewSet
    options: SimplifyOptions
    grades: bool
    progress: Progress | None
    psnr: float | None
    left: int | None = None
    _session: Session | None = field(default=None, init=False)
    _fitted: FittedSplats | None = field(default=None, init=False)
    _before: tuple[int, float] | None = field(default=None, init=False)

    @property
    def session(self) -> Session:
        """The views, renders and pruning order that are shared by all numbers of splats."""
        if self._session is None:
            allowed = math.inf if self.psnr is None else _FAR * error_of_psnr(self.psnr)
            self._session = prepare(self.source, self.views, self.left, self.options, self.progress, allowed=allowed)
        return self._session

    @property
    def view_count(self) -> int:
        """Number of small renders in which pruning errors were measured, over all passes; 0 if they were not."""
        if self._session is None:
            return 0
        views, later = self._session.views, max(0, len(self._session.order.rounds) - 1)
        return len(self._session.taught) + len(views.used) * later + len(views.check)

    def fitted(self, left: int, allowed: float | None, seen: Seen) -> FittedSplats:
        """Return `left` splats, refitted, but at least those that are never pruned, such as unseen ones.

        Args:
            left: number of splats to keep.
            allowed, seen: as for `FittedSplats`.
        """
        gone = len(self.source) - left
        if gone > len(self.session.order.rows):
            self._extend(left, math.inf)
        gone = min(gone, len(self.session.order.rows))
        self._fitted = FittedSplats(self.session, gone, allowed, seen, self.grades, self.progress, self._fitted)
        return self._fitted

    def first_at_psnr(self, psnr: float, slope: float, seen: Seen) -> int:
        """Return the number of splats to begin with for the smallest file of a PSNR.

        Validation views show more or less of the pruning error than training views; this is measured and corrected.

        Args:
            psnr: target PSNR, dB.
            slope: fraction of the bytes that a decibel costs.
            seen: measures the PSNR of some of the source's splats on the validation views, dB.
        """
        return self._calibrated(_at_psnr(psnr, slope), seen)

    def first_at_size(self, size_bytes: int, near: tuple[int, float] | None, slope: float, seen: Seen) -> int:
        """Return the number of splats to begin with for the best file of a size.

        Args:
            size_bytes: size of the file.
            near: number of splats and PSNR in dB of a file of about that size; `None`: there is none.
            slope, seen: as for `first_at_psnr`.
        """
        if near is None:
            usual = (size_bytes - _FRAME_BYTES) / _USUAL_BYTES[self.source.sh_degree > 0]
            return max(1, min(len(self.source), int(usual)))
        return self._calibrated(_at_size(near[0], error_of_psnr(near[1]), slope), seen)

    def next_at_psnr(self, left: int, fitted_psnr: float, psnr: float, slope: float) -> tuple[int, float]:
        """Predict the number of splats for the smallest file of a PSNR, and the saving as a logarithm of bytes.

        Args:
            left: number of splats of the last fit.
            fitted_psnr: their PSNR before quantisation, dB.
            psnr, slope: as for `first_at_psnr`.
        """
        removed = max(error_of_psnr(fitted_psnr), _LEAST_REMOVED * error_of_psnr(psnr))
        before, self._before = self._before, (left, removed)
        return self._next(_at_psnr(psnr, slope), (left, removed), self._growing(before, (left, removed)))

    def next_at_size(self, left: int, fitted_psnr: float, psnr: float, slope: float) -> tuple[int, float]:
        """Predict the number of splats for the best file of a size, and the gain as a logarithm of bytes.

        Args:
            left: number of splats of a file of that size.
            fitted_psnr: their PSNR before quantisation, dB.
            psnr: PSNR of the file, dB.
            slope: as for `first_at_psnr`.
        """
        error = error_of_psnr(psnr)
        removed = max(min(error_of_psnr(fitted_psnr), error), _LEAST_REMOVED * error)
        quantised = max(error - removed, LEAST_QUANTISED * error)
        return self._next(_at_size(left, quantised, slope), (left, removed), _GROWS)

    def _next(self, cost: Cost, known: tuple[int, float], power: float) -> tuple[int, float]:
        """Return the number of kept splats with the least cost, and by how much it is below the known one."""
        left, least = self._least(cost, known, power)
        return left, float(cost(*map(np.atleast_1d, known))[0]) - least

    def _calibrated(self, cost: Cost, seen: Seen) -> int:
        mends = error_of_psnr(self._mended)
        left, _ = self._least(cost, None)
        for _ in range(_CALIBRATIONS):
            if left == len(self.source):
                break
            rows = self.session.pruned(len(self.source) - left)
            seen_error = mends * error_of_psnr(seen(self.source.select(rows)))
            before, (left, _) = left, self._least(cost, (left, seen_error))
            if abs(left - before) <= _AGREED * before:
                break
        return left

    def _growing(self, before: tuple[int, float] | None, known: tuple[int, float]) -> float:
        """Return the power with which the error after a refit grows with the pruning error, from two fits.

        Args:
            before, known: number of splats and mean squared error of two fits; `None`: there was only one.
        """
        if before is None or before[0] == known[0]:
            return _GROWS
        removed = math.log(self._error(known[0]) / self._error(before[0]))
        return min(max(math.log(known[1] / before[1]) / removed, _GROW[0]), _GROW[1]) if removed else _GROWS

    def _least(self, cost: Cost, known: tuple[int, float] | None, power: float = _GROWS) -> tuple[int, float]:
        """Return the number of kept splats with the least cost, and that cost.

        Args:
            cost: takes the numbers of kept splats and their errors after a refit.
            known: number of splats and mean squared error of a fit; `None`: the usual gain of a refit is assumed.
            power: power of the pruning error with which the error after a refit grows.
        """
        while True:
            errors = self._errors()
            left = len(self.source) - np.arange(len(errors), dtype=np.float64)
            fitted = error_of_psnr(self._mended) * errors
            if known is not None:
                fitted = known[1] * np.power(errors / self._error(known[0]), power)
            costs = cost(left, fitted)
            best = int(np.argmin(costs))
            if best < len(errors) - 1 or not self._goes_on():
                return int(left[best]), float(costs[best])

    @property
    def _mended(self) -> float:
        return _MENDED + _MENDS_MORE * math.log2(self.options.work)

    def _goes_on(self) -> bool:
        """Continue the pruning order until its error is several times as large; return False if it cannot be."""
        before = self.session.order
        self._extend(None, _FARTHER * float(before.errors.sum()))
        return len(self.session.order.rows) > len(before.rows)

    def _extend(self, left: int | None, enough: float) -> None:
        """Continue the pruning order, see `removal_order`."""
        session = self.session
        order = removal_order(
            self.source, session.sides, session.options, left, self.progress, enough=enough, start=session.order
        )
        self._session = replace(session, order=order)

    def _error(self, left: int) -> float:
        """Return the predicted mean squared error of pruning all but `left` splats."""
        errors = self._errors()
        return max(float(errors[min(len(self.source) - left, len(errors) - 1)]), _NOTHING)

    def _errors(self) -> F64:
        session = self.session
        sums = np.concatenate([[0.0], np.cumsum(session.order.errors)]) / session.value_count
        return sums[: len(self.source)]  # at least one splat is kept


def _at_psnr(psnr: float, slope: float) -> Cost:
    return lambda left, removed: log_bytes_at_error(left, removed, error_of_psnr(psnr), _MOST_REMOVED, slope)


def _at_size(splats: int, quantised: float, slope: float) -> Cost:
    # As a logarithm of bytes, as for a PSNR.
    power = price_of_bytes(slope)
    return lambda left, removed: power * np.log(error_at_size(left / splats, removed, quantised, slope))
