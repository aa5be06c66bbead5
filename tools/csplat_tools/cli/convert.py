# SPDX-License-Identifier: Apache-2.0
"""`csplat convert`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from csplat.disk_files import FOLDER_NAMES
from csplat.editing.transform import DEFAULT_AXES
from csplat.encoder import PresetName
from csplat.errors import counted
from csplat.scene_metadata import UNSPECIFIED
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.console import format_bytes, note
from csplat_tools.convert_file import Conversion, Filters, convert_file
from csplat_tools.file_streams import STANDARD_STREAM


def convert(
    source: Annotated[str, typer.Argument(metavar="IN", help="A scene in any format, a folder, or -.")],
    output: Annotated[str, typer.Argument(metavar="OUT", help="The file to write; its name determines the format.")],
    rotate: Annotated[str | None, typer.Option(metavar="X,Y,Z", help="Degrees about x, then y, then z of IN.")] = None,
    scale: Annotated[float | None, typer.Option(metavar="FACTOR", help="Enlarge by this factor.")] = None,
    translate: Annotated[str | None, typer.Option(metavar="X,Y,Z", help="Move along IN's axes, scene units.")] = None,
    crop: Annotated[
        str | None, typer.Option(metavar="NUMBERS", help="Keep a box X,Y,Z,X,Y,Z or sphere X,Y,Z,R.")
    ] = None,
    drop_floaters: Annotated[bool, typer.Option("--drop-floaters", help="Drop splats far from others.")] = False,
    up: shared.Up = None,
    sh_degree: shared.ShDegree = None,
    preset: Annotated[
        PresetName, typer.Option(metavar="PRESET", hidden=True, help="For SPZ: balanced or small. Default: balanced.")
    ] = "balanced",
    compress: Annotated[bool, typer.Option("--compress", help="Compress the splats of a .glb.")] = False,
    no_loss: Annotated[bool, typer.Option("--no-loss", help="Refuse if anything would be lost.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Report losses and size, write nothing.")] = False,
    to_axes: Annotated[
        str | None, typer.Option(metavar="RDF", hidden=True, help="Turn to other axes, e.g. RDF, RUB.")
    ] = None,
    axes: Annotated[
        str | None, typer.Option(metavar="RDF", hidden=True, help="Directions of +x, +y, +z: R/L, U/D, F/B.")
    ] = None,
    write_as: Annotated[
        str | None, typer.Option("--to", metavar="FORMAT", hidden=True, help="Format of OUT. Default: by its name.")
    ] = None,
    level: shared.HiddenLevel = None,
    read_as: shared.ReadAs = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Convert a scene to another format, and change it.

    Changes are made in this order: --to-axes (in --help-all), --rotate,
    --scale, --translate, --crop, --drop-floaters, --sh-degree. They are along
    the axes of IN, or of --to-axes. Some formats have fixed axes, such as y
    up in glTF. A box is two opposite corners, which `csplat info` prints, a
    sphere its centre and radius; add the origin if it is not 0. A line
    reports what the format cannot hold. For .csplat files, `csplat encode`
    has presets and targets. A new folder with a file lod-meta.json gets
    streamed SOG, with all levels of detail. --compress makes a .glb about 15
    times smaller: its splats are a .csplat file, as the extension
    CSPLAT_gaussian_splatting_compression_1 specifies. IN is copied bit for
    bit if it is a .csplat file, and encoded otherwise.

    Formats, their highest SH degree, and what else they hold (header: axes,
    origin, unit, metadata, antialiased, flat, colour space):
      ply             .ply             read, write  4  header, extra
      compressed-ply  .compressed.ply  read, write  3  header
      csplat          .csplat          read, write  4  header, extra, cameras
      spz             .spz             read, write  3  antialiased
      spz4            .v4.spz          read, write  4  antialiased
      splat           .splat           read, write  0
      ksplat          .ksplat          read         2
      sog             .sog, meta.json  read, write  3  antialiased, flat
      gltf            .glb, .gltf      read, write  3  header
      gltf-csplat     .csplat.glb      read, write  3  header, extra, cameras
      checkpoint      .pt, .ckpt       read         4

    Examples:
      csplat convert scene.spz scene.ply
      csplat convert scene.ply scene.sog --drop-floaters
      csplat convert scene.ply small.spz --sh-degree 1 --crop 0,0,0,3
      csplat convert scene.csplat scene.glb --compress
      csplat convert city.csplat city/lod-meta.json
    """
    out = Output(force, report, as_json, quiet)
    if output == STANDARD_STREAM:
        raise typer.BadParameter("OUT cannot be standard output: name a file")
    filters, overrides = _parse_filters(to_axes, rotate, scale, translate, crop), shared.parse_overrides(up, axes)
    filters = replace(filters, drop_floaters=drop_floaters, sh_degree=shared.parse_sh_degree(sh_degree))
    chosen, max_splats = shared.parse_level(level)
    if compress:
        if write_as is not None or Path(output).suffix.lower() != ".glb":
            what = f"--to is {write_as}" if write_as is not None else f"OUT is {output}"
            raise typer.BadParameter(f"--compress compresses the splats of a .glb, but {what}")
        write_as = "gltf-csplat"
    folder = Path(output).parent
    is_new_folder = Path(output).name in FOLDER_NAMES and not folder.exists()
    if not dry_run and not Path(output).is_dir():
        beside: list[str] = []
        if Path(output).name == "meta.json" and not is_new_folder:
            from csplat.formats.sog.sog_writer import IMAGE_NAMES

            beside = [str(folder / name) for name in IMAGE_NAMES]
        out.check(str(folder) if is_new_folder else output, *beside, inputs=(source,))
    with out.bar() as progress:
        made = convert_file(
            source, output, read_as=read_as, write_as=write_as, level=chosen, max_splats=max_splats,
            overrides=overrides, filters=filters, no_loss=no_loss, dry_run=dry_run, preset=preset, progress=progress,
        )  # fmt: skip
    out.print_findings(made.findings)
    if made.source_count and not made.count:
        cause = " and ".join(["--crop"] * (crop is not None) + ["--drop-floaters"] * drop_floaters)
        note(f"warning: {cause} keeps none of {counted(made.source_count, 'splat')}: {output} has no splats")
    if made.lost_words():
        note(f"lost on the way: {made.lost_words()}")
    out.print_findings(made.losses)
    if crop is not None:
        cropped = made.source_count - made.floater_count - made.count
        out.remark(f"--crop: {cropped:,} of {counted(made.source_count, 'splat')} dropped")
    if drop_floaters:
        out.remark(
            f"--drop-floaters: {made.floater_count:,} of {counted(made.floater_count + made.count, 'splat')} dropped"
        )
    moving = {"--rotate": rotate, "--translate": translate, "--crop": crop}
    if given := [name for name, value in moving.items() if value is not None]:
        out.remark(f"{' and '.join(given)}: along {_filter_axes(source, made, chosen=to_axes is not None)}")
    before, after = made.axes
    if before != after:
        known = f"{before} axes" if before != UNSPECIFIED else f"no axes: {DEFAULT_AXES} is assumed, --axes sets others"
        which = "as given by --to-axes" if to_axes == after else f"as {made.target_format} has them"
        out.remark(f"turned to {after} axes, {which}; the source has {known}")
    size = "a size that depends on the scene" if made.size_bytes is None else format_bytes(made.size_bytes)
    in_levels = f" and {counted(len(made.levels) - 1, 'coarser level')}" if len(made.levels) > 1 else ""
    out.remark(
        f"{counted(made.count, 'splat')}{in_levels}: {made.source_format}, {format_bytes(made.source_bytes)}"
        f" -> {made.target_format}, {'about ' * (dry_run and made.size_bytes is not None)}{size}"
    )
    out.publish(made.as_json())


def _filter_axes(source: str, made: Conversion, *, chosen: bool) -> str:
    """Describe the axes of the filters; `chosen`: by --to-axes."""
    if chosen:
        return f"the axes x, y, z = {made.filter_axes} of --to-axes"
    if made.filter_axes == UNSPECIFIED:
        return f"x, y, z as {source} stores them, without stating which of them is up"
    return f"the axes of {source}, x, y, z = {made.filter_axes}; --to-axes chooses others"


_BOX_NUMBERS, _SPHERE_NUMBERS = 6, 4  # two corners; centre and radius


def _parse_filters(
    to_axes: str | None, rotate: str | None, scale: float | None, translate: str | None, crop: str | None
) -> Filters:
    """Return the filters for values of options.

    Raises:
        typer.BadParameter: a number or the axes are invalid.
    """
    if scale is not None and not (math.isfinite(scale) and scale > 0.0):
        raise typer.BadParameter(f"--scale is {scale:g}, expected a number above 0")
    turn, offset = shared.parse_numbers("--rotate", rotate, 3), shared.parse_numbers("--translate", translate, 3)
    region = shared.parse_numbers("--crop", crop, _BOX_NUMBERS, _SPHERE_NUMBERS)
    is_box = region is not None and len(region) == _BOX_NUMBERS
    if region is not None and not is_box and region[3] <= 0.0:
        raise typer.BadParameter(f"--crop has a radius of {region[3]:g}, expected one above 0")
    return Filters(
        to_axes=None if to_axes is None else shared.parse_axes(to_axes),
        rotate=None if turn is None else (turn[0], turn[1], turn[2]),
        scale=scale,
        translate=None if offset is None else (offset[0], offset[1], offset[2]),
        crop_box=region if is_box else None,
        crop_sphere=None if is_box else region,
    )
