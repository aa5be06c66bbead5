# SPDX-License-Identifier: Apache-2.0
"""Encode a scene, and tune the file to images or to renders of the scene, as `csplat finetune` does."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

import csplat_trainer
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import decode
from csplat.encoder import EncodeOptions, EncodePlan, Importance, Origin, ShCoding, Target, encode_tiles
from csplat.errors import InputError
from csplat.goal_search import next_value
from csplat.model import SplatModel
from csplat.types import F32, I64, null_progress
from csplat_render import Camera
from csplat_render.kernels import thread_count
from csplat_render.metrics import Distance, psnr_of_mse
from csplat_render.scorer import Scorer
from csplat_tools.console import step_progress
from csplat_tools.file_streams import write_array, write_bytes
from csplat_tools.importance_file import read_importance
from csplat_tools.optimise.candidates import Candidate, CandidatePool, WholeScene
from csplat_tools.optimise.pruning import PrunedSubset, Pruner
from csplat_tools.optimise.rate_distortion import error_of_psnr
from csplat_tools.optimise.simplify import SimplifyOptions
from csplat_tools.optimise.target_search import Goal, TargetSearch, check_target
from csplat_tools.training.tuning_report import (
    describe_step,
    make_tuning_report,
    score_models,
    show_views,
    write_training_page,
)
from csplat_tools.views import VIEW_COUNT, ViewSet, shrink_cameras, with_validation_views
from csplat_trainer.device_measurements import measure_importance, measure_pruning
from csplat_trainer.fitter import FitStep
from csplat_trainer.posed_images import PosedImage, image_scorer
from csplat_trainer.pruning import kept_in_round
from csplat_trainer.sensitivity_file import StoredSensitivity
from csplat_trainer.training_options import Outputs
from csplat_trainer.tuning import (
    FinetuneOptions,
    StageTimer,
    TunedFile,
    TuningView,
    TuningViews,
    renders_of,
    split_views,
)

#: Factor of the learning rates, by whether the references are the scene's own renders. Its own renders can be matched
#: almost exactly, and large steps lose quality that small steps are slow to regain.
LEARNING_FACTOR = {False: 1.0, True: 0.03}
#: Default of lambda, loss per bit and splat, by whether the references are the scene's own renders. Their loss is
#: smaller.
RATE_WEIGHT = {False: 1e-4, True: 2e-5}
#: Entries of the codebook of shapes. It pays with clustering by sensitivities and tuning; `encode` has neither, and
#: makes no such codebook by default.
SHAPE_ENTRIES = 4096
#: Bytes per splat of a tuned file, measured with all bands and preset small. More splats of 8 bytes look worse.
SPLAT_BYTES = 10
#: Number and size of virtual training views, used without images: more and larger than for other commands.
VIEWS, VIEW_SIZE = 480, (320, 240)

#: Factor of the steps of refits before a tuning to images, which continues them. Before a tuning to renders, whose
#: steps are small, plane3 would lose 0.45 dB in 150 kB.
_DRAFT_STEPS = 0.5
# Fractions of the error of a PSNR: by which tuned files aim below it (0.05 dB), and within which another draft would
# take at most 3 % fewer bytes.
_AIM, _TOLERANCE = 0.0115, 0.1
_WORTH = 0.03  # fraction of a size that another tuning leaves free
_FINER = 0.1  # least factor of the error of the goal from one tuning to the next
_TUNINGS = 4  # largest number of tunings for a target
_PRECISIONS = (30.0, 78.0)  # dB: range of the precision searched for a size
_LOG_BYTES_PER_DB, _PRECISE = 0.045, 0.015  # log bytes: slope by the precision, and accuracy of that search
_SAMPLE = 1 << 15  # splats of the sample in which that precision is searched
_SH_CODINGS: tuple[ShCoding, ...] = ("codebook", "scalar")
_VALIDATIONS = 8  # validations of a tuning on a GPU

_VALIDATION_EVERY = 8  # every Nth virtual view is a validation view
_MOST_VALIDATION = 16  # validation views, at most


def default_validation_count(count: int, *, cameras: str | None, data: object | None) -> int | None:
    """Return the default `validation_count` of `find_view_set` for a tuning.

    With images it is 0, since `Tuner.tuning_views` splits the training views.

    Args:
        count: number of virtual training views.
        cameras, data: as for `find_view_set`.
    """
    if data is not None:
        return 0
    return min(_MOST_VALIDATION, count // _VALIDATION_EVERY) if cameras is None else None


def paced(options: FinetuneOptions) -> FinetuneOptions:
    """Return the options with fewer validations on a GPU: their files, which the CPU writes, take longer than steps."""
    if options.device == "cpu":
        return options
    return replace(options, validate_every=max(options.validate_every, options.iterations // _VALIDATIONS))


def run_finetuning(
    source: SplatModel,
    views: ViewSet,
    output: str,
    encoding: EncodeOptions,
    options: FinetuneOptions,
    files: Outputs,
    *,
    target: Target | None = None,
    prune_unseen: bool | None = None,
    importance: str | None = None,
    source_index: str | None = None,
    lpips: Distance | None = None,
    known: Mapping[str, Mapping[str, float | None]] | None = None,
    page: str | None = None,
    training: Mapping[str, Any] | None = None,
    announced: bool = False,
    context: Context = DEFAULT_CONTEXT,
    quiet: bool = False,
) -> dict[str, Any]:
    """Prune, fix the quantisation, tune, write the file, and score it.

    Args:
        source: the scene.
        views: the views; the file is tuned to training views and scored on test views.
        output: the file to write, or `-`.
        encoding: options of the encoder.
        options: options of the tuning.
        files: checkpoints.
        target, prune_unseen, importance: as for `choose_and_finetune`.
        source_index: a .npy file to write: the index in the scene of each splat of the file.
        lpips: computes LPIPS; `None`: it is not computed.
        known: as for `score_models`.
        page: an HTML report to write.
        training: log of the preceding training, for the report.
        announced: as for `step_progress`.
        context: threads and progress; seed of the encoder and of pruning.
        quiet: print only errors.

    Returns:
        The report, JSON-compatible; `log` has options, losses and the results of each validation.

    Raises:
        CsplatError: an option or a file is not usable.
        OSError: a file cannot be read or written.
    """
    with thread_count(context.threads):
        with step_progress("tuning", describe_step, announced=announced, quiet=quiet) as show:
            tuned = choose_and_finetune(
                source, views, encoding, options, target, files=files, prune_unseen=prune_unseen, importance=importance,
                context=context, on_step=show,
            )  # fmt: skip
        made, timer = tuned.made, StageTimer(dict(tuned.seconds))
        write_bytes(output, made.data)
        if source_index is not None:
            write_array(source_index, made.result.source_index)
        with timer.stage("judging"):
            models = {"source": source, "before_tuning": decode(made.plain.data), "file": made.decoded}
            scores = score_models(source, models, views, lpips, context, known=known)
        shown = [] if page is None else show_views(source, models, views, context)
    report = make_tuning_report(source, made.plain, made.result, scores, made.log, timer.seconds, tuned.pruning)
    report["log"] = made.log
    if page is not None:
        write_training_page(page, output, training, report, shown)
    return report


@dataclass(frozen=True, eq=False)
class TunedSubset:
    """A tuned file of some of a scene's splats.

    Attributes:
        made: the file.
        pruning: report on the pruned splats, JSON-compatible.
        seconds: time by stage, of all files that were tuned.
    """

    made: TunedFile
    pruning: Mapping[str, Any]
    seconds: Mapping[str, float]

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self.made.data)

    @property
    def psnr(self) -> float:
        """PSNR on the validation views, pooled, dB."""
        return float(self.made.log["best_psnr"])

    @property
    def final_bytes(self) -> int:
        """Size to which the tuning led: of its last values, if the file has values of its first half.

        The tuning has outgrown its size then, and only values of its first steps fit.
        """
        log = self.made.log
        is_early = 2 * log["best_iteration"] < log["steps"]
        return max(self.size_bytes, log["validations"][-1]["size_bytes"] if is_early else 0)


@dataclass(eq=False)
class Tuner:
    """Tunes files of a scene to the same views.

    Attributes:
        source: the scene.
        views: the views; files are tuned to training views.
        encoding, options: options of the encoder and of the tuning.
        outputs: checkpoints; the first file resumes from them.
        prune_unseen: splats that no training or validation view shows are pruned.
        effort: amount of work of pruning and refitting, 1 to 5.
        importance: importance of the source's splats; `None`: the importance of each file's splats is measured in the
            training views, as `csplat sensitivity` does.
        context, on_step: as for `csplat_trainer.finetune`.
    """

    source: SplatModel
    views: ViewSet
    encoding: EncodeOptions
    options: FinetuneOptions
    outputs: Outputs
    prune_unseen: bool
    effort: int
    importance: NDArray[Any] | Importance | None = None
    context: Context = DEFAULT_CONTEXT
    on_step: Callable[[FitStep], None] | None = None
    _timer: StageTimer = field(default_factory=StageTimer, init=False)

    @cached_property
    def tuning_views(self) -> TuningViews:
        """Training and validation views with their images, or renders of the scene if there are none.

        Without validation views, some training views become validation views.
        """
        views, background = self.views, np.array(self.views.background, np.float32)

        def as_views(cameras: Sequence[Camera]) -> list[TuningView]:
            if views.images:
                return [TuningView(image.camera, image) for image in views.images_of(cameras)]
            return renders_of(self.source, cameras, background, context=self.context)

        training = as_views(views.training)
        if views.validation:
            return TuningViews(training, as_views(views.validation), background)
        return split_views(training, background)

    @cached_property
    def rows(self) -> I64:
        """[M] int64, the indices of the splats to choose from, ascending.

        Raises:
            InputError: no view shows any splat.
        """
        if not self.prune_unseen:
            return np.arange(len(self.source))
        errors = measure_pruning(
            self.source, [*self.views.training, *self.views.validation], self._background, self.options.device,
            context=self.context,
        )  # fmt: skip
        if not errors.seen.any():
            raise InputError("no view shows any splat: check that the cameras belong to the scene")
        return np.flatnonzero(errors.seen)

    def _pruner(self, options: SimplifyOptions) -> Pruner:
        """Return a pruner of the splats to choose from. Without validation views, some training views serve as such."""
        views = with_validation_views(replace(self.views, training=self._measuring_views, test=()))
        return options.pruner(self.source.select(self.rows), views, use_classes=False, context=self.context)

    @property
    def _pruning_options(self) -> SimplifyOptions:
        """The options of pruning for the effort."""
        return SimplifyOptions(effort=self.effort)

    @property
    def _measuring_views(self) -> Sequence[Camera]:
        """The views in which importance is measured, and to whose renders kept splats are fitted."""
        return self.views.training[:VIEW_COUNT] if self.views.virtual else self.views.training

    def tune_kept(self, kept_count: int | None) -> TunedSubset:
        """Tune a file of this number of splats at most; `None`: all splats that are not pruned as unseen."""
        with self._timer.stage("choosing"):
            rows = self.rows
            if kept_count is not None and kept_count < len(rows):
                kept = self._pruner(self._pruning_options).refit_in_rounds(kept_count)
                model, rows = kept.model, rows[kept.rows]
            else:
                model = self.source.select(rows)
        return self._tune(model, rows, self.encoding, None, is_pruned=kept_count is not None)

    def _tune(
        self,
        model: SplatModel,
        rows: I64,
        encoding: EncodeOptions,
        size_bytes: int | None,
        *,
        is_pruned: bool = True,
        weights: NDArray[Any] | Importance | None = None,
    ) -> TunedSubset:
        """Tune a file, and add the times of its stages to the timer. Only the first file resumes from a checkpoint.

        Args:
            model: its splats.
            rows: [N] int64, their indices in the source, ascending.
            encoding: options of the encoder.
            size_bytes: largest size, to which the tuning adjusts lambda; `None`: no limit.
            is_pruned: splats may have been pruned that a view shows.
            weights: importance of the splats, if it is known.
        """
        with self._timer.stage("choosing"):
            views = self.tuning_views
            weights = self._importance_of(model, rows) if weights is None else weights
        pruning = {"unseen": len(self.source) - len(self.rows)}
        if is_pruned:
            pruning["simplified_from"] = len(self.rows)
        made = csplat_trainer.finetune(
            model, views, encoding, self.options, size_bytes=size_bytes, importance=weights, source=self.source,
            origin=Origin(len(self.source), rows), metadata=pruning, outputs=self.outputs, context=self.context,
            on_step=self.on_step,
        )  # fmt: skip
        self.outputs = replace(self.outputs, resume=None)  # the checkpoint was of this file
        for stage, seconds in made.seconds.items():
            self._timer.add(stage, seconds)
        return TunedSubset(made, pruning, self._timer.seconds)

    def _importance_of(self, model: SplatModel, rows: I64) -> NDArray[Any] | Importance:
        """Return the importance of some splats; `rows`, [N] int64, are their indices in the source."""
        known = self.importance
        if known is not None:
            return known.select(rows) if isinstance(known, Importance) else known[rows]
        return measure_importance(
            model, self._measuring_views, self._background, self.options.device, context=self.context
        )

    @property
    def _background(self) -> F32:
        """[3], the background colour of the views."""
        return np.array(self.views.background, np.float32)

    def _precise(self, model: SplatModel, weights: NDArray[Any] | Importance, size_bytes: int) -> EncodeOptions:
        """Return the options with the precision at which the untuned file has about a size, and a coding of SH.

        Options that have a precision are returned unchanged. The search uses a sample, whose splats take more bytes
        for centres, and fewer for indices of its smaller codebooks. How much all splats take is learnt without
        importance and shapes, which cost most of the time: of 130,000 splats of Lego, 0.94 of the sample's bytes per
        splat instead of 0.92.

        Args:
            model: the splats of the file.
            weights: their importance.
            size_bytes: the size. If even the least precision needs more, that is returned.
        """
        if self.encoding.attribute_psnr is not None:
            return self.encoding
        count = min(len(model), _SAMPLE)
        rows = np.sort(np.random.default_rng(self.context.seed).choice(len(model), count, replace=False))
        sample = model.select(rows)
        sample_weights = weights.select(rows) if isinstance(weights, Importance) else weights[rows]
        silent = replace(self.context, progress=null_progress)

        def encoded_bytes(
            splats: SplatModel, splat_weights: NDArray[Any] | Importance | None, options: EncodeOptions
        ) -> int:
            """Return the size of an untuned file of these splats."""
            plan = EncodePlan.of(splats, options, importance=splat_weights, allow_classes=False, context=silent)
            return len(encode_tiles(plan).write().data)

        def search_quality(most: float) -> float:
            """Return the precision of the sample's largest file of at most `most` bytes, dB; extends `measured`."""
            while True:
                quality = next_value(
                    math.log(most), measured, _LOG_BYTES_PER_DB, bounds=_PRECISIONS, margin=0.5 * _PRECISE,
                    tolerance=_PRECISE, least_step=0.5 * _PRECISE / _LOG_BYTES_PER_DB,
                )  # fmt: skip
                if quality is None:
                    break
                size = encoded_bytes(sample, sample_weights, replace(options, attribute_psnr=quality))
                measured.append((quality, math.log(size)))
            return max((quality for quality, size in measured if size <= math.log(most)), default=_PRECISIONS[0])

        middle = replace(self.encoding, attribute_psnr=sum(_PRECISIONS) / 2.0)
        is_open = model.sh_degree and self.encoding.sh_coding == "auto"  # its choice differs between precisions
        codings = [replace(middle, sh_coding=coding) for coding in _SH_CODINGS] if is_open else [middle]
        sizes = [encoded_bytes(sample, sample_weights, coding) for coding in codings]
        options, size = min(zip(codings, sizes, strict=True), key=operator.itemgetter(1))
        measured = [(sum(_PRECISIONS) / 2.0, math.log(size))]  # precision and log bytes of files of the sample
        quality = search_quality(size_bytes * count / len(model))
        if count < len(model):
            plain = replace(options, attribute_psnr=quality, shape_codebook_size=0)
            # The size of the sample's file when the file of all splats has `size_bytes`.
            quality = search_quality(
                size_bytes * encoded_bytes(sample, None, plain) / encoded_bytes(model, None, plain)
            )
        return replace(options, attribute_psnr=quality)

    def tune_to_size(self, size_bytes: int) -> TunedSubset:
        """Tune a file of a size without drafts: for trainings, which prune themselves, and on a GPU.

        One splat is kept for `SPLAT_BYTES`, and the untuned file gets the precision that leads to the size.

        Raises:
            InputError: the file is larger, at the largest lambda.
        """
        kept_count = min(max(1, size_bytes // SPLAT_BYTES), len(self.rows))
        with self._timer.stage("choosing"):
            rows = self.rows
            while len(rows) > kept_count:
                model = self.source.select(rows)
                errors = measure_pruning(
                    model, self._measuring_views, self._background, self.options.device, context=self.context
                )
                rows = rows[kept_in_round(model.opacities, errors, kept_count)]
            model = self.source.select(rows)
            weights = self._importance_of(model, rows)
        goal = math.log(size_bytes)
        made = list[tuple[float, TunedSubset]]()  # with the log of the untuned size
        while True:
            untuned = next_value(
                goal, [(value, math.log(subset.final_bytes)) for value, subset in made], lambda value: value - _WORTH,
                bounds=(0.0, goal), margin=_WORTH, tolerance=math.inf, tries=_TUNINGS,
            )  # fmt: skip
            if untuned is None:
                break
            with self._timer.stage("choosing"):
                encoding = self._precise(model, weights, round(math.exp(untuned)))
            made.append((untuned, self._tune(model, rows, encoding, size_bytes, weights=weights)))
        return max(_files_within([subset for _, subset in made], size_bytes), key=lambda subset: subset.psnr)

    def tune_to(self, target: Target) -> TunedSubset:
        """Tune the best file of a size, or the smallest file of a PSNR on the validation views.

        The search of `csplat encode` chooses splats, coding and precision by drafts, which are compared with renders of
        the source. The best draft is tuned without becoming larger. The difference between the errors of the tuned file
        and of the draft corrects the goal of another search.

        Raises:
            InputError: no file meets the target.
        """
        with self._timer.stage("choosing"):
            options = self._pruning_options
            pruner = self._pruner(options)
            if self.views.images:
                pruner.steps_factor *= _DRAFT_STEPS
            cameras = shrink_cameras(pruner.views.validation, pruner.size)  # not the views of refits
            quiet = replace(self.context, progress=null_progress)
            scorer = Scorer.of_source(pruner.source, cameras, self.views.background, context=quiet)
            pool = CandidatePool(self.encoding, scorer, self.context.progress)
            whole = WholeScene(pruner.source, None, None, quiet)
            missed = 0.0 if target.psnr is None else self._image_error(pruner.source)
        # Values are sizes or errors of drafts; results are sizes or errors of the tuned files.
        is_size = target.size_bytes is not None
        goal = value = float(target.size_bytes or error_of_psnr(target.psnr or 0.0))
        made, drafts = list[TunedSubset](), list[Candidate]()
        measured = list[tuple[float, float]]()
        while True:
            if is_size:
                margin, tolerance = _WORTH if made else 0.0, 1.0  # any file of at most the size ends the search
            else:
                margin, tolerance = _AIM, _TOLERANCE
            proposed = next_value(
                goal, measured, lambda value: value + missed, bounds=(_FINER * value, goal if is_size else 1.0),
                margin=margin * goal, tolerance=tolerance * goal, tries=_TUNINGS,
            )  # fmt: skip
            if proposed is None:
                break
            value = proposed
            draft_goal = Goal(round(value)) if is_size else Goal(error=value)
            with self._timer.stage("choosing"):
                draft, expected = TargetSearch(draft_goal, pool, whole, pruner, options.work).best_draft()
            if draft in drafts:
                break
            drafts.append(draft)
            subset = draft.subset
            assert isinstance(subset, PrunedSubset)
            most = target.size_bytes or draft.size_bytes
            made.append(self._tune(subset.model, self.rows[subset.rows], draft.options, most))
            result = made[-1].size_bytes if is_size else error_of_psnr(made[-1].psnr)
            measured.append((value if is_size else expected, result))
        if target.psnr is None:
            return _files_within(made, target.size_bytes or 0)[0]
        reached = [subset for subset in made if subset.psnr >= target.psnr]
        if reached:
            return min(reached, key=lambda subset: subset.size_bytes)
        best = max(made, key=lambda subset: subset.psnr)
        text = f"{target.psnr:g} dB cannot be reached: {best.size_bytes:,} bytes have {best.psnr:.2f} dB"
        if missed > 0.0:
            text += f", the scene itself {psnr_of_mse(missed):.2f} dB: train it in more steps, or with more splats"
        raise InputError(text)

    def _image_error(self, model: SplatModel) -> float:
        """Return the mean squared error of a scene against the validation images; 0 without images."""
        images = [view.reference for view in self.tuning_views.validation if isinstance(view.reference, PosedImage)]
        if not images:
            return 0.0
        scorer = image_scorer(images, self.tuning_views.background, context=self.context)
        return scorer.pooled(scorer.errors(model))


def _files_within(made: Sequence[TunedSubset], size_bytes: int) -> list[TunedSubset]:
    """Return the files of at most a size, at least one, in the given order.

    Raises:
        InputError: all files are larger.
    """
    fitting = [subset for subset in made if subset.size_bytes <= size_bytes]
    if not fitting:
        smallest = min(subset.size_bytes for subset in made)
        raise InputError(f"the smallest file has {smallest:,} bytes, more than {size_bytes:,}")
    return fitting


def choose_and_finetune(
    source: SplatModel,
    views: ViewSet,
    encoding: EncodeOptions,
    options: FinetuneOptions,
    target: Target | None = None,
    *,
    files: Outputs | None = None,
    prune_unseen: bool | None = None,
    importance: str | None = None,
    context: Context = DEFAULT_CONTEXT,
    on_step: Callable[[FitStep], None] | None = None,
) -> TunedSubset:
    """Choose the splats of the file, and tune them.

    Args:
        source: the scene.
        views: the views; the file is tuned to training views.
        encoding: options of the encoder.
        options: options of the tuning.
        target: a size, a PSNR on the validation views, or the fraction of the splats to keep. `None`: keep all.
        files: checkpoints; not used for a PSNR, for which several files may be tuned.
        prune_unseen: prune splats that no training or validation view shows; `None`: only if the views have images.
        importance: a file with the importance of the source's splats; `None`: as for `Tuner`.
        context, on_step: as for `csplat_trainer.finetune`.

    Raises:
        InputError: no file meets the target, no view shows any splat, an option is set that the target determines, or
            the file with the importance is invalid or belongs to another scene.
        CsplatError: as for `csplat_trainer.finetune`.
    """
    if target is not None:
        target.require("finetune", "psnr", "size", "keep")
        check_target(source, target, encoding)
    views.require_fit()
    tuner = Tuner(
        source, views, encoding, options,
        Outputs() if files is None or (target is not None and target.psnr is not None) else files,
        bool(views.images) if prune_unseen is None else prune_unseen,
        Target.effort if target is None else target.effort, _read_importance(importance, source), context, on_step,
    )  # fmt: skip
    if target is None:
        return tuner.tune_kept(None)
    most = 0 if target.size_bytes is None else target.size_bytes // SPLAT_BYTES
    if target.size_bytes is not None and (options.device != "cpu" or len(source) <= most):
        return tuner.tune_to_size(target.size_bytes)
    return tuner.tune_kept(target.count(len(source))) if target.keep is not None else tuner.tune_to(target)


def _read_importance(importance: str | None, source: SplatModel) -> NDArray[Any] | Importance | None:
    """Return the importance in a file, [N] if it is an array, of the source's N splats; `None` without a file.

    Raises:
        InputError: the file is invalid, or belongs to another scene.
    """
    if importance is None:
        return None
    content = read_importance(importance, source)
    if isinstance(content, StoredSensitivity):
        return content.importance()
    if isinstance(content, np.ndarray) and content.shape != (len(source),):
        raise InputError(f"{importance} has shape {content.shape}, expected ({len(source)},)")
    return content
