"""How many splats may go: exact errors of their removal, what a fit of the others mends, and what bits are worth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat_tools.files.console import Progress
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

__all__ = ["Removal"]

F64 = NDArray[np.float64]
Cost = Callable[[F64, F64], F64]
Seen = Callable[[SplatModel], float]

_USUAL_BYTES = (8.0, 11.0)  # of a splat in files that are worth looking at, without and with SH
_FRAME_BYTES = 1_000  # of a file without splats: header, index, options, stated errors
_MOST_REMOVED = 0.7  # of the error that a PSNR allows
_LEAST_REMOVED = 0.01  # of the error, that what was removed is taken to have
_MENDED, _MENDS_MORE = 8.0, 1.0  # dB that a fit makes removal err by less, about, and with twice the work
_FAR = 2.0  # times the error that a PSNR allows: what is removed together mostly errs by several times the sum
_FARTHER = 4.0  # times the error of an order, where that was too little
_CALIBRATIONS = 3
_AGREED = 0.05  # of the splats
_GROWS = 0.85  # power of the error of removal with which that of what is left grows, once it is fitted, about
_GROW = (0.5, 1.1)  # between which two fits may say what it is
_NOTHING = 1e-12


@dataclass(eq=False)
class Removal:
    """Takes splats out of a scene and fits the others. Owns views, source's pictures and order, made when asked for.

    Attributes:
        source: the scene.
        views: those that teach and those that decide.
        options: how splats are removed and fitted.
        grades: what is left may be sorted into grades.
        progress: is told the stages.
        psnr: that is looked for, dB: far below it no order is needed; `None`: some other target is.
        left: splats that are to stay, if that is asked: the order is made for so many.
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
        """What all numbers of splats share."""
        if self._session is None:
            allowed = math.inf if self.psnr is None else _FAR * error_of_psnr(self.psnr)
            self._session = prepare(self.source, self.views, self.left, self.options, self.progress, allowed=allowed)
        return self._session

    @property
    def view_count(self) -> int:
        """Small views in which removal was measured, pass by pass; 0 where it was not."""
        if self._session is None:
            return 0
        views, later = self._session.views, max(0, len(self._session.order.rounds) - 1)
        return len(self._session.taught) + len(views.used) * later + len(views.check)

    def fitted(self, left: int, allowed: float | None, seen: Seen) -> FittedSplats:
        """So many splats, or those that no view saw if they are more; see `FittedSplats`."""
        gone = len(self.source) - left
        if gone > len(self.session.order.rows):
            self._extend(left, math.inf)
        gone = min(gone, len(self.session.order.rows))
        self._fitted = FittedSplats(self.session, gone, allowed, seen, self.grades, self.progress, self._fitted)
        return self._fitted

    def first_at_psnr(self, psnr: float, slope: float, seen: Seen) -> int:
        """How many splats to begin with for the smallest file of a PSNR.

        Views that decide show more or less of what is removed than those that taught: measured, and allowed for.

        Args:
            psnr: dB.
            slope: share of the bytes that a decibel costs.
            seen: PSNR of some of the source's splats by the views that decide, dB.
        """
        return self._calibrated(_at_psnr(psnr, slope), seen)

    def first_at_size(self, size_bytes: int, near: tuple[int, float] | None, slope: float, seen: Seen) -> int:
        """How many to begin with for the best file of a size.

        Args:
            size_bytes: of the file.
            near: splats and PSNR of a file of about that size; `None`: there is none.
            slope, seen: as above.
        """
        if near is None:
            usual = (size_bytes - _FRAME_BYTES) / _USUAL_BYTES[self.source.sh_degree > 0]
            return max(1, min(len(self.source), int(usual)))
        return self._calibrated(_at_size(near[0], error_of_psnr(near[1]), slope), seen)

    def next_at_psnr(self, left: int, fitted_psnr: float, psnr: float, slope: float) -> tuple[int, float]:
        """How many splats are likely to make the smallest file of a PSNR, and the share of the bytes that this saves.

        Args:
            left: so many were fitted,
            fitted_psnr: and have this PSNR before they are quantised, dB.
            psnr, slope: as above.
        """
        removed = max(error_of_psnr(fitted_psnr), _LEAST_REMOVED * error_of_psnr(psnr))
        before, self._before = self._before, (left, removed)
        return self._next(_at_psnr(psnr, slope), (left, removed), self._growing(before, (left, removed)))

    def next_at_size(self, left: int, fitted_psnr: float, psnr: float, slope: float) -> tuple[int, float]:
        """How many are likely to make the best file of a size, and the share of the bytes that the gain is worth.

        Args:
            left: of so many splats there is a file of that size.
            fitted_psnr: theirs before they were quantised. psnr: of the file, dB.
            slope: as above.
        """
        error = error_of_psnr(psnr)
        removed = max(min(error_of_psnr(fitted_psnr), error), _LEAST_REMOVED * error)
        quantised = max(error - removed, LEAST_QUANTISED * error)
        return self._next(_at_size(left, quantised, slope), (left, removed), _GROWS)

    def _next(self, cost: Cost, known: tuple[int, float], power: float) -> tuple[int, float]:
        """Splats left where a cost is least, and by how much it is less than what is known."""
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
        """The power with which errors grow once splats are fitted, by two numbers of them and their errors."""
        if before is None or before[0] == known[0]:
            return _GROWS
        removed = math.log(self._error(known[0]) / self._error(before[0]))
        return min(max(math.log(known[1] / before[1]) / removed, _GROW[0]), _GROW[1]) if removed else _GROWS

    def _least(self, cost: Cost, known: tuple[int, float] | None, power: float = _GROWS) -> tuple[int, float]:
        """Splats left where a cost of their number and of the error of the others is least, and that cost.

        Args:
            cost: of both.
            known: so many splats have this error once they are fitted; `None`: what a fit usually mends.
            power: with which that grows where more is removed.
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
        """Let the order go on until removal errs by several times as much; false where it goes no further."""
        before = self.session.order
        self._extend(None, _FARTHER * float(before.errors.sum()))
        return len(self.session.order.rows) > len(before.rows)

    def _extend(self, left: int | None, enough: float) -> None:
        """Let the order go on, see `removal_order`."""
        session = self.session
        order = removal_order(
            self.source, session.sides, session.options, left, self.progress, enough=enough, start=session.order
        )
        self._session = replace(session, order=order)

    def _error(self, left: int) -> float:
        """Mean squared error of the removal of all but so many, as predicted."""
        errors = self._errors()
        return max(float(errors[min(len(self.source) - left, len(errors) - 1)]), _NOTHING)

    def _errors(self) -> F64:
        session = self.session
        sums = np.concatenate([[0.0], np.cumsum(session.order.errors)]) / session.value_count
        return sums[: len(self.source)]  # one stays


def _at_psnr(psnr: float, slope: float) -> Cost:
    return lambda left, removed: log_bytes_at_error(left, removed, error_of_psnr(psnr), _MOST_REMOVED, slope)


def _at_size(splats: int, quantised: float, slope: float) -> Cost:
    # In bytes, as at a PSNR.
    power = price_of_bytes(slope)
    return lambda left, removed: power * np.log(error_at_size(left / splats, removed, quantised, slope))
