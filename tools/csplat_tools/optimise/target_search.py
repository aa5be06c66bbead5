# SPDX-License-Identifier: Apache-2.0
"""Search for the smallest file that meets a PSNR or a drop of PSNR, or for the best file of a size.

How a target is met:

1. A size that no file of the scene needs is recognised by one file (`finest`).
2. The pruning order predicts the error of pruning for every number of kept splats. With typical bytes per decibel this
   gives the first number of splats; for a size, typical bytes per splat do. More splats than that are refitted to
   renders of the source, in few steps. Their measured error corrects the prediction, and the pruning order continues
   with their values, until a whole refit confirms the number (`_choose_splats`).
3. Drafts of the refitted splats, which are files without a refit through their quantisers, are encoded with a coding of
   SH of each kind, then with each neighbour of the best, up to `_TRIES` codings (`_choose_coding`). They give bytes and
   error as functions of the precision (`RateLine`), and so the bytes on the goal (`_predict`).
4. Files of these splats and the best coding are made, with a refit through their quantisers. Each corrects the
   prediction of the precision, until another file is not expected to save enough (`_make_files`). If no file meets the
   goal, other numbers of splats are taken, more for a PSNR and fewer for a size. Of all files that meet it, drafts
   included, the smallest is written, or the best file of a size.

All errors are measured on validation views, those of drafts on a few of them (`CandidatePool`); test views only score
the written file. Errors are against renders of the source. For a drop, files are measured against the validation
images, too, which tells how much error against renders is allowed (`_allowed`). With all splats kept, step 2 is left
out, and the presets' own files are candidates unless the best has quantisation classes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from csplat.context import Context
from csplat.decoder import decode
from csplat.encoder import PRESETS, EncodeOptions, SearchReport, Target
from csplat.errors import InputError, SearchInterrupted
from csplat.goal_search import next_value
from csplat.model import SplatModel
from csplat.types import null_progress
from csplat_render.metrics import psnr_of_mse
from csplat_render.scene_frame import scene_frame
from csplat_render.scorer import Scorer
from csplat_tools.console import format_bytes
from csplat_tools.level_builder import FittedLevelBuilder
from csplat_tools.optimise.candidates import (
    Candidate,
    CandidatePool,
    Coding,
    Subset,
    Weights,
    WholeScene,
    complete_importance,
)
from csplat_tools.optimise.pruning import REFITS, Pruner
from csplat_tools.optimise.rate_distortion import (
    AIM,
    APART,
    BYTES_PER_DB,
    LEAST_QUANTISED,
    LOG_ERROR_PER_DB,
    MOST_LEFT_OUT,
    NOTHING,
    USUAL_BYTES,
    RateLine,
    RatePoint,
    error_of_psnr,
    log_bytes_at_error,
    log_bytes_at_size,
    rate_exponent,
)
from csplat_tools.optimise.search_plan import SCORES, keeps_all, search_plan
from csplat_tools.optimise.search_report import make_report
from csplat_tools.optimise.simplify import SimplifyOptions
from csplat_tools.planned_progress import PlannedProgress
from csplat_tools.scene_sensitivity import MANY_SPLATS
from csplat_tools.views import (
    VIRTUAL,
    ViewSet,
    extra_test_cameras,
    require_visible,
    views_off_path,
    with_validation_views,
)

# Typical values.
_USUAL = PRESETS["small"]  # the first drafts have its precision and codebook
_PSNR_PER_PRECISION = {"codebook": 0.6}  # dB of PSNR per dB of precision; 1 for other codings
# Log bytes per doubling of the codebook by which files are larger than drafts promise, since their refits gain less:
# 0.1 dB and 0.5 % of the bytes in 25 searches of five scenes.
_OCTAVE_COST = 0.012
_TUNING_GAIN = 2.0  # dB of the error of quantisation by the refit through the quantisers; 1.5 to 2.6 in five scenes

# Range and number of the candidates. From 70 dB on, opacities and quats have all their levels; finer means cut tiles.
_QUALITIES = (24.0, 80.0)  # range of the precision, PSNR of each attribute alone, dB
_AMPLE = 16  # bytes per splat; files of the finest precision have 20 or more
_MOST_ENTRIES = 1 / 4  # largest number of codebook entries per splat
_FAR_COUNT = 0.05  # relative difference of two numbers of splats from which on a correction has more steps
_LOWER = 2  # most further refits while the number of splats falls by more than that
_FEW = 3  # most drafts of one coding, files that miss narrowly, and corrections of files with levels of detail
_TRIES = 8  # most codings of some splats at the default effort, and most files of a coding
_BEYOND = 1.4  # factor of the number of splats if no file meets the goal; squared and inverse for a size
_LARGEST_SH = 1e4  # scenes with larger SH values get no codebook, since escapes cannot code them at some precisions

# Distances, and the worth of another candidate.
_NEAR, _FAR = 1.0, 5.0  # dB of precision: a draft predicts the bytes on its goal; a step is too long to be believed
_LEVEL_0 = 0.72  # fraction of a file with levels of detail that its level 0 takes; 0.72 to 0.74 of three scenes
_SPLAT_SAVING = 4e-8  # fraction of the bytes that another file must save, by splat; 1 % is worth 10 CPU seconds
_WORTH = 0.03  # fraction of the splats, or of the bytes, below which a difference is not worth a candidate

_AMPLE_REMARK = "the target is larger than this scene can use: {} hold all splats at the finest precision"
_INSIDE_REMARK = (
    "splats were pruned by virtual views, which may show less than cameras inside of the surroundings do:"
    " use --data, or --cameras with at least 40 cameras, or keep all splats with --no-prune"
)


@dataclass(frozen=True, eq=False)
class Goal:
    """The goal of a search.

    Attributes:
        size_bytes: largest size of the file; `None` without a target size.
        error: largest mean squared error on the validation views: against images for a drop, else against renders of
            the source.
        images: scorer on the validation images; `None` unless the goal is a drop.
        source_error: mean squared error of the source against these images; 0 without.
        max_error: largest errors of splats by measure; files that exceed any are rejected.
    """

    size_bytes: int | None = None
    error: float = math.inf
    images: Scorer | None = None
    source_error: float = 0.0
    max_error: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, target: Target, source: SplatModel, images: Scorer | None) -> Goal:
        """Return the goal for a target.

        Args:
            target: a PSNR, a size or a drop of PSNR.
            source: the scene.
            images: scorer on the validation images; required for a drop.
        """
        if target.psnr is not None:
            return cls(error=error_of_psnr(target.psnr), max_error=target.max_error)
        if target.max_psnr_drop is None or images is None:
            return cls(target.size_bytes, max_error=target.max_error)
        error = images.pooled(images.errors(source))
        return cls(error=error / error_of_psnr(target.max_psnr_drop), images=images, source_error=error)


@dataclass(eq=False)
class TargetSearch:
    """The search for the splats, the coding and the precision of a file.

    Attributes:
        goal: the goal.
        pool: makes the candidates.
        whole: all splats.
        pruner: prunes splats; `None`: all are kept.
        work: amount of work relative to the default effort.
        with_levels: files with levels of detail, with the log of the factor of their goal; `None`: none are requested.
        _errors: mean squared error before quantisation, by subset and SH degree.
    """

    goal: Goal
    pool: CandidatePool
    whole: WholeScene
    pruner: Pruner | None
    work: float = 1.0
    with_levels: list[tuple[float, Candidate]] | None = None
    _errors: dict[tuple[Subset, int], float] = field(default_factory=dict, init=False)

    def best(self) -> Candidate:
        """Return the smallest file that meets the goal, or the best file of a size.

        Raises:
            InputError: no file meets the goal.
        """
        if self.pruner is None:
            coding = self._choose_coding(self.whole, self._most_codings(self.whole))
            self._make_files(self.whole, coding)
            if not (coding.use_classes and self.whole.classifiable):  # the presets' own files have no classes
                self._try_presets(coding)
        else:
            subset, coding = self._choose_splats(self.pruner)
            while not self._make_files(subset, coding):
                another = self.pruner.refit(self._count_beyond(len(subset.model)))
                if len(another.model) == len(subset.model):
                    break
                subset = another
                self._draft_cost(subset, coding, {})
        return self._chosen()

    def best_with_levels(self, levels: FittedLevelBuilder) -> Candidate:
        """Return the best file with levels of detail, whose bytes count for a size.

        Bytes and error of the whole file are only known once the levels are built for the splats of a file. So the goal
        of the file without levels is predicted, and corrected by what the whole file has.

        Raises:
            InputError: no file meets the goal.
        """
        goal, is_size = self.goal, self.goal.size_bytes is not None
        made = self.with_levels = list[tuple[float, Candidate]]()
        near = _WORTH / self._bytes_per_db * self._log_result_per_db
        log_level_0 = math.log(_LEVEL_0) if is_size else 0.0  # other levels are expected to add bytes, but no error
        while True:
            log_factor = next_value(
                0.0, [(log_tried, self._log_result(file)) for log_tried, file in made],
                lambda log_tried: log_tried - log_level_0, bounds=(math.log(LEAST_QUANTISED), 0.0),
                margin=0.5 * near if made else 0.0, tolerance=near, tries=_FEW + 1,
            )  # fmt: skip
            if log_factor is None:
                break
            factor = math.exp(log_factor)
            error = goal.source_error + factor * (goal.error - goal.source_error)
            size_bytes = None if goal.size_bytes is None else max(1, int(factor * goal.size_bytes))
            without = replace(self, goal=replace(goal, size_bytes=size_bytes, error=error), with_levels=None)
            file = self.pool.with_levels(without.best(), levels)
            self._measure_image_error(file)
            made.append((log_factor, file))
        return self._chosen()

    def finest(self) -> Candidate | None:
        """Return the file of all splats at the finest precision if it meets the target size, otherwise `None`.

        It is made only if the size may be that large.
        """
        if self.goal.size_bytes is None or self.goal.size_bytes < _AMPLE * len(self.whole.model):
            return None
        candidate = self.pool.make(self.whole, self._first_codings(self.whole)[0], _QUALITIES[1], draft=False)
        return candidate if self._is_met(candidate) else None

    def best_draft(self) -> tuple[Candidate, float]:
        """Return the draft of the best splats, coding and precision, and its expected error after another refit."""
        assert self.pruner is not None
        subset, coding = self._choose_splats(self.pruner)
        draft = self.pool.make(subset, coding, self._predict(subset, coding)[0], draft=True)
        return draft, self._unquantised_error(subset, coding) + self._quantisation_error(draft)

    # The number of splats

    def _choose_splats(self, pruner: Pruner) -> tuple[Subset, Coding]:
        """Return the best number of splats by the model, refitted, and their best coding. Add drafts to the pool.

        Brief refits correct the prediction of the pruning order, and the whole refit corrects theirs. Each refit may
        show that even fewer splats suffice.
        """
        kept_count, turn, is_far = self._best_count(pruner), 0, False
        costs, errors = dict[int, float](), dict[int, float]()  # by number of splats: of drafts, and of pruning
        while True:
            part, rest_gain, surplus = pruner.turn(turn, is_far=is_far)
            count, turn = self._rounded(surplus * kept_count), turn + 1
            subset, coding = pruner.refit(count, part), None
            if self.goal.size_bytes is not None or self.goal.images is not None:  # what files of the goal are like
                coding = self._choose_coding(subset, len(self._first_codings(subset)))
            kept_count = self._best_count(pruner, subset, rest_gain, coding)
            is_settled = rest_gain < _NEAR
            if is_settled and coding is not None:
                costs[count] = self._predict(subset, coding)[1]
                cheapest = min(costs, key=costs.__getitem__)
                kept_count = kept_count if cheapest == count else cheapest
            elif is_settled:
                errors[count] = self._unquantised_error(subset, Coding())
                kept_count = self._between(errors, kept_count)
            is_near = abs(kept_count - count) <= _WORTH * kept_count
            is_whole = is_settled or len(subset.model) == len(self.whole.model)
            takes_too_much = errors.get(count, 0.0) > self._most_left_out * self._allowed
            is_far = abs(kept_count - count) > _FAR_COUNT * count
            further = _FEW if takes_too_much else _LOWER * (is_far and kept_count < count)
            if (is_near and is_whole) or turn >= len(REFITS) + further:
                return subset, self._choose_coding(subset, self._most_codings(subset))

    def _between(self, errors: Mapping[int, float], proposed: int) -> int:
        """Return a proposed number of splats, between the numbers at which pruning took too much of the error or not.

        Args:
            errors: mean squared error of pruning by number of kept splats. It rises faster than the pruning order
                predicts where splats hide each other.
            proposed: the number.
        """
        most = self._most_left_out * self._allowed
        few = max((count for count, error in errors.items() if error > most), default=0)
        enough = min((count for count, error in errors.items() if error <= most and count > few), default=0)
        return round(math.sqrt(few * enough)) if few and enough and not few < proposed < enough else proposed

    def _best_count(
        self, pruner: Pruner, refitted: Subset | None = None, rest_gain: float = 0.0, coding: Coding | None = None
    ) -> int:
        """Return the best number of splats by the model, 1 to all. For a PSNR or a drop, extends the pruning order.

        Args:
            pruner: predicts the error of pruning.
            refitted: splats whose measured error corrects the prediction; `None`: a refit has the usual gain, and a
                size the usual bytes per splat.
            rest_gain: dB by which another refit of them will reduce this error.
            coding: for a size, the best coding of these splats, of which drafts were made.
        """
        size_bytes, allowed, known = self.goal.size_bytes, self._allowed, None
        if refitted is not None:
            # With all bands that the options keep: the error of dropped bands is not due to pruning.
            error = self._unquantised_error(refitted, Coding(), exact=rest_gain < _NEAR)
            known = len(refitted.model), error_of_psnr(rest_gain) * error
        if size_bytes is None:
            counts, errors = pruner.errors(allowed, known)
            costs = log_bytes_at_error(counts, errors, allowed, self._exponent, self._most_left_out)
        elif refitted is None or coding is None:
            return self._rounded(min(size_bytes / USUAL_BYTES[self.whole.model.sh_degree > 0], len(self.whole.model)))
        else:
            line = self._rate_line(refitted, coding)
            quantised = line.error_at(line.quality_at_size(size_bytes))
            counts, errors = pruner.errors(quantised, known)
            costs = log_bytes_at_size(counts / len(refitted.model), errors, quantised, self._exponent)
        return self._rounded(counts[int(np.argmin(costs))])

    @property
    def _bytes_per_db(self) -> float:
        """The usual change of log bytes per dB of quantisation error."""
        return BYTES_PER_DB[self.whole.model.sh_degree > 0]

    @property
    def _most_left_out(self) -> float:
        """The largest fraction of a file's error that pruning and left-out SH bands may take."""
        return MOST_LEFT_OUT[self.whole.model.sh_degree > 0]

    @property
    def _exponent(self) -> float:
        """The k of bytes ∝ n · Q^-k."""
        return rate_exponent(self._bytes_per_db)

    def _count_beyond(self, count: int) -> int:
        """Return the next number of splats to try if no file of this number meets the goal."""
        return self._rounded(count * _BEYOND if self.goal.size_bytes is None else count / _BEYOND**2)

    def _rounded(self, count: float) -> int:
        """Return a number of splats; all of them if pruning the others would not pay."""
        splats = len(self.whole.model)
        return splats if count > (1.0 - _WORTH) * splats else max(1, round(count))

    # The coding

    def _most_codings(self, subset: Subset) -> int:
        """Return the number of codings to try."""
        return 1 if self._leaves_coding_open(subset) else max(2, round(_TRIES * self.work))

    @staticmethod
    def _leaves_coding_open(subset: Subset) -> bool:
        """Return True if many splats are all kept: files take too long to compare codings, and the encoder chooses."""
        return not subset.refits and len(subset.model) > MANY_SPLATS

    def _choose_coding(self, subset: Subset, most: int) -> Coding:
        """Return the coding with the least expected cost, of at most `most`.

        A coding of each kind is tried; then codebooks of other sizes, and neighbours of the best coding, one at a time.
        Adds drafts to the pool.
        """
        costs = dict[Coding, float]()
        waiting = self._first_codings(subset)
        while waiting and len(costs) < most:
            coding = waiting.pop(0)
            costs[coding] = self._draft_cost(subset, coding, costs)
            if not waiting:
                ordered = sorted(costs, key=costs.__getitem__)
                best, books = ordered[0], [book for book in ordered if book.sh == "codebook"]
                neighbours = self._fewer_bands(subset, best)
                if books:
                    neighbours += self._resized_codebook(books[0], 2.0)
                    if costs[books[0]] <= costs[best] + _WORTH:  # a smaller codebook hardly gains more
                        neighbours += self._resized_codebook(books[0], 0.5)
                    largest = max(books, key=lambda book: book.entries_per_splat or 0.0)
                    if self._needs_entries(subset, largest, costs[best]):
                        neighbours += self._resized_codebook(largest, 2.0)
                waiting = [
                    coding for coding in [*neighbours, *self._uniform_codings(subset, best)] if coding not in costs
                ][:1]
        return min(costs, key=costs.__getitem__)

    def _draft_cost(self, subset: Subset, coding: Coding, costs: Mapping[Coding, float]) -> float:
        """Return the expected cost of a coding in log bytes, from drafts on the goal.

        No draft is made if an earlier one is near the goal, more than one if the first is far and promising. New drafts
        of the first of all codings are measured against the images of a drop.

        Args:
            costs: the costs of the codings that were tried before; empty for the first.
        """
        best, quality = min(costs, key=costs.__getitem__, default=None), self._first_quality(subset, coding)
        if best is not None:  # its codebook may be too small for any precision
            quality = min(self._predict(subset, best)[0], quality + _FAR)
        earlier = self.pool.of(subset, coding, draft=subset.refits)  # when the number of splats was chosen
        if any(abs(quality - (draft.quality or 0.0)) < _NEAR for draft in earlier):
            return self._predict(subset, coding)[1]
        cost = math.inf
        for _ in range(_FEW):
            draft = self.pool.make(subset, coding, quality, draft=True)
            if not costs:
                self._measure_image_error(draft)
            quality, cost = self._predict(subset, coding)
            if abs(quality - (draft.quality or 0.0)) < _NEAR or (best is not None and cost > costs[best] + _WORTH):
                break
        return cost

    def _first_quality(self, subset: Subset, coding: Coding) -> float:
        """Return the precision of the first draft of a subset with a coding, dB.

        It follows from the last candidate of the coding, whose splats may differ; without such a candidate, it is
        the precision of `_USUAL`.
        """
        size_bytes = self.goal.size_bytes
        for candidate in reversed(self.pool.made):
            if candidate.coding == coding and candidate.quality is not None:
                line = self._rate_line(candidate.subset, coding)
                if size_bytes is None:
                    return _clipped(line.quality_at_error(self._allowed_quantisation(subset, coding)))
                return _clipped(line.quality_at_size(size_bytes / len(subset.model) * len(candidate.subset.model)))
        return _USUAL.quality[coding.sh == "none"]

    def _first_codings(self, subset: Subset) -> list[Coding]:
        """Return a coding of each kind that the caller left open, at least one; a codebook comes last."""
        encoding, degree = self.pool.encoding, self.whole.model.sh_degree
        if encoding.sh_coding == "none" or not degree or encoding.sh_degree == 0:
            return [Coding("none")]
        if self._leaves_coding_open(subset):
            return [Coding(None, _USUAL.codebook_share)]
        coarse = subset.classifiable and not subset.refits and encoding.adaptive is None
        scalar = Coding("scalar", adaptive=1.0 if coarse else None)
        book = Coding("codebook", _USUAL.codebook_share)
        if encoding.sh_coding != "auto":
            return [book if encoding.sh_coding == "codebook" else scalar]
        is_extreme = float(np.abs(self.whole.model.shN).max(initial=0.0)) > _LARGEST_SH
        return [scalar] if is_extreme or encoding.preset == "fast" else [scalar, book]

    def _resized_codebook(self, book: Coding, factor: float) -> list[Coding]:
        """Return a coding with more or fewer codebook entries, or none if their number is given or too large."""
        if book.entries_per_splat is None or self.pool.encoding.codebook_size is not None:
            return []
        entries = factor * book.entries_per_splat
        return [replace(book, entries_per_splat=entries)] if entries <= _MOST_ENTRIES else []

    def _needs_entries(self, subset: Subset, book: Coding, cost: float) -> bool:
        """Return True if a codebook may have too few entries for a PSNR.

        Precision hardly lowers its error then, so that its expected cost is high, although its drafts are smaller than
        the file expected of the best coding, whose cost in log bytes is given.
        """
        drafts = self.pool.of(subset, book, draft=subset.refits)
        return self.goal.size_bytes is None and math.log(min(draft.size_bytes for draft in drafts)) < cost - _WORTH

    def _fewer_bands(self, subset: Subset, coding: Coding) -> list[Coding]:
        """Return codings with fewer SH bands, the fewest first, if dropping these takes little of the error.

        Return none for a size, and if the caller chose the degree or the coding.
        """
        encoding, codings = self.pool.encoding, list[Coding]()
        is_fixed = encoding.sh_degree is not None or encoding.sh_coding != "auto"
        if coding.sh == "none" or is_fixed or self.goal.size_bytes is not None:
            return codings
        without = Coding("none", degree=0, use_classes=coding.use_classes)
        for degree in reversed(range(self._degree(coding))):
            fewer = replace(coding, degree=degree) if degree else without
            if self._unquantised_error(subset, fewer) > self._most_left_out * self._allowed:
                break
            codings.insert(0, fewer)
        return codings

    def _uniform_codings(self, subset: Subset, coding: Coding) -> list[Coding]:
        """Return variants of a coding with equal steps for all splats in one more respect, of importance or classes."""
        codings = [replace(coding, adaptive=None)] if coding.adaptive is not None else []
        if subset.classifiable and coding.use_classes and not subset.refits:  # classes pay for refits
            codings.append(replace(coding, use_classes=False))
        return codings

    # The precision

    def _make_files(self, subset: Subset, coding: Coding) -> bool:
        """Add files to the pool until the goal is met and another would hardly be smaller. Return True if it is met.

        Stop early if other splats or another coding cost less. The pool must have a candidate of the subset and coding.
        """
        earlier = self.pool.of(subset, coding, draft=False) or self._by_distance(subset, coding, draft=True)[:1]
        for file in earlier:
            self.pool.measure(file)
            self._measure_image_error(file)
        aim, is_pruned = AIM * self._log_result_per_db, len(subset.model) < len(self.whole.model)
        worth = _SPLAT_SAVING * len(subset.model) / self._bytes_per_db * self._log_result_per_db
        while True:
            made, line = self.pool.of(subset, coding, draft=False), self._rate_line(subset, coding)
            quality = next_value(
                0.0, [(file.quality or 0.0, self._log_result(file)) for file in made],
                partial(self._expected_log_result, subset, coding, line), bounds=_QUALITIES, margin=aim,
                tolerance=aim + max(aim, worth), largest_step=math.inf if is_pruned else _FAR, least_step=0.5 * APART,
                tries=len(earlier) + _TRIES,
            )  # fmt: skip
            is_met = any(self._is_met(file) for file in made)
            if quality is None:
                return is_met
            if self.goal.size_bytes is None:
                others = [file for file in self.pool.made if (file.subset, file.coding) != (subset, coding)]
                smaller = [file for file in others if math.log(file.size_bytes) < line.log_bytes_at(quality)]
                if any(self._is_met(file) for file in smaller):  # other splats or another coding cost less
                    return True
            finest = max((file.quality or 0.0 for file in made), default=math.inf)
            if is_pruned and not is_met and len(made) > 1 and quality > (made[0].quality or 0.0) + _FAR:
                if len(made) > _FEW or min(map(self._log_result, made)) > _NEAR * LOG_ERROR_PER_DB:
                    return False  # other splats cost less
                quality = finest + 2.0 * _NEAR  # refits through the quantisers differ by chance
            self._measure_image_error(self.pool.make(subset, coding, quality, draft=False))

    @property
    def _log_result_per_db(self) -> float:
        """Change of the log of a file's result, which the goal limits, per dB of quantisation error."""
        return LOG_ERROR_PER_DB if self.goal.size_bytes is None else self._bytes_per_db

    def _log_result(self, file: Candidate) -> float:
        """Return the log of a file's size or error, divided by the goal's."""
        if self.goal.size_bytes is not None:
            return math.log(file.size_bytes / self.goal.size_bytes)
        error = file.error if self.goal.images is None else (file.image_error or 0.0) - self.goal.source_error
        # Against images, the error of a file may equal the source's by chance.
        return math.log(max(error / (self.goal.error - self.goal.source_error), LEAST_QUANTISED))

    def _expected_log_result(self, subset: Subset, coding: Coding, line: RateLine, quality: float) -> float:
        """Return what `_log_result` is expected to be for a file at a precision, dB."""
        if self.goal.size_bytes is not None:
            return line.log_bytes_at(quality) - math.log(self.goal.size_bytes)
        return math.log((self._unquantised_error(subset, coding) + line.error_at(quality)) / self._allowed)

    def _predict(self, subset: Subset, coding: Coding) -> tuple[float, float]:
        """Return the precision at which a file of a subset and coding meets the goal, dB, and its cost in log bytes.

        For a size, the cost is the log bytes that the file's error is worth.
        """
        line = self._rate_line(subset, coding)
        if self.goal.size_bytes is not None:
            quality = _clipped(line.quality_at_size(self.goal.size_bytes * (1.0 - self._bytes_per_db * AIM)))
        else:
            quality = line.quality_at_error(self._allowed_quantisation(subset, coding))
        usual = _USUAL.codebook_share
        octaves = math.log2((coding.entries_per_splat or usual) / usual) if subset.refits else 0.0
        if self.goal.size_bytes is None:
            cost = line.log_bytes_at(quality)
        else:
            cost = self._exponent * math.log(self._unquantised_error(subset, coding) + line.error_at(quality))
        return _clipped(quality), cost + _OCTAVE_COST * octaves

    def _rate_line(self, subset: Subset, coding: Coding) -> RateLine:
        """Return quantisation error and bytes of a subset and coding by precision.

        The line passes through the candidate nearest to the goal, a draft only if there is no other. Slopes are
        measured on files of one kind if there are two, first on drafts.
        """
        gain, line = _PSNR_PER_PRECISION.get(coding.sh or "", 1.0), None
        slopes = (-gain * LOG_ERROR_PER_DB, gain * self._bytes_per_db)
        for draft in (True, False):
            made = self._by_distance(subset, coding, draft=draft)
            if made:
                line = RateLine.through([self._rate_point(candidate) for candidate in made], *slopes)
                slopes = line.error_slope, line.bytes_slope
        assert line is not None
        return line

    def _log_excess(self, candidate: Candidate) -> float:
        """Return the log of a candidate's size, or of its quantisation error, divided by the goal's."""
        if self.goal.size_bytes is not None:
            return math.log(candidate.size_bytes / self.goal.size_bytes)
        return math.log(
            self._rate_point(candidate).error / self._allowed_quantisation(candidate.subset, candidate.coding)
        )

    def _by_distance(self, subset: Subset, coding: Coding, *, draft: bool) -> list[Candidate]:
        """Return candidates: the nearest to the goal, then those on the other side of the goal, then those on its side.

        Each group ascends by distance; the list is empty without candidates.
        """
        made = [(self._log_excess(candidate), candidate) for candidate in self.pool.of(subset, coding, draft=draft)]
        made.sort(key=lambda entry: (abs(entry[0]), -(entry[1].quality or 0.0)))  # of equal distances, the finest first
        nearest, others = made[:1], made[1:]
        others.sort(key=lambda entry: (entry[0] > 0.0) == (nearest[0][0] > 0.0))  # stable: by distance on each side
        return [candidate for _, candidate in nearest + others]

    def _rate_point(self, candidate: Candidate) -> RatePoint:
        """Return precision, bytes and the expected quantisation error of a candidate, after the refit if a draft."""
        return RatePoint(candidate.quality or 0.0, self._quantisation_error(candidate), candidate.size_bytes)

    def _allowed_quantisation(self, subset: Subset, coding: Coding) -> float:
        """Return the mean squared error that quantisation may cause, above 0 even if pruning takes all of it."""
        allowed = self._allowed * error_of_psnr(AIM)
        return max(allowed - self._unquantised_error(subset, coding), LEAST_QUANTISED * allowed)

    @property
    def _allowed(self) -> float:
        """The mean squared error against renders of the source at which a file meets the goal.

        Against images, pruning and quantisation add another error than against renders. The measured file nearest to
        the goal shows the ratio, which is 1 until there is any.
        """
        allowed = self.goal.error - self.goal.source_error
        measured = [file for file in self.pool.made if file.image_error is not None]
        if not measured:
            return allowed
        nearest = min(measured, key=lambda file: abs(self._log_result(file)))
        return nearest.error * math.exp(-self._log_result(nearest))

    def _quantisation_error(self, candidate: Candidate) -> float:
        """Return the quantisation error of a candidate; for a draft, the error of its file after another refit."""
        error = max(
            candidate.error - self._unquantised_error(candidate.subset, candidate.coding),
            LEAST_QUANTISED * candidate.error,
            NOTHING,
        )
        return error * (error_of_psnr(_TUNING_GAIN) if candidate.is_draft else 1.0)

    def _unquantised_error(self, subset: Subset, coding: Coding, *, exact: bool = False) -> float:
        """Return the mean squared error before quantisation, of pruning and dropped SH bands; it is measured once.

        It is measured on all validation views if `exact`, and the first time, otherwise on a few of them.
        """
        degree = self._degree(coding)
        if not subset.refits and degree == self.whole.model.sh_degree:
            return 0.0
        key = subset, degree
        if key not in self._errors:
            self._errors[key] = self.pool.error(subset.lowered(degree), exact=exact or not self.pool.renders)
        return self._errors[key]

    def _degree(self, coding: Coding) -> int:
        """Return the SH degree of a coding's files."""
        chosen = [self.pool.encoding.sh_degree, coding.degree, 0 if coding.sh == "none" else None]
        return min([self.whole.model.sh_degree, *(degree for degree in chosen if degree is not None)])

    # Files on the goal

    def _measure_image_error(self, file: Candidate) -> None:
        """Set `image_error` of a file for a drop, unless it is set; do nothing for another goal."""
        if self.goal.images is not None and file.image_error is None:
            file.image_error = self.pool.image_error(self.goal.images, file)

    def _is_met(self, file: Candidate) -> bool:
        """Return True if a file meets the goal and may be written; for a drop, False before `image_error` is set.

        If its estimated error meets a PSNR, the error is measured.
        """
        errors = file.result.report.errors
        if any(errors[name][0] > most for name, most in self.goal.max_error.items() if name in errors):
            return False
        if self.goal.size_bytes is not None:
            return file.size_bytes <= self.goal.size_bytes
        if self.goal.images is not None:
            return file.image_error is not None and file.image_error <= self.goal.error
        if file.error <= self.goal.error:
            self.pool.measure(file)
        return file.error <= self.goal.error

    def _try_presets(self, coding: Coding) -> None:
        """Make the presets' own files if their precision is near the goal, so that a search is not worse than these."""
        quality, own = self._predict(self.whole, coding)[0], self.pool.encoding.preset
        for name, preset in PRESETS.items():
            is_allowed = name == own or "fast" not in (name, own)  # `fast` only as the caller's own, and then alone
            if is_allowed and abs(preset.quality[coding.sh == "none"] - quality) < 0.5 * _FAR:
                self._measure_image_error(
                    self.pool.make(self.whole, Coding(use_classes=False, preset=name), None, draft=False)
                )

    def best_so_far(self) -> Candidate | None:
        """Return the best file of those made so far that meet the goal, or `None` if none does."""
        is_size = self.goal.size_bytes is not None
        best_first = sorted(self._files, key=lambda file: file.error if is_size else file.size_bytes)
        return next((file for file in best_first if self._is_met(file)), None)

    def describe_best(self) -> str:
        """Describe the best file so far that meets the goal, for progress; empty if there is none."""
        met = [file for file in self._files if file.is_exact and self._is_met(file)]
        best = min(met, key=lambda file: file.size_bytes, default=None)
        return f"best so far {format_bytes(best.size_bytes)}, {best.validation_psnr:.1f} dB" if best else ""

    def interrupted_message(self) -> str:
        """Return the message if the search is interrupted before any file meets the goal: the nearest, and a remedy."""
        so_far = self._unreached_message() if self._files else f"no file{self._kind} was made"
        faster = "--effort 1 takes" if self.pruner is None else "--no-prune or --effort 1 takes"
        return f"interrupted: so far, {so_far}; {faster} less time, --preset small without a target takes seconds"

    def _chosen(self) -> Candidate:
        """Return the best file that meets the goal.

        Raises:
            InputError: no file meets the goal.
        """
        chosen = self.best_so_far()
        if chosen is None:
            raise InputError(self._unreached_message())
        self.pool.measure(chosen)
        return chosen

    @property
    def _files(self) -> list[Candidate]:
        """The files that can be compared with the goal, with levels of detail if these are requested."""
        files = self.pool.made if self.with_levels is None else [file for _, file in self.with_levels]
        return [file for file in files if self.goal.images is None or file.image_error is not None]

    @property
    def _kind(self) -> str:
        """The kind of the requested file, for messages: nothing, or levels of detail."""
        return "" if self.with_levels is None else " with levels of detail"

    def _unreached_message(self) -> str:
        """Return the error message if no file meets the goal, with PSNR and size of the nearest file."""
        goal = self.goal
        if goal.size_bytes is not None:
            kept = " with all splats" if self.pruner is None else ""
            nearest = min(self._files, key=lambda file: file.size_bytes)
            found = f"the smallest found has {nearest.size_bytes}, and {nearest.validation_psnr:.2f} dB"
            return f"no file{kept}{self._kind} has at most {goal.size_bytes} bytes; {found}"
        nearest = min(self._files, key=lambda file: file.error if file.image_error is None else file.image_error)
        error = nearest.error if nearest.image_error is None else nearest.image_error
        where = "" if goal.images is None else " on the validation images"
        found = f"the best found has {psnr_of_mse(error):.2f} dB, and {format_bytes(nearest.size_bytes)}"
        return f"no file{self._kind} reaches {psnr_of_mse(goal.error):.2f} dB{where}; {found}"


def _clipped(quality: float) -> float:
    """Clip a precision to the range of the search, dB."""
    return min(max(quality, _QUALITIES[0]), _QUALITIES[1])


def search_target(
    source: SplatModel,
    target: Target,
    views: ViewSet,
    encoding: EncodeOptions,
    *,
    importance: Weights | None,
    options: SimplifyOptions,
    levels: FittedLevelBuilder | None,
    context: Context,
) -> tuple[Candidate, SearchReport]:
    """Search for the file that meets a target, by rendering candidates.

    Args:
        source: the scene.
        target: the target, other than largest errors alone.
        views: training, validation and test views.
        encoding, importance, context: as for `csplat.encode_with_report`.
        options: options of pruning and refitting.
        levels: builds levels of detail, whose bytes count; `None`: the file has none.

    Returns:
        The file, and the report with 0 seconds.

    Raises:
        InputError: the target is out of reach, no splat is visible, or a drop of PSNR is requested without images.
        SearchInterrupted: the search was interrupted, and no file so far meets the target. If one does, the best is
            returned, and `interrupted` is set in the report.
    """
    views.require_fit()
    views = with_validation_views(views)
    plan = search_plan(options.pruner(source, views), target, encoding, has_levels=levels is not None)
    progress = PlannedProgress("search", plan, context.progress)
    context = replace(context, progress=progress)
    test_scorer = views.test_scorer(source, context=context)
    require_visible(views, test_scorer)
    if target.max_psnr_drop is not None and not views.images:
        raise InputError("a largest drop of PSNR requires images (--data), against which it is measured")
    inside = views.virtual and scene_frame(source).kind == "surrounding"
    pruner: Pruner | None = None
    sensitivity_views = 0
    pool = CandidatePool(encoding, views.validation_scorer(source, context=context), context.progress)
    images = None if target.max_psnr_drop is None else views.image_validation_scorer(context=context)
    goal, whole = Goal.of(target, source, images), WholeScene(source, importance, None, context)
    search = TargetSearch(goal, pool, whole, None, options.work, None if levels is None else [])
    progress.note = search.describe_best
    finest, interrupted = None, False
    try:
        finest = None if levels is not None else search.finest()
        if finest is None and not keeps_all(target, encoding):
            pruner = search.pruner = options.pruner(source, views, use_classes=not inside, context=context)
        if finest is not None:
            chosen = finest
        elif pruner is not None and target.keep is not None:
            chosen = pool.make(pruner.refit_in_rounds(target.count(len(source))), Coding(), None, draft=False)
            chosen = chosen if levels is None else pool.with_levels(chosen, levels)
        else:
            if pruner is None:
                measured, sensitivity_views = complete_importance(
                    source, views, encoding, importance, inside=inside, projects=not target.max_error, context=context
                )
                search.whole = replace(whole, measured=measured)
            chosen = search.best() if levels is None else search.best_with_levels(levels)
    except KeyboardInterrupt:
        if target.keep is not None:  # its only file is not complete
            raise
        best, interrupted = search.best_so_far(), True
        if best is None:
            raise SearchInterrupted(search.interrupted_message()) from None
        chosen = best
    progress(SCORES, 0.0)
    remarks = [_INSIDE_REMARK] if inside and chosen.splats < len(source) else []
    if finest is not None:
        remarks.append(_AMPLE_REMARK.format(format_bytes(finest.size_bytes)))
    report = make_report(
        target, chosen, pool, test_scorer, splats_before=len(source), views_of=views.name, remarks=remarks,
        encodes=len(pool.made), seconds=0.0,
        images=_image_psnr(source, chosen, views, context) if views.images else {},
        sensitivity_views=sensitivity_views,
        pruning_views=0 if pruner is None or chosen.subset is whole else pruner.view_count,
        elsewhere={} if interrupted else _psnr_elsewhere(source, chosen, views, context),
        reached={name: chosen.result.report.errors.get(name, (0.0, 0.0))[0] for name in target.max_error},
        interrupted=interrupted,
    )  # fmt: skip
    progress(SCORES, 1.0)
    return chosen, report


def check_target(source: SplatModel, target: Target, encoding: EncodeOptions) -> None:
    """Refuse targets that no search can meet.

    Raises:
        InputError: there are no splats, or the target contradicts an option.
    """
    if not len(source):
        raise InputError("a scene without splats cannot be encoded to a target")
    if encoding.attribute_psnr is not None and target.is_rendered and target.keep is None:
        raise InputError("attribute_psnr is chosen by the target: give only one of them")


def _psnr_elsewhere(source: SplatModel, chosen: Candidate, views: ViewSet, context: Context) -> dict[str, float]:
    """Return the PSNR on views that were not used in the search, dB to three decimals, by kind."""
    model, quiet = decode(chosen.result.data), replace(context, progress=null_progress)
    if views.name == VIRTUAL:
        groups = extra_test_cameras(source)
    else:
        groups = views_off_path(source, views.test, [*views.training, *views.validation] * (not views.virtual))
    return {
        kind: round(Scorer.of_source(source, cameras, views.background, context=quiet).psnr(model), 3)
        for kind, cameras in groups.items()
    }


def _image_psnr(source: SplatModel, chosen: Candidate, views: ViewSet, context: Context) -> dict[str, float]:
    """Return the PSNR of file and source against the test images, dB."""
    scorer = views.image_test_scorer(context=context)
    return {"file": scorer.psnr(decode(chosen.result.data)), "source": scorer.psnr(source)}
