# SPDX-License-Identifier: Apache-2.0
"""`csplat info`."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Annotated

import typer

from csplat.context import Context
from csplat.errors import InputError
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.file_streams import is_csplat, local_path, mapped_csplat
from csplat_tools.inspect.file_description import describe_file, describe_other_format
from csplat_tools.inspect.text_reports import format_description
from csplat_tools.optional_packages import require_images, require_renderer


def info(
    source: Annotated[str, typer.Argument(metavar="SCENE", help="A .csplat file, or another format of `convert`.")],
    page: Annotated[str | None, typer.Option(metavar="FILE.html", help="Write an HTML report.")] = None,
    original: Annotated[
        str | None, typer.Option("--source", metavar="SCENE", help="Scene to compare with, in the report.")
    ] = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Describe a file: scene, sizes, options, declared errors.

    Nothing is decoded: a large file takes hardly longer than a small one,
    and `csplat verify` checks if the file is intact. Of a PLY, positions are
    read for its box. The second box has the middle 90 % of the splats on each
    axis, in a .csplat file at least, by tiles: `extract --box` takes either,
    `convert --crop` if the origin is 0. --source requires the render extra.

    Examples:
      csplat info scene.csplat
      csplat info scene.csplat --json | jq .attributes.means.bits_per_splat
      csplat info scene.csplat --page scene.html --source scene.ply
    """
    out = Output(force, report, as_json, quiet)
    shared.require_one({"--source": original}, {"--page": page})
    out.check(inputs=(source, original), named={"--page": page})
    with ExitStack() as stack, out.bar() as progress:
        if original is not None:
            require_renderer()
            require_images()
        local = stack.enter_context(local_path(source))
        if not is_csplat(local):
            if page is not None:
                raise InputError(f"{source} is no .csplat file, which --page describes: `csplat encode` makes one")
            out.publish(*describe_other_format(local))
            return
        with mapped_csplat(str(local), source) as data:
            description = describe_file(data)
            if page is not None:
                from csplat_tools.inspect.file_report import write_page

                write_page(page, source, data, description, original, context=Context(progress=progress))
    out.publish(description.as_json(), format_description(description))
