"""Candidate files of a search, given by splats, coding of their colours and precision; each is made once."""

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

_ENTRIES = (16, 8192)  # least and largest number of entries of a codebook that is chosen here
_QUICK_LEVEL = 10  # DEFLATE level of drafts: the highest spends half of its time on the last per cent


@dataclass(frozen=True)
class CodingChoice:
    """The SH bands that are kept, their coding, and the use of quantisation classes.

    Attributes:
        sh: "codebook", "scalar" or "none"; `None`: as in the options, like the plain encoder.
        entries_per_splat: entries of a codebook per splat; `None`: as in the options.
        degree: bands up to this one are kept; `None`: as in the options.
        adaptive: how much coarser unimportant splats are coded; `None`: as in the options.
        use_classes: splats are sorted into quantisation classes by measurements, if there are any; False: measurements
            are not used.
    """

    sh: ShCoding | None
    entries_per_splat: float | None = None
    degree: int | None = None
    adaptive: float | None = None
    use_classes: bool = True

    def options(self, encoding: EncodeOptions, splats: int) -> EncodeOptions:
        """Return the encoder's options with this coding, for a file of `splats` splats."""
        return _options_of(self, encoding, splats)


@lru_cache(maxsize=256)  # a search compares the options of its files a thousand times, and each is checked when made
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
    """Splats that a file is to hold."""

    @property
    def model(self) -> SplatModel:
        """The splats before they are quantised."""
        ...

    @property
    def unquantised(self) -> SplatModel:
        """The splats that are quantised: SH bands may be left out."""
        ...

    @property
    def psnr(self) -> float:
        """PSNR of `unquantised` on the validation views, dB; infinite for the source's own splats."""
        ...

    @property
    def refits(self) -> bool:
        """True if encoding refits the splats through the quantisers of a file, which needs rendering."""
        ...

    @property
    def classifiable(self) -> bool:
        """True if the splats may be sorted into quantisation classes."""
        ...

    def coded(self, options: EncodeOptions, *, use_classes: bool, quick: bool) -> EncodedTiles:
        """Quantise and code the splats; `quick` leaves out the refit through the quantisers."""
        ...

    def options_entry(self, candidate: Candidate | None) -> Mapping[str, Any] | None:
        """Return the entry for a file's options: the splats and, with a file, its quality; `None`: no entry."""
        ...


@dataclass(frozen=True, eq=False)
class WholeScene:
    """All splats of a scene.

    Attributes:
        model: the scene.
        importance: the caller's importance of the splats.
        measured: importance measured from views, by which splats are sorted into quantisation classes.
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
        """Return no entry: the file holds the scene as it is."""


@dataclass(eq=False)
class Candidate:
    """A candidate file. Owns its score on the test views, which is measured when first asked for.

    Attributes:
        subset, coding: its splats, and the coding of their colours.
        quality: the PSNR of each attribute for which it was made, dB; `None`: that of the options.
        options: options of the encoder.
        is_final: it is packed as tightly as the caller requires, and no refit was left out.
        result: the encoder's result.
        test_scorer: scorer by the source's renders in the test views.
        validation_psnr: PSNR on the validation views, dB, by which files are compared.
        photo_psnr: PSNR against the validation images, dB; NaN if there are none.
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
        """PSNR of these errors, pooled, dB: targets refer to it, and files are not compared by it."""
        return psnr_of_mse(self.test_scorer.pooled(self.errors))

    @property
    def is_scored(self) -> bool:
        """True if the file has been scored on the test views."""
        return self._errors is not None

    def score_on_test_views(self) -> None:
        """Score the file on the test views: only then may it be written for a PSNR target."""
        _ = self.errors

    @property
    def is_packed(self) -> bool:
        """True if the file is packed as tightly as the caller requires."""
        return self.is_final or self.subset.refits

    def with_result(self, result: EncodeResult) -> Candidate:
        """Return the file with another result, whose options have more entries; its score is kept."""
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
    """Makes candidate files and scores them, each once. Owns all that were made.

    Attributes:
        encoding: the caller's options, which no choice overrides.
        test_scorer: scorer by the source's renders in the test views: a PSNR target refers to them, and they choose
            nothing.
        validation_scorer: scorer by the source's renders in the validation views, by which files are compared.
        image_scorer: scorer by validation images, if the target is a loss against images.
        made: all files, in order.
        progress: progress callback, called with each file that is made.
        decode: decodes the bytes of a file; an encoder other than csplat's, such as a formula in tests, brings its own.
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
        """Number of renders made of the files."""
        return sum(
            len(self.validation_scorer.cameras) + one.is_scored * len(self.test_scorer.cameras) for one in self.made
        )

    def test_psnr(self, subset: Subset) -> float:
        """Return the PSNR of a subset before quantisation on the test views, dB: the error that pruning takes."""
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
        """Make a file, or return the one that was made with the same arguments.

        Args:
            subset: its splats.
            coding: the coding of their colours.
            quality: PSNR of each attribute, dB; `None`: that of the options.
            quick: pack it less tightly if that is most of the work (the decoded splats are the same), and leave out
                the refit through the quantisers.
            encoding: options of the encoder, instead of those that all files share.
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
        tell, stage = self.progress or null_progress, f"file {len(self.made) + 1}"
        tell(stage, 0.0)
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
        tell(stage, 1.0)
        return self.made[-1]

    def of(self, subset: Subset, coding: CodingChoice, *, final: bool = False) -> list[Candidate]:
        """Return files of given splats and coding, at any quality; with `final`, only those that might be written."""
        options = coding.options(self.encoding, len(subset.model))
        made = [one for one in self.made if one.subset is subset and one.quality is not None]
        made = [one for one in made if one.coding.options(self.encoding, len(subset.model)) == options]
        return [one for one in made if one.is_final] if final else made
