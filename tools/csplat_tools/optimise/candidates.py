# SPDX-License-Identifier: Apache-2.0
"""Candidates of a search: files of a subset of the splats, with a coding of SH and a precision, each made once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import decode
from csplat.encoder import (
    PRESETS,
    EncodedTiles,
    EncodeOptions,
    EncodePlan,
    EncodeResult,
    Importance,
    PresetName,
    ShCoding,
    encode_tiles,
    max_class_count,
    project_sh,
)
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import Progress, null_progress
from csplat_render.metrics import psnr_of_mse
from csplat_render.scorer import Scorer
from csplat_tools.scene_sensitivity import importance_views, measure_importance
from csplat_tools.views import ViewSet

if TYPE_CHECKING:
    from csplat_tools.level_builder import FittedLevelBuilder

_FEW_VIEWS = 12  # least number of validation views in which drafts are compared

#: Stages of progress: a draft, which skips the refit through the quantisers; another file; levels of detail of a file.
DRAFT, FILE, LEVELS = "encoding a draft", "encoding a file", "building levels"

#: Importance of the splats, as for the encoder.
Weights = NDArray[Any] | Importance


@dataclass(frozen=True)
class Coding:
    """The SH bands of a file, their coding, and the use of quantisation classes. `None`: as in the caller's options.

    Attributes:
        sh: "codebook", "scalar" or "none".
        entries_per_splat: codebook entries per splat.
        degree: SH degree to keep.
        adaptive: how much coarser unimportant splats are coded.
        use_classes: sort splats into quantisation classes by measured importance, if there is any.
        preset: a preset whose own precision and codebook are used.
    """

    sh: ShCoding | None = None
    entries_per_splat: float | None = None
    degree: int | None = None
    adaptive: float | None = None
    use_classes: bool = True
    preset: PresetName | None = None

    def options(self, encoding: EncodeOptions, splats: int, quality: float | None) -> EncodeOptions:
        """Return the caller's options with this coding and precision, for a file of this number of splats."""
        size = encoding.codebook_size
        if self.entries_per_splat is not None and size is None:
            most = PRESETS[encoding.preset].codebook_most
            size = 1 << round(math.log2(min(max(self.entries_per_splat * splats, 1.0), most)))
        return replace(
            encoding,
            preset=self.preset or encoding.preset,
            attribute_psnr=encoding.attribute_psnr if quality is None else quality,
            sh_coding=encoding.sh_coding if self.sh is None else self.sh,
            codebook_size=size,
            sh_degree=encoding.sh_degree if self.degree is None else self.degree,
            adaptive=encoding.adaptive if self.adaptive is None else self.adaptive,
            max_classes=encoding.max_classes if self.use_classes else 1,
            tile_splats=encoding.tile_splats or _spec.TILE_SPLATS_MAX,  # smaller ones take 0.3 to 1.5 % more bytes
        )


class Subset(Protocol):
    """Splats for candidates.

    Attributes:
        model: the splats.
        refits: encoding refits the splats through the quantisers, which requires rendering; drafts skip that.
        classifiable: the splats may be sorted into quantisation classes.
    """

    @property
    def model(self) -> SplatModel:  # noqa: D102
        ...

    @property
    def refits(self) -> bool:  # noqa: D102
        ...

    @property
    def classifiable(self) -> bool:  # noqa: D102
        ...

    def encode(self, options: EncodeOptions, *, use_classes: bool, draft: bool) -> EncodedTiles:
        """Quantise and code the splats."""
        ...

    def lowered(self, degree: int) -> SplatModel:
        """Return the splats with fewer SH bands, as they are encoded."""
        ...

    def metadata(self, validation_psnr: float) -> Mapping[str, Any] | None:
        """Return the entries for the file's options."""
        ...


@dataclass(frozen=True, eq=False)
class WholeScene:
    """All splats of a scene, with the source's values.

    Attributes:
        model: the scene.
        importance: the caller's importance of the splats.
        measured: importance measured in views, for quantisation classes.
        context: threads, seed and progress.
    """

    model: SplatModel
    importance: Weights | None
    measured: Importance | None
    context: Context = DEFAULT_CONTEXT
    refits: bool = False

    @property
    def classifiable(self) -> bool:
        """True if importance was measured."""
        return self.measured is not None

    def encode(self, options: EncodeOptions, *, use_classes: bool, draft: bool) -> EncodedTiles:  # noqa: ARG002  # the protocol's
        """Quantise and code the splats."""
        weights, drops = self.importance, options.kept_degree(self.model.sh_degree) < self.model.sh_degree
        if self.measured is not None and (use_classes or drops):
            weights = self.measured if use_classes else replace(self.measured, blocks=None)
        return encode_tiles(EncodePlan.of(self.model, options, importance=weights, context=self.context))

    def lowered(self, degree: int) -> SplatModel:
        """Return the splats with fewer SH bands."""
        return project_sh(self.model, degree, self.measured)

    def metadata(self, validation_psnr: float) -> None:  # the protocol's
        """Return nothing."""


@dataclass(eq=False)
class Candidate:
    """A file of a search.

    Attributes:
        subset, coding: its splats, and the coding of their colours.
        quality: its precision, PSNR of each attribute alone, dB; `None`: the precision of the options.
        is_draft: the refit through the quantisers was skipped.
        options: options of the encoder.
        coded, result: the encoder's tiles, and its result.
        error: mean squared error on the validation views, against renders of the source.
        is_exact: the error was measured in all of these views, not estimated from some.
        image_error: mean squared error against the validation images; `None` until it is measured.
        test_psnr: PSNR on the test views, pooled, dB; `None` until it is measured.
    """

    subset: Subset
    coding: Coding
    quality: float | None
    is_draft: bool
    options: EncodeOptions
    coded: EncodedTiles = field(repr=False)
    result: EncodeResult = field(repr=False)
    error: float
    is_exact: bool
    image_error: float | None = None
    test_psnr: float | None = None

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

    @property
    def validation_psnr(self) -> float:
        """PSNR on the validation views, pooled, dB."""
        return psnr_of_mse(self.error)

    def as_json(self) -> dict[str, Any]:
        """Return settings, size and PSNR as JSON-compatible values."""
        options = self.result.report.options
        return {
            "splats": self.splats,
            "preset": self.options.preset,
            "attribute_psnr": None if self.quality is None else round(self.quality, 3),
            "draft": self.is_draft,
            "sh_coding": options["sh_coding"],
            "sh_degree": options["sh_degree"],
            "codebook_size": options["codebook_size"],
            "classes": self.class_count,
            "size_bytes": self.size_bytes,
            "validation_psnr": round(self.validation_psnr, 3),
            "estimated": not self.is_exact,
            "psnr": None if self.test_psnr is None else round(self.test_psnr, 3),
        }


@dataclass(eq=False)
class CandidatePool:
    """Makes candidates and scores them, each once.

    A few views suffice to compare candidates, but not to tell their error in all: the PSNR of eight views of a scene
    differs by 0.1 to 1.9 dB (one standard deviation of eleven scenes) from the PSNR of eight others. Where all
    validation views are rendered, the ratio of both errors is measured, with which others are estimated.

    Attributes:
        encoding: the caller's options, which are never overridden.
        validation_scorer: scorer on all validation views.
        progress: progress callback, called for each candidate.
        made: all candidates, in order.
        decode: decodes the bytes of a file; tests replace it.
        renders: number of renders that were scored.
    """

    encoding: EncodeOptions
    validation_scorer: Scorer
    progress: Progress | None = None
    made: list[Candidate] = field(default_factory=list)
    decode: Callable[[bytes], SplatModel] = decode
    renders: int = field(default=0, init=False)
    _ratio: float = field(default=1.0, init=False)  # error in all validation views, divided by the error in some

    def error(self, model: SplatModel, *, exact: bool) -> float:
        """Return the mean squared error of splats on the validation views, estimated from some unless `exact`."""
        scorer = self.validation_scorer
        step = max(1, len(scorer.cameras) // _FEW_VIEWS)
        some = scorer.every(step)
        errors = (scorer if exact else some).errors(model)
        self.renders += len(errors)
        if not exact:
            return self._ratio * some.pooled(errors)
        error, error_in_some = scorer.pooled(errors), some.pooled(errors[::step])
        self._ratio = error / error_in_some if error_in_some > 0.0 else 1.0
        return error

    def image_error(self, scorer: Scorer, candidate: Candidate) -> float:
        """Return the mean squared error of a candidate against images."""
        self.renders += len(scorer.cameras)
        return scorer.pooled(scorer.errors(self.decode(candidate.result.data)))

    def measure(self, candidate: Candidate) -> None:
        """Measure the error of a candidate in all validation views, unless that is done."""
        if not candidate.is_exact:
            candidate.error = self.error(self.decode(candidate.result.data), exact=True)
            candidate.is_exact = True

    def make(self, subset: Subset, coding: Coding, quality: float | None, *, draft: bool) -> Candidate:
        """Make a candidate, or return the candidate that was already made with the same arguments.

        Args:
            subset: its splats.
            coding: the coding of their colours.
            quality: PSNR of each attribute alone, dB; `None`: the precision of the options.
            draft: skip the refit through the quantisers, if the subset has such a refit, and estimate the error, unless
                it is the first candidate of its splats: errors of quantisation and of pruning have different ratios.
        """
        options = coding.options(self.encoding, len(subset.model), quality)
        exact = not draft or all(candidate.subset is not subset for candidate in self.made)
        draft = draft and subset.refits
        for candidate in self.made:
            is_alike = candidate.subset is subset and candidate.coding.use_classes == coding.use_classes
            if is_alike and candidate.options == options and candidate.is_draft == draft:
                if exact:
                    self.measure(candidate)
                return candidate
        report, stage = self.progress or null_progress, DRAFT if draft else FILE
        report(stage, 0.0)
        coded = subset.encode(options, use_classes=coding.use_classes, draft=draft)
        result = coded.write()
        error = self.error(self.decode(result.data), exact=exact)
        entries = subset.metadata(psnr_of_mse(error))
        result = result if entries is None else coded.write(entries)
        self.made.append(Candidate(subset, coding, quality, draft, options, coded, result, error, exact))
        report(stage, 1.0)
        return self.made[-1]

    def with_levels(self, candidate: Candidate, levels: FittedLevelBuilder) -> Candidate:
        """Return the splats of a candidate in a file with levels of detail.

        Its tiles differ from the tiles that the splats were refitted for, so its error is larger.
        """
        report = self.progress or null_progress
        report(LEVELS, 0.0)
        coded = candidate.coded
        entries = {"levels": levels.settings(len(coded.plan.model))}
        encoded = levels.encode_plan(coded.plan, coded.codebooks)
        if coded.plan.origin.refitted:  # errors refer to the source, not to the splats of the plan
            encoded = replace(encoded, errors=coded.errors)
        error = self.error(self.decode(encoded.write(entries).data), exact=True)
        result = encoded.write({**(candidate.subset.metadata(psnr_of_mse(error)) or {}), **entries})
        report(LEVELS, 1.0)
        return replace(
            candidate, coded=encoded, result=result, error=error, is_exact=True, image_error=None, test_psnr=None
        )

    def of(self, subset: Subset, coding: Coding, *, draft: bool) -> list[Candidate]:
        """Return the candidates of a subset and coding at any precision, either drafts or the others."""
        splats, options = len(subset.model), coding.options(self.encoding, len(subset.model), None)
        made = [
            candidate
            for candidate in self.made
            if candidate.subset is subset and candidate.quality is not None and candidate.is_draft == draft
        ]
        return [candidate for candidate in made if candidate.coding.options(self.encoding, splats, None) == options]


def complete_importance(
    source: SplatModel,
    views: ViewSet,
    encoding: EncodeOptions,
    importance: Weights | None,
    *,
    inside: bool,
    projects: bool = True,
    context: Context = DEFAULT_CONTEXT,
) -> tuple[Importance | None, int]:
    """Return the caller's importance, completed by measurements.

    Args:
        source: the scene.
        views: the views; importance is measured in training views.
        encoding: the caller's options; some exclude quantisation classes.
        importance: the caller's importance. If it has Gauss–Newton blocks, nothing is measured; else it is kept for SH.
        inside: the views are virtual, in a surrounding scene; they only say in which directions splats are seen.
        projects: dropped SH bands may be projected onto the others, for these directions.
        context: threads and progress.

    Returns:
        The importance, `None` if it is unknown or would change nothing; and the number of views used here.
    """
    may_classify = max_class_count(len(source), encoding) > 1
    if isinstance(importance, Importance) and importance.blocks is not None:
        return (importance if may_classify else None), 0
    has_sh = source.sh_degree > 0 and encoding.sh_degree != 0 and encoding.sh_coding != "none"
    is_fast = encoding.preset == "fast" and encoding.max_classes is None
    drops = projects and encoding.kept_degree(source.sh_degree) < source.sh_degree
    if not drops and (inside or is_fast or not (may_classify or has_sh)):
        return None, 0
    cameras = importance_views(views, len(source))
    try:
        measured = measure_importance(source, cameras, views.background, matrices=drops, context=context)
    except InputError:
        return None, 0  # no splat is visible
    if inside or is_fast:
        measured = replace(measured, blocks=None)
    if isinstance(importance, Importance):
        directions = measured.sh_metric if importance.sh_metric is None else importance.sh_metric
        measured = replace(importance, blocks=measured.blocks, sh_metric=directions)
    elif importance is not None:
        measured = replace(measured, sh=np.asarray(importance))
    if not encoding.shape_codebook_size:
        measured = replace(measured, shape_metric=None)  # frees half of the memory
    return measured, len(cameras)
