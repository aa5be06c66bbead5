"""`csplat tradeoff`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.console import note
from csplat_tools.optional_packages import prepare_renderer, require_images, require_plots, require_renderer
from csplat_tools.tradeoffs.sweep_options import SweepOptions, parse_sweep

_SLOW = {"strategies", "targets", "simplify", "finetune"}


def tradeoff(
    source: Annotated[str, typer.Argument(metavar="SCENE.ply", help="A trained 3DGS scene.")],
    page: Annotated[
        str | None, typer.Option("--output", "-o", metavar="PAGE.html", help="Write an HTML report.")
    ] = None,
    what: Annotated[
        str, typer.Option(metavar="GROUPS", show_default=False, help="Files to make, see above. Default: usual.")
    ] = "usual",
    preset: shared.Preset = SweepOptions.preset,
    cameras: shared.Cameras = None,
    data: shared.Data = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Measure size against quality of many encodings.

    Groups of --what, with values after `=` and colons between them:
      presets, strategies
      precision=36:44     PSNR of attributes, dB
      targets=38:1MB      PSNR of renders, or sizes; slow
      simplify=0.5        fractions of the splats
      finetune            takes minutes; not part of `usual`
    PSNR is measured against the source's renders, as by `csplat compare`,
    and against the images of --data. Requires the render extra.

    Examples:
      csplat tradeoff scene.ply
      csplat tradeoff scene.ply -o report.html --report report.json
      csplat tradeoff scene.ply --what presets,precision=36:44:52
      csplat tradeoff scene.ply --data capture --what usual,finetune
    """
    out = Output(force, report, as_json, quiet)
    options, views = shared.checked(parse_sweep, what, preset=preset), shared.ViewOptions(cameras, data)
    out.check(inputs=(source, *views.inputs), named={"-o": page})
    if page is not None:
        require_plots()
    require_renderer()
    require_images()
    import csplat_tools
    from csplat_tools.tradeoffs.sweep_options import read_setting
    from csplat_tools.tradeoffs.tradeoff_report import format_tradeoff, write_tradeoff_page

    with out.bar() as progress:
        setting = read_setting(source, cameras=views.cameras, data=views.data_options)
        prepare_renderer(quiet=out.quiet, simplify=bool(_SLOW & set(options.what)), ssim=True)
        out.print_findings(setting.findings)
        out.remark(*setting.views.notes)
        measured = csplat_tools.tradeoff(setting, options, say=None if out.quiet else note, progress=progress)
        if page is not None:
            write_tradeoff_page(page, measured)
    out.publish(measured.as_json(), format_tradeoff(measured))
