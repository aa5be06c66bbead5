"""Read and write the metadata of a scene as comment lines of a PLY header, and split positions from their origin.

| comment | meaning |
|---|---|
| `csplat origin X Y Z` | x, y, z are relative to this origin |
| `csplat absolute_origin X Y Z` | x, y, z are absolute, in doubles |
| `csplat coordinate_system RDF` | directions of the axes |
| `csplat up X Y Z`, `csplat unit_metres U`, `csplat licence TEXT` | as in `SplatModel` |
| `csplat training {JSON}`, `csplat view {JSON}` | the training (`csplat.training_record`) and the initial view |
| `SplatRenderMode: mip`, `SplatRenderMode: 2dgs` | antialiased, flat; also used by other programs |
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import parse_json
from csplat.editing.up_axis import UP, unit_up, up_of
from csplat.errors import InputError
from csplat.lint import Finding
from csplat.model import UNSPECIFIED, SplatModel
from csplat.training_record import TRAINING, VIEW, TrainingRecord
from csplat.types import F32, F64

_PREFIX = "csplat"
_SHOWN = 80  # maximum number of characters of a comment in a message
#: nerfstudio's ns-export names the axis that points up. Brush writes the same axis for every scene, so its comment is
#: ignored.
_VERTICAL_AXIS = re.compile(r"vertical axis\s*:\s*([+-]?)([xyz])", re.IGNORECASE)
_BRUSH = "exported from brush"
#: Comments of Brush and splat-transform for `antialiased` (mip) and `flat` (2dgs), and of Postshot for `antialiased`.
_MODES: dict[tuple[str, ...], str] = {
    ("splatrendermode:", "default"): "",
    ("splatrendermode:", "mip"): "antialiased",
    ("splatrendermode:", "2dgs"): "flat",
    ("antialiased", "0"): "",
    ("antialiased", "1"): "antialiased",
}
#: float64 positions keep origin 0 if the distance of their centre is at most this many spreads: float32 relative to 0
#: is then at most four bits coarser than relative to the centre.
_NEAR_SPREADS = 16.0


@dataclass
class CommentMetadata:
    """Scene metadata from header comments, with defaults.

    Attributes:
        origin: origin of the scene; `None` if no comment specifies one.
        origin_is_added: True if x, y and z in the file are absolute, that is, include the origin.
        coordinate_system, unit_metres, antialiased, flat: as in `SplatModel`.
        metadata: `comments` (lines that csplat does not interpret), `licence`, `training`, `up`, `view`.
        findings: findings about the comments of other programs.
    """

    origin: tuple[float, float, float] | None = None
    origin_is_added: bool = False
    coordinate_system: str = UNSPECIFIED
    unit_metres: float | None = None
    antialiased: bool = False
    flat: bool = False
    metadata: dict[str, Any] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    def fields(self) -> dict[str, Any]:
        """Return the fields of a `SplatModel` other than the origin."""
        names = ("coordinate_system", "unit_metres", "antialiased", "flat", "metadata")
        return {name: getattr(self, name) for name in names}


def parse_comments(comments: Sequence[str]) -> CommentMetadata:
    """Parse the comment lines of a header, without the word `comment`.

    Raises:
        InputError: the value of a csplat comment is invalid. It is not ignored, because a wrong origin would move the
            scene and a wrong background would invalidate comparisons.
    """
    metadata = CommentMetadata()
    others: list[str] = []
    vertical: list[str] = []
    by_brush = any(comment.strip().lower() == _BRUSH for comment in comments)
    for comment in comments:
        words = comment.split()
        mode = _MODES.get(tuple(comment.lower().split()))
        if words[:2] == [_PREFIX, TRAINING]:
            metadata.metadata[TRAINING] = _training(comment).as_json()
        elif words[:2] == [_PREFIX, VIEW]:
            metadata.metadata[VIEW] = _view(comment)
        elif mode is not None:
            metadata.antialiased |= mode == "antialiased"
            metadata.flat |= mode == "flat"
        elif _VERTICAL_AXIS.fullmatch(comment.strip()) and not by_brush:
            vertical.append(comment.strip())
        elif words[:1] != [_PREFIX] or len(words) < 2 or not _set_field(metadata, words[1], words[2:]):
            others.append(comment)
    others += _set_vertical_axis(metadata, vertical)
    if others:
        metadata.metadata["comments"] = others
    return metadata


def format_comments(model: SplatModel, *, absolute: bool) -> list[str]:
    """Format the metadata of a model as comment lines, without the word `comment`.

    Args:
        model: the scene.
        absolute: positions are written with the origin added.

    Returns:
        ASCII lines, without lines for defaults; other characters become question marks.
    """
    lines = [line for one in _strings(model.metadata.get("comments")) for line in one.splitlines()]
    if absolute or any(model.origin):
        key = "absolute_origin" if absolute else "origin"
        lines.append(f"{_PREFIX} {key} {' '.join(repr(value) for value in model.origin)}")
    if model.coordinate_system != UNSPECIFIED:
        lines.append(f"{_PREFIX} coordinate_system {model.coordinate_system}")
    up = up_of(model.metadata)
    if up is not None:
        lines.append(f"{_PREFIX} {UP} {' '.join(repr(value) for value in up)}")
    if model.unit_metres is not None:
        lines.append(f"{_PREFIX} unit_metres {model.unit_metres!r}")
    if model.flat:
        lines.append("SplatRenderMode: 2dgs")
    if model.antialiased:
        lines.append("SplatRenderMode: mip")
    licence = model.metadata.get("licence")
    if isinstance(licence, str):
        lines.append(f"{_PREFIX} licence {' '.join(licence.split())}")
    view = model.metadata.get(VIEW)
    if isinstance(view, dict) and _is_json(view):
        lines.append(f"{_PREFIX} {VIEW} {json.dumps(view)}")
    trained = TrainingRecord.of(model.metadata)
    if trained is not None:
        lines.append(f"{_PREFIX} {TRAINING} {json.dumps(trained.as_json())}")
    return [line.encode("ascii", "replace").decode("ascii") for line in lines]


def split_origin(means: NDArray[Any], metadata: CommentMetadata) -> tuple[F32, tuple[float, float, float], F64 | None]:
    """Split the positions of a PLY into float32 means and an origin.

    Args:
        means: [N, 3], float32 or float64, x, y, z of the file.
        metadata: metadata from the comments of the file.

    Returns:
        [N, 3] float32 means relative to the origin; the origin; and the positions in float64 if means and origin do
        not represent them exactly, otherwise `None`.
    """
    with np.errstate(over="ignore"):  # `SplatModel` refuses values beyond float32
        if means.dtype == np.float32:
            origin = None if metadata.origin_is_added else metadata.origin
            return means, origin or (0.0, 0.0, 0.0), None
        positions = means
        origin = metadata.origin
        if origin is None:
            origin = _choose_origin(means)
        elif not metadata.origin_is_added:
            positions = means + np.array(origin)
        rounded = (positions - np.array(origin)).astype(np.float32)
        exact = np.array_equal(rounded + np.array(origin), positions)
        return rounded, origin, None if exact else positions


def _set_vertical_axis(metadata: CommentMetadata, comments: Sequence[str]) -> Sequence[str]:
    """Set the up direction from comments on the vertical axis unless it is known; return the comments to keep."""
    if not comments:
        return ()
    directions = set()
    for comment in comments:
        found = _VERTICAL_AXIS.fullmatch(comment)
        assert found is not None, "it was matched before"
        sign, axis = found.groups()
        directions.add(tuple((-1.0 if sign == "-" else 1.0) * (axis.lower() == one) + 0.0 for one in "xyz"))
    if len(directions) > 1:
        text = f"the comments {' and '.join(map(repr, comments))} contradict each other: ignored"
        metadata.findings.append(Finding("vertical-axis", len(comments), text, "note"))
        return comments
    stated = up_of(metadata.metadata, metadata.coordinate_system)
    if stated is not None:
        return () if stated == directions.pop() else comments
    metadata.metadata[UP] = list(directions.pop())
    text = f"the comment {comments[0]!r} specifies the up axis"
    metadata.findings.append(Finding("vertical-axis", 1, text, "note"))
    return ()


def _set_field(metadata: CommentMetadata, key: str, values: Sequence[str]) -> bool:
    """Set the field of a csplat comment; return False if its key is unknown."""
    if key in ("origin", "absolute_origin"):
        x, y, z = _numbers(key, values, 3)
        metadata.origin, metadata.origin_is_added = (x, y, z), key == "absolute_origin"
    elif key == "coordinate_system" and len(values) == 1:
        metadata.coordinate_system = values[0]
    elif key == UP:
        metadata.metadata[UP] = _up(values)
    elif key == "unit_metres":
        (metadata.unit_metres,) = _numbers(key, values, 1)
    elif key == "antialiased" and not values:
        metadata.antialiased = True
    elif key == "flat" and not values:
        metadata.flat = True
    elif key == "licence" and values:
        metadata.metadata["licence"] = " ".join(values)
    else:
        return False
    return True


def _up(values: Sequence[str]) -> list[float]:
    numbers = _numbers(UP, values, 3)
    try:
        return list(unit_up(numbers))
    except InputError as error:
        raise InputError(f"the header comment {' '.join((_PREFIX, UP, *values))!r}: {error}") from None


def _training(comment: str) -> TrainingRecord:
    value = _json(comment)
    try:
        return TrainingRecord.from_json(value)
    except InputError as error:
        raise _comment_error(comment, str(error)) from None


def _view(comment: str) -> dict[str, Any]:
    """Parse a view; its members are checked where they are used."""
    view = _json(comment)
    if not isinstance(view, dict) or not _is_json(view):
        raise _comment_error(comment, "expected an object with finite numbers")
    return view


def _is_json(value: object) -> bool:
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        return False
    return True


def _json(comment: str) -> object:
    """Parse the JSON after the first two words of a comment."""
    try:
        return parse_json("".join(comment.split(None, 2)[2:]))
    except InputError as error:
        raise _comment_error(comment, f"not JSON: {error}") from None


def _comment_error(comment: str, reason: str) -> InputError:
    return InputError(f"the header comment {comment[:_SHOWN]!r} is invalid: {reason}")


def _numbers(key: str, values: Sequence[str], count: int) -> list[float]:
    try:
        numbers = [float(value) for value in values]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        line = " ".join((_PREFIX, key, *values))
        raise InputError(f"the header comment {line[:_SHOWN]!r} does not contain {count} finite numbers")
    return numbers


def _strings(value: object) -> list[str]:
    return [one for one in value if isinstance(one, str)] if isinstance(value, list) else []


def _choose_origin(positions: F64) -> tuple[float, float, float]:
    """Choose an origin for float64 positions so that float32 loses nothing visible.

    The origin is zero if float32 is exact or the scene is around zero. Otherwise it is the scene's centre (the median,
    which is robust to outliers), rounded to a multiple of a power of two near the scene's spread.
    """
    if len(positions) == 0 or np.array_equal(positions, positions.astype(np.float32)):
        return (0.0, 0.0, 0.0)
    centre = np.median(positions, axis=0)
    spread = float(np.median(np.abs(positions - centre), axis=0).max())
    if np.abs(centre).max() <= _NEAR_SPREADS * spread:
        return (0.0, 0.0, 0.0)
    if spread > 0.0:
        step = math.ldexp(0.5, math.frexp(spread)[1])
        centre = np.round(centre / step) * step
    x, y, z = centre.tolist()
    return x, y, z
