"""`csplat simplify`."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from csplat.errors import InputError
from csplat_tools.cli.console import guarded
from csplat_tools.cli.data_options import Images, Size, TestEvery, data_options
from csplat_tools.cli.parsing import parse_colour, parse_decibels, parse_size
from csplat_tools.files.console import format_table, note, progress_bar, say_json
from csplat_tools.files.extras import prepare_renderer
from csplat_tools.files.scenes import load_model
from csplat_tools.files.streams import STANDARD_STREAM, check_outputs, write_array, write_bytes, write_model
from csplat_tools.views import find_view_set

__all__ = ["simplify"]

_TARGET = "Target (one of them)"
_VIEWS = "Views (virtual ones by default)"
_HOW = "How"


@guarded
def simplify(
    source: Annotated[str, typer.Argument(metavar="IN.ply", help="A PLY or .csplat file, or - for standard input.")],
    output: Annotated[str, typer.Argument(metavar="OUT.ply", help="The PLY to write, or - for standard output.")],
    keep: Annotated[
        float | None, typer.Option(metavar="SHARE", rich_help_panel=_TARGET, help="Share of the splats that stay.")
    ] = None,
    max_loss: Annotated[
        str | None,
        typer.Option(
            metavar="DB", rich_help_panel=_TARGET, help="How far PSNR against photographs may fall; with --data."
        ),
    ] = None,
    target_psnr: Annotated[
        float | None,
        typer.Option(
            metavar="DB", rich_help_panel=_TARGET, help="PSNR against the source's renders, by the views that decide."
        ),
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
    views: Annotated[
        int, typer.Option(metavar="N", min=1, rich_help_panel=_VIEWS, help="Virtual views that teach, at most.")
    ] = 160,
    view_size: Annotated[
        str, typer.Option(metavar="WxH", rich_help_panel=_VIEWS, help="About how large the pictures that teach are.")
    ] = "240x180",
    background: Annotated[
        str | None,
        typer.Option(
            metavar="R,G,B",
            rich_help_panel=_VIEWS,
            help="Behind the scene: black, but with --data or --cameras as in training.",
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(metavar="rounds|exact|opacity|opacity-area", rich_help_panel=_HOW, help="What splats go by."),
    ] = "rounds",
    rounds: Annotated[
        int, typer.Option(metavar="N", min=1, rich_help_panel=_HOW, help="How often errors are measured anew.")
    ] = 4,
    refit: Annotated[
        bool, typer.Option("--refit/--no-refit", rich_help_panel=_HOW, help="Fit the colours of what stays.")
    ] = True,
    adjust: Annotated[
        bool,
        typer.Option("--adjust/--no-adjust", rich_help_panel=_HOW, help="Move opacities and scales of what stays."),
    ] = True,
    bands: Annotated[
        bool, typer.Option("--bands/--no-bands", rich_help_panel=_HOW, help="Set SH bands that hardly show to zero.")
    ] = True,
    drop_unseen: Annotated[
        bool, typer.Option("--drop-unseen", rich_help_panel=_HOW, help="Remove what no view shows first.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, rich_help_panel=_HOW, help="Of the virtual views.")] = 0,
    threads: Annotated[
        int | None, typer.Option(min=1, rich_help_panel=_HOW, help="One per core by default; the result stays.")
    ] = None,
    source_index: Annotated[
        str | None, typer.Option(metavar="FILE.npy", help="Write which splat of the source each one is.")
    ] = None,
    report: Annotated[str | None, typer.Option(metavar="FILE.json", help="Write what was removed and why.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="The report on standard output.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing unless something is wrong.")] = False,
) -> None:
    """Remove splats that no picture needs, and fit the others to what is to be seen.

    What the removal of each splat would change is measured exactly, in many
    small views from all around, again and again as splats go. Then colours,
    opacities and scales of the others are fitted to what the source looks
    like in views that teach. Other views decide how much may go, and others
    again judge the result. Only --max-loss wants photographs. `csplat encode`
    with a target does all this for the file that it writes. Needs the packages
    of the render extra.

    Examples:
      csplat simplify scene.ply half.ply --keep 0.5
      csplat simplify scene.ply small.ply --target-psnr 40 --report small.json
      csplat simplify scene.ply small.ply --max-loss 0.3dB --data capture
    """
    prepare_renderer(quiet=quiet, simplify=True)
    from csplat_tools.optimise.simplify import SimplifyOptions
    from csplat_tools.optimise.simplify import simplify as simplified
    from csplat_tools.optimise.target import Target

    colour = None if background is None else parse_colour(background)
    try:
        loss = None if max_loss is None else parse_decibels(max_loss)
        target = Target(target_psnr, None, loss, keep)
        options = SimplifyOptions(
            method=method,
            rounds=rounds,
            refit=refit,
            adjust=adjust,
            bands=bands,
            keep_unseen=not drop_unseen,
            view_size=parse_size(view_size),
            seed=seed,
            threads=threads,
        )
    except InputError as error:
        raise typer.BadParameter(str(error)) from None
    if max_loss is not None and data is None:
        raise typer.BadParameter("--max-loss wants --data: photographs say what is lost")
    photographs = data_options(data, size, images, test_every)
    if as_json and output == STANDARD_STREAM:
        raise typer.BadParameter("--json and - both want standard output")
    if STANDARD_STREAM in (report, source_index):
        raise typer.BadParameter("--report and --source-index want names of files")
    check_outputs((output, report, source_index), force=force, inputs=(source, cameras))
    model = load_model(source).model
    around = find_view_set(
        model, cameras=cameras, data=photographs, background=colour, count=views, size=options.view_size, seed=seed
    )
    for line in () if quiet else around.notes:
        note(line)
    with progress_bar(quiet=quiet) as progress:
        result = simplified(model, around, target=target, options=options, progress=progress)
    write_model(output, result.model, absolute=False)
    if source_index is not None:
        write_array(source_index, result.source_index)
    if report is not None:
        write_bytes(report, (json.dumps(result.report, indent=2, allow_nan=False) + "\n").encode())
    if as_json:
        say_json(result.report)
    elif not quiet:
        _tell(result.report)


def _tell(report: dict[str, Any]) -> None:
    removed, views = report["removed"], report["views"]
    before, after = report["splats_before"], report["splats"]
    note(
        f"{before} -> {after} splats ({100.0 * after / before:.1f} %); gone: {removed['invisible']} too faint to be"
        f" drawn, {removed['unseen']} unseen, {removed['least_error']} that pictures need least"
    )
    note(
        f"measured in {views['used']} views of {views['size'][0]}x{views['size'][1]}, checked in {views['check']}"
        f" others; {100.0 * report['unseen_share']:.1f} % of the splats were seen by none"
    )
    rows = [("the other views, before the fit", f"{report['check_psnr_pruned']:.2f}")]
    rows.append(("the other views, fitted", f"{report['check_psnr']:.2f}"))
    if "decided_psnr" in report:
        rows.append(("the views that decide", f"{report['decided_psnr']:.2f}"))
    if "psnr" in report:
        rows.append((f"the {report['judged_by']['views']} views that judge", f"{report['psnr']:.2f}"))
    if "photographs" in report:
        scores = report["photographs"]
        rows.append(("held-out photographs, source", f"{scores['source']:.2f}"))
        rows.append(("held-out photographs", f"{scores['psnr']:.2f}"))
    note(format_table(("PSNR", "dB"), rows))
    if report["zero_bands"]:
        shares = [f"{band}: {100.0 * count / after:.0f} %" for band, count in report["zero_bands"].items()]
        note(f"splats without SH band {', '.join(shares)}")
