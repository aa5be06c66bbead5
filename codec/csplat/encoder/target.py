# SPDX-License-Identifier: Apache-2.0
"""The target of an encoding, and the report of the search that met it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from numbers import Real
from typing import Any, Protocol

from csplat._spec import HEADER_SIZE, MEASURE_NAMES
from csplat.errors import InputError
from csplat.sizes import Size, parse_size
from csplat.types import PSNR_CAP

_DROPS = (0.001, 60.0)  # allowed range of `max_psnr_drop`, dB
_EFFORTS = (1, 5)  # allowed range of `effort`; 7 made larger files than 5 on all of four scenes


class Views(Protocol):
    """Views that a search for a target renders, as `csplat_tools.ViewSet`."""

    @property
    def name(self) -> str:
        """Name of the views, for reports."""
        ...


@dataclass(frozen=True)
class Target:
    """The target of a file: one of the first four fields, or largest errors alone or together with a PSNR or a size.

    A PSNR is computed from the squared error of renders clipped to 0..1, pooled over views, pixels and channels. It is
    at most 99 dB. Targets are met on validation views; test views are only reported. Renders are compared with:

    | target | reference |
    |---|---|
    | `psnr` | renders of the source; images, if there are any, for `finetune` and `train` |
    | `max_psnr_drop` | images |

    Attributes:
        psnr: least PSNR, dB, at most 99; the search finds the smallest such file, or the fewest splats.
        size: largest size, bytes or text such as "60kB"; the search finds the file with the best PSNR.
        max_psnr_drop: largest drop of the PSNR below the source's, 0.001 to 60 dB; the search finds the smallest such
            file, or the fewest splats.
        keep: fraction of the splats to keep, above 0, at most 1, at the precision of the preset.
        max_error: largest error of any splat by measure of the format: means in scene units, covariance relative,
            opacities, sh0 to sh4. Alone it requires no rendering. 0 keeps the values of SPZ, except rotations of its
            versions 1 and 2, and alpha of SOG; `covariance` and `sh0` then differ by roundings to float32.
        prune: prune splats, and refit the others, if that makes a smaller or better file. Without, a search takes less
            than half of the time.
        effort: 1 to 5, work of the search: number of candidates and refit steps.

    Raises:
        InputError: no target is given, or several, or a value is out of range.
    """

    psnr: float | None = None
    size: Size | None = None
    max_psnr_drop: float | None = None
    keep: float | None = None
    max_error: Mapping[str, float] = field(default_factory=dict)
    prune: bool = True
    effort: int = 3

    def __post_init__(self) -> None:
        if self.size is not None:
            object.__setattr__(self, "size", _file_size(self.size))
        for name, value in {**{name: getattr(self, name) for name in (*_ASKED, "effort")}, **self.max_error}.items():
            if value is not None and not isinstance(value, Real):
                raise InputError(f"{name} is {value!r}, expected a number")
        requested = [words for name, words in _ASKED.items() if getattr(self, name) is not None]
        if not requested and not self.max_error:
            raise InputError("no target, expected a size, a PSNR, a drop of PSNR, a kept fraction or largest errors")
        if len(requested) > 1:
            raise InputError(f"{' and '.join(requested)} are given, expected only one of them")
        if self.max_error and (self.keep is not None or self.max_psnr_drop is not None):
            raise InputError(f"largest errors exclude {requested[0]}: pruned and refitted splats have no bounds")
        if self.keep is not None and not self.prune:
            raise InputError("a kept fraction excludes prune=False")
        if self.psnr is not None and not 0.0 < self.psnr <= PSNR_CAP:
            raise InputError(f"the target PSNR is {self.psnr:g} dB, expected above 0 and at most {PSNR_CAP:g}")
        if self.max_psnr_drop is not None and not _DROPS[0] <= self.max_psnr_drop <= _DROPS[1]:
            raise InputError(
                f"the largest drop of PSNR is {self.max_psnr_drop:g} dB, expected {_DROPS[0]:g} to {_DROPS[1]:g}"
            )
        if self.keep is not None and not 0.0 < self.keep <= 1.0:
            raise InputError(f"the kept fraction is {self.keep:g}, expected above 0 and at most 1")
        if not _EFFORTS[0] <= self.effort <= _EFFORTS[1]:
            raise InputError(f"the effort is {self.effort:g}, expected {_EFFORTS[0]} to {_EFFORTS[1]}")
        for name, bound in self.max_error.items():
            if name not in MEASURE_NAMES.values():
                raise InputError(
                    f"{name!r} is not a measure of errors, expected one of {', '.join(MEASURE_NAMES.values())}"
                )
            if not (math.isfinite(bound) and bound >= 0.0):
                raise InputError(f"the largest error of {name} is {bound:g}, expected at least 0")
            if bound == 0.0 and requested:
                raise InputError(f"{requested[0]} excludes a largest error of 0, which determines the steps of {name}")

    @property
    def size_bytes(self) -> int | None:
        """`size` in bytes."""
        return None if self.size is None else parse_size(self.size)

    @property
    def is_rendered(self) -> bool:
        """True if meeting the target requires rendering."""
        return any(getattr(self, name) is not None for name in _ASKED)

    def count(self, splats: int) -> int:
        """Return the number of splats to keep, at least one, for a target with `keep`."""
        assert self.keep is not None
        return max(1, round(self.keep * splats))

    def require(self, command: str, *names: str) -> None:
        """Refuse a target that a command cannot meet.

        Args:
            command: name of the command, for the message.
            names: fields that it can meet.

        Raises:
            InputError: another field is set.
        """
        others = [name for name in self.as_json() if name not in names]
        if others:
            raise InputError(f"{others[0]} is no target of {command}, expected {' or '.join(names)}")

    def as_json(self) -> dict[str, Any]:
        """Return the targets that are set, by name."""
        targets = {name: getattr(self, name) for name in _ASKED if getattr(self, name) is not None}
        return {**targets, "max_error": dict(self.max_error)} if self.max_error else targets


def _file_size(size: Size) -> int:
    """Return the number of bytes of a size; a bare number smaller than every file lacks its unit."""
    count = parse_size(size)
    if count <= HEADER_SIZE:
        raise InputError(f"no file has {count} bytes or fewer; expected a larger size, such as 5MB")
    return count


_ASKED = {"psnr": "a PSNR", "size": "a size", "max_psnr_drop": "a drop of PSNR", "keep": "a kept fraction"}


@dataclass(frozen=True)
class SearchReport:
    """The report of a search for a target.

    Attributes:
        goal: the target, by name.
        size_bytes, splats: size of the file and its number of splats.
        splats_before: number of splats of the scene.
        encodes: number of files that were made.
        seconds: time of the whole search.
        reached: largest errors of the file by measure, for bounded measures.
        psnr: PSNR of the file on the test views against renders of the source, dB; `None`, like the following fields,
            if nothing was rendered.
        validation_psnr: PSNR of the file on the validation views against renders of the source, dB.
        images: PSNR of `file` and `source` against the test images, if any.
        worst_psnr: PSNR of the worst view, dB.
        spread: standard deviation of the PSNR over other choices of such views, dB.
        elsewhere: PSNR on views that were not used in the search, dB, by kind: virtual views beside, nearer and
            farther, or views between, beside and beyond given cameras.
        views: number of test views.
        views_of: source of the views: `virtual`, or a name.
        renders: number of scored renders.
        pruning_views, sensitivity_views: number of small renders for measuring pruning errors, and sensitivities.
        chosen, tried: the chosen file and all candidates.
        why, sure: explanations of the choice, and of the accuracy of the PSNR.
        interrupted: the search was interrupted, and its best file so far was chosen.
    """

    goal: dict[str, Any]
    size_bytes: int
    splats: int
    splats_before: int
    encodes: int
    seconds: float
    reached: dict[str, float] = field(default_factory=dict)
    psnr: float | None = None
    validation_psnr: float | None = None
    images: dict[str, float] = field(default_factory=dict)
    worst_psnr: float | None = None
    spread: float | None = None
    elsewhere: dict[str, float] = field(default_factory=dict)
    views: int = 0
    views_of: str = ""
    renders: int = 0
    pruning_views: int = 0
    sensitivity_views: int = 0
    chosen: dict[str, Any] = field(default_factory=dict)
    tried: tuple[dict[str, Any], ...] = ()
    why: tuple[str, ...] = ()
    sure: str = ""
    interrupted: bool = False

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return asdict(self)
