"""`csplat decode`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat_tools.cli.command import OutputOptions, command
from csplat_tools.cli.shared_options import OrientationOptions, ShDegree
from csplat_tools.convert_file import decode_file
from csplat_tools.file_streams import check_name


@command(beside=".ply")
def decode(
    source: Annotated[str, typer.Argument(metavar="IN.csplat", help="A .csplat file, or - for standard input.")],
    output: Annotated[str, typer.Argument(metavar="OUT.ply", help="The file to write, or -; IN.ply by default.")],
    upright: OrientationOptions,
    out: OutputOptions,
    sh_degree: ShDegree = None,
    absolute: Annotated[
        bool, typer.Option("--absolute", help="Add the origin to the positions and write them as doubles.")
    ] = False,
    max_splats: Annotated[int | None, typer.Option(metavar="N", min=1, help="Refuse a scene of more splats.")] = None,
) -> None:
    """Turn a .csplat file into a PLY that every 3DGS viewer opens.

    All checks of the format are made: a damaged file gives no PLY. Goes
    tile by tile: a scene need not fit the memory.

    Examples:
      csplat decode scene.csplat scene.ply
      csplat decode scene.csplat small.ply --sh-degree 0
      csplat decode scene.csplat - | gzip > scene.ply.gz
    """
    out.check(output, inputs=(source,))
    check_name(output, ".ply", "decode", source)
    with out.bar() as progress:
        count, degree = decode_file(
            source, output, sh_degree=sh_degree, absolute=absolute, max_splats=max_splats,
            overrides=upright.overrides(), progress=progress,
        )  # fmt: skip
    out.publish({"splats": count, "sh_degree": degree})
