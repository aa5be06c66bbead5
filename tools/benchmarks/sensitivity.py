"""What measured sensitivities are worth: bytes per splat and `psnr` of files by what the encoder was told.

    python tools/benchmarks/sensitivity.py                             # lego60k and fox120k, some minutes
    python tools/benchmarks/sensitivity.py --scenes plane3 --sizes 1024,4096 --markdown
    python tools/benchmarks/sensitivity.py --extra scene.ply --data photographs

Sensitivities come from the training views of --data, else from virtual cameras, which are not those that judge. `psnr`
is that of `csplat compare`; the columns of one attribute alone have everything else as in the source.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine
from printing import laid_out
from scenes import DATA, ROOT, describe_ply, named_scenes

from csplat.decoder import decode
from csplat.encoder import PRESETS, EncodeOptions, Importance, encode_with_report
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render.cameras import load_cameras
from csplat_render.judge import Judge
from csplat_tools.files.extras import need_renderer
from csplat_tools.optimise.sensitivity import Measured, measure_scene
from csplat_tools.views import BLACK, DataOptions, comparison_cameras, find_view_set
from csplat_trainer.sensitivity_file import read_sensitivity

_SHARES = (0.0, 0.02, 0.05, 0.1, 0.3)
_HEADER = ("told", "B/splat", "psnr", "SH alone", "shape alone", "SH entries", "shapes", "escape, %", "seconds")


def main() -> None:
    """Measure the scenes that the command line names, and print a table for each."""
    args = _arguments()
    try:
        need_renderer()
    except InputError as error:
        sys.exit(f"error: {error}")
    args.cache.mkdir(parents=True, exist_ok=True)
    scenes = named_scenes([name for name in args.scenes.split(",") if name], args.cache)
    scenes += [describe_ply(path.stem, path) for path in args.extra]
    machine = describe_machine(("numpy", "numba", "deflate"))
    for key, value in machine.items():
        print(f"{key}: {value}", file=sys.stderr)
    results = []
    for scene in scenes:
        source = read_ply(scene.path)
        start = time.perf_counter()
        data = None if args.data is None else DataOptions(args.data)
        aside = None if data is None else 0
        views = find_view_set(source, data=data, background=BLACK, count=args.views, aside=aside)
        measured = measure_scene(source, views, threads=args.threads)
        seconds = time.perf_counter() - start
        path = DATA / "psnr_cameras" / f"{scene.name}.json"
        judge = Judge.of_source(source, load_cameras(path) if path.exists() else comparison_cameras(source))
        rows = [
            _row(name, source, options, importance, judge) for name, options, importance in _variants(measured, args)
        ]
        facts = {"name": scene.name, "seconds": seconds, **measured.as_json(), "rows": rows}
        results.append(facts)
        print(
            f"{scene.name}: {len(source):,} splats, {facts['views']} {facts['source']} views in {seconds:.1f} s,"
            f" {100 * facts['unseen_share']:.2f} % unseen, preset {args.preset}"
        )
        print(_table(rows, markdown=args.markdown), flush=True)
        print(_histogram(measured, markdown=args.markdown), flush=True)
    if args.json is not None:
        args.json.write_text(json.dumps({"machine": machine, "scenes": results}, indent=2) + "\n")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default="lego60k,fox120k", help="names, separated by commas; default: %(default)s")
    parser.add_argument("--extra", type=Path, nargs="+", default=[], metavar="PLY", help="further scenes")
    parser.add_argument("--data", metavar="DATA", help="a data set whose training views are used")
    parser.add_argument("--views", type=int, default=160, help="virtual views at most; default: %(default)s")
    parser.add_argument("--preset", choices=list(PRESETS), default="small", help="default: %(default)s")
    parser.add_argument("--sizes", default="1024,4096,16384", help="of the codebooks of shapes; default: %(default)s")
    parser.add_argument("--threads", type=int, help="one per core by default")
    parser.add_argument("--markdown", action="store_true", help="print tables as guides have them")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers, for programs")
    parser.add_argument("--cache", type=Path, default=ROOT / "out" / "bench", help="folder for made files")
    return parser.parse_args()


def _variants(measured: Measured, args: argparse.Namespace) -> Iterator[tuple[str, EncodeOptions, Importance | None]]:
    """What the encoder is told: nothing, weights, matrices, codebooks of shapes; and who escapes from those."""
    path = args.cache / "sensitivity.npz"
    measured.write(str(path))
    full = read_sensitivity(path, measured.model).importance()
    plain = EncodeOptions(preset=args.preset, grades=1, threads=args.threads)
    weights = Importance(full.sh, full.shape)
    yield "nothing", plain, None
    yield "weights", plain, weights
    yield "matrices", plain, full
    yield "matrices, grades", replace(plain, grades=None), full
    sizes = [int(size) for size in args.sizes.split(",")]
    for size in sizes:
        yield f"matrices, {size:,} shapes", replace(plain, shape_codebook_size=size), full
    middle = replace(plain, shape_codebook_size=sizes[len(sizes) // 2])
    yield "nothing, shapes", middle, None
    yield "weights, shapes", middle, weights
    for share in _SHARES:
        yield f"matrices, shapes, {100 * share:g} % escape", replace(middle, shape_escape_fraction=share), full


def _row(
    name: str,
    source: SplatModel,
    options: EncodeOptions,
    importance: Importance | None,
    judge: Judge,
) -> dict[str, Any]:
    start = time.perf_counter()
    result = encode_with_report(source, options, importance=importance)
    seconds = time.perf_counter() - start
    decoded, place = decode(result.data), np.argsort(result.source_index)

    def psnr(other: SplatModel) -> float:
        return judge.psnr(other)

    shN = np.zeros_like(source.shN)
    shN[:, : decoded.shN.shape[1]] = decoded.shN[place]
    said = result.report.options
    return {
        "told": name,
        "size_bytes": len(result.data),
        "bytes_per_splat": len(result.data) / len(source),
        "psnr": psnr(decoded),
        "psnr_sh": psnr(replace(source, shN=shN)) if source.sh_degree else None,
        "psnr_shape": psnr(replace(source, quats=decoded.quats[place], scales=decoded.scales[place])),
        "sh_entries": said["codebook_sizes"],
        "shapes": said.get("shape_codebook_size", 0),
        "shape_escapes": said.get("shape_escape_fraction"),
        "seconds": seconds,
    }


def _table(rows: Sequence[dict[str, Any]], *, markdown: bool) -> str:
    lines = [
        [
            row["told"],
            f"{row['bytes_per_splat']:.2f}",
            f"{row['psnr']:.2f}",
            "" if row["psnr_sh"] is None else f"{row['psnr_sh']:.2f}",
            f"{row['psnr_shape']:.2f}",
            "+".join(f"{size:,}" for size in row["sh_entries"]),
            f"{row['shapes']:,}" if row["shapes"] else "",
            "" if row["shape_escapes"] is None else f"{100 * row['shape_escapes']:.1f}",
            f"{row['seconds']:.1f}",
        ]
        for row in rows
    ]
    return laid_out(_HEADER, lines, markdown=markdown)


def _histogram(measured: Measured, *, markdown: bool) -> str:
    """Share of the splats by decade of their sensitivities."""
    groups = {name: getattr(measured.found, name) for name in ("colour", "opacity", "shape", "shape_net")}
    decades = range(-10, 0)
    lines = []
    for name, values in groups.items():
        low = [float(np.mean((values >= 10.0**at) & (values < 10.0 ** (at + 1)))) for at in decades]
        below = float(np.mean(values < 10.0 ** decades[0]))
        lines.append([name, *(f"{100 * share:.1f}" for share in (below, *low))])
    return laid_out(("% of splats", f"< 1e{decades[0]}", *(f"1e{at} …" for at in decades)), lines, markdown=markdown)


if __name__ == "__main__":
    main()
