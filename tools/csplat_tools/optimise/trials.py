"""Files tried on the way to a target: which splats, how their colours are coded, how precisely; each is made once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import Coded, Draft, EncodeOptions, EncodeResult, Importance, ShCoding
from csplat.model import SplatModel
from csplat_render.judge import Judge
from csplat_render.metrics import psnr_of_mse
from csplat_tools.files.console import Progress

__all__ = ["Coding", "Part", "Trial", "Trials", "Whole", "spread_of"]

F64 = NDArray[np.float64]
Weights = NDArray[Any] | Importance
_ENTRIES = (16, 8192)  # of a codebook that is chosen here, at least and at most
_QUICK_LEVEL = 10  # of files that are compared: half of the time of the highest goes into the last per cent


@dataclass(frozen=True)
class Coding:
    """What is kept of SH, how it is coded, and whether splats are graded.

    Attributes:
        sh: "codebook", "scalar" or "none"; `None`: what the options say, as the plain encoder.
        share: entries of a codebook per splat; `None`: what the options say.
        degree: bands up to this one are kept; `None`: what the options say.
        adaptive: how much coarser unimportant splats are; `None`: what the options say.
        graded: splats are sorted into grades by what was measured, if anything was; else nothing measured is heeded.
    """

    sh: ShCoding | None
    share: float | None = None
    degree: int | None = None
    adaptive: float | None = None
    graded: bool = True

    def options(self, encoding: EncodeOptions, splats: int) -> EncodeOptions:
        """Options of the encoder with this coding."""
        return _options_of(self, encoding, splats)


@lru_cache(maxsize=256)  # a search compares the options of its files a thousand times, and each is checked when made
def _options_of(coding: Coding, encoding: EncodeOptions, splats: int) -> EncodeOptions:
    size = encoding.codebook_size
    if coding.sh == "codebook" and coding.share is not None and size is None:
        size = 1 << round(math.log2(min(max(coding.share * splats, _ENTRIES[0]), _ENTRIES[1])))
    return replace(
        encoding,
        sh_coding=encoding.sh_coding if coding.sh is None else coding.sh,
        codebook_size=size,
        sh_degree=encoding.sh_degree if coding.degree is None else coding.degree,
        adaptive=encoding.adaptive if coding.adaptive is None else coding.adaptive,
        grades=encoding.grades if coding.graded else 1,
    )


class Part(Protocol):
    """Splats that a file is to hold."""

    @property
    def model(self) -> SplatModel:
        """The splats before they are quantised."""
        ...

    @property
    def shown(self) -> SplatModel:
        """What of them is quantised: SH bands may be missing."""
        ...

    @property
    def psnr(self) -> float:
        """Of these by the views that decide, dB; infinite where they are the source's."""
        ...

    @property
    def refits(self) -> bool:
        """Whether colours are fitted to the quantised geometry of a file: then it takes pictures to make."""
        ...

    @property
    def gradable(self) -> bool:
        """Whether they may be sorted into grades."""
        ...

    def coded(self, options: EncodeOptions, *, graded: bool, quick: bool) -> Coded:
        """Code them; quick is without that fit."""
        ...

    def said(self, trial: Trial | None) -> Mapping[str, Any] | None:
        """What a file's options say of them, and, if there is one, of how good it is; `None`: nothing."""
        ...


@dataclass(frozen=True, eq=False)
class Whole:
    """All splats of a scene.

    Attributes:
        model: the scene.
        importance: what the caller says of the splats. measured: what views say of them, to grade them by.
        progress: is told the encoder's stages.
    """

    model: SplatModel
    importance: Weights | None
    measured: Importance | None
    progress: Progress | None
    psnr: float = math.inf
    refits: bool = False
    gradable: bool = True

    @property
    def shown(self) -> SplatModel:
        """All of it."""
        return self.model

    def coded(self, options: EncodeOptions, *, graded: bool, quick: bool) -> Coded:  # noqa: ARG002  # the protocol's
        """Code them."""
        weights = self.measured if graded and self.measured is not None else self.importance
        draft = Draft.of(self.model, options, importance=weights, progress=self.progress)
        return draft.coded(self.progress)

    def said(self, trial: Trial | None) -> None:  # as the protocol has it
        """Nothing: the file holds the scene as it is."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One file.

    Attributes:
        part, coding, quality: what it was made of, and the PSNR that each attribute was to keep; `None`: the preset's.
        options: of the encoder.
        is_careful: it is packed as tightly as the caller wants, and no fit of its colours was left out.
        result: of the encoder.
        judge: the source's renders in the views that judge.
        decided_psnr: by the views that decide, dB: what files are compared by.
        photo_psnr: by the photographs that decide, dB; NaN where none do.
        decode: reads its bytes.
    """

    part: Part
    coding: Coding
    quality: float | None
    options: EncodeOptions
    is_careful: bool
    result: EncodeResult = field(repr=False)
    judge: Judge = field(repr=False)
    decided_psnr: float
    photo_psnr: float
    decode: Callable[[bytes], SplatModel] = field(default=decode, repr=False)

    @cached_property
    def errors(self) -> F64:
        """[V] mean squared error by judging view, against the source."""
        return self.judge.errors(self.decode(self.result.data))

    @property
    def psnr(self) -> float:
        """Of these errors, pooled, dB: what a target asks for, and what files are not compared by."""
        return psnr_of_mse(self.judge.pooled(self.errors))

    @property
    def is_judged(self) -> bool:
        """Whether the views that judge looked at it yet."""
        return "errors" in vars(self)

    def let_judge(self) -> None:
        """Have them look at it: only then may it be written for a PSNR."""
        _ = self.errors

    @property
    def is_packed(self) -> bool:
        """Whether it is packed as tightly as the caller wants."""
        return self.is_careful or self.part.refits

    def told(self, result: EncodeResult) -> Trial:
        """The same file, which says more of itself; who looked at this one need not look again."""
        other = replace(self, result=result)
        vars(other).update({name: vars(self)[name] for name in ("errors",) if name in vars(self)})
        return other

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self.result.data)

    @property
    def splats(self) -> int:
        """Splats of the file."""
        return self.result.report.splat_count

    @property
    def grades(self) -> int:
        """How many grades its splats are sorted into."""
        return len(self.result.report.options.get("grades", {}).get("splats", [0]))

    def as_json(self) -> dict[str, Any]:
        """Say what was tried and what came of it."""
        options = self.result.report.options
        return {
            "splats": self.splats,
            "preset": self.options.preset,
            "attribute_psnr": None if self.quality is None else round(self.quality, 3),
            "deflate_level": options["deflate_level"],
            "sh_coding": options["sh_coding"],
            "sh_degree": options["sh_degree"],
            "codebook_size": options["codebook_size"],
            "grades": self.grades,
            "size_bytes": self.size_bytes,
            "decided_psnr": round(self.decided_psnr, 3),
            "psnr": round(self.psnr, 3) if self.is_judged else None,
        }


@dataclass(eq=False)
class Trials:
    """Makes files and judges them, each once. Owns all that were made.

    Attributes:
        encoding: the caller's knobs, which no choice overrides.
        judge: the source's renders in the views that judge: they say where a file stands, and choose nothing.
        decider: in the views that decide: by them files are compared.
        photographs: those that decide, where a loss against photographs is the target.
        made: every file, in order.
        progress: is told which file is made.
        decode: reads the bytes of a file; another encoder than csplat's, such as a formula, brings its own.
    """

    encoding: EncodeOptions
    judge: Judge
    decider: Judge
    photographs: Judge | None = None
    made: list[Trial] = field(default_factory=list)
    progress: Progress | None = None
    decode: Callable[[bytes], SplatModel] = decode
    _judged: WeakKeyDictionary[Part, float] = field(default_factory=WeakKeyDictionary, init=False)

    @property
    def renders(self) -> int:
        """How many pictures were rendered of them."""
        return sum(len(self.decider.cameras) + one.is_judged * len(self.judge.cameras) for one in self.made)

    def judged_psnr(self, part: Part) -> float:
        """Of what a part quantises by the views that judge, dB: how much of the error that they allow removal took."""
        if part not in self._judged:
            self._judged[part] = self.judge.psnr(part.shown)
        return self._judged[part]

    def make(
        self, part: Part, coding: Coding, quality: float | None, *, quick: bool, encoding: EncodeOptions | None = None
    ) -> Trial:
        """Make a file, if there is none like it yet.

        Args:
            part: its splats.
            coding: of their colours.
            quality: PSNR that each attribute is to keep; `None`: what the options say.
            quick: pack it less tightly where that is most of the work (what is decoded is the same), and leave out a
                last fit of its colours.
            encoding: knobs, instead of those that all files share.
        """
        options = coding.options(encoding or self.encoding, len(part.model))
        options = options if quality is None else replace(options, attribute_psnr=quality)
        packing = options.preset != "fast" and options.sh_coding != "codebook" and options.deflate_level is None
        if quick and packing and not part.refits:
            options = replace(options, deflate_level=_QUICK_LEVEL)
        careful = not (quick and (part.refits or packing))
        for trial in self.made:
            alike = trial.part is part and trial.options == options and trial.coding.graded == coding.graded
            if alike and trial.is_careful == careful:
                return trial
        tell, stage = self.progress or (lambda _stage, _done: None), f"file {len(self.made) + 1}"
        tell(stage, 0.0)
        coded = part.coded(options, graded=coding.graded, quick=quick)
        result = coded.write(part.said(None))
        model = self.decode(result.data)
        decided_psnr = self.decider.psnr(model)
        photo_psnr = math.nan if self.photographs is None else self.photographs.psnr(model)
        trial = Trial(
            part, coding, quality, options, careful, result, self.judge, decided_psnr, photo_psnr, self.decode
        )
        said = part.said(trial)
        self.made.append(trial if said is None else trial.told(coded.write(said)))
        tell(stage, 1.0)
        return self.made[-1]

    def of(self, part: Part, coding: Coding, *, careful: bool = False) -> list[Trial]:
        """Files of some splats and a coding, at whatever quality; those that might be written, or all."""
        wanted = coding.options(self.encoding, len(part.model))
        made = [one for one in self.made if one.part is part and one.quality is not None]
        made = [one for one in made if one.coding.options(self.encoding, len(part.model)) == wanted]
        return [one for one in made if one.is_careful] if careful else made


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
