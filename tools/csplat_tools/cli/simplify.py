# SPDX-License-Identifier: Apache-2.0
"""`csplat simplify`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat.context import Context
from csplat.errors import SearchInterrupted
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.file_streams import check_name, write_model
from csplat_tools.inspect.text_reports import format_simplification
from csplat_tools.optional_packages import require_renderer
from csplat_tools.scene_files import load_scene


def simplify(
    source: shared.SceneArgument,
    output: Annotated[str, typer.Argument(metavar="OUT.ply", help="The PLY to write, or -.")],
    keep: shared.Keep = None,
    target_psnr: shared.TargetPsnr = None,
    max_psnr_drop: shared.MaxPsnrDrop = None,
    effort: shared.Effort = None,
    cameras: shared.Cameras = None,
    data: shared.Data = None,
    up: shared.Up = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Prune splats that no render needs, and refit the others.

    Splats are fitted to training views, validation views decide how many are
    kept, and test views score the result. --max-psnr-drop requires --data.
    `csplat encode` with a target does the same for the file that it writes.
    Ctrl-C takes the fewest splats so far that meet the target. --data requires
    the render extra.

    Examples:
      csplat simplify scene.ply half.ply --keep 0.5
      csplat simplify scene.ply small.ply --target-psnr 40
      csplat simplify scene.ply small.ply --max-psnr-drop 0.3dB --data capture
    """
    out = Output(force, report, as_json, quiet)
    views, overrides = shared.ViewOptions(cameras, data), shared.parse_overrides(up)
    shared.refuse_together({"--keep": keep, "--target-psnr": target_psnr, "--max-psnr-drop": max_psnr_drop})
    shared.require_one({"--max-psnr-drop": max_psnr_drop}, {"--data": data})
    target = shared.parse_target(psnr=target_psnr, max_psnr_drop=max_psnr_drop, keep=keep, effort=effort)
    if target is None:
        raise typer.BadParameter("expected --keep, --target-psnr or --max-psnr-drop")
    require_renderer()
    import csplat_tools
    from csplat_tools.optimise.search_plan import plan_seconds, simplify_plan
    from csplat_tools.optimise.simplify import SimplifyOptions

    options = SimplifyOptions(effort=target.effort)
    out.check(output, inputs=(source, *views.inputs))
    check_name(output, ".ply", "simplify", source)
    with out.bar() as progress:
        read = load_scene(source)
        out.print_findings(read.findings)
        model = overrides.apply_to_model(read.model())
        progress("placing views", 0.0)
        view_set = views.find(model, out, source)
        plan = simplify_plan(options.pruner(model, view_set), target)
        out.announce_time(lambda: plan_seconds(plan, model, view_set), "--effort 1 takes less")
        progress("placing views", 1.0)
        context = Context(progress=progress)
        interrupt = None
        try:
            result = csplat_tools.simplify(model, target, views=view_set, options=options, context=context)
        except SearchInterrupted as caught:
            if caught.best is None:
                raise
            result, interrupt = caught.best, caught
    write_model(output, result.model, absolute=False)
    out.remark(*result.notes, *format_simplification(result.report))
    out.publish(result.report)
    if interrupt is not None:
        raise interrupt
