"""`csplat extract`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat.errors import counted
from csplat.parts import extract as extracted
from csplat_tools.cli.groups import Output
from csplat_tools.cli.options import command
from csplat_tools.cli.parsing import parse_numbers
from csplat_tools.files.console import format_bytes, note
from csplat_tools.files.streams import check_name, mapped_csplat, write_bytes

__all__ = ["extract"]


@command()
def extract(
    source: Annotated[str, typer.Argument(metavar="IN.csplat", help="A .csplat file, or - for standard input.")],
    output: Annotated[str, typer.Argument(metavar="OUT.csplat", help="The file to write, or -.")],
    out: Output,
    box: Annotated[
        str, typer.Option(metavar="X,Y,Z,X,Y,Z", help="Two corners; in scene units, relative to the origin.")
    ],
) -> None:
    """Cut a part of a scene out of a file, as a file of its own.

    Tiles that touch the box are copied as they are, up to 65,536 splats each: nothing is decoded or coded again, and
    splats around the box come along. `csplat convert --crop-box` cuts splat by splat. Stated errors are left out: they
    are those of the whole.

    Examples:
      csplat extract city.csplat square.csplat --box -10,-2,-10,10,8,10
    """
    corners = parse_numbers("--box", box, 6)
    assert corners is not None
    out.check(output, inputs=(source,))
    check_name(output, ".csplat", "extract", source)
    with mapped_csplat(source) as data:
        part = extracted(data, corners)
        size = len(data)
    write_bytes(output, part.data)
    if not out.quiet:
        tiles = counted(len(part.tiles), "tile")
        note(f"{part.splat_count:,} splats in {tiles}: {format_bytes(len(part.data))} of {format_bytes(size)}")
    out.publish({"splats": part.splat_count, "tiles": list(part.tiles), "bytes": len(part.data)})
