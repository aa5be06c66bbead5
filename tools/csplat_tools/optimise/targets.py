"""The target of an encoding: size, PSNR, drop of PSNR, kept fraction, largest errors; and parsing of error bounds."""

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
from csplat_tools.console import NUMBER

_LENGTHS = {"um": 1e-6, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3}
_IN_UNITS = "means"  # the one measure that is a length
_DROPS = (0.001, 60.0)  # allowed range of `max_psnr_drop`, dB


@dataclass(frozen=True)
class Target:
    """The target of a file: one of the first four, or largest errors alone or together with a PSNR or a size.

    Attributes:
        psnr: least PSNR of renders against the source's, dB; the search finds the smallest such file.
        size_bytes: largest size; the search finds the file with the best PSNR.
        max_psnr_drop: largest drop of the PSNR against images below the source's, 0.001 to 60 dB; the search finds the
            smallest such file.
        keep: fraction of the splats to keep, above 0, at most 1, at the precision of the preset.
        max_error: largest error of any splat by measure of the format: means in scene units, covariance relative,
            opacities, sh0, sh1, sh2, sh3.

    Raises:
        InputError: no target is given, or several, or a value is out of range.
    """

    psnr: float | None = None
    size_bytes: int | None = None
    max_psnr_drop: float | None = None
    keep: float | None = None
    max_error: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, value in {**{name: getattr(self, name) for name in _ASKED}, **self.max_error}.items():
            if value is not None and not isinstance(value, Real):
                raise InputError(f"{name} is {value!r}, expected a number")
        given = [words for name, words in _ASKED.items() if getattr(self, name) is not None]
        if not given and not self.max_error:
            raise InputError("no target, expected a size, a PSNR, a drop of PSNR, a kept fraction or largest errors")
        if len(given) > 1:
            raise InputError(f"{' and '.join(given)} are given, expected only one of them")
        if self.max_error and (self.keep is not None or self.max_psnr_drop is not None):
            raise InputError(f"largest errors exclude {given[0]}: pruned and refitted splats have no bounds")
        if self.size_bytes is not None and self.size_bytes < 1:
            raise InputError(f"the target size is {self.size_bytes} bytes, expected at least 1")
        if self.psnr is not None and not 0.0 < self.psnr <= PSNR_CAP:
            raise InputError(f"the target PSNR is {self.psnr:g} dB, expected above 0 and at most {PSNR_CAP:g}")
        if self.max_psnr_drop is not None and not _DROPS[0] <= self.max_psnr_drop <= _DROPS[1]:
            raise InputError(
                f"the largest drop of PSNR is {self.max_psnr_drop:g} dB, expected {_DROPS[0]:g} to {_DROPS[1]:g}"
            )
        if self.keep is not None and not 0.0 < self.keep <= 1.0:
            raise InputError(f"the kept fraction is {self.keep:g}, expected above 0 and at most 1")
        for name, bound in self.max_error.items():
            if name not in MEASURE_NAMES.values():
                raise InputError(
                    f"{name!r} is not a measure of errors, expected one of {', '.join(MEASURE_NAMES.values())}"
                )
            if not (math.isfinite(bound) and bound > 0.0):
                raise InputError(f"the largest error of {name} is {bound:g}, expected above 0")

    @property
    def is_rendered(self) -> bool:
        """True if meeting the target requires rendering."""
        return any(getattr(self, name) is not None for name in _ASKED)

    def count(self, splats: int) -> int:
        """Return the number of splats to keep, at least one, for a target with `keep`."""
        assert self.keep is not None
        return max(1, round(self.keep * splats))

    def as_json(self) -> dict[str, Any]:
        """Return the values that are set, by name."""
        given = {name: getattr(self, name) for name in _ASKED if getattr(self, name) is not None}
        return {**given, "max_error": dict(self.max_error)} if self.max_error else given


_ASKED = {"psnr": "a PSNR", "size_bytes": "a size", "max_psnr_drop": "a drop of PSNR", "keep": "a kept fraction"}


def parse_max_error(text: str, unit_metres: float | None) -> dict[str, float]:
    """Parse bounds by measure from `means=0.001,opacities=0.01`.

    Args:
        text: the user's text; lengths may have a unit, such as `means=2mm`, if the scene's unit is known.
        unit_metres: length of a scene unit in metres; `None` if unknown.

    Raises:
        InputError: the text is invalid; or a length has a unit, and the scene's unit is unknown.
    """
    bounds: dict[str, float] = {}
    for part in text.split(","):
        name, _, value = part.partition("=")
        name = name.strip()
        found = re.fullmatch(NUMBER + r"\s*([a-zµ]*)", value.strip().lower())
        if found is None:
            raise InputError(f"{part.strip()!r} is not an error bound, expected a measure and a number: means=0.001")
        if name in bounds:
            raise InputError(f"the largest error of {name} is given twice")
        bounds[name] = float(found[1]) * _factor(part.strip(), name, found[2], unit_metres)
    return dict(Target(max_error=bounds).max_error)


def _factor(part: str, name: str, unit: str, unit_metres: float | None) -> float:
    """Return the factor that converts a number with a unit to scene units."""
    if not unit:
        return 1.0
    if name != _IN_UNITS or unit not in _LENGTHS:
        expected = f"one of {', '.join(_LENGTHS)}" if name == _IN_UNITS else "no unit, since it is not a length"
        raise InputError(f"{part!r} has the unit {unit!r}, expected {expected}")
    if unit_metres is None:
        raise InputError(
            f"{part!r} has a unit, and the length of a scene unit is unknown: use scene units (means=0.001), or set"
            " --unit-metres"
        )
    return _LENGTHS[unit] / unit_metres
