"""`csplat tradeoff`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat_tools.cli.command import OutputOptions, chosen, command
from csplat_tools.cli.shared_options import LpipsOption, Preset, Threads, ViewOptions
from csplat_tools.console import note
from csplat_tools.file_streams import STANDARD_STREAM
from csplat_tools.optional_packages import prepare_renderer, require_images, require_plots, require_renderer
from csplat_tools.tradeoffs.sweep_options import FAMILIES, SweepOptions, parse_sweep

_SLOW = {"strategies", "targets", "simplify", "finetune"}


@command(reads=True, needs={"background": ("cameras", "data")})
def tradeoff(
    source: Annotated[str, typer.Argument(metavar="SCENE.ply", help="A trained 3DGS scene.")],
    views: ViewOptions,
    out: OutputOptions,
    page: Annotated[
        str | None,
        typer.Option("--output", "-o", metavar="PAGE.html", help="Write an HTML report with plots and renders."),
    ] = None,
    plots: Annotated[str | None, typer.Option(metavar="FOLDER", help="Write the plots as SVG files.")] = None,
    what: Annotated[
        str,
        typer.Option(
            metavar="GROUP[=VALUE:...],...",
            help=f"What is tried: {', '.join(FAMILIES)}; usual: all but the last, which takes minutes a file."
            " Values: dB for precision; dB or bytes for targets; shares for simplify; for strategies alphas to prune by"
            " or, from 1 on, entries of codebooks.",
        ),
    ] = "usual",
    preset: Preset = SweepOptions.preset,
    iterations: Annotated[
        int, typer.Option(metavar="N", min=1, hidden=True, help="Steps of fine-tuning at most.")
    ] = SweepOptions.iterations,
    modes: Annotated[
        str,
        typer.Option(metavar="exact|standard|fast,...", hidden=True, help="Modes of the renderer that are timed."),
    ] = ",".join(SweepOptions.modes),
    lpips: LpipsOption = None,
    threads: Threads = None,
) -> None:
    """Measure size against quality for all that can be chosen when a scene is encoded.

    Encodes the scene in many ways, measures bytes, quality and seconds of each,
    and marks those that no other one beats: presets, values of --attribute-psnr,
    targets (the slowest: they prune and refit splats), shares of the splats,
    fewer SH bands, and simple strategies. A small scene takes minutes. PSNR is
    against the source's own renders, as `psnr` of `csplat compare`, and next to
    it against photographs if there are any. The report has the command that
    makes each file, and renders of the place where it differs most. Requires the
    packages of the render extra.

    Examples:
      csplat tradeoff scene.ply
      csplat tradeoff scene.ply -o report.html --report report.json --plots plots
      csplat tradeoff scene.ply --what presets,precision=36:44:52
      csplat tradeoff scene.ply --what targets=38:42:1MB:500kB
      csplat tradeoff scene.ply --data photographs --size 480x270 --what usual,finetune -o report.html
    """
    wanted = chosen(
        parse_sweep, text=what, preset=preset, iterations=iterations, threads=threads,
        modes=tuple(mode.strip() for mode in modes.split(",")),
    )  # fmt: skip
    if plots == STANDARD_STREAM:
        raise typer.BadParameter("--plots wants the name of a folder")
    out.check(inputs=(source, *views.inputs, None if lpips == "auto" else lpips), named={"-o": page})
    if page is not None or plots is not None:
        require_plots()
    require_renderer()
    require_images()
    import csplat_tools
    from csplat_tools.tradeoffs.sweep_options import read_setting
    from csplat_tools.tradeoffs.tradeoff_report import check_plots, format_tradeoff, write_plots, write_tradeoff_page

    check_plots(plots, force=out.force)
    setting = read_setting(
        source, cameras=views.cameras, data=views.data_options(), background=views.colour, lpips=lpips
    )
    prepare_renderer(quiet=out.quiet, simplify=bool(_SLOW & set(wanted.what)), ssim=True, lpips=lpips is not None)
    out.print_findings(setting.findings)
    out.remark(*setting.views.notes)
    with out.bar() as progress:
        measured = csplat_tools.tradeoff(setting, wanted, say=None if out.quiet else note, progress=progress)
    if plots is not None:
        write_plots(plots, measured)
    if page is not None:
        write_tradeoff_page(page, measured)
    out.publish(measured.as_json(), format_tradeoff(measured))
