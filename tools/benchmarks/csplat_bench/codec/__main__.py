"""Measure the codec: throughput, memory and size, beside what other programs make of the same files.

    python -m csplat_bench.codec                     # everything that is there; an hour or more
    python -m csplat_bench.codec --quick             # the sample alone, one run
    python -m csplat_bench.codec --scenes lego60k,fox-1M --json out/bench.json

Times are medians. MB = 10^6 bytes. Encode and decode are timed from arrays to bytes and back, in a process of their
own; "PLY -> file" is a whole process. Peak is how much the process grew at most during its first call, as a multiple
of the scene's arrays.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer

from csplat_bench.codec.process import Run, decoded, encoded
from csplat_bench.common.command import CACHE, JSON, PEERS, PRESETS, SCENES, THREADS, listed, run
from csplat_bench.common.measuring import Timing, alone, run_timed
from csplat_bench.common.peers import CAP_SECONDS, Peer, find_splat_transform, transform
from csplat_bench.common.report import optional, table, tell_machine, write_json
from csplat_bench.common.scenes import MADE, NPM, Scene, find_scenes

_SCENES = "sample,lego60k,fox120k,fox60k_noreg,plane3,donut,horse,jacket,fox-1M,donut-1M,fox-4M,donut-4M"
_LARGE = 2_000_000  # splats: one run, fewer programs


@dataclass(frozen=True)
class Measured:
    """A preset, or another program.

    Attributes:
        size_bytes: of the file; 0 where there is none.
        whole: seconds of a whole process; `None` where it did not come through.
        encode, decode: of presets.
        remark: why there is no file.
    """

    size_bytes: int
    whole: Timing | None
    encode: Run | None = None
    decode: Run | None = None
    remark: str = ""


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
    results = {}
    for scene in find_scenes(["sample"] if quick else listed(scenes), cache):
        large = scene.splat_count > _LARGE
        times = 1 if quick or large else runs
        ours = {preset: _measured(scene, preset, times, threads, cache) for preset in listed(presets)}
        others = [] if command is None else transform(command, scene, cache, times)
        results[scene.name] = {**ours, **{peer.name: _measured_peer(peer) for peer in others}}
        print(_tables(scene, times, ours, results[scene.name]), flush=True)
    if json is not None:
        figures = {scene: {name: asdict(one) for name, one in measured.items()} for scene, measured in results.items()}
        write_json(json, {"machine": machine, "cap_seconds": CAP_SECONDS, "scenes": figures})


def _measured(scene: Scene, preset: str, runs: int, threads: int | None, cache: Path) -> Measured:
    output = cache / f"{scene.name}.{preset}.csplat"
    # A preset that clusters takes its time, and the same time each run.
    encode_runs = runs if preset == "fast" or scene.splat_count < _LARGE // 4 else 1
    encode = alone(encoded, scene.path, output, preset, threads, encode_runs)
    decode = alone(decoded, output, max(runs, 3))
    command = [sys.executable, "-m", "csplat_tools", "encode", str(scene.path), str(output)]
    command += ["--preset", preset, "--force", "--quiet", *(["--threads", str(threads)] if threads else [])]
    whole = run_timed(command, encode_runs, CAP_SECONDS)
    return Measured(output.stat().st_size, whole, encode, decode)


def _measured_peer(peer: Peer) -> Measured:
    return Measured(peer.size_bytes, peer.timing, remark=peer.remark)


def _tables(scene: Scene, runs: int, ours: dict[str, Measured], every: dict[str, Measured]) -> str:
    count, ply = scene.splat_count, scene.size_bytes
    title = f"{scene.name}: {count} splats, SH {scene.sh_degree}, PLY {ply / 1e6:.1f} MB, {runs} runs"
    way = ("s", "Msplats/s", "MB/s", "peak/arrays")
    sizes = [(*_size_cells(name, one, count, ply), one.remark) for name, one in every.items()]
    return "\n\n".join(
        (
            f"\n=== {title}",
            table(
                ("from arrays", "enc s", *way[1:], "dec s", *way[1:]), [_way_cells(*one, count) for one in ours.items()]
            ),
            table(("PLY -> file", "bytes", "B/splat", "times smaller", "wall s", "CPU s", ""), sizes),
        )
    )


def _way_cells(name: str, one: Measured, count: int) -> list[str]:
    cells = [name]
    for way in (one.encode, one.decode):
        assert way is not None
        cells += [
            f"{way.seconds:.3f}",
            f"{count / way.seconds / 1e6:.2f}",
            f"{way.array_bytes / way.seconds / 1e6:.0f}",
        ]
        cells.append(f"{way.growth_bytes / way.array_bytes:.2f}")
    return cells


def _size_cells(name: str, one: Measured, count: int, ply: int) -> list[str]:
    label = name if one.encode is None else f"csplat {name}"
    size = one.size_bytes
    sizes = [str(size), f"{size / count:.2f}", f"{ply / size:.1f}"] if size else ["-"] * 3
    wall, cpu = (None, None) if one.whole is None else (one.whole.wall, one.whole.cpu)
    return [label, *sizes, optional(wall, ".2f"), optional(cpu, ".2f")]


if __name__ == "__main__":
    sys.exit(run(main))
