"""Encode a scene, and tune the file to images or to renders of the scene, as `csplat finetune` does."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

import csplat_trainer
from csplat.decoder import decode
from csplat.encoder import PRESETS, EncodeOptions, EncodePlan, Importance, Origin, Target, encode_tiles
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import I64, Progress
from csplat_render import Camera
from csplat_render.kernels import thread_count
from csplat_render.metrics import Distance
from csplat_render.pruning_error import measure_pruning_error
from csplat_tools.console import format_bytes, note, progress_bar, step_progress
from csplat_tools.file_streams import write_array, write_bytes
from csplat_tools.importance_file import read_importance
from csplat_tools.optimise.pruning import Pruner
from csplat_tools.optimise.rate_distortion import BYTES_PER_DB
from csplat_tools.optimise.scene_sensitivity import measure_views
from csplat_tools.optimise.simplify import SimplifyOptions
from csplat_tools.optional_packages import prepare_renderer
from csplat_tools.training.tuning_report import (
    describe_step,
    make_tuning_report,
    score_models,
    show_views,
    write_training_page,
)
from csplat_tools.views import VIEW_COUNT, ViewSet, with_validation_views
from csplat_trainer.fitter import FitStep
from csplat_trainer.sensitivity import Sensitivity
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

#: Factor of the learning rates, by whether the reference are the scene's own renders. Those can be matched almost
#: exactly, and large steps lose quality that small ones are slow to regain.
LEARNING_FACTOR = {False: 1.0, True: 0.03}
#: Default of lambda, loss per bit and splat, by whether the reference are the scene's own renders. Their loss is
#: smaller.
RATE_WEIGHT = {False: 1e-4, True: 2e-5}
#: Entries of the codebook of shapes. It pays with clustering by sensitivities and tuning; `encode` has neither, and
#: makes no such codebook by default.
SHAPE_ENTRIES = 4096
#: Bytes per splat of a tuned file, measured with all bands and preset small. More splats of 8 bytes look worse.
SPLAT_BYTES = 10
#: Number and size of virtual training views, used without images: more and larger than for other commands.
VIEWS, VIEW_SIZE = 480, (320, 240)

_WITHIN = 1.02  # factor by which a draft may be too large: the tuning saves this much without loss of quality
_FINE_ENOUGH = 1.03  # factor by which a draft may be too small: finer steps would gain little
_TRIES = 3  # splat counts to try, each predicted from the last file; also quantisation steps, and tunings
_FIXED = 1.2  # exponent from a factor of bytes to a factor of splats: some bytes do not depend on splats
_FEWER = 1.08  # divisor of the number of splats if a tuned file is too large
_ENTRIES_DOUBLE = 6.0  # dB of attribute PSNR at which twice the entries of an SH codebook pay
_BYTE_ENTRIES = 255  # SH codebooks of more entries grow with precision
_MOST_ENTRIES, _SPLATS_PER_ENTRY = 1 << 15, 3  # limits of their growth: entries; least splats per entry
_FINEST = 70.0  # dB of attribute PSNR at which renders equal the scene's

_PER_DOUBLING = 1.25  # assumed gain in dB per doubling of the size, with only one file
_SLOPE_RANGE = (0.3, 12.0)  # range of the same if measured on two files
_NEAR_ENOUGH = 0.1  # dB above the target at which the search ends
_SIZE_TRIES, _FARTHEST = 5, 2.0  # files after the first; largest change of size from the nearest file, in doublings

_VALIDATION_EVERY = 8  # every Nth virtual view is a validation view
_MOST_VALIDATION = 16  # validation views, at most


def default_validation_count(count: int, *, cameras: str | None, data: object | None) -> int | None:
    """Return the default `validation_count` of `find_view_set` for a tuning.

    With images it is 0, since `training_views` splits the training views.

    Args:
        count: number of virtual training views.
        cameras, data: as for `find_view_set`.
    """
    if data is not None:
        return 0
    return min(_MOST_VALIDATION, count // _VALIDATION_EVERY) if cameras is None else None


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
        target: as for `choose_and_finetune`; or a PSNR, for which several files are made without checkpoints, and the
            smallest that reaches it is written.
        prune_unseen, importance: as for `choose_and_finetune`.
        source_index: a .npy file to write: the index in the scene of each splat of the file.
        lpips: computes LPIPS; `None`: it is not computed.
        known: as for `score_models`.
        page: an HTML report to write.
        training: log of the preceding training, for the report.
        quiet: print only errors.

    Returns:
        The report, JSON-compatible; `log` has options, losses and the results of each validation.

    Raises:
        CsplatError: an option or a file is not usable.
        OSError: a file cannot be read or written.
    """
    encoding.kept_degree(source.sh_degree)
    threads = encoding.threads
    if target is not None:
        target.require("finetune", "psnr", "size_bytes", "keep")
    with thread_count(threads):
        prepare_renderer(quiet=quiet, gradients=True)
        with progress_bar(quiet=quiet) as progress, step_progress("tuning", describe_step, quiet=quiet) as show:
            make = partial(
                choose_and_finetune, source, views, encoding, options, prune_unseen=prune_unseen, importance=importance,
                progress=progress, on_step=show,
            )  # fmt: skip
            if target is None or target.psnr is None:
                tuned = make(target, files=files)
            else:
                tuned = _tune_to_psnr(target, make, quiet=quiet)
        made, timer = tuned.made, StageTimer(tuned.seconds)
        write_bytes(output, made.data)
        if source_index is not None:
            write_array(source_index, made.result.source_index)
        with timer.stage("judging"):
            models = {"source": source, "before tuning": decode(made.plain.data), "file": made.decoded}
            scores = score_models(source, models, views, lpips, threads, known=known)
        shown = [] if page is None else show_views(source, models, views, threads)
    report = make_tuning_report(source, made.plain, made.result, scores, made.log, timer.seconds, tuned.subset.pruning)
    report["log"] = made.log
    if page is not None:
        write_training_page(page, output, training, report, shown)
    return report


@dataclass(frozen=True, eq=False)
class TunedSubset:
    """A tuned file of some of a scene's splats.

    Attributes:
        subset: the splats.
        made: the file.
        seconds: time by stage.
    """

    subset: TuningSubset
    made: TunedFile
    seconds: dict[str, float]

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self.made.data)

    @property
    def psnr(self) -> float:
        """PSNR on the validation views, pooled, dB."""
        return float(self.made.log["best_psnr"])


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
    progress: Progress | None = None,
    on_step: Callable[[FitStep], None] | None = None,
) -> TunedSubset:
    """Choose the splats of the file, and tune them.

    Args:
        source: the scene.
        views: the views; the file is tuned to training views.
        encoding: options of the encoder.
        options: options of the tuning.
        target: largest size of the file: splats are pruned and lambda is raised until it fits. Or the fraction of the
            splats to keep. `None`: keep all.
        files: checkpoints.
        prune_unseen: prune splats that no training or validation view shows; `None`: only if the views have images.
        importance: a file with the importance of the source's splats; `None`: as for `SplatChooser`.
        progress, on_step: as for `csplat_trainer.finetune`.

    Raises:
        InputError: no file is small enough, no view shows any splat, or the file with the importance is invalid or
            belongs to another scene.
        CsplatError: as for `csplat_trainer.finetune`.
    """
    timer, size_bytes = StageTimer(), None if target is None else target.size_bytes
    simplify_options = SimplifyOptions(
        effort=Target.effort if target is None else target.effort, threads=encoding.threads
    )
    with timer.stage("choosing"):
        tuning_views = training_views(source, views, encoding.threads)
        chooser = SplatChooser(
            source, views, simplify_options, bool(views.images) if prune_unseen is None else prune_unseen,
            _read_importance(importance, source), progress,
        )  # fmt: skip
        chosen = chooser.choose(target.count(len(source)) if target is not None and target.keep is not None else None)
        if size_bytes is not None:
            chosen, encoding = _fit_to_size(chosen, encoding, size_bytes, chooser.choose, progress)
    outputs, tries = files or Outputs(), _TRIES
    while True:
        made = csplat_trainer.finetune(
            chosen.model, tuning_views, encoding, options, size_bytes=size_bytes, importance=chosen.importance,
            source=source, origin=Origin(len(source), chosen.rows), metadata=chosen.pruning, outputs=outputs,
            progress=progress, on_step=on_step,
        )  # fmt: skip
        if size_bytes is None or len(made.data) <= size_bytes:
            return TunedSubset(chosen, made, {**timer.seconds, **made.seconds})
        tries -= 1
        if not tries:
            raise InputError(f"the smallest file has {len(made.data):,} bytes, more than {size_bytes:,}")
        outputs = replace(outputs, resume=None)  # the checkpoint is of a tuning of more splats
        share = (size_bytes / len(made.data)) ** 2 / _FEWER
        with timer.stage("choosing"):
            chosen = chooser.choose(max(1, int(share * len(chosen.model))))


def _tune_to_psnr(target: Target, make: Callable[[Target | None], TunedSubset], *, quiet: bool) -> TunedSubset:
    """Make files until one reaches a PSNR, and return it with the seconds of all."""
    timer = StageTimer()

    def made(size_bytes: int | None) -> TunedSubset:
        found = make(None if size_bytes is None else Target(size_bytes=size_bytes, effort=target.effort))
        for stage, seconds in found.seconds.items():
            timer.seconds[stage] = round(timer.seconds.get(stage, 0.0) + seconds, 3)
        if not quiet:
            note(f"{format_bytes(found.size_bytes)}: {found.psnr:.2f} dB on the validation views")
        return found

    assert target.psnr is not None
    return replace(smallest_reaching(target.psnr, made), seconds=timer.seconds)


def _fit_to_size(
    chosen: TuningSubset,
    encoding: EncodeOptions,
    size_bytes: int,
    choose: Callable[[int], TuningSubset],
    progress: Progress | None,
) -> tuple[TuningSubset, EncodeOptions]:
    """Return the splats and options of a draft close to a size: fewer splats, or finer steps."""

    def size_factor(encoding: EncodeOptions) -> tuple[float, dict[str, Any]]:
        """Return the allowed size divided by that of a draft, and the options that the encoder chose."""
        plan = EncodePlan.of(
            chosen.model, encoding, importance=chosen.importance, allow_classes=False, progress=progress
        )
        made = encode_tiles(plan, progress=progress).write()
        return size_bytes / len(made.data), made.report.options

    for _ in range(_TRIES):
        share, settings = size_factor(encoding)
        if share >= 1.0 / _WITHIN or len(chosen.model) == 1:
            break
        chosen = choose(max(1, round(share**_FIXED * len(chosen.model))))
    else:
        share, settings = size_factor(encoding)
    if encoding.attribute_psnr is not None:
        return chosen, encoding
    usual, best_factor, finer, slope = encoding, share, 0.0, BYTES_PER_DB
    quality, entries = PRESETS[usual.preset].quality[0 if settings["sh_degree"] else 1], settings["codebook_size"]
    for _ in range(_TRIES):
        step = min(finer + math.log(share) / slope, _FINEST - quality) - finer
        if best_factor <= _FINE_ENOUGH or step == 0.0 or finer + step <= 0.0:
            break
        finer += step
        finer_options = replace(usual, attribute_psnr=quality + finer)
        if usual.codebook_size is None and entries > _BYTE_ENTRIES:
            more = min(
                round(entries * 2.0 ** (finer / _ENTRIES_DOUBLE)), _MOST_ENTRIES, len(chosen.model) // _SPLATS_PER_ENTRY
            )
            finer_options = replace(finer_options, codebook_size=max(entries, more))
        after, _ = size_factor(finer_options)
        slope = min(max(math.log(share / after) / step, 0.5 * BYTES_PER_DB), 4.0 * BYTES_PER_DB)
        share = after
        if 1.0 / _WITHIN <= share < best_factor:
            encoding, best_factor = finer_options, share
    return chosen, encoding


class SizedFile(Protocol):
    """A file with its size and quality."""

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        ...

    @property
    def psnr(self) -> float:
        """PSNR on the validation views, pooled, dB."""
        ...


T = TypeVar("T", bound=SizedFile)


def smallest_reaching(psnr: float, make: Callable[[int | None], T]) -> T:
    """Make files until one is just above a PSNR, and return the smallest that reaches it.

    Between two files, PSNR is assumed to be linear in the logarithm of the size.

    Args:
        psnr: target PSNR, dB.
        make: makes a file of at most this number of bytes; called first with `None`, for no limit.

    Raises:
        InputError: none of the files reaches the PSNR.
    """
    tried, least = [make(None)], 1.0
    for _ in range(_SIZE_TRIES):
        if psnr <= tried[-1].psnr <= psnr + _NEAR_ENOUGH:
            break
        size = _next_size(psnr + 0.5 * _NEAR_ENOUGH, tried)
        if size <= least:  # known to fail: halfway to the smallest file instead
            size = math.sqrt(least * min(one.size_bytes for one in tried))
        try:
            tried.append(make(max(1, round(size))))
        except InputError:
            least = size
            continue
        if tried[-1].size_bytes < 0.9 * size:  # a larger file is not possible
            break
    enough = [one for one in tried if one.psnr >= psnr]
    if not enough:
        best = max(tried, key=lambda one: one.psnr)
        raise InputError(f"{psnr:g} dB cannot be reached: {best.size_bytes:,} bytes have {best.psnr:.2f} dB")
    return min(enough, key=lambda one: one.size_bytes)


def _next_size(psnr: float, tried: list[T]) -> float:
    """Predict the size for a PSNR from the two files nearest to it, one on either side if possible."""
    near = sorted(tried, key=lambda one: abs(one.psnr - psnr))
    near[1:] = sorted(near[1:], key=lambda one: (one.psnr < psnr) == (near[0].psnr < psnr))
    octave = math.log2(near[0].size_bytes)
    slope = _PER_DOUBLING
    if len(near) > 1 and near[1].size_bytes != near[0].size_bytes:
        slope = (near[1].psnr - near[0].psnr) / (math.log2(near[1].size_bytes) - octave)
    by = (psnr - near[0].psnr) / min(max(slope, _SLOPE_RANGE[0]), _SLOPE_RANGE[1])
    return float(2.0 ** (octave + min(max(by, -_FARTHEST), _FARTHEST)))


@dataclass(frozen=True, eq=False)
class TuningSubset:
    """The splats to encode and tune.

    Attributes:
        model: the splats; refitted if others were pruned.
        rows: [N] int64, their indices in the source, ascending.
        importance: their importance.
        pruning: report on the pruned splats, JSON-compatible.
    """

    model: SplatModel
    rows: I64
    importance: NDArray[Any] | Importance
    pruning: Mapping[str, Any] = field(default_factory=dict)


def training_views(source: SplatModel, views: ViewSet, threads: int | None) -> TuningViews:
    """Return training and validation views with their images, or renders of the scene if there are none.

    Without validation views, some training views become validation views.
    """
    background = np.array(views.background, np.float32)

    def as_views(cameras: Sequence[Camera]) -> list[TuningView]:
        if views.images:
            return [TuningView(one.camera, one) for one in views.images_of(cameras)]
        return renders_of(source, cameras, background, threads)

    training = as_views(views.training)
    return (
        TuningViews(training, as_views(views.validation), background)
        if views.validation
        else split_views(training, background)
    )


@dataclass(eq=False)
class SplatChooser:
    """Chooses the splats to encode and tune, and measures their importance.

    Attributes:
        source: the scene.
        views: the views; importance is measured in training views.
        options: options of pruning and refitting.
        prune_unseen: prune splats that no training or validation view shows.
        importance: importance of the source's splats; `None`: measure it in the training views, as
            `csplat sensitivity` does.
        progress: progress callback.
    """

    source: SplatModel
    views: ViewSet
    options: SimplifyOptions
    prune_unseen: bool
    importance: NDArray[Any] | Importance | None = None
    progress: Progress | None = None
    _candidates: I64 | None = field(default=None, init=False)
    _pruner: Pruner | None = field(default=None, init=False)

    def choose(self, kept_count: int | None = None) -> TuningSubset:
        """Prune splats that no view shows, and those of low importance.

        Args:
            kept_count: largest number of splats to keep; `None`: all that are seen.

        Raises:
            InputError: no view shows any splat.
        """
        source, given = self.source, self.importance
        measured = self._measure(source) if given is None and kept_count is None else None
        rows = self._candidates if self._candidates is not None else self._seen(measured)
        self._candidates = rows
        model = source.select(rows)
        pruning = {"unseen": len(source) - len(rows)}
        if kept_count is not None:
            pruning["simplified_from"] = len(rows)
            if kept_count < len(rows):
                if self._pruner is None:  # it keeps views, renders and pruning order for the next number
                    views = with_validation_views(replace(self.views, training=self._measuring, test=()))
                    self._pruner = self.options.pruner(model, views, progress=self.progress)
                kept = self._pruner.refit(kept_count)
                model, rows = kept.model, rows[kept.rows]
        if given is not None:
            weights = given.select(rows) if isinstance(given, Importance) else given[rows]
        elif measured is not None:
            weights = StoredSensitivity.of(source, measured).importance().select(rows)
        else:
            weights = StoredSensitivity.of(model, self._measure(model)).importance()
        return TuningSubset(model, rows, weights, pruning)

    @property
    def _measuring(self) -> Sequence[Camera]:
        """The views in which importance is measured, and to whose renders kept splats are fitted."""
        return self.views.training[:VIEW_COUNT] if self.views.virtual else self.views.training

    def _measure(self, model: SplatModel) -> Sensitivity:
        return measure_views(
            model, self._measuring, self.views.background, matrices=True, magnitudes=False,
            threads=self.options.threads, progress=self.progress,
        )  # fmt: skip

    def _seen(self, measured: Sensitivity | None) -> I64:
        """Return the indices of the splats to choose from, ascending; `measured` is for the whole scene."""
        cameras = [*self.views.training, *self.views.validation]
        if measured is not None and not (self.prune_unseen and len(self._measuring) < len(cameras)):
            seen = measured.seen
        else:
            seen = measure_pruning_error(
                self.source, cameras, background=self.views.background, threads=self.options.threads,
                progress=self.progress,
            ).seen  # fmt: skip
        if not seen.any():
            raise InputError("no view shows any splat: check that the cameras belong to the scene")
        return np.flatnonzero(seen) if self.prune_unseen else np.arange(len(self.source))


def _read_importance(importance: str | None, source: SplatModel) -> NDArray[Any] | Importance | None:
    if importance is None:
        return None
    given = read_importance(importance, source)
    if isinstance(given, StoredSensitivity):
        return given.importance()
    if isinstance(given, np.ndarray) and given.shape != (len(source),):
        raise InputError(f"{importance} has shape {given.shape}, expected ({len(source)},)")
    return given
