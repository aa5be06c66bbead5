"""Parse values of options that several commands have in common."""

from __future__ import annotations

import math
import re

import typer

from csplat.errors import InputError
from csplat.model import check_axes
from csplat.upright import Direction, unit_up
from csplat_tools.files.sizes import parse_size_bytes

_NAMED = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


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
