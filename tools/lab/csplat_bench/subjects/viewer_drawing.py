# SPDX-License-Identifier: Apache-2.0
"""The viewer's engine in Chromium: milliseconds of culling, sorting and drawing, memory on the GPU.

A case is a `preset`. Without option `gpu`, SwiftShader draws, a GL on the CPU, whose frames say nothing about a GPU's.
Values are medians over four views, 640 by 480; names are the engine's.
"""

from __future__ import annotations

import statistics
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from csplat.decoder import decode
from csplat.encode_api import encode
from csplat.encoder import EncodeOptions
from csplat.ply import read_ply
from csplat_bench.browser import open_page
from csplat_bench.protocol import Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.suites import Case
from csplat_render.camera import Camera
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.present.viewer_server import open_server, open_viewer_scene

_WIDTH, _HEIGHT, _VIEWS = 640, 480, 4
_SORT_ZOOM = 1 / 8  # sorting does not depend on the size of the frame, drawing does
_KEYS = (
    "cullMs", "sortMs", "frameMs", "inView", "gpuBytesPerSplat", "expandedBytesPerSplat", "decodeMs", "wholeMs",
    "pictureFormat", "glRenderer",
)  # fmt: skip

# An engine on a canvas of its own; a camera is [pinhole, width, height].
_MAKE = """async () => {
  const { createEngine } = await import('/tools/viewer/engine.mjs');
  window.bench?.close();
  window.bench = await createEngine(document.createElement('canvas'), { backend: 'webgl2' });
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


@contextmanager
def measure_drawing(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that opens a file and draws it from all views once."""
    scene = find_scene(name, setup.data, setup.work)
    with ExitStack() as stack:
        page = stack.enter_context(open_page(setup.chromium, gpu=setup.options.get("gpu", False)))

        def measure(case: Case) -> Mapping[str, Any]:
            path = setup.work / f"{scene.name}.{case['preset']}.viewer.csplat"
            if not path.exists():
                path.write_bytes(encode(read_ply(scene.path), EncodeOptions(preset=case["preset"])))
            return {"splats": scene.splat_count, "sh_degree": scene.sh_degree, **draw(page, path)}

        yield measure


def draw(page: Any, path: Path) -> dict[str, Any]:
    """Open a file in the engine, and draw it from all views."""
    cameras = virtual_cameras(decode(path.read_bytes()), _VIEWS, _WIDTH, _HEIGHT)
    with _open_viewer(page, path, _pinhole(cameras[0], _SORT_ZOOM)) as opened:
        sorts, frames = [], list[float]()
        for camera in cameras:
            page.evaluate(_LOOK, _pinhole(camera, _SORT_ZOOM))
            sorts.append(page.evaluate(_SORT))
        for camera in cameras:
            page.evaluate(_LOOK, _pinhole(camera))
            frames += page.evaluate("(count) => bench.timeFrames(count)", 1)
        stats = {**page.evaluate("({ ...bench.stats })"), "wholeMs": opened["wholeMs"]}
    cull, sort, seen = (statistics.median(column) for column in zip(*sorts, strict=True))
    stats |= {"cullMs": cull, "sortMs": sort, "inView": seen, "frameMs": statistics.median(frames)}
    return {key: stats[key] for key in _KEYS}


@contextmanager
def _open_viewer(page: Any, path: Path, view: list[Any]) -> Iterator[Any]:
    """Serve a file as `csplat view` does, and open it; yield the engine's report."""
    with open_viewer_scene(str(path), preset="balanced") as scene, open_server(scene) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            page.goto(f"{server.url}tools/viewer/index.html")
            page.evaluate(_MAKE)
            page.evaluate(_LOOK, view)
            yield page.evaluate(_OPEN, f"{server.url}scene/{scene.name}")
            page.evaluate("bench.close()")
        finally:
            server.shutdown()
            thread.join()


def _pinhole(camera: Camera, zoom: float = 1.0) -> list[Any]:
    K = camera.K * zoom
    pinhole = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "near": camera.near}
    return [{"viewmat": camera.viewmat.ravel().tolist(), **pinhole}, int(camera.W * zoom), int(camera.H * zoom)]
