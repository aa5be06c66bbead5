"""How many splats may go: exact errors of their removal, and what bits are worth (exchange.py)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat_tools.rate.exchange import LEAST_QUANTISED, error_at_size, error_of_psnr, log_bytes_at_error
from csplat_tools.rate.trials import Part
from csplat_tools.simplify.options import SimplifyOptions
from csplat_tools.simplify.order import Order, removal_order
from csplat_tools.simplify.views import Measured, find_views
from csplat_tools.views import ViewSet

__all__ = ["Pruner"]

F64 = NDArray[np.float64]
Measure = Callable[[SplatModel], float]

_LEAST_LEFT = 0.3  # share of the splats that are asked for now, down to which the order is made
_ROUNDS = 3
_CALIBRATIONS = 3
_AGREED = 1.15  # times the error that was predicted
_NOTHING = 1e-12
_LEAST_GONE = 0.02  # share of the splats; fewer are not worth a file


class Pruner:
    """Takes splats out of a scene. Owns the views that decide and the order, made when they are first asked for.

    Attributes:
        renders: passes over small pictures so far; each measures the removal of all splats in a view.
    """

    def __init__(
        self,
        source: SplatModel,
        around: ViewSet,
        options: SimplifyOptions,
        progress: Callable[[str, float], None] | None,
    ) -> None:
        self._source, self._around, self._progress = source, around, progress
        self._options = replace(options, rounds=_ROUNDS)
        self._views: Measured | None = None
        self._order: Order | None = None
        self._left = 0
        self.renders = 0

    def at_psnr(self, psnr: float, floor: float, slope: float, measure: Measure, most: float) -> Part | None:
        """Remove so many that the file of a PSNR is smallest; None where that is next to nothing.

        Args:
            psnr: of the file, in dB.
            floor: PSNR with what the SH coding costs and nothing else.
            slope: share of the bytes that a decibel costs.
            measure: PSNR of some of the source's splats, by views that judge.
            most: share of the error that is allowed which may come from what is removed.
        """
        allowed = error_of_psnr(psnr) - error_of_psnr(floor)

        def cost(left: F64, removed: F64) -> F64:
            return log_bytes_at_error(left, removed, allowed, most, slope)

        return None if allowed <= 0.0 else self._least(cost, measure, len(self._source))

    def at_size(self, psnr: float, floor: float, count: int, slope: float, measure: Measure) -> Part | None:
        """Remove so many that the file of a size is best; None where that is next to nothing.

        Args:
            psnr: of a file of that size, in dB.
            floor: PSNR with its SH coding, without the splats that it lacks, and nothing else wrong.
            count: splats that it holds.
            slope, measure: as for `at_psnr`.
        """
        error = error_of_psnr(psnr)
        quantised = max(error - error_of_psnr(floor), LEAST_QUANTISED * error)
        share = count / len(self._source)

        def cost(left: F64, removed: F64) -> F64:
            return error_at_size(left / share, removed, quantised, slope)

        return self._least(cost, measure, count)

    def _least(self, cost: Callable[[F64, F64], F64], measure: Measure, wanted: int) -> Part | None:
        """Splats left where a cost of their share and of the error of the others is least.

        Views that judge show more or less of what is removed than those that decided: measured, and allowed for.
        """
        views, order = self._prepared(wanted)
        count = len(self._source)
        errors = np.concatenate([[0.0], np.cumsum(order.errors) / views.removal.value_count])
        errors = errors[:count]  # one stays
        left = 1.0 - np.arange(len(errors)) / count
        factor, gone = 1.0, 0
        for _ in range(_CALIBRATIONS):
            gone = int(np.argmin(cost(left, factor * errors)))
            if gone < _LEAST_GONE * count:
                return None
            seen = error_of_psnr(measure(self._source.select(order.kept(count, gone))))
            before, factor = factor, seen / max(float(errors[gone]), _NOTHING)
            if before / _AGREED <= factor <= before * _AGREED:
                break
        return self._without(views, order, gone)

    def to_count(self, left: int) -> Part:
        """Remove all but so many, or but those that no view saw, if they are more."""
        views, order = self._prepared(left)
        return self._without(views, order, min(len(self._source) - left, len(order.rows)))

    def _prepared(self, wanted: int) -> tuple[Measured, Order]:
        """Views and an order that leaves fewer splats than are wanted: they may turn out to be too many."""
        left = max(1, round(_LEAST_LEFT * wanted))
        options = self._options
        if self._views is None:
            self._views = find_views(
                self._source, self._around, 1.0 - left / len(self._source), size=options.view_size,
                threads=options.threads, progress=self._progress,
            )  # fmt: skip
            self.renders += len(self._views.used) + len(self._views.check)
        if self._order is None or left < self._left:
            self._order = removal_order(self._source, self._views, options, left, self._progress)
            self._left = left
            # The first round takes what finding the views has measured.
            self.renders += len(self._views.used) * max(0, len(self._order.rounds) - 1)
        return self._views, self._order

    def _without(self, views: Measured, order: Order, gone: int) -> Part:
        rows = order.kept(len(self._source), gone)
        said = {"splats": len(self._source), "gone": gone, "views": len(views.used)}
        return Part(self._source.select(rows), rows, said)
