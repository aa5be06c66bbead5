"""Command lines of benchmarks: options that many have, lists between commas, statuses, what goes to standard error."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from subprocess import CalledProcessError
from typing import Annotated, Any, TypeVar

import typer

from csplat.encoder import PRESETS as KNOWN_PRESETS
from csplat.encoder import PresetName
from csplat.errors import CsplatError
from csplat_tools.console import note as tell

T = TypeVar("T")

SCENES = Annotated[str, typer.Option(help="names, separated by commas")]
EXTRA = Annotated[list[Path], typer.Option(metavar="PLY", help="a further scene; may be repeated")]
PRESETS = Annotated[str, typer.Option(help="of the encoder, separated by commas")]
MARKDOWN = Annotated[bool, typer.Option("--markdown", help="print tables as documents have them")]
JSON = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="write all numbers, for programs")]
OUT = Annotated[Path, typer.Option(help="folder where what was measured is kept")]
CACHE = Annotated[Path, typer.Option(help="folder for made scenes and files")]
PEERS = Annotated[Path, typer.Option(help="folder for npm packages")]
TABLES = Annotated[bool, typer.Option("--tables", help="measure nothing, print what is known")]
AGAIN = Annotated[bool, typer.Option("--again", help="forget what was measured of these scenes")]
THREADS = Annotated[int | None, typer.Option(help="default: one per core")]
VIEWS = Annotated[int, typer.Option(help="virtual views at most")]
LPIPS = Annotated[str | None, typer.Option(metavar="FILE", help="weights of LPIPS-Alex, or auto for the usual places")]

#: Raised by a benchmark if its arguments make no sense: status 2.
WrongWords = typer.BadParameter


def run(main: Callable[..., Any], words: Sequence[str] | None = None) -> int:
    """Run a benchmark: its options are the parameters of a function, its help is the text of the function's module.

    Args:
        main: the function; what it returns is the status, `None` stands for 0.
        words: the command line without its first word; `None`: the process's.

    Returns:
        The status: 0 done, 1 something cannot be used or has failed, 2 wrong words.
    """
    # Read when GNU OpenMP is loaded: threads that wait for each other sleep soon, see `csplat train`.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    # A backspace keeps the lines of a paragraph as they are.
    text = (sys.modules[main.__module__].__doc__ or "").strip().replace("\n\n", "\n\n\b\n")

    @wraps(main)
    def command(*args: Any, **named: Any) -> None:
        try:
            status = main(*args, **named) or 0
        except (CsplatError, OSError, CalledProcessError) as error:
            tell(f"error: {error}")
            status = 1
        raise typer.Exit(status)

    app.command(help=text)(command)
    try:
        app(words)
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


def listed(text: str) -> list[str]:
    """Words between commas."""
    return [word.strip() for word in text.split(",") if word.strip()]


def preset_of(word: str) -> PresetName:
    """A preset by its name.

    Raises:
        WrongWords: there is none of that name.
    """
    for name in KNOWN_PRESETS:
        if name == word:
            return name
    raise WrongWords(f"the preset is {word!r}, wanted one of {', '.join(KNOWN_PRESETS)}")


def numbers(text: str, kind: Callable[[str], T]) -> list[T]:
    """Numbers between commas.

    Raises:
        WrongWords: a word is no number of this kind.
    """
    try:
        return [kind(word) for word in listed(text)]
    except ValueError as error:
        raise WrongWords(f"{text}: {error}") from None
