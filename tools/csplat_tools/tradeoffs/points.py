"""Results of the sweep for one way of storing the scene, and the Pareto front of several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from csplat_render.metrics import Scores
from csplat_tools.pages.hardest import Place

_QUALITY = ("psnr", "psnr_mean", "psnr_worst", "worst_view", "ssim", "lpips")


@dataclass(frozen=True, eq=False)
class TriedFile:
    """A file that has not been measured yet.

    Attributes:
        data: the bytes of the file.
        settings: settings with which it was made, JSON-compatible.
        stages: seconds by stage; empty if they are not known.
    """

    data: bytes
    settings: Mapping[str, Any] = field(default_factory=dict)
    stages: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ModeTime:
    """Time and quality of a mode of the renderer.

    Attributes:
        milliseconds: time of a render, median over views.
        psnr: PSNR against the source's renders of mode `standard`, pooled over the views that were timed, dB.
    """

    milliseconds: float
    psnr: float

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {"ms": round(self.milliseconds, 3), "psnr": self.psnr}


@dataclass(frozen=True)
class Partial:
    """A file whose SH layers above a degree are not fetched.

    Attributes:
        sh_degree: the highest band that is fetched.
        size_bytes: bytes of header, index, and the layers up to this band with their codebooks.
        quality: scores against the source's renders.
        decode_seconds: time of decoding, median of some runs.
        render_milliseconds: time of a render in mode `standard`, median over views.
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
        name, family: as in `Point`.
        error: the error in one line.
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
        family: the group that it belongs to.
        command: the command that makes the same file.
        settings: settings with which the file was made, JSON-compatible.
        size_bytes: size of the file.
        sha256: hash of its bytes, in hexadecimal digits.
        splats, sh_degree: number of splats and SH degree of the file.
        source_splats, source_bytes: number of splats of the scene, and size of its PLY.
        quality: scores against the source's renders.
        photographs: scores against held-out photographs, if there are any.
        encode_seconds: time from the splats to the bytes.
        stages: seconds of its stages, as far as known.
        decode_seconds: time from the bytes to the splats, median of some runs.
        modes: times of the renderer's modes, by name.
        attribute_bytes: bytes by attribute, and everything else as `overhead`.
        first_picture_bytes: bytes of header, index, and everything but the SH bands.
        partial: results with fewer SH layers, if they were measured.
        hardest: the place where it differs most from the source.
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
        """Size of the source divided by that of the file."""
        return self.source_bytes / self.size_bytes

    @property
    def bytes_per_source_splat(self) -> float | None:
        """Bytes of the file divided by the number of splats of the source; `None` if it has none."""
        return self.size_bytes / self.source_splats if self.source_splats else None

    @property
    def psnr(self) -> float:
        """PSNR against the source's renders, dB."""
        return self.quality.psnr

    @property
    def photograph_psnr(self) -> float | None:
        """PSNR pooled over held-out photographs, dB; `None` without photographs."""
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
    """Return the indices of the points that no other one beats.

    Args:
        points: (size, quality) each: a point beats another one if it is neither larger nor worse, and better in one of
            the two. Of equal points only the first is returned.

    Returns:
        Indices, the smallest size first.
    """
    front: list[int] = []
    best = -np.inf
    for place in sorted(range(len(points)), key=lambda at: (points[at][0], -points[at][1], at)):
        if points[place][1] > best:
            front.append(place)
            best = points[place][1]
    return front
