# SPDX-License-Identifier: Apache-2.0
"""`csplat tradeoff`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat.context import Context
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import TRUSTS_PATHS, Output
from csplat_tools.console import note
from csplat_tools.file_streams import write_text
from csplat_tools.optional_packages import require_plots, require_renderer


def tradeoff(
    source: Annotated[str, typer.Argument(metavar="SCENE.ply", help="A trained 3DGS scene.")],
    page: Annotated[str | None, typer.Option(metavar="PAGE.html", help="Write an HTML report.")] = None,
    what: Annotated[str | None, typer.Option(metavar="GROUPS", help="Settings, see above. Default: all.")] = None,
    with_: Annotated[str | None, typer.Option("--with", metavar="FORMATS", help="Other formats, e.g. spz,sog.")] = None,
    preset: shared.Preset = "balanced",
    cameras: shared.Cameras = None,
    data: shared.Data = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Measure size, quality and time of many encodings.

    Groups of --what, with values after `=` and colons between them:
      presets=fast:small
      precision=36:44     PSNR of attributes, dB
      targets=38:1MB      PSNR of renders, or sizes; slow
      simplify=0.7:0.5    fractions of the splats; slow
    A group without `=` has default values. PSNR is measured against the
    source's renders, as by `csplat compare`, and against the images of --data.
    --with adds files of other formats, as `csplat convert` writes them with
    each of its presets. --page and --data require the render extra.

    Examples:
      csplat tradeoff scene.ply
      csplat tradeoff scene.ply --page report.html --report report.json
      csplat tradeoff scene.ply --what presets,precision=36:44:52
      csplat tradeoff scene.ply --with spz,sog --page report.html
      csplat tradeoff scene.ply --data capture --what presets,targets=30:32
    """
    import csplat_tools
    from csplat_tools.optimise.target_encoding import expected_search_seconds
    from csplat_tools.scene_files import read_source
    from csplat_tools.tradeoffs import GROUPS, format_tradeoff, make_tradeoff_page, parse_formats, parse_grid

    out, views = Output(force, report, as_json, quiet), shared.ViewOptions(cameras, data)
    grid = [] if with_ is None else shared.checked(parse_formats, with_)  # first, since they take seconds
    grid += shared.checked(parse_grid, ",".join(GROUPS) if what is None else what, preset)
    searches = [(setting.options, setting.target) for setting in grid if setting.target is not None]
    out.check(inputs=(source, *views.inputs), named={"--page": page})
    require_renderer()
    if page is not None:
        require_plots()
    with out.bar() as progress:
        read, context = read_source(source), Context(progress=progress)
        out.print_findings(read.findings)
        view_set = views.find(read.model(), out, source, must_fit=bool(searches))
        if len(read.model()):
            out.announce_time(
                lambda: sum(
                    expected_search_seconds(read.model(), *search, view_set, context=context) for search in searches
                ),
                "--what presets,precision takes less",
            )
        words = [*(["--cameras", cameras] if cameras else []), *(["--data", data] if data else [])]
        words += ["--trust-paths"] if TRUSTS_PATHS.get() else []
        measured = csplat_tools.tradeoff(
            read, grid, views=view_set, path=source, view_words=words, say=None if out.quiet else note,
            context=context,
        )  # fmt: skip
        if page is not None:
            write_text(page, make_tradeoff_page(measured))
    out.publish(measured.as_json(), format_tradeoff(measured))
