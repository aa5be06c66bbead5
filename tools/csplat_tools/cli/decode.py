# SPDX-License-Identifier: Apache-2.0
"""`csplat decode`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output, default_output
from csplat_tools.convert_file import decode_file
from csplat_tools.file_streams import check_name


def decode(
    source: Annotated[str, typer.Argument(metavar="IN.csplat", help="A .csplat file, or - for standard input.")],
    output: Annotated[
        str | None, typer.Argument(metavar="OUT.ply", help="The file to write, or -. Default: IN.ply.")
    ] = None,
    up: shared.Up = None,
    sh_degree: shared.ShDegree = None,
    absolute: Annotated[bool, typer.Option("--absolute", help="Add the origin to positions, as doubles.")] = False,
    limit_splats: shared.LimitSplats = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Turn a .csplat file into a PLY for any 3DGS viewer.

    A damaged file gives no PLY. Tiles are decoded one after another: a
    scene need not fit in memory.

    Examples:
      csplat decode scene.csplat scene.ply
      csplat decode scene.csplat small.ply --sh-degree 0
      csplat decode scene.csplat - | gzip > scene.ply.gz
    """
    out, output = Output(force, report, as_json, quiet), default_output(output, source, ".ply")
    overrides, sh_degree = shared.parse_overrides(up), shared.parse_sh_degree(sh_degree)
    out.check(output, inputs=(source,))
    check_name(output, ".ply", "decode", source)
    with out.bar() as progress:
        count, degree = decode_file(
            source, output, sh_degree=sh_degree, absolute=absolute, limit_splats=limit_splats, overrides=overrides,
            progress=progress,
        )  # fmt: skip
    out.publish({"splats": count, "sh_degree": degree})
