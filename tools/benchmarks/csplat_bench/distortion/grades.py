"""Measure what quantisation classes save: bytes at equal PSNR with and without, by source of the importance.

    python -m csplat_bench.distortion.grades                       # six scenes; ten minutes on two cores
    python -m csplat_bench.distortion.grades --scenes fox60k_noreg --markdown

Importance is measured by virtual views, as for a target, or by every other camera that a scene was trained with. PSNR
is judged by the cameras of the data folder, or by the other half of the training cameras: never by the cameras that
measured the importance. SH is left out of scenes that have it: its coding is another matter.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, Importance, encode_with_report
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat.scene_source import drop_bands
from csplat_bench.common.command import MARKDOWN, SCENES, listed, run
from csplat_bench.common.curves import Point, rate_at
from csplat_bench.common.measuring import timed
from csplat_bench.common.report import table, tell_machine
from csplat_bench.common.scenes import Scene, cameras_of, find_scenes
from csplat_render import Camera
from csplat_render.camera_files import load_cameras
from csplat_render.scene_frame import scene_frame
from csplat_render.scorer import Scorer
from csplat_tools.console import note
from csplat_tools.optimise.scene_sensitivity import importance_views, measure_importance
from csplat_tools.views import BLACK, find_view_set

_SCENES = "plane3,horse,donut,jacket,lego60k,fox60k_noreg"
_EVEN = (38.0, 42.0, 46.0, 50.0, 54.0, 58.0, 62.0, 66.0)  # qualities of files with one class
_GRADED = (46.0, 54.0, 62.0)
_JUDGES = 20  # cameras at most
_HEAD = ("scene", "kind", "measured by", "s", "judged by", *["of the bytes at dB"] * len(_GRADED))


def main(*, scenes: SCENES = _SCENES, markdown: MARKDOWN = False) -> None:
    """Measure scene by scene, and print a table."""
    tell_machine()
    rows = []
    for scene in find_scenes(listed(scenes)):
        rows += _rows(scene)
        note(f"{scene.name}: done")
    print(table(_HEAD, rows, markdown=markdown))


def _rows(scene: Scene) -> list[tuple[str, ...]]:
    source = drop_bands(read_ply(scene.path), 0)
    beside = scene.path.with_suffix(".cameras.json")
    given = load_cameras(beside) if beside.exists() else []
    measures = {"virtual views": importance_views(source, find_view_set(source)), "half of its cameras": given[::2]}
    view_sets = {"cameras of `psnr`": cameras_of(scene.name, source), "the other half": given[1::2][:_JUDGES]}
    kind, rows = scene_frame(source).kind, []
    even = [_file(source, quality) for quality in _EVEN]
    graded: dict[str, tuple[str, list[bytes]]] = {}
    for name, cameras in measures.items():
        if cameras:
            importance, timing = timed(measure_importance, source, cameras, BLACK, threads=None)
            graded[name] = f"{timing.wall:.1f}", [_file(source, quality, importance) for quality in _GRADED]
    for judged_by, views in view_sets.items():
        if views:
            rows += [
                (scene.name, kind, name, seconds, judged_by, *cells)
                for name, (seconds, cells) in _shares(source, views, even, graded).items()
            ]
    return rows


def _file(source: SplatModel, quality: float, importance: Importance | None = None) -> bytes:
    """Encode a file; with quantisation classes if an importance is given."""
    return encode_with_report(source, EncodeOptions(attribute_psnr=quality), importance=importance).data


def _shares(
    source: SplatModel, views: Sequence[Camera], even: Sequence[bytes], graded: dict[str, tuple[str, list[bytes]]]
) -> dict[str, tuple[str, list[str]]]:
    """Return the size of graded files relative to even ones at the same PSNR, judged by these views."""
    judge = Scorer.of_source(source, views, BLACK)

    def point(data: bytes) -> Point:
        return Point(judge.psnr(decode(data)), len(data))

    curve = {"even": [point(data) for data in even]}
    return {
        name: (seconds, [_share(curve, point(data)) for data in files]) for name, (seconds, files) in graded.items()
    }


def _share(curve: dict[str, list[Point]], one: Point) -> str:
    rate = rate_at(curve, one.psnr)
    if rate is None or rate.measured is not None or not math.isfinite(one.psnr):
        return f"- at {one.psnr:.1f}"
    return f"{one.size_bytes / rate.size_bytes:.2f} at {one.psnr:.1f}"


if __name__ == "__main__":
    sys.exit(run(main))
