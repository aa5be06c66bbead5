"""`csplat encode`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat._spec import MEASURE_NAMES, TILE_SPLATS_MAX
from csplat.encoder import PRESETS, EncodeOptions
from csplat.errors import InputError
from csplat_tools.cli.console import guarded
from csplat_tools.cli.data_options import Images, Size, TestEvery, data_options
from csplat_tools.cli.parsing import parse_colour
from csplat_tools.cli.reducing import Reducing
from csplat_tools.cli.targeting import DEFAULT_VIEWS, Looking, Targeting, target_lines
from csplat_tools.cli.ways import Ways
from csplat_tools.files.console import format_bytes, format_table, note, progress_bar, say_json
from csplat_tools.files.convert import Encoded, SceneFacts, encode_file
from csplat_tools.files.streams import STANDARD_STREAM, check_outputs

__all__ = ["encode"]

_SCENE = "What the PLY may not say"
_PRECISION = "Precision (the preset decides where nothing is given)"
_COLOUR = "Spherical harmonics"
_SHAPE = "Codebook of shapes (wants --importance of `csplat sensitivity`)"
_CODING = "Coding"
_TARGET = "Targets (all but --max-error need the render extra)"
_VIEWS = "Views for targets (virtual ones by default)"
_SIMPLE = "Simple strategies, to compare with"


@guarded
def encode(
    source: Annotated[str, typer.Argument(metavar="IN.ply", help="A 3DGS PLY, or - for standard input.")],
    target: Annotated[str, typer.Argument(metavar="OUT.csplat", help="The file to write, or - for standard output.")],
    preset: Annotated[str, typer.Option(metavar="|".join(PRESETS), help="Speed against size.")] = "balanced",
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse a PLY with defects instead of repairing it.")
    ] = False,
    keep_extra: Annotated[
        bool, typer.Option("--keep-extra", help="Carry columns that splats do not have, bit for bit.")
    ] = False,
    source_index: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.npy",
            help="Write which splat of the source each one of the file was; rows that were dropped do not count.",
        ),
    ] = None,
    importance: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="How much each splat matters, instead of opacity x size: what `csplat sensitivity` wrote, or weights"
            " (.npy) without dropped rows.",
        ),
    ] = None,
    prune_unseen: Annotated[
        bool, typer.Option("--prune-unseen", help="Leave out splats that no view of --importance saw.")
    ] = False,
    axes: Annotated[
        str | None,
        typer.Option(metavar="RDF", rich_help_panel=_SCENE, help="Directions of +x, +y, +z: R/L, U/D, F/B."),
    ] = None,
    unit_metres: Annotated[
        float | None, typer.Option(metavar="METRES", rich_help_panel=_SCENE, help="Length of one scene unit.")
    ] = None,
    antialiased: Annotated[
        bool | None,
        typer.Option("--antialiased/--no-antialiased", rich_help_panel=_SCENE, help="Trained with mip-splatting."),
    ] = None,
    licence: Annotated[
        str | None, typer.Option(metavar="TEXT", rich_help_panel=_SCENE, help="Into the metadata.")
    ] = None,
    target_size: Annotated[
        str | None,
        typer.Option(metavar="5MB", rich_help_panel=_TARGET, help="The best picture within so many bytes."),
    ] = None,
    target_psnr: Annotated[
        float | None,
        typer.Option(
            metavar="DB",
            rich_help_panel=_TARGET,
            help="The smallest file whose renders have this PSNR against the source's.",
        ),
    ] = None,
    max_error: Annotated[
        str | None,
        typer.Option(
            metavar="means=0.001,...",
            rich_help_panel=_TARGET,
            help=f"No splat errs by more, and all stay: {', '.join(MEASURE_NAMES.values())}. With mm where the unit is"
            " known.",
        ),
    ] = None,
    max_loss: Annotated[
        str | None,
        typer.Option(
            metavar="DB",
            rich_help_panel=_TARGET,
            help="The smallest file whose PSNR against the photographs of --data falls by no more than this.",
        ),
    ] = None,
    keep: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            rich_help_panel=_TARGET,
            help="This share of the splats, those that pictures need most, fitted anew; the preset says how precisely.",
        ),
    ] = None,
    keep_all: Annotated[
        bool,
        typer.Option(
            "--keep-all", rich_help_panel=_TARGET, help="The target leaves out and refits no splat: much sooner."
        ),
    ] = False,
    attribute_psnr: Annotated[
        float | None,
        typer.Option(
            metavar="DB",
            rich_help_panel=_PRECISION,
            help="PSNR that each attribute keeps by itself; that of pictures is 5 to 12 dB lower.",
        ),
    ] = None,
    position_bits: Annotated[
        int | None, typer.Option(metavar="2..16", rich_help_panel=_PRECISION, help="Bits per axis of a tile.")
    ] = None,
    position_error: Annotated[
        float | None, typer.Option(metavar="UNITS", rich_help_panel=_PRECISION, help="Largest error of a mean.")
    ] = None,
    position_step: Annotated[
        float | None, typer.Option(metavar="UNITS", rich_help_panel=_PRECISION, help="Step of the means.")
    ] = None,
    scale_step: Annotated[
        float | None, typer.Option(metavar="STEP", rich_help_panel=_PRECISION, help="Step of the log scales.")
    ] = None,
    opacity_levels: Annotated[
        int | None, typer.Option(metavar="1..65535", rich_help_panel=_PRECISION, help="Levels of opacity.")
    ] = None,
    quat_levels: Annotated[
        int | None, typer.Option(metavar="3..32767", rich_help_panel=_PRECISION, help="Levels of rotation.")
    ] = None,
    sh0_step: Annotated[
        float | None, typer.Option(metavar="STEP", rich_help_panel=_PRECISION, help="Step of the base colour.")
    ] = None,
    sh_step: Annotated[
        float | None, typer.Option(metavar="STEP", rich_help_panel=_PRECISION, help="Step of the SH bands.")
    ] = None,
    chroma_shift: Annotated[
        int | None,
        typer.Option(metavar="0..16", rich_help_panel=_PRECISION, help="Chroma is coarser by this power of two."),
    ] = None,
    adaptive: Annotated[
        float | None,
        typer.Option(metavar="0..1", rich_help_panel=_PRECISION, help="How much coarser unimportant splats may be."),
    ] = None,
    sh_degree: Annotated[
        int | None, typer.Option(metavar="0..3", rich_help_panel=_COLOUR, help="Keep the bands up to this one.")
    ] = None,
    sh_coding: Annotated[
        str, typer.Option(metavar="auto|codebook|scalar|none", rich_help_panel=_COLOUR, help="How SH is coded.")
    ] = "auto",
    codebook_size: Annotated[
        int | None, typer.Option(metavar="1..65536", rich_help_panel=_COLOUR, help="Entries of the codebook.")
    ] = None,
    codebook_stages: Annotated[
        int | None, typer.Option(metavar="1..4", rich_help_panel=_COLOUR, help="Residual stages of the codebook.")
    ] = None,
    escape_fraction: Annotated[
        float | None,
        typer.Option(metavar="0..1", rich_help_panel=_COLOUR, help="Share of splats that bypass the codebook."),
    ] = None,
    shape_codebook_size: Annotated[
        int | None,
        typer.Option(
            metavar="0..65536", rich_help_panel=_SHAPE, help="Entries at most; by default none, `finetune`: 4096."
        ),
    ] = None,
    shape_escape_fraction: Annotated[
        float | None, typer.Option(metavar="0..1", rich_help_panel=_SHAPE, help="Share with a shape of its own.")
    ] = None,
    profile: Annotated[
        str, typer.Option(metavar="base|archive", rich_help_panel=_CODING, help="Base is read everywhere.")
    ] = "base",
    means_coding: Annotated[
        str, typer.Option(metavar="auto|morton|axis", rich_help_panel=_CODING, help="How the means are coded.")
    ] = "auto",
    grades: Annotated[
        int | None,
        typer.Option(
            metavar="1..5",
            rich_help_panel=_PRECISION,
            help="Sort splats into so many grades at most, each with steps of its own, by what pictures lose: a target"
            " measures it, or --importance says it. 1 for one precision throughout.",
        ),
    ] = None,
    tile_splats: Annotated[
        int, typer.Option(metavar="1..65536", rich_help_panel=_CODING, help="Splats of a tile at most.")
    ] = TILE_SPLATS_MAX,
    effort: Annotated[int | None, typer.Option(metavar="1..12", rich_help_panel=_CODING, help="DEFLATE level.")] = None,
    deflate: Annotated[
        str, typer.Option(metavar="auto|libdeflate|zlib", rich_help_panel=_CODING, help="Which library deflates.")
    ] = "auto",
    seed: Annotated[int, typer.Option(min=0, rich_help_panel=_CODING, help="Seed of the clustering.")] = 0,
    threads: Annotated[
        int | None,
        typer.Option(min=1, rich_help_panel=_CODING, help="Threads, one per core by default; the bytes stay the same."),
    ] = None,
    prune_opacity: Annotated[
        float | None, typer.Option(metavar="ALPHA", rich_help_panel=_SIMPLE, help="Leave out splats up to this alpha.")
    ] = None,
    distil_sh: Annotated[
        bool,
        typer.Option("--distil-sh", rich_help_panel=_SIMPLE, help="Fit --sh-degree to renders instead of cutting off."),
    ] = False,
    kmeans: Annotated[
        str | None,
        typer.Option(
            metavar="256|means=4096,...",
            rich_help_panel=_SIMPLE,
            help="Cluster attributes: entries of each, or below 1 the share of its variance that may be lost.",
        ),
    ] = None,
    residual_stages: Annotated[
        int | None, typer.Option(metavar="1..4", rich_help_panel=_SIMPLE, help="Codebooks one after the other.")
    ] = None,
    cameras: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.json",
            rich_help_panel=_VIEWS,
            help="Cameras that judge; of 40 or more every fourth does, the others teach and decide.",
        ),
    ] = None,
    data: Annotated[
        str | None,
        typer.Option(
            metavar="DATA",
            rich_help_panel=_VIEWS,
            help="A data set: views of its training teach and decide, held-out ones judge.",
        ),
    ] = None,
    size: Size = None,
    images: Images = None,
    test_every: TestEvery = None,
    background: Annotated[
        str | None,
        typer.Option(
            metavar="R,G,B",
            rich_help_panel=_VIEWS,
            help="Behind the scene: black, but with --data or --cameras as in training.",
        ),
    ] = None,
    views: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            rich_help_panel=_VIEWS,
            help=f"Virtual views that teach, at most; {DEFAULT_VIEWS} by default.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report on standard output, for programs.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing unless something is wrong.")] = False,
) -> None:
    r"""Compress a trained 3DGS scene.

    Reads the PLY of any 3DGS trainer, repairs what is safe to repair (and
    says so), and states in the file how far its splats lie from the source.

    A target asks for the smallest file that reaches a PSNR, or the best one
    of a size: precision, coding of colours, grades, and how many splats stay
    are chosen, and what stays is fitted to what the scene looks like. That
    takes minutes; --keep-all leaves all splats as they are and is sooner.
    --preset fast and --max-error leave them, too. Splats are fitted in views
    that teach, files compared in views that decide, and the result is scored
    in views that judge; for --target-psnr these say how precise it has to be.

    Examples:
      csplat encode scene.ply scene.csplat
      csplat encode scene.ply scene.csplat --preset small --sh-degree 2
      csplat encode scene.ply scene.csplat --source-index scene.npy && \
        csplat verify scene.csplat --source scene.ply --source-index scene.npy
      csplat sensitivity scene.ply scene.npz --data photographs && \
        csplat encode scene.ply scene.csplat --importance scene.npz
      csplat encode scene.ply scene.csplat --target-psnr 40
      csplat encode scene.ply scene.csplat --target-psnr 42 --keep-all
      csplat encode scene.ply scene.csplat --target-size 5MB
      csplat encode scene.ply scene.csplat --keep 0.5
      csplat encode scene.ply scene.csplat --max-loss 0.3dB --data photographs
      csplat encode scene.ply scene.csplat --max-error means=0.001,sh0=0.02
      csplat encode scene.ply scene.csplat --prune-opacity 0.005 --sh-degree 0
      gunzip -c scene.ply.gz | csplat encode - - | wc -c
    """
    try:
        options = EncodeOptions(
            preset=preset,
            attribute_psnr=attribute_psnr,
            profile=profile,
            position_bits=position_bits,
            position_step=position_step,
            position_error=position_error,
            means_coding=means_coding,
            scale_step=scale_step,
            opacity_levels=opacity_levels,
            quat_levels=quat_levels,
            sh0_step=sh0_step,
            sh_step=sh_step,
            chroma_shift=chroma_shift,
            sh_degree=sh_degree,
            sh_coding=sh_coding,
            codebook_size=codebook_size,
            codebook_stages=codebook_stages,
            escape_fraction=escape_fraction,
            shape_codebook_size=shape_codebook_size,
            shape_escape_fraction=shape_escape_fraction,
            adaptive=adaptive,
            grades=grades,
            tile_splats=tile_splats,
            effort=effort,
            deflate=deflate,
            keep_extra=keep_extra,
            seed=seed,
            threads=threads,
        )
    except InputError as error:
        raise typer.BadParameter(str(error)) from None
    colour = None if background is None else parse_colour(background)
    looking = Looking(cameras, data_options(data, size, images, test_every), colour, views or DEFAULT_VIEWS)
    ways = Ways(
        options,
        Targeting(target_size, target_psnr, max_loss, keep, max_error, keep_all, importance, looking),
        Reducing(prune_opacity, distil_sh, kmeans, residual_stages, looking, sh_degree, seed, threads),
        prune_unseen,
        views_given=views is not None,
    )
    encoder = ways.encoder(quiet=quiet)
    if as_json and target == STANDARD_STREAM:
        raise typer.BadParameter("--json and - both want standard output")
    if source_index == STANDARD_STREAM:
        raise typer.BadParameter("--source-index wants the name of a file")
    check_outputs((target, source_index), force=force, inputs=(source, importance, cameras))
    with progress_bar(quiet=quiet) as progress:
        encoded = encode_file(
            source,
            target,
            options,
            facts=SceneFacts(axes, unit_metres, antialiased, licence),
            strict=strict,
            importance=importance,
            prune_unseen=prune_unseen,
            source_index=source_index,
            encoder=encoder,
            progress=progress,
        )
    if as_json:
        say_json(encoded.as_json())
    else:
        for finding in encoded.findings:
            if not quiet or finding.kind == "repair":
                note(str(finding))
        for line in encoded.result.report.notes:
            note(line)
        if not quiet:
            _report(encoded)


def _report(encoded: Encoded) -> None:
    report = encoded.result.report
    for line in target_lines(encoded.made.said) if encoded.made.key == "target" else ():
        note(line)
    per_splat = f", {report.size_bytes / report.splat_count:.2f} bytes per splat" if report.splat_count else ""
    ratio = encoded.source_bytes / report.size_bytes
    note(
        f"{report.splat_count} splats in {report.tile_count} tiles: {format_bytes(encoded.source_bytes)} ->"
        f" {format_bytes(report.size_bytes)} ({ratio:.1f} times smaller{per_splat}), {encoded.seconds:.2f} s"
    )
    if report.errors:
        names = sorted(report.errors, key=list(MEASURE_NAMES.values()).index)
        rows = [(name, *(f"{value:.4g}" for value in report.errors[name])) for name in names]
        note(format_table(("stated error", "max", "rms"), rows))
