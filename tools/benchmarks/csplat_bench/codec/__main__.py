"""Measure encoding: throughput, memory and size, compared with other programs on the same files.

    python -m csplat_bench.codec                     # everything that is there; an hour or more
    python -m csplat_bench.codec --quick             # the sample alone, one run
    python -m csplat_bench.codec --scenes lego60k,fox-1M --json out/bench.json

Times are medians. MB = 10^6 bytes. Encoding is timed from arrays to bytes, in a process of its own; "PLY -> file" is a
whole process. Peak is how much the process grew at most during its first call, as a multiple of the scene's arrays.
How fast files are decoded: csplat_bench.codec.decoders.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer

from csplat_bench.codec.process import Run, encoded
from csplat_bench.common.command import CACHE, JSON, PEERS, PRESETS, SCENES, THREADS, listed, run
from csplat_bench.common.measuring import Timing, alone, run_timed
from csplat_bench.common.peers import CAP_SECONDS, Peer, find_splat_transform, transform
from csplat_bench.common.report import Table, laid_out, optional, tell_machine, write_json
from csplat_bench.common.scenes import MADE, NPM, Scene, find_scenes

_SCENES = "sample,lego60k,fox120k,fox60k_noreg,plane3,donut,horse,jacket,fox-1M,donut-1M,fox-4M,donut-4M"
_LARGE = 2_000_000  # splats: one run, fewer programs


@dataclass(frozen=True)
class Measured:
    """A preset: its file, from arrays, and in a whole process; that is `None` if it reached the cap."""

    size_bytes: int
    encode: Run
    whole: Timing | None


def main(
    *,
    quick: Annotated[bool, typer.Option("--quick", help="the sample alone, one run")] = False,
    scenes: SCENES = _SCENES,
    presets: PRESETS = "fast,balanced,small",
    runs: Annotated[int, typer.Option(help="of each measurement")] = 3,
    threads: THREADS = None,
    no_peers: Annotated[bool, typer.Option("--no-peers", help="leave other programs out")] = False,
    json: JSON = None,
    cache: CACHE = MADE,
    peers: PEERS = NPM,
) -> None:
    """Measure the scenes that the command line names, and print tables."""
    command, remark = (None, "left out") if no_peers else find_splat_transform(peers)
    machine = tell_machine(peers=remark)
    figures = {}
    for scene in find_scenes(["sample"] if quick else listed(scenes), cache):
        times = 1 if quick or scene.splat_count > _LARGE else runs
        ours = {preset: _measured(scene, preset, times, threads, cache) for preset in listed(presets)}
        others = [] if command is None else transform(command, scene, cache, times)
        print(_tables(scene, times, ours, others), flush=True)
        figures[scene.name] = {
            "presets": {preset: asdict(one) for preset, one in ours.items()},
            "peers": {one.name: {"size_bytes": one.size_bytes, "remark": one.remark} for one in others},
        }
    if json is not None:
        write_json(json, {"machine": machine, "cap_seconds": CAP_SECONDS, "scenes": figures})


def _measured(scene: Scene, preset: str, runs: int, threads: int | None, cache: Path) -> Measured:
    output = cache / f"{scene.name}.{preset}.csplat"
    # A preset that clusters takes its time, and the same time each run.
    encode_runs = runs if preset == "fast" or scene.splat_count < _LARGE // 4 else 1
    encode = alone(encoded, scene.path, output, preset, threads, encode_runs)
    command = [sys.executable, "-m", "csplat_tools", "encode", str(scene.path), str(output)]
    command += ["--preset", preset, "--force", "--quiet", *(["--threads", str(threads)] if threads else [])]
    whole = run_timed(command, encode_runs, CAP_SECONDS)
    return Measured(output.stat().st_size, encode, whole)


def _tables(scene: Scene, runs: int, ours: Mapping[str, Measured], others: Sequence[Peer]) -> str:
    count, ply = scene.splat_count, scene.size_bytes
    sizes = [(*_size_cells(f"csplat {name}", one.size_bytes, one.whole, scene), "") for name, one in ours.items()]
    sizes += [(*_size_cells(one.name, one.size_bytes, one.timing, scene), one.remark) for one in others]
    ways = [(name, *_way_cells(one.encode, count)) for name, one in ours.items()]
    return laid_out(
        [
            f"\n=== {scene.name}: {count} splats, SH {scene.sh_degree}, PLY {ply / 1e6:.1f} MB, {runs} runs",
            Table(("from arrays", "s", "Msplats/s", "MB/s", "peak/arrays"), ways),
            Table(("PLY -> file", "bytes", "B/splat", "times smaller", "wall s", "CPU s", ""), sizes),
        ],
        markdown=False,
    )


def _way_cells(way: Run, count: int) -> tuple[str, ...]:
    splats, size = count / way.seconds / 1e6, way.array_bytes / way.seconds / 1e6
    return f"{way.seconds:.3f}", f"{splats:.2f}", f"{size:.0f}", f"{way.growth_bytes / way.array_bytes:.2f}"


def _size_cells(label: str, size: int, timing: Timing | None, scene: Scene) -> tuple[str, ...]:
    sizes = (str(size), f"{size / scene.splat_count:.2f}", f"{scene.size_bytes / size:.1f}") if size else ("-",) * 3
    wall, cpu = (None, None) if timing is None else (timing.wall, timing.cpu)
    return label, *sizes, optional(wall, ".2f"), optional(cpu, ".2f")


if __name__ == "__main__":
    sys.exit(run(main))
