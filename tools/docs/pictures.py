"""Make the pictures of README and documentation from the sample scene: two renders, a plot, views of the tutorial.

What the plot shows stands in `measured.json`: bytes, PSNR over the eight views of `csplat compare`, seconds, and the
versions of all programs. `--measure` takes those figures anew, on an idle machine; it needs npm, for splat-transform,
and some minutes. `--tutorial` takes a scene and a page that the commands of `guide/tutorial.md` left behind, and needs
Chromium. `--engines` takes what `python -m csplat_bench.viewer.owners --scenes sample --formats csplat --out FOLDER`
left behind.

Usage:
    python tools/docs/pictures.py [--measure] [--peers FOLDER] [--tutorial FOLDER] [--engines FOLDER]
"""

from __future__ import annotations

import argparse
import io
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import csplat
from csplat.encoder import PresetName
from csplat.types import U8
from csplat_bench.common.measuring import timed
from csplat_bench.common.peers import find_splat_transform
from csplat_bench.common.plots import new_figure, save_svg
from csplat_bench.common.report import describe
from csplat_render import Camera, render
from csplat_render.camera import intrinsics, look_at
from csplat_render.scorer import Scorer
from csplat_tools.file_streams import write_bytes, write_json
from csplat_tools.views.view_sets import comparison_cameras

FOLDER = Path(__file__).resolve().parent
SAMPLE = FOLDER.parent / "csplat_tools" / "data" / "sample.ply"
PICTURES = FOLDER / "pictures"
MEASURED = FOLDER / "measured.json"
SHOWN: PresetName = "balanced"  # preset of the file shown next to the source

_PRESETS: tuple[PresetName, ...] = ("fast", "balanced", "small")
_WHOLE = (30, 34, 38, 42, 46, 50)  # dB wanted, every splat kept
_FEWER = (30, 34, 38)  # dB wanted, splats removed and the others fitted
_RUNS = 5
_WIDTH, _HEIGHT = 640, 480
_QUALITY = 86
_ENGINES = ("three", "spark", "playcanvas", "babylon")
# Okabe and Ito's colours, told apart by all eyes.
_OURS, _FITTED, _SPZ, _SOG = "#0072B2", "#009E73", "#D55E00", "#CC79A7"


def main() -> None:
    """Read the command line, make the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", action="store_true", help="take all figures anew")
    parser.add_argument("--peers", type=Path, default=Path("out/npm"), metavar="FOLDER", help="for npm packages")
    parser.add_argument("--tutorial", type=Path, metavar="FOLDER", help="where its commands were run")
    parser.add_argument("--engines", type=Path, metavar="FOLDER", help="pictures of the sample in engines")
    arguments = parser.parse_args()
    if arguments.measure:
        write_json(str(MEASURED), measure(arguments.peers))
    draw_scene()
    draw_curves(json.loads(MEASURED.read_text("utf-8")))
    if arguments.tutorial is not None:
        draw_tutorial(arguments.tutorial)
    if arguments.engines is not None:
        _save(_row([arguments.engines / f"sample-{name}-csplat.png" for name in _ENGINES]), "engines.webp")
    for path in sorted(PICTURES.iterdir()):
        print(f"{path.name}: {path.stat().st_size:,} bytes")


def measure(peers: Path) -> dict[str, Any]:
    """Encode the sample in all ways that the plot shows.

    Args:
        peers: folder for npm packages.

    Returns:
        What `measured.json` holds: bytes, dB and least seconds by name, and what took them.
    """
    source = csplat.read_ply(SAMPLE)
    judge = Scorer.of_source(source, comparison_cameras(source))
    presets = {}
    for name in _PRESETS:
        options = csplat.EncodeOptions(preset=name)
        runs = [timed(csplat.encode, source, options) for _ in range(_RUNS)]
        presets[name] = {**_scored(judge, runs[0][0]), "seconds": round(min(one.wall for _, one in runs), 2)}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        whole = [_target(judge, folder, psnr, "--no-prune") for psnr in _WHOLE]
        fewer = [_target(judge, folder, psnr) for psnr in _FEWER]
        command, version = find_splat_transform(peers)
        if command is None:
            raise SystemExit(f"no splat-transform: {version}")
        others = {ending: _peer(judge, command, folder / f"sample.{ending}") for ending in ("spz", "sog")}
    return {
        "machine": describe(),
        "splat_transform": version,
        "source": {"bytes": SAMPLE.stat().st_size, "splats": len(source), "sh_degree": source.sh_degree},
        "presets": presets,
        "keep_all": whole,
        "fitted": fewer,
        **others,
    }


def draw_scene() -> None:
    """Render source and file from one place, with nothing behind them."""
    source = csplat.read_ply(SAMPLE)
    decoded = csplat.decode(csplat.encode(source, csplat.EncodeOptions(preset=SHOWN)))
    for name, model in (("source", source), (SHOWN, decoded)):
        picture = Image.fromarray(_cut_out(model, _camera()), "RGBA")
        _save(picture, f"sample-{name}.webp")


def draw_curves(measured: Mapping[str, Any]) -> None:
    """Plot PSNR over bytes. The same figures give the same bytes."""
    from matplotlib import rc_context

    splats = measured["source"]["splats"]
    version = measured["splat_transform"]
    with rc_context({"svg.fonttype": "none", "font.size": 10, "font.family": "sans-serif"}):
        figure = new_figure(7.2, 3.6)
        axis = figure.subplots()
        axis.set_xscale("log")
        for name, colour, label in (
            ("keep_all", _OURS, "csplat --target-psnr --no-prune"),
            ("fitted", _FITTED, "csplat --target-psnr: fewer splats, fitted anew"),
        ):
            rows = sorted(measured[name], key=lambda row: row["bytes"])
            style = "o-" if name == "keep_all" else "^-"
            axis.plot(*_xy(rows), style, color=colour, markersize=4.5, linewidth=1.6, label=label)
        axis.plot(*_xy(measured["presets"].values()), "s", color="0.15", markersize=5, label="csplat --preset")
        for name, one in measured["presets"].items():
            place, away = (one["bytes"] / 1000, one["psnr"]), (5, -11 if name == "fast" else -3)
            axis.annotate(name, place, away, textcoords="offset points", fontsize=9)
        for name, colour, marker in (("spz", _SPZ, "D"), ("sog", _SOG, "D")):
            one = measured[name]
            axis.plot(*_xy([one]), marker, color=colour, markersize=7, label=f"{name.upper()}, {version}")
        left, right = 35, 600
        axis.set_xlim(left, right)
        ticks = (50, 100, 200, 400)
        axis.set_xticks(ticks, [str(one) for one in ticks])
        axis.set_xticks([], minor=True)
        axis.set_xlabel(f"kB, of {measured['source']['bytes'] / 1000:,.0f} kB of PLY ({splats:,} splats, SH 3)")
        axis.set_ylabel("PSNR, dB")
        axis.grid(color="0.9", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(length=0)
        axis.legend(frameon=False, fontsize=8.5, loc="lower right")
        save_svg(figure, PICTURES / "bytes-psnr.svg")


def draw_tutorial(folder: Path) -> None:
    """Show what the commands of the tutorial left: photographs, one next to its render, the page in Chromium.

    Args:
        folder: with `photographs`, `garden.csplat` and `garden.html`.
    """
    names = [folder / "photographs" / "train" / f"{number:03d}.png" for number in (4, 9, 13, 18, 22, 27)]
    _save(_row(names), "tutorial-photographs.webp")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path="/usr/bin/chromium",
            args=["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        )
        page = browser.new_page(viewport={"width": _WIDTH, "height": _HEIGHT})
        page.goto((folder / "garden.html").resolve().as_uri())
        page.wait_for_selector("canvas")
        page.wait_for_timeout(8000)
        shot = Image.open(io.BytesIO(page.screenshot()))
        browser.close()
    _save(shot.convert("RGB"), "tutorial-page.webp")


def _row(names: Sequence[Path]) -> Image.Image:
    """Pictures of one size next to each other."""
    pictures = [Image.open(name).convert("RGBA") for name in names]
    width, height = pictures[0].size
    row = Image.new("RGBA", (width * len(pictures), height))
    for place, one in enumerate(pictures):
        row.paste(one, (place * width, 0))
    return row


def _target(judge: Scorer, folder: Path, psnr: int, *more: str) -> dict[str, Any]:
    """A file that reaches a PSNR, by the command itself."""
    path = folder / "target.csplat"
    words = ["encode", str(SAMPLE), str(path), "--target-psnr", str(psnr), "--force", "--quiet", *more]
    _, timing = timed(subprocess.run, [sys.executable, "-m", "csplat_tools", *words], check=True)
    return {**_scored(judge, path.read_bytes()), "wanted": psnr, "seconds": round(timing.wall, 1)}


def _peer(judge: Scorer, command: list[str], path: Path) -> dict[str, Any]:
    """A file of another format, with that program's defaults, and what the program reads from it."""
    back = path.with_name(path.name + ".ply")
    for given, made in ((SAMPLE, path), (path, back)):
        subprocess.run([*command, "-q", "-w", "-g", "cpu", str(given), str(made)], check=True, capture_output=True)
    return {"bytes": path.stat().st_size, "psnr": round(judge.psnr(csplat.read_ply(back)), 2)}


def _scored(judge: Scorer, data: bytes) -> dict[str, Any]:
    return {"bytes": len(data), "psnr": round(judge.psnr(csplat.decode(data)), 2)}


def _camera() -> Camera:
    """From a little above, near enough to fill the picture."""
    turn, height, distance = math.radians(215.0), math.radians(24.0), 3.2
    middle = np.array([0.0, -0.22, 0.0])  # y points down
    away = np.array([math.cos(height) * math.cos(turn), -math.sin(height), math.cos(height) * math.sin(turn)])
    K = intrinsics(_WIDTH, _HEIGHT, 42.0)
    return look_at(middle + distance * away, middle, (0, -1, 0), K, _WIDTH, _HEIGHT)


def _cut_out(model: csplat.SplatModel, camera: Camera) -> U8:
    """[H, W, 4], a render with nothing behind it."""
    seen = render(model, camera)
    alpha = np.clip(seen.alpha, 0.0, 1.0)[..., None]
    colour = np.clip(seen.rgb / np.maximum(alpha, 1e-3), 0.0, 1.0)
    return np.rint(255.0 * np.concatenate([colour, alpha], axis=-1)).astype(np.uint8)


def _save(picture: Image.Image, name: str) -> None:
    buffer = io.BytesIO()
    picture.save(buffer, "WEBP", quality=_QUALITY, method=6)
    write_bytes(str(PICTURES / name), buffer.getvalue())


def _xy(rows: Any) -> tuple[list[float], list[float]]:
    return [row["bytes"] / 1000 for row in rows], [row["psnr"] for row in rows]


if __name__ == "__main__":
    main()
