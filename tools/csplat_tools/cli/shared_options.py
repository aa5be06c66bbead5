# SPDX-License-Identifier: Apache-2.0
"""Arguments and options that several commands share, and parsers of their values.

Help texts are one line at 80 columns: what the option does, its unit, its default. Parsers raise `typer.BadParameter`
if a value is invalid.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer

from csplat._spec import MEASURE_NAMES
from csplat.disk_files import resolve_links
from csplat.encoder import PresetName, Target
from csplat.errors import CsplatError, InputError
from csplat.model import MAX_SH_DEGREE, SplatModel
from csplat.scene_metadata import Direction, check_axes, unit_up
from csplat_render import Backend, Mode
from csplat_render.up_estimate import estimate_up
from csplat_tools.cli.command_output import TRUSTS_PATHS, Output
from csplat_tools.console import NUMBER, note, print_data
from csplat_tools.file_streams import STANDARD_STREAM
from csplat_tools.scene_files import MetadataOverrides
from csplat_tools.views import VIRTUAL, DataOptions, Split, ViewSet, find_view_set

if TYPE_CHECKING:
    from csplat_tools.level_builder import LevelCount

T = TypeVar("T")
N = TypeVar("N", int, float, int | None, float | None)

_LEVEL = re.compile(r"(\d{1,15}(?:\.\d{1,15})?)(k|M)?", re.ASCII)
_LEVEL_MAX = 255  # largest level that the format has; larger numbers are numbers of splats
_LENGTHS = {"um": 1e-6, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3}  # metres
_NAMED_COLOURS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


def _print_full_help(context: typer.Context, requested: bool) -> None:
    """Print the help of a command with its hidden options, and exit, if requested."""
    if requested and not context.resilient_parsing:
        for option in context.command.params:
            option.hidden = False  # type: ignore[attr-defined]  # arguments have it, too
        print_data(context.get_help())  # empty if rich has printed it already
        raise typer.Exit


def hidden(option: Any) -> Any:
    """Return an option that only --help-all shows."""
    hidden_option = copy(option)
    hidden_option.hidden = True
    return hidden_option


# The options of every command
Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]
Report = Annotated[str | None, typer.Option(metavar="FILE", help="Write the result as JSON.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no remarks.")]
HelpAll = Annotated[
    bool,
    typer.Option("--help-all", is_eager=True, callback=_print_full_help, help="Show all options, and exit."),
]

# Scenes
SceneArgument = Annotated[
    str, typer.Argument(metavar="SCENE", help="A PLY, a .csplat file, another format of `convert`, or -.")
]
ReadAs = Annotated[
    str | None, typer.Option("--from", metavar="FORMAT", hidden=True, help="Format of IN. Default: by its content.")
]
_up = typer.Option("--up", metavar="-y|X,Y,Z", help="Up direction. Default: the scene's own.")
Up = Annotated[str | None, _up]
HiddenUp = Annotated[str | None, hidden(_up)]
ShDegree = Annotated[
    int | None, typer.Option("--sh-degree", metavar="0..4", help="Drop higher SH bands. Default: keep all.")
]
_level = typer.Option("--level", metavar="K|N", help="Level, or most splats: 1, 500k. Default: 0.")
Level = Annotated[str | None, _level]
HiddenLevel = Annotated[str | None, hidden(_level)]
LimitSplats = Annotated[int | None, typer.Option(metavar="N", min=1, help="Refuse larger scenes. Default: no limit.")]
SourceIndexOutput = Annotated[
    str | None,
    typer.Option("--source-index", metavar="FILE.npy", hidden=True, help="Write the source index of each splat."),
]
SourceIndexInput = Annotated[
    str | None, typer.Option("--source-index", metavar="FILE.npy", help="File of `encode --source-index`.")
]

# Views; hidden options are for commands that rarely need them
_cameras = typer.Option("--cameras", metavar="FILE.json", help="Test views. Default: virtual ones.")
_background = typer.Option("--background", metavar="R,G,B", help="Background. Default: the training's.")
Cameras = Annotated[str | None, _cameras]
HiddenCameras = Annotated[str | None, hidden(_cameras)]
Data = Annotated[str | None, typer.Option(metavar="DATA", help="Data set of the training. Default: none.")]
Background = Annotated[str | None, _background]
HiddenBackground = Annotated[str | None, hidden(_background)]
TestEvery = Annotated[int | None, typer.Option(metavar="N", hidden=True, help="Hold out every Nth image. Default: 8.")]
RendererName = Literal["cpu", "exact", "fast", "gpu", "auto", "software"]
BackendOption = Annotated[
    RendererName,
    typer.Option("--backend", metavar="NAME", show_default=False, help="cpu, exact, fast, gpu, auto. Default: cpu."),
]

# Encoding, training, tuning
Preset = Annotated[
    PresetName, typer.Option(metavar="PRESET", show_default=False, help="fast, balanced, small. Default: balanced.")
]
SmallPreset = Annotated[
    PresetName | None, typer.Option("--preset", metavar="PRESET", help="fast, balanced, small. Default: small.")
]
TargetPsnr = Annotated[str | None, typer.Option(metavar="DB", help="Least PSNR, e.g. 40dB. Default: none.")]
TargetSize = Annotated[str | None, typer.Option(metavar="BYTES", help="Largest file, e.g. 5MB. Default: none.")]
MaxPsnrDrop = Annotated[str | None, typer.Option(metavar="DB", help="Largest loss on images, e.g. 0.3dB.")]
_effort = typer.Option("--effort", metavar="1..5", help="Work for fewer bytes. Default: 3.")
Effort = Annotated[int | None, _effort]
HiddenEffort = Annotated[int | None, hidden(_effort)]
_keep = typer.Option("--keep", metavar="FRACTION", help="Fraction of splats to keep, e.g. 0.5.")
Keep = Annotated[float | None, _keep]
HiddenKeep = Annotated[float | None, hidden(_keep)]
Page = Annotated[str | None, typer.Option(metavar="FILE.html", help="Write an HTML report.")]
Checkpoint = Annotated[
    str | None,
    typer.Option(metavar="FILE.npz", hidden=True, help="Checkpoints, one a minute. Default: OUT.npz, removed."),
]
Resume = Annotated[
    str | None, typer.Option(metavar="FILE.npz", hidden=True, help="Go on from a checkpoint. Default: none.")
]
HiddenMemory = Annotated[
    str | None, typer.Option("--memory", metavar="BYTES", hidden=True, help="E.g. 8GB. Default: half of what is free.")
]
_scheduler = typer.Option("--scheduler", metavar="ADDRESS", help="Dask cluster, tcp://host:8786. Default: none.")
Scheduler = Annotated[str | None, _scheduler]
HiddenScheduler = Annotated[str | None, hidden(_scheduler)]
HiddenDryRun = Annotated[bool, typer.Option("--dry-run", hidden=True, help="Estimate size, time and memory only.")]


def parse_level(text: str | None) -> tuple[int, int | None]:
    """Return the level of detail and the maximum number of splats, of which only one is set, for a value of `Level`.

    Args:
        text: a level, 0 to 255; or a number of splats above, or with k or M for thousands or millions.
    """
    match = _LEVEL.fullmatch("0" if text is None else text)
    factor = {None: 1, "k": 1_000, "M": 1_000_000}[match[2]] if match else 0
    if match is None or (factor == 1 and "." in match[1]):
        raise typer.BadParameter(f"--level is {text}, expected a level, as in 1, or a number of splats, as in 500k")
    number = round(float(match[1]) * factor)
    return (number, None) if factor == 1 and number <= _LEVEL_MAX else (0, number)


def parse_backend(name: RendererName, out: Output) -> tuple[Mode, Backend]:
    """Return the mode and the backend of a renderer. For `auto`, remark if there is no GPU.

    Args:
        name: `cpu`; its slow and fast modes, `exact` and `fast`; `gpu`; `auto`, a GPU if there is one; or
            `software`, the GPU's shaders on the CPU.
        out: the command's output.

    Raises:
        InputError: there is no GPU.
    """
    if name == "cpu" or name == "exact" or name == "fast":
        return ("standard" if name == "cpu" else name), "cpu"
    from csplat_render.gpu.device import find_device

    device, reason = find_device(name)
    out.remark(f"rendering on {device.adapter}" if device else f"{reason}: rendering on the CPU")
    return "standard", name if device else "cpu"


def refuse_together(*groups: Mapping[str, object]) -> None:
    """Refuse options that exclude each other: several of a single group, or options of different groups.

    Args:
        groups: option values by spelling; `None` and False: not given.

    Raises:
        typer.BadParameter: such options are given.
    """
    given = [_given(group) for group in groups]
    both = given[0] if len(groups) == 1 else [names[0] for names in given if names]
    if len(both) > 1:
        raise typer.BadParameter(f"{' and '.join(both)}: give one of them")


def require_one(options: Mapping[str, object], required: Mapping[str, object]) -> None:
    """Refuse options that have no effect unless a required option is given.

    Raises:
        typer.BadParameter: such an option is given, and no required option.
    """
    given = _given(options)
    if given and not _given(required):
        raise typer.BadParameter(f"{given[0]} requires {' or '.join(required)}")


def _given(options: Mapping[str, object]) -> list[str]:
    return [name for name, value in options.items() if value is not None and value is not False]


def checked(kind: Callable[..., T], *args: Any, **values: Any) -> T:
    """Call a function of the library with values of options.

    Raises:
        typer.BadParameter: the library refuses them.
    """
    try:
        return kind(*args, **values)
    except InputError as error:
        raise typer.BadParameter(str(error)) from None


def describe_estimated_up(up: Direction) -> str:
    """Return the clause of remarks about an estimated up direction, such as `z`."""
    return f"the scene does not specify its up direction; {up_word(up)} is estimated"


def open_data(path: str, **options: Any) -> DataOptions:
    """Return the options of a data set, including the program's."""
    return DataOptions(path, trust_paths=TRUSTS_PATHS.get(), **options)


@dataclass(frozen=True)
class ViewOptions:
    """Views of a camera file or a data set, or virtual views without either.

    Attributes:
        cameras: a camera file.
        data: a data set, or its folder of images.
        background: background colour, see `parse_colour`; `None`: as in training.
        test_every: every Nth image was held out; `None`: as in training.

    Raises:
        typer.BadParameter: both are given, or the colour is invalid.
    """

    cameras: str | None = None
    data: str | None = None
    background: str | None = None
    test_every: int | None = None

    def __post_init__(self) -> None:
        refuse_together({"--cameras": self.cameras, "--data": self.data})
        _ = self.colour

    @property
    def inputs(self) -> tuple[str | None, str | None]:
        """Files that are read: the camera file and the data set."""
        return self.cameras, self.data

    @property
    def colour(self) -> tuple[float, float, float] | None:
        """Background colour, red, green, blue, 0 to 1; `None`: the default."""
        return None if self.background is None else parse_colour(self.background)

    @property
    def data_options(self) -> DataOptions | None:
        """The options of the data set; `None` without one."""
        return None if self.data is None else open_data(self.data, test_every=self.test_every)

    def find(
        self,
        model: SplatModel,
        output: Output,
        path: str,
        *,
        count: int | None = None,
        size: tuple[int, int] | None = None,
        validation_count: int | None = None,
        split: Split = "test",
        every: int = 1,
        must_fit: bool = True,
    ) -> ViewSet:
        """Find views of a scene, and print remarks about them.

        Args:
            model: the scene.
            output: prints remarks.
            path: the scene's file.
            count, size, validation_count, split, every: as for `find_view_set`.
            must_fit: refuse a data set that the scene does not fit, instead of a remark.

        Returns:
            The views by role; virtual views if there is neither a camera file nor a data set.

        Raises:
            InputError: the given views are not valid, or too few.
            OSError: a file cannot be read.
        """
        view_set = find_view_set(
            model, cameras=self.cameras, data=self.data_options, background=self.colour, count=count, size=size,
            validation_count=validation_count, split=split, every=every, path=path,
        )  # fmt: skip
        output.remark(*(note for note in view_set.notes if not (must_fit and note == view_set.misfit)))
        if must_fit:
            view_set.require_fit()
        axis = None if output.quiet or view_set.name != VIRTUAL else estimate_up(model, every)
        if axis is not None:
            output.remark(
                f"views are placed for -y up, since {describe_estimated_up(axis)}: "
                f"`csplat convert IN.ply OUT.ply --up {up_word(axis)}` writes it, and changes views and PSNR"
            )
        return view_set


def parse_overrides(up: str | None, axes: str | None = None, **fields: Any) -> MetadataOverrides:
    """Return overrides of a scene's metadata.

    Args:
        up: the up direction, see `parse_up`.
        axes: the axes, see `parse_axes`.
        fields: other fields of `MetadataOverrides`.
    """
    return MetadataOverrides(
        None if axes is None else parse_axes(axes), up=None if up is None else parse_up(up), **fields
    )


def parse_size(text: str) -> tuple[int, int]:
    """Parse width and height from `640x480`."""
    match = re.fullmatch(r"([1-9][0-9]{0,4})[xX]([1-9][0-9]{0,4})", text.strip())
    if match is None:
        raise typer.BadParameter(f"a size is {text!r}, expected width and height in pixels, as 640x480")
    return int(match[1]), int(match[2])


def parse_numbers(option: str, text: str | None, *counts: int) -> tuple[float, ...] | None:
    """Parse finite numbers from text such as `1,0.5,-2`; return `None` for `None`.

    Args:
        option: the option, for the message.
        text: its value.
        counts: valid numbers of numbers.
    """
    if text is None:
        return None
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
        count = " or ".join(map(str, counts))
        raise typer.BadParameter(f"{option} is {text!r}, expected {count} numbers with commas between them")
    return numbers


def parse_colour(text: str) -> tuple[float, float, float]:
    """Parse red, green and blue, 0 to 1, from `1,0.5,0`, `black` or `white`."""
    if text.lower() in _NAMED_COLOURS:
        return _NAMED_COLOURS[text.lower()]
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 3 or not all(math.isfinite(value) and 0.0 <= value <= 1.0 for value in values):
        raise typer.BadParameter(f"a colour is {text!r}, expected red,green,blue from 0 to 1, or black, or white")
    red, green, blue = values
    return red, green, blue


def parse_up(text: str) -> Direction:
    """Parse a direction from `y`, `-y`, or `0,-1,0.1`, and return it at unit length."""
    match = re.fullmatch(r"([+-]?)([xyz])", text.strip().lower())
    if match is not None:
        x, y, z = ((-1.0 if match[1] == "-" else 1.0) * (match[2] == axis) + 0.0 for axis in "xyz")
        return x, y, z
    try:
        return unit_up([float(part) for part in text.split(",")])
    except (ValueError, InputError):
        raise typer.BadParameter(
            f"up is {text!r}, expected x, -x, y, -y, z, -z, or three numbers as 0,-1,0.1"
        ) from None


def up_word(axis: Direction) -> str:
    """Return a direction in the form that `parse_up` accepts: an axis, or three numbers."""
    along = [k for k, value in enumerate(axis) if value]
    if len(along) != 1:
        return ",".join(f"{value:.3g}" for value in axis)
    return ("-" if axis[along[0]] < 0.0 else "") + "xyz"[along[0]]


def parse_axes(text: str) -> str:
    """Check axes: three letters, the directions of +x, +y and +z."""
    checked(check_axes, text)
    return text


def parse_sh_degree(degree: int | None) -> int | None:
    """Check an SH degree: 0 to 4."""
    return check_range("--sh-degree", degree, 0, MAX_SH_DEGREE)


def check_range(option: str, value: N, low: float, high: float) -> N:
    """Return the value of an option."""
    if value is not None and not low <= value <= high:
        raise typer.BadParameter(f"{option} is {value:g}, expected {low:g} to {high:g}")
    return value


def is_same_file(a: str | None, b: str | None) -> bool:
    """Return True if two paths are given and lead to the same place."""
    return a is not None and b is not None and resolve_links(a) == resolve_links(b)


def command_line(context: typer.Context, chosen: Mapping[str, str], *omitted: str) -> str:
    """Return the current command with its options, but with the chosen ones, and without the omitted ones.

    Args:
        context: the command's context.
        chosen: values by option.
        omitted: options.
    """
    words = ["csplat", *(["--trust-paths"] if TRUSTS_PATHS.get() else []), context.command.name or ""]
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if source is None or source.name != "COMMANDLINE":
            continue
        value, name = context.params.get(parameter.name or ""), parameter.opts[0]
        if parameter.param_type_name == "argument":
            words.append(str(value))
        elif name not in omitted and name not in chosen:
            words += [name] if value is True else [name, str(value)]
    return shlex.join([*words, *(word for pair in chosen.items() for word in pair)])


@contextmanager
def run_checkpoint(
    context: typer.Context,
    checkpoint: str | None,
    resume: str | None,
    output: str,
    others: Callable[[str], Sequence[Path]] = lambda _: (),
    *,
    keep_refused: bool = False,
) -> Iterator[str | None]:
    """Yield the path of a run's checkpoint: that of --checkpoint, or OUT.npz.

    OUT.npz and further checkpoints are removed when the run has succeeded, but no file that an option names.

    Args:
        context: the command's context.
        checkpoint, resume: the options.
        output: the file that the run writes.
        others: returns the paths of further checkpoints of the run, from that of the first.
        keep_refused: keep OUT.npz of a run that is refused after some steps, as for a target that it cannot meet.

    Raises:
        InputError: an earlier run has left OUT.npz, and --resume does not name it.
    """
    path = checkpoint if checkpoint is not None or output == STANDARD_STREAM else f"{output}.npz"
    if path is None:
        yield None
        return
    is_named = checkpoint is not None or is_same_file(path, resume)
    if not is_named and Path(path).exists():
        raise InputError(f"{path} is left from an earlier run: continue with --resume {path}, or remove it")
    further = [*others(path)]
    removed = further if is_named else [Path(path), *further]
    try:
        yield path
    except BaseException as error:
        is_refused = isinstance(error, CsplatError)
        if is_named and is_refused:
            removed = []
        elif Path(path).exists() and (keep_refused or not is_refused):
            removed = further if is_refused else []
            kept = [file for file in (Path(path), *further) if file.exists() and file not in removed]
            holds = ", ".join(map(_describe_checkpoint, kept))
            again = command_line(context, {"--resume": path}, "--time")
            note(f"{holds}: --resume {path} continues from them" if is_refused else f"{holds}; to continue: {again}")
        raise
    finally:
        for file in removed:
            file.unlink(missing_ok=True)


def _describe_checkpoint(path: Path) -> str:
    """Return the clause of messages about a checkpoint."""
    from csplat_trainer.fit_checkpoint import count_steps

    steps = count_steps(path)
    return f"{path} holds " + ("the finished steps" if steps is None else f"{steps[0]:,} of {steps[1]:,} steps")


def parse_decibels(text: str | None, option: str) -> float | None:
    """Parse a finite number of decibels: `0.3`, `0.3dB`, `0.3 dB`; return `None` for `None`."""
    if text is None:
        return None
    number = text.strip()
    if number.lower().endswith("db"):
        number = number[:-2]
    try:
        value = float(number)
    except ValueError:
        raise typer.BadParameter(f"{option} is {text!r}, expected decibels, as 0.3 or 0.3dB") from None
    if not math.isfinite(value):
        raise typer.BadParameter(f"{option} is {text!r}, expected a finite number of decibels")
    return value


def parse_target(
    *,
    psnr: str | None = None,
    size: str | None = None,
    max_psnr_drop: str | None = None,
    keep: float | None = None,
    max_error: str | None = None,
    prune: bool = True,
    effort: int | None = None,
) -> Target | None:
    """Return the target of a command; `None` if no option specifies one.

    Lengths with a unit in `max_error` are parsed as if a scene unit were a metre; see `parse_max_error`.
    """
    decibels = parse_decibels(psnr, "--target-psnr"), parse_decibels(max_psnr_drop, "--max-psnr-drop")
    bounds = {} if max_error is None else checked(parse_max_error, max_error, 1.0)
    if not bounds and all(value is None for value in (*decibels, size, keep)):
        return None
    return checked(
        Target, decibels[0], size, decibels[1], keep, bounds, prune,
        Target.effort if effort is None else effort,
    )  # fmt: skip


def parse_levels(text: str | None) -> LevelCount:
    """Parse a number of levels of detail, `auto` or `merged`; return `None` for `None` and `none`."""
    from csplat_tools.level_builder import LEVELS_MAX  # takes 10 ms, which other commands do without

    if text is None or text == "none":
        return None
    if text == "auto" or text == "merged":
        return text  # type: ignore[return-value]  # mypy does not narrow a str by ==
    if not re.fullmatch(r"[0-9]{1,9}", text) or not 1 <= int(text) <= LEVELS_MAX:
        raise typer.BadParameter(f"--levels is {text}, expected auto, merged, 1 to {LEVELS_MAX} or none")
    return int(text)


def parse_max_error(text: str, unit_metres: float | None) -> dict[str, float]:
    """Parse bounds by measure from `means=0.001,opacities=0.01`.

    Args:
        text: the user's text; lengths may have a unit, such as `means=2mm`, if the scene's unit is known. `0` is the
            bound of all measures.
        unit_metres: length of a scene unit in metres; `None` if unknown.

    Raises:
        InputError: the text is invalid; or a length has a unit, and the scene's unit is unknown.
    """
    bounds: dict[str, float] = {}
    if text.strip() == "0":
        return dict.fromkeys(MEASURE_NAMES.values(), 0.0)
    for part in text.split(","):
        name, _, value = part.partition("=")
        name = name.strip()
        match = re.fullmatch(NUMBER + r"\s*([a-zµ]*)", value.strip().lower())
        if match is None:
            raise InputError(f"{part.strip()!r} is not an error bound, expected a measure and a number: means=0.001")
        if name in bounds:
            raise InputError(f"the largest error of {name} is given twice")
        bounds[name] = float(match[1]) * _unit_factor(part.strip(), name, match[2], unit_metres)
    return bounds


def _unit_factor(part: str, name: str, unit: str, unit_metres: float | None) -> float:
    """Return the factor that converts a number with a unit to scene units.

    Args:
        part: the user's text, for messages.
        name: the measure; only `means` has a unit.
        unit: the unit; empty for scene units.
        unit_metres: length of a scene unit in metres; `None` if unknown.

    Raises:
        InputError: the unit is unknown or not allowed, or the scene's unit is unknown.
    """
    if not unit:
        return 1.0
    if name != "means" or unit not in _LENGTHS:
        expected = f"one of {', '.join(_LENGTHS)}" if name == "means" else "no unit, since it is not a length"
        raise InputError(f"{part!r} has the unit {unit!r}, expected {expected}")
    if unit_metres is None:
        raise InputError(
            f"{part!r} has a unit, and the length of a scene unit is unknown: use scene units (means=0.001), or set"
            " --unit-metres"
        )
    return _LENGTHS[unit] / unit_metres
