"""A page in Chromium where the engines of others find what they need, and the place that a scene is looked at from."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from csplat.editing.transform import convert_axes
from csplat.errors import InputError
from csplat.formats.format import Format
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat.scene_source import source_from_model
from csplat_bench.common.browser import open_page, serve
from csplat_bench.common.peers import npm_pinned
from csplat_bench.common.scenes import ROOT, Scene
from csplat_bench.viewer.rules import ENGINES, drawn
from csplat_render import Camera
from csplat_render.camera_paths import orbit_cameras
from csplat_render.metrics import psnr

WIDTH, HEIGHT = 320, 240  # SwiftShader takes its time

_PLACES = 8
_PACKAGES = {
    "three": "0.187", "playcanvas": "2.23", "@babylonjs/core": "9", "@babylonjs/loaders": "9", "@adobe/spz": "0.2",
    "@sparkjsdev/spark": "2.2",
}  # fmt: skip
_IMPORTS = {
    "three": "three/build/three.webgpu.js", "three/webgpu": "three/build/three.webgpu.js",
    "three/tsl": "three/build/three.tsl.js", "three/addons/": "three/examples/jsm/",
    "playcanvas": "playcanvas/build/playcanvas.mjs", "playcanvas/scripts/": "playcanvas/scripts/",
    "@babylonjs/core/": "@babylonjs/core/", "@babylonjs/loaders/": "@babylonjs/loaders/",
    "@sparkjsdev/spark": "@sparkjsdev/spark/dist/spark.module.js",
    "@playcanvas/supersplat-viewer/": "@playcanvas/supersplat-viewer/dist/",
}  # fmt: skip
#: Spark is made for three's WebGLRenderer, not for the WebGPURenderer of three's own splats.
_CLASSIC = ("/node_modules/@sparkjsdev/", "/pages/spark.mjs")
_PAGE = """<!doctype html><link rel="icon" href="data:,"><body style="margin:0;background:#000">
<canvas style="display:block"></canvas><script type="importmap">{"imports":%s,"scopes":%s}</script>"""


@contextmanager
def opened_page(
    chromium: str,
    peers: Path,
    more: Mapping[str, str] | None = None,
    serving: Callable[[Path], AbstractContextManager[str]] = serve,
    *,
    webgpu: bool = False,
) -> Iterator[tuple[Any, Path, str]]:
    """A browser, and what `served` gives.

    Args:
        chromium: the program.
        peers: folder of npm packages.
        more: packages in addition to the engines', and how their versions begin.
        serving: serves a folder, gives its address.
        webgpu: whether the browser supports WebGPU.

    Yields:
        playwright's page, the folder, its address.

    Raises:
        InputError: packages cannot be had.
    """
    failed = npm_pinned(peers, {**_PACKAGES, **(more or {})})
    if failed:
        raise InputError(failed)
    with (
        served(peers / "node_modules", serving) as (folder, address),
        open_page(chromium, gpu=False, webgpu=webgpu) as page,
    ):
        yield page, folder, address


@contextmanager
def served(
    packages: Path, serving: Callable[[Path], AbstractContextManager[str]] = serve
) -> Iterator[tuple[Path, str]]:
    """A served folder where `page.html` finds the engines and the modules that load files into them.

    Args:
        packages: the folder `node_modules`.
        serving: serves a folder, gives its address.

    Yields:
        the folder, its address.
    """
    with tempfile.TemporaryDirectory(prefix="csplat-stage-") as name, serving(Path(name)) as address:
        folder = Path(name)
        (folder / "node_modules").symlink_to(packages.resolve())
        (folder / "pages").symlink_to(Path(__file__).with_name("pages"))
        for place in ("codec/js", "tools/viewer"):  # as the viewer's modules find the decoder's
            (folder / place).parent.mkdir()
            (folder / place).symlink_to(ROOT / place)
        imports = {word: f"/node_modules/{path}" for word, path in _IMPORTS.items()}
        imports |= {f"csplat-decoder/{name}": f"/codec/js/engines/{name}.mjs" for name in ENGINES}
        scopes = {key: {"three": "/node_modules/three/build/three.module.js"} for key in _CLASSIC}
        (folder / "page.html").write_text(_PAGE % (json.dumps(imports), json.dumps(scopes)))
        yield folder, address


def looked_at(scene: Scene) -> tuple[SplatModel, Camera]:
    """A scene with the one camera that it is looked at from: of eight around it that where SH shows most."""
    model = read_ply(scene.path)
    cameras = orbit_cameras(model, _PLACES, WIDTH, HEIGHT)
    chosen = min(cameras, key=lambda camera: psnr(drawn(model, camera), drawn(model, camera, sh_degree=0)))
    return replace(model, cameras=[chosen.to_json()]), chosen


def placed_in(form: Format, model: SplatModel) -> tuple[SplatModel, Camera]:
    """Return a scene along a format's axes, and its camera."""
    placed = convert_axes(source_from_model(model), form.axes).metadata_model if form.axes else model
    return placed, Camera.from_json((placed.cameras or [])[0])


def pinhole(camera: Camera, model: SplatModel) -> dict[str, Any]:
    """A camera as the pages want it: `view` of column vectors, column by column, y down, z forward; degrees.

    `depth` is that of half of what lies in front of it, scene units.
    """
    depths = model.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    return {
        "view": camera.viewmat.T.ravel().tolist(),
        "fovY": float(np.degrees(2.0 * np.arctan(camera.H / 2.0 / camera.K[1, 1]))),
        "width": camera.W, "height": camera.H, "near": camera.near, "far": 2.0 * float(np.abs(depths).max()),
        "depth": float(np.median(depths[depths > camera.near])),
    }  # fmt: skip
