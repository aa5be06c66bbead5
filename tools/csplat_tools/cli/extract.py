"""`csplat extract`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat.errors import counted
from csplat.splat_file import open as opened
from csplat_tools.cli.command import OutputOptions, command
from csplat_tools.cli.shared_options import parse_numbers
from csplat_tools.console import format_bytes
from csplat_tools.file_streams import check_name, csplat_file, whole_output


@command()
def extract(
    source: Annotated[
        str, typer.Argument(metavar="IN.csplat", help="A .csplat file, its URL, or - for standard input.")
    ],
    output: Annotated[str, typer.Argument(metavar="OUT.csplat", help="The file to write, or -.")],
    out: OutputOptions,
    box: Annotated[
        str, typer.Option(metavar="X,Y,Z,X,Y,Z", help="Two corners; in scene units, relative to the origin.")
    ],
) -> None:
    """Cut a part of a scene out of a file, as a file of its own.

    Tiles that touch the box are copied as they are, up to 65,536 splats each:
    nothing is decoded or coded again, and splats around the box come along.
    `csplat convert --crop-box` cuts splat by splat. Stated errors are left out:
    they are those of the whole. Of a URL (https, s3 and others) the index and
    what is copied are fetched, no more; that needs the packages of the remote
    extra.

    Examples:
      csplat extract city.csplat square.csplat --box -10,-2,-10,10,8,10
      csplat extract s3://bucket/city.csplat square.csplat --box -10,-2,-10,10,8,10
    """
    corners = parse_numbers("--box", box, 6)
    assert corners is not None
    out.check(output, inputs=(source,))
    check_name(output, ".csplat", "extract", source)
    with opened(csplat_file(source)) as file, whole_output(output) as stream:
        part = file.extract(corners, stream)
        size, read, requests = file.size, file.bytes_read, file.requests
    out.remark(
        f"{part.splat_count:,} splats in {counted(len(part.tiles), 'tile')}: {format_bytes(part.size)};"
        f" read {format_bytes(read)} of {format_bytes(size)}, in {counted(requests, 'request')}"
    )
    out.publish(
        {
            "splats": part.splat_count,
            "tiles": list(part.tiles),
            "bytes": part.size,
            "source_bytes": size,
            "bytes_read": read,
            "requests": requests,
        }
    )
