# SPDX-License-Identifier: Apache-2.0
"""Represent the metadata of a scene: `SceneMetadata`, with its up direction and its training record (spec 5.4)."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from csplat import _spec
from csplat.errors import InputError

Direction = tuple[float, float, float]

#: Coordinate system of a scene whose source did not specify its axes.
UNSPECIFIED = "unspecified"

#: Number of each colour space by its name, or by itself if it is not registered.
COLOUR_SPACES = {name: value for value, name in _spec.COLOUR_SPACE_NAMES.items()}
COLOUR_SPACES |= {str(value): value for value in range(_spec.ANCILLARY_ID_MIN, 256)}
SRGB = _spec.COLOUR_SPACE_NAMES[_spec.COLOUR_SPACE_SRGB_REC709_DISPLAY]
LINEAR = _spec.COLOUR_SPACE_NAMES[_spec.COLOUR_SPACE_LIN_REC709_DISPLAY]

#: Keys of entries.
COMMENTS = _spec.META_KEY_COMMENTS
ESTIMATED = _spec.META_KEY_ESTIMATED
LICENCE = _spec.META_KEY_LICENCE
TRAINING = _spec.META_KEY_TRAINING
UP = _spec.META_KEY_UP
VIEW = _spec.META_KEY_VIEW

#: Values of the key `from` of a first view (spec 5.4): a training camera, chosen by a program, chosen by a person.
TRAINED, ESTIMATE, AUTHOR = "training", "estimate", "author"

#: Cosine of the angle between up directions that contradict each other; at larger angles another axis is closer to up.
CONTRADICTS = math.cos(math.radians(45.0))

#: Kinds of dtypes and number of components that a semantic requires; of `motion`, a multiple of this number.
_SEMANTIC_TYPES = {
    _spec.SEMANTIC_LABEL: ("iu", 1),
    _spec.SEMANTIC_OBJECT_ID: ("iu", 1),
    _spec.SEMANTIC_FRAME: ("iu", 1),
    _spec.SEMANTIC_NORMAL: ("f", 3),
    _spec.SEMANTIC_MOTION: ("f", 3),
    _spec.SEMANTIC_TIME: ("f", 1),
    _spec.SEMANTIC_INTENSITY: ("iuf", 1),
}
_AXIS_OF_LETTER = {"R": "x", "L": "x", "U": "y", "D": "y", "F": "z", "B": "z"}
_DIGITS = 6  # decimals; hides differences in the last bits between machines
_UNIT = 1e-5  # tolerance for the length of a unit vector of six digits
_MAX_COUNT = 2**31 - 1
_COLOURS = {(0.0, 0.0, 0.0): "black", (1.0, 1.0, 1.0): "white"}


@dataclass(frozen=True)
class SceneMetadata:
    """Properties of a scene other than its splats.

    Attributes:
        coordinate_system: directions of +x, +y and +z from the viewer's perspective, one letter each of R/L, U/D and
            F/B: `"RDF"`; or `"unspecified"`.
        unit_metres: length of a scene unit in metres; `None` if unknown.
        antialiased: trained with the mip-splatting low-pass filter; renders must apply it.
        flat: splats are discs (2DGS); the smallest scale has no meaning.
        colour_space: `"srgb_rec709_display"`, in which 3D Gaussian splatting trains and renders, or
            `"lin_rec709_display"` (names of KHR_gaussian_splatting), or a number of an unknown one, `"128"` to `"255"`.
        cameras: training cameras, each {K, viewmat, W, H, near, image}; viewmat maps world to camera with OpenCV axes,
            pixel centres are at +0.5. `None` if there are none.
        entries: JSON-compatible. Keys in use: `licence` (str), `comments` (list of str), `training` (a
            `TrainingRecord`), `up` (three numbers), `view` (initial camera of a viewer, in the form of `cameras`, and
            `from`: `training`, `estimate` or `author`), `estimated` (list of the keys whose values are estimates).
            Properties return their values if these are valid.
        semantics: what extra columns mean, by the column's name: `label`, `object_id`, `normal`, `feature:` and the
            name of a model, and so on (registry of semantics, spec 12). `semantic_of` returns one if its type suits.
        quantised: the values come from a file of one byte each (SPZ, SOG), so that many of them are equal. It says how
            to encode a scene, is not written to files, and does not count in comparisons.

    Raises:
        InputError: the coordinate system, the unit or the colour space is invalid.
    """

    coordinate_system: str = UNSPECIFIED
    unit_metres: float | None = None
    antialiased: bool = False
    flat: bool = False
    colour_space: str = SRGB
    cameras: Sequence[Mapping[str, Any]] | None = None
    entries: Mapping[str, Any] = field(default_factory=dict)
    semantics: Mapping[str, str] = field(default_factory=dict)
    quantised: bool = field(default=False, compare=False)

    def __post_init__(self) -> None:
        if self.coordinate_system != UNSPECIFIED:
            check_axes(self.coordinate_system)
        unit = self.unit_metres
        if unit is not None and not (math.isfinite(unit) and unit > 0):
            raise InputError(f"unit_metres is {unit}, expected a length above 0 or None")
        if self.colour_space not in COLOUR_SPACES:
            known = ", ".join(_spec.COLOUR_SPACE_NAMES.values())
            raise InputError(f"colour_space is {self.colour_space!r}, expected one of {known}")

    @property
    def stated_up(self) -> Direction | None:
        """Unit vector of the entry `up`; `None` if absent or invalid."""
        try:
            return unit_up(self.entries[UP]) if UP in self.entries else None
        except InputError:
            return None

    @property
    def up(self) -> Direction | None:
        """Up direction of the scene, a unit vector, from the entry `up` or else from the axes; `None` if unknown."""
        return self.stated_up or up_of_axes(self.coordinate_system)

    @property
    def estimated(self) -> list[str]:
        """Keys of the entries that are estimates."""
        keys = self.entries.get(ESTIMATED)
        return [key for key in keys if isinstance(key, str)] if isinstance(keys, list) else []

    @property
    def training(self) -> TrainingRecord | None:
        """Training record; `None` if absent or invalid."""
        try:
            return TrainingRecord.from_json(self.entries[TRAINING]) if TRAINING in self.entries else None
        except InputError:
            return None

    @property
    def licence(self) -> str | None:
        """Licence; `None` if absent."""
        licence = self.entries.get(LICENCE)
        return licence if isinstance(licence, str) else None

    @property
    def comments(self) -> list[str]:
        """Comments of the scene's source."""
        comments = self.entries.get(COMMENTS)
        return [comment for comment in comments if isinstance(comment, str)] if isinstance(comments, list) else []

    def semantic_of(self, column: str, dtype: np.dtype[Any]) -> str:
        """Return what an extra column means: its semantic, else its name if that is one; "" if unknown.

        Args:
            column: name of the column.
            dtype: type of its values, with a shape for several values of a splat. A semantic that requires another
                type is unknown.
        """
        semantic = self.semantics.get(column) or (column if column in _SEMANTIC_TYPES else "")
        if semantic not in _SEMANTIC_TYPES:
            return semantic
        kinds, components = _SEMANTIC_TYPES[semantic]
        count = math.prod(dtype.shape)
        fits = count % components == 0 if semantic == _spec.SEMANTIC_MOTION else count == components
        return semantic if fits and dtype.base.kind in kinds else ""

    def with_entries(self, **entries: Any) -> SceneMetadata:
        """Return the metadata with some entries added or replaced; `None` removes an entry."""
        merged = {**self.entries, **entries}
        return replace(self, entries={key: value for key, value in merged.items() if entries.get(key, key) is not None})

    def with_up(
        self, up: Direction | None = None, coordinate_system: str | None = None, *, estimated: bool = False
    ) -> SceneMetadata:
        """Return the metadata with another up direction or other axes; entries that contradict them are removed, and so
        is an estimated first view, since the estimate depends on them.

        Args:
            up: three finite numbers, not all 0; `None`: unchanged. Without `coordinate_system`, existing axes with a
                different up are removed.
            coordinate_system: as above; `None`: unchanged. Without `up`, an existing up direction is removed.
            estimated: `up` is an estimate.

        Examples:
            >>> import csplat
            >>> csplat.SceneMetadata(coordinate_system="RDF").with_up((0, 0, 1)).coordinate_system
            'unspecified'

        Raises:
            InputError: an argument is invalid.
        """
        if up is None and coordinate_system is None:
            return self
        entries = dict(self.entries)
        view = entries.get(VIEW)
        if isinstance(view, Mapping) and view.get("from") == ESTIMATE:
            del entries[VIEW]
        estimates = [key for key in self.estimated if key != UP] + [UP] * (estimated and up is not None)
        entries.pop(ESTIMATED, None)
        entries |= {ESTIMATED: estimates} if estimates else {}
        letters = self.coordinate_system if coordinate_system is None else coordinate_system
        if coordinate_system is not None:
            entries.pop(UP, None)
        if up is not None:
            entries[UP] = list(unit_up(up))
            before = up_of_axes(letters) if coordinate_system is None else None
            if before is not None and sum(a * b for a, b in zip(before, entries[UP], strict=True)) < CONTRADICTS:
                letters = UNSPECIFIED
        return replace(self, entries=entries, coordinate_system=letters)


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
    def from_json(cls, record: object) -> TrainingRecord:
        """Parse the result of `as_json`, ignoring unknown members.

        Raises:
            InputError: the background is missing, or a member has the wrong type or range.
        """
        if not isinstance(record, Mapping):
            raise InputError(f"{TRAINING} is {record!r}, expected an object")
        background = _get_member(
            record, "background", lambda value: _are_valid(value, 3, _is_fraction), "three numbers of 0 to 1"
        )
        size = _get_member(record, "size", lambda value: _are_valid(value, 2, _is_count), "two whole numbers above 0")
        near = _get_member(record, "near", _is_length, "a number above 0")
        every = _get_member(record, "test_every", _is_interval, "0, or a whole number above 1")
        images = _get_member(record, "images", _is_name, "a name")
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


def up_of_axes(coordinate_system: str) -> Direction | None:
    """Return the up direction of named axes; `None` if they are unspecified."""
    if coordinate_system == UNSPECIFIED:
        return None
    x, y, z = ({"U": 1.0, "D": -1.0}.get(letter, 0.0) for letter in coordinate_system)
    return x, y, z


def unit_up(values: object) -> Direction:
    """Normalise a direction to unit length, rounded to six digits.

    Args:
        values: three finite numbers, not all 0.

    Raises:
        InputError: the values are invalid.
    """
    numbers = list(values) if isinstance(values, Sequence) and not isinstance(values, str) else []
    if len(numbers) == 3 and all(type(value) in (int, float) and abs(value) < math.inf for value in numbers):
        largest = max(abs(value) for value in numbers)
        if largest > 0.0:
            parts = [value / largest for value in numbers]  # squares of large numbers overflow
            length = math.hypot(*parts)
            length = length if abs(length * largest - 1.0) > _UNIT else 1.0 / largest  # unit vectors stay unchanged
            x, y, z = (round(part / length, _DIGITS) + 0.0 for part in parts)
            return x, y, z
    raise InputError(f"{UP} is {values!r}, expected three finite numbers, not all 0")


def check_axes(letters: str) -> None:
    """Raise an `InputError` unless these are three letters, one each of R/L, U/D and F/B."""
    axes = {_AXIS_OF_LETTER.get(letter) for letter in letters}
    if len(letters) != 3 or axes != {"x", "y", "z"}:
        raise InputError(f"the axes are {letters!r}, expected three letters, one each of R/L, U/D and F/B, such as RDF")


def _get_member(record: Mapping[str, Any], name: str, is_valid: Callable[[Any], bool], expected: str) -> Any:
    """Return a member of a training record, or `None` if it is absent; raise an `InputError` if it is invalid."""
    value = record.get(name)
    if value is not None and not is_valid(value):
        raise InputError(f"{name} of {TRAINING} is {value!r}, expected {expected}")
    return value


def _are_valid(values: object, count: int, is_valid: Callable[[Any], bool]) -> bool:
    """Return True if `values` is a list or tuple of `count` valid values."""
    return isinstance(values, list | tuple) and len(values) == count and all(is_valid(value) for value in values)


def _is_fraction(value: Any) -> bool:
    """Return True for a number from 0 to 1."""
    return type(value) in (int, float) and 0.0 <= value <= 1.0


def _is_length(value: Any) -> bool:
    """Return True for a finite number above 0."""
    return type(value) in (int, float) and 0.0 < value <= sys.float_info.max


def _is_interval(value: Any) -> bool:
    """Return True for 0 or an integer from 2 to `_MAX_COUNT`."""
    return type(value) is int and (value == 0 or 1 < value <= _MAX_COUNT)


def _is_name(value: Any) -> bool:
    """Return True for a printable text that is not empty; surrogates and line breaks are not printable."""
    return isinstance(value, str) and value.isprintable() and value != ""  # excludes surrogates and line breaks


def _is_count(value: Any) -> bool:
    """Return True for an integer from 1 to `_MAX_COUNT`."""
    return type(value) is int and 0 < value <= _MAX_COUNT
