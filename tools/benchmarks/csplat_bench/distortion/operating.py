"""Measure operating points: what a thumbnail, a web page and an archive of a scene take, and how long they download.

    python -m csplat_bench.distortion.operating                        # seven scenes; half an hour on two cores
    python -m csplat_bench.distortion.operating --scenes plane3 --rate 5
    python -m csplat_bench.distortion.operating --tables --markdown    # print what was measured

The first picture is there when header, index and layer 0 of all tiles are: everything but SH bands. What was measured
is kept in out/operating/NAME.json.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Annotated, TypedDict

import typer

from csplat.decoder import decode, read_header
from csplat.encoder import encode
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat.scene_source import drop_bands
from csplat_bench.common.command import MARKDOWN, OUT, SCENES, TABLES, listed, run
from csplat_bench.common.kept import Kept, read_kept
from csplat_bench.common.measuring import timed
from csplat_bench.common.report import table, tell_machine
from csplat_bench.common.scenes import OUT as EVERYTHING
from csplat_bench.common.scenes import find_scenes
from csplat_render.scorer import Scorer
from csplat_tools.optimise.target_encoding import encode_to
from csplat_tools.tradeoffs.sweep_points import fetched_bytes
from csplat_tools.views import BLACK, comparison_cameras

_SCENES = "plane3,donut,horse,lego60k,fox60k_noreg,fox120k,statue"
#: By name, options of `csplat encode`; the target, and whether all splats stay.
_POINTS = {
    "thumbnail": ("--target-psnr 30", 30.0, False),
    "web page": ("--target-psnr 38", 38.0, False),
    "balanced": ("--preset balanced", None, True),
    "archive": ("--target-psnr 50 --no-prune", 50.0, True),
}
_HEAD = ("scene", "for", "kB", "× smaller", "dB", "whole, s", "first picture, kB", "dB", "s", "encoding, s")


class Reached(TypedDict, total=False):
    """A file, and its first picture; or why there is none."""

    ply_bytes: int
    size_bytes: int
    psnr: float
    first_bytes: int
    first_psnr: float
    seconds: float
    error: str


def main(
    *,
    scenes: SCENES = _SCENES,
    rate: Annotated[float, typer.Option(help="of the download, Mbit/s")] = 10.0,
    tables: TABLES = False,
    markdown: MARKDOWN = False,
    out: OUT = EVERYTHING / "operating",
) -> None:
    """Measure what the command line names, and print a table."""
    if not tables:
        tell_machine()
        for scene in find_scenes(listed(scenes)):
            source, kept = read_ply(scene.path), Kept(out / f"{scene.name}.json")
            for name in _POINTS:
                kept.measure("points", name, partial(_reached, source, scene.size_bytes, name))
    known: dict[str, dict[str, Reached]] = {name: one["points"] for name, one in read_kept(out).items()}
    for name, (options, _, _) in _POINTS.items():
        print(f"{name}: csplat encode {options}")
    rows = [(scene, name, *_cells(one, rate)) for scene, points in known.items() for name, one in points.items()]
    print(table(_HEAD, rows, markdown=markdown))


def _reached(source: SplatModel, ply_bytes: int, name: str) -> Reached:
    _, psnr, whole = _POINTS[name]
    try:
        data, timing = timed(_encoded, source, psnr, whole=whole)
    except InputError as error:
        return {"error": str(error)}
    judge = Scorer.of_source(source, comparison_cameras(source), BLACK)
    model = decode(data)
    return {
        "ply_bytes": ply_bytes,
        "size_bytes": len(data),
        "psnr": judge.psnr(model),
        "first_bytes": fetched_bytes(read_header(data), 0),
        "first_psnr": judge.psnr(drop_bands(model, 0)),
        "seconds": timing.wall,
    }


def _encoded(source: SplatModel, psnr: float | None, *, whole: bool) -> bytes:
    return encode(source) if psnr is None else encode_to(source, psnr=psnr, no_prune=whole).data


def _cells(one: Reached, rate: float) -> tuple[str, ...]:
    if "error" in one:
        return (one["error"], *[""] * (len(_HEAD) - 3))
    size, first, per_second = one["size_bytes"], one["first_bytes"], rate * 1e6 / 8.0
    return (
        f"{size / 1e3:.0f}",
        f"{one['ply_bytes'] / size:.0f}",
        f"{one['psnr']:.1f}",
        f"{size / per_second:.2f}",
        f"{first / 1e3:.0f}",
        f"{one['first_psnr']:.1f}",
        f"{first / per_second:.2f}",
        f"{one['seconds']:.0f}",
    )


if __name__ == "__main__":
    sys.exit(run(main))
