"""`csplat info`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer

from csplat.decoder import DeclaredBounds
from csplat.errors import InputError, counted
from csplat_tools.cli.groups import Output
from csplat_tools.cli.options import command
from csplat_tools.files.console import format_table
from csplat_tools.files.extras import need_pictures, prepare_renderer
from csplat_tools.files.streams import STANDARD_STREAM, is_csplat, mapped_csplat
from csplat_tools.inspect.foreign import describe_foreign
from csplat_tools.inspect.info import AttributeFacts, CodebookFacts, FileFacts, LayerFacts, describe_file
from csplat_tools.inspect.words import coding_words, headline, other_metadata, scene_words


@command(reads=True, needs={"beside": ("page",)})
def info(
    source: Annotated[str, typer.Argument(metavar="SCENE", help="A .csplat file; or any other of `csplat formats`.")],
    out: Output,
    page: Annotated[str | None, typer.Option(metavar="FILE.html", help="Write a page about it.")] = None,
    beside: Annotated[
        str | None,
        typer.Option(
            "--source",
            metavar="SCENE",
            help="What it was made from, PLY or .csplat: the page shows where they differ. Wants the render extra.",
        ),
    ] = None,
) -> None:
    """Say what is in a file: scene, sizes, options, stated errors.

    Reads the header, the index and the heads of the blocks: a large file
    takes hardly longer than a small one. Nothing is decoded: whether the
    file is intact is what `csplat verify` tells. --page writes the same as
    one HTML page that opens from a disk, with words for all of it.

    Examples:
      csplat info scene.csplat
      csplat info scene.csplat --json | jq .attributes.means.bits_per_splat
      csplat info scene.csplat --page scene.html --source scene.ply
    """
    out.check(inputs=(source, beside), named={"--page": page})
    if beside is not None:
        prepare_renderer(quiet=out.quiet, ssim=True)
        need_pictures()
    if source != STANDARD_STREAM and not is_csplat(Path(source)):
        if page is not None:
            raise InputError(f"{source} is no .csplat file, of which --page tells: `csplat encode` makes one")
        out.publish(*describe_foreign(source))
        return
    with mapped_csplat(source) as data:
        facts = describe_file(data)
        if page is not None:
            from csplat_tools.inspect.page import write_page

            with out.bar() as progress:
                write_page(page, source, data, facts, beside, progress=progress)
    out.publish(facts.as_json(), _format(facts))


def _format(facts: FileFacts) -> str:
    size = facts.header.file_size
    parts = [
        _scene(facts),
        _sizes("attribute", facts.attributes, size, [coding_words(one) for one in facts.attributes.values()]),
        _sizes("layer", facts.layers, size, [counted(one.tiles, "tile") for one in facts.layers.values()]),
        "other bytes: " + ", ".join(f"{name} {number}" for name, number in facts.overhead.items()),
    ]
    if facts.codebooks:
        parts.append("\n".join(_codebook(one) for one in facts.codebooks))
    if facts.declared_bounds is not None:
        parts.append(_stated_errors(facts.declared_bounds))
    parts += [
        f"{title}  {json.dumps(value, sort_keys=True)}"
        for title, value in (("options ", facts.options), ("metadata", other_metadata(facts)))
        if value
    ]
    return "\n\n".join(parts)


def _scene(facts: FileFacts) -> str:
    return "\n".join([headline(facts), *(f"{name:12} {value}" for name, value in scene_words(facts).items())])


def _sizes(
    title: str, entries: Mapping[str, AttributeFacts | LayerFacts], file_size: int, remarks: Sequence[str]
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


def _codebook(codebook: CodebookFacts) -> str:
    bands = f" bands {codebook.bands[0]} to {codebook.bands[-1]}" if codebook.bands else ""
    size = f"{counted(codebook.entries, 'entry', 'entries')}, {counted(codebook.size_bytes, 'byte')}"
    return f"codebook {codebook.id}: {codebook.kind}{bands}, {size}"


def _stated_errors(stated: DeclaredBounds) -> str:
    source = f"{counted(stated.source_count, 'splat')}, SH degree {stated.source_sh_degree}"
    lines = [f"stands for a source of {source}; {stated.pruned_count} pruned"]
    if stated.refitted:
        lines.append("attributes were fitted anew: renders are the judge of those without an error here")
    if stated.records:
        rows = [(one.measure, f"{one.max:.6g}", f"{one.rms:.6g}") for one in stated.records]
        lines.append(format_table(("stated error", "max", "rms"), rows))
    return "\n".join(lines)
