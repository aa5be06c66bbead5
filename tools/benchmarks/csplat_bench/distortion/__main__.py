"""Measure rate against distortion, compared with SPZ and SOG: bytes at equal PSNR, with and without simplification.

    python -m csplat_bench.distortion plain                       # peers, and files of whole scenes; half an hour
    python -m csplat_bench.distortion simplified                  # files of simplified scenes; an hour
    python -m csplat_bench.distortion simplified --offsets=-4,2   # below and above the PSNR of SPZ, too
    python -m csplat_bench.distortion simplified --offsets= --psnr 45   # wherever SPZ is
    python -m csplat_bench.distortion tables --markdown           # print what was measured, plot it

Peers are written in the same run, by splat-transform: SPZ, and SOG if that takes minutes at most (one iteration of
its k-means). PSNR is against the source from the cameras of the data folder (psnr_cameras/NAME.json). What was measured
is kept scene by scene in tools/benchmarks/results/distortion/NAME.json: an interrupted run continues where it stopped;
--again forgets.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated

import typer

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, Importance, ShCoding, encode_with_report
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.common.command import (
    AGAIN,
    CACHE,
    MARKDOWN,
    OUT,
    PEERS,
    SCENES,
    VIEWS,
    listed,
    numbers,
    preset_of,
    run,
)
from csplat_bench.common.curves import Point, bracket, rate_at
from csplat_bench.common.kept import Kept, read_kept
from csplat_bench.common.measuring import timed
from csplat_bench.common.peers import find_splat_transform, judged, transform
from csplat_bench.common.report import tell_machine
from csplat_bench.common.scenes import MADE, NPM, ROOT, Scene, find_scenes, given_cameras, judge_of
from csplat_bench.common.scenes import OUT as EVERYTHING
from csplat_bench.distortion.known import GRADED, KeptPoint, Measured, Simplified
from csplat_bench.distortion.plot import plot as draw
from csplat_bench.distortion.tables import tables
from csplat_render.scene_frame import scene_frame
from csplat_render.scorer import Scorer
from csplat_tools.console import note
from csplat_tools.optimise.scene_sensitivity import importance_views, measure_importance
from csplat_tools.optimise.target_encoding import encode_to
from csplat_tools.views import BLACK, find_view_set

_SCENES = "plane3,horse,donut,jacket,lego60k,fox60k_noreg,angel,st-peter,fox120k,statue"  # the quick ones first
_KEPT = ROOT / "tools" / "benchmarks" / "results" / "distortion"
_CHOICES = (("balanced", "scalar"), ("balanced", "codebook"), ("small", "codebook"), ("small", "scalar"))
_SH_CODINGS: dict[str, ShCoding] = {"scalar": "scalar", "codebook": "codebook"}
_QUALITIES = (20.0, 110.0)  # dB, between which the encoder's is looked for
_LOSS = (5.0, 12.0)  # dB between what each attribute keeps by itself and what all keep, without and with SH, about
_GRID_TRIES = 4  # files at most for one point of a curve
GRID = (-9.0, -6.0, -3.0, 3.0, 6.0)  # dB from the PSNR of SPZ at which the curve is drawn, too
_GRID_FAR = (-16.0, -12.5)  # likewise, without SH, if SPZ is far above what pictures need


class Part(StrEnum):
    """The stages that the command line can name."""

    plain = "plain"
    simplified = "simplified"
    tables = "tables"


def main(
    what: Annotated[Part, typer.Argument(help="what to measure, or tables of what is known")],
    *,
    scenes: SCENES = _SCENES,
    offsets: Annotated[str, typer.Option(help="dB beside the PSNR of SPZ")] = "0",
    psnr: Annotated[str, typer.Option(help="dB, wherever SPZ is")] = "",
    views: VIEWS = 160,
    again: AGAIN = False,
    markdown: MARKDOWN = False,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="draw the curves: tools/study/distortion.svg")
    ] = None,
    out: OUT = _KEPT,
    cache: CACHE = MADE,
    peers: PEERS = NPM,
) -> None:
    """Measure what the command line names; print tables of all that is known."""
    names = listed(scenes)
    if what != Part.tables:
        command, remark = find_splat_transform(peers)
        machine = tell_machine(peers=remark)
        if command is None:
            raise InputError(f"no splat-transform: {remark}")
        for scene in find_scenes(names, cache):
            kept = Kept(out / f"{scene.name}.json", again=again)
            source = read_ply(scene.path)
            bench = _Bench(scene, source, judge_of(scene.name, source), kept)
            kept.values |= {"machine": machine, "splats": len(source), "sh_degree": source.sh_degree}
            kept.values["cameras"] = "given" if given_cameras(scene.name) else "virtual"
            _peers(bench, command, EVERYTHING / "distortion")
            if what == Part.plain:
                _plain(bench)
            else:
                _simplified(bench, numbers(offsets, float), numbers(psnr, float), views)
    known = read_kept(out)
    chosen = {name: Measured(known[name]) for name in names if name in known}
    print(tables(chosen, markdown=markdown))
    if plot is not None:
        draw(chosen, plot)


@dataclass(frozen=True, eq=False)
class _Bench:
    """A scene, its stored results, and the judge of its files."""

    scene: Scene
    source: SplatModel
    judge: Scorer
    kept: Kept

    @cached_property
    def importance(self) -> Importance | None:
        """Importance by the cameras stored next to the scene, else by virtual views if it is an object, else None."""
        beside = self.scene.path.with_suffix(".cameras.json")
        given = str(beside) if beside.exists() else None
        if given is None and scene_frame(self.source).kind != "object":
            return None
        cameras = importance_views(self.source, find_view_set(self.source, cameras=given, background=BLACK))
        return measure_importance(self.source, cameras, BLACK, threads=None)

    @property
    def known(self) -> Measured:
        """The results measured so far."""
        return Measured(self.kept.values)  # type: ignore[arg-type]  # as this module keeps it

    @property
    def goals(self) -> dict[str, float]:
        """PSNR of each peer that came through, dB."""
        return {name: one.psnr for name, one in self.known.peers().items()}


def _peers(bench: _Bench, command: list[str], folder: Path) -> None:
    """Let splat-transform write and read back what it can; kept by the name of the format."""
    known: dict[str, KeptPoint] = bench.kept.values.setdefault("peers", {})
    if known:
        return
    folder.mkdir(parents=True, exist_ok=True)
    for peer in transform(command, bench.scene, folder):
        psnr = judged(command, peer, bench.judge)
        if isinstance(psnr, str) or peer.timing is None:
            known[peer.name] = {"remark": str(psnr)}
        else:
            known[peer.name] = {"psnr": psnr, "size_bytes": peer.size_bytes, "seconds": peer.timing.wall}
    bench.kept.write()
    note(f"{bench.scene.name} peers: {known}")


def _plain(bench: _Bench) -> None:
    """Files of the whole scene around the PSNR of each peer, by preset and coding of SH; then further away."""
    has_sh = bench.source.sh_degree > 0
    # Without SH, presets differ by nothing but the quality.
    choices = list(_CHOICES) if has_sh else [("balanced", "none")]
    drawn = choices[:2]
    if bench.importance is not None:
        graded = [(GRADED, coding) for coding in dict.fromkeys(coding for _, coding in choices)]
        choices, drawn = [*choices, *graded], [*drawn, *graded]
    goals = bench.goals
    for preset, coding in choices:
        for goal in goals.values():
            _extend(bench, preset, coding, goal)
    spz = goals.get("SPZ")
    if spz is None:
        return
    for offset in GRID if has_sh else (*_GRID_FAR, *GRID):
        for preset, coding in drawn:
            for _ in range(_GRID_TRIES):
                series = bench.known.plain().get(f"{preset}, {coding}", ())
                if any(abs(one.psnr - spz - offset) < 1.0 for one in series):
                    break
                _extend(bench, preset, coding, spz + offset, most=1)


def _extend(bench: _Bench, preset: str, coding: str, goal: float, most: int = 8) -> None:
    """Add the points of a series that enclose a PSNR."""
    name = f"{preset}, {coding}"
    series: list[KeptPoint] = bench.kept.values.setdefault("plain", {}).setdefault(name, [])

    def measure(quality: float) -> Point:
        quality = round(quality, 2)
        options = EncodeOptions(attribute_psnr=quality, sh_coding=_SH_CODINGS.get(coding, "auto"))
        graded = preset == GRADED
        options = replace(options, adaptive=1.0) if graded else replace(options, preset=preset_of(preset))
        importance = bench.importance if graded else None
        result, timing = timed(encode_with_report, bench.source, options, importance=importance)
        point = Point(bench.judge.psnr(decode(result.data)), len(result.data), quality, timing.wall)
        series.append(asdict(point))  # type: ignore[arg-type]  # the same fields
        bench.kept.write()
        size = point.size_bytes / len(bench.source)
        note(f"{bench.scene.name} {name} at {quality:g}: {size:.2f} B at {point.psnr:.2f} dB, {timing.wall:.1f} s")
        return point

    start = goal + _LOSS[bench.source.sh_degree > 0]
    plain = bench.known.plain()
    best = rate_at(plain, goal)
    ceiling = math.inf if best is None else best.size_bytes
    bracket(plain[name], goal, measure, start=start, limits=_QUALITIES, ceiling=ceiling, most=most)


def _simplified(bench: _Bench, offsets: Sequence[float], psnrs: Sequence[float], views: int) -> None:
    """Measure the smallest files, with pruning allowed, that reach given PSNRs and some near that of SPZ."""
    spz = bench.goals.get("SPZ")
    goals = {} if spz is None else {f"{offset:+g}": spz + offset for offset in offsets}
    for name, goal in {**goals, **{f"{psnr:g} dB": psnr for psnr in psnrs}}.items():
        bench.kept.measure("simplified", name, partial(_reached, bench, goal, views))


def _reached(bench: _Bench, goal: float, views: int) -> Simplified:
    """The file of a PSNR by the cameras that judge all files here; virtual views teach and decide."""
    around = replace(find_view_set(bench.source, count=views), test=bench.judge.cameras)
    try:
        found, timing = timed(encode_to, bench.source, psnr=goal, views=around)
    except InputError as error:
        return {"goal": goal, "remark": str(error), "seconds": 0.0}
    chosen = found.report.chosen
    return {
        "goal": goal,
        "psnr": chosen["psnr"],
        "size_bytes": chosen["size_bytes"],
        "splats": chosen["splats"],
        "sh_coding": chosen["sh_coding"],
        "encodes": found.report.encodes,
        "seconds": timing.wall,
    }


if __name__ == "__main__":
    sys.exit(run(main))
