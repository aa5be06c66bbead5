"""Compare the cameras that `psnr` chooses with those that the data folder fixes, on the same pairs of scenes.

    python tools/benchmarks/virtual_cameras.py                         # ten minutes
    python tools/benchmarks/virtual_cameras.py --scenes donut,horse --presets balanced --seeds 0

Each scene is encoded with each preset and decoded. `given` is the PSNR of the decoded scene against its source from the
cameras of the data folder (psnr_cameras/NAME.json), `own` that from the virtual cameras of the source with the first
seed, which may differ by 1 dB; the last columns are the differences for the other seeds.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from machine import describe_machine
from quality import decoded_presets
from scenes import DATA, ROOT, Scene, find_scenes

from csplat.encoder import PRESETS
from csplat.ply import read_ply
from csplat_render.cameras import load_cameras
from csplat_render.judge import Judge
from csplat_render.virtual import scene_frame, virtual_cameras
from csplat_tools.files.console import format_table

_SCENES = "fox120k,fox60k_noreg,lego60k,plane3,object_id,statue,donut,jacket,horse,angel,st-peter"
_LIMIT = 1.0  # dB between given and own cameras


def main() -> None:
    """Measure the scenes that the command line names, and print a table."""
    args = _arguments()
    machine = describe_machine(("numpy", "numba", "deflate"))
    for key, value in machine.items():
        print(f"{key}: {value}", file=sys.stderr)
    seeds = [int(seed) for seed in args.seeds.split(",")]
    results = []
    for scene in find_scenes([name for name in args.scenes.split(",") if name], args.cache):
        if not _given(scene).exists():
            print(f"{scene.name}: the data folder has no cameras of it", file=sys.stderr)
            continue
        start = time.perf_counter()
        results += _measure(scene, args.presets.split(","), seeds)
        print(f"{scene.name}: {time.perf_counter() - start:.1f} s", file=sys.stderr, flush=True)
    header = ["scene", "kind", "preset", "given dB", "own dB", *(f"seed {seed}" for seed in seeds)]
    print(format_table(header, [_line(result) for result in results]))
    off = max((abs(result["differences"][0]) for result in results), default=0.0)
    print(f"largest difference with seed {seeds[0]}: {off:.2f} dB, allowed are {_LIMIT:g} dB")
    if args.json is not None:
        args.json.write_text(json.dumps({"machine": machine, "seeds": seeds, "results": results}, indent=2) + "\n")


def _given(scene: Scene) -> Path:
    return DATA / "psnr_cameras" / f"{scene.name}.json"


def _measure(scene: Scene, presets: Sequence[str], seeds: Sequence[int]) -> list[dict[str, Any]]:
    source = read_ply(scene.path)
    cameras = [load_cameras(_given(scene)), *(virtual_cameras(source, seed=seed) for seed in seeds)]
    judges = [Judge.of_source(source, some) for some in cameras]
    kind, results = scene_frame(source).kind, []
    for preset, other, _ in decoded_presets(source, presets):
        given, *own = (judge.psnr(other) for judge in judges)
        results.append(
            {
                "scene": scene.name,
                "kind": kind,
                "preset": preset,
                "given": given,
                "own": own[0],
                "differences": [psnr - given for psnr in own],
            }
        )
    return results


def _line(result: dict[str, Any]) -> list[str]:
    return [
        *(result[key] for key in ("scene", "kind", "preset")),
        f"{result['given']:.2f}",
        f"{result['own']:.2f}",
        *(f"{difference:+.2f}" for difference in result["differences"]),
    ]


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=_SCENES, help="names, with commas; default: %(default)s")
    parser.add_argument("--presets", default=",".join(PRESETS), help="default: %(default)s")
    parser.add_argument("--seeds", default="0,1,2,3,4", help="of the virtual cameras; default: %(default)s")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too")
    parser.add_argument("--cache", type=Path, default=ROOT / "out" / "scenes", help="where scenes are made")
    return parser.parse_args()


if __name__ == "__main__":
    main()
