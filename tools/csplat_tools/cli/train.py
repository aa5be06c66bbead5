"""`csplat train`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from csplat.errors import InputError
from csplat_tools.cli.console import guarded
from csplat_tools.cli.parsing import parse_size
from csplat_tools.files.streams import STANDARD_STREAM, check_output
from csplat_tools.training.train import Files, Reading, run_training
from csplat_trainer.options import BACKGROUNDS, DEVICES, INITS, LOSSES, STRATEGIES, TrainOptions

__all__ = ["train"]

_DEFAULT = TrainOptions()
_DATA = "Data set"
_SPLATS = "Splats"
_LOSS = "Loss"
_FILES = "Files on the way"
_RATES = "Learning rates and schedules"


@guarded
def train(
    source: Annotated[str, typer.Argument(metavar="DATA", help="A folder or transforms.json of posed pictures.")],
    output: Annotated[str, typer.Option("--output", "-o", metavar="OUT.ply", help="The scene to write.")],
    max_splats: Annotated[
        int, typer.Option(metavar="N", rich_help_panel=_SPLATS, help="No more splats than this.")
    ] = _DEFAULT.max_splats,
    sh_degree: Annotated[
        int, typer.Option(metavar="0..3", rich_help_panel=_SPLATS, help="How colour depends on direction.")
    ] = _DEFAULT.sh_degree,
    iterations: Annotated[int, typer.Option(metavar="N", help="Training steps.")] = _DEFAULT.iterations,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Scale the pictures to this size.")] = None,
    images: Annotated[
        str | None, typer.Option(metavar="NAME", rich_help_panel=_DATA, help="COLMAP: folder of pictures, images_4.")
    ] = None,
    test_every: Annotated[
        int, typer.Option(metavar="N", rich_help_panel=_DATA, help="Hold out every Nth picture; 0: none.")
    ] = 8,
    near: Annotated[
        float | None, typer.Option(metavar="UNITS", rich_help_panel=_DATA, help="Near plane; else one that suits.")
    ] = None,
    seed: Annotated[int, typer.Option(metavar="S", help="Of all random choices.")] = _DEFAULT.seed,
    device: Annotated[str, typer.Option(metavar="|".join(DEVICES), help="cuda wants a GPU and gsplat.")] = "cpu",
    threads: Annotated[
        int | None, typer.Option(min=1, help="Threads, one per core by default; the scene stays the same.")
    ] = None,
    strategy: Annotated[
        str, typer.Option(metavar="|".join(STRATEGIES), rich_help_panel=_SPLATS, help="How splats come and go.")
    ] = _DEFAULT.strategy,
    init: Annotated[
        str, typer.Option(metavar="|".join(INITS), rich_help_panel=_SPLATS, help="Where splats start.")
    ] = _DEFAULT.init,
    initial_splats: Annotated[
        int, typer.Option(metavar="N", rich_help_panel=_SPLATS, help="How many at first; 0: the strategy decides.")
    ] = _DEFAULT.initial_splats,
    background: Annotated[
        str,
        typer.Option(metavar="|".join(BACKGROUNDS), rich_help_panel=_LOSS, help="auto: white behind RGBA, else black."),
    ] = _DEFAULT.background,
    antialiased: Annotated[
        bool, typer.Option("--antialiased", rich_help_panel=_LOSS, help="Train with the mip-splatting filter.")
    ] = False,
    loss: Annotated[
        str,
        typer.Option(metavar="|".join(LOSSES), rich_help_panel=_LOSS, help="0.8 L1 + 0.2 D-SSIM, L1 + 0.2 D-SSIM, L1."),
    ] = _DEFAULT.loss,
    lpips_weight: Annotated[
        float, typer.Option(metavar="WEIGHT", rich_help_panel=_LOSS, help="Of a perceptual term.")
    ] = _DEFAULT.lpips_weight,
    lpips_weights: Annotated[
        str | None, typer.Option(metavar="FILE.npz", rich_help_panel=_LOSS, help="Weights of LPIPS-Alex.")
    ] = None,
    opacity_weight: Annotated[
        float, typer.Option(metavar="WEIGHT", rich_help_panel=_LOSS, help="Of the mean opacity.")
    ] = _DEFAULT.opacity_weight,
    scale_weight: Annotated[
        float, typer.Option(metavar="WEIGHT", rich_help_panel=_LOSS, help="Of the mean standard deviation.")
    ] = _DEFAULT.scale_weight,
    lr_means: Annotated[
        float, typer.Option(metavar="RATE", rich_help_panel=_RATES, help="Times the scene's extent, at first.")
    ] = _DEFAULT.lr_means,
    lr_means_final: Annotated[
        float, typer.Option(metavar="RATE", rich_help_panel=_RATES, help="Times the scene's extent, at the end.")
    ] = _DEFAULT.lr_means_final,
    sh_interval: Annotated[
        int, typer.Option(metavar="N", rich_help_panel=_RATES, help="Steps before each next SH degree; 0: automatic.")
    ] = _DEFAULT.sh_interval,
    log: Annotated[
        str | None, typer.Option("--json", metavar="LOG", rich_help_panel=_FILES, help="Options, losses, figures.")
    ] = None,
    plot: Annotated[
        str | None, typer.Option(metavar="FILE.png", rich_help_panel=_FILES, help="The loss over the steps.")
    ] = None,
    previews: Annotated[
        str | None,
        typer.Option(metavar="FOLDER", rich_help_panel=_FILES, help="Early pictures, beside the photograph."),
    ] = None,
    preview_every: Annotated[
        int, typer.Option(metavar="N", min=0, rich_help_panel=_FILES, help="Steps; 0: after 100, 200, 400, ...")
    ] = 0,
    checkpoint: Annotated[
        str | None, typer.Option(metavar="FILE.npz", rich_help_panel=_FILES, help="Where checkpoints go.")
    ] = None,
    checkpoint_every: Annotated[
        int, typer.Option(metavar="N", min=0, rich_help_panel=_FILES, help="Steps; 0: at the end alone.")
    ] = 0,
    resume: Annotated[
        str | None, typer.Option(metavar="FILE.npz", rich_help_panel=_FILES, help="Go on from this checkpoint.")
    ] = None,
    eval_every: Annotated[
        int, typer.Option(metavar="N", rich_help_panel=_FILES, help="Steps; 0: at the end alone.")
    ] = _DEFAULT.eval_every,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing unless something is wrong.")] = False,
) -> None:
    """Train a scene from posed pictures, on a CPU.

    DATA is a NeRF-synthetic folder, an instant-ngp transforms.json or its
    folder, or a COLMAP folder with its pictures. Test pictures are held out:
    those that the data set names, or every eighth.

    What is behind the splats is white where pictures have an alpha channel
    and black where they have none. A comment in OUT.ply says so, and which
    pictures were held out, their size and the near plane: other commands read
    it and judge the scene alike; encode and decode keep it.

    Examples:
      csplat train lego -o lego.ply --max-splats 10000
      csplat train lego -o lego.ply --size 200x200 --json lego.json --plot loss.png
      csplat train capture -o scene.ply --checkpoint run.npz --checkpoint-every 1000
      csplat train capture -o scene.ply --resume run.npz --max-splats 60000
    """
    try:
        options = TrainOptions(
            max_splats=max_splats,
            sh_degree=sh_degree,
            iterations=iterations,
            seed=seed,
            device=device,
            strategy=strategy,
            init=init,
            initial_splats=initial_splats,
            background=background,
            antialiased=antialiased,
            loss=loss,
            lpips_weight=lpips_weight,
            opacity_weight=opacity_weight,
            scale_weight=scale_weight,
            lr_means=lr_means,
            lr_means_final=lr_means_final,
            sh_interval=sh_interval,
            eval_every=eval_every,
        )
    except InputError as error:
        raise typer.BadParameter(str(error)) from None
    if STANDARD_STREAM in (log, plot, checkpoint):
        raise typer.BadParameter("--json, --plot and --checkpoint want names of files")
    inputs = tuple(path for path in (resume, lpips_weights) if path is not None)
    check_output(output, force=force, inputs=inputs)
    for path in (log, plot):
        if path is not None:
            check_output(path, force=force, inputs=(*inputs, output))
    if checkpoint is not None:
        again = resume is not None and Path(checkpoint).exists() and Path(checkpoint).samefile(resume)
        check_output(checkpoint, force=force or again)
    reading = Reading(None if size is None else parse_size(size), images, test_every, near)
    files = Files(output, log, plot, previews, preview_every, checkpoint, checkpoint_every, resume, lpips_weights)
    run_training(source, options, reading, files, threads=threads, quiet=quiet)
