"""Measure rate control: targets asked and reached, files tried, pictures rendered, seconds.

    python tools/benchmarks/rate.py                               # six scenes; an hour on two cores
    python tools/benchmarks/rate.py --scenes plane3,donut --keep-all
    python tools/benchmarks/rate.py --tables                      # print what was measured

Each scene is asked for two sizes and two PSNRs. The file is decoded and judged anew: `psnr` of `csplat compare`, by
the virtual cameras of the source, which are those that the search judged by; and by the eight cameras of the data
folder (psnr_cameras/NAME.json), which it did not see. What was measured is kept in out/rate/NAME.json.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from machine import describe_machine
from printing import laid_out
from scenes import DATA, ROOT, Scene, named_scenes

from csplat.decoder import decode
from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render.cameras import load_cameras
from csplat_render.judge import Judge
from csplat_tools.rate.control import encode_to_target
from csplat_tools.rate.targets import RateTarget
from csplat_tools.views import BLACK, comparison_cameras

_SCENES = "plane3,donut,horse,lego60k,fox60k_noreg,fox120k"
_SIZES = "4,8"
_PSNRS = "34,42"
_HEAD = (
    "scene",
    "splats",
    "asked",
    "size, kB",
    "of it",
    "dB",
    "other cameras",
    "± dB",
    "left",
    "files",
    "renders",
    "s",
)


def main() -> None:
    """Measure what the command line names, and print a table."""
    args = _arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    if not args.tables:
        for key, value in describe_machine(("numpy", "numba", "deflate")).items():
            print(f"{key}: {value}", file=sys.stderr)
        for scene in named_scenes(args.scenes.split(","), ROOT / "out" / "bench"):
            _measure(scene, args)
    print(_table([json.loads(path.read_text()) for path in sorted(args.out.glob("*.json"))], markdown=args.markdown))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=_SCENES, help="names, separated by commas; default: %(default)s")
    parser.add_argument("--sizes", default=_SIZES, help="bytes per splat of the source; default: %(default)s")
    parser.add_argument("--psnr", default=_PSNRS, help="dB; default: %(default)s")
    parser.add_argument("--preset", default="balanced", help="default: %(default)s")
    parser.add_argument("--keep-all", action="store_true", help="leave no splat out")
    parser.add_argument("--tables", action="store_true", help="measure nothing")
    parser.add_argument("--markdown", action="store_true", help="print the table as a guide has it")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "rate", help="default: %(default)s")
    return parser.parse_args()


def _measure(scene: Scene, args: argparse.Namespace) -> None:
    path = args.out / f"{scene.name}.json"
    kept: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {"name": scene.name, "targets": {}}
    source, judge = read_ply(scene.path), None
    kept["splats"] = len(source)
    wanted = {
        f"{size} B/splat": RateTarget(size_bytes=int(float(size) * len(source))) for size in args.sizes.split(",")
    }
    wanted |= {f"{psnr} dB": RateTarget(psnr=float(psnr)) for psnr in args.psnr.split(",")}
    for asked, target in wanted.items():
        key = asked + (", every splat" if args.keep_all else "")
        if key in kept["targets"]:
            continue
        judge = judge or _Judges(scene, source)
        start = time.perf_counter()
        options = EncodeOptions(preset=args.preset)
        try:
            found = encode_to_target(source, target, options, prune=False if args.keep_all else None)
        except InputError as error:
            kept["targets"][key] = {"error": str(error)}
        else:
            seconds = time.perf_counter() - start
            kept["targets"][key] = {**found.report, **judge.judged(found.result.data), "seconds": round(seconds, 1)}
        path.write_text(json.dumps(kept, indent=1) + "\n")
        print(f"{scene.name} {key}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)


class _Judges:
    """Judges files by the virtual cameras and by those of the data folder. Owns the source's pictures."""

    def __init__(self, scene: Scene, source: SplatModel) -> None:
        self._same = Judge.of_source(source, comparison_cameras(source), BLACK)
        path = DATA / "psnr_cameras" / f"{scene.name}.json"
        self._other = Judge.of_source(source, load_cameras(path), BLACK) if path.exists() else None

    def judged(self, data: bytes) -> dict[str, Any]:
        """PSNR of a file."""
        model = decode(data)
        other = None if self._other is None else self._other.psnr(model)
        return {"decoded_psnr": self._same.psnr(model), "other_psnr": other}


def _table(results: list[dict[str, Any]], *, markdown: bool) -> str:
    rows = [
        (one["name"], f"{one['splats']:,}", asked, *_cells(one["splats"], found))
        for one in results
        for asked, found in one["targets"].items()
    ]
    return laid_out(_HEAD, rows, markdown=markdown)


def _cells(splats: int, found: dict[str, Any]) -> tuple[str, ...]:
    if "error" in found:
        return (found["error"], *[""] * (len(_HEAD) - 4))
    goal = found["goal"].get("size_bytes")
    return (
        f"{found['size_bytes'] / 1e3:.1f}",
        "" if goal is None else f"{100.0 * found['size_bytes'] / goal:.1f} %",
        f"{found['decoded_psnr']:.2f}",
        "" if found["other_psnr"] is None else f"{found['other_psnr']:.2f}",
        "" if found["spread"] is None else f"{found['spread']:.1f}",
        f"{100.0 * found['splats'] / splats:.0f} %",
        str(found["encodes"]),
        f"{found['renders']} + {found['removal_views'] + found['sensitivity_views']}",
        f"{found['seconds']:.0f}",
    )


if __name__ == "__main__":
    main()
