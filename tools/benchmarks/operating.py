"""Measure operating points: what a thumbnail, a web page and an archive of a scene take, and how long they download.

    python tools/benchmarks/operating.py                        # seven scenes; half an hour on two cores
    python tools/benchmarks/operating.py --scenes plane3 --rate 5
    python tools/benchmarks/operating.py --tables --markdown    # print what was measured

The first picture is there when header, index and layer 0 of all tiles are: everything but SH bands. What was measured
is kept in out/operating/NAME.json.
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
from scenes import ROOT, Scene, named_scenes

from csplat.decoder import decode, read_header
from csplat.encoder import encode_with_report
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render.judge import Judge
from csplat_tools.files.scenes import without_bands
from csplat_tools.optimise.optimiser import optimise
from csplat_tools.optimise.target import Target
from csplat_tools.tradeoff.measuring import fetched_bytes
from csplat_tools.views import BLACK, comparison_cameras, find_view_set

_SCENES = "plane3,donut,horse,lego60k,fox60k_noreg,fox120k,statue"
#: Name, options of `csplat encode`; the target, and whether all splats stay.
_POINTS = (
    ("thumbnail", "--target-psnr 30", Target(psnr=30.0), False),
    ("web page", "--target-psnr 38", Target(psnr=38.0), False),
    ("balanced", "--preset balanced", None, True),
    ("archive", "--target-psnr 50 --keep-all", Target(psnr=50.0), True),
)
_HEAD = ("scene", "for", "kB", "× smaller", "dB", "whole, s", "first picture, kB", "dB", "s", "encoding, s")


def main() -> None:
    """Measure what the command line names, and print a table."""
    args = _arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    if not args.tables:
        for key, value in describe_machine(("numpy", "numba", "deflate")).items():
            print(f"{key}: {value}", file=sys.stderr)
        for scene in named_scenes(args.scenes.split(","), ROOT / "out" / "bench"):
            _measure(scene, args.out)
    results = [json.loads(path.read_text()) for path in sorted(args.out.glob("*.json"))]
    for name, options, _, _ in _POINTS:
        print(f"{name}: csplat encode {options}")
    print(_table(results, args.rate, markdown=args.markdown))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=_SCENES, help="names, separated by commas; default: %(default)s")
    parser.add_argument("--rate", type=float, default=10.0, help="of the download, Mbit/s; default: %(default)s")
    parser.add_argument("--tables", action="store_true", help="measure nothing")
    parser.add_argument("--markdown", action="store_true", help="print the table as a guide has it")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "operating", help="default: %(default)s")
    return parser.parse_args()


def _measure(scene: Scene, out: Path) -> None:
    path = out / f"{scene.name}.json"
    kept: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {"name": scene.name, "points": {}}
    source, judge = read_ply(scene.path), None
    kept["ply_bytes"] = scene.size_bytes
    for name, _, target, whole in _POINTS:
        if name in kept["points"]:
            continue
        judge = judge or Judge.of_source(source, comparison_cameras(source), BLACK)
        start = time.perf_counter()
        try:
            data = _encoded(source, target, whole=whole)
        except InputError as error:
            kept["points"][name] = {"error": str(error)}
        else:
            seconds = time.perf_counter() - start
            kept["points"][name] = {**_judged(data, judge), "seconds": round(seconds, 1)}
        path.write_text(json.dumps(kept, indent=1) + "\n")
        print(f"{scene.name} {name}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)


def _encoded(source: SplatModel, target: Target | None, *, whole: bool) -> bytes:
    if target is None:
        return encode_with_report(source).data
    return optimise(source, target, find_view_set(source), keep_all=whole).result.data


def _judged(data: bytes, judge: Judge) -> dict[str, Any]:
    """Bytes and PSNR of the whole file, and of its first picture."""
    header, model = read_header(data), decode(data)
    return {
        "size_bytes": len(data),
        "psnr": judge.psnr(model),
        "first_bytes": fetched_bytes(header, 0),
        "first_psnr": judge.psnr(without_bands(model, 0)),
    }


def _table(results: list[dict[str, Any]], rate: float, *, markdown: bool) -> str:
    rows = [
        (one["name"], name, *_cells(one["ply_bytes"], point, rate))
        for one in results
        for name, point in one["points"].items()
    ]
    return laid_out(_HEAD, rows, markdown=markdown)


def _cells(ply_bytes: int, point: dict[str, Any], rate: float) -> tuple[str, ...]:
    if "error" in point:
        return (point["error"], *[""] * (len(_HEAD) - 3))
    size, first, per_second = point["size_bytes"], point["first_bytes"], rate * 1e6 / 8.0
    return (
        f"{size / 1e3:.0f}",
        f"{ply_bytes / size:.0f}",
        f"{point['psnr']:.1f}",
        f"{size / per_second:.2f}",
        f"{first / 1e3:.0f}",
        f"{point['first_psnr']:.1f}",
        f"{first / per_second:.2f}",
        f"{point['seconds']:.0f}",
    )


if __name__ == "__main__":
    main()
