"""Options that several commands share."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, ClassVar

import typer

from csplat.editing.up_axis import Direction, unit_up
from csplat.encoder import PRESETS, EncodeOptions, PresetName
from csplat.errors import InputError
from csplat.model import SplatModel, check_axes
from csplat_render import Mode
from csplat_render.up_estimate import estimate_up
from csplat_tools.cli.command import LibrarySettings, OptionGroup, OutputOptions, chosen
from csplat_tools.console import parse_size_bytes
from csplat_tools.scene_files import MetadataOverrides
from csplat_tools.views import VIRTUAL, DataOptions, Split, ViewSet, find_view_set

_NAMED = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
_SCENE = "Metadata that a PLY may lack"
_DATA = "Photographs of --data (default: as in training)"
_VIEWS = "Views (default: virtual ones)"

#: The dataclass whose fields `--set` takes for the encoder, as `module:name`.
ENCODER_SETTINGS = "csplat.encoder.encode_options:EncodeOptions"

SceneArgument = Annotated[
    str, typer.Argument(metavar="SCENE", help="A PLY, a .csplat file, another of `csplat formats`, or -.")
]


Seed = Annotated[int, typer.Option(min=0, hidden=True, help="Seed of all random choices. Default: 0.")]
#: Arguments of `typer.Option` for --effort; commands add a panel.
EFFORT: dict[str, Any] = {
    "metavar": "1..9", "min": 1, "max": 9, "show_default": False, "help": "Work for fewer bytes. Default: 3."
}  # fmt: skip
Threads = Annotated[
    int | None, typer.Option(min=1, hidden=True, help="Threads, which do not change the result. Default: one per core.")
]
ModeOption = Annotated[
    Mode, typer.Option(metavar="exact|standard|fast", help="Accuracy of the renderer against its speed.")
]
LpipsOption = Annotated[
    str | None, typer.Option(metavar="WEIGHTS.npz", help="Compute LPIPS (Alex) with these weights, or with `auto`.")
]
ShDegree = Annotated[int | None, typer.Option(metavar="0..3", min=0, max=3, help="Leave out SH bands above this one.")]
SourceIndex = Annotated[
    str | None,
    typer.Option(
        metavar="FILE.npy", hidden=True, help="Write the index of the source splat of each splat of the result."
    ),
]
Importance = Annotated[
    str | None,
    typer.Option(
        metavar="FILE",
        hidden=True,
        help="Importance of each splat: a file of `csplat sensitivity`, or weights (.npy) of the splats as read.",
    ),
]
Checkpoint = Annotated[
    str | None, typer.Option(metavar="FILE.npz", hidden=True, help="Write checkpoints to this file.")
]
CheckpointEvery = Annotated[
    int,
    typer.Option(
        metavar="N", min=0, hidden=True, help="Steps from one checkpoint to the next; 0: only at the end. Default: 0."
    ),
]
Resume = Annotated[str | None, typer.Option(metavar="FILE.npz", hidden=True, help="Continue from this checkpoint.")]
ByteCost = Annotated[
    float | None,
    typer.Option(
        "--lambda",
        metavar="COST",
        help="Weight of a bit per splat in the loss. Default: 1e-4; a target finds its own.",
    ),
]


Preset = Annotated[PresetName, typer.Option(metavar="|".join(PRESETS), help="Speed against size.")]
SplitOption = Annotated[
    Split,
    typer.Option(metavar="test|train", rich_help_panel=_DATA, help="Photographs to use as test views. Default: test."),
]
Near = Annotated[
    float | None,
    typer.Option(metavar="UNITS", rich_help_panel=_DATA, hidden=True, help="Near plane of the cameras, scene units."),
]


@dataclass(frozen=True)
class OrientationOptions(OptionGroup):
    """Options of the scene's orientation, which override its own."""

    up: Annotated[str | None, typer.Option(metavar="-y|X,Y,Z", help="Direction that is up.")] = None
    axes: Annotated[
        str | None, typer.Option(metavar="RDF", hidden=True, help="Directions of +x, +y, +z: R/L, U/D, F/B.")
    ] = None

    def parse(self) -> None:
        """Refuse an invalid direction or axes."""
        self.overrides()

    def overrides(self) -> MetadataOverrides:
        """Return the given up direction and axes, as overrides of the scene's own."""
        up = None if self.up is None else parse_up(self.up)
        return MetadataOverrides(None if self.axes is None else parse_axes(self.axes), up=up)

    def take_estimated_up(
        self, axis: Direction | None, output: OutputOptions, *, shown: bool = True
    ) -> Direction | None:
        """Return the estimated up direction, with a remark, if neither the user nor the scene specifies one.

        Args:
            axis: the estimate of `estimate_up`; `None`: there is none.
            output: prints remarks.
            shown: True if the command's result shows the scene with this direction up.
        """
        if axis is None or (self.up, self.axes) != (None, None):
            return None
        word = up_word(axis)
        output.remark(
            f"the scene does not specify its up direction; {word} is estimated"
            + (", and used (encode --up writes it into a file)" if shown else f": --up {word} writes it")
        )
        return axis


@dataclass(frozen=True)
class ViewOptions(OptionGroup):
    """Views of a camera file or a data set."""

    one_of: ClassVar[Sequence[tuple[str, ...]]] = (("cameras", "data"),)
    needs: ClassVar[Mapping[str, tuple[str, ...]]] = dict.fromkeys(("size", "images", "test_every"), ("data",))

    cameras: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.json",
            rich_help_panel=_VIEWS,
            help="Test views; of 40 or more most are for training.",
        ),
    ] = None
    data: Annotated[
        str | None,
        typer.Option(
            metavar="DATA",
            rich_help_panel=_VIEWS,
            help="Photographs for training, held-out ones for test.",
        ),
    ] = None
    background: Annotated[
        str | None,
        typer.Option(
            metavar="R,G,B",
            rich_help_panel=_VIEWS,
            hidden=True,
            help="Background colour. Default: black; with --data or --cameras, that of training.",
        ),
    ] = None
    size: Annotated[
        str | None,
        typer.Option(metavar="WxH", rich_help_panel=_DATA, hidden=True, help="Scale photographs to this size, pixels."),
    ] = None
    images: Annotated[
        str | None,
        typer.Option(metavar="NAME", rich_help_panel=_DATA, hidden=True, help="Folder of images, such as images_4."),
    ] = None
    test_every: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            rich_help_panel=_DATA,
            hidden=True,
            help="Every Nth photograph was held out. Default: as in training, or 8.",
        ),
    ] = None

    def parse(self) -> None:
        """Refuse an invalid colour or size."""
        _ = self.colour, None if self.size is None else parse_size(self.size)

    @property
    def inputs(self) -> tuple[str | None, str | None]:
        """Files that are read: the camera file and the data set."""
        return self.cameras, self.data

    @property
    def colour(self) -> tuple[float, float, float] | None:
        """Background colour, red, green, blue, 0 to 1; `None`: the default."""
        return None if self.background is None else parse_colour(self.background)

    def data_options(self, near: float | None = None) -> DataOptions | None:
        """Return the options of the data set; `None` without one.

        Args:
            near: near plane of the photographs; `None`: one that suits.
        """
        size = None if self.size is None else parse_size(self.size)
        return None if self.data is None else DataOptions(self.data, size, self.images, self.test_every, near)

    def find(
        self, model: SplatModel, output: OutputOptions, *, near: float | None = None, every: int = 1, **how: Any
    ) -> ViewSet:
        """Find views of a scene, and print remarks about them.

        Args:
            model: the scene.
            output: prints remarks.
            near: near plane of the photographs; `None`: one that suits.
            every: as for `find_view_set`.
            how: other arguments of `find_view_set`, which defines their defaults.
        """
        data = self.data_options(near)
        found = find_view_set(model, cameras=self.cameras, data=data, background=self.colour, every=every, **how)
        output.remark(*found.notes)
        axis = None if output.quiet or found.name != VIRTUAL else estimate_up(model, every)
        if axis is not None:
            word = up_word(axis)
            output.remark(
                f"views are placed for -y up, since the scene does not specify its up direction; {word} is estimated:"
                f" `csplat convert IN.ply OUT.ply --up {word}` writes it, and changes views and PSNR"
            )
        return found


@dataclass(frozen=True)
class VirtualViewOptions(OptionGroup):
    """Options of the virtual training views."""

    views: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, hidden=True, rich_help_panel=_VIEWS, help="Virtual training views, at most."),
    ] = None
    view_size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH", hidden=True, rich_help_panel=_VIEWS, help="Approximate size of training renders, pixels."
        ),
    ] = None

    def parse(self) -> None:
        """Refuse an invalid size."""
        self.given()

    def given(self) -> dict[str, Any]:
        """Return the options that are given, as arguments of `find_view_set`."""
        size = None if self.view_size is None else parse_size(self.view_size)
        return {name: value for name, value in (("count", self.views), ("size", size)) if value is not None}


@dataclass(frozen=True)
class SourceOptions(OrientationOptions):
    """Options of reading a scene, and metadata that it may lack."""

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
        str | None, typer.Option(metavar="TEXT", rich_help_panel=_SCENE, hidden=True, help="Licence, for the metadata.")
    ] = None

    def read(self) -> MetadataOverrides:
        """Return the metadata that the options specify."""
        return replace(
            self.overrides(), unit_metres=self.unit_metres, antialiased=self.antialiased, licence=self.licence
        )


@dataclass(frozen=True)
class EncodingOptions(OptionGroup):
    """Options of the encoder."""

    preset: Preset = "balanced"
    attribute_psnr: Annotated[
        float | None,
        typer.Option(metavar="DB", help="PSNR of each attribute; renders have 5 to 12 dB less."),
    ] = None
    sh_degree: Annotated[int | None, typer.Option(metavar="0..3", help="Leave out SH bands above this one.")] = None
    max_classes: Annotated[
        int | None,
        typer.Option(
            metavar="1..5",
            hidden=True,
            help="Quantisation classes at most, into which a target or --importance sorts splats; 1: one precision.",
        ),
    ] = None
    deflate_level: Annotated[
        int | None, typer.Option(metavar="1..12", hidden=True, help="Level of DEFLATE; zlib has 9 at most.")
    ] = None
    seed: Annotated[int, typer.Option(min=0, hidden=True, help="Seed of the clustering. Default: 0.")] = 0
    threads: Annotated[
        int | None,
        typer.Option(min=1, hidden=True, help="Threads, which do not change the bytes. Default: one per core."),
    ] = None

    def options(self, source_options: SourceOptions, settings: LibrarySettings) -> EncodeOptions:
        """Return the options of the encoder.

        Args:
            source_options: specifies whether extra columns are carried.
            settings: values of `--set`.

        Raises:
            typer.BadParameter: an option is out of its range.
        """
        own = {one.name: getattr(self, one.name) for one in fields(self)}
        return chosen(EncodeOptions, **own, **settings.of(EncodeOptions), keep_extra=source_options.keep_extra)


def parse_size(text: str) -> tuple[int, int]:
    """Parse width and height from `640x480`.

    Raises:
        typer.BadParameter: the text is not a size.
    """
    found = re.fullmatch(r"([1-9][0-9]{0,4})[xX]([1-9][0-9]{0,4})", text.strip())
    if found is None:
        raise typer.BadParameter(f"a size is {text!r}, wanted width and height in pixels, as 640x480")
    return int(found[1]), int(found[2])


def parse_bytes(text: str | None) -> int | None:
    """Parse a number of bytes from `2GB`; return `None` for `None`.

    Raises:
        InputError: the text is not a size.
    """
    return None if text is None else parse_size_bytes(text)


def parse_numbers(option: str, text: str | None, count: int) -> tuple[float, ...] | None:
    """Parse `count` finite numbers from text such as `1,0.5,-2`; return `None` for `None`.

    Raises:
        typer.BadParameter: the text is not that many finite numbers.
    """
    if text is None:
        return None
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise typer.BadParameter(f"{option} is {text!r}, wanted {count} numbers with commas between them")
    return numbers


def parse_colour(text: str) -> tuple[float, float, float]:
    """Parse red, green and blue, 0 to 1, from `1,0.5,0`, `black` or `white`.

    Raises:
        typer.BadParameter: the text is not a colour.
    """
    if text.lower() in _NAMED:
        return _NAMED[text.lower()]
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 3 or not all(math.isfinite(value) and 0.0 <= value <= 1.0 for value in values):
        raise typer.BadParameter(f"a colour is {text!r}, wanted red,green,blue from 0 to 1, or black, or white")
    red, green, blue = values
    return red, green, blue


def parse_up(text: str) -> Direction:
    """Parse a direction from `y`, `-y`, or `0,-1,0.1`, and return it at unit length.

    Raises:
        typer.BadParameter: the text is not a direction.
    """
    found = re.fullmatch(r"([+-]?)([xyz])", text.strip().lower())
    if found is not None:
        x, y, z = ((-1.0 if found[1] == "-" else 1.0) * (found[2] == axis) + 0.0 for axis in "xyz")
        return x, y, z
    try:
        return unit_up([float(part) for part in text.split(",")])
    except (ValueError, InputError):
        raise typer.BadParameter(f"up is {text!r}, wanted x, -x, y, -y, z, -z, or three numbers as 0,-1,0.1") from None


def up_word(axis: Direction) -> str:
    """Return an axis, or its opposite, as `parse_up` takes it."""
    at = next(k for k, value in enumerate(axis) if value)
    return ("-" if axis[at] < 0.0 else "") + "xyz"[at]


def parse_axes(text: str) -> str:
    """Check axes: three letters, the directions of +x, +y and +z.

    Raises:
        typer.BadParameter: the text is not such axes.
    """
    try:
        check_axes(text)
    except InputError as error:
        raise typer.BadParameter(str(error)) from None
    return text


def parse_decibels(text: str) -> float:
    """Parse a number of decibels: `0.3`, `0.3dB`, `0.3 dB`.

    Raises:
        typer.BadParameter: the text is not a number of decibels.
    """
    number = text.strip()
    if number.lower().endswith("db"):
        number = number[:-2]
    try:
        return float(number)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no number of decibels, wanted 0.3 or 0.3dB") from None
