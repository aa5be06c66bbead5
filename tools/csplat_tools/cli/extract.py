# SPDX-License-Identifier: Apache-2.0
"""`csplat extract`."""

from __future__ import annotations

from typing import Annotated

import typer

import csplat
from csplat.errors import counted
from csplat.scene_metadata import UNSPECIFIED
from csplat.splat_file import SplatFile
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.console import format_bytes
from csplat_tools.file_streams import check_name, csplat_file, whole_output


def extract(
    source: Annotated[
        str, typer.Argument(metavar="IN.csplat", help="A .csplat file, its URL, or - for standard input.")
    ],
    output: Annotated[str, typer.Argument(metavar="OUT.csplat", help="The file to write, or -.")],
    box: Annotated[str, typer.Option(metavar="X,Y,Z,X,Y,Z", help="Two opposite corners, scene units.")],
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Cut a box out of a file, tile by tile.

    Tiles that touch the box are copied unchanged, with up to 65,536 splats
    each: some splats around the box are copied, too. `csplat convert --crop`
    cuts splat by splat. Corners are relative to the origin, along the axes of
    the file, like the box that `csplat info` prints. Declared errors are left
    out. Of a URL (https, s3 and others) only the index and the copied tiles
    are fetched; that requires the remote extra.

    Examples:
      csplat extract city.csplat square.csplat --box -10,-2,-10,10,8,10
      csplat extract s3://bucket/city.csplat part.csplat --box 0,0,0,9,9,9
    """
    out = Output(force, report, as_json, quiet)
    corners = shared.parse_numbers("--box", box, 6)
    assert corners is not None
    out.check(output, inputs=(source,))
    check_name(output, ".csplat", "extract", source)
    with out.bar(), SplatFile.open(csplat_file(source)) as file, whole_output(output) as stream:
        part = csplat.extract(file, corners, stream)
        size, read, requests, axes = file.size_bytes, file.bytes_read, file.requests, file.header.coordinate_system
        is_whole = part.splat_count == file.count
    which = f"x, y, z as {source} stores them" if axes == UNSPECIFIED else f"the axes of {source}, x, y, z = {axes}"
    out.remark(f"--box: along {which}")
    out.remark(
        f"{part.splat_count:,} splats in {counted(len(part.tiles), 'tile')}: {format_bytes(part.size_bytes)};"
        f" read {format_bytes(read)} of {format_bytes(size)}, in {counted(requests, 'request')}"
    )
    if is_whole:
        out.remark("the box touches every tile, so nothing is left out: `csplat convert --crop` cuts splat by splat")
    out.publish(
        {
            "splats": part.splat_count,
            "tiles": len(part.tiles),
            "tile_indices": list(part.tiles),
            "coordinate_system": axes,
            "size_bytes": part.size_bytes,
            "source_bytes": size,
            "bytes_read": read,
            "requests": requests,
        }
    )
