"""Measure what the presets keep: bytes per splat, and `psnr` of the decoded scene against its source.

    python tools/benchmarks/quality.py                        # the shared scenes; ten minutes
    python tools/benchmarks/quality.py --scenes plane3 --no-peers
    python tools/benchmarks/quality.py --extra other.ply --markdown

`psnr` is that of `csplat compare`: eight 640 by 480 views, black background, pooled. The cameras are those of the data
folder (psnr_cameras/NAME.json), else the virtual ones of the source.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from machine import describe_machine
from peers import find_splat_transform, spz_and_back
from printing import laid_out
from scenes import DATA, ROOT, Scene, describe_ply, named_scenes

from csplat.decoder import decode
from csplat.encoder import PRESETS, EncodeOptions, encode_with_report
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render.cameras import load_cameras
from csplat_render.judge import Judge
from csplat_tools.files.extras import need_renderer
from csplat_tools.views import comparison_cameras

__all__ = ["decoded_presets"]

_SCENES = "fox120k,fox60k_noreg,lego60k,plane3,statue,donut,jacket,horse,angel,st-peter"


def main() -> None:
    """Measure the scenes that the command line names, and print a table."""
    args = _arguments()
    try:
        need_renderer()
    except InputError as error:
        sys.exit(f"error: {error}")
    scenes = named_scenes([name for name in args.scenes.split(",") if name], args.cache)
    scenes += [describe_ply(path.stem, path) for path in args.extra]
    args.cache.mkdir(parents=True, exist_ok=True)
    command, remark = (None, "left out") if args.no_peers else find_splat_transform(args.peers)
    machine = describe_machine(("numpy", "numba", "deflate"))
    for key, value in {**machine, "SPZ": remark}.items():
        print(f"{key}: {value}", file=sys.stderr)
    presets = args.presets.split(",")
    results = []
    for scene in scenes:
        start = time.perf_counter()
        results.append(_measure(scene, presets, command, args.cache))
        print(f"{scene.name}: {time.perf_counter() - start:.1f} s", file=sys.stderr, flush=True)
    columns = [*presets, *(["SPZ"] if command is not None else [])]
    print(_table(results, columns, markdown=args.markdown))
    if args.json is not None:
        document = {"machine": machine, "peer": remark, "scenes": results}
        args.json.write_text(json.dumps(document, indent=2) + "\n")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=_SCENES, help="names, separated by commas; default: %(default)s")
    parser.add_argument("--extra", type=Path, nargs="+", default=[], metavar="PLY", help="further scenes")
    parser.add_argument("--presets", default=",".join(PRESETS), help="default: %(default)s")
    parser.add_argument("--no-peers", action="store_true", help="leave SPZ out")
    parser.add_argument("--markdown", action="store_true", help="print the table as the README has it")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers, for programs")
    parser.add_argument("--cache", type=Path, default=ROOT / "out" / "bench", help="folder for made files")
    parser.add_argument("--peers", type=Path, default=ROOT / "out" / "peers", help="folder for npm packages")
    return parser.parse_args()


def _measure(scene: Scene, presets: Sequence[str], command: list[str] | None, cache: Path) -> dict[str, Any]:
    source = read_ply(scene.path)
    path = DATA / "psnr_cameras" / f"{scene.name}.json"
    judge = Judge.of_source(source, load_cameras(path) if path.exists() else comparison_cameras(source))
    columns = {name: _quality(source, other, judge, size) for name, other, size in decoded_presets(source, presets)}
    if command is not None:
        peer, back = spz_and_back(command, scene, cache)
        if peer.size_bytes is None:
            columns["SPZ"] = {"remark": peer.remark}
        else:
            columns["SPZ"] = _quality(source, read_ply(back), judge, peer.size_bytes)
    return {
        "name": scene.name,
        "splats": len(source),
        "sh_degree": source.sh_degree,
        "cameras": path.name if path.exists() else "virtual",
        "columns": columns,
    }


def decoded_presets(source: SplatModel, presets: Sequence[str]) -> Iterator[tuple[str, SplatModel, int]]:
    """Encode a scene with presets: the name of each, what is decoded, and the size in bytes."""
    for preset in presets:
        data = encode_with_report(source, EncodeOptions(preset=preset)).data
        yield preset, decode(data), len(data)


def _quality(source: SplatModel, other: SplatModel, judge: Judge, size_bytes: int) -> dict[str, Any]:
    compared = judge.scores(other).as_json()
    return {"size_bytes": size_bytes, "bytes_per_splat": size_bytes / len(source), **compared}


def _table(results: list[dict[str, Any]], columns: Sequence[str], *, markdown: bool) -> str:
    header = ["B/splat at dB", "splats, SH", *columns]
    rows = [
        [one["name"], f"{one['splats']:,}, {one['sh_degree']}", *(_cell(one["columns"][name]) for name in columns)]
        for one in results
    ]
    return laid_out(header, rows, markdown=markdown)


def _cell(column: dict[str, Any]) -> str:
    if "remark" in column:
        return str(column["remark"])
    return f"{column['bytes_per_splat']:.2f} at {column['psnr']:.1f}"


if __name__ == "__main__":
    main()
