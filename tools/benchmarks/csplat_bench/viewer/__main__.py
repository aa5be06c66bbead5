"""Measure the viewer: culling, sorting, drawing, memory on the GPU.

    python -m csplat_bench.viewer                             # everything that is there; a quarter of an hour
    python -m csplat_bench.viewer --quick                     # the sample alone
    python -m csplat_bench.viewer --gpu                       # let Chromium use the machine's GPU

Requires Chromium and playwright. Without --gpu pictures are drawn by SwiftShader, a GL on the CPU, whose frames say
nothing about a GPU's. Times are medians. Scenes of other sizes are copies side by side.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from csplat.encoder import EncodeOptions, encode
from csplat.ply import read_ply
from csplat_bench.common.browser import open_page
from csplat_bench.common.command import CACHE, JSON, PRESETS, listed, numbers, preset_of, run
from csplat_bench.common.making import blow_up
from csplat_bench.common.report import table, tell_machine, write_json
from csplat_bench.common.scenes import MADE, Scene, find_scenes
from csplat_bench.viewer.page import HEIGHT, WIDTH, Drawn, File, drawn
from csplat_tools.console import note


def main(
    *,
    quick: Annotated[bool, typer.Option("--quick", help="the sample alone, small pictures of it")] = False,
    sources: Annotated[str, typer.Option(help="scenes to draw")] = "fox120k,donut",
    sizes: Annotated[str, typer.Option(help="splats to draw")] = "100000,500000,1000000",
    presets: PRESETS = "balanced,fast",
    runs: Annotated[int, typer.Option(help="of each measurement")] = 5,
    gpu: Annotated[bool, typer.Option("--gpu", help="do not ask for SwiftShader")] = False,
    chromium: Annotated[str, typer.Option(help="the program")] = shutil.which("chromium") or "chromium",
    json: JSON = None,
    cache: CACHE = MADE,
) -> None:
    """Measure what the command line names, and print a table."""
    machine, draw = tell_machine(), list[Drawn]()
    size = [None] if quick else numbers(sizes, int)
    scenes = find_scenes(["sample"] if quick else listed(sources), cache)
    with open_page(chromium, gpu=gpu) as page:
        for file in _draw_files(scenes, size, listed(presets), cache):
            draw.append(drawn(page, file, runs))
            note(f"{file.name} {file.preset}: done")
    print(_draw_table(draw), flush=True)
    if json is not None:
        write_json(json, {"machine": machine, "draw": draw})


def _draw_files(
    scenes: Sequence[Scene], sizes: Sequence[int | None], presets: Sequence[str], cache: Path
) -> Iterator[File]:
    for scene in scenes:
        for size in sizes:
            # Without SH presets differ in nothing that the GPU would notice.
            for preset in presets if scene.sh_degree else presets[:1]:
                yield _encoded(scene, preset, cache, size)


def _encoded(scene: Scene, preset: str, cache: Path, size: int | None = None) -> File:
    """Return a file of a scene, or of copies of it with `size` splats; made once."""
    name = scene.name if size is None else f"{scene.name}-{size // 1000}k"
    path = cache / f"{name}.{preset}.viewer.csplat"
    if not path.exists():
        source = read_ply(scene.path)
        model = source if size is None else blow_up(source, size)
        path.write_bytes(encode(model, EncodeOptions(preset=preset_of(preset))))
    return File(name, preset, path)


def _draw_table(found: Sequence[Drawn]) -> str:
    if not found:
        return "\ndrawing: no scenes  <-- NOT MEASURED"
    rows = [
        (
            one["name"],
            one["preset"],
            f"{one['splatCount']:,}",
            f"{one['inView']:,.0f}",
            f"{one['cullMs']:.1f}",
            f"{one['sortMs']:.1f}",
            f"{one['frameMs']:.0f}",
            f"{1000 / one['frameMs']:.2f}",
            f"{one['gpuBytesPerSplat']:.1f}",
            one["expandedBytesPerSplat"],
            f"{one['expandedBytesPerSplat'] / one['gpuBytesPerSplat']:.1f}",
            f"{one['decodeMs']:.0f}",
            f"{one['wholeMs']:.0f}",
        )
        for one in found
    ]
    header = (
        "scene", "preset", "splats", "in view", "cull ms", "sort ms", "frame ms", "fps", "B/splat on GPU", "as floats",
        "smaller by", "decode ms", "open ms",
    )  # fmt: skip
    title = f"Drawing at {WIDTH}x{HEIGHT} into {found[0]['pictureFormat']} by {found[0]['glRenderer']}"
    more = "4 B/splat for the order and at most 8 MiB of projected splats come on top of the attributes"
    return f"\n{title}\n{table(header, rows)}\n{more}"


if __name__ == "__main__":
    sys.exit(run(main))
