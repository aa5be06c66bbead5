"""What a search says of the file that it found."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from csplat.encoder import EncodeResult

__all__ = ["Optimised", "Report"]


@dataclass(frozen=True)
class Report:
    """A search.

    Attributes:
        goal: what was asked, by name.
        size_bytes, splats: of the file. splats_before: of the scene.
        encodes: how many files were made. seconds: for everything.
        reached: largest errors of the file, by measure, where they are bounded.
        psnr: of the file against the source, dB; `None` where nothing was rendered, as all that follows.
        photographs: PSNR of `file` and `source` by the photographs that judge, where there are some.
        worst_psnr: of the worst view. spread: what other such views would make of the PSNR, one standard deviation, dB.
        views: that judged. views_of: where they come from. renders: pictures that were judged.
        removal_views, sensitivity_views: small views in which removal and the precision wanted were measured.
        chosen, tried: files, see `Trial.as_json`.
        why, sure: sentences.
    """

    goal: dict[str, Any]
    size_bytes: int
    splats: int
    splats_before: int
    encodes: int
    seconds: float
    reached: dict[str, float] = field(default_factory=dict)
    psnr: float | None = None
    photographs: dict[str, float] = field(default_factory=dict)
    worst_psnr: float | None = None
    spread: float | None = None
    views: int = 0
    views_of: str = ""
    renders: int = 0
    removal_views: int = 0
    sensitivity_views: int = 0
    chosen: dict[str, Any] = field(default_factory=dict)
    tried: tuple[dict[str, Any], ...] = ()
    why: tuple[str, ...] = ()
    sure: str = ""

    def as_json(self) -> dict[str, Any]:
        """Everything, JSON-compatible."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Optimised:
    """A file that keeps to a target.

    Attributes:
        result: of the encoder; its source index is into the source.
        report: how it was found.
    """

    result: EncodeResult
    report: Report
