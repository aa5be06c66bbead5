"""`csplat decode`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat_tools.cli.console import guarded
from csplat_tools.files.console import progress_bar
from csplat_tools.files.convert import decode_file
from csplat_tools.files.streams import check_output

__all__ = ["decode"]


@guarded
def decode(
    source: Annotated[str, typer.Argument(metavar="IN.csplat", help="A .csplat file, or - for standard input.")],
    target: Annotated[str, typer.Argument(metavar="OUT.ply", help="The file to write, or - for standard output.")],
    sh_degree: Annotated[
        int | None, typer.Option(metavar="0..3", min=0, max=3, help="Leave out SH bands above this one.")
    ] = None,
    absolute: Annotated[
        bool, typer.Option("--absolute", help="Add the origin to the positions and write them as doubles.")
    ] = False,
    max_splats: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Refuse a scene of more splats; 2^25 by default.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Turn a .csplat file into a PLY that every 3DGS viewer opens.

    All checks of the format are made first: a damaged file gives no PLY.

    Examples:
      csplat decode scene.csplat scene.ply
      csplat decode scene.csplat small.ply --sh-degree 0
      csplat decode scene.csplat - | gzip > scene.ply.gz
    """
    check_output(target, force=force, inputs=(source,))
    with progress_bar() as progress:
        decode_file(source, target, sh_degree=sh_degree, absolute=absolute, max_splats=max_splats, progress=progress)
