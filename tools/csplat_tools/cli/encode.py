# SPDX-License-Identifier: Apache-2.0
"""`csplat encode`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

import csplat
from csplat.context import Context
from csplat.decoder import read_header
from csplat.encoder import EncodeOptions, Target
from csplat.errors import SearchInterrupted
from csplat.model import SplatModel
from csplat.out_of_core import estimate_cost
from csplat.scene import Scene
from csplat.scene_metadata import UP
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output, default_output
from csplat_tools.console import note
from csplat_tools.encode_file import (
    EncodedFile,
    describe_wait,
    encode_file,
    format_cost,
    format_encoding,
    read_degree,
)
from csplat_tools.file_streams import check_name, source_path
from csplat_tools.level_builder import LevelCount, choose_levels
from csplat_tools.optional_packages import require_renderer
from csplat_tools.scene_files import read_source
from csplat_tools.views import ViewSet


def encode(
    source: Annotated[str, typer.Argument(metavar="IN.ply", help="A PLY, another format of `convert`, or -.")],
    output: Annotated[
        str | None, typer.Argument(metavar="OUT.csplat", help="The file to write, or -. Default: IN.csplat.")
    ] = None,
    preset: shared.Preset = "balanced",
    sh_degree: shared.ShDegree = None,
    target_psnr: shared.TargetPsnr = None,
    target_size: shared.TargetSize = None,
    max_psnr_drop: shared.MaxPsnrDrop = None,
    max_error: Annotated[str | None, typer.Option(metavar="NAME=MAX", help="E.g. means=0.001,sh0=0.02, or 0.")] = None,
    no_prune: Annotated[bool, typer.Option("--no-prune", help="Targets keep all splats unchanged.")] = False,
    data: shared.Data = None,
    levels: Annotated[
        str | None, typer.Option(metavar="LEVELS", help="auto, merged, 1 to 16, or none. Default: none.")
    ] = None,
    up: shared.HiddenUp = None,
    attribute_psnr: Annotated[
        float | None, typer.Option(metavar="DB", hidden=True, help="PSNR of each attribute. Default: by preset.")
    ] = None,
    keep: shared.HiddenKeep = None,
    effort: shared.HiddenEffort = None,
    cameras: Annotated[
        str | None,
        typer.Option("--cameras", metavar="FILE.json", hidden=True, help="First view; with a target, its views."),
    ] = None,
    background: shared.HiddenBackground = None,
    importance: Annotated[
        str | None, typer.Option(metavar="FILE", hidden=True, help="File of `csplat sensitivity`, or .npy weights.")
    ] = None,
    source_index: shared.SourceIndexOutput = None,
    memory: shared.HiddenMemory = None,
    resume: Annotated[bool, typer.Option("--resume", hidden=True, help="Go on from OUT.csplat.work.")] = False,
    scheduler: shared.HiddenScheduler = None,
    dry_run: shared.HiddenDryRun = False,
    keep_extra: Annotated[
        bool, typer.Option("--keep-extra", hidden=True, help="Keep columns that splats do not have.")
    ] = False,
    unit_metres: Annotated[
        float | None, typer.Option(metavar="METRES", hidden=True, help="Length of a scene unit. Default: unknown.")
    ] = None,
    antialiased: Annotated[
        bool, typer.Option("--antialiased", hidden=True, help="The scene was trained with mip-splatting.")
    ] = False,
    licence: Annotated[
        str | None, typer.Option(metavar="TEXT", hidden=True, help="Licence of the scene. Default: none.")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(metavar="N", min=1, hidden=True, help="Threads. Default: one per core.")
    ] = None,
    read_as: shared.ReadAs = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Compress a trained 3DGS scene.

    The file declares its largest errors. --preset: fast for previews, balanced
    for archives, small if size matters more than precision. One of
    --target-psnr, --target-size, --max-psnr-drop (with --data) and --keep
    chooses the precision and prunes splats; it goes on as long as it expects to
    save 1 % of the bytes per 10 CPU seconds, and Ctrl-C takes the best file so
    far that meets the target. --max-error limits errors of means, covariance,
    opacities, sh0 to sh4; --max-error 0 keeps the values of SPZ. Views are
    virtual without --data, which requires the render extra, or --cameras.
    --levels adds coarser versions of the scene, which viewers show first: a
    third more bytes, and minutes; merged takes a sixth of the time, and looks
    worse. --help-all shows --keep, --cameras, --up and all others.

    Examples:
      csplat encode scene.ply scene.csplat
      csplat encode scene.ply scene.csplat --preset small --sh-degree 2
      csplat encode scene.ply scene.csplat --target-size 5MB --no-prune
      csplat encode scene.ply scene.csplat --max-error means=0.001,sh0=0.02
    """
    out, output = Output(force, report, as_json, quiet), default_output(output, source, ".csplat")
    views = shared.ViewOptions(cameras, data, background)
    precision = {"--target-psnr": target_psnr, "--target-size": target_size, "--max-psnr-drop": max_psnr_drop}
    rendered = {**precision, "--keep": keep}
    targets = {**rendered, "--max-error": max_error}
    whole = {**targets, "--importance": importance, "--source-index": source_index}
    out_of_core = {"--memory": memory, "--resume": resume, "--scheduler": scheduler, "--dry-run": dry_run}
    shared.refuse_together(rendered)
    shared.refuse_together({"--attribute-psnr": attribute_psnr}, precision)
    shared.refuse_together({"--keep": keep}, {"--no-prune": no_prune, "--importance": importance})
    shared.refuse_together({"--effort": effort}, {"--no-prune": no_prune})
    shared.refuse_together(out_of_core, whole)
    shared.require_one({"--max-psnr-drop": max_psnr_drop}, {"--data": data})
    shared.require_one({"--no-prune": no_prune}, {**precision, "--max-error": max_error})
    shared.require_one({"--effort": effort, "--background": background, "--data": data}, rendered)
    shared.require_one({"--background": background}, {"--cameras": cameras, "--data": data})
    shared.parse_sh_degree(sh_degree)
    options = shared.checked(
        EncodeOptions, preset=preset, sh_degree=sh_degree, attribute_psnr=attribute_psnr, keep_extra=keep_extra
    )
    first_view = cameras if all(value is None for value in rendered.values()) else None
    target = shared.parse_target(
        psnr=target_psnr, size=target_size, max_psnr_drop=max_psnr_drop, keep=keep, max_error=max_error,
        prune=not no_prune, effort=effort,
    )  # fmt: skip
    level_count = shared.parse_levels(levels)
    overrides = shared.parse_overrides(up, unit_metres=unit_metres, antialiased=antialiased or None, licence=licence)
    with out.bar() as progress:
        context = shared.checked(
            Context, threads=threads, workers=scheduler, memory=memory, resume=resume, progress=progress
        )
        if dry_run:
            _publish_estimate(source, read_as, options, context, level_count, out)
            return
        out.check(output, inputs=(source, importance, *views.inputs), named={"--source-index": source_index})
        check_name(output, ".csplat", "encode", source)
        scene: str | Scene = source
        view_set = None
        if target is not None:
            if target.is_rendered:
                require_renderer()
            scene = read_source(
                source, overrides, format=read_as, keep_extra=keep_extra, sh_degree=read_degree(options),
                context=context,
            )  # fmt: skip
            if max_error is not None:
                target = replace(target, max_error=shared.parse_max_error(max_error, scene.metadata.unit_metres))
            if target.is_rendered:
                view_set = _find_views(source, scene.model(), options, target, views, level_count, out, context)
        try:
            encoded = encode_file(
                scene, output, options, target=target, views=view_set, overrides=overrides, importance=importance,
                source_index=source_index, levels=level_count, first_view=first_view, format=read_as,
                context=context,
            )  # fmt: skip
        except SearchInterrupted as interrupt:
            if interrupt.best is not None:
                _publish_encoded(interrupt.best, source, output, out)
            raise
        _publish_encoded(encoded, source, output, out)


def _publish_encoded(encoded: EncodedFile, source: str, output: str, out: Output) -> None:
    """Print findings, notes, the search and lines on sizes, and write the report.

    Args:
        encoded: the written file.
        source, output: names of the files.
        out: where to print.
    """
    report = encoded.result.report
    out.print_findings(encoded.source.findings)
    for line in report.notes:
        note(line)
    if report.search is not None:
        from csplat_tools.optimise.search_report import format_search

        out.remark(*format_search(report.search))
    metadata = encoded.source.metadata
    if UP in metadata.estimated and metadata.up is not None:
        out.remark(f"{shared.describe_estimated_up(metadata.up)}, and stored as such: --up sets another")
    out.remark(*format_encoding(encoded, source, output))
    data = encoded.result.content
    out.remark(*describe_wait(read_header(output if data is None else data)))
    out.publish(encoded.as_json())


def _publish_estimate(
    source: str, read_as: str | None, options: EncodeOptions, context: Context, levels: LevelCount, out: Output
) -> None:
    """Report memory, disk space and time that an encoding would take; writes no .csplat file."""
    with source_path(source) as local, csplat.open(local, read_as, sh_degree=read_degree(options)) as scene:
        cost = estimate_cost(scene, options, context, choose_levels(scene.count, options, levels))
    out.publish(cost.as_json(), format_cost(cost))


def _find_views(
    source: str,
    model: SplatModel,
    options: EncodeOptions,
    target: Target,
    views: shared.ViewOptions,
    levels: LevelCount,
    out: Output,
    context: Context,
) -> ViewSet:
    """Find the views of a scene, and announce how long the search will take."""
    from csplat_tools.optimise.target_encoding import expected_search_seconds

    context.progress("placing views", 0.0)
    view_set = views.find(model, out, source)
    if len(model) and view_set.test:
        may_prune = target.prune and target.keep is None
        out.announce_time(
            lambda: expected_search_seconds(
                model, options, target, view_set, has_levels=levels is not None, context=context
            ),
            "--no-prune takes less than half of that, a preset seconds" if may_prune else "a preset takes seconds",
        )
    context.progress("placing views", 1.0)
    return view_set
