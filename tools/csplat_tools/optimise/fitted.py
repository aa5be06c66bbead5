"""Splats of which others were taken away, fitted to what the source looks like: what a file of fewer splats holds."""

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
from csplat_render.removal import Removal, measure_removal
from csplat_tools.files.console import Progress
from csplat_tools.optimise.exchange import error_of_psnr
from csplat_tools.optimise.simplify.adjusting import adjust, adjust_frozen
from csplat_tools.optimise.simplify.bands import band_mask, free_coefficients, without
from csplat_tools.optimise.simplify.fitting import BAND_STEPS, FIT_STEPS
from csplat_tools.optimise.simplify.simplify import Session
from csplat_tools.optimise.trials import Trial
from csplat_tools.views import evenly
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.sensitivity_file import StoredSensitivity

__all__ = ["FittedSplats"]

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]
Seen = Callable[[SplatModel], float]

_GRADED = 4_000  # splats; what is left of smaller scenes is too alike
_LEAST_LEFT = 0.2  # of the fit's error, that is left to bands and quantisation
_MOST_BANDS = 0.7  # of what the fit leaves, that bands which are left out may take
_BAND_TRIES, _FEWER_BANDS = 2, 4.0  # where they take more: again, with so much less of them
_CARRIED_STEPS = 480  # of a fit that begins where another ended
_FILE_STEPS = 480  # through the quantisers of a file
_SENSITIVITY_VIEWS = (120, 40)  # that say how precise the splats have to be, without and with SH


@dataclass(eq=False)
class FittedSplats:
    """So many splats of a scene, fitted.

    Attributes:
        session: the scene, its views, the order in which its splats go.
        gone: how many went.
        allowed: PSNR that files are to have by the views that decide, dB: what the fit leaves of that error says which
            SH bands are worth their bits; `None`: the fit's own error does.
        seen: PSNR of some splats by the views that decide, dB.
        grades: they may be sorted into grades, if views can say how.
        progress: is told the stages.
        before: another number of them that was fitted: where this fit begins.
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
        """[N] int64, which of the source they are."""
        return self.session.pruned(self.gone)

    @property
    def gradable(self) -> bool:
        """Whether they may be sorted into grades: where views can say how, and there are many."""
        return self.grades and len(self.rows) >= _GRADED

    @property
    def model(self) -> SplatModel:
        """The splats before they are quantised, fitted."""
        return self._fitted

    @cached_property
    def fitted_psnr(self) -> float:
        """Of these by the views that decide, dB."""
        return self.seen(self.model)

    @cached_property
    def banded(self) -> tuple[SplatModel, Mask | None]:
        """The same without the SH bands that are not worth their bits, and which bands stay; `None`: all do."""
        session, model = self.session, self.model
        if not session.options.bands or not model.sh_degree:
            return model, None
        error, most = error_of_psnr(session.checked.psnr(model)), math.inf
        if self.allowed is not None:  # views that teach and those that decide see errors of different size
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
        """What is quantised."""
        return self.banded[0]

    @property
    def psnr(self) -> float:
        """Of what is quantised by the views that decide, dB."""
        return self._banded_psnr  # a cached property of this name would not be the protocol's for pyright

    def coded(self, options: EncodeOptions, *, graded: bool, quick: bool) -> Coded:
        """Quantise and code them; unless quick, after they were adjusted through the quantisers."""
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
        if self.seen(shown[1]) < self.seen(shown[0]):  # a handful of splats may be too few for steps so long
            held, shown = frozen.start(), shown[:1]
        self._check_psnr = session.checked.psnr(shown[-1])
        return frozen.coded(held, self.progress)

    def said(self, trial: Trial | None) -> Mapping[str, Any]:
        """How many there were, what decided, and how good renders of the last file are."""
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
        self.before = None  # as large as the scene, and nobody else may need it
        return self._adjusted(start, steps)

    def _left_out(self, error: float) -> tuple[SplatModel, Mask]:
        """The splats without the bands that are not worth their bits where files err by so much; those that stay."""
        session, model = self.session, self.model
        stays = band_mask(self._removal, error * self._removal.value_count / max(1, len(model)))
        banded = without(model, stays)
        if session.options.refit and not stays.all():
            banded = self._adjusted(banded, BAND_STEPS, free_coefficients(stays))
        return banded, stays

    def _adjusted(self, model: SplatModel, steps: int, free: Mask | None = None) -> SplatModel:
        """Adjust what may be other than zero."""
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
    def _removal(self) -> Removal:
        """How much pictures depend on each splat, its bands and its colours."""
        session = self.session
        return measure_removal(
            self.model, session.views.used, background=session.options.background, threads=session.options.threads,
            progress=self.progress,
        )  # fmt: skip

    @cached_property
    def _measured(self) -> Importance:
        """How much they depend on all else, too."""
        session, count = self.session, _SENSITIVITY_VIEWS[self.model.sh_degree > 0]
        found = measure_sensitivity(
            self.model, evenly(session.views.used, count), background=session.options.background, magnitudes=False,
            threads=session.options.threads, progress=self.progress,
        )  # fmt: skip
        return replace(StoredSensitivity.of(self.model, found).importance(), sh=self._removal.squared_weight)


def _carried(before: SplatModel, its_rows: I64, start: SplatModel, rows: I64) -> SplatModel:
    """Splats of the source as another fit left them, as far as they were among those; `rows` ascend."""
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
