"""`csplat simplify`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from csplat.errors import counted
from csplat_tools.cli.command_output import Output
from csplat_tools.cli.shared_options import (
    Cameras,
    Data,
    Effort,
    Force,
    HelpAll,
    Json,
    Keep,
    MaxPsnrDrop,
    Quiet,
    Report,
    SceneArgument,
    TargetPsnr,
    Up,
    ViewOptions,
    check_range,
    checked,
    parse_decibels,
    parse_overrides,
    refuse_together,
    require_one,
)
from csplat_tools.console import format_table
from csplat_tools.file_streams import check_name, write_model
from csplat_tools.optional_packages import prepare_renderer, require_renderer
from csplat_tools.scene_files import load_model

#: Cost in renders of all training views: for --keep (measured: donut 9, plane3 19), and for a target, which searches
#: for the share to keep (20 and 45); half of the cost is fitting.
_PASSES = (20.0, 45.0)


def simplify(
    source: SceneArgument,
    output: Annotated[str, typer.Argument(metavar="OUT.ply", help="The PLY to write, or -.")],
    keep: Keep = None,
    target_psnr: TargetPsnr = None,
    max_psnr_drop: MaxPsnrDrop = None,
    effort: Effort = None,
    cameras: Cameras = None,
    data: Data = None,
    up: Up = None,
    force: Force = False,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
    _all: HelpAll = False,
) -> None:
    """Prune splats that no render needs, and refit the others.

    One of --keep, --target-psnr and --max-psnr-drop is required. Splats are
    fitted to training views, validation views decide how many are kept, and
    test views score the result. `csplat encode` with a target does the same
    for the file that it writes. Requires the render extra.

    Examples:
      csplat simplify scene.ply half.ply --keep 0.5
      csplat simplify scene.ply small.ply --target-psnr 40
      csplat simplify scene.ply small.ply --max-psnr-drop 0.3dB --data capture
    """
    out = Output(force, report, as_json, quiet)
    views, overrides = ViewOptions(cameras, data), parse_overrides(up)
    refuse_together({"--keep": keep, "--target-psnr": target_psnr, "--max-psnr-drop": max_psnr_drop})
    require_one({"--max-psnr-drop": max_psnr_drop}, {"--data": data})
    check_range("--effort", effort, 1, 9)
    require_renderer()
    import csplat_tools
    from csplat_tools.optimise.pruning_order import SimplifyOptions
    from csplat_tools.optimise.targets import Target
    from csplat_tools.views import shrink_cameras
    from csplat_tools.views.view_sets import total_render_seconds

    psnr, drop = parse_decibels(target_psnr, "--target-psnr"), parse_decibels(max_psnr_drop, "--max-psnr-drop")
    checked(Target, psnr=psnr, max_psnr_drop=drop, keep=keep)  # before anything is read
    options = SimplifyOptions() if effort is None else SimplifyOptions(effort=effort)
    out.check(output, inputs=(source, *views.inputs))
    check_name(output, ".ply", "simplify", source)
    with out.bar() as progress:
        read = load_model(source)
        out.print_findings(read.findings)
        model = overrides.apply(read.model)
        prepare_renderer(quiet=out.quiet, simplify=True)
        around = views.find(model, out)
        passes = _PASSES[keep is None] * (0.5 + 0.5 * options.work)
        size = options.views_and_size(len(model))[1]
        out.announce_time(
            lambda: passes * total_render_seconds(model, shrink_cameras(around.training, size)),
            "--effort 1 takes less",
        )
        result = csplat_tools.simplify(
            model, keep=keep, psnr=psnr, max_psnr_drop=drop, views=around, options=options, progress=progress
        )
    write_model(output, result.model, absolute=False)
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
