"""What to keep of SH, how to code it, and whether splats are graded.

Tried at one quality, compared by what each would take to reach the goal.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import PRESETS, EncodeOptions
from csplat.model import SplatModel
from csplat_tools.models import without_bands
from csplat_tools.rate.exchange import BYTES_PER_DB, error_at_size, error_of_psnr
from csplat_tools.rate.trials import Choice, Part, Trial, Trials

__all__ = ["Chooser", "Goal"]

_LARGEST_SH = 1e4  # larger values are no escapes of a codebook at every quality
_FIRST_SHARE = 1 / 32  # entries of an SH codebook per splat
_SHARE_STEP = 4.0
_SHARES = (1 / 512, 1 / 8)
_ELSEWHERE = 6.0  # dB of quality beyond which what was dearer there says nothing
_FAR = 0.15  # of the bytes; a choice that was so much dearer is not tried again
_ADAPTIVE = 1.0  # coarseness of unimportant splats that is tried beside the preset's, where importance was measured
_LEAST_LEFT = 1e-3  # of an error: what quantisation has of it, at least; below, a difference is noise
_DROPPED = 5.0  # dB above the goal: what bands that are left out may cost, a third of the error


@dataclass(frozen=True)
class Goal:
    """A PSNR in dB, or a size; what files of other sizes and qualities say of the file that meets it."""

    psnr: float | None = None
    size_bytes: int | None = None

    def cost(self, trial: Trial, reached: float, floor: float) -> float:
        """What a file like this one would cost at the goal, in logarithms of bytes but for a constant.

        At a PSNR that is its size. At a size it is what the error is worth.

        Args:
            trial: the file.
            reached: its PSNR.
            floor: PSNR with nothing wrong but what is left out; the finest steps do not get beyond it.
        """
        dropped, error = error_of_psnr(floor), error_of_psnr(reached)
        left = max(error - dropped, _LEAST_LEFT * error)
        if self.size_bytes is not None:
            share = np.array(trial.size_bytes / self.size_bytes)
            return BYTES_PER_DB * 10.0 * math.log10(float(error_at_size(share, np.array(dropped), left, BYTES_PER_DB)))
        allowed = error_of_psnr(self.psnr or 0.0) - dropped
        if allowed <= 0.0:
            return math.inf
        return math.log(trial.size_bytes) + BYTES_PER_DB * 10.0 * math.log10(max(left, _LEAST_LEFT * allowed) / allowed)


@dataclass
class Chooser:
    """Compares choices. Owns what it found out of the scene without its upper bands.

    Attributes:
        trials: makes the files.
        source: the scene.
        encoding: what the caller fixed is not chosen here.
    """

    trials: Trials
    source: SplatModel
    encoding: EncodeOptions

    def __post_init__(self) -> None:
        self._truncated: dict[int, float] = {}
        self._costs: dict[Choice, float] = {}
        self._quality = 0.0

    def first(self) -> Choice:
        """The choice that comparisons begin with, and the only one where nothing is left to choose."""
        encoding = self.encoding
        if not self._degree() or encoding.sh_coding == "none":
            return Choice("none")
        coding = encoding.sh_coding
        if coding == "auto":
            huge = float(np.abs(self.source.shN).max(initial=0.0)) > _LARGEST_SH
            coding = "scalar" if huge else PRESETS[encoding.preset].sh_coding
        return Choice("scalar") if coding == "scalar" else Choice("codebook", _FIRST_SHARE)

    def best(self, part: Part, quality: float, goal: Goal, start: Trial | None = None) -> Choice:
        """Compare.

        Args:
            part: the splats that are coded.
            quality: of the encoder, at which all are tried.
            goal: what is looked for.
            start: a file of these splats at this quality, where there is one.
        """
        if not self._choosable() and not self.trials.gradable:
            return self.first()
        before, costs = self._costs, dict[Choice, float]()
        if abs(quality - self._quality) > _ELSEWHERE:
            before = {}
        likely = min(before, key=lambda choice: before[choice]) if before else self.first()
        start = self.trials.judged(start or self.trials.encode(part, likely, quality))
        wanted = start.psnr if goal.psnr is None else goal.psnr
        costs[start.choice] = goal.cost(start, start.psnr, self.floor(start))

        def cost(choice: Choice) -> float:
            if before.get(choice, -math.inf) > _FAR + min(before.values(), default=0.0):
                return math.inf  # it was far behind with other splats
            if choice not in costs:
                trial = self.trials.encode(part, choice, quality)
                reached = self.trials.glimpsed(decode(trial.result.data))
                costs[choice] = goal.cost(trial, reached, self.floor(trial))
            return costs[choice]

        if self._choosable():
            self._try_codings(start.choice, cost)
            if self.encoding.sh_degree is None:
                self._try_degrees(min(costs, key=lambda choice: costs[choice]), wanted, cost)
        if self.trials.gradable:
            cost(replace(min(costs, key=lambda choice: costs[choice]), graded=False, adaptive=None))
        self._costs, self._quality = costs, quality
        return min(costs, key=lambda choice: costs[choice])

    def floor(self, trial: Trial) -> float:
        """PSNR with this file's SH and nothing else wrong: what the finest steps of the others do not get beyond."""
        if trial.choice.coding == "none" and self._degree():
            return self._without(0)
        if trial.choice.coding != "codebook":
            return math.inf if trial.choice.degree is None else self._without(trial.choice.degree)
        decoded = decode(trial.result.data)
        return self.trials.glimpsed(replace(trial.part.model.select(_rows(trial)), shN=decoded.shN))

    def _try_codings(self, start: Choice, cost: Callable[[Choice], float]) -> None:
        """Codebooks around one that was tried, and none."""
        encoding = self.encoding
        if start.coding == "codebook" and encoding.codebook_size is None:
            self._descend(start, cost)
        if encoding.sh_coding == "auto":
            cost(Choice("scalar"))
        if encoding.sh_coding != "codebook" and encoding.adaptive is None and self.trials.gradable:
            cost(Choice("scalar", adaptive=_ADAPTIVE))

    def _descend(self, start: Choice, cost: Callable[[Choice], float]) -> None:
        """Codebooks larger and smaller by steps, as long as it pays."""
        for factor in (1 / _SHARE_STEP, _SHARE_STEP):
            choice, gained = start, False
            while True:
                share = (choice.share or 0.0) * factor
                if not _SHARES[0] <= share <= _SHARES[1]:
                    break
                after = replace(choice, share=share)
                if cost(after) >= cost(choice):
                    break
                choice, gained = after, True
            if gained:
                break

    def _try_degrees(self, best: Choice, wanted: float, cost: Callable[[Choice], float]) -> None:
        """The fewest bands that hide what is missing from the goal, by what the scene itself shows without others."""
        for degree in range(self._degree()):
            if self._without(degree) >= wanted + _DROPPED or (degree == 0 and self._without(0) > wanted + 1.0):
                cost(Choice("none", degree=0) if degree == 0 else replace(best, degree=degree))
                if self._without(degree) >= wanted + _DROPPED:
                    break

    def _without(self, degree: int) -> float:
        """PSNR of the source with the bands up to a degree and no others."""
        if degree not in self._truncated:
            self._truncated[degree] = self.trials.glimpsed(without_bands(self.source, degree))
        return self._truncated[degree]

    def _choosable(self) -> bool:
        """Whether there is SH to choose about."""
        return self._degree() > 0 and self.encoding.sh_coding != "none"

    def _degree(self) -> int:
        fixed = self.encoding.sh_degree
        return self.source.sh_degree if fixed is None else min(fixed, self.source.sh_degree)


def _rows(trial: Trial) -> NDArray[np.int64]:
    """Which splat of its part each splat of a file is."""
    index = trial.result.source_index
    return index if trial.part.rows is None else np.searchsorted(trial.part.rows, index)
