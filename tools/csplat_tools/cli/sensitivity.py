"""`csplat sensitivity`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat_tools.cli.console import guarded
from csplat_tools.cli.data_options import Images, Size, TestEvery, data_options
from csplat_tools.cli.parsing import parse_colour, parse_size
from csplat_tools.files.console import format_table, note, progress_bar, say_json
from csplat_tools.files.extras import prepare_renderer
from csplat_tools.files.scenes import load_model
from csplat_tools.files.streams import STANDARD_STREAM, check_output
from csplat_tools.optimise.sensitivity import Measured, measure_scene
from csplat_tools.views import find_view_set

__all__ = ["sensitivity"]

_VIEWS = "Views"

_SHOWN = {"colour": "colour (largest of the SH coefficients)", "opacity": "opacity", "shape": "shape, over its size"}


@guarded
def sensitivity(
    source: Annotated[str, typer.Argument(metavar="IN.ply", help="A PLY or .csplat file, or - for standard input.")],
    output: Annotated[str, typer.Argument(metavar="OUT.npz", help="The file to write.")],
    data: Annotated[
        str | None, typer.Option(metavar="DATA", rich_help_panel=_VIEWS, help="A data set: the views of its training.")
    ] = None,
    size: Size = None,
    images: Images = None,
    test_every: TestEvery = None,
    cameras: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.json",
            rich_help_panel=_VIEWS,
            help="Your own cameras; of 40 or more those that teach in other commands.",
        ),
    ] = None,
    views: Annotated[
        int, typer.Option(metavar="N", min=1, rich_help_panel=_VIEWS, help="Virtual views at most.")
    ] = 160,
    view_size: Annotated[
        str, typer.Option(metavar="WxH", rich_help_panel=_VIEWS, help="How large virtual views are.")
    ] = "240x180",
    background: Annotated[
        str | None,
        typer.Option(
            metavar="R,G,B",
            rich_help_panel=_VIEWS,
            help="Behind the scene: black, but with --data or --cameras as in training.",
        ),
    ] = None,
    matrices: Annotated[
        bool,
        typer.Option(
            "--matrices/--no-matrices",
            help="Store how errors of SH add up, which codebooks are chosen by: 240 bytes per splat.",
        ),
    ] = True,
    seed: Annotated[int, typer.Option(min=0, help="Of the virtual views.")] = 0,
    threads: Annotated[int | None, typer.Option(min=1, help="One per core by default; the result stays.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="What was found on standard output.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing unless something is wrong.")] = False,
) -> None:
    """Measure how much pictures depend on each splat, attribute by attribute.

    The file goes to `csplat encode --importance`, which then spends bytes where
    they show. It belongs to this scene alone. Training views say most; without
    them virtual ones are made, as many as it takes until they agree. Needs the
    packages of the render extra.

    Examples:
      csplat sensitivity scene.ply scene.npz --data photographs
      csplat encode scene.ply scene.csplat --importance scene.npz
    """
    if output == STANDARD_STREAM:
        raise typer.BadParameter("OUT.npz wants the name of a file")
    if data is not None and cameras is not None:
        raise typer.BadParameter("--data and --cameras both say where to look from: give one of them")
    colour = None if background is None else parse_colour(background)
    photographs = data_options(data, size, images, test_every)
    pixels = parse_size(view_size)
    check_output(output, force=force, inputs=tuple(path for path in (source, cameras) if path is not None))
    prepare_renderer(quiet=quiet, simplify=data is None and cameras is None)  # virtual views are looked for
    model = load_model(source).model
    around = find_view_set(
        model, cameras=cameras, data=photographs, background=colour, count=views if cameras is None else 0, size=pixels,
        seed=seed, aside=None if data is None else 0,
    )  # fmt: skip
    for line in () if quiet else around.notes:
        note(line)
    with progress_bar(quiet=quiet) as progress:
        measured = measure_scene(model, around, matrices=matrices, threads=threads, progress=progress)
    measured.write(output)
    if as_json:
        say_json(measured.as_json())
    elif not quiet:
        _tell(measured)


def _tell(measured: Measured) -> None:
    facts = measured.as_json()
    note(
        f"{facts['splats']} splats from {facts['views']} {facts['source']} views; no view saw {facts['unseen']} of them"
        f" ({100.0 * facts['unseen_share']:.2f} %)"
    )
    if facts["missed_share"] is not None:
        note(f"views that were kept aside saw {100.0 * facts['missed_share']:.2f} % more of the splats")
    rows = [
        (label, *(f"{facts['quantiles'][name][q]:.3g}" for q in ("0.5", "0.9", "0.99", "1.0")))
        for name, label in _SHOWN.items()
    ]
    note(format_table(("sensitivity", "median", "90 %", "99 %", "largest"), rows))
