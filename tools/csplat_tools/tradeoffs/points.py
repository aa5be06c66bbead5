"""What was found out about one way of storing a scene, and which of several ways no other one beats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from csplat_render.metrics import Scores
from csplat_tools.pages.hardest import Place

__all__ = ["Failure", "ModeTime", "Partial", "Point", "TriedFile", "pareto_front"]

_QUALITY = ("psnr", "psnr_mean", "psnr_worst", "worst_view", "ssim", "lpips")


@dataclass(frozen=True, eq=False)
class TriedFile:
    """A file, before anything is measured.

    Attributes:
        data: the file.
        settings: how it was made, JSON-compatible.
        stages: seconds by stage, where whoever made it knows them.
    """

    data: bytes
    settings: Mapping[str, Any] = field(default_factory=dict)
    stages: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ModeTime:
    """A mode of the renderer.

    Attributes:
        milliseconds: median over views.
        psnr: against the source's renders of mode `standard`, pooled over the views that were timed, dB.
    """

    milliseconds: float
    psnr: float

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {"ms": round(self.milliseconds, 3), "psnr": self.psnr}


@dataclass(frozen=True)
class Partial:
    """A file of which the SH layers above a degree are not fetched.

    Attributes:
        sh_degree: the highest band.
        size_bytes: header, index, and the layers up to this band with their codebooks.
        quality: against the source's renders.
        decode_seconds: median of some runs.
        render_milliseconds: of mode `standard`, median over views.
    """

    sh_degree: int
    size_bytes: int
    quality: Scores
    decode_seconds: float
    render_milliseconds: float

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {
            "sh_degree": self.sh_degree,
            "size_bytes": self.size_bytes,
            **{name: getattr(self.quality, name) for name in ("psnr", "psnr_worst", "ssim")},
            "decode_seconds": round(self.decode_seconds, 5),
            "render_ms": round(self.render_milliseconds, 3),
        }


@dataclass(frozen=True)
class Failure:
    """A point that could not be measured.

    Attributes:
        name, family: as of `Point`.
        error: one line.
    """

    name: str
    family: str
    error: str

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {"name": self.name, "family": self.family, "error": self.error}


@dataclass(frozen=True, eq=False)
class Point:
    """One way of storing the scene, measured.

    Attributes:
        name: unique among the points.
        family: which group it belongs to.
        command: makes the same file.
        settings: how the file was made, JSON-compatible.
        size_bytes: of the file. sha256: of its bytes, in hexadecimal digits.
        splats, sh_degree: of the file.
        source_splats, source_bytes: of the scene, and of its PLY.
        quality: against the source's renders.
        photographs: against held-out photographs, where there are some.
        encode_seconds: everything from the splats to the bytes. stages: what stages took of that, as far as known.
        decode_seconds: from the bytes to the splats, median of some runs.
        modes: the renderer's, by name.
        attribute_bytes: by attribute, and everything else as `overhead`.
        first_picture_bytes: header, index, and everything but the SH bands.
        partial: quality by SH layers fetched, where it was looked at.
        hardest: where it differs most from the source.
    """

    name: str
    family: str
    command: str
    settings: Mapping[str, Any]
    size_bytes: int
    sha256: str
    splats: int
    sh_degree: int
    source_splats: int
    source_bytes: int
    quality: Scores
    photographs: Scores | None
    encode_seconds: float
    stages: Mapping[str, float]
    decode_seconds: float
    modes: Mapping[str, ModeTime]
    attribute_bytes: Mapping[str, int]
    first_picture_bytes: int
    partial: Sequence[Partial] = ()
    hardest: Place | None = field(default=None, repr=False)

    @property
    def ratio(self) -> float:
        """How many times the file is smaller than the source."""
        return self.source_bytes / self.size_bytes

    @property
    def bytes_per_source_splat(self) -> float | None:
        """Bytes of the file over splats of the source; `None` where it has none."""
        return self.size_bytes / self.source_splats if self.source_splats else None

    @property
    def psnr(self) -> float:
        """Against the source's renders, dB."""
        return self.quality.psnr

    @property
    def photograph_psnr(self) -> float | None:
        """Pooled over held-out photographs, dB."""
        return None if self.photographs is None else self.photographs.psnr

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {
            "name": self.name,
            "family": self.family,
            "error": None,
            "command": self.command,
            "settings": dict(self.settings),
            "size_bytes": self.size_bytes,
            "sha256": self.sha256,
            "bytes_per_source_splat": self.bytes_per_source_splat,
            "ratio": self.ratio,
            "splats": self.splats,
            "sh_degree": self.sh_degree,
            **{name: getattr(self.quality, name) for name in _QUALITY},
            "photographs": None if self.photographs is None else self.photographs.as_json(),
            "seconds": {
                "encode": round(self.encode_seconds, 4),
                "stages": {name: round(seconds, 4) for name, seconds in self.stages.items()},
                "decode": round(self.decode_seconds, 5),
            },
            "render": {name: one.as_json() for name, one in self.modes.items()},
            "attribute_bytes": dict(self.attribute_bytes),
            "first_picture_bytes": self.first_picture_bytes,
            "partial": [one.as_json() for one in self.partial],
        }


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Which of some points no other one beats.

    Args:
        points: (size, quality) each: a point beats another one where it is not larger and not worse, and one of
            the two is better. Of equal ones the first counts.

    Returns:
        Their places, the smallest size first.
    """
    front: list[int] = []
    best = -np.inf
    for place in sorted(range(len(points)), key=lambda at: (points[at][0], -points[at][1], at)):
        if points[place][1] > best:
            front.append(place)
            best = points[place][1]
    return front
