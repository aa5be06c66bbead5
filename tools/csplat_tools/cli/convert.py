"""`csplat convert` and `csplat formats`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from csplat.editing.transform import DEFAULT_AXES
from csplat.errors import counted
from csplat.model import UNSPECIFIED
from csplat_tools.cli.command import OptionGroup, OutputOptions, command
from csplat_tools.cli.shared_options import OrientationOptions, ShDegree, parse_axes, parse_numbers
from csplat_tools.console import format_bytes, format_table, note
from csplat_tools.convert_file import Filters, convert_file, format_rows
from csplat_tools.file_streams import STANDARD_STREAM

_CHANGES = "Changes, in this order"
_COLUMNS = ("format", "endings", "read", "written", "SH degree", "axes", "exact", "has a place for")


@dataclass(frozen=True)
class _FilterOptions(OptionGroup):
    """Options that change the scene on its way."""

    to_axes: Annotated[
        str | None,
        typer.Option(metavar="RDF", rich_help_panel=_CHANGES, help="Turn it to these directions of +x, +y, +z."),
    ] = None
    rotate: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", rich_help_panel=_CHANGES, help="Degrees about x, then y, then z.")
    ] = None
    scale: Annotated[
        float | None, typer.Option(metavar="FACTOR", rich_help_panel=_CHANGES, help="So many times as large.")
    ] = None
    translate: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", rich_help_panel=_CHANGES, help="Move it, scene units.")
    ] = None
    crop_box: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z,X,Y,Z", rich_help_panel=_CHANGES, help="Keep what lies between two corners."),
    ] = None
    crop_sphere: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z,R", rich_help_panel=_CHANGES, help="Keep what lies in a sphere."),
    ] = None
    drop_floaters: Annotated[
        bool,
        typer.Option("--drop-floaters", rich_help_panel=_CHANGES, help="Drop splats that have next to no others near."),
    ] = False

    def parse(self) -> None:
        """Refuse invalid numbers and axes."""
        self.filters(None)

    def filters(self, sh_degree: int | None) -> Filters:
        """Return the filters that the options specify.

        Args:
            sh_degree: leave out the SH bands above; `None`: keep all.

        Raises:
            typer.BadParameter: a number or the axes are invalid.
        """
        if self.scale is not None and not (math.isfinite(self.scale) and self.scale > 0.0):
            raise typer.BadParameter(f"--scale is {self.scale:g}, wanted a number above 0")
        x, y, z = parse_numbers("--rotate", self.rotate, 3) or (0.0, 0.0, 0.0)
        a, b, c = parse_numbers("--translate", self.translate, 3) or (0.0, 0.0, 0.0)
        sphere = parse_numbers("--crop-sphere", self.crop_sphere, 4)
        if sphere is not None and sphere[3] <= 0.0:
            raise typer.BadParameter(f"--crop-sphere has a radius of {sphere[3]:g}, wanted one above 0")
        return Filters(
            to_axes=None if self.to_axes is None else parse_axes(self.to_axes),
            rotate=None if self.rotate is None else (x, y, z),
            scale=self.scale,
            translate=None if self.translate is None else (a, b, c),
            crop_box=parse_numbers("--crop-box", self.crop_box, 6),
            crop_sphere=sphere,
            drop_floaters=self.drop_floaters,
            sh_degree=sh_degree,
        )


@command(reads=True)
def convert(
    source: Annotated[str, typer.Argument(metavar="IN", help="A scene in any format that is read; a folder; or -.")],
    output: Annotated[str, typer.Argument(metavar="OUT", help="What to write; its name says the format.")],
    changes: _FilterOptions,
    upright: OrientationOptions,
    out: OutputOptions,
    sh_degree: ShDegree = None,
    write_as: Annotated[
        str | None, typer.Option("--to", metavar="FORMAT", hidden=True, help="Of OUT, if its name does not say it.")
    ] = None,
    level: Annotated[
        int, typer.Option(min=0, metavar="N", help="Of streamed SOG: 0 is the finest level, which is read by default.")
    ] = 0,
    no_loss: Annotated[bool, typer.Option("--no-loss", help="Refuse where anything would be lost.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be lost and how large it gets.")] = False,
) -> None:
    """Turn a scene in one format into another.

    `csplat formats` lists them. What is lost on the way is said in one line.
    For the best file of this project's own format use `csplat encode`, which
    has presets and targets.

    Examples:
      csplat convert scene.spz scene.ply
      csplat convert scene.ply scene.sog --drop-floaters
      csplat convert scene.ply small.spz --sh-degree 1 --crop-sphere 0,0,0,3
      csplat convert scene.ply scene.glb --dry-run
    """
    if output == STANDARD_STREAM:
        raise typer.BadParameter("OUT cannot be standard output: name a file")
    folder = Path(output).parent
    made_anew = Path(output).name == "meta.json" and not folder.exists()  # SOG as a folder
    if not dry_run and not Path(output).is_dir():
        out.check(str(folder) if made_anew else output, inputs=(source,))
    with out.bar() as progress:
        made = convert_file(
            source, output, write_as=write_as, level=level, overrides=upright.overrides(),
            filters=changes.filters(sh_degree), no_loss=no_loss, dry_run=dry_run, progress=progress,
        )  # fmt: skip
    out.print_findings(made.findings)
    if made.losses():
        note(f"lost on the way: {made.losses()}")
    before, after = made.axes
    if before != after:
        said = f"{before} axes" if before != UNSPECIFIED else f"no axes, taken as {DEFAULT_AXES} (--axes says others)"
        out.remark(f"turned to {after} axes, as {made.target_format} has them; the source has {said}")
    size = "a size that depends on the scene" if made.size_bytes is None else format_bytes(made.size_bytes)
    out.remark(
        f"{counted(made.count, 'splat')}: {made.source_format}, {format_bytes(made.source_bytes)}"
        f" -> {made.target_format}, {'about ' * (dry_run and made.size_bytes is not None)}{size}"
    )
    out.publish(made.as_json())


@command()
def formats(out: OutputOptions) -> None:
    """List the formats that are read and written, and what each has a place for.

    `exact`: what comes back bit for bit. `axes`: directions of +x, +y, +z
    that all files of a format have.

    Examples:
      csplat formats
      csplat formats --json
    """
    rows = format_rows()
    table = format_table(_COLUMNS, rows, left=len(_COLUMNS))
    out.publish([dict(zip(_COLUMNS, row, strict=True)) for row in rows], table)
