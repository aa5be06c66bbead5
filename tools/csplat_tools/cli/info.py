"""`csplat info`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Annotated

import typer

from csplat.decoder import StatedErrors
from csplat.errors import counted
from csplat.training import TRAINING, TrainedOn
from csplat.upright import UP, up_of
from csplat_tools.cli.options import Output, command
from csplat_tools.files.console import format_bytes, format_table
from csplat_tools.files.streams import mapped_csplat
from csplat_tools.inspect.info import AttributeFacts, CodebookFacts, FileFacts, LayerFacts, describe_file

__all__ = ["info"]


@command()
def info(
    source: Annotated[str, typer.Argument(metavar="F.csplat", help="A .csplat file, or - for standard input.")],
    out: Output,
) -> None:
    """Say what is in a file: scene, sizes, options, stated errors.

    Reads the header, the index and the heads of the blocks: a large file
    takes hardly longer than a small one. Nothing is decoded: whether the
    file is intact is what `csplat verify` tells.

    Examples:
      csplat info scene.csplat
      csplat info scene.csplat --json | jq .attributes.means.bits_per_splat
    """
    out.check(inputs=(source,))
    with mapped_csplat(source) as data:
        facts = describe_file(data)
    out.publish(facts.as_json(), _format(facts))


def _format(facts: FileFacts) -> str:
    size = facts.header.file_size
    parts = [
        _scene(facts),
        _sizes("attribute", facts.attributes, size, [_coding(one) for one in facts.attributes.values()]),
        _sizes("layer", facts.layers, size, [counted(one.tiles, "tile") for one in facts.layers.values()]),
        "other bytes: " + ", ".join(f"{name} {number}" for name, number in facts.overhead.items()),
    ]
    if facts.codebooks:
        parts.append("\n".join(_codebook(one) for one in facts.codebooks))
    if facts.stated_errors is not None:
        parts.append(_stated_errors(facts.stated_errors))
    metadata = dict(facts.metadata or {})
    if TrainedOn.of(metadata) is not None:  # in words above
        del metadata[TRAINING]
    if up_of(metadata) is not None:
        del metadata[UP]
    parts += [
        f"{title}  {json.dumps(value, sort_keys=True)}"
        for title, value in (("options ", facts.options), ("metadata", metadata))
        if value
    ]
    return "\n\n".join(parts)


def _scene(facts: FileFacts) -> str:
    header, per_splat = facts.header, facts.bytes_per_splat
    average = "" if per_splat is None else f", {per_splat:.2f} bytes per splat"
    version = f"csplat {header.version[0]}.{header.version[1]}"
    flags = [name for name in ("antialiased", "flat") if getattr(header, name)]
    up = up_of(facts.metadata or {}, header.coordinate_system)
    lines = [
        f"{version}, profile {header.profile}, {format_bytes(header.file_size)}{average}",
        f"splats       {header.splat_count:,}, SH degree {header.sh_degree}",
        f"axes         {header.coordinate_system}",
        f"up           {'unknown' if up is None else ' '.join(f'{value:g}' for value in up)}",
        f"unit         {'unknown' if header.unit_metres is None else f'{header.unit_metres:g} m'}",
        f"origin       {' '.join(f'{value:.17g}' for value in header.origin)}",
        f"flags        {', '.join(flags) or 'none'}",
        f"tiles        {_tiles(facts)}",
    ]
    extras = ", ".join(f"{one.name} ({one.dtype or 'of a type not known here'})" for one in header.extras)
    if extras:
        lines.append(f"extra        {extras}")
    if facts.cameras is not None:
        lines.append(f"cameras      {facts.cameras}")
    trained = TrainedOn.of(facts.metadata or {})
    if trained is not None:
        lines.append(f"trained on   {trained}")
    return "\n".join(lines)


def _tiles(facts: FileFacts) -> str:
    words = {
        name: str(one.min) if one.min == one.max else f"{one.min} to {one.max}" for name, one in facts.spans.items()
    }
    if not words:
        return "0"
    count = len(facts.header.tiles)
    bits = f"{words['bits_per_axis']} bits per axis, exponents {words['exponents']}"
    return f"{count} of {words['splats']} splats, {bits}"


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


def _coding(attribute: AttributeFacts) -> str:
    words = ["+".join(attribute.codings)]
    if attribute.step is not None:
        words.append(f"step {attribute.step:.4g}")
    if attribute.levels:
        words.append(f"{attribute.levels} levels")
    if attribute.mapping not in (None, "lattice", "unit_w"):
        words.append(str(attribute.mapping))
    if attribute.chroma_shift:
        words.append(f"chroma / {2**attribute.chroma_shift}")
    if attribute.codebook_bytes:
        words.append(f"codebook {format_bytes(attribute.codebook_bytes)}")
    if attribute.escaped_splats:
        words.append(f"{attribute.escaped_splats} escaped")
    words.append("+".join(attribute.coders))
    return ", ".join(word for word in words if word)


def _codebook(codebook: CodebookFacts) -> str:
    bands = f" bands {codebook.bands[0]} to {codebook.bands[-1]}" if codebook.bands else ""
    size = f"{counted(codebook.entries, 'entry', 'entries')}, {counted(codebook.size_bytes, 'byte')}"
    return f"codebook {codebook.id}: {codebook.kind}{bands}, {size}"


def _stated_errors(stated: StatedErrors) -> str:
    source = f"{counted(stated.source_count, 'splat')}, SH degree {stated.source_sh_degree}"
    lines = [f"stands for a source of {source}; {stated.pruned_count} pruned"]
    if stated.refitted:
        lines.append("attributes were fitted anew: renders are the judge of those without an error here")
    if stated.records:
        rows = [(one.measure, f"{one.max:.6g}", f"{one.rms:.6g}") for one in stated.records]
        lines.append(format_table(("stated error", "max", "rms"), rows))
    return "\n".join(lines)
