"""Cameras and photographs that a command line names, for simplification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_tools.compare import BLACK, WHITE, Colour
from csplat_tools.photographs import DataViews, relative_to, show_photograph

__all__ = ["Sights", "find_sights", "parse_target"]

F32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Sights:
    """What a scene is looked at from.

    Attributes:
        cameras: the user's own, relative to the scene's origin; None for virtual ones.
        background: red, green, blue behind everything.
        photographs: cameras and what was photographed there, to judge by; None where there are none.
    """

    cameras: list[Camera] | None
    background: Colour
    photographs: tuple[Sequence[Camera], Sequence[F32]] | None = None


def find_sights(
    model: SplatModel,
    cameras: str | None,
    data: str | None,
    *,
    judged: bool,
    background: Colour | None = None,
) -> Sights:
    """Read a camera file or a data set.

    Args:
        model: the scene.
        cameras: a camera file, relative to the scene's origin.
        data: a data set: the cameras of its training pictures decide.
        judged: photographs are wanted: the set's test pictures.
        background: behind everything; None for black, but white with pictures that have an alpha channel.

    Raises:
        InputError: both are given, or one cannot be read.
    """
    if cameras is not None and data is not None:
        raise InputError("cameras come from a file or from a data set, not from both")
    if cameras is not None:
        from csplat_render.cameras import load_cameras

        return Sights(load_cameras(cameras), background or BLACK)
    if data is None:
        return Sights(None, background or BLACK)
    origin = model.origin
    taken = DataViews(data, "train").read()
    views = [relative_to(origin, picture.camera) for picture in taken]
    behind = background or (WHITE if any(picture.has_alpha for picture in taken) else BLACK)
    if not judged:
        return Sights(views, behind)
    pictures = DataViews(data, "test").read()
    shown = [show_photograph(picture, behind) for picture in pictures]
    return Sights(views, behind, ([relative_to(origin, picture.camera) for picture in pictures], shown))


def parse_target(text: str) -> float:
    """A number of decibels: `0.3`, `0.3dB`, `0.3 dB`.

    Raises:
        InputError: it is something else.
    """
    number = text.strip()
    if number.lower().endswith("db"):
        number = number[:-2]
    try:
        return float(number)
    except ValueError:
        raise InputError(f"{text!r} is no number of decibels, wanted 0.3 or 0.3dB") from None
