"""The splats kept after pruning, refitted to renders of the source: the content of a file of fewer splats."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import Coded, Draft, EncodeOptions, Importance, Origin, most_grades
from csplat.model import SplatModel
from csplat.types import I64, Mask, Progress
from csplat_render.pruning_error import PruningError, measure_pruning_error
from csplat_tools.optimise.exchange import error_of_psnr
from csplat_tools.optimise.simplify.adjusting import adjust, adjust_frozen
from csplat_tools.optimise.simplify.bands import band_mask, free_coefficients, without
from csplat_tools.optimise.simplify.fitting import BAND_STEPS, FIT_STEPS
from csplat_tools.optimise.simplify.simplify import Session
from csplat_tools.optimise.trials import Trial
from csplat_tools.views import evenly
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.sensitivity_file import StoredSensitivity

Seen = Callable[[SplatModel], float]

_GRADED = 4_000  # least number of splats for quantisation classes: fewer are too similar
_LEAST_LEFT = 0.2  # fraction of the fit's error that is at least left to bands and quantisation
_MOST_BANDS = 0.7  # fraction of the error left by the fit that leaving out bands may take at most
_BAND_TRIES, _FEWER_BANDS = 2, 4.0  # if they take more: number of tries, each with the bound divided by this factor
_CARRIED_STEPS = 480  # steps of a fit that starts from the result of another
_FILE_STEPS = 480  # steps of a fit through the quantisers of a file
_SENSITIVITY_VIEWS = (120, 40)  # number of views to measure the sensitivity of splats, without and with SH


@dataclass(eq=False)
class FittedSplats:
    """The splats of a scene that are kept after pruning, refitted.

    Attributes:
        session: the scene, its views, and the pruning order of its splats.
        gone: number of pruned splats.
        allowed: PSNR that files are to have on the validation views, dB: the error that the fit leaves below it
            determines which SH bands are worth their bits; `None`: the fit's own error does.
        seen: measures the PSNR of some splats on the validation views, dB.
        grades: the splats may be sorted into quantisation classes, if there are enough.
        progress: progress callback.
        before: a fit with another number of splats, from which this one starts.
    """

    session: Session
    gone: int
    allowed: float | None
    seen: Seen
    grades: bool
    progress: Progress | None
    before: FittedSplats | None = None
    refits: bool = True

    def __post_init__(self) -> None:
        self._check_psnr = 0.0

    @cached_property
    def rows(self) -> I64:
        """[N] int64, the source splats that are kept."""
        return self.session.pruned(self.gone)

    @property
    def gradable(self) -> bool:
        """True if the splats may be sorted into quantisation classes: `grades` is set, and there are enough."""
        return self.grades and len(self.rows) >= _GRADED

    @property
    def model(self) -> SplatModel:
        """The refitted splats before quantisation."""
        return self._fitted

    @cached_property
    def fitted_psnr(self) -> float:
        """PSNR of the refitted splats, with all bands, on the validation views, dB."""
        return self.seen(self.model)

    @cached_property
    def banded(self) -> tuple[SplatModel, Mask | None]:
        """The splats without the SH bands that are not worth their bits, and a mask of kept bands; `None`: all."""
        session, model = self.session, self.model
        if not session.options.bands or not model.sh_degree:
            return model, None
        error, most = error_of_psnr(session.checked.psnr(model)), math.inf
        if self.allowed is not None:  # training and validation views see errors of different size
            fitted, allowed = error_of_psnr(self.fitted_psnr), error_of_psnr(self.allowed)
            error *= max(allowed / fitted - 1.0, _LEAST_LEFT)
            most = max(fitted + _MOST_BANDS * (allowed - fitted), (1.0 + _LEAST_LEFT) * fitted)
        banded, stays = self._left_out(error)
        for _ in range(0 if self.allowed is None else _BAND_TRIES):
            if error_of_psnr(self.seen(banded)) <= most:
                break
            error /= _FEWER_BANDS
            del banded  # as large as the scene
            banded, stays = self._left_out(error)
        return banded, stays

    @property
    def shown(self) -> SplatModel:
        """The splats that are quantised: refitted, without the bands that are left out."""
        return self.banded[0]

    @property
    def psnr(self) -> float:
        """PSNR of `shown` on the validation views, dB."""
        return self._banded_psnr  # pyright does not take a cached property for the protocol's

    def coded(self, options: EncodeOptions, *, graded: bool, quick: bool) -> Coded:
        """Quantise and code the splats; unless `quick`, they are refitted through the quantisers before."""
        session, refit = self.session, self.session.options.refit
        start = self.banded[0]
        draft = Draft.of(
            start, options, importance=self._importance(options, graded=graded),
            origin=Origin(len(session.source), self.rows, refitted=refit, adjusted=refit),
            progress=self.progress,
        )  # fmt: skip
        if quick or not refit:
            return draft.coded(self.progress)
        frozen = draft.frozen(session.source, self.progress)
        held = adjust_frozen(
            frozen, session.taught, session.wanted, session.options, steps=session.options.steps(_FILE_STEPS),
            progress=self.progress,
        )  # fmt: skip
        shown = [replace(start, **vars(frozen.seen(values)), means_double=None) for values in (frozen.start(), held)]
        if self.seen(shown[1]) < self.seen(shown[0]):  # steps of this length may be too long for a handful of splats
            held, shown = frozen.start(), shown[:1]
        self._check_psnr = session.checked.psnr(shown[-1])
        return frozen.coded(held, self.progress)

    def said(self, trial: Trial | None) -> Mapping[str, Any]:
        """Return the entry for a file's options: splats of the source, number of views, and PSNRs of the file."""
        session = self.session
        said = {"splats": len(session.source), "views": len(session.taught)}
        figures = {} if trial is None else {"decided_psnr": round(trial.decided_psnr, 3)}
        if trial is not None and trial.is_careful:
            figures["check_psnr"] = round(self._check_psnr, 3)
        return {"simplified": {**said, **figures}}

    @cached_property
    def _banded_psnr(self) -> float:
        return self.seen(self.banded[0])

    @cached_property
    def _fitted(self) -> SplatModel:
        session, steps = self.session, FIT_STEPS
        start = session.source.select(self.rows)
        if not (session.options.refit and self.gone):
            return start
        if self.before is not None:
            start, steps = _carried(self.before.model, self.before.rows, start, self.rows), _CARRIED_STEPS
        self.before = None  # as large as the scene, and perhaps not used elsewhere
        return self._adjusted(start, steps)

    def _left_out(self, error: float) -> tuple[SplatModel, Mask]:
        """Return the splats without the bands that are not worth their bits at a squared error, and the kept bands."""
        session, model = self.session, self.model
        stays = band_mask(self._removal, error * self._removal.value_count / max(1, len(model)))
        banded = without(model, stays)
        if session.options.refit and not stays.all():
            banded = self._adjusted(banded, BAND_STEPS, free_coefficients(stays))
        return banded, stays

    def _adjusted(self, model: SplatModel, steps: int, free: Mask | None = None) -> SplatModel:
        """Refit the splats; with `free`, only these SH coefficients beyond the first."""
        session = self.session
        return adjust(
            model, session.taught, session.wanted, session.options, steps=session.options.steps(steps), free=free,
            progress=self.progress,
        )  # fmt: skip

    def _importance(self, options: EncodeOptions, *, graded: bool) -> NDArray[Any] | Importance:
        if graded and most_grades(len(self.rows), options) > 1 and (self.gradable or options.grades is not None):
            return self._measured
        weights = self._removal.squared_weight
        return replace(self._measured, curvatures=None) if options.shape_codebook_size else weights

    @cached_property
    def _removal(self) -> PruningError:
        """The error of removing each splat and each of its SH bands, and the weights of their colours."""
        session = self.session
        return measure_pruning_error(
            self.model, session.views.used, background=session.options.background, threads=session.options.threads,
            progress=self.progress,
        )  # fmt: skip

    @cached_property
    def _measured(self) -> Importance:
        """The importance of the splats, with Gauss–Newton blocks of the other attributes."""
        session, count = self.session, _SENSITIVITY_VIEWS[self.model.sh_degree > 0]
        found = measure_sensitivity(
            self.model, evenly(session.views.used, count), background=session.options.background, magnitudes=False,
            threads=session.options.threads, progress=self.progress,
        )  # fmt: skip
        return replace(StoredSensitivity.of(self.model, found).importance(), sh=self._removal.squared_weight)


def _carried(before: SplatModel, its_rows: I64, start: SplatModel, rows: I64) -> SplatModel:
    """Return splats of the source with the values of another fit for those that it had; `rows` ascend."""
    _, there, here = np.intersect1d(its_rows, rows, assume_unique=True, return_indices=True)

    def carried(own: NDArray[np.float32], its: NDArray[np.float32]) -> NDArray[np.float32]:
        own = own.copy()
        own[here] = its[there]
        return own

    return replace(
        start,
        quats=carried(start.quats, before.quats),
        scales=carried(start.scales, before.scales),
        opacities=carried(start.opacities, before.opacities),
        sh0=carried(start.sh0, before.sh0),
        shN=carried(start.shN, before.shN),
    )
