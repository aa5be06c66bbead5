"""Choose SH bands, their coding and quantisation classes, by the expected cost of candidates near the goal."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from csplat.encoder import EncodeOptions
from csplat.model import SplatModel
from csplat.scene_source import drop_bands
from csplat_tools.optimise.candidates import Candidate, CodingChoice, Subset
from csplat_tools.optimise.precision_search import PrecisionSearch

_LARGEST_SH = 1e4  # scenes with larger SH values get no codebook, since escapes cannot code them at some qualities
_USUAL_ENTRIES = (38.0, 1 / 64, 0.4)  # PSNR in dB, usual codebook entries per splat at this PSNR, octaves per dB
_ENTRIES_STEP = 4.0  # factor between codebook sizes to try
_FITTED = 2.0  # factor of the entries per splat after pruning, since kept splats are more diverse
_ENTRIES_PER_SPLAT = (1 / 4096, 1 / 4)  # least and most codebook entries per splat
_ADAPTIVE = 1.0  # `adaptive` to try instead of the preset's for scalar coding of SH, if importance was measured
_BANDS_DROPPED = 5.0  # dB above the goal that a scene without its upper bands must reach: a third of the error
_NONE_DROPPED = 1.0  # dB above the goal that fewer bands must reach to be tried; enough for no SH at all
_FIRST_TRIES, _TRIES = 4, 2  # most candidates for the first coding, and for others, to get near the goal
_CLOSER = 3  # additional candidates for the best coding, to get nearer to the goal
_CLASSES_GAIN = 1.0  # typical gain of quantisation classes, dB
_CODEBOOK_GAIN = 0.7  # typical gain of a codebook over scalar coding at the same precision, dB
_UNSURE = (0.02, 0.04)  # uncertainty of an expected cost, as a fraction of file size: on the goal, and per dB off it
_FAR_OFF = 1.5  # dB; a codebook is too small or too large if its file is off the goal by more
_CLOSE = 0.1  # fraction of file size; a codebook whose cost exceeds the best by less may win with another size


@dataclass(eq=False)
class CodingSearch:
    """A comparison of codings for subsets of one scene. Owns the PSNR of the scene without its upper bands.

    Attributes:
        source: the scene.
        encoding: the caller's options, which are never overridden.
        classifiable: importance was measured, so that quantisation classes are possible.
    """

    source: SplatModel
    encoding: EncodeOptions
    classifiable: bool
    _truncated: dict[int, float] = field(default_factory=dict, init=False)

    def usual_codings(self, subset: Subset, psnr: float = _USUAL_ENTRIES[0]) -> list[CodingChoice]:
        """Return one coding of each possible kind: scalar, codebook, or none.

        Args:
            subset: the splats.
            psnr: approximate PSNR of candidates near the goal, dB.
        """
        if not self._degree or self.encoding.sh_coding == "none":
            return [CodingChoice("none")]
        coarse = self.classifiable and not subset.refits and self.encoding.adaptive is None
        scalar = CodingChoice("scalar", adaptive=_ADAPTIVE if coarse else None)
        kinds = {
            "scalar": [scalar],
            "codebook": [
                CodingChoice("codebook", _usual_entries_per_splat(psnr) * (_FITTED if subset.refits else 1.0))
            ],
        }
        if self.encoding.sh_coding != "auto":
            return kinds[self.encoding.sh_coding]
        is_extreme = float(np.abs(self.source.shN).max(initial=0.0)) > _LARGEST_SH
        if is_extreme or self.encoding.preset == "fast":  # a codebook for each precision takes too long
            return [scalar]
        return [scalar, *kinds["codebook"]]

    def best(self, search: PrecisionSearch, subset: Subset, start: float, *, brief: bool = False) -> list[Candidate]:
        """Try the codings that may be best.

        Args:
            search: finds the precision of candidates.
            subset: the splats.
            start: attribute PSNR of the first candidate, dB.
            brief: try only one coding of each kind.

        Returns:
            One candidate of each coding, the least costly first.
        """
        tried = _TriedCodings(search, subset, start)
        first, *others = self.usual_codings(subset, search.goal.psnr or _USUAL_ENTRIES[0])
        tried.add(first)
        if others:
            goal = tried.found[first].validation_psnr - search.margin(tried.found[first])
            others = self.usual_codings(subset, goal)[1:]
        for coding in others:
            tried.add(coding, sized=self.encoding.codebook_size is None)
        if brief:
            return tried.ordered()
        if self.encoding.codebook_size is None:
            for book in [coding for coding in tried.found if coding.sh == "codebook"]:
                close = tried.add(book) < tried.add(tried.best) + (0.0 if subset.refits else _CLOSE) + 1e-9
                if close or tried.is_far_off(book):
                    tried.resize(book)
        if tried.best.adaptive is not None:
            tried.add(replace(tried.best, adaptive=None))
        if not subset.refits:
            tried.bring_closer()
            if self.encoding.sh_degree is None and self.encoding.sh_coding != "none":
                for degree in self._degrees(search):
                    tried.add(CodingChoice("none", degree=0) if degree == 0 else replace(tried.best, degree=degree))
        if self.classifiable and subset.classifiable:
            tried.add(replace(tried.best, use_classes=False, adaptive=None), finer=_CLASSES_GAIN)
        return tried.ordered()

    @property
    def _degree(self) -> int:
        fixed = self.encoding.sh_degree
        return self.source.sh_degree if fixed is None else min(fixed, self.source.sh_degree)

    def _degrees(self, search: PrecisionSearch) -> list[int]:
        """Return the lower SH degrees worth a try, by the PSNR of the unquantised scene at each."""
        goal = search.goal.psnr
        if goal is None:
            goal = max((candidate.validation_psnr for candidate in search.candidates.made), default=0.0)
        found: set[int] = set()
        for degree in reversed(range(self._degree)):
            if degree not in self._truncated:
                self._truncated[degree] = search.candidates.validation_scorer.psnr(drop_bands(self.source, degree))
            reached = self._truncated[degree]
            if reached <= goal + _NONE_DROPPED:
                break  # fewer bands have a lower PSNR
            if reached >= goal + _BANDS_DROPPED:
                found = {degree}
            elif degree == 0:
                found.add(degree)
        return sorted(found)


@dataclass(eq=False)
class _TriedCodings:
    """One candidate of each coding that was tried for a subset, near the goal or promising.

    Attributes:
        search: finds the precision of candidates.
        subset: the splats.
        start: attribute PSNR of the first candidate, dB.
        found: the candidates.
    """

    search: PrecisionSearch
    subset: Subset
    start: float
    found: dict[CodingChoice, Candidate] = field(default_factory=dict, init=False)

    @property
    def best(self) -> CodingChoice:
        """The coding with the least expected cost; for a PSNR, codings too far from the goal come last."""
        unknown = {coding: self.search.goal.size_bytes is None and self.is_far_off(coding) for coding in self.found}
        return min(self.found, key=lambda coding: (unknown[coding], self.search.expected_cost(self.found[coding])))

    def ordered(self) -> list[Candidate]:
        """Return the candidates, the least costly first."""
        return sorted(self.found.values(), key=self.search.cost)

    def add(self, coding: CodingChoice, *, finer: float = 0.0, sized: bool = True) -> float:
        """Try a coding, with a second candidate if the first is promising, and return its expected cost.

        Args:
            coding: the coding; nothing is made if it was tried before.
            finer: approximate precision that it needs in addition to that of the best so far, dB.
            sized: other codebook sizes may be tried later, instead of another precision.
        """
        search, found = self.search, self.found
        if not found:
            found[coding] = search.find_near(self.subset, coding, self.start, _FIRST_TRIES)
        elif coding not in found:
            known, quality = search.expected_cost(found[self.best]), self._quality() + finer
            if coding.sh == "codebook" and all(one.sh != "codebook" for one in found):
                quality -= _CODEBOOK_GAIN
            found[coding] = candidate = search.find_near(self.subset, coding, quality, 1)
            unsure = _UNSURE[0] + _UNSURE[1] * abs(search.margin(candidate))
            if search.expected_cost(candidate) < known + unsure and not (sized and self.is_far_off(coding)):
                found[coding] = search.find_near(self.subset, coding, quality, _TRIES)
        return search.expected_cost(found[coding])

    def resize(self, book: CodingChoice) -> None:
        """Try smaller or larger codebooks, step by step while it pays; in one direction if it is far off the goal."""
        above, stalled = self.search.margin(self.found[book]), self.search.is_stalled(self.found[book])
        ways = ((1 / _ENTRIES_STEP, above < -_FAR_OFF or stalled), (_ENTRIES_STEP, above > _FAR_OFF))
        for factor in [factor for factor, is_wrong in ways if not is_wrong]:
            coding, gained = book, False
            while (after := _resize(coding, factor)) is not None:
                # If a codebook is too small for any precision, larger ones are tried even if this one did not pay.
                pays = self.add(after) < self.add(coding)
                if not pays and not (factor > 1.0 and self.search.is_stalled(self.found[after])):
                    break
                coding, gained = after, gained or pays
            if gained:
                break

    def bring_closer(self) -> None:
        """Make more candidates of the best coding until one is near enough to the goal for a reliable cost."""
        for _ in range(_CLOSER):
            best = self.best
            self.found[best] = self.search.find_closer(self.found[best])

    def is_far_off(self, coding: CodingChoice) -> bool:
        """Return True if another codebook size is likelier to get near the goal than another precision."""
        if coding.entries_per_splat is None:
            return False
        above = self.search.margin(self.found[coding])
        entries_per_splat = coding.entries_per_splat * (_ENTRIES_STEP if above < 0.0 else 1 / _ENTRIES_STEP)
        is_far = abs(above) > _FAR_OFF or self.search.is_stalled(self.found[coding])
        return is_far and _ENTRIES_PER_SPLAT[0] <= entries_per_splat <= _ENTRIES_PER_SPLAT[1]

    def _quality(self) -> float:
        """Return the attribute PSNR at which the best coding so far would meet the goal, dB."""
        known = min(self.found.values(), key=self.search.cost)
        assert known.quality is not None
        return known.quality - self.search.margin(known)


def _resize(book: CodingChoice, factor: float) -> CodingChoice | None:
    """Return the coding with `factor` times the codebook entries, within limits; `None` if they change too little."""
    before = book.entries_per_splat or 0.0
    entries_per_splat = min(max(before * factor, _ENTRIES_PER_SPLAT[0]), _ENTRIES_PER_SPLAT[1])
    return (
        replace(book, entries_per_splat=entries_per_splat)
        if abs(math.log2(entries_per_splat / before)) >= 1.0
        else None
    )


def _usual_entries_per_splat(psnr: float) -> float:
    """Return the codebook entries per splat that are usual at a PSNR."""
    usual, entries_per_splat, octaves = _USUAL_ENTRIES
    wanted = entries_per_splat * math.pow(2.0, octaves * (psnr - usual))
    return min(max(wanted, _ENTRIES_PER_SPLAT[0] * _ENTRIES_STEP), _ENTRIES_PER_SPLAT[1] / _ENTRIES_STEP)
