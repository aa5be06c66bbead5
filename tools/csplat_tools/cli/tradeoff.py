"""`csplat tradeoff`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from csplat.encoder import PRESETS
from csplat.errors import InputError
from csplat_tools.cli.console import guarded
from csplat_tools.cli.data_options import Images, Size, TestEvery, data_options
from csplat_tools.cli.parsing import parse_mode
from csplat_tools.files.console import note, say
from csplat_tools.files.extras import need_pictures, need_plots, prepare_renderer
from csplat_tools.files.streams import STANDARD_STREAM, check_outputs, write_bytes
from csplat_tools.tradeoff.options import FAMILIES, USUAL, Wanted, parse_numbers, parse_sizes, parse_words

__all__ = ["tradeoff"]

_WHAT = "What is tried"
_JUDGES = "What judges"


@guarded
def tradeoff(
    source: Annotated[str, typer.Argument(metavar="SCENE.ply", help="A trained 3DGS scene.")],
    output: Annotated[
        str | None, typer.Option("--output", "-o", metavar="REPORT.html", help="Write a page with plots and pictures.")
    ] = None,
    as_json: Annotated[
        str | None, typer.Option("--json", metavar="FILE", help="Write everything for programs; - for standard output.")
    ] = None,
    plots: Annotated[str | None, typer.Option(metavar="FOLDER", help="Write the plots as SVG files.")] = None,
    what: Annotated[
        str, typer.Option(metavar="GROUP,…", rich_help_panel=_WHAT, help=f"Groups: {', '.join(FAMILIES)}.")
    ] = ",".join(USUAL),
    with_finetune: Annotated[
        bool, typer.Option("--with-finetune", rich_help_panel=_WHAT, help="Fine-tuned files, too: minutes for each.")
    ] = False,
    preset: Annotated[
        str, typer.Option(metavar="|".join(PRESETS), rich_help_panel=_WHAT, help="Preset of all other files.")
    ] = Wanted.preset,
    attribute_psnr: Annotated[
        str | None, typer.Option(metavar="DB,…", rich_help_panel=_WHAT, help="Values of `encode --attribute-psnr`.")
    ] = None,
    psnr: Annotated[
        str | None, typer.Option(metavar="DB,…", rich_help_panel=_WHAT, help="Values of `encode --target-psnr`.")
    ] = None,
    sizes: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE,…",
            rich_help_panel=_WHAT,
            help="Values of `encode --target-size`: 2MB,800kB; by default none.",
        ),
    ] = None,
    keep: Annotated[
        str | None,
        typer.Option(metavar="SHARE,…", rich_help_panel=_WHAT, help="Shares of the splats for `encode --keep`."),
    ] = None,
    opacities: Annotated[
        str | None, typer.Option(metavar="ALPHA,…", rich_help_panel=_WHAT, help="Values of `encode --prune-opacity`.")
    ] = None,
    kmeans: Annotated[
        str | None,
        typer.Option(metavar="K,…", rich_help_panel=_WHAT, help="Values of `encode --kmeans`: entries per attribute."),
    ] = None,
    iterations: Annotated[
        int, typer.Option(metavar="N", min=1, rich_help_panel=_WHAT, help="Steps of fine-tuning at most.")
    ] = Wanted.iterations,
    modes: Annotated[
        str,
        typer.Option(
            metavar="exact|standard|fast,…", rich_help_panel=_JUDGES, help="Modes of the renderer that are timed."
        ),
    ] = ",".join(Wanted.modes),
    cameras: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.json",
            rich_help_panel=_JUDGES,
            help="Cameras that judge; of 40 or more every fourth does, the others teach and decide.",
        ),
    ] = None,
    data: Annotated[
        str | None,
        typer.Option(
            metavar="DATA",
            rich_help_panel=_JUDGES,
            help="Posed photographs: those of the training teach and decide, those held out judge.",
        ),
    ] = None,
    size: Size = None,
    images: Images = None,
    test_every: TestEvery = None,
    lpips: Annotated[
        str | None,
        typer.Option(
            metavar="WEIGHTS.npz", rich_help_panel=_JUDGES, help="LPIPS (Alex) with these weights, or `auto`."
        ),
    ] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="Threads, one per core by default.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing unless something is wrong.")] = False,
) -> None:
    """Show what a scene costs and what it keeps, over everything that can be chosen.

    Encodes the scene in many ways, measures bytes, pictures and seconds of
    each, and marks those that no other one beats: presets, values of
    --attribute-psnr, targets (the slowest: they remove and refit splats),
    shares of the splats, fewer SH bands, and simple strategies. A small scene
    takes minutes. `psnr` is against the source's own renders, as that of
    `csplat compare`; photographs judge beside it. Needs the packages of the
    render extra.

    Examples:
      csplat tradeoff scene.ply
      csplat tradeoff scene.ply -o report.html --json report.json --plots plots
      csplat tradeoff scene.ply --what presets,precision --attribute-psnr 36,44,52
      csplat tradeoff scene.ply --what targets --psnr 38,42 --sizes 1MB,500kB
      csplat tradeoff scene.ply --data photographs --size 480x270 --with-finetune -o report.html
    """
    lists = {
        "attribute_psnr": attribute_psnr, "psnr": psnr, "sizes": sizes, "keep": keep, "opacities": opacities,
        "kmeans": kmeans,
    }  # fmt: skip
    wanted = _wanted(what, with_finetune, preset, lists, iterations, modes, threads)
    if cameras is not None and data is not None:
        raise typer.BadParameter("wanted one of --cameras and --data")
    if STANDARD_STREAM in (output, plots):
        raise typer.BadParameter("-o and --plots want names; --json alone may be -")
    shots = data_options(data, size, images, test_every)
    inputs = (source, cameras, None if lpips == "auto" else lpips)
    for path in inputs:
        if path not in (None, STANDARD_STREAM):
            Path(str(path)).stat()  # an OSError that names it, before the seconds that the renderer may take
    check_outputs((output, as_json), force=force, inputs=inputs)
    if output is not None or plots is not None:
        need_plots()
    slow = bool({"strategies", "targets", "simplify", "finetune"} & set(wanted.what))
    prepare_renderer(quiet=quiet, simplify=slow, ssim=True, lpips=lpips is not None)
    need_pictures()
    from csplat_tools.tradeoff.outputs import check_plots, write_page, write_plots
    from csplat_tools.tradeoff.running import measure_tradeoff
    from csplat_tools.tradeoff.setting import read_setting
    from csplat_tools.tradeoff.tables import format_tradeoff

    check_plots(plots, force=force)
    setting = read_setting(source, cameras=cameras, data=shots, lpips=lpips)
    for finding in setting.findings:
        if not quiet or finding.kind == "repair":
            note(str(finding))
    for line in () if quiet else setting.views.notes:
        note(line)
    measured = measure_tradeoff(setting, wanted, quiet=quiet)
    if as_json is not None:
        write_bytes(as_json, json.dumps(measured.as_json(), indent=1, allow_nan=False).encode() + b"\n")
    if plots is not None:
        write_plots(plots, measured)
    if output is not None:
        write_page(output, measured)
    if as_json != STANDARD_STREAM:
        say(format_tradeoff(measured))


def _wanted(
    what: str,
    with_finetune: bool,
    preset: str,
    lists: Mapping[str, str | None],
    iterations: int,
    modes: str,
    threads: int | None,
) -> Wanted:
    """What is swept; a list that is not given is the usual one, an empty one asks for no such points."""
    asked = (*parse_words(what), *(("finetune",) if with_finetune else ()))
    try:
        values: dict[str, Any] = {
            name: parse_sizes(text) if name == "sizes" else parse_numbers(text)
            for name, text in lists.items()
            if text is not None
        }
        usual = Wanted()
        return replace(
            usual, what=tuple(dict.fromkeys(asked)), preset=preset, iterations=iterations,
            modes=tuple(parse_mode(mode) for mode in parse_words(modes)), threads=threads, **values,
        )  # fmt: skip
    except InputError as error:
        raise typer.BadParameter(str(error)) from None
