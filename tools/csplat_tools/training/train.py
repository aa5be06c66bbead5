"""From a data set on disk to a trained PLY, or to a file that was tuned by the same photographs: `csplat train`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import csplat_trainer
from csplat.encoder import EncodeOptions
from csplat.errors import InputError, counted
from csplat.training import TrainedOn
from csplat_render.jit import thread_count
from csplat_render.lpips import load_lpips
from csplat_tools.files.console import note, step_progress
from csplat_tools.files.extras import prepare_renderer
from csplat_tools.files.facts import SceneOverrides
from csplat_tools.files.streams import write_model
from csplat_tools.training.finetune import BYTE_COST, run_finetuning, usually_aside
from csplat_tools.training.page import show_views, write_page
from csplat_tools.views import DataOptions, find_view_set
from csplat_trainer.checkpoint import load_checkpoint
from csplat_trainer.data import DataSet, load
from csplat_trainer.options import TrainOptions
from csplat_trainer.outputs import Outputs, TrainResult
from csplat_trainer.perceptual import PerceptualLoss
from csplat_trainer.report import TrainingStep, plot_loss
from csplat_trainer.tuning import FinetuneOptions

__all__ = ["run_training", "run_training_to_file", "tuning_after", "tuning_checkpoint"]

_TUNING = 1 / 6  # of the steps of a training, those of the tuning that follows it,
_BRIEF = 4_000  # and steps of one whose scene gains by the whole learning rates: a longer one has found what they find


def run_training(
    data: DataOptions,
    output: str,
    options: TrainOptions,
    files: Outputs,
    *,
    facts: SceneOverrides | None = None,
    plot: str | None = None,
    page: str | None = None,
    threads: int | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Read a data set, train, write the scene.

    Args:
        data: the data set; where it says nothing every eighth picture is held out.
        output: the PLY to write, or `-`.
        options: of the training.
        files: that are written, and read, on the way.
        facts: what the scene is to say instead of what the set does.
        plot: a PNG of the loss over the steps.
        page: an HTML file to write, which shows what came of it.
        threads: how many; `None` for all.
        quiet: say nothing.

    Returns:
        Options, losses and figures, JSON-compatible.

    Raises:
        InputError: a package or the data set is missing, or does not suit the options.
        OSError: a file cannot be read or written.
    """
    result = _trained(data, options, files, plot=plot, threads=threads, quiet=quiet)
    model = (facts or SceneOverrides()).applied(result.model)
    write_model(output, model, absolute=False)
    if page is not None:
        views = find_view_set(model, data=data, aside=0)
        write_page(page, output, result.log, None, show_views(model, {"trained scene": model}, views, threads))
    if not quiet:
        note(f"{output} says how to compare it with its photographs: {TrainedOn.of(result.model.metadata)}")
    return result.log


def run_training_to_file(
    data: DataOptions,
    output: str,
    options: TrainOptions,
    files: Outputs,
    encoding: EncodeOptions,
    tuning: FinetuneOptions,
    *,
    size_bytes: int | None = None,
    psnr: float | None = None,
    facts: SceneOverrides | None = None,
    plot: str | None = None,
    page: str | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Read a data set, train, and tune a file by the same photographs; of the scene nothing else is written.

    Args:
        data, options, facts, plot, page, quiet: as for `run_training`.
        output: the `.csplat` file to write, or `-`.
        files: likewise; checkpoints of the tuning stand beside those of the training (`tuning_checkpoint`), and a run
            goes on from them where the training had ended.
        encoding: of the encoder; its threads hold for all.
        tuning: of the tuning.
        size_bytes: of the file, at most.
        psnr: as for `run_finetuning`.

    Returns:
        `training`, as `run_training` returns it, and `file`, as `run_finetuning` does.

    Raises:
        InputError: as both.
        OSError: a file cannot be read or written.
    """
    further = _tuning_outputs(files, options)
    for one in _loaded(data).val:  # a damaged one is found before training; nobody keeps them until then
        _ = one.pixels, one.mask
    result = _trained(data, options, files, plot=plot, threads=encoding.threads, quiet=quiet)
    model = (facts or SceneOverrides()).applied(result.model)
    views = find_view_set(model, data=data, aside=usually_aside(0, cameras=None, data=data))
    known = None
    if result.metrics is not None and options.eval_views == 0 and options.device == "cpu":
        known = {"source": {**result.metrics, "lpips": None}}
    report = run_finetuning(
        model, views, output, encoding, tuning, further, size_bytes=size_bytes, psnr=psnr, known=known, page=page,
        training=result.log, quiet=quiet,
    )  # fmt: skip
    return {"training": result.log, "file": report}


def tuning_after(training: TrainOptions, byte_cost: float | None = None) -> FinetuneOptions:
    """How a scene is tuned that was trained so: the longer it was, the longer and in the smaller steps.

    Args:
        training: as it was trained.
        byte_cost: of a bit per splat in the loss; `None`: the usual one.

    Raises:
        InputError: the cost is out of its range.
    """
    usual = FinetuneOptions(seed=training.seed, byte_cost=BYTE_COST[False] if byte_cost is None else byte_cost)
    tuning = usual.scaled(min(1.0, _BRIEF / training.iterations))
    steps = max(usual.iterations, round(_TUNING * training.iterations))
    return replace(tuning, iterations=steps, lr_exposure=training.lr_exposure)


def tuning_checkpoint(path: str | Path) -> Path:
    """Where the tuning keeps its checkpoint, by where the training does: run.npz, run.tuning.npz."""
    return Path(f"{str(path).removesuffix('.npz')}.tuning.npz")


def _tuning_outputs(files: Outputs, options: TrainOptions) -> Outputs:
    """Checkpoints of the tuning.

    It goes on from its own where the run goes on, and the training, whose scene it tunes, had ended. A run that leaves
    the checkpoint as it is makes another file of the training.
    """
    checkpoint = None if files.checkpoint is None else tuning_checkpoint(files.checkpoint)
    tuned = Outputs(checkpoint, files.checkpoint_every)
    if files.resume is None or checkpoint is None or not checkpoint.exists():
        return tuned
    same = Path(str(files.checkpoint)).resolve() == Path(files.resume).resolve()
    ended = load_checkpoint(files.resume).iteration >= options.iterations
    return replace(tuned, resume=checkpoint) if same and ended else tuned


def _trained(
    data: DataOptions, options: TrainOptions, files: Outputs, *, plot: str | None, threads: int | None, quiet: bool
) -> TrainResult:
    """Read, train, draw the loss, say what came of it."""
    _check_inputs(options, files)
    pictures = _loaded(data)
    for line in () if quiet else pictures.report:
        note(line)
    pictures.read()  # a damaged picture is found before kernels are compiled
    with thread_count(threads):
        if options.device == "cpu":
            prepare_renderer(quiet=quiet, gradients=True)
        with step_progress("training", _state, quiet=quiet) as show:
            result = csplat_trainer.train(pictures, options, outputs=files, on_step=show)
    if plot is not None:
        plot_loss(plot, result.log["losses"], Path(data.path).name)
    if not quiet:
        note(_summary(result.log, result.metrics))
    return result


def _loaded(data: DataOptions) -> DataSet:
    """The data set; where it says nothing every eighth picture is held out."""
    every = 8 if data.test_every is None else data.test_every
    return load(data.path, data.size, images=data.images, test_every=every, near=data.near)


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
