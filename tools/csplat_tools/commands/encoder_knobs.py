"""The encoder's knobs, for commands that encode beside `csplat encode`: declared there, and nowhere else."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import typer

from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat_tools.commands.encode import encode

__all__ = ["with_encoder_knobs"]

_NAMES = {field.name for field in fields(EncodeOptions)}


def with_encoder_knobs(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command every option of `csplat encode` that `EncodeOptions` has a field for.

    Keywords are passed through here, against the custom: two dozen options, declared once, serve all commands, and
    a new one appears in all of them.

    Args:
        command: takes them as one argument, `encoding`.
    """
    own = inspect.signature(command, eval_str=True)
    shared = [one for one in inspect.signature(encode, eval_str=True).parameters.values() if one.name in _NAMES]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        chosen = {one.name: given.pop(one.name) for one in shared}
        try:
            encoding = EncodeOptions(**chosen)
        except InputError as error:
            raise typer.BadParameter(str(error)) from None
        command(**given, encoding=encoding)

    kept = [one for one in own.parameters.values() if one.name != "encoding"]
    positional = [one for one in kept if one.default is inspect.Parameter.empty]
    rest = [one for one in kept if one.default is not inspect.Parameter.empty]
    signature = own.replace(parameters=[*positional, *shared, *rest])
    run.__signature__ = signature  # type: ignore[attr-defined]  # functions take attributes; typer reads this one
    run.__annotations__ = {one.name: one.annotation for one in signature.parameters.values()} | {"return": None}
    return run
