"""Options of the encoder, for every command that writes a .csplat file."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Annotated

import typer

from csplat.encoder import PRESETS, EncodeOptions, PresetName
from csplat_tools.cli.groups import Group
from csplat_tools.cli.options import chosen
from csplat_tools.cli.settings import Settings
from csplat_tools.cli.view_options import Upright
from csplat_tools.files.facts import SceneOverrides

_SCENE = "What the PLY may not say"

#: The dataclass whose fields `--set` takes for the encoder, as `module:name`.
ENCODER = "csplat.encoder.options:EncodeOptions"

Preset = Annotated[PresetName, typer.Option(metavar="|".join(PRESETS), help="Speed against size.")]


@dataclass(frozen=True)
class Facts(Upright):
    """Options of reading a PLY, and metadata that it may lack."""

    strict: Annotated[
        bool, typer.Option("--strict", hidden=True, help="Refuse a PLY with defects instead of repairing it.")
    ] = False
    keep_extra: Annotated[
        bool, typer.Option("--keep-extra", hidden=True, help="Carry columns that splats do not have, bit for bit.")
    ] = False
    unit_metres: Annotated[
        float | None,
        typer.Option(metavar="METRES", rich_help_panel=_SCENE, hidden=True, help="Length of one scene unit."),
    ] = None
    antialiased: Annotated[
        bool | None,
        typer.Option(
            "--antialiased/--no-antialiased", rich_help_panel=_SCENE, hidden=True, help="Trained with mip-splatting."
        ),
    ] = None
    licence: Annotated[
        str | None, typer.Option(metavar="TEXT", rich_help_panel=_SCENE, hidden=True, help="Into the metadata.")
    ] = None

    def read(self) -> SceneOverrides:
        """Return the metadata that the options specify."""
        return replace(self.upright(), unit_metres=self.unit_metres, antialiased=self.antialiased, licence=self.licence)


@dataclass(frozen=True)
class Encoding(Group):
    """Options of the encoder."""

    preset: Preset = "balanced"
    attribute_psnr: Annotated[
        float | None,
        typer.Option(metavar="DB", help="PSNR of each attribute alone; of pictures 5 to 12 less."),
    ] = None
    sh_degree: Annotated[int | None, typer.Option(metavar="0..3", help="Leave out SH bands above this one.")] = None
    grades: Annotated[
        int | None,
        typer.Option(
            metavar="1..5",
            hidden=True,
            help="Sort splats into so many grades at most, each with steps of its own, by what pictures lose: a target"
            " measures it, or --importance says it. 1 for one precision throughout.",
        ),
    ] = None
    deflate_level: Annotated[
        int | None, typer.Option(metavar="1..12", hidden=True, help="How hard DEFLATE tries; zlib stops at 9.")
    ] = None
    seed: Annotated[int, typer.Option(min=0, hidden=True, help="Seed of the clustering.")] = 0
    threads: Annotated[
        int | None,
        typer.Option(min=1, hidden=True, help="Threads, one per core by default; the bytes stay the same."),
    ] = None

    def options(self, facts: Facts, settings: Settings) -> EncodeOptions:
        """Return the options of the encoder.

        Args:
            facts: specifies whether extra columns are carried.
            settings: values of `--set`.

        Raises:
            typer.BadParameter: an option is out of its range.
        """
        own = {one.name: getattr(self, one.name) for one in fields(self)}
        return chosen(EncodeOptions, **own, **settings.of(EncodeOptions), keep_extra=facts.keep_extra)
