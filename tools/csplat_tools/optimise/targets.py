"""The target of an encoding (size, PSNR, loss, fraction of the splats, largest errors), and parsing of error bounds."""

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
_LOSSES = (0.001, 60.0)  # allowed range of `max_psnr_drop`, dB


@dataclass(frozen=True)
class Target:
    """The target of a file: one of the first four, or largest errors alone or together with a PSNR or a size.

    Attributes:
        psnr: least PSNR of its renders against the source's, dB; the smallest such file is searched.
        size_bytes: largest size; the file with the best PSNR within it is searched.
        max_psnr_drop: dB that its PSNR against photographs may be below the source's, 0.001 to 60; the smallest such
            file is searched.
        keep: fraction of the splats to keep, above 0, at most 1, at the precision of the preset.
        max_error: the largest error of any splat, by measure of the format: means in scene units, covariance relative,
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
                raise InputError(f"{name} is {value!r}, wanted a number")
        given = [words for name, words in _ASKED.items() if getattr(self, name) is not None]
        if not given and not self.max_error:
            raise InputError("no target, wanted a size, a PSNR, a loss, a share of the splats or largest errors")
        if len(given) > 1:
            raise InputError(f"{' and '.join(given)} are asked for, wanted one of them: the others follow")
        if self.max_error and (self.keep is not None or self.max_psnr_drop is not None):
            raise InputError(f"largest errors and {given[0]}: what is left out or fitted anew has no bounds")
        if self.size_bytes is not None and self.size_bytes < 1:
            raise InputError(f"the target size is {self.size_bytes} bytes, wanted 1 or more")
        if self.psnr is not None and not 0.0 < self.psnr <= PSNR_CAP:
            raise InputError(f"the target PSNR is {self.psnr:g} dB, wanted above 0, at most {PSNR_CAP:g}")
        if self.max_psnr_drop is not None and not _LOSSES[0] <= self.max_psnr_drop <= _LOSSES[1]:
            raise InputError(f"the largest loss is {self.max_psnr_drop:g} dB, wanted {_LOSSES[0]:g} to {_LOSSES[1]:g}")
        if self.keep is not None and not 0.0 < self.keep <= 1.0:
            raise InputError(f"the share of the splats is {self.keep:g}, wanted above 0, at most 1")
        for name, bound in self.max_error.items():
            if name not in MEASURE_NAMES.values():
                raise InputError(f"{name!r} is no measure of errors, wanted one of {', '.join(MEASURE_NAMES.values())}")
            if not (math.isfinite(bound) and bound > 0.0):
                raise InputError(f"the largest error of {name} is {bound:g}, wanted above 0")

    @property
    def is_rendered(self) -> bool:
        """True if meeting the target requires rendering."""
        return any(getattr(self, name) is not None for name in _ASKED)

    def count(self, splats: int) -> int:
        """Return the number of splats to keep of `splats`, at least one; only for a target with `keep`."""
        assert self.keep is not None
        return max(1, round(self.keep * splats))

    def as_json(self) -> dict[str, Any]:
        """Return the values that are set, by name."""
        given = {name: getattr(self, name) for name in _ASKED if getattr(self, name) is not None}
        return {**given, "max_error": dict(self.max_error)} if self.max_error else given


_ASKED = {"psnr": "a PSNR", "size_bytes": "a size", "max_psnr_drop": "a loss", "keep": "a share of the splats"}


def parse_max_error(text: str, unit_metres: float | None) -> dict[str, float]:
    """Parse bounds by measure from `means=0.001,opacities=0.01`.

    Args:
        text: the user's text; lengths with a unit such as `means=2mm` are accepted if the scene's unit is known.
        unit_metres: length of a scene unit in metres; `None` if it is not known.

    Raises:
        InputError: the text is invalid; or a length has a unit, and the scene's unit is not known.
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
    """Return the factor that converts a number with a unit to scene units."""
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
