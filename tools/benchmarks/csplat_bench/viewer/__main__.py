"""Measure the viewer: culling, sorting, drawing, memory on the GPU, decoding in JavaScript.

    python -m csplat_bench.viewer                             # everything that is there; a quarter of an hour
    python -m csplat_bench.viewer --quick                     # the sample alone
    python -m csplat_bench.viewer --only decode --extra statue.ply
    python -m csplat_bench.viewer --gpu                       # let Chromium use the machine's GPU

Wants Chromium, playwright, and Node.js for the table of decoders. Without --gpu pictures are drawn by SwiftShader, a
GL on the CPU, whose frames say nothing about a GPU's. Times are medians. Scenes of other sizes are copies side by side.
"""

from __future__ import annotations

import json as format_json
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, TypedDict

import typer

from csplat.encoder import EncodeOptions, encode
from csplat.ply import read_ply
from csplat_bench.common.command import CACHE, EXTRA, JSON, PRESETS, listed, numbers, preset_of, run, tell
from csplat_bench.common.making import blow_up
from csplat_bench.common.report import table, tell_machine, write_json
from csplat_bench.common.scenes import MADE, Scene, find_scenes
from csplat_bench.viewer.page import HEIGHT, WIDTH, Drawn, File, drawn, open_page

_PARTS = "draw,decode"
_SCRIPT = Path(__file__).with_name("js_decode.mjs")


class Decoded(TypedDict):
    """What `js_decode.mjs` prints of a file; seconds of either decoder."""

    file: str
    splats: int
    shDegree: int
    seconds: float
    pythonSeconds: float


def main(
    *,
    quick: Annotated[bool, typer.Option("--quick", help="the sample alone, small pictures of it")] = False,
    only: Annotated[str, typer.Option(help="which tables")] = _PARTS,
    sources: Annotated[str, typer.Option(help="scenes to draw")] = "fox120k,donut",
    sizes: Annotated[str, typer.Option(help="splats to draw")] = "100000,500000,1000000",
    presets: PRESETS = "balanced,fast",
    decoded: Annotated[str, typer.Option(help="scenes for the decoders")] = "fox120k,lego60k,donut,donut-1M",
    extra: EXTRA = [],
    runs: Annotated[int, typer.Option(help="of each measurement")] = 5,
    gpu: Annotated[bool, typer.Option("--gpu", help="do not ask for SwiftShader")] = False,
    chromium: Annotated[str, typer.Option(help="the program")] = shutil.which("chromium") or "chromium",
    json: JSON = None,
    cache: CACHE = MADE,
) -> None:
    """Measure what the command line names, and print a table of each."""
    machine, parts = tell_machine(), listed(only)
    draw, rows = list[Drawn](), list[Decoded]()
    if "draw" in parts:
        size = [None] if quick else numbers(sizes, int)
        scenes = find_scenes(["sample"] if quick else listed(sources), cache)
        with open_page(chromium, gpu=gpu) as page:
            for file in _draw_files(scenes, size, listed(presets), cache):
                draw.append(drawn(page, file, runs))
                tell(f"{file.name} {file.preset}: done")
        print(_draw_table(draw), flush=True)
    if "decode" in parts:
        scenes = find_scenes(["sample"] if quick else listed(decoded), cache, extra)
        rows = _decoders([_encoded(scene, "balanced", cache).path for scene in scenes], runs)
        print(_decode_table(rows))
    if json is not None:
        write_json(json, {"machine": machine, "draw": draw, "decode": rows})


def _draw_files(
    scenes: Sequence[Scene], sizes: Sequence[int | None], presets: Sequence[str], cache: Path
) -> Iterator[File]:
    for scene in scenes:
        for size in sizes:
            # Without SH presets differ in nothing that the GPU would notice.
            for preset in presets if scene.sh_degree else presets[:1]:
                yield _encoded(scene, preset, cache, size)


def _encoded(scene: Scene, preset: str, cache: Path, size: int | None = None) -> File:
    """A file of a scene, or of so many splats of copies of it; made once."""
    name = scene.name if size is None else f"{scene.name}-{size // 1000}k"
    path = cache / f"{name}.{preset}.viewer.csplat"
    if not path.exists():
        source = read_ply(scene.path)
        model = source if size is None else blow_up(source, size)
        path.write_bytes(encode(model, EncodeOptions(preset=preset_of(preset))))
    return File(name, preset, path)


def _decoders(paths: Sequence[Path], runs: int) -> list[Decoded]:
    node = shutil.which("node")
    if node is None:
        tell("decoders: Node.js is not installed  <-- NOT MEASURED")
        return []
    command = [node, str(_SCRIPT), "--repeat", str(runs), "--python", sys.executable, "--json", *map(str, paths)]
    rows: list[Decoded] = format_json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    return rows


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


def _decode_table(found: Sequence[Decoded]) -> str:
    rows = []
    for one in found:
        times = one["seconds"], one["pythonSeconds"]
        cells = (text for time in times for text in (f"{1000 * time:.0f}", f"{one['splats'] / time / 1e6:.2f}"))
        rows.append((one["file"].partition(".")[0], f"{one['splats']:,}", one["shDegree"], *cells))
    return f"\n{table(('decode', 'splats', 'SH', 'JavaScript ms', 'M splats/s', 'Python ms', 'M splats/s'), rows)}"


if __name__ == "__main__":
    sys.exit(run(main))
