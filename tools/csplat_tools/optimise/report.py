"""The report of a search on the file that it found."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from csplat.encoder import EncodeResult
from csplat.errors import counted
from csplat_tools.files.console import format_bytes

_LESS = 1.0  # dB: a PSNR from elsewhere that is lower by more is pointed out


@dataclass(frozen=True)
class Report:
    """The report of a search.

    Attributes:
        goal: the target, by name.
        size_bytes, splats: size of the file and its number of splats.
        splats_before: number of splats of the scene.
        encodes: number of files that were made.
        seconds: time of the whole search.
        reached: largest errors of the file by measure, for those that are bounded.
        psnr: PSNR of the file against the source, dB; `None` if nothing was rendered, as for all that follows.
        photographs: PSNR of `file` and `source` against the test photographs, if there are any.
        worst_psnr: PSNR of the worst view, dB.
        spread: standard deviation of the PSNR over other choices of such views, dB.
        elsewhere: PSNR from virtual views that had no part in the search, dB: `beside` those of `psnr`, and the same
            `nearer` and `farther`.
        views: number of test views.
        views_of: source of the views: `virtual`, or a name.
        renders: number of renders that were scored.
        removal_views, sensitivity_views: number of small renders to measure pruning errors, and sensitivities.
        chosen, tried: the chosen file and all files, see `Trial.as_json`.
        why, sure: explanations of the choice, and of the reliability of the PSNR.
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
        """Return everything as JSON-compatible values."""
        return asdict(self)

    def lines(self) -> tuple[str, ...]:
        """Return the report for users, a sentence each."""
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
    """A file that meets a target.

    Attributes:
        result: the encoder's result; its source index refers to the source.
        report: the report of the search.
    """

    result: EncodeResult
    report: Report

    def __repr__(self) -> str:
        said, psnr = self.result.report, self.report.psnr
        quality = "" if psnr is None else f", {psnr:.2f} dB"
        return f"Optimised({said.size_bytes:,} bytes, {said.splat_count:,} splats{quality})"

    @property
    def data(self) -> bytes:
        """The bytes of the file."""
        return self.result.data
