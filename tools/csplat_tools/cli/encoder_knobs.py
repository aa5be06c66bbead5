"""The options of `csplat encode`, for commands that encode beside it: declared there, and nowhere else."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import typer

from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat_tools.cli.encode import encode
from csplat_tools.files.convert import SceneFacts

__all__ = ["with_encoder_knobs"]

_KNOBS = {field.name for field in fields(EncodeOptions)}
# By the names that the command line has for them, which `SceneFacts` takes in this order.
_FACTS = ("axes", "unit_metres", "antialiased", "licence")
_READING = ("strict",)  # passed on under its name


def with_encoder_knobs(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command every option of `csplat encode` that `EncodeOptions` or `SceneFacts` has a field for.

    Keywords are passed through here, against the custom: two dozen options, declared once, serve all commands, and
    a new one appears in all of them.

    Args:
        command: takes them as two arguments, `encoding` and `facts`; and `strict`, which is declared there, too.
    """
    own = inspect.signature(command, eval_str=True)
    declared = inspect.signature(encode, eval_str=True).parameters.values()
    shared = [one for one in declared if one.name in {*_KNOBS, *_FACTS, *_READING}]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        facts = SceneFacts(*(given.pop(name) for name in _FACTS))
        chosen = {one.name: given.pop(one.name) for one in shared if one.name in _KNOBS}
        try:
            encoding = EncodeOptions(**chosen)
        except InputError as error:
            raise typer.BadParameter(str(error)) from None
        command(**given, encoding=encoding, facts=facts)

    kept = [one for one in own.parameters.values() if one.name not in ("encoding", "facts", *_READING)]
    positional = [one for one in kept if one.default is inspect.Parameter.empty]
    rest = [one for one in kept if one.default is not inspect.Parameter.empty]
    signature = own.replace(parameters=[*positional, *shared, *rest])
    run.__signature__ = signature  # type: ignore[attr-defined]  # functions take attributes; typer reads this one
    run.__annotations__ = {one.name: one.annotation for one in signature.parameters.values()} | {"return": None}
    return run
