"""Files of simplified scenes around a PSNR: how many splats, how precisely, by which coding of SH."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from distortion_curves import Point, Series, bracket, rate_at

from csplat.encoder import EncodeOptions
from csplat.model import SplatModel
from csplat_render.judge import Judge
from csplat_tools.simplify import SimplifyOptions
from csplat_tools.simplify.candidate import Candidate
from csplat_tools.simplify.core import Session, most_gone, prepare

__all__ = ["Shrinker"]

_MARGIN = 1.0  # dB above the goal to which splats are removed at first, before what stays is fitted
_CAREFUL = 3.0  # dB to which they are removed where that was too many
_NUMBERS = 3  # of splats, at most
_ROOM = (2.0, 4.0)  # dB that a fit is to leave for quantisation, without and with SH
_QUALITIES = (20.0, 110.0)
_MOST = 5  # files by coding and number of splats


@dataclass(frozen=True, eq=False)
class Shrinker:
    """Simplifies one scene for several PSNRs. The order in which splats go is found once.

    Attributes:
        name: of the scene.
        source: the scene.
        judge: takes PSNRs; its views decide nothing but the number of splats and the quality.
        options: of simplification.
    """

    name: str
    source: SplatModel
    judge: Judge
    options: SimplifyOptions

    @cached_property
    def _session(self) -> Session:
        return prepare(self.source, None, None, self.options)

    def around(self, goal: float, loss: float, plain: Series) -> dict[str, Any]:
        """Encode at a few numbers of splats, from just below to just above a PSNR.

        Args:
            goal: PSNR, dB.
            loss: decibels between the quality of each attribute and that of the whole, about.
            plain: files of the whole scene: what is larger than they are is not pursued.

        Returns:
            JSON-compatible: `goal`, `points` by number of splats and coding, `seconds`, those of `prepare` among them.
        """
        start = time.perf_counter()
        session, has_sh = self._session, self.source.sh_degree > 0
        found: dict[str, list[Point]] = {}
        codings = ["scalar", "codebook"] if has_sh else ["none"]
        margin, rates, quality = _MARGIN, list[float](), goal + loss
        for _ in range(_NUMBERS):
            gone = most_gone(session, self.judge, goal + margin)
            left = len(self.source) - gone
            if not gone or any(how.startswith(f"{left} ") for how in found):
                break
            candidate = Candidate(session, gone, self.judge, None, goal)
            mine: dict[str, list[Point]] = {}
            for coding in codings:
                best = rate_at({**plain, **found, **mine}, goal)
                mine[f"{left} {coding}"] = series = []
                self._enclose(candidate, coding, goal, quality, best.size_bytes if best else math.inf, series)
            found |= mine
            near = min((one for points in found.values() for one in points), key=lambda one: abs(one.psnr - goal))
            quality = near.quality + goal - near.psnr
            rate = rate_at(mine, goal)
            rates.append(rate.size_bytes if rate else math.inf)
            if len(rates) == 1:
                codings = codings if rate is None else [rate.how.split()[1]]
                # What a fit left goes into fewer splats; where it left too little, more stay.
                spare = self.judge.psnr(candidate.fitted) - goal - _ROOM[has_sh]
                margin = _MARGIN - spare if spare > 0.0 else _CAREFUL
            elif margin == _CAREFUL or rates[1] <= rates[0]:
                break
            else:
                margin = _CAREFUL  # the other way, then
        points = {how: [one.as_json() for one in series] for how, series in found.items()}
        return {"goal": goal, "points": points, "seconds": time.perf_counter() - start}

    def _enclose(
        self, candidate: Candidate, coding: str, goal: float, start_at: float, ceiling: float,
        series: list[Point],
    ) -> None:  # fmt: skip
        """Encode one number of splats by one coding, from just below to just above a PSNR; into `series`."""

        def measure(quality: float) -> Point:
            start = time.perf_counter()
            encoding = EncodeOptions(sh_coding="auto" if coding == "none" else coding)
            file = candidate.encoded(encoding, round(quality, 2))
            size, psnr = len(file.result.data), float(file.report["psnr"])
            point = Point(psnr, size, round(quality, 2), time.perf_counter() - start)
            said = f"{self.name} at {goal:.1f}: {file.report['splats']} splats, {coding}, quality {quality:.2f}"
            rate = f"{size / len(self.source):.2f} B at {psnr:.2f} dB"
            print(f"{said}: {rate}, {point.seconds:.1f} s", file=sys.stderr, flush=True)
            series.append(point)
            return point

        bracket([], goal, measure, start=start_at, limits=_QUALITIES, ceiling=ceiling, most=_MOST)
