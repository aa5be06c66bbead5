"""`csplat info`."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from csplat.training import TRAINING, TrainedOn
from csplat_tools.cli.console import guarded
from csplat_tools.files.console import format_bytes, format_table, say, say_json
from csplat_tools.files.streams import mapped_csplat
from csplat_tools.inspect.reading import describe_file

__all__ = ["info"]


@guarded
def info(
    source: Annotated[str, typer.Argument(metavar="F.csplat", help="A .csplat file, or - for standard input.")],
    as_json: Annotated[bool, typer.Option("--json", help="Everything, for programs.")] = False,
) -> None:
    """Say what is in a file: scene, sizes, options, stated errors.

    Reads the header, the index and the heads of the blocks: a large file
    takes hardly longer than a small one. Nothing is decoded: whether the
    file is intact is what `csplat verify` tells.

    Examples:
      csplat info scene.csplat
      csplat info scene.csplat --json | jq .attributes.means.bits_per_splat
    """
    with mapped_csplat(source) as data:
        described = describe_file(data)
    if as_json:
        say_json(described)
    else:
        say(_format(described))


def _format(described: dict[str, Any]) -> str:
    parts = [
        _scene(described),
        _sizes("attribute", described["attributes"], described, _coding),
        _sizes("layer", described["layers"], described, lambda layer: f"{layer['tiles']} tiles"),
        _overhead(described),
    ]
    if described["codebooks"]:
        parts.append("\n".join(_codebook(one) for one in described["codebooks"]))
    if described["stated_errors"] is not None:
        parts.append(_stated_errors(described["stated_errors"]))
    metadata = dict(described["metadata"] or {})
    if TrainedOn.of(metadata) is not None:  # in words above
        del metadata[TRAINING]
    parts += [
        f"{title}  {json.dumps(value, sort_keys=True)}"
        for title, value in (("options ", described["options"]), ("metadata", metadata))
        if value
    ]
    return "\n\n".join(parts)


def _scene(described: dict[str, Any]) -> str:
    per_splat = described["bytes_per_splat"]
    average = "" if per_splat is None else f", {per_splat:.2f} bytes per splat"
    unit = described["unit_metres"]
    flags = [name for name in ("antialiased", "flat") if described[name]]
    lines = [
        f"{described['format']}, profile {described['profile']}, {format_bytes(described['size_bytes'])}{average}",
        f"splats       {described['splats']}, SH degree {described['sh_degree']}",
        f"axes         {described['coordinate_system']}",
        f"unit         {'unknown' if unit is None else f'{unit:g} m'}",
        f"origin       {' '.join(f'{value:.17g}' for value in described['origin'])}",
        f"flags        {', '.join(flags) or 'none'}",
        f"tiles        {_tiles(described['tiles'])}",
    ]
    extras = ", ".join(f"{one['name']} ({one['dtype']})" for one in described["extra_columns"])
    if extras:
        lines.append(f"extra        {extras}")
    if described["cameras"] is not None:
        lines.append(f"cameras      {described['cameras']}")
    trained = TrainedOn.of(described["metadata"] or {})
    if trained is not None:
        lines.append(f"trained on   {trained}")
    return "\n".join(lines)


def _tiles(tiles: dict[str, Any]) -> str:
    if not tiles["count"]:
        return "0"
    return (
        f"{tiles['count']} of {_range(tiles['splats'])} splats,"
        f" {_range(tiles['bits_per_axis'])} bits per axis, exponents {_range(tiles['exponents'])}"
    )


def _range(pair: dict[str, int]) -> str:
    return str(pair["min"]) if pair["min"] == pair["max"] else f"{pair['min']} to {pair['max']}"


def _sizes(title: str, entries: dict[str, Any], described: dict[str, Any], remark: Any) -> str:
    rows = []
    for name, one in entries.items():
        bits = one["bits_per_splat"]
        share = 100.0 * one["size_bytes"] / described["size_bytes"]
        rows.append((name, one["size_bytes"], "-" if bits is None else f"{bits:.2f}", f"{share:.1f}"))
    lines = format_table((title, "bytes", "bits/splat", "% of file"), rows).splitlines()
    remarks = ["", *(remark(one) for one in entries.values())]
    return "\n".join(f"{line}  {text}".rstrip() for line, text in zip(lines, remarks, strict=True))


def _coding(attribute: dict[str, Any]) -> str:
    words = ["+".join(attribute["codings"])]
    if "step" in attribute:
        words.append(f"step {attribute['step']:.4g}")
    if attribute.get("levels"):
        words.append(f"{attribute['levels']} levels")
    if attribute.get("mapping") not in (None, "lattice", "unit_w"):
        words.append(attribute["mapping"])
    if attribute.get("chroma_shift"):
        words.append(f"chroma / {2 ** attribute['chroma_shift']}")
    if attribute["codebook_bytes"]:
        words.append(f"codebook {format_bytes(attribute['codebook_bytes'])}")
    if attribute["escaped_splats"]:
        words.append(f"{attribute['escaped_splats']} escaped")
    words.append("+".join(attribute["coders"]))
    return ", ".join(word for word in words if word)


def _overhead(described: dict[str, Any]) -> str:
    sizes = ", ".join(f"{name} {size}" for name, size in described["overhead"].items())
    return f"other bytes: {sizes}"


def _codebook(codebook: dict[str, Any]) -> str:
    bands = f" bands {codebook['bands'][0]} to {codebook['bands'][-1]}" if codebook["bands"] else ""
    stages = " + ".join(str(size) for size in codebook["stages"])
    return f"codebook {codebook['id']}: {codebook['kind']}{bands}, {stages} entries, {codebook['size_bytes']} bytes"


def _stated_errors(stated: dict[str, Any]) -> str:
    source = f"{stated['source_splats']} splats, SH degree {stated['source_sh_degree']}"
    lines = [f"stands for a source of {source}; {stated['pruned_splats']} pruned"]
    if stated["refitted"]:
        lines.append("attributes were fitted anew: renders are the judge, not these errors")
    if stated["errors"]:
        rows = [(name, f"{one['max']:.6g}", f"{one['rms']:.6g}") for name, one in stated["errors"].items()]
        lines.append(format_table(("stated error", "max", "rms"), rows))
    return "\n".join(lines)
