# SPDX-License-Identifier: Apache-2.0
"""Make the images of README and documentation from the sample scene.

`measured.json` holds the figures of the README's table and plot: bytes, PSNR over the eight views of `csplat compare`,
seconds, and versions. `--measure` updates them; run it on an idle machine with npm, for splat-transform, and then
`python -m csplat_bench pages`. `--tutorial` takes the output of the commands in `guide/tutorial.md` and needs Chromium.
`--engines` takes a folder of screenshots `sample-ENGINE-csplat.png`.

Usage:
    python tools/docs/pictures.py [--measure] [--peers FOLDER] [--tutorial FOLDER] [--engines FOLDER]
"""

from __future__ import annotations

import argparse
import io
import math
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import csplat
from csplat.encoder import PresetName
from csplat.image_opener import open_image
from csplat.types import U8
from csplat_bench.measuring import timed
from csplat_bench.peers import find_splat_transform, splat_transform_version
from csplat_bench.results import describe
from csplat_render import Camera, render
from csplat_render.camera import intrinsics, look_at
from csplat_render.first_view import viewing_metadata
from csplat_render.scorer import Scorer
from csplat_tools.file_streams import write_bytes, write_json
from csplat_tools.views.view_sets import comparison_cameras

FOLDER = Path(__file__).resolve().parent
SAMPLE = FOLDER.parent / "csplat_tools" / "data" / "sample.ply"
PICTURES = FOLDER / "pictures"
MEASURED = FOLDER / "measured.json"
SHOWN: PresetName = "balanced"  # preset of the file shown next to the source

_PRESETS: tuple[PresetName, ...] = ("fast", "balanced", "small")
_TARGETS = (30, 34, 38, 42, 46, 50)  # dB, every splat kept
_PRUNED_TARGETS = (30, 34, 38)  # dB, splats pruned and the rest refitted
_RUNS = 5
_WIDTH, _HEIGHT = 640, 480
_QUALITY = 86
_ENGINES = ("three", "spark", "playcanvas", "babylon")


def main() -> None:
    """Parse the command line and make the images."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", action="store_true", help="measure all figures again")
    parser.add_argument("--peers", type=Path, default=Path("out/npm"), metavar="FOLDER", help="folder of npm packages")
    parser.add_argument("--tutorial", type=Path, metavar="FOLDER", help="folder in which its commands were run")
    parser.add_argument("--engines", type=Path, metavar="FOLDER", help="screenshots of the sample scene in engines")
    arguments = parser.parse_args()
    if arguments.measure:
        write_json(str(MEASURED), measure(arguments.peers))
    draw_scene()
    if arguments.tutorial is not None:
        draw_tutorial(arguments.tutorial)
    if arguments.engines is not None:
        _save(_row([arguments.engines / f"sample-{name}-csplat.png" for name in _ENGINES]), "engines.webp")
    for path in sorted(PICTURES.iterdir()):
        print(f"{path.name}: {path.stat().st_size:,} bytes")


def measure(peers: Path) -> dict[str, Any]:
    """Encode the sample scene with every setting that the README shows.

    Args:
        peers: folder of npm packages.

    Returns:
        The content of `measured.json`.
    """
    source = csplat.read(SAMPLE)
    scorer = Scorer.of_source(source, comparison_cameras(source))
    viewed = source.with_metadata(viewing_metadata(source))  # as `csplat encode` writes it
    rows: list[dict[str, Any]] = []
    for name in _PRESETS:
        options = csplat.EncodeOptions(preset=name)
        runs = [timed(csplat.encode, viewed, options) for _ in range(_RUNS)]
        seconds = round(min(one.wall for _, one in runs), 2)
        rows.append(
            {"name": name, "preset": name, "series": "preset", **_scored(scorer, runs[0][0]), "seconds": seconds}
        )
    command = find_splat_transform(peers)
    with tempfile.TemporaryDirectory() as folder:
        rows += [_target(scorer, Path(folder), psnr, "--no-prune") for psnr in _TARGETS]
        rows += [_target(scorer, Path(folder), psnr) for psnr in _PRUNED_TARGETS]
        rows += [_peer(scorer, command, Path(folder) / f"sample.{ending}") for ending in ("spz", "sog")]
    machine, versions = describe()
    return {
        "command": "python tools/docs/pictures.py --measure",
        "machine": machine,
        "versions": {**versions, "splat_transform": splat_transform_version(peers).removeprefix("splat-transform ")},
        "source": {"size_bytes": SAMPLE.stat().st_size, "splats": len(source), "sh_degree": source.sh_degree},
        "rows": rows,
    }


def draw_scene() -> None:
    """Render the source and a file of it from one camera, on a transparent background."""
    source = csplat.read(SAMPLE)
    decoded = csplat.decode(csplat.encode(source, csplat.EncodeOptions(preset=SHOWN)))
    for name, model in (("source", source), (SHOWN, decoded)):
        picture = Image.fromarray(_cut_out(model, _camera()), "RGBA")
        _save(picture, f"sample-{name}.webp")


def draw_tutorial(folder: Path) -> None:
    """Show the results of the tutorial: photographs in a row, and the exported page in Chromium.

    Args:
        folder: contains `photographs` and `garden.html`.
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
        data = page.screenshot()
        browser.close()
    with open_image(data) as shot:
        _save(shot.convert("RGB"), "tutorial-page.webp")


def _row(names: Sequence[Path]) -> Image.Image:
    """Put images of one size next to each other."""
    pictures = [_read(name) for name in names]
    width, height = pictures[0].size
    row = Image.new("RGBA", (width * len(pictures), height))
    for place, one in enumerate(pictures):
        row.paste(one, (place * width, 0))
    return row


def _read(name: Path) -> Image.Image:
    with open_image(name) as picture:
        return picture.convert("RGBA")


def _target(scorer: Scorer, folder: Path, psnr: int, *options: str) -> dict[str, Any]:
    path = folder / "target.csplat"
    words = ["encode", str(SAMPLE), str(path), "--target-psnr", str(psnr), "--force", "--quiet", *options]
    _, timing = timed(subprocess.run, [sys.executable, "-m", "csplat_tools", *words], check=True)
    name = " ".join(["--target-psnr", str(psnr), *options])
    series = "no-prune" if options else "pruned"
    return {"name": name, "series": series, **_scored(scorer, path.read_bytes()), "seconds": round(timing.wall, 1)}


def _peer(scorer: Scorer, command: list[str], path: Path) -> dict[str, Any]:
    """Encode with another program's defaults, and score the scene that it decodes."""
    back = path.with_name(path.name + ".ply")
    for given, made in ((SAMPLE, path), (path, back)):
        subprocess.run([*command, "-q", "-w", "-g", "cpu", str(given), str(made)], check=True, capture_output=True)
    name, psnr = path.suffix[1:].upper(), round(scorer.psnr(csplat.read(back)), 2)
    return {"name": name, "series": name, "size_bytes": path.stat().st_size, "psnr": psnr}


def _scored(scorer: Scorer, data: bytes) -> dict[str, Any]:
    return {"size_bytes": len(data), "psnr": round(scorer.psnr(csplat.decode(data)), 2)}


def _camera() -> Camera:
    """Return a camera slightly above the scene, close enough to fill the image."""
    turn, height, distance = math.radians(215.0), math.radians(24.0), 3.2
    middle = np.array([0.0, -0.22, 0.0])  # y points down
    away = np.array([math.cos(height) * math.cos(turn), -math.sin(height), math.cos(height) * math.sin(turn)])
    K = intrinsics(_WIDTH, _HEIGHT, 42.0)
    return look_at(middle + distance * away, middle, (0, -1, 0), K, _WIDTH, _HEIGHT)


def _cut_out(model: csplat.SplatModel, camera: Camera) -> U8:
    """Render on a transparent background: [H, W, 4]."""
    seen = render(model, camera)
    alpha = np.clip(seen.alpha, 0.0, 1.0)[..., None]
    colour = np.clip(seen.rgb / np.maximum(alpha, 1e-3), 0.0, 1.0)
    return np.rint(255.0 * np.concatenate([colour, alpha], axis=-1)).astype(np.uint8)


def _save(picture: Image.Image, name: str) -> None:
    buffer = io.BytesIO()
    picture.save(buffer, "WEBP", quality=_QUALITY, method=6)
    write_bytes(str(PICTURES / name), buffer.getvalue())


if __name__ == "__main__":
    main()
