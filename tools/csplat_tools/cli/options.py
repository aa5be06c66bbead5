"""Build commands from functions with groups of options, which are declared once and checked in one place.

A command is a function whose parameters are arguments, options, and groups of options: subclasses of `Group`.
`command` turns it into a function for typer: each group arrives as one typed value, and declares itself which options
exclude each other or require another one.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from copy import copy
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import typer
from typer.models import OptionInfo

from csplat.errors import InputError
from csplat.formats import insisting
from csplat_render import Mode
from csplat_tools.cli.console import guarded
from csplat_tools.cli.groups import Group, Output
from csplat_tools.cli.settings import Settings, describe_settings, read_settings
from csplat_tools.files.console import progress_bar, say
from csplat_tools.files.streams import STANDARD_STREAM

Scene = Annotated[
    str, typer.Argument(metavar="SCENE", help="A PLY, a .csplat file, another of `csplat formats`, or -.")
]
Seed = Annotated[int, typer.Option(min=0, hidden=True, help="Of all random choices.")]
#: Arguments of `typer.Option` for --effort; commands add a panel.
EFFORT: dict[str, Any] = {
    "metavar": "1..9", "min": 1, "max": 9, "show_default": False, "help": "Work for fewer bytes, usually 3."
}  # fmt: skip
Threads = Annotated[
    int | None, typer.Option(min=1, hidden=True, help="One per core by default; the result stays the same.")
]
ModeWord = Annotated[Mode, typer.Option(metavar="exact|standard|fast", help="Of the renderer: speed for accuracy.")]
Lpips = Annotated[
    str | None, typer.Option(metavar="WEIGHTS.npz", help="Compute LPIPS (Alex) with these weights, or with `auto`.")
]
ShDegree = Annotated[int | None, typer.Option(metavar="0..3", min=0, max=3, help="Leave out SH bands above this one.")]
SourceIndex = Annotated[
    str | None,
    typer.Option(metavar="FILE.npy", hidden=True, help="Write which splat of the source each one of the result is."),
]
Importance = Annotated[
    str | None,
    typer.Option(
        metavar="FILE",
        hidden=True,
        help="How much each splat matters: what `csplat sensitivity` wrote, or weights (.npy) without dropped rows.",
    ),
]
Checkpoint = Annotated[str | None, typer.Option(metavar="FILE.npz", hidden=True, help="Where checkpoints go.")]
CheckpointEvery = Annotated[int, typer.Option(metavar="N", min=0, hidden=True, help="Steps; 0: at the end alone.")]
Resume = Annotated[str | None, typer.Option(metavar="FILE.npz", hidden=True, help="Go on from this checkpoint.")]
ByteCost = Annotated[
    float | None,
    typer.Option(
        "--lambda",
        metavar="COST",
        help="Of a bit per splat in the loss of the tuning, usually 1e-4; targets find their own.",
    ),
]

_Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE,...", hidden=True, help="Settings that have no option; see below."),
]
_ReadAs = Annotated[
    str | None,
    typer.Option(
        "--from",
        metavar="FORMAT",
        hidden=True,
        help="Read scenes as this one of `csplat formats` where their content does not say what they are.",
    ),
]
_READ_AS = "read_as"
_MORE = re.compile(r"\n *---\n")  # in a docstring: the text below this line is shown by --help-all only
_HELP_ALL = "help_all"
_ALIAS = "output_option"  # parameter of `-o`, the other way to give the argument `output`
_EXCLUDED_MAX = 6  # an option that excludes more is not named in the help of each of them
T = TypeVar("T")


def command(
    *,
    one_of: Sequence[tuple[str, ...]] = (),
    needs: Mapping[str, tuple[str, ...]] | None = None,
    settings: Sequence[str] = (),
    serves: bool = False,
    beside: str | None = None,
    reads: bool = False,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Turn a function into one that typer runs: groups are expanded, options are checked, errors end in one line.

    An argument `output` may be given as `-o`, too. The resulting function has an attribute `parsed`, which takes the
    same options and checks them without doing anything.

    Args:
        one_of, needs: as in `Group`, for options of several groups or of none.
        settings: dataclasses, as `module:name`, whose fields without an option `--set` takes; the values arrive as a
            parameter `settings` of type `Settings`.
        serves: the command runs until it is stopped, and shows no progress.
        beside: file name ending of the output that is written next to the source if none is given; `None`: an output
            is required.
        reads: the command reads scenes in any format, and takes `--from`.
    """

    def made(function: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(function, include_extras=True)
        own = [one.replace(annotation=hints[one.name]) for one in inspect.signature(function).parameters.values()]
        own.sort(key=lambda one: one.annotation is Output)  # the group that every command has comes last
        groups: dict[str, type[Group]] = {one.name: one.annotation for one in own if _is_group(one.annotation)}
        exclusive = [*one_of, *(names for kind in groups.values() for names in kind.one_of)]
        wanting = {name: those for kind in groups.values() for name, those in kind.needs.items()} | dict(needs or {})
        flat = [one for each in own for one in (_fields(groups[each.name]) if each.name in groups else _own(each))]
        options = {one.name: _spelling(one) for one in flat}
        defaults = {one.name: one.default for one in flat}

        def parsed(**given: Any) -> dict[str, Any]:
            given.pop(_HELP_ALL, None)
            given.pop(_READ_AS, None)
            _check({name for name in given if given[name] != defaults[name]}, options, exclusive, wanting)
            if settings:
                given["settings"] = read_settings(given["settings"] or (), settings, options)
            if _ALIAS in given:
                given["output"] = _one_output(given["output"], given.pop(_ALIAS), given.get("source"), beside)
            values = {
                name: kind(**{one.name: given.pop(one.name) for one in fields(kind)}) for name, kind in groups.items()
            }
            for group in values.values():
                group.parse()
            return {**given, **values}

        @functools.wraps(function)
        def run(**given: Any) -> None:
            read_as = given.pop(_READ_AS, None)
            values = parsed(**given)
            quiet = any(isinstance(group, Output) and group.quiet for group in values.values())
            with nullcontext() if serves else progress_bar(quiet=quiet), insisting(read_as):
                function(**values)

        flat += [_keyword(_READ_AS, None, _ReadAs)] * reads
        flat.append(_help_all(functools.partial(_more_help, function, settings, options)))
        shown = {one.name: options.get(one.name, "") for one in flat if not _is_hidden(one)}
        told = [_saying_what_excludes_it(one, shown, exclusive) for one in flat]
        for each in (run, parsed):
            taking: Any = each  # attributes, as all functions
            taking.__signature__ = inspect.Signature(told)
            taking.__annotations__ = {one.name: one.annotation for one in told} | {"return": None}
        run.__doc__ = _MORE.split(function.__doc__ or "")[0]
        run.parsed = parsed  # type: ignore[attr-defined]  # likewise
        return guarded(run)

    return made


def chosen(kind: Callable[..., T], **values: Any) -> T:
    """Build options of the library from those of a command line.

    Raises:
        typer.BadParameter: the library refuses them.
    """
    try:
        return kind(**values)
    except InputError as error:
        raise typer.BadParameter(str(error)) from None


def _is_hidden(one: inspect.Parameter) -> bool:
    return any(getattr(info, "hidden", False) for info in getattr(one.annotation, "__metadata__", ()))


def _help_all(more: Callable[[], str]) -> inspect.Parameter:
    """Return the option that shows what `--help` leaves out."""

    def show(context: typer.Context, wanted: bool) -> None:
        if wanted and not context.resilient_parsing:
            for option in context.command.params:
                option.hidden = option.name in (_HELP_ALL, _ALIAS)  # type: ignore[attr-defined]  # arguments have it, too
            # If rich draws the help, it is printed already, and the returned text is empty.
            say("\n\n".join(part for part in (context.get_help(), more()) if part))
            raise typer.Exit

    option = typer.Option(
        "--help-all", is_eager=True, callback=show, help="Show every option, setting and example, and exit."
    )
    return _keyword(_HELP_ALL, False, Annotated[bool, option])


def _keyword(name: str, default: object, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _more_help(function: Callable[..., None], settings: Sequence[str], options: Mapping[str, str]) -> str:
    """Return the text that `--help-all` adds to the options: the docstring below its `---`, and the settings."""
    parts = [inspect.cleandoc("\n" + one) for one in _MORE.split(function.__doc__ or "")[1:]]
    parts += [describe_settings(settings, options)] * bool(settings)
    return "\n\n".join(parts)


def _is_group(annotation: object) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, Group)


def _fields(kind: type[Group]) -> list[inspect.Parameter]:
    hints = get_type_hints(kind, include_extras=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    return [
        inspect.Parameter(one.name, keyword, default=one.default, annotation=hints[one.name]) for one in fields(kind)
    ]


def _own(one: inspect.Parameter) -> list[inspect.Parameter]:
    """Return a parameter as typer is to see it; for the output two: the argument and `-o`."""
    one = one.replace(kind=inspect.Parameter.KEYWORD_ONLY)
    if one.annotation is Settings:
        return [one.replace(default=None, annotation=_Set)]
    if one.name != "output":
        return [one]
    alias = Annotated[str | None, typer.Option("--output", "-o", hidden=True)]
    info = copy(one.annotation.__metadata__[0])
    info.help = f"{info.help} Or: -o OUT."
    output = one.replace(default=None, annotation=Annotated[str | None, info])
    return [output, inspect.Parameter(_ALIAS, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=alias)]


def _one_output(output: str | None, alias: str | None, source: str | None, beside: str | None) -> str:
    """Return the output; if none is given, the source's name with the ending `beside`, if the command has one."""
    if (output, alias) == (None, None) and beside is not None and source not in (None, STANDARD_STREAM):
        return str(Path(source).with_suffix(beside))
    if (output is None) == (alias is None):
        raise typer.BadParameter("wanted one output: OUT, or -o OUT")
    return output or alias or ""


def _spelling(one: inspect.Parameter) -> str:
    """Return an option as users write it; empty for an argument."""
    info = next(iter(getattr(one.annotation, "__metadata__", ())), None)
    if not isinstance(info, OptionInfo):
        return ""
    given: list[object] = [info.default]  # inside of Annotated the first name is taken for the default
    given.extend(info.param_decls or ())
    declared = [word for word in given if isinstance(word, str) and word.startswith("--")]
    return declared[0].partition("/")[0] if declared else "--" + one.name.replace("_", "-")


def _saying_what_excludes_it(
    one: inspect.Parameter, shown: Mapping[str, str], exclusive: Sequence[tuple[str, ...]]
) -> inspect.Parameter:
    """Return an option whose help names the other one that it excludes; for three and more the panel's name does that.

    If an option excludes many others, only its own help names them.

    Args:
        one: the option.
        shown: spelling of the options that `--help` shows, by name.
        exclusive: as `one_of` of `Group`.
    """
    pairs = [names for names in exclusive if len(names) == 2]
    many = {name for name in shown if sum(name in names for names in pairs) > _EXCLUDED_MAX}
    own = [names for names in pairs if one.name in names]
    others = [shown[name] for names in own for name in names if name != one.name and name in shown and name not in many]
    if not others:
        return one
    kind, info = one.annotation.__origin__, copy(one.annotation.__metadata__[0])
    info.help = f"{info.help} Not with {' or '.join([*filter(None, [', '.join(others[:-1])]), others[-1]])}."
    return one.replace(annotation=Annotated[kind, info])


def _check(
    given: set[str],
    options: Mapping[str, str],
    exclusive: Sequence[tuple[str, ...]],
    needs: Mapping[str, tuple[str, ...]],
) -> None:
    """Refuse options that exclude each other, and those that have no effect without others.

    Raises:
        typer.BadParameter: such options are given.
    """
    for names in exclusive:
        those = [options[name] for name in names if name in given]
        if len(those) > 1:
            raise typer.BadParameter(f"{' and '.join(those)}: give one of them")
    for name, wanted in needs.items():
        if name in given and not given & set(wanted):
            raise typer.BadParameter(
                f"{options[name]} says nothing without {' or '.join(options[one] for one in wanted)}"
            )
