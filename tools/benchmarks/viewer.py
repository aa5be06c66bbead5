"""Measure the viewer: culling, sorting, drawing, memory on the GPU, the first picture, decoding in JavaScript.

    python tools/benchmarks/viewer.py                             # everything that is there; a quarter of an hour
    python tools/benchmarks/viewer.py --quick                     # the sample alone
    python tools/benchmarks/viewer.py --only first --extra statue.ply
    python tools/benchmarks/viewer.py --gpu                       # let Chromium use the machine's GPU

Wants Chromium, playwright, and Node.js for the table of decoders. Without --gpu pictures are drawn by SwiftShader, a
GL on the CPU, whose frames say nothing about a GPU's. Times are medians. Scenes of other sizes are copies side by side.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from machine import describe_machine
from scenes import ROOT, Scene, blow_up, describe_ply, find_scenes

from csplat.decoder import decode, read_header
from csplat.encoder import EncodeOptions, encode
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render.camera import Camera
from csplat_render.virtual import virtual_cameras
from csplat_tools.files.console import format_table
from csplat_tools.present.server import open_server
from csplat_tools.present.viewing import open_scene

_SIZES = (100_000, 500_000, 1_000_000)
_SOURCES = ("fox120k", "donut")
_FIRST = "fox120k,fox60k_noreg,lego60k,plane3"
_DECODED = "fox120k,lego60k,donut,donut-1M"
_PARTS = ("draw", "first", "decode")
_WIDTH, _HEIGHT = 640, 480
_SORT_ZOOM = 1 / 8  # sorting does not depend on the size of the picture, drawing does
_SYNTHETIC = {"lego60k": 11.5}
_CAPTURE = 10.0

_SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_HARDWARE = ["--ignore-gpu-blocklist", "--use-angle=vulkan", "--enable-features=Vulkan", "--disable-vulkan-surface"]

# One engine on a canvas of its own; the camera is [pinhole, width, height].
_MAKE = """async () => {
  const { createEngine } = await import('/tools/viewer/engine.mjs');
  window.bench?.close();
  window.bench = await createEngine(document.createElement('canvas'));
}"""
_LOOK = """(view) => {
  const [camera, width, height] = view;
  bench.setSize(width, height);
  bench.setCamera(camera);
}"""
_OPEN = """async (url) => {
  const start = performance.now();
  await bench.open(url);
  const wholeMs = performance.now() - start;
  await bench.settled();
  return { ...bench.stats, wholeMs };
}"""
_SORT = """async () => {
  await bench.settled();
  return [bench.stats.cullMs, bench.stats.sortMs, bench.stats.splatsDrawn];
}"""


@dataclass(frozen=True)
class _File:
    """An encoded scene."""

    name: str
    preset: str
    path: Path


def main() -> None:
    """Measure what the command line names, and print tables."""
    args = _arguments()
    parts = [part for part in args.only.split(",") if part]
    if set(parts) - set(_PARTS):
        sys.exit(f"error: --only takes {', '.join(_PARTS)}")
    args.cache.mkdir(parents=True, exist_ok=True)
    machine = describe_machine(("numpy", "playwright"))
    print("\n".join(f"{key}: {value}" for key, value in machine.items()))
    results: dict[str, Any] = {"machine": machine}
    with _browser(args) as page:
        if "draw" in parts:
            results["draw"] = [_measure_drawing(page, file, args.runs) for file in _draw_files(args)]
            print(_draw_table(results["draw"]), flush=True)
        if "first" in parts:
            results["first"] = [_measure_first(page, file) for file in _files(args, args.first)]
            print(_first_table(results["first"]), flush=True)
    if "decode" in parts:
        results["decode"] = _measure_decoders([file.path for file in _files(args, args.decoded)], args.runs)
        print(_decode_table(results["decode"]))
    if args.json is not None:
        args.json.write_text(json.dumps(results, indent=2) + "\n")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the sample alone, small pictures of it")
    parser.add_argument("--only", default=",".join(_PARTS), help="which tables, default: %(default)s")
    parser.add_argument("--sizes", default=",".join(map(str, _SIZES)), help="splats to draw, default: %(default)s")
    parser.add_argument("--sources", default=",".join(_SOURCES), help="scenes to draw, default: %(default)s")
    parser.add_argument("--presets", default="balanced,fast", help="presets to draw, default: %(default)s")
    parser.add_argument("--first", default=_FIRST, help="scenes for the first picture, default: %(default)s")
    parser.add_argument("--decoded", default=_DECODED, help="scenes for the decoders, default: %(default)s")
    parser.add_argument("--extra", type=Path, nargs="+", default=[], metavar="PLY", help="further scenes for both")
    parser.add_argument("--runs", type=int, default=5, help="runs of each measurement, default %(default)s")
    parser.add_argument("--gpu", action="store_true", help="do not ask for SwiftShader")
    parser.add_argument("--chromium", default=shutil.which("chromium") or "chromium", help="default: %(default)s")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers, for programs")
    parser.add_argument("--cache", type=Path, default=ROOT / "out" / "bench", help="folder for made files")
    return parser.parse_args()


@contextmanager
def _browser(args: argparse.Namespace) -> Iterator[Any]:
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        sys.exit("error: playwright is not installed: pip install playwright")
    with sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--disable-dev-shm-usage", *(_HARDWARE if args.gpu else _SOFTWARE)]
        chromium = playwright.chromium.launch(executable_path=args.chromium, args=arguments)
        page = chromium.new_page()
        page.set_default_timeout(600_000)
        yield page
        chromium.close()


def _draw_files(args: argparse.Namespace) -> Iterator[_File]:
    presets = args.presets.split(",")
    if args.quick:
        for scene in find_scenes(["sample"], args.cache):
            yield from (_encoded(scene.name, read_ply(scene.path), preset, args.cache) for preset in presets)
        return
    for scene in find_scenes(args.sources.split(","), args.cache):
        source = read_ply(scene.path)
        for size in map(int, args.sizes.split(",")):
            name = f"{scene.name}-{size // 1000}k"
            # donut has no SH: its presets differ in nothing that the GPU would notice
            for preset in presets if scene.sh_degree else presets[:1]:
                yield _encoded(name, source, preset, args.cache, size)


def _files(args: argparse.Namespace, names: str) -> list[_File]:
    scenes: list[Scene] = find_scenes(["sample"] if args.quick else names.split(","), args.cache)
    scenes += [describe_ply(path.stem, path) for path in args.extra]
    return [_encoded(scene.name, read_ply(scene.path), "balanced", args.cache) for scene in scenes]


def _encoded(name: str, source: SplatModel, preset: str, cache: Path, size: int | None = None) -> _File:
    path = cache / f"{name}.{preset}.viewer.csplat"
    if not path.exists():
        model = source if size is None else blow_up(source, size)
        path.write_bytes(encode(model, EncodeOptions(preset=preset)))
    return _File(name, preset, path)


@contextmanager
def _served(page: Any, file: _File) -> Iterator[str]:
    """Serve a file as `csplat view` does and go to the empty page; yields the scene's address."""
    with open_scene(str(file.path), preset="balanced") as scene, open_server(scene) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            page.goto(f"{server.url}tools/viewer/index.html")
            yield f"{server.url}scene/{scene.name}"
        finally:
            server.shutdown()
            thread.join()


def _pinhole(camera: Camera, zoom: float = 1.0) -> list[Any]:
    K = camera.K * zoom
    pinhole = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "near": camera.near}
    return [{"viewmat": camera.viewmat.ravel().tolist(), **pinhole}, int(camera.W * zoom), int(camera.H * zoom)]


def _measure_drawing(page: Any, file: _File, runs: int) -> dict[str, Any]:
    data = file.path.read_bytes()
    cameras = virtual_cameras(decode(data), 4, _WIDTH, _HEIGHT)
    with _served(page, file) as url:
        page.evaluate(_MAKE)
        page.evaluate(_LOOK, _pinhole(cameras[0], _SORT_ZOOM))
        stats: dict[str, Any] = page.evaluate(_OPEN, url)
        sorts = []
        for camera in cameras * runs:
            page.evaluate(_LOOK, _pinhole(camera, _SORT_ZOOM))
            sorts.append(page.evaluate(_SORT))
        frames: list[float] = []
        for camera in cameras:
            page.evaluate(_LOOK, _pinhole(camera))
            frames += page.evaluate("(count) => bench.timeFrames(count)", max(1, runs // 2))
        stats = page.evaluate("({ ...bench.stats })") | {"wholeMs": stats["wholeMs"]}
        page.evaluate("bench.close()")
    cull, sort, drawn = (statistics.median(column) for column in zip(*sorts, strict=True))
    print(f"{file.name} {file.preset}: done", file=sys.stderr, flush=True)
    return {
        "name": file.name,
        "preset": file.preset,
        **{
            key: stats[key] for key in ("splatCount", "decodeMs", "wholeMs", "glRenderer", "pictureFormat", "workBytes")
        },
        **{key: stats[key] for key in ("gpuBytesPerSplat", "expandedBytesPerSplat")},
        "cullMs": cull,
        "sortMs": sort,
        "inView": drawn,
        "frameMs": statistics.median(frames),
    }


def _measure_first(page: Any, file: _File) -> dict[str, Any]:
    data = file.path.read_bytes()
    header = read_header(data)
    camera = virtual_cameras(decode(data), 1, _WIDTH, _HEIGHT)[0]
    with _served(page, file) as url:
        page.evaluate(_MAKE)
        page.evaluate(_LOOK, _pinhole(camera))
        stats: dict[str, Any] = page.evaluate(_OPEN, url)
        page.evaluate("bench.close()")
    chunks = sum(tile.layers[0].size for tile in header.tiles)
    tables = sum(record.size for record in header.directory if record.type == b"CODB" and record.layer == 0)
    begin = min([record.offset for record in header.directory] + [tile.layers[0].offset for tile in header.tiles])
    return {
        "name": file.name,
        "splats": header.splat_count,
        "fileBytes": len(data),
        "firstBytes": begin + tables + chunks,  # header, index, codebooks of layer 0, layer 0
        **{key: stats[key] for key in ("firstPictureMs", "firstPictureBytes", "wholeMs", "frameMs", "glRenderer")},
    }


def _measure_decoders(paths: Sequence[Path], runs: int) -> list[dict[str, Any]]:
    node = shutil.which("node")
    if node is None:
        print("decoders: Node.js is not installed  <-- NOT MEASURED")
        return []
    script = Path(__file__).with_name("js_decode.mjs")
    command = [node, str(script), "--repeat", str(runs), "--python", sys.executable, "--json", *map(str, paths)]
    rows: list[dict[str, Any]] = json.loads(
        subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    )
    return rows


def _draw_table(results: Sequence[dict[str, Any]]) -> str:
    if not results:
        return "\ndrawing: no scenes  <-- NOT MEASURED"
    header = ["scene", "preset", "splats", "in view", "cull ms", "sort ms", "frame ms", "fps"]
    header += ["B/splat on GPU", "as floats", "smaller by", "decode ms", "open ms"]
    rows = []
    for one in results:
        gpu, floats = one["gpuBytesPerSplat"], one["expandedBytesPerSplat"]
        row = [one["name"], one["preset"], f"{one['splatCount']:,}", f"{one['inView']:,.0f}"]
        row += [f"{one['cullMs']:.1f}", f"{one['sortMs']:.1f}", f"{one['frameMs']:.0f}", f"{1000 / one['frameMs']:.2f}"]
        row += [f"{gpu:.1f}", f"{floats}", f"{floats / gpu:.1f}", f"{one['decodeMs']:.0f}", f"{one['wholeMs']:.0f}"]
        rows.append(row)
    one = results[0]
    title = f"Drawing at {_WIDTH}x{_HEIGHT} into {one['pictureFormat']} by {one['glRenderer']}"
    more = "4 B/splat for the order and at most 8 MiB of projected splats come on top of the attributes"
    return f"\n{title}\n{format_table(header, rows)}\n{more}"


def _first_table(results: Sequence[dict[str, Any]]) -> str:
    header = ["first picture", "splats", "file B/splat", "layer 0 B/splat", "at most", "", "share of file"]
    header += ["received then", "first ms", "whole ms"]
    rows = []
    for one in results:
        splats, bound = one["splats"], _SYNTHETIC.get(one["name"], _CAPTURE)
        first = one["firstBytes"] / splats
        row = [one["name"], f"{splats:,}", f"{one['fileBytes'] / splats:.2f}", f"{first:.2f}", f"{bound:g}"]
        row += ["ok" if first <= bound else "MORE", f"{one['firstBytes'] / one['fileBytes']:.0%}"]
        row += [f"{one['firstPictureBytes'] / splats:.2f}", f"{one['firstPictureMs']:.0f}", f"{one['wholeMs']:.0f}"]
        rows.append(row)
    return f"\n{format_table(header, rows)}"


def _decode_table(results: Sequence[dict[str, Any]]) -> str:
    header = ["decode", "splats", "SH", "JavaScript ms", "M splats/s", "Python ms", "M splats/s"]
    rows = []
    for one in results:
        times = [one["seconds"], one["pythonSeconds"]]
        cells = [text for time in times for text in (f"{1000 * time:.0f}", f"{one['splats'] / time / 1e6:.2f}")]
        rows.append([one["file"].partition(".")[0], f"{one['splats']:,}", one["shDegree"], *cells])
    return f"\n{format_table(header, rows)}" if rows else ""


if __name__ == "__main__":
    main()
