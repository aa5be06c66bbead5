# SPDX-License-Identifier: Apache-2.0
"""`csplat train`."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from csplat.context import Context
from csplat.encoder import EncodeOptions
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.console import format_seconds, parse_seconds
from csplat_tools.file_streams import check_name, is_one_way
from csplat_tools.optional_packages import require_trainer
from csplat_trainer.training_options import BACKGROUNDS, Outputs, TrainOptions

_DEFAULT = TrainOptions()
_BACKGROUNDS = ", ".join(BACKGROUNDS)
if TYPE_CHECKING:
    from csplat_tools.training.time_plan import TrainingSettings

_FRACTIONS = {2: "half", 4: "a quarter of", 8: "an eighth of"}  # names of 1 / divisor of the width, by divisor
_HOUR = 3600.0  # seconds, the default of --time


def train(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="DATA", help="A folder or transforms.json of posed images.")],
    output: Annotated[str, typer.Argument(metavar="OUT", help="OUT.ply; or OUT.csplat, which is tuned as well.")],
    time: Annotated[str | None, typer.Option(metavar="TIME", help="Time for all, e.g. 30min. Default: 1h.")] = None,
    max_splats: Annotated[int | None, typer.Option(metavar="N", help="Most splats. Default: by --time.")] = None,
    sh_degree: Annotated[
        int, typer.Option(metavar="0..4", show_default=False, help="SH degree of colours. Default: 3.")
    ] = _DEFAULT.sh_degree,
    iterations: Annotated[int | None, typer.Option(metavar="N", help="Training steps, instead of a time.")] = None,
    preset: shared.SmallPreset = None,
    keep: Annotated[
        float | None, typer.Option(metavar="FRACTION", help="Splats kept in OUT.csplat. Default: 0.8.")
    ] = None,
    target_size: shared.TargetSize = None,
    target_psnr: shared.TargetPsnr = None,
    device: Annotated[
        str, typer.Option(metavar="DEVICE", show_default=False, help="cpu; cuda: a GPU; torch. Default: cpu.")
    ] = "cpu",
    preview: Annotated[
        str | None, typer.Option(metavar="FILE.png", help="Image and render, renewed meanwhile.")
    ] = None,
    page: shared.Page = None,
    up: shared.HiddenUp = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", hidden=True, help="Scale images. Default: by --time.")
    ] = None,
    test_every: shared.TestEvery = None,
    background: Annotated[
        str,
        typer.Option(metavar="COLOUR", hidden=True, show_default=False, help=f"{_BACKGROUNDS}. Default: auto."),
    ] = _DEFAULT.background,
    seed: Annotated[
        int, typer.Option(metavar="N", min=0, hidden=True, show_default=False, help="Random seed. Default: 0.")
    ] = 0,
    checkpoint: shared.Checkpoint = None,
    resume: shared.Resume = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Train a scene from posed images.

    DATA is a NeRF-synthetic folder, a transforms.json or its folder, a COLMAP
    folder, or the folder of images in one of them (garden/images_4). The test
    images of the set, or every 8th image, are held out. A few timed steps
    choose the size of images, splats and steps for --time; the printed command
    makes the same file again. With --iterations, the defaults are unscaled
    images and 20,000 splats, or as many as a --target-size holds.
    OUT.csplat is tuned as by `csplat finetune`, with --preset, --keep or a
    target. To make files of several sizes, train once with --checkpoint, then
    use --resume (--help-all shows both), which takes the settings of the
    checkpoint. With --trust-paths, DATA may name files outside of its folder.
    An interrupted run leaves OUT.npz, from which --resume continues.

    Examples:
      csplat train garden/images_4 garden.csplat --time 30min
      csplat train lego lego.ply --max-splats 10000 --iterations 7000
      csplat train lego lego.csplat --target-size 800KB --checkpoint run.npz
      csplat train lego small.csplat --resume run.npz --target-size 400KB
    """
    out = Output(force, report, as_json, quiet)
    ending = Path(output).suffix.lower()
    to_file = ending == ".csplat"
    targets = {"--keep": keep, "--target-size": target_size, "--target-psnr": target_psnr}
    shared.refuse_together(targets)
    for name, value in {"--preset": preset, **targets}.items():
        if value is not None and not to_file:
            raise typer.BadParameter(f"{name} is for files, expected OUT.csplat")
    shared.refuse_together({"--time": time}, {"--iterations": iterations, "--resume": resume})
    seconds = _HOUR if time is None else shared.checked(parse_seconds, time)
    target, overrides = shared.parse_target(psnr=target_psnr, size=target_size, keep=keep), shared.parse_overrides(up)
    pixels = None if size is None else shared.parse_size(size)
    require_trainer(plots=page is not None)
    from csplat_tools.training.time_plan import TrainingSettings, plan_in_time
    from csplat_tools.training.training_run import (
        explain_size,
        plan_training,
        run_training,
        run_training_to_file,
        splats_for,
        stored_settings,
        tuning_after,
        tuning_checkpoint,
    )
    from csplat_tools.training.tuning_report import format_tuning_report
    from csplat_tools.training.tuning_run import SHAPE_ENTRIES

    processor = {"device": "cpu", "engine": "torch"} if device == "torch" else {"device": device}
    options = shared.checked(
        TrainOptions, sh_degree=sh_degree, seed=seed, background=background, **processor,
        max_splats=(splats_for(target) or TrainOptions.max_splats) if max_splats is None else max_splats,
        iterations=TrainOptions.iterations if iterations is None else iterations,
    )  # fmt: skip
    replaces = shared.is_same_file(checkpoint, resume)
    tuned = str(tuning_checkpoint(checkpoint)) if to_file and checkpoint is not None and target_psnr is None else None
    written = {} if replaces else {"--checkpoint": checkpoint, "the checkpoint of the tuning": tuned}
    named = {"--page": page, "--preview": preview, **written}
    if resume is not None:  # a resumed run renews its preview
        out.check(output, inputs=(source, resume), named=named, force=True)
        del named["--preview"]
    out.check(output, inputs=(source, resume), named=named)
    if not to_file:
        check_name(output, ".ply", "train", source)
        if ending != ".ply" and not is_one_way(output):
            raise typer.BadParameter(f"{output} ends in neither .ply nor .csplat, expected OUT.ply or OUT.csplat")
    encoding = EncodeOptions(preset or "small", shape_codebook_size=SHAPE_ENTRIES)
    data = shared.open_data(source, size=pixels, test_every=test_every)
    settings = TrainingSettings(pixels, options.max_splats, options.iterations)
    if resume is not None:
        settings = stored_settings(resume, size=pixels, max_splats=max_splats, iterations=iterations)
    elif iterations is None:
        with out.bar() as progress:
            settings = plan_in_time(
                data, options, seconds, to_file=to_file, max_splats=max_splats,
                most_splats=splats_for(target, most=True), context=Context(seed=seed, progress=progress),
            )  # fmt: skip
        out.remark(*_describe_plan(settings, seconds, context))
    data = replace(data, size=settings.size)
    options = replace(options, max_splats=settings.max_splats, iterations=settings.iterations)
    if to_file:
        options = plan_training(options, target, max_splats=settings.max_splats)
    kept = shared.run_checkpoint(
        context, checkpoint, resume, output, lambda path: [tuning_checkpoint(path)] if to_file else [],
        keep_refused=resume is None,
    )  # fmt: skip
    with kept as path, out.bar() as progress:
        files, run = Outputs(path, preview=preview, resume=resume), Context(seed=seed, progress=progress)
        expected = settings.seconds or None
        if to_file:
            result = run_training_to_file(
                data, output, options, files, encoding, tuning_after(training=options), target=target,
                overrides=overrides, page=page, expected=expected, context=run, quiet=out.quiet,
            )  # fmt: skip
        else:
            result = run_training(
                data, output, options, files, overrides=overrides, page=page, expected=expected, context=run,
                quiet=out.quiet,
            )  # fmt: skip
    if to_file:
        out.remark(format_tuning_report(result["file"]), *explain_size(result, target))
        out.remark(_describe_next_steps(output, checkpoint or resume))
    out.publish(result)


def _describe_next_steps(output: str, checkpoint: str | None) -> str:
    """Return a line on what to do with a file, and how to make others of the same training.

    Args:
        output: the file.
        checkpoint: the checkpoint that the run leaves; `None`: it is removed.
    """
    other_sizes = f"`--resume {shlex.quote(checkpoint or 'run.npz')} --target-size …` makes other sizes"
    if checkpoint is None:
        other_sizes = f"with `--checkpoint run.npz`, {other_sizes} of a training"
    return f"`csplat view {shlex.quote(output)}` shows it; {other_sizes}"


def _describe_plan(settings: TrainingSettings, seconds: float, context: typer.Context) -> list[str]:
    """Return lines on the settings of a timed training, and the command that repeats it."""
    text, scaled = f"{settings.max_splats:,} splats, {settings.iterations:,} steps", []
    chosen = {"--max-splats": str(settings.max_splats), "--iterations": str(settings.iterations)}
    if settings.size is not None:
        chosen["--size"] = "{}x{}".format(*settings.size)
        text += ", images of {}×{} pixels".format(*settings.size)
        if settings.scaled_from is not None:
            fraction = _FRACTIONS[round(settings.scaled_from[0] / settings.size[0])]
            scaled = [
                f"images of {fraction} their width and height lose details, and PSNR is not comparable with that of"
                " unscaled images; --size {}x{} keeps them".format(*settings.scaled_from)
            ]
    late = "" if settings.seconds <= seconds else f", more than {format_seconds(seconds)}: --size makes images smaller"
    return [
        f"{text}; this takes about {format_seconds(settings.seconds)}{late}",
        *scaled,
        f"to repeat it: {shared.command_line(context, chosen, '--time')}",
    ]
