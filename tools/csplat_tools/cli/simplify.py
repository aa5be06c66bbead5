"""`csplat simplify`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

import typer

from csplat.errors import counted
from csplat_tools.cli.command import LibrarySettings, OutputOptions, chosen, command
from csplat_tools.cli.shared_options import (
    EFFORT,
    OrientationOptions,
    SceneArgument,
    Seed,
    SourceIndex,
    Threads,
    ViewOptions,
    VirtualViewOptions,
    parse_decibels,
)
from csplat_tools.console import format_table
from csplat_tools.file_streams import check_name, write_array, write_model
from csplat_tools.optional_packages import prepare_renderer, require_renderer
from csplat_tools.scene_files import load_model

_TARGET = "Target (one of them)"
#: Cost in renders of all training views: for --keep (measured: donut 9, plane3 19), and for a target, which searches
#: for the share to keep (20 and 45); half of the cost is fitting.
_PASSES = (20.0, 45.0)
_OPTIONS = "csplat_tools.optimise.pruning_order:SimplifyOptions"


@command(
    reads=True,
    one_of=(("keep", "target_psnr", "max_psnr_drop"),),
    needs={"max_psnr_drop": ("data",)},
    settings=(_OPTIONS,),
)
def simplify(
    source: SceneArgument,
    output: Annotated[str, typer.Argument(metavar="OUT.ply", help="The PLY to write, or -.")],
    views: ViewOptions,
    virtual: VirtualViewOptions,
    upright: OrientationOptions,
    out: OutputOptions,
    settings: LibrarySettings,
    keep: Annotated[
        float | None, typer.Option(metavar="SHARE", rich_help_panel=_TARGET, help="Share of the splats to keep.")
    ] = None,
    target_psnr: Annotated[
        str | None,
        typer.Option(
            metavar="DB", rich_help_panel=_TARGET, help="Least PSNR of the validation views against source renders."
        ),
    ] = None,
    max_psnr_drop: Annotated[
        str | None,
        typer.Option(
            metavar="DB", rich_help_panel=_TARGET, help="Largest drop of the PSNR against the photographs of --data."
        ),
    ] = None,
    effort: Annotated[int, typer.Option(**EFFORT)] = 3,
    seed: Seed = 0,
    threads: Threads = None,
    source_index: SourceIndex = None,
) -> None:
    """Prune splats that no render needs, and refit the others.

    The error that pruning each splat causes is measured exactly, in many small
    views from all around, and again as splats are pruned. Then colours, opacities,
    scales and rotations of the others are fitted to the source's renders in the
    training views. Validation views decide how many splats are kept, and test
    views score the result. Only --max-psnr-drop requires photographs. `csplat
    encode` with a target does all this for the file that it writes. Requires the
    packages of the render extra.

    Examples:
      csplat simplify scene.ply half.ply --keep 0.5
      csplat simplify scene.ply small.ply --target-psnr 40 --report small.json
      csplat simplify scene.ply small.ply --max-psnr-drop 0.3dB --data capture
    """
    require_renderer()
    import csplat_tools
    from csplat_tools.optimise.pruning_order import SimplifyOptions
    from csplat_tools.optimise.targets import Target
    from csplat_tools.views import shrink_cameras
    from csplat_tools.views.view_sets import total_render_seconds

    drop = None if max_psnr_drop is None else parse_decibels(max_psnr_drop)
    psnr = None if target_psnr is None else parse_decibels(target_psnr)
    chosen(Target, psnr=psnr, max_psnr_drop=drop, keep=keep)  # before anything is read
    options = chosen(SimplifyOptions, **settings.of(SimplifyOptions), effort=effort, seed=seed, threads=threads)
    out.check(output, inputs=(source, *views.inputs), named={"--source-index": source_index})
    check_name(output, ".ply", "simplify", source)
    read = load_model(source)
    out.print_findings(read.findings)
    model = upright.overrides().apply(read.model)
    prepare_renderer(quiet=out.quiet, simplify=True)
    given = virtual.given()
    around = views.find(model, out, seed=seed, **given)
    options = replace(options, view_size=given.get("size"))
    passes = _PASSES[keep is None] * (0.5 + 0.5 * options.work)
    out.announce_time(
        lambda: (
            passes * total_render_seconds(model, shrink_cameras(around.training, options.views_and_size(len(model))[1]))
        ),
        "fewer or smaller views take less: --help-all",
    )
    with out.bar() as progress:
        result = csplat_tools.simplify(
            model, keep=keep, psnr=psnr, max_psnr_drop=drop, views=around, options=options, progress=progress
        )
    write_model(output, result.model, absolute=False)
    if source_index is not None:
        write_array(source_index, result.source_index)
    out.remark(*_lines(result.report))
    out.publish(result.report)


def _lines(report: Mapping[str, Any]) -> list[str]:
    removed, views = report["removed"], report["views"]
    before, after = report["splats_before"], report["splats"]
    pruned = (
        f"{removed['invisible']} too faint to be drawn, {removed['unseen']} unseen,"
        f" {removed['least_error']} that renders need least"
    )
    size = f"{views['size'][0]}x{views['size'][1]}"
    unseen = f"{100.0 * report['unseen_share']:.1f} % of the splats were seen by none"
    lines = [
        f"{before:,} -> {counted(after, 'splat')} ({100.0 * after / before:.1f} %); pruned: {pruned}",
        f"measured in {counted(views['used'], 'view')} of {size}, checked in {views['check']} others; {unseen}",
    ]
    rows = [("the other views, before the fit", f"{report['check_psnr_pruned']:.2f}")]
    rows.append(("the other views, fitted", f"{report['check_psnr']:.2f}"))
    if "validation_psnr" in report:
        rows.append(("validation views", f"{report['validation_psnr']:.2f}"))
    if "psnr" in report:
        rows.append((f"{report['test_views']['views']} test views", f"{report['psnr']:.2f}"))
    if "photographs" in report:
        scores = report["photographs"]
        rows.append(("held-out photographs, source", f"{scores['source']:.2f}"))
        rows.append(("held-out photographs", f"{scores['psnr']:.2f}"))
    lines.append(format_table(("PSNR", "dB"), rows))
    if report["zero_bands"]:
        shares = [f"{band}: {100.0 * count / after:.0f} %" for band, count in report["zero_bands"].items()]
        lines.append(f"splats without SH band {', '.join(shares)}")
    return lines
