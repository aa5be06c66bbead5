# SPDX-License-Identifier: Apache-2.0
"""`csplat finetune`."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Annotated

import typer

from csplat.context import Context
from csplat.encoder import EncodeOptions
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.encode_file import read_degree
from csplat_tools.file_streams import check_name
from csplat_tools.optional_packages import require_trainer
from csplat_tools.scene_files import MetadataOverrides, read_source, with_first_view


def finetune(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="IN.ply", help="A trained 3DGS scene.")],
    output: Annotated[str, typer.Argument(metavar="OUT.csplat", help="The file to write.")],
    data: shared.Data = None,
    own_renders: Annotated[bool, typer.Option("--self", help="Tune to the scene's own renders.")] = False,
    preset: shared.Preset = "balanced",
    keep: shared.Keep = None,
    target_size: shared.TargetSize = None,
    target_psnr: shared.TargetPsnr = None,
    iterations: Annotated[
        int, typer.Option(metavar="N", min=1, show_default=False, help="Largest number of steps. Default: 1,000.")
    ] = 1_000,
    lambda_: Annotated[
        float | None,
        typer.Option("--lambda", metavar="COST", help="Loss per bit and splat. Default: 1e-4; --self: 2e-5."),
    ] = None,
    page: shared.Page = None,
    cameras: shared.HiddenCameras = None,
    background: shared.HiddenBackground = None,
    source_index: shared.SourceIndexOutput = None,
    checkpoint: shared.Checkpoint = None,
    resume: shared.Resume = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Compress a scene, and tune the values in the file.

    --data or --self is required: values are tuned through the encoder's
    quantisers until renders of the file match the images, or the renders of
    the scene itself. Targets choose the number of splats and lambda. Requires
    the render extra. An interrupted run leaves OUT.csplat.npz, from which
    --resume continues, except with --target-psnr.

    Examples:
      csplat finetune scene.ply scene.csplat --data capture --preset small
      csplat finetune scene.ply scene.csplat --data capture --target-size 2MB
      csplat finetune scene.ply scene.csplat --data capture --target-psnr 30
      csplat finetune scene.ply scene.csplat --self
    """
    out = Output(force, report, as_json, quiet)
    views = shared.ViewOptions(cameras, data, background)
    if data is None and not own_renders:
        raise typer.BadParameter("expected --data or --self")
    shared.refuse_together({"--data": data, "--self": own_renders})
    by_psnr = {"--target-psnr": target_psnr}
    shared.refuse_together({**by_psnr, "--target-size": target_size, "--keep": keep})
    shared.refuse_together(by_psnr, {"--checkpoint": checkpoint, "--resume": resume})
    shared.refuse_together({"--lambda": lambda_}, {"--target-size": target_size, **by_psnr})
    shared.require_one({"--background": background}, {"--cameras": cameras, "--data": data})
    target = shared.parse_target(psnr=target_psnr, size=target_size, keep=keep)
    require_trainer(plots=page is not None)
    from csplat_tools.training import tuning_run as tuning
    from csplat_tools.training.tuning_report import format_tuning_report
    from csplat_trainer.training_options import Outputs
    from csplat_trainer.tuning.tuning_options import FinetuneOptions

    cost = tuning.RATE_WEIGHT[own_renders] if lambda_ is None else lambda_
    options = shared.checked(FinetuneOptions, iterations=iterations, lambda_=cost).scaled(
        tuning.LEARNING_FACTOR[own_renders]
    )
    encoding = EncodeOptions(preset, shape_codebook_size=tuning.SHAPE_ENTRIES)
    replaces = shared.is_same_file(checkpoint, resume)  # a run may replace the checkpoint that it goes on from
    named = {"--source-index": source_index, "--page": page}
    if replaces:
        out.check(inputs=(source, *views.inputs), named={"--checkpoint": checkpoint}, force=True)
    else:
        named["--checkpoint"] = checkpoint
    out.check(output, inputs=(source, *views.inputs, resume), named=named)
    check_name(output, ".csplat", "finetune", source)
    kept = nullcontext() if target_psnr is not None else shared.run_checkpoint(context, checkpoint, resume, output)
    with kept as path, out.bar() as progress:
        scene = read_source(source, MetadataOverrides(), sh_degree=read_degree(encoding))
        out.print_findings(scene.findings)
        model = scene.model()
        validation_count = tuning.default_validation_count(tuning.VIEWS, cameras=cameras, data=data)
        view_set = views.find(
            model, out, source, count=tuning.VIEWS, size=tuning.VIEW_SIZE, validation_count=validation_count
        )
        view_set.read_images()
        result = tuning.run_finetuning(
            with_first_view(scene).model(), view_set, output, encoding, options, Outputs(path, resume=resume),
            target=target, source_index=source_index, page=page,
            context=Context(progress=progress), quiet=out.quiet,
        )  # fmt: skip
    out.remark(format_tuning_report(result))
    out.publish(result)
