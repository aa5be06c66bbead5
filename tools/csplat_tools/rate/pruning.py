"""How many splats may go, from the exact errors of their removal and from what bits are worth.

A decibel costs the share s of a file's bytes, so that quantisation which errs by Q takes bytes in proportion to
n · Q^-k for n splats, k = 10 / ln(10) · s. With P(n) the error of what was removed and F that of an SH codebook, a file
with the error D is smallest where n · (D - P(n) - F)^-k is; one of a given size is best where
P(n) + F + Q · (n / N)^(1 / k) is least, Q being what quantisation costs while all N splats are there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat_render import Camera
from csplat_tools.rate.trials import Part
from csplat_tools.simplify.core import Session, prepare
from csplat_tools.simplify.options import SimplifyOptions

__all__ = ["Pruner"]

F64 = NDArray[np.float64]
Measure = Callable[[SplatModel], float]

_LEAST_LEFT = 0.3  # share of the splats down to which the order is made, where the target asks for no fewer
_ROUNDS = 3
_ROOM = 3  # times fewer splats that an order allows for than are wanted now: they may be too many
_CALIBRATIONS = 3
_AGREED = 1.15  # times the error that was predicted
_NOTHING = 1e-12
_LEAST_QUANTISED = 0.1  # of the error of a file, that quantisation is taken to have
_LEAST_GONE = 0.02  # share of the splats; fewer are not worth a file


class Pruner:
    """Takes splats out of a scene. Owns the order in which they go, made when it is first asked for."""

    def __init__(
        self,
        source: SplatModel,
        cameras: list[Camera] | None,
        options: SimplifyOptions,
        progress: Callable[[str, float], None] | None,
    ) -> None:
        self._source, self._cameras, self._options, self._progress = source, cameras, options, progress
        self._session: Session | None = None
        self._left = 0

    @property
    def renders(self) -> int:
        """Passes over small pictures so far: each measures the removal of all splats in a view."""
        if self._session is None:
            return 0
        views = self._session.views
        return len(views.used) * (1 + len(self._session.order.rounds)) + len(views.check)

    def at_psnr(self, psnr: float, floor: float, slope: float, measure: Measure, most: float) -> Part | None:
        """Remove so many that the file of a PSNR is smallest; None where that is next to nothing.

        Args:
            psnr: of the file, in dB.
            floor: PSNR with what the SH coding costs and nothing else.
            slope: share of the bytes that a decibel costs.
            measure: PSNR of some of the source's splats, by views that judge.
            most: share of the error that is allowed which may come from what is removed; what is left for quantisation
                is a small difference of numbers that are not known well.
        """
        power = slope * 10.0 / math.log(10.0)
        allowed = _error(psnr) - _error(floor)

        def cost(left: F64, removed: F64) -> F64:
            spare = np.maximum(allowed - removed, _NOTHING * allowed)
            return np.where(removed > most * allowed, np.inf, np.log(left) - power * np.log(spare))

        return None if allowed <= 0.0 else self._least(cost, measure)

    def at_size(self, psnr: float, floor: float, count: int, slope: float, measure: Measure) -> Part | None:
        """Remove so many that the file of a size is best; None where that is next to nothing.

        Args:
            psnr: of a file of that size, in dB.
            floor: PSNR with its SH coding, without the splats that it lacks, and nothing else wrong.
            count: splats that it holds.
            slope, measure: as for `at_psnr`.
        """
        power = slope * 10.0 / math.log(10.0)
        quantised = max(_error(psnr) - _error(floor), _LEAST_QUANTISED * _error(psnr))
        share = count / len(self._source)

        def cost(left: F64, removed: F64) -> F64:
            return np.asarray(removed + quantised * (left / share) ** (1.0 / power))

        return self._least(cost, measure, count)

    def _least(self, cost: Callable[[F64, F64], F64], measure: Measure, count: int | None = None) -> Part | None:
        """Splats left where a cost of their share and of the error of the others is least.

        Views that judge show more or less of what is removed than those that decided: measured, and allowed for.
        """
        session = self._prepared(max(1, round(_LEAST_LEFT * (len(self._source) if count is None else count))))
        count = len(self._source)
        errors = np.concatenate([[0.0], np.cumsum(session.order.errors) / session.views.removal.value_count])
        errors = errors[:count]  # one stays
        left = 1.0 - np.arange(len(errors)) / count
        factor, gone = 1.0, 0
        for _ in range(_CALIBRATIONS):
            gone = int(np.argmin(cost(left, factor * errors)))
            if gone < _LEAST_GONE * count:
                return None
            seen = _error(measure(self._source.select(session.pruned(gone))))
            before, factor = factor, seen / max(float(errors[gone]), _NOTHING)
            if before / _AGREED <= factor <= before * _AGREED:
                break
        return self._without(session, gone)

    def to_count(self, left: int) -> Part:
        """Remove all but so many, or but those that no view saw, if they are more."""
        session = self._prepared(max(1, left // _ROOM))
        gone = min(len(self._source) - left, len(session.order.rows))
        return self._without(session, gone)

    def _prepared(self, left: int) -> Session:
        if self._session is None or left < self._left:
            options = replace(self._options, rounds=_ROUNDS)
            self._session = prepare(self._source, self._cameras, left, options, self._progress)
            self._left = left
        return self._session

    def _without(self, session: Session, gone: int) -> Part:
        rows = session.pruned(gone)
        said = {"splats": len(self._source), "gone": gone, "views": len(session.views.used)}
        return Part(self._source.select(rows), rows, said)


def _error(psnr: float) -> float:
    return math.pow(10.0, -psnr / 10.0)
