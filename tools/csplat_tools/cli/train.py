"""`csplat train`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from csplat.encoder import PRESETS, EncodeOptions, PresetName
from csplat_tools.cli.command import LibrarySettings, OutputOptions, chosen, command
from csplat_tools.cli.shared_options import (
    ByteCost,
    Checkpoint,
    CheckpointEvery,
    OrientationOptions,
    Resume,
    Seed,
    Threads,
    parse_bytes,
    parse_decibels,
    parse_size,
)
from csplat_tools.file_streams import check_name
from csplat_tools.optional_packages import require_trainer
from csplat_tools.views import DataOptions
from csplat_trainer.training_options import BACKGROUNDS, DEVICES, Outputs, TrainOptions

_DEFAULT = TrainOptions()
_KEEP = 0.8  # default fraction of the trained splats that OUT.csplat keeps: some of them are hardly seen


@command(
    needs={"preview_every": ("previews",), "checkpoint_every": ("checkpoint",)},
    one_of=(("keep", "target_size", "target_psnr"), ("byte_cost", "target_size", "target_psnr")),
    settings=("csplat_trainer.training_options:TrainOptions",),
)
def train(
    source: Annotated[str, typer.Argument(metavar="DATA", help="A folder or transforms.json of posed images.")],
    output: Annotated[
        str, typer.Argument(metavar="OUT.ply|OUT.csplat", help="The scene to write, or a file that is tuned as well.")
    ],
    upright: OrientationOptions,
    out: OutputOptions,
    settings: LibrarySettings,
    max_splats: Annotated[
        int | None,
        typer.Option(metavar="N", help="Splats at most. Default: 20,000; with a target, as many as it allows."),
    ] = None,
    sh_degree: Annotated[int, typer.Option(metavar="0..3", help="SH degree of the colours.")] = _DEFAULT.sh_degree,
    iterations: Annotated[int, typer.Option(metavar="N", help="Training steps.")] = _DEFAULT.iterations,
    preset: Annotated[
        PresetName | None,
        typer.Option(metavar="|".join(PRESETS), help="Preset of OUT.csplat: speed against size. Default: small."),
    ] = None,
    keep: Annotated[
        float | None,
        typer.Option(metavar="SHARE", help="Share of the trained splats that OUT.csplat keeps. Default: 0.8."),
    ] = None,
    target_size: Annotated[
        str | None, typer.Option(metavar="1.4MB", help="Largest size of OUT.csplat; not with --keep.")
    ] = None,
    target_psnr: Annotated[
        str | None,
        typer.Option(metavar="dB", help="Least PSNR of OUT.csplat against validation photographs."),
    ] = None,
    byte_cost: ByteCost = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Scale the images to this size.")] = None,
    images: Annotated[str | None, typer.Option(metavar="NAME", help="Folder of images, such as images_4.")] = None,
    test_every: Annotated[int, typer.Option(metavar="N", help="Hold out every Nth image; 0: none. Default: 8.")] = 8,
    background: Annotated[
        str, typer.Option(metavar="|".join(BACKGROUNDS), help="auto: white behind RGBA, else black.")
    ] = _DEFAULT.background,
    device: Annotated[
        str, typer.Option(metavar="|".join(DEVICES), help="cuda requires a GPU, torch and gsplat.")
    ] = "cpu",
    near: Annotated[
        float | None,
        typer.Option(metavar="UNITS", hidden=True, help="Near plane, scene units. Default: one that suits the set."),
    ] = None,
    seed: Seed = _DEFAULT.seed,
    threads: Threads = None,
    antialiased: Annotated[
        bool, typer.Option("--antialiased", hidden=True, help="Train with the mip-splatting filter.")
    ] = False,
    lpips_weights: Annotated[
        str | None, typer.Option(metavar="FILE.npz", hidden=True, help="Weights of LPIPS-Alex.")
    ] = None,
    plot: Annotated[
        str | None, typer.Option(metavar="FILE.png", hidden=True, help="Plot the loss over the steps.")
    ] = None,
    page: Annotated[
        str | None, typer.Option(metavar="FILE.html", help="Write an HTML report: scores, curves, renders.")
    ] = None,
    previews: Annotated[
        str | None, typer.Option(metavar="FOLDER", hidden=True, help="Write early renders next to the photograph.")
    ] = None,
    preview_every: Annotated[
        int,
        typer.Option(
            metavar="N", min=0, hidden=True, help="Steps from one preview to the next; 0: after 100, 200, 400, ..."
        ),
    ] = 0,
    checkpoint: Checkpoint = None,
    checkpoint_every: CheckpointEvery = 0,
    resume: Resume = None,
) -> None:
    """Train a scene from posed images, on a CPU.

    DATA is a NeRF-synthetic folder, an instant-ngp transforms.json or its
    folder, or a COLMAP folder with its images. Test images are held out: those
    that the data set names, or every eighth. Black areas of masks (`mask_path`,
    or a folder `masks` next to COLMAP's images) are neither learnt nor scored.

    The background is white if images have an alpha channel, else black. OUT.ply
    records it in a comment, with the held-out images, their size and the near
    plane: other commands read it and score the scene alike; encode and decode
    keep it. Another comment records the up direction, from the kind of set or
    from how its cameras were held.

    For OUT.csplat, splats that renders hardly need are pruned while others can
    still learn to replace them. Then `csplat finetune --data DATA` follows: the
    values are tuned through the encoder's quantisers. Validation photographs of
    the set, or some training photographs, choose the best step. --target-size
    weighs bytes in the loss so that the file keeps to it. --target-psnr tunes
    files of several sizes, until the smallest reaches it. --checkpoint and
    --resume cover training and tuning: one training can make files of several
    sizes.

    Examples:
      csplat train lego -o lego.ply --max-splats 10000
      csplat train lego -o lego.ply --size 200x200 --report lego.json
      csplat train lego -o lego.csplat --target-size 800KB --page lego.html
    ---
    More examples:
      csplat train lego -o lego.ply --plot loss.png --previews pictures
      csplat train lego -o lego.ply --set strategy=gradient,loss=l1
      csplat train capture -o scene.ply --set lr_exposure=0.01  # photographs differ in brightness
      csplat train lego -o lego.csplat --max-splats 120000 --keep 0.8 --iterations 7000
      csplat train lego -o smaller.csplat --max-splats 120000 --resume run.npz --target-size 500KB
      csplat train capture -o scene.ply --checkpoint run.npz --checkpoint-every 1000
      csplat train capture -o scene.ply --resume run.npz --max-splats 60000
    """
    require_trainer(plots=plot is not None or page is not None)
    from csplat_tools.training.training_run import run_training, run_training_to_file, tuning_after, tuning_checkpoint
    from csplat_tools.training.tuning_report import format_tuning_report
    from csplat_tools.training.tuning_run import SHAPE_ENTRIES, SPLAT_BYTES
    from csplat_trainer.training_checkpoint import load_checkpoint

    to_file, size_bytes = Path(output).suffix == ".csplat", parse_bytes(target_size)
    psnr = None if target_psnr is None else parse_decibels(target_psnr)
    if psnr is not None and not math.isfinite(psnr):
        raise typer.BadParameter(f"--target-psnr is {target_psnr}, wanted a finite number of dB")
    if not to_file and (preset, keep, size_bytes, psnr, byte_cost) != (None, None, None, None, None):
        raise typer.BadParameter("--preset, --keep, --lambda and targets are about a file: wanted OUT.csplat")
    if keep is not None and not 0.0 < keep <= 1.0:
        raise typer.BadParameter(f"--keep is {keep:g}, wanted a share above 0, at most 1")
    share = 1.0 if not to_file or psnr is not None else _KEEP if keep is None else keep
    if (size_bytes, psnr) != (None, None) and max_splats is None and resume is not None:
        max_splats = load_checkpoint(resume).options.get("max_splats")
    if size_bytes is not None:
        left = max(1, size_bytes // SPLAT_BYTES)
        max_splats = max_splats or round(left / _KEEP)
        share = min(1.0, left / max_splats)
    options = chosen(
        TrainOptions, max_splats=max_splats or TrainOptions.max_splats, sh_degree=sh_degree, iterations=iterations,
        seed=seed, device=device, background=background, antialiased=antialiased,
        **{"final_share": share, **settings.of(TrainOptions)},
    )  # fmt: skip
    again = None not in (checkpoint, resume) and Path(str(checkpoint)).resolve() == Path(str(resume)).resolve()
    later = str(tuning_checkpoint(checkpoint)) if to_file and checkpoint is not None and psnr is None else None
    out.check(
        output, inputs=(source, resume, lpips_weights),
        named={
            "--plot": plot, "--page": page, "--checkpoint": None if again else checkpoint,
            "the checkpoint of the tuning": None if again else later,
        },
    )  # fmt: skip
    if not to_file:
        check_name(output, ".ply", "train", source)
    data = DataOptions(source, None if size is None else parse_size(size), images, test_every, near)
    files = Outputs(checkpoint, checkpoint_every, previews, preview_every, resume, lpips_weights)
    overrides = upright.overrides()
    if not to_file:
        out.publish(
            run_training(
                data,
                output,
                options,
                files,
                overrides=overrides,
                plot=plot,
                page=page,
                threads=threads,
                quiet=out.quiet,
            )
        )
        return
    encoding = EncodeOptions(preset or "small", seed=seed, threads=threads, shape_codebook_size=SHAPE_ENTRIES)
    report = run_training_to_file(
        data, output, options, files, encoding, chosen(tuning_after, training=options, byte_cost=byte_cost),
        size_bytes=size_bytes, psnr=psnr, overrides=overrides, plot=plot, page=page, quiet=out.quiet,
    )  # fmt: skip
    out.remark(format_tuning_report(report["file"]))
    out.publish(report)
