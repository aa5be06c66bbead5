"""What a search says of the file that it found."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from csplat.encoder import EncodeResult
from csplat.errors import counted
from csplat_tools.files.console import format_bytes

__all__ = ["Optimised", "Report"]

_LESS = 1.0  # dB below the PSNR, that are worth a word


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
        elsewhere: PSNR from virtual views that had no part in the search, dB: `beside` those of `psnr`, and the same
            `nearer` and `farther`.
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
    elsewhere: dict[str, float] = field(default_factory=dict)
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

    def lines(self) -> tuple[str, ...]:
        """What a user should know of it, a sentence each."""
        goal = self.goal
        asked = [f"{name} within {bound:g}" for name, bound in goal.get("max_error", {}).items()]
        if "size_bytes" in goal:
            share = 100.0 * self.size_bytes / goal["size_bytes"]
            asked.append(f"{format_bytes(goal['size_bytes'])}, of which the file takes {share:.1f} %")
        if "psnr" in goal:
            asked.append(f"{goal['psnr']:g} dB, of which it reaches {self.psnr:.2f}")
        if "keep" in goal:
            asked.append(f"{100.0 * goal['keep']:g} % of {counted(self.splats_before, 'splat')}")
        if "max_loss" in goal:
            asked.append(f"a loss of {goal['max_loss']:g} dB by the photographs that decide")
        lines = [f"target: {'; '.join(asked)}"]
        if self.photographs:
            file, source = self.photographs["file"], self.photographs["source"]
            lines.append(f"photographs that judge: {file:.2f} dB, the source {source:.2f}")
        lines += [f"chosen: {line}" for line in self.why]
        if self.psnr is not None:
            lines.append(f"PSNR {self.psnr:.2f} dB, {self.sure}")
            lines += self._elsewhere(self.psnr)
        cost = f"{counted(self.encodes, 'file')} tried"
        if self.renders:
            cost += f", {counted(self.renders, 'picture')} judged"
        if self.sensitivity_views:
            cost += f", sensitivity measured in {self.sensitivity_views}"
        if self.removal_views:
            cost += f", removal measured in {self.removal_views} small ones"
        return (*lines, cost)

    def _elsewhere(self, psnr: float) -> list[str]:
        if not self.elsewhere:
            return []
        shown = ", ".join(f"{found:.2f} {kind}" for kind, found in self.elsewhere.items())
        less = psnr - min(self.elsewhere.values())
        worse = f": up to {less:.1f} dB less than where it was judged" if less > _LESS else ""
        return [f"from virtual views that nothing was chosen by, PSNR {shown}{worse}"]


@dataclass(frozen=True, eq=False, repr=False)
class Optimised:
    """A file that keeps to a target.

    Attributes:
        result: of the encoder; its source index is into the source.
        report: how it was found.
    """

    result: EncodeResult
    report: Report

    def __repr__(self) -> str:
        said, psnr = self.result.report, self.report.psnr
        quality = "" if psnr is None else f", {psnr:.2f} dB"
        return f"Optimised({said.size_bytes:,} bytes, {said.splat_count:,} splats{quality})"

    @property
    def data(self) -> bytes:
        """The file."""
        return self.result.data
