"""A page in Chromium that runs the viewer's engine alone, and what is measured in it."""

from __future__ import annotations

import statistics
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

from csplat.decoder import decode
from csplat_render.camera import Camera
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.present.viewer_server import open_server, open_viewer_scene

WIDTH, HEIGHT = 640, 480

_VIEWS = 4
_SORT_ZOOM = 1 / 8  # sorting does not depend on the size of the picture, drawing does

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
class File:
    """A file to look at."""

    name: str
    preset: str
    path: Path


class Drawn(TypedDict):
    """Medians over some views; names as the engine has them. Milliseconds, bytes."""

    name: str
    preset: str
    splatCount: int
    inView: float
    cullMs: float
    sortMs: float
    frameMs: float
    gpuBytesPerSplat: float
    expandedBytesPerSplat: int
    decodeMs: float
    wholeMs: float
    pictureFormat: str
    glRenderer: str


def drawn(page: Any, file: File, runs: int) -> Drawn:
    """Open a file, look at it from some places, and draw it there."""
    cameras = virtual_cameras(decode(file.path.read_bytes()), _VIEWS, WIDTH, HEIGHT)
    with _served(page, file, _pinhole(cameras[0], _SORT_ZOOM)) as opened:
        sorts = []
        for camera in cameras * runs:
            page.evaluate(_LOOK, _pinhole(camera, _SORT_ZOOM))
            sorts.append(page.evaluate(_SORT))
        frames: list[float] = []
        for camera in cameras:
            page.evaluate(_LOOK, _pinhole(camera))
            frames += page.evaluate("(count) => bench.timeFrames(count)", max(1, runs // 2))
        stats = {**page.evaluate("({ ...bench.stats })"), "wholeMs": opened["wholeMs"], "name": file.name}
    cull, sort, seen = (statistics.median(column) for column in zip(*sorts, strict=True))
    stats |= {"preset": file.preset, "cullMs": cull, "sortMs": sort, "inView": seen}
    stats["frameMs"] = statistics.median(frames)
    result: Drawn = {name: stats[name] for name in Drawn.__annotations__}  # type: ignore[assignment]  # all of its names
    return result


@contextmanager
def _served(page: Any, file: File, view: list[Any]) -> Iterator[Any]:
    """Serve a file as `csplat view` does and open it from somewhere; yields the engine's report."""
    with open_viewer_scene(str(file.path), preset="balanced") as scene, open_server(scene) as server:
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
