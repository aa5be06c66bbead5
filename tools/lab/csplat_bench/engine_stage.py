# SPDX-License-Identifier: Apache-2.0
"""Engines of others: a page in Chromium with their packages, the view of a scene, and our renders by their rules.

Rules are the known differences in how an engine draws; what still differs from our renders is due to the file.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import scene as csplat_scene
from csplat.editing.transform import convert_axes
from csplat.formats.format import Format
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat.spherical_harmonics import SH_C0, evaluate_sh
from csplat_bench.browser import open_page, serve
from csplat_bench.peers import npm_pinned
from csplat_bench.scenes import ROOT, Scene
from csplat_render import Camera, render
from csplat_render.camera_paths import orbit_cameras
from csplat_render.metrics import psnr

Image = NDArray[np.float32]

DEGREE = 3
WIDTH, HEIGHT = 320, 240  # pixels; SwiftShader is slow

_CAMERAS = 8  # around a scene
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
# Spark needs three's WebGLRenderer; three's own splats need its WebGPURenderer.
_CLASSIC = ("/node_modules/@sparkjsdev/", "/pages/spark.mjs", "/codec/js/engines/spark.mjs")
_PAGE = """<!doctype html><link rel="icon" href="data:,"><body style="margin:0;background:#000">
<canvas style="display:block"></canvas><script type="importmap">{"imports":%s,"scopes":%s}</script>"""


@dataclass(frozen=True)
class Engine:
    """A program that draws splats, and its rules.

    Attributes:
        title: its name.
        reads: formats, by their names in `csplat.formats.formats()`.
        clips: it clips the colour of a splat to 0..1, that of degree 0 as well before adding the other bands.
        thin: it dilates splats half as far as we do.
        antialiased: it compensates opacity for the dilation, whatever a file declares.
    """

    title: str
    reads: tuple[str, ...]
    clips: bool = False
    thin: bool = False
    antialiased: bool = False

    def render(self, model: SplatModel, camera: Camera, sh_degree: int) -> Image:
        """Render by these rules."""
        shown = _colour(model, camera, min(sh_degree, model.sh_degree)) if self.clips else model
        if self.thin:  # twice as large, then every other pixel, with centres where they were
            K = 2.0 * camera.K
            K[2] = 0.0, 0.0, 1.0
            K[:2, 2] -= 0.5
            camera = replace(camera, K=K, W=2 * camera.W, H=2 * camera.H)
        step = 2 if self.thin else 1
        return screen_render(shown, camera, antialiased=self.antialiased or None, sh_degree=sh_degree)[::step, ::step]


#: By the names of their pages.
ENGINES = {
    "three": Engine("three.js", ("ply", "csplat", "gltf", "spz", "spz4", "splat"), clips=True, antialiased=True),
    "playcanvas": Engine("PlayCanvas", ("ply", "csplat", "gltf", "sog", "compressed-ply", "spz4"), thin=True),
    "babylon": Engine(
        "Babylon.js", ("ply", "csplat", "gltf", "sog", "compressed-ply", "spz", "spz4", "splat"), clips=True, thin=True
    ),
    "spark": Engine("Spark", ("ply", "csplat")),
}


@contextmanager
def opened_page(
    chromium: str,
    peers: Path,
    more: Mapping[str, str] | None = None,
    serving: Callable[[Path], AbstractContextManager[str]] = serve,
    *,
    webgpu: bool = False,
) -> Iterator[tuple[Any, Path, str]]:
    """Open a page that can import the engines.

    Args:
        chromium: the program.
        peers: folder of npm packages.
        more: further packages, and how their versions begin.
        serving: serves a folder, yields its address.
        webgpu: enable WebGPU.

    Yields:
        playwright's page, the folder, its address.

    Raises:
        AbsentError: packages or the browser cannot be installed.
    """
    npm_pinned(peers, {**_PACKAGES, **(more or {})})
    with (
        served(peers / "node_modules", serving) as (folder, address),
        open_page(chromium, gpu=False, webgpu=webgpu) as page,
    ):
        yield page, folder, address


@contextmanager
def served(
    packages: Path, serving: Callable[[Path], AbstractContextManager[str]] = serve
) -> Iterator[tuple[Path, str]]:
    """Serve a folder whose `page.html` can import the engines and the modules that load files into them.

    Args:
        packages: the folder `node_modules`.
        serving: serves a folder, yields its address.

    Yields:
        the folder, its address.
    """
    with tempfile.TemporaryDirectory(prefix="csplat-stage-") as name, serving(Path(name)) as address:
        folder = Path(name)
        (folder / "node_modules").symlink_to(packages.resolve())
        (folder / "pages").symlink_to(Path(__file__).parent / "subjects" / "pages")
        for path in ("codec/js", "tools/viewer"):  # the viewer's modules import the decoder's by this path
            (folder / path).parent.mkdir()
            (folder / path).symlink_to(ROOT / path)
        imports = {name: f"/node_modules/{path}" for name, path in _IMPORTS.items()}
        imports |= {f"csplat-decoder/{name}": f"/codec/js/engines/{name}.mjs" for name in ENGINES}
        scopes = {key: {"three": "/node_modules/three/build/three.module.js"} for key in _CLASSIC}
        (folder / "page.html").write_text(_PAGE % (json.dumps(imports), json.dumps(scopes)))
        yield folder, address


def chosen_view(scene: Scene) -> tuple[SplatModel, Camera]:
    """Return a scene with one camera: the one of eight around it in whose render SH changes most."""
    model = read_ply(scene.path)
    cameras = orbit_cameras(model, _CAMERAS, WIDTH, HEIGHT)
    chosen = min(
        cameras,
        key=lambda camera: psnr(screen_render(model, camera), screen_render(model, camera, sh_degree=0)),
    )
    return replace(model, metadata=replace(model.metadata, cameras=[chosen.as_json()])), chosen


def placed_in(form: Format, model: SplatModel) -> tuple[SplatModel, Camera]:
    """Return a scene along a format's axes, and its camera."""
    placed = convert_axes(csplat_scene.Scene.of(model), form.axes).empty() if form.axes else model
    return placed, Camera.from_json((placed.metadata.cameras or [])[0])


def pinhole(camera: Camera, model: SplatModel) -> dict[str, Any]:
    """Return a camera for the pages.

    `view` holds column vectors, column by column, y down, z forward; `fovY` is in degrees; `depth` is the median depth
    of the splats in front of the camera, scene units.
    """
    depths = model.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    return {
        "view": camera.viewmat.T.ravel().tolist(),
        "fovY": float(np.degrees(2.0 * np.arctan(camera.H / 2.0 / camera.K[1, 1]))),
        "width": camera.W, "height": camera.H, "near": camera.near, "far": 2.0 * float(np.abs(depths).max()),
        "depth": float(np.median(depths[depths > camera.near])),
    }  # fmt: skip


def screen_render(
    model: SplatModel, camera: Camera, *, antialiased: bool | None = None, sh_degree: int = DEGREE
) -> Image:
    """Render as a screen shows it, in 0..1."""
    return np.clip(render(model, camera, antialiased=antialiased, sh_degree=sh_degree).rgb, 0.0, 1.0)


def _colour(model: SplatModel, camera: Camera, degree: int) -> SplatModel:
    """Return the splats with the clipped colours that a camera sees, without SH."""
    directions = model.means - camera.position
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = evaluate_sh(degree, directions)[:, 1:]
    colours = np.clip(0.5 + SH_C0 * model.sh0, 0.0, 1.0)
    colours += np.einsum("nk,nkc->nc", basis, model.shN[:, : basis.shape[1]])
    sh0 = (np.clip(colours, 0.0, 1.0) - 0.5) / SH_C0
    return replace(model, sh0=sh0.astype(np.float32), shN=model.shN[:, :0])
