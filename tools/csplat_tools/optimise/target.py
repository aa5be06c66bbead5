"""What is asked of a file: a size, a PSNR, a loss, a share of the splats, largest errors; how a user writes it."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

from csplat._spec import MEASURE_NAMES
from csplat.errors import InputError
from csplat_render.metrics import PSNR_CAP
from csplat_tools.files.sizes import NUMBER

__all__ = ["Target", "parse_max_error"]

_LENGTHS = {"um": 1e-6, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3}
_IN_UNITS = "means"  # the one measure that is a length
_LOSSES = (0.001, 60.0)  # dB


@dataclass(frozen=True)
class Target:
    """What a file is to keep to: one of the first four, largest errors alone or beside a PSNR or a size.

    Attributes:
        psnr: dB of its renders against the source's at least; the smallest file that reaches them is looked for.
        size_bytes: its size at most; the best picture within it is looked for.
        max_loss: dB that its PSNR against photographs may be below the source's, 0.001 to 60; the smallest such file.
        keep: share of the splats that stay, above 0, at most 1, at the precision of the preset.
        max_error: by measure of the format (means in scene units, covariance relative, opacities, sh0, sh1, sh2, sh3),
            the largest error of any splat.

    Raises:
        InputError: nothing is asked for, or too much, or a value is out of range.
    """

    psnr: float | None = None
    size_bytes: int | None = None
    max_loss: float | None = None
    keep: float | None = None
    max_error: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, value in {**{name: getattr(self, name) for name in _ASKED}, **self.max_error}.items():
            if value is not None and not isinstance(value, Real):
                raise InputError(f"{name} is {value!r}, wanted a number")
        given = [words for name, words in _ASKED.items() if getattr(self, name) is not None]
        if not given and not self.max_error:
            raise InputError("no target, wanted a size, a PSNR, a loss, a share of the splats or largest errors")
        if len(given) > 1:
            raise InputError(f"{' and '.join(given)} are asked for, wanted one of them: the others follow")
        if self.max_error and (self.keep is not None or self.max_loss is not None):
            raise InputError(f"largest errors and {given[0]}: what is left out or fitted anew has no bounds")
        if self.size_bytes is not None and self.size_bytes < 1:
            raise InputError(f"the target size is {self.size_bytes} bytes, wanted 1 or more")
        if self.psnr is not None and not 0.0 < self.psnr <= PSNR_CAP:
            raise InputError(f"the target PSNR is {self.psnr:g} dB, wanted above 0, at most {PSNR_CAP:g}")
        if self.max_loss is not None and not _LOSSES[0] <= self.max_loss <= _LOSSES[1]:
            raise InputError(f"the largest loss is {self.max_loss:g} dB, wanted {_LOSSES[0]:g} to {_LOSSES[1]:g}")
        if self.keep is not None and not 0.0 < self.keep <= 1.0:
            raise InputError(f"the share of the splats is {self.keep:g}, wanted above 0, at most 1")
        for name, bound in self.max_error.items():
            if name not in MEASURE_NAMES.values():
                raise InputError(f"{name!r} is no measure of errors, wanted one of {', '.join(MEASURE_NAMES.values())}")
            if not (math.isfinite(bound) and bound > 0.0):
                raise InputError(f"the largest error of {name} is {bound:g}, wanted above 0")

    @property
    def is_rendered(self) -> bool:
        """Whether pictures have to be rendered to meet it."""
        return any(getattr(self, name) is not None for name in _ASKED)

    def count(self, splats: int) -> int:
        """How many of so many splats stay, one at least; for `keep`."""
        assert self.keep is not None
        return max(1, round(self.keep * splats))

    def as_json(self) -> dict[str, Any]:
        """What is asked, by name."""
        said = {name: getattr(self, name) for name in _ASKED if getattr(self, name) is not None}
        return {**said, "max_error": dict(self.max_error)} if self.max_error else said


_ASKED = {"psnr": "a PSNR", "size_bytes": "a size", "max_loss": "a loss", "keep": "a share of the splats"}


def parse_max_error(text: str, unit_metres: float | None) -> dict[str, float]:
    """Bounds by measure from `means=0.001,opacities=0.01`.

    Args:
        text: what a user wrote; lengths with a unit as `means=2mm` are taken where the scene's unit is known.
        unit_metres: length of a scene unit; `None` where nobody knows.

    Raises:
        InputError: it is something else; or a length has a unit and the scene has none.
    """
    bounds: dict[str, float] = {}
    for part in text.split(","):
        name, _, value = part.partition("=")
        name = name.strip()
        found = re.fullmatch(NUMBER + r"\s*([a-zµ]*)", value.strip().lower())
        if found is None:
            raise InputError(f"{part.strip()!r} bounds no error, wanted a measure and a number, as means=0.001")
        if name in bounds:
            raise InputError(f"the largest error of {name} is given twice")
        bounds[name] = float(found[1]) * _factor(part.strip(), name, found[2], unit_metres)
    return dict(Target(max_error=bounds).max_error)


def _factor(part: str, name: str, unit: str, unit_metres: float | None) -> float:
    """What a number has to be multiplied by to be in scene units."""
    if not unit:
        return 1.0
    if name != _IN_UNITS or unit not in _LENGTHS:
        wanted = f"one of {', '.join(_LENGTHS)}" if name == _IN_UNITS else "a number without one: it is no length"
        raise InputError(f"{part!r} has the unit {unit!r}, wanted {wanted}")
    if unit_metres is None:
        raise InputError(
            f"{part!r} has a unit, and the scene does not say how long its own is: give scene units (means=0.001),"
            " or say it with --unit-metres"
        )
    return _LENGTHS[unit] / unit_metres
