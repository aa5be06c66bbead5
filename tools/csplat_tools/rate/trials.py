"""Files tried on the way to a target: encoded, and looked at when somebody asks how good they are."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, EncodeResult, Importance, Origin, encode_with_report
from csplat.model import SplatModel
from csplat_render.judge import Judge
from csplat_render.metrics import psnr_of_mse

__all__ = ["Choice", "Part", "Trial", "Trials", "spread_of"]

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]
Progress = Callable[[str, float], None]

_FEW_VIEWS = 3  # of those that judge; they are enough to compare
_ENTRIES = (16, 8192)  # of a codebook that is chosen here, at least and at most


@dataclass(frozen=True)
class Choice:
    """What is kept of SH, and how it is coded.

    Attributes:
        coding: "codebook", "scalar" or "none".
        share: entries of a codebook per splat; `None`: what the options say.
        degree: bands up to this one are kept; `None`: what the options say.
        adaptive: how much coarser unimportant splats are; `None`: what the options say.
        graded: splats are sorted into grades by what was measured, if anything was; else nothing that was measured is
            heeded.
    """

    coding: str
    share: float | None = None
    degree: int | None = None
    adaptive: float | None = None
    graded: bool = True

    def options(self, encoding: EncodeOptions, splats: int, quality: float) -> EncodeOptions:
        """Options of the encoder with this choice, at a quality."""
        size = encoding.codebook_size
        if self.coding == "codebook" and self.share is not None and size is None:
            size = 1 << round(math.log2(min(max(self.share * splats, _ENTRIES[0]), _ENTRIES[1])))
        degree = encoding.sh_degree if self.degree is None else self.degree
        adaptive = encoding.adaptive if self.adaptive is None else self.adaptive
        return replace(
            encoding,
            sh_coding=self.coding,
            codebook_size=size,
            sh_degree=degree,
            adaptive=adaptive,
            grades=encoding.grades if self.graded else 1,
            attribute_psnr=quality,
        )


@dataclass(frozen=True, eq=False)
class Part:
    """Splats that a file is to hold.

    Attributes:
        model: the splats.
        rows: [N] int64, which of the source they are; `None`: all.
        said: what the file says of those that are gone, JSON-compatible.
    """

    model: SplatModel
    rows: I64 | None = None
    said: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Trial:
    """One file.

    Attributes:
        part, choice, options, quality: what it was made of; the choice is the first of those with these options.
        result: of the encoder.
        psnr: dB against the source; NaN where nobody looked yet.
        errors: [V] mean squared error by view.
    """

    part: Part
    choice: Choice
    options: EncodeOptions
    quality: float
    result: EncodeResult = field(repr=False)
    psnr: float = math.nan
    errors: F64 = field(default_factory=lambda: np.zeros(0))

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self.result.data)

    @property
    def grades(self) -> int:
        """How many grades its splats are sorted into."""
        return len(self.result.report.options.get("grades", {}).get("splats", [0]))

    def as_json(self) -> dict[str, Any]:
        """Say what was tried and what came of it."""
        options = self.result.report.options
        return {
            "splats": len(self.part.model),
            "quality": round(self.quality, 3),
            "sh_coding": options["sh_coding"],
            "sh_degree": options["sh_degree"],
            "codebook_sizes": options["codebook_sizes"],
            "grades": self.grades,
            "size_bytes": self.size_bytes,
            "psnr": None if math.isnan(self.psnr) else round(self.psnr, 3),
        }


class Trials:
    """Makes files of a scene and looks at them. Owns all that were made, and counts renders.

    Attributes:
        judge: what the source looks like.
        made: every file, in order.
        renders: how many pictures were rendered, the source's among them.
    """

    def __init__(
        self,
        source: SplatModel,
        encoding: EncodeOptions,
        judge: Judge,
        importance: NDArray[Any] | Importance | None,
        progress: Progress | None,
        measured: Importance | None = None,
    ) -> None:
        self._source, self._encoding, self._importance, self._progress = source, encoding, importance, progress
        self._measured = measured
        self.judge = judge
        self.made: list[Trial] = []
        self.renders = count = len(judge.cameras)
        self._few = sorted({round(i * (count - 1) / (_FEW_VIEWS - 1)) for i in range(_FEW_VIEWS)})
        self._offset = 0.0

    @property
    def gradable(self) -> bool:
        """Whether something was measured that may sort splats into grades."""
        return self._measured is not None

    def encode(self, part: Part, choice: Choice, quality: float) -> Trial:
        """Make a file, if there is none of these options yet; nobody looks at it."""
        options = choice.options(self._encoding, len(part.model), quality)
        for trial in self.made:
            if trial.part is part and trial.options == options:
                return trial
        origin, said = None, dict[str, Any]()
        importance = self._measured if self.gradable and choice.graded else self._importance
        if part.rows is not None:
            if isinstance(importance, Importance):
                importance = importance.select(part.rows)
            elif importance is not None:
                importance = importance[part.rows]
            origin, said = Origin(len(self._source), part.rows), {"pruned": part.said}
        result = encode_with_report(
            part.model, options, importance=importance, origin=origin, said=said, progress=self._progress
        )
        trial = Trial(part, choice, options, quality, result)
        self.made.append(trial)
        return trial

    def judged(self, trial: Trial) -> Trial:
        """Look at a file from all views."""
        place = next(i for i, one in enumerate(self.made) if one.result is trial.result)
        if not math.isnan(self.made[place].psnr):
            return self.made[place]
        errors = self.judge.errors(decode(trial.result.data))
        self.renders += len(errors)
        seen = replace(trial, psnr=psnr_of_mse(self.judge.pooled(errors)), errors=errors)
        self._offset = psnr_of_mse(self.judge.some(self._few).pooled(errors[self._few])) - seen.psnr
        self.made[place] = seen
        return seen

    def seen(self, model: SplatModel) -> float:
        """PSNR of some splats, not coded, from all views."""
        errors = self.judge.errors(model)
        self.renders += len(errors)
        return psnr_of_mse(self.judge.pooled(errors))

    def glimpsed(self, model: SplatModel) -> float:
        """PSNR of some splats from a few views, corrected by how these differed from all for the last file."""
        few = self.judge.some(self._few)
        self.renders += len(self._few)
        return psnr_of_mse(few.pooled(few.errors(model))) - self._offset


def spread_of(errors: F64) -> float:
    """How much a PSNR over views would change with other views: one standard deviation in dB, by jackknife.

    Args:
        errors: [V] mean squared error by view.
    """
    if len(errors) < 2 or errors.sum() == 0.0:
        return math.nan
    without = (errors.sum() - errors) / (len(errors) - 1)
    decibels = 10.0 * np.log10(np.maximum(without, np.finfo(np.float64).tiny))
    return float(np.sqrt((len(errors) - 1) * np.mean(np.square(decibels - decibels.mean()))))
