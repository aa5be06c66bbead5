# SPDX-License-Identifier: Apache-2.0
"""Read and write the metadata of a scene as comment lines of a PLY header, and split positions from their origin.

| comment | meaning |
|---|---|
| `csplat origin X Y Z` | x, y, z are relative to this origin |
| `csplat absolute_origin X Y Z` | x, y, z are absolute, in doubles |
| `csplat coordinate_system RDF` | directions of the axes |
| `csplat up X Y Z`, `csplat unit_metres U`, `csplat licence TEXT` | as in `SceneMetadata` |
| `csplat estimated KEY ...` | entries that are estimates: `up` |
| `csplat colour_space NAME` | as in `SceneMetadata`; absent for sRGB |
| `csplat semantic NAME SEMANTIC` | what an extra column means; absent if its name says so |
| `csplat comment TEXT` | a comment that is not printable ASCII |
| `csplat training {JSON}`, `csplat view {JSON}` | the training (`TrainingRecord`) and the initial view |
| `SplatRenderMode: mip`, `SplatRenderMode: 2dgs` | antialiased, flat; also used by other programs |

Headers are ASCII, because plyfile refuses others. TEXT and SEMANTIC are JSON strings if they are not one line of it.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import parse_json
from csplat.errors import InputError
from csplat.lint import Finding
from csplat.scene_metadata import (
    ESTIMATED,
    LICENCE,
    SRGB,
    TRAINING,
    UNSPECIFIED,
    UP,
    VIEW,
    SceneMetadata,
    TrainingRecord,
    unit_up,
)
from csplat.types import F32, F64

_PREFIX = "csplat"
_COMMENT, _SEMANTIC = "comment", "semantic"
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


@dataclass(frozen=True)
class CommentMetadata:
    """Scene metadata from header comments, with defaults.

    Attributes:
        origin: origin of the scene; `None` if no comment specifies it.
        origin_is_added: True if x, y and z in the file are absolute, that is, include the origin.
        metadata: the scene's metadata; comments that csplat does not interpret are its `comments`.
        findings: findings about the comments of other programs.
    """

    origin: tuple[float, float, float] | None = None
    origin_is_added: bool = False
    metadata: SceneMetadata = field(default_factory=SceneMetadata)
    findings: tuple[Finding, ...] = ()


def parse_comments(comments: Sequence[str]) -> CommentMetadata:
    """Parse the comment lines of a header, without the word `comment`.

    Raises:
        InputError: the value of a csplat comment is invalid. It is not ignored, because a wrong origin would move the
            scene and a wrong background would invalidate comparisons.
    """
    fields: dict[str, Any] = {}
    entries: dict[str, Any] = {}
    others: list[str] = []
    vertical: list[str] = []
    by_brush = any(comment.strip().lower() == _BRUSH for comment in comments)
    for comment in comments:
        words = comment.split()
        mode = _MODES.get(tuple(comment.lower().split()))
        if words[:2] == [_PREFIX, TRAINING]:
            entries[TRAINING] = _parse_training(comment).as_json()
        elif words[:2] == [_PREFIX, VIEW]:
            entries[VIEW] = _view(comment)
        elif mode is not None:
            fields |= {mode: True} if mode else {}
        elif _VERTICAL_AXIS.fullmatch(comment.strip()) and not by_brush:
            vertical.append(comment.strip())
        elif words[:2] == [_PREFIX, _COMMENT] and len(words) > 2:
            others.append(_parse_text(comment, 2))
        elif words[:2] == [_PREFIX, LICENCE] and len(words) > 2:
            entries[LICENCE] = _parse_text(comment, 2)
        elif words[:2] == [_PREFIX, _SEMANTIC] and len(words) > 3:
            fields.setdefault("semantics", {})[words[2]] = _parse_text(comment, 3)
        elif words[:1] != [_PREFIX] or len(words) < 2 or not _set_field(fields, entries, words[1], words[2:]):
            others.append(comment)
    origin, origin_is_added = fields.pop("origin", None), fields.pop("origin_is_added", False)
    metadata = SceneMetadata(**fields, entries=entries)
    metadata, ignored, findings = _with_vertical_axis(metadata, vertical)
    if others or ignored:
        metadata = metadata.with_entries(comments=[*others, *ignored])
    return CommentMetadata(origin, origin_is_added, metadata, findings)


def format_comments(metadata: SceneMetadata, origin: Sequence[float], *, absolute: bool) -> list[str]:
    """Format metadata as comment lines, without the word `comment`.

    Args:
        metadata, origin: metadata and origin of the scene.
        absolute: positions are written with the origin added.

    Returns:
        Lines of printable ASCII. Defaults get no line.
    """
    lines = [
        comment if _is_line(comment) else f"{_PREFIX} {_COMMENT} {json.dumps(comment)}" for comment in metadata.comments
    ]
    if absolute or any(origin):
        key = "absolute_origin" if absolute else "origin"
        lines.append(f"{_PREFIX} {key} {' '.join(repr(value) for value in origin)}")
    if metadata.coordinate_system != UNSPECIFIED:
        lines.append(f"{_PREFIX} coordinate_system {metadata.coordinate_system}")
    if metadata.stated_up is not None:
        lines.append(f"{_PREFIX} {UP} {' '.join(repr(value) for value in metadata.stated_up)}")
    if metadata.estimated:
        lines.append(f"{_PREFIX} {ESTIMATED} {' '.join(metadata.estimated)}")
    if metadata.unit_metres is not None:
        lines.append(f"{_PREFIX} unit_metres {metadata.unit_metres!r}")
    if metadata.colour_space != SRGB:
        lines.append(f"{_PREFIX} colour_space {metadata.colour_space}")
    named = ((name, semantic) for name, semantic in metadata.semantics.items() if name != semantic)
    lines += [f"{_PREFIX} {_SEMANTIC} {name} {_format_text(semantic)}" for name, semantic in named]
    if metadata.flat:
        lines.append("SplatRenderMode: 2dgs")
    if metadata.antialiased:
        lines.append("SplatRenderMode: mip")
    if metadata.licence is not None:
        lines.append(f"{_PREFIX} {LICENCE} {_format_text(metadata.licence)}")
    view = metadata.entries.get(VIEW)
    if isinstance(view, dict) and _is_json(view):
        lines.append(f"{_PREFIX} {VIEW} {json.dumps(view)}")
    if metadata.training is not None:
        lines.append(f"{_PREFIX} {TRAINING} {json.dumps(metadata.training.as_json())}")
    return lines


def unwritten_entries(metadata: SceneMetadata) -> list[str]:
    """Return the keys of the entries that `format_comments` does not write, or not completely."""
    try:
        written = parse_comments(format_comments(metadata, (0.0, 0.0, 0.0), absolute=False)).metadata
    except InputError:
        return list(metadata.entries)
    read = {**written.entries, UP: None if written.stated_up is None else list(written.stated_up)}
    wanted = {**metadata.entries, UP: None if metadata.stated_up is None else list(metadata.stated_up)}
    return [key for key in metadata.entries if not _is_json(wanted[key]) or _plain_json(wanted[key]) != read.get(key)]


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


def _with_vertical_axis(
    metadata: SceneMetadata, comments: Sequence[str]
) -> tuple[SceneMetadata, Sequence[str], tuple[Finding, ...]]:
    """Add the up direction that comments on the vertical axis specify, unless it is known.

    Returns:
        The metadata; the comments to keep, which are those that contradict each other or the known direction; and a
        finding if a direction was added or the comments contradict each other.
    """
    if not comments:
        return metadata, (), ()
    directions = set()
    for comment in comments:
        match = _VERTICAL_AXIS.fullmatch(comment)
        assert match is not None, "it was matched before"
        sign, axis = match.groups()
        length = -1.0 if sign == "-" else 1.0
        directions.add(tuple(length if axis.lower() == name else 0.0 for name in "xyz"))
    if len(directions) > 1:
        text = f"the comments {' and '.join(map(repr, comments))} contradict each other: ignored"
        return metadata, comments, (Finding("vertical-axis", len(comments), text, "note"),)
    direction = directions.pop()
    if metadata.up is not None:
        return metadata, () if metadata.up == direction else comments, ()
    text = f"the comment {comments[0]!r} specifies the up axis"
    return metadata.with_entries(up=list(direction)), (), (Finding("vertical-axis", 1, text, "note"),)


def _set_field(fields: dict[str, Any], entries: dict[str, Any], key: str, values: Sequence[str]) -> bool:
    """Set the field or entry of a csplat comment; return False if its key or its number of values is unknown."""
    if key in ("origin", "absolute_origin"):
        fields |= {"origin": tuple(_parse_numbers(key, values, 3)), "origin_is_added": key == "absolute_origin"}
    elif key in ("coordinate_system", "colour_space") and len(values) == 1:
        fields[key] = values[0]
    elif key == UP:
        entries[UP] = _parse_up(values)
    elif key == "unit_metres":
        (fields[key],) = _parse_numbers(key, values, 1)
    elif key in ("antialiased", "flat") and not values:
        fields[key] = True
    elif key == ESTIMATED and values:
        entries[ESTIMATED] = list(values)
    else:
        return False
    return True


def _is_line(text: str) -> bool:
    """Return True if a text is a line of a header that every program reads as it is."""
    return text.isascii() and text.replace("\t", " ").isprintable() and text == text.rstrip()


def _format_text(text: str) -> str:
    """Return a text as `_parse_text` reads it."""
    is_plain = _is_line(text) and text == text.strip() and text[:1] not in ("", '"')
    return text if is_plain else json.dumps(text)


def _parse_text(comment: str, words: int) -> str:
    """Return the text after the first words of a comment: a JSON string, or anything else as it is."""
    text = comment.split(None, words)[words].rstrip()
    with suppress(ValueError):
        value = json.loads(text)
        if isinstance(value, str):
            return value
    return text


def _parse_up(values: Sequence[str]) -> list[float]:
    """Parse an up direction to a unit vector; raise an `InputError` that quotes the comment if it is not one."""
    numbers = _parse_numbers(UP, values, 3)
    try:
        return list(unit_up(numbers))
    except InputError as error:
        raise InputError(f"the header comment {' '.join((_PREFIX, UP, *values))!r}: {error}") from None


def _parse_training(comment: str) -> TrainingRecord:
    """Parse a training record; raise an `InputError` that quotes the comment if it is invalid."""
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
    """Return True if a value can be written as JSON: without NaN and infinity, and not nested too deeply."""
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        return False
    return True


def _plain_json(value: object) -> Any:
    """Return a value as it comes back from JSON."""
    return json.loads(json.dumps(value))


def _json(comment: str) -> object:
    """Parse the JSON after the first two words of a comment; raise an `InputError` that quotes it if it is none."""
    try:
        return parse_json("".join(comment.split(None, 2)[2:]))
    except InputError as error:
        raise _comment_error(comment, f"not JSON: {error}") from None


def _comment_error(comment: str, reason: str) -> InputError:
    """Return an error that quotes the start of a header comment."""
    return InputError(f"the header comment {comment[:_SHOWN]!r} is invalid: {reason}")


def _parse_numbers(key: str, values: Sequence[str], count: int) -> list[float]:
    """Parse the values of a comment; raise an `InputError` unless they are `count` finite numbers."""
    try:
        numbers = [float(value.replace("_", "?")) for value in values]  # Python accepts 1_000
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        line = " ".join((_PREFIX, key, *values))
        raise InputError(f"the header comment {line[:_SHOWN]!r} does not contain {count} finite numbers")
    return numbers


def _choose_origin(positions: F64) -> tuple[float, float, float]:
    """Choose an origin for positions [N, 3] so that float32 loses nothing visible.

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
