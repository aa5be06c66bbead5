# SPDX-License-Identifier: Apache-2.0
"""Train a scene from a data set, and write a PLY, or a file tuned to the same images: `csplat train`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import csplat_trainer
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.disk_files import resolve_links
from csplat.encoder import EncodeOptions, Target
from csplat.errors import InputError, counted
from csplat_render.kernels import thread_count
from csplat_render.lpips import load_lpips
from csplat_tools.console import format_bytes, note, step_progress
from csplat_tools.file_streams import write_model
from csplat_tools.scene_files import MetadataOverrides
from csplat_tools.training.time_plan import TrainingSettings, expected_seconds
from csplat_tools.training.tuning_report import describe_step, show_views, write_training_page
from csplat_tools.training.tuning_run import RATE_WEIGHT, SPLAT_BYTES, paced, run_finetuning
from csplat_tools.views import DataOptions, find_view_set
from csplat_trainer.data import DataSet, load
from csplat_trainer.device_measurements import make_rasteriser
from csplat_trainer.fit_checkpoint import load_checkpoint
from csplat_trainer.losses import PerceptualLoss
from csplat_trainer.training_options import Outputs, TrainOptions, TrainResult, uses_torch
from csplat_trainer.training_report import plot_loss
from csplat_trainer.tuning import FinetuneOptions

_TUNING = 1 / 6  # steps of the tuning that follows a training, as a fraction of the training's steps
_KEEP = 0.8  # default fraction of the trained splats that a file keeps: some of them are hardly seen
_MOST_TRAINED = 3.0  # largest number of splats that a timed training for a size chooses, by those that the file keeps
_BRIEF_TUNING = 1 / 4  # the same of trainings so short that it is fewer than the usual steps of a tuning
_ANNOUNCED_FROM = 100  # steps; a few are timed before longer trainings
_MUCH_SMALLER = 0.9  # fraction of its largest size below which a file is explained
_BRIEF = 4_000  # training steps up to which the tuning uses full learning rates; later they gain nothing


def run_training(
    data: DataOptions,
    output: str,
    options: TrainOptions,
    files: Outputs,
    *,
    overrides: MetadataOverrides | None = None,
    plot: str | None = None,
    page: str | None = None,
    expected: float | None = None,
    context: Context = DEFAULT_CONTEXT,
    quiet: bool = False,
) -> dict[str, Any]:
    """Read a data set, train, and write the scene.

    Args:
        data: the data set; every eighth image is a test image if it does not specify any.
        output: the PLY to write, or `-`.
        options: options of the training.
        files: files that are written and read during training.
        overrides: overrides of the data set's metadata.
        plot: a PNG to write with the loss over the steps.
        page: an HTML report to write.
        expected: expected time of the whole run, seconds, if it has been announced; otherwise `None`.
        context: threads and progress.
        quiet: print nothing.

    Returns:
        The log: options, losses and scores, JSON-compatible.

    Raises:
        InputError: a package is missing, or the data set is invalid or does not fit the options.
        OSError: a file cannot be read or written.
    """
    data_set = _load(data, options, files)
    result = _train(data_set, options, files, plot=plot, expected=expected, context=context, quiet=quiet)
    model = (overrides or MetadataOverrides()).apply_to_model(result.model)
    write_model(output, model, absolute=False)
    if page is not None:
        views = find_view_set(model, data=data_set, validation_count=0, check_fit=False)
        shown = show_views(model, {"trained scene": model}, views, context)
        write_training_page(page, output, result.log, None, shown)
    if not quiet:
        record = result.model.metadata.training
        note(f"the metadata of {output} contain the options for comparing it with its images: {record}")
    return result.log


def run_training_to_file(
    data: DataOptions,
    output: str,
    options: TrainOptions,
    files: Outputs,
    encoding: EncodeOptions,
    tuning: FinetuneOptions,
    *,
    target: Target | None = None,
    overrides: MetadataOverrides | None = None,
    plot: str | None = None,
    page: str | None = None,
    expected: float | None = None,
    context: Context = DEFAULT_CONTEXT,
    quiet: bool = False,
) -> dict[str, Any]:
    """Read a data set, train, and tune a file to the same images; the trained scene itself is not written.

    Args:
        data, overrides, plot, page, expected, quiet: as for `run_training`.
        options: options of the training; `plan_training` derives them from the target.
        output: the `.csplat` file to write, or `-`.
        files: as for `run_training`. Checkpoints of the tuning are next to the training's
            (`tuning_checkpoint`); a run resumes from them if the training had ended.
        encoding: options of the encoder.
        tuning: options of the tuning.
        target: as for `run_finetuning`; but the training has already pruned to a fraction to keep.
        context: threads and progress; seed of the encoder and of pruning.

    Returns:
        `training`, the log of `run_training`, and `file`, the report of `run_finetuning`.

    Raises:
        InputError: as for both.
        OSError: a file cannot be read or written.
    """
    tuning_files = _tuning_outputs(files, options)
    data_set = _load(data, options, files)
    for image in data_set.val:  # training does not read these images: this finds damaged files before it
        _ = image.pixels, image.mask
    result = _train(data_set, options, files, plot=plot, expected=expected, context=context, quiet=quiet)
    model = (overrides or MetadataOverrides()).apply_to_model(result.model)
    views = find_view_set(
        model, data=data_set, validation_count=0, check_fit=False
    )  # the tuning splits the training views
    known = None
    if result.metrics is not None and options.eval_views == 0 and options.device == "cpu":
        known = {"source": {**result.metrics, "lpips": None}}
    report = run_finetuning(
        model, views, output, encoding, tuning, tuning_files,
        target=None if target is None or target.keep is not None else target, known=known, page=page,
        training=result.log, announced=expected is not None, context=context, quiet=quiet,
    )  # fmt: skip
    return {"training": result.log, "file": report}


def splats_for(target: Target | None, *, most: bool = False) -> int | None:
    """Return the number of splats to train for a size, a quarter more than are kept; `None` without a size.

    Args:
        target: the target of the file.
        most: return the largest number that is of use, for a training that has the time for it.
    """
    if target is None or target.size_bytes is None:
        return None
    return round(_kept_for(target.size_bytes) * (_MOST_TRAINED if most else 1.0 / _KEEP))


def _kept_for(size_bytes: int) -> int:
    """Return the number of splats that a file of a size keeps."""
    return max(1, size_bytes // SPLAT_BYTES)


def plan_training(
    options: TrainOptions, target: Target | None = None, *, max_splats: int | None = None
) -> TrainOptions:
    """Return the options of a training before a tuning: the number of splats, and the fraction to keep.

    Args:
        options: the other options.
        target: the target of the file. A fraction to keep refers to the trained splats. A size leaves one splat per
            `SPLAT_BYTES`. A PSNR leaves all, since the tuning prunes. `None`: 0.8 are kept.
        max_splats: number of splats to train; `None`: `splats_for` the target, otherwise the default.

    Raises:
        InputError: the target is of another kind.
    """
    if max_splats is None:
        max_splats = splats_for(target) or TrainOptions.max_splats
    share = _KEEP
    if target is not None:
        target.require("train", "psnr", "size", "keep")
        if target.size_bytes is not None:
            share = min(1.0, _kept_for(target.size_bytes) / max_splats)
        else:
            share = 1.0 if target.keep is None else target.keep
    return replace(options, max_splats=max_splats, final_share=share)


def stored_settings(
    checkpoint: str | Path,
    *,
    size: tuple[int, int] | None = None,
    max_splats: int | None = None,
    iterations: int | None = None,
) -> TrainingSettings:
    """Return the settings of the training that a checkpoint is of, or those that are given instead.

    Raises:
        InputError: the checkpoint is damaged.
    """
    stored = load_checkpoint(checkpoint)
    known, count, steps = (stored.own.get("size"), *map(stored.options.get, ("max_splats", "iterations")))
    if not isinstance(count, int) or not isinstance(steps, int):
        raise InputError(f"{checkpoint} lacks the options of its training, expected max_splats and iterations")
    if size is None and isinstance(known, list) and len(known) == 2 and all(isinstance(side, int) for side in known):
        size = known[0], known[1]
    return TrainingSettings(size, max_splats or count, iterations or steps)


def explain_size(result: Mapping[str, Any], target: Target | None) -> list[str]:
    """Return a line on what limits a file that is much smaller than its largest size; no line if it is not.

    Args:
        result: result of `run_training_to_file`.
        target: the target of the file.
    """
    training, file = result["training"], result["file"]
    if target is None or target.size_bytes is None or file["size_bytes"] >= _MUCH_SMALLER * target.size_bytes:
        return []
    count, most, steps = training["splats"], training["options"]["max_splats"], training["options"]["iterations"]
    text = f"{format_bytes(target.size_bytes)} do not bind: {format_bytes(file['size_bytes'])} hold"
    if count >= _kept_for(target.size_bytes):
        return [f"{text} the {file['splats']:,} splats; more need a larger --max-splats than {most:,}"]
    if count >= most:
        return [f"{text} the {count:,} splats that --max-splats allows, the size {_kept_for(target.size_bytes):,}"]
    return [f"{text} the {count:,} splats to which {counted(steps, 'step')} grew the scene; more --iterations add some"]


def tuning_after(training: TrainOptions, lambda_: float | None = None) -> FinetuneOptions:
    """Return the options of the tuning after a training: the longer the training, the more and smaller steps.

    A sixth of the training's steps, but at least the usual number, or a quarter of the training's if that is less.

    Args:
        training: options of the training.
        lambda_: lambda, loss per bit and splat; `None`: the default.

    Raises:
        InputError: lambda is out of range.
    """
    usual = FinetuneOptions(seed=training.seed, lambda_=RATE_WEIGHT[False] if lambda_ is None else lambda_)
    tuning = usual.scaled(min(1.0, _BRIEF / training.iterations))
    least = min(usual.iterations, max(1, round(_BRIEF_TUNING * training.iterations)))
    steps = max(least, round(_TUNING * training.iterations))
    warm_up = min(usual.warm_up, steps // 10)
    engine, device = training.engine, training.device
    return paced(
        replace(
            tuning, iterations=steps, warm_up=warm_up, lr_exposure=training.lr_exposure, device=device, engine=engine
        )
    )


def tuning_checkpoint(path: str | Path) -> Path:
    """Return the path of the tuning's checkpoint: run.tuning.npz for a training with run.npz."""
    return Path(f"{str(path).removesuffix('.npz')}.tuning.npz")


def _tuning_outputs(files: Outputs, options: TrainOptions) -> Outputs:
    """Return the checkpoints of the tuning.

    The tuning resumes from its own checkpoint if the training had ended, and the run writes the checkpoint that it
    resumes from. Otherwise the run makes another file from the same training.
    """
    checkpoint = None if files.checkpoint is None else tuning_checkpoint(files.checkpoint)
    outputs = Outputs(checkpoint, files.checkpoint_seconds)
    if files.resume is None or checkpoint is None or not checkpoint.exists():
        return outputs
    is_same = resolve_links(str(files.checkpoint)) == resolve_links(files.resume)
    has_ended = load_checkpoint(files.resume).iteration >= options.iterations
    return replace(outputs, resume=checkpoint) if is_same and has_ended else outputs


def _train(
    data_set: DataSet,
    options: TrainOptions,
    files: Outputs,
    *,
    plot: str | None,
    expected: float | None,
    context: Context,
    quiet: bool,
) -> TrainResult:
    """Read the images, train, plot the loss to the path `plot` if given, and print a summary unless `quiet`.

    Raises:
        InputError: an image is damaged, or an option cannot be used.
    """
    for line in () if quiet else data_set.report:
        note(line)
    context.progress("reading images", 0.0)
    data_set.read()  # to find damaged images before the first step
    context.progress("reading images", 1.0)
    done = 0 if files.resume is None else load_checkpoint(files.resume).iteration
    announced = expected is not None
    if not announced and not quiet and options.iterations - done >= _ANNOUNCED_FROM:
        expected = expected_seconds(data_set, options, done, context)
    with (
        thread_count(context.threads),
        step_progress("training", describe_step, expected=expected, announced=announced, quiet=quiet) as show,
    ):
        result = csplat_trainer.train(data_set, options, outputs=files, on_step=show)
    if plot is not None:
        plot_loss(plot, result.log["losses"], Path(data_set.name).name)
    if not quiet:
        note(_summarise_training(result.log, result.metrics))
    return result


def _load(data: DataOptions, options: TrainOptions, files: Outputs) -> DataSet:
    """Check the other inputs, and open the data set."""
    _check_inputs(options, files)
    every = 8 if data.test_every is None else data.test_every
    return load(
        data.path, data.size, images=data.images, test_every=every, near=data.near, trust_paths=data.trust_paths
    )


def _check_inputs(options: TrainOptions, files: Outputs) -> None:
    """Check small inputs before the data set is read, which takes long.

    Raises:
        InputError: weights, checkpoint, torch or GPU are missing or damaged.
    """
    if uses_torch(options.device, options.engine):
        make_rasteriser(options.device, antialiased=options.antialiased)
    if options.lpips_weight > 0.0:
        PerceptualLoss(load_lpips(files.lpips_weights))
    elif files.lpips_weights is not None:
        load_lpips(files.lpips_weights)
    if files.resume is not None:
        load_checkpoint(files.resume)


def _summarise_training(log: dict[str, Any], metrics: dict[str, Any] | None) -> str:
    """Return a line on a training: splats, steps, seconds, and scores on test images if there are any."""
    text = f"{counted(log['splats'], 'splat')} after {counted(len(log['losses']), 'step')}, {log['seconds']:.1f} s"
    if metrics is None:
        return text + "; no test images"
    text += f"; {counted(metrics['views'], 'test image')}: PSNR {metrics['psnr']:.2f} dB pooled,"
    text += f" {metrics['psnr_mean']:.2f} mean, SSIM {metrics['ssim']:.4f}"
    return text + (f", LPIPS {metrics['lpips']:.4f}" if metrics["lpips"] is not None else "")
