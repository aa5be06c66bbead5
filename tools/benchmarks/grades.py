"""Measure what grades are worth: bytes at equal PSNR with and without, by who says how precise splats have to be.

    python tools/benchmarks/grades.py                       # six scenes; ten minutes on two cores
    python tools/benchmarks/grades.py --scenes fox60k_noreg --markdown

Who measures: virtual views, as for a target; or every other camera that a scene was trained with. Who judges: the
cameras of the data folder; or the other half of the training cameras. Nobody judges what the same cameras measured. SH
is left out of scenes that have it: its coding is another matter.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from distortion_curves import Point, rate_at
from machine import describe_machine
from printing import laid_out
from scenes import DATA, ROOT, Scene, named_scenes

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, Importance, encode_with_report
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render import Camera
from csplat_render.cameras import load_cameras
from csplat_render.judge import Judge
from csplat_render.virtual import scene_frame, virtual_cameras
from csplat_tools.files.scenes import without_bands
from csplat_tools.optimise.sensitivity import measured_importance, measuring_views
from csplat_tools.views import BLACK, find_view_set

_SCENES = "plane3,horse,donut,jacket,lego60k,fox60k_noreg"
_EVEN = (38.0, 42.0, 46.0, 50.0, 54.0, 58.0, 62.0, 66.0)  # qualities of files without grades
_GRADED = (46.0, 54.0, 62.0)
_JUDGES = 20  # cameras at most
_HEAD = ("scene", "kind", "measured by", "s", "judged by", *["of the bytes at dB"] * len(_GRADED))


def main() -> None:
    """Measure scene by scene, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=_SCENES, help="names, separated by commas; default: %(default)s")
    parser.add_argument("--markdown", action="store_true", help="print the table as a guide has it")
    args = parser.parse_args()
    for key, value in describe_machine(("numpy", "numba", "deflate")).items():
        print(f"{key}: {value}", file=sys.stderr)
    rows = []
    for scene in named_scenes(args.scenes.split(","), ROOT / "out" / "scenes"):
        rows += _rows(scene)
        print(f"{scene.name}: done", file=sys.stderr, flush=True)
    print(laid_out(_HEAD, rows, markdown=args.markdown))


def _rows(scene: Scene) -> list[tuple[str, ...]]:
    source = without_bands(read_ply(scene.path), 0)
    given, own = _cameras(scene.path.with_suffix(".cameras.json")), _cameras(_of_psnr(scene.name))
    measures = {"virtual views": measuring_views(source, find_view_set(source)), "half of its cameras": given[::2]}
    judges = {"cameras of `psnr`": own or virtual_cameras(source), "the other half": given[1::2][:_JUDGES]}
    kind, found = scene_frame(source).kind, dict[str, tuple[Importance, float]]()
    for name, cameras in measures.items():
        if cameras:
            start = time.perf_counter()
            importance = measured_importance(source, cameras, BLACK, threads=None)
            found[name] = importance, time.perf_counter() - start
    even = [_file(source, quality, None) for quality in _EVEN]
    graded = {name: [_file(source, quality, one) for quality in _GRADED] for name, (one, _) in found.items()}
    rows = []
    for judged_by, cameras in judges.items():
        if not cameras:
            continue
        judge = Judge.of_source(source, cameras, BLACK)
        curve = {"even": [Point(judge.psnr(decode(data)), len(data)) for data in even]}
        for name, files in graded.items():
            cells = [_share(curve, judge.psnr(decode(data)), len(data)) for data in files]
            rows.append((scene.name, kind, name, f"{found[name][1]:.1f}", judged_by, *cells))
    return rows


def _cameras(path: Path) -> Sequence[Camera]:
    return load_cameras(path) if path.exists() else []


def _of_psnr(name: str) -> Path:
    return DATA / "psnr_cameras" / f"{name}.json"


def _file(source: SplatModel, quality: float, importance: Importance | None) -> bytes:
    """A file; graded where an importance says how."""
    return encode_with_report(source, EncodeOptions(attribute_psnr=quality), importance=importance).data


def _share(curve: dict[str, list[Point]], psnr: float, size_bytes: int) -> str:
    """What part of the bytes of files without grades a file takes, at its own PSNR."""
    rate = rate_at(curve, psnr)
    if rate is None or rate.measured is not None or not math.isfinite(psnr):
        return f"- at {psnr:.1f}"
    return f"{size_bytes / rate.size_bytes:.2f} at {psnr:.1f}"


if __name__ == "__main__":
    main()
