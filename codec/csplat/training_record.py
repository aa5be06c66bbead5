"""Record of a scene's training, as far as later renders of it depend on that (spec 5.4).

Its training may leave one of its cameras, too, under `VIEW`: from there a viewer shows the scene first.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from csplat.errors import InputError

#: Keys of the metadata for the training and the first view.
TRAINING = "training"
VIEW = "view"

_MAX_COUNT = 2**31 - 1
_COLOURS = {(0.0, 0.0, 0.0): "black", (1.0, 1.0, 1.0): "white"}


@dataclass(frozen=True)
class TrainingRecord:
    """Settings of the training that a comparison of the scene with its photographs has to repeat.

    Attributes:
        background: red, green, blue behind the splats, 0..1.
        test_every: every Nth photograph was held out, 0 for none; `None`: the data set names them itself.
        size: width and height that the photographs were scaled to, pixels; `None`: they were not.
        near: near plane of the cameras, scene units; `None`: not known.
        images: for COLMAP sets, the folder of images; `None`: the reader chose.
    """

    background: tuple[float, float, float]
    test_every: int | None = None
    size: tuple[int, int] | None = None
    near: float | None = None
    images: str | None = None

    @classmethod
    def of(cls, metadata: Mapping[str, Any]) -> TrainingRecord | None:
        """Return the record in a scene's metadata; `None` if it has none, or none that can be understood."""
        try:
            return cls.from_json(metadata[TRAINING]) if TRAINING in metadata else None
        except InputError:
            return None

    @classmethod
    def from_json(cls, said: object) -> TrainingRecord:
        """The inverse of `as_json`; members of other names are passed over.

        Raises:
            InputError: there is no background, or a member is not what it is called.
        """
        if not isinstance(said, Mapping):
            raise InputError(f"{TRAINING} is {said!r}, wanted an object")
        background = _member(said, "background", lambda value: _are(value, 3, _is_share), "three numbers of 0 to 1")
        size = _member(said, "size", lambda value: _are(value, 2, _is_count), "two whole numbers above 0")
        near = _member(said, "near", _is_length, "a number above 0")
        every = _member(said, "test_every", _is_split, "0, or a whole number above 1")
        images = _member(said, "images", _is_name, "a name")
        if background is None:
            raise InputError(f"{TRAINING} names no background")
        red, green, blue = (float(value) for value in background)
        return cls((red, green, blue), every, None if size is None else (size[0], size[1]), near, images)

    def as_json(self) -> dict[str, Any]:
        """Return the JSON for the metadata, without unknown values."""
        said: dict[str, Any] = {"background": list(self.background)}
        for name in ("test_every", "near", "images"):
            if getattr(self, name) is not None:
                said[name] = getattr(self, name)
        return said if self.size is None else {**said, "size": list(self.size)}

    def __str__(self) -> str:
        """The same in words, for people."""
        colour = _COLOURS.get(self.background) or " ".join(f"{value:g}" for value in self.background)
        words = [f"{colour} background"]
        if self.test_every is not None:
            words.append(f"1 in {self.test_every} photographs held out" if self.test_every else "none held out")
        if self.size is not None:
            words.append(f"scaled to {self.size[0]}×{self.size[1]}")
        if self.images is not None:
            words.append(f"from {self.images}")
        if self.near is not None:
            words.append(f"near plane {self.near:.4g}")
        return ", ".join(words)


def _member(said: Mapping[str, Any], name: str, suits: Callable[[Any], bool], wanted: str) -> Any:
    value = said.get(name)
    if value is not None and not suits(value):
        raise InputError(f"{name} of {TRAINING} is {value!r}, wanted {wanted}")
    return value


def _are(values: object, count: int, suits: Callable[[Any], bool]) -> bool:
    return isinstance(values, list | tuple) and len(values) == count and all(suits(value) for value in values)


def _is_share(value: Any) -> bool:
    return type(value) in (int, float) and 0.0 <= value <= 1.0


def _is_length(value: Any) -> bool:
    return type(value) in (int, float) and 0.0 < value <= sys.float_info.max


def _is_split(value: Any) -> bool:
    return type(value) is int and (value == 0 or 1 < value <= _MAX_COUNT)


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and value.isprintable() and value != ""  # no surrogates, no ends of lines


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 < value <= _MAX_COUNT
