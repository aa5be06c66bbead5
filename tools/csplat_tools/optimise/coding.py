"""What to keep of SH, how to code it, whether splats are graded: tried near the goal, compared by what they cost."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from csplat.encoder import EncodeOptions
from csplat.model import SplatModel
from csplat_tools.files.scenes import without_bands
from csplat_tools.optimise.solving import Solver
from csplat_tools.optimise.trials import Coding, Part, Trial

__all__ = ["Codings"]

_LARGEST_SH = 1e4  # larger values are no escapes of a codebook at every quality
_SHARE_AT = (38.0, 1 / 64, 0.4)  # dB of a file, entries of its SH codebook per splat, and how many octaves a dB is
_SHARE_STEP = 4.0
_FITTED = 2.0  # times as many per splat where others were taken away: those that stay differ more
_SHARES = (1 / 4096, 1 / 4)
_ADAPTIVE = 1.0  # coarseness of the SH of unimportant splats, beside the preset's, where importance was measured
_DROPPED = 5.0  # dB above the goal: what bands that are left out may cost, a third of the error
_NONE_DROPPED = 1.0  # the same without any: a file of no SH is the quickest to try
_FIRST_TRIES, _TRIES = 4, 2  # files that bring a coding near the goal, at most
_CLOSER = 3  # files that bring what seems best nearer still
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
        kinds = {"scalar": [scalar], "codebook": [Coding("codebook", _share(psnr) * (_FITTED if part.refits else 1.0))]}
        if self.encoding.sh_coding != "auto":
            return kinds[self.encoding.sh_coding]
        huge = float(np.abs(self.source.shN).max(initial=0.0)) > _LARGEST_SH
        plain = huge or self.encoding.preset == "fast"  # a codebook for each precision that is tried takes too long
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
        tried = _Tried(solver, part, start)
        first, *others = self.usual(part, solver.goal.psnr or _SHARE_AT[0])
        tried.add(first)
        if others:
            others = self.usual(part, tried.found[first].decided_psnr - solver.about(tried.found[first]))[1:]
        for coding in others:
            tried.add(coding, sized=self.encoding.codebook_size is None)
        if brief:
            return tried.ordered()
        if self.encoding.codebook_size is None:
            for book in [coding for coding in tried.found if coding.sh == "codebook"]:
                close = tried.add(book) < tried.add(tried.best) + (0.0 if part.refits else _CLOSE) + 1e-9
                if close or tried.is_off(book):
                    tried.resize(book)
        if tried.best.adaptive is not None:
            tried.add(replace(tried.best, adaptive=None))
        if not part.refits:
            tried.bring_closer()
            if self.encoding.sh_degree is None and self.encoding.sh_coding != "none":
                for degree in self._degrees(solver):
                    tried.add(Coding("none", degree=0) if degree == 0 else replace(tried.best, degree=degree))
        if self.gradable and part.gradable:
            tried.add(replace(tried.best, graded=False, adaptive=None), finer=_GRADED)
        return tried.ordered()

    @property
    def _degree(self) -> int:
        fixed = self.encoding.sh_degree
        return self.source.sh_degree if fixed is None else min(fixed, self.source.sh_degree)

    def _degrees(self, solver: Solver) -> list[int]:
        """The fewest bands that hide what is missing from the goal, by what the scene itself shows without others."""
        wanted = solver.goal.psnr
        if wanted is None:
            wanted = max((trial.decided_psnr for trial in solver.trials.made), default=0.0)
        found: set[int] = set()
        for degree in reversed(range(self._degree)):
            if degree not in self._truncated:
                self._truncated[degree] = solver.trials.decider.psnr(without_bands(self.source, degree))
            shown = self._truncated[degree]
            if shown <= wanted + _NONE_DROPPED:
                break  # fewer bands show less
            if shown >= wanted + _DROPPED:
                found = {degree}
            elif degree == 0:
                found.add(degree)
        return sorted(found)


@dataclass(eq=False)
class _Tried:
    """One file of each coding that was tried for some splats: near the goal, or as near as was worth it.

    Attributes:
        solver: brings files near the goal.
        part: the splats.
        start: PSNR that each attribute is to keep, to begin with.
        found: the files.
    """

    solver: Solver
    part: Part
    start: float
    found: dict[Coding, Trial] = field(default_factory=dict, init=False)

    @property
    def best(self) -> Coding:
        """What is expected to cost least; of a PSNR, among what is near enough for that to be known."""
        unknown = {coding: self.solver.goal.size_bytes is None and self.is_off(coding) for coding in self.found}
        return min(self.found, key=lambda coding: (unknown[coding], self.solver.expected(self.found[coding])))

    def ordered(self) -> list[Trial]:
        """The files, what costs least first."""
        return sorted(self.found.values(), key=self.solver.cost)

    def add(self, coding: Coding, *, finer: float = 0.0, sized: bool = True) -> float:
        """What a coding is expected to cost; a first file says whether a second one is worth it.

        Args:
            coding: what is tried, if it was not yet.
            finer: dB by which it wants more precision than the best one so far, about.
            sized: another size of a codebook may be tried instead of other steps.
        """
        solver, found = self.solver, self.found
        if not found:
            found[coding] = solver.near(self.part, coding, self.start, _FIRST_TRIES)
        elif coding not in found:
            known, quality = solver.expected(found[self.best]), self._quality() + finer
            if coding.sh == "codebook" and all(one.sh != "codebook" for one in found):
                quality -= _BOOKED
            found[coding] = trial = solver.near(self.part, coding, quality, 1)
            unsure = _UNSURE[0] + _UNSURE[1] * abs(solver.about(trial))
            if solver.expected(trial) < known + unsure and not (sized and self.is_off(coding)):
                found[coding] = solver.near(self.part, coding, quality, _TRIES)
        return solver.expected(found[coding])

    def resize(self, book: Coding) -> None:
        """Codebooks of other sizes by steps, as long as it pays; where one is far off, the way that this says."""
        above, stalled = self.solver.about(self.found[book]), self.solver.is_stalled(self.found[book])
        ways = ((1 / _SHARE_STEP, above < -_OFF or stalled), (_SHARE_STEP, above > _OFF))
        for factor in [factor for factor, is_wrong in ways if not is_wrong]:
            coding, gained = book, False
            while (after := _resized(coding, factor)) is not None:
                # Where one is too small for any precision, smaller ones are, too, though no file of theirs says so yet.
                pays = self.add(after) < self.add(coding)
                if not pays and not (factor > 1.0 and self.solver.is_stalled(self.found[after])):
                    break
                coding, gained = after, gained or pays
            if gained:
                break

    def bring_closer(self) -> None:
        """More files of what seems best, until it lies so near the goal that it may be taken for it."""
        for _ in range(_CLOSER):
            best = self.best
            self.found[best] = self.solver.closer(self.found[best])

    def is_off(self, coding: Coding) -> bool:
        """Whether another size of its codebook is likelier to bring it near the goal than other steps."""
        if coding.share is None:
            return False
        above = self.solver.about(self.found[coding])
        share = coding.share * (_SHARE_STEP if above < 0.0 else 1 / _SHARE_STEP)
        is_far = abs(above) > _OFF or self.solver.is_stalled(self.found[coding])
        return is_far and _SHARES[0] <= share <= _SHARES[1]

    def _quality(self) -> float:
        """The precision at which the best of those tried would meet the goal."""
        known = min(self.found.values(), key=self.solver.cost)
        assert known.quality is not None
        return known.quality - self.solver.about(known)


def _resized(book: Coding, factor: float) -> Coding | None:
    """A codebook of so many times the entries, or as many as there may be; `None` where it has these."""
    before = book.share or 0.0
    share = min(max(before * factor, _SHARES[0]), _SHARES[1])
    return replace(book, share=share) if abs(math.log2(share / before)) >= 1.0 else None


def _share(psnr: float) -> float:
    """Entries of a codebook per splat that are usual at a PSNR."""
    usual, share, octaves = _SHARE_AT
    wanted = share * math.pow(2.0, octaves * (psnr - usual))
    return min(max(wanted, _SHARES[0] * _SHARE_STEP), _SHARES[1] / _SHARE_STEP)
