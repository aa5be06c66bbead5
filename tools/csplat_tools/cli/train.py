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
    source: Annotated[str, typer.Argument(metavar="DATA", help="A folder or transforms.json of posed pictures.")],
    output: Annotated[
        str, typer.Argument(metavar="OUT.ply|OUT.csplat", help="The scene to write, or a file that was tuned, too.")
    ],
    upright: OrientationOptions,
    out: OutputOptions,
    settings: LibrarySettings,
    max_splats: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="No more splats than this; by default 20,000, with a target as many as it has room for."
        ),
    ] = None,
    sh_degree: Annotated[
        int, typer.Option(metavar="0..3", help="How colour depends on direction.")
    ] = _DEFAULT.sh_degree,
    iterations: Annotated[int, typer.Option(metavar="N", help="Training steps.")] = _DEFAULT.iterations,
    preset: Annotated[
        PresetName | None,
        typer.Option(metavar="|".join(PRESETS), help="Of OUT.csplat: speed against size; by default small."),
    ] = None,
    keep: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE", help="Of the splats that are trained, how many OUT.csplat holds; by default 0.8."
        ),
    ] = None,
    target_size: Annotated[
        str | None, typer.Option(metavar="1.4MB", help="OUT.csplat has so many bytes at most; not with --keep.")
    ] = None,
    target_psnr: Annotated[
        str | None,
        typer.Option(metavar="dB", help="OUT.csplat is the smallest found that has it on photographs that decide."),
    ] = None,
    byte_cost: ByteCost = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Scale the pictures to this size.")] = None,
    images: Annotated[str | None, typer.Option(metavar="NAME", help="Folder of images, such as images_4.")] = None,
    test_every: Annotated[int, typer.Option(metavar="N", help="Hold out every Nth picture; 0: none.")] = 8,
    background: Annotated[
        str, typer.Option(metavar="|".join(BACKGROUNDS), help="auto: white behind RGBA, else black.")
    ] = _DEFAULT.background,
    device: Annotated[
        str, typer.Option(metavar="|".join(DEVICES), help="cuda wants a GPU and gsplat, and never ran on one.")
    ] = "cpu",
    near: Annotated[
        float | None, typer.Option(metavar="UNITS", hidden=True, help="Near plane; else one that suits.")
    ] = None,
    seed: Seed = _DEFAULT.seed,
    threads: Threads = None,
    antialiased: Annotated[
        bool, typer.Option("--antialiased", hidden=True, help="Train with the mip-splatting filter.")
    ] = False,
    lpips_weights: Annotated[
        str | None, typer.Option(metavar="FILE.npz", hidden=True, help="Weights of LPIPS-Alex.")
    ] = None,
    plot: Annotated[str | None, typer.Option(metavar="FILE.png", hidden=True, help="The loss over the steps.")] = None,
    page: Annotated[
        str | None, typer.Option(metavar="FILE.html", help="Write a page about it: scores, curves, pictures.")
    ] = None,
    previews: Annotated[
        str | None, typer.Option(metavar="FOLDER", hidden=True, help="Early pictures, beside the photograph.")
    ] = None,
    preview_every: Annotated[
        int, typer.Option(metavar="N", min=0, hidden=True, help="Steps; 0: after 100, 200, 400, ...")
    ] = 0,
    checkpoint: Checkpoint = None,
    checkpoint_every: CheckpointEvery = 0,
    resume: Resume = None,
) -> None:
    """Train a scene from posed pictures, on a CPU.

    DATA is a NeRF-synthetic folder, an instant-ngp transforms.json or its
    folder, or a COLMAP folder with its pictures. Test pictures are held out:
    those that the data set names, or every eighth. Where masks are black
    (`mask_path`, or a folder `masks` beside COLMAP's pictures), nothing is
    learnt and nothing judged.

    What is behind the splats is white where pictures have an alpha channel
    and black where they have none. A comment in OUT.ply says so, and which
    pictures were held out, their size and the near plane: other commands read
    it and judge the scene alike; encode and decode keep it. Another says which
    way is up, by the kind of set or by how its cameras were held.

    For OUT.csplat splats that pictures hardly need go while others still learn
    to stand in for them. Then `csplat finetune --data DATA` follows: values
    move, seen through the encoder's quantisers, until the photographs look
    right. Photographs that a set names for validation, or some that teach, say
    which step was best. With --target-size bytes cost as much in the loss as
    keeps the file to it. --target-psnr tunes files of several sizes, until the
    smallest has it. --checkpoint and --resume cover training and tuning: from
    one training files of several sizes can be made.

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
    from csplat_tools.training.trained_scene import run_training, run_training_to_file, tuning_after, tuning_checkpoint
    from csplat_tools.training.tuned_file import SHAPE_ENTRIES, SPLAT_BYTES
    from csplat_tools.training.tuning_report import format_tuning_report
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
    facts = upright.upright()
    if not to_file:
        out.publish(
            run_training(
                data, output, options, files, facts=facts, plot=plot, page=page, threads=threads, quiet=out.quiet
            )
        )
        return
    encoding = EncodeOptions(preset or "small", seed=seed, threads=threads, shape_codebook_size=SHAPE_ENTRIES)
    report = run_training_to_file(
        data, output, options, files, encoding, chosen(tuning_after, training=options, byte_cost=byte_cost),
        size_bytes=size_bytes, psnr=psnr, facts=facts, plot=plot, page=page, quiet=out.quiet,
    )  # fmt: skip
    out.remark(format_tuning_report(report["file"]))
    out.publish(report)
