"""`csplat finetune`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from csplat_tools.cli.command import LibrarySettings, OutputOptions, chosen, command
from csplat_tools.cli.shared_options import (
    ENCODER_SETTINGS,
    ByteCost,
    Checkpoint,
    CheckpointEvery,
    EncodingOptions,
    Importance,
    LpipsOption,
    Near,
    Resume,
    SourceIndex,
    SourceOptions,
    ViewOptions,
    VirtualViewOptions,
    parse_bytes,
    parse_decibels,
)
from csplat_tools.encode_file import read_degree
from csplat_tools.file_streams import check_name
from csplat_tools.optional_packages import require_trainer
from csplat_tools.scene_files import read_source


@command(
    reads=True,
    one_of=(
        ("data", "itself"),
        ("data", "views"),
        ("data", "view_size"),
        *(("target_psnr", other) for other in ("target_size", "keep", "checkpoint", "resume")),
        ("byte_cost", "target_size", "target_psnr"),
    ),
    needs={"near": ("data",), "checkpoint_every": ("checkpoint",)},
    settings=(ENCODER_SETTINGS, "csplat_trainer.tuning.tuning_options:FinetuneOptions"),
)
def finetune(
    source: Annotated[str, typer.Argument(metavar="IN.ply", help="A trained 3DGS scene.")],
    output: Annotated[str, typer.Argument(metavar="OUT.csplat", help="The file to write.")],
    encoding: EncodingOptions,
    source_options: SourceOptions,
    views: ViewOptions,
    virtual: VirtualViewOptions,
    out: OutputOptions,
    settings: LibrarySettings,
    itself: Annotated[
        bool, typer.Option("--self", help="Tune by the scene's own renders instead of photographs.")
    ] = False,
    keep: Annotated[
        float | None,
        typer.Option(metavar="SHARE", help="Share of the splats to keep; the others are pruned first."),
    ] = None,
    target_size: Annotated[
        str | None,
        typer.Option(metavar="5MB", help="Largest size of the file; splats are pruned to reach it."),
    ] = None,
    target_psnr: Annotated[
        str | None,
        typer.Option(metavar="dB", help="Least PSNR of the validation views; several files are tuned."),
    ] = None,
    prune_unseen: Annotated[
        bool | None,
        typer.Option(
            "--prune-unseen/--keep-unseen",
            hidden=True,
            help="Prune splats that no view shows. Default: only with --data.",
        ),
    ] = None,
    importance: Importance = None,
    near: Near = None,
    validation_count: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=0,
            hidden=True,
            help="Validation views, which choose the best step; 0: those of the data set or of the training.",
        ),
    ] = 0,
    iterations: Annotated[int, typer.Option(metavar="N", min=1, help="Steps at most, each with one image.")] = 1_000,
    byte_cost: ByteCost = None,
    lr_factor: Annotated[
        float | None,
        typer.Option(
            metavar="FACTOR", hidden=True, help="Factor of all learning rates. Default: 1; with --self, 0.03."
        ),
    ] = None,
    lpips: LpipsOption = None,
    page: Annotated[
        str | None, typer.Option(metavar="FILE.html", help="Write an HTML report: scores, curve, renders.")
    ] = None,
    source_index: SourceIndex = None,
    checkpoint: Checkpoint = None,
    checkpoint_every: CheckpointEvery = 0,
    resume: Resume = None,
) -> None:
    """Compress a scene, and tune the values in the file by photographs or renders.

    The sensitivity of the views to each splat is measured, by which the encoder
    chooses lattices, tiles and codebooks, once. Then the values are tuned through
    the encoder's quantisers until renders of the decoded scene match the
    photographs, or without photographs the renders of the scene itself. The
    step with the best renders for its bytes is written. Requires the packages
    of the render extra.

    Examples:
      csplat finetune scene.ply scene.csplat --data capture --preset small
      csplat finetune scene.ply scene.csplat --data capture --attribute-psnr 40 --report scene.json
      csplat finetune scene.ply scene.csplat --data capture --keep 0.5
      csplat finetune scene.ply scene.csplat --data capture --target-size 2MB
      csplat finetune scene.ply scene.csplat --data capture --target-psnr 30
      csplat finetune scene.ply scene.csplat --self
      csplat finetune scene.ply scene.csplat --data capture --checkpoint run.npz --resume run.npz
    """
    require_trainer(plots=page is not None)
    from csplat_render.lpips import load_lpips
    from csplat_tools.training import tuning_run as tuning
    from csplat_tools.training.tuning_report import format_tuning_report
    from csplat_trainer.training_options import Outputs
    from csplat_trainer.tuning.tuning_options import FinetuneOptions

    if views.data is None and not itself:
        raise typer.BadParameter("wanted one of --data and --self")
    if keep is not None and not 0.0 < keep <= 1.0:
        raise typer.BadParameter(f"--keep is {keep:g}, wanted a share above 0, at most 1")
    size_bytes = parse_bytes(target_size)
    psnr = None if target_psnr is None else parse_decibels(target_psnr)
    if psnr is not None and not math.isfinite(psnr):
        raise typer.BadParameter(f"--target-psnr is {target_psnr}, wanted a finite number of dB")
    cost = tuning.RATE_WEIGHT[itself] if byte_cost is None else byte_cost
    rates = settings.of(FinetuneOptions)
    options = chosen(FinetuneOptions, iterations=iterations, seed=encoding.seed, byte_cost=cost, **rates)
    options = chosen(options.scaled, factor=tuning.LEARNING_FACTOR[itself] if lr_factor is None else lr_factor)
    encoder = encoding.options(source_options, settings)
    if encoder.shape_codebook_size is None:
        encoder = replace(encoder, shape_codebook_size=tuning.SHAPE_ENTRIES)
    # A checkpoint may take the place of the one that it goes on from.
    again = None not in (checkpoint, resume) and Path(str(checkpoint)).resolve() == Path(str(resume)).resolve()
    inputs = (source, importance, *views.inputs, None if lpips == "auto" else lpips)
    named = {"--source-index": source_index, "--checkpoint": checkpoint, "--page": page}
    if again:
        out.check(inputs=inputs, named={"--checkpoint": checkpoint}, force=True)
        del named["--checkpoint"]
    out.check(output, inputs=(*inputs, resume), named=named)
    check_name(output, ".csplat", "finetune", source)
    distance = None if lpips is None else load_lpips(None if lpips == "auto" else lpips)
    degree = read_degree(encoder)
    read = read_source(
        source,
        source_options.read(),
        strict=source_options.strict,
        keep_extra=source_options.keep_extra,
        sh_degree=degree,
    )
    out.print_findings(read.findings)
    given = {"count": tuning.VIEWS, "size": tuning.VIEW_SIZE, **virtual.given()}
    aside_count = validation_count or tuning.default_validation_count(
        given["count"], cameras=views.cameras, data=views.data
    )
    around = views.find(read.model, out, near=near, validation_count=aside_count, **given)
    around.read_images()
    report = tuning.run_finetuning(
        read.model, around, output, encoder, options, Outputs(checkpoint, checkpoint_every, resume=resume), keep=keep,
        prune_unseen=prune_unseen, importance=importance, source_index=source_index, lpips=distance,
        size_bytes=size_bytes, psnr=psnr, page=page, quiet=out.quiet,
    )  # fmt: skip
    out.remark(format_tuning_report(report))
    out.publish(report)
