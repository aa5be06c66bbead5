"""From a data set on disk to a trained PLY: the work of `csplat train`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from csplat.errors import InputError
from csplat.training import TrainedOn
from csplat_tools.files.console import note, step_progress
from csplat_tools.files.extras import need_trainer
from csplat_tools.files.streams import write_model

if TYPE_CHECKING:
    from csplat_trainer.options import TrainOptions
    from csplat_trainer.report import Progress

__all__ = ["Files", "Reading", "run_training"]

_FRUGAL_SPINS = "1000"  # see _wait_frugally


@dataclass(frozen=True)
class Reading:
    """How the data set is read: see `csplat_trainer.data.load`."""

    size: tuple[int, int] | None
    images: str | None
    test_every: int
    near: float | None


@dataclass(frozen=True)
class Files:
    """What is written, and read beside the data set; `None`: not wanted."""

    output: str
    log: str | None
    plot: str | None
    previews: str | None
    preview_every: int
    checkpoint: str | None
    checkpoint_every: int
    resume: str | None
    lpips_weights: str | None


def run_training(
    source: str, options: TrainOptions, reading: Reading, files: Files, *, threads: int | None, quiet: bool
) -> None:
    """Read a data set, train, write the scene and what else is wanted.

    Raises:
        InputError: a package or the data set is missing, or does not suit the options.
        OSError: a file cannot be read or written.
    """
    _wait_frugally()
    need_trainer(plots=files.plot is not None)
    from csplat_render.jit import thread_count
    from csplat_render.warmup import warm_up
    from csplat_trainer.data import load
    from csplat_trainer.loop import train
    from csplat_trainer.outputs import Outputs
    from csplat_trainer.report import plot_loss, write_log

    _check_inputs(options, files)
    data = load(source, reading.size, images=reading.images, test_every=reading.test_every, near=reading.near)
    if not quiet:
        for line in data.report:
            note(line)
    data.read()  # a damaged picture is found before kernels are compiled
    outputs = Outputs(
        files.checkpoint,
        files.checkpoint_every,
        files.previews,
        files.preview_every,
        files.resume,
        files.lpips_weights,
    )
    with thread_count(threads):
        if options.device == "cpu":
            warm_up(None if quiet else note)
        with step_progress(
            "training", _state, iterations=options.iterations, log_every=options.log_every, quiet=quiet
        ) as show:
            result = train(data, options, show, outputs)
    write_model(files.output, result.model, absolute=False)
    if files.log is not None:
        write_log(files.log, result.log)
    if files.plot is not None:
        plot_loss(files.plot, result.log["losses"], Path(source).name)
    if not quiet:
        note(_summary(result.log, result.metrics))
        note(f"{files.output} says how to compare it with its photographs: {TrainedOn.of(result.model.metadata)}")


def _check_inputs(options: TrainOptions, files: Files) -> None:
    """Read what is small, or fail: before the data set is read and kernels are compiled, which takes its time.

    Raises:
        InputError: weights, checkpoint or torch are absent or damaged, or what early pictures go to is no folder.
    """
    from csplat_render.lpips import load_lpips
    from csplat_trainer.checkpoint import load_checkpoint
    from csplat_trainer.perceptual import PerceptualLoss

    if options.lpips_weight > 0.0:
        PerceptualLoss(load_lpips(files.lpips_weights))
    elif files.lpips_weights is not None:
        load_lpips(files.lpips_weights)
    if files.resume is not None:
        load_checkpoint(files.resume)
    if files.previews is not None and Path(files.previews).exists() and not Path(files.previews).is_dir():
        raise InputError(f"{files.previews} is not a folder")


def _wait_frugally() -> None:
    """Let the threads of GNU OpenMP sleep soon while they wait for each other.

    They spin for milliseconds otherwise, and where another program wants the same cores, a training
    step waits for a thread that waits for a core: measured, 57 instead of 470 ms. Read when the
    library is loaded, so set before; what the user has set stays.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", _FRUGAL_SPINS)


def _state(now: Progress) -> str:
    return (
        f"{now.iteration}/{now.iterations}: loss {now.loss:.4f}, PSNR {now.psnr:.2f} dB, {now.splat_count} splats,"
        f" SH {now.sh_degree}, {now.seconds:.0f} s, {now.seconds_left:.0f} s left"
    )


def _summary(log: dict[str, Any], metrics: dict[str, Any] | None) -> str:
    text = f"{log['splat_count']} splats after {len(log['losses'])} steps, {log['seconds']:.1f} s"
    if metrics is None:
        return text + "; no test pictures"
    text += f"; {metrics['views']} test pictures: PSNR {metrics['psnr']:.2f} dB pooled, {metrics['psnr_mean']:.2f} mean"
    text += f", SSIM {metrics['ssim']:.4f}"
    return text + (f", LPIPS {metrics['lpips']:.4f}" if metrics["lpips"] is not None else "")
