"""Measure rate against distortion beside SPZ and SOG: bytes at equal PSNR, without and with simplification.

    python tools/benchmarks/distortion.py plain                       # peers, and files of whole scenes; half an hour
    python tools/benchmarks/distortion.py simplified                  # files of simplified scenes; two hours
    python tools/benchmarks/distortion.py simplified --offsets=-4,2   # below and above the PSNR of SPZ, too
    python tools/benchmarks/distortion.py tables --markdown           # print what was measured, plot it

Peers are written in the same run, by splat-transform: SPZ, and SOG where that takes minutes at most (one iteration of
its k-means). PSNR is against the source from the cameras of the data folder (psnr_cameras/NAME.json). What was measured
is kept scene by scene in out/distortion/NAME.json: an interrupted run goes on where it ended; --again forgets.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from distortion_curves import Point, bracket, rate_at
from distortion_plot import plot
from distortion_tables import GRADED, Measured, tables
from kept import Kept
from machine import describe_machine
from peers import Peer, find_splat_transform, run_timed, transform
from scenes import DATA, ROOT, Scene, find_scenes

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, Importance, encode_with_report
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render.cameras import load_cameras
from csplat_render.judge import Judge
from csplat_render.virtual import scene_frame, virtual_cameras
from csplat_tools.files.extras import need_renderer
from csplat_tools.optimise.optimiser import optimise
from csplat_tools.optimise.sensitivity import measured_importance, measuring_views
from csplat_tools.optimise.target import Target
from csplat_tools.views import BLACK, find_view_set

__all__ = ["main"]

_SCENES = "plane3,horse,donut,jacket,lego60k,fox60k_noreg,angel,st-peter,fox120k,statue"  # the quick ones first
_CHOICES = (("balanced", "scalar"), ("balanced", "codebook"), ("small", "codebook"), ("small", "scalar"))
_QUALITIES = (20.0, 110.0)  # dB, between which the encoder's is looked for
_LOSS = (5.0, 12.0)  # dB between what each attribute keeps by itself and what all keep, without and with SH, about
_GRID_TRIES = 4  # files at most for one point of a curve
_GRID = (-9.0, -6.0, -3.0, 3.0, 6.0)  # dB beside the PSNR of SPZ at which the curve is drawn, too
_GRID_FAR = (-16.0, -12.5)  # likewise, without SH, where SPZ is far above what pictures need


def main() -> None:
    """Measure what the command line names; print tables of all that is known."""
    args = _arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.what != "tables":
        try:
            need_renderer()
        except InputError as error:
            sys.exit(f"error: {error}")
        _measure_scenes(args)
    results = {path.stem: Measured(json.loads(path.read_text())) for path in sorted(args.out.glob("*.json"))}
    chosen = {name: results[name] for name in args.scenes.split(",") if name in results}
    print(tables(chosen, markdown=args.markdown))
    if args.plot is not None:
        args.plot.parent.mkdir(parents=True, exist_ok=True)
        plot(chosen, args.plot)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("plain", "simplified", "tables"))
    parser.add_argument("--scenes", default=_SCENES, help="names, separated by commas; default: %(default)s")
    parser.add_argument("--offsets", default="0", help="dB beside the PSNR of SPZ; default: %(default)s")
    parser.add_argument("--views", type=int, default=160, help="of simplification, at most; default: %(default)s")
    parser.add_argument("--again", action="store_true", help="forget what was measured of these scenes")
    parser.add_argument("--markdown", action="store_true", help="print tables as a guide has them")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the curves: tools/study/distortion.svg")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "distortion", help="default: %(default)s")
    parser.add_argument("--cache", type=Path, default=ROOT / "out" / "scenes", help="folder for made files")
    parser.add_argument("--peers", type=Path, default=ROOT / "out" / "peers", help="folder for npm packages")
    return parser.parse_args()


def _measure_scenes(args: argparse.Namespace) -> None:
    command, remark = find_splat_transform(args.peers)
    machine = {**describe_machine(("numpy", "numba", "deflate")), "peers": remark}
    for key, value in machine.items():
        print(f"{key}: {value}", file=sys.stderr)
    if command is None:
        sys.exit(f"error: no splat-transform: {remark}")
    for name in [name for name in args.scenes.split(",") if name]:
        scenes = find_scenes([name], args.cache)
        if not scenes:
            print(f"absent: {name}", file=sys.stderr)
            continue
        kept = Kept(args.out / f"{name}.json", again=args.again)
        bench = _Bench.of(scenes[0], kept)
        kept.values.update(machine=machine, splats=len(bench.source), sh_degree=bench.source.sh_degree)
        _peers(bench, command, args.out / "peers")
        if args.what == "plain":
            _plain(bench)
            continue
        _simplified(bench, [float(text) for text in args.offsets.split(",")], args.views)


@dataclass(frozen=True, eq=False)
class _Bench:
    """A scene, what is known of it, and who judges."""

    scene: Scene
    source: SplatModel
    judge: Judge
    kept: Kept

    @cached_property
    def importance(self) -> Importance | None:
        """What training cameras say, or virtual views of an object; None inside of surroundings without cameras."""
        beside = self.scene.path.with_suffix(".cameras.json")
        given = str(beside) if beside.exists() else None
        if given is None and scene_frame(self.source).kind != "object":
            return None
        start = time.perf_counter()
        cameras = measuring_views(self.source, find_view_set(self.source, cameras=given, background=BLACK))
        found = measured_importance(self.source, cameras, BLACK, threads=None)
        seconds = time.perf_counter() - start
        facts = {"cameras": len(cameras), "given": given is not None, "seconds": seconds}
        self.kept.values.setdefault("graded by", facts)
        return found

    @classmethod
    def of(cls, scene: Scene, kept: Kept) -> _Bench:
        source = read_ply(scene.path)
        path = DATA / "psnr_cameras" / f"{scene.name}.json"
        cameras = load_cameras(path) if path.exists() else virtual_cameras(source)
        kept.values["cameras"] = path.name if path.exists() else "virtual"
        return cls(scene, source, Judge.of_source(source, cameras, BLACK), kept)

    def goals(self) -> dict[str, float]:
        """PSNR of each peer that came through, dB."""
        return {name: one["psnr"] for name, one in self.kept.values["peers"].items() if "psnr" in one}

    def loss(self) -> float:
        """Decibels between the quality of each attribute and that of the whole, about."""
        return _LOSS[self.source.sh_degree > 0]


def _peers(bench: _Bench, command: list[str], folder: Path) -> None:
    """Let splat-transform write and read back what it can; kept by the name of the format."""
    known = bench.kept.values.setdefault("peers", {})
    if known:
        return
    folder.mkdir(exist_ok=True)
    found = {peer.name: _judged(bench, command, peer, folder) for peer in transform(command, bench.scene, folder, 1)}
    known.update(found)
    bench.kept.write()
    print(f"{bench.scene.name} peers: {json.dumps(found)}", file=sys.stderr, flush=True)


def _judged(bench: _Bench, command: list[str], peer: Peer, folder: Path) -> dict[str, Any]:
    if peer.size_bytes is None or peer.timing is None:
        return {"remark": peer.remark}
    file = folder / f"{bench.scene.name}.{peer.name.lower()}"
    back = file.with_name(file.name + ".ply")
    try:
        if run_timed([*command, "-q", "-w", str(file), str(back)], 1) is None:
            return {"remark": "reading it back took too long"}
    except subprocess.CalledProcessError:
        return {"remark": "reading it back failed"}
    psnr = bench.judge.psnr(read_ply(back))
    back.unlink()
    return {"psnr": psnr, "size_bytes": peer.size_bytes, "seconds": peer.timing.wall}


def _plain(bench: _Bench) -> None:
    """Files of the whole scene around the PSNR of each peer, by preset and coding of SH; then further away."""
    has_sh = bench.source.sh_degree > 0
    # Without SH, presets differ by nothing but the quality.
    choices = list(_CHOICES) if has_sh else [("balanced", "none")]
    drawn = choices[:2]
    if bench.importance is not None:
        graded = [(GRADED, coding) for coding in dict.fromkeys(coding for _, coding in choices)]
        choices, drawn = [*choices, *graded], [*drawn, *graded]
    goals = bench.goals()
    for preset, coding in choices:
        for goal in goals.values():
            _extend(bench, preset, coding, goal)
    spz = goals.get("SPZ")
    if spz is None:
        return
    for offset in _GRID if has_sh else (*_GRID_FAR, *_GRID):
        for preset, coding in drawn:
            for _ in range(_GRID_TRIES):
                series = Measured(bench.kept.values).plain().get(f"{preset}, {coding}", ())
                if any(abs(one.psnr - spz - offset) < 1.0 for one in series):
                    break
                _extend(bench, preset, coding, spz + offset, most=1)


def _extend(bench: _Bench, preset: str, coding: str, goal: float, most: int = 8) -> None:
    """Add the points of a series that enclose a PSNR."""
    series = bench.kept.values.setdefault("plain", {}).setdefault(f"{preset}, {coding}", [])

    def measure(quality: float) -> Point:
        quality = round(quality, 2)
        options = EncodeOptions(attribute_psnr=quality, sh_coding="auto" if coding == "none" else coding)
        graded = preset == GRADED
        options = replace(options, adaptive=1.0) if graded else replace(options, preset=preset)
        start = time.perf_counter()
        data = encode_with_report(bench.source, options, importance=bench.importance if graded else None).data
        seconds = time.perf_counter() - start
        point = Point(bench.judge.psnr(decode(data)), len(data), quality, seconds)
        series.append(point.as_json())
        bench.kept.write()
        size = len(data) / len(bench.source)
        said = f"{bench.scene.name} {preset}, {coding} at {quality:g}: {size:.2f} B at {point.psnr:.2f} dB"
        print(f"{said}, {seconds:.1f} s", file=sys.stderr, flush=True)
        return point

    start = goal + bench.loss()
    known = [Point(**one) for one in series]
    best = rate_at(Measured(bench.kept.values).plain(), goal)
    ceiling = math.inf if best is None else best.size_bytes
    bracket(known, goal, measure, start=start, limits=_QUALITIES, ceiling=ceiling, most=most)


def _simplified(bench: _Bench, offsets: Sequence[float], views: int) -> None:
    """The smallest files that reach PSNRs beside that of SPZ, where splats may go."""
    spz = bench.goals().get("SPZ")
    if spz is None:
        return
    for offset in offsets:
        goal = spz + offset
        bench.kept.measure("simplified", f"{offset:+g}", lambda goal=goal: _reached(bench, goal, views))


def _reached(bench: _Bench, goal: float, views: int) -> dict[str, Any]:
    """The file of a PSNR by the cameras that judge all files here; virtual views teach and decide."""
    around = replace(find_view_set(bench.source, count=views), judges=bench.judge.cameras)
    start = time.perf_counter()
    try:
        report = optimise(bench.source, Target(psnr=goal), around).report
    except InputError as error:
        return {"goal": goal, "remark": str(error), "seconds": time.perf_counter() - start}
    file = {name: report.chosen[name] for name in ("psnr", "size_bytes", "splats", "sh_coding")}
    return {"goal": goal, **file, "encodes": report.encodes, "seconds": report.seconds}


if __name__ == "__main__":
    main()
