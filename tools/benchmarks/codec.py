"""Measure the codec: throughput, memory and size, beside what other programs make of the same files.

    python tools/benchmarks/codec.py                     # everything that is there; an hour or more
    python tools/benchmarks/codec.py --quick             # the sample alone, one run
    python tools/benchmarks/codec.py --scenes lego60k,fox-1M --json out/bench.json

Times are medians. MB = 10^6 bytes. Encode and decode are timed from arrays to bytes and back, in a process of their
own; "PLY -> file" is a whole process. Peak is how much the process grew at most during its first call, as a multiple
of the scene's arrays.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from machine import describe_machine
from peers import CAP_SECONDS, compress_general, find_splat_transform, run_timed, transform
from scenes import ROOT, Scene, find_scenes

from csplat.decoder import read_header
from csplat_tools.files.console import format_table
from csplat_tools.inspect.info import byte_shares

_CHILD = Path(__file__).with_name("child.py")
_PRESETS = ("fast", "balanced", "small")
_LARGE = 2_000_000  # splats: one run, fewer programs
_ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh0", "sh1", "sh2", "sh3")


def main() -> None:
    """Measure the scenes that the command line names, and print tables."""
    args = _arguments()
    names = [name for name in args.scenes.split(",") if name]
    if args.quick and not names:
        names = ["sample"]
    runs = 1 if args.quick else args.runs
    scenes = find_scenes(names, args.cache)
    missing = set(names) - {scene.name for scene in scenes}
    if missing:
        sys.exit(f"error: no scene {', '.join(sorted(missing))}")
    args.cache.mkdir(parents=True, exist_ok=True)
    machine = describe_machine()
    print("\n".join(f"{key}: {value}" for key, value in machine.items()))
    command, remark = (None, "left out") if args.no_peers else find_splat_transform(args.peers)
    print(f"SPZ and SOG: {remark}" + ("" if command else "  <-- NOT MEASURED"))
    results = []
    for scene in scenes:
        result = _measure(scene, args.presets.split(","), command, 1 if scene.splat_count > _LARGE else runs, args)
        results.append(result)
        print(_format(result), flush=True)
    if args.json is not None:
        document = {"machine": machine, "peer": remark, "cap_seconds": CAP_SECONDS, "scenes": results}
        args.json.write_text(json.dumps(document, indent=2) + "\n")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the sample alone, one run")
    parser.add_argument("--scenes", default="", help="names, separated by commas; default: all that are there")
    parser.add_argument("--presets", default=",".join(_PRESETS), help="default: %(default)s")
    parser.add_argument("--runs", type=int, default=3, help="runs of each measurement, default %(default)s")
    parser.add_argument("--threads", type=int, help="threads of the encoder, default: one per core")
    parser.add_argument("--no-peers", action="store_true", help="leave other programs out")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers, for programs")
    parser.add_argument("--cache", type=Path, default=ROOT / "out" / "bench", help="folder for made scenes and files")
    parser.add_argument("--peers", type=Path, default=ROOT / "out" / "peers", help="folder for npm packages")
    return parser.parse_args()


def _measure(
    scene: Scene, presets: list[str], command: list[str] | None, runs: int, args: argparse.Namespace
) -> dict[str, Any]:
    rows = {preset: _measure_preset(scene, preset, runs, args) for preset in presets}
    large = scene.splat_count > _LARGE
    peers = [] if args.no_peers else compress_general(scene, gzip=not large)
    if command is not None:
        peers += transform(command, scene, args.cache, runs)
    return {
        "name": scene.name,
        "splats": scene.splat_count,
        "sh_degree": scene.sh_degree,
        "ply_bytes": scene.size_bytes,
        "runs": runs,
        "presets": rows,
        "peers": [
            {
                "name": peer.name,
                "size_bytes": peer.size_bytes,
                "wall_seconds": peer.timing and peer.timing.wall,
                "cpu_seconds": peer.timing and peer.timing.cpu,
                "remark": peer.remark,
            }
            for peer in peers
        ],
    }


def _measure_preset(scene: Scene, preset: str, runs: int, args: argparse.Namespace) -> dict[str, Any]:
    output = args.cache / f"{scene.name}.{preset}.csplat"
    threads = [] if args.threads is None else ["--threads", str(args.threads)]
    # A preset that clusters takes its time, and the same time each run.
    encode_runs = runs if preset == "fast" or scene.splat_count < _LARGE // 4 else 1
    encode = _child("encode", scene.path, "--preset", preset, "--output", output, "--runs", encode_runs, *threads)
    decode = _child("decode", output, "--runs", max(runs, 3))
    program = [sys.executable, "-m", "csplat_tools", "encode", str(scene.path), str(output)]
    whole = run_timed([*program, "--preset", preset, "--force", "--quiet", *threads], encode_runs)
    data = output.read_bytes()
    shares = byte_shares(data, read_header(data))
    return {
        "encode": encode,
        "decode": decode,
        "whole_wall_seconds": whole and whole.wall,
        "whole_cpu_seconds": whole and whole.cpu,
        "size_bytes": len(data),
        "attribute_bytes": {name: size for name, size in shares.items() if name != "overhead"},
    }


def _child(*words: object) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, str(_CHILD), *map(str, words)], check=True, stdout=subprocess.PIPE, text=True
    )
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def _format(result: dict[str, Any]) -> str:
    count, ply = result["splats"], result["ply_bytes"]
    title = f"{result['name']}: {count} splats, SH {result['sh_degree']}, PLY {ply / 1e6:.1f} MB, {result['runs']} runs"
    return "\n\n".join(
        [
            f"\n=== {title}",
            _codec_table(result, count),
            _attribute_table(result, count),
            _size_table(result, count, ply),
        ]
    )


def _codec_table(result: dict[str, Any], count: int) -> str:
    header = ["from arrays", "enc s", "Msplats/s", "MB/s", "peak/arrays", "dec s", "Msplats/s", "MB/s", "peak/arrays"]
    rows = []
    for preset, one in result["presets"].items():
        row = [preset]
        for way in ("encode", "decode"):
            seconds, arrays = one[way]["seconds"], one[way]["array_bytes"]
            row += [f"{seconds:.3f}", f"{count / seconds / 1e6:.2f}", f"{arrays / seconds / 1e6:.0f}"]
            row += [f"{one[way]['growth_bytes'] / arrays:.2f}"]
        rows.append(row)
    return format_table(header, rows)


def _attribute_table(result: dict[str, Any], count: int) -> str:
    used = [name for name in _ATTRIBUTES if any(name in one["attribute_bytes"] for one in result["presets"].values())]
    rows = []
    for preset, one in result["presets"].items():
        sizes = [one["attribute_bytes"].get(name, 0) for name in used]
        other = one["size_bytes"] - sum(sizes)
        rows.append([preset, *(f"{size / count:.3f}" for size in (*sizes, other, one["size_bytes"]))])
    return format_table(["bytes per splat", *used, "other", "file"], rows)


def _size_table(result: dict[str, Any], count: int, ply: int) -> str:
    header = ["PLY -> file", "bytes", "B/splat", "times smaller", "wall s", "CPU s", ""]
    entries = [
        (f"csplat {preset}", one["size_bytes"], one["whole_wall_seconds"], one["whole_cpu_seconds"], "")
        for preset, one in result["presets"].items()
    ]
    entries += [
        (peer["name"], peer["size_bytes"], peer["wall_seconds"], peer["cpu_seconds"], peer["remark"])
        for peer in result["peers"]
    ]
    rows = []
    for name, size, wall, cpu, remark in entries:
        sizes = ["-"] * 3 if size is None else [size, f"{size / count:.2f}", f"{ply / size:.1f}"]
        times = ["-" if seconds is None else f"{seconds:.2f}" for seconds in (wall, cpu)]
        rows.append([name, *sizes, *times, remark])
    return format_table(header, rows)


if __name__ == "__main__":
    main()
