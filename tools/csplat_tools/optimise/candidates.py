"""Candidates of a search, given by subset, coding of colours and precision; each is made once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Protocol
from weakref import WeakKeyDictionary

from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import EncodedTiles, EncodeOptions, EncodePlan, EncodeResult, Importance, ShCoding, encode_tiles
from csplat.model import SplatModel
from csplat.types import F64, Progress, null_progress
from csplat_render.metrics import psnr_of_mse
from csplat_render.scorer import Scorer

#: Importance of the splats, as for the encoder.
Weights = NDArray[Any] | Importance

_ENTRIES = (16, 8192)  # least and largest number of codebook entries chosen here
_QUICK_LEVEL = 10  # DEFLATE level of drafts; the highest level spends half of its time on the last 1 %


@dataclass(frozen=True)
class CodingChoice:
    """The SH bands to keep, their coding, and the use of quantisation classes.

    Attributes:
        sh: "codebook", "scalar" or "none"; `None`: as in the options.
        entries_per_splat: codebook entries per splat; `None`: as in the options.
        degree: SH degree to keep; `None`: as in the options.
        adaptive: how much coarser unimportant splats are coded; `None`: as in the options.
        use_classes: sort splats into quantisation classes by measured importance, if there is any.
    """

    sh: ShCoding | None
    entries_per_splat: float | None = None
    degree: int | None = None
    adaptive: float | None = None
    use_classes: bool = True

    def options(self, encoding: EncodeOptions, splats: int) -> EncodeOptions:
        """Return the encoder's options with this coding, for a file with this number of splats."""
        return _options_of(self, encoding, splats)


@lru_cache(maxsize=256)  # a search compares options a thousand times, and they are validated when made
def _options_of(coding: CodingChoice, encoding: EncodeOptions, splats: int) -> EncodeOptions:
    size = encoding.codebook_size
    if coding.sh == "codebook" and coding.entries_per_splat is not None and size is None:
        size = 1 << round(math.log2(min(max(coding.entries_per_splat * splats, _ENTRIES[0]), _ENTRIES[1])))
    return replace(
        encoding,
        sh_coding=encoding.sh_coding if coding.sh is None else coding.sh,
        codebook_size=size,
        sh_degree=encoding.sh_degree if coding.degree is None else coding.degree,
        adaptive=encoding.adaptive if coding.adaptive is None else coding.adaptive,
        max_classes=encoding.max_classes if coding.use_classes else 1,
    )


class Subset(Protocol):
    """Splats for a candidate."""

    @property
    def model(self) -> SplatModel:
        """The splats before SH bands are dropped."""
        ...

    @property
    def unquantised(self) -> SplatModel:
        """The splats to quantise; SH bands may have been dropped."""
        ...

    @property
    def psnr(self) -> float:
        """PSNR of `unquantised` on the validation views, dB; infinite for the source's own splats."""
        ...

    @property
    def refits(self) -> bool:
        """True if encoding refits the splats through the quantisers, which requires rendering."""
        ...

    @property
    def classifiable(self) -> bool:
        """True if the splats may be sorted into quantisation classes."""
        ...

    def coded(self, options: EncodeOptions, *, use_classes: bool, quick: bool) -> EncodedTiles:
        """Quantise and code the splats; `quick` skips the refit through the quantisers."""
        ...

    def options_entry(self, candidate: Candidate | None) -> Mapping[str, Any] | None:
        """Return the entry for the file's options: the splats and, with a candidate, its quality; `None`: no entry."""
        ...


@dataclass(frozen=True, eq=False)
class WholeScene:
    """All splats of a scene.

    Attributes:
        model: the scene.
        importance: the caller's importance of the splats.
        measured: importance measured in views, for quantisation classes.
        progress: progress callback.
    """

    model: SplatModel
    importance: Weights | None
    measured: Importance | None
    progress: Progress | None
    psnr: float = math.inf
    refits: bool = False
    classifiable: bool = True

    @property
    def unquantised(self) -> SplatModel:
        """The whole scene."""
        return self.model

    def coded(self, options: EncodeOptions, *, use_classes: bool, quick: bool) -> EncodedTiles:  # noqa: ARG002  # the protocol's
        """Quantise and code the splats."""
        weights = self.measured if use_classes and self.measured is not None else self.importance
        plan = EncodePlan.of(self.model, options, importance=weights, progress=self.progress)
        return encode_tiles(plan, progress=self.progress)

    def options_entry(self, candidate: Candidate | None) -> None:  # the protocol's
        """Return no entry."""


@dataclass(eq=False)
class Candidate:
    """A candidate file. Owns its score on the test views, which is measured on first use.

    Attributes:
        subset, coding: its splats, and the coding of their colours.
        quality: its attribute PSNR, dB; `None`: that of the options.
        options: options of the encoder.
        is_final: it is fully compressed, and no refit was skipped.
        result: the encoder's result.
        test_scorer: scorer on the test views, against the source's renders.
        validation_psnr: PSNR on the validation views, dB, by which candidates are compared.
        photo_psnr: PSNR on the validation images, dB; NaN without images.
        decode: decodes its bytes.
    """

    subset: Subset
    coding: CodingChoice
    quality: float | None
    options: EncodeOptions
    is_final: bool
    result: EncodeResult = field(repr=False)
    test_scorer: Scorer = field(repr=False)
    validation_psnr: float
    photo_psnr: float
    decode: Callable[[bytes], SplatModel] = field(default=decode, repr=False)
    _errors: F64 | None = field(default=None, repr=False)

    @property
    def errors(self) -> F64:
        """[V] mean squared error against the source, by test view."""
        if self._errors is None:
            self._errors = self.test_scorer.errors(self.decode(self.result.data))
        return self._errors

    @property
    def psnr(self) -> float:
        """PSNR on the test views, pooled, dB. Targets refer to it; candidates are not compared by it."""
        return psnr_of_mse(self.test_scorer.pooled(self.errors))

    @property
    def is_scored(self) -> bool:
        """True if the file has been scored on the test views."""
        return self._errors is not None

    def score_on_test_views(self) -> None:
        """Score the file on the test views, as required for a PSNR target."""
        _ = self.errors

    @property
    def is_packed(self) -> bool:
        """True if the file is fully compressed."""
        return self.is_final or self.subset.refits

    def with_result(self, result: EncodeResult) -> Candidate:
        """Return the candidate with another result of the same splats; the score is kept."""
        return replace(self, result=result)

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self.result.data)

    @property
    def splats(self) -> int:
        """Number of splats of the file."""
        return self.result.report.splat_count

    @property
    def class_count(self) -> int:
        """Number of quantisation classes of its splats."""
        return len(self.result.report.options.get("classes", {}).get("splats", [0]))

    def as_json(self) -> dict[str, Any]:
        """Return settings, size and PSNR as JSON-compatible values."""
        options = self.result.report.options
        return {
            "splats": self.splats,
            "preset": self.options.preset,
            "attribute_psnr": None if self.quality is None else round(self.quality, 3),
            "deflate_level": options["deflate_level"],
            "sh_coding": options["sh_coding"],
            "sh_degree": options["sh_degree"],
            "codebook_size": options["codebook_size"],
            "classes": self.class_count,
            "size_bytes": self.size_bytes,
            "validation_psnr": round(self.validation_psnr, 3),
            "psnr": round(self.psnr, 3) if self.is_scored else None,
        }


@dataclass(eq=False)
class CandidatePool:
    """Makes candidates and scores them, each once. Owns all of them.

    Attributes:
        encoding: the caller's options, which are never overridden.
        test_scorer: scorer on the test views, to which a PSNR target refers.
        validation_scorer: scorer on the validation views, by which candidates are compared.
        image_scorer: scorer on validation images, if the target is a drop of PSNR.
        made: all candidates, in order.
        progress: progress callback, called for each candidate.
        decode: decodes the bytes of a file; tests replace it.
    """

    encoding: EncodeOptions
    test_scorer: Scorer
    validation_scorer: Scorer
    image_scorer: Scorer | None = None
    made: list[Candidate] = field(default_factory=list)
    progress: Progress | None = None
    decode: Callable[[bytes], SplatModel] = decode
    _test_psnr: WeakKeyDictionary[Subset, float] = field(default_factory=WeakKeyDictionary, init=False)

    @property
    def render_count(self) -> int:
        """Number of renders of the candidates."""
        return sum(
            len(self.validation_scorer.cameras) + one.is_scored * len(self.test_scorer.cameras) for one in self.made
        )

    def test_psnr(self, subset: Subset) -> float:
        """Return the PSNR of a subset before quantisation on the test views, dB."""
        if subset not in self._test_psnr:
            self._test_psnr[subset] = self.test_scorer.psnr(subset.unquantised)
        return self._test_psnr[subset]

    def make(
        self,
        subset: Subset,
        coding: CodingChoice,
        quality: float | None,
        *,
        quick: bool,
        encoding: EncodeOptions | None = None,
    ) -> Candidate:
        """Make a candidate, or return the one that was made with the same arguments.

        Args:
            subset: its splats.
            coding: the coding of their colours.
            quality: attribute PSNR, dB; `None`: that of the options.
            quick: make a draft: lower compression if that saves time (the decoded splats are the same), and no refit
                through the quantisers.
            encoding: options of the encoder, instead of the shared ones.
        """
        options = coding.options(encoding or self.encoding, len(subset.model))
        options = options if quality is None else replace(options, attribute_psnr=quality)
        packing = options.preset != "fast" and options.sh_coding != "codebook" and options.deflate_level is None
        if quick and packing and not subset.refits:
            options = replace(options, deflate_level=_QUICK_LEVEL)
        final = not (quick and (subset.refits or packing))
        for candidate in self.made:
            is_same_kind = candidate.subset is subset and candidate.coding.use_classes == coding.use_classes
            if is_same_kind and candidate.options == options and candidate.is_final == final:
                return candidate
        report, stage = self.progress or null_progress, f"file {len(self.made) + 1}"
        report(stage, 0.0)
        coded = subset.coded(options, use_classes=coding.use_classes, quick=quick)
        result = coded.write(subset.options_entry(None))
        model = self.decode(result.data)
        validation_psnr = self.validation_scorer.psnr(model)
        photo_psnr = math.nan if self.image_scorer is None else self.image_scorer.psnr(model)
        candidate = Candidate(
            subset, coding, quality, options, final, result, self.test_scorer, validation_psnr, photo_psnr, self.decode
        )
        entry = subset.options_entry(candidate)
        self.made.append(candidate if entry is None else candidate.with_result(coded.write(entry)))
        report(stage, 1.0)
        return self.made[-1]

    def of(self, subset: Subset, coding: CodingChoice, *, final: bool = False) -> list[Candidate]:
        """Return candidates of a subset and coding, at any precision; with `final`, without drafts."""
        options = coding.options(self.encoding, len(subset.model))
        made = [one for one in self.made if one.subset is subset and one.quality is not None]
        made = [one for one in made if one.coding.options(self.encoding, len(subset.model)) == options]
        return [one for one in made if one.is_final] if final else made
