"""Encode a scene and tune the file to look like photographs or the scene, as `csplat finetune` does."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, TypeVar

import csplat_trainer
from csplat.decoder import decode
from csplat.encoder import PRESETS, EncodeOptions, EncodePlan, Origin, encode_tiles
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import Progress
from csplat_render.kernels import thread_count
from csplat_render.metrics import Distance
from csplat_tools.console import format_bytes, note, progress_bar, step_progress
from csplat_tools.file_streams import write_array, write_bytes
from csplat_tools.optimise.rate_distortion import BYTES_PER_DB
from csplat_tools.optional_packages import prepare_renderer
from csplat_tools.training.training_page import show_views, write_training_page
from csplat_tools.training.tuning_inputs import TuningSubset, choose_splats, training_views
from csplat_tools.training.tuning_report import make_tuning_report, score_models
from csplat_tools.views import ViewSet
from csplat_trainer.training_options import Outputs
from csplat_trainer.tuning import FinetuneOptions, StageTimer, TunedFile, TuningStep

#: Factor of the learning rates; True: the scene's own renders are the reference instead of photographs. Those can be
#: matched almost exactly: what long steps lose of that, short ones take long to regain.
LEARNING_FACTOR = {False: 1.0, True: 0.03}
#: Default of lambda, the rate weight: loss per bit and splat. It is smaller for the scene's own renders, whose loss is
#: smaller.
RATE_WEIGHT = {False: 1e-4, True: 2e-5}
#: Entries of the codebook of shapes, which clustering by sensitivities and tuning make good use of; `encode`, which has
#: neither, makes no such codebook by default.
SHAPE_ENTRIES = 4096
#: Bytes per splat of a tuned file, measured with all bands and the preset small: more splats of 8 bytes look worse.
SPLAT_BYTES = 10
#: Number of virtual training views without photographs, and their size: more and larger than for other commands.
VIEWS, VIEW_SIZE = 480, (320, 240)

_WITHIN = 1.02  # factor by which a draft may be too large: the rate weight saves that before renders get worse
_FINE_ENOUGH = 1.03  # factor by which a draft may be too small: finer steps are not worth the time
_TRIES = 3  # largest number of splat counts, each predicted from the last file; of steps; of tunings
_FIXED = 1.2  # power of a factor of bytes that gives the factor of splats: some bytes do not depend on splats
_FEWER = 1.08  # divisor of the number of splats if a tuned file is too large
_ENTRIES_DOUBLE = 6.0  # dB of all attributes at which twice the entries of an SH codebook pay
_BYTE_ENTRIES, _MOST_ENTRIES, _SPLATS_PER_ENTRY = (
    255,
    1 << 15,
    3,
)  # codebooks of more entries grow; up to this; least splats per entry
_FINEST = 70.0  # dB of an attribute at which renders are as good as the scene's

_PER_DOUBLING = 1.25  # dB that twice the bytes bring, about, if there is only one file
_SLOPE_RANGE = (0.3, 12.0)  # range of this slope if it is taken from two files, dB per doubling
_NEAR_ENOUGH = 0.1  # dB above the target that are near enough
_SIZE_TRIES, _FARTHEST = 5, 2.0  # files after the first; largest change of size from the nearest file, in doublings

_VALIDATION_EVERY = 8  # one in this many renders is held out for validation
_MOST_VALIDATION = 16  # largest number of them


def default_validation_count(count: int, *, cameras: str | None, data: object | None) -> int | None:
    """Return the default number of validation views, as `validation_count` for `find_view_set`.

    With photographs it is 0, as `training_views` takes some training views; of few virtual views it is few.

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
    size_bytes: int | None = None,
    psnr: float | None = None,
    keep: float | None = None,
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
        views: views that the file is to match.
        output: the file to write, or `-`.
        encoding: options of the encoder.
        options: options of the tuning.
        files: checkpoints.
        size_bytes: as for `choose_and_finetune`.
        psnr: a target instead of a size: PSNR on the validation views, pooled, dB. Of several files that are made, the
            smallest that reaches it is written, and there are no checkpoints.
        keep, prune_unseen, importance: as for `choose_splats`.
        source_index: a .npy file to write: for each splat of the file, its index in the scene.
        lpips: computes LPIPS; `None`: it is not computed.
        known: as for `score_models`.
        page: an HTML report to write.
        training: log of the training before, for the report.
        quiet: print only errors.

    Returns:
        The report, JSON-compatible; under `log` options, losses and the results of each validation.

    Raises:
        CsplatError: an option or a file is not usable.
        OSError: a file cannot be read or written.
    """
    threads = encoding.threads
    with thread_count(threads):
        prepare_renderer(quiet=quiet, gradients=True)
        with progress_bar(quiet=quiet) as progress, step_progress("tuning", _state, quiet=quiet) as show:
            make = partial(
                choose_and_finetune, source, views, encoding, options, prune_unseen=prune_unseen, importance=importance,
                progress=progress, on_step=show,
            )  # fmt: skip
            if psnr is None:
                tuned = make(size_bytes=size_bytes, files=files, keep=keep)
            else:
                tuned = _tune_to_psnr(psnr, make, quiet=quiet)
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
    *,
    size_bytes: int | None = None,
    files: Outputs | None = None,
    keep: float | None = None,
    prune_unseen: bool | None = None,
    importance: str | None = None,
    progress: Progress | None = None,
    on_step: Callable[[TuningStep], None] | None = None,
) -> TunedSubset:
    """Choose the splats of the file, and tune them.

    Args:
        source: the scene.
        views: views that the file is to match.
        encoding: options of the encoder.
        options: options of the tuning.
        size_bytes: largest size of the file: splats are kept as far as they fit in, and the tuning meets it.
        files: checkpoints.
        keep, prune_unseen, importance: as for `choose_splats`; with `size_bytes`, `keep` is an upper bound.
        progress, on_step: as for `csplat_trainer.finetune`.

    Raises:
        InputError: no file of the scene is small enough.
        CsplatError: as for `choose_splats` and `csplat_trainer.finetune`.
    """
    timer = StageTimer()

    def choose(share: float | None) -> TuningSubset:
        return choose_splats(
            source, views, keep=share, prune_unseen=prune_unseen, importance=importance, threads=encoding.threads,
            progress=progress,
        )  # fmt: skip

    with timer.stage("choosing"):
        tuning_views = training_views(source, views, encoding.threads)
        chosen = choose(keep)
        if size_bytes is not None:
            chosen, encoding = _fit_to_size(
                chosen, encoding, size_bytes, lambda count: choose(count / len(source)), progress
            )
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
        outputs = replace(outputs, resume=None)  # that checkpoint belongs to a tuning of more splats
        share = (size_bytes / len(made.data)) ** 2 / _FEWER
        with timer.stage("choosing"):
            chosen = choose(max(1, int(share * len(chosen.model))) / len(source))


def _tune_to_psnr(psnr: float, make: Callable[..., TunedSubset], *, quiet: bool) -> TunedSubset:
    """Make files until one reaches a PSNR; the seconds are those of all of them."""
    timer = StageTimer()

    def made(size_bytes: int | None) -> TunedSubset:
        found = make(size_bytes=size_bytes)
        for stage, seconds in found.seconds.items():
            timer.seconds[stage] = round(timer.seconds.get(stage, 0.0) + seconds, 3)
        if not quiet:
            note(f"{format_bytes(found.size_bytes)}: {found.psnr:.2f} dB on the validation views")
        return found

    return replace(smallest_reaching(psnr, made), seconds=timer.seconds)


def _fit_to_size(
    chosen: TuningSubset,
    encoding: EncodeOptions,
    size_bytes: int,
    choose: Callable[[int], TuningSubset],
    progress: Progress | None,
) -> tuple[TuningSubset, EncodeOptions]:
    """Return splats and options of a file that the tuning can bring to a size: fewer splats, or finer steps."""

    def size_factor(encoding: EncodeOptions) -> tuple[float, dict[str, Any]]:
        """Return the factor from the size of a draft to the size allowed, and the options that the encoder chose."""
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


def _state(now: TuningStep) -> str:
    return (
        f"{now.iteration}/{now.iterations}: loss {now.loss:.4f}, validation {now.validation_psnr:.2f} dB"
        f" (best {now.best_psnr:.2f}), {now.size_bytes / 1e6:.3f} MB,"
        f" {now.seconds:.0f} s, {now.seconds_left:.0f} s left"
    )


class SizedFile(Protocol):
    """A file that was made."""

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
    """Make files until one is near enough above a PSNR, and return the smallest that reaches it.

    Between two files, PSNR is taken to be linear in the logarithm of the size.

    Args:
        psnr: target PSNR, dB.
        make: makes a file of at most a number of bytes; called first with `None`, for any size.

    Raises:
        InputError: none of the files reaches the PSNR.
    """
    tried, least = [make(None)], 1.0
    for _ in range(_SIZE_TRIES):
        if psnr <= tried[-1].psnr <= psnr + _NEAR_ENOUGH:
            break
        size = _next_size(psnr + 0.5 * _NEAR_ENOUGH, tried)
        if size <= least:  # no file can be that small: halfway to the smallest file
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
        raise InputError(f"{psnr:g} dB are not reached: {best.size_bytes:,} bytes have {best.psnr:.2f} dB")
    return min(enough, key=lambda one: one.size_bytes)


def _next_size(psnr: float, tried: list[T]) -> float:
    """Return the size at which a PSNR is expected, from the two files nearest to it, on either side if possible."""
    near = sorted(tried, key=lambda one: abs(one.psnr - psnr))
    near[1:] = sorted(near[1:], key=lambda one: (one.psnr < psnr) == (near[0].psnr < psnr))
    octave = math.log2(near[0].size_bytes)
    slope = _PER_DOUBLING
    if len(near) > 1 and near[1].size_bytes != near[0].size_bytes:
        slope = (near[1].psnr - near[0].psnr) / (math.log2(near[1].size_bytes) - octave)
    by = (psnr - near[0].psnr) / min(max(slope, _SLOPE_RANGE[0]), _SLOPE_RANGE[1])
    return float(2.0 ** (octave + min(max(by, -_FARTHEST), _FARTHEST)))
