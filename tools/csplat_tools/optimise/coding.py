"""What to keep of SH, how to code it, whether splats are graded: tried near the goal, compared by what they cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from csplat.encoder import PRESETS, EncodeOptions
from csplat.model import SplatModel
from csplat_tools.models import without_bands
from csplat_tools.optimise.solving import Solver
from csplat_tools.optimise.trials import Coding, Part, Trial

__all__ = ["Codings"]

_LARGEST_SH = 1e4  # larger values are no escapes of a codebook at every quality
_SHARE_AT = (38.0, 1 / 64, 0.4)  # dB of a file, entries of its SH codebook per splat, and how many octaves a dB is
_SHARE_STEP = 4.0
_SHARES = (1 / 4096, 1 / 8)
_ADAPTIVE = 1.0  # coarseness of the SH of unimportant splats, beside the preset's, where importance was measured
_DROPPED = 5.0  # dB above the goal: what bands that are left out may cost, a third of the error
_FIRST_TRIES, _TRIES = 4, 2  # files that bring a coding near the goal, at most
_CLOSER = 3  # files that bring what seems best so near that it may be taken for it
_GRADED = 1.0  # dB that grades are worth, about
_BOOKED = 0.7  # dB by which a codebook's file is better than one of values one by one, at the same precision
_UNSURE = (0.02, 0.04)  # of the bytes: what a file says of the cost on the goal, and for every dB that it lies beside
_OFF = 1.5  # dB: a codebook that is so much worse than values one by one is too small, one so much better too large
_CLOSE = 0.1  # of the bytes: a codebook that costs so much more than values one by one may win in another size


@dataclass(eq=False)
class Codings:
    """Compares codings for the splats of one scene. Owns what the scene shows without its upper bands.

    Attributes:
        source: the scene.
        encoding: what the caller fixed is not chosen here.
        gradable: something was measured by which splats may be graded.
    """

    source: SplatModel
    encoding: EncodeOptions
    gradable: bool
    _truncated: dict[int, float] = field(default_factory=dict, init=False)

    def usual(self, part: Part, psnr: float = _SHARE_AT[0]) -> list[Coding]:
        """One coding of each kind that may be: values one by one, a codebook, none.

        Args:
            part: the splats.
            psnr: of files near the goal, about, dB.
        """
        if not self._degree or self.encoding.sh_coding == "none":
            return [Coding("none")]
        coarse = self.gradable and not part.refits and self.encoding.adaptive is None
        scalar = Coding("scalar", adaptive=_ADAPTIVE if coarse else None)
        kinds = {"scalar": [scalar], "codebook": [Coding("codebook", _share(psnr))]}
        if self.encoding.sh_coding != "auto":
            return kinds[self.encoding.sh_coding]
        huge = float(np.abs(self.source.shN).max(initial=0.0)) > _LARGEST_SH
        plain = huge or PRESETS[self.encoding.preset].sh_coding == "scalar"
        return [scalar] if plain else [scalar, *kinds["codebook"]]

    def best(self, solver: Solver, part: Part, start: float, *, brief: bool = False) -> list[Trial]:
        """Try what may be best.

        Args:
            solver: brings files near the goal.
            part: the splats.
            start: PSNR that each attribute is to keep, to begin with.
            brief: only one coding of each kind.

        Returns:
            One file of each coding that was tried, what costs least first.
        """
        found: dict[Coding, Trial] = {}

        def cost(coding: Coding, finer: float = 0.0) -> float:
            if coding not in found:
                known = min(map(solver.expected, found.values()), default=math.inf)
                quality = _start(solver, found, start) + finer
                quality -= _BOOKED if coding.sh == "codebook" and all(one.sh != "codebook" for one in found) else 0.0
                found[coding] = trial = solver.near(part, coding, quality, 1 if found else _FIRST_TRIES)
                unsure = _UNSURE[0] + _UNSURE[1] * abs(solver.about(trial))
                if len(found) > 1 and solver.expected(trial) < known + unsure and not self._is_off(trial, solver):
                    found[coding] = solver.near(part, coding, quality, _TRIES)
            return solver.expected(found[coding])

        def best() -> Coding:
            return min(found, key=lambda coding: solver.expected(found[coding]))

        first, *others = self.usual(part, solver.goal.psnr or _SHARE_AT[0])
        cost(first)
        if others:
            others = self.usual(part, found[first].decided_psnr - solver.about(found[first]))[1:]
        for coding in others:
            cost(coding)
        if brief:
            return sorted(found.values(), key=solver.cost)
        for book in [coding for coding in found if coding.sh == "codebook" and self.encoding.codebook_size is None]:
            if cost(book) < cost(best()) + (0.0 if part.refits else _CLOSE) + 1e-9:
                _resize(book, cost, solver.about(found[book]))
        if best().adaptive is not None:
            cost(replace(best(), adaptive=None))
        for _ in range(0 if part.refits else _CLOSER):
            likeliest = best()
            found[likeliest] = solver.closer(found[likeliest])
        if not part.refits and self.encoding.sh_degree is None and self.encoding.sh_coding != "none":
            for degree in self._degrees(solver):
                cost(Coding("none", degree=0) if degree == 0 else replace(best(), degree=degree))
        if self.gradable and part.gradable and not part.refits:
            cost(replace(best(), graded=False, adaptive=None), _GRADED)
        return sorted(found.values(), key=solver.cost)

    def _is_off(self, trial: Trial, solver: Solver) -> bool:
        """Whether another size of its codebook is likelier to bring it near the goal than other steps."""
        if trial.coding.share is None or self.encoding.codebook_size is not None:
            return False
        above = solver.about(trial)
        share = trial.coding.share * (_SHARE_STEP if above < 0.0 else 1 / _SHARE_STEP)
        return abs(above) > _OFF and _SHARES[0] <= share <= _SHARES[1]

    @property
    def _degree(self) -> int:
        fixed = self.encoding.sh_degree
        return self.source.sh_degree if fixed is None else min(fixed, self.source.sh_degree)

    def _degrees(self, solver: Solver) -> Iterator[int]:
        """The fewest bands that hide what is missing from the goal, by what the scene itself shows without others."""
        wanted = solver.goal.psnr
        if wanted is None:
            wanted = max((trial.decided_psnr for trial in solver.trials.made), default=0.0)
        for degree in range(self._degree):
            if degree not in self._truncated:
                self._truncated[degree] = solver.trials.decider.psnr(without_bands(self.source, degree))
            shown = self._truncated[degree]
            if shown >= wanted + _DROPPED or (degree == 0 and shown > wanted + 1.0):
                yield degree
            if shown >= wanted + _DROPPED:
                break


def _start(solver: Solver, found: dict[Coding, Trial], start: float) -> float:
    """Where the best of those tried would meet the goal."""
    if not found:
        return start
    known = min(found.values(), key=solver.cost)
    assert known.quality is not None
    return known.quality - solver.about(known)


def _share(psnr: float) -> float:
    """Entries of a codebook per splat that are usual at a PSNR."""
    usual, share, octaves = _SHARE_AT
    wanted = share * math.pow(2.0, octaves * (psnr - usual))
    return min(max(wanted, _SHARES[0] * _SHARE_STEP), _SHARES[1] / _SHARE_STEP)


def _resize(start: Coding, cost: Callable[[Coding], float], above: float) -> None:
    """Codebooks of other sizes by steps, as long as it pays; smaller ones, where the first is so far above the goal."""
    factors = [factor for factor, off in ((1 / _SHARE_STEP, above < -_OFF), (_SHARE_STEP, above > _OFF)) if not off]
    for factor in factors:
        coding, gained = start, False
        while _SHARES[0] <= (coding.share or 0.0) * factor <= _SHARES[1]:
            after = replace(coding, share=(coding.share or 0.0) * factor)
            if cost(after) >= cost(coding):
                break
            coding, gained = after, True
        if gained:
            break
