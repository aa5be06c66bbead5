"""Values of options that several commands understand alike."""

from __future__ import annotations

import math
import re

import typer

from csplat.errors import InputError
from csplat.model import check_axes
from csplat.upright import Direction, unit_up
from csplat_tools.files.sizes import parse_size_bytes

__all__ = [
    "parse_axes",
    "parse_bytes",
    "parse_colour",
    "parse_decibels",
    "parse_numbers",
    "parse_size",
    "parse_up",
    "up_word",
]

_NAMED = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


def parse_size(text: str) -> tuple[int, int]:
    """Width and height from `640x480`.

    Raises:
        typer.BadParameter: it is something else.
    """
    found = re.fullmatch(r"([1-9][0-9]{0,4})[xX]([1-9][0-9]{0,4})", text.strip())
    if found is None:
        raise typer.BadParameter(f"a size is {text!r}, wanted width and height in pixels, as 640x480")
    return int(found[1]), int(found[2])


def parse_bytes(text: str | None) -> int | None:
    """Bytes from `2GB`; `None` where nothing was given.

    Raises:
        InputError: it is something else.
    """
    return None if text is None else parse_size_bytes(text)


def parse_numbers(option: str, text: str | None, count: int) -> tuple[float, ...] | None:
    """So many finite numbers from `1,0.5,-2`; `None` where nothing was given.

    Raises:
        typer.BadParameter: it is something else.
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
    """Red, green and blue, 0 to 1, from `1,0.5,0`; `black` and `white` have names.

    Raises:
        typer.BadParameter: it is something else.
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
    """A direction from `y`, `-y`, or `0,-1,0.1`, at unit length.

    Raises:
        typer.BadParameter: it is something else.
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
    """An axis, or its opposite, as `parse_up` takes it."""
    at = next(k for k, value in enumerate(axis) if value)
    return ("-" if axis[at] < 0.0 else "") + "xyz"[at]


def parse_axes(text: str) -> str:
    """Three letters: directions of +x, +y and +z.

    Raises:
        typer.BadParameter: they are something else.
    """
    try:
        check_axes(text)
    except InputError as error:
        raise typer.BadParameter(str(error)) from None
    return text


def parse_decibels(text: str) -> float:
    """A number of decibels: `0.3`, `0.3dB`, `0.3 dB`.

    Raises:
        typer.BadParameter: it is something else.
    """
    number = text.strip()
    if number.lower().endswith("db"):
        number = number[:-2]
    try:
        return float(number)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no number of decibels, wanted 0.3 or 0.3dB") from None
