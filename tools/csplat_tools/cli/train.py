# SPDX-License-Identifier: Apache-2.0
"""`csplat train`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from csplat.context import Context
from csplat.encoder import EncodeOptions
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.file_streams import check_name
from csplat_tools.optional_packages import require_trainer
from csplat_trainer.training_options import BACKGROUNDS, Outputs, TrainOptions

_DEFAULT = TrainOptions()
_BACKGROUNDS = ", ".join(BACKGROUNDS)
_ENGINE_HELP = "native, or torch: slower on a CPU. Default: native, with cuda torch."


def train(
    source: Annotated[str, typer.Argument(metavar="DATA", help="A folder or transforms.json of posed images.")],
    output: Annotated[str, typer.Argument(metavar="OUT", help="OUT.ply; or OUT.csplat, which is tuned as well.")],
    max_splats: Annotated[
        int | None, typer.Option(metavar="N", help="Largest number of splats. Default: 20,000.")
    ] = None,
    sh_degree: Annotated[
        int, typer.Option(metavar="0..4", show_default=False, help="SH degree of colours. Default: 3.")
    ] = _DEFAULT.sh_degree,
    iterations: Annotated[
        int, typer.Option(metavar="N", show_default=False, help="Training steps. Default: 7,000.")
    ] = _DEFAULT.iterations,
    preset: shared.SmallPreset = None,
    keep: Annotated[
        float | None, typer.Option(metavar="FRACTION", help="Splats kept in OUT.csplat. Default: 0.8.")
    ] = None,
    target_size: shared.TargetSize = None,
    target_psnr: shared.TargetPsnr = None,
    device: Annotated[
        str, typer.Option(metavar="DEVICE", show_default=False, help="cpu, or cuda: a GPU. Default: cpu.")
    ] = "cpu",
    engine: Annotated[
        str, typer.Option(metavar="ENGINE", hidden=True, show_default=False, help=_ENGINE_HELP)
    ] = _DEFAULT.engine,
    page: shared.Page = None,
    up: shared.HiddenUp = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", hidden=True, help="Scale images, pixels. Default: unscaled.")
    ] = None,
    test_every: shared.TestEvery = None,
    background: Annotated[
        str,
        typer.Option(metavar="COLOUR", hidden=True, show_default=False, help=f"{_BACKGROUNDS}. Default: auto."),
    ] = _DEFAULT.background,
    seed: Annotated[
        int, typer.Option(metavar="N", min=0, hidden=True, show_default=False, help="Random seed. Default: 0.")
    ] = _DEFAULT.seed,
    antialiased: Annotated[
        bool, typer.Option("--antialiased", hidden=True, help="Train with the mip-splatting filter.")
    ] = False,
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
    images of the set, or every 8th image, are held out. OUT.csplat is tuned as
    by `csplat finetune`, with --preset, --keep or a target. To make files of
    several sizes, train once with --checkpoint, then use --resume (--help-all
    shows both). With --trust-paths, DATA may name files outside of its folder.
    An interrupted run leaves OUT.npz, from which --resume continues.

    Examples:
      csplat train lego lego.ply --max-splats 10000
      csplat train garden/images_4 garden.ply --report garden.json
      csplat train lego lego.csplat --target-size 800KB --checkpoint run.npz
      csplat train lego small.csplat --resume run.npz --target-size 400KB
    """
    out = Output(force, report, as_json, quiet)
    to_file = Path(output).suffix == ".csplat"
    targets = {"--keep": keep, "--target-size": target_size, "--target-psnr": target_psnr}
    shared.refuse_together(targets)
    for name, value in {"--preset": preset, **targets}.items():
        if value is not None and not to_file:
            raise typer.BadParameter(f"{name} is for files, expected OUT.csplat")
    target, overrides = shared.parse_target(psnr=target_psnr, size=target_size, keep=keep), shared.parse_overrides(up)
    data = shared.open_data(source, size=None if size is None else shared.parse_size(size), test_every=test_every)
    require_trainer(plots=page is not None)
    from csplat_tools.training.training_run import (
        plan_training,
        run_training,
        run_training_to_file,
        tuning_after,
        tuning_checkpoint,
    )
    from csplat_tools.training.tuning_report import format_tuning_report
    from csplat_tools.training.tuning_run import SHAPE_ENTRIES

    options = shared.checked(
        TrainOptions, max_splats=TrainOptions.max_splats if max_splats is None else max_splats, sh_degree=sh_degree,
        iterations=iterations, seed=seed, device=device, engine=engine, background=background, antialiased=antialiased,
    )  # fmt: skip
    if to_file:
        options = plan_training(options, target, max_splats=max_splats, resume=resume)
    replaces = shared.is_same_file(checkpoint, resume)
    tuned = str(tuning_checkpoint(checkpoint)) if to_file and checkpoint is not None and target_psnr is None else None
    written = {} if replaces else {"--checkpoint": checkpoint, "the checkpoint of the tuning": tuned}
    out.check(output, inputs=(source, resume), named={"--page": page, **written})
    if not to_file:
        check_name(output, ".ply", "train", source)
    encoding = EncodeOptions(preset or "small", shape_codebook_size=SHAPE_ENTRIES)
    kept = shared.run_checkpoint(checkpoint, resume, output, lambda path: [tuning_checkpoint(path)])
    with kept as path, out.bar() as progress:
        files, context = Outputs(path, resume=resume), Context(seed=seed, progress=progress)
        if to_file:
            result = run_training_to_file(
                data, output, options, files, encoding, tuning_after(training=options), target=target,
                overrides=overrides, page=page, context=context, quiet=out.quiet,
            )  # fmt: skip
        else:
            result = run_training(
                data, output, options, files, overrides=overrides, page=page, context=context, quiet=out.quiet
            )
    if to_file:
        out.remark(format_tuning_report(result["file"]))
    out.publish(result)
