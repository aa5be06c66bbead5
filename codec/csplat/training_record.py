"""Record the training settings that comparisons of a scene with its images depend on (spec 5.4).

The metadata may also contain a training camera under `VIEW`, the initial camera of a viewer.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from csplat.errors import InputError

#: Metadata keys of the training record and of the initial camera.
TRAINING = "training"
VIEW = "view"

_MAX_COUNT = 2**31 - 1
_COLOURS = {(0.0, 0.0, 0.0): "black", (1.0, 1.0, 1.0): "white"}


@dataclass(frozen=True)
class TrainingRecord:
    """Training settings that a comparison of the scene with its images must repeat.

    Attributes:
        background: red, green and blue of the background, 0..1.
        test_every: N if every Nth image was held out, 0 if none; `None`: the data set specifies the test images.
        size: width and height that the images were scaled to, pixels; `None`: not scaled.
        near: near plane of the cameras, scene units; `None`: unknown.
        images: folder of images in a COLMAP data set; `None`: the reader's choice.
    """

    background: tuple[float, float, float]
    test_every: int | None = None
    size: tuple[int, int] | None = None
    near: float | None = None
    images: str | None = None

    @classmethod
    def of(cls, metadata: Mapping[str, Any]) -> TrainingRecord | None:
        """Return the record in a scene's metadata, `None` if there is none or it is invalid."""
        try:
            return cls.from_json(metadata[TRAINING]) if TRAINING in metadata else None
        except InputError:
            return None

    @classmethod
    def from_json(cls, record: object) -> TrainingRecord:
        """Parse the result of `as_json`, ignoring unknown members.

        Raises:
            InputError: the background is missing, or a member has the wrong type or range.
        """
        if not isinstance(record, Mapping):
            raise InputError(f"{TRAINING} is {record!r}, expected an object")
        background = _member(
            record, "background", lambda value: _are(value, 3, _is_fraction), "three numbers of 0 to 1"
        )
        size = _member(record, "size", lambda value: _are(value, 2, _is_count), "two whole numbers above 0")
        near = _member(record, "near", _is_length, "a number above 0")
        every = _member(record, "test_every", _is_interval, "0, or a whole number above 1")
        images = _member(record, "images", _is_name, "a name")
        if background is None:
            raise InputError(f"{TRAINING} has no background")
        red, green, blue = (float(value) for value in background)
        return cls((red, green, blue), every, None if size is None else (size[0], size[1]), near, images)

    def as_json(self) -> dict[str, Any]:
        """Return the record as JSON, without unknown values."""
        record: dict[str, Any] = {"background": list(self.background)}
        for name in ("test_every", "near", "images"):
            if getattr(self, name) is not None:
                record[name] = getattr(self, name)
        return record if self.size is None else {**record, "size": list(self.size)}

    def __str__(self) -> str:
        """Return a description in words."""
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


def _member(record: Mapping[str, Any], name: str, is_valid: Callable[[Any], bool], expected: str) -> Any:
    value = record.get(name)
    if value is not None and not is_valid(value):
        raise InputError(f"{name} of {TRAINING} is {value!r}, expected {expected}")
    return value


def _are(values: object, count: int, is_valid: Callable[[Any], bool]) -> bool:
    return isinstance(values, list | tuple) and len(values) == count and all(is_valid(value) for value in values)


def _is_fraction(value: Any) -> bool:
    return type(value) in (int, float) and 0.0 <= value <= 1.0


def _is_length(value: Any) -> bool:
    return type(value) in (int, float) and 0.0 < value <= sys.float_info.max


def _is_interval(value: Any) -> bool:
    return type(value) is int and (value == 0 or 1 < value <= _MAX_COUNT)


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and value.isprintable() and value != ""  # excludes surrogates and line breaks


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 < value <= _MAX_COUNT
