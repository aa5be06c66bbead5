# SPDX-License-Identifier: Apache-2.0
"""`csplat merge`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat.editing.merge import merge as merged
from csplat.encoder import EncodeOptions
from csplat.errors import InputError, counted
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.console import format_bytes
from csplat_tools.file_streams import STANDARD_STREAM, check_name, csplat_file, whole_output


def merge(
    sources: Annotated[
        list[str],
        typer.Argument(metavar="A.csplat B.csplat ...", help="Files in the order of their splats; URLs, or one -."),
    ],
    target: Annotated[str, typer.Option("--output", "-o", metavar="OUT.csplat", help="The file to write, or -.")],
    preset: shared.Preset = "balanced",
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Join files into one.

    Tiles are copied unchanged if all files have the same steps, SH degree,
    origin and extra columns, as parts of one scene do. Otherwise the scenes
    are decoded and encoded together with --preset, and a line gives the
    reason. Files with different axes, up directions or units are refused; of
    a file without axes, RDF is assumed, with a remark. Metadata that all
    files share is kept; declared errors are left out.

    Examples:
      csplat merge north.csplat south.csplat -o city.csplat
    """
    out = Output(force, report, as_json, quiet)
    if sources.count(STANDARD_STREAM) > 1:
        raise InputError("two files cannot both come from standard input")
    out.check(target, inputs=sources)
    check_name(target, ".csplat", "-o", sources[0])
    with out.bar(), whole_output(target) as stream:
        done = merged(
            [csplat_file(source) for source in sources],
            stream,
            options=EncodeOptions(preset=preset, keep_extra=True),
        )
    if done.why:
        out.remark(f"decoded and coded again ({preset}): {done.why}")
    out.remark(*done.notes)
    if done.dropped:
        out.remark(f"not all files have them, left out: {', '.join(done.dropped)}")
    how = "coded again" if done.why else "copied"
    size = format_bytes(done.size_bytes)
    out.remark(f"{done.splat_count:,} splats in {counted(done.tile_count, 'tile')}, {how}: {size}")
    out.publish(
        {
            "splats": done.splat_count,
            "tiles": done.tile_count,
            "size_bytes": done.size_bytes,
            "copied": not done.why,
            "why": done.why,
            "dropped": list(done.dropped),
            "notes": list(done.notes),
        }
    )
