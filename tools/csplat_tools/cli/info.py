"""`csplat info`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer

from csplat.decoder import DeclaredBounds
from csplat.errors import InputError, counted
from csplat_tools.cli.command_output import Output
from csplat_tools.cli.shared_options import Force, HelpAll, Json, Quiet, Report, require_one
from csplat_tools.console import format_table
from csplat_tools.file_streams import STANDARD_STREAM, is_csplat, mapped_csplat
from csplat_tools.inspect.file_description import (
    AttributeSummary,
    CodebookSummary,
    FileDescription,
    LayerSummary,
    describe_coding,
    describe_file,
    describe_other_format,
    describe_scene,
    format_headline,
    other_metadata,
)
from csplat_tools.optional_packages import prepare_renderer, require_images


def info(
    source: Annotated[str, typer.Argument(metavar="SCENE", help="A .csplat file, or another of `csplat formats`.")],
    page: Annotated[str | None, typer.Option(metavar="FILE.html", help="Write an HTML report.")] = None,
    original: Annotated[
        str | None, typer.Option("--source", metavar="SCENE", help="Scene to compare with, in the report.")
    ] = None,
    force: Force = False,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
    _all: HelpAll = False,
) -> None:
    """Describe a file: scene, sizes, options, declared errors.

    Nothing is decoded: a large file takes hardly longer than a small one,
    and `csplat verify` checks if the file is intact. --source requires the
    render extra.

    Examples:
      csplat info scene.csplat
      csplat info scene.csplat --json | jq .attributes.means.bits_per_splat
      csplat info scene.csplat --page scene.html --source scene.ply
    """
    out = Output(force, report, as_json, quiet)
    require_one({"--source": original}, {"--page": page})
    out.check(inputs=(source, original), named={"--page": page})
    with out.bar() as progress:
        if original is not None:
            prepare_renderer(quiet=out.quiet, ssim=True)
            require_images()
        if source != STANDARD_STREAM and not is_csplat(Path(source)):
            if page is not None:
                raise InputError(f"{source} is no .csplat file, which --page describes: `csplat encode` makes one")
            out.publish(*describe_other_format(source))
            return
        with mapped_csplat(source) as data:
            description = describe_file(data)
            if page is not None:
                from csplat_tools.inspect.file_report import write_page

                write_page(page, source, data, description, original, progress=progress)
    out.publish(description.as_json(), _format(description))


def _format(description: FileDescription) -> str:
    size = description.header.file_size
    parts = [
        _scene(description),
        _sizes(
            "attribute", description.attributes, size, [describe_coding(one) for one in description.attributes.values()]
        ),
        _sizes("layer", description.layers, size, [counted(one.tiles, "tile") for one in description.layers.values()]),
        "other bytes: " + ", ".join(f"{name} {number}" for name, number in description.overhead.items()),
    ]
    if description.codebooks:
        parts.append("\n".join(_codebook(one) for one in description.codebooks))
    if description.declared_bounds is not None:
        parts.append(_stated_errors(description.declared_bounds))
    parts += [
        f"{title}  {json.dumps(value, sort_keys=True)}"
        for title, value in (("options ", description.options), ("metadata", other_metadata(description)))
        if value
    ]
    return "\n\n".join(parts)


def _scene(description: FileDescription) -> str:
    return "\n".join(
        [format_headline(description), *(f"{name:12} {value}" for name, value in describe_scene(description).items())]
    )


def _sizes(
    title: str, entries: Mapping[str, AttributeSummary | LayerSummary], file_size: int, remarks: Sequence[str]
) -> str:
    rows = [
        (
            name,
            one.size_bytes,
            "-" if one.bits_per_splat is None else f"{one.bits_per_splat:.2f}",
            f"{100.0 * one.size_bytes / file_size:.1f}",
        )
        for name, one in entries.items()
    ]
    lines = format_table((title, "bytes", "bits/splat", "% of file"), rows).splitlines()
    return "\n".join(f"{line}  {text}".rstrip() for line, text in zip(lines, ["", *remarks], strict=True))


def _codebook(codebook: CodebookSummary) -> str:
    bands = f" bands {codebook.bands[0]} to {codebook.bands[-1]}" if codebook.bands else ""
    size = f"{counted(codebook.entries, 'entry', 'entries')}, {counted(codebook.size_bytes, 'byte')}"
    return f"codebook {codebook.id}: {codebook.kind}{bands}, {size}"


def _stated_errors(stated: DeclaredBounds) -> str:
    source = f"{counted(stated.source_count, 'splat')}, SH degree {stated.source_sh_degree}"
    lines = [f"source: {source}; {stated.pruned_count} pruned"]
    if stated.refitted:
        lines.append("attributes were refitted: those without an error here are checked by renders only")
    if stated.records:
        rows = [(one.measure, f"{one.max:.6g}", f"{one.rms:.6g}") for one in stated.records]
        lines.append(format_table(("stated error", "max", "rms"), rows))
    return "\n".join(lines)
