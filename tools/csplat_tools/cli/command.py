"""Build commands from functions with groups of options, which are declared once and checked in one place.

A command is a function whose parameters are arguments, options, and groups of options: subclasses of `OptionGroup`.
`command` turns it into a function for typer: each group arrives as one typed value, and declares which of its options
exclude each other or require another one. Expected errors end in one line and a status.
"""

from __future__ import annotations

import errno
import functools
import inspect
import os
import re
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from dataclasses import dataclass, fields
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NoReturn, ParamSpec, TypeVar, get_args, get_origin, get_type_hints

import typer
from typer.models import OptionInfo

from csplat.errors import CsplatError, InputError, missing_package
from csplat.formats import assume_format
from csplat.lint import Finding
from csplat.types import Progress
from csplat_tools.console import LONG_WORK_SECONDS, format_estimate, note, print_data, print_json, progress_bar
from csplat_tools.file_streams import STANDARD_STREAM, check_name, check_outputs, write_json

EXIT_FAILED = 1
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells have it
_EXIT_USAGE = 2

_AGAIN = "copy or download it again"
_NEWER = "a newer csplat may know it"
_INVALID = ("the file contradicts itself", f"{_AGAIN}; `csplat verify` lists all that is wrong")
_DAMAGED = ("the file is damaged", _AGAIN)
#: By error code of the format: the defect, and the remedy. The viewer has the same in `tools/viewer/messages.mjs`.
_DEFECTS = {
    "E_MAGIC": ("not a .csplat file", "`csplat encode` makes one of a PLY"),
    "E_VERSION": ("written in another version of the format", _NEWER),
    "E_TRUNCATED": ("the file ends too early", _AGAIN),
    "E_TRAILING": ("something follows the end of the file", _AGAIN),
    "E_CRC": _DAMAGED,
    "E_CODER": _DAMAGED,
    "E_UNSUPPORTED": ("", _NEWER),
    "E_STORE": ("", "nothing was kept; try again"),
    "E_LIMIT": (
        "the scene is larger than is allowed here",
        "`csplat decode` and `csplat verify` take scenes of any size",
    ),
}
_LOST_URL = re.compile(r"([a-z][a-z0-9+]+):/+(.+)")  # a URL read as a path, which loses a slash
_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EIO)
_OS_ADVICE = {
    errno.ENOENT: "is the name right?",
    errno.EACCES: "you are not allowed to",
    errno.EISDIR: "name a file",
    errno.ENOSPC: "no half of a file was left; make room, or name another place",
    errno.EFBIG: "no half of a file was left; name another place",
    errno.EDQUOT: "no half of a file was left; make room, or name another place",
}

#: Base class of the errors that typer raises for a command line; typer exports only one of its subclasses.
UsageError: type[Exception] = typer.BadParameter.__bases__[0]
_EMPTY_PHRASES = re.compile(r"^Invalid value: |(?<=: )Value error, |\.$")  # in typer's messages

#: Options with their new names; the old ones are refused for one version.
RENAMED_OPTIONS = {
    "--aside": "--validation-count",
    "--grades": "--max-classes",
    "--keep-all": "--no-prune",
    "--max-loss": "--max-psnr-drop",
}

P = ParamSpec("P")
T = TypeVar("T")


def report_errors(command: Callable[P, T]) -> Callable[P, T]:
    """Turn expected errors into one line on standard error and status 1.

    Defects of csplat itself still end in a traceback: a bug report needs it.
    """

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            result = command(*args, **kwargs)
            sys.stdout.flush()  # a closed pipe shows here, not when the interpreter ends
        except CsplatError as error:
            _fail(_csplat_error(error))
        except BrokenPipeError:
            _drop_stdout()
            raise typer.Exit(EXIT_FAILED) from None
        except OSError as error:
            if error.filename is None and error.errno in _FULL:
                _drop_stdout()  # all other writers name their file
            _fail(_os_error(error))
        except MemoryError:
            _fail("out of memory")
        except KeyboardInterrupt:
            note("interrupted")
            raise typer.Exit(EXIT_INTERRUPTED) from None
        return result

    return run


def usage_message(error: Any) -> str:
    """Return the message of an error in a command line, in one line; for a renamed option, with its new name."""
    renamed = RENAMED_OPTIONS.get(getattr(error, "option_name", None) or "")
    if renamed is not None:
        return f"{error.option_name} is called {renamed} now"
    return " ".join(_EMPTY_PHRASES.sub("", error.format_message()).split())


def refuse_command_line(error: Any) -> NoReturn:
    """Print the error in a command line, in the form of other errors, and exit with status 2."""
    message = usage_message(error)
    if message:  # empty for a command line without arguments: help is printed already
        command = error.ctx.command_path if error.ctx is not None else "csplat"
        helps = f"`{command} --help`" if error.ctx is not None else "`csplat COMMAND --help`"
        note(f"error: {command}: {message}; {helps} says what is possible (E_USAGE)")
    sys.exit(_EXIT_USAGE)


def _fail(message: str) -> NoReturn:
    note("error: " + " ".join(message.split()))
    raise typer.Exit(EXIT_FAILED) from None


def _csplat_error(error: CsplatError) -> str:
    """Return the message of an error: the file, the defect in plain words, the details, the remedy, and the code."""
    what, advice = _DEFECTS.get(error.code, ("", "") if isinstance(error, InputError) else _INVALID)
    message = str(error)
    parts = [error.path] if error.path is not None and Path(error.path).name not in message else []
    parts += [part for part in (what, message) if part]
    code = "" if error.code in message else f" ({error.code})"
    return ": ".join(parts) + (f"; {advice}" if advice else "") + code


def _os_error(error: OSError) -> str:
    reason = error.strerror or str(error) or type(error).__name__
    number = error.errno or 0
    code = f" ({errno.errorcode[number]})" if number in errno.errorcode else ""
    if error.filename is None:
        return (f"standard output: {reason}; what it holds is not whole" if number in _FULL else reason) + code
    if number == errno.ENOENT and (url := _LOST_URL.match(str(error.filename))):
        return f"{url[1]}://{url[2]} is a URL, expected a file: download it first; extract and batch read URLs" + code
    return f"{error.filename}: {reason}" + (f"; {_OS_ADVICE[number]}" if number in _OS_ADVICE else "") + code


def _drop_stdout() -> None:
    """Redirect standard output to the null device, so that the interpreter's flush at exit cannot fail."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):
        return  # standard output is not a file here


_READERS: dict[type, tuple[Callable[[str], Any], str]] = {
    bool: ({"yes": True, "no": False}.__getitem__, "yes or no"),
    int: (int, "an integer"),
    float: (float, "a number"),
    str: (str, "a word"),
}


@dataclass(frozen=True)
class LibrarySettings:
    """The values of `--set`.

    Attributes:
        values: values by dataclass of the library and by field.
    """

    values: dict[type, dict[str, Any]]

    def of(self, kind: type) -> dict[str, Any]:
        """Return the values that were set for a dataclass, by field."""
        return self.values.get(kind, {})


def parse_settings(texts: Sequence[str], kinds: Sequence[str], taken: Collection[str]) -> LibrarySettings:
    """Parse settings such as `position-bits=12,scale-step=0.1`.

    Args:
        texts: values of `--set`, each with settings separated by commas.
        kinds: dataclasses whose fields may be set, as `module:name`; imported only if anything is set.
        taken: names of fields that have an option of their own.

    Raises:
        typer.BadParameter: there is no such setting, one is given twice, or its value is of another type.
        InputError: an extra is not installed.
    """
    known = {name: (kind, type_) for kind in _imported(kinds if texts else ()) for name, type_ in _names(kind, taken)}
    found = dict[type, dict[str, Any]]()
    for word in (word.strip() for text in texts for word in text.split(",") if word.strip()):
        shown, equals, value = (part.strip() for part in word.partition("="))
        name = shown.replace("-", "_")
        if name not in known or not equals:
            near = get_close_matches(name, known, 1)
            meant = f", perhaps {near[0].replace('_', '-')}=...?" if near else ": --help-all lists them"
            raise typer.BadParameter(f"--set {word}: no such setting{meant}")
        kind, type_ = known[name]
        values = found.setdefault(kind, {})
        if name in values:
            raise typer.BadParameter(f"--set {shown} is given twice")
        read, wanted = _READERS[type_]
        try:
            values[name] = read(value)
        except (ValueError, KeyError):
            raise typer.BadParameter(f"--set {shown} is {value!r}, wanted {wanted}") from None
    return LibrarySettings(found)


def describe_settings(kinds: Sequence[str], taken: Collection[str]) -> str:
    """Describe the settings by the docstrings of their dataclasses, for `--help-all`."""
    lines = []
    try:
        found = _imported(kinds)
    except InputError as error:
        return f"Settings of --set: {error}"
    for kind in found:
        texts = dict(re.findall(r"^    (\w+): (.*(?:\n        .*)*)", inspect.getdoc(kind) or "", re.MULTILINE))
        for name, _ in _names(kind, taken):
            lines.append(f"  {name.replace('_', '-')}: {' '.join(texts.get(name, '').split())}")
    return "Settings of --set NAME=VALUE,...:\n" + "\n".join(lines)


def _imported(kinds: Sequence[str]) -> list[type]:
    try:
        return [getattr(import_module(module), name) for module, _, name in (kind.partition(":") for kind in kinds)]
    except ModuleNotFoundError as error:
        raise missing_package(error) from None


def _names(kind: type, taken: Collection[str]) -> list[tuple[str, type]]:
    """Return the fields of plain types, including Literal words, that have no option of their own, with their types."""
    hints = get_type_hints(kind)
    found = []
    for one in fields(kind):
        hint = hints[one.name]
        each_of = (hint,) if get_origin(hint) is Literal else get_args(hint) or (hint,)
        # The dataclass checks the words of a Literal when it is created.
        types = [str if get_origin(each) is Literal else each for each in each_of if each is not type(None)]
        if one.name not in taken and len(types) == 1 and types[0] in _READERS:
            found.append((one.name, types[0]))
    return found


_ENDINGS = {
    "--report": ".json", "--page": ".html", "-o": ".html", "--source-index": ".npy", "--checkpoint": ".npz",
}  # fmt: skip


@dataclass(frozen=True)
class OptionGroup:
    """Options that belong together: the fields, with their defaults.

    Class attributes:
        one_of: groups of options, of each of which at most one may be given.
        needs: options that have no effect unless one of the named others is given.
    """

    one_of: ClassVar[Sequence[tuple[str, ...]]] = ()
    needs: ClassVar[Mapping[str, tuple[str, ...]]] = {}

    def parse(self) -> None:
        """Refuse invalid values before any work is done.

        Raises:
            typer.BadParameter: a value is invalid.
        """


@dataclass(frozen=True)
class OutputOptions(OptionGroup):
    """Options of the results, the same for every command."""

    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False
    report: Annotated[str | None, typer.Option(metavar="FILE.json", help="Write the result as JSON.")] = None
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no remarks.")] = False

    def check(
        self,
        *outputs: str | None,
        inputs: Sequence[str | None] = (),
        named: Mapping[str, str | None] | None = None,
        force: bool = False,
    ) -> None:
        """Refuse unusable files before any work is done for them.

        Args:
            outputs: files that the command writes, or `-`; `None` for one that is not requested.
            inputs: files that it reads; none of them may be written.
            named: other files that it writes, by option; not `-`, nor files with the ending of another kind.
            force: existing files may be replaced, even without --force.

        Raises:
            InputError: a file exists, two are the same, or one has the ending of another kind of file.
            OSError: an input does not exist, or the folder of an output.
            typer.BadParameter: two outputs would go to standard output, or one that cannot.
        """
        files = {"--report": self.report, **(named or {})}
        for name, path in files.items():
            if path == STANDARD_STREAM:
                raise typer.BadParameter(f"{name} requires the name of a file")
        if self.as_json and STANDARD_STREAM in outputs:
            raise typer.BadParameter("--json and - both use standard output")
        check_outputs((*outputs, *files.values()), force=self.force or force, inputs=inputs)
        for name, path in files.items():
            if path is not None and name in _ENDINGS:
                check_name(path, _ENDINGS[name], name)

    def publish(self, result: Any, text: str = "") -> None:
        """Publish the result: as JSON to the file of `--report`, and to standard output with `--json`, else as text.

        Args:
            result: JSON-compatible, without NaN and infinities.
            text: the result for people; empty if the result is a file.
        """
        if self.report is not None:
            write_json(self.report, result)
        if self.as_json:
            print_json(result)
        elif text:
            print_data(text)

    def remark(self, *lines: str) -> None:
        """Print remarks on standard error, unless `--quiet` is given."""
        for line in () if self.quiet else lines:
            note(line)

    def announce_time(self, estimate: Callable[[], float], faster: str) -> None:
        """Announce the time of long work, so that people may choose otherwise.

        Args:
            estimate: returns the seconds; not called with `--quiet`.
            faster: advice on what takes less time.
        """
        seconds = 0.0 if self.quiet else estimate()
        if seconds > LONG_WORK_SECONDS:
            note(f"this takes about {format_estimate(seconds)} here; {faster}")

    def print_findings(self, findings: Sequence[Finding], name: str = "") -> None:
        """Print unusual findings in a file, unless `--quiet` is given; repairs are printed in any case.

        Args:
            findings: findings in the file.
            name: name of the file, if a command reads several.
        """
        for one in findings:
            if one.kind == "repair" or not (self.quiet or one.usual):
                note(f"{name}: {one}" if name else str(one))

    def bar(self) -> AbstractContextManager[Progress | None]:
        """Return the progress bar, see `progress_bar`."""
        return progress_bar(quiet=self.quiet)


_Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE,...", hidden=True, help="Settings without an option of their own; see below."
    ),
]
_ReadAs = Annotated[
    str | None,
    typer.Option(
        "--from",
        metavar="FORMAT",
        hidden=True,
        help="Format of scenes, one of `csplat formats`, if their content does not identify it.",
    ),
]
_READ_AS = "read_as"
_MORE = re.compile(r"\n *---\n")  # separates the part of a docstring that only --help-all shows
_HELP_ALL = "help_all"
_ALIAS = "output_option"  # parameter of `-o`, the other way to give the argument `output`
_EXCLUDED_MAX = 6  # an option that excludes more is not named in the help of each of them


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
        one_of, needs: as in `OptionGroup`, for options of several groups or of none.
        settings: dataclasses, as `module:name`, whose fields without an option `--set` takes; the values arrive as a
            parameter `settings` of type `LibrarySettings`.
        serves: the command runs until it is stopped, and shows no progress.
        beside: file name ending of the output that is written next to the source if none is given; `None`: an output
            is required.
        reads: the command reads scenes in any format, and takes `--from`.
    """

    def build(function: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(function, include_extras=True)
        own = [one.replace(annotation=hints[one.name]) for one in inspect.signature(function).parameters.values()]
        own.sort(key=lambda one: one.annotation is OutputOptions)  # the group that every command has comes last
        groups: dict[str, type[OptionGroup]] = {one.name: one.annotation for one in own if _is_group(one.annotation)}
        exclusive = [*one_of, *(names for kind in groups.values() for names in kind.one_of)]
        required = {name: those for kind in groups.values() for name, those in kind.needs.items()} | dict(needs or {})
        flat = [one for each in own for one in (_fields(groups[each.name]) if each.name in groups else _own(each))]
        options = {one.name: _spelling(one) for one in flat}
        defaults = {one.name: one.default for one in flat}

        def parsed(**given: Any) -> dict[str, Any]:
            given.pop(_HELP_ALL, None)
            given.pop(_READ_AS, None)
            _check({name for name in given if given[name] != defaults[name]}, options, exclusive, required)
            if settings:
                given["settings"] = parse_settings(given["settings"] or (), settings, options)
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
            quiet = any(isinstance(group, OutputOptions) and group.quiet for group in values.values())
            with nullcontext() if serves else progress_bar(quiet=quiet), assume_format(read_as):
                function(**values)

        flat += [_keyword(_READ_AS, None, _ReadAs)] * reads
        flat.append(_help_all(functools.partial(_more_help, function, settings, options)))
        shown = {one.name: options.get(one.name, "") for one in flat if not _is_hidden(one)}
        described = [_with_exclusions(one, shown, exclusive) for one in flat]
        for each in (run, parsed):
            target: Any = each  # functions have attributes
            target.__signature__ = inspect.Signature(described)
            target.__annotations__ = {one.name: one.annotation for one in described} | {"return": None}
        run.__doc__ = _MORE.split(function.__doc__ or "")[0]
        run.parsed = parsed  # type: ignore[attr-defined]  # likewise
        return report_errors(run)

    return build


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
            print_data("\n\n".join(part for part in (context.get_help(), more()) if part))
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
    return isinstance(annotation, type) and issubclass(annotation, OptionGroup)


def _fields(kind: type[OptionGroup]) -> list[inspect.Parameter]:
    hints = get_type_hints(kind, include_extras=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    return [
        inspect.Parameter(one.name, keyword, default=one.default, annotation=hints[one.name]) for one in fields(kind)
    ]


def _own(one: inspect.Parameter) -> list[inspect.Parameter]:
    """Return a parameter for typer; for the output two: the argument and `-o`."""
    one = one.replace(kind=inspect.Parameter.KEYWORD_ONLY)
    if one.annotation is LibrarySettings:
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
    """Return the spelling of an option; empty for an argument."""
    info = next(iter(getattr(one.annotation, "__metadata__", ())), None)
    if not isinstance(info, OptionInfo):
        return ""
    given: list[object] = [info.default]  # inside of Annotated the first name is taken for the default
    given.extend(info.param_decls or ())
    declared = [word for word in given if isinstance(word, str) and word.startswith("--")]
    return declared[0].partition("/")[0] if declared else "--" + one.name.replace("_", "-")


def _with_exclusions(
    one: inspect.Parameter, shown: Mapping[str, str], exclusive: Sequence[tuple[str, ...]]
) -> inspect.Parameter:
    """Return an option whose help names the one that it excludes; for three or more the panel's name does that.

    If an option excludes many others, only its own help names them.

    Args:
        one: the option.
        shown: spelling of the options that `--help` shows, by name.
        exclusive: as `one_of` of `OptionGroup`.
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
