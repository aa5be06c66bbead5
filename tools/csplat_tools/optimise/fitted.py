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
from csplat_tools.optimise.simplify.bands import band_mask, free_coefficients, without
from csplat_tools.optimise.simplify.colours import fit, refitted
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

_GRADED = 15_000  # splats; what is left of smaller scenes is too alike: 6,875 of plane3 take 3 % more with grades
_LEAST_LEFT = 0.2  # of the fit's error, that is left to bands and quantisation
_MOST_BANDS = 0.7  # of what the fit leaves, that bands which are left out may take
_BAND_TRIES, _FEWER_BANDS = 2, 4.0  # where they take more: again, with so much less of them
_BAND_STEPS = 4  # of a fit after bands were left out
_STEPS = 2  # of a fit that begins where another one ended
_SENSITIVITY_VIEWS = (120, 40)  # that say how precise the splats have to be, without and with SH


@dataclass(eq=False)
class FittedSplats:
    """So many splats of a scene, fitted. Owns the colours of its last file, where the next fit begins.

    Attributes:
        session: the scene, its views, the order in which its splats go.
        gone: how many went.
        allowed: PSNR that files are to have by the views that decide, dB: what the fit leaves of that error says which
            SH bands are worth their bits; `None`: the fit's own error does.
        seen: PSNR of some splats by the views that decide, dB.
        grades: they may be sorted into grades, if views can say how.
        progress: is told the stages.
    """

    session: Session
    gone: int
    allowed: float | None
    seen: Seen
    grades: bool
    progress: Progress | None
    refits: bool = True

    def __post_init__(self) -> None:
        self._last: SplatModel | None = None
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
        """The splats before they are quantised: colours, opacities and scales fitted."""
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
            banded, stays = self._left_out(error)
        return banded, stays

    @property
    def psnr(self) -> float:
        """Of what is quantised by the views that decide, dB."""
        return self._banded_psnr  # a cached property of this name would not be the protocol's for pyright

    def coded(self, options: EncodeOptions, *, graded: bool, quick: bool) -> Coded:
        """Quantise the geometry, fit colours to that, code all of it; quick is without the fit."""
        session, (start, stays) = self.session, self.banded
        draft = Draft.of(
            replace(self.model, sh0=start.sh0, shN=start.shN), options,
            importance=self._importance(options, graded=graded),
            origin=Origin(len(session.source), self.rows, adjusted=session.options.refit and session.options.adjust),
            progress=self.progress,
        )  # fmt: skip
        if not quick and session.options.refit:
            last = start if self._last is None else self._last
            start = self._last = self._refitted(replace(draft.scene, sh0=last.sh0, shN=last.shN), stays, _STEPS)
            self._check_psnr = session.checked.psnr(start)
        return draft.with_colours(start.sh0, start.shN).coded(self.progress)

    def said(self, trial: Trial | None) -> Mapping[str, Any]:
        """How many there were, what decided, and how good renders of the last file are."""
        session = self.session
        said = {"splats": len(session.source), "views": len(session.views.used)}
        figures = {} if trial is None else {"decided_psnr": round(trial.decided_psnr, 3)}
        if trial is not None and trial.is_careful:
            figures["check_psnr"] = round(self._check_psnr, 3)
        return {"simplified": {**said, **figures}}

    @cached_property
    def _banded_psnr(self) -> float:
        return self.seen(self.banded[0])

    @cached_property
    def _fitted(self) -> SplatModel:
        session = self.session
        options = replace(session.options, bands=False)
        return fit(self._pruned, session.views.used, session.wanted, options, progress=self.progress).model

    @cached_property
    def _pruned(self) -> SplatModel:
        return self.session.source.select(self.rows)

    def _left_out(self, error: float) -> tuple[SplatModel, Mask]:
        """The splats without the bands that are not worth their bits where files err by so much; those that stay."""
        session, model = self.session, self.model
        stays = band_mask(self._removal, error * session.views.removal.value_count / max(1, len(model)))
        banded = without(model, stays)
        return (self._refitted(banded, stays, _BAND_STEPS) if session.options.refit else banded), stays

    def _refitted(self, model: SplatModel, stays: Mask | None, steps: int) -> SplatModel:
        """Fit the colours that may be other than zero."""
        session, free = self.session, None if stays is None else free_coefficients(stays)
        return refitted(
            model, session.views.used, session.wanted, session.options, steps=steps, free=free, centre=self._pruned,
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
            self.model, evenly(session.views.used, count), background=session.options.background,
            threads=session.options.threads, progress=self.progress,
        )  # fmt: skip
        return replace(StoredSensitivity.of(self.model, found).importance(), sh=self._removal.squared_weight)
