"""`csplat finetune`."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat_tools.cli.console import guarded
from csplat_tools.cli.data_options import Images, Near, Size, TestEvery, data_options
from csplat_tools.cli.encoder_knobs import with_encoder_knobs
from csplat_tools.cli.parsing import parse_colour, parse_size
from csplat_tools.files.console import note, say_json
from csplat_tools.files.convert import SceneFacts
from csplat_tools.files.extras import need_trainer
from csplat_tools.files.streams import STANDARD_STREAM, check_output, check_outputs
from csplat_tools.views import find_view_set

__all__ = ["finetune"]

_LIKE = "What the file is to look like (one of --data and --self)"
_FILES = "Files on the way"
_HOW = "How"
_RENDERS_ASIDE = 8  # one of so many renders decides, as well as those that teach,
_MOST_ASIDE = 16  # but no more than these


@guarded
@with_encoder_knobs
def finetune(
    source: Annotated[str, typer.Argument(metavar="IN.ply", help="A trained 3DGS scene.")],
    encoding: EncodeOptions,
    facts: SceneFacts,
    strict: bool,
    output: Annotated[str, typer.Option("--output", "-o", metavar="OUT.csplat", help="The file to write.")],
    data: Annotated[
        str | None,
        typer.Option(
            metavar="DATA",
            rich_help_panel=_LIKE,
            help="Posed photographs: those of the training teach, those held out judge.",
        ),
    ] = None,
    itself: Annotated[
        bool, typer.Option("--self", rich_help_panel=_LIKE, help="The scene's own renders, from all around.")
    ] = False,
    size: Size = None,
    images: Images = None,
    test_every: TestEvery = None,
    near: Near = None,
    cameras: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.json",
            rich_help_panel=_LIKE,
            help="With --self: cameras that judge; of 40 or more most teach instead.",
        ),
    ] = None,
    views: Annotated[
        int,
        typer.Option(
            metavar="N", min=1, rich_help_panel=_LIKE, help="With --self: virtual views that teach; 16 more do."
        ),
    ] = 480,
    view_size: Annotated[
        str, typer.Option(metavar="WxH", rich_help_panel=_LIKE, help="With --self: of the virtual views.")
    ] = "320x240",
    background: Annotated[
        str | None,
        typer.Option(
            metavar="R,G,B",
            rich_help_panel=_LIKE,
            help="Behind the scene: black, but with --data or --cameras as in training.",
        ),
    ] = None,
    aside: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=0,
            rich_help_panel=_LIKE,
            help="Views that decide which step was best, and do not teach; 0: with --data some that teach decide, with"
            " --self a few others.",
        ),
    ] = 0,
    keep: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            rich_help_panel=_HOW,
            help="First leave only this share of the splats, those that pictures need most.",
        ),
    ] = None,
    prune_unseen: Annotated[
        bool | None,
        typer.Option(
            "--prune-unseen/--keep-unseen",
            rich_help_panel=_HOW,
            help="Leave out splats that no view shows; by default with --data.",
        ),
    ] = None,
    importance: Annotated[
        str | None,
        typer.Option(
            metavar="FILE", rich_help_panel=_HOW, help="As for `encode`; by default sensitivities are measured here."
        ),
    ] = None,
    iterations: Annotated[
        int, typer.Option(metavar="N", min=1, rich_help_panel=_HOW, help="Steps at most, one picture each.")
    ] = 1_000,
    lr_factor: Annotated[
        float | None,
        typer.Option(
            metavar="FACTOR",
            rich_help_panel=_HOW,
            help="Multiplies all learning rates; by default 1, with --self 0.03.",
        ),
    ] = None,
    byte_cost: Annotated[
        float | None,
        typer.Option(
            metavar="COST",
            rich_help_panel=_HOW,
            help="What a bit per splat weighs in the loss; by default 1e-4, with --self 2e-5; 0: nothing.",
        ),
    ] = None,
    patience: Annotated[
        int,
        typer.Option(
            metavar="N", min=0, rich_help_panel=_HOW, help="Stop after so many late looks without a gain; 0: never."
        ),
    ] = 4,
    lpips: Annotated[
        str | None, typer.Option(metavar="WEIGHTS.npz", help="Report LPIPS (Alex) with these weights, or `auto`.")
    ] = None,
    source_index: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.npy", rich_help_panel=_FILES, help="Write which splat of the source each one of the file was."
        ),
    ] = None,
    report: Annotated[
        str | None, typer.Option(metavar="FILE.json", rich_help_panel=_FILES, help="What came of it, for programs.")
    ] = None,
    log: Annotated[
        str | None,
        typer.Option(
            "--json",
            metavar="LOG",
            rich_help_panel=_FILES,
            help="Write options, losses and what each look at the views found.",
        ),
    ] = None,
    checkpoint: Annotated[
        str | None, typer.Option(metavar="FILE.npz", rich_help_panel=_FILES, help="Where checkpoints go.")
    ] = None,
    checkpoint_every: Annotated[
        int, typer.Option(metavar="N", min=0, rich_help_panel=_FILES, help="Steps; 0: at the end alone.")
    ] = 0,
    resume: Annotated[
        str | None, typer.Option(metavar="FILE.npz", rich_help_panel=_FILES, help="Go on from this checkpoint.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    as_text: Annotated[
        bool, typer.Option("--say-json", help="Write the report to standard output, for programs.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing unless something is wrong.")] = False,
) -> None:
    """Compress a scene, and tune what the file holds until it looks right.

    How much the views depend on each splat is measured; by that the encoder
    decides lattices, tiles and codebooks, once. Then the values move, seen
    through the encoder's own quantisers, until pictures of what a decoder
    will see look like the photographs; without photographs, like the scene
    itself. What looks best for its bytes is written. Needs the packages of
    the render extra.

    Examples:
      csplat finetune scene.ply --data capture -o scene.csplat --preset small
      csplat finetune scene.ply --data capture -o scene.csplat --attribute-psnr 40 --report scene.json
      csplat finetune scene.ply --data capture -o scene.csplat --keep 0.5
      csplat finetune scene.ply --self -o scene.csplat
      csplat finetune scene.ply --data capture -o scene.csplat --checkpoint run.npz --resume run.npz
    """
    need_trainer()
    from csplat_tools.training.finetune import BYTE_COST, LEARNING_FACTOR, SHAPE_ENTRIES, Files, Scene, run_finetuning
    from csplat_tools.training.report import format_report
    from csplat_trainer.finetune.options import FinetuneOptions

    if (data is None) != itself:
        raise typer.BadParameter("wanted one of --data and --self")
    if keep is not None and not 0.0 < keep <= 1.0:
        raise typer.BadParameter(f"--keep is {keep:g}, wanted a share above 0, at most 1")
    if data is not None and cameras is not None:
        raise typer.BadParameter("--cameras goes with --self")
    photographs = data_options(data, size, images, test_every, near)
    colour = None if background is None else parse_colour(background)
    try:
        options = FinetuneOptions(
            iterations=iterations,
            seed=encoding.seed,
            byte_cost=BYTE_COST[itself] if byte_cost is None else byte_cost,
            patience=patience,
        ).scaled(LEARNING_FACTOR[itself] if lr_factor is None else lr_factor)
    except InputError as error:
        raise typer.BadParameter(str(error)) from None
    if STANDARD_STREAM in (source_index, report, log, checkpoint):
        raise typer.BadParameter("--source-index, --report, --json and --checkpoint want names of files")
    if as_text and output == STANDARD_STREAM:
        raise typer.BadParameter("--say-json and - both want standard output")
    for path in (resume, importance):
        if path is not None:
            Path(path).stat()  # an OSError that names it, before the minutes that views and splats may take
    # A checkpoint may take the place of the one that it goes on from.
    again = None not in (checkpoint, resume) and Path(str(checkpoint)).resolve() == Path(str(resume)).resolve()
    inputs = (source, importance, cameras, None if lpips == "auto" else lpips)
    outputs = (output, source_index, report, log, None if again else checkpoint)
    check_outputs(outputs, force=force, inputs=(*inputs, resume))
    if again:
        check_output(str(checkpoint), force=True, inputs=tuple(path for path in inputs if path is not None))
    find = partial(
        find_view_set, cameras=cameras, data=photographs, background=colour, count=views, size=parse_size(view_size),
        aside=aside or _usually_aside(data, cameras, views),
    )  # fmt: skip
    files = Files(source, output, importance, source_index, log, report, checkpoint, checkpoint_every, resume, lpips)
    scene = Scene(facts, strict)
    if encoding.shape_codebook_size is None:
        encoding = replace(encoding, shape_codebook_size=SHAPE_ENTRIES)
    found = run_finetuning(files, scene, encoding, find, options, keep=keep, prune_unseen=prune_unseen, quiet=quiet)
    if as_text:
        say_json(found)
    elif not quiet:
        note(format_report(found))


def _usually_aside(data: str | None, cameras: str | None, views: int) -> int | None:
    """How many views decide which step was best: of photographs some that teach do, of few virtual views few."""
    if data is not None:
        return 0
    return min(_MOST_ASIDE, views // _RENDERS_ASIDE) if cameras is None else None
