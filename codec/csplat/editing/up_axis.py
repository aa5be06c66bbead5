"""Read and set the up direction of a scene (spec 5.4).

The axes of a scene specify the directions of +x, +y and +z, so their up direction is along one of these. The metadata
entry `up` can be any direction and takes precedence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from csplat.errors import InputError
from csplat.model import UNSPECIFIED, SplatModel

Direction = tuple[float, float, float]

#: The key of the metadata for the up direction.
UP = "up"

_DIGITS = 6  # decimals; hides differences in the last bits between machines
_UNIT = 1e-5  # tolerance for the length of a unit vector of six digits
#: Cosine of the angle between up directions that contradict each other; at larger angles another axis is closer to up.
CONTRADICTS = math.cos(math.radians(45.0))


def up_of(metadata: Mapping[str, Any], coordinate_system: str = UNSPECIFIED) -> Direction | None:
    """Return the up direction of a scene; `None` if it specifies no valid one.

    Args:
        metadata: metadata of the scene; a valid `up` in it takes precedence.
        coordinate_system: as in `SplatModel`.
    """
    try:
        return unit_up(metadata[UP]) if UP in metadata else up_of_axes(coordinate_system)
    except InputError:
        return up_of_axes(coordinate_system)


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


def with_up(model: SplatModel, up: Direction | None = None, coordinate_system: str | None = None) -> SplatModel:
    """Return the scene with another up direction or other axes; contradicting metadata is removed.

    Args:
        model: the scene.
        up: three finite numbers, not all 0; `None`: unchanged. Without `coordinate_system`, existing axes with a
            different up are removed.
        coordinate_system: as in `SplatModel`; `None`: unchanged. Without `up`, an existing up direction is removed.

    Examples:
        >>> import csplat
        >>> csplat.with_up(csplat.read_ply("scene.ply"), (0, 0, 1)).metadata["up"]
        [0.0, 0.0, 1.0]

    Raises:
        InputError: an argument is invalid.
    """
    if up is None and coordinate_system is None:
        return model
    metadata = dict(model.metadata)
    letters = model.coordinate_system if coordinate_system is None else coordinate_system
    if coordinate_system is not None:
        metadata.pop(UP, None)
    if up is not None:
        metadata[UP] = list(unit_up(up))
        before = up_of_axes(letters) if coordinate_system is None else None
        if before is not None and sum(a * b for a, b in zip(before, metadata[UP], strict=True)) < CONTRADICTS:
            letters = UNSPECIFIED
    return replace(model, metadata=metadata, coordinate_system=letters)
