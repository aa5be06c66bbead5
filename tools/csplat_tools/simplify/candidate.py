"""A number of splats, fitted to what the source looks like, that become files of several qualities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from csplat.decoder import decode
from csplat.encoder import Draft, EncodeOptions, EncodeResult, Importance, Origin, most_grades
from csplat.model import SplatModel
from csplat_render.judge import Judge
from csplat_render.removal import measure_removal
from csplat_tools.simplify.colours import fit
from csplat_tools.simplify.core import Session
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.sensitivity_file import StoredSensitivity

__all__ = ["Candidate", "SimplifiedFile"]

Progress = Callable[[str, float], None]

_GRADED = 15_000  # splats; what is left of smaller scenes is too alike: 6,875 of plane3 take 3 % more with grades
_SHORT = 3  # steps of a fit that begins where another one ended


@dataclass(frozen=True, eq=False)
class SimplifiedFile:
    """A file, and what was done for it.

    Attributes:
        result: of the encoder; its source index is into the source.
        report: JSON-compatible.
    """

    result: EncodeResult
    report: dict[str, Any]


class Candidate:
    """A number of splats, encoded at several qualities. Owns the colours of the last fit, where the next one begins.

    Attributes:
        fitted: what stays, before anything is quantised.
    """

    def __init__(
        self, session: Session, gone: int, judge: Judge, progress: Progress | None, allowed: float | None = None
    ) -> None:
        self._session, self._judge, self._progress = session, judge, progress
        self._rows = session.pruned(gone)
        self._error = None if allowed is None else 10.0 ** (-allowed / 10.0) * session.views.removal.value_count
        self._pruned = session.source.select(self._rows)
        self._last: SplatModel | None = None
        options = session.options
        self.fitted = fit(
            self._pruned, session.views.used, session.wanted, replace(options, bands=False), progress=progress
        ).model
        self._weights = measure_removal(
            self.fitted, session.views.used, background=options.background, threads=options.threads, progress=progress
        ).squared_weight
        self._importance: Importance | None = None

    def encoded(self, encoding: EncodeOptions, quality: float | None) -> SimplifiedFile:
        """Encode at a quality, the preset's if it is None. The file says how good its renders are."""
        session = self._session
        report: dict[str, Any] = {"splats": len(self._rows), "splats_before": len(session.source), "quality": quality}
        draft = Draft.of(
            self.fitted, replace(encoding, attribute_psnr=quality),
            importance=self._measured() if encoding.shape_codebook_size or self._grades(encoding) else self._weights,
            origin=Origin(len(session.source), self._rows, adjusted=session.options.refit and session.options.adjust),
            progress=self._progress,
        )  # fmt: skip
        start, last = draft.scene, self._last
        fitted = fit(
            start if last is None else replace(start, sh0=last.sh0, shN=last.shN), session.views.used, session.wanted,
            replace(session.options, steps=_SHORT), error=self._error, centre=self._pruned, fixed=True,
            progress=self._progress,
        )  # fmt: skip
        self._last = fitted.model
        if fitted.stays is not None:
            report["zero_bands"] = (~fitted.stays).sum(axis=0).tolist()
        coded = draft.with_colours(fitted.model.sh0, fitted.model.shN).coded(self._progress)
        report["check_psnr"] = session.checked.psnr(fitted.model)
        report["psnr"] = self._judge.psnr(decode(coded.write().data))
        said = {
            "splats": len(session.source),
            "views": len(session.views.used),
            "method": session.options.method,
            **{name: round(report[name], 3) for name in ("psnr", "check_psnr")},
        }
        return SimplifiedFile(coded.write({"simplified": said}), report)

    def _grades(self, encoding: EncodeOptions) -> bool:
        """Whether splats are to be sorted into grades."""
        if encoding.grades is None and len(self._rows) < _GRADED:
            return False
        return not self._session.inside and most_grades(len(self._rows), encoding) > 1

    def _measured(self) -> Importance:
        """How much pictures depend on shapes, and on all else, too."""
        if self._importance is None:
            session, options = self._session, self._session.options
            found = measure_sensitivity(
                self.fitted, session.views.used, background=options.background, threads=options.threads,
                progress=self._progress,
            )  # fmt: skip
            measured = StoredSensitivity.of(self.fitted, found).importance()
            curvatures = None if session.inside else measured.curvatures
            self._importance = replace(measured, sh=self._weights, curvatures=curvatures)
        return self._importance
