"""From a data set on disk to a trained PLY: the work of `csplat train`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import csplat_trainer
from csplat.errors import InputError, counted
from csplat.training import TrainedOn
from csplat_render.jit import thread_count
from csplat_render.lpips import load_lpips
from csplat_tools.files.console import note, step_progress
from csplat_tools.files.extras import prepare_renderer
from csplat_tools.files.facts import SceneOverrides
from csplat_tools.files.streams import write_model
from csplat_tools.views import DataOptions
from csplat_trainer.checkpoint import load_checkpoint
from csplat_trainer.data import load
from csplat_trainer.options import TrainOptions
from csplat_trainer.outputs import Outputs
from csplat_trainer.perceptual import PerceptualLoss
from csplat_trainer.report import TrainingStep, plot_loss

__all__ = ["run_training"]


def run_training(
    data: DataOptions,
    output: str,
    options: TrainOptions,
    files: Outputs,
    *,
    facts: SceneOverrides | None = None,
    plot: str | None = None,
    threads: int | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Read a data set, train, write the scene and what else is wanted.

    Args:
        data: the data set; where it says nothing every eighth picture is held out.
        output: the PLY to write, or `-`.
        options: of the training.
        files: that are written, and read, on the way.
        facts: what the scene is to say instead of what the set does.
        plot: a PNG of the loss over the steps.
        threads: how many; `None` for all.
        quiet: say nothing.

    Returns:
        Options, losses and figures, JSON-compatible.

    Raises:
        InputError: a package or the data set is missing, or does not suit the options.
        OSError: a file cannot be read or written.
    """
    _check_inputs(options, files)
    every = 8 if data.test_every is None else data.test_every
    pictures = load(data.path, data.size, images=data.images, test_every=every, near=data.near)
    for line in () if quiet else pictures.report:
        note(line)
    pictures.read()  # a damaged picture is found before kernels are compiled
    with thread_count(threads):
        if options.device == "cpu":
            prepare_renderer(quiet=quiet, gradients=True)
        with step_progress("training", _state, quiet=quiet) as show:
            result = csplat_trainer.train(pictures, options, outputs=files, on_step=show)
    write_model(output, (facts or SceneOverrides()).applied(result.model), absolute=False)
    if plot is not None:
        plot_loss(plot, result.log["losses"], Path(data.path).name)
    if not quiet:
        note(_summary(result.log, result.metrics))
        note(f"{output} says how to compare it with its photographs: {TrainedOn.of(result.model.metadata)}")
    return result.log


def _check_inputs(options: TrainOptions, files: Outputs) -> None:
    """Read what is small, or fail: before the data set is read and kernels are compiled, which takes its time.

    Raises:
        InputError: weights, checkpoint or torch are absent or damaged, or what early pictures go to is no folder.
    """
    if options.lpips_weight > 0.0:
        PerceptualLoss(load_lpips(files.lpips_weights))
    elif files.lpips_weights is not None:
        load_lpips(files.lpips_weights)
    if files.resume is not None:
        load_checkpoint(files.resume)
    if files.previews is not None and Path(files.previews).exists() and not Path(files.previews).is_dir():
        raise InputError(f"{files.previews} is not a folder")


def _state(now: TrainingStep) -> str:
    return (
        f"{now.iteration}/{now.iterations}: loss {now.loss:.4f}, PSNR {now.psnr:.2f} dB,"
        f" {counted(now.splat_count, 'splat')}, SH {now.sh_degree}, {now.seconds:.0f} s, {now.seconds_left:.0f} s left"
    )


def _summary(log: dict[str, Any], metrics: dict[str, Any] | None) -> str:
    text = f"{counted(log['splat_count'], 'splat')} after {counted(len(log['losses']), 'step')}, {log['seconds']:.1f} s"
    if metrics is None:
        return text + "; no test pictures"
    text += f"; {counted(metrics['views'], 'test picture')}: PSNR {metrics['psnr']:.2f} dB pooled,"
    text += f" {metrics['psnr_mean']:.2f} mean"
    text += f", SSIM {metrics['ssim']:.4f}"
    return text + (f", LPIPS {metrics['lpips']:.4f}" if metrics["lpips"] is not None else "")
