"""Stored results of a scene, and figures of other formats on other scenes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict

from csplat_bench.common.curves import Point, Rate, Series, rate_at
from csplat_bench.common.report import Machine

#: Prefix of the names of series whose splats are in quantisation classes by measured importance.
GRADED = "graded"


@dataclass(frozen=True)
class Figure:
    """A format's figures on other scenes: bytes per splat, and PSNR if it was measured."""

    name: str
    bytes_per_splat: tuple[float, float]
    psnr: tuple[float, float] | None = None

    @property
    def short(self) -> str:
        """The name, abbreviated to fit into a plot."""
        return self.name.replace("splat-transform", "s.-t.")


#: By whether the scenes had SH; taken with the tools named, on scenes of 9 to 300 thousand splats.
FIGURES = {
    True: (
        Figure("SPZ v4", (15.7, 23.7), (36.0, 45.0)),
        Figure("SOG by gsbox", (12.6, 21.0), (34.0, 41.0)),
        Figure("SOG by splat-transform", (37.0, 50.0), (48.0, 56.0)),
        Figure(".spx", (11.4, 12.4)),
        Figure("compressed.ply", (61.0, 61.0)),
    ),
    False: (
        Figure("SPZ v4", (14.7, 14.7)),
        Figure("SOG by splat-transform", (12.0, 13.0), (46.0, 55.0)),
        Figure(".spx", (10.5, 11.0)),
        Figure("compressed.ply", (16.3, 16.3)),
    ),
}


class KeptPoint(TypedDict, total=False):
    """A point as JSON has it; or why there is none."""

    psnr: float
    size_bytes: int
    quality: float
    seconds: float
    remark: str


class Simplified(TypedDict, total=False):
    """A file of a simplified scene; or why there is none. `goal` is the PSNR that was looked for, dB."""

    goal: float
    seconds: float
    psnr: float
    size_bytes: int
    splats: int
    sh_coding: str
    encodes: int
    remark: str


class Values(TypedDict, total=False):
    """Stored results of a scene.

    Attributes:
        cameras: cameras that judge: "given" or "virtual".
        peers: files of other formats, by format.
        plain: files of the whole scene, by preset and coding of SH.
        simplified: files of simplified scenes, by dB relative to SPZ, or by dB.
    """

    machine: Machine
    splats: int
    sh_degree: int
    cameras: str
    peers: dict[str, KeptPoint]
    plain: dict[str, list[KeptPoint]]
    simplified: dict[str, Simplified]


@dataclass(frozen=True, eq=False)
class Measured:
    """The results measured for a scene."""

    values: Values

    @property
    def splats(self) -> int:
        """Splats of the source: what bytes are divided by everywhere."""
        return self.values["splats"]

    @property
    def has_sh(self) -> bool:
        """True if the scene has SH above degree 0."""
        return self.values["sh_degree"] > 0

    def plain(self) -> Series:
        """Files of the whole scene, by preset and coding of SH."""
        return {how: [point_of(one) for one in points] for how, points in self.values.get("plain", {}).items()}

    def unmeasured(self) -> Series:
        """Files of the whole scene that were encoded without measuring importance in renders."""
        return {how: points for how, points in self.plain().items() if not how.startswith(GRADED)}

    def simplified(self) -> Series:
        """Files of simplified scenes, by number of splats, coding of SH, and PSNR that was looked for."""
        return {
            f"{one['splats']} {one['sh_coding']} for {one['goal']:.1f}": [Point(one["psnr"], one["size_bytes"])]
            for one in self.values.get("simplified", {}).values()
            if "psnr" in one
        }

    def simplified_rate(self, psnr: float) -> Rate | None:
        """Return the rate at a PSNR if splats may be pruned; keeping the whole scene is one way of simplifying.

        `None` if no file was simplified to that PSNR.
        """
        simplified = self.simplified()
        if rate_at(simplified, psnr) is None:
            return None
        return rate_at({**simplified, **self.plain()}, psnr)

    def peers(self) -> dict[str, Point]:
        """Files of others that were judged."""
        known = self.values.get("peers", {})
        return {name: point_of(one) for name, one in known.items() if "psnr" in one}

    def per_splat(self, size_bytes: float) -> float:
        """Bytes per splat of the source."""
        return size_bytes / self.splats


def point_of(one: KeptPoint) -> Point:
    """A file as it was judged."""
    return Point(one["psnr"], one["size_bytes"], one.get("quality", 0.0), one.get("seconds", 0.0))
